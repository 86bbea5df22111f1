"""A friction law that no integration follows beyond an age."""

from __future__ import annotations

from pathlib import Path

from srfcli.laws.registry import bundled_folder

END = 5 * 0.402  # s: five times D0/V0


def brittle_law(folder: Path) -> Path:
    """Write a law to the folder, named `brittle`, whose friction is no number where the age exceeds END; return the folder."""
    text = (bundled_folder() / "friction" / "srf-vsat.toml").read_text(encoding="utf-8").partition("[[checks]]")[0]
    text = text.replace('name = "srf-vsat"', 'name = "brittle"')
    text = text.replace('Vsat*phi/D0)"', 'Vsat*phi/D0) - 1e-9*sqrt(5 - phi*V0/D0)"')
    (folder / "brittle.toml").write_text(text, encoding="utf-8")
    return folder
