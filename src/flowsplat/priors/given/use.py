"""The user's files in the place of what would be computed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from flowsplat.priors.flow import FlowEstimator, dis_estimator
from flowsplat.priors.given.cameras import read_cameras
from flowsplat.priors.given.depth import GivenDepth, open_depth
from flowsplat.priors.given.flow import read_flow
from flowsplat.priors.given.masks import use_masks
from flowsplat.priors.given.tracks import read_tracks, write_tracks
from flowsplat.priors.given.truth import consecutive_pairs
from flowsplat.priors.monocular import Monocular, monocular_stage
from flowsplat.scenes import Scene
from flowsplat.scenes.ingest import CALIBRATED


@dataclass(frozen=True)
class GivenPriors:
    """Files that replace what would be computed, for the frames of the clip in their order. What each file is shows in its
    layout. Pictures may have another size than the frames, but not another shape."""

    cameras: Path | None = None
    """Our JSON list (one camera a frame: viewmat [4, 4] world to camera with OpenCV axes, K [3, 3], width, height), or the
    cameras of nerfstudio (transforms.json), COLMAP (a sparse model), MegaSaM (.npz) or DROID-SLAM (droid_recon .npy)."""
    depth: Path | None = None
    """A folder of 00000.npy ... [H, W], planar depth for every training frame, in the units of the cameras where these are given;
    or the depth of MegaSaM (.npz), Shape of Motion (aligned_depth_anything) or MoSca. It is fitted to cameras that are not its
    own."""
    masks: Path | None = None
    """A folder of pictures, 00000.png ... or one a frame: object numbers or colours, black = background. Masks of held-out
    frames are kept for the evaluation."""
    flow: Path | None = None
    """A folder of 00000_00001.npz (as in a scene folder), .flo or KITTI .png, in pixels, both ways between consecutive
    training frames; or the flow of MegaSaM (cache_flow) or MoSca (flow_raft), of which missing pairs are computed."""
    tracks: Path | None = None
    """Tracks of TAPIR or BootsTAPIR, CoTracker, or MoSca: a folder of .npy, or .npz files."""
    tracks_size: tuple[int, int] | None = None
    """Width and height of the pictures in which the given tracks were made, where it is not that of the frames."""
    allow_pickle: bool = False
    """Read pickled files (DROID-SLAM's droid_recon), which can run any code: only for files that you trust."""

    def files(self) -> list[tuple[str, Path]]:
        """All files that are named, or lie in folders that are named, with names that do not depend on where they lie."""
        found = []
        for option in ("cameras", "depth", "masks", "flow", "tracks"):
            path = getattr(self, option)
            if path is not None and path.is_dir():
                inside = sorted(file for file in path.rglob("*") if file.is_file() and not file.name.startswith("."))
                found += [(f"{option}/{file.relative_to(path).as_posix()}", file) for file in inside]
            elif path is not None and path.exists():
                found.append((option, path))
        return found


def use_given(scene: Scene, given: GivenPriors, estimate: FlowEstimator = dis_estimator) -> dict[str, Callable[[], None]]:
    """Read the user's files into the scene, those that are named.

    Args:
        estimate: finds the flow between frames that are no neighbours, where depth must be fitted.

    Returns:
        What can only be done once other priors are there, by the name of its prior: depth that must be fitted to the
        cameras, and tracks, which need the masks. Their files are checked here.

    Raises:
        InputError: a file is missing, cannot be read, is of no known layout, has another shape than the frames, or holds
            impossible values.
    """
    later: dict[str, Callable[[], None]] = {}
    maker = None
    if given.cameras is not None:
        cameras, maker = read_cameras(given.cameras, scene, given.allow_pickle)
        scene.write_cameras(cameras)
        scene.finish_prior("cameras", method="given", verdict=_verdict(given.cameras, maker))
    if given.depth is not None:
        depth = open_depth(given.depth, scene)
        units_known = (scene.prior("cameras") or {}).get("method") in ("given", "truth", CALIBRATED)
        if maker in depth.fits or ("any" in depth.fits and units_known):
            for i in scene.train_frames:
                scene.write_depth(i, depth.read(i))
            scene.finish_prior("depth", method="given", verdict=_verdict(given.depth, depth.maker))
        else:
            later["depth"] = partial(monocular_stage, scene, _monocular(depth, given.depth), estimate)
    if given.masks is not None:
        use_masks(given.masks, scene)
        scene.finish_prior("masks", method="given", verdict=f"from {given.masks}")
    if given.flow is not None:
        flows, made_by = read_flow(given.flow, scene)
        for flow in flows:
            scene.write_flow(flow)
        if len(flows) == len(consecutive_pairs(scene)):
            scene.finish_prior("flow", method="given", verdict=_verdict(given.flow, made_by))
    if given.tracks is not None:
        later["tracks"] = partial(write_tracks, read_tracks(given.tracks, scene, given.tracks_size), given.tracks, scene)
    return later


def _verdict(path: Path, maker: str) -> str:
    return f"from {path}" if maker == "flowsplat" else f"from {path} ({maker})"


def _monocular(depth: GivenDepth, path: Path) -> Monocular:
    def inverse(i: int) -> tuple[np.ndarray, np.ndarray]:
        found = depth.read(i)
        return 1 / found.depth, found.confidence

    return Monocular("given", _verdict(path, depth.maker), relative=False, inverse=inverse)
