"""Monocular depth places objects as far as it is right where nothing moves. What is worse than what is known changes nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.priors.background.monocular_maps import Monocular
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.graph import PRIORS
from flowsplat.priors.objects import load_objects
from flowsplat.priors.objects.distance import Cue
from flowsplat.priors.objects.monocular_cue import ERROR_RATIO, MonocularDistances, _area_errors
from flowsplat.priors.objects.solving import _distance
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors
from flowsplat.scenes import Scene
from tests.priors.planes import WALL, write_planes


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """Prepared with true masks: nothing tells how far away the square is."""
    return prepared(tmp_path_factory.mktemp("monocular") / "scene", step=2)


def prepared(folder: Path, step: int) -> Scene:
    scene = write_planes(folder, step=step, square=True)
    for i in scene.train_frames:
        scene.write_mask(i, scene.truth.mask(i))
    scene.finish_prior("masks", method="truth")
    prepare_priors(scene, PriorsOptions())
    return scene


def write_depth(scene: Scene, folder: Path, error: float) -> Path:
    """True depth under another scale in every frame, wrong by ``error`` in ln over tiles of 16 pixels where nothing moves."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    rows, columns = -(-scene.height // 16), -(-scene.width // 16)
    off = np.kron(error * rng.standard_normal((rows, columns)), np.ones((16, 16)))[: scene.height, : scene.width]
    for i in scene.train_frames:
        inverse = np.exp(np.where(scene.truth.mask(i) > 0, 0, off)) / scene.truth.depth(i).depth
        np.save(folder / f"{i:05d}.npy", (rng.uniform(2, 5) / inverse).astype(np.float32))
    return folder


def given(folder: Path, kind: str = "depth") -> PriorsOptions:
    return PriorsOptions(given=GivenPriors(object_depth=folder, depth_kind=kind))


def place(scene: Scene, options: PriorsOptions):
    """Return the square, placed anew."""
    PRIORS.forget(scene, ["depth"])
    prepare_priors(scene, options)
    (obj,) = load_objects(scene).objects
    return obj


def test_it_places_what_nothing_ties(scene: Scene, tmp_path: Path):
    (before,) = load_objects(scene).objects
    assert not before.cues
    options = given(write_depth(scene, tmp_path / "good", 0.02))
    still = scene.depth(4).depth[scene.mask(4) == 0]
    assert set(prepare_priors(scene, options)) == {"depth", "given"}
    (obj,) = load_objects(scene).objects
    assert list(obj.cues) == ["monocular"]
    assert np.exp(np.nanmedian(obj.log_depth)) == pytest.approx(WALL / 2, rel=0.08)
    assert obj.cues["monocular"].sigma == pytest.approx(0.03, abs=0.015)
    assert obj.sigma < 0.5 * before.sigma
    np.testing.assert_array_equal(scene.depth(4).depth[scene.mask(4) == 0], still)  # all else stays what the images show
    assert scene.prior("objects")["monocular"] == "given"
    assert "helps to place 1 of them" in scene.prior("objects")["verdict"]
    assert not (scene.folder / "monocular").exists()
    assert not prepare_priors(scene, options)
    assert not prepare_priors(scene, PriorsOptions())


def test_a_bare_wall_does_not_tell_the_shift(scene: Scene, tmp_path: Path):
    folder = tmp_path / "disparity"
    folder.mkdir()
    for i in scene.train_frames:
        np.save(folder / f"{i:05d}.npy", 1 / scene.truth.depth(i).depth)
    assert not place(scene, given(folder, "disparity")).cues


def test_what_runs_the_other_way_round_is_not_used():
    measured = np.tile(np.linspace(1, 2, 60, dtype=np.float32), (40, 1))

    class Clip:
        median = 1.5

        def __len__(self) -> int:
            return 1

    class Static:
        def fill(self, k: int):
            return measured, np.full_like(measured, 9.0)

        def mask(self, k: int):
            return np.zeros(measured.shape, np.uint8)

    class Maps:
        clip = Clip()
        source = Monocular("a test", "a test", True, lambda i: (measured, measured))

        def __init__(self, slope: float):
            self._slope = slope

        def small(self, k: int):
            return (self._slope * measured + 5).astype(np.float32), np.ones_like(measured)

    right, turned = (MonocularDistances(Maps(slope), Static())._fit(0) for slope in (2.0, -2.0))
    assert turned is None
    np.testing.assert_allclose(right.error, 0, atol=0.01)
    assert right.line == pytest.approx((0.5, -2.5), abs=0.02)


def test_what_is_wrong_where_nothing_moves_is_not_believed(scene: Scene, tmp_path: Path):
    bad = place(scene, given(write_depth(scene, tmp_path / "bad", 0.3)))
    # The error of a tile, averaged over an area as large as the square: three tiles.
    assert bad.cues["monocular"].sigma == pytest.approx(ERROR_RATIO * 0.3 / np.sqrt(3), rel=0.5)
    good = place(scene, given(write_depth(scene, tmp_path / "good", 0.02)))
    assert bad.sigma > good.sigma
    assert abs(np.log(np.exp(np.nanmedian(bad.log_depth)) / (WALL / 2))) < 2 * bad.sigma


def test_without_parallax_it_carries_all_depth(tmp_path: Path):
    scene = prepared(tmp_path / "still", step=0)
    assert scene.prior("depth")["method"] == "guess"
    options = given(write_depth(scene, tmp_path / "depth", 0.0))
    assert "depth" in prepare_priors(scene, options)
    depth, mask = scene.depth(4).depth, scene.mask(4) > 0
    assert np.median(depth[~mask]) / np.median(depth[mask]) == pytest.approx(2, rel=0.1)
    assert scene.prior("depth")["method"] == "guess"  # its scale is one
    assert "the same for the whole clip" in scene.prior("depth")["verdict"]
    assert not prepare_priors(scene, options)


@pytest.mark.parametrize(("sigma", "helps"), [(0.05, True), (0.5, False)])
def test_what_is_less_sure_than_the_rest_changes_nothing(sigma: float, helps: bool):
    stands = Cue(0.3, 0.06, 0.2)
    none = np.zeros(0)
    alone, _ = _distance(0.0, {}, stands, None, none)
    both, cues = _distance(0.0, {}, stands, None, none, Cue(0.1, sigma, 0.1))
    assert ("monocular" in cues) == helps
    assert (both == alone) == (not helps)
    if helps:
        assert 0.1 < both.log_scale < 0.3
        assert both.sigma < alone.sigma


def test_errors_of_areas():
    error, sure = np.full((40, 60), 0.1, np.float32), np.ones((40, 60), np.float32)
    sure[:, 30:] = 0
    found = _area_errors(error * sure, sure, 8)
    np.testing.assert_allclose(found, 0.1, rtol=1e-5)
    assert 40 < len(found) < 100


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (PriorsOptions(object_depth="depth-pro", depth="depth-anything"), "leave out what takes other depth"),
        (PriorsOptions(object_depth="depth-pro", given=GivenPriors(object_depth=Path("x"))), "give one of them"),
        (PriorsOptions(given=GivenPriors(object_depth=Path("nowhere"))), "nowhere does not exist"),
    ],
)
def test_what_contradicts_itself_is_refused(scene: Scene, options: PriorsOptions, says: str):
    PRIORS.forget(scene, ["depth"])
    with pytest.raises(InputError, match=says):
        prepare_priors(scene, options)
