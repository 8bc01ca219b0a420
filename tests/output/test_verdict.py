"""Words that judge a run: one sentence for people, and the same in decibels."""

from __future__ import annotations

import pytest

from flowsplat.output.verdict import (
    MAX_SURE_SIGMA,
    MIN_MISPLACED_CONTRAST,
    MIN_SHARP_DETAIL,
    MIN_SHARP_PSNR,
    MIN_SOFT_DETAIL,
    MIN_SOFT_PSNR,
    verdict,
    word_figures,
)
from tests.output.test_report import scores


def obj(sigma: float, cues: list[str], step: float = 0.02, depth: float = 2.0) -> dict:
    return {"number": 1, "sigma": sigma, "cues": cues, "largest_step": step, "depth": depth}


def guess(number: int, hint: str | None = "4,5@6") -> dict:
    return {**obj(0.8, []), "number": number, "hint": hint}


def held_out(psnr: float, moving: float | None = None) -> dict:
    return {"heldout_frames": scores(psnr, 0.9, moving)}


def orbit(degrees: float, holds: bool = True) -> dict:
    return {"orbit": {"degrees": degrees, "unknown": 0.03, "holds": holds}}


def detail(share: float, moving: float | None = None, contrast: float = 0.5) -> dict:
    """Figures of a run that measured sharpness, whose decibels say the opposite."""
    region = None if moving is None else {"psnr": 19.0, "ssim": 0.5, "detail": moving, "contrast": contrast}
    return {"psnr": 22.0, "ssim": 0.8, "detail": share, "contrast": contrast, "moving": region}


SHARP = held_out(33.0)


@pytest.mark.parametrize(
    ("metrics", "says"),
    [
        (held_out(MIN_SHARP_PSNR), "Sharp along your path;"),
        (held_out(MIN_SHARP_PSNR - 0.1), "Soft along your path;"),
        (held_out(MIN_SOFT_PSNR), "Soft along your path;"),
        (held_out(MIN_SOFT_PSNR - 0.1), "Blurred along your path;"),
        (held_out(33.0, 25.0), "Sharp along your path, but what moves is soft;"),
        (held_out(27.6, 19.0), "Soft along your path, but what moves is blurred;"),
        (held_out(33.0, 30.0), "Sharp along your path;"),
        (held_out(25.0, 33.0), "Soft along your path;"),
        ({"training_frames": scores(31.0, 0.9, None)}, "is not known: your own frames come back sharp;"),
        ({}, "No frame was held out, so how sharp it is between your frames is not known;"),
        ({"heldout_frames": detail(MIN_SHARP_DETAIL)}, "Sharp along your path;"),
        ({"heldout_frames": detail(MIN_SHARP_DETAIL - 0.01)}, "Soft along your path;"),
        ({"heldout_frames": detail(MIN_SOFT_DETAIL)}, "Soft along your path;"),
        ({"heldout_frames": detail(MIN_SOFT_DETAIL - 0.01)}, "Blurred along your path;"),
        ({"heldout_frames": detail(0.3, contrast=MIN_MISPLACED_CONTRAST)}, "Misplaced along your path;"),
        ({"heldout_frames": detail(0.9, 0.9)}, "Sharp along your path;"),
        ({"heldout_frames": detail(0.9, 0.5)}, "Sharp along your path, but what moves is soft;"),
        ({"heldout_frames": detail(0.9, 0.3, 0.8)}, "Sharp along your path, but what moves is misplaced;"),
        ({"training_frames": detail(0.9)}, "is not known: your own frames come back sharp;"),
    ],
)
def test_how_sharp_it_is_along_the_path(metrics, says):
    assert says in verdict(metrics)
    assert verdict(metrics).endswith("; how far it holds from the side was not measured.")


@pytest.mark.parametrize(
    ("known", "says"),
    [
        (orbit(8.0), "from the side it holds for about 8 degrees."),
        (orbit(3.0), "from the side it holds for about 3 degrees."),
        (orbit(12.0), "from the side it holds for 12 degrees and more."),
        (orbit(3.0, holds=False), "from the side it does not hold for 3 degrees."),
        ({"heldout_views": scores(26.0, 0.8, None)}, "soft from where other cameras stood."),
        (
            {"heldout_views": scores(33.0, 0.8, None), **orbit(5.0)},
            "sharp from where other cameras stood; from the side it holds for about 5 degrees.",
        ),
        ({"heldout_views": detail(0.8)}, "sharp from where other cameras stood."),
        ({"heldout_views": detail(0.8, 0.5)}, "sharp from where other cameras stood, but what moves is soft."),
        ({"heldout_views": scores(30.0, 0.9, 15.0)}, "sharp from where other cameras stood."),
        ({"heldout_views": {**detail(0.3), "covisible": detail(0.5)}}, "soft from where other cameras stood."),
        (
            {"heldout_views": {**scores(26.0, 0.8, None), "covisible": scores(30.0, 0.9, None)}},
            "soft from where other cameras stood.",
        ),
        ({"orbit": None}, "how far it holds from the side was not measured."),
    ],
)
def test_how_far_it_holds_from_the_side(known, says):
    assert verdict({**SHARP, **known}) == f"Sharp along your path; {says}"


SHOW = ": show where it touches the ground"


@pytest.mark.parametrize(
    ("objects", "says"),
    [
        ([], ""),
        ([obj(0.07, ["contact"])], ""),
        ([obj(MAX_SURE_SIGMA, ["height"])], ""),
        ([{**obj(MAX_SURE_SIGMA + 0.01, ["height"])}], "; the distance of what moves is a guess"),
        ([guess(1)], f"; the distance of what moves is a guess{SHOW}"),
        ([guess(1, None)], "; the distance of what moves is a guess"),
        ([obj(0.07, ["contact"]), guess(2)], f"; the distance of object 2 is a guess{SHOW}"),
        ([obj(0.07, ["contact"]), {**guess(2), "small": True}], ""),
        (
            [obj(0.07, ["contact"]), guess(2), guess(5), guess(7)],
            "; the distances of objects 2, 5 and 7 are guesses: show where each touches the ground",
        ),
        ([guess(2), guess(5, None)], "; the distances of all 2 objects are guesses: show where each touches the ground"),
        ([obj(0.07, ["contact"]), *map(guess, range(2, 7))], "; the distances of 5 of 6 objects are guesses: show where each"),
        ([obj(0.07, ["contact"]), obj(0.5, []) | {"number": None}], "; the distance of 1 of 2 objects is a guess"),
    ],
)
def test_which_distances_are_guesses(objects, says):
    said = verdict({**SHARP, **orbit(4.0), "objects": objects})
    start = "Sharp along your path; from the side it holds for about 4 degrees"
    assert said.startswith(start + says)
    assert says or said == f"{start}."


@pytest.mark.parametrize(
    ("ours", "theirs", "says"),
    [
        (30.0, 25.0, "5.00 dB better"),
        (24.0, 25.0, "1.00 dB worse"),
        (25.05, 25.0, "as good as"),
        (30.0, None, "never saw are rendered at 30.00 dB."),
        (None, None, "No frame was held out"),
    ],
)
def test_the_path_in_decibels(ours, theirs, says):
    metrics = {
        "heldout_frames": None if ours is None else {"psnr": ours, "count": 3},
        "baselines": None if theirs is None else {"flow_interpolation": {"psnr": theirs}},
    }
    assert says in word_figures(metrics)


@pytest.mark.parametrize(
    ("known", "says"),
    [
        ({}, "From aside: not measured."),
        (
            {"heldout_views": scores(16.94, 0.5, 11.2)},
            "From aside: views by other cameras, which training never saw, are rendered at 16.94 dB, what moves at 11.20 dB.",
        ),
        ({"depth_abs_rel": {"moving": {"mean": 0.41}}}, "no view was measured; the depth of what moves is off by 41% (mean)."),
        (
            {"objects": [obj(0.07, ["contact"]), obj(0.14, ["height"], step=0.01)]},
            "not measured; the distances of its 2 objects are sure to 7% to 15%, enough for steps aside of up to 0.5% of their",
        ),
        (
            {"objects": [obj(0.07, ["contact"]), {**obj(0.5, []), "small": True}]},
            "not measured; the distance of its object is sure to 7%",
        ),
        ({"objects": [obj(0.5, [])]}, "From aside: not measured; the distance of its object is a guess."),
        ({"objects": [obj(0.07, ["contact"]), obj(0.5, [])]}, "2 objects are sure to 7%, 1 of them a guess."),
    ],
)
def test_what_is_known_from_aside_in_figures(known, says):
    metrics = {"heldout_frames": {"psnr": 30.7, "count": 3}, **known}
    assert "Along the clip's path: the 3 images that training never saw are rendered at 30.70 dB." in word_figures(metrics)
    assert says in word_figures(metrics)
