"""Cameras and depth of Depth Anything 3 and VGGT, whose images are resized, cropped or padded as their code does it, and of forks
of MegaSaM that round the sides of theirs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.given.cameras import read_cameras
from flowsplat.priors.given.depth import open_depth
from flowsplat.priors.given.fitting import Placement
from flowsplat.priors.prepare import use_given
from flowsplat.scenes import Scene

from .test_camera_files import megasam, path

FRAMES = 5
LANDSCAPE, PORTRAIT = (854, 480), (480, 854)


def make_scene(folder: Path, size: tuple[int, int] = LANDSCAPE) -> Scene:
    return Scene.create(
        folder, name="s", source="", width=size[0], height=size[1], timestamps=range(FRAMES), holdout=3, source_fps=1
    )


def network_depth(size: tuple[int, int], whole: Placement) -> np.ndarray:
    """A depth that rises with the position in the whole frame, from 1 to 4 across and 0 to 1 down; -1 beside it."""
    x = (np.arange(size[0]) + 0.5 - whole.left) / whole.width
    y = (np.arange(size[1]) + 0.5 - whole.top) / whole.height
    inside = ((x > 0) & (x < 1))[None] & ((y > 0) & (y < 1))[:, None]
    return np.where(inside, 1 + 3 * x[None] + y[:, None], -1).astype(np.float32)


def network_cameras(whole: Placement, frame: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera poses [N, 3, 4] and intrinsics [N, 3, 3] in pixels of what the network saw."""
    cameras = [camera.resize(*frame) for camera in path(frame)]
    K = np.diag([whole.width / frame[0], whole.height / frame[1], 1]) @ cameras[0].K
    K[:2, 2] += whole.left, whole.top
    return np.stack([camera.viewmat[:3] for camera in cameras]).astype(np.float32), np.repeat(K[None], FRAMES, 0).astype(np.float32)


def depth_anything(
    file: Path, size: tuple[int, int] = (504, 280), whole: Placement | None = None, frame: tuple[int, int] = LANDSCAPE,
    cameras: bool = True, **change: np.ndarray,
) -> Path:  # fmt: skip
    """As export_to_npz writes it."""
    whole = whole or Placement(0, 0, *size)
    depth = np.repeat(network_depth(size, whole)[None], FRAMES, 0)
    poses, K = network_cameras(whole, frame)
    content = {
        "image": np.zeros((FRAMES, *size[::-1], 3), np.uint8), "depth": np.round(depth, 6),
        "conf": np.round(np.full(depth.shape, 1.37, np.float32), 2),
        **({"extrinsics": poses, "intrinsics": K} if cameras else {}), **change,
    }  # fmt: skip
    np.savez_compressed(file, **content)
    return file


def vggt(
    file: Path, size: tuple[int, int], whole: Placement, frame: tuple[int, int] = LANDSCAPE, border: float | None = None,
    images: bool = True, **change: np.ndarray,
) -> Path:  # fmt: skip
    """As demo_gradio.py writes it, with what is beside the frame of one value."""
    depth = network_depth(size, whole)
    image = np.where(depth > 0, 0.4, border or 0).astype(np.float32)
    poses, K = network_cameras(whole, frame)
    content = {
        "pose_enc": np.zeros((FRAMES, 9), np.float32), "depth": np.repeat(depth[None, ..., None], FRAMES, 0),
        "depth_conf": np.full((FRAMES, *size[::-1]), 2, np.float32), "extrinsic": poses, "intrinsic": K,
        **({"images": np.broadcast_to(image, (FRAMES, 3, *size[::-1]))} if images else {}), **change,
    }  # fmt: skip
    np.savez(file, **content)
    return file


def check(scene: Scene, file: Path, maker: str) -> None:
    """Cameras are those of the frames again, and so is the depth wherever it was seen."""
    size = scene.width, scene.height
    read = read_cameras(file, scene, False)
    found, who = read.cameras, read.maker
    assert who == maker
    for camera, true in zip(found, path(size), strict=True):
        np.testing.assert_allclose(camera.viewmat, true.viewmat, atol=1e-6)
        np.testing.assert_allclose(camera.K, true.K, rtol=1e-5)
    given = open_depth(file, scene)
    depth = given.read(3)
    expected = network_depth(size, Placement(0, 0, *size))
    seen = depth.confidence == 1
    assert given.maker == maker
    assert set(np.unique(depth.confidence)) <= {0, 1}
    np.testing.assert_allclose(depth.depth[seen], expected[seen], atol=0.01)
    assert (depth.depth > 0).all()


@pytest.mark.parametrize(
    ("size", "whole", "frame"),
    [
        ((504, 280), None, LANDSCAPE),
        ((280, 504), None, PORTRAIT),
        ((1022, 574), None, LANDSCAPE),
        ((896, 504), None, LANDSCAPE),  # lower_bound_resize
        ((504, 392), Placement(0, -5, 504, 403), (720, 576)),  # upper_bound_crop: (403 - 392) // 2 rows above
    ],
)
def test_depth_anything_3(tmp_path: Path, size: tuple[int, int], whole: Placement | None, frame: tuple[int, int]):
    scene = make_scene(tmp_path / "scene", frame)
    file = depth_anything(tmp_path / "results.npz", size, whole, frame)
    check(scene, file, "Depth Anything 3")


def test_depth_anything_3_without_cameras_is_depth_alone(tmp_path: Path):
    file = depth_anything(tmp_path / "results.npz", cameras=False)
    scene = make_scene(tmp_path / "scene")
    assert open_depth(file, scene).maker == "Depth Anything 3"
    with pytest.raises(InputError, match=r"no cameras of a known layout. Looked for: .*Depth Anything 3"):
        read_cameras(file, scene, False)


@pytest.mark.filterwarnings("error")
def test_depth_of_0_or_nan_or_next_to_0_is_not_known(tmp_path: Path):
    depth = np.repeat(network_depth((504, 280), Placement(0, 0, 504, 280))[None], FRAMES, 0)
    depth[:, :10], depth[:, 10:20], depth[:, 10:20, :250] = 0, np.nan, 1e-40
    given = open_depth(depth_anything(tmp_path / "results.npz", depth=depth), make_scene(tmp_path / "scene")).read(0)
    assert (given.confidence[:34] == 0).all()
    assert (given.confidence[35:] == 1).all()
    assert np.isfinite(given.depth).all()


VGGT_WAYS = {
    "resized": ((518, 294), Placement(0, 0, 518, 294), LANDSCAPE, None),
    "padded with white": ((518, 518), Placement(0, 112, 518, 294), LANDSCAPE, 1.0),
    "padded with black": ((518, 518), Placement(0, (518 - 480 * 518 / 854) / 2, 518, 480 * 518 / 854), LANDSCAPE, 0.0),
    "cropped": ((518, 518), Placement(0, -203, 518, 924), PORTRAIT, None),
    "tall, padded with white": ((518, 518), Placement(112, 0, 294, 518), PORTRAIT, 1.0),
    "tall, padded with black": ((518, 518), Placement((518 - 480 * 518 / 854) / 2, 0, 480 * 518 / 854, 518), PORTRAIT, 0.0),
    "square": ((518, 518), Placement(0, 0, 518, 518), (600, 600), None),
}  # fmt: skip


@pytest.mark.parametrize("how", VGGT_WAYS)
def test_vggt(tmp_path: Path, how: str):
    size, whole, frame, border = VGGT_WAYS[how]
    check(make_scene(tmp_path / "scene", frame), vggt(tmp_path / "predictions.npz", size, whole, frame, border), "VGGT")


@pytest.mark.parametrize("how", ["padded with white", "cropped"])
def test_vggt_that_cannot_be_told_is_refused(tmp_path: Path, how: str):
    size, whole, frame, border = VGGT_WAYS[how]
    file = vggt(tmp_path / "predictions.npz", size, whole, frame, border, images=False)
    scene = make_scene(tmp_path / "scene", frame)
    for read in (lambda: read_cameras(file, scene, False), lambda: open_depth(file, scene)):
        with pytest.raises(InputError, match=r"more than one way \(cropped or padded\): keep its array images") as caught:
            read()
        assert "\n" not in str(caught.value)


def test_what_is_cut_off_has_no_confidence(tmp_path: Path):
    size, whole, frame, _ = VGGT_WAYS["cropped"]
    depth = open_depth(vggt(tmp_path / "a.npz", size, whole, frame), make_scene(tmp_path / "scene", frame)).read(0)
    seen = depth.confidence[:, 0] == 1
    assert np.flatnonzero(seen)[[0, -1]].tolist() == [round(203 * 854 / 924), round((203 + 518) * 854 / 924) - 1]


def test_a_batch_of_one_is_the_clip(tmp_path: Path):
    file = vggt(tmp_path / "a.npz", (518, 294), Placement(0, 0, 518, 294))
    content = {name: array[None] for name, array in np.load(file).items()}
    np.savez(file, **content)
    check(make_scene(tmp_path / "scene"), file, "VGGT")


def test_both_from_one_file_need_no_fitting(tmp_path: Path):
    file = depth_anything(tmp_path / "results.npz")
    scene = make_scene(tmp_path / "scene")
    assert use_given(scene, GivenPriors(cameras=file, depth=file)) == {}
    assert scene.prior("depth")["method"] == "given"


BAD = {
    "another shape": (lambda f: depth_anything(f, (504, 378)), "504x378 pixels, which is another shape"),
    "VGGT of another shape": (lambda f: vggt(f, (518, 392), Placement(0, 0, 518, 392)), "another shape"),
    "VGGT, square and of nothing that is beside the frame": (
        lambda f: vggt(f, (518, 518), Placement(0, 0, 518, 518)), "518x518 pixels, which is another shape"
    ),
    "fewer frames": (
        lambda f: depth_anything(f, extrinsics=np.zeros((3, 3, 4)), intrinsics=np.zeros((3, 3, 3))), "holds 3 cameras"
    ),
    "cameras that do not fit": (lambda f: depth_anything(f, intrinsics=np.zeros((3, 3, 3))), "not as Depth Anything 3 writes it"),
    "no cameras": (lambda f: depth_anything(f, intrinsics=np.full((5, 3, 3), np.nan)), "frame 0 is not finite"),
    "depth of no size": (lambda f: depth_anything(f, depth=np.zeros((5, 0, 4), np.float32)), "depth has shape"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, name: str):
    make, message = BAD[name]
    with pytest.raises(InputError, match=message) as caught:
        read_cameras(make(tmp_path / "a.npz"), make_scene(tmp_path / "scene"), False)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("size", "whole"),
    [
        ((848, 480), (848, 480)),
        ((680, 376), (680, 376)),
        ((640, 352), (640, 359)),
        ((644, 364), (644, 364)),
        ((512, 280), (514, 287)),
    ],
)
def test_megasam_with_rounded_sides(tmp_path: Path, size: tuple[int, int], whole: tuple[int, int]):
    """Resized as a whole or cropped at the right and the bottom: the principal point, in the middle, tells which."""
    place = Placement(0, 0, *whole)
    _, K = network_cameras(place, LANDSCAPE)
    K = K[0].astype(np.float64)
    K[:2, 2] = np.array(whole) / 2
    depths = np.repeat(network_depth(size, place)[None], FRAMES, 0)
    megasam(tmp_path / "a.npz", depths=depths, intrinsic=K, images=np.zeros((FRAMES, *size[::-1], 3), np.uint8))
    scene = make_scene(tmp_path / "scene")
    camera = read_cameras(tmp_path / "a.npz", scene, False).cameras[2]
    expected = path(LANDSCAPE)[0].K.copy()
    expected[:2, 2] = 427, 240
    np.testing.assert_allclose(camera.K, expected, rtol=1e-6)
    found = open_depth(tmp_path / "a.npz", scene).read(0)
    seen = found.confidence == 1
    np.testing.assert_allclose(found.depth[seen], network_depth(LANDSCAPE, Placement(0, 0, *LANDSCAPE))[seen], atol=0.01)
    assert seen.mean() == pytest.approx(size[0] * size[1] / whole[0] / whole[1], abs=0.005)
