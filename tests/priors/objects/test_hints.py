"""Hints place objects where the user says, are remembered, and are refused in one line where they mean nothing."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.priors.objects import load_objects
from flowsplat.priors.objects.hints import parse_hints
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors
from flowsplat.scenes import Scene
from tests.priors.planes import WALL, square_at, write_planes

FRAME = 6


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """Prepared without hints: the square is a guess before the wall."""
    scene = write_planes(tmp_path_factory.mktemp("hints") / "scene", step=2, square=True)
    for i in scene.train_frames:
        scene.write_mask(i, scene.truth.mask(i))
    scene.finish_prior("masks", method="truth")
    prepare_priors(scene, PriorsOptions())
    return scene


def place() -> tuple[int, int]:
    x, y = square_at(FRAME)
    return x + 14, y + 14


def depth_there(scene: Scene) -> float:
    x, y = place()
    return float(scene.depth(FRAME).depth[y, x])


def test_hints_place_an_object_and_changed_ones_place_it_anew(scene, capsys):
    x, y = place()
    (before,) = load_objects(scene).objects
    assert not before.cues
    assert depth_there(scene) < 0.99 * WALL
    hinted = PriorsOptions(same_depth=(f"{x},{y}@{FRAME}=4,4",))
    seconds = prepare_priors(scene, hinted)
    assert set(seconds) == {"depth"}
    (obj,) = load_objects(scene).objects
    assert list(obj.cues) == ["same_depth_hint"]
    assert obj.sigma == pytest.approx(0.03, abs=0.005)
    # It stands at the wall, or a little before it, so that it hides it.
    assert depth_there(scene) == pytest.approx(WALL, rel=0.05)
    assert not prepare_priors(scene, hinted)
    assert not prepare_priors(scene, PriorsOptions())
    assert set(prepare_priors(scene, PriorsOptions(contact=(f"{x},{y}@{FRAME}", "0.2,0.3@0")))) == {"depth"}
    (obj,) = load_objects(scene).objects
    assert list(obj.cues) == ["contact_hint"]
    assert scene.prior("objects")["hints"] == [f"contact {x},{y}@{FRAME}", "contact 0.2,0.3@0"]
    assert np.exp(np.nanmedian(obj.log_depth)) == pytest.approx(WALL, rel=0.06)


@pytest.mark.parametrize(
    ("hint", "says"),
    [
        ({"contact": ("4,4@6",)}, "nothing moves there; in frame 6 there are objects 1 about"),
        ({"contact": ("a,b@6",)}, "--contact a,b@6 cannot be understood"),
        ({"contact": ("40,30@99",)}, "there is no frame 99"),
        ({"same_depth": ("40,30@6",)}, "give x,y@frame=x2,y2"),
        ({"same_depth": ("40,30@6=3.5",)}, "give x,y@frame=x2,y2"),
        ({"same_depth": ("52,38@6=52,38",)}, "something moves at 52,38"),
        ({"same_depth": ("52,38@6=900,38",)}, "lies outside the frames"),
        ({"contact": ("52,38@6",), "priors": "true"}, "leave out what takes other depth"),
    ],
)  # fmt: skip
def test_hints_that_mean_nothing_are_one_line(scene, hint, says):
    with pytest.raises(InputError, match="--") as caught:
        prepare_priors(scene, PriorsOptions(**hint))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_typed():
    class Shape:
        width, height, num_frames = 100, 50, 9
        train_frames, heldout_frames = list(range(8)), [8]

    hints = parse_hints(("0.5,0.5@2",), ("10,20@3=30,40",), Shape())
    assert [(each.kind, each.frame, each.place, each.still) for each in hints] == [
        ("contact_hint", 2, (50.0, 25.0), None), ("same_depth_hint", 3, (10.0, 20.0), (30.0, 40.0)),
    ]  # fmt: skip
    with pytest.raises(InputError, match="held out"):
        parse_hints(("10,20@8",), (), Shape())
