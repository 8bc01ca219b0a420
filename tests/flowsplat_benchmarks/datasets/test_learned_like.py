"""Stand-ins for learned priors are as wrong as they say."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.priors.options import PriorsOptions
from flowsplat.scenes.clip import InputOptions
from flowsplat_benchmarks.datasets.learned_like import BLUR, FLICKER, StandIn, write_depth, write_masks

SIZE = (270, 480)


class Rig:
    """A slanted wall, and a square that moves before it."""

    def mask(self, i: int) -> np.ndarray:
        mask = np.zeros(SIZE, np.uint8)
        mask[100:160, 50 + 5 * i : 110 + 5 * i] = 2
        return mask

    def depth(self, i: int):
        class Known:
            depth = np.where(self.mask(i) > 0, 3, np.linspace(4, 9, SIZE[1])[None]).astype(np.float32)

        return Known()


@pytest.mark.parametrize("error", [0.0, 0.08])
def test_depth_is_off_as_much_as_it_says(tmp_path: Path, error: float):
    rig, frames = Rig(), (0, 23)
    off = []
    for seed in range(4):
        write_depth(rig, frames, tmp_path / str(seed), error, seed)
        for i in frames:
            values = np.load(tmp_path / str(seed) / f"{i:05d}.npy").astype(np.float64)
            assert (values > 0).all()
            inner = cv2.erode((rig.mask(i) == 0).astype(np.uint8), np.ones((13, 13))) > 0
            x, y = values[inner], 1 / rig.depth(i).depth[inner]
            fitted = np.polyval(np.polyfit(x, y, 1, w=1 / y), x)
            off.append(np.log(fitted / y))
    spread = np.std(np.concatenate(off))
    assert spread == pytest.approx(np.hypot(error, FLICKER), rel=0.35)
    assert BLUR > 0


def test_the_error_of_an_object_moves_with_it(tmp_path: Path):
    rig, error = Rig(), 0.08
    frames = (2, 20)
    write_depth(rig, frames, tmp_path, error, 0)
    ratios = []
    for i in frames:
        values = np.load(tmp_path / f"{i:05d}.npy").astype(np.float64)
        inner = cv2.erode((rig.mask(i) > 0).astype(np.uint8), np.ones((13, 13))) > 0
        ratios.append(values[inner].reshape(48, 48) / values[inner].mean())
    # Scale, shift and flicker are their own in every frame; what lasts is the same pattern.
    assert np.corrcoef(ratios[0].ravel(), ratios[1].ravel())[0, 1] > 0.7


def test_masks_are_off_as_much_as_they_say_and_one_is_lost(tmp_path: Path):
    rig = Rig()
    write_masks(rig, range(24), tmp_path / "off", 2, 0)
    masks = [cv2.imread(str(tmp_path / "off" / f"{i:05d}.png"), cv2.IMREAD_UNCHANGED) for i in range(24)]
    assert sum(not mask.any() for mask in masks) == 10
    sides = {int((mask[130] > 0).sum()) for mask in masks if mask.any()}
    assert sides in ({64}, {56})
    write_masks(rig, range(24), tmp_path / "true", 0, 0)
    for i in range(24):
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "true" / f"{i:05d}.png"), cv2.IMREAD_UNCHANGED), rig.mask(i))


def test_a_run_is_given_what_it_says(runs_root: Path, tmp_path: Path):
    stand_in = StandIn("cue", 0.04, "given", 2, 1)
    options = stand_in.give(runs_root / "rig" / "tiny", InputOptions(every=1), tmp_path, PriorsOptions())
    assert options.given.object_depth is not None
    assert len(list(options.given.object_depth.glob("*.npy"))) > 2
    assert options.given.masks is not None
    assert len(list(options.given.masks.glob("*.png"))) > 2
    assert options.given.depth is None
    assert stand_in.words == "depth 4% off as a cue, masks 2 pixels off, noise 1"
    everything = StandIn("all", masks="own").give(runs_root / "rig" / "tiny", InputOptions(every=1), tmp_path, PriorsOptions())
    assert everything.given.depth is not None
    assert everything.given.masks is None
