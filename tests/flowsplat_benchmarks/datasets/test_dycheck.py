"""DyCheck's protocol on a stand-in that is written as its authors write theirs: masks of what the clip saw, and marked points."""

from __future__ import annotations

import json
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.evaluation.metrics import compute_masked_ssim, ssim_map
from flowsplat.gaussians.renderer import Rendering
from flowsplat.scenes import Scene
from flowsplat.scenes.ingest import ingest, open_clip
from flowsplat.scenes.synthetic import SyntheticScene
from flowsplat_benchmarks.datasets import dycheck, dycheck_cases
from flowsplat_benchmarks.datasets.tables import tables
from tests.flowsplat_benchmarks.ablations.test_training_runs import call
from tests.flowsplat_benchmarks.datasets.conftest import result
from tests.scenes.formats.nvidia_layouts import write_nerfies

SPEC = SyntheticScene(width=128, height=96, frames=4, fps=6.0)
MARKED = (0, 2, 3)
"""Frames with marked points."""


def write_dycheck(folder):
    """At twice the size at which it is measured: the left half of each test image was seen, and three points are marked."""
    write_nerfies(folder, SPEC)
    seen = np.zeros((SPEC.height // 2, SPEC.width // 2), np.uint8)
    seen[:, : SPEC.width // 4] = 255
    (folder / "covisible/2x/val").mkdir(parents=True)
    for name in json.loads((folder / "splits/val.json").read_text())["frame_names"]:
        cv2.imwrite(str(folder / "covisible/2x/val" / f"{name}.png"), seen)
    (folder / "keypoint/2x/train").mkdir(parents=True)
    for t in MARKED:
        points = [[10 + 2 * t, 20, 1], [30, 24, 1], [40, 30, int(t != 3)]]
        (folder / "keypoint/2x/train" / f"4_{t:05d}.json").write_text(json.dumps(points))


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("root")
    write_dycheck(root / "dycheck" / "apple")
    return root


@pytest.fixture(scope="module")
def scene(root, tmp_path_factory) -> Scene:
    (case,) = dycheck_cases(root)
    return ingest(open_clip(case.source, case.config.input), tmp_path_factory.mktemp("scene"), case.config.input)


def test_every_frame_trains_at_half_the_size(root, scene):
    (case,) = dycheck_cases(root, ["apple"])
    assert (case.protocol, case.name) == ("dycheck", "apple_given-cameras_default")
    assert case.config.input.resize == 64
    assert (scene.width, scene.height, scene.num_frames, len(scene.views)) == (64, 48, 4, 12)
    assert scene.heldout_frames == []
    with pytest.raises(InputError, match="no scene 'x': choose from apple"):
        dycheck_cases(root, ["x"])


@dataclass
class Knowing:
    """Shows every test image as it is where the clip saw it, and black elsewhere."""

    scene: Scene

    def render(self, camera, t):
        frame = int(np.argmin(np.abs(self.scene.timestamps - t)))
        view = next(v for v in self.scene.views if v.frame == frame and np.allclose(v.camera.viewmat, camera.viewmat))
        image = self.scene.view_image(view).astype(np.float32) / 255 * self.scene.view_mask(view, "covisible")[..., None]
        return Rendering(color=image, alpha=image[..., 0], depth=image[..., 0], flow=None)


def test_only_what_the_clip_saw_counts(scene, tmp_path):
    found = dycheck.measure_dycheck(Knowing(scene), scene, _without_points(scene, tmp_path))
    assert found["mpsnr"] == 100
    assert found["mssim"] == pytest.approx(1)
    assert found["views"] == 12
    assert (found["pck"], found["transfers"]) == (None, 0)


def _without_points(scene, folder):
    write_nerfies(folder / "plain", SPEC)
    return folder / "plain"


def test_a_masked_ssim_is_the_usual_one_where_all_is_seen_and_knows_nothing_else():
    rng = np.random.default_rng(0)
    a, b = rng.random((40, 50, 3)), rng.random((40, 50, 3))
    everything, left = np.ones((40, 50), bool), np.arange(50) < np.full((40, 1), 30)
    assert compute_masked_ssim(a, b, everything) == pytest.approx(ssim_map(a, b).mean())
    other = np.where(left[..., None], b, rng.random((40, 50, 3)))
    assert compute_masked_ssim(a, b, left) == pytest.approx(compute_masked_ssim(a, other, left))
    assert compute_masked_ssim(a, b, left) != pytest.approx(ssim_map(a, b)[left].mean(), abs=1e-6)
    assert compute_masked_ssim(a, b, np.zeros((40, 50), bool)) is None


def test_marked_points_are_in_pixels_of_the_scene(root, scene):
    found = dycheck.read_keypoints(root / "dycheck" / "apple", scene)
    assert list(found) == list(MARKED)
    np.testing.assert_allclose(found[2][0], [14, 20, 1])


@pytest.mark.parametrize("text", ["[[1, 2]]", '[["a", 1, 1]]', "{}", "[[1, 2, 1]]", "[[NaN, 1, 1], [1, 1, 1], [1, 1, 1]]"])
def test_damaged_marks_are_refused(text, scene, tmp_path):
    write_dycheck(tmp_path / "apple")
    (tmp_path / "apple/keypoint/2x/train/4_00002.json").write_text(text)
    with pytest.raises(InputError, match=r"4_00002\.json"):
        dycheck.read_keypoints(tmp_path / "apple", scene)


def test_a_point_is_right_where_it_comes_near_its_mark(root, scene, monkeypatch):
    """The first moves and is lost in frame 3, the second is exact, the third is 4 pixels off: more than 5 % of 64."""
    depth = 2.0
    places = {0: lambda t: (10 + 2 * t, 20), 1: lambda t: (30, 24), 2: lambda t: (44, 30)}

    def follow(model, cameras, timestamps, queries):
        points = np.full((len(queries), len(cameras), 3), np.nan)
        for q, (u, v, _) in enumerate(queries):
            k = min(places, key=lambda k: abs(places[k](0)[1] - v))
            for t, camera in enumerate(cameras):
                if (k, t) != (0, 3):
                    points[q, t] = camera.unproject(np.array([places[k](t)], float), np.array([depth]))[0]
            assert u > 0
        return type("Paths", (), {"points": points})()

    monkeypatch.setattr(dycheck, "follow_points", follow)
    monkeypatch.setattr(type(scene), "views", property(lambda _: []))
    found = dycheck.measure_dycheck(None, scene, root / "dycheck" / "apple")
    # Of three frames in pairs: six of the first (two of them into frame 3), six of the second, two of the third.
    assert found["transfers"] == 14
    assert found["pck"] == pytest.approx(100 * (4 + 6) / 14)
    assert (found["mpsnr"], found["mssim"], found["views"]) == (None, None, 0)


def test_the_table_has_its_figures_and_their_mean():
    measured = {"mpsnr": 20.0, "mssim": 0.8, "pck": 90.0, "views": 12, "transfers": 14}
    results = [
        result("apple", "dycheck", dycheck=measured),
        result("block", "dycheck", dycheck={**measured, "mpsnr": 22.0, "pck": None}),
    ]
    table = tables("dycheck", results)[0]
    assert [row[2] for row in table.rows] == ["20.00", "22.00", "21.00"]
    assert [row[4] for row in table.rows] == ["90.0", "–", "90.0"]


@pytest.mark.slow
def test_the_command_measures_a_scene(root, tmp_path):
    call("dycheck", root, "-o", tmp_path, "--preset", "fast", "--train.iterations", "20")
    value = json.loads((tmp_path / "apple_given-cameras_fast.json").read_text())
    assert 5 < value["dycheck"]["mpsnr"] < 60
    assert 0 <= value["dycheck"]["pck"] <= 100
    assert "mPSNR" in (tmp_path / "dycheck.md").read_text()
