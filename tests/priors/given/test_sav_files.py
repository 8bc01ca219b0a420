"""Masks of Segment Anything Video, in COCO's packed run lengths."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.given.sav import decode_runs
from flowsplat.priors.prepare import use_given
from flowsplat.scenes import Scene

WIDTH, HEIGHT, FRAMES = 64, 40, 5


def make_scene(folder: Path, frames: int = FRAMES) -> Scene:
    """Frame 2 is held out."""
    return Scene.create(folder, name="s", source="", width=WIDTH, height=HEIGHT, timestamps=range(frames), holdout=3, source_fps=1)


def pack(mask: np.ndarray) -> dict[str, Any]:
    """As pycocotools encodes a mask [H, W], and SA-V stores it (rleToString of maskApi.c)."""
    flat = mask.T.ravel().astype(int)
    ends = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff([0, *([0] if flat[0] else []), *ends, len(flat)])
    text = ""
    for i, run in enumerate(runs):
        x = int(run) - (int(runs[i - 2]) if i > 2 else 0)
        more = True
        while more:
            c = x & 0x1F
            x >>= 5
            more = x != -1 if c & 0x10 else x != 0
            text += chr((c | 0x20 if more else c) + 48)
    return {"size": list(mask.shape), "counts": text}


def labels(i: int, scale: int = 1) -> np.ndarray:
    """A large object, and a small one on it that comes in the third frame."""
    found = np.zeros((HEIGHT * scale, WIDTH * scale), int)
    found[5 * scale : 25 * scale, (2 + i) * scale : (22 + i) * scale] = 1
    if i >= 2:
        found[8 * scale : 12 * scale, 10 * scale : 15 * scale] = 2
    return found


def sav(file: Path, frames: int = FRAMES, scale: int = 2, **change: Any) -> Path:
    """As the data set has it: the small object is part of the large one, and of size 0 before it comes."""
    masklet = [[pack(labels(i, scale) > 0), pack(labels(i, scale) == 2)] for i in range(frames)]
    content = {
        "video_id": "sav_000001", "video_duration": 4.0, "video_frame_count": 4.0 * frames, "video_height": float(HEIGHT * scale),
        "video_width": float(WIDTH * scale), "masklet": masklet, "masklet_id": [0, 1], "masklet_num": 2,
        "masklet_first_appeared_frame": [0.0, 2.0], "masklet_type": ["manual", "manual"], **change,
    }  # fmt: skip
    file.write_text(json.dumps(content))
    return file


def test_masks_are_those_of_the_frames(tmp_path: Path):
    scene = make_scene(tmp_path / "scene")
    use_given(scene, GivenPriors(masks=sav(tmp_path / "sav_000001_manual.json")))
    for i in scene.train_frames:
        np.testing.assert_array_equal(scene.mask(i), labels(i))
    np.testing.assert_array_equal(scene.heldout_masks.mask(2), labels(2) > 0)


def test_run_lengths_of_pycocotools():
    """What its encode (2.0) gave."""
    small = np.array([[0, 1, 1, 0], [0, 1, 0, 0], [1, 0, 0, 1]], bool)
    np.testing.assert_array_equal(decode_runs({"size": [3, 4], "counts": "231N30"}), small)
    large = np.zeros((500, 300), bool)
    large[3:400, 20:30] = large[100:420, 60:260] = large[0, 0] = True
    text = "01bh9\\<eZF" + "0" * 17 + "ig>cMdZA" + "0" * 397 + "l]c0"
    np.testing.assert_array_equal(decode_runs({"size": [500, 300], "counts": text}), large)


def test_run_lengths_of_any_mask():
    np.testing.assert_array_equal(decode_runs({"size": [2, 2], "counts": [1, 2, 1]}), [[False, True], [True, False]])
    noise = np.random.default_rng(0).random((37, 300)) < 0.3
    noise[:, 50:250] = False
    for mask in (noise, ~noise, np.zeros((4, 5), bool), np.ones((4, 5), bool)):
        np.testing.assert_array_equal(decode_runs(pack(mask)), mask)


def test_a_clip_of_all_frames_is_told_to_take_every_fourth(tmp_path: Path):
    with pytest.raises(InputError, match="masks of 5 frames, every fourth of its video: read the clip with --every 4"):
        use_given(make_scene(tmp_path / "scene", 4 * FRAMES), GivenPriors(masks=sav(tmp_path / "a.json")))


BAD = {
    "no masks": ({"masklet": 3}, "holds no masks as Segment Anything Video has them"),
    "too few": ({"masklet": [[]] * 4}, "holds 4 lists of masks, but the clip has 5"),
    "no object": ({"masklet": [[]] * 5}, "holds 0 masks"),
    "text": ({"masklet": [["a"]] * 5}, "no mask in COCO's run lengths"),
    "other letters": ({"masklet": [[{"size": [40, 64], "counts": "ab\u00e9"}]] * 5}, "no packed run lengths"),
    "an endless number": ({"masklet": [[{"size": [40, 64], "counts": "o" * 99}]] * 5}, "no packed run lengths"),
    "cut off": ({"masklet": [[{"size": [40, 64], "counts": "o"}]] * 5}, "end within a number"),
    "too short": ({"masklet": [[{"size": [40, 64], "counts": "4"}]] * 5}, "do not fill 64 x 40"),
    "too large": ({"masklet": [[{"size": [10**6, 10**6], "counts": "4"}]] * 5}, "its size is"),
    "another shape": ({"masklet": [[pack(np.zeros((40, 40)))]] * 5}, "another shape"),
    "inverted": ({"masklet": [[pack(labels(0) == 0)]] * 5}, "hardly anything rests"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, name: str):
    change, message = BAD[name]
    scene = make_scene(tmp_path / "scene")
    given = GivenPriors(masks=sav(tmp_path / "a.json", **change))
    with pytest.raises(InputError, match=message) as caught:
        use_given(scene, given)
    assert "\n" not in str(caught.value)
    assert scene.prior("masks") is None
