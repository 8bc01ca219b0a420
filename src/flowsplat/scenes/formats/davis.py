"""The DAVIS data set: ``JPEGImages/480p/<sequence>/00000.jpg`` and ``Annotations/480p/<sequence>/00000.png``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from flowsplat.common.errors import InputError
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.formats.images import ImagesClip, list_images, natural_key, open_images

IMAGES = Path("JPEGImages/480p")
MASKS = Path("Annotations/480p")


def sequence_folders(root: Path, sequence: str | None) -> tuple[Path, Path | None]:
    """Return (images, masks) of a sequence. Only the first mask is published for some: those count as sequences without masks.

    Raises:
        InputError: no such sequence.
    """
    if not (root / IMAGES).is_dir():
        raise InputError(f"{root} has no {IMAGES}: give the root folder of DAVIS at 480p.")
    names = [p.name for p in sorted((root / IMAGES).iterdir(), key=natural_key) if p.is_dir()]
    if sequence not in names:
        known = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        wrong = f"has no sequence {sequence!r}" if sequence else "is a root folder of DAVIS"
        raise InputError(f"{root} {wrong}: choose one of {known} with --sequence.")
    masks = root / MASKS / sequence
    is_complete = masks.is_dir() and len(list_images(masks)) > 1
    return root / IMAGES / sequence, masks if is_complete else None


def open_davis(root: Path, options: InputOptions) -> ImagesClip:
    """Open the sequence ``options.sequence`` of DAVIS.

    Raises:
        InputError: no such sequence, or files that do not fit.
    """
    folder, masks = sequence_folders(Path(root), options.sequence)
    return open_images(folder, replace(options, keep_all=True), masks)  # its frames are numbered for everybody
