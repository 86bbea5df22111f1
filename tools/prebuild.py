"""Write the generated modules that the package brings along, `srfcli/codegen/models/`, anew: python tools/prebuild.py [FOLDER]"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import sympy

from srfcli.codegen.model import open_model
from srfcli.core.cache import MARK, SHIPPED_MODELS, header_key
from srfcli.laws.law_file import read_header
from srfcli.laws.registry import bundled_registry, scan_python


def shipped_systems() -> list[dict[str, Any]]:
    """Return the arguments of `open_model` for the systems that are shipped: each law once, with the defaults beside it."""
    laws = {kind: [e.name for e in bundled_registry().entries(kind)] for kind in ("friction", "ageing", "interface")}
    asked: list[dict[str, Any]] = [{"law": name} for name in laws["friction"]]
    asked += [{"ageing": name} for name in laws["ageing"] if name != "dieterich"]
    asked += [{"interface": name} for name in laws["interface"] if name != "elastic"]
    asked += [{"ageing": "dieterich+linker-dieterich"}, {"loading": "inclined"}, {"inertia": False}]
    asked += [{"random_field": True}, {"tables": (("mu", "slip"),)}]  # `srf fit` and `srf diagnose` begin with these
    for ageing in ("dieterich", "ruina"):  # a rock press
        rock = {"law": "dieterich-ruina", "ageing": ageing, "interface": "rigid", "inertia": False}
        asked += [rock, {**rock, "random_field": True}]
    return asked


def headers_text() -> str:
    """Return the text of headers.json, what the shipped law files hold."""
    found = {}
    for path in sorted({e.location for e in bundled_registry().entries()}):
        rows = [read_header(path)] if path.suffix == ".toml" else scan_python(path)
        found[header_key(path, path.read_bytes())] = rows
    return json.dumps(found, indent=1, ensure_ascii=False, sort_keys=True) + "\n"


def module_file(**asked: Any) -> tuple[str, str]:
    """Return the name and the text of one file: the key it is built under, then the module."""
    model = open_model(bundled_registry(), **asked, anew=True)
    return f"{model.key[:16]}.py", f"{MARK}{model.key}\n{model.source}"


def main() -> None:
    """Write all of them and remove what is no longer shipped."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else SHIPPED_MODELS
    folder.mkdir(exist_ok=True)
    (folder / "headers.json").write_text(headers_text(), encoding="utf-8")
    (folder / "sympy.txt").write_text(f"{sympy.__version__}\n", encoding="utf-8")
    wanted = [module_file(**asked) for asked in shipped_systems()]
    for path in {*folder.glob("*.py")} - {folder / name for name, _ in wanted}:
        path.unlink()
    for name, text in wanted:
        (folder / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
