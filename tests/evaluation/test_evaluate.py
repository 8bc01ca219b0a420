import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowsplat.common.errors import InputError
from flowsplat.common.files import write_json
from flowsplat.common.registry import Entry
from flowsplat.evaluation import evaluate as module
from flowsplat.evaluation.baselines import BASELINES, Baseline, HeldoutImage, title_of
from flowsplat.evaluation.evaluate import evaluate
from flowsplat.evaluation.metrics import MAX_PSNR
from flowsplat.geometry import Similarity
from flowsplat.pipeline.summary import list_rows
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import read_image

MOVED = Similarity(0.4, Rotation.from_euler("xyz", [0.3, -0.2, 0.5]).as_matrix(), np.array([1.0, 2, -3]))


@pytest.fixture(autouse=True)
def no_lpips(monkeypatch):
    """The same figures on machines with and without the weights."""
    monkeypatch.setattr(module, "lpips_metric", lambda: (None, "LPIPS is not here."))


def numbers(value):
    """Every float inside nested figures."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [number for item in value for number in numbers(item)]
    return [value] if isinstance(value, float) else []


def test_the_truth_scores_perfectly(world, build_scene):
    scene = build_scene()
    metrics = evaluate(world, scene)
    for kind, count in (("heldout_frames", 2), ("heldout_views", 2), ("training_frames", 10)):
        figures = metrics[kind]
        assert figures["psnr"] == MAX_PSNR
        assert figures["ssim"] == pytest.approx(1)
        assert figures["count"] == count
        assert figures["moving"]["psnr"] == MAX_PSNR
        assert figures["moving"]["count"] == count
    for name in ("flow_epe", "prior_flow_epe", "flow_prior_epe"):  # flow is stored in 1/64 pixel
        assert max(metrics[name]["mean"], metrics[name]["moving"]["mean"]) < 1 / 64
    assert max(numbers(metrics["depth_abs_rel"])) < 1e-6
    assert metrics["training_stride"] == 1
    assert metrics["lpips_reason"] == "LPIPS is not here."
    assert metrics["heldout_frames"]["lpips"] is None
    assert metrics["heldout_views"]["covisible"] is None


def test_the_figures_are_json_with_finite_numbers(world, build_scene, tmp_path):
    metrics = evaluate(world, build_scene(), static_model=world)
    write_json(tmp_path / "metrics.json", metrics)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert np.isfinite(numbers(metrics)).all()
    kinds = [entry["kind"] for entry in metrics["per_image"]]
    assert kinds == ["heldout_frame"] * 2 + ["heldout_view"] * 2 + ["training_frame"] * 10
    assert [entry["name"] for entry in metrics["per_image"][:4]] == ["00004", "00009", "left", "right"]


def test_baselines_are_worse_than_the_truth_and_ordered(world, build_scene):
    still = replace(world, moves=False)
    metrics = evaluate(world, build_scene(), static_model=still)
    frames, views = metrics["baselines"], metrics["baselines_views"]
    assert frames["copy"]["psnr"] < frames["blend"]["psnr"] < frames["flow_interpolation"]["psnr"] < MAX_PSNR
    assert frames["static"]["moving"]["psnr"] + 3 < frames["flow_interpolation"]["moving"]["psnr"]
    assert views["copy"]["psnr"] + 5 < views["warp_by_depth"]["psnr"]
    assert views["static"]["count"] == 2
    per_image = metrics["per_image"][0]["baselines"]
    assert set(per_image) >= {"copy", "blend", "flow_interpolation", "static"}


def test_without_a_static_model_its_row_is_null(world, build_scene):
    metrics = evaluate(world, build_scene())
    assert metrics["baselines"]["static"] is None
    assert metrics["baselines_views"]["static"] is None


def test_a_baseline_that_somebody_adds_is_measured_and_shown(world, build_scene, monkeypatch):
    """In the figures, the summary, and with its title in the report, where it is not known by its name."""
    BASELINES.names()  # what there is, is looked for once
    monkeypatch.setattr(BASELINES, "_found", dict(BASELINES._found))
    asked: list[HeldoutImage] = []

    def predict_gray(image: HeldoutImage) -> np.ndarray | None:
        asked.append(image)
        return np.full((image.scene.height, image.scene.width, 3), 0.5, np.float32)

    BASELINES.add(Entry("mid_gray", "nothing but gray", "Gray.", Baseline(predict_gray, of_views=False)))
    metrics = evaluate(world, build_scene())
    assert 5 < metrics["baselines"]["mid_gray"]["psnr"] < metrics["baselines"]["copy"]["psnr"]
    assert "mid_gray" not in metrics["baselines_views"]
    assert {image.view for image in asked} == {None}
    assert ("nothing but gray, PSNR", ("baselines", "mid_gray", "psnr"), ".2f") in list_rows()
    assert (title_of("mid_gray"), title_of("of a package that is gone")) == ("nothing but gray", "of a package that is gone")


def test_baselines_can_be_left_out(world, build_scene, monkeypatch):
    monkeypatch.setattr(module, "predict", lambda *_: pytest.fail("computed"))
    metrics = evaluate(world, build_scene(), baselines=False)
    assert metrics["baselines"] is None
    assert metrics["baselines_views"] is None


def test_motion_errors_are_measured_in_pixels_and_relative_depth(world, build_scene):
    class Wrong:
        def render(self, camera, t, flow_to=None):
            true = world.render(camera, t, flow_to)
            flow = None if true.flow is None else true.flow + np.float32([0.3, -0.4])
            return replace(true, flow=flow, depth=true.depth * np.float32(1.25))

    metrics = evaluate(Wrong(), build_scene())
    assert metrics["flow_epe"]["median"] == pytest.approx(0.5, abs=0.02)
    assert metrics["flow_epe"]["moving"]["mean"] == pytest.approx(0.5, abs=0.02)
    for region in ("all", "static", "moving"):
        assert metrics["depth_abs_rel"][region] == pytest.approx({"mean": 0.25, "median": 0.25})


@pytest.mark.parametrize("scene_options", [{"holdout": None}, {"views": False}, {"holdout": None, "views": False}])
def test_what_the_scene_does_not_have_is_null(world, build_scene, scene_options):
    metrics = evaluate(world, build_scene(**scene_options))
    no_frames, no_views = "holdout" in scene_options, "views" in scene_options
    assert (metrics["heldout_frames"] is None) == (metrics["baselines"] is None) == no_frames
    assert (metrics["heldout_views"] is None) == (metrics["baselines_views"] is None) == no_views
    assert metrics["training_frames"]["psnr"] == MAX_PSNR


def test_without_truth_only_the_prior_flow_is_compared(world, build_scene):
    metrics = evaluate(world, build_scene(truth=False))
    assert metrics["flow_epe"] is None
    assert metrics["prior_flow_epe"] is None
    assert metrics["depth_abs_rel"] is None
    assert metrics["flow_prior_epe"]["mean"] < 1 / 64
    assert metrics["baselines_views"]["warp_by_depth"] is None
    assert metrics["baselines_views"]["copy"]["psnr"] < 30


def test_without_masks_regions_are_null(world, build_scene):
    metrics = evaluate(world, build_scene(masks=False))
    for kind in ("heldout_frames", "heldout_views", "training_frames", "flow_epe", "flow_prior_epe"):
        assert metrics[kind]["moving"] is None
    assert metrics["baselines"]["copy"]["moving"] is None
    assert metrics["depth_abs_rel"]["moving"] is None
    assert metrics["depth_abs_rel"]["static"] is None
    assert metrics["depth_abs_rel"]["all"] is not None


def test_with_full_masks_the_region_is_the_image(world, build_scene):
    metrics = evaluate(world, build_scene(full_masks=True))
    copy = metrics["baselines"]["copy"]
    assert copy["moving"]["psnr"] == pytest.approx(copy["psnr"])
    assert metrics["flow_epe"]["moving"]["mean"] == pytest.approx(metrics["flow_epe"]["mean"])
    assert metrics["depth_abs_rel"]["static"] is None


def test_estimated_cameras_place_the_views_and_scale_the_depth(world, build_scene):
    scene = build_scene(similarity=MOVED)
    metrics = evaluate(replace(world, similarity=MOVED), scene)
    assert metrics["heldout_views"]["psnr"] > 60
    assert metrics["heldout_frames"]["psnr"] > 60
    assert metrics["depth_abs_rel"]["all"]["mean"] < 1e-5
    assert metrics["baselines_views"]["warp_by_depth"]["psnr"] > 20


def test_views_without_any_true_camera_are_an_input_error(world, build_scene):
    scene = build_scene(similarity=MOVED, truth=False)
    with pytest.raises(InputError, match="no true cameras"):
        evaluate(world, scene)


def test_a_model_full_of_nan_scores_badly_and_finitely(world, build_scene):
    class Broken:
        def render(self, camera, t, flow_to=None):
            true = world.render(camera, t, flow_to)
            nothing = {name: np.full_like(value, np.nan) for name, value in vars(true).items() if value is not None}
            return replace(true, **nothing)

    metrics = evaluate(Broken(), build_scene())
    assert np.isfinite(numbers(metrics)).all()
    assert metrics["heldout_frames"]["psnr"] < 10
    assert metrics["depth_abs_rel"]["all"] == {"mean": 1.0, "median": 1.0}


def test_lpips_is_averaged_where_it_can_be_measured(world, build_scene, monkeypatch):
    monkeypatch.setattr(module, "lpips_metric", lambda: (lambda a, b: float(np.abs(a - b).mean()), ""))
    metrics = evaluate(world, build_scene())
    assert metrics["lpips_reason"] is None
    assert metrics["heldout_frames"]["lpips"] < 1e-6
    assert metrics["baselines"]["copy"]["lpips"] > 0.01
    assert metrics["baselines"]["copy"]["moving"]["lpips"] is None


def test_a_long_clip_without_truth_renders_a_sample_of_its_training_frames(world, build_scene):
    scene = build_scene(truth=False)
    scene.train_frames = list(range(24))
    assert module.choose_training_stride(scene) == 3
    scene.train_frames = list(range(400))
    assert module.choose_training_stride(scene) == 8


def test_renderings_and_sheets_are_written(world, build_scene, tmp_path):
    scene = build_scene()
    evaluate(world, scene, folder=tmp_path / "evaluation")
    images = ("heldout/00004", "heldout/00009", "views/left", "views/right")
    names = {f"{image}{kind}" for image in images for kind in (".png", "_sheet.png")}
    assert {path.relative_to(tmp_path / "evaluation").as_posix() for path in tmp_path.glob("evaluation/*/*")} == names
    np.testing.assert_array_equal(read_image(tmp_path / "evaluation/heldout/00004.png"), scene.heldout_frame(4))
    sheet = read_image(tmp_path / "evaluation/heldout/00004_sheet.png")
    assert sheet.shape[1] >= 3 * scene.width


def test_training_frames_never_reach_held_out_ones(world, build_scene, monkeypatch):
    scene = build_scene()
    asked = []
    monkeypatch.setattr(Scene, "heldout_frame", lambda self, i: asked.append(i) or self.any_frame(i))
    evaluate(world, scene)
    assert set(asked) == {4, 9}


def test_refined_poses_are_a_second_figure(world, build_scene):
    """Poses that are off by a pixel spoil the strict figures; the refined ones stand beside them."""
    scene = build_scene(holdout=4)
    true = scene.cameras
    asked = []

    class Shaken:
        def render(self, camera, t, flow_to=None):
            is_true = any(np.array_equal(camera.viewmat, known.viewmat) for known in true)
            return world.render(camera if not is_true else camera_beside(camera), t, flow_to)

    def camera_beside(camera):
        viewmat = camera.viewmat.copy()
        viewmat[0, 3] += 0.05
        return replace(camera, viewmat=viewmat)

    def refine(camera, seconds, target):
        asked.append(seconds)
        assert target.shape == (scene.height, scene.width, 3)
        viewmat = camera.viewmat.copy()
        viewmat[0, 3] += 1e-9
        return replace(camera, viewmat=viewmat)

    metrics = evaluate(Shaken(), scene, refine=refine)
    strict, refined = metrics["heldout_frames"], metrics["heldout_frames_refined"]
    assert asked == [scene.timestamps[i] for i in scene.heldout_frames]
    assert refined["psnr"] > strict["psnr"] + 10
    assert refined["moving"]["psnr"] > strict["moving"]["psnr"] + 10
    assert refined["count"] == strict["count"] == 2
    first = metrics["per_image"][0]
    assert first["refined"]["psnr"] > first["psnr"] + 10
    assert "refined" not in metrics["per_image"][-1]
    plain = evaluate(Shaken(), scene)
    assert plain["heldout_frames_refined"] is None
    assert plain["heldout_frames"] == strict
