"""Choose which frames are held out: gaps of several lengths, and the end of the clip."""

from __future__ import annotations

from itertools import cycle

GAP_LENGTHS = (1, 3, 5)
"""Frames of the gaps, which take turns."""
END_LENGTH, END_SHARE = 3, 0.125
"""Frames that are held out at the end of the clip, and which share of it at most."""
HELDOUT_SHARE = 0.3
"""Share of the frames that is held out at most, so that a clip is still learned."""
MIN_FRAMES = 4
"""Of a clip in which that leaves room for a gap."""
END = "end"
"""What the frames at the end are called among the gaps."""


def place_gaps(count: int) -> dict[str, list[int]]:
    """Return the held-out frames of a clip of ``count`` frames by the length of their gap (``"1"``, ``"3"``, ``"5"``) and ``END``.

    Gaps are as far apart as they can be; a clip that is too short for a length has none of it, and one of fewer than
    ``MIN_FRAMES`` has none at all.

    >>> place_gaps(40)
    {'1': [9], '3': [18, 19, 20], '5': [29, 30, 31, 32, 33], 'end': [37, 38, 39]}
    """
    end = min(END_LENGTH, int(END_SHARE * count))
    lengths: list[int] = []
    for length in cycle(GAP_LENGTHS):
        if end + sum(lengths) + length > HELDOUT_SHARE * count:
            break
        lengths.append(length)
    between = (count - end - sum(lengths)) / (len(lengths) + 1)
    found: dict[str, list[int]] = {}
    passed = 0
    for k, length in enumerate(lengths):
        first = round((k + 1) * between) + passed
        found.setdefault(str(length), []).extend(range(first, first + length))
        passed += length
    return {**found, **({END: list(range(count - end, count))} if end else {})}


def list_heldout(count: int) -> tuple[int, ...]:
    """Return the numbers of all of them, rising."""
    return tuple(sorted(i for frames in place_gaps(count).values() for i in frames))
