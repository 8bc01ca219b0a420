from __future__ import annotations

import subprocess
import sys

import pytest

from flowsplat.common.memory import peak_memory

PROGRAM = "from flowsplat.common.memory import peak_memory as peak; a = peak(); b = bytearray(200 << 20); del b; print(peak() - a)"


@pytest.mark.skipif(peak_memory() is None, reason="this system does not tell how much memory a process needed")
def test_what_was_freed_counts():
    told = subprocess.run([sys.executable, "-c", PROGRAM], check=True, capture_output=True, text=True, timeout=60).stdout
    assert 0.15 < float(told) < 0.25
