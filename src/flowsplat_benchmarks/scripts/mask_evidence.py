"""How often pixels that move look like something, and how often those that rest: the tables by which masks are cut, counted.

    python -m flowsplat_benchmarks.scripts.mask_evidence OUT DATA_ROOT            # prepares some 70 scenes once; then five minutes
    python -m flowsplat_benchmarks.scripts.mask_evidence OUT DATA_ROOT --write    # also makes the tables the package's own

Counted on random worlds of low seeds and on the rendered scenes under ``DATA_ROOT``, every one with the same weight, at pixels of
objects of which motion alone finds something, and at those round them; other worlds, all of seeds below 900, tell what the tables
are worth. Scenes are prepared as for ``flowsplat_benchmarks.scripts.identity``. ``OUT/mask_evidence.md`` is the table: masks as the
package cuts them, and cut by tables counted on worlds alone, to which the rendered scenes are new, and on both.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from flowsplat.common.errors import InputError
from flowsplat.common.files import write_json, write_text
from flowsplat.common.progress import report, track
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.static_depth import static_depth
from flowsplat.priors.flow import dis_estimator
from flowsplat.priors.masks.background_plate import PlateComparison
from flowsplat.priors.masks.colors import look_up
from flowsplat.priors.masks.evidence import AXES, TABLES, UNEXPLAINED, Tables, weigh_plates
from flowsplat.priors.masks.motion import motion_evidence
from flowsplat.priors.masks.stage import compare_plates, cut_masks, learn_colors, weigh_colors, write_rough_masks
from flowsplat.scenes import Scene
from flowsplat_benchmarks.scripts.identity import WORLDS, prepare_scene

TUNED = ("rig/street", "rig/market", "rig/workshop", "rig/garden")
REST_REACH = 0.05
"""Share of the long side round an object within which what rests is counted. Chosen by eye."""
MIN_FOUND_SHARE = 0.2
"""Share of an object that motion alone must find for it to be counted. Chosen by eye."""
FRAME_STRIDE = 2
"""Frames that are counted: every so many."""
COUNT_SMOOTHING, RARE = 0.6, 1e-3
"""Of counts: bins over which they are smoothed, and the share of all, spread over all bins, that is added. Chosen by eye."""
MIN_OBJECT_PIXELS = 150
"""Of an object in a frame, below which its feet are not measured. Chosen by eye."""
FEET_SHARE = 0.1
"""Share of an object's height that is called its feet."""

Counts = dict[str, np.ndarray]
"""By the names of ``AXES``: what rests and what moves, [2, ...]."""


@dataclass
class Known:
    """A scene whose cues are counted.

    Attributes:
        motion: summed evidence of every training frame, cues: how each differs from its plates, and its motion.
        true: [T, H, W] uint8 ids, counted: [T, H, W] uint8, 1 for what rests near objects that were found, 2 for these, else 0.
        before: [T, H, W] bool, the masks with which it was prepared.
    """

    clip: MatchedClip
    motion: list[np.ndarray]
    cues: list[tuple[PlateComparison, np.ndarray]]
    true: np.ndarray
    counted: np.ndarray
    before: np.ndarray


def read_known(scene: Scene, true_mask: Callable[[int], np.ndarray]) -> Known:
    """Compute the cues of a prepared scene; its masks are left as they were."""
    frames = scene.train_frames
    before = [scene.mask(i).copy() for i in frames]
    clip = MatchedClip(scene, dis_estimator)
    motion = motion_evidence(clip, static_depth(clip, False))
    try:
        write_rough_masks(clip, motion)
        rough = np.stack([scene.mask(i) > 0 for i in frames])
        cues = [to_half_precision(*each) for each in compare_plates(clip, motion)]
    finally:
        for i, mask in zip(frames, before, strict=True):
            scene.write_mask(i, mask)
    true = np.stack([true_mask(i) for i in frames]).astype(np.uint8)
    return Known(clip, motion, cues, true, choose_counted(true, rough), np.stack(before) > 0)


def to_half_precision(found: PlateComparison, motion: np.ndarray) -> tuple[PlateComparison, np.ndarray]:
    """Return cues as float16: all frames of all scenes stay in memory."""
    return PlateComparison(*(values.astype(np.float16) for values in vars(found).values())), motion.astype(np.float16)


def choose_counted(true: np.ndarray, rough: np.ndarray) -> np.ndarray:
    """Return ``Known.counted``, from true ids [T, H, W] and what motion finds [T, H, W]."""
    pixels, hits = np.bincount(true.ravel(), minlength=256), np.bincount(true[rough], minlength=256)
    found = (hits >= MIN_FOUND_SHARE * pixels) & (pixels > 0)
    found[0] = False
    reach = round(REST_REACH * max(true.shape[1:]))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    moves = found[true].astype(np.uint8)
    near = np.stack([cv2.dilate(mask, disc) for mask in moves])
    return np.where(moves > 0, 2, near * (true == 0)).astype(np.uint8)


def count_cues(known: Known) -> Counts:
    """All but those of colors."""
    counts = {name: np.zeros((2, *(len(knots) for knots in AXES[name]))) for name in ("plates", "motion", "light")}
    for (found, motion), counted in list(zip(known.cues, known.counted, strict=True))[::FRAME_STRIDE]:
        for which in (0, 1):
            inside = counted == which + 1
            beside = inside & (found.similar >= 0)
            lit = beside & (found.median > np.mean(UNEXPLAINED))
            add(counts["plates"][which], AXES["plates"], found.similar[beside], found.median[beside], motion[beside])
            add(counts["motion"][which], AXES["motion"], motion[inside & ~beside])
            add(counts["light"][which], AXES["light"], found.brightness[lit], found.tint[lit], found.detail[lit])
    return counts


def count_colors(known: Known, tables: Tables) -> Counts:
    """Those of colors, for what the others say together."""
    counts = {name: np.zeros((2, *(len(knots) for knots in AXES[name]))) for name in ("color", "color without plate")}
    evidence = [weigh(tables, *cues) for cues in known.cues]
    colors = learn_colors(known.clip, evidence, known.motion)
    if colors is not None:
        scene = known.clip.scene
        for k in range(0, len(evidence), FRAME_STRIDE):
            color = look_up(colors, scene.frame(scene.train_frames[k]))
            has_plate = known.cues[k][0].similar >= 0
            for name, where in (("color", has_plate), ("color without plate", ~has_plate)):
                for which in (0, 1):
                    inside = where & (known.counted[k] == which + 1)
                    add(counts[name][which], AXES[name], evidence[k][inside], color[inside])
    return counts


def weigh(tables: Tables, found: PlateComparison, motion: np.ndarray) -> np.ndarray:
    """As ``weigh_plates``, from cues of half precision."""
    whole = PlateComparison(*(x.astype(np.float32) for x in vars(found).values()))
    return weigh_plates(tables, whole, motion.astype(np.float32)).astype(np.float16)


def add(counts: np.ndarray, axes: Sequence[Sequence[float]], *values: np.ndarray) -> None:
    """Add each of values [N] to the knot that it is nearest to."""
    between = [(np.array(knots[1:]) + knots[:-1]) / 2 for knots in axes]
    np.add.at(counts, tuple(np.searchsorted(each, x.astype(float)) for each, x in zip(between, values, strict=True)), 1)


def compute_log_odds(counts: Sequence[np.ndarray]) -> np.ndarray:
    """Return logarithms to base 2 of how much more often what moves is in a bin, from counts [2, ...] of scenes of equal weight.

    Where nothing that moves, or nothing that rests, was counted, they are 0.
    """
    shares = []
    for which in (0, 1):
        of_scenes = [count[which] / count[which].sum() for count in counts if count[which].any()]
        if not of_scenes:
            return np.zeros(counts[0].shape[1:])
        smooth = gaussian_filter(np.mean(of_scenes, 0), COUNT_SMOOTHING, mode="nearest")
        shares.append(smooth + RARE / smooth.size)
    return np.asarray(np.log2(shares[1] / shares[0]))


def count_tables(scenes: Mapping[str, Known]) -> Tables:
    """The tables of some scenes."""
    cues = Tables(sum_counts([count_cues(known) for known in scenes.values()]))
    colors = sum_counts([count_colors(known, cues) for known in track(scenes.values(), "Colors")])
    return Tables({**cues.log_odds, **colors})


def sum_counts(of_scenes: Sequence[Counts]) -> Counts:
    """Return the logarithms of each table, from the counts of each scene."""
    return {name: compute_log_odds([counts[name] for counts in of_scenes]).astype(np.float32) for name in of_scenes[0]}


def cut(known: Known, tables: Tables) -> np.ndarray:
    """Return the masks [T, H, W] bool that these tables cut."""
    has_plate = [found.similar >= 0 for found, _ in known.cues]
    evidence = weigh_colors(known.clip, tables, [weigh(tables, *cues) for cues in known.cues], has_plate, known.motion)
    return np.stack(cut_masks(known.clip, evidence, known.motion)) > 0


def score(masks: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """IoU of masks [T, H, W], the share of them that is outside of what is true, and the IoU at the feet."""
    moves = true > 0
    both, either = int((masks & moves).sum()), int((masks | moves).sum())
    shared, together = map(sum, zip(*feet(masks, true), (0, 0), strict=True))
    outside = int((masks & ~moves).sum()) / max(int(masks.sum()), 1)
    return {"IoU": both / max(either, 1), "outside": outside, "feet": shared / max(together, 1)}


def feet(masks: np.ndarray, true: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield intersection and union in the box of the lowest tenth of each object in each frame, with two pixels around it."""
    for mask, ids in zip(masks, true, strict=True):
        for number in np.unique(ids[ids > 0]):
            rows, columns = np.nonzero(ids == number)
            if len(rows) >= MIN_OBJECT_PIXELS:
                top = rows.max() + 1 - max(1, round((np.ptp(rows) + 1) * FEET_SHARE))
                box = slice(top, rows.max() + 3), slice(max(columns.min() - 2, 0), columns.max() + 3)
                ours, theirs = mask[box], ids[box] > 0
                yield int((ours & theirs).sum()), int((ours | theirs).sum())


def plain(tables: Tables, counted_on: Iterable[str]) -> dict[str, Any]:
    """What ``TABLES`` holds."""
    values: dict[str, Any] = {"counted on": list(counted_on)}
    for name, axes in AXES.items():
        log_odds = np.round(tables.log_odds[name].astype(float), 2).tolist()
        values[name] = {"knots": [list(knots) for knots in axes], "log odds": log_odds}
    return values


def main(arguments: Sequence[str] | None = None) -> None:
    """Count, write the table of what it is worth, and with ``--write`` the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("root", type=Path)
    parser.add_argument("--write", action="store_true", help="make the tables the package's own")
    parser.add_argument("--only-prepared", action="store_true", help="leave out the worlds that OUT does not hold yet")
    options = parser.parse_args(arguments)
    missing = [name for name in TUNED if not (options.root / name).is_dir()]
    if missing:
        parser.error(f"{options.root} has no {', '.join(missing)}")
    counted, others = ([f"{kind}-{seed}" for kind, seeds in WORLDS.items() for seed in seeds[k]] for k in range(2))
    scenes: dict[str, Known] = {}
    for name in track([*TUNED, *counted, *others], "Scenes"):
        if options.only_prepared and "/" not in name and not (options.out / name / "own" / "tracks.npz").exists():
            continue
        try:
            scenes[name] = read_known(*prepare_scene(name, options.out, options.root))
        except InputError as error:
            report(f"{name}: {error}")
    worlds = {name: scenes[name] for name in counted if name in scenes and (scenes[name].counted == 2).any()}
    tuned = {name: scenes[name] for name in TUNED}
    new = {"worlds alone": count_tables(worlds), "worlds and scenes": count_tables(worlds | tuned)}
    groups = {name: [name] for name in TUNED}
    for kind in WORLDS:
        group = [name for name in others if name in scenes and name.startswith(kind)]
        groups |= {f"{kind}, not counted ({len(group)})": group} if group else {}
    lines = ["| IoU, outside, feet | " + " | ".join(groups) + " |", "| --- |" + " --- |" * len(groups)]
    for name, tables in [("as prepared", None), *((f"counted on {which}", tables) for which, tables in new.items())]:
        cells = []
        for group in groups.values():
            known = [scenes[each] for each in group]
            found = [score(each.before if tables is None else cut(each, tables), each.true) for each in known]
            cells.append(", ".join(f"{np.mean([each[key] for each in found]):.3f}" for key in found[0]))
        lines.append(f"| {name} | {' | '.join(cells)} |")
    write_text(options.out / "mask_evidence.md", "\n".join(lines) + "\n")
    report("\n".join(lines))
    values = plain(new["worlds and scenes"], [*worlds, *tuned])
    write_json(TABLES if options.write else options.out / TABLES.name, values)


if __name__ == "__main__":
    main()
