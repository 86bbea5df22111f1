"""What each effect could still explain beyond a state-space fit, at first order: Rao's score test by the filter's derivatives.

Each effect has a column, the derivative of the standardised innovations and of their variances by its size at the neutral value.
Projected off those of everything that was fitted, parameters, field and gauge noise, it gives the gain in log likelihood that a
refit should bring and the size to expect. Effects that are functions of slip, time or stage position, of which many inner values
are tried, are carried through the filter's own transitions instead.
Rao 1948; de Jong and Penzer, JASA 93 (1998).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel, open_model
from srfcli.core.errors import SrfError
from srfcli.core.units import to_base
from srfcli.data.values import Experiment, Run, per_elongation
from srfcli.diagnosis.hypotheses import Excluded, ProfileFunction, inner_grid, neutral_values, own_parameters, profile_function
from srfcli.inference.critical_loads import TableLikelihood, apparatus
from srfcli.inference.prediction import run_parameters, run_specific_names, run_specific_start
from srfcli.inference.recordings import slip_along
from srfcli.inference.shared_field import FieldPrior
from srfcli.inference.state_space import Filtered, StateSpaceFit, field_columns, filter_run
from srfcli.laws.registry import Registry
from srfcli.laws.values import Effect

# likeness of two effects' projected columns beyond which one is tried in the place of the other: a fit decides
RIVAL_CORRELATION = 0.9
NODE_SPACING, MAX_NODES = 0.4, 400  # of a shared field: correlation lengths between them; how many
MIN_SQUARED_NORM = 1e-100  # of a column's squares: a bump beyond the ends of all runs, say
COLUMN_BLOCK = 32  # columns that are projected at a time
QUADRATURE_POINTS = 20  # points between samples at which a function of slip or stage is averaged


@dataclass(frozen=True)
class Score:
    """One effect's score: `gain` in log likelihood at first order, the `values` expected of its parameters there.

    `size` and `stderr` are those of its first parameter, `detectable` the size that would gain 12 in log likelihood, `tolerance`
    the share of the effect's squared signal that what was fitted cannot absorb. `shifts` are what it does to the parameters that
    were fitted.
    """

    effect: Effect
    gain: float
    values: dict[str, float]
    size: float
    stderr: float
    detectable: float
    tolerance: float
    direction: Array = field(repr=False, compare=False)
    shifts: dict[str, float] = field(repr=False, compare=False, default_factory=dict)


@dataclass(frozen=True)
class _Column:
    """Columns (2 m, q) of an effect by the size called `name`, at given inner values; names are the effect's own.

    Projected, they are free of what was fitted, along whose directions they had `coefficients` (p, q); `whole` is their square
    before that, and `along` (r, q) what they have of the field that all runs share.
    """

    effect: Effect
    name: str
    inner: dict[str, float]
    columns: Array
    whole: float = 0.0
    coefficients: Array = field(default_factory=lambda: np.zeros((0, 0)))
    along: Array | None = None

    @property
    def tolerance(self) -> float:
        """Return the share of its square that what was fitted cannot absorb."""
        return float(np.sum(self.columns**2)) / self.whole


@dataclass(frozen=True)
class SharedField:
    """A random friction field that all runs share, at first order: `gain` in log marginal likelihood at its best `amplitude`.

    In directions `u` (2 m, q) it absorbs the parts `absorbed` (q,) of `projected` (q,).
    """

    u: Array = field(repr=False)
    absorbed: Array = field(repr=False)
    projected: Array = field(repr=False)
    gain: float
    amplitude: float = 0.0


class ResidualProjection:
    """What a fit leaves, `projected` (n,): standardised innovations and their squares, projected off what was fitted.

    `residuals` (n,) is the same before that, `basis` (n, p) are orthonormal directions of what was fitted. Residuals of critical
    loads, over their errors, stand at the end.
    """

    def __init__(self, fitted: StateSpaceFit) -> None:
        self.fitted, point = fitted, fitted.maximum.point
        recorded = [np.concatenate([f.white, (f.white**2 - 1) / np.sqrt(2)]) for f in point.runs]
        self.residuals = np.concatenate([*recorded, *(t.white for t in point.tables)])
        basis = np.zeros((self.residuals.size, len(fitted.likelihood.names)))
        at = 0
        for f in point.runs:
            block = _whitened(f)
            basis[at : at + len(block), [fitted.likelihood.names.index(n) for n in f.names]] = block
            at += len(block)
        for t in point.tables:
            basis[at : at + len(t.white)] = -t.slopes
            at += len(t.white)
        size = np.linalg.norm(basis, axis=0)
        u, s, v = np.linalg.svd(basis[:, size > 0] / size[size > 0], full_matrices=False)
        known = s > 1e-7 * s[0]
        self.basis = u[:, known]
        self._to_parameters = np.zeros((size.size, int(known.sum())))
        self._to_parameters[size > 0] = v[known].T / s[known] / size[size > 0][:, None]
        self._directions = np.zeros((int(known.sum()), size.size))  # each parameter's direction in `basis`
        self._directions[:, size > 0] = s[known, None] * v[known]
        self.projected = self.project(self.residuals)

    def padded(self, blocks: Sequence[Array]) -> Array:
        """Return columns (n, k) of the runs' blocks, zero for critical loads."""
        columns = np.concatenate(blocks)
        return np.concatenate([columns, np.zeros((self.residuals.size - len(columns), columns.shape[1]))])

    def project(self, columns: Array) -> Array:
        """Return columns (2 m, k) projected off what was fitted."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    def shifts(self, coefficients: Array) -> Array:
        """Return by how much fitted parameters change where something with `coefficients` (p,) in `basis` is added."""
        return np.asarray(-self._to_parameters @ coefficients)

    def basis_without(self, names: Sequence[str]) -> Array:
        """Return orthonormal directions (p, r), in `basis`, of what was fitted besides the parameters `names`."""
        u, s, _ = np.linalg.svd(self._directions[:, ~np.isin(self.fitted.likelihood.names, names)], full_matrices=False)
        return np.asarray(u[:, s > 1e-7 * max(s[0], 1e-300)])

    @cached_property
    def runs(self) -> tuple[Filtered, ...]:
        """Return the runs filtered once more, with what the smoother needs."""
        return self.fitted.likelihood.at(self.fitted.maximum.point.x, slopes=False, keep=True).runs

    @cached_property
    def shared(self) -> SharedField:
        """Return the field that all runs share, of the correlation length that each run's own has."""
        if self.fitted.smooth or len(self.runs) < 2 or not all(f.whole for f in self.runs):
            return SharedField(np.zeros((self.projected.size, 0)), np.zeros(0), np.zeros(0), 0.0)
        values, states = self.fitted.values, self.fitted.likelihood.problem.model.states
        slips = [slip_along(f.run, f.found.kept.mean, states) for f in self.runs if f.found.kept]
        first, last = min(s.min() for s in slips), max(s.max() for s in slips)
        count = int(np.clip(np.ceil((last - first) / (NODE_SPACING * values["field_length"])) + 1, 2, MAX_NODES))
        nodes = np.linspace(first, last, count)
        hat = ProfileFunction("slip", lambda s, k: np.interp(s, nodes, np.arange(count) == k), ("node",))
        columns = self.padded([_propagated_columns(f, self.fitted, [(hat, [k]) for k in range(count)]) for f in self.runs])
        columns = self.project(columns @ FieldPrior(1.0, values["field_length"]).root(nodes))
        power, directions = np.linalg.eigh(columns.T @ columns)
        known = power > 1e-12 * power[-1]
        size = np.sqrt(power[known])
        u = columns @ (directions[:, known] / size)
        projected = u.T @ self.projected
        best = SharedField(u, np.zeros(size.size), projected, 0.0)
        for amplitude in values["field_amplitude"] * np.geomspace(0.01, 3.0, 30):
            power = (amplitude * size) ** 2
            gain = 0.5 * float(np.sum(projected**2 * power / (1 + power) - np.log1p(power)))
            if gain > best.gain:
                best = SharedField(u, power / (1 + power), projected, gain, float(amplitude))
        return best


@dataclass(frozen=True)
class RunSpecificValue:
    """A parameter with a value of its own in one run: what that gains in log likelihood at first order, and the change there."""

    gain: float
    parameter: str
    run: str
    change: float


def run_specific_values(projection: ResidualProjection) -> list[RunSpecificValue]:
    """Return what each parameter that runs share would gain by a value of its own in one of them, largest gain first."""
    runs, names, end, found = projection.fitted.maximum.point.runs, projection.fitted.likelihood.problem.names, 0, []
    for f in runs if len(runs) > 1 else ():
        shared = [n for n in f.names if n in names and "[" not in n and not n.startswith(f"{f.run.name}.")]
        columns = np.zeros((projection.residuals.size, len(shared)))
        columns[end : end + 2 * f.white.size] = _whitened(f)[:, [f.names.index(n) for n in shared]]
        end += 2 * f.white.size
        free = projection.project(columns)
        power, g = np.sum(free**2, axis=0), free.T @ projection.projected
        known = power > MIN_SQUARED_NORM
        found += [
            RunSpecificValue(0.5 * float(b) ** 2 / float(a), n, f.run.name, float(b / a))
            for n, a, b in zip(np.array(shared)[known].tolist(), power[known], g[known], strict=True)
        ]
    return sorted(found, key=lambda v: -v.gain)


class Scores:
    """The scores around a fit, of a model that has the effects `present`; `excluded` are those that cannot join it."""

    def __init__(
        self,
        registry: Registry,
        experiment: Experiment,
        projection: ResidualProjection,
        present: Sequence[Effect],
        candidates: Sequence[Effect],
    ) -> None:
        self.registry, self.experiment, self.present = registry, experiment, tuple(present)
        self.projection, self.fitted = projection, projection.fitted
        self.excluded: list[Excluded] = []
        self.shared = self.projection.shared
        self.columns = self._projected(self._all_columns(candidates))
        self.every = self._best_of(self.columns)

    @cached_property
    def singles(self) -> list[Score]:
        """The best score of each effect under the name that it is reported by, largest gain first."""
        best: dict[str, Score] = {}
        for score in self.every:
            best.setdefault(score.effect.reported, score)
        return list(best.values())

    def _all_columns(self, candidates: Sequence[Effect]) -> list[_Column]:
        shapes = {e.name: shape for e in candidates if (shape := profile_function(e)) is not None}
        found: list[_Column] = []
        regular = [e for e in candidates if e.sizes and not e.settings and not e.observed and e.name not in shapes]
        # a pass costs as its states cubed, and rates that are scanned together may have no steady state
        alone = [e for e in regular if e.states or (e.scans and "rate" in dict(e.changes))]
        found += self._derivative_columns([e for e in regular if e not in alone])
        for effect in alone:
            found += self._derivative_columns([effect])
        along = [e for e in candidates if e.name in shapes]
        if along:
            found += self._table_columns(along, shapes)
        if freed := [e for e in candidates if "K" in e.frees]:
            values = {"K": self.experiment.stiffness, **self.fitted.values}
            columns = self._columns(self.fitted.likelihood.problem.model, (), values, ["K"])
            found += [_Column(e, "K", {}, columns) for e in freed]
        if late := [e for e in candidates if e.observed]:  # of first order in the delay a gauge shows less by what u gained in it
            columns = self.projection.padded([_propagated_columns(f, self.fitted, (), late=True) for f in self.projection.runs])
            found += [_Column(e, e.sizes[0], {}, columns) for e in late]
        return found

    def _open_model(self, added: Sequence[Effect], *, stability: bool) -> GeneratedModel:
        choice = self.experiment.choice.plus(e.name for e in (*self.present, *added))
        return open_model(self.registry, **asdict(choice), random_field=not stability, stability=stability)

    def _neutral(self, model: GeneratedModel, added: Sequence[Effect]) -> dict[str, float]:
        values = dict(self.fitted.values)
        for effect in self.present:  # names change where two effects have a parameter of the same name
            for long, p in own_parameters(effect, model).items():
                if long not in values and p.name in values:
                    values[long] = values[p.name]
        for effect in added:
            neutral = neutral_values(effect)
            for long, p in own_parameters(effect, model).items():
                values[long] = neutral.get(p.name, to_base(p.default, p.unit))
        return values

    def _columns(self, model: GeneratedModel, added: Sequence[Effect], values: Mapping[str, float], by: Sequence[str]) -> Array:
        """Return the columns (n, k) by parameters of a model with `added` effects, at values where it is the fitted one."""
        likelihood = self.fitted.likelihood

        def block(run: Run) -> Array:
            own, trend = likelihood.problem.local(run, values), likelihood.problem.trend
            p = run_parameters(model, self.experiment, run, own)
            begun = {
                n: run_specific_start(model, run, p, n, trend)[0] for n in run_specific_names(model, run, trend) if n not in own
            }
            found = filter_run(
                model, self.experiment, run, own | begun, by=by, gauges=likelihood.gauges(run), trend=trend, rtol=likelihood.rtol
            )
            return _whitened(found)

        return np.concatenate([*likelihood.over_runs(block), *self._load_columns(added, values, by)])

    def _load_columns(self, added: Sequence[Effect], values: Mapping[str, float], by: Sequence[str]) -> list[Array]:
        """Return the same of each table of critical loads; zero for what they do not depend on."""
        problem, found = self.fitted.likelihood.problem, []
        if not problem.tables:
            return []
        model = self._open_model(added, stability=True)
        known = [n for n in by if n in model.names]
        for loads in problem.tables:
            given = apparatus(self.experiment, loads.frequency) | dict(values)
            bounds = {n: (values[n], values[n] - 1.0, values[n] + 1.0) for n in known}
            slopes = TableLikelihood(model, loads, given, bounds).at(values).slopes
            columns = np.zeros((len(loads.table), len(by)))
            columns[:, [by.index(n) for n in known]] = -slopes
            found.append(columns)
        return found

    def _derivative_columns(self, effects: Sequence[Effect]) -> list[_Column]:
        """Return the columns of effects from one model that has them all, in parts where they do not go together.

        Each has its inner parameters at the values of its own grid; at neutral sizes none sees those of another.
        """
        if not effects:
            return []
        try:
            model = self._open_model(effects, stability=not self.experiment.runs)
        except SrfError as error:
            if len(effects) == 1:
                self.excluded.append(Excluded(effects[0].reported, error.message))
                return []
            half = len(effects) // 2
            return self._derivative_columns(effects[:half]) + self._derivative_columns(effects[half:])
        longs = {e.name: {p.name: long for long, p in own_parameters(e, model).items()} for e in effects}
        grids = {e.name: [inner for group in _phase_groups(e) for inner in group] for e in effects}
        columns: dict[str, list[Array]] = {e.name: [] for e in effects}
        for j in range(max(len(grid) for grid in grids.values())):
            some = [e for e in effects if j < len(grids[e.name])]
            inner = {longs[e.name][n]: v for e in some for n, v in grids[e.name][j].items()}
            sizes = [longs[e.name][e.sizes[0]] for e in some]
            found = self._columns(model, effects, self._neutral(model, effects) | inner, sizes)
            for k, e in enumerate(some):
                columns[e.name].append(found[:, k])
        return [column for e in effects for column in _columns_by_phase(e, np.stack(columns[e.name], axis=1))]

    def _table_columns(self, effects: Sequence[Effect], shapes: Mapping[str, ProfileFunction]) -> list[_Column]:
        """Return the columns of effects that are functions of slip, time or stage position, for all inner values."""
        grids = [(shapes[e.name], [inner for group in _phase_groups(e) for inner in group]) for e in effects]
        functions = [(shape, [inner.get(n, 0.0) for n in shape.inner]) for shape, grid in grids for inner in grid]
        every = self.projection.padded([_propagated_columns(f, self.fitted, functions) for f in self.projection.runs])
        parts = np.split(every, np.cumsum([len(grid) for _, grid in grids])[:-1], axis=1)
        return [column for e, columns in zip(effects, parts, strict=True) for column in _columns_by_phase(e, columns)]

    @cached_property
    def single_run(self) -> list[Score]:
        """The scores of effects that act in one run alone, largest first, where that gains more than to act in all.

        By more than the choice of the run costs. Laws are the same in all runs, and so is what the rig's elasticity makes of the
        load; other faults of the apparatus may befall one.
        """
        runs, base, found, end = self.projection.fitted.maximum.point.runs, self.projection.basis, [], 0
        if len(runs) < 2:
            return []
        every = {s.effect.reported: s.gain + float(np.log(len(runs))) for s in self.singles}
        apparatus = [c for c in self.columns if can_act_in_one_run(c.effect)]
        for f in runs:
            rows = slice(end, end := end + 2 * f.white.size)
            best: list[Score] = []
            for first in range(0, len(apparatus), COLUMN_BLOCK):
                parts = []
                for c in apparatus[first : first + COLUMN_BLOCK]:
                    columns = np.zeros_like(c.columns)
                    columns[rows] = c.columns[rows] + base[rows] @ c.coefficients
                    parts.append(replace(c, effect=replace(c.effect, run=f.run.name), columns=columns))
                best += self._best_of(self._projected(parts))
            foremost: dict[str, Score] = {}
            for score in sorted(best, key=lambda s: -s.gain):
                foremost.setdefault(score.effect.reported, score)
            found += [s for name, s in foremost.items() if s.gain > every[name]]
        return sorted(found, key=lambda s: -s.gain)

    def _projected(self, columns: Sequence[_Column]) -> list[_Column]:
        """Return the columns that do something here, projected off what was fitted, many at a time."""
        found: list[_Column] = []
        for first in range(0, len(columns), COLUMN_BLOCK):
            size = [float(np.sum(c.columns**2)) for c in columns[first : first + COLUMN_BLOCK]]
            some = [
                replace(c, whole=whole)
                for c, whole in zip(columns[first : first + COLUMN_BLOCK], size, strict=True)
                if whole > MIN_SQUARED_NORM and np.isfinite(whole)
            ]
            if not some:
                continue
            whole_columns = np.concatenate([c.columns for c in some], axis=1)
            coefficients = self.projection.basis.T @ whole_columns
            free = whole_columns - self.projection.basis @ coefficients
            along = self.shared.u.T @ free if self.shared.gain else None
            at = 0
            for c in some:
                part = slice(at, at := at + c.columns.shape[1])
                beside = None if along is None else along[:, part]
                found.append(replace(c, columns=free[:, part], along=beside, coefficients=coefficients[:, part]))
        return found

    def _gain_and_sizes(self, column: _Column) -> tuple[float, Array, Array]:
        """Return what a column gains, its sizes, and the covariance of these."""
        gram, g = column.columns.T @ column.columns, column.columns.T @ self.projection.projected
        plain = self._normal_equations(gram, g)
        if column.along is None:
            return plain
        kept = column.along * self.shared.absorbed[:, None]
        beside = self._normal_equations(gram - column.along.T @ kept, g - kept.T @ self.shared.projected)
        gain = max(plain[0] - self.shared.gain, beside[0])
        return (gain, *(beside if gain == beside[0] else plain)[1:])

    def _normal_equations(self, gram: Array, g: Array) -> tuple[float, Array, Array]:
        d = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        inverse = np.linalg.pinv(gram / np.outer(d, d), rcond=1e-9, hermitian=True) / np.outer(d, d)
        size = inverse @ g
        return 0.5 * float(g @ size), size, inverse

    def _best_of(self, columns: Sequence[_Column]) -> list[Score]:
        """Return the best score of each effect, variants of one apart, largest gain first."""
        best: dict[str, Score] = {}
        for column in columns:
            score = self._score(column)
            if column.effect.name not in best or best[column.effect.name].gain < score.gain:
                best[column.effect.name] = score
        return sorted(best.values(), key=lambda s: -s.gain)

    def absorbed_by(self, names: Sequence[str]) -> list[Score]:
        """Return the score of each effect that parameters `names` absorb, and the others do not, where they absorb most of it."""
        least: dict[str, tuple[float, _Column]] = {}
        others = self.projection.basis_without(names)
        for column in self.columns:
            left, own = float(np.sum(column.columns**2)), column.coefficients - others @ (others.T @ column.coefficients)
            absorbed = float(np.sum(own**2))
            share = left / max(left + absorbed, 1e-300)
            if share < least.get(column.effect.name, (1 - RIVAL_CORRELATION**2,))[0]:
                least[column.effect.name] = share, column
        return [self._score(column) for _, column in least.values()]

    def _score(self, column: _Column) -> Score:
        gain, size, covariance = self._gain_and_sizes(column)
        if not self._admissible(column, size):
            gain = 0.0
        error = float(np.sqrt(max(covariance[0, 0], 0.0)))
        direction = column.columns @ size
        norm = float(np.linalg.norm(direction))
        shifts = self.projection.shifts(column.coefficients @ size).tolist()
        return Score(
            column.effect, gain, self._expected_values(column, size), float(size[0]), error, error * np.sqrt(24.0),
            column.tolerance, direction / norm if norm > 0 else direction,
            dict(zip(self.fitted.likelihood.names, shifts, strict=True)),
        )  # fmt: skip

    def _admissible(self, column: _Column, size: Array) -> bool:
        """Return whether the expected size lies on a side of the neutral value on which there is any."""
        p = next((p for p in column.effect.parameters if p.name == column.name), None)
        if p is None or size.size > 1:
            return True
        neutral = neutral_values(column.effect)[column.name]
        low, high = to_base(p.lower, p.unit), to_base(p.upper, p.unit)
        return not ((size[0] < 0 and neutral <= low) or (size[0] > 0 and neutral >= high))

    def _expected_values(self, column: _Column, size: Array) -> dict[str, float]:
        """Return what is expected of an effect's parameters, within their bounds; two phases are one amplitude and its phase."""
        effect, inner = column.effect, dict(column.inner)
        if "K" in effect.frees:
            K = self.fitted.likelihood.problem.experiment.stiffness
            return {"K": float(np.clip(K + size[0], 0.3 * K, 3 * K))}
        p = next(p for p in effect.parameters if p.name == column.name)
        value, low, high = float(size[0]), to_base(p.lower, p.unit), to_base(p.upper, p.unit)
        if size.size == 2:
            value, inner["phase"] = float(np.hypot(*size)), float(np.arctan2(size[1], size[0]))
        return inner | {column.name: float(np.clip(neutral_values(effect)[column.name] + value, low, high))}


def can_act_in_one_run(effect: Effect) -> bool:
    """Return whether an effect is a fault of the apparatus, and no law of the contact, the spring or the frame under load."""
    elastic = any(
        slot == "K" or (slot == "V" and {"W", "W_dot"} & {str(s) for s in formula.free_symbols})
        for slot, formula in effect.changes
    )
    return not (effect.constitutive or effect.frees or effect.settings or elastic)


def _whitened(f: Filtered) -> Array:
    """Return the derivatives (2 m, k) whose product with [white, (white^2 - 1)/sqrt 2] is the score."""
    a, b = f.slopes
    return np.concatenate([-a, b / np.sqrt(2)])


def _phase_groups(effect: Effect) -> list[list[dict[str, float]]]:
    """Return the inner values at which an effect is tried, in groups that differ by their phase alone."""
    groups: dict[tuple[float, ...], list[dict[str, float]]] = {}
    for inner in inner_grid(effect):
        groups.setdefault(tuple(v for n, v in inner.items() if n != "phase"), []).append(inner)
    return list(groups.values())


def _columns_by_phase(effect: Effect, columns: Array) -> list[_Column]:
    """Return the columns (n, k) of an effect, one for each of its inner values, those of each group together."""
    groups = _phase_groups(effect)
    parts = np.split(columns, np.cumsum([len(group) for group in groups])[:-1], axis=1)
    return [_Column(effect, effect.sizes[0], group[0], part) for group, part in zip(groups, parts, strict=True)]


def _propagated_columns(
    f: Filtered, fitted: StateSpaceFit, functions: Sequence[tuple[ProfileFunction, Sequence[float]]], *, late: bool = False
) -> Array:
    """Return the columns (2 m, q) of functions of slip or time that add to mu, or of the stage that multiply V, by 1 + g.

    With `late` a column is added for a gauge that shows the elongation of a moment before.
    """
    run, kept, every, problem = f.run, f.found.kept, f.every, fitted.likelihood.problem
    assert kept is not None and every.kept is not None
    model, states = problem.model, list(problem.model.states)
    n, a = kept.mean.shape
    slip = slip_along(run, kept.mean, model.states)
    steps = np.linspace(0.0, 1.0, QUADRATURE_POINTS, endpoint=False) + 0.5 / QUADRATURE_POINTS
    fine_t = (run.t[:-1, None] + np.diff(run.t)[:, None] * steps).ravel()
    V = run.drive(fine_t)
    stage = np.concatenate([[0.0], np.cumsum(V * np.repeat(np.diff(run.t) / QUADRATURE_POINTS, QUADRATURE_POINTS))])
    signals, known, shown = len(run.signals), every.kept, np.zeros(n)
    moved = np.zeros((every.nu.size, a, len(functions) + late))  # the states expected, of each column
    inputs = moved[::signals]
    if late:
        shown = -_elongation_rate(run, kept.mean, model, fitted)
    at, slope = states.index("field"), states.index("field_slope")
    rate = np.sqrt(3) / fitted.values["field_length"]
    start: Array | None = None
    by_V = None
    for j, (shape, inner) in enumerate(functions):
        if shape.argument in ("slip", "time"):
            x = slip if shape.argument == "slip" else run.t
            g = np.broadcast_to(np.asarray(shape.g(x, *inner), dtype=float), x.shape)
            inputs[1:, at, j] = np.diff(g)
            inputs[1:, slope, j] = 0.5 * (g[1:] + g[:-1]) * rate * np.diff(slip)
            if start is None:
                start = field_columns(fitted.likelihood, run, fitted.values)
            inputs[0, : len(states), j] = start * g[0]
        else:
            middle = 0.5 * (stage[1:] + stage[:-1])
            gained = V * np.broadcast_to(np.asarray(shape.g(middle, *inner), dtype=float), middle.shape)
            total = (gained.reshape(-1, QUADRATURE_POINTS) * (np.diff(run.t) / QUADRATURE_POINTS)[:, None]).sum(axis=1)
            if by_V is None:
                by_V = _rates_by_V(model, fitted, run, kept.mean[:, : len(states)])
            inputs[1:, : len(states), j] = 0.5 * (by_V[1:] + by_V[:-1]) * total[:, None]
    lost = np.einsum("kij,kj->ki", known.transition[1:], known.gain[:-1])  # of what a reading shows, by the next one
    through = known.transition.copy()
    through[1:] -= lost[:, :, None] * known.gradient[:-1, None, :]
    if late:  # a delay is that of the first signal's gauge
        moved[1::signals, :, -1] -= (lost * np.repeat(shown, signals)[:-1, None])[::signals]
    for k in range(1, len(moved)):
        moved[k] += through[k] @ moved[k - 1]
    out = np.einsum("ka,kaq->kq", known.gradient, moved)
    if late:
        out[::signals, -1] += shown
    white = out[f.used] / np.sqrt(every.S[f.used])[:, None]
    return np.concatenate([white, np.zeros_like(white)])


def _elongation_rate(run: Run, x: Array, model: GeneratedModel, fitted: StateSpaceFit) -> Array:
    """Return how fast the reading's elongation changes (n,), along the states expected, in the observable's unit."""
    states = list(model.states)
    problem = fitted.likelihood.problem
    p = run_parameters(model, problem.experiment, run, problem.local(run, fitted.values))
    W, W_dot = run.load(run.t)
    V = run.drive(run.t)
    if "u" in states:
        slipping = x[:, states.index("z")] if "z" in states else np.exp(x[:, states.index("ln_v")])
        rate = V - slipping
    else:
        rate = np.gradient(np.asarray(model.elongation(x[:, : len(states)], V, W, W_dot, p)), run.t)
    return np.asarray(rate * per_elongation(run.observable, p[model.index("K")], W))


def _rates_by_V(model: GeneratedModel, fitted: StateSpaceFit, run: Run, x: Array) -> Array:
    problem = fitted.likelihood.problem
    p = run_parameters(model, problem.experiment, run, problem.local(run, fitted.values))
    W, W_dot = run.load(run.t)
    V = run.drive(run.t) + 1e-30j
    return np.asarray(model.rates(x.astype(complex), V, W, W_dot, p)).imag / 1e-30
