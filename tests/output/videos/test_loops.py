"""Loops go as far as the clip has seen."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flowsplat.gaussians.support import Support
from flowsplat.geometry import Camera, Similarity
from flowsplat.output.videos.loops import ANGLES, Loops
from tests.gaussians.test_support import WALL, WallAndCard, camera_at


def scene_of(reach: float) -> Any:
    """A clip whose camera goes that far to either side."""
    cameras = [camera_at(x) for x in np.linspace(-reach, reach, 9)]
    return SimpleNamespace(cameras=cameras, timestamps=np.linspace(0, 1, 9), similarity=Similarity(1 / WALL))


def test_the_farther_the_camera_went_the_wider_the_loop():
    found = [Loops(WallAndCard(card_depth=3.5), scene_of(reach), None).angle([0.5], "orbit") for reach in (0.0, 0.01, 0.05, 1.0)]
    assert found[0] == found[1] == min(ANGLES)
    assert min(ANGLES) < found[2] < found[3]


def test_loops_stay_away_from_what_moves(monkeypatch: pytest.MonkeyPatch):
    def is_near(self: Support, camera: Camera, own: Camera, t: float) -> bool:
        return float(np.linalg.norm(camera.center - own.center)) < 0.45

    monkeypatch.setattr(Support, "keeps_clear", is_near)
    angle = Loops(WallAndCard(card_depth=3.5), scene_of(1.0), None).angle([0.5], "orbit")
    assert angle == 6.0, "6 degrees of 4 are .42, 7 are .49"


def test_what_the_user_gave_is_taken():
    assert Loops(WallAndCard(), scene_of(0.0), 25.0).angle([0.5], "orbit") == 25.0
