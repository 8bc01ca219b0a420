"""A clip prepared with a network for everything that has one: random, so that only the way is tested and not the result."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.priors.learned.weights import ModelOptions
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors

from ..planes import HEIGHT, WIDTH, write_planes


@pytest.mark.slow
@pytest.mark.parametrize(("masks", "prompts"), [("sam2", ()), ("sam3", ("60,40@3",))])
def test_every_network_takes_its_place(tmp_path: Path, monkeypatch, raft_file, depth_anything, sam2, sam3, masks, prompts):
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("flow of another method")

    monkeypatch.setattr("flowsplat.priors.flow.dis_flow", refuse)
    scene = write_planes(tmp_path, step=2, square=True, holdout=5)
    models = ModelOptions(raft=str(raft_file), depth_anything=str(depth_anything), sam2=str(sam2), sam3=str(sam3))
    options = PriorsOptions(flow="raft", masks=masks, depth="depth-anything", models=models, mask_click=prompts)
    assert set(prepare_priors(scene, options)) == {"flow", "masks", "depth", "tracks"}
    assert [scene.prior(name)["method"] for name in ("flow", "masks", "depth")] == ["raft", masks, "depth-anything"]
    assert not any(scene.has_mask(i) or scene.has_depth(i) for i in scene.heldout_frames)
    for i in scene.train_frames:
        assert scene.mask(i).shape == (HEIGHT, WIDTH)
        assert np.isfinite(scene.depth(i).depth).all()
    assert prepare_priors(scene, options) == {}
