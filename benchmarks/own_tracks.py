"""The diagnosis where each run has a random friction field of its own.

usage: own_tracks.py [--repeats N] [--workers N]      N cases of each effect, 1 if left out

Cases are drawn like those of a sealed trial (`srf prove`), by the same independent generator, but the slider is set down anew
before each run: amplitudes of 1e-4 and 3e-4 in turn, correlation lengths of 3 to 30 um. They are not sealed.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import common
import numpy as np

EFFECTS = (
    (), ("interface-compliance",), ("load-transmission",), ("friction-drift",), ("linker-dieterich",), ("age-saturation",),
    ("sensor-lag",), ("viscous-drag",), ("age-exponent",), ("linker-dieterich", "tangential-crosstalk"),
)  # fmt: skip


def one(task: tuple[tuple[str, ...], float, int]) -> tuple[str, str, bool, float]:
    """Return the verdict, the names, whether both are right, and the CPU it took."""
    from srfcli.validation.blind import diagnose_case
    from srfcli.validation.cases import case_files, draw_recipe, read_gauge
    from srfcli.validation.slider import Track, move

    effects, amplitude, seed = task
    rng = np.random.default_rng([seed, int(1e6 * amplitude), 7])
    recipe = draw_recipe(rng, effects=list(effects) if effects else None, kind=None if effects else "none", rough=amplitude)
    readings = {}
    for plan in recipe.plans:
        track = Track(amplitude, recipe.physics.track.length, int(rng.integers(2**31)))
        trace = move(replace(recipe.physics, track=track), plan)
        readings[plan] = read_gauge(trace.u, recipe.gauge, rng, backlash=recipe.physics.backlash)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "case"
        folder.mkdir()
        for file, text in case_files("own tracks", recipe.baseline, readings).items():
            (folder / file).write_text(text, encoding="utf-8")
        begun = time.process_time()
        found = diagnose_case(folder, ())
    used = time.process_time() - begun
    listed = all(e.listed for e in recipe.effects)
    if not effects:
        right = found.verdict == "none"
    elif listed:
        right = found.verdict == "identified" and set(found.effects) == set(effects)
    else:
        right = found.verdict == "unknown"
    return found.verdict, "+".join(sorted(found.effects)) or "-", right, used


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    asked = parser.parse_args()
    report = common.Report("own_tracks", __doc__ or "")
    tasks = [
        (effects, (1e-4, 3e-4)[number % 2], seed)
        for seed in range(asked.repeats)
        for number, effects in enumerate(EFFECTS)
    ]
    rows, marks = [], []
    with ProcessPoolExecutor(asked.workers) as pool:
        for task, (verdict, names, right, used) in zip(tasks, pool.map(one, tasks), strict=True):
            marks.append(right)
            concealed = "+".join(task[0]) or "nothing"
            row = (concealed, f"{task[1]:.0e}", verdict, names, "right" if right else "WRONG", f"{used:.0f} s")
            rows.append(row)
            print(row, flush=True)
    report.table(("concealed", "field", "verdict", "effects", "", "CPU"), rows)
    report.say(f"right: {sum(marks)} of {len(marks)}")


if __name__ == "__main__":
    main()
