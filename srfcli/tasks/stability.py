"""`derive`, `code`: a system's formulas; `linear`, `response`, `floquet`, `critical`, `continue`: its sliding and stability."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import SrfError, Status, as_names, check_choice, explained, worst
from srfcli.core.settings import check_value, require_parameter
from srfcli.core.units import to_base
from srfcli.numerics.hopf import closed_forms, hopf_points, steady_is_stable, weakening
from srfcli.numerics.plane import Axis, Plane, check_count
from srfcli.results.stability import (
    BoundaryResult,
    CodeResult,
    CriticalResult,
    DerivationResult,
    LinearResult,
    MeanFrictionResult,
    PaperResult,
    PeriodicResult,
    ResponseResult,
)

if TYPE_CHECKING:
    from srfcli.codegen.slider import Opener, SlidingSystem
    from srfcli.numerics.continuation import Boundary, ContinuationSettings
    from srfcli.numerics.critical import CriticalLine, LoadWindow

Values = Sequence[float] | float
Said = Callable[[str], None]


def swept(model: GeneratedModel, over: Mapping[str, Sequence[float] | float]) -> dict[str, tuple[float, ...]]:
    """Return parameter -> values in declared units; raises SrfError for an unknown name or a value out of bounds."""
    if not isinstance(over, Mapping):
        raise SrfError(f"over = {over!r} is no mapping from a parameter to its values", "Like {'V': [1, 10, 100]}.")
    return {name: checked(model, name, values) for name, values in over.items()}


def checked(model: GeneratedModel, name: str, values: Any) -> tuple[float, ...]:
    """Return the values of one parameter, a number or several, in its declared unit; raises SrfError as `swept` does.

    Each is a number or text with a unit.
    """
    parameter = require_parameter(name, model.parameters, where=model.title)
    listed = [values] if isinstance(values, str) or np.ndim(values) == 0 else list(values)
    if not listed:
        raise SrfError(f"{name}: expected a number or a list of numbers", f'Like {{"{name}": [1, 2, 5]}}.')
    return tuple(check_value(parameter, v) for v in listed)


def _ends(model: GeneratedModel, window: Any) -> tuple[float, float]:
    """Return the ends of a window of loads in N."""
    ends = checked(model, "W0", window)
    if len(ends) != 2 or not 0 < ends[0] < ends[1]:
        raise SrfError(f"`window` {window!r} is not two rising loads above 0", "Like (4, 500).")
    return ends[0], ends[1]


# `derive` and `code`: what follows from the laws by algebra, whatever the values.


@explained
def derive(system: SlidingSystem | Opener, *, extras: str | Sequence[str] = ()) -> DerivationResult:
    """Return steady state, slopes of friction, equations, dispersion relation and closed critical loads, by algebra.

    The coefficients C0, C1, ... of the dispersion relation are in the form and normalisation of the paper's appendix.

    Parameters
    ----------
    system : SlidingSystem
        The slider, from `srfcli.system`; the values of its parameters do not matter.
    extras : str or sequence of str
        Long parts: 'jacobian' of the equations, and their derivatives by the 'parameters'.

    Returns
    -------
    DerivationResult
        `.formulas` as sympy expressions; `.text`, `.latex`, `.python`, `.document`.

    Raises
    ------
    SrfError
        For an unknown part, or a system with effects.

    References
    ----------
    Cochard, Bureau and Baumberger (2003), Trans. ASME J. Appl. Mech. 70, 220: the appendix.

    Examples
    --------
    >>> import srfcli as srf
    >>> found = srf.derive(srf.system())
    >>> found.formulas["W0c"]
    (D0 - lambda*(mu_phi - mu_v))*(K - M*Omega_c**2)/(mu_phi - mu_v)
    """
    from srfcli.symbolic.derivation import EXTRAS

    extras = as_names(extras, "extras")
    for name in extras:
        check_choice("extras", name, EXTRAS)
    return DerivationResult(system.formulas, tuple(extras))


def check_paper() -> PaperResult:
    """Return the paper's printed equations, claims and words, held against what follows from its own model."""
    from srfcli.symbolic import paper

    return PaperResult(tuple(paper.check_paper()))


@explained
def code(system: SlidingSystem | Opener) -> CodeResult:
    """Return the NumPy module that computes everything numerical about steady sliding and its stability.

    Parameters
    ----------
    system : SlidingSystem
        The slider, from `srfcli.system`; the module takes the values of its parameters as arguments, in um, s, N.

    Returns
    -------
    CodeResult
        `.text` is the module, `.write(path)` keeps it, `.table` lists its functions.

    Raises
    ------
    SrfError
        For a system with an effect that steady sliding does not depend on.

    Examples
    --------
    >>> import srfcli as srf
    >>> module = srf.code(srf.system("dieterich-ruina"))
    >>> module.table.rows[0]
    ('positive_ratio', 'above, below', 'above/below where that is positive, else nan.')
    >>> module.write("model.py")
    """
    return CodeResult(system.model)


# `linear`: stability of steady sliding under constant load.

FEWEST_SAMPLES = 8  # of a line on which crossings are looked for

LOADS_TRIED = np.geomspace(1e-3, 1e5, 9)  # um, times K: where there is no Hopf point, stability is that of these
VELOCITIES_TRIED = tuple(np.geomspace(1.0, 100.0, 60).tolist())  # um/s


@explained
def linear(
    system: SlidingSystem, *, over: Mapping[str, Sequence[float] | float] | None = None, all_roots: bool = False
) -> LinearResult:
    """Return the critical load, K/W0 and frequency of steady sliding, from the exact characteristic polynomial.

    Parameters
    ----------
    system : SlidingSystem
        The slider, from `srfcli.system`.
    over : mapping from parameter to values, optional
        Values in declared units; a grid of their products. V from 1 to 100 um/s if left out.
    all_roots : bool
        Whether every Hopf point is listed, also where stability returns or other roots are unstable.

    Returns
    -------
    LinearResult
        One row for each point of the grid; where there is no Hopf point its status says so.

    Raises
    ------
    SrfError
        For a parameter that the system does not have or that has no part here, or a value out of bounds.

    References
    ----------
    Cochard, Bureau and Baumberger (2003), Trans. ASME J. Appl. Mech. 70, 220: the appendix.
    Rice and Ruina (1983), Trans. ASME J. Appl. Mech. 50, 343.

    Examples
    --------
    >>> import srfcli as srf
    >>> found = srf.linear(srf.system(), over={"V": [1, 10, 100]})
    >>> [round(W0, 4) for W0 in found.to_dataframe()["W0"]]
    [7.2832, 7.805, 13.0808]
    """
    grid = swept(system.model, over or {"V": VELOCITIES_TRIED})
    for name in set(grid) & {"W0", "eps", "f"}:
        what = "is what is found" if name == "W0" else "has no part in steady sliding under constant load"
        raise SrfError(f"{name} is swept and {what}", "Sweep another parameter, or use `srf critical`.")
    check_count(*map(len, grid.values()))
    points: list[dict[str, Any]] = []
    for values in itertools.product(*grid.values()):
        points += _rows(system, dict(zip(grid, values, strict=True)), all_roots)
    return LinearResult(system, grid, tuple(points))


def _rows(system: SlidingSystem, at: dict[str, float], all_roots: bool) -> list[dict[str, Any]]:
    """Return the rows of one parameter point: its critical load, or every Hopf point, or one row that says there is none."""
    model, p = system.model, system.vector(**at)
    value = {name: float(p[model.index(name)]) for name in model.names}
    common: dict[str, Any] = {n: model.declared(n, value[n]) for n in at} | {"V": value["V"], "K": value["K"]}
    common |= closed_forms(model, p)
    points = hopf_points(model, p)
    if not all_roots:
        points = [q for q in points if q.leading and q.crossing_rate > 0][:1]
    if not points:
        return [common | {"status": _without_hopf(model, p)}]
    rows = []
    for q in points:
        cells: dict[str, Any] = {"W0": q.W0, "K_over_W0": value["K"] / q.W0, "Omega_c": q.Omega, "crossing_rate": q.crossing_rate}
        cells |= {"lyapunov": q.lyapunov, "leading": q.leading, "criticality": q.criticality or None}
        if "D0" in value:
            cells["Omega_reduced"] = value["D0"] * q.Omega / value["V"]
        known = math.isfinite(q.lyapunov)
        rows.append(common | cells | {"status": "ok" if known else "no Lyapunov coefficient: the Jacobian overflows"})
    return rows


def _without_hopf(model: GeneratedModel, p: Array) -> str:
    """Return why steady sliding has no Hopf bifurcation in W0."""
    slope = weakening(model, p)
    if slope <= 0:
        return "velocity strengthening: no Hopf"
    stable = [steady_is_stable(model, p, W0) for W0 in LOADS_TRIED * p[model.index("K")]]
    if None in stable or not math.isfinite(slope):
        return "no value: the law, or a slope of it, is no number"
    if all(stable) or not any(stable):
        return f"no Hopf: {'stable' if stable[0] else 'unstable'} at every load looked at"
    return "no Hopf found"


# `response`: how sliding follows a modulated load.

FREQUENCIES = tuple(np.geomspace(1.0, 1000.0, 200).tolist())  # Hz


@explained
def response(
    system: SlidingSystem,
    *,
    over: Mapping[str, Sequence[float] | float] | None = None,
    eps: Values | None = None,
    tol: float = 1e-6,
) -> ResponseResult | MeanFrictionResult:
    """Return how friction, position and slip velocity follow a modulated load, to first order; with `eps` the mean friction.

    Parameters
    ----------
    system : SlidingSystem
        The slider, from `srfcli.system`.
    over : mapping from one parameter to values, optional
        Values in declared units; f from 1 to 1000 Hz if left out.
    eps : number or sequence, optional
        Relative amplitudes at which the mean friction of the forced periodic states is found in place of the linear response.
    tol : float
        Relative error of the mean friction.

    Returns
    -------
    ResponseResult or MeanFrictionResult
        A row for each value, and each amplitude; the status is the worst of the rows.

    Raises
    ------
    SrfError
        For several parameters, one that the system does not have or eps, a value out of bounds, or a law without a value under
        a load that changes.

    References
    ----------
    Perfettini, Schmittbuhl, Rice and Cocco (2001), J. Geophys. Res. 106, 13455: the linear response.
    Bureau, Baumberger and Caroli (2000), Phys. Rev. E 62, 6810: the mean friction.

    Examples
    --------
    >>> import srfcli as srf
    >>> slider = srf.system(V=10, W0=6)
    >>> found = srf.response(slider, over={"f": [10, 100]})
    >>> [round(gain, 4) for gain in found.to_dataframe()["position_gain"]]
    [6.7659, 0.6162]
    >>> drop = srf.response(slider, over={"f": [120]}, eps=0.2).table.rows[0][4]
    >>> round(drop, 5)
    0.07176
    """
    from srfcli.numerics.response import linear_response, mean_friction

    over = {"f": FREQUENCIES} if over is None else over
    if len(grid := swept(system.model, over)) != 1:
        raise SrfError(f"`over` has {len(grid)} parameters", "One is swept, such as f from 1 to 1000 Hz.")
    model, ((name, values),) = system.model, grid.items()
    if name == "eps":
        raise SrfError("eps is not swept", "Give amplitudes by `eps`; the linear response has none.")
    model.check_changing_load(system.vector())

    points = np.array([to_base(value, model.unit(name)) for value in values])

    def at(amplitude: float) -> Array:
        return model.with_values(system.vector(), **{name: points, "eps": amplitude})

    if eps is None:
        return ResponseResult(system, name, values, linear_response(model, at(0.0)))
    means = {amplitude: mean_friction(model, at(amplitude), tol=tol) for amplitude in checked(model, "eps", eps)}
    return MeanFrictionResult(system, name, values, means)


# `floquet`: one forced periodic state in full.


@explained
def floquet(system: SlidingSystem, *, tol: float = 1e-6, max_mesh: int = 1024, harmonics: int = 5) -> PeriodicResult:
    """Return the forced periodic state at the system's V, W0 and eps: multipliers, mean friction, harmonics.

    Parameters
    ----------
    system : SlidingSystem
        The slider, from `srfcli.system`.
    tol : float
        Error of the multipliers; the mesh is doubled until it is met.
    max_mesh : int
        Intervals of the finest mesh.
    harmonics : int
        Harmonics of elongation and friction.

    Returns
    -------
    PeriodicResult
        Where no state was found its status says so.

    Raises
    ------
    SrfError
        For a law without a value under a load that changes.

    References
    ----------
    Ascher, Mattheij and Russell (1995), Numerical Solution of Boundary Value Problems: collocation.

    Examples
    --------
    >>> import srfcli as srf
    >>> state = srf.floquet(srf.system(V=8, W0=9, eps=0.09))
    >>> state.stable, round(state.state.mean_friction, 6)
    (True, 0.418811)
    """
    if harmonics < 0:
        raise SrfError(f"`harmonics` {harmonics} is below 0", "Like 5.")
    p = system.model.vector(system.resolved.values)
    system.model.check_changing_load(p)
    from srfcli.numerics.floquet import solve_floquet  # costs a tenth of the start of `linear`, like the imports below

    found = solve_floquet(system.model, p, tol=tol, max_mesh=max_mesh, harmonics=harmonics)
    return PeriodicResult(system, found)


# `critical` and `continue`: the stability boundary under modulation, point by point and as curves.

LINES_FOLLOWED = 5  # that are followed outwards to find the loads to look between


@explained
def critical(
    system: SlidingSystem,
    *,
    V: Values | None = None,
    eps: Values | None = None,
    window: tuple[float, float] | None = None,
    tol: float = 1e-8,
    samples: int = 192,
    resolution: float = 1e-3,
    max_mesh: int = 512,
    progress: Said = lambda text: None,
) -> CriticalResult:
    """Return every critical load at the given velocities and amplitudes, numbered from low W0.

    Parameters
    ----------
    system : SlidingSystem
        The slider, from `srfcli.system`.
    V, eps : number or sequence, optional
        Driving velocities in um/s and relative amplitudes; the system's own if left out.
    window : (float, float), optional
        Loads to look between, in N; else all at which a crossing can be.
    tol : float
        Relative error of a critical load.
    samples : int
        Loads looked at first, on each line.
    resolution : float
        Finest spacing in ln W0 where a pair of crossings could hide.
    max_mesh : int
        Intervals of the finest mesh.
    progress : callable
        Told what was done, once for each velocity and amplitude.

    Returns
    -------
    CriticalResult
        Ctrl-C is a status: the lines that were finished are kept.

    Raises
    ------
    SrfError
        For values out of bounds.

    References
    ----------
    Cochard, Bureau and Baumberger (2003), Trans. ASME J. Appl. Mech. 70, 220.

    Examples
    --------
    >>> import srfcli as srf
    >>> srf.critical(srf.system(), eps=0.13, V=7).table.rows[0][6]  # doctest: +ELLIPSIS
    10.55524...
    """
    from srfcli.numerics.critical import critical_line

    if not 1e-12 < tol < 0.1 or not 1e-8 < resolution < 1:
        raise SrfError(f"`tol` {tol:g} or `resolution` {resolution:g} is out of range", "Take 1e-8 and 1e-3.")
    if samples < FEWEST_SAMPLES:
        raise SrfError(f"`samples` {samples}: between so few loads crossings would be missed", f"Take {FEWEST_SAMPLES} or more.")
    model, own = system.model, system.resolved.values
    model.check_changing_load(system.vector())
    velocities = (own["V"],) if V is None else checked(model, "V", V)
    amplitudes = (own["eps"],) if eps is None else checked(model, "eps", eps)
    lo, hi = (None, None) if window is None else _ends(model, window)
    found: list[tuple[str, CriticalLine]] = []
    status = Status.OK
    try:
        for amplitude, velocity in itertools.product(amplitudes, velocities):
            base = model.vector({**own, "V": velocity, "eps": amplitude})
            line = critical_line(model, base, lo=lo, hi=hi, tol=tol, samples=samples, resolution=resolution, max_mesh=max_mesh)
            place = f"eps = {amplitude:g}, V = {velocity:g} um/s"
            found.append((place, line))
            progress(place)
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    notes: list[str] = []
    ends = [(float(line.scans[0].values[0]), float(line.scans[-1].values[-1])) for _, line in found]
    for (place, line), (low, high) in zip(found, ends, strict=True):
        notes += [f"{place}: {note}" for note in line.notes]
        if not line.points:
            side = _side([g for scan in line.scans for g in scan.g.tolist()])
            notes.append(f"{place}: no crossing between W0 = {low:.4g} and {high:.4g} N; {side}")
    if ends:
        span = f"{min(ends)[0]:.4g} to {max(high for _, high in ends):.4g} N"
        span += "" if window else ", to where the growth rate settles"
        notes.append(f"looked from {span}; pairs of crossings closer than {resolution:g} in ln W0 are not looked for")
    points = tuple(q for _, line in found for q in line.points)
    crossings = tuple(number for _, line in found for number in line.crossings)
    if status is Status.OK:
        status = worst([s for _, line in found for s in (line.status, *(q.status for q in line.points))])
    return CriticalResult(system, points, crossings, tuple(notes), status)


def _side(g: list[float]) -> str:
    values = np.asarray(g)
    if not np.isfinite(values).all():
        return "no sign change among the samples that were found"
    if not values.size:
        return "no periodic state found"
    return f"{'stable' if (values < 0).all() else 'unstable'} at every load looked at"


@explained
def continue_boundary(
    system: SlidingSystem,
    *,
    eps: Values | None = None,
    over: Mapping[str, tuple[float, float]] | None = None,
    log: Sequence[str] | None = None,
    settings: ContinuationSettings | None = None,
    progress: Said = lambda text: None,
) -> Iterator[BoundaryResult]:
    """Return an iterator of the boundary under modulation as it grows, after each component; the last one is complete.

    Parameters
    ----------
    system : SlidingSystem
        The slider, from `srfcli.system`.
    eps : number or sequence, optional
        Relative amplitudes, a boundary for each; the system's own if left out, none where eps is an axis.
    over : mapping from parameter to (low, high), optional
        One axis, against W0, or two, in declared units; V from 1 to 100 um/s if left out.
    log : sequence of str, optional
        Which of the axes are logarithmic; those whose ends are positive and a decade or more apart if left out.
    settings : ContinuationSettings, optional
        Scan lines, samples, steps, tolerance and meshes.
    progress : callable
        Told what is being done.

    Returns
    -------
    iterator of BoundaryResult
        Ctrl-C is a status: what was followed until then is yielded last.

    Raises
    ------
    SrfError
        For axes that span no plane, and values out of bounds.

    Examples
    --------
    >>> import srfcli as srf
    >>> *_, found = srf.continue_boundary(srf.system(), eps=0.09, over={"V": (5, 20)})
    >>> found.status.value, len(found.boundaries[0].branches)
    ('ok', 1)
    """
    from srfcli.numerics.continuation import ContinuationSettings

    model, settings = system.model, settings or ContinuationSettings()
    if not isinstance(settings, ContinuationSettings):
        raise SrfError(f"`settings` {settings!r} are none of a curve", "Like srfcli.ContinuationSettings(tol=1e-8).")
    axes = _axes(model, over or {"V": (1.0, 100.0)}, log, eps is not None)
    model.check_changing_load(system.vector())
    own = system.resolved.values["eps"]
    swept = "eps" in [a.name for a in axes]
    amplitudes: tuple[float | None, ...] = (None,) if swept else (own,) if eps is None else checked(model, "eps", eps)
    return _grown(system, axes, amplitudes, settings, progress)


def _grown(
    system: SlidingSystem, axes: list[Axis], amplitudes: Sequence[float | None], settings: ContinuationSettings, progress: Said
) -> Iterator[BoundaryResult]:
    from srfcli.numerics.continuation import find_components

    model = system.model
    done: list[Boundary] = []
    try:
        for amplitude in amplitudes:
            plane, window = _plane(system, axes, amplitude)
            dense = settings if window is None else replace(settings, samples=math.ceil(settings.samples * window.widening))
            boundary: Boundary | None = None
            for boundary in find_components(model, plane, dense, progress=progress):
                yield BoundaryResult(system, (*done, boundary), worst([*(a.status for a in done), boundary.status]))
            assert boundary is not None
            if window is not None:
                boundary = _judged_window(model, boundary, window)
            done.append(boundary)
            if boundary.status is Status.INTERRUPTED:
                break
    except KeyboardInterrupt:
        yield BoundaryResult(system, tuple(done), Status.INTERRUPTED)
        return
    stopped = bool(done) and done[-1].status is Status.INTERRUPTED
    yield BoundaryResult(system, tuple(done), Status.INTERRUPTED if stopped else worst(a.status for a in done))


def _axes(
    model: GeneratedModel, over: Mapping[str, tuple[float, float]], logs: Sequence[str] | None, amplitudes: bool
) -> list[Axis]:
    """Return the axes, one or two, x first."""
    if len(over) > 2:
        raise SrfError(f"`over` has {len(over)} axes", "A plane has two: V and W0.")
    axes = []
    for name, ends in over.items():
        values = checked(model, name, ends)
        if len(values) != 2 or not values[0] < values[1]:
            raise SrfError(f"{name} = {ends} is no axis", f'An axis runs from a low to a high end: {{"{name}": (1, 100)}}.')
        log = name in logs if logs is not None else values[1] >= 10 * values[0] > 0
        lo, hi = (to_base(value, model.unit(name)) for value in values)
        axes.append(Axis(name, lo, hi, log))
    if "eps" in over and amplitudes:
        raise SrfError("eps is an axis and has values too", "Leave out `eps`, or take eps out of `over`.")
    if axes[0].name == "W0":
        if len(axes) == 1:
            raise SrfError("`over` W0 alone spans no plane", "Add the other axis, such as V from 1 to 100.")
        axes = axes[::-1]  # stability is followed across the load
    return axes


def _plane(system: SlidingSystem, axes: list[Axis], amplitude: float | None) -> tuple[Plane, LoadWindow | None]:
    """Return the plane of one amplitude, and the loads that were found for it, if any were; eps itself may be an axis."""
    from srfcli.numerics.critical import found_window

    model, x = system.model, axes[0]
    base = model.vector(system.resolved.values | ({} if amplitude is None else {"eps": amplitude}))
    if len(axes) == 2:
        return Plane(base, x, axes[1]), None
    lines: list[Any] = [base.copy() for _ in range(LINES_FOLLOWED)]
    for line, value in zip(lines, x.samples(LINES_FOLLOWED), strict=True):
        line[model.index(x.name)] = value
    window = found_window(model, lines)
    return Plane(base, x, Axis("W0", window.lo, window.hi)), window


def _judged_window(model: GeneratedModel, boundary: Boundary, window: LoadWindow) -> Boundary:
    """Return the boundary with notes on where its curves leave the loads that were found, and what of these is not certain."""
    x, notes, status = boundary.plane.x.name, list(boundary.notes), boundary.status
    for number, branch in enumerate(boundary.branches, 1):
        for point in (branch.points[0], branch.points[-1]):
            W0 = point.value(model, "W0")
            side = "above" if 0.999 * window.hi < W0 else "below" if 1.001 * window.lo > W0 else ""
            if side:
                at = f"{x} = {model.declared(x, point.value(model, x)):.4g}"
                notes.append(f"component {number} goes on {side} W0 = {W0:.4g} N at {at} (--over W0=LOW:HIGH for more)")
    if not window.certain:
        notes.append(f"crossings below {window.lo:.4g} or above {window.hi:.4g} N are not ruled out")
        status = Status.UNSETTLED if status is Status.OK else status
    return replace(boundary, notes=tuple(notes), status=status)
