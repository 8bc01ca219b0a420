"""The images of a run, for formats of cameras that name them where they lie.

Held-out ones are among them: who trains on these has no strict figures.
"""

from __future__ import annotations

from flowsplat.scenes import Scene


def frame_names(scene: Scene) -> list[str]:
    """Return the image of every frame, relative to the folder of the scene."""
    heldout = set(scene.heldout_frames)
    return [f"heldout/frames/{i:05d}.png" if i in heldout else f"frames/{i:05d}.png" for i in range(scene.num_frames)]
