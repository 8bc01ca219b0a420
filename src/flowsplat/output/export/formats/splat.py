"""3D Gaussians as the .splat of https://github.com/antimatter15/splat: 32 bytes each, without view dependence.

Position and scales as float32, then color and opacity, then the quaternion (wxyz, 128 + 128 q), as bytes. What is large
and opaque comes first, so that a viewer shows it first.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flowsplat.common.files import write_bytes
from flowsplat.common.registry import Entry
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.export.formats import EXPORTERS, Exporter
from flowsplat.output.export.options import ExportOptions
from flowsplat.output.export.still import Still, middle_or, still_at
from flowsplat.scenes import Scene

RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])


def write(path: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
    """Write one file atomically."""
    write_splat(path, still_at(model, middle_or(model, options.time), flip_axes=options.flip_axes))


def estimate_bytes(model: SceneModel, scene: Scene, options: ExportOptions) -> int:
    """Exact."""
    return RECORD.itemsize * model.active_count(middle_or(model, options.time))


def write_splat(path: Path, still: Still) -> None:
    """Write one file atomically.

    Raises:
        InputError: it cannot be written.
    """
    records = np.empty(len(still.means), RECORD)
    records["position"] = still.means.numpy()
    records["scale"] = np.exp(still.log_scales.numpy())
    rgba = np.concatenate([still.colors.numpy(), still.opacities.numpy()[:, None]], 1)
    records["color"] = np.rint(255 * rgba)
    records["rotation"] = np.clip(np.rint(still.quats.numpy() * 128 + 128), 0, 255)
    size = still.log_scales.sum(1).numpy() + np.log(np.maximum(still.opacities.numpy(), 1e-12))
    write_bytes(path, records[np.argsort(-size, kind="stable")].tobytes())


SPLAT = Exporter(write, estimate_bytes, "scene.splat", is_of_one_time=True, can_flip_axes=True)
EXPORTERS.add(Entry("splat", "Splat", "32 bytes a Gaussian, without view dependence, at one time.", SPLAT, place=40))
