"""Given depth says which way round it is by the parallax of the clip, whatever its folder is called."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.flow import flow_stage
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.given.depth import DEPTH, DISPARITY, INVERTED, open_depth
from flowsplat.priors.given.depth_check import choose_kind, match_training_frames
from flowsplat.priors.graph import PRIORS
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import use_given
from flowsplat.priors.prior import PriorRequest
from flowsplat.scenes import Scene
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic

SPEC = SyntheticScene(width=240, height=136, frames=20)
SHIFT, SCALE = 0.2, 3.0


def stretch(values: np.ndarray) -> np.ndarray:
    """From 0 to 1."""
    return (values - values.min()) / np.ptp(values)


def write_npy(path: Path, values: np.ndarray) -> None:
    np.save(path.with_suffix(".npy"), values.astype(np.float32))


def write_png(path: Path, values: np.ndarray) -> None:
    assert cv2.imwrite(str(path.with_suffix(".png")), np.rint(values).astype(np.uint16 if values.max() > 255 else np.uint8))


FORMS: dict[str, tuple[str, str, Callable[[Path, np.ndarray], None]]] = {
    "relative disparity": ("disp", DISPARITY, lambda path, depth: write_npy(path, SCALE / depth + SHIFT)),
    "metric depth": ("depth_anything_v2_metric", DEPTH, lambda path, depth: write_npy(path, SCALE * depth)),
    "8 bits, near is bright": ("maps", DISPARITY, lambda path, depth: write_png(path, 255 * stretch(1 / depth))),
    "8 bits, near is dark": ("maps", INVERTED, lambda path, depth: write_png(path, 255 - 255 * stretch(1 / depth))),
    "16 bits, millimeters": ("x_disp", DEPTH, lambda path, depth: write_png(path, 1000 * depth)),
    "8 bits in three channels": (
        "maps", DEPTH, lambda path, depth: write_png(path, np.repeat(20 * depth[..., None], 3, axis=2)),
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Scene:
    """With true cameras and masks; every fifth frame is held out."""
    scene = write_synthetic(tmp_path_factory.mktemp("clip") / "scene", SPEC, holdout=5)
    scene.write_cameras(scene.truth.cameras)
    scene.finish_prior("cameras", method="given")
    for i in scene.train_frames:
        scene.write_mask(i, scene.truth.mask(i))
    scene.finish_prior("masks", method="given")
    return scene


@pytest.fixture(scope="module")
def with_flow(clip: Scene) -> Scene:
    flow_stage(clip)
    MatchedClip(clip)  # solved here once
    return clip


@pytest.fixture
def scene(with_flow: Scene, tmp_path: Path) -> Scene:
    shutil.copytree(with_flow.folder, tmp_path / "scene")
    return Scene(tmp_path / "scene")


def write(scene: Scene, form: str, folder: Path) -> Path:
    name, _, write_map = FORMS[form]
    (folder / name).mkdir()
    for i in scene.train_frames:
        write_map(folder / name / f"{i:05d}", scene.truth.depth(i).depth.astype(np.float64))
    return folder / name


def choose(scene: Scene, path: Path, asked: str | None = None) -> tuple[str, str]:
    return choose_kind(scene, open_depth(path, scene), match_training_frames(scene), path, asked)


@pytest.mark.parametrize("form", FORMS)
def test_parallax_tells_which_way_round_values_are(clip: Scene, tmp_path: Path, form: str):
    kind, said = choose(clip, write(clip, form, tmp_path))
    assert kind == FORMS[form][1]
    assert f"read as {kind} (off the parallax as depth by " in said
    assert "as disparity by " in said


@pytest.mark.parametrize("form", ["relative disparity", "8 bits, near is dark", "16 bits, millimeters"])
def test_what_is_near_stays_near(scene: Scene, tmp_path: Path, form: str):
    request = PriorRequest(scene, PriorsOptions(given=GivenPriors(depth=write(scene, form, tmp_path))))
    PRIORS.read_given(request)["depth"]()
    errors = [np.median(np.abs(scene.depth(i).depth / scene.truth.depth(i).depth - 1)) for i in scene.train_frames]
    assert np.median(errors) < 0.05
    assert FORMS[form][1] in scene.prior("depth")["verdict"]


def test_what_is_asked_for_wins_and_is_warned_of(clip: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = write(clip, "metric depth", tmp_path)
    assert choose(clip, path, DEPTH)[0] == DEPTH
    assert "would fit far better" not in capsys.readouterr().err
    assert choose(clip, path, DISPARITY)[0] == DISPARITY
    assert "read as disparity, as it is said to be, but as depth it would fit far better" in capsys.readouterr().err


def test_what_tells_nothing_is_asked_for_in_one_line(clip: Scene, tmp_path: Path):
    rng = np.random.default_rng(0)
    for i in clip.train_frames:
        np.save(tmp_path / f"{i:05d}.npy", cv2.resize(rng.uniform(1, 2, (6, 8)).astype(np.float32), (240, 136)))
    with pytest.raises(InputError, match=r"do not tell \(as depth by .*--given.depth-kind") as error:
        choose(clip, tmp_path)
    assert "\n" not in str(error.value)
    assert choose(clip, tmp_path, DISPARITY)[0] == DISPARITY


def test_before_a_camera_that_stands_still_it_is_asked_for_at_once(tmp_path: Path):
    frames = 8
    scene = Scene.create(
        tmp_path / "scene", name="s", source="", width=240, height=136, timestamps=range(frames), holdout=None, source_fps=1
    )
    still = SyntheticScene(width=240, height=136, frames=2)
    image = still.render(still.camera(0), 0.0).image
    (tmp_path / "depth").mkdir()
    for i in range(frames):
        scene.write_frame(i, image)
        np.save(tmp_path / "depth" / f"{i:05d}.npy", np.full((136, 240), 3.0, np.float32))
    given = GivenPriors(depth=tmp_path / "depth")
    with pytest.raises(InputError, match=r"stands still, so that nothing tells: say it with --given.depth-kind") as error:
        use_given(scene, given)
    assert "\n" not in str(error.value)
    assert set(use_given(scene, replace(given, depth_kind="depth"))) == {"depth"}


@pytest.mark.parametrize("values", ["depth", "disparity", "depth in other units"])
def test_depth_that_is_not_in_the_units_of_given_cameras_is_fitted(scene: Scene, tmp_path: Path, values: str):
    (tmp_path / "depth").mkdir()
    for i in scene.train_frames:
        depth = scene.truth.depth(i).depth
        np.save(tmp_path / "depth" / f"{i:05d}.npy", {"depth": depth, "disparity": 1 / depth}.get(values, 0.3 * depth))
    later = use_given(scene, GivenPriors(depth=tmp_path / "depth"))
    assert set(later) == (set() if values == "depth" else {"depth"})
    for stage in later.values():
        stage()
    assert ("not in the units of the cameras" in scene.prior("depth")["verdict"]) == (values != "depth")
    i = scene.train_frames[3]
    assert np.median(np.abs(scene.depth(i).depth / scene.truth.depth(i).depth - 1)) < 0.05


def test_colors_that_stand_for_depth_are_refused_in_one_line(clip: Scene, tmp_path: Path):
    rng = np.random.default_rng(0)
    for i in clip.train_frames:
        cv2.imwrite(str(tmp_path / f"{i:05d}.png"), rng.integers(0, 255, (136, 240, 3), np.uint8))
    with pytest.raises(InputError, match="no gray PNG of depth") as error:
        open_depth(tmp_path, clip)
    assert "\n" not in str(error.value)
