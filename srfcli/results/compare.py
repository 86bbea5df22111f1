"""Laws side by side: a row for each law and amplitude, a sentence for each pair, their boundaries over each other."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

from srfcli.core.errors import Status
from srfcli.results.tables import Column, Result, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srfcli.codegen.model import GeneratedModel
    from srfcli.codegen.slider import SlidingSystem
    from srfcli.numerics.compare import LawStudy, Match, Observables, Window

COLUMNS = (
    Column("law", "", "friction law, ageing law, or both"),
    Column("eps", "1", "modulation amplitude"),
    Column(
        "reentrance_eps", "1", "smallest amplitude at which a line of constant V meets more than one boundary", ".4g"
    ),
    Column(
        "reentrance_end", "1", "amplitude from which none does any more, nothing if that is beyond the largest", ".4g"
    ),
    Column(
        "destabilised",
        "1",
        "share of the window, in ln V and ln K/W0, stable at a smaller amplitude, unstable at this one",
    ),
    Column("stabilised", "1", "share of the window unstable without modulation, stable at this amplitude"),
    Column("folds", "1", "how often V turns round along the boundaries"),
    Column("components", "1", "connected boundaries in the window"),
    Column("V_fold", "um/s", "highest velocity at which a boundary turns back to lower ones"),
    Column("miss", "1", "what matching left, relative", ".2g"),
    Column("status"),
)


@dataclass(frozen=True, repr=False, eq=False)
class ComparisonResult(Result):
    """The stability diagrams of several laws, each brought to the first one's observables at one low velocity.

    Attributes
    ----------
    names : tuple of str
        What the laws are called here; the first is the reference.
    systems : tuple of SlidingSystem
        The laws with their parameters before matching.
    goal : Observables
        Friction, slope, critical load and period of the reference.
    matches : tuple of Match
        The parameters of each law (um, s, N), which of them were adjusted, and what matching left.
    studies : Mapping[int, LawStudy]
        Critical loads and boundaries of each law that could be matched, by its number.
    amplitudes, wanted : tuple of float
        Amplitudes that were computed, and those of the table.
    window : Window
        Velocities (um/s) and loads (N) that were looked at.
    """

    names: tuple[str, ...]
    systems: tuple[SlidingSystem, ...]
    goal: Observables = field(repr=False)
    matches: tuple[Match, ...] = field(repr=False)
    studies: Mapping[int, LawStudy] = field(repr=False)
    amplitudes: tuple[float, ...]
    wanted: tuple[float, ...]
    window: Window = field(repr=False)

    @cached_property
    def table(self) -> Table:
        """Return a row for each law and amplitude; the notes say what was matched, and where an experiment tells laws apart."""
        names, models, matches = list(self.names), [s.model for s in self.systems], list(self.matches)
        studies = dict(self.studies)
        pairs, said = sentences(names, models, matches, studies, self.amplitudes, self.window)
        rows, worst = law_rows(names, matches, studies, self.amplitudes, list(self.wanted), self.window)
        notes = (*law_notes(names, models, matches, self.goal, self.window), *said)
        meta = law_meta(names, models, matches, self.goal, pairs)
        described = self.systems[0].described(without=("V", "W0", "eps"))
        return Table("srf.compare/1", COLUMNS, rows, f"{len(names)} laws", notes, described, meta, worst.value)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the boundaries at the largest amplitude over each other, each law named with its matched parameters."""
        return compare_figure(
            list(self.names), [s.model for s in self.systems], list(self.matches), dict(self.studies), self.amplitudes,
            self.window, self.table.parameters, ax,
        )  # fmt: skip


def law_rows(
    names: list[str],
    matches: list[Match],
    studies: dict[int, LawStudy],
    amplitudes: tuple[float, ...],
    wanted: list[float],
    window: Window,
) -> tuple[list[tuple[Any, ...]], Status]:
    """Return a row under COLUMNS for each law and wanted amplitude, and the worst status among them."""
    from srfcli.numerics.compare import changed_areas

    rows: list[tuple[Any, ...]] = []
    statuses = []
    for k, name in enumerate(names):
        if k not in studies:
            rows.append((name, None, *(None,) * 7, matches[k].miss, matches[k].status.value))
            statuses.append(matches[k].status)
            continue
        study, miss = studies[k], matches[k].miss
        begins, ends = (b[1] if math.isfinite(b[1]) else None for b in (study.onset, study.end))
        for eps in wanted:
            i = amplitudes.index(eps)
            shape = (study.folds[i], len(study.curves[i]), highest_fold(study, i))
            areas = changed_areas(study.crossings[: i + 1], window)
            rows.append((name, eps, begins, ends, *areas, *shape, miss, study.status[i].value))
            statuses.append(study.status[i])
    return rows, next((s for s in statuses if not s.ok), Status.OK)


def law_notes(
    names: list[str], models: list[GeneratedModel], matches: list[Match], goal: Observables, window: Window
) -> list[str]:
    """Return what laws were brought to, with which parameters, and where was looked."""
    return [
        f"reference {names[0]} at {goal.V:g} um/s: friction {goal.friction:.6g}, slope -d mu/d ln V {goal.slope:.6g}, "
        f"critical load {goal.W0:.6g} N, period {2 * math.pi / goal.Omega:.6g} s",
        *(_said(names[k], models[k], m) for k, m in enumerate(matches) if m.adjusted),
        f"looked at V from {window.V[0]:g} to {window.V[1]:g} um/s and W0 from {window.W0[0]:.4g} to {window.W0[1]:.4g} N, "
        f"{window.columns} x {window.rows} points a map",
    ]


def law_meta(
    names: list[str],
    models: list[GeneratedModel],
    matches: list[Match],
    goal: Observables,
    pairs: list[dict[str, Any]],
) -> dict[str, Any]:
    """Return what JSON holds beside the rows."""
    fitted = {
        names[k]: {n: models[k].declared(n, float(m.p[models[k].index(n)])) for n in m.adjusted}
        for k, m in enumerate(matches)
    }
    observed = {"V": goal.V, "friction": goal.friction, "slope": goal.slope, "W0": goal.W0, "Omega": goal.Omega}
    return {"pairs": pairs, "adjusted": fitted, "observables": observed}


def _said(name: str, model: GeneratedModel, m: Match) -> str:
    values = ", ".join(f"{n} = {model.declared(n, float(m.p[model.index(n)])):.6g}" for n in m.adjusted)
    if m.status.ok:
        return f"{name} matched with {values}"
    return f"{name} could not be matched: {m.miss:.2g} is left with {values}"


def highest_fold(study: LawStudy, i: int) -> float | None:
    """Return the highest velocity at which a boundary that came from lower ones turns back, None where none does."""
    tops = [
        float(v)
        for curve in study.curves[i]
        for before, v, after in zip(curve[:-2, 0], curve[1:-1, 0], curve[2:, 0], strict=True)
        if before < v > after
    ]
    return max(tops, default=None)


def sentences(
    names: list[str],
    models: list[GeneratedModel],
    matches: list[Match],
    studies: dict[int, LawStudy],
    amplitudes: tuple[float, ...],
    window: Window,
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return for each pair of laws where their critical loads differ most, as data and as a sentence."""
    from srfcli.numerics.compare import EXPERIMENT, contrast

    pairs, said = [], []
    for a, b in itertools.combinations(sorted(studies), 2):
        best = contrast(studies[a], studies[b], amplitudes, window)
        if best is None:
            said.append(f"{names[a]} and {names[b]}: no velocity at which both have a critical load in the window")
            continue
        K = [float(matches[k].p[models[k].index("K")]) for k in (a, b)]
        ratios = [k / w for k, w in zip(K, best.W0, strict=True)]
        times = best.difference / EXPERIMENT
        told = (
            f"{times:.1f} times the {EXPERIMENT:.0%} of the paper's critical loads"
            if best.seen
            else f"not to be told apart by an experiment good to {EXPERIMENT:.0%}"
        )
        apart = f"a factor of {1 + best.difference:.3g}" if best.difference > 1 else f"{best.difference:.1%}"
        said.append(
            f"{names[a]} and {names[b]} differ most at V = {best.V:.3g} um/s, eps = {best.eps:.3g}: W0c = {best.W0[0]:.4g} "
            f"and {best.W0[1]:.4g} N (K/W0 = {ratios[0]:.4g} and {ratios[1]:.4g} /um), {apart}, {told}"
        )
        pairs.append(
            {
                "laws": [names[a], names[b]],
                "eps": best.eps,
                "V": best.V,
                "W0": list(best.W0),
                "K_over_W0": ratios,
                "difference": best.difference,
                "seen": bool(best.seen),
            }
        )
    return pairs, said


def compare_figure(
    names: list[str],
    models: list[GeneratedModel],
    matches: list[Match],
    studies: dict[int, LawStudy],
    amplitudes: tuple[float, ...],
    window: Window,
    described: Mapping[str, Mapping[str, Any]],
    ax: Axes | None = None,
) -> Figure:
    """Return the laws' boundaries at the largest amplitude over each other, each named with the parameters it was given."""
    from srfcli.results import plots

    first, K = studies[min(studies)].crossings[0][:, 0], float(matches[0].p[models[0].index("K")])
    labels = []
    for name, model, m in zip(names, models, matches, strict=True):
        values = {n: model.declared(n, float(m.p[model.index(n)])) for n in m.adjusted}
        units = {q.name: q.unit for q in model.parameters}
        told = ", ".join(plots.valued(n, value, units[n]) for n, value in values.items())
        labels.append(f"{plots.name_text(name)}, matched with {told}" if told else plots.name_text(name))
    branches = [
        {"eps": k, "label": labels[k], "V": curve[:, 0].tolist(), "K_over_W0": (K / curve[:, 1]).tolist()}
        for k, study in sorted(studies.items())
        for curve in study.curves[-1]
    ]
    hopf = {"V": window.velocities().tolist(), "K_over_W0": (K / first).tolist()}
    matched = any(m.adjusted for m in matches)
    title = f"{len(names)} laws, {'matched at low velocity' if matched else 'as given'}, ε = {amplitudes[-1]:g}"
    title = plots.titled(f"{title}; {names[0]} with", described)
    return plots.stability_diagram(branches, hopf=hopf, title=title, ax=ax)
