"""The whole way on a tiny clip: what comes out, resuming to the same bits, and the law of the split."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import flowsplat
from flowsplat.common.errors import InputError
from flowsplat.common.settings import from_plain, to_plain
from flowsplat.output.viewer.source import Source
from flowsplat.pipeline import demo, fitting, prepare, preparing, run, stages, summary, train
from flowsplat.pipeline.config import RunConfig, preset
from flowsplat.pipeline.describe import describe
from flowsplat.pipeline.folder import RunFolder, stage_key
from flowsplat.priors.given import GivenPriors
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.layers import write_image
from flowsplat.training.trainer import Trainer
from tests.marks import slow
from tests.scene_files import edited
from tests.shared import small_config


def comparable(metrics):
    return {
        name: value for name, value in metrics.items() if name not in ("seconds", "wall_seconds", "peak_memory_gib", "memory_gib")
    }


def test_everything_comes_out(finished):
    metrics = json.loads((finished / "metrics.json").read_text())
    for name in ("heldout_frames", "heldout_views"):
        assert {"psnr", "ssim", "lpips", "moving"} <= set(metrics[name])
    assert metrics["heldout_frames_refined"]["psnr"] >= metrics["heldout_frames"]["psnr"]
    assert set(metrics["baselines"]) == {"copy", "blend", "flow_interpolation", "static"}
    assert metrics["baselines"]["static"] is None
    assert {"mean", "median", "moving"} <= set(metrics["flow_epe"])
    assert {"mean", "median", "moving"} <= set(metrics["flow_prior_epe"])
    assert metrics["depth_abs_rel"]["all"]["mean"] < 0.2
    assert metrics["gaussians"]["active_mean"] <= metrics["gaussians"]["total"]
    assert {"train", "evaluate", "render"} <= set(metrics["seconds"])
    assert metrics["heldout_frames"]["psnr"] > metrics["baselines"]["copy"]["psnr"]
    for name in ("report.html", "preview.png", "renders/input_path.mp4", "model/gaussians.safetensors", "run.json"):
        assert (finished / name).stat().st_size > 0, name
    assert list((finished / "logs").rglob("events.out*"))
    assert not list(finished.rglob("*.partial*"))


def test_a_finished_run_is_not_computed_again(finished, tiny_scene, tmp_path, monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    monkeypatch.setattr(Trainer, "run", lambda self: pytest.fail("trained again"))
    run(tiny_scene, out, small_config())
    assert (out / "metrics.json").read_bytes() == (finished / "metrics.json").read_bytes()


def test_the_python_api_renders_arrays(finished):
    scene = flowsplat.Scene(finished / "scene")
    model = flowsplat.load(finished)
    rendering = model.render(scene.cameras[3], scene.timestamps[3], (scene.cameras[4], scene.timestamps[4]))
    assert rendering.color.shape == (48, 64, 3)
    assert rendering.flow.shape == (48, 64, 2)
    assert rendering.color.dtype == np.float32
    error = np.abs(rendering.color - scene.frame(3) / 255).mean()
    assert error < 0.1
    true_depth = scene.truth.depth(3).depth
    assert np.median(np.abs(rendering.depth / true_depth - 1)) < 0.1  # in the units of the scene's cameras


class Stopped(Exception):
    pass


@pytest.mark.parametrize("at", [slow(5), 17])
def test_interrupted_training_ends_at_the_same_bits(tiny_scene, finished, tmp_path, monkeypatch, at):
    iterate = Trainer.iterate

    def stop(self):
        if self.step == at:
            raise Stopped
        return iterate(self)

    monkeypatch.setattr(Trainer, "iterate", stop)
    with pytest.raises(Stopped):
        run(tiny_scene, tmp_path / "out", small_config())
    monkeypatch.setattr(Trainer, "iterate", iterate)
    metrics = run(tiny_scene, tmp_path / "out", small_config())
    assert comparable(metrics) == comparable(json.loads((finished / "metrics.json").read_text()))
    assert same_model(tmp_path / "out", finished)


def same_model(a: Path, b: Path) -> bool:
    """Whether the measured models of two runs have the same bits."""
    one, other = flowsplat.load(a / "model").gaussians, flowsplat.load(b / "model").gaussians
    return torch.equal(one.dynamic, other.dynamic) and all(torch.equal(one.params[k], other.params[k]) for k in one.params)


def test_heldout_pixels_of_a_prepared_scene_do_not_reach_the_model(tiny_scene, finished, tmp_path):
    corrupted = tmp_path / "scene"
    shutil.copytree(tiny_scene, corrupted)
    scene = Scene(corrupted)
    assert scene.heldout_frames == [9]
    scene.write_frame(9, np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8))
    folder = prepare(corrupted, tmp_path / "out", small_config())
    train(folder)
    assert same_model(tmp_path / "out", finished)


@pytest.mark.slow
def test_heldout_pixels_of_the_input_do_not_reach_the_model_when_cameras_are_given(tiny_scene, tmp_path):
    from flowsplat.scenes.layers import write_image

    truth = Scene(shutil.copytree(tiny_scene, tmp_path / "scene"))
    config = small_config()
    truth.write_cameras(truth.truth.cameras)
    cameras = truth.folder / "cameras.json"
    config = replace(config, priors=replace(config.priors, priors="own", given=replace(config.priors.given, cameras=cameras)))
    for name in ("clean", "corrupt"):
        for i in range(truth.num_frames):
            image = truth.any_frame(i)
            if name == "corrupt" and i == 9:
                image = 255 - image[::-1]
            write_image(tmp_path / name / f"{i:05d}.png", image)
        train(prepare(tmp_path / name, tmp_path / f"out_{name}", config))
    assert same_model(tmp_path / "out_clean", tmp_path / "out_corrupt")


def test_other_settings_train_again_and_keep_the_scene(tiny_scene, finished, tmp_path):
    shutil.copytree(finished, tmp_path / "out")
    stamp = (tmp_path / "out" / "scene" / "depth" / "00000.npz").stat().st_mtime_ns
    metrics = run(tiny_scene, tmp_path / "out", small_config(seed=5))
    assert (tmp_path / "out" / "scene" / "depth" / "00000.npz").stat().st_mtime_ns == stamp
    assert metrics["heldout_frames"]["psnr"] != json.loads((finished / "metrics.json").read_text())["heldout_frames"]["psnr"]


def test_with_all_baselines_there_is_a_static_scene(tiny_scene, finished, tmp_path):
    shutil.copytree(finished, tmp_path / "out")
    metrics = run(tiny_scene, tmp_path / "out", replace(small_config(), baselines="all"))
    assert metrics["baselines"]["static"]["psnr"] > 5


def test_no_holdout_gives_no_heldout_figures(tmp_path):
    from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic

    write_synthetic(tmp_path / "scene", SyntheticScene(width=48, height=32, frames=4), holdout=None)
    metrics = run(tmp_path / "scene", tmp_path / "out", small_config())
    assert metrics["heldout_frames"] is None
    assert metrics["training_frames"]["psnr"] > 10


def test_a_prepared_scene_may_hold_out_its_first_and_last_frame(tiny_scene, tmp_path):
    shutil.copytree(tiny_scene, tmp_path / "scene")
    scene = Scene(tmp_path / "scene")
    images = [scene.any_frame(i) for i in range(scene.num_frames)]
    scene = edited(scene, train=list(range(1, 11)), heldout=[0, 11])
    for i, image in enumerate(images):
        scene.write_frame(i, image)
    metrics = run(tmp_path / "scene", tmp_path / "out", small_config())
    assert metrics["heldout_frames"]["count"] == 2
    assert metrics["baselines"]["copy"]["psnr"] == metrics["baselines"]["flow_interpolation"]["psnr"] > 10


def test_a_figure_that_has_no_value_is_a_dash(finished, tmp_path):
    folder = RunFolder(shutil.copytree(finished, tmp_path / "out"))
    metrics = json.loads(folder.metrics_path.read_text())
    metrics["training_frames"]["psnr"] = None
    folder.metrics_path.write_text(json.dumps(metrics))
    assert any(line.startswith("  training frames: PSNR –, SSIM 0.") for line in describe(folder.path))


def test_a_model_that_is_gone_is_said(finished, tmp_path):
    folder = RunFolder(shutil.copytree(finished, tmp_path / "out"))
    shutil.rmtree(folder.model_path)
    assert f"  model: {folder.model_path} is gone; flowsplat train {folder.path} trains it again" in list(describe(folder.path))
    for options in (None, replace(folder.config.render, paths=("bullet",))):
        with pytest.raises(InputError, match=r"model is gone: flowsplat train .* trains it again"):
            stages.render_run(folder, options)


def test_the_folder_of_another_input_is_refused(finished, tmp_path):
    from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic

    write_synthetic(tmp_path / "scene", SyntheticScene(width=48, height=32, frames=4), holdout=None)
    with pytest.raises(InputError, match="different input"):
        prepare(tmp_path / "scene", finished, small_config())
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").write_text("x")
    with pytest.raises(InputError, match="not empty"):
        prepare(tmp_path / "scene", tmp_path / "other", small_config())


def test_a_damaged_checkpoint_is_explained_and_can_be_deleted(tiny_scene, finished, tmp_path, monkeypatch):
    iterate = Trainer.iterate

    def stop(self):
        if self.step == 15:
            raise Stopped
        return iterate(self)

    monkeypatch.setattr(Trainer, "iterate", stop)
    with pytest.raises(Stopped):
        run(tiny_scene, tmp_path / "out", small_config())
    checkpoint = next((tmp_path / "out" / "training").glob("step_*.safetensors"))
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(InputError, match=r"damaged or truncated.*Delete it to compute it again"):
        run(tiny_scene, tmp_path / "out", small_config())
    checkpoint.unlink()
    monkeypatch.setattr(Trainer, "iterate", iterate)
    run(tiny_scene, tmp_path / "out", small_config())
    assert same_model(tmp_path / "out", finished)


@pytest.mark.parametrize("lost", ["model/gaussians.safetensors", "renders/input_path.mp4", "renders"])
def test_what_was_deleted_is_made_again(tiny_scene, finished, tmp_path, lost):
    shutil.copytree(finished, tmp_path / "out")
    path = tmp_path / "out" / lost
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    run(tiny_scene, tmp_path / "out", small_config())
    assert path.exists()
    assert same_model(tmp_path / "out", finished)


def test_a_wrong_setting_of_training_costs_nothing(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "out")
    folder = RunFolder(tmp_path / "out")
    folder.config = small_config(init=replace(small_config().train.init, opacity=1.5))
    with pytest.raises(InputError, match=r"init\.opacity"):
        train(folder)
    assert same_model(tmp_path / "out", finished)
    assert RunFolder(tmp_path / "out").record["stages"].keys() == RunFolder(finished).record["stages"].keys()


def test_other_previews_and_checkpoints_do_not_train_again(tiny_scene, finished, tmp_path, monkeypatch):
    out, config = tmp_path / "out", small_config()
    often = replace(config, train=replace(config.train, preview_every=7, checkpoint_every=6))
    stop = 15

    def until(self):
        if self.step == stop:
            raise Stopped
        return iterate(self)

    iterate = Trainer.iterate
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "iterate", until)
        with pytest.raises(Stopped):
            run(tiny_scene, out, config)
    stop = 3  # which is passed already
    monkeypatch.setattr(Trainer, "iterate", until)
    run(tiny_scene, out, often)
    assert same_model(out, finished)
    monkeypatch.setattr(Trainer, "run", lambda self: pytest.fail("trained again"))
    run(tiny_scene, out, config)


def test_videos_of_the_model_before_are_not_shown(tiny_scene, finished, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    folder = RunFolder(out)
    stages.render_run(folder, replace(folder.config.render, paths=("bullet",), max_frames=2))
    assert "bullet_time.mp4" in (out / "report.html").read_text()
    run(tiny_scene, out, small_config(seed=5))
    assert "bullet_time.mp4" not in (out / "report.html").read_text()
    assert "input_path.mp4" in (out / "report.html").read_text()


def test_what_was_made_of_the_model_before_goes_with_it(finished, tmp_path):
    folder = RunFolder(shutil.copytree(finished, tmp_path / "out"))
    folder.config = replace(folder.config, train=replace(folder.config.train, iterations=2))
    train(folder)
    for path in (folder.metrics_path, folder.report_path, folder.evaluation_path, folder.all_frames_path):
        assert not path.exists()
    told = list(describe(folder.path))
    assert "  evaluate: not finished" in told
    assert not any("PSNR" in line for line in told)
    assert "not measured yet" in repr(flowsplat.Run(folder.path))
    with pytest.raises(InputError, match="not measured yet"):
        flowsplat.compare(folder.path, finished)


def test_figures_are_not_of_a_scene_that_was_prepared_anew(tiny_scene, finished, tmp_path):
    config = small_config()
    folder = RunFolder(shutil.copytree(finished, tmp_path / "out"))
    prepare(tiny_scene, folder.path, replace(config, priors=replace(config.priors, mask_click=("10,10@0",))))
    told = list(describe(folder.path))
    assert "  train: not finished" in told
    assert any("it is of the scene before it was prepared anew" in line for line in told)
    assert not any("PSNR" in line for line in told)
    with pytest.raises(InputError, match="not measured yet"):
        _ = flowsplat.Run(folder.path).metrics
    prepare(tiny_scene, folder.path, config)
    assert flowsplat.Run(folder.path).metrics == json.loads((finished / "metrics.json").read_text())


def test_a_scene_that_came_out_otherwise_is_trained_on_again(tiny_scene, finished, tmp_path):
    """As where another version or machine prepared it anew, with the same settings."""
    folder = RunFolder(shutil.copytree(finished, tmp_path / "out"))
    scene = Scene(folder.scene_path)
    for scale, is_done in ((1 + 1e-9, True), (1.5, False)):
        scene.write_similarity(replace(scene.similarity, scale=scale * scene.similarity.scale))
        before = (folder.model_path / "model.json").stat().st_mtime_ns
        train(RunFolder(folder.path))
        assert ((folder.model_path / "model.json").stat().st_mtime_ns == before) is is_done
        flowsplat.load(folder.path)


def test_figures_of_an_earlier_version_are_shown(finished, tmp_path):
    """A later version has more settings, and other keys for that."""
    folder = RunFolder(shutil.copytree(finished, tmp_path / "out"))
    stages = folder.record["stages"]
    for name in ("train", "evaluate"):
        stages[name]["key"] = "0123456789abcdef"
        del stages[name]["scene"]
    folder.save()
    assert "heldout_frames" in flowsplat.Run(folder.path).metrics
    assert any("PSNR" in line for line in describe(folder.path))


def test_seconds_of_a_stage_that_was_stopped_count(tiny_scene, tmp_path, monkeypatch):
    def compute(scene: Scene, options: object, device: str, after: Callable[[str, float], None]) -> dict[str, float]:
        after("flow", 2.0)
        raise KeyboardInterrupt

    monkeypatch.setattr(preparing, "prepare_priors", compute)
    with pytest.raises(KeyboardInterrupt):
        prepare(tiny_scene, tmp_path / "out", small_config())
    noted = RunFolder(tmp_path / "out").record["unfinished"]["prepare"]
    monkeypatch.setattr(preparing, "prepare_priors", lambda *_: {"depth": 3.0})
    monkeypatch.setattr(preparing, "write_priors_report", lambda *_: tmp_path)
    monkeypatch.setattr(preparing, "verdict", lambda _: "")
    prepare(tiny_scene, tmp_path / "out", small_config())
    folder = RunFolder(tmp_path / "out")
    assert (folder.seconds["flow"], folder.seconds["depth"]) == (2.0, 3.0)
    assert folder.seconds["ingest"] >= noted["ingest"]
    assert "prepare" not in folder.record["unfinished"]


def test_a_model_is_not_shown_in_a_scene_that_was_prepared_anew(finished, tmp_path):
    out = Path(shutil.copytree(finished, tmp_path / "out"))
    scene = Scene(out / "scene")
    scene.write_similarity(replace(scene.similarity, scale=2 * scene.similarity.scale))
    for read in (flowsplat.load, lambda path: flowsplat.load(path / "model"), Source, lambda path: flowsplat.export(path, "ply")):
        with pytest.raises(InputError, match=r"was prepared anew: run flowsplat train on it again\.$"):
            read(out)


def camera_file(path: Path, fov: float, frames: int = 2) -> Path:
    entry = {"viewmat": np.eye(4).tolist(), "fov_y": fov, "t": 0.0}
    path.write_text(json.dumps({"fps": 4, "width": 32, "height": 16, "frames": [{**entry, "note": "x" * 100}] * frames}))
    return path


def test_another_content_of_the_camera_file_is_rendered_again(tiny_scene, finished, tmp_path, monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    config = small_config()
    config = replace(config, render=replace(config.render, paths=(), camera_file=camera_file(tmp_path / "path.json", 40.0)))
    run(tiny_scene, out, config)
    before = (out / "renders" / "custom_path_path.mp4").read_bytes()
    camera_file(tmp_path / "path.json", 60.0)
    run(tiny_scene, out, config)
    assert (out / "renders" / "custom_path_path.mp4").read_bytes() != before
    (tmp_path / "elsewhere").mkdir()
    moved = replace(config, render=replace(config.render, camera_file=camera_file(tmp_path / "elsewhere" / "path.json", 60.0)))
    monkeypatch.setattr(stages, "render_videos", lambda *_: pytest.fail("rendered again"))
    run(tiny_scene, out, moved)


def test_the_middle_of_a_long_camera_file_counts(finished, tmp_path):
    folder = RunFolder(finished)
    file = camera_file(tmp_path / "path.json", 40.0, frames=1000)
    folder.config = replace(folder.config, render=replace(folder.config.render, camera_file=file))
    key = stages._render_key(folder)
    text = file.read_text()
    middle = text.index("40.0", len(text) // 2)
    file.write_text(text[:middle] + "60.0" + text[middle + 4 :])
    assert stages._render_key(folder) != key


def test_videos_without_a_camera_file_have_the_key_that_they_always_had(finished):
    folder = RunFolder(finished)
    folder.config = replace(folder.config, final_fit=False)
    assert stages._render_key(folder) == stage_key(fitting.train_key(folder), to_plain(folder.config.render))


def test_the_model_is_read_once_and_flows_of_the_report_are_rendered_once(finished, tmp_path, monkeypatch):
    shutil.copytree(finished, tmp_path / "out")
    folder = RunFolder(tmp_path / "out")
    for stage in ("evaluate", "all_frames", "render"):
        folder.forget(stage)
    folder.config = replace(folder.config, final_fit=False)
    read, compared, listed = [], [], []
    load_model, comparison, flow_pairs = stages.load_model, summary.FlowComparison, Scene.flow_pairs

    def count(calls, function):
        return lambda *arguments: calls.append(arguments) or function(*arguments)

    monkeypatch.setattr(stages, "load_model", count(read, load_model))
    monkeypatch.setattr(summary, "FlowComparison", count(compared, comparison))
    stages.render_run(folder)
    assert len(read) == 1
    assert len(compared) == len({title for title, *_ in compared}) > 0
    monkeypatch.setattr(Scene, "flow_pairs", property(count(listed, flow_pairs.fget)))
    stages.render_run(folder, replace(folder.config.render, paths=("bullet",), max_frames=2))
    assert len(listed) == 1
    assert len(read) == 2


def test_other_contents_of_given_files_are_noticed(tiny_scene, finished, tmp_path):
    scene, masks = Scene(finished / "scene"), tmp_path / "masks"
    config = small_config()
    config = replace(config, priors=replace(config.priors, priors="own", given=GivenPriors(masks=masks)))
    bare = tmp_path / "scene"
    shutil.copytree(tiny_scene, bare)
    info = json.loads((bare / "scene.json").read_text())
    info["priors"].pop("masks", None)
    (bare / "scene.json").write_text(json.dumps(info))
    left = np.zeros((scene.height, scene.width), np.uint8)
    left[:, : scene.width // 2] = 1
    for moving in (0 * left, left):
        for i in range(scene.num_frames):
            write_image(masks / f"{i:05d}.png", moving)
        folder = prepare(bare, tmp_path / "out", config)
        assert ((Scene(folder.scene_path).mask(0) > 0) == moving).all(), "numbers are ours to divide"


def test_memory_of_an_earlier_process_counts(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "out")
    folder = RunFolder(tmp_path / "out")
    folder.record["stages"]["train"]["peak_memory_gib"] = 99.5
    folder.config = replace(folder.config, refine_poses=False)
    assert stages.evaluate_run(folder)["peak_memory_gib"] == 99.5


@pytest.mark.parametrize("missing", ["input", "started", "stages", "fingerprint", "config", "version"])
def test_a_damaged_record_is_refused_in_one_line(finished, tmp_path, missing):
    record = json.loads((finished / "run.json").read_text())
    del record[missing]
    (tmp_path / "run.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=f"damaged.*{missing}"):
        RunFolder(tmp_path)


def test_settings_survive_their_file(tmp_path):
    for name in ("fast", "default", "paper", "high"):
        assert from_plain(RunConfig, json.loads(json.dumps(to_plain(preset(name))))) == preset(name)
    with pytest.raises(InputError, match="Unknown setting"):
        from_plain(RunConfig, {"color": 3})
    with pytest.raises(InputError, match="Unknown preset"):
        preset("best")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("objects", [{"depth": 1}]), ("objects", 3), ("baselines", {"flow_interpolation": 2}), ("depth_abs_rel",
        {"moving": "much"}),
        ("seconds", {"train": "long"}), ("seconds", {"train": -1}), ("flow_epe", {"mean": [1]}), ("gaussians", {"active": 3}),
    ],
)  # fmt: skip
def test_damaged_figures_are_refused_in_one_line(finished, tmp_path, name, value):
    shutil.copytree(finished, tmp_path / "out")
    path = tmp_path / "out" / "metrics.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), name: value}))
    with pytest.raises(InputError, match=f"{name}"):
        list(describe(tmp_path / "out"))


@pytest.mark.parametrize("name", ["gaussians", "heldout_frames"])
def test_figures_that_are_missing_are_named(finished, tmp_path, name):
    shutil.copytree(finished, tmp_path / "out")
    path = tmp_path / "out" / "metrics.json"
    path.write_text(json.dumps({key: value for key, value in json.loads(path.read_text()).items() if key != name}))
    with pytest.raises(InputError, match=f"metrics.json is damaged: it has no '{name}'"):
        stages.evaluate_run(RunFolder(tmp_path / "out"))


def test_a_history_without_steps_is_refused(tmp_path):
    assert stages.read_history(tmp_path / "history.json") == []
    for entries in ([{"psnr": 20.0}], [{"step": None}], [{"step": "1"}], {"step": 1}):
        (tmp_path / "history.json").write_text(json.dumps(entries))
        with pytest.raises(InputError, match=r"history\.json is damaged"):
            stages.read_history(tmp_path / "history.json")


def test_a_folder_of_a_newer_version_is_refused(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "out", ignore=shutil.ignore_patterns("scene"))
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    (tmp_path / "out" / "run.json").write_text(json.dumps({**record, "version": 99}))
    with pytest.raises(InputError, match="newer"):
        RunFolder(tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "means", "quats"),
    [
        ("paper", True, True), ("default", False, True), ("paper", False, False),
        slow("default", True, True), slow("paper", False, True), slow("default", False, False),
    ],
)  # fmt: skip
def test_every_representation_trains(tiny_scene, tmp_path, name, means, quats):
    config = preset(name).train
    config = replace(config, iterations=4, model=replace(config.model, move_means=means, move_quats=quats))
    if name == "paper" and not quats:
        config = replace(config, init=replace(config.init, from_priors=False, random_count=2000))
    config = replace(config, density=replace(config.density, every=2, start=2))
    folder = prepare(tiny_scene, tmp_path / "out", replace(small_config(), train=config))
    model = train(folder)
    assert len(model.gaussians) > 100
    for value in model.gaussians.params.values():
        assert torch.isfinite(value).all()


def interrupt(monkeypatch, thing, name, *arguments):
    """Run, and be stopped where ``name`` is called."""

    def stop(*_args, **_kwargs):
        raise Stopped

    with monkeypatch.context() as patch:
        patch.setattr(thing, name, stop)
        with pytest.raises(Stopped):
            run(*arguments)


@pytest.mark.parametrize(
    ("module", "where"),
    [(preparing, "prepare_priors"), slow(Trainer, "run"), slow(preparing, "write_priors_report")],
)  # fmt: skip
def test_back_to_the_first_settings_after_others_were_interrupted(tiny_scene, finished, tmp_path, monkeypatch, module, where):
    out, first = tmp_path / "out", small_config()
    shutil.copytree(finished, out)
    others = replace(first, priors=replace(first.priors, mask_click=("10,10@0",)), train=replace(first.train, seed=5))
    interrupt(monkeypatch, module, where, tiny_scene, out, others)
    metrics = run(tiny_scene, out, first)
    assert comparable(metrics) == comparable(json.loads((finished / "metrics.json").read_text()))
    assert same_model(out, finished)


@pytest.mark.parametrize("where", ["write_json", slow("write_report")])
def test_a_stage_is_finished_when_its_results_are_written(tiny_scene, finished, tmp_path, monkeypatch, where):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    written = getattr(stages, where)

    def stop(path, *arguments):
        if where == "write_report" or Path(path).name == "metrics.json":
            raise Stopped
        return written(path, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(stages, where, stop)
        with pytest.raises(Stopped):
            run(tiny_scene, out, small_config(seed=5))
    metrics = run(tiny_scene, out, small_config(seed=5))
    assert metrics["heldout_frames"]["psnr"] != json.loads((finished / "metrics.json").read_text())["heldout_frames"]["psnr"]
    assert "renders/input_path.mp4" in (out / "report.html").read_text()


def test_a_model_is_not_measured_under_other_settings(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "out")
    folder = RunFolder(tmp_path / "out")
    folder.config = small_config(seed=5)
    with pytest.raises(InputError, match="trained with other settings"):
        stages.evaluate_run(folder)


def test_what_a_prepared_scene_cannot_follow_is_said(tiny_scene, tmp_path, capsys):
    prepare(tiny_scene, tmp_path / "out", replace(small_config(), input=InputOptions(holdout=None)))
    assert "no effect" in capsys.readouterr().err


def test_the_seconds_of_all_sittings_count(tiny_scene, tmp_path, monkeypatch):
    iterate = Trainer.iterate

    def stop(self):
        if self.step == 25:
            raise Stopped
        time.sleep(0.02)
        return iterate(self)

    folder = prepare(tiny_scene, tmp_path / "out", small_config())
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "iterate", stop)
        with pytest.raises(Stopped):
            train(folder)
    (tmp_path / "out" / "training" / ".step_000030.1.partial.safetensors").write_text("left by a process that was killed")
    train(folder)
    assert folder.seconds["train"] > 20 * 0.02
    assert {path.name for path in (tmp_path / "out" / "training").iterdir()} == {"history.json"}


@pytest.mark.parametrize("wrong", [{"given": GivenPriors(masks=Path("/nonexistent"))}, {"mask_click": ("900,3@0",)}])
def test_an_option_that_cannot_be_used_costs_nothing(tiny_scene, finished, tmp_path, monkeypatch, wrong):
    out, first = tmp_path / "out", small_config()
    shutil.copytree(finished, out)
    with pytest.raises(InputError):
        run(tiny_scene, out, replace(first, priors=replace(first.priors, **wrong)))
    assert RunFolder(out).config == first
    monkeypatch.setattr(preparing, "prepare_priors", lambda *_: pytest.fail("prepared again"))
    monkeypatch.setattr(Trainer, "run", lambda self: pytest.fail("trained again"))
    run(tiny_scene, out, first)


def test_a_scene_that_was_put_aside_is_not_taken_for_a_later_one(tiny_scene, finished, tmp_path, monkeypatch):
    """Killed while others settings were prepared, and these then cannot be used: the first ones are prepared again."""
    out, first = tmp_path / "out", small_config()
    shutil.copytree(finished, out)
    others = replace(first, priors=replace(first.priors, mask_click=("10,10@0",)))
    interrupt(monkeypatch, preparing, "prepare_priors", tiny_scene, out, others)

    def refuse(*_args):
        raise InputError("cannot be used")

    with monkeypatch.context() as patch:
        patch.setattr(preparing, "prepare_priors", refuse)
        with pytest.raises(InputError, match="cannot be used"):
            run(tiny_scene, out, others)
    metrics = run(tiny_scene, out, others)
    assert RunFolder(out).config == others
    shutil.rmtree(out)
    assert comparable(run(tiny_scene, out, others)) == comparable(metrics)
    assert not (out / preparing.SET_ASIDE).exists()


def test_what_is_wrong_with_the_videos_is_said_first(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(preparing, "prepare_priors", lambda *_: pytest.fail("prepared before the videos were looked at"))
    config = small_config()
    with pytest.raises(InputError, match=r"nope\.json"):
        run(tiny_scene, tmp_path / "out", replace(config, render=replace(config.render, camera_file=tmp_path / "nope.json")))
    assert not (tmp_path / "out").exists()


def test_what_is_wrong_with_the_videos_of_a_prepared_run_is_said_before_the_training(tiny_scene, tmp_path, monkeypatch):
    out, config = tmp_path / "out", small_config()
    prepare(tiny_scene, out, config)
    monkeypatch.setattr(Trainer, "run", lambda self: pytest.fail("trained before the videos were looked at"))
    for wrong in ({"camera_file": tmp_path / "nope.json"}, {"bullet_time": 99.0}, {"width": 1}):
        with pytest.raises(InputError):
            run(tiny_scene, out, replace(config, render=replace(config.render, **wrong)))
        assert RunFolder(out).config == config


def test_settings_that_are_no_numbers_are_named(tiny_scene, tmp_path):
    config = small_config()
    cameras = replace(config.priors.cameras, focal=float("inf"))
    for changed, name in (
        (replace(config, input=replace(config.input, start=float("nan"))), "--start"),
        (replace(config, priors=replace(config.priors, cameras=cameras)), "--cameras.focal"),
        (replace(config, render=replace(config.render, slow_motion=float("nan"))), "--render.slow-motion"),
    ):
        with pytest.raises(InputError, match=name):
            prepare(tiny_scene, tmp_path / "out", changed)


def test_a_demo_of_another_size_is_not_taken_for_this_one(tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "prepare", stop_here)
    for _ in range(2):
        with pytest.raises(Stopped):
            demo.run_demo(tmp_path / "demo", 64, 4)
    with pytest.raises(InputError, match="another size"):
        demo.run_demo(tmp_path / "demo", 96, 4)


def stop_here(*_args, **_kwargs):
    raise Stopped
