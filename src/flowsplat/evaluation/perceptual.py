"""LPIPS with AlexNet, where the extra ``metrics`` and the network's weights are installed; a reason where not."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from flowsplat.common.errors import describe_install, first_line

PerceptualMetric = Callable[[np.ndarray, np.ndarray], float | None]
"""(image, other image), both float RGB [H, W, 3], clipped to [0, 1], to a distance: 0 = they look the same.

None for images with a side below ``MIN_SIDE``, which the network would pool to nothing. Several threads may call it at once.
"""

MIN_SIDE = 64
"""Pixels. Chosen by eye."""


def lpips_metric() -> tuple[PerceptualMetric | None, str]:
    """Return the learned perceptual distance (https://arxiv.org/abs/1801.03924, AlexNet), or why it cannot be measured here.

    The network's weights are used only if they are in torch's cache already: nothing is downloaded, nothing is raised.

    Returns:
        (metric, "") or (None, one sentence with the reason and the remedy).
    """
    try:
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity
        from torchvision.models import AlexNet_Weights
    except Exception as error:  # missing: ImportError; built for another torch: RuntimeError, OSError
        return None, f"LPIPS needs the packages of {describe_install('metrics')}: {first_line(error)}."
    weights = Path(torch.hub.get_dir()) / "checkpoints" / Path(AlexNet_Weights.DEFAULT.url).name
    if not weights.exists():
        return None, (
            f"LPIPS needs the AlexNet weights {weights.name} in torch's cache; this fetches them once: "
            "python -c \"import torchvision; torchvision.models.alexnet(weights='DEFAULT')\"."
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            network = LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True)
    except Exception as error:  # a truncated file raises whatever the unpickler stumbles over
        return None, f"LPIPS could not read the AlexNet weights {weights.name}, delete them: {first_line(error)}."

    lock = threading.Lock()  # the network adds up what it was asked until it is reset

    def distance(a: np.ndarray, b: np.ndarray) -> float | None:
        if min(a.shape[:2]) < MIN_SIDE:
            return None
        with lock, torch.no_grad():
            value = float(network(_batch(a), _batch(b)))
            network.reset()
        return value

    return distance, ""


def _batch(image: np.ndarray) -> torch.Tensor:
    return torch.tensor(image.transpose(2, 0, 1)[None], dtype=torch.float32).clamp(0, 1)
