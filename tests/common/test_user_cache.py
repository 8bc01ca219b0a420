"""Where compiled kernels lie: also without a home folder, with one that cannot be written, and beside other users."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from pathlib import Path

import pytest

from flowsplat.common import user_cache
from flowsplat.common.user_cache import cache_folder


@pytest.fixture
def user(monkeypatch, tmp_path) -> Path:
    """A home folder, and a folder for temporary files beside it."""
    for name in ("FLOWSPLAT_CACHE", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    home, temporary = tmp_path / "home", tmp_path / "temporary"
    for folder in (home, temporary):
        folder.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    for function in (user_cache._can_be_written, user_cache._private_folder):
        function.cache_clear()
    yield home
    for function in (user_cache._can_be_written, user_cache._private_folder):
        function.cache_clear()


@pytest.mark.parametrize(
    ("system", "place"),
    [("linux", ".cache/flowsplat"), ("darwin", "Library/Caches/flowsplat"), ("win32", "AppData/Local/flowsplat")],
)
def test_every_system_has_its_place(user, monkeypatch, system, place):
    monkeypatch.setattr(sys, "platform", system)
    assert cache_folder() == user / place
    assert not (user / place).exists(), "it is made when something is written"
    monkeypatch.setenv("FLOWSPLAT_CACHE", str(user / "own"))
    assert cache_folder() == user / "own"


def homeless(monkeypatch) -> None:
    def none() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", none)


def unwritable(monkeypatch) -> None:
    allowed = os.access
    monkeypatch.setattr(os, "access", lambda path, how: "home" not in Path(path).parts[-2:] and allowed(path, how))


def nowhere(monkeypatch) -> None:
    monkeypatch.setenv("HOME", os.path.join(os.environ["HOME"], "file", "below"))
    Path(os.environ["HOME"]).parent.touch()


@pytest.mark.parametrize("spoil", [homeless, unwritable, nowhere])
def test_without_a_home_it_is_a_folder_of_this_user_alone(user, monkeypatch, spoil):
    spoil(monkeypatch)
    folder = cache_folder()
    assert folder == Path(tempfile.gettempdir()) / f"flowsplat-{os.getuid()}"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    user_cache._private_folder.cache_clear()
    assert cache_folder() == folder, "the next process finds it"


@pytest.mark.parametrize("kind", ["link", "file", "open to all", "of another"])
def test_what_somebody_else_has_put_there_is_not_taken(user, monkeypatch, kind):
    homeless(monkeypatch)
    there = Path(tempfile.gettempdir()) / f"flowsplat-{os.getuid()}"
    if kind == "link":
        there.symlink_to(user)
    elif kind == "file":
        there.touch()
    else:
        there.mkdir()
        there.chmod(0o777 if kind == "open to all" else 0o700)
    if kind == "of another":
        other = os.getuid() + 1
        there = there.rename(there.with_name(f"flowsplat-{other}"))
        monkeypatch.setattr(os, "getuid", lambda: other)
    folder = cache_folder()
    assert folder != there
    assert folder.parent == there.parent
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert os.environ["FLOWSPLAT_CACHE"] == str(folder), "processes that are started take it, too"


def test_where_nothing_can_be_written_nothing_is_kept(user, monkeypatch):
    homeless(monkeypatch)
    monkeypatch.setattr(tempfile, "tempdir", str(user / "not" / "there"))
    folder = cache_folder()
    assert not folder.exists()
    with pytest.raises(OSError):
        folder.mkdir(parents=True)
