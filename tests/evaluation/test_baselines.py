import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.evaluation.baselines import HeldoutImage, predict, to_float
from flowsplat.evaluation.baselines.copy import copy_to_view
from flowsplat.evaluation.baselines.warp_by_depth import warp_by_depth
from flowsplat.evaluation.metrics import psnr
from flowsplat.evaluation.scores import score_image, summarize
from flowsplat.geometry import Camera
from flowsplat.scenes import Scene
from tests.scene_files import edited


def textured(height: int, width: int, shift: float = 0.0) -> np.ndarray:
    y, x = np.mgrid[:height, :width] + 0.0
    x = x - shift
    waves = [np.sin(x / 5 + y / 9), np.sin(x / 7 - y / 6), np.cos(x / 11 + y / 4)]
    return np.clip(127 + 90 * np.stack(waves, -1), 0, 255).astype(np.uint8)


def sliding_scene(folder: Path, timestamps: list[float], shifts: list[float]) -> Scene:
    scene = Scene.create(folder, name="slide", source="test", width=96, height=80, timestamps=timestamps, holdout=2, source_fps=1.0)
    for i, shift in enumerate(shifts):
        scene.write_frame(i, textured(80, 96, shift))
    return scene


def test_flow_interpolation_follows_the_motion_and_blend_does_not(tmp_path):
    scene = sliding_scene(tmp_path / "scene", [0.0, 1.0, 2.0], [0.0, 3.0, 6.0])
    target = to_float(scene.heldout_frame(1))[8:-8, 8:-8]
    scores = {name: psnr(image[8:-8, 8:-8], target) for name, image in predict(HeldoutImage(scene, 1)).items()}
    assert scores["copy"] < scores["blend"] < scores["flow_interpolation"]
    assert scores["flow_interpolation"] > 35


def test_the_held_out_time_sets_the_weights(tmp_path):
    scene = sliding_scene(tmp_path / "scene", [0.0, 1.0, 4.0], [0.0, 1.5, 6.0])
    predictions = predict(HeldoutImage(scene, 1))
    first, second = to_float(scene.frame(0)), to_float(scene.frame(2))
    np.testing.assert_allclose(predictions["blend"], 0.75 * first + 0.25 * second, atol=1e-6)
    np.testing.assert_array_equal(predictions["copy"], first)
    target = to_float(scene.heldout_frame(1))[8:-8, 8:-8]
    assert psnr(predictions["flow_interpolation"][8:-8, 8:-8], target) > 35


def hold_out(scene: Scene, frames: list[int]) -> Scene:
    """The same scene with another split, as other tools may have made it."""
    images = [scene.any_frame(i) for i in range(scene.num_frames)]
    scene = edited(scene, heldout=frames, train=[i for i in range(scene.num_frames) if i not in frames])
    for i, image in enumerate(images):
        scene.write_frame(i, image)
    return scene


def test_a_held_out_frame_at_either_end_is_predicted_from_its_only_neighbor(tmp_path):
    scene = sliding_scene(tmp_path / "scene", [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], [0.0, 2.0, 4.0, 6.0, 8.0, 10.0])
    scene = hold_out(scene, [0, 1, 5])
    for i, neighbor in ((0, 2), (1, 2), (5, 4)):
        predictions = predict(HeldoutImage(scene, i))
        for name in ("copy", "blend", "flow_interpolation"):
            image = predictions[name]
            np.testing.assert_array_equal(image, to_float(scene.frame(neighbor)))


def camera(x: float = 0.0, width: int = 64, height: int = 48) -> Camera:
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    return Camera(viewmat, np.array([[60.0, 0, width / 2], [0, 60, height / 2], [0, 0, 1]]), width, height)


def test_a_warp_into_the_same_camera_is_the_image():
    image = textured(48, 64)
    warped = warp_by_depth(image, np.full((48, 64), 3.0), camera(), camera())
    np.testing.assert_array_equal((warped * 255).round().astype(np.uint8), image)


def test_a_warp_of_a_wall_shifts_it_by_its_disparity():
    image = textured(48, 64)
    warped = warp_by_depth(image, np.full((48, 64), 3.0), camera(), camera(0.25))  # 60 * 0.25 / 3 = 5 pixels
    np.testing.assert_allclose(warped[:, :59], to_float(image)[:, 5:], atol=1 / 255)


def test_the_nearest_surface_wins_whatever_the_order():
    """A red bar at depth 1 slides over a blue wall at depth 10 and must hide it, from either side."""
    for x in (0.1, -0.1):  # 6 pixels at depth 1
        image = np.zeros((48, 64, 3), np.uint8)
        image[..., 2] = 255
        depth = np.full((48, 64), 10.0)
        image[:, 28:36], depth[:, 28:36] = [255, 0, 0], 1.0
        warped = warp_by_depth(image, depth, camera(), camera(x))
        start = 28 - round(60 * x)
        np.testing.assert_allclose(warped[:, start + 1 : start + 7], np.broadcast_to([1.0, 0, 0], (48, 6, 3)), atol=0.01)
        np.testing.assert_allclose(warped[:, :10, 2], 1)


def test_holes_are_filled_from_around():
    image = np.full((48, 64, 3), 200, np.uint8)
    depth = np.full((48, 64), 10.0)
    depth[:, 28:36] = 1.0
    np.testing.assert_allclose(warp_by_depth(image, depth, camera(), camera(0.2)), 200 / 255, atol=4 / 255)


def test_a_copy_has_the_size_of_the_view():
    image = textured(48, 64)
    np.testing.assert_array_equal(copy_to_view(image, camera()), to_float(image))
    assert copy_to_view(image, camera(0, 32, 24)).shape == (24, 32, 3)


# -- the published figures of simple tools, on real data


def data_folder(name: str) -> Path:
    root = os.environ.get("FLOWSPLAT_DATA")
    if not root:
        pytest.skip("FLOWSPLAT_DATA is not set: the data to measure with is elsewhere")
    folder = Path(root) / name
    if not folder.exists():
        pytest.skip(f"{folder} does not exist")
    return folder


def read_rgb(path: Path) -> np.ndarray:
    return np.ascontiguousarray(cv2.imread(str(path))[..., ::-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("clip", "expected"),
    [
        ("bear", {"copy": (19.41, 0.364), "blend": (21.23, 0.419), "flow_interpolation": (30.86, 0.928)}),
        ("train", {"copy": (18.10, 0.364), "blend": (20.08, 0.415), "flow_interpolation": (26.08, 0.805)}),
    ],
)
def test_predicting_held_out_frames_of_davis(tmp_path, clip, expected):
    paths = sorted((data_folder("davis") / clip / "images").glob("*.jpg"))
    height, width = read_rgb(paths[0]).shape[:2]
    times = [i / 24 for i in range(len(paths))]
    scene = Scene.create(
        tmp_path, name=clip, source="DAVIS", width=width, height=height, timestamps=times, holdout=10, source_fps=24
    )
    scores: dict[str, list] = {name: [] for name in expected}
    for i in scene.heldout_frames:
        for k in (i - 1, i, i + 1):
            scene.write_frame(k, read_rgb(paths[k]))
        target = to_float(scene.heldout_frame(i))
        for name, image in predict(HeldoutImage(scene, i)).items():
            scores[name].append(score_image(image, target, {}, None))
    for name, (expected_psnr, expected_ssim) in expected.items():
        figures = summarize(scores[name])
        assert figures["psnr"] == pytest.approx(expected_psnr, abs=0.1)
        assert figures["ssim"] == pytest.approx(expected_ssim, abs=0.005)


@pytest.mark.slow
def test_predicting_held_out_views_of_the_workshop():
    folder = data_folder("rig") / "workshop"
    clip = json.loads((folder / "cameras.json").read_text())
    heldout = json.loads((folder / "heldout" / "cameras.json").read_text())
    depth = np.load(folder / "depth.npz")["depth"].astype(np.float32)

    def as_camera(viewmat: list, values: dict) -> Camera:
        return Camera(np.array(viewmat), np.array(values["K"]), values["width"], values["height"])

    scores: dict[str, list] = {"copy": [], "warp": []}
    for name, path in heldout["cameras"].items():
        for i, viewmat in zip(path["times"], path["w2c"], strict=True):
            target = to_float(read_rgb(folder / "heldout" / name / f"{i:05d}.png"))
            image = read_rgb(folder / "rgb" / f"{i:05d}.png")
            regions = {
                region: read_rgb(folder / "heldout" / f"{name}_{region}" / f"{i:05d}.png")[..., 0] > 0
                for region in ("masks", "covisible")
            }
            view = as_camera(viewmat, heldout)
            warped = warp_by_depth(image, depth[i], as_camera(clip["w2c"][i], clip), view)
            scores["copy"].append(score_image(copy_to_view(image, view), target, regions, None))
            scores["warp"].append(score_image(warped, target, regions, None))
    copy, warp = (summarize(scores[name], ("masks", "covisible")) for name in ("copy", "warp"))
    assert copy["psnr"] == pytest.approx(15.80, abs=0.01)
    assert copy["masks"]["psnr"] == pytest.approx(12.06, abs=0.01)
    assert warp["psnr"] == pytest.approx(25.76, abs=0.3)
    assert warp["covisible"]["psnr"] == pytest.approx(26.31, abs=0.3)
    assert warp["masks"]["psnr"] == pytest.approx(28.64, abs=0.3)
