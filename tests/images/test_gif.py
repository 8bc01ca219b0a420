"""Animated GIFs."""

from __future__ import annotations

import av
import numpy as np
import pytest

from flowsplat.images.gif import write_gif


def test_frames_come_back_in_their_colors(tmp_path):
    ramp = np.add.outer(np.arange(30), np.arange(45))[..., None]
    frames = [np.clip(ramp * [1, 2, 3] + [40 * k, 0, 0], 0, 255).astype(np.uint8) for k in range(4)]
    write_gif(tmp_path / "a.gif", frames, 12.0)
    content = (tmp_path / "a.gif").read_bytes()
    assert content.startswith(b"GIF89a")
    assert b"NETSCAPE2.0" in content, "it loops"
    with av.open(str(tmp_path / "a.gif")) as container:
        assert container.streams.video[0].average_rate == pytest.approx(12.5)
        found = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(found) == 4
    for frame, expected in zip(found, frames, strict=True):
        assert np.abs(frame.astype(int) - expected).mean() < 8


def test_nothing_to_write(tmp_path):
    with pytest.raises(ValueError, match="at least one"):
        write_gif(tmp_path / "a.gif", [], 10)
