"""The site of the documents: MkDocs builds it without a warning, its references are whole, it loads nothing from elsewhere."""

from __future__ import annotations

import html
import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import srfcli as srf
from srfcli.cli.main import COMMANDS

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `mkdocs build --strict` builds it."""
    for name in ("material", "mkdocstrings_handlers.python"):
        if find_spec(name.partition(".")[0]) is None:
            pytest.skip('SITE NOT BUILT: the extra "docs" is not installed: pip install -e ".[docs]"')
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "PYTHONWARNINGS": "default"}
    done = subprocess.run(build, cwd=ROOT, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def text_of(page: Path) -> str:
    return html.unescape(re.sub(r"<[^>]+>", "", page.read_text(encoding="utf-8")))


def test_nothing_is_loaded_from_other_hosts(site: Path) -> None:
    for page in site.rglob("*.html"):
        loaded = re.findall(r'<(?:script|img|iframe)[^>]+src="([^"]+)"', page.read_text(encoding="utf-8"))
        loaded += re.findall(r'<link[^>]+rel="(?:stylesheet|preconnect|icon)"[^>]+href="([^"]+)"', page.read_text("utf-8"))
        assert not [place for place in loaded if "//" in place], page


def test_pages_are_linked_by_their_titles(site: Path) -> None:
    text = (site / "fit.html").read_text(encoding="utf-8")
    assert 'href="measurements.html"' in text and not re.findall(r">[\w/-]+\.md</a>", text)


def test_the_reference_has_every_command_and_its_options(site: Path) -> None:
    text = text_of(site / "reference" / "commands.html")
    assert all(f"Usage: srf {name} " in text for name in COMMANDS)
    assert "--scan-lines" in text and "Examples:" in text


def test_the_reference_has_every_public_name(site: Path) -> None:
    text = text_of(site / "reference" / "api.html")
    assert all(f"srf.{name}" in text for name in srf.__all__)
    assert text.count("Parameters:") >= 11 and "Raises:" in text
