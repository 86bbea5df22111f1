"""Work spread over processes and a cluster: the same bytes whatever is killed, and resumed runs that end alike."""

from __future__ import annotations

import functools
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from in_workers import deadly, faulty, fragile, slow, square

from srfcli.cli.main import cli
from srfcli.cli.options import Spread
from srfcli.core.errors import SrfError
from srfcli.core.parallel import Store, fingerprint, run_cluster, run_here, run_processes, stored
from srfcli.numerics.map import compute_map, solve_tile
from srfcli.numerics.plane import MapAxis, MapGrid, MapSettings, tile_tasks

ROOT = Path(__file__).resolve().parents[1]


def cube(task):
    return {"value": np.array(task[0] or 0) ** 3}


def values(results):
    return {index: float(result["value"]) for index, result in results}


TASKS = [(n, "") for n in range(7)]
SQUARES = {n: float(n * n) for n in range(7)}


@pytest.mark.parametrize("workers", [1, 3])
def test_processes_do_every_task(workers):
    assert values(run_processes(square, TASKS, workers=workers)) == SQUARES


def test_a_killed_worker_costs_its_task_only(tmp_path):
    mark = str(tmp_path / "mark")
    assert values(run_processes(fragile, [(n, mark) for n in range(7)], workers=2)) == SQUARES
    assert Path(mark).exists()


def test_a_task_that_kills_every_worker_is_named():
    with pytest.raises(SrfError, match="task 0 ended 3 worker processes"):
        list(run_processes(deadly, [(0, "")], workers=1))


def test_what_a_task_raises_comes_out():
    with pytest.raises(SrfError, match="this task is wrong"):
        list(run_processes(faulty, TASKS, workers=2))


def test_no_worker_is_left_behind():
    import multiprocessing

    run = run_processes(slow, TASKS, workers=2)
    next(run)
    run.close()
    assert multiprocessing.active_children() == []


def running(number):
    """Return whether a process computes still; one that only waits to be fetched does not."""
    state = Path(f"/proc/{number}/stat")
    return state.exists() and state.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc to see processes in")
def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    code = f"from in_workers import all_endless; all_endless({str(tmp_path)!r})"
    parent = subprocess.Popen([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"})
    try:
        assert eventually(lambda: len(list(tmp_path.iterdir())) == 2)
    finally:
        parent.kill()
        parent.wait()
    numbers = [path.name for path in tmp_path.iterdir()]
    try:
        assert eventually(lambda: not any(map(running, numbers)))
    finally:
        for number in filter(running, numbers):
            os.kill(int(number), signal.SIGKILL)


def eventually(condition, patience=1200.0):
    """Return whether the condition comes true before patience, in s, is out."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.05)
    return False


def test_a_store_gives_back_what_it_kept(tmp_path):
    calls = []

    def counted(task):
        calls.append(task[0])
        return square(task)

    store = Store(tmp_path / "parts")
    assert values(stored(run_here, store, counted, TASKS)) == SQUARES
    (tmp_path / "parts" / "part-00002.npz").unlink()
    damaged = tmp_path / "parts" / "part-00004.npz"
    damaged.write_bytes(damaged.read_bytes()[:50])
    calls.clear()
    assert values(stored(run_here, store, counted, TASKS)) == SQUARES
    assert calls == [2, 4]  # the lost one and the damaged one, no other


def test_a_forged_part_is_not_taken_for_a_result(tmp_path):
    """Not one that somebody wrote, nor one with another's seal, nor one of another place or another run."""
    store, calls = Store(tmp_path / "parts"), []

    def counted(task):
        calls.append(task[0])
        return square(task)

    list(stored(run_here, store, square, TASKS))
    list(stored(run_here, Store(tmp_path / "other"), cube, [*TASKS[:-1], (99, None)]))
    parts = [tmp_path / "parts" / f"part-{i:05d}.npz" for i in range(len(TASKS))]
    np.savez(parts[0], value=np.array(666))
    parts[1].write_bytes(parts[0].read_bytes() + parts[1].read_bytes()[-64:])
    parts[2].write_bytes(parts[3].read_bytes())
    parts[4].write_bytes((tmp_path / "other" / "part-00004.npz").read_bytes())
    assert values(stored(run_here, store, counted, TASKS)) == SQUARES
    assert calls == [0, 1, 2, 4]
    assert values(stored(run_here, store, counted, TASKS)) == SQUARES and len(calls) == 4


def test_parts_that_cannot_be_sealed_are_not_begun(tmp_path, monkeypatch):
    (tmp_path / "srf").mkdir()
    (tmp_path / "srf" / "cache.key").write_text("short")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with pytest.raises(SrfError, match=r"parts cannot be sealed: .*cache.key is damaged"):
        list(stored(run_here, Store(tmp_path / "parts"), square, TASKS))
    assert not (tmp_path / "parts").exists()


def test_a_map_resumed_later_in_another_way(tmp_path, monkeypatch):
    """The clock set back and the parts damaged: the same bytes. The law edited: refused, and nothing is lost."""
    monkeypatch.chdir(tmp_path)
    law = (ROOT / "plugins" / "friction" / "dieterich-ruina.toml").read_text(encoding="utf-8")
    Path("own.toml").write_text(law, encoding="utf-8")
    grid = ["map", "--law", "./own.toml", "--eps", "0.09", "--over", "V=1:100:3", "--over", "K/W0=0.002:0.03:3"]
    grid += ["--interface", "rigid", "--no-boundaries", "--no-provenance", "--resume", "parts"]

    def run(out):
        return CliRunner().invoke(cli, [*grid, "--out", out], prog_name="srf")

    assert run("a.csv").exit_code == 0
    parts = sorted(Path("parts").glob("part-*.npz"))
    parts[0].write_bytes(parts[0].read_bytes()[:-70])
    for path in Path("parts").iterdir():
        os.utime(path, (4e9, 4e9))  # in 2096: written before a clock that was wrong was set back
    assert run("b.csv").exit_code == 0
    assert Path("b.csv").read_bytes() == Path("a.csv").read_bytes()
    assert [p.stat().st_mtime == 4e9 for p in parts] == [False, *[True] * (len(parts) - 1)]
    before = {p.name: p.read_bytes() for p in Path("parts").iterdir()}
    Path("own.toml").write_text(law.replace("default = 0.464", "default = 0.47"), encoding="utf-8")
    done = run("c.csv")
    assert done.exit_code == 2 and "--resume parts holds the parts of another run" in done.stderr
    assert not Path("c.csv").exists() and {p.name: p.read_bytes() for p in Path("parts").iterdir()} == before
    Path("own.toml").write_text(law, encoding="utf-8")
    Path("parts/srf-run.json").write_text('{"schema"')
    done = run("c.csv")
    assert done.exit_code == 2 and "srf-run.json cannot be read" in done.stderr


def test_a_store_of_another_run_is_refused(tmp_path):
    store = Store(tmp_path / "parts")
    list(stored(run_here, store, square, TASKS))
    with pytest.raises(SrfError, match="another run"):
        list(stored(run_here, store, square, TASKS[:-1]))
    other = tmp_path / "full"
    other.mkdir()
    (other / "thesis.tex").write_text("precious", encoding="utf-8")
    with pytest.raises(SrfError, match="not a folder of a run"):
        list(stored(run_here, Store(other), square, TASKS))


def small_grid(model):
    base = model.vector({"eps": 0.18})
    return MapGrid(base, MapAxis("V", 5.0, 40.0, 13), MapAxis("W0", 0.01, 0.02, 17, True, "K"))


SMALL = MapSettings(block=(4, 8), depth=2)


def test_the_fingerprint_is_of_content(model):
    tasks = tile_tasks(model, small_grid(model), SMALL)
    assert fingerprint(tasks) == fingerprint(tile_tasks(model, small_grid(model), SMALL))
    assert fingerprint(tasks) != fingerprint(tile_tasks(model, small_grid(model), MapSettings(block=(4, 8), depth=3)))


def test_maps_are_the_same_bytes_for_any_number_of_workers(model):
    runs = [run_here, *(functools.partial(run_processes, workers=n) for n in (1, 3))]
    maps = [compute_map(model, small_grid(model), SMALL, run=run) for run in runs]
    for other in maps[1:]:
        assert other.leading.tobytes() == maps[0].leading.tobytes()
        assert other.extra_at.tobytes() == maps[0].extra_at.tobytes()
        assert [s.p.tobytes() for s in other.seeds] == [s.p.tobytes() for s in maps[0].seeds]


ARGUMENTS = ["map", "--eps", "0.18", "--over", "V=5:40:34", "--over", "K/W0=0.01:0.02:60", "--no-provenance"]


def srf(*arguments, cwd):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-m", "srfcli.cli.main", *arguments],
        cwd=cwd,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process):
    _, said = process.communicate(timeout=1200)
    assert process.returncode == 0, said


def test_a_killed_run_resumes_to_the_same_bytes(tmp_path):
    """Killed with -9 while its workers are at it; the run that goes on does only what is missing."""
    whole = srf(*ARGUMENTS, "--out", "whole.csv", "--boundary", "whole-b.csv", cwd=tmp_path)
    finish(whole)
    first = srf(*ARGUMENTS, "--resume", "parts", "--workers", "2", "--out", "x.csv", cwd=tmp_path)
    deadline = time.monotonic() + 1200
    while len(list((tmp_path / "parts").glob("part-*.npz"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.02)
    first.kill()
    first.communicate()
    kept = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "parts").glob("part-*.npz")}
    assert kept and not (tmp_path / "x.csv").exists()
    again = srf(*ARGUMENTS, "--resume", "parts", "--out", "again.csv", "--boundary", "again-b.csv", cwd=tmp_path)
    finish(again)
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
    assert (tmp_path / "again-b.csv").read_bytes() == (tmp_path / "whole-b.csv").read_bytes()
    assert all((tmp_path / "parts" / name).stat().st_mtime_ns == at for name, at in kept.items())


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A scheduler and two workers of dask.distributed on loopback, each a process of its own: (address, workers)."""
    if shutil.which("true") is None or not _has_distributed():
        pytest.skip("DASK.DISTRIBUTED ABSENT: pip install 'srfcli[cluster]' to test --cluster")
    folder = tmp_path_factory.mktemp("cluster")
    note = folder / "scheduler.json"
    environment = {
        **os.environ,
        "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}",
        "OPENBLAS_NUM_THREADS": "1",
        "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "10s",
    }
    local = ["--host", "127.0.0.1", "--scheduler-file", str(note)]

    def start(*words):
        return subprocess.Popen(
            [sys.executable, "-m", *words], cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    scheduler = start("distributed.cli.dask_scheduler", *local, "--port", "0", "--no-dashboard")
    crew = []
    try:
        _wait_for(note.exists)
        import json

        address = json.loads(note.read_text(encoding="utf-8"))["address"]
        for _ in range(2):
            # --no-nanny: a worker that is killed stays dead, and its task has to go elsewhere
            crew.append(
                start(
                    "distributed.cli.dask_worker",
                    "--scheduler-file",
                    str(note),
                    "--no-nanny",
                    "--nthreads",
                    "1",
                    "--no-dashboard",
                )
            )
        _wait_for(lambda: _workers(address) == 2)
        yield address, crew
    finally:
        for process in (*crew, scheduler):
            process.kill()
            process.wait()


def _has_distributed():
    import importlib.util

    return importlib.util.find_spec("distributed") is not None


def _wait_for(condition, seconds=1200.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "the cluster did not start"
        time.sleep(0.1)


def _workers(address):
    from distributed import Client

    try:
        with Client(address, timeout="5s", set_as_default=False) as client:
            return len(client.scheduler_info()["workers"])
    except OSError:
        return 0


@pytest.mark.filterwarnings("default")
def test_a_cluster_gives_the_same_bytes(model, cluster):
    address, _ = cluster
    here = dict(run_here(solve_tile, tile_tasks(model, small_grid(model), SMALL)))
    there = dict(Spread(cluster=address).run(solve_tile, tile_tasks(model, small_grid(model), SMALL)))
    assert sorted(there) == sorted(here)
    for index, tile in here.items():
        assert {k: v.tobytes() for k, v in there[index].items()} == {k: np.asarray(v).tobytes() for k, v in tile.items()}


@pytest.mark.filterwarnings("default")
def test_a_worker_of_the_cluster_killed_in_mid_run_costs_its_tile(model, cluster):
    address, crew = cluster
    tasks = tile_tasks(model, small_grid(model), SMALL)
    here = dict(run_here(solve_tile, tasks))
    results = {}
    for index, tile in Spread(cluster=address).run(solve_tile, tasks):
        results[index] = tile
        if len(results) == 2:
            crew[0].kill()
    assert sorted(results) == sorted(here)
    assert all(results[k]["leading"].tobytes() == here[k]["leading"].tobytes() for k in here)
    assert crew[0].wait() == -signal.SIGKILL


@pytest.mark.filterwarnings("default")
def test_a_cluster_that_is_not_there_is_told():
    if not _has_distributed():
        pytest.skip("DASK.DISTRIBUTED ABSENT: pip install 'srfcli[cluster]' to test --cluster")
    with pytest.raises(SrfError, match="no scheduler answers"):
        list(run_cluster(square, TASKS, address="tcp://127.0.0.1:1", timeout="1s"))


def test_without_the_library_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SrfError, match="not installed") as caught:
        list(Spread(cluster="tcp://127.0.0.1:1").run(square, TASKS))
    assert "srfcli[cluster]" in caught.value.hint
