"""A file of static Gaussians is rendered and shown as a run is."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.output.camera_files import write_camera_file
from flowsplat.output.export.formats.ply import write_ply
from flowsplat.output.splat_files import read_splats
from flowsplat.output.videos import RenderOptions
from flowsplat.output.viewer.export_panel import render_command
from flowsplat.output.viewer.source import Source
from flowsplat.pipeline import splat_file
from flowsplat.splatting import rasterization
from tests.output.splat_files.test_reading import make_still


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(splat_file, "WIDTH", 64)
    monkeypatch.setattr(splat_file, "HEIGHT", 48)
    monkeypatch.setattr(splat_file, "FRAMES", 5)


@pytest.fixture
def file(tmp_path):
    still = make_still(300)
    moved = replace(still, means=still.means * 3 + torch.tensor([10.0, -5, 2]), log_scales=still.log_scales + 2)
    write_ply(tmp_path / "scene.ply", moved, has_objects=False)
    return tmp_path / "scene.ply"


def test_a_camera_sees_what_the_rasterizer_draws_of_the_file(file):
    splats = read_splats(file)
    model, cameras = splat_file.make_model(splats), splat_file.make_cameras(splats)
    camera = cameras[3].resize(96, 54)
    rendered = model.render(camera, 1.0)
    values = (torch.from_numpy(value) for value in (splats.means, splats.quats, np.exp(splats.log_scales)))
    viewmat, K = camera.tensors()
    expected, alphas, _ = rasterization(
        *values, torch.from_numpy(splats.logit_opacities).sigmoid(), torch.from_numpy(splats.sh), viewmat[None], K[None], 96, 54,
        sh_degree=3,
    )  # fmt: skip
    assert 0.2 < float(alphas.mean()) < 0.99
    np.testing.assert_allclose(rendered.alpha, alphas[0, ..., 0].numpy(), atol=2e-3)
    np.testing.assert_allclose(rendered.color, expected[0].clamp(0, 1).numpy(), atol=5e-3)


def test_cameras_go_once_round_the_middle(file):
    splats = read_splats(file)
    cameras = splat_file.make_cameras(splats)
    assert all(camera.is_valid for camera in cameras)
    pixels = [camera.project(np.median(splats.means, 0))[0] for camera in cameras]
    np.testing.assert_allclose(pixels, [[480, 270]] * len(cameras), atol=1e-6)
    np.testing.assert_allclose(cameras[0].viewmat, cameras[-1].viewmat, atol=1e-9)
    assert np.linalg.norm(cameras[0].center - cameras[len(cameras) // 2].center) > 3


def test_the_command_renders_a_camera_file(small, file, tmp_path):
    cameras = splat_file.make_cameras(read_splats(file))
    write_camera_file(tmp_path / "path.json", [(camera.resize(64, 48), t) for t, camera in enumerate(cameras)], 12.0)
    main(["render", str(file), "-o", str(tmp_path / "out"), "--render.camera-file", str(tmp_path / "path.json"), "--render.paths"])
    rendered = sorted(path.name for path in (tmp_path / "out" / "renders").glob("*.mp4"))
    assert rendered == ["custom_path_path.mp4", "custom_path_path_color.mp4"]
    source = Source(tmp_path / "out")
    assert source.frame(0.0).std() > 5
    assert source.loaded.state == "trained"


def test_a_folder_is_of_one_file(small, file, tmp_path):
    options = RenderOptions(paths=(), camera_file=tmp_path / "path.json")
    cameras = splat_file.make_cameras(read_splats(file))
    write_camera_file(options.camera_file, [(camera.resize(32, 24), 0.1 * t) for t, camera in enumerate(cameras[:3])], 12.0)
    splat_file.render_splat_file(file, tmp_path / "out", options)
    frame = tmp_path / "out" / "scene" / "frames" / "00000.png"
    written = frame.stat().st_mtime_ns
    splat_file.render_splat_file(file, tmp_path / "out", replace(options, width=32))
    assert frame.stat().st_mtime_ns == written, "the frames are there and are not drawn again"
    write_ply(tmp_path / "other" / "scene.ply", make_still(20), has_objects=False)
    with pytest.raises(InputError, match="belongs to a different input"):
        splat_file.render_splat_file(tmp_path / "other" / "scene.ply", tmp_path / "out", options)


def test_a_camera_file_that_cannot_be_used_is_refused_before_anything_is_drawn(small, file, tmp_path, monkeypatch):
    monkeypatch.setattr(splat_file.SceneModel, "render", lambda *_: pytest.fail("something is drawn"))
    (tmp_path / "path.json").write_text("[]")
    with pytest.raises(InputError, match=r"path\.json cannot be used"):
        splat_file.render_splat_file(file, tmp_path / "out", RenderOptions(paths=(), camera_file=tmp_path / "path.json"))
    assert not (tmp_path / "out").exists(), "the folder is for another file, too"


def test_a_file_that_differs_in_its_middle_alone_is_another(small, tmp_path):
    write_ply(tmp_path / "scene.ply", make_still(1000), has_objects=False)
    splat_file.open_splat_file(tmp_path / "scene.ply", tmp_path / "out")
    data = bytearray((tmp_path / "scene.ply").read_bytes())
    assert len(data) > 3 * 2**16
    data[len(data) // 2] ^= 1
    (tmp_path / "scene.ply").write_bytes(data)
    with pytest.raises(InputError, match="belongs to a different input"):
        splat_file.open_splat_file(tmp_path / "scene.ply", tmp_path / "out")


def test_the_viewer_opens_a_file(small, file, tmp_path, monkeypatch):
    """What is saved while one looks stays, and what it says can be rendered is rendered."""
    seen = []
    monkeypatch.setattr("flowsplat.output.viewer.server.view", lambda folder, options: seen.append((folder, Source(folder))))
    monkeypatch.setattr("flowsplat.output.viewer.server.check_address", lambda *_: None)
    monkeypatch.chdir(tmp_path)
    main(["view", str(file)])
    main(["view", str(file), "-o", "other"])
    assert [folder for folder, _ in seen] == [Path("out/scene"), Path("other")]
    for folder, source in seen:
        assert folder.exists()
        assert source.file == file
        assert len(source.loaded.part("all").gaussians) == 300
    saved = folder / "viewer" / "path 1.json"
    write_camera_file(saved, [(camera.resize(32, 24), t) for t, camera in enumerate(source.scene.cameras[:2])], 12.0)
    main(shlex.split(render_command(source, saved))[1:])
    assert [path.name for path in sorted((folder / "renders").glob("*_color.mp4"))] == ["custom_path_path-1_color.mp4"]


@pytest.mark.parametrize("options", [["--port", "0"], ["--largest", "2"], ["--host", "203.0.113.9", "--port", "8099"]])
def test_the_viewer_draws_nothing_where_it_cannot_serve(file, tmp_path, capsys, monkeypatch, options):
    monkeypatch.setattr(splat_file.SceneModel, "render", lambda *_: pytest.fail("something is drawn"))
    refused(capsys, "view", file, "-o", tmp_path / "out", *options)
    assert not (tmp_path / "out").exists()


def refused(capsys, *arguments: object) -> str:
    """The one line with which a command ends that cannot work."""
    with pytest.raises(SystemExit) as end:
        main([*map(str, arguments)])
    assert end.value.code == 2
    message = capsys.readouterr().err.strip()
    assert message.startswith("Error: ")
    assert "\n" not in message
    return message


def change_ply(path, index, name, value):
    """Write another number into a .ply of ours: of the Gaussians that ``index`` names."""
    data = path.read_bytes()
    begin = data.index(b"end_header\n") + len("end_header\n")
    names = [line.split()[2] for line in data[:begin].decode().splitlines() if line.startswith("property")]
    vertices = np.frombuffer(data[begin:], "<f4").reshape(-1, len(names)).copy()
    columns = [k for k, found in enumerate(names) if found in name]
    vertices[index, columns] = value(vertices[index][..., columns])
    path.write_bytes(data[:begin] + vertices.tobytes())


MEANS = ("x", "y", "z")


@pytest.mark.parametrize("case", ["far", "large"])
def test_what_the_model_could_not_hold_is_left_out(small, tmp_path, capsys, case):
    """Within bounds in the units of the file, and beyond them in those of the model."""
    path = tmp_path / "scene.ply"
    write_ply(path, make_still(60), has_objects=False)
    change_ply(path, slice(None), MEANS, lambda values: values * (1e-3 if case == "far" else 1e-8))
    change_ply(path, slice(7, 8), *((MEANS, lambda _: 1e8) if case == "far" else (("scale_0",), lambda _: 75)))
    assert len(read_splats(path)) == 60
    model, _ = splat_file.open_splat_file(path, tmp_path / "out")
    assert len(model.gaussians) == 59
    assert "scene.ply: 1 of 60 Gaussians are left out" in " ".join(capsys.readouterr().err.split())
    assert len(splat_file.open_splat_file(path, tmp_path / "out")[0].gaussians) == 59


def test_a_file_that_no_camera_can_see_is_refused(tmp_path):
    path = tmp_path / "scene.ply"
    write_ply(path, make_still(20), has_objects=False)
    change_ply(path, slice(None), MEANS, lambda _: 9e8)
    with pytest.raises(InputError, match=r"scene\.ply is too far away or too large to be seen \(its middle is at 9e\+08, 9e\+08, "):
        splat_file.open_splat_file(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    change_ply(path, slice(None), MEANS, lambda _: np.arange(60).reshape(20, 3) * 1e-8)
    change_ply(path, slice(None), ("scale_1",), lambda _: 79)
    with pytest.raises(InputError, match="holds no Gaussian that can be drawn"):
        splat_file.open_splat_file(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_is_refused(small, file, tmp_path, capsys):
    with pytest.raises(InputError, match="no objects"):
        splat_file.render_splat_file(file, tmp_path / "out", RenderOptions(parts=("objects",)))
    assert "leave out -o, which is for files" in refused(capsys, "render", tmp_path, "-o", tmp_path / "out")
    assert "leave out -o, which is for files" in refused(capsys, "view", tmp_path, "-o", tmp_path / "out")
    assert "none.ply does not exist" in refused(capsys, "render", tmp_path / "none.ply", "-o", tmp_path / "out")
    (tmp_path / "damaged.ply").write_bytes(file.read_bytes()[:-1])
    with pytest.raises(InputError, match="truncated"):
        splat_file.render_splat_file(tmp_path / "damaged.ply", tmp_path / "out", RenderOptions())
    assert not (tmp_path / "out").exists()


def test_gaussians_in_one_place_have_cameras():
    still = make_still(3)
    values = still.quats.numpy(), still.log_scales.numpy(), np.zeros(3), still.sh.numpy()
    cameras = splat_file.make_cameras(splat_file.Splats(np.zeros((3, 3), np.float32), *values))
    assert all(camera.is_valid for camera in cameras)
