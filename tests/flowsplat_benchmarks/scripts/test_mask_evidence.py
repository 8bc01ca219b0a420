"""The counts by which masks are cut: counted on a drawn scene, they cut its square out; and what is stored is of this code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.files import read_json
from flowsplat.priors.flow import flow_stage
from flowsplat.priors.masks.evidence import AXES, TABLES, make_tables
from flowsplat_benchmarks.scripts.mask_evidence import (
    add,
    choose_counted,
    compute_log_odds,
    count_tables,
    cut,
    plain,
    read_known,
    score,
)
from tests.priors.planes import write_planes


def test_tables_of_a_scene_cut_its_object_out_and_leave_its_masks(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=True)
    flow_stage(scene)
    for i in scene.train_frames:
        scene.write_mask(i, np.full((scene.height, scene.width), 7, np.uint8))
    known = read_known(scene, scene.truth.mask)
    assert known.before.all()
    assert all((scene.mask(i) == 7).all() for i in scene.train_frames)
    assert ((known.counted == 2) == (known.true > 0)).all()
    assert 0 < (known.counted == 1).mean() < 0.5
    tables = count_tables({"planes": known})
    assert score(cut(known, tables), known.true)["IoU"] > 0.9
    again = make_tables(plain(tables, ["planes"]))
    rests, moves = ([np.array([value], np.float32) for value in cues] for cues in ((0.3, 0.3, -12), (9, 9, 12)))
    assert again.look_up("plates", *rests) < -2
    assert again.look_up("plates", *moves) > 2
    # Read again, it speaks of the same cues.
    assert read_known(scene, scene.truth.mask).counted.sum() == known.counted.sum()


def test_objects_that_motion_does_not_find_are_not_counted():
    true, rough = np.zeros((2, 40, 60), np.uint8), np.zeros((2, 40, 60), bool)
    true[:, 10:20, 10:20], true[:, 10:20, 40:50] = 1, 2
    rough[0, 10:15, 10:20] = True  # A quarter of the first.
    counted = choose_counted(true, rough)
    assert (counted[:, 10:20, 10:20] == 2).all()
    assert (counted[:, 10:20, 40:50] == 0).all()
    assert (counted[:, 10:20, 8:10] == 1).all()
    assert (counted[:, :, 25:40] == 0).all()
    rough[0, 10:15, 12:20] = False
    assert (choose_counted(true, rough) == 0).all()


def test_log_odds_are_those_of_the_counts_and_every_scene_weighs_the_same():
    counts = np.zeros((2, 40))
    counts[0, 10], counts[1, 10], counts[0, 30], counts[1, 30] = 100, 800, 300, 200
    log_odds = compute_log_odds([counts])
    assert log_odds[10] == pytest.approx(np.log2(0.8 / 0.25), abs=0.01)
    assert log_odds[30] == pytest.approx(np.log2(0.2 / 0.75), abs=0.01)
    np.testing.assert_allclose(compute_log_odds([counts, 1000 * counts]), log_odds)
    other = counts[::-1]
    np.testing.assert_allclose(compute_log_odds([counts, 1000 * other]), 0, atol=1e-9)
    counts[1] = 0
    assert (compute_log_odds([counts]) == 0).all()


def test_values_are_added_to_the_nearest_knot():
    counts = np.zeros((3, 2))
    add(counts, ((0.0, 1.0, 4.0), (-1.0, 1.0)), np.array([-9, 0.4, 2.6, 50]), np.array([-2, 0.1, -0.1, 3]))
    assert counts.tolist() == [[1, 1], [0, 0], [1, 1]]


def test_the_feet_are_the_lowest_tenth():
    true = np.zeros((1, 60, 60), np.uint8)
    true[0, 10:50, 20:40] = 1
    masks = true > 0
    assert score(masks, true) == {"IoU": 1, "outside": 0, "feet": 1}
    assert score(np.zeros_like(masks), true) == {"IoU": 0, "outside": 0, "feet": 0}
    masks[0, 46:] = False
    found = score(masks, true)
    assert found["IoU"] == pytest.approx(0.9)
    assert found["feet"] == 0
    masks[0, 10:46, 10:20] = True
    assert score(masks, true)["outside"] == pytest.approx(1 / 3)


def test_what_is_stored_is_of_these_knots():
    values = read_json(TABLES)
    tables = make_tables(values)
    assert plain(tables, values["counted on"]) == values
    assert {name: table.shape for name, table in tables.log_odds.items()} == {
        name: tuple(map(len, axes)) for name, axes in AXES.items()
    }
