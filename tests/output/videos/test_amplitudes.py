"""Loops and dolly zooms go as far as the clip has seen."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flowsplat.gaussians.visibility import ClipVisibility
from flowsplat.geometry import Camera, Similarity
from flowsplat.geometry.paths import turn_aside
from flowsplat.output.videos import amplitudes
from flowsplat.output.videos.amplitudes import DOLLY_FACTORS, MAX_UNSEEN_SHARE, PULL_RANGE, SWING_ANGLES, Amplitudes
from tests.gaussians.test_visibility import WALL, WallAndBillboard, camera_at


def scene_of(reach: float) -> Any:
    """A clip whose camera goes that far to either side."""
    cameras = [camera_at(x) for x in np.linspace(-reach, reach, 9)]
    similarity = Similarity(1 / WALL)
    return SimpleNamespace(folder=Path("no-priors"), cameras=cameras, timestamps=np.linspace(0, 1, 9), similarity=similarity)


def test_the_farther_the_camera_went_the_wider_the_loop():
    reaches = (0.0, 0.01, 0.05, 1.0)
    found = [Amplitudes(WallAndBillboard(billboard_depth=3.5), scene_of(reach), None).angle([0.5], "orbit") for reach in reaches]
    assert found[0] == found[1] == min(SWING_ANGLES)
    assert min(SWING_ANGLES) < found[2] < found[3]


def test_it_is_told_whether_even_the_narrowest_loop_holds():
    still, far = (
        Amplitudes(WallAndBillboard(billboard_depth=3.5), scene_of(reach), None).measure_swing([0.5], "orbit")
        for reach in (0.0, 1.0)
    )
    assert (still.degrees, still.holds) == (min(SWING_ANGLES), False)
    assert far.holds
    assert far.unknown <= amplitudes.MAX_UNKNOWN_SHARE < still.unknown


def test_loops_stay_away_from_what_moves(monkeypatch: pytest.MonkeyPatch):
    def is_near(self: ClipVisibility, camera: Camera, own: Camera, t: float) -> bool:
        return float(np.linalg.norm(camera.center - own.center)) < 0.45

    monkeypatch.setattr(ClipVisibility, "keeps_clear", is_near)
    angle = Amplitudes(WallAndBillboard(billboard_depth=3.5), scene_of(1.0), None).angle([0.5], "orbit")
    assert angle == 6.0, "6 degrees of 4 are .42, 7 are .49"


def test_what_the_user_gave_is_taken():
    assert Amplitudes(WallAndBillboard(), scene_of(0.0), 25.0).angle([0.5], "orbit") == 25.0


@pytest.mark.parametrize(("sigma", "widest"), [(0.05, 12.0), (0.24, 6.0), (1.0, min(SWING_ANGLES))])
def test_objects_whose_distance_is_not_known_keep_loops_narrow(monkeypatch: pytest.MonkeyPatch, sigma: float, widest: float):
    """With a focal length of .78 widths 6 degrees move an object with sigma .24 by 2 % of the width."""
    objects = [SimpleNamespace(number=1, sigma=sigma), SimpleNamespace(number=2, sigma=9.0)]
    monkeypatch.setattr(amplitudes, "load_objects", lambda scene: SimpleNamespace(objects=objects))
    monkeypatch.setattr(amplitudes, "large_objects", lambda scene: {1})
    monkeypatch.setattr(amplitudes, "MAX_UNKNOWN_SHARE", 1.0)
    assert Amplitudes(WallAndBillboard(billboard_depth=3.5), scene_of(1.0), None).angle([0.5], "orbit") == widest


def test_dolly_zooms_go_as_far_as_the_clip_saw():
    far, still = (Amplitudes(WallAndBillboard(billboard_depth=3.5), scene_of(reach), None).dolly(0.5, 3.5) for reach in (1.0, 0.0))
    assert far == max(DOLLY_FACTORS)
    assert still == min(DOLLY_FACTORS)


def test_the_page_is_pulled_until_it_shows_what_no_frame_has_seen():
    """To the side farther where the clip went there."""
    sideways = []
    for reach in (0.0, 1.0):
        model, scene, angle = WallAndBillboard(billboard_depth=3.5), scene_of(reach), 8.0
        found = Amplitudes(model, scene, None)
        (pulls,) = found.pulls([0.5], angle)
        visibility, own = ClipVisibility(model, scene.cameras, scene.timestamps.tolist()), found.path.at(0.5)
        for k, pull in enumerate(pulls):
            around = 2 * np.pi * k / len(pulls)
            turned = turn_aside(own, WALL, pull * angle * np.cos(around), pull * angle / 2 * np.sin(around))
            assert visibility.unseen_share(turned, 0.5) <= MAX_UNSEEN_SHARE
        assert pulls[2] == pulls[6] == PULL_RANGE[1], "the wall is as far away everywhere: up and down nothing comes to light"
        assert pulls[0] == pulls[4]
        sideways.append(pulls[0])
    assert PULL_RANGE[0] < sideways[0] < sideways[1] < 1
