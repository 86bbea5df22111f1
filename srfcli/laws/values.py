"""Laws and readers are values: frozen, stateless, comparable; formulas are sympy expressions in named symbols."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srfcli.core.settings import Parameter

if TYPE_CHECKING:
    import sympy

# where an effect has a reference velocity and the friction law has none
REFERENCE_VELOCITY = Parameter("V0", 1.0, "um/s", 1e-12, about="reference velocity, no physical meaning of its own")


@dataclass(frozen=True)
class State:
    """A state variable of age type: its symbol, its characteristic slip length and its weight in mu (parameter names)."""

    name: str = "phi"
    length: str = "D0"
    weight: str = "B"


@dataclass(frozen=True)
class Check:
    """A worked value by which a law tests itself: `quantity` at the symbol values `at` equals `value`."""

    quantity: str
    at: tuple[tuple[str, float], ...]
    value: float
    rtol: float = 1e-9


@dataclass(frozen=True)
class Law:
    """What every law has: a name, parameters in declared units, prose, references, worked values and an origin."""

    name: str
    parameters: tuple[Parameter, ...] = ()
    about: str = ""
    cites: tuple[str, ...] = ()
    checks: tuple[Check, ...] = ()
    source: str = field(default="", compare=False)


@dataclass(frozen=True)
class FrictionLaw(Law):
    """mu(v, phi...): the friction coefficient as a function of slip velocity, state variables and parameters."""

    mu: sympy.Expr = None
    states: tuple[State, ...] = (State(),)


@dataclass(frozen=True)
class AgeingLaw(Law):
    """phi' = rate, written for one state `phi` of length `D0` and weight `B`; applied to each state of the friction law.

    Symbols: v, phi, mu, mu_dot (dmu/dt), W, W_dot, F_dot_over_W (d(W mu)/dt / W), and the parameters, also the friction law's.
    """

    rate: sympy.Expr = None


@dataclass(frozen=True)
class AgeingModifier(Law):
    """A term that is added to the rate of any ageing law, in the same symbols."""

    term: sympy.Expr = None


@dataclass(frozen=True)
class Interface(Law):
    """The shear stiffness kappa of the interface as a function of W and parameters; None for a rigid one."""

    kappa: sympy.Expr | None = None


@dataclass(frozen=True)
class ExtraState:
    """An unknown that an effect brings along: its rate, its value in steady sliding; its logarithm is solved for, or itself."""

    name: str
    rate: sympy.Expr
    steady: sympy.Expr
    logarithmic: bool = False


@dataclass(frozen=True)
class Effect(Law):
    """A piece of physics nested in a baseline: at the `neutral` values of its parameters the model is the baseline.

    `changes` holds (slot, formula): mu, rate, kappa, W (the load on the asperities), force (along the track, on the slider), V,
    K (the spring's stiffness) or gauge (what it shows of the elongation); in a formula the slot's own name is what was there
    before. `settings` replace choices of the model (interface, inertia),
    `frees` names parameters of the apparatus that are fitted instead. `neutral` holds the sizes' neutral values, `scans` the
    inner parameters (unseen at neutral sizes) with the number of values to try. `answers` is the name under which it is reported.
    `scaled` holds (parameter, lower, upper or default, formula in the scales of a recording) for what takes a number's place.
    Those in `fixed` are never fitted: a reference load, say.
    One `on_request` is searched for only where it is named.
    A report says what is `wrong` where it is found, and its `remedy`.
    `constants` are numbers with units that formulas in `written` name; in `changes` and `states` their values stand, um, s, N.
    A hypothesis may have it act in one `run` alone.
    """

    changes: tuple[tuple[str, sympy.Expr], ...] = ()
    states: tuple[ExtraState, ...] = ()
    settings: tuple[tuple[str, str | bool], ...] = ()
    frees: tuple[str, ...] = ()
    neutral: tuple[tuple[str, float], ...] = ()
    scans: tuple[tuple[str, int], ...] = ()
    needs: tuple[str, ...] = ()
    lacks: tuple[str, ...] = ()
    observed: str = ""
    constitutive: bool = True
    answers: str = ""
    constants: tuple[Parameter, ...] = ()
    written: tuple[tuple[str, sympy.Expr], ...] = field(default=(), compare=False)
    scaled: tuple[tuple[str, str, sympy.Expr], ...] = ()
    on_request: bool = False
    fixed: tuple[str, ...] = ()
    wrong: str = ""
    remedy: str = ""
    run: str = ""

    @property
    def label(self) -> str:
        """Return the name of a hypothesis that has it: with the run, where it acts in one alone."""
        return f"{self.reported}[{self.run}]" if self.run else self.reported

    @property
    def reported(self) -> str:
        """Return the name under which a verdict has it: variants of one effect share one."""
        return self.answers or self.name

    @property
    def sizes(self) -> tuple[str, ...]:
        """Return the parameters that vanish, or are 1, in the baseline."""
        return tuple(name for name, _ in self.neutral)


# What a reader of data files is: a frozen value that turns a file into named columns.

Blocks = Callable[[tuple[int, ...]], Iterator[Sequence[Any]]]


@dataclass(frozen=True)
class Source:
    """The columns of one file: headings such as `time [s]`, and a function that reads some of them block by block.

    `blocks((2, 0))` yields pairs of equally long arrays, of columns 2 and 0. `rows` is their number where the file says it.
    `whole` is True where a column cannot be read in parts. `remarks` is what the user of a column should know, by heading.
    `about` is an estimate of their number, by which a file that is far too large is refused unread.
    """

    headings: tuple[str, ...]
    blocks: Blocks = field(repr=False)
    rows: int | None = None
    whole: bool = False
    remarks: Mapping[str, str] = field(default_factory=dict)
    about: int | None = None


@dataclass(frozen=True)
class Reader:
    """A kind of data file: how it is recognised and how it is read.

    `read(path)` returns a `Source`, or a mapping from headings to equally long arrays. `sniff(head)` tells the kind from the
    first 4096 bytes; without it the `suffixes` do.
    """

    name: str
    read: Callable[[Path], Source | Mapping[str, Any]] = field(repr=False)
    suffixes: tuple[str, ...] = ()
    sniff: Callable[[bytes], bool] | None = field(default=None, repr=False)
    about: str = ""
    source: str = field(default="", compare=False)
