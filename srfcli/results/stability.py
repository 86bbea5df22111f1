"""Formulas of a system; its stability under constant load, of one forced periodic state, and the boundary under modulation."""

from __future__ import annotations

import ast
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from srfcli.codegen.model import GeneratedModel
from srfcli.core.errors import Status, worst
from srfcli.numerics.hopf import critical_point
from srfcli.results import plots
from srfcli.results.figures import gains
from srfcli.results.tables import STATUS, Column, Result, Table, TextResult, tag

if TYPE_CHECKING:
    import sympy as sp
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srfcli.codegen.slider import SlidingSystem
    from srfcli.numerics.boundary import BoundaryPoint
    from srfcli.numerics.continuation import Boundary
    from srfcli.numerics.floquet import FloquetResult
    from srfcli.numerics.response import LinearResponse, MeanFriction
    from srfcli.symbolic.derivation import Section
    from srfcli.symbolic.paper import Finding
    from srfcli.symbolic.system import System

# What follows by algebra, the paper's equations held against it, and the module that computes with it.


def _derivation() -> Any:
    """Return the module that writes formulas, imported when it is asked for: sympy comes with it."""
    from srfcli.symbolic import derivation

    return derivation


@dataclass(frozen=True, repr=False, eq=False)
class DerivationResult(TextResult):
    """What follows from a system's laws by algebra, in the letters and normalisation of the paper.

    Attributes
    ----------
    system : System
        The laws as one system of formulas.
    extras : tuple of str
        The long parts that were asked for.
    """

    system: System = field(repr=False)
    extras: tuple[str, ...] = ()

    @cached_property
    def sections(self) -> tuple[Section, ...]:
        """Return the parts of the derivation, each with its named formulas and notes."""
        return _derivation().derivation(self.system, self.extras)

    @property
    def formulas(self) -> dict[str, sp.Expr]:
        """Return name -> sympy expression of every formula."""
        return {formula.name: formula.value for section in self.sections for formula in section.formulas}

    @cached_property
    def table(self) -> Table:
        """Return a row for each formula, as text and as LaTeX."""
        columns = (Column("part", ""), Column("name", ""), Column("formula", ""), Column("latex", "", "name = formula"))
        parts = self.document["sections"]
        rows = [(p["key"], f["name"], f["text"], f"{f['latex_name']} = {f['latex']}") for p in parts for f in p["formulas"]]
        notes = tuple(note for part in parts for note in part["notes"])
        return Table("srf.derive.table/1", columns, rows, self.system.title, notes)

    @property
    def text(self) -> str:
        """Return the formulas as plain text, one a line."""
        return _derivation().to_text(self.system, self.sections, unicode=False)

    @property
    def pretty(self) -> str:
        """Return the formulas over several lines in Unicode."""
        return _derivation().to_text(self.system, self.sections, unicode=True)

    @property
    def latex(self) -> str:
        """Return a LaTeX document, which needs amsmath."""
        return _derivation().to_latex(self.system, self.sections)

    @property
    def python(self) -> str:
        """Return a NumPy function of the coefficients of the dispersion relation, in um, s, N."""
        return _derivation().to_python(self.system)

    @property
    def document(self) -> dict[str, Any]:
        """Return the formulas as plain data, which `srf derive --format json` prints."""
        return _derivation().to_document(self.system, self.sections)

    def _repr_html_(self) -> str:
        """Return the formulas for a notebook, which sets what stands between dollar signs."""
        parts = [tag("b", self.system.title)]
        for section in self.document["sections"]:
            parts.append(tag("h4", section["title"]))
            parts += [tag("p", f"${f['latex_name']} = {f['latex']}$") for f in section["formulas"]]
            parts += [tag("p", note) for note in section["notes"]]
        return tag("div", parts)


@dataclass(frozen=True, repr=False, eq=False)
class PaperResult(TextResult):
    """The printed equations, claims and words of the paper, held against its own model.

    Attributes
    ----------
    findings : tuple of Finding
        What is printed, where, whether it holds and what is right.
    """

    findings: tuple[Finding, ...] = field(repr=False)

    @cached_property
    def table(self) -> Table:
        """Return a row for each finding."""
        about = {"line": "of the manuscript's source", "right": "what follows from the model"}
        findings = self.document["findings"]
        columns = tuple(Column(name, "", about.get(name, "")) for name in findings[0])
        rows = [tuple(finding.values()) for finding in findings]
        return Table("srf.derive-paper.table/1", columns, rows, "The paper's equations, claims and words")

    @property
    def text(self) -> str:
        """Return the findings as text: equations, claims and words."""
        return _derivation().paper_text(self.findings)

    @property
    def document(self) -> dict[str, Any]:
        """Return the findings as plain data, which `srf derive --check-paper --format json` prints."""
        return _derivation().paper_document(self.findings)


@dataclass(frozen=True, repr=False, eq=False)
class CodeResult(TextResult):
    """The generated NumPy module of a system.

    Attributes
    ----------
    model : GeneratedModel
        The module, loaded: its functions, and the parameters in the order in which these take them.
    """

    model: GeneratedModel

    @property
    def text(self) -> str:
        """Return the text of the module, which needs NumPy alone."""
        return self.model.source

    @cached_property
    def table(self) -> Table:
        """Return a row for each function of the module: its arguments, and what it returns."""
        columns = (Column("function", "", "name"), Column("arguments", "", "arrays of any leading shape"), Column("returns", ""))
        found = (f for f in ast.parse(self.text).body if isinstance(f, ast.FunctionDef) and not f.name.startswith("_"))
        rows = [(f.name, ", ".join(a.arg for a in f.args.args), (ast.get_docstring(f) or "").partition("\n")[0]) for f in found]
        notes = (f"p: {', '.join(self.model.names)}", f"x: {', '.join(self.model.states)}", "units um, s, N")
        return Table("srf.code/1", columns, rows, self.model.title, notes)


# Steady sliding under constant load: critical loads from the characteristic polynomial.


@dataclass(frozen=True, repr=False, eq=False)
class LinearResult(Result):
    """Critical loads of steady sliding at every point of a grid.

    Attributes
    ----------
    system : SlidingSystem
        The laws and the parameters that were not swept.
    over : Mapping[str, tuple of float]
        The values of each parameter that was swept, in its declared unit.
    points : tuple of Mapping[str, Any]
        One mapping for each row of the table, from column to value.
    """

    system: SlidingSystem
    over: Mapping[str, tuple[float, ...]]
    points: tuple[Mapping[str, Any], ...] = field(repr=False)

    @cached_property
    def table(self) -> Table:
        """Return critical load, K/W0 and frequency with the closed forms beside them, a row for each point."""
        units = {q.name: q for q in self.system.model.parameters}
        names = [n for n in self.over if n not in ("V", "W0")]
        columns = (
            Column("V", "um/s", "driving velocity"),
            Column("K_over_W0", "1/um", "critical K/W0"),
            Column("W0", "N", "critical load: stability is lost above it"),
            *(Column(n, units[n].unit, units[n].about) for n in names),
            Column("Omega_c", "rad/s", "frequency at the bifurcation"),
            Column("status", "", STATUS),
            Column("Omega_reduced", "1", "D0 Omega_c / V"),
            Column("K_over_W0_rigid", "1/um", "the same for kappa to infinity (closed form)"),
            Column("K_over_W0_quasistatic", "1/um", "the same for kappa to infinity and M to 0 (closed form)"),
            Column("Omega_rigid", "rad/s", "Omega_c for kappa to infinity (closed form)"),
            Column("crossing_rate", "1/(N s)", "d Re(s)/dW0 at the root", ".4g"),
            Column("lyapunov", "1", "Re c/Omega of z' = i Omega z + c z |z|^2, delta ln v = 2 Re z", ".4g"),
            Column("criticality", "", "supercritical, subcritical or, at third order, degenerate Hopf bifurcation"),
            Column("leading", "", "all other roots are stable"),
        )
        cells = [tuple(row.get(c.name) for c in columns) for row in self.points]
        kept = self.system.described(without=(*self.over, "W0", "eps", "f"))
        return Table("srf.linear/1", columns, cells, title=self.system.model.title, parameters=kept)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the critical K/W0 (1/um) over the first parameter that was swept, a curve for each value of the others."""
        (x, values), *others = self.over.items()
        if x == "V" and not others:
            curve = {k: [row.get(k) for row in self.points] for k in ("V", "K_over_W0")}
            return plots.stability_diagram([], hopf=curve, title=self._figure_title, ax=ax)
        groups: dict[str, list[Mapping[str, Any]]] = {}
        for row in self.points:
            name = ", ".join(plots.valued(n, row[n], self.system.model.unit(n)) for n, _ in others)
            groups.setdefault(name, []).append(row)
        return plots.lines(
            [row[x] for row in next(iter(groups.values()))],
            [[row.get("K_over_W0") for row in group] for group in groups.values()],
            list(groups),
            plots.axis_label(x, self.system.model.unit(x)),
            "critical K/W$_0$  [1/µm]",
            logx=spread(values),
            title=self._figure_title,
            ax=ax,
        )


def spread(values: tuple[float, ...]) -> bool:
    """Return whether rising values are spaced logarithmically: by one ratio, or over a decade where they are two."""
    if len(values) < 3:
        return len(values) == 2 and 0 < 10 * values[0] <= values[1]
    if values[0] <= 0:
        return False
    ratio = (values[-1] / values[0]) ** (1 / (len(values) - 1))
    return all(abs(b / a / ratio - 1) < 1e-6 for a, b in itertools.pairwise(values))


# The response to a modulated load: to first order, and in the mean at any amplitude.

QUANTITIES = {  # whose response is found: unit of the gain, what it is of, its name in a figure
    "friction": ("1", "of the friction coefficient", "µ"),
    "force": ("1", "of the friction force over W0", "µW/W$_0$"),
    "position": ("um", "of the slider's position", "x  [µm]"),
    "velocity": ("1", "of the interface's slip velocity over V", "v/V"),
}


@dataclass(frozen=True, repr=False, eq=False)
class ResponseResult(Result):
    """The response of steady sliding to a modulated load, to first order in its amplitude, over one parameter.

    Attributes
    ----------
    system : SlidingSystem
        The laws and the parameters that were not swept.
    name : str
        The parameter that was swept.
    values : tuple of float
        Its values (n,) in its declared unit.
    response : LinearResponse
        Transfer functions (n,) of friction, force, position and velocity.
    """

    system: SlidingSystem
    name: str
    values: tuple[float, ...] = field(repr=False)
    response: LinearResponse = field(repr=False)

    @cached_property
    def table(self) -> Table:
        """Return gain and phase of each quantity, a row for each value; notes say where they resonate."""
        from srfcli.numerics.response import resonance

        found, status = self.response, self.response.status
        parts = {name: getattr(found, name) for name in QUANTITIES}
        cells = [f(values) for values in parts.values() for f in (np.abs, np.angle)]
        steady = [("stable" if found.stable[i] else "unstable") if s.ok else None for i, s in enumerate(status)]
        rows = [(x, *(float(c[i]) for c in cells), steady[i], status[i].value) for i, x in enumerate(self.values)]
        columns = [_swept(self.system, self.name)]
        for name, (unit, about, _) in QUANTITIES.items():
            columns.append(Column(f"{name}_gain", unit, f"amplitude {about} for eps = 1, to first order"))
            columns.append(Column(f"{name}_phase", "rad", "ahead of the load"))
        columns += [Column("type", "", "stable or unstable: steady sliding"), Column("status", "", STATUS)]
        notes = ["to first order in eps: amplitudes are eps times the gains"]
        if self.name == "f":
            for name, values in parts.items():
                top = resonance(np.array(self.values), np.abs(values))
                where = "none inside the range" if top is None else f"{top[0]:.6g} Hz, gain {top[1]:.6g}"
                notes.append(f"resonance of {name}: {where}")
        if "unstable" in steady:
            notes.append("where steady sliding is unstable the response is not what would be seen")
        kept = self.system.described(without=(self.name, "eps"))
        overall = worst(status).value
        return Table("srf.response/2", tuple(columns), rows, self.system.model.title, tuple(notes), kept, status=overall)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return gain and phase of each quantity over the parameter that was swept."""
        drawn = {label: getattr(self.response, name) for name, (_, _, label) in QUANTITIES.items()}
        label = plots.axis_label(self.name, _swept(self.system, self.name).unit)
        return plots.in_place(
            ax, lambda: gains(self.values, drawn, xlabel=label, logx=spread(self.values), title=self._figure_title)
        )


@dataclass(frozen=True, repr=False, eq=False)
class MeanFrictionResult(Result):
    """The mean friction of the forced periodic states under a modulated load, over one parameter.

    Attributes
    ----------
    system : SlidingSystem
        The laws and the parameters that were not swept.
    name : str
        The parameter that was swept.
    values : tuple of float
        Its values (n,) in its declared unit.
    means : Mapping[float, MeanFriction]
        Time means (n,) over a forcing period, by the amplitude eps.
    """

    system: SlidingSystem
    name: str
    values: tuple[float, ...] = field(repr=False)
    means: Mapping[float, MeanFriction] = field(repr=False)

    @cached_property
    def table(self) -> Table:
        """Return mean friction, and what modulation takes off it, a row for each amplitude and value."""
        rows = []
        for eps, found in self.means.items():
            cells = (found.steady, found.force, found.drop, found.friction, found.growth, found.error)
            rows += [(eps, x, *(float(c[i]) for c in cells), found.status[i].value) for i, x in enumerate(self.values)]
        about = "ln of the leading multiplier's modulus; the forced state is stable where negative"
        columns = (
            Column("eps", "1", "modulation amplitude"),
            _swept(self.system, self.name),
            Column("steady_force", "1", "friction force of steady sliding over W0"),
            Column("mean_force", "1", "mean friction force over W0"),
            Column("force_drop", "1", "what modulation takes off the mean friction force, over W0"),
            Column("mean_friction", "1", "mean friction coefficient"),
            Column("growth_per_period", "1", about),
            Column("error", "1", "estimated error of the mesh", ".2g"),
            Column("status", "", STATUS),
        )
        notes = ("mean over a forcing period of the forced periodic state, stable or not",)
        kept = self.system.described(without=(self.name, "eps"))
        overall = worst([s for found in self.means.values() for s in found.status]).value
        return Table("srf.response.mean/2", columns, rows, self.system.model.title, notes, kept, status=overall)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the drop of the mean friction force over the parameter that was swept, a curve for each amplitude."""
        curves = [found.drop.tolist() for found in self.means.values()]
        names = [f"ε = {eps:g}" for eps in self.means]
        label = plots.axis_label(self.name, _swept(self.system, self.name).unit)
        ylabel = "drop of the mean friction force / W$_0$"
        return plots.lines(self.values, curves, names, label, ylabel, spread(self.values), title=self._figure_title, ax=ax)


def _swept(system: SlidingSystem, name: str) -> Column:
    """Return the column of the parameter that was swept."""
    return Column(name, system.model.unit(name), "", ".8g")


# One forced periodic state: its Floquet multipliers, mean friction and harmonics.


@dataclass(frozen=True, repr=False, eq=False)
class PeriodicResult(Result):
    """The forced periodic state at one point.

    Attributes
    ----------
    system : SlidingSystem
        Laws and parameters.
    state : FloquetResult
        The orbit on its mesh, the multipliers (complex, n), mean friction and harmonics.
    """

    system: SlidingSystem
    state: FloquetResult = field(repr=False)

    @property
    def stable(self) -> bool:
        """Return whether all multipliers lie inside the unit circle."""
        return bool(self.state.stable)

    @cached_property
    def table(self) -> Table:
        """Return a row for each multiplier, largest modulus first; `meta` has friction and harmonics."""
        r, model, parameters = self.state, self.system.model, self.system.described()
        f = float(r.p[model.index("f")])
        columns = (
            Column("multiplier", "1", "number, largest modulus first"),
            Column("re", "1", "real part", ".9g"),
            Column("im", "1", "imaginary part", ".9g"),
            Column("modulus", "1", "of the multiplier", ".9g"),
            Column("theta", "rad", "angle over one forcing period", ".9g"),
            Column("growth_rate", "1/s", "ln|multiplier| times the forcing frequency; none for a multiplier of 0"),
            Column("error", "1", "estimated error of the multipliers", ".2g"),
        )
        rows = []
        for i, m in enumerate(r.multipliers):
            modulus = abs(m)
            growth = float(np.log(modulus) * f) if modulus > 0 else None
            rows.append((i + 1, m.real, m.imag, modulus, float(np.angle(m)), growth, r.error))
        intervals = len(r.orbit.edges) - 1
        if not r.found:
            notes: tuple[str, ...] = (f"no forced periodic state was found, on up to {intervals} intervals",)
            meta: dict[str, Any] = {"stable": None, "intervals": intervals}
            return Table("srf.floquet/1", columns, rows, model.title, notes, parameters, meta, r.status.value)
        meta = {
            "stable": r.stable,
            "mean_friction": r.mean_friction,
            "friction_shift": r.friction_shift,
            "u_harmonics": [{"k": k, "amplitude_um": abs(c), "phase": float(np.angle(c))} for k, c in enumerate(r.u_harmonics)],
            "mu_harmonics": [{"k": k, "amplitude": abs(c), "phase": float(np.angle(c))} for k, c in enumerate(r.mu_harmonics)],
            "intervals": intervals,
            "liouville": r.liouville,
        }
        known = not math.isnan(r.liouville)
        compared = f"{r.liouville:.1g}" if known else "not compared: the fastest multiplier is far below rounding"
        notes = (
            f"{'stable' if r.stable else 'unstable'}; error of the multipliers {r.error:.1g} on {intervals} intervals, "
            f"product of the multipliers against exp(integrated trace) {compared}",
            f"mean friction {r.mean_friction:.8f}, shift from eps = 0 {r.friction_shift:+.8f}",
            "harmonics of u [um]: " + ", ".join(f"{k}: {abs(c):.4g}" for k, c in enumerate(r.u_harmonics)),
            "harmonics of mu: " + ", ".join(f"{k}: {abs(c):.4g}" for k, c in enumerate(r.mu_harmonics)),
        )
        return Table("srf.floquet/1", columns, rows, model.title, notes, parameters, meta, r.status.value)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return one period of elongation, slip velocity, ages, friction and load, a panel for each."""
        from srfcli.numerics.floquet import waveforms

        r, model = self.state, self.system.model
        waves = waveforms(model, r.p, r.orbit, 400)
        # the period closes: its end is its beginning
        tau, closed = np.append(waves.tau, 1.0), lambda values: np.append(values, values[0])
        column = {name: closed(waves.x[:, i]) for i, name in enumerate(model.states)}
        ages = {n[3:]: np.exp(values) for n, values in column.items() if n.startswith("ln_") and n != "ln_v"}
        verdict = ("stable" if r.stable else "unstable") if r.found else "not converged"
        title = plots.titled(f"{model.title}, {verdict}", self.table.parameters)
        return plots.in_place(ax, lambda: plots.orbit(
            tau, u=closed(waves.u), v=np.exp(column["ln_v"]), states=ages, mu=closed(waves.mu), W=closed(waves.W),
            title=title,
        ))  # fmt: skip


# Critical loads under modulation: points at given velocities, and the boundary as curves.

BOUNDARY_COLUMNS = (
    Column("eps", "1", "modulation amplitude"),
    Column("component", "1", "number of the connected curve, none where points are found one by one"),
    Column("crossing", "1", "number among the crossings at this V, from low W0; odd: stability is lost as W0 rises"),
    Column("type", "", "ns, pd or fold: a multiplier off the real axis, at -1, at +1"),
    Column("V", "um/s", "driving velocity"),
    Column("K_over_W0", "1/um", "critical K/W0", ".10g"),
    Column("W0", "N", "critical load", ".10g"),
    Column("theta", "rad", "angle of the critical multiplier over one forcing period"),
    Column("status", "", STATUS),
    Column("W0_low", "N", "bracket of W0, from the estimated error", ".10g"),
    Column("W0_high", "N", "bracket of W0, from the estimated error", ".10g"),
    Column("error", "1", "estimated relative error", ".2g"),
    Column("residual", "1", "what Newton's method left of the correction, relative", ".2g"),
    Column("slope", "1", "d ln|multiplier| / d ln W0 at fixed V", ".4g"),
    Column("others", "1", "largest modulus among the other multipliers", ".3g"),
    Column("intervals", "1", "of the mesh"),
)


def boundary_columns(model: GeneratedModel, extra: tuple[str, ...] = ()) -> tuple[Column, ...]:
    """Return the columns of boundary points, the parameters `extra` among them, behind the load."""
    declared = {q.name: q for q in model.parameters}
    place = [c.name for c in BOUNDARY_COLUMNS].index("W0") + 1
    added = (Column(n, declared[n].unit, declared[n].about) for n in extra)
    return (*BOUNDARY_COLUMNS[:place], *added, *BOUNDARY_COLUMNS[place:])


def boundary_row(
    model: GeneratedModel, point: BoundaryPoint, component: int | None, crossing: int | None, extra: tuple[str, ...] = ()
) -> tuple[Any, ...]:
    """Return one boundary point under `boundary_columns`, the parameters `extra` in their declared units."""
    value = {n: point.value(model, n) for n in ("eps", "V", "K", "W0")}
    width = point.error * value["W0"]
    own = (model.declared(n, point.value(model, n)) for n in extra)
    place = (value["eps"], component, crossing, point.kind, value["V"], value["K"] / value["W0"], value["W0"], *own)
    bracket = (point.theta, point.status.value, value["W0"] - width, value["W0"] + width)
    return (*place, *bracket, point.error, point.residual, point.slope, point.others, point.orbit.x.shape[-2])


@dataclass(frozen=True, repr=False, eq=False)
class CriticalResult(Result):
    """Every critical load at some velocities and amplitudes, numbered from low W0.

    Attributes
    ----------
    system : SlidingSystem
        The laws and the parameters that were not swept.
    points : tuple of BoundaryPoint
        The polished crossings, each with its bracket, error and status.
    crossings : tuple of int
        The number of each at its velocity; stability is lost at odd ones as W0 rises, regained at even ones.
    said : tuple of str
        Notes: the loads that were searched, and crossings that were not found.
    worst : Status
        The worst status of lines and points.
    """

    system: SlidingSystem
    points: tuple[BoundaryPoint, ...] = field(repr=False)
    crossings: tuple[int, ...] = field(repr=False)
    said: tuple[str, ...] = field(repr=False)
    worst: Status = Status.OK

    @cached_property
    def table(self) -> Table:
        """Return a row for each critical load, with its bracket and error."""
        model = self.system.model
        rows = [boundary_row(model, q, None, k) for q, k in zip(self.points, self.crossings, strict=True)]
        described = self.system.described(without=("W0", "V", "eps"))
        return Table("srf.critical/1", BOUNDARY_COLUMNS, rows, model.title, self.said, described, status=self.worst.value)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the critical K/W0 (1/um) against V (um/s): marks, full where stability is lost as W0 rises, else open.

        Crossings of one number and amplitude are joined by a thin line for the eye.
        """
        points = self.table.records()
        order = list(dict.fromkeys(p["eps"] for p in points))
        with plots.one_panel(ax, title=self._figure_title) as (figure, ax):
            ax.set_xscale("log")
            for eps, crossing in sorted({(p["eps"], p["crossing"]) for p in points}):
                mine = sorted((p for p in points if (p["eps"], p["crossing"]) == (eps, crossing)), key=lambda p: p["V"])
                index, lost = order.index(eps), crossing % 2 == 1
                style = plots.curve_style(index)
                name = f"ε = {eps:g}: stability is {'lost' if lost else 'regained'} as W$_0$ rises"
                ax.plot(
                    [p["V"] for p in mine], [p["K_over_W0"] for p in mine], **style, linewidth=0.7, marker="os^Dv<>"[index % 7],
                    markersize=5.5, markerfacecolor=style["color"] if lost else "white", label=name if crossing < 3 else None,
                    clip_on=False, zorder=3,
                )  # fmt: skip
            ax.set(xlabel="V  [µm/s]", ylabel="critical K/W$_0$  [1/µm]")
            ax.margins(x=0.06)
            ax.set_ylim(0.0, 1.12 * max((p["K_over_W0"] for p in points), default=1.0))
            plots.decade_ticks(ax)
            return figure


@dataclass(frozen=True, repr=False, eq=False)
class BoundaryResult(Result):
    """The stability boundary in a plane of two parameters: all components in a window, a set for each amplitude.

    Attributes
    ----------
    system : SlidingSystem
        The laws and the parameters that were not swept.
    boundaries : tuple of Boundary
        The components in the plane of each amplitude: polished points, how each curve ends, notes and status.
    worst : Status
        The worst status, INTERRUPTED where the search was stopped.
    """

    system: SlidingSystem
    boundaries: tuple[Boundary, ...] = field(repr=False)
    worst: Status = Status.OK

    @property
    def _axes(self) -> tuple[str, str]:
        plane = self.boundaries[0].plane if self.boundaries else None
        return (plane.x.name, plane.y.name) if plane else ("V", "W0")

    @cached_property
    def table(self) -> Table:
        """Return a row for each point, component after component."""
        from srfcli.numerics.continuation import crossing_numbers

        model, rows, notes = self.system.model, [], []
        extra = tuple(n for n in self._axes if n not in ("V", "W0", "eps"))
        for boundary in self.boundaries:
            numbers = crossing_numbers(model, boundary)
            for component, (branch, crossings) in enumerate(zip(boundary.branches, numbers, strict=True), 1):
                pairs = zip(branch.points, crossings, strict=True)
                rows += [boundary_row(model, q, component, k, extra) for q, k in pairs]
            named = "" if "eps" in self._axes else f"eps = {boundary.plane.base[model.index('eps')]:g}: "
            count = len(boundary.branches)
            ends = "; ".join(f"{i}: {b.start.value}, {b.end.value}" for i, b in enumerate(boundary.branches, 1))
            notes.append(f"{named}{count} component{'' if count == 1 else 's'}" + (f" (ends {ends})" if count else ""))
            notes += [named + note for note in boundary.notes]
        columns = boundary_columns(model, extra)
        described = self.system.described(without=(*self._axes, "eps"))
        return Table("srf.continue/1", columns, rows, model.title, tuple(notes), described, status=self.worst.value)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the boundary in its plane; against V and K/W0 with that under constant load, and stable sliding shaded."""
        model, title = self.system.model, self._figure_title
        if not self.boundaries:
            return plots.stability_diagram([], title=title, ax=ax)
        plane, usual = self.boundaries[0].plane, self._axes == ("V", "W0")

        def height(q: BoundaryPoint) -> float:
            if usual:
                return q.value(model, "K") / q.value(model, "W0")
            return model.declared(plane.y.name, q.value(model, plane.y.name))

        branches = [
            {
                "eps": float(boundary.plane.base[model.index("eps")]),
                "V": [model.declared(plane.x.name, q.value(model, plane.x.name)) for q in branch.points],
                "K_over_W0": list(map(height, branch.points)),
                "label": "boundary" if "eps" in self._axes else None,
            }
            for boundary in self.boundaries
            for branch in boundary.branches
        ]
        if not usual:
            with plots.one_panel(ax, title=title) as (figure, ax):
                ax.set_xscale("log" if plane.x.log else "linear")
                ax.set_yscale("log" if plane.y.log else "linear")
                plots.draw_branches(ax, branches)
                xlabel, ylabel = (plots.axis_label(a, model.unit(a)) for a in self._axes)
                ax.set(xlabel=xlabel, ylabel=ylabel)
                plots.decade_ticks(ax)
                return figure
        velocities = np.geomspace(plane.x.lo, plane.x.hi, 80)
        points = [critical_point(model, model.with_values(plane.base, V=velocity))[0] for velocity in velocities]
        hopf = [None if point is None else float(plane.base[model.index("K")]) / point.W0 for point in points]
        return plots.stability_diagram(branches, hopf={"V": velocities, "K_over_W0": hopf}, title=title, ax=ax)
