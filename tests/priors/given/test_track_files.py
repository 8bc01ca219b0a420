"""Tracks in the layouts of others, written exactly as their code writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.given.tracks import read_tracks
from flowsplat.priors.prepare import use_given
from flowsplat.scenes import Scene

WIDTH, HEIGHT, FRAMES, POINTS = 128, 80, 6, 9


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """Frame 2 is held out; the left half moves."""
    scene = Scene.create(
        tmp_path / "scene", name="s", source="", width=WIDTH, height=HEIGHT, timestamps=range(FRAMES), holdout=3, source_fps=1
    )
    for i in scene.train_frames:
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[:, : WIDTH // 2] = 1
        scene.write_mask(i, mask)
    scene.finish_prior("masks", method="given")
    return scene


def pixels(start: int = 0) -> np.ndarray:
    """[N, T, 2] with whole numbers at pixel centers."""
    points = np.zeros((POINTS, FRAMES, 2), np.float32)
    points[..., 0] = 10 + 12 * np.arange(POINTS)[:, None] + np.arange(FRAMES) + start
    points[..., 1] = 20 + 2 * np.arange(FRAMES)
    return points


def visible() -> np.ndarray:
    """[N, T]: the first track is hidden in frame 4."""
    seen = np.ones((POINTS, FRAMES), bool)
    seen[0, 4] = False
    return seen


def tapir(folder: Path, name: str = "{:05d}") -> Path:
    """Shape of Motion's compute_tracks: from every frame to every frame x, y, occlusion and expected distance as logits."""
    for q in range(FRAMES):
        for t in range(FRAMES):
            logits = np.where(visible()[:, t, None], [-6.0, -5.0], [4.0, -5.0])
            np.save(
                folder / f"{name.format(q)}_{name.format(t)}.npy", np.concatenate([pixels(q)[:, t], logits], 1).astype(np.float32)
            )
    return folder


def marbles(folder: Path) -> Path:
    for q in range(FRAMES):
        values = np.concatenate([pixels(q), visible()[..., None]], -1).swapaxes(0, 1)
        np.save(folder / f"track_{q:05d}.npy", values.astype(np.float16))
    return folder


def mosca(folder: Path) -> Path:
    for name in ("dynamic_dep=uni", "uniform_dep=uni"):
        np.savez_compressed(
            folder / f"{name}_cotracker_tap.npz", queries=np.zeros((1, POINTS, 3)), tracks=pixels().swapaxes(0, 1),
            visibility=visible().T,
        )  # fmt: skip
    return folder


def spatial(folder: Path) -> Path:
    """MoSca with SpaTracker, whose tracks have a depth too."""
    tracks = np.concatenate([pixels(), np.ones((POINTS, FRAMES, 1))], -1).swapaxes(0, 1)
    np.savez_compressed(folder / "spatracker_tap.npz", tracks=tracks, visibility=visible().T)
    return folder / "spatracker_tap.npz"


def cotracker(folder: Path) -> Path:
    np.savez(folder / "a.npz", pred_tracks=pixels().swapaxes(0, 1)[None], pred_visibility=visible().T[None])
    return folder / "a.npz"


def cotracker_batch(folder: Path) -> Path:
    """As what comes out of CoTracker 3 is often saved: with its batch, and visibility with an axis of its own."""
    np.savez(folder / "a.npz", tracks=pixels().swapaxes(0, 1)[None], visibility=visible().T[None, ..., None])
    return folder / "a.npz"


def spatial_v2(folder: Path, kept: tuple[int, int] = (336, 209), whole: tuple[int, int] = (518, 322), top: int = 0) -> Path:
    """As SpatialTrackerV2's inference.py writes it: in the world, with cameras of images of 518 x 322, stored 336 wide."""
    scale = 336 / 518
    size = np.array([WIDTH, HEIGHT])
    uv = ((pixels() + 0.5) * (whole / size) - [0, top]) * scale - 0.5  # [N, T, 2]
    K = np.diag([400.0, 400, 1])
    K[:2, 2] = np.array([518, min(whole[1], 518)]) * scale / 2
    depth = 2 + np.arange(POINTS)[:, None] + 0.1 * np.arange(FRAMES)
    local = np.concatenate([uv, np.ones((*uv.shape[:2], 1))], -1) @ np.linalg.inv(K).T * depth[..., None]
    poses = np.repeat(np.eye(4)[None], FRAMES, 0)
    for t in range(FRAMES):
        angle = 0.1 * t
        poses[t, :3, :3] = [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
        poses[t, :3, 3] = [0.3 * t, 0.1, -0.2 * t]
    coords = np.einsum("tji,ntj->tni", poses[:, :3, :3], local - poses[:, :3, 3])
    np.savez(
        folder / "clip_result.npz", coords=coords.astype(np.float32), extrinsics=poses.astype(np.float32),
        intrinsics=np.repeat(K[None], FRAMES, 0).astype(np.float32), depths=np.ones((FRAMES, *kept[::-1]), np.float32),
        video=np.zeros((FRAMES, 3, *kept[::-1]), np.float32), visibs=visible().T[..., None].astype(np.float32),
        unc_metric=np.ones((FRAMES, *kept[::-1]), np.float32),
    )  # fmt: skip
    return folder / "clip_result.npz"


def tapnet(folder: Path) -> Path:
    np.savez(folder / "a.npz", tracks=pixels(), visibles=visible())
    return folder / "a.npz"


LAYOUTS = {
    "tapir": (tapir, "TAPIR", FRAMES),
    "tapir, other names": (lambda folder: tapir(folder, "take_{}"), "TAPIR", FRAMES),
    "marbles": (marbles, "CoTracker", FRAMES),
    "mosca": (mosca, "MoSca", 2),
    "spatracker": (spatial, "MoSca", 1),
    "cotracker": (cotracker, "CoTracker", 1),
    "cotracker, with its batch": (cotracker_batch, "MoSca", 1),
    "spatialtracker2": (spatial_v2, "SpatialTrackerV2", 1),
    "tapnet": (tapnet, "TAPIR", 1),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_the_same_tracks(scene: Scene, tmp_path: Path, layout: str):
    write, maker, times = LAYOUTS[layout]
    (tmp_path / "given").mkdir()
    found = read_tracks(write(tmp_path / "given"), scene, None)
    assert found.maker == maker
    assert found.points.shape == (times * POINTS, FRAMES, 2)
    np.testing.assert_allclose(found.points[:POINTS], pixels() + 0.5, atol=0.05)
    seen = visible()
    seen[:, 2] = False
    np.testing.assert_array_equal(found.confidence[:POINTS] >= 0.5, seen)
    assert (found.confidence[:, 2] == 0).all()


def test_tracks_are_the_prior_once_there_are_masks(scene: Scene, tmp_path: Path):
    (tmp_path / "given").mkdir()
    later = use_given(scene, GivenPriors(tracks=cotracker(tmp_path / "given")))
    assert scene.prior("tracks") is None
    later["tracks"]()
    tracks = scene.tracks
    assert not tracks.visible[:, 2].any()
    assert tracks.moving.tolist() == (pixels()[:, :, 0].mean(1) < WIDTH // 2).tolist()
    how = scene.prior("tracks")
    assert how["method"] == "given"
    assert "CoTracker" in how["verdict"]
    assert how["moving"] == tracks.moving.sum()


def test_tracks_of_larger_images_need_their_size(scene: Scene, tmp_path: Path):
    np.savez(tmp_path / "a.npz", tracks=(pixels() + 0.5) * 4 - 0.5, visibles=visible())
    with pytest.raises(InputError, match=r"outside the 128x80 pixels.*--given.tracks-size WIDTH HEIGHT") as caught:
        read_tracks(tmp_path / "a.npz", scene, None)
    assert "\n" not in str(caught.value)
    found = read_tracks(tmp_path / "a.npz", scene, (4 * WIDTH, 4 * HEIGHT))
    np.testing.assert_allclose(found.points, pixels() + 0.5, atol=1e-4)


def test_what_leaves_the_image_is_not_seen_there(scene: Scene, tmp_path: Path):
    points = pixels()
    points[1, 5] = [200, 30]
    points[2, 5] = np.nan
    np.savez(tmp_path / "a.npz", tracks=points, visibles=visible())
    found = read_tracks(tmp_path / "a.npz", scene, None)
    assert (found.confidence[[1, 2], 5] == 0).all()
    assert np.isfinite(found.points).all()


def test_of_very_many_tracks_an_even_choice_is_kept(scene: Scene, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("flowsplat.priors.given.tracks.MAX_TRACKS", 20)
    found = read_tracks(tapir(tmp_path), scene, None)
    assert len(found.points) == FRAMES * 3
    np.testing.assert_allclose(found.points[:3], pixels()[::3] + 0.5)


def test_a_size_of_nothing_is_refused(scene: Scene, tmp_path: Path):
    with pytest.raises(InputError, match=r"--given\.tracks-size 0 80"):
        read_tracks(tapnet(tmp_path), scene, (0, HEIGHT))


BAD = {
    "nothing": (lambda f: f / "none", "does not exist"),
    "an empty folder": (lambda f: f, r"Looked for: .*MoSca"),
    "an archive of something": (lambda f: saved(f, points=np.ones(3)), r"Looked for: .*TAPIR"),
    "other frames": (lambda f: saved(f, tracks=pixels()[:, :4], visibles=visible()[:, :4]), "holds 4 positions a track.*6 frames"),
    "no visibility": (lambda f: saved(f, tracks=pixels(), visibles=visible()[:4]), "visibility of shape"),
    "one file short": (lambda f: missing(f), "00001_00003.npy does not exist"),
    "other columns": (lambda f: wrong(f), r"are not \[N, 4\]"),
    "no tracks": (lambda f: saved(f, tracks=pixels()[:0], visibles=visible()[:0]), "holds no tracks"),
    "one axis": (lambda f: saved(f, pred_tracks=np.ones(5), pred_visibility=np.ones(5)), r"tracks of shape \(5,\)"),
    "files of different length": (lambda f: shorter(f), "tracks of different length"),
}


def saved(folder: Path, **arrays: np.ndarray) -> Path:
    np.savez(folder / "a.npz", **arrays)
    return folder / "a.npz"


def missing(folder: Path) -> Path:
    (tapir(folder) / "00001_00003.npy").unlink()
    return folder


def shorter(folder: Path) -> Path:
    values = np.load(marbles(folder) / "track_00003.npy")
    np.save(folder / "track_00003.npy", values[:4])
    return folder


def wrong(folder: Path) -> Path:
    np.save(tapir(folder) / "00001_00003.npy", np.ones((POINTS, 3)))
    return folder


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line(scene: Scene, tmp_path: Path, name: str):
    make, message = BAD[name]
    (tmp_path / "given").mkdir()
    with pytest.raises(InputError, match=message) as caught:
        read_tracks(make(tmp_path / "given"), scene, None)
    assert "\n" not in str(caught.value)


def test_spatialtracker2_of_a_tall_clip_is_put_back_where_it_was_cropped(tmp_path: Path):
    """A clip of 480 x 854 becomes 518 x 924, of which the middle 518 rows are seen."""
    scene = Scene.create(
        tmp_path / "scene", name="s", source="", width=480, height=854, timestamps=range(FRAMES), holdout=3, source_fps=1
    )
    seen = np.ones((FRAMES, 1), np.float32)
    middle = {
        "coords": np.tile(np.float32([0, 0, 2]), (FRAMES, 1, 1)), "visibs": seen, "depths": np.ones((FRAMES, 336, 336), np.float32),
        "extrinsics": np.repeat(np.eye(4)[None], FRAMES, 0),
        "intrinsics": np.repeat(np.array([[300.0, 0, 0], [0, 300, 0], [0, 0, 1]])[None], FRAMES, 0),
    }  # fmt: skip
    np.savez(tmp_path / "a.npz", **middle)
    found = read_tracks(tmp_path / "a.npz", scene, None).points[0, 0]
    np.testing.assert_allclose(found, [0.5 * 480 / 336, (0.5 * 518 / 336 + 203) * 854 / 924], rtol=1e-5)


def test_spatialtracker2_of_another_shape_is_refused(scene: Scene, tmp_path: Path):
    with pytest.raises(InputError, match="another shape"):
        read_tracks(spatial_v2(tmp_path, (336, 336)), scene, None)
    content = dict(np.load(tmp_path / "clip_result.npz"))
    np.savez(tmp_path / "a.npz", **{**content, "visibs": content["visibs"][1:]})
    with pytest.raises(InputError, match="not as SpatialTrackerV2 writes it"):
        read_tracks(tmp_path / "a.npz", scene, None)
