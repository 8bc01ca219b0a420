"""Cameras, depth and masks of ViPE, written as its code writes them, and cameras for some frames only."""

from __future__ import annotations

import base64
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.given.camera_check import compute_misfit, match_frames
from flowsplat.priors.given.cameras import read_cameras
from flowsplat.priors.given.depth import open_depth
from flowsplat.priors.given.exr import decode_exr
from flowsplat.priors.given.fitting import Placement
from flowsplat.priors.prepare import use_given
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.ingest import ingest, open_clip

from .test_camera_files import colmap_binary, path, transforms, write
from .test_feedforward_files import network_depth

SIZE = (854, 480)
FRAMES = 5
STORED = (1280, 720)
OPENEXR = (
    "di8xAQIAAABjaGFubmVscwBjaGxpc3QAEwAAAFoAAQAAAAAAAAABAAAAAQAAAABjb21wcmVzc2lvbgBjb21wcmVzc2lvbgABAAAA"
    "A2RhdGFXaW5kb3cAYm94MmkAEAAAAAAAAAAAAAAABAAAABEAAABkaXNwbGF5V2luZG93AGJveDJpABAAAAAAAAAAAAAAAAQAAAAR"
    "AAAAbGluZU9yZGVyAGxpbmVPcmRlcgABAAAAAHBpeGVsQXNwZWN0UmF0aW8AZmxvYXQABAAAAAAAgD9zY3JlZW5XaW5kb3dDZW50"
    "ZXIAdjJmAAgAAAAAAAAAAAAAAHNjcmVlbldpbmRvd1dpZHRoAGZsb2F0AAQAAAAAAIA/ACUBAAAAAAAAhgEAAAAAAAAAAAAAWQAA"
    "AHheRYvJDYAwDARdWkrigRDXI7sBJHri4dJYk0T4WI9GsuWvLKcUx0TuXal1JF3dlMaCJaqLv9RV9ucgh7uQ41WI6SQxS2GWwiKF"
    "VYAtohFa7D9pa7zqY0nIEAAAABQAAAAARABFAEYARwBIQERARUBGQEcgSA=="
)
"""A file of OpenEXR 3.5, made as ViPE makes them: 5 x 18 pixels, column + row / 4."""


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return make_scene(tmp_path / "scene", FRAMES)


def make_scene(folder: Path, frames: int) -> Scene:
    """Frame 2 is held out, and every third from there on."""
    return Scene.create(
        folder, name="clip", source="", width=SIZE[0], height=SIZE[1], timestamps=range(frames), holdout=3, source_fps=1
    )


def along(frames: int) -> list[Camera]:
    """A smooth path of a camera whose principal point is the middle."""
    known = path(SIZE)[0]
    K = known.K.copy()
    K[:2, 2] = np.array(SIZE) / 2
    cameras = []
    for i in range(frames):
        viewmat = np.eye(4)
        viewmat[:3, :3] = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]) * i)[0]
        viewmat[:3, 3] = [0.1 * np.sin(0.2 * i), -0.01 * i, 0.02 * i]
        cameras.append(Camera(viewmat, K, *SIZE))
    return cameras


def write_exr(depth: np.ndarray) -> bytes:
    """As OpenEXR writes halfs [H, W] in one channel Z: blocks of 16 rows, in which differences of bytes are packed."""
    height, width = depth.shape

    def attribute(name: str, kind: str, data: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data

    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = (
        struct.pack("<2i", 20000630, 2)
        + attribute("channels", "chlist", b"Z\0" + struct.pack("<iB3x2i", 1, 0, 1, 1) + b"\0")
        + attribute("compression", "compression", b"\3")
        + attribute("dataWindow", "box2i", window)
        + attribute("displayWindow", "box2i", window)
        + attribute("lineOrder", "lineOrder", b"\0")
        + attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
        + attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0))
        + attribute("screenWindowWidth", "float", struct.pack("<f", 1))
        + b"\0"
    )
    blocks = []
    for row in range(0, height, 16):
        plain = np.frombuffer(depth[row : row + 16].astype("<f2").tobytes(), np.uint8)
        halves = np.concatenate([plain[::2], plain[1::2]]).astype(int)
        packed = zlib.compress(np.append(halves[:1], np.diff(halves) + 128).astype(np.uint8).tobytes())
        packed = packed if len(packed) < len(plain) else plain.tobytes()
        blocks.append(struct.pack("<2i", row, len(packed)) + packed)
    places = len(header) + 8 * len(blocks) + np.cumsum([0, *map(len, blocks)])[:-1]
    return header + places.astype("<u8").tobytes() + b"".join(blocks)


def vipe(
    folder: Path, frames: Iterable[int] = range(FRAMES), name: str = "clip", labels: str = "0: background\n1: bear\n2: sky\n",
    **change: np.ndarray,
) -> Path:  # fmt: skip
    """As save_artifacts of vipe/utils/io.py writes them."""
    inds = np.array(list(frames))
    cameras = along(inds.max() + 1)
    stored = cameras[0].resize(*STORED)
    content = {
        "pose": np.stack([np.linalg.inv(cameras[i].viewmat) for i in inds]).astype(np.float32),
        "intrinsics": np.repeat(stored.intrinsics[None], len(inds), 0).astype(np.float32), **change,
    }  # fmt: skip
    for kind in ("pose", "intrinsics", "depth", "mask"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for kind in ("pose", "intrinsics"):
        np.savez(folder / kind / f"{name}.npz", data=content[kind], inds=inds[: len(content[kind])])
    (folder / "intrinsics" / f"{name}_camera.txt").write_text("".join(f"{i}: PINHOLE\n" for i in inds))
    depth = network_depth((160, 90), Placement(0, 0, 160, 90)).astype(np.float16)
    depth[:9] = np.nan
    mask = np.zeros((90, 160), np.uint8)
    mask[20:40, :50], mask[:20] = 1, 2
    with zipfile.ZipFile(folder / "depth" / f"{name}.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for i in inds:
            archive.writestr(f"{i:05d}.exr", write_exr(depth))
    with zipfile.ZipFile(folder / "mask" / f"{name}.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for i in inds:
            archive.writestr(f"{i:05d}.png", cv2.imencode(".png", mask)[1].tobytes())
    (folder / "mask" / f"{name}.txt").write_text(labels)
    return folder


def check(found: list[Camera], tolerance: float = 1e-5) -> None:
    for camera, true in zip(found, along(len(found)), strict=True):
        assert (camera.width, camera.height) == SIZE
        np.testing.assert_allclose(camera.viewmat, true.viewmat, atol=tolerance)
        np.testing.assert_allclose(camera.K, true.K, rtol=1e-5)


def test_openexr_is_read():
    expected = (np.arange(5) + np.arange(18)[:, None] / 4).astype(np.float16)
    np.testing.assert_array_equal(decode_exr(base64.b64decode(OPENEXR)), expected)
    for height in (1, 16, 37):
        noise = np.random.default_rng(0).random((height, 7)).astype(np.float16)
        np.testing.assert_array_equal(decode_exr(write_exr(noise)), noise)


def test_cameras(scene: Scene, tmp_path: Path):
    given = read_cameras(vipe(tmp_path / "vipe"), scene, False)
    assert (given.maker, given.told) == ("ViPE", "")
    check(given.cameras)


def test_of_several_clips_that_of_this_name_is_read(scene: Scene, tmp_path: Path):
    folder = vipe(tmp_path / "vipe")
    vipe(folder, name="other", frames=range(FRAMES + 2))
    check(read_cameras(folder, scene, False).cameras)
    for kind in ("pose", "depth", "mask"):
        for file in (folder / kind).glob("clip*"):
            os.replace(file, file.with_stem(file.stem.replace("clip", "third")))
    for read in (lambda: read_cameras(folder, scene, False), lambda: open_depth(folder, scene)):
        with pytest.raises(InputError, match="holds 2 clips, none called clip as this one"):
            read()


def test_depth(scene: Scene, tmp_path: Path):
    given = open_depth(vipe(tmp_path / "vipe"), scene)
    found = given.read(3)
    assert given.maker == "ViPE"
    assert (found.confidence[:48] == 0).all()
    assert (found.confidence[48:] == 1).all()
    np.testing.assert_allclose(found.depth[48:], network_depth(SIZE, Placement(0, 0, *SIZE))[48:], atol=0.02)


def test_masks_without_the_sky(scene: Scene, tmp_path: Path):
    use_given(scene, GivenPriors(masks=vipe(tmp_path / "vipe")))
    expected = np.zeros((90, 160), np.uint8)
    expected[20:40, :50] = 1
    np.testing.assert_array_equal(scene.mask(3), cv2.resize(expected, SIZE, interpolation=cv2.INTER_NEAREST_EXACT))
    assert scene.heldout_masks.mask(2).any()


def test_labels_are_what_the_file_beside_says(scene: Scene, tmp_path: Path):
    use_given(scene, GivenPriors(masks=vipe(tmp_path / "vipe", labels="0: background\n1: sky\n2: bird\n")))
    assert scene.mask(3)[:100].all()
    assert not scene.mask(3)[110:].any()


def test_few_cameras_that_are_missing_are_interpolated_and_said(tmp_path: Path):
    scene = make_scene(tmp_path / "scene", 12)
    frames = [0, 1, 3, 4, 5, 8, 9, 10, 11]
    given = read_cameras(vipe(tmp_path / "vipe", frames), scene, False)
    assert given.told == "those of 3 frames that it lacks are interpolated"
    check(given.cameras, 1e-3)


def test_missing_cameras_of_colmap_and_nerfstudio(scene: Scene, tmp_path: Path):
    """By the numbers in the names of their images, of which the first and the last are there."""
    content = transforms()
    del content["frames"][2]
    write(tmp_path / "transforms.json", json.dumps(content))
    given = read_cameras(tmp_path / "transforms.json", scene, False)
    assert given.told == "those of 1 frames that it lacks are interpolated"
    for i in (0, 1, 3, 4):
        np.testing.assert_allclose(given.cameras[i].viewmat, path()[i].viewmat, atol=1e-6)
    np.testing.assert_allclose(given.cameras[2].viewmat, path()[2].viewmat, atol=0.05)


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([0, 1, 2, 6, 7], "no cameras of frames 3 to 5: they are interpolated only where at most 2 in a row"),
        ([1, 2, 3, 4, 5, 6, 7], "no cameras of frames 0 to 0"),
        ([0, 1, 2, 3, 4, 5, 6], "no cameras of frames 7 to 7"),
        (range(9), "holds 9 cameras, but the clip has 8 frames"),
    ],
)
def test_too_many_missing_cameras_are_refused(tmp_path: Path, frames: Iterable[int], message: str):
    scene = make_scene(tmp_path / "scene", 8)
    with pytest.raises(InputError, match=message) as caught:
        read_cameras(vipe(tmp_path / "vipe", frames), scene, False)
    assert "\n" not in str(caught.value)


def test_colmap_that_lacks_its_last_frame_is_refused(tmp_path: Path):
    colmap_binary(tmp_path / "sparse" / "0")
    with pytest.raises(InputError, match="holds 5 registered images, but the clip has 6 frames"):
        read_cameras(tmp_path, make_scene(tmp_path / "scene", 6), False)


def spoil_zip(folder: Path, kind: str, name: str, data: bytes) -> Path:
    with zipfile.ZipFile(folder / kind / "clip.zip", "w") as archive:
        for i in range(FRAMES):
            archive.writestr(name.format(i), data)
    return folder


BAD = {
    "no intrinsics": (lambda f: (f / "intrinsics" / "clip.npz").unlink(), "intrinsics/clip.npz does not exist"),
    "a wide lens": (lambda f: write(f / "intrinsics" / "clip_camera.txt", "0: MEI\n"), r"no pinholes \(MEI\)"),
    "poses of no rotation": (lambda f: vipe(f, pose=np.ones((5, 4, 4))), "no camera's|not finite or"),
    "NaN": (lambda f: vipe(f, pose=np.full((5, 4, 4), np.nan)), "not finite or"),
    "intrinsics of another size": (lambda f: vipe(f, intrinsics=np.full((5, 4), 300.0)), "another shape"),
    "no principal point": (lambda f: vipe(f, intrinsics=np.full((5, 4), np.nan)), "the middle of no image"),
    "half a principal point": (lambda f: vipe(f, intrinsics=np.tile([300, 300, 150, np.nan], (5, 1))), "the middle of no image"),
    "the other half": (lambda f: vipe(f, intrinsics=np.tile([300, 300, np.nan, 90], (5, 1))), "the middle of no image"),
    "another layout": (lambda f: vipe(f, pose=np.ones((5, 3, 4))), "not as ViPE writes it"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_cameras_are_refused_in_one_line(scene: Scene, tmp_path: Path, name: str):
    spoil, message = BAD[name]
    folder = vipe(tmp_path / "vipe")
    spoil(folder)
    with pytest.raises(InputError, match=message) as caught:
        read_cameras(folder, scene, False)
    assert "\n" not in str(caught.value)


def whole_numbers() -> bytes:
    return write_exr(np.ones((9, 16))).replace(b"Z\0\1", b"Z\0\0")


BAD_MAPS = {
    "depth of another program": (lambda f: spoil_zip(f, "depth", "{:05d}.exr", b"no"), "no depth that can be read here"),
    "depth of whole numbers": (lambda f: spoil_zip(f, "depth", "{:05d}.exr", whole_numbers()), "not one channel of half or float"),
    "depth that is cut off": (lambda f: spoil_zip(f, "depth", "{:05d}.exr", write_exr(np.ones((90, 160)))[:-9]), "can be read"),
    "depth packed otherwise": (
        lambda f: spoil_zip(f, "depth", "{:05d}.exr", write_exr(np.ones((90, 160))).replace(
            b"compression\0\1\0\0\0\3", b"compression\0\1\0\0\0\4")), "another way than ZIP"
    ),
    "no depth": (lambda f: spoil_zip(f, "depth", "{}.txt", b""), "holds no 00000.exr: give depth for every training frame"),
    "no zip": (lambda f: write(f / "depth" / "clip.zip", "no"), "no zip file"),
    "masks that are none": (lambda f: spoil_zip(f, "mask", "{:05d}.png", b"no"), "no readable mask"),
    "labels that are none": (lambda f: write(f / "mask" / "clip.txt", "sky\n"), "its lines are not number"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_MAPS)
def test_bad_depth_and_masks_are_refused_in_one_line(scene: Scene, tmp_path: Path, name: str):
    spoil, message = BAD_MAPS[name]
    folder = vipe(tmp_path / "vipe")
    spoil(folder)
    given = GivenPriors(masks=folder) if "mask" in name or "label" in name else GivenPriors(depth=folder)
    with pytest.raises(InputError, match=message) as caught:
        use_given(scene, given)
    assert "\n" not in str(caught.value)


@pytest.mark.skipif("FLOWSPLAT_DATA" not in os.environ, reason="needs FLOWSPLAT_DATA")
def test_real_cameras_of_vipe_fit_their_clip(tmp_path: Path):
    folder = Path(os.environ["FLOWSPLAT_DATA"]) / "formats" / "vipe"
    if not folder.is_dir():
        pytest.skip("FLOWSPLAT_DATA has no results of ViPE")
    options = InputOptions(resize=320)
    ingest(open_clip(folder / "rgb" / "cosmos-example.mp4", options), tmp_path / "scene", options)
    scene = Scene(tmp_path / "scene")
    assert compute_misfit(read_cameras(folder, scene, False).cameras, match_frames(scene)) < 0.1
