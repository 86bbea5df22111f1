"""The same command gives the same bytes for any number of threads and workers."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("empty_folder")

PLANE = "--eps 0.09 --over V=5:20:3 --over K/W0=0.01:0.03:3 --workers {workers}"
# the recording is so long that sums over it are shared by the threads of OpenBLAS, where it has them
STEP = "simulate --drive 0.5:8,0.5:16 --W0 5 --rate 12000 --noise 0.02 --start-values perturb:10% --free A,B,D0"
COMMANDS = {
    "linear.csv": "linear --over V=1:100:3",
    "critical.csv": "critical --V 7 --eps 0.13",
    "floquet.csv": "floquet --V 8 --W0 9 --eps 0.09",
    "continue.csv": "continue --eps 0.18 --over V=8:20 --over W0=6:20 --scan-lines 2 --samples 16 --tol 1e-4",
    "response.csv": "response --over f=1:100:3",
    "map.csv": f"map {PLANE}",
    "compare.csv": f"compare --law srf-vsat --law log-log {PLANE}",
    "simulate.csv": "simulate --V 8 --W0 6 --eps 0.1 --f 30 --for 1 --rate 200 --noise 0.01",
    "made": STEP,
    "fit.json": "fit made --track smooth",
    "loads.json": "fit loads.csv --free A,B --max-evaluations 3",
}
LOADS = "V [um/s],eps [%],W0c [N],sigma [N]\n10,0,7.80,0.23\n20,0,9.1,0.2\n50,20.9,23.5,0.5\n"
ALL = """
import sys
from srfcli.cli.main import main
if __name__ == "__main__":  # workers import this file
    for line in sys.stdin:
        try:
            main(line.split())
        except SystemExit as end:
            assert end.code in (0, 3), line
"""


@pytest.mark.slow
def test_any_number_of_threads_and_workers() -> None:
    Path("all.py").write_text(ALL)
    running = []
    for threads, workers in (("1", "1"), ("4", "2")):
        folder = Path(threads)
        folder.mkdir()
        (folder / "loads.csv").write_text(LOADS)
        lines = [
            f"{words.format(workers=workers)} --no-provenance {'--out' if '.' in name else '--out-dir'} {name}"
            for name, words in COMMANDS.items()
        ]
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
        process = subprocess.Popen(
            [sys.executable, Path("all.py").absolute()], cwd=folder, env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip
        assert process.stdin is not None
        process.stdin.write("\n".join(lines))
        process.stdin.close()
        process.stdin = None
        running.append((process, folder))
    written = []
    for process, folder in running:
        said = process.communicate()[1]
        assert process.returncode == 0, said
        written.append({str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*.*") if p.is_file()})
    one, other = written
    assert set(one) == set(other) > {n for n in COMMANDS if "." in n}
    assert not [name for name in one if one[name] != other[name]]
