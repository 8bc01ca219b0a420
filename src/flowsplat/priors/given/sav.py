"""Masks of Segment Anything Video: ``<video>_manual.json`` and ``<video>_auto.json``.

https://github.com/facebookresearch/sam2/tree/main/sav_dataset: ``masklet`` holds for every annotated frame (every fourth of the
video) a list with one mask an object, in COCO's run lengths: {size: [height, width], counts}.
"""

from __future__ import annotations

from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json
from flowsplat.images.header import MAX_PIXELS
from flowsplat.priors.given.fitting import require_frames
from flowsplat.scenes import Scene

_MAX_BYTES = 64 * 2**20
"""Of a file. Chosen by eye."""
ANNOTATED = 4
"""Of so many frames of a video one is annotated."""
MAX_RUN_BYTES = 7
"""Characters of one run length: more than a whole number of 32 bits needs."""


def read_masklets(path: Path, scene: Scene) -> list[Any]:
    """Return the masks of every frame, as they are in the file.

    Raises:
        InputError: damaged, or not one list a frame.
    """
    content = read_json(path, most=_MAX_BYTES)
    masklets = content.get("masklet") if isinstance(content, dict) else None
    if not isinstance(masklets, list) or not all(isinstance(each, list) for each in masklets):
        raise InputError(f"{path} holds no masks as Segment Anything Video has them: masklet, a list a frame of masks.")
    if len(masklets) == -(-scene.num_frames // ANNOTATED) != scene.num_frames:
        raise InputError(
            f"{path} holds masks of {len(masklets)} frames, every fourth of its video: read the clip with --every {ANNOTATED}."
        )
    require_frames(path, len(masklets), scene, "lists of masks")
    return masklets


def decode_labels(where: Path, masks: list[Any]) -> np.ndarray:
    """Return [H, W] int32 of the masks of one frame: 1 for the first object, ..., small ones over large ones; 0 = background.

    Args:
        where: what to call them in an error.

    Raises:
        InputError: damaged, or of different sizes.
    """
    try:
        decoded = [decode_runs(mask) for mask in masks]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where} is no mask in COCO's run lengths: {error}.") from error
    if not decoded or len({mask.shape for mask in decoded}) > 1:
        raise InputError(f"{where} holds {len(decoded)} masks, of different sizes or none: give one an object.")
    labels = np.zeros(decoded[0].shape, np.int32)
    for k in sorted(range(len(decoded)), key=lambda k: -int(decoded[k].sum())):
        labels[decoded[k]] = k + 1
    return labels


def decode_runs(mask: dict[str, Any]) -> np.ndarray:
    """Return [H, W] bool of COCO's run lengths, packed in text or as a list: of what is not and what is of the object in turn, down
    the columns (https://github.com/cocodataset/cocoapi/blob/master/common/maskApi.c, ``rleFrString``).

    Raises:
        KeyError, TypeError, ValueError, OverflowError: it is none.
    """
    height, width = (int(side) for side in mask["size"])
    if min(height, width) < 1 or height * width > MAX_PIXELS:
        raise ValueError(f"its size is {width} x {height}")
    counts = mask["counts"]
    runs = _unpack_runs(counts) if isinstance(counts, str) else [int(count) for count in counts]
    if any(run < 0 for run in runs) or sum(runs) != height * width:
        raise ValueError(f"its runs do not fill {width} x {height} pixels")
    values = np.zeros(height * width, bool)
    ends = list(accumulate(runs))
    for start, end in zip(ends[::2], ends[1::2], strict=False):
        values[start:end] = True
    return values.reshape(width, height).T


def _unpack_runs(text: str) -> list[int]:
    """Return run lengths out of text: six bits a character, five of them a part of the number, the lowest first, and whether more
    follow; from the third run on as the difference from the one before the last."""
    runs: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64 or shift >= 5 * MAX_RUN_BYTES:
            raise ValueError("its counts are no packed run lengths")
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        value -= (1 << shift) if bits & 16 else 0  # the sign
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    if shift:
        raise ValueError("its counts end within a number")
    return runs
