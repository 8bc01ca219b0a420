from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path

import pytest

from flowsplat.common.memory import peak_memory

PROGRAM = "from flowsplat.common.memory import peak_memory as peak; a = peak(); b = bytearray(200 << 20); del b; print(peak() - a)"


@pytest.mark.skipif(peak_memory() is None, reason="this system does not tell how much memory a process needed")
def test_what_was_freed_counts():
    told = subprocess.run([sys.executable, "-c", PROGRAM], check=True, capture_output=True, text=True, timeout=60).stdout
    assert 0.15 < float(told) < 0.25


STAGES = """
from flowsplat.common.memory import begin_peak, get_recent_peak, peak_memory
b = bytearray(300 << 20); del b
first = peak_memory()
begin_peak()
b = bytearray(100 << 20)
print(first - get_recent_peak(), first - peak_memory())
"""


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="this system cannot count the peak anew")
def test_the_peak_of_a_stage_does_not_hold_what_was_before_it_and_that_of_the_process_does():
    told = subprocess.run([sys.executable, "-c", STAGES], check=True, capture_output=True, text=True, timeout=60).stdout
    less, same = map(float, told.split())
    assert 0.15 < less < 0.25
    assert same == 0


FAULTS = """
import resource
import numpy as np
from flowsplat.common.memory import keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(4):
        np.ones(64 << 20, np.uint8)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

before = faults()
with keep_freed_memory():
    faults()
    inside = faults()
print(before, inside, faults())
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="no glibc")
def test_what_was_freed_is_used_again_without_asking_the_system():
    told = subprocess.run([sys.executable, "-c", FAULTS], check=True, capture_output=True, text=True, timeout=60).stdout
    before, inside, after = map(int, told.split())
    assert inside < 0.05 * before
    assert after > 0.5 * before


HOLES = """
import re
from pathlib import Path
import numpy as np
from flowsplat.common.memory import give_back_memory

def held():
    return int(re.search(r"VmRSS:\\s*([0-9]+) kB", Path("/proc/self/status").read_text()).group(1)) / 2**20

# Blocks too small to be mapped one by one; one in sixteen stays, so that the heap has no free end.
blocks = [np.ones(64 << 10, np.uint8) for _ in range(4096)]
full = held()
kept = blocks[::16]
del blocks
freed = held()
give_back_memory()
print(full - freed, freed - held())
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="no glibc")
def test_what_lies_between_what_is_in_use_is_given_back():
    told = subprocess.run([sys.executable, "-c", HOLES], check=True, capture_output=True, text=True, timeout=60).stdout
    by_itself, given_back = map(float, told.split())
    assert by_itself < 0.05
    assert given_back > 0.15


KEPT = """
import gc, weakref
from flowsplat.common.memory import give_back_memory, keep_imported

class Loop: pass

give_back_memory()
first = gc.get_freeze_count()
keep_imported()
give_back_memory()
kept = gc.get_freeze_count()
loop = Loop()
loop.itself = loop
seen = weakref.ref(loop)
del loop
give_back_memory()
print(first, kept > 1000, gc.get_freeze_count() <= kept, seen())
"""


def test_what_is_imported_is_looked_through_once():
    """And what comes later is freed as ever."""
    told = subprocess.run([sys.executable, "-c", KEPT], check=True, capture_output=True, text=True, timeout=60).stdout
    assert told.split() == ["0", "True", "True", "None"]
