"""Judge a run in words: one plain sentence, and the same in decibels. Everything that says how good a run is asks here."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from flowsplat.evaluation.scores import pick
from flowsplat.output.videos.amplitudes import MAX_OBJECT_ERROR, SWING_ANGLES
from flowsplat.priors.objects.description import sureness

MIN_SHARP_DETAIL, MIN_SOFT_DETAIL = 0.747, 0.405
"""Share of the fine detail (``evaluation.detail``) from which images are called sharp, and soft; below they are blurred. The
medians of what 42 frames of seven clips (DAVIS bear, camel, train; rigs garden, market, street, workshop) keep, blurred by one and
by two pixels."""
MIN_MISPLACED_CONTRAST = 0.765
"""Share of the contrast of fine detail from which images that reproduce too little of it to be soft are misplaced and not
blurred: the median of what the same frames keep, blurred by one pixel."""
MIN_SHARP_PSNR, MIN_SOFT_PSNR = 28.6, 24.4
"""The same in decibels, for runs that were measured before there was a figure of detail. The medians of what the middle frames of
six DAVIS clips (bear, camel, dance-twirl, lady-running, lucia, train; 854x480) have, blurred by one and by two pixels."""
MAX_SURE_SIGMA = MAX_OBJECT_ERROR / math.radians(SWING_ANGLES[0])
"""Standard deviation of the logarithm of an object's distance up to which it is no guess: with a focal length as long as the image
is wide, the object stands no farther beside its place in the narrowest loop than videos allow."""
_MAX_NAMED_OBJECTS = 3
"""Objects that the sentence names by their numbers. Chosen by eye."""
_EVEN_DECIBELS = 0.1
"""Decibels of PSNR that are not visible. Chosen by eye."""

_BADNESS = {"sharp": 0, "soft": 1, "blurred": 2, "misplaced": 2}
"""Of the grades of ``grade_sharpness``."""


def grade_sharpness(figures: Mapping[str, Any] | None) -> str | None:
    """Return how sharp images are: ``sharp``, ``soft``, ``blurred``, or ``misplaced``, with fine detail that is not the true one.

    Args:
        figures: of some images or a region of them, as ``metrics.json`` has them.

    Returns:
        None where nothing was measured.

    Examples:
        >>> grade_sharpness({"psnr": 24.0, "detail": 0.8, "contrast": 0.9}), grade_sharpness({"psnr": 35.2})
        ('sharp', 'sharp')
        >>> grade_sharpness({"detail": 0.3, "contrast": 0.4}), grade_sharpness({"detail": 0.3, "contrast": 0.9})
        ('blurred', 'misplaced')
    """
    detail, psnr = pick(figures or {}, "detail"), pick(figures or {}, "psnr")
    if detail is not None:
        if detail >= MIN_SOFT_DETAIL:
            return "sharp" if detail >= MIN_SHARP_DETAIL else "soft"
        return "misplaced" if (pick(figures or {}, "contrast") or 0.0) >= MIN_MISPLACED_CONTRAST else "blurred"
    if psnr is None:
        return None
    return "sharp" if psnr >= MIN_SHARP_PSNR else "soft" if psnr >= MIN_SOFT_PSNR else "blurred"


def verdict(metrics: Mapping[str, Any]) -> str:
    """Return one sentence for people: how sharp the scene is along the clip's path, how far it holds from the side, and which
    objects' distances are guesses.

    Args:
        metrics: the content of ``metrics.json``; missing keys are like null ones.

    Examples:
        >>> verdict({"heldout_frames": {"psnr": 33.0}, "orbit": {"degrees": 8.0, "unknown": 0.03, "holds": True}})
        'Sharp along your path; from the side it holds for about 8 degrees.'
    """
    sentence = "; ".join(part for part in (_word_path(metrics), _word_side(metrics), _word_guesses(metrics)) if part)
    return f"{sentence[0].upper()}{sentence[1:]}."


def _word_path(metrics: Mapping[str, Any]) -> str:
    grade = grade_sharpness(metrics.get("heldout_frames"))
    if grade is None:
        training = grade_sharpness(metrics.get("training_frames"))
        known = "" if training is None else f": your own frames come back {training}"
        return f"no frame was held out, so how sharp it is between your frames is not known{known}"
    return f"{grade} along your path{_word_moving(grade, pick(metrics, 'heldout_frames', 'moving'))}"


def _word_moving(grade: str, figures: Mapping[str, Any] | None) -> str:
    """Return what is said of what moves where it is worse than all."""
    inside = grade_sharpness(figures) or grade
    return f", but what moves is {inside}" if _BADNESS[inside] > _BADNESS[grade] else ""


def _word_side(metrics: Mapping[str, Any]) -> str:
    # What the clip never saw is missing, and neither sharp nor blurred.
    orbit, seen, moving = metrics.get("orbit"), *(pick(metrics, "heldout_views", name) for name in ("covisible", "moving"))
    views = grade_sharpness(seen if pick(seen or {}, "detail") is not None else metrics.get("heldout_views"))
    but = "" if views is None or pick(moving or {}, "detail") is None else _word_moving(views, moving)
    parts = [] if views is None else [f"{views} from where other cameras stood{but}"]
    if orbit is None:
        return parts[0] if parts else "how far it holds from the side was not measured"
    degrees = orbit["degrees"]
    if not orbit["holds"]:
        parts.append(f"from the side it does not hold for {SWING_ANGLES[0]:g} degrees")
    elif degrees >= SWING_ANGLES[-1]:
        parts.append(f"from the side it holds for {degrees:g} degrees and more")
    else:
        parts.append(f"from the side it holds for about {degrees:g} degrees")
    return "; ".join(parts)


def list_guesses(metrics: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return those large objects of ``metrics.json`` whose distances are guesses: nothing speaks for them, or too little."""
    return [obj for obj in list_large_objects(metrics) if not obj["cues"] or obj["sigma"] > MAX_SURE_SIGMA]


def _word_guesses(metrics: Mapping[str, Any]) -> str:
    objects, guesses = list_large_objects(metrics), list_guesses(metrics)
    if not guesses:
        return ""
    numbers = [obj.get("number") for obj in guesses]
    if len(objects) == 1:
        who = "the distance of what moves is a guess"
    elif len(guesses) == len(objects):
        who = f"the distances of all {len(objects)} objects are guesses"
    elif len(guesses) == 1:
        who = f"the distance of {f'1 of {len(objects)} objects' if numbers[0] is None else f'object {numbers[0]}'} is a guess"
    elif len(guesses) > _MAX_NAMED_OBJECTS or None in numbers:
        who = f"the distances of {len(guesses)} of {len(objects)} objects are guesses"
    else:
        who = f"the distances of objects {', '.join(map(str, numbers[:-1]))} and {numbers[-1]} are guesses"
    if not any(obj.get("hint") for obj in guesses):
        return who
    return f"{who}: show where {'it touches' if len(guesses) == 1 else 'each touches'} the ground"


def grade_path(metrics: Mapping[str, Any]) -> str:
    """Along the clip's path, beside interpolating by optical flow: better, even or worse; or unmeasured."""
    ours, theirs = pick(metrics, "heldout_frames", "psnr"), pick(metrics, "baselines", "flow_interpolation", "psnr")
    if ours is None or theirs is None:
        return "unmeasured"
    return "even" if abs(ours - theirs) < _EVEN_DECIBELS else "better" if ours > theirs else "worse"


def word_figures(metrics: Mapping[str, Any]) -> str:
    """Return the same in decibels: how good the scene is along the path of the clip beside interpolating, and from aside."""
    return f"{_along(metrics)} {_aside(metrics)}"


def _along(metrics: Mapping[str, Any]) -> str:
    """Return what was measured along the clip's own path."""
    ours, theirs = pick(metrics, "heldout_frames", "psnr"), pick(metrics, "baselines", "flow_interpolation", "psnr")
    training = pick(metrics, "training_frames", "psnr")
    if ours is None:
        known = "" if training is None else f" They are reproduced at {training:.2f} dB."
        return "No frame was held out, so nothing here tells how good the scene is between the training frames." + known
    count = pick(metrics, "heldout_frames", "count")
    images = "Images" if count is None else "The image" if count == 1 else f"The {count} images"
    are = "is" if count == 1 else "are"
    seen = f"Along the clip's path: {images[0].lower()}{images[1:]} that training never saw {are} rendered at {ours:.2f} dB"
    if theirs is None:
        return f"{seen}."
    gain = ours - theirs
    if abs(gain) < _EVEN_DECIBELS:
        return f"{seen}, as good as interpolating between the neighboring frames by optical flow ({theirs:.2f} dB)."
    if gain > 0:
        return f"{seen}, {gain:.2f} dB better than interpolating between the neighboring frames by optical flow."
    return (
        f"{seen}, {-gain:.2f} dB worse than interpolating between the neighboring frames by optical flow: "
        "the scene has not learned all of the motion."
    )


def _aside(metrics: Mapping[str, Any]) -> str:
    """Return what was measured from aside, or that nothing was and how sure the distances of objects are."""
    views = pick(metrics, "heldout_views", "psnr")
    if views is not None:
        moving = pick(metrics, "heldout_views", "moving", "psnr")
        warped = pick(metrics, "baselines_views", "warp_by_depth", "psnr")
        of_objects = "" if moving is None else f", what moves at {moving:.2f} dB"
        beside = "" if warped is None else f"; warping the frame of the same time by its true depth gives {warped:.2f} dB"
        return f"From aside: views by other cameras, which training never saw, are rendered at {views:.2f} dB{of_objects}{beside}."
    error = pick(metrics, "depth_abs_rel", "moving", "mean")
    if error is not None:
        return f"From aside: no view was measured; the depth of what moves is off by {error:.0%} (mean)."
    objects = list_large_objects(metrics)
    if not objects:
        return "From aside: not measured."
    steps = [obj["largest_step"] / obj["depth"] for obj in objects if obj["cues"]]
    near = f", enough for steps aside of up to {min(steps):.1%} of their distance" if len(steps) == len(objects) else ""
    whose = "the distance of its object is" if len(objects) == 1 else f"the distances of its {len(objects)} objects are"
    return f"From aside: not measured; {whose} {word_sureness(objects)}{near}."


def list_large_objects(metrics: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return what ``metrics.json`` has of objects, small parts left out."""
    return [obj for obj in metrics.get("objects") or [] if not obj.get("small")]


def word_sureness(objects: Sequence[Mapping[str, Any]]) -> str:
    """Return how sure the distances of objects are, as ``sureness`` says it."""
    tied = [obj["sigma"] for obj in objects if obj["cues"]]
    return sureness(tied, len(objects) - len(tied))
