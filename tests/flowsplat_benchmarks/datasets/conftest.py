"""A tiny data root with scenes of every protocol, and figures as a run leaves them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.scenes.layers import write_image
from flowsplat.scenes.synthetic import SyntheticScene
from tests.flowsplat_benchmarks.conftest import write_rig
from tests.scenes.formats.nvidia_layouts import write_nerfies, write_raw, write_twelve

SPEC = SyntheticScene(width=64, height=48, frames=12, fps=6.0)
SMALL = SyntheticScene(width=64, height=48, frames=4, fps=6.0)


def write_heldout(folder: Path, spec: SyntheticScene) -> None:
    """The held-out cameras of a rig scene."""
    cameras: dict[str, dict] = {}
    for view in spec.heldout_views():
        name, time = view.name.rsplit("_", 1)
        rendered = spec.render(view.camera, spec.timestamps[view.frame])
        write_image(folder / "heldout" / name / f"{time}.png", rendered.image)
        write_image(folder / "heldout" / f"{name}_masks" / f"{time}.png", (rendered.mask > 0).astype(np.uint8) * 255)
        entry = cameras.setdefault(name, {"times": [], "w2c": []})
        entry["times"].append(view.frame)
        entry["w2c"].append(view.camera.viewmat.tolist())
    values = {"K": spec.camera(0).K.tolist(), "width": spec.width, "height": spec.height, "cameras": cameras}
    (folder / "heldout" / "cameras.json").write_text(json.dumps(values))


@pytest.fixture(scope="session")
def runs_root(tmp_path_factory) -> Path:
    """``rig/tiny``, ``davis/bear`` with masks (the name only), ``davis/plain`` without, and ``nvidia`` in three forms."""
    root = tmp_path_factory.mktemp("runs")
    rig = root / "rig" / "tiny"
    write_rig(rig, SPEC)
    write_heldout(rig, SPEC)
    for i in range(SPEC.frames):
        image = cv2.imread(str(rig / "rgb" / f"{i:05d}.png"))[..., ::-1]
        mask = cv2.imread(str(rig / "masks" / f"{i:05d}.png"), cv2.IMREAD_UNCHANGED)
        for name in ("bear", "plain"):
            write_image(root / "davis" / name / "images" / f"{i:05d}.png", image)
        write_image(root / "davis" / "bear" / "masks" / f"{i:05d}.png", (mask > 0).astype(np.uint8) * 255)
    write_raw(root / "nvidia" / "Raw", SMALL)
    write_twelve(root / "nvidia" / "jumping", SMALL)
    write_nerfies(root / "nvidia" / "Balloon1", replace(SMALL, width=96, height=72))
    return root


def figures(psnr: float, **more) -> dict:
    return {"psnr": psnr, "ssim": 0.9, "lpips": None, "count": 3, "moving": {"psnr": psnr - 3, "ssim": 0.8, "lpips": None}, **more}


def result(scene: str, protocol: str = "davis", **changes) -> dict:
    """The JSON of a case."""
    value = {
        "name": f"{scene}_given-masks_default", "protocol": protocol, "scene": scene, "form": "", "variant": "given masks",
        "settings": "default", "tuned": scene == "bear", "flowsplat": "0", "frames": 12, "size": [64, 48],
        "test": {"kind": "frames", "count": 3}, "ours": figures(31.23),
        "baselines": {"copy": figures(20.5), "flow_interpolation": figures(30.75), "static": figures(25.0)},
        "training_frames": figures(33.0), "flow_epe": None, "flow_prior_epe": {"mean": 1.0, "median": 0.5, "moving": None},
        "depth_abs_rel": None, "lpips_reason": "LPIPS needs its weights.", "tracks": None,
        "gaussians": {"total": 196_000, "active_mean": 91_000.0}, "images_a_second": 7.5,
        "seconds": {"flow": 3.0, "train": 3600.0, "static": 900.0, "evaluate": 5.0}, "peak_memory_gib": 2.5,
        "verdicts": {"cameras": "good", "depth": "", "masks": "given"},
    }  # fmt: skip
    return {**value, **changes}
