"""Random parameters over the declared bounds through the commands, and stability against brute force.

    python benchmarks/stress.py --draws 20 --points 200 --seed 1

Each friction law with the paper's ageing law and interface, each ageing law, modifier and interface with the paper's friction
law: every parameter is drawn at random, in its logarithm within its bounds and some decades of its default (`--decades`), and
so are V, W0, eps and f. A command may say that it did not converge (3) or that the system is none (2). What counts as a failure
is a traceback, a warning of Python or NumPy, and a NaN or a missing number in a row whose status is ok. With `--ends` each
parameter is then swept over the ends of its range by `srf linear` and `srf response`. The last tables compare the verdict of
`srf floquet` with multipliers from shooting with DOP853: on the paper's equations written by hand (`tests/brute.py`), and for
every system in turn on the rates that its module computes, their derivatives by central differences.
"""

from __future__ import annotations

import argparse
import collections
import json
import math
import random
import re
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from scipy.integrate import solve_ivp

from srfcli.cli.main import cli
from srfcli.codegen.model import GeneratedModel, open_model
from srfcli.core.settings import Parameter
from srfcli.core.units import to_base
from srfcli.laws.registry import Registry, bundled_registry
from srfcli.numerics.floquet import climbed
from srfcli.numerics.orbit import scales

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from brute import Slider, shoot, steady

NEEDED = {  # the columns that have a number in a row that is ok
    "linear": ("V", "K_over_W0", "W0", "Omega_c"),
    "floquet": ("re", "im", "modulus", "theta", "error"),  # no rate of growth where a multiplier is 0
    "critical": ("eps", "V", "K_over_W0", "W0", "theta", "W0_low", "W0_high", "error", "residual", "slope", "others"),
    "simulate": ("t", "V", "W", "u", "v", "phi", "mu", "tau"),
}


def systems() -> list[dict[str, str]]:
    """The systems that are tried, by the options that name them."""
    registry = bundled_registry()
    found = [{"law": e.name} for e in registry.entries("friction")]
    found += [{"ageing": e.name} for e in registry.entries("ageing") if e.name != "dieterich"]
    found += [{"ageing": f"dieterich+{e.name}"} for e in registry.entries("modifier")]
    return found + [{"interface": e.name} for e in registry.entries("interface") if e.name != "elastic"]


def drawn(parameter: Parameter, chance: random.Random, decades: float) -> float:
    """A value within the bounds and some decades of the default."""
    size = abs(parameter.default) or 1.0
    if parameter.lower < 0:
        return chance.uniform(max(parameter.lower, -10 * size), min(parameter.upper, 10 * size))
    low = max(parameter.lower, size * 10**-decades)
    high = min(parameter.upper, size * 10**decades)
    return 0.0 if parameter.lower == 0 and chance.random() < 0.05 else math.exp(chance.uniform(math.log(low), math.log(high)))


def draw(parameters: tuple[Parameter, ...], chance: random.Random, decades: float) -> tuple[list[str], dict[str, float]]:
    """Options that set every parameter but those of the point, and a point V, W0, eps, f."""
    own = [p for p in parameters if p.name not in ("V", "W0", "eps", "f")]
    options = [word for p in own for word in ("--set", f"{p.name}={drawn(p, chance, decades)!r}")]
    point = {"V": 10 ** chance.uniform(-2, 3), "W0": 10 ** chance.uniform(-1, 2)}
    return options, point | {"eps": chance.uniform(0.01, 0.9), "f": 10 ** chance.uniform(0, 3)}


def commands(point: dict[str, float]) -> dict[str, list[str]]:
    """The commands that are tried at a point."""
    V, W0, eps, f = (repr(point[n]) for n in ("V", "W0", "eps", "f"))
    length, rate = repr(min(5.0, 20 / point["V"])), repr(50 / min(5.0, 20 / point["V"]))
    return {
        "linear": ["linear", "--over", f"V={V}"],
        "floquet": ["floquet", "--V", V, "--W0", W0, "--eps", eps, "--f", f],
        "critical": ["critical", "--V", V, "--eps", eps, "--f", f],
        "simulate": ["simulate", "--V", V, "--W0", W0, "--eps", eps, "--f", f, "--for", length, "--rate", rate],
    }


def over_the_ends(registry: Registry) -> collections.Counter[str]:
    """Count what the rows say where one parameter runs over its bounds, its default and 0, for every system."""
    counts: collections.Counter[str] = collections.Counter()
    for names in systems():
        named = [w for k, v in names.items() for w in (f"--{k}", v)]
        for p in open_model(registry, **names).parameters:
            if p.name in ("W0", "eps", "f"):
                continue
            ends = {max(p.lower, -1e29), p.default or 1.0, min(p.upper, 1e29)} | ({0.0} if p.lower <= 0 else set())
            over = f"{p.name}={','.join(map(repr, sorted(ends)))}"
            for words in (["linear"], ["response"], ["response", "--mean", "--eps", "0.1"]):
                command = [*words, "--over", over, *named]
                said, why = verdict(command)
                if said in ("failed", "refused"):
                    counts[f"{' '.join(words[:2])}: {said}"] += 1
                    print(f"{said.upper()} srf {' '.join(command)}: {why}", flush=True)
                    continue
                done = CliRunner().invoke(cli, [*command, "--json"], prog_name="srf")
                for row in json.loads(done.stdout)["rows"]:
                    counts[f"{' '.join(words[:2])}: {row['status']}"] += 1
                    numbers = [row[n] for n in ("W0", "friction_gain", "mean_force") if n in row]
                    if (row["status"] == "ok") != (None not in numbers) and "Lyapunov" not in row["status"]:
                        print(f"FAILED srf {' '.join(command)}: {row}", flush=True)
    return counts


def why_not(model: GeneratedModel, values: dict[str, float]) -> str:
    """Say what keeps `srf floquet` from a state: how far eps can be raised from 0, and what becomes of the state there."""
    p = model.vector({q.name: to_base(values[q.name], q.unit) for q in model.parameters if q.name in values})
    with np.errstate(all="ignore"):
        if not model.has_rates(p):
            return "a formula has no value"
        batch, reached = climbed(model, p[:, None], 512)
        swing = float(np.ptp(batch.orbit.stages[0][..., list(model.logarithmic)], axis=(0, 1)).max())
        if reached == 0:
            return "none near eps = 0: growth over a period, or a rate, beyond what numbers hold"
        if reached == 1:
            return "found, and its multipliers not to the tolerance"
        return "velocity or age runs over 300 decades" if swing > 680 else "the branch of states ends before eps"


def verdict(arguments: list[str]) -> tuple[str, str]:
    """Run a command and say what it did: ok, not converged, refused, or how it failed."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = CliRunner().invoke(cli, [*arguments, "--json"], prog_name="srf")
    said = done.stderr.strip().splitlines()
    if done.exit_code not in (0, 2, 3) or "unexpected" in done.stderr:
        return "failed", f"exit {done.exit_code}: {said[:1]}"
    if done.exit_code == 2:
        return "refused", str(said[:1])
    if not done.stdout:
        return ("failed" if "at these values" in done.stderr else "not converged"), f"{said[:1]} names no parameter"
    found = json.loads(done.stdout)
    for row in found["rows"]:
        missing = [n for n in NEEDED.get(arguments[0], ()) if row.get("status", found["status"]) == "ok" and row[n] is None]
        if missing:
            return "failed", f"no number for {missing} in a row that is ok: {row}"
    if nothing := [note for note in found["notes"] if re.search(r"\b(nan|inf)\b", note)]:
        return "failed", f"no number in the notes: {nothing}"
    return ("ok", "") if done.exit_code == 0 else ("not converged", said[-1].partition(": ")[2].partition(";")[0])


def stable_by_hand(s: Slider) -> bool | None:
    """Whether the periodic state is stable, by shooting; None where it is not found, or the multiplier too near to 1."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            orbit = shoot(s, steady(s), rtol=1e-9, tol=1e-7)
        except Exception:  # shooting from steady sliding need not converge
            return None
    largest = float(np.abs(orbit.multipliers).max())
    return None if not np.isfinite(largest) or abs(largest - 1) < 1e-4 else largest < 1


def compared(points: int, chance: random.Random, seconds: float) -> collections.Counter[str]:
    """Count on how many random points of the paper's system the verdict is that of its equations by hand."""
    counts: collections.Counter[str] = collections.Counter()
    begun = time.monotonic()
    while counts["agree"] + counts["differ"] < points and time.monotonic() - begun < seconds:
        s = Slider(V=10 ** chance.uniform(0, 2), W0=chance.uniform(4, 40), eps=chance.uniform(0.01, 0.25),
                   f=chance.uniform(40, 300), A=chance.uniform(0.008, 0.02), B=chance.uniform(0.015, 0.04),
                   D0=chance.uniform(0.2, 0.8), lam=chance.uniform(0.3, 1.0), K=chance.uniform(0.1, 0.4))  # fmt: skip
        by_hand = stable_by_hand(s)
        given = {"V": s.V, "W0": s.W0, "eps": s.eps, "f": s.f, "K": s.K}
        options = [w for n, v in given.items() for w in (f"--{n}", repr(v))]
        options += [w for n, v in (("A", s.A), ("B", s.B), ("D0", s.D0), ("lambda", s.lam)) for w in ("--set", f"{n}={v!r}")]
        done = CliRunner().invoke(cli, ["floquet", *options, "--json"], prog_name="srf")
        if by_hand is None or done.exit_code != 0:
            counts["by hand not found" if by_hand is None else "not converged"] += 1
            continue
        found = json.loads(done.stdout)
        ours = max(row["modulus"] for row in found["rows"]) < 1
        counts["agree" if ours == by_hand else "differ"] += 1
        counts["stable" if by_hand else "unstable"] += 1
        if ours != by_hand:
            print(f"DIFFER {s}", flush=True)
    return counts


def shot(model: GeneratedModel, values: dict[str, float]) -> bool | None:
    """Whether the periodic state next to steady sliding is stable, for any system; None as above, and where it costs much."""
    p = model.vector({q.name: to_base(values[q.name], q.unit) for q in model.parameters if q.name in values})
    with np.errstate(all="ignore"):
        x, n = np.asarray(model.steady(p), dtype=float), len(model.states)
        size, left = scales(model, p[:, None])[0], 60_000
        apart = np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)]) * 1e-6

        def field(tau: float, y: np.ndarray) -> np.ndarray:
            nonlocal left
            left -= 1
            if left < 0:
                raise ArithmeticError("too stiff for DOP853")
            at = (y[:n] + apart) * size
            rates = model.cycle(tau, at, p[:, None]) / size
            J = (rates[1 : n + 1] - rates[n + 1 :]).T / 2e-6
            return np.concatenate([rates[0], (J @ y[n:].reshape(n, n)).ravel()])

        x = x / size
        for _ in range(25):
            try:
                run = solve_ivp(field, (0, 1), np.concatenate([x, np.eye(n).ravel()]), "DOP853", rtol=1e-9, atol=1e-10)
                end, monodromy = run.y[:n, -1], run.y[n:, -1].reshape(n, n)
                step = np.linalg.solve(np.eye(n) - monodromy, end - x)
            except (ArithmeticError, ValueError, np.linalg.LinAlgError):
                return None
            if not run.success or not np.isfinite(step).all():
                return None
            if np.abs(step).max() < 1e-7:
                largest = float(np.abs(np.linalg.eigvals(monodromy)).max())
                return None if abs(largest - 1) < 1e-3 else largest < 1
            x = x + step * min(1.0, 1.0 / float(np.abs((step * size)[list(model.logarithmic)]).max()))
    return None


def compared_all(points: int, chance: random.Random, seconds: float) -> collections.Counter[str]:
    """Count on how many random points of all systems the verdict is that of shooting; parameters within a third of a decade."""
    counts: collections.Counter[str] = collections.Counter()
    registry, begun = bundled_registry(), time.monotonic()
    while counts["agree"] + counts["differ"] < points and time.monotonic() - begun < seconds:
        for names in systems():
            options, point = draw(open_model(registry, **names).parameters, chance, 1 / 3)
            point = {"V": 10 ** chance.uniform(0, 2), "W0": chance.uniform(4, 40)}
            point |= {"eps": chance.uniform(0.01, 0.25), "f": chance.uniform(40, 300)}
            values = {n: float(v) for n, v in (w.split("=") for w in options if w != "--set")} | point
            by_hand = shot(open_model(registry, **names), values)
            named = [w for k, v in names.items() for w in (f"--{k}", v)]
            command = [*commands(point)["floquet"], *named, *options]
            done = CliRunner().invoke(cli, [*command, "--json"], prog_name="srf")
            if by_hand is None or done.exit_code != 0:
                counts["by shooting not found" if by_hand is None else "not converged"] += 1
                continue
            ours = max(row["modulus"] for row in json.loads(done.stdout)["rows"]) < 1
            counts["agree" if ours == by_hand else "differ"] += 1
            counts["stable" if by_hand else "unstable"] += 1
            if ours != by_hand:
                print(f"DIFFER srf {' '.join(command)}", flush=True)
    return counts


def main() -> None:
    """Run both parts and print their tables."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--draws", type=int, default=20)
    asked.add_argument("--points", type=int, default=200)
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--seconds", type=float, default=float("inf"), help="stop each part after so long")
    asked.add_argument("--decades", type=float, default=3.0)
    asked.add_argument("--ends", action="store_true", help="sweep the ends of each parameter too")
    asked.add_argument("--skip", default="", help="commands that are left out, with commas")
    given = asked.parse_args()
    chance = random.Random(given.seed)
    counts: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    reasons: collections.Counter[tuple[str, str]] = collections.Counter()
    registry, begun = bundled_registry(), time.monotonic()
    for number in range(given.draws):
        for names in systems():
            if time.monotonic() - begun > given.seconds:
                break
            options, point = draw(open_model(registry, **names).parameters, chance, given.decades)
            values = {n: float(v) for n, v in (w.split("=") for w in options if w != "--set")}
            named = [w for k, v in names.items() for w in (f"--{k}", v)]
            for command, arguments in commands(point).items():
                if command in given.skip.split(","):
                    continue
                said, why = verdict([*arguments, *named, *options])
                counts[command][said] += 1
                if said == "not converged":
                    reasons[command, why_not(open_model(registry, **names), values | point) if command == "floquet" else why] += 1
                if said == "failed":
                    print(f"FAILED draw {number}: srf {' '.join([*arguments, *named, *options])}: {why}", flush=True)
    print("| command | draws | ok | not converged | refused | failed |\n|---|---|---|---|---|---|")
    for command, count in counts.items():
        cells = " | ".join(str(count[n]) for n in ("ok", "not converged", "refused", "failed"))
        print(f"| {command} | {count.total()} | {cells} |")
    print("\n| not converged | why | draws |\n|---|---|---|")
    for (command, name), value in sorted(reasons.items()):
        print(f"| {command} | {name} | {value} |")
    if given.ends:
        print("\n| over the ends of each parameter | rows |\n|---|---|")
        for name, value in sorted(over_the_ends(registry).items()):
            print(f"| {name} | {value} |")
    print("\n| stability of the paper's system at random points | |\n|---|---|")
    for name, value in compared(given.points, chance, given.seconds).items():
        print(f"| {name} | {value} |")
    print("\n| stability of every system at random points | |\n|---|---|")
    for name, value in compared_all(given.points, chance, given.seconds).items():
        print(f"| {name} | {value} |")


if __name__ == "__main__":
    main()
