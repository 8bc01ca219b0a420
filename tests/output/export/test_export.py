"""Exports, read by readers that are not ours wherever there is one, and drawn by the oracle."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from safetensors.torch import load_file

import flowsplat
from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.gaussians.crop import compute_bounds, crop, parse_crop
from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Gaussians4D
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.visibility import with_seen
from flowsplat.geometry import Camera, Similarity
from flowsplat.output.camera_files import read_camera_file
from flowsplat.output.export import ExportOptions, export_scene
from flowsplat.output.export.formats import EXPORTERS
from flowsplat.output.export.formats.splat import RECORD
from flowsplat.output.export.formats.spz import write_spz
from flowsplat.output.export.importance import choose_most_important
from flowsplat.output.export.shots import export_sequence
from flowsplat.output.export.still import rotate_harmonics, still_at
from flowsplat.output.page_reader import read_page
from flowsplat.output.player.pack import draw_page
from flowsplat.priors.given.colmap import read_colmap
from flowsplat.scenes import Scene
from flowsplat.splatting import rasterize
from flowsplat.splatting.harmonics import colors_from_harmonics
from flowsplat.splatting.rules import C0
from tests.output.small import (
    FIRST,
    FRAMES,
    HEIGHT,
    LAST,
    LINEAR,
    OURS,
    PAPER,
    WIDTH,
    five_pairs,
    flat,
    psnr,
    rendered,
    small_cameras,
    small_gaussians,
    small_model,
    small_run,
    small_times,
)
from tests.output.tiny import tiny_run

DEFAULT = ExportOptions()
TURNED = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])


@pytest.fixture
def run(tmp_path) -> Path:
    return small_run(tmp_path / "run", small_model())


def drawn(
    means: torch.Tensor, quats: torch.Tensor, log_scales: torch.Tensor, logit_opacities: torch.Tensor, sh: torch.Tensor,
    camera: Camera, near: float,
) -> np.ndarray:  # fmt: skip
    """[H, W, 3] what was read from a file, drawn by the oracle."""
    colors = colors_from_harmonics(sh, means - torch.as_tensor(camera.center), int(sh.shape[1] ** 0.5) - 1)
    return rasterize(
        means, quats, log_scales.exp(), logit_opacities.sigmoid(), colors, *camera.tensors(torch.float64), camera.width,
        camera.height, near_plane=near, backend="reference",
    )[0].numpy()  # fmt: skip


def drawn_from_ply(path: Path, camera: Camera, near: float) -> np.ndarray:
    """A .ply of 3D Gaussian Splatting, read by plyfile."""
    vertices = PlyData.read(path)["vertex"]

    def columns(*names: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([vertices[name] for name in names], 1).astype(np.float64))

    means = columns("x", "y", "z")
    rest = [p.name for p in vertices.properties if p.name.startswith("f_rest_")]
    assert rest == [f"f_rest_{k}" for k in range(len(rest))]
    sh = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest:
        sh = torch.cat([sh, columns(*rest).reshape(len(means), 3, -1).transpose(1, 2)], 1)
    quats, log_scales = columns("rot_0", "rot_1", "rot_2", "rot_3"), columns("scale_0", "scale_1", "scale_2")
    return drawn(means, quats, log_scales, columns("opacity")[:, 0], sh, camera, near)


def drawn_from_spz(path: Path, camera: Camera, near: float) -> np.ndarray:
    """An .spz, read by gsply; ``camera`` with y up and z backward."""
    gsply = pytest.importorskip("gsply", reason="no independent reader of spz is installed: pip install gsply (extra dev)")
    found = gsply.read_spz(path)
    means, quats, log_scales, opacities, sh0 = (
        torch.from_numpy(np.asarray(part, np.float64))
        for part in (found.means, found.quats, found.scales, found.opacities, found.sh0)
    )
    sh = torch.cat([sh0[:, None], torch.from_numpy(np.asarray(found.shN, np.float64)).reshape(len(sh0), -1, 3)], 1)
    return drawn(means, quats, log_scales, opacities, sh, camera, near)


def flipped(camera: Camera) -> Camera:
    """The camera in a world with y up and z backward."""
    return Camera(camera.viewmat @ np.diag([1.0, -1, -1, 1]), camera.K, camera.width, camera.height)


def test_what_a_format_cannot_hold_is_told(tmp_path, capsys):
    told = {}
    for name, config in (("varies", OURS), ("does not", PAPER)):
        model = small_model(config)
        small_run(tmp_path / name, model)
        for to in ("ply", "splat", "safetensors", "html", "colmap"):
            export_scene(model, Scene(tmp_path / name / "scene"), to, tmp_path / f"{name}.{to}", ExportOptions())
            told[name, to] = "how brightness varies inside is left out" in capsys.readouterr().err
    assert {key for key, was_told in told.items() if was_told} == {("varies", "ply"), ("varies", "splat")}


@pytest.mark.parametrize(
    ("config", "options"),
    [(OURS, {}), (PAPER, {}), (LINEAR, {}), (OURS, {"rotation": TURNED}), (OURS, {"moving": 0}), (OURS, {"moving": 1})],
    ids=["ours", "paper", "linear", "turned", "nothing moves", "one moves"],
)
def test_ply_shows_the_scene_at_its_time(tmp_path, config, options):
    model = small_model(config, **options)
    small_run(tmp_path, model)
    for camera, seconds in five_pairs(model) if config is OURS and not options else five_pairs(model)[2:4]:
        path = export_scene(model, Scene(tmp_path / "scene"), "ply", tmp_path / "scene.ply", ExportOptions(time=seconds))
        assert psnr(drawn_from_ply(path, camera, NEAR_PLANE / model.similarity.scale), rendered(flat(model), camera, seconds)) > 45


def test_ply_has_the_layout_of_the_original(tmp_path, run):
    path = export_scene(small_model(), Scene(run / "scene"), "ply", tmp_path / "scene.ply", DEFAULT)
    vertices = PlyData.read(path)["vertex"]
    names = [prop.name for prop in vertices.properties]
    assert names == [
        "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{k}" for k in range(9)),
        "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "object_id",
    ]  # fmt: skip
    assert {prop.val_dtype for prop in vertices.properties} == {"f4"}
    assert PlyData.read(path).byte_order == "<"


def test_axes_can_be_flipped(tmp_path, run):
    model = small_model()
    camera, seconds = five_pairs(model)[3]
    options = ExportOptions(time=seconds, flip_axes=True)
    path = export_scene(model, Scene(run / "scene"), "ply", tmp_path / "scene.ply", options)
    assert psnr(drawn_from_ply(path, flipped(camera), NEAR_PLANE * 3), rendered(flat(model), camera, seconds)) > 45


def test_turned_harmonics_look_the_same_along_turned_directions():
    generator = torch.Generator().manual_seed(1)
    sh, directions = torch.randn(50, 16, 3, generator=generator), torch.randn(50, 3, generator=generator)
    R = torch.from_numpy(TURNED)
    found = colors_from_harmonics(rotate_harmonics(sh, R), directions @ R.float().T, 3)
    torch.testing.assert_close(found, colors_from_harmonics(sh, directions, 3), atol=1e-5, rtol=1e-5)


def test_a_sequence_has_a_file_a_frame_and_replaces_an_older_one(tmp_path, run):
    model, folder = small_model(), tmp_path / "sequence"
    folder.mkdir()
    (folder / "frame0099.ply").write_text("of a longer sequence")
    (folder / ".frame0003.1.partial.ply").write_text("left by a process that was killed")
    export_scene(model, Scene(run / "scene"), "ply-sequence", folder, DEFAULT)
    assert sorted(p.name for p in folder.glob("[!.]*")) == [f"frame{k:04d}.ply" for k in range(1, FRAMES + 1)]
    camera = small_cameras(model)[6]
    found = drawn_from_ply(folder / "frame0007.ply", camera, NEAR_PLANE * 3)
    assert psnr(found, rendered(flat(model), camera, small_times()[6])) > 45
    (folder / "holiday.jpg").write_text("mine")
    with pytest.raises(InputError, match=r"holiday\.jpg"):
        export_scene(model, Scene(run / "scene"), "ply-sequence", folder, DEFAULT)


def test_splat_holds_32_bytes_a_gaussian_largest_first(tmp_path, run):
    model = small_model()
    path = export_scene(model, Scene(run / "scene"), "splat", tmp_path / "scene.splat", DEFAULT)
    records = np.fromfile(path, RECORD)
    still = still_at(model, (FIRST + LAST) / 2)
    assert RECORD.itemsize == 32
    assert len(records) == len(still.means)
    volume = records["scale"].prod(1) * records["color"][:, 3]
    assert volume[:50].mean() > volume[-50:].mean()
    nearest = np.abs(records["position"][:, None] - still.means.numpy()[None]).sum(2).argmin(1)
    assert sorted(nearest) == list(range(len(records)))
    np.testing.assert_allclose(records["scale"], np.exp(still.log_scales.numpy()[nearest]), rtol=1e-5)
    np.testing.assert_allclose(records["color"][:, 3] / 255, still.opacities.numpy()[nearest], atol=0.003)
    colors = np.clip(0.5 + C0 * still.sh[:, 0].numpy()[nearest], 0, 1)
    np.testing.assert_allclose(records["color"][:, :3] / 255, colors, atol=0.003)
    np.testing.assert_allclose((records["rotation"] - 128.0) / 128, still.quats.numpy()[nearest], atol=0.009)


def test_ply_tells_whose_a_gaussian_is(tmp_path):
    """As a property that a reader of others passes over; a scene without objects has none."""
    gsply = pytest.importorskip("gsply", reason="no independent reader of splats is installed: pip install gsply (extra dev)")
    model = small_model()
    small_run(tmp_path, model)
    scene, seconds = Scene(tmp_path / "scene"), small_times()[4]
    path = export_scene(model, scene, "ply", tmp_path / "scene.ply", ExportOptions(time=seconds))
    vertices = PlyData.read(path)["vertex"]
    expected = model.gaussians.object_ids[model.gaussians.active(model.clip_time(seconds)).rows]
    assert set(expected.tolist()) == {0, 1, 2}
    assert vertices["object_id"].tolist() == expected.tolist()
    found = gsply.plyread(path)
    np.testing.assert_array_equal(found.means[:, 0], vertices["x"])
    model.gaussians.object_ids[:] = 0
    plain = export_scene(model, scene, "ply", tmp_path / "plain.ply", ExportOptions(time=seconds))
    assert "object_id" not in {p.name for p in PlyData.read(plain)["vertex"].properties}


def test_ply_tells_what_the_clip_has_seen(tmp_path):
    model = small_model()
    small_run(tmp_path, model)
    scene, seconds = Scene(tmp_path / "scene"), small_times()[4]
    plain = export_scene(model, scene, "ply", tmp_path / "plain.ply", ExportOptions(time=seconds))
    assert not {"seen_frames", "seen_spread"} & {p.name for p in PlyData.read(plain)["vertex"].properties}
    known = with_seen(model, scene.cameras, small_times())
    size = EXPORTERS["ply"].estimate_bytes(known, scene, ExportOptions(time=seconds))
    path = export_scene(known, scene, "ply", tmp_path / "scene.ply", ExportOptions(time=seconds))
    vertices = PlyData.read(path)["vertex"]
    expected = known.gaussians.seen[known.gaussians.active(known.clip_time(seconds)).rows]
    np.testing.assert_array_equal(np.stack([vertices["seen_frames"], vertices["seen_spread"]], 1), expected)
    assert 0 <= path.stat().st_size - size < 2000
    tensors = load_file(export_scene(known, scene, "safetensors", tmp_path / "g.safetensors", DEFAULT))
    assert torch.equal(tensors["seen"], known.gaussians.seen)


def test_all_parameters_come_back_from_both_containers(tmp_path, run):
    model, scene = small_model(), Scene(run / "scene")
    npz = np.load(export_scene(model, scene, "npz", tmp_path / "g.npz", DEFAULT), allow_pickle=False)
    tensors = load_file(export_scene(model, scene, "safetensors", tmp_path / "g.safetensors", DEFAULT))
    about = json.loads(str(npz["about"]))
    arrays = {name: torch.from_numpy(npz[name]) for name in npz.files if name != "about"}
    assert set(arrays) == set(tensors)
    kept = {"dynamic": model.gaussians.dynamic, "object_ids": model.gaussians.object_ids}
    for name, value in {**model.gaussians.params, **kept}.items():
        assert torch.equal(arrays[name], value)
        assert torch.equal(tensors[name], value)
    dynamic, object_ids = arrays.pop("dynamic"), arrays.pop("object_ids")
    again = SceneModel(
        Gaussians4D(arrays, dynamic, ModelConfig(**about["model"]), about["sh_degree"], object_ids),
        Similarity.from_json(about["similarity"]), about["first"], about["last"], fill=False,
    )  # fmt: skip
    camera, seconds = five_pairs(model)[0]
    np.testing.assert_array_equal(again.render(camera, seconds).color, model.render(camera, seconds).color)


def test_cameras_come_back_from_colmap_and_nerfstudio(tmp_path, run):
    model, scene = small_model(), Scene(run / "scene")
    colmap, *_ = read_colmap(export_scene(model, scene, "colmap", tmp_path / "colmap", DEFAULT), scene)
    folder = export_scene(model, scene, "nerfstudio", tmp_path / "nerfstudio", DEFAULT)
    shots = read_camera_file(folder / "transforms.json", (WIDTH, HEIGHT), (FIRST, LAST)).shots
    assert [t for _, t in shots] == pytest.approx(small_times())
    for found in (colmap, [camera for camera, _ in shots]):
        for camera, other in zip(scene.cameras, found, strict=True):
            np.testing.assert_allclose(camera.viewmat, other.viewmat, atol=1e-9)
            np.testing.assert_allclose(camera.K, other.K)
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    images = [(folder / frame["file_path"]).resolve() for frame in frames]
    assert images[2] == (run / "scene" / "frames" / "00002.png").resolve()
    assert images[3] == (run / "scene" / "heldout" / "frames" / "00003.png").resolve()
    points = np.loadtxt(tmp_path / "colmap" / "points3D.txt")
    np.testing.assert_allclose(points[0, 1:4], still_at(model, FIRST).means[0], atol=1e-4)


def test_the_most_important_ones_are_better_than_random_and_than_large_opaque_ones():
    model = small_model(resting=1500, moving=700)
    views = list(zip(small_cameras(model), small_times(), strict=True))
    count = len(model.gaussians) // 2
    params = model.gaussians.params
    sizes = torch.sigmoid(params["logit_opacities"]) * params["log_scales"].sum(1).exp()
    choices = {
        "random": torch.randperm(len(sizes), generator=torch.Generator().manual_seed(0))[:count],
        "large": sizes.argsort(descending=True)[:count],
    }
    models = {name: replace(model, gaussians=model.gaussians.select(rows)) for name, rows in choices.items()}
    models["ours"] = choose_most_important(model, views, count)
    assert len(models["ours"].gaussians) == count
    beside = five_pairs(model)[3:]
    figures = {
        name: np.mean([psnr(rendered(kept, *pair), rendered(model, *pair)) for pair in beside]) for name, kept in models.items()
    }
    assert figures["ours"] > max(figures["random"], figures["large"]) + 1, figures
    assert choose_most_important(model, views, 10**6) is model


@pytest.mark.parametrize("to", ["html", "ply", "splat", "spz", "npz", "safetensors"])
def test_the_estimate_is_near_the_size(tmp_path, run, to):
    model, scene = small_model(resting=8000, moving=8000), Scene(run / "scene")
    path = export_scene(model, scene, to, tmp_path / f"out.{to}", DEFAULT)
    assert 0.5 < EXPORTERS[to].estimate_bytes(model, scene, DEFAULT) / path.stat().st_size < 2


@pytest.mark.parametrize(("config", "options"), [(OURS, {}), (LINEAR, {}), (OURS, {"rotation": TURNED}), (OURS, {"moving": 1})])
def test_spz_shows_the_scene_at_its_time(tmp_path, config, options):
    model = small_model(config, **options)
    small_run(tmp_path, model)
    for camera, seconds in five_pairs(model)[2:4]:
        path = export_scene(model, Scene(tmp_path / "scene"), "spz", tmp_path / "scene.spz", ExportOptions(time=seconds))
        found = drawn_from_spz(path, flipped(camera), NEAR_PLANE / model.similarity.scale)
        assert psnr(found, rendered(flat(model), camera, seconds)) > 45


def test_spz_keeps_far_places_and_takes_fewer_bits_for_them(tmp_path):
    gsply = pytest.importorskip("gsply", reason="no independent reader of spz is installed: pip install gsply (extra dev)")
    still = still_at(small_model(), FIRST, flip_axes=True)
    for size, step in ((1.0, 2**-16), (1000.0, 2**-12), (1e6, 2**-2)):
        far = replace(still, means=still.means * size / still.means.abs().max())
        write_spz(tmp_path / "far.spz", far)
        assert np.abs(gsply.read_spz(tmp_path / "far.spz").means - far.means.numpy()).max() <= 0.51 * step + 1e-6 * size


def export(capsys, *arguments: object) -> tuple[int, str]:
    code = 0
    try:
        main(["export", *map(str, arguments)])
    except SystemExit as end:
        code = int(end.code or 0)
    return code, capsys.readouterr().err.strip().splitlines()[-1]


@pytest.mark.parametrize("to", EXPORTERS.names())
def test_the_command_writes_every_format_into_the_run(capsys, run, to):
    code, line = export(capsys, run, "--to", to)
    assert code == 0
    written = Path(line.removeprefix("Written: "))
    assert written.parent == run / "export"
    assert written.exists()
    assert not list(run.rglob("*partial*"))


def test_the_command_keeps_as_many_as_it_is_told(capsys, tmp_path, run):
    assert export(capsys, run, "--to", "ply", "--max-gaussians", 50, "-o", tmp_path / "a.ply")[0] == 0
    assert 0 < len(PlyData.read(tmp_path / "a.ply")["vertex"]) <= 50


def test_a_crop_is_what_lies_in_its_box(capsys, tmp_path, run):
    """In the coordinates of the cameras, which are those of the file."""
    model = flowsplat.load(run)
    bounds = compute_bounds(model)
    middle = (bounds.low[0] + bounds.high[0]) / 2
    box = str(replace(bounds, high=(middle, *bounds.high[1:]), low=tuple(value - 1 for value in bounds.low)))
    code, line = export(capsys, run, "--to", "npz", f"--crop={box}", "-o", tmp_path / "a.npz")
    assert code == 0, line
    kept = len(np.load(tmp_path / "a.npz")["means"])
    assert kept == len(crop(model, parse_crop(box)).gaussians)
    assert 0 < kept < len(model.gaussians)


@pytest.mark.parametrize("to", ["html", "splat", "npz"])
def test_the_file_is_no_larger_than_it_may_be_and_hardly_smaller(tmp_path, run, to):
    model, scene = small_model(resting=4000, moving=3000), Scene(run / "scene")
    whole = export_scene(model, scene, to, tmp_path / f"whole.{to}", DEFAULT).stat().st_size
    most = 0.6 * whole
    path = export_scene(model, scene, to, tmp_path / f"out.{to}", ExportOptions(size_mb=most / 1e6))
    assert 0.8 * most < path.stat().st_size <= most
    same = export_scene(model, scene, to, tmp_path / f"same.{to}", ExportOptions(size_mb=whole / 1e6))
    assert same.stat().st_size == whole


def test_how_far_a_page_may_be_pulled_is_measured_once(tmp_path, run, monkeypatch):
    from flowsplat.output.videos import amplitudes

    measured: list[int] = []
    real = amplitudes.loop_widths
    monkeypatch.setattr(amplitudes, "loop_widths", lambda model, scene: measured.append(len(model.gaussians)) or real(model, scene))
    model, scene = small_model(resting=4000, moving=3000), Scene(run / "scene")
    export_scene(model, scene, "html", tmp_path / "small.html", ExportOptions(size_mb=0.25))
    assert measured == [7000]


def test_a_page_that_cannot_be_that_small_is_not_written(capsys, tmp_path, run):
    (tmp_path / "a.html").write_text("the page of before")
    code, line = export(capsys, run, "--to", "html", "--size-mb", "0.01", "-o", tmp_path / "a.html")
    assert code == 2
    assert "--size-mb 0.01 is too little: beside Gaussians there are " in line
    assert (tmp_path / "a.html").read_text() == "the page of before"


def test_what_the_page_holds_and_how_to_embed_it_is_told(capsys, run):
    main(["export", str(run), "--to", "html", "--embed"])
    *_, holds, embed, written = capsys.readouterr().err.strip().splitlines()
    assert "no frame, no sound" in holds
    assert embed.startswith('<iframe src="player.html#embed"')
    text = Path(written.removeprefix("Written: ")).read_text(encoding="utf-8")
    assert not any(element in text for element in ("<audio", "<video"))
    assert str(run) not in text


def test_what_a_page_of_shots_holds_is_told_once(capsys, tmp_path, run):
    model, scene = small_model(), Scene(run / "scene")
    shots = [("1", model, scene), ("2", model, scene)]
    export_sequence(shots, tmp_path / "all.html", "clip", ExportOptions(embed=True))
    told = capsys.readouterr().err
    assert told.count("no frame, no sound") == 1
    assert told.count("<iframe ") == 1


def test_python_tells_how_to_embed_a_page(capsys, run):
    (run / "run.json").write_text("{}")
    flowsplat.export(run, "html", embed=True)
    assert '<iframe src="player.html#embed"' in capsys.readouterr().err
    with pytest.raises(InputError, match="--embed is for html"):
        flowsplat.export(run, "ply", embed=True)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--to", "obj"], "obj"),
        (["--to", "ply", "--time", "9"], "outside the clip"),
        (["--to", "html", "--time", "1"], "--time is for ply"),
        (["--to", "npz", "--flip-axes"], "--flip-axes is for"),
        (["--to", "spz", "--flip-axes"], "not for spz"),
        (["--to", "ply", "--embed"], "--embed is for html, not for ply"),
        (["--to", "ply", "--max-gaussians", "0"], "at least 1"),
        (["--to", "ply", "--size-mb", "0"], "more than 0"),
        (["--to", "ply", "--crop=1,2"], "--crop 1,2 cannot be understood"),
        (["--to", "npz", "--crop=90,90,90,91,91,91"], "holds nothing of the scene"),
        (["--to", "colmap", "--crop=-9,-9,-9,9,9,9"], "--crop is for Gaussians: colmap has none"),
        (["--to", "ply", "--size-mb", "nan"], "more than 0"),
        (["--to", "ply-sequence", "--size-mb", "5"], "ply-sequence has a folder"),
        (["--to", "colmap", "--size-mb", "5"], "colmap has none"),
        (["--to", "ply", "-o", "{folder}"], "is a folder"),
        (["--to", "colmap", "-o", "{file}"], "is a file"),
        (["--to", "ply", "-o", "{file}/scene.ply"], "is a file"),
    ],
)
def test_what_cannot_be_exported_is_said_in_one_line(capsys, tmp_path, run, arguments, words):
    (tmp_path / "file").write_text("x")
    places = {"folder": tmp_path, "file": tmp_path / "file"}
    code, line = export(capsys, run, *(argument.format(**places) for argument in arguments))
    assert code == 2
    assert line.startswith("Error: ")
    assert words in line


@pytest.mark.parametrize("to", EXPORTERS.names())
def test_a_run_that_is_still_training_is_refused(capsys, tmp_path, to):
    code, line = export(capsys, tiny_run(tmp_path / "out", trained=False), "--to", to)
    assert code == 2
    assert "no trained scene yet" in line


def test_a_folder_that_may_not_be_written_is_named(tmp_path, run, monkeypatch):
    def refuse(self: Path, *_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    model, scene = small_model(), Scene(run / "scene")
    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(InputError, match="No permission to write"):
        export_scene(model, scene, "ply", tmp_path / "locked" / "scene.ply", DEFAULT)


@pytest.mark.parametrize(("resting", "moving"), [(0, 1), (40, 0), (40, 1)])
def test_a_scene_with_hardly_anything_that_moves_can_be_exported(tmp_path, run, resting, moving):
    model = SceneModel(small_gaussians(OURS, resting=resting, moving=moving), Similarity(), FIRST, LAST)
    for to in EXPORTERS.names():
        export_scene(model, Scene(run / "scene"), to, tmp_path / f"x.{to}", DEFAULT)


@pytest.mark.parametrize("to", [name for name in EXPORTERS.names() if EXPORTERS[name].has_gaussians])
def test_a_file_that_would_show_nothing_is_refused(tmp_path, run, to):
    model, scene = small_model(resting=0), Scene(run / "scene")
    params, path = model.gaussians.params, tmp_path / f"x.{to}"
    params["times"][:], params["log_lambdas"][:] = 0.1, 8.0
    if EXPORTERS[to].is_of_one_time:
        with pytest.raises(InputError, match=r"No Gaussian is there at 1\.5 s: give another --time"):
            export_scene(model, scene, to, path, DEFAULT)
    params["times"][:] = 9
    with pytest.raises(InputError, match="at any time of the clip"):
        export_scene(model, scene, to, path, DEFAULT)
    assert not path.exists()


@pytest.mark.parametrize("to", ["html", "spz", "4dgs"])
def test_what_is_far_away_costs_the_others_nothing(tmp_path, run, capsys, to):
    """One that rests and one that moves, both far beyond what the scene spans."""
    model, scene, path = small_model(), Scene(run / "scene"), tmp_path / f"x.{to}"
    far = replace(model, gaussians=model.gaussians.select(torch.cat([torch.arange(len(model.gaussians)), torch.tensor([7, 407])])))
    far.gaussians.params["means"][-2:] = torch.tensor([3e8, -2e8, -1e8])
    plain = export_scene(model, scene, to, tmp_path / f"plain.{to}", DEFAULT)
    capsys.readouterr()
    export_scene(far, scene, to, path, DEFAULT)
    told = capsys.readouterr().err
    assert told.count(f"{to} cannot hold Gaussians beyond 1,000 times the median depth: 1 at rest are shown nearer") == 1
    assert "1 that move, or could, are left out" in told
    assert path.stat().st_size < 1.1 * plain.stat().st_size
    camera, seconds = small_cameras(model)[4], small_times()[4]
    images = [shown_by(each, model, camera, seconds) for each in (path, plain)]
    assert psnr(*images) > 45


def shown_by(path: Path, model: SceneModel, camera: Camera, seconds: float) -> np.ndarray:
    """What the file's own reader draws."""
    if path.suffix == ".html":
        return draw_page(read_page(path), model.similarity.camera(camera), seconds).numpy()
    if path.suffix == ".spz":
        return drawn_from_spz(path, flipped(camera), NEAR_PLANE / model.similarity.scale)
    fourdgs = pytest.importorskip("fourdgs", reason="no reader of 4dgs is installed: pip install fourdgs")
    scene = fourdgs.read(path)
    state, found = scene.state_at(seconds - FIRST), scene.gaussians
    rows = state["indices"]
    sh = torch.from_numpy((found.colors[rows, None, :3].astype(np.float64) - 0.5) / C0)
    return drawn(
        torch.from_numpy(state["centers"]), torch.from_numpy(state["orientations"]).roll(1, 1),
        torch.from_numpy(found.scales[rows].astype(np.float64)).log(),
        torch.logit(torch.from_numpy(state["opacity"]).double().clamp(1e-6, 1 - 1e-6)), sh, flipped(camera),
        NEAR_PLANE / model.similarity.scale,
    )  # fmt: skip
