"""Options of videos that would never end are refused before anything is rendered."""

from __future__ import annotations

from dataclasses import replace

import pytest

from flowsplat.common.errors import InputError
from flowsplat.output.videos.options import RenderOptions, check_options


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("max_frames", 10**9, "2 to 100,000"),
        ("slow_motion", 1e30, "slower"),
        ("slow_motion", 0.0, "slower"),
        ("width", 10**6, "16 to 8192"),
    ],
)
def test_values_beyond_what_can_be_made(name, value, words):
    with pytest.raises(InputError, match=words):
        check_options(replace(RenderOptions(), **{name: value}), 24, 0, 4)


def test_a_clip_of_months_makes_no_video():
    check_options(RenderOptions(), 24, 0, 4000)
    with pytest.raises(InputError, match="240,000,000 frames cannot be made"):
        check_options(RenderOptions(), 24, 0, 1e7)
