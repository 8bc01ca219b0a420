"""The scene inside a page, read with NumPy alone, as the page's own program and our renderer have it."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.output.page_reader import read_page
from flowsplat.output.player.pack import pack
from flowsplat.output.player.sequence import write_sequence
from flowsplat.splatting import rasterize
from flowsplat.splatting.harmonics import colors_from_harmonics
from tests.output.player.unpacking import unpack
from tests.output.small import (
    LINEAR,
    OURS,
    PAPER,
    five_pairs,
    flat,
    psnr,
    rendered,
    small_cameras,
    small_model,
    small_player,
    small_times,
)


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    return small_player(tmp_path_factory.mktemp("page") / "a <b>.html", small_model(), 'a <b> & "c"')


def change(page: Path, tmp_path: Path, name: str, value: object) -> Path:
    """A page whose header has something else there."""
    text = page.read_text()
    found = re.search(r'<script id="about" type="application/json">([^<]*)', text)
    assert found is not None
    header = json.loads(found[1])
    *within, last = name.split(".")
    at = header
    for part in within:
        at = at[int(part)] if part.isdigit() else at[part]
    at[last] = value
    path = tmp_path / "changed.html"
    path.write_text(text[: found.start(1)] + json.dumps(header).replace("<", "\\u003c") + text[found.end(1) :])
    return path


@pytest.mark.parametrize("config", [OURS, PAPER, LINEAR], ids=["ours", "paper", "linear"])
def test_it_reads_what_was_packed(config, tmp_path):
    model = small_model(config)
    scene = read_page(small_player(tmp_path / "page.html", model))
    packed = pack(model, small_times(), small_cameras(model), "small")
    expected = unpack(packed.about, packed.data)
    assert set(scene.arrays) == set(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(scene.arrays[name], values)
    assert (scene.header["title"], len(scene)) == ("small", len(scene.arrays["means"]))


@pytest.mark.parametrize("config", [OURS, LINEAR], ids=["ours", "linear"])
def test_its_gaussians_at_a_time_are_the_scene(config, tmp_path):
    """Drawn as any program of static Gaussians would, beside our own image of the scene."""
    model = flat(small_model(config)) if config.slopes else small_model(config)
    scene = read_page(small_player(tmp_path / "page.html", model))
    for camera, seconds in five_pairs(model):
        still = scene.at(seconds)
        inner = model.similarity.camera(camera)
        directions = torch.from_numpy(still.means) - torch.as_tensor(inner.center, dtype=torch.float32)
        colors = colors_from_harmonics(torch.from_numpy(still.sh), directions, scene.header["shDegree"])
        shapes = (
            torch.from_numpy(np.ascontiguousarray(each)) for each in (still.means, still.quats, still.scales, still.opacities)
        )
        image = rasterize(
            *shapes, colors * torch.from_numpy(still.gains)[:, None], *inner.tensors(), inner.width, inner.height,
            near_plane=scene.header["near"], eps2d=scene.header["eps2d"],
        )[0]  # fmt: skip
        assert psnr(image.numpy(), rendered(model, camera, seconds)) > 38


def test_objects_and_slopes_are_told(page):
    scene = read_page(page)
    counted = {number: int((scene.object_ids == number).sum()) for number, _ in scene.header["objects"]}
    assert counted == dict(map(tuple, scene.header["objects"]))
    assert scene.slopes.shape == (len(scene), 2)
    assert np.abs(scene.slopes).max() > 0.01


def test_torch_is_not_needed(page):
    code = f"""
import sys
sys.modules["torch"] = None
from flowsplat.output.page_reader import read_page
print(read_page({str(page)!r}).at(1.0).means.shape)
"""
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert said.stdout.strip() == str((len(read_page(page)), 3)), said.stderr


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("version", 3, "newer flowsplat"),
        ("version", 1, "of an earlier flowsplat"),
        ("resting", 3, "its array means has"),
        ("arrays.0.count", 10_000_000, "its array means has"),
        ("arrays.0.name", "other", "no array means"),
        ("arrays.1.name", "means", "is damaged"),
        ("arrays.0.chunk", 0, "is damaged"),
        ("arrays.0.chunk", 1, "another size than its header says"),
        ("arrays.0.components", 900, "its array means has"),
        ("bytes", 10**9, "its data cannot be read"),
        ("bytes", 0, "said to hold|another size"),
        ("arrays.0.bits", 12, "is damaged"),
        ("pMin", 0, "is damaged"),
        ("arrays", [], "no array means"),
    ],
)
def test_a_header_that_cannot_be_is_refused(page, tmp_path, name, value, says):
    with pytest.raises(InputError, match=says):
        read_page(change(page, tmp_path, name, value))


def test_what_is_no_page_is_refused(page, tmp_path):
    text = page.read_text()
    cut = tmp_path / "cut.html"
    cut.write_text(re.sub(r'(text/plain">[^<]{400})[^<]*', r"\1", text))
    other = tmp_path / "other.html"
    other.write_text("<html></html>")
    many = write_sequence(tmp_path / "many.html", [text], ["1"], "shots")
    for path, says in ((cut, "damaged"), (other, "no page that plays"), (many, "several shots"), (tmp_path / "x", "not exist")):
        with pytest.raises(InputError, match=says):
            read_page(path)
