from __future__ import annotations

import numpy as np

from flowsplat.priors.tracks import TrackTable, corner_strength, new_points, oldest_of_crowds, refine_points
from flowsplat.priors.tracks.points import COARSE_DAMPING, detail

from .textures import shifted, texture


def test_the_longest_tracks_are_kept_in_their_order():
    table = TrackTable(columns=1)
    table.count = 5
    for frame, tracks in enumerate(([0, 1, 2], [1, 2, 3], [2, 3, 4], [1, 3])):
        table.add(frame, np.array(tracks), np.array(tracks, np.float32)[:, None])
    table.keep_longest(5)
    assert table.values(4).shape == (5, 4, 1)
    table.keep_longest(3)
    values = table.values(4)[..., 0]
    frame, track, listed = table.list_all()
    assert sorted(zip(track, frame, strict=True)) == list(zip(track, frame, strict=True))
    np.testing.assert_array_equal(listed[:, 0], values[track, frame])
    assert len(listed) == np.isfinite(values).sum()
    assert (np.nanmean(values, 1) == [1, 2, 3]).all()
    assert (np.isfinite(values).sum(1) == [3, 3, 3]).all()


def test_refinement_reaches_a_small_fraction_of_a_pixel():
    big = texture(160, 200)
    a, b = shifted(big, 0, 0, 150, 110), shifted(big, 1.37, -0.62, 150, 110)
    points = new_points(corner_strength(a), np.zeros((0, 2)), 12)
    points = points[(points > 12).all(1) & (points < [138, 98]).all(1)]
    found, ok = refine_points(a, b, points, points + [1.0, 0.0], 15)
    assert ok.mean() > 0.9
    assert np.median(np.linalg.norm(found - points - [1.37, -0.62], axis=1)[ok]) < 0.05


def test_refinement_refuses_what_is_not_there():
    points = np.random.default_rng(0).uniform(20, 80, (50, 2))
    _, ok = refine_points(texture(100, 100, 1), texture(100, 100, 2), points, points, 15)
    assert ok.mean() < 0.4
    assert refine_points(texture(100, 100), texture(100, 100), np.zeros((0, 2)), np.zeros((0, 2)), 15)[0].shape == (0, 2)


def test_new_points_fill_only_empty_cells_of_any_image_size():
    strength = np.ones((25, 37), np.float32)
    everything = new_points(strength, np.zeros((0, 2)), 10)
    assert len(everything) == 4 * 3
    assert len(new_points(strength, everything, 10)) == 0
    assert len(new_points(np.zeros_like(strength), np.zeros((0, 2)), 10)) == 0


def test_the_oldest_of_a_crowd_stays():
    points = np.array([[1.0, 1], [2, 2], [15, 1], [3, 3], [16, 2]])
    assert oldest_of_crowds(points, 10).tolist() == [0, 2]


def test_a_table_keeps_what_was_noted():
    table = TrackTable()
    a, b = table.start(2), table.start(1)
    table.add(0, a, np.array([[1.0, 2], [3, 4]]))
    table.add(2, np.concatenate([a[1:], b]), np.array([[5.0, 6], [7, 8]]))
    values = table.values(3)
    assert values.shape == (3, 3, 2)
    assert values[1, 2].tolist() == [5, 6]
    assert np.isfinite(values[..., 0]).tolist() == [[True, False, False], [True, False, True], [False, False, True]]


def test_shade_is_muted_and_detail_stays():
    shade = np.linspace(40, 200, 120)[None] * np.ones((90, 1))
    grain = 20 * np.where(np.indices((90, 120)).sum(0) % 2, 1.0, -1.0)
    found = detail(np.clip(shade + grain, 0, 255).astype(np.uint8))
    inner = (slice(20, -20), slice(20, -20))
    rise = found.mean(0)[100] - found.mean(0)[20]
    assert abs(rise / (shade[0, 100] - shade[0, 20]) - (1 - COARSE_DAMPING)) < 0.05
    assert abs(np.abs(np.diff(found, axis=1))[inner].mean() / 40 - 1) < 0.05
    assert np.abs(detail(np.full((20, 30), 128, np.uint8)) - 128).max() < 1e-3
