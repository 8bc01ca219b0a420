"""The three layouts of the NVIDIA scenes: cameras and images arrive, views belong to their times, bad files are one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.evaluation.placement import view_camera
from flowsplat.geometry import Camera
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.formats.nvidia import read_poses_bounds
from flowsplat.scenes.ingest import fingerprint, ingest, kind_of_input, open_clip
from flowsplat.scenes.synthetic import SyntheticScene
from tests.scenes.formats.nvidia_layouts import make_image, rig_camera, scaled, write_nerfies, write_raw, write_twelve

SPEC = SyntheticScene(width=64, height=48, frames=3)
WRITERS = {"raw": write_raw, "twelve": write_twelve, "nerfies": write_nerfies}
KINDS = {"raw": "nvidia", "twelve": "nvidia", "nerfies": "nerfies"}


@pytest.fixture(scope="session")
def originals(tmp_path_factory) -> Path:
    """One folder a layout."""
    root = tmp_path_factory.mktemp("nvidia")
    for name, write in WRITERS.items():
        write(root / name, SPEC)
    return root


@pytest.fixture
def layouts(originals, tmp_path) -> Path:
    """Copies to spoil."""
    return Path(shutil.copytree(originals, tmp_path / "layouts"))


def read(folder: Path, into: Path, **options) -> Scene:
    chosen = InputOptions(**options)
    return ingest(open_clip(folder, chosen), into, chosen)


def same(camera: Camera, other: Camera) -> None:
    np.testing.assert_allclose(camera.viewmat, other.viewmat, atol=1e-4)
    np.testing.assert_allclose(camera.K, other.K, rtol=1e-6)
    assert (camera.width, camera.height) == (other.width, other.height)


def close(image: np.ndarray, other: np.ndarray, within: float) -> None:
    assert image.shape == other.shape
    assert np.abs(image.astype(int) - other).mean() <= within


def test_raw(originals, tmp_path):
    scene = read(originals / "raw", tmp_path / "scene")
    assert scene.train_frames == [0, 1, 2]
    for t in range(3):
        same(scene.cameras[t], rig_camera(SPEC, t))
        close(scene.frame(t), make_image(SPEC, rig_camera(SPEC, t), t), 2)  # JPEG
    assert len(scene.views) == 3 * 11
    assert {view.name for view in scene.views if view.frame == 1} == {f"cam{c:02d}_00001" for c in range(1, 13) if c != 2}
    for name, camera, t in (("cam01_00002", 0, 2), ("cam12_00001", 11, 1)):
        view = next(view for view in scene.views if view.name == name)
        assert view.frame == t
        same(view.camera, rig_camera(SPEC, camera))
        rendered = SPEC.render(rig_camera(SPEC, camera), SPEC.timestamps[t])
        close(scene.view_image(view), rendered.image, 2)
        np.testing.assert_array_equal(scene.view_mask(view), rendered.mask > 0)
    assert not scene.has_mask(0)
    assert scene.truth is None
    assert any("t % 12" in note for note in scene.info.notes)


def test_raw_with_a_row_for_every_time(tmp_path):
    spec = SyntheticScene(width=32, height=32, frames=14)
    write_raw(tmp_path / "raw", spec, rows=14)
    clip = open_clip(tmp_path / "raw", InputOptions())
    assert clip.cameras is not None
    same(clip.cameras[13], rig_camera(spec, 1))
    assert clip.num_views == 14 * 11
    some = open_clip(tmp_path / "raw", InputOptions(start=12 / 24))
    assert {p.view.name for p in some.views()} >= {"cam01_00013", "cam02_00012"}
    assert some.num_views == 2 * 11


def test_twelve(originals, tmp_path):
    """Frames at the size asked for; the targets stay as they are stored, with cameras to fit."""
    scene = read(originals / "twelve", tmp_path / "scene")
    assert (scene.width, scene.height) == (128, 96)
    for t in range(3):
        same(scene.cameras[t], scaled(rig_camera(SPEC, t), 2))
    close(scene.frame(2), make_image(SPEC, scaled(rig_camera(SPEC, 2), 2), 2), 0)
    assert [(view.name, view.frame) for view in scene.views] == [(f"v000_t{t:03d}", t) for t in range(3)]
    for t, view in enumerate(scene.views):
        same(view.camera, rig_camera(SPEC, 0))
        close(scene.view_image(view), make_image(SPEC, rig_camera(SPEC, 0), t), 0)
    half = read(originals / "twelve", tmp_path / "half", resize=64)
    same(half.cameras[1], rig_camera(SPEC, 1))
    same(half.views[2].camera, rig_camera(SPEC, 0))


@pytest.mark.parametrize("place", ["scene/gt", "gt/scene"])
def test_twelve_with_its_targets_aside(tmp_path, place):
    spec = SyntheticScene(width=64, height=48, frames=2)
    write_twelve(tmp_path / "scene", spec, tmp_path / place)
    assert open_clip(tmp_path / "scene", InputOptions()).num_views == 2
    before = fingerprint(tmp_path / "scene", InputOptions())
    shutil.copy(tmp_path / place / "v000_t000.png", tmp_path / place / "v000_t001.png")
    assert fingerprint(tmp_path / "scene", InputOptions()) != before


def test_nerfies(originals, tmp_path):
    scene = read(originals / "nerfies", tmp_path / "scene")
    for t in range(3):
        same(scene.cameras[t], rig_camera(SPEC, 4))
        close(scene.frame(t), make_image(SPEC, rig_camera(SPEC, 4), t), 0)
    assert len(scene.views) == 9
    for view in scene.views:
        camera, time = map(int, view.name.split("_"))
        assert view.frame == time
        same(view.camera, rig_camera(SPEC, camera))
        close(scene.view_image(view), make_image(SPEC, rig_camera(SPEC, camera), time), 0)
    assert "Camera 4 makes the clip, 3, 5, 6 the test." in scene.info.notes


@pytest.mark.parametrize("layout", WRITERS)
def test_cameras_are_the_scenes_own(originals, tmp_path, layout):
    """They are not estimated again, and views are rendered from where they were taken."""
    assert kind_of_input(originals / layout) == KINDS[layout]
    scene = read(originals / layout, tmp_path / "scene", holdout=2)
    assert scene.heldout_frames == []
    prior = scene.prior("cameras")
    assert prior is not None
    assert prior["method"] == "calibrated"
    for view in scene.views:
        same(view_camera(scene, view), view.camera)


def test_a_pinhole_that_is_not_centered(tmp_path, originals):
    """What Nerfies has and LLFF has not: a principal point, and pixels that are not square."""
    folder = Path(shutil.copytree(originals / "nerfies", tmp_path / "nerfies"))
    path = folder / "camera" / "4_00000.json"
    value = json.loads(path.read_text())
    path.write_text(json.dumps({**value, "principal_point": [30.0, 25.0], "pixel_aspect_ratio": 1.1}))
    clip = open_clip(folder, InputOptions())
    assert clip.cameras is not None
    f = rig_camera(SPEC, 4).K[0, 0]
    np.testing.assert_allclose(clip.cameras[0].K, [[f, 0, 30], [0, 1.1 * f, 25], [0, 0, 1]])


def spoil_poses(rows: np.ndarray, row: int, column: int, value: float) -> np.ndarray:
    rows = rows.copy()
    rows[row, column] = value
    return rows


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: rows[:, :15], r"must hold \[N, 17\]"),
        (lambda rows: rows.astype(int), r"must hold \[N, 17\]"),
        (lambda rows: rows[:2], "has 3 images in images/ but 2 cameras"),
        (lambda rows: spoil_poses(rows, 1, 0, np.nan), "row 1 is no camera"),
        (lambda rows: spoil_poses(rows, 2, 14, 0.0), "row 2 is no camera"),
        (lambda rows: spoil_poses(rows, 2, 0, 7.0), "not finite or not a rotation"),
        (lambda rows: spoil_poses(rows, 0, 9, 500.0), "another shape"),
    ],
)
def test_poses_that_are_none(layouts, tmp_path, change, words):
    path = layouts / "twelve" / "poses_bounds.npy"
    np.save(path, change(np.load(path)))
    with pytest.raises(InputError, match=words) as error:
        read(layouts / "twelve", tmp_path / "scene")
    assert "\n" not in str(error.value)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:40])


def change_json(path: Path, **values) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


BROKEN = {
    "truncated poses": ("raw", lambda f: truncate(f / "poses_bounds.npy"), "damaged or truncated"),
    "a time is missing": ("raw", lambda f: shutil.rmtree(f / "mv_images" / "00001"), "without a gap"),
    "a time is no number": ("raw", lambda f: (f / "mv_images" / "00001").rename(f / "mv_images" / "²"), "without a gap"),
    "no times": ("raw", lambda f: [shutil.rmtree(p) for p in (f / "mv_images").iterdir()], "without a gap"),
    "a camera is missing": ("raw", lambda f: (f / "mv_images/00001/cam07.jpg").unlink(), "cam07.jpg is missing"),
    "too few rows": ("raw", lambda f: np.save(f / "poses_bounds.npy", np.load(f / "poses_bounds.npy")[:7]), "7 rows"),
    "a damaged view": ("raw", lambda f: truncate(f / "mv_images/00001/cam07.jpg"), "cam07.jpg is missing, empty, damaged"),
    "no targets": ("twelve", lambda f: [p.unlink() for p in f.glob("v000*")], "no v000_t000.png"),
    "a target is missing": ("twelve", lambda f: (f / "v000_t001.png").unlink(), "v000_t001.png is missing"),
    "an image is missing": ("twelve", lambda f: (f / "images/001.png").unlink(), "2 images in images/ but 3 cameras"),
    "no split": ("nerfies", lambda f: (f / "splits/val.json").unlink(), "val.json does not exist"),
    "a split that is none": ("nerfies", lambda f: (f / "splits/val.json").write_text("[]"), "must hold frame_names"),
    "times do not fit": ("nerfies", lambda f: change_json(f / "splits/train.json", time_ids=[0, 1]), "as many of each"),
    "one time twice": ("nerfies", lambda f: change_json(f / "splits/train.json", time_ids=[0, 1, 1]), "two images at one time"),
    "names outside": ("nerfies", lambda f: change_json(f / "splits/val.json", frame_names=["../x"] * 9), "cannot name a file"),
    "no camera": ("nerfies", lambda f: (f / "camera/5_00001.json").unlink(), "5_00001.json does not exist"),
    "half a camera": ("nerfies", lambda f: (f / "camera/5_00001.json").write_text("{}"), "does not hold a camera"),
    "distortion": ("nerfies", lambda f: change_json(f / "camera/5_00001.json", radial_distortion=[0.1, 0, 0]), "distortion"),
    "no image": ("nerfies", lambda f: (f / "rgb/1x/4_00001.png").unlink(), "4_00001.png is missing"),
    "a size that differs": ("nerfies", lambda f: shutil.copy(f.parent / "twelve/images/001.png", f / "rgb/1x/4_00001.png"),
                            "all images must have one size"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_files_that_do_not_fit_are_one_line(layouts, tmp_path, case):
    layout, spoil, words = BROKEN[case]
    spoil(layouts / layout)
    with pytest.raises(InputError, match=words) as error:
        read(layouts / layout, tmp_path / "scene")
    assert "\n" not in str(error.value)


def test_poses_that_do_not_exist(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_poses_bounds(tmp_path / "poses_bounds.npy")


@pytest.mark.slow
@pytest.mark.parametrize("layout", WRITERS)
def test_a_whole_run(originals, tmp_path, layout):
    """As a user calls it: the views are the test, rendered from the calibrated cameras."""
    quick = ["--train.iterations", "6", "--render.paths", "input", "--render.width", "32"]
    main(["run", str(originals / layout), "-o", str(tmp_path / "out"), *quick])
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["heldout_frames"] is None
    assert metrics["heldout_views"]["count"] == {"raw": 33, "twelve": 3, "nerfies": 9}[layout]
