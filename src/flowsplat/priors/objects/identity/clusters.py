"""Tracks clustered into objects by two multicuts: of tracks into fragments, of fragments into objects."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from flowsplat.priors.objects.identity import fragments as of_fragments
from flowsplat.priors.objects.identity import pairs as of_tracks
from flowsplat.priors.objects.identity.cost import Costs, make_costs, read_weights
from flowsplat.priors.objects.identity.fragments import compute_fragment_features
from flowsplat.priors.objects.identity.masked_tracks import MaskedTracks
from flowsplat.priors.objects.identity.multicut import multicut
from flowsplat.priors.objects.identity.pairs import Trajectories, compute_pair_features, list_candidate_pairs, thin_tracks

MIN_TRACKS = 8
"""Tracks, about one in each cell of the image, below which a cluster is too small to be an object."""
MOTION_WEIGHT = 3.0
"""Pixels of distance that a pixel of a difference in motion counts, where a track that was left out goes with its neighbors."""
VOTES = 3

FEATURES = {"tracks": of_tracks.FEATURES, "fragments": of_fragments.FEATURES}


def identify_tracks(clip: MaskedTracks, colors: np.ndarray | None = None, costs: Costs | None = None) -> np.ndarray:
    """The object, from 1, that every track is on [P]; 0 for those on none, or on what is too small to know.

    Args:
        colors: [P, 3] CIE L*a*b* of every track; None = all alike.
        costs: of cutting two tracks or fragments apart; None = the package's own.
    """
    on = np.flatnonzero((clip.part > 0).any(1))
    owners = np.zeros(len(clip.part), int)
    chosen = on[thin_tracks(clip.points[on], clip.part[on], clip.long_side)]
    if len(chosen) == 0:
        return owners
    tracks = make_trajectories(clip, chosen, colors)
    pairs = list_candidate_pairs(tracks)
    costs = costs or make_costs(read_weights(), FEATURES)
    owners[chosen] = cluster(tracks, pairs, costs.tracks(compute_pair_features(tracks, pairs)), costs)
    _give_to_neighbors(clip, owners, on)
    return owners


def make_trajectories(clip: MaskedTracks, chosen: np.ndarray, colors: np.ndarray | None = None) -> Trajectories:
    """The chosen tracks of a clip."""
    colors = np.zeros((len(clip.part), 3)) if colors is None else colors
    masks = np.stack(clip.masks) > 0
    return Trajectories(clip.points[chosen].astype(np.float32), clip.part[chosen], colors[chosen], masks)


def cluster(tracks: Trajectories, pairs: np.ndarray, log_odds: np.ndarray, costs: Costs) -> np.ndarray:
    """The object of every track [N], from 1, the largest first; 0 for what is too small.

    Args:
        pairs: [E, 2] of tracks, log_odds: [E] that the two are on one object.
    """
    fragment = find_fragments(len(tracks.part), pairs, log_odds + costs.bias)
    found, features = compute_fragment_features(tracks, fragment, pairs, log_odds)
    whole = multicut(int(fragment.max(initial=-1)) + 1, found, costs.fragments(features))
    objects = renumber(np.where(fragment >= 0, np.append(whole, -1)[fragment], -1), MIN_TRACKS)
    drawn = np.zeros((len(fragment), int(objects.max(initial=-1)) + 2))
    for a, b in (pairs.T, pairs[:, ::-1].T):
        np.add.at(drawn, (a, objects[b] + 1), log_odds)
    drawn[:, 0] = 0
    return np.where(objects >= 0, objects + 1, drawn.argmax(1))


def find_fragments(count: int, pairs: np.ndarray, log_odds: np.ndarray) -> np.ndarray:
    """The fragment of every track [count], from 0, the largest first; -1 for those in none."""
    return renumber(multicut(count, pairs, log_odds), of_fragments.MIN_TRACKS)


def renumber(labels: np.ndarray, fewest: int) -> np.ndarray:
    """Labels [N] renumbered from 0 by how often they occur; -1 for those below 0, and for those with less than ``fewest``."""
    sizes = np.bincount(labels[labels >= 0], minlength=1)
    order = np.argsort(-sizes, kind="stable")
    rank = np.full(len(sizes) + 1, -1)
    order = order[sizes[order] >= fewest]
    rank[order] = np.arange(len(order))
    return rank[labels]


def _give_to_neighbors(clip: MaskedTracks, owners: np.ndarray, on: np.ndarray) -> None:
    """Give tracks without an object that of those that are nearest and move like them in most frames, in place."""
    votes = np.zeros((len(owners), int(owners.max(initial=0)) + 1), int)
    open_, frames = owners == 0, clip.part.shape[1]
    for k in range(frames):
        other = k + 1 if k + 1 < frames else k - 1
        here = on[(clip.part[on, k] > 0) & (clip.part[on, other] > 0)]
        known, asking = here[owners[here] > 0], here[open_[here]]
        if len(known) == 0 or len(asking) == 0:
            continue
        motion = (clip.points[:, other] - clip.points[:, k]) * (other - k)
        where = [np.concatenate([clip.points[rows, k], MOTION_WEIGHT * motion[rows]], 1) for rows in (known, asking)]
        _, near = cKDTree(where[0]).query(where[1], k=min(VOTES, len(known)))
        np.add.at(votes, (asking[:, None], owners[known[near.reshape(len(asking), -1)]]), 1)
    owners[open_] = votes[open_].argmax(1)
