"""Masks from clicks and boxes on single frames, without learned weights: cut out there, then carried along the flow.

On its own frame an object is cut out by GrabCut (https://doi.org/10.1145/1015706.1015720), which starts from what moves
like the clicked point, or as the middle of the box does, where that differs from its surroundings. From frame to frame the
mask follows the flow, and GrabCut decides anew in a narrow band along its edge.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.progress import track
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.geometry.interpolation import sample_map
from flowsplat.scenes import Scene

REACH = 0.25
"""Share of the picture's long side within which the object under a click is looked for."""

MOVES = 1.0
"""Pixels a frame by which an object's motion must differ from its surroundings' to be told by it."""

BAND = 0.012
"""Share of the picture's long side by which the flow may misplace an edge."""

LOST = 0.3
"""Mean confidence of the flow below which a carried part of a mask is dropped."""

ALIKE = 30.0
"""Grey levels beyond which a pixel is not the one that the flow says it was."""

SAME = 0.5
"""Share of the smaller one by which two masks overlap if they show one object."""

COLLAPSED = 0.2
"""Share of a first guess below which what GrabCut leaves of it is a failure."""

ROUNDS = 4
"""Of GrabCut on the frame with the prompt; one is enough to correct an edge."""

_EXAMPLES = {2: "320,180@0", 4: "280,120,400,240@0"}
_NUMBER = r"-?\d+(?:\.\d+)?"


@dataclass(frozen=True)
class Prompt:
    """An object on one frame: ``clicks`` [(x, y), ...] on it, and perhaps the ``box`` (left, top, right, bottom) round it,
    in pixels of the frames."""

    frame: int
    clicks: tuple[tuple[float, float], ...]
    box: tuple[float, float, float, float] | None = None


def parse_prompts(clicks: Sequence[str], boxes: Sequence[str], scene: Scene) -> list[Prompt]:
    """Prompts as they are typed: ``x,y@frame`` and ``x0,y0,x1,y1@frame``.

    Values that are all at most 1 are shares of width and height, others are pixels of the frames. A click inside a box of
    its frame belongs to it; any other is an object of its own.

    Raises:
        InputError: not of that form, outside the picture, or on a frame that is held out or does not exist.
    """
    found = []
    points = [(text, *parse_place(text, "--mask-click", 2, scene)) for text in clicks]
    for text in boxes:
        frame, (x0, y0, x1, y1) = parse_place(text, "--mask-box", 4, scene)
        if x1 - x0 < 2 or y1 - y0 < 2:
            raise InputError(f"--mask-box {text} is empty: give left,top,right,bottom@frame.")
        inside = [p for p in points if p[1] == frame and x0 <= p[2][0] <= x1 and y0 <= p[2][1] <= y1]
        points = [p for p in points if p not in inside]
        found.append(Prompt(frame, tuple((p[2][0], p[2][1]) for p in inside), (x0, y0, x1, y1)))
    return found + [Prompt(frame, ((x, y),)) for _, frame, (x, y) in points]


def parse_place(text: str, option: str, count: int, scene: Scene) -> tuple[int, tuple[float, ...]]:
    """The frame and the ``count`` (2 or 4) values, in pixels, of a place in a training frame as it is typed.

    Args:
        option: that it was given to, for messages.

    Raises:
        InputError: as ``parse_prompts``.
    """
    form = ("x,y" if count == 2 else "x0,y0,x1,y1") + "@frame"
    match = re.fullmatch(rf"\s*({_NUMBER}(?:\s*,\s*{_NUMBER}){{{count - 1}}})\s*@\s*(\d+)\s*", text)
    if match is None:
        raise InputError(f"{option} {text} cannot be understood: give {form}, for example {option} {_EXAMPLES[count]}.")
    values, frame = np.array([float(value) for value in match[1].split(",")]), int(match[2])
    limits = np.array([scene.width, scene.height] * (count // 2))
    if values.max() <= 1:
        values = values * limits
    if count == 4:
        values = np.clip(values, 0, limits)  # A box may reach over the edge.
    if (values < 0).any() or (values > limits).any():
        raise InputError(f"{option} {text} lies outside the frames, which have {scene.width}x{scene.height} pixels.")
    if frame in scene.heldout_frames:
        near = min(scene.train_frames, key=lambda i: abs(i - frame))
        raise InputError(f"{option} {text}: frame {frame} is held out for the figures; choose another, for example {near}.")
    if frame not in scene.train_frames:
        raise InputError(f"{option} {text}: there is no frame {frame}; they count from 0 to {scene.num_frames - 1}.")
    return frame, tuple(values.tolist())


def prompt_stage(scene: Scene, prompts: Sequence[Prompt]) -> None:
    """Masks with object numbers for the training frames. Needs flow."""
    frames = scene.train_frames
    walks = [_carried(scene, prompt) for prompt in track(prompts, "Masks")]
    numbers = _numbers(walks, [frames.index(prompt.frame) for prompt in prompts])
    pixels, sure = 0, []
    masks = [np.zeros((scene.height, scene.width), np.uint8) for _ in frames]
    for walk, number in zip(walks, numbers, strict=True):
        for mask, (part, confidence) in zip(masks, walk, strict=True):
            mask[part & (mask == 0)] = number
            sure.append(confidence)
    for i, mask in zip(frames, masks, strict=True):
        scene.write_mask(i, mask)
        pixels += int((mask > 0).sum())
    share = pixels / (len(frames) * scene.width * scene.height)
    scene.finish_prior(
        "masks", method="clicks", verdict=f"{max(numbers)} object(s) from clicks and boxes on {share:.1%} of the picture",
        objects=max(numbers), share=round(share, 5), confidence=round(float(np.mean(sure)), 4),
    )  # fmt: skip


Part = tuple[np.ndarray, float]
"""A mask bool [H, W], and how sure the flow along which it came was."""


def _carried(scene: Scene, prompt: Prompt) -> list[Part]:
    """The object of a prompt in every training frame."""
    frames = scene.train_frames
    start = frames.index(prompt.frame)
    neighbour = frames[start + 1] if start + 1 < len(frames) else frames[start - 1]
    first = cut_out(scene.frame(prompt.frame), scene.flow(prompt.frame, neighbour).flow, prompt)
    parts: list[Part] = [(first, 1.0)] * len(frames)
    for steps in (range(start + 1, len(frames)), range(start - 1, -1, -1)):
        before = start
        for k in steps:
            parts[k] = _next(scene, parts[before][0], frames[before], frames[k])
            before = k
    return parts


def _next(scene: Scene, mask: np.ndarray, before: int, i: int) -> Part:
    """A mask one training frame further: where the flow back ends inside it, with the edge where the picture has one."""
    if not mask.any():
        return mask, 0.0
    back = scene.flow(i, before)
    source = (pixel_grid(scene.width, scene.height) + back.flow).reshape(-1, 2)
    carried = sample_map(mask.astype(np.float32), source).reshape(mask.shape)
    inside = (source > 0).all(1) & (source < [scene.width, scene.height]).all(1)
    carried = np.where(inside.reshape(mask.shape), carried, 0)
    image = scene.frame(i)
    was = sample_map(scene.frame(before), source).reshape(image.shape)
    apart = cv2.blur(np.abs(image.astype(np.float32) - was).mean(-1), (5, 5))
    moved = _reliable(carried > 0.5, np.where(apart < ALIKE, back.confidence, 0))
    if not moved.any():
        return moved, 0.0
    return snapped(image, moved), float(back.confidence[moved].mean())


def _reliable(mask: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """The parts of a mask, bool [H, W], to which the flow leads with some confidence: not what it makes of an object that left."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8))
    means = np.bincount(labels.ravel(), confidence.ravel(), count) / np.maximum(np.bincount(labels.ravel(), minlength=count), 1)
    kept = means >= LOST
    kept[0] = False
    return kept[labels]


def _numbers(walks: list[list[Part]], starts: list[int]) -> list[int]:
    """Object numbers 1, 2, ... of the walks: one where a later one starts on what an earlier one shows."""
    numbers: list[int] = []
    for n, (walk, start) in enumerate(zip(walks, starts, strict=True)):
        own = walk[start][0]
        for earlier in range(n):
            other = walks[earlier][start][0]
            if (own & other).sum() > SAME * min(own.sum(), other.sum()):
                numbers.append(numbers[earlier])
                break
        else:
            numbers.append(max(numbers, default=0) + 1)
    return numbers


def cut_out(image: np.ndarray, flow: np.ndarray, prompt: Prompt) -> np.ndarray:
    """The object of a prompt, bool [H, W].

    Args:
        image: RGB [H, W, 3] uint8.
        flow: [H, W, 2] pixels to a neighbouring frame.
    """
    height, width = image.shape[:2]
    long_side = max(height, width)
    clicked, inside = np.zeros((height, width), np.uint8), np.zeros((height, width), np.uint8)
    for x, y in prompt.clicks:
        cv2.circle(clicked, (min(int(x), width - 1), min(int(y), height - 1)), max(2, round(0.006 * long_side)), 1, -1)
    if prompt.box is None:
        x, y = prompt.clicks[0]
        cv2.circle(inside, (int(x), int(y)), round(REACH * long_side), 1, -1)
    else:
        x0, y0, x1, y1 = (round(value) for value in prompt.box)
        inside[y0:y1, x0:x1] = 1
    seeds, possible = clicked > 0, inside > 0
    # The colours of a box decide best; where they fail, its motion does.
    guesses = [_like_the_click(image, flow, seeds, possible)] if prompt.box is None else [possible, _unlike_outside(flow, possible)]
    for guess in guesses:
        trimap = np.full((height, width), cv2.GC_BGD, np.uint8)
        trimap[possible] = cv2.GC_PR_BGD
        trimap[guess] = cv2.GC_PR_FGD
        trimap[seeds] = cv2.GC_FGD
        found = _grab(image, trimap, ROUNDS)
        found = _touching(found, seeds) if prompt.clicks else found
        if found.sum() > COLLAPSED * guess.sum():
            return found
    return guesses[-1] | seeds


def _unlike_outside(flow: np.ndarray, possible: np.ndarray) -> np.ndarray:
    """What of a box, bool [H, W], does not move as its surroundings do; all of it where nothing does."""
    ring = cv2.dilate(possible.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    around = flow[ring & ~possible]
    if len(around) == 0:
        return possible
    moves = possible & (np.linalg.norm(flow - np.median(around, axis=0), axis=-1) > 0.5 * MOVES)
    return moves if moves.sum() > COLLAPSED * possible.sum() else possible


def _like_the_click(image: np.ndarray, flow: np.ndarray, seeds: np.ndarray, possible: np.ndarray) -> np.ndarray:
    """What near a click, bool [H, W], moves as it does; where nothing moves apart, what looks like it."""
    own = np.median(flow[seeds], axis=0)
    apart = float(np.linalg.norm(own - np.median(flow[possible], axis=0)))
    if apart > MOVES:
        moves = _touching(possible & (np.linalg.norm(flow - own, axis=-1) < 0.5 * apart), seeds)
        if moves.sum() > 4 * seeds.sum():
            return moves
    lab = cv2.cvtColor(cv2.bilateralFilter(np.ascontiguousarray(image), 7, 30, 5), cv2.COLOR_RGB2LAB).astype(np.float32)
    colour = np.median(lab[seeds], axis=0)
    distance = np.linalg.norm(lab - colour, axis=-1)
    return _touching(possible & (distance < 12 + 2 * float(np.median(distance[seeds]))), seeds)


def snapped(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The mask, bool [H, W], with its edge moved to one of the picture RGB [H, W, 3] where there is one nearby."""
    margin = max(2, round(BAND * max(mask.shape)))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    solid = mask.astype(np.uint8)
    trimap = np.full(mask.shape, cv2.GC_BGD, np.uint8)
    trimap[cv2.dilate(solid, kernel) > 0] = cv2.GC_PR_BGD
    trimap[mask] = cv2.GC_PR_FGD
    trimap[cv2.erode(solid, kernel, borderValue=1) > 0] = cv2.GC_FGD
    return _grab(image, trimap, 1)


def _grab(image: np.ndarray, trimap: np.ndarray, rounds: int) -> np.ndarray:
    """GrabCut from a trimap [H, W] of ``cv2.GC_*``, in a window round what is open; what is left as it was where it fails."""
    probable = (trimap == cv2.GC_FGD) | (trimap == cv2.GC_PR_FGD)
    x, y, width, height = cv2.boundingRect((trimap != cv2.GC_BGD).astype(np.uint8))
    # Wide enough that the background's colours are seen.
    pad = max(8, max(width, height) // 4)
    window = (slice(max(y - pad, 0), y + height + pad), slice(max(x - pad, 0), x + width + pad))
    inner = trimap[window].copy()
    background = (inner == cv2.GC_BGD) | (inner == cv2.GC_PR_BGD)
    found = probable.copy()
    if background.any() and not background.all():
        picture = np.ascontiguousarray(image[window][..., ::-1])
        cv2.setRNGSeed(0)  # Its colour models start from random samples.
        cv2.grabCut(picture, inner, None, np.zeros((1, 65)), np.zeros((1, 65)), rounds, cv2.GC_INIT_WITH_MASK)
        cut = (inner == cv2.GC_FGD) | (inner == cv2.GC_PR_FGD)
        if cut.any():
            found[window] = cut
    return found


def _touching(mask: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The parts of a mask that ``seeds`` touch, and the seeds themselves; all bool [H, W]."""
    _, labels = cv2.connectedComponents((mask | seeds).astype(np.uint8))
    return np.isin(labels, np.unique(labels[seeds]))
