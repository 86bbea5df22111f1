"""A slider on a rough surface: its laws, its generated model and the values of its parameters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from srfcli.codegen.model import GeneratedModel, open_model
from srfcli.core.errors import SrfError, as_names, explained
from srfcli.core.settings import DEFAULTS, Parameter, Resolved, resolve
from srfcli.laws.registry import Registry, chosen_instead, load_registry
from srfcli.laws.values import Effect, Law

if TYPE_CHECKING:
    from srfcli.symbolic.system import System


@dataclass(frozen=True)
class SlidingSystem:
    """A slider with its laws and parameters, as `srfcli.system` makes it.

    Attributes
    ----------
    resolved : Resolved
        The value of every parameter, and where it comes from.
    formulas : System
        The laws joined to one system, as sympy expressions. Raises SrfError if the system has effects.
    model : GeneratedModel
        Functions of arrays, in um, s, N: those of steady sliding and of a modulation that lasts. Raises SrfError for an effect
        that neither depends on.
    motion : GeneratedModel
        The same for motion in time, under any drive and load. Differs from `model` if the system has effects.
    """

    resolved: Resolved = field(repr=False)
    opener: Opener = field(repr=False)
    title: str

    @property
    def formulas(self) -> System:
        """Return the system of formulas, from which the models are generated."""
        return self.opener.formulas

    @property
    def model(self) -> GeneratedModel:
        """Return the model of steady sliding and its stability."""
        return self.opener.model

    @property
    def motion(self) -> GeneratedModel:
        """Return the model of motion in time."""
        return self.opener.motion

    @property
    def parameters(self) -> dict[str, float]:
        """Return name -> value of every parameter, in its declared unit."""
        return dict(self.resolved.declared)

    def described(self, *, without: Iterable[str] = ()) -> dict[str, dict[str, Any]]:
        """Return name -> {value, unit, origin} of the parameters, but for those that are swept."""
        left = set(without)
        return {k: v for k, v in self.resolved.described().items() if k not in left}

    def vector(self, **declared: float) -> NDArray[Any]:
        """Return the parameters (n_parameters,) of `model` in um, s, N, some at other values in their declared units."""
        from srfcli.core.units import to_base

        units = {q.name: q.unit for q in self.resolved.parameters}
        moved = {n: to_base(float(v), units[n]) for n, v in declared.items()}
        return self.model.vector({**self.resolved.values, **moved})

    def at(self, **parameters: float | str) -> SlidingSystem:
        """Return the same system with other values of some parameters, as numbers in declared units or text with a unit.

        Raises
        ------
        SrfError
            For a name that the system does not have, a value out of bounds or a unit that does not fit.
        """
        kept = {n: v for n, v in self.resolved.declared.items() if self.resolved.origins[n] != "law default"}
        flags = {**kept, **parameters}
        return SlidingSystem(resolve(self.resolved.parameters, flags, env={}, where=self.title), self.opener, self.title)

    def __repr__(self) -> str:
        return f"<SlidingSystem: {self.title}>"


@explained
def system(
    law: str = str(DEFAULTS["law"].value),
    *,
    ageing: str = str(DEFAULTS["ageing"].value),
    interface: str = str(DEFAULTS["interface"].value),
    loading: str = str(DEFAULTS["loading"].value),
    inertia: bool = True,
    effects: str | Sequence[str] = (),
    plugins: Sequence[str | Path] = (),
    parameters: Mapping[str, float | str] | None = None,
    **more: float | str,
) -> SlidingSystem:
    """Return a slider with these laws and parameters.

    Parameter values are not read from settings files or environment variables.

    Parameters
    ----------
    law, ageing, interface : str
        Names of laws, or paths of their files; modifiers of the ageing law follow it after a plus sign.
    loading : {'vertical', 'inclined'}
        How the normal load is applied.
    inertia : bool
        Whether the slider's mass counts.
    effects : str or sequence of str
        Effects that the system has besides its laws, names or paths of files.
    plugins : sequence of path
        Folders in which laws are looked for, too.
    parameters, **more : number or str
        Values in declared units (um, s, N, kg, Hz, deg), or text with a unit; those not given are the laws' own. A name that
        is no Python name, such as lambda, goes into `parameters`.

    Returns
    -------
    SlidingSystem

    Raises
    ------
    SrfError
        For an unknown law or parameter, a value out of bounds or a unit that does not fit.

    References
    ----------
    Cochard, Bureau and Baumberger (2003), Trans. ASME J. Appl. Mech. 70, 220: the default laws and values.

    Examples
    --------
    >>> import srfcli as srf
    >>> pmma = srf.system("srf-vsat", K="210 N/mm", parameters={"lambda": 0.6})
    >>> pmma
    <SlidingSystem: srf-vsat, dieterich, elastic, vertical, inertia on>
    >>> pmma.parameters["K"], pmma.at(K=0.3).parameters["K"]
    (0.21, 0.3)
    """
    effects = as_names(effects, "effects")
    words = [w.strip() for text in (law, ageing, interface, *effects) for w in text.split("+")]
    registry = load_registry([Path(p) for p in plugins], named=[Path(w) for w in words if w.endswith(".py")])
    if inertia not in (True, False):
        raise SrfError(f"`inertia` {inertia!r} is neither True nor False", "True, where the slider's mass counts.")
    names = {"law": law, "ageing": ageing, "interface": interface, "loading": loading, "inertia": bool(inertia)}
    opener = Opener(registry, names, effects)
    model = opener.motion if why_not_steady(registry, effects) else opener.model
    given = {**(parameters or {}), **more}
    return SlidingSystem(resolve(declared(model), given, env={}, where=model.title), opener, model.title)


@dataclass(frozen=True, eq=False)
class Opener:
    """Opens the formulas and the models of the system that `names`, those of `open_model`, and effects describe.

    Raises SrfError for an effect that only changes what the system is; the model of stability for one that it does not have.
    """

    registry: Registry
    names: Mapping[str, Any]
    effects: Sequence[str] = ()

    def __post_init__(self) -> None:
        check_effects(self.registry, self.effects)

    @cached_property
    def formulas(self) -> System:
        """Return the laws joined to a system of formulas; raises SrfError for a system with effects, which have none here."""
        from srfcli.symbolic.system import build_system

        if self.effects:
            what = f"effect '{self.effects[0]}' has no part in a derivation"
            raise SrfError(what, "Leave it out; a modifier is part of the ageing law.")
        return build_system(self.registry, **self.names)

    @cached_property
    def model(self) -> GeneratedModel:
        """Return the model of steady sliding and its stability."""
        if reason := why_not_steady(self.registry, self.effects):
            raise SrfError(reason, "Leave it out.")
        return open_model(self.registry, **self.names, effects=self.effects, stability=True)

    @cached_property
    def motion(self) -> GeneratedModel:
        """Return the model of motion in time."""
        if not self.effects:
            return self.model
        return open_model(self.registry, **self.names, effects=self.effects, stability=False)


def why_not_steady(registry: Registry, effects: Sequence[str]) -> str:
    """Return why critical loads do not depend on one of these effects; nothing where they depend on all."""
    if not effects:
        return ""
    from srfcli.symbolic.system import without_part

    for name in effects:
        effect = registry.get("effect", name)
        if isinstance(effect, Effect) and (reason := without_part(effect)):
            return f"critical loads do not depend on '{effect.name}': it {reason}"
    return ""


def check_effects(registry: Registry, effects: Sequence[str]) -> None:
    """Raise SrfError for an effect that is named twice, or has no formula of its own and only changes what the system is."""
    for name in as_names(effects, "effects"):
        effect = registry.get("effect", name)
        assert isinstance(effect, Effect)
        if instead := chosen_instead(effect):
            raise SrfError(f"'{effect.name}' only replaces what the system is", f"Choose {' and '.join(instead)}.")


def declared(model: GeneratedModel) -> tuple[Parameter, ...]:
    """Return the parameters of a model that a person sets: what effects ask of a run is not among them."""
    if "begin" not in model.names:
        return model.parameters
    from srfcli.symbolic.system import RUN_SYMBOLS

    return tuple(p for p in model.parameters if p not in RUN_SYMBOLS)


@explained
def load_law(name: str | Path, *, kind: str = "friction", plugins: Sequence[str | Path] = ()) -> Law:
    """Return a law as a value: its formula, parameters, references and checks.

    Parameters
    ----------
    name : str or path
        Name of a registered law, or the path of a law's file.
    kind : {'friction', 'ageing', 'modifier', 'interface', 'effect'}
        Which of the kinds `srf laws` lists.
    plugins : sequence of path
        Folders in which laws are looked for, too.

    Returns
    -------
    Law

    Raises
    ------
    SrfError
        For a name that is not registered, or a file that is no law.

    Examples
    --------
    >>> import srfcli as srf
    >>> law = srf.load_law("srf-vsat")
    >>> law.mu
    A*log(v/V0) + B*log(1 + Vsat*phi/D0) + mu0
    >>> [p.name for p in law.parameters]
    ['mu0', 'A', 'B', 'D0', 'V0', 'Vsat']
    """
    text = str(name)
    registry: Registry = load_registry([Path(p) for p in plugins], named=[Path(text)] if text.endswith(".py") else [])
    return registry.get(kind, text)
