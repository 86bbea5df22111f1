"""What the examples share: the model of the paper, arguments, progress on stderr, figures in a folder."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from srfcli.codegen.model import GeneratedModel, open_model
from srfcli.core.files import write_atomic
from srfcli.laws.registry import load_registry
from srfcli.results.plots import figure_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def arguments(about: str) -> argparse.Namespace:
    """Return the parsed command line: --out DIR."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="folder for the figure (default: here)")
    return parser.parse_args()


def paper_model() -> GeneratedModel:
    """Return the paper's system; its default parameters are the optimised column of Table I."""
    return open_model(load_registry())


def progress(text: str = "") -> None:
    """Write one line to stderr, over the line before where stderr is a terminal; no text clears the line."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)
    elif text:
        print(text, file=sys.stderr)


def save(figure: Figure, out: Path, name: str) -> None:
    """Save a figure as DIR/name and say so."""
    out.mkdir(parents=True, exist_ok=True)
    write_atomic(out / name, figure_bytes(figure, (out / name).suffix))
    progress()
    print(f"figure: {out / name}")
