"""Cameras in the layouts of others, written exactly as their code writes them, are our cameras again."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.given.cameras import read_cameras
from flowsplat.priors.prepare import use_given
from flowsplat.scenes import Scene

SIZE = (854, 480)
FRAMES = 5
FULL = (1920, 1080)
"""The images that others were given: twice and a bit as large as the working size."""


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene.create(
        tmp_path / "scene", name="s", source="", width=SIZE[0], height=SIZE[1], timestamps=range(FRAMES), holdout=3, source_fps=1
    )


def path(size: tuple[int, int] = FULL) -> list[Camera]:
    width, height = size
    K = np.array([[0.9 * width, 0, 0.51 * width], [0, 0.92 * width, 0.48 * height], [0, 0, 1]])
    cameras = []
    for i in range(FRAMES):
        viewmat = np.eye(4)
        viewmat[:3, :3] = Rotation.from_rotvec([0.1, -0.2 * i, 0.05 * i]).as_matrix()
        viewmat[:3, 3] = [0.3 * i, -0.1, 0.2 * i]
        cameras.append(Camera(viewmat, K, width, height))
    return cameras


def check(scene: Scene, file: Path, maker: str, tolerance: float = 1e-6, allow_pickle: bool = False) -> None:
    given = read_cameras(file, scene, allow_pickle)
    found, who = given.cameras, given.maker
    assert given.told == ""
    assert who == maker
    assert len(found) == FRAMES
    for camera, true in zip(found, path(), strict=True):
        expected = true.resize(*SIZE)
        assert (camera.width, camera.height) == SIZE
        np.testing.assert_allclose(camera.viewmat, expected.viewmat, atol=tolerance)
        np.testing.assert_allclose(camera.K, expected.K, rtol=tolerance * 100 if tolerance > 1e-6 else 1e-6, atol=1e-6)


def transforms(**common: object) -> dict:
    frames = []
    for i, camera in enumerate(path()):
        c2w = np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"images/frame_{i + 1}.png", "transform_matrix": c2w.tolist()})
    K = path()[0].K
    return {
        "camera_model": "OPENCV", "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": FULL[0], "h": FULL[1],
        "frames": frames, **common,
    }  # fmt: skip


def test_nerfstudio(scene: Scene, tmp_path: Path):
    content = transforms(k1=0.0, k2=1e-9)
    content["frames"] = content["frames"][::-1]
    content["frames"][2]["transform_matrix"] = content["frames"][2]["transform_matrix"][:3]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    check(scene, tmp_path / "transforms.json", "nerfstudio")
    check(scene, tmp_path, "nerfstudio")


def test_nerfstudio_in_the_order_of_times_with_cameras_of_their_own(scene: Scene, tmp_path: Path):
    content = transforms()
    for i, frame in enumerate(content["frames"]):
        frame.update(time=i / 4, fl_x=content["fl_x"], file_path=f"{9 - i}.png")
    del content["fl_x"]
    content["frames"] = [content["frames"][i] for i in (3, 0, 4, 1, 2)]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    check(scene, tmp_path / "transforms.json", "nerfstudio")


def quat(camera: Camera) -> list[float]:
    x, y, z, w = Rotation.from_matrix(camera.viewmat[:3, :3]).as_quat()
    return [w, x, y, z]


def colmap_text(folder: Path, model: str = "PINHOLE", parameters: tuple[float, ...] | None = None) -> None:
    K = path()[0].K
    values = parameters or (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 {model} {FULL[0]} {FULL[1]} {' '.join(map(str, values))}\n"
    )
    lines = ["# Image list with two lines of data per image:", "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    for i in (4, 1, 0, 3, 2):
        camera = path()[i]
        pose = " ".join(map(str, [*quat(camera), *camera.viewmat[:3, 3]]))
        lines += [f"{i + 1} {pose} 1 frame {i + 1}.png", "12.5 8.25 -1 100.5 50.25 7" if i != 3 else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")


def colmap_binary(folder: Path, model: int = 1) -> None:
    K = path()[0].K
    folder.mkdir(parents=True)
    values = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, model, *FULL, *values))
    data = struct.pack("<Q", FRAMES)
    for i in (2, 0, 4, 1, 3):
        camera = path()[i]
        data += struct.pack("<i7di", i + 1, *quat(camera), *camera.viewmat[:3, 3], 1) + f"{i:05d}.jpg".encode() + b"\0"
        data += struct.pack("<Q", i) + b"".join(struct.pack("<ddq", 1.0, 2.0, -1) for _ in range(i))
    (folder / "images.bin").write_bytes(data)


@pytest.mark.parametrize("place", ["", "sparse/0", "colmap/sparse/0"])
def test_colmap_in_text(scene: Scene, tmp_path: Path, place: str):
    colmap_text(tmp_path / "model" / place)
    check(scene, tmp_path / "model", "COLMAP")


def test_colmap_in_binary(scene: Scene, tmp_path: Path):
    colmap_binary(tmp_path / "model" / "sparse" / "0")
    check(scene, tmp_path / "model", "COLMAP")


def test_colmap_with_one_focal_length_and_hardly_any_distortion(scene: Scene, tmp_path: Path):
    colmap_text(tmp_path / "model", "SIMPLE_RADIAL", (1700.0, 960.0, 540.0, 1e-4))
    cameras = read_cameras(tmp_path / "model", scene, False).cameras
    expected = Camera(np.eye(4), np.array([[1700, 0, 960], [0, 1700, 540], [0, 0, 1]]), *FULL).resize(*SIZE)
    np.testing.assert_allclose(cameras[2].K, expected.K)


def slam_intrinsics() -> tuple[tuple[int, int], tuple[int, int], np.ndarray]:
    """DROID-SLAM's image before and after its crop, and K in its pixels (``image_stream`` of its demo.py)."""
    w0, h0 = FULL
    h1, w1 = int(h0 * np.sqrt((384 * 512) / (h0 * w0))), int(w0 * np.sqrt((384 * 512) / (h0 * w0)))
    K = path()[0].K.copy()
    K[0] *= w1 / w0
    K[1] *= h1 / h0
    return (w1, h1), (w1 - w1 % 8, h1 - h1 % 8), K


def megasam(file: Path, frames: int = FRAMES, **change: object) -> None:
    _, (width, height), K = slam_intrinsics()
    arrays = {
        "images": np.zeros((frames, height, width, 3), np.uint8),
        "depths": np.full((frames, height, width), 2, np.float16),
        "intrinsic": K,
        "cam_c2w": np.stack([np.linalg.inv(camera.viewmat) for camera in path()[:frames]]).astype(np.float32),
    }
    np.savez(file, **{**arrays, **change})


def test_megasam(scene: Scene, tmp_path: Path):
    megasam(tmp_path / "clip_sgd_cvd_hr.npz")
    check(scene, tmp_path / "clip_sgd_cvd_hr.npz", "MegaSaM", 2e-5)


def droid(file: Path) -> None:
    _, (width, height), K = slam_intrinsics()
    content = {
        "tstamps": np.array([0.0, 2, 4]),
        "images": np.zeros((3, height // 8, width // 8, 3)),
        "map_c2w": np.zeros((3, 4, 4)),
        "traj_c2w": np.stack([np.linalg.inv(camera.viewmat) for camera in path()]).astype(np.float32),
        "intrinsics": (np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]) / 8).astype(np.float32),
        "img_shape": (height // 8, width // 8),
    }
    np.save(file, np.array(content))


def test_droid_slam_is_read_only_where_pickles_are_allowed(scene: Scene, tmp_path: Path):
    droid(tmp_path / "clip.npy")
    with pytest.raises(InputError, match=r"is a pickle.*--given.allow-pickle"):
        read_cameras(tmp_path / "clip.npy", scene, False)
    check(scene, tmp_path / "clip.npy", "DROID-SLAM", 2e-5, allow_pickle=True)


def test_given_cameras_are_the_prior_and_say_from_whom(scene: Scene, tmp_path: Path):
    megasam(tmp_path / "clip.npz")
    use_given(scene, GivenPriors(cameras=tmp_path / "clip.npz"))
    assert scene.prior("cameras") == {"method": "given", "verdict": f"from {tmp_path / 'clip.npz'} (MegaSaM)"}
    assert len(scene.cameras) == FRAMES


def edited(content: dict, **change: object) -> str:
    return json.dumps({**content, **change})


BAD: dict[str, tuple[Callable[[Path], Path], str]] = {
    "nothing": (lambda f: f / "none.json", "does not exist"),
    "a folder of nothing": (lambda f: f, "transforms.json, a COLMAP model .*MegaSaM"),
    "text": (lambda f: write(f / "cameras.txt", "1"), "no cameras of a known layout"),
    "no lens": (lambda f: write(f / "transforms.json", edited(transforms(k1=-1e6))), "a lens that cannot be: no pinhole"),
    "another fisheye": (lambda f: write(f / "transforms.json", edited(transforms(camera_model="FISHEYE624"))), "FISHEYE624: und"),
    "a panorama": (lambda f: write(f / "transforms.json", edited(transforms(camera_model="EQUIRECTANGULAR"))), "not known here, E"),
    "too few": (
        lambda f: write(f / "transforms.json", edited(transforms(), frames=transforms()["frames"][:3])), "holds 3 frames.*5 frames"
    ),
    "no pose": (lambda f: write(f / "transforms.json", edited(transforms(), frames=[{"file_path": "a"}] * 5)), "transform_matrix"),
    "no focal length": (
        lambda f: write(f / "transforms.json", json.dumps({k: v for k, v in transforms().items() if k != "fl_x"})), "camera_angle_x"
    ),
    "a negative focal length": (lambda f: write(f / "transforms.json", edited(transforms(), fl_x=-5)), "fl_x is -5"),
    "no rotation": (
        lambda f: write(f / "transforms.json", edited(transforms(), frames=[
            {"file_path": "a", "transform_matrix": (2 * np.eye(4)).tolist()}] * 5)), "frame 0 is not finite or"
    ),
    "another shape": (lambda f: write(f / "transforms.json", edited(transforms(), w=1000, h=1000)), "another shape"),
    "COLMAP's FOV": (lambda f: colmap(f / "m", "FOV", (1.0, 1, 1, 1, 0.5)), "FOV is no pinhole: undistort"),
    "COLMAP's thin prism": (
        lambda f: colmap(f / "m", "THIN_PRISM_FISHEYE", (1.0,) * 12), "THIN_PRISM_FISHEYE is no pinhole: undistort"
    ),
    "COLMAP's fisheye without a middle": (
        lambda f: colmap(f / "m", "OPENCV_FISHEYE", (1.0, 1, -9, 1, 0, 0, 0, 0)), "a lens that cannot be: no pinhole"
    ),
    "COLMAP's lens of no number": (
        lambda f: colmap(f / "m", "SIMPLE_RADIAL", (1700.0, 960.0, 540.0, float("nan"))), "a lens that cannot be: no pinhole"
    ),
    "COLMAP, short": (lambda f: colmap(f / "m", "PINHOLE", (1.0, 2.0)), "no readable COLMAP model"),
    "COLMAP, truncated": (lambda f: cut(f / "m"), "no readable COLMAP model"),
    "COLMAP's binary thin prism": (lambda f: binary(f / "m", 10), "number 10 is no pinhole"),
    "MegaSaM of other frames": (lambda f: sam(f / "a.npz", frames=4), "holds 4 cameras"),
    "MegaSaM of another clip": (lambda f: sam(f / "a.npz", depths=np.ones((5, 384, 512), np.float32)), "another shape"),
    "MegaSaM without cameras": (lambda f: archive(f / "a.npz"), "no cameras of a known layout"),
    "a damaged pickle": (lambda f: write(f / "a.npy", "no"), "does not hold traj_c2w|is damaged"),
}  # fmt: skip


def write(file: Path, text: str) -> Path:
    file.write_text(text)
    return file


def colmap(folder: Path, model: str, parameters: tuple[float, ...]) -> Path:
    colmap_text(folder, model, parameters)
    return folder


def binary(folder: Path, model: int) -> Path:
    colmap_binary(folder, model)
    return folder


def cut(folder: Path) -> Path:
    colmap_binary(folder)
    (folder / "images.bin").write_bytes((folder / "images.bin").read_bytes()[:-40])
    return folder


def sam(file: Path, **change: object) -> Path:
    megasam(file, **change)
    return file


def archive(file: Path) -> Path:
    np.savez(file, depth=np.ones(3))
    return file


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line(scene: Scene, tmp_path: Path, name: str):
    make, message = BAD[name]
    with pytest.raises(InputError, match=message) as caught:
        read_cameras(make(tmp_path), scene, True)
    assert "\n" not in str(caught.value)


def test_a_line_of_a_colmap_text_that_is_cut_off_is_no_image(scene: Scene, tmp_path: Path):
    colmap_text(tmp_path / "sparse")
    images = tmp_path / "sparse" / "images.txt"
    lines = images.read_text().splitlines()
    lines[2] = "5 1.0 0.0 0.0 0.0 0.1 0.2 1 a.png"
    images.write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"the pose of .* has .* numbers, not 7"):
        read_cameras(tmp_path, scene, False)
