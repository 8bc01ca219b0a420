"""Colors of every encoding come out as the colors that went in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.formats.video import open_video
from flowsplat.scenes.formats.video_color import (
    BT709,
    HIGHLIGHT_KNEE,
    HLG,
    PQ,
    UNSPECIFIED,
    VideoColors,
    compress_highlights,
    gamut_matrix,
    to_srgb,
)

PATCHES = np.array([[200, 30, 60], [10, 220, 40], [30, 60, 210], [230, 230, 230], [20, 20, 20], [128, 128, 128], [240, 200, 20]])
P3 = 12


def chart(height: int = 64) -> np.ndarray:
    """One column of 32 pixels for each patch."""
    return np.broadcast_to(np.repeat(PATCHES, 32, 0), (height, 32 * len(PATCHES), 3)).astype(np.uint8)


def patches(path: Path) -> np.ndarray:
    """[7, 3] the middle of each patch in the first frame."""
    clip = open_video(path, InputOptions())
    frame = next(iter(clip.frames([0])))
    return frame[frame.shape[0] // 2, 16::32].astype(float)


@pytest.mark.parametrize("full_range", [False, True])
@pytest.mark.parametrize("matrix", [1, 5, 6, 7, 9])
@pytest.mark.parametrize(("codec", "pixels"), [("libx264", "yuv420p"), ("libx264", "yuv444p"), ("libx265", "yuv420p10le")])
def test_tagged(tmp_path, write_video, codec, pixels, matrix, full_range):
    path = write_video(tmp_path / "a.mp4", [chart()] * 3, codec=codec, pixels=pixels, matrix=matrix, full_range=full_range)
    assert np.abs(patches(path) - PATCHES).max() <= 4


@pytest.mark.parametrize(("height", "matrix"), [(480, 5), (576, 5), (578, 1), (720, 1)])
def test_untagged_by_height(tmp_path, write_video, height, matrix):
    path = write_video(tmp_path / "a.mp4", [chart(height)] * 2, matrix=matrix, tags={}, options={"preset": "ultrafast"})
    assert np.abs(patches(path) - PATCHES).max() <= 4


def test_lossless_rgb(tmp_path, write_video):
    path = write_video(tmp_path / "a.mkv", [chart()] * 2, codec="ffv1", pixels="bgr0", matrix=1, tags={}, options={})
    np.testing.assert_array_equal(patches(path), PATCHES)


def test_gray(tmp_path, write_video):
    path = write_video(tmp_path / "a.mkv", [chart()] * 2, codec="ffv1", pixels="gray", matrix=5, tags={}, full_range=True)
    got = patches(path)
    assert np.ptp(got, axis=1).max() == 0
    assert np.abs(got[3:6] - PATCHES[3:6]).max() <= 1


def test_unknown_matrix_is_refused(tmp_path, write_video):
    path = write_video(tmp_path / "a.mp4", [chart()] * 2, tags={"colorspace": 8})
    with pytest.raises(InputError, match="rare way"):
        open_video(path, InputOptions())


# -- high dynamic range and wide gamut


def pq(nits: np.ndarray) -> np.ndarray:
    """Signal 0 to 1 of light in cd/m2 (SMPTE ST 2084, in the published decimals)."""
    y = (np.asarray(nits, float) / 10000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * y) / (1 + 18.6875 * y)) ** 78.84375


def srgb(light: np.ndarray) -> np.ndarray:
    light = np.asarray(light, float)
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def codes(signal: np.ndarray) -> np.ndarray:
    return np.rint(np.asarray(signal) * 65535).astype(np.uint16)


def hdr(transfer: int, primaries: int = 9) -> VideoColors:
    return VideoColors(matrix=9, full_range=False, transfer=transfer, primaries=primaries, bits=10)


def test_pq_of_known_light():
    """Below the knee light is kept: 10 % and 50 % of the 203 cd/m2 of white; gray stays gray."""
    nits = np.array([0, 20.3, 101.5])
    got = to_srgb(codes(np.repeat(pq(nits)[:, None], 3, 1)), hdr(PQ))
    np.testing.assert_allclose(got, np.repeat(srgb([0, 0.1, 0.5])[:, None], 3, 1), atol=1)


def test_hlg_and_pq_agree():
    """BT.2408: 75 % HLG and 58 % PQ are both the 203 cd/m2 of white; BT.2100: 50 % HLG on a display of 1000 cd/m2 is 50.7."""
    for hlg, light in ((0.75, 203), (0.5, 50.7)):
        ours = to_srgb(codes(np.full((1, 3), hlg)), hdr(HLG)).astype(int)
        np.testing.assert_allclose(ours, to_srgb(codes(np.full((1, 3), pq(light))), hdr(PQ)), atol=1)


def test_highlights():
    light = np.linspace(0, 50, 2001, dtype=np.float32)[:, None] * np.array([1, 0.5, 0.25], np.float32)
    out = compress_highlights(light)
    assert out.max() <= 1
    assert np.diff(out, axis=0).min() > -1e-6
    np.testing.assert_array_equal(out[light[:, 0] <= HIGHLIGHT_KNEE], light[light[:, 0] <= HIGHLIGHT_KNEE])
    np.testing.assert_allclose(out[1:, 1] / out[1:, 0], 0.5, rtol=1e-5)


def test_gamuts():
    """White stays white; the published BT.2020 to BT.709 matrix (ITU-R BT.2087, annex 2)."""
    for primaries in (9, P3):
        np.testing.assert_allclose(gamut_matrix(primaries) @ np.ones(3), 1, atol=1e-12)
    published = [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
    np.testing.assert_allclose(gamut_matrix(9), published, atol=1e-4)
    np.testing.assert_array_equal(gamut_matrix(UNSPECIFIED), gamut_matrix(BT709))


@pytest.mark.parametrize("full_range", [False, True])
@pytest.mark.parametrize(("transfer", "name"), [(PQ, "PQ"), (HLG, "HLG")])
def test_hdr_video(tmp_path, write_video, transfer, name, full_range):
    """BT.709 colors of known light, written as HDR in BT.2020, come back as sRGB."""
    light = np.array([[0.7, 0.05, 0.05], [0.1, 0.6, 0.1], [0.05, 0.1, 0.5], [0.5, 0.5, 0.5], [0.02, 0.02, 0.02]])
    wide = light @ np.linalg.inv(gamut_matrix(9)).T * 203
    if transfer == PQ:
        signal = pq(wide)
    else:
        luminance = (wide / 1000) @ [0.2627, 0.6780, 0.0593]
        scene = wide / 1000 * luminance[:, None] ** (1 / 1.2 - 1)
        signal = np.where(
            scene <= 1 / 12, np.sqrt(3 * scene), 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
        )
    image = np.broadcast_to(codes(np.repeat(signal, 32, 0)), (64, 160, 3))
    color_range = 2 if full_range else 1
    path = write_video(
        tmp_path / "a.mkv",
        [image] * 2,
        codec="libx265",
        pixels="yuv444p10le",
        matrix=9,
        full_range=full_range,
        tags={"colorspace": 9, "color_range": color_range, "color_trc": transfer, "color_primaries": 9},
    )
    clip = open_video(path, InputOptions())
    assert name in " ".join(clip.notes)
    np.testing.assert_allclose(patches(path), srgb(light), atol=6)


def test_hdr_tags_are_enough(tmp_path, write_video):
    """A transfer of PQ without matrix and primaries means BT.2020."""
    tags = {"color_trc": PQ}
    path = write_video(
        tmp_path / "a.mp4",
        [chart()] * 2,
        codec="libx265",
        pixels="yuv420p10le",
        matrix=9,
        tags=tags,
    )
    colors = open_video(path, InputOptions()).colors
    assert (colors.matrix, colors.primaries, colors.is_hdr) == (9, 9, True)


def test_wide_gamut_video(tmp_path, write_video):
    """Gray stays as it is, Display P3 colors become stronger BT.709 ones."""
    tags = {"colorspace": 1, "color_range": 1, "color_trc": 1, "color_primaries": P3}
    path = write_video(tmp_path / "a.mp4", [chart()] * 2, tags=tags)
    got = patches(path)
    assert "Display P3" in " ".join(open_video(path, InputOptions()).notes)
    assert np.abs(got[3:6] - PATCHES[3:6]).max() <= 3
    expected = np.clip(gamut_matrix(P3) @ linear(PATCHES[6]), 0, 1)
    np.testing.assert_allclose(got[6], srgb(expected), atol=5)
    assert got[0, 0] > 205


def linear(code: np.ndarray) -> np.ndarray:
    signal = code / 255
    return np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)
