"""Any input becomes a scene folder, once, whatever interrupts it."""

from __future__ import annotations

import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.settings import to_plain
from flowsplat.geometry import Similarity
from flowsplat.scenes import Scene
from flowsplat.scenes.ingest import InputOptions, fingerprint, ingest, kind_of_input, open_clip

OPTIONS = InputOptions(holdout=5)
COUNT = 12


def mask_of(i: int) -> np.ndarray:
    mask = np.zeros((48, 64), np.uint8)
    mask[:, i : i + 20] = 255
    return mask


@pytest.fixture
def folder(tmp_path, make_image, write_image_file) -> Path:
    """Images with masks."""
    folder = tmp_path / "input"
    for i in range(COUNT):
        write_image_file(folder / "images" / f"{i:05d}.png", make_image(i))
        write_image_file(folder / "masks" / f"{i:05d}.png", mask_of(i))
    return folder


def run(path: Path, out: Path, options: InputOptions = OPTIONS) -> Scene:
    return ingest(open_clip(path, options), out, options)


def test_images_with_masks(folder, tmp_path, make_image):
    run(folder, tmp_path / "scene")
    scene = Scene(tmp_path / "scene")
    assert scene.info.ingested
    assert (scene.name, scene.width, scene.height, scene.heldout_frames) == ("input", 64, 48, [4, 9])
    assert scene.prior("masks") == {"method": "given"}
    assert scene.prior("depth") is None
    for i in range(COUNT):
        np.testing.assert_array_equal(scene.any_frame(i), make_image(i))
        layers = scene.heldout_masks if i in (4, 9) else scene
        np.testing.assert_array_equal(layers.mask(i), mask_of(i) > 0)
    assert sorted(p.stem for p in (scene.folder / "heldout" / "masks").iterdir()) == ["00004", "00009"]
    assert len(list((scene.folder / "masks").iterdir())) == COUNT - 2
    assert scene.truth is None
    assert scene.views == []


def test_video(tmp_path, make_image, write_video):
    path = write_video(tmp_path / "My clip.mp4", [make_image(i) for i in range(COUNT)], sound=True)
    options = replace(OPTIONS, every=2)
    scene = run(path, tmp_path / "scene", options)
    assert (scene.name, scene.num_frames, scene.heldout_frames) == ("My clip", 6, [4])
    np.testing.assert_allclose(scene.timestamps, np.arange(6) * 0.08, atol=1e-6)
    assert scene.info.source_fps == pytest.approx(25)
    assert scene.info.audio == "sound.flac"
    assert scene.info.audio_start == 0
    assert "one frame in 2" in scene.info.notes[0]
    assert scene.prior("masks") is None
    assert np.abs(scene.frame(3).astype(int) - make_image(6)).mean() < 4


class Interruption(Exception):
    """What a user does."""


def test_resumed_where_it_was_interrupted(folder, tmp_path, make_image, monkeypatch):
    out = tmp_path / "scene"
    clip = open_clip(folder, OPTIONS)
    asked: list[list[int]] = []
    read = clip.frames

    def frames(numbers):
        asked.append(list(numbers))
        for count, image in enumerate(read(numbers)):
            if len(asked) == 1 and count == 5:
                raise Interruption
            yield image

    monkeypatch.setattr(clip, "frames", frames)
    with pytest.raises(Interruption):
        ingest(clip, out, OPTIONS)
    assert not Scene(out).info.ingested
    scene = ingest(clip, out, OPTIONS)
    assert asked == [list(range(COUNT)), list(range(5, COUNT))]
    assert scene.info.ingested
    for i in range(COUNT):
        np.testing.assert_array_equal(scene.any_frame(i), make_image(i))
    # A finished one is not touched again.
    ingest(clip, out, OPTIONS)
    assert len(asked) == 2


def test_folder_of_another_input(folder, tmp_path):
    run(folder, tmp_path / "scene")
    for options in (
        replace(OPTIONS, every=2),
        replace(OPTIONS, holdout=3),
        replace(OPTIONS, fps=10.0),
        replace(OPTIONS, resize=48),
    ):
        with pytest.raises(InputError, match="another input or other options"):
            run(folder, tmp_path / "scene", options)


def test_output_in_the_way(folder, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="not a folder"):
        run(folder, tmp_path / "file")


def test_kinds(folder, tmp_path, make_image, write_image_file, write_video):
    assert kind_of_input(folder) == "images"
    assert kind_of_input(folder / "images") == "images"
    assert kind_of_input(write_video(tmp_path / "a.mp4", [make_image(0)] * 2)) == "video"
    run(folder, tmp_path / "scene")
    assert kind_of_input(tmp_path / "scene") == "scene"
    shutil.copytree(folder / "images", tmp_path / "davis" / "JPEGImages" / "480p" / "bear")
    assert kind_of_input(tmp_path / "davis") == "davis"
    assert open_clip(tmp_path / "davis", InputOptions(sequence="bear")).name == "bear"


@pytest.mark.parametrize("name", ["missing", "missing.mp4"])
def test_missing_input(tmp_path, name):
    for call in (kind_of_input, lambda path: open_clip(path, OPTIONS), lambda path: fingerprint(path, OPTIONS)):
        with pytest.raises(InputError, match="does not exist"):
            call(tmp_path / name)


def test_an_animated_image_is_no_single_one(tmp_path):
    """The chunk VP8X as Pillow writes it: flags of animation and alpha, three bytes, width and height less one."""
    path = tmp_path / "a.webp"
    for flags, words in ((0x12, "an animated WebP"), (0x10, "a single image")):
        path.write_bytes(
            b"RIFF" + (22).to_bytes(4, "little") + b"WEBPVP8X" + bytes([10, 0, 0, 0, flags, 0, 0, 0, 63, 0, 0, 47, 0, 0])
        )
        with pytest.raises(InputError, match=words):
            open_clip(path, OPTIONS)


def test_a_folder_of_videos(tmp_path, make_image, write_video):
    write_video(tmp_path / "a.mp4", [make_image(0)] * 2)
    with pytest.raises(InputError, match=r"a folder with a video: give .*a\.mp4\."):
        open_clip(tmp_path, OPTIONS)
    write_video(tmp_path / "b.mov", [make_image(0)] * 2)
    with pytest.raises(InputError, match=r"holds 2 videos: give one, as .*a\.mp4, or the folder to flowsplat batch"):
        open_clip(tmp_path, OPTIONS)


def test_input_of_no_known_kind(folder, tmp_path):
    with pytest.raises(InputError, match="single image"):
        open_clip(folder / "images" / "00000.png", OPTIONS)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no images"):
        open_clip(tmp_path / "empty", OPTIONS)
    (tmp_path / "hollow" / "images").mkdir(parents=True)
    with pytest.raises(InputError, match="no images"):
        open_clip(tmp_path / "hollow", OPTIONS)
    with pytest.raises(InputError, match="needs the root folder of DAVIS"):
        open_clip(folder, replace(OPTIONS, sequence="bear"))
    run(folder, tmp_path / "scene")
    with pytest.raises(InputError, match="prepared scene already"):
        open_clip(tmp_path / "scene", OPTIONS)


def test_options_are_checked(folder):
    with pytest.raises(InputError, match=r"--every"):
        open_clip(folder, InputOptions(every=0))


def test_too_few_training_frames(folder, tmp_path):
    with pytest.raises(InputError, match="at least two frames"):
        run(folder, tmp_path / "scene", InputOptions(max_frames=2, holdout=1000, every=12))


def test_two_frames(folder, tmp_path):
    scene = run(folder, tmp_path / "scene", InputOptions(max_frames=2))
    assert (scene.num_frames, scene.heldout_frames) == (2, [])


# -- fingerprints


def test_frames_that_are_not_named_change_no_fingerprint(folder):
    """Or what earlier versions have computed of an input would count for another."""
    assert to_plain(OPTIONS) == {name: value for name, value in asdict(OPTIONS).items() if name != "holdout_frames"}
    assert fingerprint(folder, replace(OPTIONS, holdout_frames=(1,))) != fingerprint(folder, OPTIONS)


def test_fingerprint_does_not_depend_on_the_place(folder, tmp_path):
    name = fingerprint(folder, OPTIONS)
    shutil.copytree(folder, tmp_path / "elsewhere" / "moved")
    assert fingerprint(tmp_path / "elsewhere" / "moved", OPTIONS) == name
    (folder / "notes.txt").write_text("not part of the input")
    assert fingerprint(folder, OPTIONS) == name


def test_fingerprint_tells_inputs_apart(folder, tmp_path, write_image_file, make_image):
    def change_options() -> str:
        return fingerprint(folder, replace(OPTIONS, start=0.1))

    def change_an_image() -> str:
        write_image_file(folder / "images" / "00003.png", make_image(30))
        return fingerprint(folder, OPTIONS)

    def change_a_mask() -> str:
        write_image_file(folder / "masks" / "00003.png", mask_of(30))
        return fingerprint(folder, OPTIONS)

    def rename_an_image() -> str:
        (folder / "images" / "00003.png").rename(folder / "images" / "00003b.png")
        return fingerprint(folder, OPTIONS)

    names = [fingerprint(folder, OPTIONS)]
    names += [change() for change in (change_options, change_an_image, change_a_mask, rename_an_image)]
    assert len(set(names)) == len(names)


def test_fingerprint_of_a_scene_is_of_all_that_was_made_not_of_what_was_looked_at(folder, tmp_path):
    scene = run(folder, tmp_path / "scene")
    names = [fingerprint(scene.folder, OPTIONS)]
    assert fingerprint(scene.folder, replace(OPTIONS, every=3)) == names[0]
    scene.write_similarity(Similarity(2.0, np.eye(3), np.zeros(3)))
    assert fingerprint(scene.folder, OPTIONS) == names[0]
    scene.write_frame(0, 255 - scene.frame(0))
    names.append(fingerprint(scene.folder, OPTIONS))
    scene.write_mask(0, np.ones((scene.height, scene.width), np.uint8))
    names.append(fingerprint(scene.folder, OPTIONS))
    scene.finish_prior("depth", method="given")
    names.append(fingerprint(scene.folder, OPTIONS))
    assert len(set(names)) == 4


@pytest.mark.parametrize("position", [10, 199_990])
def test_fingerprint_of_a_file(tmp_path, position):
    path = tmp_path / "a.mp4"
    path.write_bytes(bytes(200_000))
    name = fingerprint(path, OPTIONS)
    data = bytearray(200_000)
    data[position] = 1
    path.write_bytes(data)
    assert fingerprint(path, OPTIONS) != name


# -- measured data


@pytest.mark.parametrize(("name", "count", "heldout"), [("bear", 82, 8), ("train", 80, 7)])
@pytest.mark.slow
def test_davis(data, tmp_path, name, count, heldout):
    scene = run(data / "davis" / name, tmp_path / "scene", InputOptions())
    assert (scene.name, scene.width, scene.height) == (name, 854, 480)
    assert (scene.num_frames, len(scene.heldout_frames)) == (count, heldout)
    assert scene.info.notes == []
    for i in (0, count - 1):
        assert set(np.unique(scene.mask(i))) == {0, 1}
        assert 0.01 < scene.mask(i).mean() < 0.6
    assert scene.heldout_masks.mask(9).any()
