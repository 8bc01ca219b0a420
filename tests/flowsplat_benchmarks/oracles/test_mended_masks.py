"""Ids are the true ones, what rests goes to what it hangs together with, and only what was found becomes whole."""

from __future__ import annotations

import numpy as np

from flowsplat.scenes import Scene
from flowsplat_benchmarks.oracles import mended_masks
from flowsplat_benchmarks.oracles.mended_masks import correct_ids, mend_masks
from flowsplat_benchmarks.oracles.objects import MIN_PIXELS
from tests.flowsplat_benchmarks.oracles.conftest import SHADOW

OWNER = {4: 1, 5: 2, 9: 3}


def test_two_bodies_in_one_number_are_two():
    mask, true = np.uint8([[4, 4, 4, 4, 4, 0, 4]]), np.uint8([[1, 1, 0, 2, 2, 2, 2]])
    assert correct_ids(mask, true, OWNER)[0, [0, 1, 3, 4, 5, 6]].tolist() == [1, 1, 2, 2, 0, 2]


def test_a_shadow_keeps_to_what_it_hangs_together_with():
    """The nearer object is another one, which the mask does not reach."""
    mask, true = np.uint8([[5, 5, 5, 5, 0, 4]]), np.uint8([[2, 2, 0, 0, 0, 1]])
    assert correct_ids(mask, true, OWNER).tolist() == [[2, 2, 2, 2, 0, 1]]
    assert correct_ids(np.uint8([[5, 5, 0, 9]]), np.uint8([[0, 0, 0, 0]]), OWNER).tolist() == [[2, 2, 0, 3]], "by its number"


def test_what_is_on_nothing_keeps_a_number_of_its_own(wrong_scene):
    scene = Scene(wrong_scene)
    own = dict(mend_masks(scene, "ids"))
    i = scene.train_frames[0]
    here = own[i][scene.mask(i) == SHADOW]
    assert (here == 4).any()
    assert set(here) <= {1, 2, 3, 4}, "where it hangs together with an object it is that one's"
    assert not any((mask > 3).any() for _, mask in mend_masks(scene, "shadow"))


def test_only_what_was_found_becomes_whole():
    true = np.zeros((8, 32), np.uint8)
    true[:, :10], true[:, 20:] = 1, 2
    mask = np.zeros_like(true)
    mask[:4, :8] = 4
    mask[0, 20 : 20 + MIN_PIXELS // 2] = 5
    found = mended_masks._mend(mask, true, "parts", OWNER)
    np.testing.assert_array_equal(found == 1, true == 1)
    np.testing.assert_array_equal(found == 2, mask == 5)
    np.testing.assert_array_equal(mended_masks._mend(mask, true, "masks", OWNER), true)
