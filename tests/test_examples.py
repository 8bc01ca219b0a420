"""Every example runs as a reader would run it, only shorter."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import pytest

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
