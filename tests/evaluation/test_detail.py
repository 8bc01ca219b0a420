"""Sharpness is measured as sharpness: blurred, displaced and wrong images are told apart, and so are parts of one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flowsplat.evaluation.detail import DetailPair
from flowsplat.evaluation.scores import score_image, summarize
from flowsplat.output.verdict import grade_sharpness


def wall(seed: int = 0, height: int = 192, width: int = 256) -> np.ndarray:
    """Things of all sizes, as in a photograph: a sum of noise at several scales."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width, 3))
    for sigma in (1, 2, 4, 8, 16):
        noise = cv2.GaussianBlur(rng.standard_normal((height, width, 3)), (0, 0), sigma)
        image += noise / noise.std()
    return np.clip(0.5 + 0.07 * image, 0, 1)


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), sigma)


@pytest.mark.parametrize(
    ("change", "grade"),
    [
        (lambda image: image, "sharp"),
        (lambda image: blur(image, 0.75), "sharp"),
        (lambda image: blur(image, 1.5), "soft"),
        (lambda image: blur(image, 3), "blurred"),
        (lambda image: np.roll(image, 2, 0), "sharp"),
        (lambda image: np.roll(image, (1, 1), (0, 1)), "sharp"),
        (lambda image: blur(np.roll(image, 2, 1), 1.5), "soft"),
        (lambda image: np.roll(image, (13, 25), (0, 1)), "misplaced"),
        (lambda image: wall(1), "misplaced"),
        (lambda image: np.full_like(image, 0.5), "blurred"),
        (lambda image: np.clip(0.9 * image + 0.08, 0, 1), "sharp"),
    ],
    ids=["itself", "blurred a little", "by 1.5", "by 3", "2 beside", "1 and 1", "both", "25 beside", "another", "empty", "exposed"],
)
def test_blurred_displaced_and_wrong_images_are_told_apart(change, grade):
    target = wall()
    figures = score_image(change(target), target, {}, None, with_sharpness=True)
    assert grade_sharpness(figures) == grade
    assert 0 <= figures["detail"] <= figures["contrast"] + 0.1 <= 1.1


def test_each_part_of_an_image_has_its_own():
    """What moves is blurred and the rest is not; what is too small, or has no detail to lose, tells nothing."""
    target, mask = wall(), np.zeros((192, 256), bool)
    mask[40:150, 60:180] = True
    image = np.where(mask[..., None], blur(target, 3), target)
    small = np.zeros_like(mask)
    small[:20, :20] = True
    figures = score_image(image, target, {"moving": mask, "rest": ~mask, "small": small}, None, with_sharpness=True)
    assert grade_sharpness(figures["moving"]) == "blurred"
    assert grade_sharpness(figures["rest"]) == "sharp"
    assert figures["moving"]["detail"] < figures["detail"] < figures["rest"]["detail"]
    assert (figures["small"]["detail"], figures["small"]["contrast"]) == (None, None)
    assert DetailPair(target, np.full_like(target, 0.5)).measure() is None
    assert "detail" not in score_image(image, target, {}, None)


def test_what_lies_over_the_images_does_not_count():
    target, overlay = wall(), np.zeros((192, 256), bool)
    overlay[:96] = True
    image = np.where(overlay[..., None], target, blur(target, 3))
    assert grade_sharpness(score_image(image, target, {}, None, overlay, with_sharpness=True)) == "blurred"


def test_means_are_of_the_images_that_have_detail():
    target = wall()
    images = [score_image(blur(target, sigma), target, {}, None, with_sharpness=True) for sigma in (0.5, 2)]
    plain = score_image(target, np.full_like(target, 0.5), {}, None, with_sharpness=True)
    means = summarize([*images, plain])
    assert means["detail"] == pytest.approx(np.mean([image["detail"] for image in images]))
    assert "detail" not in summarize([score_image(target, target, {}, None)])


@pytest.mark.parametrize("shape", [(5, 7), (1, 40), (33, 16)])
def test_images_of_any_size_are_measured(shape):
    target = np.random.default_rng(0).random((*shape, 3))
    assert DetailPair(target, target).measure(np.ones(shape, bool)) is None or shape == (33, 16)
