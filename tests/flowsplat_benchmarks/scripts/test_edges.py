"""The benchmark of unusual clips: they are what their names say, and each is an ordinary run with a row in the table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowsplat.scenes.synthetic import SyntheticScene
from flowsplat.scenes.synthetic.writing import write_synthetic
from flowsplat_benchmarks.scripts import edges


def sizes(name: str) -> tuple[int, int, int]:
    clip = edges.EDGES[name].clip
    return clip.frames, clip.width, clip.height


def test_the_clips_are_what_they_are_called():
    assert sizes("300 frames")[0] == 300
    assert sizes("240p")[2] == 240
    assert sizes("1080p")[1:] == (1920, 1080)
    assert sizes("portrait")[1] < sizes("portrait")[2]
    still = edges.EDGES["static camera"].clip
    np.testing.assert_array_equal(still.camera(0).viewmat, still.camera(40).viewmat)
    wide = edges.EDGES["12 wide images"].clip
    steps = [np.linalg.norm(wide.camera(i + 1).center - wide.camera(i).center) for i in range(11)]
    assert wide.frames == 12
    assert min(steps) > 0.05, "meters, where the scene is five away"


def test_masks_are_compared_with_the_true_ones(tmp_path):
    spec = SyntheticScene(96, 64, 3)
    scene = write_synthetic(tmp_path / "scene", spec)
    truth = scene.truth
    for i in scene.train_frames:
        scene.write_mask(i, truth.mask(i))
    assert edges.mask_overlap(spec, scene) == 1
    mask = truth.mask(0).copy()
    mask[:, :48] = 0
    scene.write_mask(0, mask)
    assert 0.3 < edges.mask_overlap(spec, scene) < 1


@pytest.mark.slow
def test_a_clip_is_run_and_told(tmp_path, monkeypatch):
    def brief(config):
        return replace(config, train=replace(config.train, iterations=10))

    tiny = edges.Edge(SyntheticScene(96, 64, 8), lambda config: edges._hold_out(4)(brief(config)), given_cameras=True)
    monkeypatch.setitem(edges.EDGES, "tiny", tiny)
    figures = edges.run_edge("tiny", "fast", tmp_path / "tiny", "some key")
    assert (figures["frames"], figures["size"], figures["test"]) == (8, [96, 64], 1)
    assert figures["ours"]["psnr"] > 10
    assert "cameras.json" in figures["verdicts"]["cameras"]
    row = edges.table([figures]).splitlines()[-1]
    assert row.startswith("| tiny: 8 frames of 96x64, fast | ")
    assert f"{figures['ours']['psnr']:.2f}" in row
    assert f"| {figures['masks_iou']:.3f} |" in row
    again = edges.run_edge("tiny", "fast", tmp_path / "tiny", "some key")
    assert again["seconds"] is None, "it is there, and nothing was filmed anew"
    assert again["ours"] == figures["ours"]
    (tmp_path / "tiny" / "rest.txt").write_text("of other settings")
    assert edges.run_edge("tiny", "fast", tmp_path / "tiny", "another key")["seconds"] is not None
    assert not (tmp_path / "tiny" / "rest.txt").exists()
