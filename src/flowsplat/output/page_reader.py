"""Read the scene inside a page that ``flowsplat export --to html`` wrote. Needs NumPy, and not torch.

docs/container.md describes the layout, for readers in other languages; this is the one to compare them with.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from typing_extensions import TypedDict

from flowsplat.common.errors import InputError
from flowsplat.common.files.json_file import Count, Number, Pixels, Positive, SimilarityFile, Text, decode_json
from flowsplat.common.files.opening import read_bytes
from flowsplat.output.text_encoding import decode_text

VERSION = 2
MAX_PAGE_BYTES = 2**30
"""Bytes of a page; one of a million Gaussians has 50 million. A round number."""
MAX_RATIO = 50
"""Times as large as they are in the page that the arrays may become; those of trained scenes become less than 5 times as large.
Chosen by eye."""
MAX_EXPONENT = 80.0
"""Largest logarithm of a scale, a precision or a brightness whose exponential is a float32. A round number."""
_MIN_BOUND_BYTES = 2**24
"""Bytes that they may have whatever the page has. A round number."""

_SHOTS_ELEMENT = re.compile(rb'<script type="application/json" class="page">')
_HEADER_ELEMENT = re.compile(rb'<script id="about" type="application/json">([^<]*)</script>')
_DATA_ELEMENT = re.compile(rb'<script id="data" type="[^"<>]*">([^<]*)</script>')


class ArrayFile(TypedDict):
    """What the header says of an array."""

    name: Text
    bits: Literal[8, 16, 24]
    count: Count
    components: Annotated[int, Meta(ge=0, le=1000)]
    chunk: Annotated[int, Meta(ge=1, le=10_000_000)]
    delta: bool


class HeaderFile(TypedDict):
    """The header; more may stand there."""

    version: Count
    title: Text
    width: Pixels
    height: Pixels
    first: Number
    last: Number
    frames: Count
    bytes: Annotated[int, Meta(ge=0, le=MAX_PAGE_BYTES)]
    resting: Count
    moving: Count
    objects: list[tuple[Count, Count]]
    shDegree: Annotated[int, Meta(ge=0, le=3)]
    gains: Annotated[int, Meta(ge=0, le=100)]
    pMin: Annotated[float, Meta(gt=0, lt=1)]
    near: Positive
    eps2d: Number
    focal: Number
    similarity: SimilarityFile
    arrays: Annotated[list[ArrayFile], Meta(max_length=100)]
    clipPath: list[tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number, Number, Number, Number]]


@dataclass(frozen=True)
class GaussiansAtTime:
    """Static Gaussians, in the normalized coordinates of the page. N Gaussians, those at rest first.

    Attributes:
        means: [N, 3] float32
        quats: [N, 4] float32, wxyz, unit length.
        scales: [N, 3] float32, standard deviations.
        opacities: [N] float32; 0 of what is not there at the time.
        sh: [N, K, 3] float32, harmonics as in 3D Gaussian Splatting.
        gains: [N] float32 by which the color that they give is multiplied.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    gains: np.ndarray


@dataclass(frozen=True)
class PageScene:
    """A scene as a page holds it. N Gaussians, of which the last M move.

    Attributes:
        header: as ``HeaderFile``.
        arrays: float32 [count, components] by name.
    """

    header: dict[str, Any]
    arrays: dict[str, np.ndarray]

    def __len__(self) -> int:
        """N."""
        return int(self.header["resting"] + self.header["moving"])

    @property
    def object_ids(self) -> np.ndarray:
        """[N] uint8, the number of the object that each belongs to; 0: none."""
        found = self.arrays.get("object_ids")
        return np.zeros(len(self), np.uint8) if found is None else np.rint(found[:, 0]).astype(np.uint8)

    @property
    def slopes(self) -> np.ndarray:
        """[N, 2] float32, how much brighter each gets along its first two axes, a standard deviation."""
        return self.arrays.get("slopes", np.zeros((len(self), 2), np.float32))

    def at(self, seconds: float) -> GaussiansAtTime:
        """Return the Gaussians at a time of the clip, in seconds; beyond its ends as there."""
        header, arrays, resting = self.header, self.arrays, self.header["resting"]
        span = header["last"] - header["first"]
        t = float(np.clip((seconds - header["first"]) / span, 0, 1)) if span > 0 else 0.0
        center, precision = arrays["times"][:, 0], np.exp(arrays["logLambdas"][:, 0])
        reach = np.sqrt(-2 * np.log(header["pMin"]) / precision)
        start, end = np.maximum(center - reach, 0), np.minimum(center + reach, 1)
        s = (t - (start + end) / 2) / np.maximum((end - start) / 2, 1e-6)
        presence = np.exp(-precision * (t - center) ** 2 / 2)
        means, quats, opacities = arrays["means"].copy(), arrays["quats"].copy(), arrays["opacities"][:, 0].copy()
        means[resting:] += _chebyshev(arrays["meanCoefficients"], s, 3)
        quats[resting:] += _chebyshev(arrays["quatCoefficients"], s, 4)
        opacities[resting:] *= np.where(presence >= header["pMin"], presence, 0)
        quats /= np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
        gains = np.ones(len(self), np.float32)
        if header["gains"]:
            gains[:resting] = np.exp(arrays["gains"] @ np.cos(np.pi * t * np.arange(1, header["gains"] + 1)))
        sh = np.concatenate([arrays["colors"], *([arrays["harmonics"]] if header["shDegree"] else [])], 1)
        return GaussiansAtTime(
            means, quats, np.exp(arrays["logScales"]), opacities, sh.reshape(len(sh), sh.shape[1] // 3, 3), gains
        )


def read_page(path: str | Path) -> PageScene:
    """Read the scene of a page.

    Args:
        path: of the ``.html``, of one shot.

    Raises:
        InputError: it is missing, too large, damaged, of a newer version, or no such page.

    Examples:
        >>> scene = read_page("out/clip/export/scene.html")  # doctest: +SKIP
        >>> scene.at(1.5).means.shape  # doctest: +SKIP
        (246679, 3)
    """
    text = read_bytes(Path(path), MAX_PAGE_BYTES)
    if _SHOTS_ELEMENT.search(text):
        raise InputError(f"{path} plays several shots: export one of them, as in flowsplat export out/clip/shots/01 --to html.")
    header_text, data_text = _HEADER_ELEMENT.search(text), _DATA_ELEMENT.search(text)
    if header_text is None or data_text is None:
        raise InputError(f"{path} is no page that plays a scene: flowsplat export RUN --to html writes one.")
    header: dict[str, Any] = decode_json(f"{path}, the header,", header_text[1])
    version = header.get("version") if isinstance(header, dict) else None
    if isinstance(version, int) and version != VERSION:
        of = "a newer flowsplat. Update flowsplat" if version > VERSION else "an earlier flowsplat: export it again"
        raise InputError(f"{path} is of {of}.")
    header = decode_json(f"{path}, the header,", header_text[1], HeaderFile)
    _check_header(path, header)
    try:
        packed = decode_text(data_text[1].decode(), header["bytes"])
    except ValueError as error:
        raise InputError(f"{path} is damaged: its data cannot be read.") from error
    except MemoryError as error:
        raise InputError(f"There is not enough memory to read {path}.") from error
    arrays = _read_arrays(path, header["arrays"], packed)
    for name, terms in (("logScales", 1), ("logLambdas", 1), ("gains", max(header["gains"], 1))):
        if name in arrays and np.abs(arrays[name]).max(initial=0) > MAX_EXPONENT / terms:
            raise InputError(f"{path} is damaged: its array {name} has values that no scene has.")
    return PageScene(header, arrays)


def _check_header(path: str | Path, header: dict[str, Any]) -> None:
    """Refuse a header whose arrays are not those of a scene."""
    resting, moving, degree = header["resting"], header["moving"], header["shDegree"]
    count = resting + moving
    found = {array["name"]: array for array in header["arrays"]}
    wanted = {
        "means": (count, 3), "quats": (count, 4), "logScales": (count, 3), "opacities": (count, 1), "colors": (count, 3),
        "times": (moving, 1), "logLambdas": (moving, 1), "meanCoefficients": (moving, 3), "quatCoefficients": (moving, 4),
    }  # fmt: skip
    if degree:
        wanted["harmonics"] = (count, 3 * ((degree + 1) ** 2 - 1))
    if header["gains"]:
        wanted["gains"] = (resting, header["gains"])
    optional = {"slopes": (count, 2), "object_ids": (count, 1), "logReaches": (resting, 1)}
    for name, (rows, components) in (wanted | {name: shape for name, shape in optional.items() if name in found}).items():
        array = found.get(name)
        if array is None:
            raise InputError(f"{path} is damaged: it has no array {name}.")
        fits = array["components"] % components == 0 if name.endswith("Coefficients") else array["components"] == components
        if array["count"] != rows or not fits:
            raise InputError(f"{path} is damaged: its array {name} has {array['count']} rows of {array['components']} numbers.")
    if len(found) != len(header["arrays"]):
        raise InputError(f"{path} is damaged: two of its arrays have one name.")


def _count_chunks(array: ArrayFile) -> int:
    return -(-array["count"] // array["chunk"])


def _count_bytes(array: ArrayFile) -> int:
    """Return its bytes: the steps of every chunk, and the rounded numbers."""
    return array["components"] * (4 * _count_chunks(array) + array["count"] * array["bits"] // 8)


def _read_arrays(path: str | Path, about: list[ArrayFile], packed: bytes) -> dict[str, np.ndarray]:
    size = sum(map(_count_bytes, about))
    if size > max(MAX_RATIO * len(packed), _MIN_BOUND_BYTES):
        raise InputError(f"{path} is damaged: {len(packed):,} bytes are said to hold {size:,}.")
    try:
        body = zlib.decompressobj().decompress(packed, size + 1)
    except zlib.error as error:
        raise InputError(f"{path} is damaged: its data cannot be unpacked.") from error
    except MemoryError as error:
        raise InputError(f"There is not enough memory to read {path}.") from error
    if len(body) != size:
        raise InputError(f"{path} is damaged: its data have another size than its header says.")
    arrays, at = {}, 0
    for array in about:
        arrays[array["name"]] = _read_array(path, array, body[at : at + _count_bytes(array)])
        at += _count_bytes(array)
    return arrays


def _read_array(path: str | Path, about: ArrayFile, body: bytes) -> np.ndarray:
    """Return [count, components] float32."""
    count, components, chunk, chunks = about["count"], about["components"], about["chunk"], _count_chunks(about)
    step = np.frombuffer(body, "<f4", chunks * components).reshape(components, chunks)
    if not np.isfinite(step).all() or np.abs(step).max(initial=0) > 1e12:
        raise InputError(f"{path} is damaged: its array {about['name']} has steps that are no numbers.")
    planes = np.frombuffer(body[step.nbytes :], np.uint8).reshape(components, about["bits"] // 8, count)
    z = np.zeros((components, count), np.int64)
    for k in range(planes.shape[1]):
        z = z << 8 | planes[:, k]
    q = z >> 1 ^ -(z & 1)
    if about["delta"] and count:
        # Sums begin anew in every chunk.
        total = np.cumsum(q, axis=1)
        starts = np.arange(0, count, chunk)
        before = (total - q)[:, starts]
        q = total - before[:, np.arange(count) // chunk]
    return np.ascontiguousarray((step[:, np.arange(count) // chunk] * q.astype(np.float32)).T)


def _chebyshev(coefficients: np.ndarray, s: np.ndarray, components: int) -> np.ndarray:
    """Return [M, C], the sum of coefficients [M, D * C] of the polynomials of degree 1 to D at ``s`` [M], clipped to -1 to 1."""
    terms = coefficients.reshape(len(s), coefficients.shape[1] // components, components)
    degrees = np.arange(1, terms.shape[1] + 1)
    return np.einsum("mk,mkc->mc", np.cos(degrees * np.arccos(np.clip(s, -1, 1))[:, None]), terms).astype(np.float32)
