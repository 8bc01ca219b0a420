"""Every example runs as a reader would run it, only shorter."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from flowsplat.geometry.cameras import pixel_grid
from flowsplat.output.export.formats.colmap import write_colmap
from flowsplat.output.export.still import still_at
from flowsplat.output.splat_files import read_splats
from flowsplat.priors.prepare import use_truth
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from tests.output.small import small_model

EXAMPLES = Path(__file__).parent.parent / "examples"


def run_example(name: str, *arguments: object) -> str:
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_every_example_is_tested():
    tested = Path(__file__).read_text(encoding="utf-8")
    for path in EXAMPLES.glob("[0-9]*.py"):
        assert path.name in tested, path.name


def test_the_notebook_runs_and_shows_images(tmp_path):
    command = [sys.executable, "-m", "tests.notebook", str(EXAMPLES / "notebook.ipynb"), str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=EXAMPLES.parent)
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    images = {path.name: cv2.imread(str(path)) for path in sorted((tmp_path / "shown").iterdir())}
    assert list(images) == ["01.jpeg", "02.jpeg", "03.jpeg", "05.png", "06.png", "07.png", "08.png"]
    assert {name: image.std() > 10 for name, image in images.items()} == dict.fromkeys(images, True)
    assert images["05.png"].shape == (288, 512, 3)
    assert abs(images["01.jpeg"].mean() - images["02.jpeg"].mean()) < 5, "the trained scene is as bright as the clip"
    assert (tmp_path / "out" / "notebook" / "compare.html").read_text().count("<video ") == 2
    assert (tmp_path / "out" / "notebook" / "player.html").stat().st_size > 100_000


def test_splatting_on_the_cpu(tmp_path):
    output = run_example("01_splat_on_the_cpu.py", tmp_path, 60)
    errors = [float(line.rsplit(" ", 1)[1]) for line in output.splitlines() if line.startswith("step")]
    assert errors[-1] < 0.5 * errors[0]
    assert (tmp_path / "01_fitted.png").exists()


@pytest.mark.slow
def test_training_and_rendering_from_python(tmp_path):
    assert "held-out views" in run_example("02_train_from_python.py", tmp_path, 20)
    run_example("03_render_a_trained_scene.py", tmp_path)
    assert (tmp_path / "03_rendered.png").exists()


@pytest.mark.slow
def test_a_motion_model_of_ones_own(tmp_path):
    output = run_example("04_add_a_motion_model.py", tmp_path, 40)
    losses = next(line for line in output.splitlines() if line.startswith("loss")).split()
    assert float(losses[3].rstrip(",")) < 0.9 * float(losses[1])
    assert (tmp_path / "04_player.html").stat().st_size > 100_000


@pytest.mark.slow
def test_code_of_gsplat_users(tmp_path):
    output = run_example("05_gsplat_users.py", tmp_path, 80)
    steps = [line.split() for line in output.splitlines() if line.startswith("step")]
    assert float(steps[-1][-1]) > float(steps[0][-1]) + 5  # dB
    if "gsplat is not installed" not in output:
        assert int(steps[-1][2]) > int(steps[0][2])
    assert (tmp_path / "05_gsplat_users.png").exists()


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_static_scene_from_colmap(tmp_path, strategy):
    """Of a rendered clip, with its own cameras and points near its surfaces."""
    if importlib.util.find_spec("gsplat") is None:
        pytest.skip("gsplat is not installed")
    scene = write_synthetic(tmp_path / "scene", SyntheticScene(width=64, height=48, frames=10), holdout=None)
    use_truth(scene)
    model = small_model(resting=500, moving=0)
    grid = scene.cameras[0].unproject(pixel_grid(64, 48)[::4, ::4].reshape(-1, 2), np.full(192, 1 / scene.similarity.scale))
    still = replace(still_at(model, model.first), means=torch.from_numpy(grid).float(), sh=torch.zeros(192, 1, 3))
    write_colmap(tmp_path / "colmap", scene, still)
    images, masks = tmp_path / "scene", tmp_path / "scene" / "masks"
    if strategy == "mcmc":  # names with spaces, and masks in the folders of the images
        table = tmp_path / "colmap" / "images.txt"
        text = table.read_text()
        assert " frames/" in text
        table.write_text(text.replace(" frames/", " left eye/"))
        shutil.copytree(images / "frames", tmp_path / "images" / "left eye")
        shutil.copytree(masks, tmp_path / "moving" / "left eye")
        images, masks = tmp_path / "images", tmp_path / "moving"
    output = run_example(
        "06_train_static.py", tmp_path / "colmap", images, "--masks", masks, "--steps", 60,
        "--strategy", strategy, "-o", tmp_path,
    )  # fmt: skip
    figures = [float(line.split("PSNR ")[1].split()[0]) for line in output.splitlines() if line.startswith("step")]
    assert figures[-1] > figures[0] + 0.5
    assert len(read_splats(tmp_path / "06_static.ply")) > 100
