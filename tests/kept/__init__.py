"""What a release has written, kept as it was: every later version reads it, or says in one line why not.

``release_0_2`` is the folder of a run, and in it a model. ``python -m tests.kept NAME`` writes such a folder with the version that
is checked out, once for a release whose files have a new form; one that is there is never written again.
"""

from __future__ import annotations

from pathlib import Path

HERE = Path(__file__).parent
RELEASES = tuple(sorted(path.name for path in HERE.glob("release_*")))
IMAGE, FRAME = "expected.png", 3
"""What the model shows at a frame of the run, and which one."""
