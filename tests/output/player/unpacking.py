"""A second reader of the player's data, in NumPy and torch: what the page's JavaScript and shaders must do."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import torch

from flowsplat.gaussians.slicing import Slice
from flowsplat.gaussians.slopes.reference import image_slopes
from flowsplat.geometry import Camera, Similarity
from flowsplat.splatting import blend, project
from flowsplat.splatting.harmonics import colors_from_harmonics


def unpack(about: dict[str, Any], data: bytes) -> dict[str, np.ndarray]:
    """Every array [count, components] float32, by name."""
    body, at, result = zlib.decompress(data), 0, {}

    def take(dtype: str, count: int) -> np.ndarray:
        nonlocal at
        array = np.frombuffer(body, dtype, count, at)
        at += array.nbytes
        return array

    for array in about["arrays"]:
        count, components, chunk = array["count"], array["components"], array["chunk"]
        chunks = (count + chunk - 1) // chunk
        steps = take("<f4", chunks * components).reshape(components, chunks)
        columns = []
        for c in range(components):
            z = np.zeros(count, np.int64)
            for _ in range(array["bits"] // 8):
                z = z * 256 + take("u1", count)
            q = np.where(z % 2 == 1, -(z + 1) // 2, z // 2)
            if array["delta"]:
                parts = [np.cumsum(q[start : start + chunk]) for start in range(0, count, chunk)]
                q = np.concatenate(parts) if parts else q
            columns.append(np.repeat(steps[c], chunk)[:count] * q.astype(np.float32))
        result[array["name"]] = np.stack(columns, 1) if columns else np.zeros((count, 0), np.float32)
    assert at == len(body)
    return result


def chebyshev(coefficients: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Coefficients [M, D, C] of T_1 ... T_D at s [M] to [M, C]."""
    degrees = np.arange(1, coefficients.shape[1] + 1)
    return np.einsum("mk,mkc->mc", np.cos(degrees * np.arccos(np.clip(s, -1, 1))[:, None]), coefficients)


def show(about: dict[str, Any], arrays: dict[str, np.ndarray], camera: Camera, seconds: float, backend: Any = "auto") -> np.ndarray:
    """[H, W, 3] the scene at a time, before uncovered pixels are filled; camera in the coordinates of the scene."""
    t = (seconds - about["first"]) / (about["last"] - about["first"])
    resting = about["resting"]
    times, lambdas = arrays["times"][:, 0], np.exp(arrays["logLambdas"][:, 0])
    reach = np.sqrt(-2 * np.log(about["pMin"]) / lambdas)
    start, end = np.maximum(times - reach, 0), np.minimum(times + reach, 1)
    s = (t - (start + end) / 2) / np.maximum((end - start) / 2, 1e-6)
    presence = np.exp(-lambdas * (t - times) ** 2 / 2)
    means, quats = arrays["means"].copy(), arrays["quats"].copy()
    for states, name in ((means, "meanCoefficients"), (quats, "quatCoefficients")):
        coefficients, components = arrays[name], states.shape[1]
        states[resting:] += chebyshev(coefficients.reshape(len(times), coefficients.shape[1] // components, components), s)
    opacities = arrays["opacities"][:, 0].copy()
    opacities[resting:] *= np.where(presence >= about["pMin"], presence, 0)
    degree = about["shDegree"]
    sh = arrays["colors"]
    if degree:
        sh = np.concatenate([sh, arrays["harmonics"]], 1)
    moved = Similarity.from_json(about["similarity"]).camera(camera)
    directions = torch.from_numpy(means) - torch.as_tensor(moved.center, dtype=torch.float32)
    colors = colors_from_harmonics(torch.from_numpy(sh.reshape(len(means), -1, 3)), directions, degree).numpy()
    if about["gains"]:
        cosines = np.cos(np.pi * t * np.arange(1, about["gains"] + 1))
        colors[:resting] *= np.exp(arrays["gains"] @ cosines)[:, None]
    given = [means, quats, np.exp(arrays["logScales"]), opacities, colors, arrays.get("slopes", np.zeros((len(means), 2)))]
    means, quats, scales, opacities, colors, slopes = (torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in given)
    size, planes = (moved.width, moved.height), {"near_plane": about["near"], "eps2d": about["eps2d"]}
    projected = project(means, quats, scales, opacities, *moved.tensors(), *size, **planes, backend=backend)
    sliced = Slice(means, quats, scales, None, opacities, colors, means, None, None, slopes)
    return blend(projected, opacities, colors, *size, slopes=image_slopes(sliced, projected, moved))[0].numpy()
