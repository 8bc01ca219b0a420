"""The weights by which tracks are clustered into objects, fitted where the truth is known, and how many ids are right with them.

    python -m flowsplat_benchmarks.scripts.identity OUT DATA_ROOT            # prepares some 75 scenes once; then three minutes
    python -m flowsplat_benchmarks.scripts.identity OUT DATA_ROOT --write    # also makes them the package's own

Fitted on random worlds of low seeds and on the tuned scenes under ``DATA_ROOT``, every one with the same weight; other worlds, all
of seeds below 900, tell which bias is best and what the weights are worth (``WORLDS``). Each is prepared once, as far as tracks.
IDF1 is that of the ids at the tracks that are clustered. ``OUT/identity.md`` is the table: also that of weights fitted on worlds
alone, to which the tuned scenes are new, and the best that tracks allow, one true label a track.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from flowsplat.common.errors import InputError
from flowsplat.common.files import write_json, write_text
from flowsplat.common.progress import report, track
from flowsplat.priors.cameras import CameraOptions, camera_stage
from flowsplat.priors.flow import flow_stage
from flowsplat.priors.masks import mask_stage
from flowsplat.priors.objects.identity import MaskedTracks
from flowsplat.priors.objects.identity.clusters import FEATURES, cluster, find_fragments, make_trajectories
from flowsplat.priors.objects.identity.cost import WEIGHTS, Cost, Costs, expand, make_costs, read_weights
from flowsplat.priors.objects.identity.fragments import compute_fragment_features
from flowsplat.priors.objects.identity.pairs import Trajectories, compute_pair_features, list_candidate_pairs, thin_tracks
from flowsplat.priors.objects.identity.renumber import track_colors
from flowsplat.priors.tracks import tracks_stage
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.formats.images import read_input_image
from flowsplat.scenes.ingest import ingest, open_clip
from flowsplat_benchmarks.objects.benchmark import FRAMES, HEIGHT, WIDTH
from flowsplat_benchmarks.objects.preparation import WorldKind, prepare_world

TUNED = ("rig/street", "rig/market", "rig/workshop", "rig/garden", "davis/train", "davis/bear")
WORLDS: dict[WorldKind, tuple[range, range]] = {
    "any": (range(24), range(100, 124)), "crowd": (range(8), range(8, 14)), "dancers": (range(4), range(4, 8)),
}  # fmt: skip
"""Seeds of the worlds that are fitted, and of those that are not, by their kind."""
BIASES = (-1.0, -1.5, -2.0)
"""That are tried, the weakest first; fragments of all of them are fitted."""
LOGISTIC_RIDGE, LOGISTIC_STEPS = 1e-2, 25
"""Of the logistic regression: the weight of the mean squared weight, and Newton's steps. Chosen by eye."""
FRAGMENTS_RIDGE = 0.1
"""``LOGISTIC_RIDGE`` of the fit of fragments. Chosen by eye."""
MIN_PURITY = 0.7
"""Share of a fragment that must be on one object. Chosen by eye."""
MIN_PAIRS = 50
"""Without as many, a scene tells nothing. Chosen by eye."""


@dataclass(frozen=True)
class Known:
    """The tracks of a scene, and what they are on.

    Attributes:
        true: [N, T] the object that each is on, label: [N] the one that it is mostly on.
        pairs: [E, 2], features: [E, F].
    """

    tracks: Trajectories
    true: np.ndarray
    label: np.ndarray
    pairs: np.ndarray
    features: np.ndarray


def prepare_scene(name: str, out: Path, root: Path) -> tuple[Scene, Callable[[int], np.ndarray]]:
    """A scene with tracks, and its true masks by frame.

    Args:
        name: ``rig/street`` and the like, or ``any-3``: a world.
    """
    if "/" not in name:
        kind, seed = name.rsplit("-", 1)
        folder = out / name / "own"
        if not (folder / "scene.json").exists() or Scene(folder).prior("tracks") is None:
            prepare_world(int(seed), out / name, WIDTH, HEIGHT, FRAMES, next(each for each in WORLDS if each == kind))
        scene = Scene(folder)
        truth = scene.truth
        assert truth is not None
        return scene, truth.mask
    folder, source = out / name.replace("/", "-"), root / name
    is_rig = name.startswith("rig/")
    options = InputOptions(every=1, max_frames=100_000, holdout=None if is_rig else 10)
    if not (folder / "scene.json").exists():
        ingest(open_clip(source if is_rig else source / "images", options), folder, options)
    scene = Scene(folder)
    stages: dict[str, Callable[[], None]] = {
        "cameras": lambda: camera_stage(scene, CameraOptions()), "flow": lambda: flow_stage(scene),
        "masks": lambda: mask_stage(scene), "tracks": lambda: tracks_stage(scene),
    }  # fmt: skip
    for prior, stage in stages.items():
        if scene.prior(prior) is None:
            stage()
    truth = scene.truth
    if truth is not None:
        return scene, truth.mask
    files = sorted((source / "masks").glob("*.png"))

    def mask(i: int) -> np.ndarray:
        image = read_input_image(files[i])
        inside = (image[..., 0] if image.ndim == 3 else image) > 0
        return cv2.resize(inside.astype(np.uint8), (scene.width, scene.height), interpolation=cv2.INTER_NEAREST)

    return scene, mask


def read_known(scene: Scene, true_mask: Callable[[int], np.ndarray]) -> Known | None:
    """What is fitted of a scene; None if there is next to nothing, or nothing true among it."""
    frames, tracks = scene.train_frames, scene.tracks
    clip = MaskedTracks(tracks.points[:, frames, :2], tracks.visible[:, frames], [scene.mask(i) for i in frames])
    on = np.flatnonzero((clip.part > 0).any(1))
    chosen = on[thin_tracks(clip.points[on], clip.part[on], clip.long_side)]
    if len(chosen) == 0:
        return None
    found = make_trajectories(clip, chosen, track_colors(scene, frames, clip))
    true = np.zeros(found.part.shape, int)
    for k, i in enumerate(frames):
        mask = true_mask(i)
        x, y = np.clip(found.points[:, k].astype(int), 0, [mask.shape[1] - 1, mask.shape[0] - 1]).T
        true[:, k] = np.where(found.seen[:, k], mask[y, x], 0)
    label = np.array([np.bincount(t[s]).argmax() for t, s in zip(true, found.seen, strict=True)])
    pairs = list_candidate_pairs(found)
    if len(pairs) < MIN_PAIRS or not label.any():
        return None
    return Known(found, true, label, pairs, compute_pair_features(found, pairs))


def fit_cost(features: Sequence[np.ndarray], same: Sequence[np.ndarray], weights: Sequence[np.ndarray], ridge: float) -> Cost:
    """Logistic regression on features [E, F] of several scenes, by Newton's method.

    Args:
        same: [E] whether the two are one object, weights: [E] of each, by scene.
    """
    values, truth, weight = np.concatenate(features), np.concatenate(same).astype(float), np.concatenate(weights)
    mean, deviation = values.mean(0), values.std(0) + 1e-9
    design, weight = expand((values - mean) / deviation), weight / weight.sum()
    found = np.zeros(design.shape[1])
    penalty = np.append(np.full(len(found) - 1, ridge / len(found)), 1e-9)
    for _ in range(LOGISTIC_STEPS):
        chance = 1 / (1 + np.exp(-np.clip(design @ found, -30, 30)))
        curvature = (design * (weight * chance * (1 - chance))[:, None]).T @ design + np.diag(penalty)
        found = found - np.linalg.solve(curvature, design.T @ (weight * (chance - truth)) + penalty * found)
    return Cost(mean, deviation, found)


def fit_tracks(scenes: Iterable[Known]) -> Cost:
    """The cost of cutting tracks apart; pairs that are on nothing true tell nothing."""
    features, same, weights = [], [], []
    for known in scenes:
        labels = known.label[known.pairs]
        told = (labels > 0).any(1)
        features.append(known.features[told])
        same.append(labels[told, 0] == labels[told, 1])
        weights.append(np.full(int(told.sum()), 1 / len(told)))
    return fit_cost(features, same, weights, LOGISTIC_RIDGE)


def fit_fragments(scenes: Iterable[Known], tracks: Cost) -> Cost:
    """The cost of cutting fragments apart, from those of all biases; a pair counts as much as its smaller fragment has tracks."""
    features, same, weights = [], [], []
    for known in scenes:
        for bias in BIASES:
            log_odds = tracks(known.features)
            fragment = find_fragments(len(known.label), known.pairs, log_odds + bias)
            pairs, values = compute_fragment_features(known.tracks, fragment, known.pairs, log_odds)
            counts = np.zeros((int(fragment.max(initial=-1)) + 1, int(known.true.max()) + 1))
            here = known.tracks.seen & (fragment >= 0)[:, None]
            np.add.at(counts, (np.broadcast_to(fragment[:, None], here.shape)[here], known.true[here]), 1)
            label, pure = counts.argmax(1), counts.max(1, initial=0) > MIN_PURITY * counts.sum(1)
            told = (label[pairs] > 0).any(1) & pure[pairs].all(1)
            size = np.bincount(fragment[fragment >= 0], minlength=len(counts))[pairs[told]].min(1, initial=len(fragment))
            features.append(values[told])
            same.append(label[pairs[told, 0]] == label[pairs[told, 1]])
            weights.append(size / np.sqrt(max(len(size), 1)))
    return fit_cost(features, same, weights, FRAGMENTS_RIDGE)


def idf1(found: np.ndarray, known: Known) -> float:
    """IDF1 of ids [N] at the tracks, in every frame in which each is seen; 0 is no object."""
    seen = known.tracks.seen
    ours, true = np.broadcast_to(found[:, None], seen.shape)[seen], known.true[seen]
    shared = np.zeros((ours.max(initial=0) + 1, true.max(initial=0) + 1))
    np.add.at(shared, (ours, true), 1)
    rows, columns = linear_sum_assignment(-shared[1:, 1:])
    return float(2 * shared[1:, 1:][rows, columns].sum() / max((ours > 0).sum() + (true > 0).sum(), 1))


def score(known: Known, costs: Costs) -> float:
    """IDF1 of a scene."""
    return idf1(cluster(known.tracks, known.pairs, costs.tracks(known.features), costs), known)


def fit(fitted_on: Mapping[str, Known], told_by: Mapping[str, Known]) -> Costs:
    """Both costs from some scenes, and the bias that is best for others: the weakest that is no worse than the one with the
    largest mean IDF1 by more than a standard error of their difference (Breiman et al., 1984)."""
    tracks = fit_tracks(fitted_on.values())
    fragments = fit_fragments(fitted_on.values(), tracks)
    scores = {bias: np.array([score(known, Costs(tracks, bias, fragments)) for known in told_by.values()]) for bias in BIASES}
    best = max(scores.values(), key=np.mean)
    for bias, found in scores.items():
        report(f"bias {bias:+.1f}: IDF1 {found.mean():.3f} on worlds that were not fitted")
    worse = {bias: best - found for bias, found in scores.items()}
    chosen = next(bias for bias, by in worse.items() if by.mean() <= by.std() / np.sqrt(len(by)))
    return Costs(tracks, chosen, fragments)


def plain(costs: Costs, fitted_on: Iterable[str]) -> dict[str, Any]:
    """What ``WEIGHTS`` holds."""
    values: dict[str, Any] = {"fitted on": list(fitted_on), "bias": costs.bias}
    for name, cost in (("tracks", costs.tracks), ("fragments", costs.fragments)):
        numbers = {key: [float(f"{x:.9g}") for x in getattr(cost, key)] for key in ("mean", "deviation", "weights")}
        values[name] = {"features": list(FEATURES[name]), **numbers}
    return values


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit, write the table, and with ``--write`` the weights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("root", type=Path)
    parser.add_argument("--write", action="store_true", help="make the weights the package's own")
    parser.add_argument("--only-prepared", action="store_true", help="leave out the worlds that OUT does not hold yet")
    options = parser.parse_args(arguments)
    fit_names, other_names = ([f"{kind}-{seed}" for kind, seeds in WORLDS.items() for seed in seeds[k]] for k in range(2))
    scenes: dict[str, Known] = {}
    for name in track([*TUNED, *fit_names, *other_names], "Scenes"):
        if options.only_prepared and "/" not in name and not (options.out / name / "own" / "tracks.npz").exists():
            continue
        try:
            known = read_known(*prepare_scene(name, options.out, options.root))
        except InputError as error:
            report(f"{name}: {error}")
            continue
        if known is not None:
            scenes[name] = known
    worlds = {name: scenes[name] for name in fit_names if name in scenes}
    tuned = {name: scenes[name] for name in TUNED if name in scenes}
    others = {name: scenes[name] for name in other_names if name in scenes}
    costs = {
        "the package's own until now": make_costs(read_weights(), FEATURES),
        "fitted on worlds alone": fit(worlds, others),
        "fitted on worlds and tuned scenes": fit(worlds | tuned, others),
    }
    scores = {name: {each: score(known, cost) for each, known in scenes.items()} for name, cost in costs.items()}
    scores["best label of each track"] = {each: idf1(known.label, known) for each, known in scenes.items()}
    groups = {name: [name] for name in tuned}
    for kind in WORLDS:
        for which, group in (("fitted", worlds), ("not fitted", others)):
            found = [name for name in group if name.startswith(kind)]
            groups |= {f"{kind}, {which} ({len(found)})": found} if found else {}
    lines = ["| IDF1 at tracks | " + " | ".join(groups) + " |", "| --- |" + " --- |" * len(groups)]
    for name, values in scores.items():
        cells = [f"{np.mean([values[each] for each in group]):.3f}" for group in groups.values()]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    write_text(options.out / "identity.md", "\n".join(lines) + "\n")
    report("\n".join(lines))
    values = plain(costs["fitted on worlds and tuned scenes"], [*worlds, *tuned])
    write_json(WEIGHTS if options.write else options.out / WEIGHTS.name, values)


if __name__ == "__main__":
    main()
