"""A run and a model that a release wrote are opened, shown, measured and exported by this version."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import flowsplat
from flowsplat.cli import main
from flowsplat.output.page_reader import read_page
from flowsplat.output.splat_files import read_splats
from tests.kept import FRAME, HERE, IMAGE, RELEASES

MAX_BYTES = 300_000


@pytest.fixture(params=RELEASES)
def kept(request, tmp_path) -> Path:
    """A copy."""
    return Path(shutil.copytree(HERE / request.param, tmp_path / "run"))


def image_of(path: Path) -> np.ndarray:
    """RGB between 0 and 255."""
    return cv2.imread(str(path))[..., ::-1].astype(float)


def test_there_is_one_and_it_is_small():
    assert RELEASES
    for name in RELEASES:
        assert sum(path.stat().st_size for path in (HERE / name).rglob("*") if path.is_file()) < MAX_BYTES


@pytest.mark.parametrize("what", ["model", "."])
def test_the_model_shows_what_it_showed(kept, what):
    scene = flowsplat.Scene(kept / "scene")
    model = flowsplat.load(kept / what)
    camera, seconds = scene.cameras[FRAME], float(scene.timestamps[FRAME])
    following = scene.cameras[FRAME + 1], float(scene.timestamps[FRAME + 1])
    rendered = model.render(camera, seconds, following)
    assert np.isfinite(rendered.flow).all()
    assert np.abs(rendered.flow).max() > 0.1
    if what == "model":
        error = np.abs(np.rint(255 * rendered.color) - image_of(kept / IMAGE))
        assert error.max() <= 2, "of 255: processors round in ways of their own"
        assert error.mean() < 0.05


def test_the_folder_is_that_of_a_finished_run(kept, capsys):
    main(["info", str(kept)])
    said = capsys.readouterr().out
    assert "train: finished" in said
    run = flowsplat.Run(kept)
    assert len(run.model.gaussians) > 50
    assert run.scene.num_frames == 6


def test_it_is_exported(kept):
    for form in ("html", "ply", "npz"):
        main(["export", str(kept), "--to", form])
    (ply,) = (kept / "export").glob("*.ply")
    assert len(read_splats(ply)) > 50
    (page,) = (kept / "export").glob("*.html")
    assert len(read_page(page)) > 50


def test_it_is_measured_as_it_was_and_rendered(kept):
    before = json.loads((kept / "metrics.json").read_text())
    main(["render", str(kept), "--render.paths", "input", "--render.width", "24"])
    assert (kept / "renders" / "input_path_color.mp4").stat().st_size > 500
    (kept / "metrics.json").unlink()
    main(["evaluate", str(kept)])
    after = json.loads((kept / "metrics.json").read_text())
    for where in ("heldout_frames", "training_frames"):
        assert after[where]["psnr"] == pytest.approx(before[where]["psnr"], abs=0.02), where
