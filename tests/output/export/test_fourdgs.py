"""The export to 4dgs, read by the package of those who made the format, and drawn by our rasterizer."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch

from flowsplat.cli import main
from flowsplat.gaussians.gaussians4d import NEAR_PLANE
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import OPENGL
from flowsplat.geometry.paths import CameraPath
from flowsplat.images.sound import keep_sound
from flowsplat.output.export import ExportOptions, export_scene
from flowsplat.output.export.formats import EXPORTERS
from flowsplat.output.export.still import Still, still_at
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
    OTHERS,
    OURS,
    PAPER,
    WIDTH,
    flat,
    psnr,
    rendered,
    small_cameras,
    small_model,
    small_run,
    small_times,
)

fourdgs = pytest.importorskip("fourdgs", reason="no reader of 4dgs is installed: pip install fourdgs")
validation = pytest.importorskip("fourdgs.validate")

TURNED = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])
STEADY = replace(OURS, gains=0)
BETWEEN = [FIRST, 0.61, 0.875, 1.0, 1.31, 1.667, 2.03, 2.25, 2.49, LAST]
"""Seconds at frames and between them."""
DURATION = (LAST - FIRST) * FRAMES / (FRAMES - 1)


def exported(folder: Path, model: SceneModel, **options: Any) -> Path:
    small_run(folder, model)
    return export_scene(model, Scene(folder / "scene"), "4dgs", folder / "scene.4dgs", ExportOptions(**options))


def camera_at(model: SceneModel, seconds: float) -> Camera:
    return CameraPath(small_times(), small_cameras(model)).at(seconds)


def drawn(scene: Any, model: SceneModel, seconds: float, camera: Camera | None = None) -> np.ndarray:
    """[H, W, 3] what a reader has at a time of the clip, drawn by the oracle."""
    found, inside = scene.gaussians, turned(camera_at(model, seconds) if camera is None else camera)
    state = scene.state_at(seconds - FIRST)
    rows = state["indices"]
    sh = torch.from_numpy((found.colors[rows, None, :3].astype(np.float64) - 0.5) / C0)
    if found.sh is not None:
        rest = fourdgs.quantization.sh_coefficient(found.sh[rows]).reshape(len(rows), 3, -1)
        sh = torch.cat([sh, torch.from_numpy(rest).transpose(1, 2)], 1)
    means = torch.from_numpy(state["centers"])
    colors = colors_from_harmonics(sh, means - torch.as_tensor(inside.center), found.sh_degree)
    return rasterize(
        means, torch.from_numpy(state["orientations"]).roll(1, 1), torch.from_numpy(found.scales[rows].astype(np.float64)),
        torch.from_numpy(state["opacity"]), colors, *inside.tensors(torch.float64), WIDTH, HEIGHT,
        near_plane=NEAR_PLANE / model.similarity.scale, backend="reference",
    )[0].numpy()  # fmt: skip


def turned(camera: Camera) -> Camera:
    """The camera in a world with y up and z backward."""
    return Camera(camera.viewmat @ OPENGL, camera.K, camera.width, camera.height)


def pixels_off(scene: Any, model: SceneModel, seconds: float) -> tuple[np.ndarray, np.ndarray, Still]:
    """[A] how far the centers of ours are from those that a reader has, in pixels, each next to its own; which of these [A] that
    is, and ours. What has next to no presence may be there or not and is left out."""
    state = scene.state_at(seconds - FIRST)
    sure = model.gaussians.select(torch.nonzero(model.gaussians.presence(model.clip_time(seconds)) > 0.052).squeeze(1))
    still = still_at(replace(model, gaussians=sure), seconds, flip_axes=True)
    own = still.means.double().numpy()
    # Neighbors that are side by side differ in their other values.
    beside = np.abs(own[:, None] - state["centers"][None]).max(2)
    beside += 0.05 * np.abs(still.opacities.numpy()[:, None] - state["opacity"][None])
    beside += 0.05 * np.abs(still.log_scales.exp().numpy()[:, None] - scene.gaussians.scales[state["indices"]][None]).max(2)
    nearest = beside.argmin(1)
    assert len(set(nearest.tolist())) == len(own), "each of ours has one of its own"
    camera = turned(camera_at(model, seconds))
    (ours, depth), (theirs, _) = camera.project(own), camera.project(state["centers"][nearest])
    is_seen = (depth > 0) & ((ours >= 0) & (ours < [WIDTH, HEIGHT])).all(1)
    return np.linalg.norm(ours - theirs, axis=1)[is_seen], nearest, still


@pytest.mark.parametrize(
    ("config", "options"),
    [(OURS, {}), (PAPER, {}), (LINEAR, {}), (OURS, {"rotation": TURNED}), (OTHERS["splines"], {}), (OTHERS["hexplane"], {})],
    ids=["ours", "paper", "linear", "turned", "splines", "hexplane"],
)
def test_centers_are_within_a_tenth_of_a_pixel_also_between_frames(tmp_path, config, options):
    model = flat(small_model(config, **options))
    scene = fourdgs.read(exported(tmp_path, model))
    for seconds in BETWEEN:
        off, _, _ = pixels_off(scene, model, seconds)
        assert len(off) > 10
        assert off.max() < 0.1


@pytest.mark.parametrize(
    ("config", "options", "least"),
    [(OURS, {}, 47), (STEADY, {}, 50), (PAPER, {}, 49), (LINEAR, {}, 55), (STEADY, {"rotation": TURNED}, 50)],
    ids=["ours", "steady", "paper", "linear", "turned"],
)
def test_what_a_reader_has_looks_like_ours_along_the_path(tmp_path, config, options, least):
    model = flat(small_model(config, **options))
    scene = fourdgs.read(exported(tmp_path, model))
    for seconds in BETWEEN:
        assert psnr(drawn(scene, model, seconds), rendered(model, camera_at(model, seconds), seconds)) > least


@pytest.mark.parametrize("config", [OURS, PAPER, LINEAR], ids=["ours", "paper", "linear"])
def test_as_many_are_there_as_in_the_sequence_of_ply(tmp_path, config):
    model = flat(small_model(config))
    scene = fourdgs.read(exported(tmp_path, model))
    for seconds in BETWEEN:
        assert abs(len(scene.state_at(seconds - FIRST)["indices"]) - model.active_count(seconds)) <= 2


@pytest.mark.parametrize("config", [OURS, PAPER, LINEAR], ids=["ours", "paper", "linear"])
def test_it_keeps_the_rules_of_the_format(tmp_path, config):
    path = exported(tmp_path, flat(small_model(config)))
    report = validation.validate(path.read_bytes())
    assert not report.findings
    scene = fourdgs.read(path, recover_truncated=False)
    assert scene.summary_crc_ok
    assert not scene.skipped_opcodes
    assert scene.duration_sec == pytest.approx(DURATION)
    assert scene.gaussians.count == scene.header.gaussian_count == scene.statistics.gaussian_count
    assert scene.header.cutoff == config.p_min
    (frame,) = scene.provenance.frames
    assert (frame.handedness, frame.up_axis, frame.forward_axis) == (1, 1, 5)


def test_rounding_keeps_the_bounds_that_the_file_declares(tmp_path):
    """Of what is not cut: positions and shapes at rest."""
    model = flat(small_model(STEADY))
    scene = fourdgs.read(exported(tmp_path, model))
    bounds = {name: float(text) for name, text in scene.quantization.bounds.items()}
    assert set(bounds) == {"pos", "scale_rel", "rot", "rgb", "alpha", "motion", "time", "sigma_rel", "sh"}
    still = still_at(replace(model, gaussians=model.gaussians.select(torch.arange(400))), FIRST, flip_axes=True)
    found = scene.gaussians
    rests = np.nonzero((found.motions == 0).all(1) & np.isinf(found.sigma_t))[0]
    nearest = rests[np.abs(still.means.numpy()[:, None] - found.positions[None, rests]).max(2).argmin(1)]
    assert np.abs(found.positions[nearest] - still.means.numpy()).max() <= bounds["pos"] + 1e-6
    assert np.abs(np.log(found.scales[nearest]) - still.log_scales.numpy()).max() <= np.log1p(bounds["scale_rel"]) + 1e-6
    assert np.abs(found.colors[nearest, 3] - still.opacities.numpy()).max() <= bounds["alpha"] + 1e-6
    quats = np.roll(still.quats.numpy(), -1, axis=1)
    assert np.abs((found.rotations[nearest] * quats).sum(1)).min() > 1 - 10 * bounds["rot"] ** 2


def test_every_gaussian_keeps_its_object(tmp_path):
    model = flat(small_model(STEADY))
    scene = fourdgs.read(exported(tmp_path, model))
    for seconds in BETWEEN:
        _, nearest, still = pixels_off(scene, model, seconds)
        np.testing.assert_array_equal(scene.state_at(seconds - FIRST)["object_id"][nearest], still.object_ids)
    assert [entry.object_id for entry in scene.objects.table.entries] == [1, 2]
    for entry in scene.objects.table.entries:
        own = scene.gaussians.positions[scene.gaussians.object_id == entry.object_id]
        assert (own.min(0) <= entry.anchor).all()
        assert (entry.anchor <= own.max(0)).all()
    assert not scene.objects.tracks


def test_a_scene_without_objects_has_none(tmp_path):
    model = flat(small_model(STEADY))
    model.gaussians.object_ids[:] = 0
    scene = fourdgs.read(exported(tmp_path, model))
    assert scene.gaussians.object_id is None
    assert scene.objects.table is None


def test_what_rests_is_there_once(tmp_path):
    model = flat(small_model(STEADY, moving=0))
    found = fourdgs.read(exported(tmp_path, model)).gaussians
    assert found.count == len(model.gaussians) == 400
    assert (found.win_lo == 0).all()
    assert found.win_hi == pytest.approx(DURATION)
    assert np.isinf(found.sigma_t).all()
    assert not found.motions.any()


def test_what_moves_on_a_line_is_one_piece(tmp_path):
    model = flat(small_model(LINEAR))
    assert fourdgs.read(exported(tmp_path, model)).gaussians.count <= len(model.gaussians)


def test_brightness_changes_with_time(tmp_path):
    """In steps that are as small as is said."""
    model = flat(small_model(replace(OURS, sh_degree=0), moving=0))
    model.gaussians.params["log_gains"] *= 0.15  # as it is, it changes by more within the shortest time of a piece
    scene = fourdgs.read(exported(tmp_path, model))
    changes = 0.0
    for seconds in BETWEEN:
        _, nearest, still = pixels_off(scene, model, seconds)
        colors = scene.gaussians.colors[scene.state_at(seconds - FIRST)["indices"][nearest], :3]
        own = (C0 * still.sh[:, 0] + 0.5).clamp(0, 1).numpy()
        # What is brighter than can be stored may be off by more, and what is hardly opaque by as much as shows as little.
        unclipped = ((own > 0.01) & (own < 0.99)).all(1)
        allowed = 0.006 / still.opacities.numpy()[unclipped, None] + 0.003
        assert (np.abs(colors - own)[unclipped] <= allowed).all()
        changes = max(changes, float(np.abs(own - still_at(model, FIRST).colors.numpy()).max()))
    assert changes > 0.02


def test_colors_that_cannot_be_stored_look_right_along_the_path(tmp_path):
    """Their constant part is beyond 1 or below 0: harmonics of degree 1 make up for it."""
    model = flat(small_model(STEADY))
    model.gaussians.params["sh"][:, 0] *= 2
    assert (still_at(model, FIRST).sh[:, 0] * C0 + 0.5 > 1.2).any()
    scene = fourdgs.read(exported(tmp_path, model))
    for seconds in BETWEEN[::3]:
        assert psnr(drawn(scene, model, seconds), rendered(model, camera_at(model, seconds), seconds)) > 45


def test_chunks_hold_what_their_time_needs(tmp_path, monkeypatch):
    from fourdgs.indexed_reader import open_indexed, read_chunk
    from fourdgs.readable import BytesReadable

    from flowsplat.output.export.fourdgs import writing

    monkeypatch.setattr(writing, "MIN_CHUNK_TICKS", 16)
    monkeypatch.setattr(writing, "MIN_CHUNK_PIECES", 40)
    model = flat(small_model(PAPER))
    path = exported(tmp_path, model)
    assert not validation.validate(path.read_bytes()).findings
    whole, source = fourdgs.read(path), BytesReadable(path.read_bytes())
    indexed = open_indexed(source)
    assert len(whole.chunk_index) > 4
    for seconds in BETWEEN:
        entries = indexed.chunks_for_time(seconds - FIRST)
        assert len(entries) < len(whole.chunk_index)
        centers = []
        for entry in entries:
            part = read_chunk(source, indexed, entry, max_sh_band=3)
            windows = np.array(indexed.windows)[part["window_index"]]
            since = seconds - FIRST - part["mu_t"]
            presence = np.exp(-0.5 * (since / part["sigma_t"]) ** 2)
            there = (windows[:, 0] <= seconds - FIRST) & (seconds - FIRST < windows[:, 1]) & (presence >= whole.header.cutoff)
            centers.append((part["positions"] + part["motions"] * since[:, None])[there])
        np.testing.assert_allclose(
            np.sort(np.concatenate(centers), 0), np.sort(whole.state_at(seconds - FIRST)["centers"], 0), atol=1e-5
        )


def test_its_camera_moves_as_that_of_the_clip(tmp_path):
    model = flat(small_model(rotation=TURNED))
    scene = fourdgs.read(exported(tmp_path, model))
    (sensor,) = scene.provenance.sensors
    assert (sensor.width_px, sensor.height_px) == (WIDTH, HEIGHT)
    points = still_at(model, 1.5, flip_axes=True).means.double().numpy()[::20]
    for seconds in BETWEEN:
        pose = scene.provenance.sensor_pose_at("camera", seconds - FIRST)
        axes = np.stack([pose.apply(axis) for axis in np.eye(3)]) - pose.translation
        seen = (points - pose.translation) @ axes.T
        pixels = seen[:, :2] / seen[:, 2:] * [sensor.fx, sensor.fy] + [sensor.cx, sensor.cy]
        expected, depth = turned(camera_at(model, seconds)).project(points)
        assert (depth > 0).all()
        np.testing.assert_allclose(pixels, expected, atol=0.02)
    camera = scene.camera
    assert camera.fov_y_deg == pytest.approx(np.degrees(2 * np.arctan(32 / 82)))
    assert (camera.interpolation, camera.loop) == ("linear", False)
    middle = turned(camera_at(model, camera.times[9] + FIRST))
    np.testing.assert_allclose(camera.positions[9], middle.center, atol=1e-6)
    np.testing.assert_allclose(middle.project(np.array(camera.targets[9]))[0], middle.K[:2, 2], atol=1e-6)
    assert camera.times[-1] == pytest.approx(LAST - FIRST)


def test_that_its_camera_does_not_zoom_is_told(tmp_path, capsys):
    model = flat(small_model(STEADY))
    exported(tmp_path, model)
    assert "does not zoom" not in capsys.readouterr().err
    cameras = [replace(camera, K=camera.K * [[1 + 0.02 * k], [1 + 0.02 * k], [1]]) for k, camera in enumerate(small_cameras(model))]
    Scene(tmp_path / "scene").write_cameras(cameras)
    path = export_scene(model, Scene(tmp_path / "scene"), "4dgs", tmp_path / "zoom.4dgs", ExportOptions())
    assert "its camera does not zoom as the clip's does" in capsys.readouterr().err
    assert fourdgs.read(path).provenance.sensors[0].fx == pytest.approx(80)


def add_sound(folder: Path) -> np.ndarray:
    """Give a scene a tone that begins half a second before its first frame; return what is heard, at 48000 samples a second."""
    wave = 0.3 * np.sin(np.arange(48000 * 4) * (2 * np.pi * 440 / 48000))
    wave[: 48000 // 2] = 0
    with av.open(str(folder / "tone.wav"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=48000)
        stream.layout = "mono"
        frame = av.AudioFrame.from_ndarray((32767 * wave).astype(np.int16)[None], format="s16", layout="mono")
        frame.sample_rate = 48000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert keep_sound(folder / "tone.wav", 0.5, DURATION, folder / "scene" / "sound.flac")
    Scene(folder / "scene").mark_ingested("sound.flac")
    return wave[48000 // 2 :]


def test_the_sound_of_the_clip_is_in_it(tmp_path, capsys):
    model = flat(small_model(STEADY))
    small_run(tmp_path, model)
    heard = add_sound(tmp_path)
    path = export_scene(model, Scene(tmp_path / "scene"), "4dgs", tmp_path / "scene.4dgs", ExportOptions())
    assert "with sound" in capsys.readouterr().err
    assert not validation.validate(path.read_bytes()).findings
    (source,) = fourdgs.read(path).audio_sources
    assert (source.codec, source.channel_layout, source.spatial, source.start_sec) == ("opus", "mono", False, 0)
    assert source.duration_sec == pytest.approx(DURATION, abs=0.01)
    with av.open(io.BytesIO(source.data)) as container:
        assert container.streams.audio[0].codec_context.name in ("opus", "libopus")
        resampler = av.AudioResampler("fltp", "mono", 48000)
        samples = np.concatenate(
            [part.to_ndarray()[0] for frame in container.decode(audio=0) for part in resampler.resample(frame)]
        )
    assert len(samples) / 48000 == pytest.approx(DURATION, abs=0.03)
    middle = slice(48000 // 2, 48000)
    assert np.corrcoef(samples[middle], heard[middle])[0, 1] > 0.95, "nothing is early or late"


def test_the_sound_can_be_left_out(tmp_path, capsys):
    model = flat(small_model(STEADY))
    small_run(tmp_path, model)
    add_sound(tmp_path)
    path = export_scene(model, Scene(tmp_path / "scene"), "4dgs", tmp_path / "scene.4dgs", ExportOptions(sound=False))
    assert "without sound" in capsys.readouterr().err
    scene = fourdgs.read(path)
    assert not scene.audio_sources
    assert not scene.header.has_audio


def test_sound_that_cannot_be_read_costs_no_scene(tmp_path, capsys):
    model = flat(small_model(STEADY))
    small_run(tmp_path, model)
    (tmp_path / "scene" / "sound.flac").write_bytes(b"fLaC" + bytes(100))
    Scene(tmp_path / "scene").mark_ingested("sound.flac")
    path = export_scene(model, Scene(tmp_path / "scene"), "4dgs", tmp_path / "scene.4dgs", ExportOptions())
    assert "without sound" in capsys.readouterr().err
    assert fourdgs.read(path).gaussians.count


def test_how_many_it_became_and_how_far_off_they_are_is_told(tmp_path, capsys):
    model = flat(small_model(STEADY))
    path = exported(tmp_path, model)
    told = " ".join(capsys.readouterr().err.split())
    count, pieces, off = re.search(r"4dgs: ([\d,]+) Gaussians became ([\d,]+) that .* by at most ([\d.]+) px", told).groups()
    scene = fourdgs.read(path)
    assert int(count.replace(",", "")) == len(model.gaussians)
    assert int(pieces.replace(",", "")) == scene.gaussians.count
    measured = max(pixels_off(scene, model, seconds)[0].max() for seconds in np.linspace(FIRST, LAST, 25))
    assert 0.7 * float(off) < measured < float(off) + 0.01
    assert float(off) < 0.1


def test_the_same_scene_gives_the_same_bytes(tmp_path):
    model = flat(small_model())
    small_run(tmp_path, model)
    add_sound(tmp_path)
    first, second = (
        export_scene(model, Scene(tmp_path / "scene"), "4dgs", tmp_path / name, ExportOptions()).read_bytes() for name in "ab"
    )
    assert first == second


@pytest.mark.parametrize("config", [OURS, STEADY, PAPER, LINEAR], ids=["ours", "steady", "paper", "linear"])
def test_the_estimate_is_near_the_size(tmp_path, config):
    model = flat(small_model(config, resting=1500, moving=1000))
    path = exported(tmp_path, model)
    estimate = EXPORTERS["4dgs"].estimate_bytes(model, Scene(tmp_path / "scene"), ExportOptions())
    assert 0.5 < estimate / path.stat().st_size < 2


@pytest.mark.parametrize("clip_lengths", [3e4, 1e6])
def test_what_is_most_present_long_before_the_clip_is_there(tmp_path, clip_lengths):
    """So wide that its presence in the clip is that at one deviation from the middle of it."""
    model = flat(small_model(STEADY, moving=2))
    params, row = model.gaussians.params, 401
    params["times"][row], params["log_lambdas"][row] = -clip_lengths, -2 * np.log(clip_lengths)
    for name in ("mean_poly", "mean_cos", "mean_sin", "quat_poly"):
        params[name][row] = 0
    scene = fourdgs.read(exported(tmp_path, model))
    for seconds in BETWEEN:
        still, state = still_at(model, seconds, flip_axes=True), scene.state_at(seconds - FIRST)
        at = np.abs(state["centers"] - still.means[-1].numpy()).sum(1).argmin()
        assert float(state["opacity"][at]) == pytest.approx(float(still.opacities[-1]), abs=0.01)


def test_the_command_writes_it(tmp_path, capsys):
    run = small_run(tmp_path / "run", small_model(STEADY))
    main(["export", str(run), "--to", "4dgs", "-o", str(tmp_path / "all.4dgs")])
    told = capsys.readouterr().err
    assert "how brightness varies inside is left out" in told
    assert f"Written: {tmp_path / 'all.4dgs'}" in told
    whole = fourdgs.read(tmp_path / "all.4dgs")
    main(["export", str(run), "--to", "4dgs", "--max-gaussians", "50", "-o", str(tmp_path / "few.4dgs")])
    assert "4dgs: 50 Gaussians became" in capsys.readouterr().err
    most = (tmp_path / "all.4dgs").stat().st_size / 2
    main(["export", str(run), "--to", "4dgs", "--size-mb", str(most / 1e6), "-o", str(tmp_path / "small.4dgs")])
    assert (tmp_path / "small.4dgs").stat().st_size <= most
    assert capsys.readouterr().err.count("that move on straight lines") == 1
    main(["export", str(run), "--to", "4dgs", "--crop=-9,-9,-9,0,9,9", "-o", str(tmp_path / "left.4dgs")])
    left = fourdgs.read(tmp_path / "left.4dgs").gaussians
    assert 0 < left.count < whole.gaussians.count
    rests = ~left.motions.any(1)
    assert left.positions[rests, 0].max() < 0.01


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--to", "4dgs", "--time", "1"], "4dgs is not of one time"),
        (["--to", "4dgs", "--flip-axes"], "not for 4dgs"),
        (["--to", "ply", "--no-sound"], "--no-sound is for 4dgs: ply never holds sound"),
        (["--to", "4dgs", "-o", "{folder}"], "is a folder, 4dgs is one file"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(capsys, tmp_path, arguments, words):
    run = small_run(tmp_path / "run", small_model())
    with pytest.raises(SystemExit) as end:
        main(["export", str(run), *(argument.format(folder=tmp_path) for argument in arguments)])
    assert end.value.code == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("Error: ")
    assert words in line
    assert not (run / "export").exists()
