"""Compiled kernels on disk belong to everything that they are made of."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from flowsplat.common import kernel_cache
from flowsplat.common.kernel_cache import KernelCache, kernels_folder, key_of, remove_old, sources_of
from flowsplat.common.kernels import kernel
from flowsplat.common.source import PACKAGE

RADIUS = """
import torch
from flowsplat.splatting.cpu.functions import project
from flowsplat.splatting.cpu.projection import project_forward
one = torch.ones(1)
K = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
means, quats, scales = torch.tensor([[0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]), 0.1 * torch.ones(1, 3)
found = project(means, quats, scales, None, 0.9 * one, torch.eye(4), K, 100, 100, 0.01, 1e10, 0.3)
print(int(found[3][0, 0]), sum(project_forward.stats.cache_hits.values()))
"""


def radius(package: Path, cache: Path) -> tuple[int, int]:
    """The radius of one Gaussian by a process that uses a copy of the package, and how many kernels it found compiled."""
    environment = {**os.environ, "PYTHONPATH": str(package.parent), "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run([sys.executable, "-c", RADIUS], env=environment, capture_output=True, text=True, check=True)
    pixels, hits = done.stdout.split()
    return int(pixels), int(hits)


@pytest.fixture
def package(tmp_path) -> Path:
    """A copy."""
    return Path(shutil.copytree(PACKAGE, tmp_path / "copy" / "flowsplat", ignore=shutil.ignore_patterns("__pycache__")))


def with_another_constant(package: Path) -> str:
    """Change one that lies in another file than the kernel; what the file was."""
    rules = package / "splatting" / "rules.py"
    text = rules.read_text()
    assert "ALPHA_MIN = 1.0 / 255.0" in text
    rules.write_text(text.replace("ALPHA_MIN = 1.0 / 255.0", "ALPHA_MIN = 1.0 / 20.0"))
    return text


def test_a_constant_of_another_file_is_never_that_of_before(package, tmp_path):
    first = radius(package, tmp_path / "cache")
    with_another_constant(package)
    changed = radius(package, tmp_path / "cache")
    assert changed[0] < first[0]
    assert (first[1], changed[1]) == (0, 0), "both were compiled"
    assert not list(package.rglob("*.nb?")), "nothing is written beside the sources"


@pytest.mark.slow
def test_what_is_compiled_is_found_again_by_the_code_that_it_is_of(package, tmp_path):
    cache = tmp_path / "cache"
    first = radius(package, cache)
    assert radius(package, cache) == (first[0], 1)
    text = with_another_constant(package)
    changed = radius(package, cache)
    assert changed == radius(package, tmp_path / "empty")
    assert changed[0] < first[0]
    (package / "splatting" / "rules.py").write_text(text)
    assert radius(package, cache) == (first[0], 1), "that of the first code is there still"
    assert not list(package.rglob("*.nb?")), "nothing is written beside the sources"


def test_the_sources_of_a_kernel_are_all_that_it_imports():
    of = {path.relative_to(PACKAGE).as_posix() for path in sources_of(PACKAGE / "splatting" / "cpu" / "blending.py")}
    assert {
        "splatting/cpu/blending.py",
        "splatting/cpu/tiles.py",
        "splatting/rules.py",
        "common/simd.py",
        "common/kernels.py",
    } <= of
    assert not {name for name in of if name.startswith(("training/", "priors/", "output/"))}


def test_every_constant_that_a_kernel_of_ours_takes_from_a_file_is_of_its_sources():
    """Import statements are read, not run: what a kernel's globals hold must come from the files that were found."""
    import importlib

    from numba.core.dispatcher import Dispatcher

    checked = 0
    for file in PACKAGE.rglob("*.py"):
        if "common.kernels import" not in file.read_text():
            continue
        module = importlib.import_module(".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts))
        sources = set(sources_of(file))
        for value in vars(module).values():
            if isinstance(value, Dispatcher):
                checked += 1
                assert Path(value.py_func.__code__.co_filename).resolve() in sources
    assert checked > 60


def test_other_settings_of_the_compiler_have_another_key(monkeypatch):
    file = PACKAGE / "splatting" / "cpu" / "tiles.py"
    before = key_of(file)
    for cached in (key_of, kernel_cache._machine):
        cached.cache_clear()
    monkeypatch.setattr(kernel_cache.config, "OPT", "1")
    assert key_of(file) != before
    for cached in (key_of, kernel_cache._machine):
        cached.cache_clear()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder for compiled kernels."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    return tmp_path / "kernels"


def doubled(values):
    """A kernel."""
    return values * 2


def test_files_that_are_spoilt_are_compiled_anew(folder):
    ones = np.ones(3, np.float32)
    kernel(doubled)(ones)
    (file,) = folder.rglob("*.kernel")
    whole = file.read_bytes()
    for content in (b"", whole[: len(whole) // 2], b"\x80\x05N."):
        file.write_bytes(content)
        again = kernel(doubled)
        assert (again(ones) == 2).all()
        assert sum(again.stats.cache_hits.values()) == 0
        assert len(file.read_bytes()) > len(whole) // 2 + 100, "and written anew"
    assert (kernel(doubled)(ones) == 2).all()


def test_where_nothing_can_be_written_it_works_all_the_same(folder):
    folder.write_text("a file in the place of the folder")
    assert (kernel(doubled)(np.ones(3, np.float32)) == 2).all()


def test_code_that_changed_after_it_was_imported_is_not_kept(folder):
    made = kernel(doubled)
    made._cache._made = 0.0
    assert (made(np.ones(3, np.float32)) == 2).all()
    assert not list(folder.rglob("*.kernel"))


def test_what_nothing_was_loaded_from_for_long_is_deleted(folder):
    kernel(doubled)(np.ones(3, np.float32))
    (used,) = folder.iterdir()
    for name, days in ((f"old-{0:016x}", 31), (f"newer-{1:016x}", 29), ("of_others", 100)):
        (folder / name).mkdir()
        (folder / name / "x.kernel").write_bytes(b"")
        past = time.time() - days * 24 * 3600
        os.utime(folder / name, (past, past))
    remove_old(folder)
    assert {path.name for path in folder.iterdir()} == {used.name, f"newer-{1:016x}", "of_others"}
    past = time.time() - 2 * 24 * 3600
    os.utime(used, (past, past))
    kernel(doubled)(np.ones(3, np.float32))
    assert time.time() - used.stat().st_mtime < 3600, "being used is noted"


def test_its_folder_is_the_users(monkeypatch, tmp_path):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("FLOWSPLAT_CACHE", str(tmp_path))
    assert kernels_folder() == tmp_path / "kernels"
    assert Path(KernelCache(doubled).cache_path).parent == tmp_path / "kernels"
