"""Decoded video frames to RGB: matrix, range, bit depth, wide gamut, and high dynamic range to what a screen shows.

The numbers of matrices, transfers and primaries are those of ITU-T H.273, which FFmpeg uses as they are. Ordinary video (BT.601
and BT.709, any bit depth) keeps its code values, as every player shows it. High dynamic range (PQ and HLG, ITU-R BT.2100)
becomes light relative to reference white at 203 cd/m2 (ITU-R BT.2408), is brought to BT.709 primaries, softly clipped above
``HIGHLIGHT_KNEE`` of white, and encoded as sRGB. Wide gamut without high dynamic range (Display P3, BT.2020) only changes
primaries.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import av
import numpy as np

from flowsplat.common.errors import InputError

UNSPECIFIED = 2
"""FFmpeg's number of a color space that is not told."""
MATRICES = {1, 4, 5, 6, 7, 9}
"""What can be undone: BT.709, FCC, BT.601 (625 and 525 lines), SMPTE 240M, BT.2020."""
BT601, BT709, BT2020 = 5, 1, 9
"""FFmpeg's numbers of the color spaces (ITU-T H.273)."""
LIMITED, FULL = 1, 2
"""FFmpeg's numbers of the color ranges: limited (16 to 235) and full (0 to 255)."""
PQ, HLG = 16, 18
"""Numbers of the transfer functions of high dynamic range (ITU-T H.273)."""
GAMUTS = {9: "BT.2020", 11: "DCI-P3", 12: "Display P3"}
"""Primaries that are wider than a screen's."""
CHROMATICITIES = {
    BT709: ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060)),
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    11: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
}
WHITE_POINT = (0.3127, 0.3290)
"""CIE x and y of D65."""
REFERENCE_WHITE = 203.0
"""cd/m2 that become white."""
HLG_PEAK = 1000.0
"""cd/m2 of the display that HLG is shown on, at which its system gamma is 1.2."""
HIGHLIGHT_KNEE = 0.8
"""Light relative to white above which highlights are compressed. Chosen by eye."""
STANDARD_DEFINITION = 576
"""Lines up to which video without a tag is taken for BT.601."""

# swscale's flags BILINEAR | FULL_CHR_H_INT | FULL_CHR_H_INP | ACCURATE_RND | BITEXACT, as numbers because older PyAV has no
# names for all. Chroma at full resolution: the fast paths are off by up to three levels. Bit-exact: the same on every machine.
_SCALING = 0x2 | 0x2000 | 0x4000 | 0x40000 | 0x80000


@dataclass(frozen=True)
class VideoColors:
    """How the colors of a video are encoded (H.273 numbers), with what the file leaves open filled in."""

    matrix: int
    full_range: bool
    transfer: int
    primaries: int
    bits: int

    @property
    def is_hdr(self) -> bool:
        """Whether the transfer function is PQ or HLG."""
        return self.transfer in (PQ, HLG)

    @property
    def is_plain(self) -> bool:
        """Whether the code values after the matrix are what a screen shows."""
        return not self.is_hdr and self.primaries not in GAMUTS

    @property
    def notes(self) -> list[str]:
        """What is converted that the user may not expect."""
        if self.is_hdr:
            name = "PQ" if self.transfer == PQ else "HLG"
            return [f"High dynamic range ({name}, {self.bits} bits) was tone-mapped to ordinary 8-bit colors."]
        if not self.is_plain:
            return [f"Wide-gamut colors ({GAMUTS[self.primaries]}) were converted to BT.709."]
        return [f"{self.bits}-bit colors were reduced to 8 bits."] if self.bits > 8 else []


def colors_of(frame: av.VideoFrame, source: str) -> VideoColors:
    """Read the color tags of a decoded frame.

    Raises:
        InputError: the matrix is none that can be undone.
    """
    layout = frame.format
    transfer, primaries, matrix = int(frame.color_trc), int(frame.color_primaries), int(frame.colorspace)
    is_hdr = transfer in (PQ, HLG)
    if layout.is_rgb or layout.has_palette:
        matrix, full_range = BT709, True
    else:
        if matrix in (0, UNSPECIFIED):
            matrix = BT2020 if is_hdr else BT601 if frame.height <= STANDARD_DEFINITION else BT709
        range_is_implied = layout.name.startswith(("yuvj", "gray"))
        full_range = frame.color_range == FULL or (frame.color_range != LIMITED and range_is_implied)
    if matrix not in MATRICES:
        raise InputError(
            f"{source} encodes its colors in a rare way (matrix {matrix} of H.273): convert it to ordinary H.264 video first."
        )
    if is_hdr and primaries not in CHROMATICITIES:
        primaries = BT2020
    bits = max(component.bits for component in layout.components)
    return VideoColors(matrix, full_range, transfer, primaries, bits)


def decode_rgb(frame: av.VideoFrame, colors: VideoColors) -> np.ndarray:
    """Undo matrix and range: [H, W, 3] uint8 where the colors are plain, else uint16 code values for ``to_srgb``."""
    # As tags of the frame and not as arguments, because older PyAV takes no BT.2020 there.
    frame.colorspace, frame.color_range = colors.matrix, FULL if colors.full_range else LIMITED
    # Planar for 16 bits: swscale's packed rgb48 is wrong with chroma at full resolution.
    rgb = frame.reformat(
        format="rgb24" if colors.is_plain else "gbrp16le",
        dst_color_range=FULL,
        interpolation=_SCALING,
    )
    return rgb.to_ndarray()


def to_srgb(codes: np.ndarray, colors: VideoColors) -> np.ndarray:
    """Code values [H, W, 3] of ``decode_rgb`` to sRGB [H, W, 3] uint8."""
    if colors.is_plain:
        return codes
    light = _light_table(colors.transfer)[codes]
    if colors.transfer == HLG:
        # The system gamma of BT.2100: light of the display from light of the scene, by the scene's luminance.
        luminance = light @ _rgb_to_xyz(BT2020)[1].astype(np.float32)
        light = light * np.maximum(luminance, 1e-6)[..., None] ** np.float32(0.2) * np.float32(HLG_PEAK / REFERENCE_WHITE)
    light = np.maximum(light @ gamut_matrix(colors.primaries).T.astype(np.float32), 0)
    if colors.is_hdr:
        light = compress_highlights(light)
    return np.rint(_encode_srgb(np.minimum(light, 1)) * 255).astype(np.uint8)


def compress_highlights(light: np.ndarray) -> np.ndarray:
    """Bring light [..., 3] of any strength to at most 1: unchanged up to ``HIGHLIGHT_KNEE``, smooth beyond, with its hue kept."""
    peak = light.max(-1, keepdims=True)
    room = 1 - HIGHLIGHT_KNEE
    compressed = HIGHLIGHT_KNEE + room * (1 - np.exp(-(np.maximum(peak, HIGHLIGHT_KNEE) - HIGHLIGHT_KNEE) / room))
    return np.where(peak > HIGHLIGHT_KNEE, light * (compressed / np.maximum(peak, HIGHLIGHT_KNEE)), light)


@cache
def gamut_matrix(primaries: int) -> np.ndarray:
    """Return [3, 3] linear RGB of H.273 ``primaries`` to linear RGB of BT.709."""
    return np.linalg.inv(_rgb_to_xyz(BT709)) @ _rgb_to_xyz(primaries if primaries in CHROMATICITIES else BT709)


@cache
def _rgb_to_xyz(primaries: int) -> np.ndarray:
    xyz = np.array([(x / y, 1, (1 - x - y) / y) for x, y in CHROMATICITIES[primaries]]).T
    x, y = WHITE_POINT
    return xyz * np.linalg.solve(xyz, [x / y, 1, (1 - x - y) / y])


@cache
def _light_table(transfer: int) -> np.ndarray:
    """Return [65536] float32: code value to light; relative to reference white, for HLG scene light between 0 and 1."""
    signal = np.arange(65536) / 65535
    if transfer == PQ:
        m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
        root = signal ** (1 / m2)
        light = (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1) * 10000 / REFERENCE_WHITE
    elif transfer == HLG:
        a = 0.17883277
        b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
        light = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    else:
        light = np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)


def _encode_srgb(light: np.ndarray) -> np.ndarray:
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * np.maximum(light, 1e-8) ** (1 / 2.4) - 0.055)
