"""A coarse scene to look at while the run goes on: few frames, none of those that are held out, and nothing of it in the run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.output.videos import RenderOptions, list_rendered
from flowsplat.pipeline import coarse, preparing, run, stages
from flowsplat.pipeline.coarse import LONG_SIDE, MAX_FRAME_SECONDS, MAX_FRAMES, CoarseClip, choose_frames, is_worth_it
from flowsplat.pipeline.compiling import Ahead
from flowsplat.pipeline.config import RunConfig, preset
from flowsplat.pipeline.folder import RunFolder
from flowsplat.pipeline.speed import estimate_seconds_of_clip
from flowsplat.scenes.clip import Clip, InputOptions
from flowsplat.scenes.scene import split_frames
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic_video
from flowsplat.training.checkpoint import load_model


@dataclass(kw_only=True)
class _Recorded(Clip):
    """Tells which of its frames were read."""

    read: list[int] = field(default_factory=list)

    def frames(self, numbers: Sequence[int]) -> Iterator[np.ndarray]:
        for i in numbers:
            self.read.append(i)
            yield np.full((self.height, self.width, 3), i % 256, np.uint8)


def clip_of(frames: int, fps: float, size: tuple[int, int] = (854, 480)) -> _Recorded:
    width, height = size
    return _Recorded(name="c", source="c", width=width, height=height, timestamps=np.arange(frames) / fps, source_fps=fps)


@pytest.mark.parametrize(
    ("frames", "fps", "last"), [(12, 24.0, 11), (80, 24.0, 79), (100, 10.0, 51), (100_000, 30.0, 153), (30, 1.0, 25)]
)
def test_frames_are_spread_over_the_clip_or_its_beginning(frames, fps, last):
    """As far as motion can be followed; frames that the run holds out are not among them."""
    train, heldout = split_frames(frames, 10)
    numbers = choose_frames(np.arange(frames) / fps, train)
    assert len(numbers) <= MAX_FRAMES
    assert not set(numbers) & set(heldout)
    assert abs(numbers[-1] - last) <= 3
    assert np.diff(numbers).max() <= max(2, MAX_FRAME_SECONDS * fps + 1)


def test_few_small_frames_are_read():
    clip = clip_of(100, 24.0, (1920, 1080))
    coarse = CoarseClip.of(clip, InputOptions(holdout=10))
    images = list(coarse.frames(range(coarse.num_frames)))
    assert images[0].shape == (coarse.height, coarse.width, 3)
    assert max(coarse.width, coarse.height) == LONG_SIDE
    assert clip.read == coarse.numbers
    np.testing.assert_allclose(coarse.timestamps, clip.timestamps[coarse.numbers])


def test_short_runs_do_without():
    clip = clip_of(80, 24.0)
    assert is_worth_it(sum(estimate_seconds_of_clip(clip, RunConfig()).values()))
    small = clip_of(80, 24.0, (427, 240))
    assert not is_worth_it(sum(estimate_seconds_of_clip(small, preset("fast")).values()))


@pytest.fixture
def config(monkeypatch) -> RunConfig:
    settings = replace(coarse.coarse_settings(), iterations=6)
    monkeypatch.setattr(coarse, "coarse_settings", lambda: settings)
    monkeypatch.setattr(stages, "is_worth_it", lambda whole: True)
    monkeypatch.setattr(stages, "compile_ahead", lambda device: nullcontext(Ahead(None)))
    ours = RunConfig()
    render = RenderOptions(paths=("input",), width=32)
    return replace(ours, train=replace(ours.train, iterations=6), render=render, refine_poses=False)


@pytest.mark.slow
def test_the_run_is_the_same_to_the_bit(tmp_path, config, monkeypatch):
    write_synthetic_video(tmp_path / "clip.mp4", SyntheticScene(width=96, height=64, frames=12))
    run(tmp_path / "clip.mp4", tmp_path / "with", config)
    run(tmp_path / "clip.mp4", tmp_path / "without", replace(config, coarse_scene=False))
    assert not (tmp_path / "without" / "coarse").exists()
    for folder in ("scene", "model", "model_all_frames"):
        files = sorted(path for path in (tmp_path / "without" / folder).rglob("*") if path.is_file())
        assert files
        for path in files:
            same = tmp_path / "with" / path.relative_to(tmp_path / "without")
            assert same.read_bytes() == path.read_bytes(), path
    where = tmp_path / "with" / "coarse"
    assert len(load_model(where / "model").gaussians) > 0
    assert {"input_path", "orbit"} <= set(list_rendered(where / "renders"))
    monkeypatch.setattr(coarse, "ingest", lambda *_: pytest.fail("made again"))
    folder = RunFolder(tmp_path / "with")
    coarse.coarse_scene(folder, clip_of(12, 24.0, (96, 64)))


def test_what_cannot_be_made_is_told_and_left_out(tmp_path, config, monkeypatch, capsys):
    def refuse(*arguments):
        raise InputError("No cameras.")

    monkeypatch.setattr(coarse, "prepare_priors", refuse)
    folder = RunFolder.open_or_create(tmp_path / "out", "c", "c", config)
    coarse.coarse_scene(folder, clip_of(12, 24.0, (96, 64)))
    assert "There is no coarse scene: No cameras." in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out" / "coarse" / "model").exists()


@pytest.mark.parametrize("error", [InputError("No cameras."), MemoryError(), np.linalg.LinAlgError("Singular matrix")])
def test_it_stops_no_run(tmp_path, config, monkeypatch, capsys, error):
    def fail(*arguments):
        raise error

    monkeypatch.setattr(coarse, "prepare_priors", fail)
    coarse.coarse_scene(RunFolder.open_or_create(tmp_path / "out", "c", "c", config), clip_of(12, 24.0, (96, 64)))
    assert "There is no coarse scene" in capsys.readouterr().err


def test_what_can_be_wrong_is_said_first(tmp_path, config):
    """A click that is none, and a camera file that cannot be read; without either it comes before all else."""
    write_synthetic_video(tmp_path / "clip.mp4", SyntheticScene(width=96, height=64, frames=12))
    made: list[str] = []

    def show(folder, clip):
        made.append(folder.path.name)
        raise KeyboardInterrupt

    plain = replace(config, render=RenderOptions())
    clicked = replace(plain, priors=replace(plain.priors, mask_click=("500,5@0",)))
    with pytest.raises(InputError, match="outside the frames"):
        preparing.prepare_folder(tmp_path / "clip.mp4", tmp_path / "clicked", clicked, show)
    filed = replace(plain, render=replace(plain.render, camera_file=tmp_path / "none.json"))
    with pytest.raises(InputError):
        preparing.prepare_folder(tmp_path / "clip.mp4", tmp_path / "filed", filed, show)
    assert not made
    with pytest.raises(KeyboardInterrupt):
        preparing.prepare_folder(tmp_path / "clip.mp4", tmp_path / "plain", plain, show)
    assert made == ["plain"]
    assert not (tmp_path / "plain" / "scene").exists()
