"""Where compiled code is kept, and who may use it."""

import os
from pathlib import Path

import pytest

from gemuco.compiled import jit


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package of its own, and a home."""
    here, home = tmp_path / "compiled", tmp_path / "home"
    here.mkdir()
    home.mkdir()
    (here / "one.py").write_text("x = 1\n")
    monkeypatch.setattr(jit, "HERE", here)
    monkeypatch.setattr(jit.CONFIG, "CACHE_DIR", "")
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setattr(jit.tempfile, "gettempdir", lambda: str(tmp_path / "tmp"))
    before = os.umask(0o022)
    yield here
    os.umask(before)


def test_it_lies_beside_the_sources_where_others_may_read_and_not_write(sources: Path) -> None:
    folder = jit.find_folder()
    assert folder is not None
    assert folder.parent == sources / "__pycache__"
    assert folder.stat().st_mode & 0o777 == 0o755


def test_what_another_user_compiled_is_copied_and_not_compiled_again(
    sources: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    beside = jit.find_folder()
    assert beside is not None
    (beside / "part").mkdir()
    (beside / "part" / "search.nbi").write_bytes(b"code")
    owns = jit._is_own
    monkeypatch.setattr(jit, "_is_own", lambda folder: folder != beside and owns(folder))
    folder = jit.find_folder()
    assert folder is not None
    assert folder != beside
    assert (folder / "part" / "search.nbi").read_bytes() == b"code"


def test_other_sources_have_another_folder(sources: Path) -> None:
    before = jit.find_folder()
    (sources / "one.py").write_text("x = 2\n")
    assert jit.find_folder() != before


def test_a_folder_that_others_may_write_to_is_not_used(sources: Path) -> None:
    folder = jit.find_folder()
    assert folder is not None
    folder.chmod(0o777)
    other = jit.find_folder()
    assert other is not None
    assert other != folder
