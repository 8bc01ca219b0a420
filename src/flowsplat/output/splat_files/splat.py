"""The .splat of https://github.com/antimatter15/splat: 32 bytes a Gaussian, see ``output.export.formats.splat``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import ordinary_file
from flowsplat.output.export.formats.splat import RECORD
from flowsplat.output.splat_files.splats import MAX_GAUSSIANS, Splats, to_float32
from flowsplat.splatting.rules import C0


def read_splat(path: Path) -> Splats:
    """Read a file.

    Raises:
        InputError: it is missing, no such file, truncated, or has more Gaussians than can be read.
    """
    size = ordinary_file(path, MAX_GAUSSIANS * RECORD.itemsize)
    if size % RECORD.itemsize:
        raise InputError(f"{path} is damaged, truncated or no .splat: {size:,} bytes are no multiple of {RECORD.itemsize}.")
    records = np.fromfile(path, RECORD, size // RECORD.itemsize)
    with np.errstate(divide="ignore", invalid="ignore"):
        rgba = records["color"].astype(np.float32) / 255
        log_scales = np.log(records["scale"])
        logits = np.log(rgba[:, 3]) - np.log1p(-rgba[:, 3])
    quats = (records["rotation"].astype(np.float32) - 128) / 128
    return Splats(to_float32(records["position"]), quats, to_float32(log_scales), logits, ((rgba[:, :3] - 0.5) / C0)[:, None])
