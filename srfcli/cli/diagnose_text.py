"""What `srf diagnose` prints for a reader: the verdict in a sentence, then tables of what it rests on."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.output.tables import Column, Table, print_terminal, to_text

if TYPE_CHECKING:
    from srfcli.diagnosis.locate import Location
    from srfcli.diagnosis.verdict import Diagnosis

HYPOTHESES = (
    Column("hypothesis", "", "effects added to the baseline"),
    Column("evidence", "", "log evidence over the baseline's", ".1f"),
    Column("rms_over_noise", "", "1 where all but noise is explained", ".4f"),
    Column("p_value", "", "that noise alone is left", ".2g"),
    Column("confidence", "", "stated", ".3f"),
    Column("track", "", "rough where it was needed"),
)
PARAMETERS = (
    Column("parameter", "", "name"),
    Column("baseline", "", "estimate"),
    Column("stderr", "", "its standard error", ".2g"),
    Column("augmented", "", "estimate in the final model"),
    Column("stderr ", "", "its standard error", ".2g"),
    Column("unit", "", "of the four before"),
    Column("bent_by", "", "how far the baseline was off, in the final model's standard errors", ".1f"),
)
RUNS = (
    Column("run", "", "name"),
    Column("role", "", "fit, or held out"),
    Column("baseline", "", "residual over noise", ".4f"),
    Column("augmented", "", "residual over noise", ".4f"),
    Column("share", "", "of the baseline's excess misfit", ".2f"),
    Column("p_value", "", "adjusted for all that was looked at", ".1g"),
    Column("where", "", "times (s) that hold most of it"),
)
SENTENCES = {
    "none": "none: the baseline explains the recordings down to the noise",
    "identified": "identified: {}",
    "ambiguous": "ambiguous: {}: they do equally well",
    "unknown": "unknown: something is missing that no registered effect explains",
    "inconclusive": "inconclusive: nothing is needed, and effects of interesting size could not have been seen",
}
MOST = 8  # hypotheses that are shown


def print_answer(found: dict[str, Any], diagnosis: Diagnosis, location: Location, folder: Path | None) -> None:
    """Print verdict and tables to stdout."""
    from srfcli.diagnosis.answer import parameter_rows, ranked_rows, run_views

    click.echo(SENTENCES[found["verdict"]].format(" and ".join(found["effects"])))
    click.echo()
    ranked = ranked_rows(diagnosis)
    zero = next(r["evidence"] for r in ranked if r["name"] == "none")
    rows = [
        (
            r["name"],
            r["evidence"] - zero,
            r["rms_over_noise"],
            r["p_value"],
            r["confidence"],
            "rough" if r["rough"] else "",
        )
        for r in ranked[:MOST]
    ]
    _print(Table("srf.diagnose.hypotheses/1", HYPOTHESES, rows, "hypotheses", tuple(_notes(found))))
    keys = ("name", "baseline", "baseline_stderr", "augmented", "augmented_stderr", "unit", "shift_sigma")
    rows = [tuple(r[k] for k in keys) for r in parameter_rows(diagnosis)]
    _print(Table("srf.diagnose.parameters/1", PARAMETERS, rows, "parameters"))
    places = {r.name: r for r in location.runs}
    rows = []
    for v in run_views(diagnosis):
        place = places.get(v.run.name)
        where = "" if place is None else ", ".join(f"{a:.4g} to {b:.4g}" for a, b in place.windows)
        told = (None, None, where) if place is None else (place.share, place.p_value, where)
        rows.append((v.run.name, "held out" if v.holdout else "fit", *v.rms, *told))
    _print(Table("srf.diagnose.runs/1", RUNS, rows, "runs", tuple(_places(location))))
    if folder is not None:
        home = folder / "augmented"
        laws = f"--law {home / 'friction.toml'} --ageing {home / 'ageing.toml'} --interface {home / 'interface.toml'}"
        click.echo(f"The augmented model: srf fit {home}")
        click.echo(f"Its laws' diagram: srf linear {laws}")


def _print(table: Table) -> None:
    if sys.stdout.isatty():
        print_terminal(table, sys.stdout)
    else:
        click.echo(to_text(table), nl=False)
    click.echo()


def _notes(found: dict[str, Any]) -> list[str]:
    notes = list(found["reasons"])
    for name, side in (("baseline", found["baseline"]), ("final model", found["augmented"])):
        held = side["holdout"]["rms_over_noise"]
        rest = "" if held is None else f", {held:.4g} in those held out"
        notes.append(f"{name}: rms over noise {side['fit']['rms_over_noise']:.4g} in the runs fitted{rest}")
    notes += [f"{a} and {b} cannot be told apart by these recordings" for a, b in found["equivalent"]]
    notes += [f"{x['effect']} is not identifiable: {x['reason']}" for x in found["not_identifiable"]]
    notes += _missing(found.get("missing") or {})
    notes += (found.get("experiment") or {}).get("sentences", [])
    for effect, size in found.get("detectable", {}).items():
        notes.append(f"{effect} could have been seen from a size of {size:.3g} on")
    return notes


def _missing(missing: dict[str, Any]) -> list[str]:
    """Return what is known of a force that no registered effect explains."""
    if not missing:
        return []
    latent = missing["latent"]
    notes = [f"a friction of {latent['amplitude']:.2g} that changes within {latent['time']:.2g} s is missing"]
    for name, share in list(latent["coordinates"].items())[:1]:
        notes[0] += f"; a function of {name} is {100 * share:.0f} % of it"
    if missing["form"] is None:
        return [*notes, "no closed form over the candidate terms is worth its parameters"]
    gain, held = missing["gain"], missing["held_gain"]
    told = "" if held is None else f", {held:+.1f} in held-out runs"
    left = "" if missing["leaves_noise_alone"] else f"; it leaves {missing['rms_over_noise']:.3g} times the noise"
    return [*notes, f"it behaves like {missing['form']}: log likelihood {gain:+.1f}{told}{left}"]


def _places(location: Location) -> list[str]:
    notes = []
    if location.forcing_phase is not None:
        notes.append(
            "the misfit goes with the forcing: {:.2f} to {:.2f} rad after its maximum".format(*location.forcing_phase)
        )
    if location.frequencies:
        notes.append(f"it has lines at {', '.join(f'{f:.4g}' for f in location.frequencies)} Hz")
    if location.coordinate is not None:
        name, share = location.coordinate
        notes.append(f"a function of {name} explains {100 * share:.0f} % of it")
    return notes
