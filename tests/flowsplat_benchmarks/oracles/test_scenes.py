"""Each oracle's layers: what should be true is, at the scale of the cameras, and the rest is as it was."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.scenes import Scene
from flowsplat_benchmarks.oracles.mended_masks import FAULTS
from flowsplat_benchmarks.oracles.objects import match_objects, object_depth_errors
from flowsplat_benchmarks.oracles.scenes import ORACLES, make_oracle
from tests.flowsplat_benchmarks.oracles.conftest import SCALE


@pytest.fixture(scope="module")
def oracles(wrong_scene, tmp_path_factory) -> dict[str, Scene]:
    folder = tmp_path_factory.mktemp("made")
    before = contents(wrong_scene)
    made = {name: make_oracle(wrong_scene, folder / name, name) for name in ORACLES}
    assert contents(wrong_scene) == before, "the prepared scene stays as it is"
    assert {path.name for path in folder.iterdir()} == set(ORACLES)
    return made


def contents(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def differing(scene: Scene, other: Path) -> set[str]:
    """Which layers of two scenes differ."""
    ours, theirs = contents(scene.folder), contents(other)
    return {name.split("/")[0] for name in ours.keys() | theirs.keys() if ours.get(name) != theirs.get(name)} - {"scene.json"}


def frames(scene: Scene):
    """(frame, own mask, true mask, depth, true depth at the scale of the cameras)."""
    truth = scene.truth
    assert truth is not None
    for i in scene.train_frames:
        yield i, scene.mask(i), truth.mask(i), scene.depth(i).depth, SCALE * truth.depth(i).depth


def test_which_layers_are_replaced(oracles, wrong_scene):
    found = {name: differing(scene, wrong_scene) for name, scene in oracles.items()}
    replaced = {
        "own": set(),
        "constant": {"depth"},
        "depth_trajectory": {"depth"},
        "shape_offset": {"depth"},
        "outline": {"depth", "masks", "tracks.npz", "objects.json", "objects.npz"},
        "background": {"depth", "masks", "tracks.npz"},
        "flow": {"depth", "masks", "tracks.npz", "flow"},
        "cameras": {"depth", "masks", "tracks.npz", "flow", "cameras.json"},
        **{fault: {"depth", "masks", "tracks.npz", "objects.json", "objects.npz"} for fault in FAULTS},
    }
    assert found == replaced


def test_names_and_scale_of_training(oracles, wrong_scene):
    for name, scene in oracles.items():
        assert scene.name == f"synthetic, {name}"
        assert scene.info.oracle["name"] == name
        trusted = np.concatenate([scene.depth(i).depth[scene.depth(i).trusted] for i in scene.train_frames])
        assert np.median(trusted) * scene.similarity.scale == pytest.approx(1, abs=0.05)
        assert not (scene.folder / "multiview").exists()
    assert oracles["background"].similarity != Scene(wrong_scene).similarity


def test_constant(oracles, wrong_scene):
    scene, own = oracles["constant"], Scene(wrong_scene)
    errors = object_depth_errors(own)
    assert len(errors) == 4
    for i, mask, _, depth, _ in frames(scene):
        expected = own.depth(i).depth.copy()
        for error in errors:
            expected[error.matched.region(mask)] *= np.exp(-error.constant)
        np.testing.assert_allclose(depth, expected, rtol=1e-5)
    for before, after in zip(errors, object_depth_errors(scene), strict=True):
        assert after.constant == pytest.approx(0, abs=1e-5)
        assert after.shape_offset == pytest.approx(before.shape_offset, abs=1e-5)
        assert after.depth_trajectory == pytest.approx(before.depth_trajectory, abs=1e-5)


def test_depth_trajectory(oracles, wrong_scene):
    scene, own = oracles["depth_trajectory"], Scene(wrong_scene)
    for i, mask, true_mask, depth, true in frames(scene):
        for obj in match_objects(own):
            region, compared = obj.region(mask), obj.select_compared(mask, true_mask)
            if region.any():
                np.testing.assert_allclose(depth[region], np.median(true[compared]), rtol=1e-5)
        np.testing.assert_array_equal(depth[mask == 0], own.depth(i).depth[mask == 0])


def test_shape_offset(oracles, wrong_scene):
    own = Scene(wrong_scene)
    for i, mask, _, depth, true in frames(oracles["shape_offset"]):
        np.testing.assert_allclose(depth[mask > 0], true[mask > 0], rtol=1e-5)
        np.testing.assert_array_equal(depth[mask == 0], own.depth(i).depth[mask == 0])


def test_outline(oracles):
    scene = oracles["outline"]
    off = []
    for _, mask, true_mask, depth, true in frames(scene):
        np.testing.assert_array_equal(mask, true_mask)
        np.testing.assert_allclose(depth[mask > 0], true[mask > 0], rtol=1e-5)
        off.append(np.abs(np.log(depth / true))[mask == 0])
    static = np.concatenate(off)
    assert 1e-4 < np.median(static) < 0.3, "static depth is computed anew, not the truth and not a guess"
    assert (scene.prior("depth") or {})["method"] == "multi-view"
    assert (scene.prior("tracks") or {})["method"] == "patches"
    assert scene.tracks.moving.any()


def test_masks_lose_one_fault_after_the_other(oracles, wrong_scene):
    own = Scene(wrong_scene)
    for i in own.train_frames:
        mask, true = own.mask(i), own.truth.mask(i)
        ids, shadow, parts, masks = (oracles[fault].mask(i) for fault in ("ids", "shadow", "parts", "masks"))
        np.testing.assert_array_equal(ids > 0, mask > 0)
        np.testing.assert_array_equal(ids[(mask > 0) & (true > 0)], true[(mask > 0) & (true > 0)])
        np.testing.assert_array_equal(shadow, np.where(mask > 0, true, 0))
        np.testing.assert_array_equal(parts[shadow > 0], shadow[shadow > 0])
        np.testing.assert_array_equal(masks, true)
    for fault in FAULTS:
        made = oracles[fault]
        assert (made.prior("depth") or {})["method"] == "multi-view", "depth is our own"
        assert any(np.abs(made.depth(i).depth - SCALE * made.truth.depth(i).depth)[made.mask(i) > 0].max() > 1e-3 for i in (0, 4))


@pytest.mark.parametrize("name", ["background", "flow"])
def test_background(oracles, name):
    for _, mask, true_mask, depth, true in frames(oracles[name]):
        np.testing.assert_array_equal(mask, true_mask)
        np.testing.assert_allclose(depth, true, rtol=1e-5)


def test_flow_and_cameras(oracles):
    truth = oracles["flow"].truth
    assert truth is not None
    for pair in oracles["flow"].flow_pairs:
        np.testing.assert_array_equal(oracles["flow"].flow(*pair).flow, truth.flow(*pair).flow)
        assert np.abs(oracles["background"].flow(*pair).flow - truth.flow(*pair).flow).max() > 0.4
    scene = oracles["cameras"]
    for i in scene.train_frames:
        np.testing.assert_array_equal(scene.cameras[i].viewmat, truth.cameras[i].viewmat)
        np.testing.assert_array_equal(scene.depth(i).depth, truth.depth(i).depth)
        assert (oracles["flow"].cameras[i].center != scene.cameras[i].center).any()
    assert (scene.prior("tracks") or {})["method"] == "truth"


def test_what_is_there_is_kept_until_the_scene_is_another(wrong_scene, tmp_path):
    prepared, folder = tmp_path / "prepared", tmp_path / "shape_offset"
    shutil.copytree(wrong_scene, prepared)
    first = make_oracle(prepared, folder, "shape_offset")
    path = first.folder / "depth" / "00003.npz"
    written = path.stat().st_mtime_ns
    make_oracle(prepared, folder, "shape_offset")
    assert path.stat().st_mtime_ns == written
    Scene(prepared).finish_prior("depth", method="another")
    make_oracle(prepared, folder, "shape_offset")
    assert path.stat().st_mtime_ns != written


def test_what_was_interrupted_is_made_anew(wrong_scene, tmp_path):
    (tmp_path / ".shape_offset.making" / "depth").mkdir(parents=True)
    assert make_oracle(wrong_scene, tmp_path / "shape_offset", "shape_offset").has_depth(0)
    assert [path.name for path in tmp_path.iterdir()] == ["shape_offset"]


def test_bad_input(wrong_scene, tmp_path):
    with pytest.raises(InputError, match="no oracle 'sound': choose from own, constant"):
        make_oracle(wrong_scene, tmp_path / "out", "sound")
    with pytest.raises(InputError, match="not a prepared scene"):
        make_oracle(tmp_path, tmp_path / "out", "shape_offset")
    shutil.copytree(wrong_scene, tmp_path / "bare")
    shutil.rmtree(tmp_path / "bare" / "truth")
    with pytest.raises(InputError, match="only rendered scenes do"):
        make_oracle(tmp_path / "bare", tmp_path / "out", "shape_offset")
    assert not (tmp_path / "out").exists()
