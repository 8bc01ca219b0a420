"""The graph of priors: its order, what follows from what, and how little a new kind needs."""

from __future__ import annotations

import dataclasses
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.files import read_npz, write_npz
from flowsplat.priors import prepare
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.graph import PRIORS, Graph
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors, use_truth
from flowsplat.priors.prior import Kind, Prior
from flowsplat.scenes import Scene

from .planes import write_planes


def test_the_order():
    assert PRIORS.names == ["cameras", "flow", "masks", "tracks", "depth"]  # and those that were added
    assert PRIORS.recorded == ["cameras", "flow", "masks", "tracks", "objects", "depth"]
    steps = {prior.name: prior.part_of for prior in PRIORS if prior.part_of}
    assert steps == {
        "static_depth": "masks", "masked_static_depth": "depth", "objects": "depth", "resting_tracks": "tracks",
        "object_flow": "flow",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "followers"),
    [
        ("cameras", {"masks", "tracks", "depth"}), ("flow", {"masks", "tracks", "depth"}), ("masks", {"tracks", "depth"}),
        ("tracks", set()), ("objects", {"depth"}), ("depth", {"tracks"}),
    ],
)  # fmt: skip
def test_what_follows_from_what(name, followers):
    assert PRIORS.followers(name) == followers


def test_other_images_change_everything():
    assert PRIORS.followers("cameras", outlasting=False) == {"flow", "masks", "tracks", "depth"}


@pytest.mark.parametrize(
    "priors",
    [
        (Prior("a", Kind()), Prior("a", Kind())),
        (Prior("a", Kind(), needs=("b",)), Prior("b", Kind())),
        (Prior("a", Kind(), part_of="b"),),
    ],
)
def test_a_graph_that_is_none(priors):
    with pytest.raises(ValueError, match=r"name of its own|does not come before it"):
        Graph(*priors)


def test_every_setting_decides_on_a_prior():
    decided = {name for prior in PRIORS for name in prior.kind.options}
    assert decided | {"priors", "given"} == {field.name for field in dataclasses.fields(PriorsOptions)}
    assert PRIORS.list_depending_on(["mask_click"]) == ["masks", "tracks", "depth"]
    assert PRIORS.list_depending_on(["contact"]) == ["depth"]
    assert PRIORS.list_depending_on(["given"]) == []


def test_every_prior_can_be_given():
    assert sorted(GivenPriors.names()) == sorted(prior.name for prior in PRIORS.whole if prior.kind.read_given is not None)


@pytest.fixture(scope="module")
def true_scene(tmp_path_factory) -> Path:
    scene = write_planes(tmp_path_factory.mktemp("true"), step=2, square=True)
    use_truth(scene)
    return scene.folder


@pytest.fixture
def scene(true_scene: Path, tmp_path: Path) -> Scene:
    shutil.copytree(true_scene, tmp_path / "scene")
    return Scene(tmp_path / "scene")


def test_all_files_of_a_scene_have_an_owner(scene):
    brought = {"scene.json", "frames", "truth", "views", "views.json"}
    owned = {name for prior in PRIORS for name in prior.kind.files}
    assert {path.name for path in scene.folder.iterdir()} - brought <= owned


def test_steps_are_forgotten_with_their_prior_and_with_what_they_follow_from(scene):
    for name in ("cameras", "flow", "masks", "tracks", "depth"):
        scene.finish_prior("objects", method="motion")
        (scene.folder / "objects.json").touch()
        PRIORS.forget(scene, {name})
        assert scene.prior(name) is scene.prior("objects") is None
        assert not (scene.folder / "objects.json").exists()
    left = {path.name for path in scene.folder.iterdir()}
    assert {"cameras.json", "masks"} <= left
    assert left.isdisjoint({"flow", "depth", "tracks.npz"})


# -- a kind of a plugin, say


def compute_normals(scene: Scene) -> None:
    """Unit normals [H, W, 3] float32 of the surfaces that depth shows, in the axes of the camera."""
    for i in scene.train_frames:
        down, right = np.gradient(np.log(scene.depth(i).depth))
        normals = np.stack([right, down, np.full_like(right, -1.0)], -1)
        write_npz(scene.folder / "normals" / f"{i:05d}.npz", {"normals": normals / np.linalg.norm(normals, axis=-1, keepdims=True)})
    scene.finish_prior("normals", method="gradient", verdict="normals of the depth")


NORMALS = Kind(compute=lambda request: partial(compute_normals, request.scene), files=("normals",), own=("gradient",))


def test_a_new_kind_is_computed_kept_and_made_anew_with_what_it_needs(scene, monkeypatch, capsys):
    graph = Graph(*PRIORS, Prior("normals", NORMALS, needs=("depth",)))
    monkeypatch.setattr(prepare, "PRIORS", graph)
    assert "normals" in prepare_priors(scene, PriorsOptions())
    assert read_npz(scene.folder / "normals" / "00000.npz")["normals"].shape == (scene.height, scene.width, 3)
    assert "normals: normals of the depth" in capsys.readouterr().err
    assert prepare_priors(scene, PriorsOptions()) == {}
    scene.finish_prior("depth", method="guess")  # now it is another one than the truth
    assert set(prepare_priors(scene, PriorsOptions(priors="true"))) == {"truth", "normals"}
    graph.forget(scene, {"normals"})
    assert not (scene.folder / "normals").exists()
