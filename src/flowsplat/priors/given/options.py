"""Name the files of the user's that take the place of what would be computed."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class GivenPriors:
    """Files that replace what would be computed, for the frames of the clip in their order. What each file is shows in its
    layout. Images may have another size than the frames, but not another shape."""

    cameras: Path | None = None
    """Our JSON list (one camera a frame: viewmat [4, 4] world to camera with OpenCV axes, K [3, 3], width, height), or the
    cameras of nerfstudio (transforms.json), COLMAP (a sparse model), Depth Anything 3, VGGT or MegaSaM (.npz), ViPE (the folder of
    its results) or DROID-SLAM (droid_recon .npy). Two missing frames in a row are interpolated. A lens of nerfstudio or COLMAP that
    bends images is taken out of the frames and of all that is given for them."""
    depth: Path | None = None
    """A folder of 00000.npy ... [H, W] or gray .png of 8 or 16 bits, one for every training frame: planar depth (in the units of
    the cameras where these are given; whole numbers of millimeters, too) or disparity, which the parallax of the clip tells; or the
    depth of Depth Anything 3, VGGT or MegaSaM (.npz), ViPE (the folder of its results), Shape of Motion (aligned_depth_anything) or
    MoSca. 0 and NaN are unknown. It is fitted to cameras that are not its own."""
    masks: Path | None = None
    """A folder of images, 00000.png ... or one a frame: object numbers or colors, black = background; or the masks of ViPE (the
    folder of its results) or Segment Anything Video (.json). Masks of held-out frames are kept for the evaluation."""
    flow: Path | None = None
    """A folder of 00000_00001.npz (as in a scene folder), .flo or KITTI .png, in pixels, both ways between consecutive
    training frames; or the flow of MegaSaM (cache_flow) or MoSca (flow_raft), of which missing pairs are computed."""
    tracks: Path | None = None
    """Tracks of TAPIR or BootsTAPIR, CoTracker, SpatialTrackerV2 or MoSca: a folder of .npy, or .npz files."""
    depth_kind: Literal["depth", "disparity", "inverted-disparity"] | None = None
    """What the values of given depth are, where the parallax of the clip does not tell: depth (large is far, zero is here),
    disparity (large is near), or disparity subtracted from white (large is far)."""
    tracks_size: tuple[int, int] | None = None
    """Width and height of the images in which the given tracks were made, where it is not that of the frames."""
    allow_pickle: bool = False
    """Read pickled files (DROID-SLAM's droid_recon), which can run any code: only for files that you trust."""
    object_depth: Path | None = None
    """Depth of a network, as for depth, that only helps to tell how far away objects are (--object-depth): all else stays what the
    images show."""

    @staticmethod
    def names() -> list[str]:
        """Return the priors that files can be given for, in the order in which they are read."""
        return [each.name for each in fields(GivenPriors) if each.name not in _NO_PRIORS]

    @property
    def named(self) -> dict[str, Path]:
        """The files that are named, by the prior that they replace, in the order in which they are read."""
        return {name: path for name in self.names() if (path := getattr(self, name)) is not None}

    def files(self) -> list[tuple[str, Path]]:
        """Return all files that are named, or lie in folders that are named, with names that do not depend on where they lie."""
        found = []
        cue = {"object_depth": self.object_depth} if self.object_depth is not None else {}
        for name, path in {**self.named, **cue}.items():
            if path.is_dir():
                inside = sorted(file for file in path.rglob("*") if file.is_file() and not file.name.startswith("."))
                found += [(f"{name}/{file.relative_to(path).as_posix()}", file) for file in inside]
            elif path.exists():
                found.append((name, path))
        return found


_NO_PRIORS = ("object_depth", "depth_kind", "tracks_size", "allow_pickle")
"""What takes the place of no prior."""
