"""Of three things that float in a room no camera tells how far away they are. What is believed of them must say so."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.priors.objects import load_objects
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.ingest import ingest, open_clip
from flowsplat.scenes.synthetic import SyntheticScene, encode_frames, write_synthetic
from flowsplat_benchmarks.objects.measure import depth_scale, identities, overlaps

SIGMAS = 3.0


@pytest.mark.slow
def test_every_error_is_within_three_of_its_own_sigmas(tmp_path):
    drawn = write_synthetic(tmp_path / "drawn", SyntheticScene(), holdout=InputOptions().holdout)
    encode_frames(tmp_path / "clip.mp4", drawn)
    scene = ingest(open_clip(tmp_path / "clip.mp4", InputOptions()), tmp_path / "scene", InputOptions())
    prepare_priors(scene, PriorsOptions())
    (drawn.folder / "truth").rename(scene.folder / "truth")
    scene = Scene(scene.folder)
    truth, frames = scene.truth, scene.train_frames
    assert truth is not None
    true, ours = (np.stack([layers.mask(i) for i in frames]) for layers in (truth, scene))
    found = {obj.number: obj for obj in load_objects(scene).objects}
    assigned, _, _ = identities(overlaps(true, ours, 3), true, ours)
    scale = depth_scale(scene)
    log = np.stack([np.log(scale * scene.depth(i).depth / truth.depth(i).depth) for i in frames])
    for number, ours_is in enumerate(assigned, 1):
        assert ours_is is not None, f"object {number} was not found"
        error = float(np.median(log[(true == number) & (ours == ours_is)]))
        sigma = found[ours_is].sigma
        assert abs(error) <= SIGMAS * sigma, f"object {number} is {error:+.3f} off in ln, sure to {sigma:.3f}"
