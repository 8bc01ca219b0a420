"""RAFT (https://arxiv.org/abs/2003.12039) as torchvision has it, with torchvision's weights or those that its authors publish.

The networks are the same (torchvision ported its first weights from https://github.com/princeton-vl/RAFT): same norms and biases, a
ReLU after every convolution of a block, the small one enlarged bilinearly with ``align_corners``. Only the names differ.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from flowsplat.common.errors import InputError, first_line
from flowsplat.priors.flow import FlowEstimator
from flowsplat.priors.learned.weights import require_package, state_dict_file

OPTION, SETTING, INSTEAD = "--flow raft", "--models.raft", "--flow dis"

MIN_SIDE = 360
"""Pixels of the shorter side below which images are enlarged: it matches them at an eighth of their size. With 360 instead of the
128 that its pyramid of correlations needs, the small network's end-point error on ten random worlds of 320 x 180 (seeds 0 to 9) is
.23 instead of .35 pixels, on objects 1.00 instead of 1.77 (``flowsplat_benchmarks.scripts.flow_error``)."""

SIDE_MULTIPLE = 8
"""Sides are continued to a multiple of this."""

FIRST_WEIGHT = "feature_encoder.convnormrelu.0.weight"
"""Its number of channels tells large from small."""

PRINCETON = "fnet.conv1.weight"
"""A weight by which a file of RAFT's authors is known, once the prefix of parallel training (``module.``) is taken away."""

RENAMED = (
    (r"^fnet\.", "feature_encoder."),
    (r"^cnet\.", "context_encoder."),
    (r"^(\w+_encoder\.)conv1\.", r"\1convnormrelu.0."),
    (r"^(\w+_encoder\.)norm1\.", r"\1convnormrelu.1."),
    (r"^(\w+_encoder\.)conv2\.", r"\1conv."),
    (r"^(\w+_encoder\.layer\d\.\d\.)conv(\d)\.", r"\1convnormrelu\2.0."),
    (r"^(\w+_encoder\.layer\d\.\d\.)norm(\d)\.", r"\1convnormrelu\2.1."),
    (r"^update_block\.encoder\.convc(\d)\.", r"update_block.motion_encoder.convcorr\1.0."),
    (r"^update_block\.encoder\.convf(\d)\.", r"update_block.motion_encoder.convflow\1.0."),
    (r"^update_block\.encoder\.conv\.", "update_block.motion_encoder.conv.0."),
    (r"^update_block\.gru\.conv([zrq])\.", r"update_block.recurrent_block.convgru1.conv\1."),
    (r"^update_block\.gru\.conv([zrq])(\d)\.", r"update_block.recurrent_block.convgru\2.conv\1."),
    (r"^update_block\.mask\.0\.", "mask_predictor.convrelu.0."),
    (r"^update_block\.mask\.2\.", "mask_predictor.conv."),
)
"""From the names of RAFT's authors to torchvision's, each applied in turn."""

REPEATED = re.compile(r"^cnet\.layer\d\.0\.norm3\.")
"""The norm of a shortcut, which the authors' files of the large network hold once more as ``downsample.1``."""


def translate_names(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return weights by torchvision's names, from these or from those of RAFT's authors."""
    bare = {name.removeprefix("module."): value for name, value in state.items()}
    if PRINCETON not in bare:
        return dict(state)
    translated = {}
    for name, value in bare.items():
        if REPEATED.match(name):
            continue
        for pattern, replacement in RENAMED:
            name = re.sub(pattern, replacement, name)
        translated[name] = value
    return translated


def raft_estimator(source: str, device: torch.device, min_side: int | None = None) -> FlowEstimator:
    """Return flow by RAFT, which compares all pixels with all and leaves a guess aside.

    Args:
        source: ``large`` or ``small`` with torchvision's weights, from torch's cache or fetched once, or a ``.pth`` file with
            weights of either by torchvision's names or by those of RAFT's authors.
        min_side: pixels of the shorter side below which images are enlarged, at least 128; None = ``MIN_SIDE``.

    Raises:
        InputError: torchvision or the weights are not there.
    """
    models = require_package("torchvision.models.optical_flow", OPTION, INSTEAD)
    if source in ("large", "small"):
        weights = (models.Raft_Large_Weights if source == "large" else models.Raft_Small_Weights).DEFAULT
        network = (models.raft_large if source == "large" else models.raft_small)(weights=None)
        file = Path(torch.hub.get_dir()) / "checkpoints" / Path(weights.url).name
        try:
            state: dict[str, Any] = dict(weights.get_state_dict(progress=False, check_hash=True))
        except Exception as error:  # no network, no permission, a truncated file
            raise InputError(
                f"{OPTION}: the weights {file} can be neither found nor fetched ({first_line(error)}). Fetch {weights.url} to "
                f"that place, or name your file with {SETTING} FILE, or do without: {INSTEAD}."
            ) from error
        path = file
    else:
        path = Path(source)
        state = translate_names(state_dict_file(path, option=OPTION, setting=SETTING, instead=INSTEAD))
        channels = state[FIRST_WEIGHT].shape[0] if FIRST_WEIGHT in state else 0
        small = models.raft_small(weights=None)
        network = small if small.state_dict()[FIRST_WEIGHT].shape[0] == channels else models.raft_large(weights=None)
    try:
        network.load_state_dict(state)
    except RuntimeError as error:
        raise InputError(
            f"{OPTION}: {path} holds no RAFT by the names of its authors or of torchvision ({first_line(error)}). Give such a file "
            f"with {SETTING} FILE, or do without: {INSTEAD}."
        ) from error
    network = network.to(device).eval()

    @torch.inference_mode()
    def estimate(a: np.ndarray, b: np.ndarray, guess: np.ndarray | None = None) -> np.ndarray:
        height, width = a.shape[:2]
        factor = max(1.0, (min_side or MIN_SIDE) / min(height, width))
        rows, columns = round(height * factor), round(width * factor)
        padding = (0, -columns % SIDE_MULTIPLE, 0, -rows % SIDE_MULTIPLE)
        pair = torch.stack([torch.tensor(image).permute(2, 0, 1) for image in (a, b)]).to(device, torch.float32) / 127.5 - 1
        if (rows, columns) != (height, width):
            pair = F.interpolate(pair, (rows, columns), mode="bilinear", align_corners=False)
        pair = F.pad(pair, padding, mode="replicate")
        flow = network(pair[:1], pair[1:])[-1][..., :rows, :columns]
        if (rows, columns) != (height, width):
            flow = F.interpolate(flow, (height, width), mode="area")
        scale = np.array([width / columns, height / rows], np.float32)
        return flow[0].permute(1, 2, 0).cpu().numpy().astype(np.float32) * scale

    return estimate
