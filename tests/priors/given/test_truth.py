"""True flow across held-out frames: put together from that of the pairs between, and left as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowsplat.pipeline import prepare
from flowsplat.pipeline.config import RunConfig
from flowsplat.priors.flow import flow_stage
from flowsplat.priors.given import true_flow
from flowsplat.priors.object_flow import object_flow_stage
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import Layers
from flowsplat.scenes.synthetic import SyntheticScene
from tests.flowsplat_benchmarks.conftest import write_rig

SPEC = SyntheticScene(width=96, height=64, frames=10, fps=12.0)
GAP = (4, 5, 6)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """Prepared with true priors."""
    folder = tmp_path_factory.mktemp("truth")
    write_rig(folder / "rig", SPEC)
    config = RunConfig()
    config = replace(
        config, input=replace(config.input, holdout_frames=GAP), priors=replace(config.priors, priors="true"), device="cpu"
    )
    return Scene(prepare(folder / "rig", folder / "out", config).scene_path)


@pytest.mark.parametrize("pair", [(3, 7), (7, 3), (2, 4)])
def test_it_is_that_of_the_scene(scene, pair):
    truth = scene.truth
    assert truth is not None
    assert pair not in truth.flow_pairs
    found, exact = true_flow(truth, *pair), SPEC.flow(*pair)
    assert found is not None
    assert (found.i, found.j) == pair
    assert not (found.trusted & ~exact.trusted).mean() > 0.01, "what is hidden at the end is not trusted"
    both = found.trusted & exact.trusted
    assert both.sum() > 0.8 * exact.trusted.sum()
    errors = np.linalg.norm(found.flow - exact.flow, axis=-1)
    assert np.percentile(errors[both], 95) < 0.1
    inside = both & (truth.mask(pair[0]) > 0)
    assert inside.sum() > 20
    assert np.median(errors[inside]) < 0.1


def test_a_truth_without_the_pairs_between_has_none(scene, tmp_path):
    layers = Layers(tmp_path, scene.width, scene.height)
    layers.write_flow(scene.truth.flow(3, 4))
    assert true_flow(layers, 3, 4) is not None
    assert true_flow(layers, 3, 5) is None


def test_a_scene_with_true_priors_has_true_flow_across_its_gaps(scene):
    assert scene.prior("flow")["method"] == "truth"
    found, exact = scene.flow(3, 7), true_flow(scene.truth, 3, 7)
    np.testing.assert_array_equal(found.trusted, exact.trusted)
    np.testing.assert_allclose(found.flow, exact.flow, atol=1 / 64)


def test_what_is_sure_is_not_searched_again(scene, tmp_path):
    copy = Scene.create(
        tmp_path / "copy",
        name="x",
        source="",
        width=SPEC.width,
        height=SPEC.height,
        timestamps=range(3),
        holdout=None,
        source_fps=1,
    )
    rng = np.random.default_rng(0)
    for i in range(3):
        copy.write_frame(i, scene.frame(i))
        copy.write_mask(i, (scene.truth.mask(i) > 0).astype(np.uint8))
    copy.finish_prior("masks", method="given")
    wrong = replace(scene.flow(0, 1), flow=rng.uniform(-9, 9, (64, 96, 2)).astype(np.float32), confidence=np.zeros((64, 96)))
    for pair in ((0, 1), (1, 0), (1, 2), (2, 1)):
        copy.write_flow(replace(wrong, i=pair[0], j=pair[1]))
    flow_stage(copy)
    before = {pair: copy.flow(*pair).flow for pair in copy.flow_pairs}
    object_flow_stage(copy, [(0, 1), (1, 0)])
    for pair, flow in before.items():
        assert np.array_equal(copy.flow(*pair).flow, flow) == (pair in ((0, 1), (1, 0))), pair
