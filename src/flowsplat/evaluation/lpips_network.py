"""LPIPS with AlexNet from a file of its weights, in plain PyTorch: where they are at hand, and torchvision or its cache is not.

https://arxiv.org/abs/1801.03924: features of both images after every convolution, each of length 1, their squared differences
weighted by what was learned from people (version 0.1, which torchmetrics brings), averaged over the image and added up.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

from flowsplat.common.errors import InputError, describe_install
from flowsplat.evaluation.perceptual import MIN_SIDE, PerceptualMetric
from flowsplat.priors.learned.weights import state_dict_file

LAYERS = (
    ("features.0", (64, 3, 11, 11), 4, 2, False), ("features.3", (192, 64, 5, 5), 1, 2, True),
    ("features.6", (384, 192, 3, 3), 1, 1, True), ("features.8", (256, 384, 3, 3), 1, 1, False),
    ("features.10", (256, 256, 3, 3), 1, 1, False),
)  # fmt: skip
"""Of each convolution: its name in torchvision's file, the shape of its weights, stride, padding, and whether the largest of 3 x 3
is taken before it."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Of colors from -1 to 1, as LPIPS was trained: ImageNet's mean and standard deviation."""
EPSILON = 1e-8
"""Added to the squared length of features."""
HEADS = Path("functional", "image", "lpips_models", "alex.pth")
"""In torchmetrics: the weights of the differences."""


def open_lpips(path: Path) -> PerceptualMetric:
    """Return LPIPS by AlexNet's weights in a file such as torchvision's ``alexnet-owt-7be5be79.pth``.

    Raises:
        InputError: the file is missing, damaged or of another network, or torchmetrics is not installed.
    """
    option = {"option": "--lpips", "setting": "--lpips", "instead": "leave it out"}
    weights = state_dict_file(path, **option)
    found = importlib.util.find_spec("torchmetrics")
    if found is None or found.origin is None:
        raise InputError(f"--lpips needs the package of {describe_install('metrics')}.")
    heads = state_dict_file(Path(found.origin).parent / HEADS, **option)
    for name, shape, *_ in LAYERS:
        _check(path, weights, f"{name}.weight", shape)
        _check(path, weights, f"{name}.bias", shape[:1])

    def distance(a: np.ndarray, b: np.ndarray) -> float | None:
        if min(a.shape[:2]) < MIN_SIDE:
            return None
        images = torch.from_numpy(np.stack([a, b]).astype(np.float32)).permute(0, 3, 1, 2).clamp(0, 1)
        return measure(images, weights, heads)

    return distance


def _check(path: Path, weights: Mapping[str, Tensor], name: str, shape: tuple[int, ...]) -> None:
    value = weights.get(name)
    if value is None or value.shape != shape or value.dtype != torch.float32 or not bool(value.isfinite().all()):
        raise InputError(f"--lpips: {path} does not hold AlexNet: {name} is missing, or no {list(shape)} float32 numbers.")


@torch.no_grad()
def measure(images: Tensor, weights: Mapping[str, Tensor], heads: Mapping[str, Tensor]) -> float:
    """Return the distance of two images [2, 3, H, W], 0 to 1."""
    shift, scale = (torch.tensor(values)[:, None, None] for values in (SHIFT, SCALE))
    features, total = (2 * images - 1 - shift) / scale, 0.0
    for k, (name, _, stride, padding, pools) in enumerate(LAYERS):
        features = max_pool2d(features, 3, 2) if pools else features
        features = torch.relu(conv2d(features, weights[f"{name}.weight"], weights[f"{name}.bias"], stride, padding))
        unit = features / torch.sqrt(EPSILON + (features**2).sum(1, keepdim=True))
        squared = (unit[:1] - unit[1:]) ** 2
        total += float(conv2d(squared, heads[f"lin{k}.model.1.weight"]).mean())
    return total
