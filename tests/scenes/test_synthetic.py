"""The synthetic clip: its truths agree with each other and with its images."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.geometry.cameras import pixel_grid, unproject_depth
from flowsplat.scenes import Flow, Scene
from flowsplat.scenes.synthetic import SyntheticScene, View, write_synthetic, write_synthetic_video
from tests.geometry.still import camera_flow

SMALL = SyntheticScene(width=64, height=48, frames=8)
WIDE = SyntheticScene(width=64, height=36)
"""The default clip with fewer pixels: shares of the image are the same, displacements a fifth."""
FULL = SyntheticScene()


def view(spec: SyntheticScene, i: int) -> View:
    return spec.render(spec.camera(i), spec.timestamps[i])


def sample(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """``image`` at pixels ``uv``, bilinear."""
    x, y = np.moveaxis(uv.astype(np.float32) - 0.5, -1, 0)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return 10 * np.log10(255**2 / np.mean((a.astype(float) - b.astype(float)) ** 2))


def landing(flow: Flow) -> np.ndarray:
    return pixel_grid(flow.flow.shape[1], flow.flow.shape[0]) + flow.flow


@pytest.fixture(scope="module")
def pair() -> tuple[View, View]:
    """Frames 20 and 21 of the default clip."""
    return view(FULL, 20), view(FULL, 21)


def test_flow_of_static_pixels_is_the_cameras_flow_over_the_depth():
    for i, j in [(3, 4), (4, 3), (1, 6)]:
        seen = view(SMALL, i)
        static = seen.mask == 0
        flow = SMALL.flow(i, j)
        np.testing.assert_allclose(flow.flow[static], camera_flow(seen.depth, SMALL.camera(i), SMALL.camera(j))[static], atol=1e-4)
        assert (flow.i, flow.j) == (i, j)


def test_objects_do_not_follow_the_cameras_flow():
    seen, flow = view(FULL, 20), FULL.flow(20, 21)
    own = np.linalg.norm(flow.flow - camera_flow(seen.depth, FULL.camera(20), FULL.camera(21)), axis=-1)
    for number in (1, 2, 3):
        assert 1 < own[seen.mask == number].mean() < 12


def test_forward_and_backward_flow_undo_each_other():
    forward, backward = FULL.flow(10, 11), FULL.flow(11, 10)
    back = sample(backward.flow, landing(forward))
    error = np.linalg.norm(forward.flow + back, axis=-1)[forward.trusted]
    # Bilinear sampling of the backward flow mixes two surfaces along edges.
    assert np.median(error) < 0.01
    assert np.percentile(error, 90) < 0.05


def test_valid_flow_lands_on_the_same_body_and_invalid_flow_does_not_return(pair: tuple[View, View]):
    first, second = pair
    flow = FULL.flow(20, 21)
    x, y = np.floor(landing(flow)).astype(int)[flow.trusted].T
    assert np.mean(second.mask[y, x] == first.mask[flow.trusted]) > 0.99
    inside = ((landing(flow) >= 0) & (landing(flow) < [FULL.width, FULL.height])).all(-1)
    hidden = inside & ~flow.trusted
    assert hidden.sum() > 100
    assert not flow.trusted[~inside].any()
    world_depth = FULL.camera(21).project(unproject_depth(first.depth, FULL.camera(20)))[1]
    static = hidden & (first.mask == 0)
    x, y = np.floor(landing(flow)).astype(int)[static].T
    # Something nearer stands before hidden static points (at the center of the pixel, so not at every edge).
    assert np.mean(second.depth[y, x] < world_depth[static] - 0.02) > 0.85


def test_warping_the_next_frame_back_reproduces_the_frame(pair: tuple[View, View]):
    first, second = pair
    flow = FULL.flow(20, 21)
    warped = sample(second.image, landing(flow))
    assert flow.trusted.mean() > 0.93
    assert psnr(warped[flow.trusted], first.image[flow.trusted]) > 30
    assert psnr(second.image, first.image) < 18


def test_texture_is_everywhere(pair: tuple[View, View]):
    gray = cv2.cvtColor(pair[0].image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    deviation = np.sqrt(np.maximum(cv2.blur(gray * gray, (15, 15)) - cv2.blur(gray, (15, 15)) ** 2, 0))
    assert np.percentile(deviation, 1) > 3
    corners = cv2.goodFeaturesToTrack(pair[0].image[..., 1], 2000, 0.01, 4)
    cells = {(int(x // 40), int(y // 36)) for x, y in corners[:, 0]}
    assert len(cells) == 8 * 5


def test_depth_is_inside_the_room_and_at_the_hits():
    seen = view(SMALL, 5)
    points = unproject_depth(seen.depth, SMALL.camera(5))
    room = SMALL.bodies[0]
    assert (np.abs(points - room.motion(0.0)[1]) <= room.size + 1e-9).all()
    assert 1.5 < np.percentile(seen.depth, 1) < 4 < 6 < np.percentile(seen.depth, 99) < 10


def test_objects_cover_a_tenth_to_a_fifth_and_the_image_moves_a_few_pixels_a_frame():
    scale = FULL.width / WIDE.width
    cover, background, objects, seen_numbers = [], [], [], set()
    for i in range(0, WIDE.frames - 1, 3):
        grid = pixel_grid(WIDE.width, WIDE.height).reshape(-1, 2).astype(float)
        hits = WIDE.cast(WIDE.camera(i), WIDE.timestamps[i], grid)
        numbers = WIDE.numbers[hits.part]
        length = np.linalg.norm(WIDE.flow(i, i + 1).flow, axis=-1).ravel() * scale
        cover.append(np.mean(numbers > 0))
        background.append(length[numbers == 0].mean())
        objects.append(length[numbers > 0].mean())
        seen_numbers |= set(numbers)
    assert 0.10 < np.mean(cover) < 0.20
    assert min(cover) > 0.08
    assert max(cover) < 0.25
    assert 3.5 < np.mean(background) < 8
    assert 2 < np.mean(objects) < 8
    assert seen_numbers == {0, 1, 2, 3}


def test_objects_rotate_travel_on_a_curve_and_deform():
    block, ball, jelly = sorted((b for b in FULL.bodies if b.number), key=lambda b: b.number)
    times = FULL.timestamps
    turn = block.motion(times[-1])[0] @ np.linalg.inv(block.motion(times[10])[0])
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) > 90

    path = np.array([ball.motion(t)[1] for t in times])
    chord = (path[-1] - path[0]) / np.linalg.norm(path[-1] - path[0])
    offset = path - path[0]
    assert np.linalg.norm(offset - np.outer(offset @ chord, chord), axis=1).max() > 0.5

    radii = np.array([np.linalg.norm(jelly.motion(t)[0], axis=0) for t in times])
    assert (radii.max(0) / radii.min(0) > 1.3).all()
    assert np.abs(np.diff(radii, axis=0)).max() < 0.05


def test_tracks_lie_on_the_surface_that_is_seen():
    tracks = SMALL.tracks()
    assert tracks.points.shape == (*tracks.visible.shape, 3)
    assert tracks.visible.any(1).all()
    assert (~tracks.visible).any()
    assert tracks.moving.sum() > 150
    assert (~tracks.moving).sum() == 200
    relative, hidden = [], []
    for i in range(SMALL.frames):
        camera, depth = SMALL.camera(i), view(SMALL, i).depth
        uv, z = camera.project(tracks.points[:, i].astype(float))
        inside = ((uv >= 0) & (uv < [SMALL.width, SMALL.height])).all(1)
        assert not tracks.visible[~inside, i].any()
        x, y = np.floor(uv).astype(int).clip(0, [SMALL.width - 1, SMALL.height - 1]).T
        difference = z / depth[y, x] - 1
        relative.append(np.abs(difference[tracks.visible[:, i]]))
        hidden.append(difference[inside & ~tracks.visible[:, i]])
    # The depth map is known at the centers of pixels, tracks fall between them.
    assert np.median(np.concatenate(relative)) < 0.01
    assert np.percentile(np.concatenate(relative), 90) < 0.06
    assert np.median(np.concatenate(hidden)) > 0.02
    still = tracks.points[~tracks.moving]
    np.testing.assert_array_equal(still, np.broadcast_to(still[:, :1], still.shape))
    assert (np.ptp(tracks.points[tracks.moving], axis=1).max(1) > 0.02).all()


def test_heldout_views_see_the_same_world_from_aside():
    views = FULL.heldout_views()
    assert [v.frame for v in views[:4]] == [0, 0, 4, 4]
    assert len({v.name for v in views}) == len(views) == 20
    chosen = views[10]
    own = FULL.camera(chosen.frame)
    seen, clip = FULL.render(chosen.camera, FULL.timestamps[chosen.frame]), view(FULL, chosen.frame)
    assert 0.05 < np.linalg.norm(chosen.camera.center - own.center) / np.median(clip.depth) < 0.08
    covisible = FULL.covisible(chosen)
    assert 0.88 < covisible.mean() < 0.99
    uv, _ = own.project(unproject_depth(seen.depth, chosen.camera))
    warped = sample(clip.image, uv)
    assert psnr(warped[covisible], seen.image[covisible]) > 27
    assert psnr(warped[~covisible], seen.image[~covisible]) < 20


def test_same_parameters_same_bits():
    first, second = SyntheticScene(48, 32, 3, seed=5), SyntheticScene(48, 32, 3, seed=5)
    other = SyntheticScene(48, 32, 3, seed=6)
    np.testing.assert_array_equal(view(first, 2).image, view(second, 2).image)
    np.testing.assert_array_equal(first.tracks().points, second.tracks().points)
    assert (view(first, 2).image != view(other, 2).image).mean() > 0.5
    np.testing.assert_array_equal(view(first, 2).depth, view(other, 2).depth)


def test_written_scene_reads_back(tmp_path: Path):
    write_synthetic(tmp_path / "scene", SMALL, holdout=4)
    scene = Scene(tmp_path / "scene")
    assert (scene.train_frames, scene.heldout_frames) == ([0, 1, 2, 4, 5, 6, 7], [3])
    np.testing.assert_allclose(scene.timestamps, np.arange(8) / 24)
    np.testing.assert_array_equal(scene.frame(2), view(SMALL, 2).image)
    np.testing.assert_array_equal(scene.heldout_frame(3), view(SMALL, 3).image)
    assert not any((scene.has_cameras, scene.has_depth(0), scene.has_mask(0), scene.has_tracks))
    assert scene.flow_pairs == []

    truth = scene.truth
    assert truth is not None
    neighbors = {(i, i + 1) for i in range(7)} | {(2, 4)}
    assert set(truth.flow_pairs) == neighbors | {(j, i) for i, j in neighbors}
    exact = SMALL.flow(2, 4)
    np.testing.assert_allclose(truth.flow(2, 4).flow, exact.flow, atol=1 / 128 + 1e-6)
    np.testing.assert_array_equal(truth.flow(2, 4).trusted, exact.trusted)
    np.testing.assert_allclose(truth.depth(3).depth, view(SMALL, 3).depth, rtol=1e-6)
    assert truth.depth(3).trusted.all()
    np.testing.assert_array_equal(truth.mask(3), view(SMALL, 3).mask)
    np.testing.assert_allclose(truth.cameras[7].viewmat, SMALL.camera(7).viewmat)
    assert truth.tracks.points.shape[1:] == (8, 3)

    assert [v.name for v in scene.views] == ["left_00000", "right_00000", "left_00004", "right_00004"]
    last = scene.views[-1]
    assert scene.view_image(last).shape == (48, 64, 3)
    covisible, objects = scene.view_mask(last, "covisible"), scene.view_mask(last)
    np.testing.assert_array_equal(covisible, SMALL.covisible(last))
    assert objects is not None
    assert 0.05 < objects.mean() < 0.3


def test_scene_without_truth_has_frames_only(tmp_path: Path):
    scene = write_synthetic(tmp_path / "scene", SyntheticScene(32, 32, 2), with_truth=False)
    assert scene.truth is None
    assert scene.views == []
    assert scene.has_frame(0)
    assert scene.has_frame(1)


def test_video_shows_the_frames(tmp_path: Path):
    write_synthetic_video(tmp_path / "clip.mp4", SMALL)
    with av.open(str(tmp_path / "clip.mp4")) as container:
        assert float(container.streams.video[0].average_rate) == 24
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == SMALL.frames
    assert psnr(frames[3], view(SMALL, 3).image) > 26


@pytest.mark.parametrize(
    "bad", [{"width": 8}, {"height": 0}, {"frames": 1}, {"fps": 0.0}, {"fps": float("nan")}, {"fps": float("inf")}], ids=str
)
def test_parameters_that_make_no_clip_are_refused(bad: dict[str, float]):
    with pytest.raises(InputError, match="synthetic clip"):
        SyntheticScene(**bad)  # type: ignore[arg-type]
