"""Camera paths in files: round trips, axes, and lines that say what is wrong."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.output.camera_files import read_camera_file, write_camera_file

SIZE, CLIP = (64, 48), (1.0, 3.0)


def some_camera(seed: int, width: int = 80, height: int = 60) -> Camera:
    random = np.random.default_rng(seed)
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.random(rng=random).as_matrix()
    viewmat[:3, 3] = random.normal(size=3)
    return Camera(viewmat, np.array([[70.0, 0, 41], [0, 72, 29], [0, 0, 1]]), width, height)


def opengl_pose(camera: Camera) -> np.ndarray:
    """Camera to world, columns right, up, back, center."""
    R = camera.viewmat[:3, :3]
    pose = np.eye(4)
    pose[:3] = np.stack([R[0], -R[1], -R[2], camera.center], axis=1)
    return pose


def read(tmp_path, content):
    path = tmp_path / "path.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_camera_file(path, SIZE, CLIP)


def assert_same(camera: Camera, other: Camera) -> None:
    np.testing.assert_allclose(camera.viewmat, other.viewmat, atol=1e-9)
    np.testing.assert_allclose(camera.K, other.K, atol=1e-9)
    assert (camera.width, camera.height) == (other.width, other.height)


def test_our_format_round_trips(tmp_path):
    shots = [(some_camera(k), 1.0 + k / 2) for k in range(4)]
    write_camera_file(tmp_path / "path.json", shots, fps=12.5)
    found = read_camera_file(tmp_path / "path.json", SIZE, CLIP)
    assert found.fps == 12.5
    for (camera, time), (expected, when) in zip(found.shots, shots, strict=True):
        assert_same(camera, expected)
        assert time == when


def test_our_format_with_a_field_of_view_and_without_times(tmp_path):
    frames = [{"viewmat": some_camera(k).viewmat.tolist(), "fov_y": 90} for k in range(3)]
    found = read(tmp_path, {"frames": frames})
    assert found.fps is None
    assert [time for _, time in found.shots] == [1.0, 2.0, 3.0]
    np.testing.assert_allclose(found.shots[0][0].K, [[24, 0, 32], [0, 24, 24], [0, 0, 1]])


def test_nerfstudio_camera_path(tmp_path):
    camera = some_camera(5)
    content = {
        "camera_type": "perspective", "render_height": 60, "render_width": 80, "fps": 30, "seconds": 2,
        "camera_path": [
            {"camera_to_world": opengl_pose(camera).ravel().tolist(), "fov": 60, "aspect": 4 / 3, "render_time": time}
            for time in (0, 0.25)
        ],
    }  # fmt: skip
    found = read(tmp_path, content)
    assert found.fps == 30
    assert [time for _, time in found.shots] == [1.0, 1.5]
    focal = 30 / np.tan(np.radians(30))
    expected = Camera(camera.viewmat, np.array([[focal, 0, 40], [0, focal, 30], [0, 0, 1]]), 80, 60)
    assert_same(found.shots[0][0], expected)
    # A point straight ahead and a little above lands above the center.
    R = camera.viewmat[:3, :3]
    uv, depth = found.shots[0][0].project(camera.center + 2 * R[2] - 0.1 * R[1])
    assert depth == pytest.approx(2)
    assert uv[1] < 30


def test_transforms_json(tmp_path):
    cameras = [some_camera(k) for k in range(2)]
    frames = [{"file_path": "a.png", "transform_matrix": opengl_pose(camera).tolist()} for camera in cameras]
    frames[1].update(fl_x=35.0, transform_matrix=frames[1]["transform_matrix"][:3])
    found = read(tmp_path, {"fl_x": 70, "fl_y": 72, "cx": 41, "cy": 29, "w": 80, "h": 60, "frames": frames})
    assert_same(found.shots[0][0], cameras[0])
    np.testing.assert_allclose(found.shots[1][0].viewmat, cameras[1].viewmat, atol=1e-9)
    assert found.shots[1][0].K[0, 0] == 35
    assert [time for _, time in found.shots] == [1.0, 3.0]


def test_transforms_json_with_an_angle(tmp_path):
    frames = [{"transform_matrix": np.eye(4).tolist(), "time": 1.0}]
    found = read(tmp_path, {"camera_angle_x": np.pi / 2, "frames": frames})
    camera, time = found.shots[0]
    np.testing.assert_allclose(camera.K, [[32, 0, 32], [0, 32, 24], [0, 0, 1]])
    assert (camera.width, camera.height, time) == (64, 48, 3.0)


LENS = {"fl_x": 50, "frames": [{"transform_matrix": np.eye(4).tolist()}]}
GOOD = {"t": 1.5, "viewmat": np.eye(4).tolist(), "K": [[50, 0, 32], [0, 50, 24], [0, 0, 1]]}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "JSON"),
        ([1], "object"),
        ({}, "no list"),
        ({"frames": []}, "at least one"),
        ({"frames": [3]}, "frame 0"),
        ({"frames": [GOOD, {**GOOD, "viewmat": [[1, 0], [0, 1]]}]}, "frame 1: viewmat has 4 numbers"),
        ({"frames": [{**GOOD, "viewmat": (2 * np.eye(4)).tolist()}]}, "not a rotation"),
        ({"frames": [{**GOOD, "viewmat": np.diag([1.0, 1, -1, 1]).tolist()}]}, "not a rotation"),
        ({"frames": [{**GOOD, "viewmat": "no"}]}, "frame 0"),
        ({"frames": [{**GOOD, "viewmat": [[float("nan")] * 4] * 4}]}, "not finite"),
        ({"frames": [{"t": 1.5, "viewmat": GOOD["viewmat"]}]}, "no 'fov_y'"),
        ({"frames": [{**GOOD, "K": [[50, 9, 32], [0, 50, 24], [0, 0, 1]]}]}, "K is not of the form"),
        ({"frames": [{**GOOD, "t": 9}]}, "the clip runs from 1 to 3 s"),
        ({"frames": [{**GOOD, "t": float("nan")}]}, "not finite"),
        ({"frames": [{**GOOD, "t": None}, GOOD]}, "1 of 2 frames have a time"),
        ({"frames": [GOOD], "fps": 0}, "fps is 0"),
        ({"frames": [GOOD], "fps": 0.0004}, "fps is 0.0004: only 0.1 to 1000 can be written"),
        ({"frames": [GOOD], "width": 1e9, "height": 2}, "not possible"),
        ({"camera_path": [{}], "camera_type": "fisheye"}, "fisheye"),
        ({"camera_path": [{"camera_to_world": np.zeros(16).tolist(), "fov": 50}]}, "frame 0"),
        ({"camera_path": [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 180}]}, "180 degrees"),
        ({**LENS, "k1": -0.3}, r"frame 0: it describes a lens that bends the image by .* undistorted ones\.$"),
        ({**LENS, "k1": float("nan")}, "not finite"),
        ({**LENS, "camera_model": "OPENCV_FISHEYE"}, "it describes a fisheye"),
        ({**LENS, "fl_x": -50}, "fl_x is -50"),
        ({**LENS, "frames": [{"transform_matrix": [1, 2]}]}, "transform_matrix has 2 numbers"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path, content, says):
    with pytest.raises(InputError, match=says) as caught:
        read(tmp_path, content)
    assert "path.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_camera_file(tmp_path / "none.json", SIZE, CLIP)
