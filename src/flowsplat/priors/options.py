"""Settings of the priors: where each comes from, and how it is made."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from flowsplat.priors.cameras import CameraOptions
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.learned.weights import ModelOptions


@dataclass(frozen=True)
class PriorsOptions:
    """Where the priors come from."""

    priors: Literal["own", "true", "learned", "auto"] = "own"
    """``own`` computes them from the frames, without weights; ``true`` takes those of a rendered scene, as far as it has them;
    ``learned`` takes networks for flow and masks, and ``auto`` those of them that are installed with their weights: it fetches
    nothing. ``--flow``, ``--masks`` and ``--depth`` go before it."""
    flow: Literal["dis", "raft"] | None = None
    """Optical flow: dis (no weights) or raft (a network of the extra ``learned``). None = as --priors says, dis by default."""
    masks: Literal["motion", "sam2", "sam3", "edgetam"] | None = None
    """Masks of what moves: motion (no weights), or what the motion or your clicks and boxes show, followed by a network of the
    extra ``learned`` (edgetam also needs timm). None = as --priors says, motion by default."""
    mask_click: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A moving object: x,y@frame, in pixels of the prepared frames or as shares of the image (0.5,0.4@0). Repeat it for more.
    With the number of an object behind it (x,y@frame=1) it corrects that one, on another frame, say: they count from 1, boxes
    first. Of a clip with cuts x,y@shot/frame is on a frame of one shot (0.5,0.4@2/7), whose objects are counted; so with all."""
    mask_box: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A box round a moving object: x0,y0,x1,y1@frame. A click inside it on the same frame belongs to it."""
    mask_negative: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """What is none of these objects, or not the one of a number: x,y@frame or x,y@frame=1. Any frame will do."""
    contact: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Where something that moves touches what is still, the ground, say: x,y@frame, as for --mask-click. One such place tells how
    far away it is over the whole clip. Repeat it for more."""
    same_depth: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """What something that moves is as far away as: x,y@frame=x2,y2, where x2,y2 shows something still in that frame."""
    depth: Literal["multiview", "depth-anything", "depth-pro"] | None = None
    """Depth: multiview (no weights), or a monocular network of the extra ``learned``, fitted to the cameras frame by frame. None =
    multiview."""
    object_depth: Literal["none", "depth-anything", "depth-pro"] | None = None
    """Monocular depth by a network of the extra ``learned`` that only helps to tell how far away objects are, as far as it is right
    where nothing moves. Where the camera does not travel, it also gives the depth of all else. None = none, unless ``--priors``
    says otherwise."""
    models: ModelOptions = field(default_factory=ModelOptions)
    """Which weights the learned ones use."""
    given: GivenPriors = field(default_factory=GivenPriors)
    """Your own files, which take the place of either."""
    cameras: CameraOptions = field(default_factory=CameraOptions)
    """How cameras are computed."""


def names_places(options: PriorsOptions) -> bool:
    """Return whether clicks, boxes or distances are given, which a clip has to be read for."""
    return bool(options.mask_click or options.mask_box or options.mask_negative or options.contact or options.same_depth)
