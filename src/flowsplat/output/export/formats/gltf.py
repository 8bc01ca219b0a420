"""The scene at one time and the clip's moving camera as glTF 2.0, for Blender and other programs that put things into it.

A binary file (``.glb``), or text that holds its data (a name that ends in ``.gltf``). The background and every object are points of
their own, colored, and have what the extension ``KHR_gaussian_splatting`` (a review draft of Khronos) says of Gaussians: programs
that know it draw splats, all others points. The camera is animated over the whole clip, with straight lines between frames.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flowsplat import __version__
from flowsplat.common.files import write_bytes
from flowsplat.common.progress import report
from flowsplat.common.registry import Entry
from flowsplat.gaussians.gaussians4d import NEAR_PLANE
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry.cameras import OPENGL
from flowsplat.geometry.rotations import rotations_to_quats
from flowsplat.output.export.formats import EXPORTERS, Exporter
from flowsplat.output.export.options import ExportOptions
from flowsplat.output.export.still import Still, middle_or, still_at
from flowsplat.scenes import Scene
from flowsplat.splatting.harmonics import harmonics_count

EXTENSION = "KHR_gaussian_splatting"
"""Name of the extension, and of its attributes before a colon."""
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _POINTS, _ARRAY_BUFFER = 5126, 0, 34962
_HEADER_BYTES = 8000
"""Of text for a scene with an object. Chosen by eye."""


def write(path: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
    """Write one file atomically."""
    document, data = _build(model, scene, middle_or(model, options.time))
    if path.suffix.lower() == ".gltf":
        document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
        write_bytes(path, json.dumps(document).encode())
    else:
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + len(data)
        head = struct.pack("<IIIII", _MAGIC, 2, total, len(text), _JSON)
        write_bytes(path, head + text + struct.pack("<II", len(data), _BIN) + data)
    losses = _find_losses(model, scene)
    if losses:
        report(f"gltf: {'; '.join(losses)}.")


def estimate_bytes(model: SceneModel, scene: Scene, options: ExportOptions) -> int:
    """Return about how many it will be, as a binary file."""
    harmonics = harmonics_count(model.gaussians.sh_degree)
    each = 4 * (3 + 4 + 3 + 1 + 4 + 3 * harmonics)
    return _HEADER_BYTES + 32 * scene.num_frames + each * model.active_count(middle_or(model, options.time))


class _Buffer:
    """Arrays behind one another, and what glTF says of each."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: np.ndarray, *, is_vertex: bool = True, has_range: bool = False) -> int:
        """Add [N] or [N, C] numbers as float32; return the number of their accessor."""
        values = np.ascontiguousarray(values, "<f4")
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes}
        if is_vertex:
            view["target"] = _ARRAY_BUFFER
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        accessor: dict[str, Any] = {
            "bufferView": len(self.views), "componentType": _FLOAT, "count": len(values), "type": kind
        }  # fmt: skip
        if has_range:
            rows = values.reshape(len(values), -1)
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.data += values.tobytes()
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _build(model: SceneModel, scene: Scene, seconds: float) -> tuple[dict[str, Any], bytes]:
    """Return the document and its binary data."""
    still, buffer = still_at(model, seconds, flip_axes=True), _Buffer()
    meshes: list[dict[str, Any]] = []
    nodes: list[dict[str, Any]] = []
    for number in np.unique(still.object_ids.numpy()).tolist():
        name = f"object {number}" if number else "background"
        rows = torch.nonzero(still.object_ids == number).squeeze(1)
        nodes.append({"name": name, "mesh": len(meshes), "extras": {"object_id": number}})
        meshes.append({"name": name, "primitives": [_make_points(still, rows, buffer)]})
    first = scene.cameras[0]
    K = first.K
    camera = {
        "name": "camera", "type": "perspective",
        "perspective": {
            "aspectRatio": float(first.width * K[1, 1] / (first.height * K[0, 0])),
            "yfov": float(2 * np.arctan(first.height / 2 / K[1, 1])), "znear": float(NEAR_PLANE / model.similarity.scale),
        },
    }  # fmt: skip
    places = np.array([OPENGL[:3, :3] @ each.center for each in scene.cameras])
    # From the axes of a camera of glTF (y up, looking along -z) to those of the scene.
    turns = np.array([OPENGL[:3, :3] @ each.viewmat[:3, :3].T @ OPENGL[:3, :3] for each in scene.cameras])
    quats = np.roll(rotations_to_quats(torch.from_numpy(turns)).numpy(), -1, axis=1)
    # q and -q are one rotation: neighbors have to be on one side, or a reader turns the long way round.
    for k in range(1, len(quats)):
        quats[k] *= -1 if quats[k] @ quats[k - 1] < 0 else 1
    nodes.append({"name": "camera", "camera": 0, "translation": places[0].tolist(), "rotation": quats[0].tolist()})
    times = buffer.add(scene.timestamps - model.first, is_vertex=False, has_range=True)
    channels: list[dict[str, Any]] = []
    samplers: list[dict[str, Any]] = []
    for path, values in (("translation", places), ("rotation", quats)):
        channels.append({"sampler": len(samplers), "target": {"node": len(nodes) - 1, "path": path}})
        samplers.append({"input": times, "output": buffer.add(values, is_vertex=False), "interpolation": "LINEAR"})
    document = {
        "asset": {"version": "2.0", "generator": f"flowsplat {__version__}", "extras": {"seconds": seconds - model.first}},
        "extensionsUsed": [EXTENSION], "scene": 0, "scenes": [{"nodes": list(range(len(nodes)))}], "nodes": nodes, "meshes": meshes,
        "cameras": [camera], "animations": [{"name": "clip", "channels": channels, "samplers": samplers}],
        "accessors": buffer.accessors, "bufferViews": buffer.views, "buffers": [{"byteLength": len(buffer.data)}],
    }  # fmt: skip
    return document, bytes(buffer.data)


def _make_points(still: Still, rows: torch.Tensor, buffer: _Buffer) -> dict[str, Any]:
    """Return the primitive of some Gaussians."""
    sh = still.sh[rows].numpy()
    opacities = still.opacities[rows].numpy()
    colors = still.colors[rows].numpy()
    # The base format has linear colors, the extension those of the screen.
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    attributes = {
        "POSITION": buffer.add(still.means[rows].numpy(), has_range=True),
        "COLOR_0": buffer.add(np.concatenate([linear, opacities[:, None]], 1)),
        f"{EXTENSION}:ROTATION": buffer.add(np.roll(still.quats[rows].numpy(), -1, axis=1)),
        f"{EXTENSION}:SCALE": buffer.add(np.exp(still.log_scales[rows].numpy())),
        f"{EXTENSION}:OPACITY": buffer.add(opacities),
    }
    for degree in range(round(sh.shape[1] ** 0.5)):
        for k in range(2 * degree + 1):
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}"] = buffer.add(sh[:, degree**2 + k])
    properties = {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective", "sortingMethod": "cameraDistance"
    }  # fmt: skip
    return {"mode": _POINTS, "attributes": attributes, "extensions": {EXTENSION: properties}}


def _find_losses(model: SceneModel, scene: Scene) -> list[str]:
    """Return what a reader will not see."""
    losses = ["it is of one time, the camera of the whole clip"]
    first = scene.cameras[0]
    shift = max(abs(first.K[0, 2] - first.width / 2), abs(first.K[1, 2] - first.height / 2))
    if shift > 0.5:
        losses.append(f"its camera looks through the middle of the image, which is {shift:.1f} pixels from where the clip's does")
    if np.ptp([camera.K[0, 0] for camera in scene.cameras]) > 1e-3 * first.K[0, 0]:
        losses.append("its camera does not zoom as the clip's does")
    return losses


SENTENCE = "glTF: the clip's camera, animated, and the scene as points and splats, at one time."
EXPORTERS.add(Entry("gltf", "glTF", SENTENCE, Exporter(write, estimate_bytes, "scene.glb", is_of_one_time=True), place=55))
