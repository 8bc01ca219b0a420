"""What is installed to test and to release is what was tested: everything is pinned, with its hash."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_lock_has_every_pin_and_a_hash_for_each():
    lock = (ROOT / "requirements.lock").read_text().replace("\\\n", " ")
    locked = {line.split()[0]: line for line in lock.splitlines() if line.strip()}
    assert all("--hash=sha256:" in line for line in locked.values())
    pins = {line.split(";")[0].strip() for line in (ROOT / "constraints.txt").read_text().splitlines() if line and line[0] != "#"}
    assert {pin for pin in pins if pin not in locked} == {pin for pin in pins if pin.startswith("torch==")}


def test_it_is_what_is_installed():
    makefile = (ROOT / "Makefile").read_text()
    assert "pip install --no-deps --require-hashes -r requirements.lock" in makefile
    assert re.search(r"pip install --no-deps --no-build-isolation -e \.", makefile)
