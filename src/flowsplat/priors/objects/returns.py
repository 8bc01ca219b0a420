"""Objects that leave and come back: one number and one trajectory for what was told to be one, and the words that say so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from flowsplat.priors.continuity import Continuity
from flowsplat.priors.objects.areas import describe_count, large_objects
from flowsplat.priors.objects.identity.appearance import MaskedFrames
from flowsplat.priors.objects.identity.returning import Pair, ReturnClassifier, join_pairs, read_classifier, score_pairs
from flowsplat.priors.objects.shape_offset import ShapePoints
from flowsplat.priors.objects.solving import DynamicObject
from flowsplat.priors.objects.storage import SceneObjects
from flowsplat.scenes import Scene

RETURNS, MAY_RETURN = "returns", "may_return"
"""What the record of masks calls those that are one and those that may be: ``object``, ``leaves`` and ``back`` in seconds and
``probability``, and of the latter ``as``, the number with which it may be back."""


def find_returns(scene: Scene) -> list[Pair]:
    """Return the pairs of numbers of which one ends before the other begins, each with the probability that they are one object.

    Needs cameras, and masks with the numbers of ``identify_objects``; frames are positions in ``scene.train_frames``.
    """
    frames, continuity = scene.train_frames, Continuity(scene)
    every = scene.cameras
    clip = MaskedFrames(
        np.asarray(scene.timestamps)[frames], np.asarray(continuity.pieces), [every[i] for i in frames],
        lambda k: scene.mask(frames[k]), lambda k: scene.frame(frames[k]),
    )  # fmt: skip
    return score_pairs(clip)


def join_returns(
    scene: Scene, found: SceneObjects, pairs: Sequence[Pair], classifier: ReturnClassifier | None = None
) -> SceneObjects:
    """Return the objects, those that are one as one, and rewrite the stored masks and their record; nothing without pairs.

    The earlier number stays, and numbers stay without gaps. Before and after an absence each keeps the depth that it was solved
    with, for no point of it was followed from one to the other.

    Args:
        found: objects with the numbers of the masks.
        pairs: of ``find_returns``.
        classifier: None = the package's own.
    """
    classifier = classifier or read_classifier()
    joined = join_pairs(pairs, classifier.gate)
    first, second = {pair.before for pair in joined}, {pair.after for pair in joined}
    rest = [pair for pair in pairs if pair.before not in first and pair.after not in second]
    table = np.arange(256)
    if joined:
        table = _rewrite_masks(scene, joined)
        objects: dict[int, DynamicObject] = {}
        for obj in found.objects:
            number = int(table[obj.number])
            objects[number] = _merge(objects[number], obj) if number in objects else replace(obj, number=number)
        found = replace(found, objects=list(objects.values()))
    _record(scene, [_tell(scene, pair, table) for pair in joined], [
        {**_tell(scene, pair, table), "as": int(table[pair.after])} for pair in join_pairs(rest, classifier.maybe)
    ])  # fmt: skip
    return found


def describe_returns(masks: Mapping[str, Any]) -> str:
    """Return what the record of masks says of who comes back, ``""`` of nobody.

    Examples:
        >>> told = {"object": 1, "leaves": 3.2, "back": 5.1, "probability": 0.96}
        >>> describe_returns({"returns": [told]})
        'object 1 leaves at 3.2 s and is back at 5.1 s, sure to 96%'
        >>> describe_returns({"may_return": [{**told, "probability": 0.7, "as": 2}]})
        'object 1 leaves at 3.2 s and may be back at 5.1 s as object 2 (70%)'
    """
    words = []
    for each in masks.get(RETURNS, []):
        words.append(f"{_leaves(each)} and is back at {each['back']:.1f} s, sure to {each['probability']:.0%}")
    for each in masks.get(MAY_RETURN, []):
        words.append(f"{_leaves(each)} and may be back at {each['back']:.1f} s as object {each['as']} ({each['probability']:.0%})")
    return "; ".join(words)


def _leaves(told: Mapping[str, Any]) -> str:
    return f"object {told['object']} leaves at {told['leaves']:.1f} s"


def _rewrite_masks(scene: Scene, joined: Sequence[Pair]) -> np.ndarray:
    """Return the new number [256] of every number, after the masks are written with it."""
    masks = [scene.mask(i) for i in scene.train_frames]
    heads = np.arange(256)
    for pair in joined:  # by time, so that the number before already has that of the first one
        heads[pair.after] = heads[pair.before]
    present = np.unique(np.concatenate([np.unique(mask) for mask in masks]))
    kept = np.unique(np.append(heads[present], 0))
    table = np.searchsorted(kept, heads).clip(0, len(kept) - 1)
    for i, mask in zip(scene.train_frames, masks, strict=True):
        scene.write_mask(i, table.astype(np.uint8)[mask])
    return table


def _merge(a: DynamicObject, b: DynamicObject) -> DynamicObject:
    """Return one object of two that are never seen at one time; what is said of its distance is what is said of the less sure."""
    unsure = a if a.sigma >= b.sigma else b
    points = [np.concatenate([getattr(a.points, name), getattr(b.points, name)]) for name in vars(a.points)]
    return DynamicObject(
        a.number, np.where(np.isfinite(a.log_depth), a.log_depth, b.log_depth),
        np.where(np.isfinite(a.middles), a.middles, b.middles), unsure.sigma, a.rigid and b.rigid, unsure.cues,
        ShapePoints(*points), max(a.expected, b.expected),
    )  # fmt: skip


def _tell(scene: Scene, pair: Pair, table: np.ndarray) -> dict[str, Any]:
    leaves, back = (float(scene.timestamps[scene.train_frames[k]]) for k in (pair.last, pair.first))
    return {
        "object": int(table[pair.before]),
        "leaves": round(leaves, 3),
        "back": round(back, 3),
        "probability": round(pair.probability, 3),
    }


def _record(scene: Scene, returns: list[dict[str, Any]], may_return: list[dict[str, Any]]) -> None:
    """Write what was found into the record of masks, and take out what an earlier run found."""
    before = scene.prior("masks")
    if before is None:
        return
    how = {name: value for name, value in before.items() if name not in (RETURNS, MAY_RETURN)}
    if returns:
        how[RETURNS], how["objects"] = returns, how["objects"] - len(returns)
    if may_return:
        how[MAY_RETURN] = may_return
    if how.get("method") == "motion" and "share" in how and (returns or may_return):
        large = len(large_objects(scene))
        count = describe_count(large, how["objects"] - large)
        how["verdict"] = f"{count} on {how['share']:.1%} of the image; {describe_returns(how)}"
    if how != before:
        scene.finish_prior("masks", **how)
