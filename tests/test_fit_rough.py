"""`srf fit` on recordings of another code: whether runs share a track, and what that tells of held-out ones."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from srfcli.cli.main import cli
from srfcli.codegen.c_source import compiler
from srfcli.validation.cases import Gauge, case_files, read_gauge
from srfcli.validation.slider import Physics, Plan, Track, move

PLANS = (
    Plan("up", ((0.6, 20), (0.6, 60)), 3.0, 0.002),
    Plan("down", ((0.8, 50), (0.4, 15)), 3.0, 0.002),
    Plan("again", ((0.5, 30), (0.7, 45)), 3.0, 0.002, holdout=True),
)
pytestmark = [
    pytest.mark.usefixtures("empty_folder"),
    pytest.mark.skipif(compiler() is None, reason="no C compiler: motion is too slow here"),
]


@pytest.fixture(scope="module", params=[(3, 3, 3), (3, 4, 5)], ids=["one track", "own tracks"])
def fitted(request, tmp_path_factory):
    folder, rng, base = tmp_path_factory.mktemp("rough"), np.random.default_rng(5), Physics()
    tracks = [Track(2e-3, 6.0, seed) for seed in request.param]
    readings = {
        q: read_gauge(move(replace(base, track=track), q).u, Gauge(), rng)
        for q, track in zip(PLANS, tracks, strict=True)
    }
    for name, text in case_files("small", base, readings).items():
        (folder / name).write_text(text)
    done = CliRunner().invoke(cli, ["fit", str(folder), "--free", "mu0,A,B", "--json"])
    assert done.exit_code == 0, done.stderr
    return len(set(request.param)) == 1, json.loads(done.stdout)


def test_runs_share_a_track_where_they_do(fitted):
    shared, found = fitted
    assert found["meta"]["track"]["shared"] is shared
    note = next(n for n in found["notes"] if n.startswith("friction field: "))
    assert ("one for all runs" in note) is shared and ("each run has its own" in note) is not shared


def test_a_run_that_was_held_out_is_predicted(fitted):
    """On the track that all share; where each has its own, by the filter, each reading from those before it."""
    _, found = fitted
    over = found["meta"]["rms_over_noise"]
    assert over["fit"] < 1.15 and over["holdout"] < 1.15


def test_parameters_are_those_concealed_within_their_errors(fitted):
    _, found = fitted
    truth = Physics()
    for row in found["rows"]:
        assert abs(row["value"] - getattr(truth, row["parameter"])) < 3.5 * row["stderr"], row
