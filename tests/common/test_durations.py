"""Durations in words."""

import pytest

from flowsplat.common.durations import format_duration


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0, "0.0 s"), (59.94, "59.9 s"), (59.96, "1 min 0 s"), (245, "4 min 5 s"), (3599.6, "1 h 0 min"), (4800, "1 h 20 min")],
)
def test_in_words(seconds, words):
    assert format_duration(seconds) == words
