"""Locks of open files, by each system's own way."""

from __future__ import annotations

import errno
import os
import sys
from types import SimpleNamespace

import pytest

from flowsplat.common.errors import InUseError
from flowsplat.common.files import locks
from flowsplat.common.files.lease import holder, lease
from flowsplat.common.files.locks import NoLocksError, is_locked, open_to_lock, remove_locked, try_lock

flock = pytest.importorskip("fcntl", reason="plays the other systems' locks by flock").flock


def lock_byte(file: int, how: int, count: int) -> None:
    """As ``msvcrt.locking``: one open file has a byte of it, and whoever asks for it elsewhere gets an error."""
    assert count == 1
    assert os.lseek(file, 0, os.SEEK_CUR) == locks._LOCKED_BYTE
    try:
        flock(file, 8 if how == 0 else 2 | 4)
    except OSError as error:
        raise PermissionError(errno.EACCES, "Permission denied") from error


@pytest.fixture(params=["flock", "msvcrt"])
def system(request, monkeypatch):
    """By which it is locked."""
    if request.param == "msvcrt":
        monkeypatch.setattr(locks, "fcntl", None)
        monkeypatch.setattr(locks, "msvcrt", SimpleNamespace(locking=lock_byte, LK_NBLCK=2, LK_UNLCK=0))
        monkeypatch.setattr(locks, "_LOOK_SECONDS", 0.001)
    return request.param


def test_one_has_it_and_others_see_that(system, tmp_path):
    path = tmp_path / "lock"
    ours = open_to_lock(path, create=True)
    os.write(ours, b"who has it")
    other, looks = open_to_lock(path, create=True), open_to_lock(path, create=False)
    assert not is_locked(looks)
    assert not is_locked(looks), "who only looks locks nothing"
    os.close(looks)
    looks = open_to_lock(path, create=False)
    assert try_lock(ours)
    assert not try_lock(other)
    assert is_locked(looks)
    assert os.read(looks, 100) == b"who has it"
    remove_locked(ours, path)
    assert not path.exists()
    assert try_lock(other)
    for file in (other, looks):
        os.close(file)


def test_a_lease_is_one_by_either(system, tmp_path, monkeypatch):
    folder = tmp_path / "out"
    with lease(folder):
        assert f"process {os.getpid()}" in (holder(folder) or "")
        with monkeypatch.context() as patch:
            patch.setattr(sys.modules["flowsplat.common.files.lease"], "_held", {})  # as another process would come
            with pytest.raises(InUseError, match=f"by process {os.getpid()} on "), lease(folder):
                pass
        (folder / "x").touch()
    assert holder(folder) is None
    assert [path.name for path in folder.iterdir()] == ["x"]


def test_without_locks_nothing_is_locked(tmp_path, monkeypatch):
    monkeypatch.setattr(locks, "fcntl", None)
    monkeypatch.setattr(locks, "msvcrt", None)
    with lease(tmp_path / "out"):
        assert holder(tmp_path / "out") is None
        assert list((tmp_path / "out").iterdir()) == []
    file = open_to_lock(tmp_path / "file", create=True)
    assert not is_locked(file)
    with pytest.raises(NoLocksError):
        try_lock(file)
    os.close(file)


def test_a_file_system_without_locks_is_worked_on(tmp_path, monkeypatch):
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(locks.fcntl, "flock", refuse)
    with lease(tmp_path / "out"):
        assert list((tmp_path / "out").iterdir()) == []
