"""Set up before any test imports Triton: without a GPU its kernels run in its interpreter, on the CPU."""

from __future__ import annotations

import atexit
import gc
import os
import shutil
import signal
import tempfile

import pytest
import torch

from flowsplat.common.kernel_cache import kernels_folder
from tests.browser import chromium  # noqa: F401 (a fixture, of which there can be only one)

# What tests measure of this machine is not for its user; kernels that are compiled are.
os.environ.setdefault("NUMBA_CACHE_DIR", str(kernels_folder()))
if "FLOWSPLAT_CACHE" not in os.environ:
    os.environ["FLOWSPLAT_CACHE"] = tempfile.mkdtemp(prefix="flowsplat-tests-")
    atexit.register(shutil.rmtree, os.environ["FLOWSPLAT_CACHE"], ignore_errors=True)

if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")

# A shell's background jobs ignore Ctrl-C, and hand that on to every process that tests start and interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Whoever asks for the browser is a test in a browser."""
    for item in items:
        if "chromium" in getattr(item, "fixturenames", ()):
            item.add_marker("browser")


def pytest_collection_finish() -> None:
    """What is imported now stays. Every stage of a run looks for what nothing uses any more: not among this, half of its time."""
    gc.collect()
    gc.freeze()


def pytest_addoption(parser: pytest.Parser) -> None:
    """How much is tried where the ordinary run tries a part of it only."""
    parser.addoption("--fuzz", type=int, default=None, metavar="COUNT", help="try so many spoiled files in tests/fuzz")
    text = "let so many requests come to the viewer in tests/output/viewer/test_soak.py"
    parser.addoption("--requests", type=int, default=None, metavar="COUNT", help=text)
