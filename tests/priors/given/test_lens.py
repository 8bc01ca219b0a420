"""A lens that comes with given cameras is taken out of the images, and of whatever else lies in them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.geometry.lens import Distortion, Lens
from flowsplat.priors.cameras import straightening
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.given.camera_check import compute_misfit, match_frames
from flowsplat.priors.given.cameras import read_cameras
from flowsplat.priors.given.depth import open_depth
from flowsplat.priors.given.flow import read_flow
from flowsplat.priors.given.tracks import read_tracks
from flowsplat.priors.given.truth import consecutive_pairs
from flowsplat.priors.prepare import use_given
from flowsplat.scenes import Scene
from tests.priors.test_nasty_clips import ROOM, World, travel

FRAMES, SIZE, CALIBRATED = 12, (256, 160), (1024, 640)
"""The clip, and the size of the images that others saw, four times as large."""
OPENCV = Distortion((-0.3, 0.08, 0.004, -0.003))
FISHEYE = Distortion((0.02, -0.01, 0.002, 0.0), is_fisheye=True)


def K_of(size: tuple[int, int]) -> np.ndarray:
    """A longer lens than that of ``travel``, so that all that it shows is in its images."""
    return np.diag([size[0], size[0], 1]) @ np.array([[1.3, 0, 0.515], [0, 1.32, 0.305], [0, 0, 1]])


def bend(image: np.ndarray, K: np.ndarray, distortion: Distortion) -> np.ndarray:
    """Return what a lens shows of what a pinhole with ``K`` sees; numbers [H, W] stay what they are."""
    height, width = image.shape[:2]
    lens = K_of((width, height))
    x = distortion.straighten((pixel_grid(width, height) - lens[:2, 2]) / lens[[0, 1], [0, 1]])
    source = (x * K[[0, 1], [0, 1]] + K[:2, 2] - 0.5).astype(np.float32)
    assert ((source >= -0.5) & (source <= [width - 0.5, height - 0.5])).all()
    method = cv2.INTER_NEAREST if image.ndim == 2 else cv2.INTER_CUBIC
    return cv2.remap(image, source, None, method, borderMode=cv2.BORDER_REPLICATE)


def zoom_to(image: np.ndarray, K: np.ndarray, camera: Camera) -> np.ndarray:
    """Return what ``camera``, at the same place, sees of what a pinhole with ``K`` does."""
    grid = (pixel_grid(camera.width, camera.height) - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    source = (grid * K[[0, 1], [0, 1]] + K[:2, 2] - 0.5).astype(np.float32)
    return cv2.remap(
        image, source, None, cv2.INTER_NEAREST if image.ndim == 2 else cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    return travel(FRAMES, way=1.5, size=SIZE)


@pytest.fixture(scope="module")
def images(cameras: list[Camera]) -> list[np.ndarray]:
    world = World(ROOM, width=SIZE[0])
    return [world.image(camera) for camera in cameras]


@pytest.fixture(scope="module")
def bent(cameras: list[Camera], images: list[np.ndarray]) -> list[np.ndarray]:
    """What a camera with the lens ``OPENCV`` takes."""
    return [bend(image, cameras[0].K, OPENCV) for image in images]


def mask_of(i: int) -> np.ndarray:
    """Stripes, whose edges are everywhere."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    return np.where((x + y + 3 * i) % 24 < 8, 3, 0).astype(np.uint8)


def make_scene(folder: Path, frames: Sequence[np.ndarray], masks: Sequence[np.ndarray] = ()) -> Scene:
    height, width = frames[0].shape[:2]
    scene = Scene.create(
        folder, name="clip", source="", width=width, height=height, timestamps=range(len(frames)), holdout=5, source_fps=1
    )
    for i, frame in enumerate(frames):
        scene.write_frame(i, frame)
    for i, mask in enumerate(masks):
        (scene if i in scene.train_frames else scene.heldout_masks).write_mask(i, mask)
    if masks:
        scene.finish_prior("masks", method="given")
    return scene


def transforms(file: Path, cameras: Sequence[Camera], distortion: Distortion, **more: object) -> Path:
    """As nerfstudio writes it."""
    K = K_of(CALIBRATED)
    names = ("k1", "k2", "k3", "k4") if distortion.is_fisheye else ("k1", "k2", "p1", "p2", "k3")
    poses = [np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1]) for camera in cameras]
    frames = [{"file_path": f"images/frame_{i + 1:05d}.png", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    values = {
        "camera_model": "OPENCV_FISHEYE" if distortion.is_fisheye else "OPENCV", "w": CALIBRATED[0], "h": CALIBRATED[1],
        "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], **dict(zip(names, distortion.coefficients, strict=False)),
        "frames": frames, **more,
    }  # fmt: skip
    file.parent.mkdir(exist_ok=True)
    file.write_text(json.dumps(values))
    return file


def colmap(folder: Path, cameras: Sequence[Camera], models: Sequence[tuple[str, Sequence[float]]]) -> Path:
    """As COLMAP writes a model as text; cameras, one a frame or one for all."""
    folder.mkdir(exist_ok=True)
    lines = [
        f"{k + 1} {name} {CALIBRATED[0]} {CALIBRATED[1]} {' '.join(map(repr, map(float, values)))}"
        for k, (name, values) in enumerate(models)
    ]
    (folder / "cameras.txt").write_text("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + "\n".join(lines) + "\n")
    lines = []
    for i, camera in enumerate(cameras):
        x, y, z, w = Rotation.from_matrix(camera.viewmat[:3, :3]).as_quat()
        pose = " ".join(map(repr, map(float, (w, x, y, z, *camera.viewmat[:3, 3]))))
        lines += [f"{i + 1} {pose} {i + 1 if len(models) > 1 else 1} frame_{i + 1:05d}.png", ""]
    (folder / "images.txt").write_text("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n" + "\n".join(lines) + "\n")
    return folder


def parameters(distortion: Sequence[float], K: np.ndarray | None = None) -> list[float]:
    K = K_of(CALIBRATED) if K is None else K
    return [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion]


Give = Callable[[Path, list[Camera]], Path]
GIVE: dict[str, tuple[Distortion, Give]] = {
    "nerfstudio": (OPENCV, lambda folder, cameras: transforms(folder / "transforms.json", cameras, OPENCV)),
    "COLMAP": (OPENCV, lambda folder, cameras: colmap(folder / "m", cameras, [("OPENCV", parameters(OPENCV.coefficients))])),
    "nerfstudio's fisheye": (FISHEYE, lambda folder, cameras: transforms(folder / "transforms.json", cameras, FISHEYE)),
    "COLMAP's fisheye": (
        FISHEYE, lambda folder, cameras: colmap(folder / "m", cameras, [("OPENCV_FISHEYE", parameters(FISHEYE.coefficients))])
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", GIVE)
def test_frames_and_masks_are_straightened_for_the_cameras(tmp_path: Path, cameras, images, name: str):
    distortion, give = GIVE[name]
    bent = [bend(image, cameras[0].K, distortion) for image in images]
    scene = make_scene(tmp_path / "scene", bent, [bend(mask_of(i), cameras[0].K, distortion) for i in range(FRAMES)])
    use_given(scene, GivenPriors(cameras=give(tmp_path, cameras)))
    verdict = scene.prior("cameras")["verdict"]
    assert "miss the images by 0.0" in verdict
    assert "the lens moved points of the border by up to" in verdict
    assert "frames and given masks were straightened" in verdict
    assert "were straightened" in scene.info.notes[-1]
    assert compute_misfit(scene.cameras, match_frames(scene)) < 0.15
    lens = scene.lens
    for i, (camera, true) in enumerate(zip(scene.cameras, cameras, strict=True)):
        np.testing.assert_allclose(camera.viewmat, true.viewmat, atol=1e-9)
        np.testing.assert_allclose(camera.K, lens.pinhole, rtol=1e-12)
        expected, difference = zoom_to(images[i], true.K, camera), zoom_to(bent[i], K_of(SIZE), camera)
        off = np.abs(scene.any_frame(i).astype(float) - expected).mean()
        assert off < 0.8
        assert off < 0.1 * np.abs(difference.astype(float) - expected).mean()
        assert (mask_in(scene, i) != zoom_to(mask_of(i), true.K, camera)).mean() < 0.04
        assert set(np.unique(mask_in(scene, i))) == {0, 3}


def test_the_rendered_workshop(tmp_path: Path):
    if "FLOWSPLAT_DATA" not in os.environ:
        pytest.skip("FLOWSPLAT_DATA is not set")
    folder = Path(os.environ["FLOWSPLAT_DATA"]) / "rig" / "workshop"
    truth = json.loads((folder / "cameras.json").read_text())
    size = 240, 135
    cameras = [Camera(np.array(m), np.array(truth["K"]), truth["width"], truth["height"]).resize(*size) for m in truth["w2c"][::4]]
    paths = sorted((folder / "rgb").glob("*.png"))[::4]
    images = [cv2.resize(cv2.imread(str(path))[..., ::-1], size, interpolation=cv2.INTER_AREA) for path in paths]
    scene = make_scene(tmp_path / "scene", [bend(image, cameras[0].K, OPENCV) for image in images])
    large = 1920, 1080
    K = K_of(large)
    own = {"w": large[0], "h": large[1], "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    use_given(scene, GivenPriors(cameras=transforms(tmp_path / "transforms.json", cameras, OPENCV, **own)))
    assert "miss the images by 0.0" in scene.prior("cameras")["verdict"]
    for i, (camera, true) in enumerate(zip(scene.cameras, cameras, strict=True)):
        # A point of the scene lies where the true camera says, in the straightened image.
        rays = true.unproject(np.array([[60.0, 40], [120, 70], [180, 100]]), np.array([3.0, 5, 4]))
        there = (true.project(rays)[0] - true.K[:2, 2]) / true.K[[0, 1], [0, 1]] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
        np.testing.assert_allclose(camera.project(rays)[0], there, atol=1e-6)
        expected = zoom_to(images[i], true.K, camera).astype(float)
        assert np.abs(scene.any_frame(i) - expected)[2:-2, 2:-2].mean() < 0.7


# -- what else lies in the images


@pytest.fixture
def straightened(tmp_path: Path, cameras, bent) -> Scene:
    scene = make_scene(tmp_path / "scene", bent)
    use_given(scene, GivenPriors(cameras=transforms(tmp_path / "transforms.json", cameras, OPENCV)))
    return scene


def show(lens: Lens, points: np.ndarray) -> np.ndarray:
    """Where the images as they came have ``points`` [..., 2] of the straightened ones."""
    x = (points - lens.pinhole[:2, 2]) / lens.pinhole[[0, 1], [0, 1]]
    return lens.distortion.bend(x) * lens.K[[0, 1], [0, 1]] + lens.K[:2, 2]


def test_given_depth_is_straightened(straightened: Scene, tmp_path: Path):
    lens, grid = straightened.lens, pixel_grid(*SIZE).astype(np.float64)
    there = lens.straighten_positions(grid)
    (tmp_path / "depth").mkdir()
    for i in range(FRAMES):
        bent = (2 + there[..., 0] / 100).astype(np.float32)
        bent[:, :40] = np.nan
        np.save(tmp_path / "depth" / f"{i:05d}.npy", bent)
    found = open_depth(tmp_path / "depth", straightened).read(0)
    known = found.confidence > 0
    assert np.abs(found.depth - (2 + grid[..., 0] / 100))[known].max() < 0.015
    edge = lens.straighten_positions(np.array([40.0, 80]))[0]
    assert np.flatnonzero(known[80])[0] == pytest.approx(edge, abs=1)


def test_given_flow_and_tracks_are_straightened(straightened: Scene, tmp_path: Path):
    lens, grid = straightened.lens, pixel_grid(*SIZE).astype(np.float64)
    (tmp_path / "flow").mkdir()
    for i, j in consecutive_pairs(straightened):
        flow = show(lens, lens.straighten_positions(grid) + [5, 3]) - grid
        np.savez(
            tmp_path / "flow" / f"{i:05d}_{j:05d}.npz", flow=flow.astype(np.float32), confidence=np.ones(SIZE[::-1], np.float32)
        )
    flow = read_flow(tmp_path / "flow", straightened)[0][0]
    assert np.abs(flow.flow - [5, 3])[flow.trusted].max() < 0.1
    assert flow.trusted[:, :-6].mean() > 0.95
    assert not flow.trusted[:, -4:].any()
    straight = np.array([[30.0, 40], [200, 120]])[:, None] + 2.0 * np.arange(FRAMES)[None, :, None]
    np.savez(tmp_path / "t.npz", tracks=show(lens, straight) - 0.5, visibles=np.ones((2, FRAMES), bool))
    tracks = read_tracks(tmp_path / "t.npz", straightened, None)
    seen = [i for i in range(FRAMES) if i not in straightened.heldout_frames]
    np.testing.assert_allclose(tracks.points[:, seen], straight[:, seen], atol=1e-3)
    np.testing.assert_array_equal(tracks.confidence[:, seen], 1)


def write_masks(folder: Path, camera: Camera) -> Path:
    folder.mkdir()
    for i in range(FRAMES):
        cv2.imwrite(str(folder / f"{i:05d}.png"), bend(mask_of(i), camera.K, OPENCV))
    return folder


# -- once, and only once


def mask_in(scene: Scene, i: int) -> np.ndarray:
    return (scene if i in scene.train_frames else scene.heldout_masks).mask(i)


def require_same(scene: Scene, other: Scene) -> None:
    for i in range(FRAMES):
        np.testing.assert_array_equal(scene.any_frame(i), other.any_frame(i))
        np.testing.assert_array_equal(mask_in(scene, i), mask_in(other, i))
    for camera, expected in zip(scene.cameras, other.cameras, strict=True):
        np.testing.assert_array_equal(camera.K, expected.K)


def test_the_same_files_again_straighten_nothing_twice(tmp_path: Path, cameras, bent):
    masks = write_masks(tmp_path / "masks", cameras[0])
    given = GivenPriors(cameras=transforms(tmp_path / "transforms.json", cameras, OPENCV), masks=masks)
    once, again = make_scene(tmp_path / "once", bent), make_scene(tmp_path / "again", bent)
    use_given(once, given)
    for i in range(FRAMES):
        expected = zoom_to((mask_of(i) > 0).astype(np.uint8), cameras[i].K, once.cameras[i])
        assert ((mask_in(once, i) > 0) != expected).mean() < 0.04
    use_given(again, given)
    use_given(Scene(again.folder), given)
    require_same(Scene(again.folder), once)
    assert len(Scene(again.folder).info.notes) == 1


def test_straightening_goes_on_after_a_kill(tmp_path: Path, cameras, bent, monkeypatch: pytest.MonkeyPatch):
    masks = write_masks(tmp_path / "masks", cameras[0])
    given = GivenPriors(cameras=transforms(tmp_path / "transforms.json", cameras, OPENCV), masks=masks)
    once, scene = make_scene(tmp_path / "once", bent), make_scene(tmp_path / "killed", bent)
    use_given(once, given)

    def dying(*_: object) -> None:
        raise KeyboardInterrupt

    for name in ("replace_images", "describe_lens"):  # before the images are replaced, and after, before that is noted
        with monkeypatch.context() as patch:
            patch.setattr(straightening, name, dying)
            with pytest.raises(KeyboardInterrupt):
                use_given(Scene(scene.folder), given)
        assert Scene(scene.folder).prior("cameras") is None
    use_given(Scene(scene.folder), given)
    require_same(Scene(scene.folder), once)


# -- whose lens it is


def check_lens(file: Path, cameras: Sequence[Camera], folder: Path, distortion: Distortion, K: np.ndarray | None = None) -> None:
    scene = Scene.create(
        folder, name="s", source="", width=SIZE[0], height=SIZE[1], timestamps=range(len(cameras)), holdout=5, source_fps=1
    )
    given = read_cameras(file, scene, False)
    assert given.lens is not None
    assert given.lens.distortion.is_fisheye is distortion.is_fisheye
    np.testing.assert_allclose(given.lens.distortion.array, distortion.array, atol=1e-12)
    np.testing.assert_allclose(given.lens.K, K_of(SIZE) if K is None else K, rtol=1e-9)
    for camera in given.cameras:
        assert (camera.width, camera.height) == SIZE
        np.testing.assert_allclose(camera.K, given.lens.pinhole, rtol=1e-9)


f, cx, cy = 1331.0, 527.0, 312.0
MODELS = {
    "SIMPLE_RADIAL": ((f, cx, cy, -0.1), Distortion((-0.1, 0, 0, 0))),
    "RADIAL": ((f, cx, cy, -0.1, 0.02), Distortion((-0.1, 0.02, 0, 0))),
    "OPENCV": ((f, f, cx, cy, -0.1, 0.02, 0.001, 0.002), Distortion((-0.1, 0.02, 0.001, 0.002))),
    "FULL_OPENCV": (
        (f, f, cx, cy, -0.1, 0.02, 0.001, 0.002, 0.01, 0.02, 0.03, 0.04),
        Distortion((-0.1, 0.02, 0.001, 0.002, 0.01, 0.02, 0.03, 0.04)),
    ),
    "OPENCV_FISHEYE": ((f, f, cx, cy, 0.01, 0.02, 0.03, 0.04), Distortion((0.01, 0.02, 0.03, 0.04), True)),
    "SIMPLE_RADIAL_FISHEYE": ((f, cx, cy, 0.01), Distortion((0.01, 0, 0, 0), True)),
    "RADIAL_FISHEYE": ((f, cx, cy, 0.01, 0.02), Distortion((0.01, 0.02, 0, 0), True)),
}


@pytest.mark.parametrize("model", MODELS)
def test_models_of_colmap(tmp_path: Path, cameras, model: str):
    values, distortion = MODELS[model]
    K = np.diag([0.25, 0.25, 1]) @ [[f, 0, cx], [0, f, cy], [0, 0, 1]]
    check_lens(colmap(tmp_path / "m", cameras, [(model, values)]), cameras, tmp_path / "scene", distortion, K)


def test_lenses_of_nerfstudio_and_instant_ngp(tmp_path: Path, cameras):
    five = Distortion((-0.14, 0.03, 0.002, -0.001, 0.004))
    check_lens(transforms(tmp_path / "a.json", cameras, five), cameras, tmp_path / "a", five)
    check_lens(transforms(tmp_path / "b.json", cameras, FISHEYE), cameras, tmp_path / "b", FISHEYE)
    ngp = transforms(tmp_path / "c.json", cameras, FISHEYE)
    ngp.write_text(json.dumps({**json.loads(ngp.read_text()), "camera_model": None, "is_fisheye": True}))
    check_lens(ngp, cameras, tmp_path / "c", FISHEYE)


def test_frames_may_lack_cameras(tmp_path: Path, cameras, bent):
    scene = make_scene(tmp_path / "scene", bent)
    file = transforms(tmp_path / "transforms.json", cameras, OPENCV)
    values = json.loads(file.read_text())
    del values["frames"][4]
    file.write_text(json.dumps(values))
    use_given(scene, GivenPriors(cameras=file))
    assert "1 frames that it lacks are interpolated; they miss the images by 0.0" in scene.prior("cameras")["verdict"]
    np.testing.assert_allclose(scene.cameras[4].K, scene.lens.pinhole)


def calibrated_one_by_one(cameras: Sequence[Camera], spread: float) -> list[tuple[str, list[float]]]:
    rng = np.random.default_rng(0)
    return [
        ("OPENCV", parameters(np.array(OPENCV.coefficients) * (1 + spread * rng.normal(size=4)), K_of(CALIBRATED) * np.array(
            [[1 + spread * rng.normal()] * 3, [1 + spread * rng.normal()] * 3, [1, 1, 1]])))
        for _ in cameras
    ]  # fmt: skip


def test_frames_calibrated_one_by_one_have_one_lens_where_they_hardly_differ(tmp_path: Path, cameras, bent):
    scene = make_scene(tmp_path / "scene", bent)
    use_given(scene, GivenPriors(cameras=colmap(tmp_path / "m", cameras, calibrated_one_by_one(cameras, 0.002))))
    assert "miss the images by 0." in scene.prior("cameras")["verdict"]
    for camera in scene.cameras:
        np.testing.assert_allclose(camera.K, scene.lens.pinhole, rtol=0.01)


def test_a_small_distortion_stays(tmp_path: Path, cameras, images):
    scene = make_scene(tmp_path / "scene", images)
    small = Distortion((0.01, 0, 0, 0))
    before = scene.any_frame(0)
    assert read_cameras(transforms(tmp_path / "a.json", cameras, small), scene, False).lens is None
    np.testing.assert_array_equal(scene.any_frame(0), before)


def refuse(scene: Scene, file: Path, message: str) -> None:
    before = scene.any_frame(0)
    with pytest.raises(InputError, match=message) as caught:
        use_given(scene, GivenPriors(cameras=file))
    assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(Scene(scene.folder).any_frame(0), before)


def test_what_cannot_be_straightened_is_refused_in_one_line(tmp_path: Path, cameras, images):
    scene = make_scene(tmp_path / "scene", images)
    refuse(scene, colmap(tmp_path / "m", cameras, calibrated_one_by_one(cameras, 0.05)), "lenses that differ by .* pixels")
    mixed = [("OPENCV", parameters(OPENCV.coefficients)), *[("OPENCV_FISHEYE", parameters(FISHEYE.coefficients))] * (FRAMES - 1)]
    refuse(scene, colmap(tmp_path / "m", cameras, mixed), "lenses of several kinds")
    file = transforms(tmp_path / "transforms.json", cameras, OPENCV)
    scene.finish_prior("flow", method="dis")
    refuse(scene, file, "Flow of clip were made for the images as they came: give cameras without a lens instead of")
    scene.forget_priors(["flow"])
    moved = [replace(camera, viewmat=np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])) for camera in cameras]
    turned = transforms(
        tmp_path / "turned.json", [replace(c, viewmat=moved[(5 * i) % FRAMES].viewmat) for i, c in enumerate(cameras)], OPENCV
    )
    refuse(scene, turned, "do not belong to these images")
    assert scene.prior("cameras") is None
    assert scene.lens is None
    scene.create_truth()
    refuse(scene, file, "clip is rendered by pinholes: give cameras without a lens")


def test_images_that_were_straightened_by_others_are_not_bent(tmp_path: Path, cameras, images):
    straight = [zoom_to(image, cameras[0].K, replace(cameras[0], K=K_of(SIZE))) for image in images]
    strong = Distortion((-0.4, 0.1, 0, 0))
    scene = make_scene(tmp_path / "scene", straight)
    refuse(scene, transforms(tmp_path / "transforms.json", cameras, strong), "images are straight already: .* Give the cameras of")
    use_given(scene, GivenPriors(cameras=transforms(tmp_path / "none.json", cameras, Distortion())))
    assert scene.lens is None


def test_images_are_straightened_for_one_lens_alone(straightened: Scene, tmp_path: Path, cameras):
    other = transforms(tmp_path / "other.json", cameras, replace(OPENCV, coefficients=(-0.1, 0.03, 0.002, -0.001)))
    refuse(straightened, other, "were straightened for another lens than that of .*other.json. Start from the clip")
    none = transforms(tmp_path / "none.json", cameras, Distortion())
    refuse(straightened, none, "were straightened for another lens")


@pytest.mark.parametrize("change", [{"K": [1, 2]}, {"distortion": "no"}, {"zoom": None}, {"width": 99_999}])
def test_a_damaged_note_of_the_lens_is_refused_in_one_line(straightened: Scene, change: dict):
    path = straightened.folder / "scene.json"
    values = json.loads(path.read_text())
    path.write_text(json.dumps({**values, "lens": {**values["lens"], **change}}))
    with pytest.raises(InputError, match="does not hold the lens of its images") as caught:
        _ = Scene(straightened.folder).lens
    assert "\n" not in str(caught.value)
