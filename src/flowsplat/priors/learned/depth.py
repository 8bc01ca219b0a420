"""Monocular depth by Depth Anything (https://arxiv.org/abs/2406.09414) and Depth Pro (https://arxiv.org/abs/2410.02073)."""

from __future__ import annotations

import numpy as np
import torch

from flowsplat.priors.background.monocular_maps import Monocular
from flowsplat.priors.learned.weights import ModelOptions, from_hub, require_package
from flowsplat.scenes import Scene

INSTEAD = "--depth multiview"


def predict_depth(name: str, scene: Scene, models: ModelOptions, device: torch.device, option: str | None = None) -> Monocular:
    """Return the depth of ``depth-anything`` or ``depth-pro`` for training frames of a scene.

    Args:
        option: what the user chose, as it is typed; the default is ``--depth``.

    Raises:
        InputError: transformers or the weights are not there.
    """
    option = option or f"--depth {name}"
    transformers = require_package("transformers", option, INSTEAD)
    require_package("torchvision", option, INSTEAD)  # What prepares the images needs it.
    source = models.depth_pro if name == "depth-pro" else models.depth_anything
    setting = f"--models.{name}"
    # Not the automatic kinds: a folder with another model is then refused instead of believed.
    kind = transformers.DepthProForDepthEstimation if name == "depth-pro" else transformers.DepthAnythingForDepthEstimation
    network = from_hub(kind, source, option=option, setting=setting, instead=INSTEAD).to(device)
    prepare = from_hub(transformers.AutoImageProcessor, source, option=option, setting=setting, instead=INSTEAD)
    # Depth Pro and the metric variants of Depth Anything say depth, the others inverse depth with an unknown shift.
    relative = name == "depth-anything" and network.config.depth_estimation_type == "relative"

    @torch.inference_mode()
    def inverse(i: int) -> tuple[np.ndarray, np.ndarray]:
        image = scene.frame(i)
        outputs = network(**prepare(images=image, return_tensors="pt").to(device))
        found = prepare.post_process_depth_estimation(outputs, target_sizes=[image.shape[:2]])[0]["predicted_depth"]
        values = found.float().cpu().numpy()
        known = np.isfinite(values) & (values > (0 if not relative else -np.inf))
        values = np.where(known, values, 1)
        return (values if relative else 1 / values).astype(np.float32), known.astype(np.float32)

    return Monocular(name, f"{name} ({source})", relative, inverse)
