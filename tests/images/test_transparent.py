"""WebM with alpha, decoded as a browser does."""

from __future__ import annotations

import av
import numpy as np
import pytest

from flowsplat.images.transparent import webm_writer


def decoded(path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.metadata["ALPHA_MODE"] == "1"
        decoder = av.CodecContext.create("libvpx-vp9", "r")
        return [f.to_ndarray(format="rgba") for packet in container.demux(stream) if packet.size for f in decoder.decode(packet)]


def test_color_and_alpha_come_back(tmp_path):
    frames = []
    for k in range(5):
        frame = np.zeros((40, 61, 4), np.uint8)
        frame[10:30, 5 + 4 * k : 25 + 4 * k] = (220, 60, 30, 255)
        frame[32:38] = (40, 180, 60, 128)
        frames.append(frame)
    with webm_writer(tmp_path / "a.webm", 12.5) as write:
        for frame in frames:
            write(frame)
    found = decoded(tmp_path / "a.webm")
    assert len(found) == 5
    assert found[0].shape == (40, 62, 4), "padded to even sizes"
    for k, frame in enumerate(found):
        np.testing.assert_allclose(frame[20, 15 + 4 * k], frames[k][20, 15 + 4 * k], atol=8)
        np.testing.assert_allclose(frame[35, 30, 3], 128, atol=6)
        assert frame[3, 3, 3] < 6
        assert frame[:, 61, 3].max() < 40


@pytest.mark.parametrize("frame", [np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4, 4), np.float32)])
def test_other_frames_are_refused(tmp_path, frame):
    with pytest.raises(ValueError, match="H, W, 4"), webm_writer(tmp_path / "a.webm", 10) as write:
        write(frame)
    assert not list(tmp_path.iterdir())


def test_frames_of_one_size(tmp_path):
    def write_two_sizes() -> None:
        with webm_writer(tmp_path / "a.webm", 10) as write:
            write(np.zeros((16, 16, 4), np.uint8))
            write(np.zeros((16, 18, 4), np.uint8))

    with pytest.raises(ValueError, match="the first one"):
        write_two_sizes()
    with pytest.raises(ValueError, match="at least one"), webm_writer(tmp_path / "a.webm", 10):
        pass
