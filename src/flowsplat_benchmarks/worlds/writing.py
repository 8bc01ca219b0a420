"""A random world as a scene folder with its truth."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

from flowsplat.common.files import read_json, write_json
from flowsplat.common.progress import track
from flowsplat.scenes.layers import Depth, Layers
from flowsplat.scenes.scene import Scene
from flowsplat.scenes.synthetic.worlds.world import World

OBJECTS = "objects.json"
"""In the folder of the truth: ``objects`` (see ``World.describe``) and the object of every true track, ``tracks`` [P]."""


def write_world(folder: Path, world: World, holdout: int | None = None) -> Scene:
    """Render a world into a scene folder, without any prior.

    The truth has cameras, depth, masks, tracks, flow both ways between neighboring frames and neighboring training frames, and
    ``OBJECTS``.

    Args:
        holdout: every how many frames one is held out; None = none.

    Raises:
        InputError: the folder cannot be written.
    """
    scene = Scene.create(
        folder,
        name=f"world {world.seed}",
        source=f"random world {world.seed}",
        width=world.width,
        height=world.height,
        timestamps=world.timestamps.tolist(),
        holdout=holdout,
        source_fps=world.fps,
    )
    truth = scene.create_truth()
    for i in track(range(world.frames), f"Rendering world {world.seed}"):
        scene.write_frame(i, world.image(i))
        depth, mask = world.geometry(i)
        truth.write_depth(i, Depth(depth, depth * 0 + 1))
        truth.write_mask(i, mask)
        if i in scene.heldout_frames:
            scene.heldout_masks.write_mask(i, mask)
    truth.write_cameras([world.camera(i) for i in range(world.frames)])
    tracks, owners = world.tracks_and_owners()
    truth.write_tracks(tracks)
    for i, j in sorted({*pairwise(range(world.frames)), *pairwise(scene.train_frames)}):
        truth.write_flow(world.flow(i, j))
        truth.write_flow(world.flow(j, i))
    objects = [world.describe(number + 1) for number in range(len(world.objects))]
    # Written last: where it is, the truth is whole.
    write_json(
        truth.folder / OBJECTS,
        {"seed": world.seed, "ground": world.ground.kind, "camera": world.camera_kind, "objects": objects, "tracks": owners},
    )
    return scene


def read_objects(truth: Layers) -> dict[str, Any]:
    """Return what ``write_world`` wrote into ``OBJECTS``.

    Raises:
        InputError: missing or damaged.
    """
    values: dict[str, Any] = read_json(truth.folder / OBJECTS)
    return values
