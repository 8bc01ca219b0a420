"""3D Gaussians as the .ply of 3D Gaussian Splatting, which every splat viewer reads.

Binary, little endian, float32: ``x y z``, unused normals, ``f_dc_*`` and ``f_rest_*`` (harmonics, channel by channel),
``opacity`` before the sigmoid, ``scale_*`` before exp, ``rot_*`` wxyz. As the original code writes it
(https://github.com/graphdeco-inria/gaussian-splatting), except that only harmonics in use are written: 0, 9, 24 or 45. Where
something moves one more follows, ``object_id``: the number of the object, 0 = none; and where it is known what the clip has seen,
``seen_frames`` and ``seen_spread`` (``Gaussians4D.seen``). They are floats as well, because there are readers that take every
property for one.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flowsplat.common.files import write_bytes
from flowsplat.common.registry import Entry
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.export.formats import EXPORTERS, Exporter
from flowsplat.output.export.options import ExportOptions
from flowsplat.output.export.still import Still, middle_or, still_at
from flowsplat.scenes import Scene
from flowsplat.splatting.harmonics import harmonics_count


def write(path: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
    """Write one file atomically."""
    write_at(path, model, scene, middle_or(model, options.time), options.flip_axes)


def write_at(path: Path, model: SceneModel, scene: Scene, seconds: float, flip_axes: bool) -> None:
    """Write one file atomically: what is there at these seconds of the clip."""
    comment = f"{re.sub(r'[^ -~]', '?', scene.name)} at {seconds:.4f} s"
    write_ply(path, still_at(model, seconds, flip_axes=flip_axes), _has_objects(model), [comment])


def estimate_bytes(model: SceneModel, scene: Scene, options: ExportOptions) -> int:
    """Exact but for the header."""
    return count_record_bytes(model) * model.active_count(middle_or(model, options.time))


def count_record_bytes(model: SceneModel) -> int:
    """Return bytes of one Gaussian."""
    gaussians = model.gaussians
    return 4 * len(property_names(harmonics_count(gaussians.sh_degree), _has_objects(model), gaussians.seen is not None))


def _has_objects(model: SceneModel) -> bool:
    return bool(model.gaussians.object_ids.any())


def property_names(harmonics: int, has_objects: bool, has_seen: bool = False) -> list[str]:
    """Return names in the order of the file for ``harmonics`` coefficients a channel."""
    rest = [f"f_rest_{k}" for k in range(3 * (harmonics - 1))]
    return [
        "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest,
        "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", *(["object_id"] if has_objects else []),
        *(["seen_frames", "seen_spread"] if has_seen else []),
    ]  # fmt: skip


def write_ply(path: Path, still: Still, has_objects: bool, comments: Sequence[str] = ()) -> None:
    """Write one file atomically, with the numbers of objects if the scene has some.

    Raises:
        InputError: it cannot be written.
    """
    count, harmonics = still.sh.shape[:2]
    columns = [
        still.means, still.means.new_zeros(count, 3), still.sh[:, 0], still.sh[:, 1:].transpose(1, 2).flatten(1),
        still.logit_opacities[:, None], still.log_scales, still.quats,
    ]  # fmt: skip
    columns += [still.object_ids[:, None].float()] if has_objects else []
    columns += [still.seen] if still.seen is not None else []
    body = np.concatenate([column.numpy() for column in columns], 1).astype("<f4")
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    properties = [f"property float {name}" for name in property_names(harmonics, has_objects, still.seen is not None)]
    lines += [f"element vertex {count}", *properties, "end_header", ""]
    write_bytes(path, "\n".join(lines).encode("ascii", "replace") + body.tobytes())


PLY = Exporter(write, estimate_bytes, "scene.ply", is_of_one_time=True, can_flip_axes=True)
EXPORTERS.add(Entry("ply", "PLY", "3D Gaussian Splatting's own, for every viewer of splats, at one time.", PLY, place=20))
