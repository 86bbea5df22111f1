"""Makes an experiment whose model lacks one effect, for `srf diagnose` to find: the truth goes to a file beside the folder.

The first three are the paper's own story: a rigid interface, an air cushion that passes on a part of the modulation, and an age
that feels changes of the load.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from srfcli.core.errors import SrfError
from srfcli.validation.cases import NAMES, OUTSIDE_NAMES, make_case


def main() -> None:
    """Write the experiment and its truth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("effects", nargs="*", help=f"what to conceal, nothing for nothing: {', '.join((*NAMES, *OUTSIDE_NAMES))}")
    parser.add_argument("--out", type=Path, required=True, help="the new folder")
    parser.add_argument("--seed", type=int, default=1, help="of laws, protocol, noise and track")
    parser.add_argument("--size", type=float, default=0.6, help="from 0, hardly there, to 1, strong")
    parser.add_argument("--rough", type=float, default=0.0, help="standard deviation of mu0 along the track")
    options = parser.parse_args()
    try:
        truth = make_case(
            options.out, options.seed, kind=None if options.effects else "none", effects=options.effects or None,
            size=options.size, rough=options.rough,
        )  # fmt: skip
    except SrfError as error:
        parser.exit(2, f"Error: {error.message}\nTry: {error.hint}\n")
    beside = options.out.with_name(f"{options.out.name}.truth.json")
    beside.write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    print(f"{options.out}: {len(truth['runs'])} runs; what is concealed stands in {beside}")


if __name__ == "__main__":
    main()
