"""Camera paths in the making."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.output.viewer.keys import CameraKeys


def camera(x: float) -> Camera:
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    return Camera(viewmat, np.diag([50.0, 50, 1]), 8, 6)


def test_shots_go_through_the_keys():
    keys = CameraKeys(2.0)
    for x, t in ((0.0, 1.0), (1.0, 1.0), (4.0, 3.0)):
        keys.add(camera(x), t)
    assert keys.seconds == 4.0
    shots = keys.shots(5.0)
    assert len(shots) == 21
    for k, (x, t) in zip((0, 10, 20), ((0.0, 1.0), (1.0, 1.0), (4.0, 3.0)), strict=True):
        assert shots[k][0].center[0] == pytest.approx(x)
        assert shots[k][1] == pytest.approx(t)
    assert shots[15][1] == pytest.approx(2.0)
    there, t = keys.shot_at()(3.0)
    assert t == pytest.approx(2.0)
    np.testing.assert_allclose(there.center, shots[15][0].center)


def test_a_path_from_a_file_comes_back_frame_by_frame():
    shots = [(camera(x), t) for x, t in ((0.0, 0.0), (0.5, 0.3), (0.2, 0.1), (0.9, 0.9))]
    back = CameraKeys.of_shots(shots, 12.5).shots(12.5)
    assert [t for _, t in back] == pytest.approx([t for _, t in shots])
    np.testing.assert_allclose([c.center for c, _ in back], [c.center for c, _ in shots], atol=1e-12)


def test_a_path_that_came_as_a_whole_takes_no_more_keys():
    with pytest.raises(InputError, match="clear it"):
        CameraKeys.of_shots([(camera(0.0), 0.0), (camera(1.0), 1.0)], 30.0).add(camera(2.0), 1.0)


def test_few_keys():
    keys = CameraKeys()
    assert keys.shots(10.0) == []
    assert keys.seconds == 0
    keys.add(camera(1.0), 0.5)
    ((there, t),) = keys.shots(10.0)
    assert (there.center[0], t) == (1.0, 0.5)
