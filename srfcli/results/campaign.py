"""A campaign: many experiments, a row each, as the table that a laboratory publishes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from srfcli.core.errors import SrfError, Status
from srfcli.results.tables import Column, Result, Table, own_figure

ROOM = 60  # letters of the experiments' names that stand upright below the figure
PAIRS = (("A", "B"), ("A", "D0"), ("B", "D0"))  # whose covariances a fit of a velocity step is quoted with
LEADING = (
    Column("experiment", "", "folder or file"),
    Column("status", "", "of the fit; failed where there is none"),
    Column("law", "", "friction and ageing law"),
    Column("runs", "", "that were fitted"),
    Column("samples", "", "compared in them"),
    Column("V_min", "um/s", "lowest velocity of the drive"),
    Column("V_max", "um/s", "highest velocity of the drive"),
    Column("load", "", "mean of the fitted runs, in the unit beside it"),
    Column("load_unit", "", "N or MPa"),
    Column("segments", "", "of constant velocity, one slip length D0 or longer"),
    Column("steady", "", "of them, those that end in steady sliding"),
    Column("final_slope", "1/mm", "largest change of friction with slip at the end of a segment, over its error 3 or more"),
    Column("rms_over_noise", "", "1 where the model explains all but the noise"),
)
DERIVED = (
    Column("A_minus_B", "1", "A - B: above 0, friction rises with velocity"),
    Column("A_minus_B_stderr", "1", "with the covariance of the two"),
)
STATED = (
    Column("k", "", "stiffness, stated or fitted, in the unit beside it"),
    Column("k_stderr", "", "empty where the stiffness is the stated one"),
    Column("k_unit", "", "as the experiment states it"),
)
TRAILING = (
    Column("flags", "", "what is to be known before the row is used"),
    Column("reason", "", "why there is no fit"),
)


@dataclass(frozen=True, repr=False, eq=False)
class CampaignResult(Result):
    """The fits of many experiments.

    Attributes
    ----------
    rows : sequence of dict
        What each experiment's fit gave, by the name of its column, and `parameters`, name -> [value, standard error, unit].
    worst : Status
        INTERRUPTED where not all were done.
    """

    rows: Sequence[Mapping[str, Any]]
    asked: int
    worst: Status = Status.OK

    @property
    def failed(self) -> int:
        """Return how many experiments have no fit."""
        return sum(row["status"] == "failed" for row in self.rows)

    @property
    def table(self) -> Table:
        """Return a row for each experiment; a parameter that an experiment does not fit is empty in its row."""
        names = list(dict.fromkeys(name for row in self.rows for name in row.get("parameters", {}) if name != "K"))
        columns = [*LEADING]
        for name in names:
            units = dict.fromkeys(row["parameters"][name][2] for row in self.rows if name in row.get("parameters", {}))
            unit = next(iter(units)) if len(units) == 1 else ""
            columns += [Column(name, unit, "estimate"), Column(f"{name}_stderr", unit, "standard error", ".3g")]
        both = {"A", "B"} <= set(names)
        covariances = [Column(f"cov_{a}_{b}", "", "covariance") for a, b in PAIRS if {a, b} <= set(names)]
        columns += [*(DERIVED if both else ()), *STATED, *covariances, *TRAILING]
        cells = []
        for row in self.rows:
            found = {**row, **row.get("covariances", {})}
            for name, (value, error, _) in row.get("parameters", {}).items():
                found |= {name: value, f"{name}_stderr": error}
            cells.append([found.get(column.name) for column in columns])
        notes = []
        if self.failed:
            notes.append(f"{self.failed} of {len(self.rows)} experiments have no fit: their rows say why")
        if len(self.rows) < self.asked:
            notes.append(f"interrupted: {len(self.rows)} of {self.asked} experiments were done")
        title = f"{len(self.rows)} experiment" + ("s" if len(self.rows) != 1 else "")
        worst = Status.INTERRUPTED if len(self.rows) < self.asked else self.worst
        return Table("srf.campaign/1", tuple(columns), cells, title, tuple(notes), status=worst.value)

    def plot(self, ax: Any = None) -> Any:
        """Return A - B with its error over the velocity of each experiment, those that have no fit left out."""
        from srfcli.results import plots

        own_figure(ax, "a campaign")
        known = [row for row in self.rows if row.get("A_minus_B") is not None]
        if not known:
            raise SrfError("no experiment of the campaign has A and B: there is nothing to draw", "Leave --plot out.")
        laws = list(dict.fromkeys(str(row["law"]) for row in known))
        title = plots.name_text("; ".join(laws), wide=True)
        with plots.one_panel(None, title=title, size=(max(6.0, 1.0 + 0.3 * len(known)), 4.2)) as (figure, axes):
            place = range(len(known))
            values, errors = ([row[key] for row in known] for key in ("A_minus_B", "A_minus_B_stderr"))
            errors = [e if e is not None and math.isfinite(e) else 0.0 for e in errors]
            axes.errorbar(place, values, yerr=[1.96 * e for e in errors], fmt="o", capsize=3, color=plots.COLOURS[0])
            axes.axhline(0.0, color="#555555", linestyle=plots.DOTTED)
            axes.set(xticks=list(place), ylabel="A − B, and 95 % intervals", xlabel="experiment")
            names = _short([str(row["experiment"]) for row in known])
            turn: dict[str, Any] = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"}
            upright = sum(map(len, names)) <= ROOM and len(known) < 10
            axes.set_xticklabels([plots.name_text(name) for name in names], **({} if upright else turn))
            axes.margins(x=0.5 / len(known) if len(known) > 1 else 0.5)
        return figure


def _short(places: Sequence[str]) -> list[str]:
    """Return the names of folders or files, those of their folders where all are called alike, whole where two are the same."""
    named = [
        Path(place).parent.name or place if Path(place).name == "experiment.toml" else Path(place).name
        for place in places
    ]
    return [name if named.count(name) == 1 else place for name, place in zip(named, places, strict=True)]
