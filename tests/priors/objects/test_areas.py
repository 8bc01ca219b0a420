"""What counts as an object."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from flowsplat.priors.objects.areas import describe_count, large_objects


def test_shreds_are_no_objects():
    masks = np.zeros((3, 40, 40), np.uint8)
    masks[:, :20, :20] = 1
    masks[0, 30:40, 30:40] = 2  # 100 of 1200
    masks[1, 30:35, 30:40] = 4  # 50 of 1200
    scene = SimpleNamespace(train_frames=[0, 1, 2], mask=lambda i: masks[i])
    assert large_objects(scene) == {1, 2}
    masks[:] = 0
    assert large_objects(scene) == set()


@pytest.mark.parametrize(
    ("count", "small", "words"),
    [
        (0, 0, "nothing moves"), (1, 0, "1 moving object"), (2, 1, "2 moving objects and 1 small part"),
        (1, 7, "1 moving object and 7 small parts"),
    ],
)  # fmt: skip
def test_in_words(count, small, words):
    assert describe_count(count, small) == words
