"""The cache: lost, broken, shared or read-only, it changes nothing but the time taken, and what others put there never runs."""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from uuid import uuid4

import pytest
from click.testing import CliRunner

from srfcli.cli.main import cli
from srfcli.codegen import c_source
from srfcli.codegen.c_source import compiled, compiler
from srfcli.codegen.model import open_model
from srfcli.core import cache
from srfcli.core.cache import cache_folder, cached_source, content_key
from srfcli.laws.registry import bundled_folder, load_registry

TEXT = "value = 1\nother = 2\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SRF_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "cache"


def never() -> str:
    raise AssertionError("built again")


def test_what_was_built_is_found(folder: Path) -> None:
    assert cached_source("k", lambda: TEXT) == TEXT
    assert cached_source("k", never) == TEXT
    assert [p.name for p in folder.iterdir()] == ["k.py"]


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace("value = 1", "value = 3"),
        lambda text: "",
        lambda text: text.partition("\n")[2],
        lambda text: text + "import os\n",
    ],
    ids=["truncated", "tampered", "empty", "no hash", "appended"],
)
def test_a_damaged_entry_is_built_anew(folder: Path, damage) -> None:
    cached_source("k", lambda: TEXT)
    entry = folder / "k.py"
    entry.write_text(damage(entry.read_text()))
    assert cached_source("k", lambda: TEXT) == TEXT
    assert cached_source("k", never) == TEXT


def test_bytes_that_are_no_text_are_built_anew(folder: Path) -> None:
    cached_source("k", lambda: TEXT)
    (folder / "k.py").write_bytes(b"\xff\xfe\x00")
    assert cached_source("k", lambda: TEXT) == TEXT


def test_a_folder_that_cannot_be_made_or_no_cache_at_all_does_no_harm(tmp_path, monkeypatch) -> None:
    (tmp_path / "file").write_text("")
    for place in (str(tmp_path / "file"), str(tmp_path / "file" / "below"), ""):
        monkeypatch.setenv("SRF_CACHE", place)
        assert cached_source("k", lambda: TEXT) == TEXT
        assert cached_source("k", lambda: TEXT) == TEXT


def test_writers_at_once_leave_one_whole_entry(folder: Path) -> None:
    texts = [f"value = {i}\n" * 5000 for i in range(8)]
    seen: list[str] = []

    def work(text: str) -> None:
        seen.extend(cached_source("k", lambda: text) for _ in range(20))

    threads = [threading.Thread(target=work, args=(t,)) for t in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(seen) <= set(texts)
    assert cached_source("k", never) in texts
    assert [p.name for p in folder.iterdir()] == ["k.py"]


def test_keys_tell_lists_apart() -> None:
    keys = {content_key(parts) for parts in (["ab", "c"], ["a", "bc"], ["abc"], ["ab", "c", ""])}
    assert len(keys) == 4


def test_a_changed_law_is_derived_anew(folder: Path, tmp_path: Path) -> None:
    plugins = tmp_path / "plugins"
    plugins.mkdir()
    law = plugins / "mine.toml"
    source = (bundled_folder() / "friction" / "srf-vsat.toml").read_text()
    law.write_text(source.replace('name = "srf-vsat"', 'name = "mine"'))

    def friction() -> float:
        model = open_model(load_registry([plugins]), law="mine")
        return float(model.steady_friction(model.vector({"V": 10.0})))

    before = friction()
    assert friction() == before and len(list(folder.iterdir())) == 1
    law.write_text(law.read_text().replace("mu0 + A*log(v/V0)", "mu0 + 2*A*log(v/V0)"))
    assert friction() > before + 0.01
    assert len(list(folder.iterdir())) == 2
    # as a file it is derived once, wherever it lies; one without a name has its file's
    for place in ("one", "other"):
        (tmp_path / place).mkdir()
        text = law.read_text().replace('name = "mine"', "")
        (tmp_path / place / "mine.toml").write_text(text)
        (tmp_path / place / f"{place}.toml").write_text(text)
    titles = [
        open_model(load_registry(), law=str(tmp_path / place / "mine.toml"), stability=False).title for place in ("one", "other")
    ]
    assert titles[0] == titles[1] and len(list(folder.iterdir())) == 3
    titles = [
        open_model(load_registry(), law=str(tmp_path / place / f"{place}.toml"), stability=False).title
        for place in ("one", "other")
    ]
    assert [title.split(",")[0] for title in titles] == ["one", "other"] and len(list(folder.iterdir())) == 5


def test_a_second_start_imports_no_sympy(folder: Path) -> None:
    code = (
        "import sys; from srfcli.codegen.model import open_model; from srfcli.laws.registry import load_registry; "
        "open_model(load_registry(), law='dieterich-ruina', interface='rigid'); print('sympy' in sys.modules)"
    )
    environment = {**os.environ, "SRF_CACHE": str(folder)}
    runs = [
        subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    ]
    assert runs == ["True\n", "False\n"]
    shutil.rmtree(folder)


# no way in: what others could have put there


POSIX = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="no owners and modes here")


@pytest.fixture
def key() -> str:
    """A key that nothing in memory has."""
    return uuid4().hex


def kept_nowhere(folder: Path, key: str, caplog: pytest.LogCaptureFixture, said: str) -> None:
    """The cache is refused with one warning, what lies there is not read, and memory stands in for it."""
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    with caplog.at_level(logging.WARNING, "srfcli"):
        for _ in range(3):
            assert cached_source(key, lambda: TEXT) == TEXT
        assert cached_source(key, never) == TEXT
    assert len(caplog.messages) == 1 and said in caplog.messages[0]
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before


@POSIX
@pytest.mark.parametrize("mode", [0o777, 0o770, 0o707, 0o1777])
def test_a_folder_that_others_may_write_to_is_refused(
    folder: Path, key: str, caplog: pytest.LogCaptureFixture, mode: int
) -> None:
    cached_source(key, lambda: "evil = 1\n")
    folder.chmod(mode)
    kept_nowhere(folder, key, caplog, f"others may write to {folder}")


@POSIX
def test_a_folder_that_others_may_replace_is_refused(
    tmp_path: Path, key: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    monkeypatch.setenv("SRF_CACHE", str(tmp_path / "open" / "cache"))
    kept_nowhere(tmp_path / "open", key, caplog, "others may replace")


@POSIX
def test_a_folder_of_another_is_refused(folder: Path, key: str, caplog: pytest.LogCaptureFixture) -> None:
    cached_source(key, lambda: "evil = 1\n")
    try:
        os.chown(folder, os.geteuid() + 1, -1)
    except PermissionError:
        pytest.skip("only root can give a folder away")
    kept_nowhere(folder, key, caplog, "belongs to another user")


@POSIX
@pytest.mark.parametrize("harm", ["open", "short", "link", "fifo"])
def test_a_secret_that_is_not_the_users_alone_is_refused(
    folder: Path, key: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, harm: str
) -> None:
    cached_source(key, lambda: "evil = 1\n")
    secret = tmp_path / "state" / "srf" / "cache.key"
    assert secret.stat().st_mode & 0o777 == 0o600 and secret.stat().st_size == 32
    if harm == "open":
        secret.chmod(0o644)
    elif harm == "short":
        secret.write_bytes(b"")
    else:
        secret.rename(tmp_path / "moved")
        secret.symlink_to(tmp_path / "moved") if harm == "link" else os.mkfifo(secret, 0o600)
    kept_nowhere(folder, key, caplog, "cache.key")


def test_a_forged_entry_never_runs(folder: Path, tmp_path: Path) -> None:
    evil = "raise SystemExit('forged')\n"
    cached_source("k", lambda: TEXT)
    forgeries = [
        f"# sha256 {hashlib.sha256(evil.encode()).hexdigest()}\n{evil}",
        f"# seal {hashlib.sha256(evil.encode()).hexdigest()}\n{evil}",
        f"{(folder / 'k.py').read_text().partition(chr(10))[0]}\n{evil}",
        evil,
    ]
    key = tmp_path / "state" / "srf" / "cache.key"
    own = key.read_bytes()
    key.write_bytes(bytes(32))
    cached_source("other", lambda: evil)  # sealed with the secret of somebody else
    forgeries.append((folder / "other.py").read_text())
    key.write_bytes(own)
    cached_source("mine", lambda: evil)  # sealed rightly, but moved to another key
    forgeries.append((folder / "mine.py").read_text())
    for text in forgeries:
        (folder / "k.py").write_text(text)
        assert cached_source("k", lambda: TEXT) == TEXT
        assert cached_source("k", never) == TEXT


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
def test_a_forged_library_is_never_loaded(folder: Path, tmp_path: Path, make_model, monkeypatch) -> None:
    command = compiler()
    assert command is not None
    for name, code in (("good", "int srf_integrate(void) { return 7; }"), ("evil", "int srf_integrate(void) { return 13; }")):
        (tmp_path / f"{name}.c").write_text(code)
        subprocess.run([*command, "-shared", "-fPIC", "-o", tmp_path / f"{name}.so", tmp_path / f"{name}.c"], check=True)
    evil = (tmp_path / "evil.so").read_bytes()
    quick = tmp_path / "cc.py"  # compiles everything to good.so
    quick.write_text(f"import shutil, sys\nshutil.copy({str(tmp_path / 'good.so')!r}, sys.argv[sys.argv.index('-o') + 1])\n")
    monkeypatch.setenv("SRF_CC", f"{sys.executable} {quick}")
    model = make_model()

    def found(place: Path) -> int:
        """What is loaded from this folder, new to this process: a library of a known path is not loaded again."""
        monkeypatch.setenv("SRF_CACHE", str(place))
        compiled.cache_clear(), compiler.cache_clear()
        library = compiled(model)
        assert library is not None
        return int(library.srf_integrate())

    try:
        assert found(folder) == 7
        (library,) = folder.glob("*.so")
        forgeries = {
            "hash": hashlib.sha256(evil).hexdigest(),
            "of another name": cache.seal("other.so", evil),
            "of what was there": library.with_suffix(".sum").read_text(),
            "empty": "",
        }
        for number, mark in enumerate(forgeries.values()):
            place = tmp_path / f"forged{number}"
            place.mkdir(mode=0o700)
            (place / library.name).write_bytes(evil)
            (place / library.with_suffix(".sum").name).write_text(mark)
            assert found(place) == 7
        place = tmp_path / "own"
        place.mkdir(mode=0o700)
        (place / library.name).write_bytes(evil)
        (place / library.with_suffix(".sum").name).write_text(cache.seal(library.name, evil))
        assert found(place) == 13  # with the right seal it is what is loaded: the others were refused for theirs
    finally:
        compiled.cache_clear(), compiler.cache_clear()


def build(make_model) -> None:
    """Compile the paper's system as a new process does."""
    compiled.cache_clear(), c_source._methods.clear()
    assert compiled(make_model()) is not None


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory, make_model) -> Path:
    """A folder with cache and secret, in which the paper's system was compiled."""
    folder = tmp_path_factory.mktemp("built")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SRF_CACHE", str(folder / "cache"))
        patch.setenv("XDG_STATE_HOME", str(folder / "state"))
        build(make_model)
    return folder


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize(
    "how", ["as it was", *(pytest.param(h, marks=pytest.mark.slow) for h in ("of another name", "not to be written"))]
)
def test_a_method_that_is_not_this_user_s_is_compiled_anew(
    built: Path, folder: Path, tmp_path: Path, make_model, how: str
) -> None:
    """What is no object would end the linker; a place that cannot be written is done without."""
    shutil.copytree(built, tmp_path, dirs_exist_ok=True)
    try:
        (method,) = folder.glob("*.o")
        mark, whole, forged = method.with_suffix(".sum"), method.read_bytes(), b"forged"
        for library in folder.glob("*.so"):
            library.unlink()
        method.write_bytes(forged)
        if how == "of another name":
            mark.write_text(cache.seal("other.o", forged))
        if how == "not to be written":
            mark.unlink()
            mark.mkdir()
        build(make_model)
        assert method.read_bytes() == (forged if mark.is_dir() else whole)  # a compiler makes the same of the same text
    finally:
        compiled.cache_clear(), c_source._methods.clear()


@POSIX
@pytest.mark.usefixtures("empty_folder")
def test_a_command_says_once_that_nothing_is_cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    for more, said in ((), 1), (("-q",), 0):
        folder = tmp_path / f"cache{said}"
        folder.mkdir()
        folder.chmod(0o777)
        monkeypatch.setenv("SRF_CACHE", str(folder))
        done = CliRunner().invoke(cli, ["linear", "--law", "dieterich-ruina", "--interface", "rigid", *more], prog_name="srf")
        assert done.exit_code == 0, done.output
        assert done.stderr.count("Warning: nothing is cached: others may write to") == said
        assert not list(folder.iterdir())


def test_relative_folders_of_the_desktop_do_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SRF_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "theirs")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert cache_folder() == tmp_path / ".cache" / "srf"


@POSIX
def test_folders_are_made_private_whatever_the_umask(folder: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("SRF_CACHE", str(tmp_path / "new" / "cache"))
    before = os.umask(0)
    try:
        cached_source("k", lambda: TEXT)
    finally:
        os.umask(before)
    assert cached_source("k", never) == TEXT
    for made in (tmp_path / "new", tmp_path / "new" / "cache", tmp_path / "state" / "srf"):
        assert made.stat().st_mode & 0o777 == 0o700
