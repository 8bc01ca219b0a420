"""What the clip has not seen fades into the window, as it does in the page."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import flowsplat.output.player
from flowsplat.common.files import read_text
from flowsplat.gaussians.crop import CropBox
from flowsplat.gaussians.visibility import ClipVisibility, with_seen
from flowsplat.output.viewer.browser_frame import BrowserFrame
from flowsplat.output.viewer.drawing import Look, Wish, draw
from flowsplat.output.viewer.layout import BAR_GRAY
from flowsplat.output.viewer.mask import KEPT_FROM, KEPT_TO, MASK_SIDE, compute_kept, fade_into_window
from flowsplat.output.viewer.source import Source
from flowsplat.training.checkpoint import save_model
from tests.output.tiny import FPS, FRAMES, tiny_cameras, tiny_model, tiny_run

SIZE = (128, 96)
TURN = (30.0, 0.0)


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Source:
    """A run that knows what its clip has seen of a wall that is larger than what it has seen."""
    folder = tiny_run(tmp_path_factory.mktemp("seen") / "out")
    save_model(folder / "model", with_seen(tiny_model(), tiny_cameras((64, 48)), (np.arange(FRAMES) / FPS).tolist()))
    return Source(folder)


def view(source: Source, turn: tuple[float, float], t: float = 0.5, **look) -> tuple[np.ndarray, np.ndarray]:
    drawing = draw(source, BrowserFrame(source.scene.similarity), Wish(SIZE, t, Look(**look), None, turn))
    return drawing.image, drawing.depth


def test_the_numbers_are_those_of_the_page():
    assets = Path(flowsplat.output.player.__file__).parent / "assets"
    side = re.search(r"const MASK_SIZE = (\d+);", read_text(assets / "renderer.js"))
    ends = re.search(r"isMasked \? smoothstep\(([\d.]+), ([\d.]+),", read_text(assets / "present.frag"))
    assert side is not None
    assert ends is not None
    assert (int(side[1]), float(ends[1]), float(ends[2])) == (MASK_SIDE, KEPT_FROM, KEPT_TO)


@pytest.mark.parametrize("size", [(480, 640), (1, 1), (7, 300), (24, 24)])
def test_a_small_gap_is_kept_and_a_bare_side_is_not(size):
    alpha = np.ones(size, np.float32)
    np.testing.assert_array_equal(compute_kept(alpha), 1)
    np.testing.assert_array_equal(compute_kept(0 * alpha), 0)
    height, width = size
    alpha[height // 2, width // 2 : width // 2 + width // 100] = 0
    assert compute_kept(alpha).min() == 1
    if width > 100:
        alpha[:, : width // 2] = 0
        kept = compute_kept(alpha)
        assert (kept[:, : width // 3] == 0).all()
        assert (kept[:, -width // 3 :] == 1).all()
    image = np.full((*size, 3), 200, np.uint8)
    np.testing.assert_array_equal(fade_into_window(image, 0 * compute_kept(alpha)), BAR_GRAY)
    np.testing.assert_array_equal(fade_into_window(image, 0 * compute_kept(alpha) + 1), image)


@pytest.mark.parametrize("show", ["color", "alpha", "depth", "flow"])
def test_what_no_frame_has_seen_is_not_shown_beside_the_input_camera(source, show):
    image, depth = view(source, TURN, show=show)
    camera = source.input_camera(0.5, TURN).resize(*SIZE)
    visibility = ClipVisibility(source.loaded.part("all"), source.scene.cameras, source.scene.timestamps.tolist())
    unseen = ~visibility.compute_seen(camera, 0.5).is_seen
    shown = depth < 100  # at least half of it
    step = SIZE[0] // unseen.shape[1]
    assert unseen.mean() > 0.15, "or there is nothing to hide"
    assert (shown[::step, ::step] & unseen).mean() < 0.06, "the width of a Gaussian whose center was seen"
    assert (shown[::step, ::step] & ~unseen).mean() > 0.99 * (~unseen).mean()
    assert (image[:, -6:] == BAR_GRAY).all()


def test_what_the_clip_has_seen_well_looks_as_it_does_without_a_mask(source):
    model, turn = source.loaded.part("all"), (8.0, 0.0)
    image, _ = view(source, turn)
    bare = np.rint(255 * model.render(source.input_camera(0.5, turn).resize(*SIZE), 0.5).color)
    assert np.abs(bare - image)[12:-12, 12:96].max() <= 1, "but for Gaussians beyond the edges of all frames"


def test_the_input_camera_itself_and_free_cameras_are_shown_all(source):
    frame = BrowserFrame(source.scene.similarity)
    camera = source.input_camera(0.5, TURN).resize(*SIZE)
    free = draw(source, frame, Wish(SIZE, 0.5, Look(), frame.pose(camera))).image
    assert (free != BAR_GRAY).any(-1).all()
    home, _ = view(source, (0.0, 0.0))
    assert (
        np.abs(home.astype(int) - np.rint(255 * source.model("all").render(source.path.at(0.5).resize(*SIZE), 0.5).color)).max()
        <= 1
    )


def test_objects_black_guesses_and_boxes_are_as_they_were(source):
    """None of them has anything to fade into."""
    objects, _ = view(source, TURN, part="objects")
    assert objects.any()
    assert np.median(objects) == 0
    faded, _ = view(source, TURN, confidence_fade=True)
    assert faded[:, -6:].max() < BAR_GRAY, "black"
    masked, _ = view(source, TURN)
    cropped, _ = view(source, TURN, crop=CropBox((-9.0, -9.0, 0.0), (9.0, 9.0, 9.0)))
    assert cropped[:, -6:].max() < BAR_GRAY
    np.testing.assert_array_equal(cropped[:, :80], masked[:, :80])
    points, _ = view(source, TURN, show="Gaussians")
    everything, _ = view(Source(source.folder), (0.01, 0.0), show="Gaussians")
    assert len(np.unique(points[:, -6:])) == 1 < len(np.unique(everything[:, -6:])), "none of what was not seen"


def test_where_it_is_not_known_all_is_shown(run_folder):
    source = Source(run_folder)
    image, _ = view(source, TURN)
    assert (image != BAR_GRAY).any(-1).mean() > 0.99
