"""Repeated frames, blank ones and fades are left out, and nothing else is."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import cv2
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.scenes.clip import InputOptions, select_frames
from flowsplat.scenes.formats.images import read_input_image
from flowsplat.scenes.ingest import ingest, open_clip
from flowsplat.scenes.repeats import find_fades, find_repeats, measure_changes

COUNT = 30
BLACK = np.zeros((96, 160, 3), np.uint8)
REAL_CLIPS = ("bear", "camel", "train")


@cache
def texture(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    smooth = cv2.GaussianBlur(rng.normal(size=(200, 400, 3)).astype(np.float32), (0, 0), 3)
    return np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def pan(count: int = COUNT) -> list[np.ndarray]:
    """The camera moves, three pixels a frame."""
    return [texture()[50:146, 20 + 3 * i : 180 + 3 * i] for i in range(count)]


def still(count: int = COUNT, noise: float = 2.0) -> list[np.ndarray]:
    """The camera stands; something small moves, but for frames 12 to 19, and every image has noise of its own."""
    rng = np.random.default_rng(1)
    images = []
    for i in range(count):
        image = texture()[50:146, 20:180].astype(np.float32)
        x = 20 + 2 * (min(i, 12) if i < 20 else i - 7)
        image[40:60, x : x + 20] = texture(5)[:20, :20]
        images.append(np.clip(image + rng.normal(0, noise, image.shape), 0, 255).astype(np.uint8))
    return images


def repeat(images: list[np.ndarray], rate: float, to: float) -> tuple[list[np.ndarray], list[int]]:
    """The images at another rate, and at which of its frames each is first shown."""
    shown = [int(k * rate / to + 1e-9) for k in range(int(len(images) * to / rate))]
    return [images[i] for i in shown], [0, *(k + 1 for k, (a, b) in enumerate(pairwise(shown)) if a != b)]


def grays(images: list[np.ndarray]) -> list[np.ndarray]:
    return [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]


def steps(images: list[np.ndarray]) -> np.ndarray:
    return measure_changes(grays(images), len(images)).steps


@pytest.mark.parametrize("to", [60, 30, 48, 25, 120])
@pytest.mark.parametrize("options", [None, {"crf": "18"}, {"crf": "28"}])
def test_frames_that_repeat_are_left_out(write_video, tmp_path, to, options):
    """As they are, and encoded anew, after which twins differ."""
    images, first = repeat(pan(), 24, to)
    if options is None:
        np.testing.assert_array_equal(np.flatnonzero(~find_repeats(steps(images))), first)
        return
    path = write_video(tmp_path / "clip.mp4", images, rate=to, options=options)
    clip = open_clip(path, InputOptions(max_frames=1000))
    np.testing.assert_allclose(clip.timestamps, np.array(first) / to, atol=1e-3)
    assert f"Left out {len(images) - len(first)} of {len(images)} frames, which only repeat" in " ".join(clip.notes)
    assert open_clip(path, InputOptions(max_frames=1000, keep_all=True)).num_frames == len(images)
    for k, image in zip((1, 7, 20), clip.frames((1, 7, 20)), strict=True):
        assert np.argmin([np.abs(image.astype(int) - other).mean() for other in pan()]) == k


def test_held_out_frames_have_no_twins(write_video, write_image_file, tmp_path):
    """Of a video, and of a folder of its frames with masks."""
    images, first = repeat(pan(), 24, 60)
    write_video(tmp_path / "clip.mp4", images, rate=60, options={"crf": "20"})
    for k, image in enumerate(images):
        write_image_file(tmp_path / "clip" / "images" / f"{k:05d}.png", image)
        write_image_file(
            tmp_path / "clip" / "masks" / f"{k:05d}.png", np.pad(np.full((20, 20), 255, np.uint8), ((0, 76), (k, 140 - k)))
        )
    for name in ("clip.mp4", "clip"):
        options = InputOptions(fps=60)
        clip = open_clip(tmp_path / name, options)
        np.testing.assert_allclose(clip.timestamps, np.array(first) / 60, atol=1e-3)
        scene = ingest(clip, tmp_path / f"{name}-scene", options)
        shown = [scene.any_frame(t).astype(int) for t in range(scene.num_frames)]
        assert min(np.abs(a - b).mean() for a, b in pairwise(shown)) > 5
        assert scene.heldout_frames == [9, 19]
    assert (scene.mask(10) > 0).argmax(1).max() == first[10]


@pytest.mark.parametrize("noise", [0.0, 2.0, 6.0])
def test_a_still_camera_keeps_its_frames(write_video, tmp_path, noise):
    """Noise is no step, and a rest is none of a change of the rate, even where its frames are alike in every pixel."""
    assert not find_repeats(steps(still(60, noise))).any()
    for crf in ("18", "28"):
        path = write_video(tmp_path / f"{crf}.mp4", still(60, noise), options={"crf": crf})
        assert open_clip(path, InputOptions()).num_frames == 60


def test_a_rest_keeps_the_rate_of_the_others():
    """In a clip that repeats frames, a rest is neither left out nor kept with its twins."""
    images, first = repeat(still(60, noise=0.0), 24, 60)
    kept = np.flatnonzero(~find_repeats(steps(images)))
    assert abs(len(kept) - len(first)) <= 1
    resting = (kept > 12 * 2.5 + 1) & (kept < 19 * 2.5)
    assert 5 <= resting.sum() <= 8
    np.testing.assert_array_equal(kept[kept < 29], [k for k in first if k < 29])


@pytest.mark.parametrize("images", [[pan(1)[0]] * 12, pan(2), [BLACK] * 5, pan(6)[:3] + [pan(6)[2]] * 3])
def test_short_and_still_clips(images):
    assert not find_repeats(steps(images)).any()


def test_there_and_back():
    """The frame at which a clip turns round is there twice."""
    assert np.flatnonzero(find_repeats(steps(pan(8) + pan(8)[::-1]))).tolist() == [8]


@pytest.mark.parametrize("name", REAL_CLIPS)
def test_real_clips_keep_all_frames(data, name):
    images = [read_input_image(path) for path in sorted((data / "davis" / name / "images").iterdir())[:40]]
    small = [cv2.resize(image, (320, 180), interpolation=cv2.INTER_AREA) for image in images]
    assert not find_repeats(steps(small)).any()
    repeated, first = repeat(small, 24, 60)
    np.testing.assert_array_equal(np.flatnonzero(~find_repeats(steps(repeated))), first)


def test_a_second_at_two_rates(data):
    clips = [open_clip(data / "given" / "repeated_frames" / f"{name}.mp4", InputOptions()) for name in ("b24", "b60")]
    assert clips[0].num_frames == clips[1].num_frames
    assert np.abs(clips[0].timestamps - clips[1].timestamps).max() < 1 / 60
    assert [len(clip.notes) for clip in clips] == [0, 1]


def fade(images: list[np.ndarray], count: int, color: float = 0.0) -> list[np.ndarray]:
    """The first images rise out of one color."""
    return [
        np.rint(color + min(1, (i + 1) / (count + 1)) * (image.astype(float) - color)).astype(np.uint8)
        for i, image in enumerate(images)
    ]


@pytest.mark.parametrize("count", [0, 4, 12, 24])
@pytest.mark.parametrize("color", [0.0, 255.0])
def test_blank_frames_and_fades_are_left_out(count, color):
    blank = np.full_like(BLACK, round(color))
    images = [blank, blank, *fade(pan(60), count, color)]
    for frames in (images, images[::-1], [*pan(20), *images], [*images, *images[::-1]]):
        found = measure_changes(grays(frames), len(frames))
        faded = find_fades(found.contrasts, np.arange(len(frames)) / 24)
        times = 2 if len(frames) == 2 * len(images) else 1
        assert times * (2 + 0.9 * count) - 1 <= faded.sum() <= times * (2 + count)
        assert all(faded[k] for k in range(len(frames)) if frames[k].std() < 3)


def test_a_fade_is_said(write_video, tmp_path):
    path = write_video(tmp_path / "clip.mp4", [BLACK, BLACK, *fade(pan(40), 12)], rate=24)
    clip = open_clip(path, InputOptions())
    assert 40 - 12 <= clip.num_frames <= 40 - 11
    assert clip.timestamps[0] == 0
    assert any("frames, which are blank or fade: keep them with --keep-all" in note for note in clip.notes)
    assert next(clip.frames([0])).std() > 0.9 * pan()[0].std()
    assert open_clip(path, InputOptions(keep_all=True)).num_frames == 42


def test_a_long_clip_is_looked_at_where_it_ends():
    """Thinned so far, no frame can be chosen beside its twin."""
    looked = []

    def look(numbers: np.ndarray) -> list[np.ndarray]:
        looked.extend(numbers)
        return grays([BLACK if n < 3 else texture()[50:146, n % 200 : n % 200 + 160] for n in numbers])

    chosen = select_frames(np.arange(3000) / 30, InputOptions(), "clip", look)
    assert chosen.numbers[0] == 3
    assert len(looked) < 200


def test_damage_is_said_by_the_frame_that_is_chosen(write_image_file, tmp_path):
    for k, image in enumerate(pan(8)):
        write_image_file(tmp_path / f"{k}.png", image)
    (tmp_path / "3.png").write_bytes(b"")
    list(open_clip(tmp_path, InputOptions(every=2)).frames(range(4)))
    with pytest.raises(InputError, match=r"3\.png"):
        list(open_clip(tmp_path, InputOptions()).frames(range(8)))


def test_all_blank_is_kept():
    assert not find_fades(measure_changes(grays([BLACK] * 6), 6).contrasts, np.arange(6) / 24).any()
