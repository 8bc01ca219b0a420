"""Every reader of files from outside, each with small files that it can read."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.common.files import write_json
from flowsplat.images.sound import keep_sound
from flowsplat.images.video import mp4_writer
from flowsplat.output.camera_files import read_camera_file, write_camera_file
from flowsplat.output.export import ExportOptions, export_scene
from flowsplat.output.export.formats.ply import write_ply
from flowsplat.output.export.formats.splat import write_splat
from flowsplat.output.export.formats.spz import write_spz
from flowsplat.output.page_reader import read_page
from flowsplat.output.report import write_report
from flowsplat.output.splat_files import is_splat_file, read_splats
from flowsplat.output.tracks import read_queries
from flowsplat.output.viewer.messages import Gate
from flowsplat.pipeline.config import RunConfig, check
from flowsplat.pipeline.describe import describe
from flowsplat.pipeline.folder import RunFolder
from flowsplat.pipeline.shot_list import read_shots
from flowsplat.pipeline.splat_file import make_cameras, make_model
from flowsplat.pipeline.stages import read_history, read_metrics
from flowsplat.pipeline.summary import figures_table, report_data
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.given.cameras import read_cameras
from flowsplat.priors.given.depth import open_depth
from flowsplat.priors.given.fitting import Placement
from flowsplat.priors.given.flow import read_flow
from flowsplat.priors.given.tracks import read_tracks
from flowsplat.priors.given.truth import consecutive_pairs
from flowsplat.priors.objects import load_objects
from flowsplat.priors.objects.distance import Cue
from flowsplat.priors.objects.shape_offset import ShapePoints
from flowsplat.priors.objects.solving import DynamicObject
from flowsplat.priors.objects.storage import SceneObjects, save_objects
from flowsplat.priors.prepare import use_given, use_truth
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.ingest import ingest, open_clip
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from flowsplat.studio.choices import first_choices
from flowsplat.studio.project import Project
from flowsplat.studio.results import describe as describe_project
from flowsplat.studio.standing import StandingReader
from flowsplat.studio.tasks import Tasks
from flowsplat.training.checkpoint import load_checkpoint, load_model, save_model
from flowsplat.training.config import TrainConfig
from flowsplat.training.trainer import Trainer
from flowsplat_benchmarks.datasets.dycheck import read_keypoints
from tests.output.small import OTHERS, small_cameras, small_model, small_player
from tests.output.splat_files.test_reading import make_still
from tests.priors.given import test_camera_files as cameras_of_others
from tests.priors.given import test_feedforward_files as networks
from tests.priors.given import test_map_files as maps_of_others
from tests.priors.given import test_sav_files as sav_files
from tests.priors.given import test_track_files as tracks_of_others
from tests.priors.given import test_vipe_files as vipe_files
from tests.scenes.conftest import make_image, write_image_file, write_video
from tests.scenes.formats.nvidia_layouts import write_nerfies, write_raw, write_twelve
from tests.training.handful import a_few, seen, tiny

SPEC = SyntheticScene(width=64, height=48, frames=4)
OPTIONS = InputOptions(holdout=3)
CAMERAS = "cameras"


@dataclass(frozen=True)
class Reader:
    """One reader.

    Attributes:
        name: of what it reads.
        originals: the folder under the root of originals that it is given a copy of.
        files: patterns of those that are spoiled.
        read: reads all of it from the copy.
    """

    name: str
    originals: str
    files: tuple[str, ...]
    read: Callable[[Path], Any]


# -- originals


def make_originals(root: Path) -> None:
    """Small files of every kind, each of which can be read as it is."""
    _run(root / "run")
    _training(root / "training")
    _sharing(root / "sharing")
    for suffix in ("png", "jpg", "webp", "tif", "bmp"):
        for i in range(3):
            write_image_file(root / suffix / "images" / f"{i}.{suffix}", make_image(i))
            write_image_file(root / suffix / "masks" / f"{i}.png", np.pad(np.full((24, 32), 40 * i, np.uint8), ((0, 24), (0, 32))))
    _films(root / "films")
    _rig(root / "rig")
    write_raw(root / "raw", replace(SPEC, frames=2))
    write_twelve(root / "twelve", replace(SPEC, frames=2))
    write_nerfies(root / "nerfies", replace(SPEC, frames=2))
    _dycheck(root / "dycheck")
    _given(root / "given")
    _camera_files(root / CAMERAS)
    _messages(root / "messages")
    _splat_files(root / "splats")
    _studio(root / "studio")
    _shots(root / "shots")
    _page(root / "page")


def _run(folder: Path) -> None:
    RunFolder.open_or_create(folder, "clip.mp4", "0" * 16, RunConfig())
    scene = write_synthetic(folder / "scene", SPEC, holdout=3)
    overlay = np.zeros((scene.height, scene.width), bool)
    overlay[2:6, 2:9] = True
    scene.write_overlay(overlay)
    scene.write_overlay_frame(0, np.where(overlay[..., None], scene.frame(0), 0))
    use_truth(scene)
    frames = len(scene.train_frames)
    points = ShapePoints(np.zeros(5, int), np.full((5, 2), 9.0), np.zeros(5), np.full(5, 0.1))
    cues = {"ground": Cue(0.1, 0.2, 0.3)}
    obj = DynamicObject(1, np.zeros(frames), np.full((frames, 2), 20.0), 0.1, False, cues, points, 0.05)
    save_objects(scene, SceneObjects([obj], np.array([0.0, -1.0, 0.0]), True))
    assert scene.similarity
    model = small_model(resting=60, moving=30)
    save_model(folder / "model", replace(model, first=0.0, last=float(scene.timestamps[-1]), similarity=scene.similarity))
    write_json(folder / "metrics.json", _figures(SPEC.frames))
    history = [{"step": k, "psnr": 20.0 + k, "loss": 0.1 / k, "flow": 0.1} for k in (1, 2, 3)]
    write_json(folder / "training" / "history.json", history)
    video = {"key": "0" * 16, "fps": 24.0, "frames": 9, "files": ["input_path.mp4", "input_path_color.mp4"]}
    write_json(
        folder / "renders" / "renders.json",
        {
            "input_path": video,
            "orbit": {**video, "files": ["orbit.mp4"], "swing": {"degrees": 6.0, "unknown": 0.05, "holds": True}},
        },
    )


def _figures(frames: int) -> dict[str, Any]:
    """What an evaluation may write."""
    part = {"psnr": 20.0, "ssim": 0.8, "lpips": None, "count": 2}
    scores = {**part, "moving": part, "covisible": part}
    error = {"mean": 0.5, "median": 0.2}
    obj = {"depth": 2.5, "sigma": 0.1, "largest_step": 0.2, "cues": ["ground"], "small": False, "number": 1, "hint": "9,9@0"}
    kinds = ("heldout_frames", "heldout_frames_refined", "heldout_views", "training_frames")
    return {
        **dict.fromkeys(kinds, scores), "baselines": {"copy": scores, "flow_interpolation": scores, "static": None},
        "baselines_views": {"warp_by_depth": scores}, "lpips_reason": "not installed", "objects": [obj],
        **{name: {**error, "moving": error} for name in ("flow_epe", "prior_flow_epe", "flow_prior_epe")},
        "depth_abs_rel": {"all": error, "static": error, "moving": None},
        "gaussians": {"total": 90, "active_mean": 80.5, "active": [80] * frames, "objects": {"1": 30}},
        "seconds": {"ingest": 0.1, "train": 20.5}, "peak_memory_gib": 0.5,
        "orbit": {"degrees": 6.0, "unknown": 0.05, "holds": True},
        "memory_gib": {"train": 0.5}, "measured": "model", "shown": "model_all_frames",
    }  # fmt: skip


def _training(folder: Path) -> None:
    config = replace(tiny("default"), checkpoint_every=1)
    start = a_few(config)
    Trainer(seen(start), None, config, folder / "training", start=start).run()
    save_model(folder / "model", small_model(resting=30, moving=20))


def _sharing_config() -> TrainConfig:
    config = replace(tiny("default"), checkpoint_every=1)
    return replace(config, model=OTHERS["bases"])


def _sharing(folder: Path) -> None:
    """Of motion models whose Gaussians share parameters."""
    start = a_few(_sharing_config())
    Trainer(seen(a_few(tiny("default"))), None, _sharing_config(), folder / "training", start=start).run()
    for kind in ("bases", "deformation"):
        save_model(folder / kind, small_model(OTHERS[kind], resting=30, moving=20))


def _dycheck(folder: Path) -> None:
    """Three frames, points that were marked in them, and what the clip saw of the test images."""
    spec = replace(SPEC, frames=3)
    write_nerfies(folder, spec)
    for i in range(spec.frames):
        path = folder / "keypoint/2x/train" / f"4_{i:05d}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps([[9.5 + i, 8.5, 1], [20.0, 12.5, i % 2]]))
        for camera in (3, 5, 6):
            write_image_file(folder / "covisible/2x/val" / f"{camera}_{i:05d}.png", np.full((24, 32), 255, np.uint8))


def _films(folder: Path) -> None:
    folder.mkdir(parents=True)
    images = [make_image(i) for i in range(4)]
    for name, codec, pixels in (
        ("a.mp4", "libx264", "yuv420p"), ("b.mkv", "libx264", "yuv420p"), ("c.webm", "libvpx-vp9", "yuv420p"),
        ("d.avi", "mpeg4", "yuv420p"), ("e.mov", "mjpeg", "yuvj420p"),
    ):  # fmt: skip
        write_video(folder / name, images, codec=codec, pixels=pixels, sound=name in ("a.mp4", "b.mkv"))
    with mp4_writer(folder / "f.mp4", 25.0) as write:
        for image in images:
            write(image)


def _rig(folder: Path) -> None:
    count, shape = 3, (3, 48, 64)
    K = [[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]
    for i in range(count):
        write_image_file(folder / "rgb" / f"{i:05d}.png", make_image(i))
        write_image_file(folder / "masks" / f"{i:05d}.png", np.pad(np.full((24, 32), i, np.uint8), ((0, 24), (0, 32))))
        write_image_file(folder / "heldout" / "left" / f"{i:05d}.png", make_image(i + 9))
    poses = [np.eye(4).tolist()] * count
    (folder / "cameras.json").write_text(json.dumps({"K": K, "width": 64, "height": 48, "w2c": poses, "fps": 12}))
    views = {"left": {"times": list(range(count)), "w2c": poses}}
    (folder / "heldout" / "cameras.json").write_text(json.dumps({"K": K, "width": 64, "height": 48, "cameras": views}))
    flow, valid = np.ones((*shape, 2), np.float16), np.ones(shape, bool)
    np.savez(folder / "depth.npz", depth=np.full(shape, 5, np.float16))
    np.savez_compressed(folder / "flow.npz", fwd=flow, bwd=-flow, fwd_valid=valid, bwd_valid=valid)
    moving = np.arange(5) > 2
    points, visible = np.ones((count, 5, 3)), np.ones((count, 5), bool)
    np.savez(folder / "tracks.npz", points=points, visible=visible, moving=moving, birth=0 * moving)


def given_scene(folder: Path, size: tuple[int, int], frames: int) -> Scene:
    """A scene of those frames without images: 2 is held out."""
    return Scene.create(
        folder, name="s", source="", width=size[0], height=size[1], timestamps=range(frames), holdout=3, source_fps=1
    )


def _given(folder: Path) -> None:
    others, maps, tracks = cameras_of_others, maps_of_others, tracks_of_others
    folders = (
        "cameras depth depth_png disparity_disp mosca_depth masks flow flo kitti mosca_flow megasam millimeters vggt "
        "depth_anything_3 sav lens"
    )
    for name in folders.split():
        (folder / name).mkdir(parents=True)
    (folder / "cameras" / "transforms.json").write_text(json.dumps(others.transforms()))
    (folder / "lens" / "transforms.json").write_text(json.dumps(others.transforms(k1=-0.1, k2=0.02, p1=0.001, p2=-0.001)))
    others.colmap_text(folder / "text")
    others.colmap_text(folder / "fisheye", "OPENCV_FISHEYE", (1700.0, 1710.0, 960.0, 540.0, 0.02, -0.01, 0.002, 0.001))
    others.colmap_binary(folder / "binary")
    write_json(folder / "own" / "own.json", [camera.to_json() for camera in others.path()])
    others.megasam(folder / "megasam" / "a.npz")
    networks.depth_anything(folder / "depth_anything_3" / "a.npz", (56, 28))
    networks.vggt(folder / "vggt" / "a.npz", (70, 70), Placement(0, 14, 70, 42), border=1.0)
    sav_files.sav(
        folder / "sav" / "a.json", masklet=[[sav_files.pack(np.pad(np.ones((20, 30)), ((0, 28), (0, 55))))]] * maps.FRAMES
    )
    vipe_files.vipe(folder / "vipe")
    maps.flow_cache(folder / "cache")
    wide = np.full((48, 85), 2.0, np.float32)
    for i in range(maps.FRAMES):
        np.save(folder / "depth" / f"{i:05d}.npy", wide)
        cv2.imwrite(str(folder / "depth_png" / f"{i:05d}.png"), np.full((48, 85), 2000, np.uint16))
        np.save(folder / "disparity_disp" / f"{i:05d}.npy", wide)
        np.savez_compressed(folder / "mosca_depth" / f"{i:05d}.npz", dep=wide)
        cv2.imwrite(str(folder / "millimeters" / f"{i:05d}.png"), np.full((48, 85), 2000, np.uint16))
        write_image_file(folder / "masks" / f"{i:05d}.png", np.pad(np.full((24, 40), i, np.uint8), ((0, 24), (0, 45))))
    scene = given_scene(folder / "scene", maps.SIZE, maps.FRAMES)
    for i, j in [*consecutive_pairs(scene), (1, 2)]:
        flow = np.ones((48, 85, 2), np.float32)
        np.savez(folder / "flow" / f"{i:05d}_{j:05d}.npz", flow=flow, confidence=wide / 2)
        head = np.float32(202021.25).tobytes() + np.array([85, 48], "<i4").tobytes()
        (folder / "flo" / f"{i:05d}_{j:05d}.flo").write_bytes(head + flow.tobytes())
        cv2.imwrite(str(folder / "kitti" / f"{i:05d}_{j:05d}.png"), np.full((48, 85, 3), 33_000, np.uint16))
        np.savez_compressed(folder / "mosca_flow" / f"{i}.jpg_to_{j}.jpg.npz", flow=flow, mask=wide / 2)
    shutil.rmtree(folder / "scene")
    for name in tracks.LAYOUTS:
        target = folder / "tracks" / name.split(",")[0]
        target.mkdir(parents=True, exist_ok=True)
        if not any(target.iterdir()):
            tracks.LAYOUTS[name][0](target)


def _camera_files(folder: Path) -> None:
    folder.mkdir()
    cameras = cameras_of_others.path((64, 48))
    write_camera_file(folder / "own.json", [(camera, 0.1 * i) for i, camera in enumerate(cameras)], 24.0)
    (folder / "transforms.json").write_text(json.dumps(cameras_of_others.transforms()))
    entries = [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50, "render_time": 0.1 * i} for i in range(3)]
    values = {"camera_type": "perspective", "render_width": 64, "render_height": 48, "fps": 24, "camera_path": entries}
    (folder / "nerfstudio.json").write_text(json.dumps(values))
    (folder / "queries.json").write_text("[[1.5, 2.5, 0], [3, 4, 1]]")
    (folder / "queries.csv").write_text("# u,v,frame\n1.5,2.5,0\n3,4,1\n")


def _shots(folder: Path) -> None:
    folder.mkdir()
    shots = [{"start": 0.0, "end": 1.5}, {"start": 1.54, "end": 3.0}]
    similarity = {"scale": 1.5, "rotation": np.eye(3).tolist(), "translation": [0.1, 0.2, 0.3]}
    place = {"shots": [1, 2], "similarity": similarity, "matches": 120, "pixels": 0.75, "split_pixels": 1.25}
    record = {
        "version": 1, "input": "clip.mp4", "fingerprint": "0" * 16, "shots": shots, "notes": ["Left out: 1 frame."],
        "places": [place],
    }  # fmt: skip
    (folder / "shots.json").write_text(json.dumps(record))


def _messages(folder: Path) -> None:
    from tests.output.viewer.test_messages import CAMERA, UPDATE, UPLOAD

    folder.mkdir()
    for k, message in enumerate((CAMERA, UPDATE, UPLOAD)):
        (folder / f"{k}.json").write_text(json.dumps(message))


def _splat_files(folder: Path) -> None:
    folder.mkdir()
    still = make_still(20, degree=1)
    write_ply(folder / "a.ply", still, has_objects=True, comments=["a scene"])
    write_splat(folder / "b.splat", still)
    write_spz(folder / "c.spz", still)


# -- reading


def _read_scene(folder: Path) -> None:
    scene = Scene(folder / "scene")
    _ = scene.similarity, scene.cameras, scene.views, scene.sound, scene.times, scene.overlay, scene.overlay_frame(0)
    for i in scene.train_frames:
        scene.frame(i), scene.depth(i), scene.mask(i)
    for i in scene.heldout_frames:
        scene.heldout_frame(i)
        if scene.heldout_masks.has_mask(i):
            scene.heldout_masks.mask(i)
    for i, j in scene.flow_pairs:
        with suppress(InputError):
            scene.flow(i, j)
    if scene.has_tracks:
        _ = scene.tracks
    for view in scene.views:
        scene.view_image(view), scene.view_mask(view)
    if scene.truth is not None:
        _ = scene.truth.cameras, scene.truth.tracks
    load_objects(scene)
    list(describe(folder))


def _read_flow_of_scene(folder: Path) -> None:
    scene = Scene(folder / "scene")
    for i, j in scene.flow_pairs:
        scene.flow(i, j)


def _read_run(folder: Path) -> None:
    check(RunFolder(folder).config)
    list(describe(folder))


def _read_report(folder: Path) -> None:
    """As a run whose evaluation is finished shows its figures again."""
    metrics, history = read_metrics(folder / "metrics.json"), read_history(folder / "training" / "history.json")
    figures_table({"": metrics})
    write_report(folder, report_data(folder, "clip.mp4", Scene(folder / "scene"), [], metrics, history, RunConfig()))


def _read_model(folder: Path) -> None:
    model = load_model(folder / "model")
    scene = Scene(folder / "scene")
    model.render(scene.cameras[0], model.first)
    for to in ("ply", "npz"):
        export_scene(model, scene, to, folder / f"out.{to}", ExportOptions())


def _read_checkpoint(folder: Path) -> None:
    model, _, _ = load_checkpoint(folder / "training", small_model(resting=1, moving=1).similarity, 0.0, 1.0, 50.0)
    model.active_count(0.5)


def _read_sharing(folder: Path) -> None:
    for kind in ("bases", "deformation"):
        model = load_model(folder / kind)
        model.render(small_cameras(model, 32, 24)[0], model.first)


def _go_on_sharing(folder: Path) -> None:
    config = _sharing_config()
    Trainer(seen(a_few(tiny("default"))), None, config, folder / "training", start=a_few(config)).run()


def _read_dycheck(folder: Path) -> None:
    _ingest(folder)
    read_keypoints(folder, Scene(folder.parent / "ingested"))


def _train_on(folder: Path) -> None:
    config = replace(tiny("default"), checkpoint_every=1)
    Trainer(seen(a_few(config)), None, config, folder / "training", start=a_few(config)).run()


def _ingest(folder: Path) -> None:
    shutil.rmtree(folder.parent / "ingested", ignore_errors=True)
    ingest(open_clip(folder, OPTIONS), folder.parent / "ingested", OPTIONS)


def _ingest_films(folder: Path) -> None:
    for film in sorted(folder.iterdir()):
        options = replace(OPTIONS, max_frames=4)
        list(open_clip(film, options).frames(range(2)))
        keep_sound(film, 0.0, 0.1, folder.parent / "ingested" / "sound.flac")


def _given_of(name: str, place: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        tracks = name == "tracks"
        size = (tracks_of_others.WIDTH, tracks_of_others.HEIGHT) if tracks else maps_of_others.SIZE
        frames = tracks_of_others.FRAMES if tracks else maps_of_others.FRAMES
        scene, path = given_scene(folder.parent / "ingested", size, frames), folder / place
        if name == "cameras":
            read_cameras(path, scene, False)
        elif name == "depth":
            given = open_depth(path, scene)
            assert all(np.isfinite(given.read(i).depth).all() for i in scene.train_frames)
        elif name == "flow":
            read_flow(path, scene)
        elif name == "tracks":
            read_tracks(path, scene, None)
        else:
            use_given(scene, GivenPriors(masks=path))

    return read


def _read_camera_files(folder: Path) -> None:
    for name in ("own", "transforms", "nerfstudio"):
        read_camera_file(folder / f"{name}.json", (64, 48), (0.0, 2.0))


def _read_queries(folder: Path) -> None:
    scene = given_scene(folder / "into", (64, 48), 4)
    for name in ("queries.json", "queries.csv"):
        read_queries((), folder / name, scene)


def _page(folder: Path) -> None:
    """A page whose program is left out: nobody but a browser reads that."""
    folder.mkdir(parents=True)
    text = small_player(folder / "scene.html", small_model(resting=40, moving=20)).read_text()
    parts = [text[text.index(f'<script id="{name}"') :].partition("</script>")[0] + "</script>" for name in ("about", "data")]
    (folder / "scene.html").write_text("\n".join(parts))


def _read_page(folder: Path) -> None:
    scene = read_page(folder / "scene.html")
    for seconds in (scene.header["first"], 1.0, scene.header["last"]):
        still = scene.at(seconds)
        assert np.isfinite(still.means).all()
        assert np.isfinite(still.scales).all()
    assert len(scene.object_ids) == len(scene.slopes) == len(scene)


def _read_shots(folder: Path) -> None:
    found = read_shots(folder)
    if found is None:  # what leads nowhere is not there, and the folder is one of a run
        return
    assert all(str(place) for place in found.places or ())
    for shot in found.shots:
        assert str(shot)
        assert folder in shot.path.parents


def _read_splats(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        if is_splat_file(path):
            splats = read_splats(path)
            assert all(camera.is_valid for camera in make_cameras(splats))
            make_model(splats).render(make_cameras(splats)[0].resize(32, 18), 0.0)


def _hear(folder: Path) -> None:
    gate = Gate()
    for path in sorted(folder.iterdir()):
        if path.is_file() and path.stat().st_size < 2**20:
            data = path.read_bytes()
            gate.admit(data)
            with suppress(msgspec.MsgspecError, RecursionError, UnicodeDecodeError, OverflowError):
                gate.admit(msgspec.msgpack.encode(msgspec.json.decode(data)))


def _command(*arguments: str) -> Callable[[Path], None]:
    """A whole command: it ends well, or with one line and exit code 2."""

    def read(folder: Path) -> None:
        try:
            main([argument.replace("RUN", str(folder)) for argument in arguments])
        except SystemExit as error:
            if error.code not in (0, 2, None):
                raise RuntimeError(f"exit code {error.code}") from error
            if error.code == 2:
                raise InputError("refused by the command") from error

    return read


RUN_FILES = ("run.json", "metrics.json", "model/*", "scene/*.json", "scene/*.npz", "scene/*/*")


def _studio(root: Path) -> None:
    mark, other = ({"x": 0.5, "y": 0.25, "frame": frame, "second": 0.5} for frame in (3, "2/3"))
    task = {"what": "run", "process": 2**22 + 7, "begun": "1", "since": 1e9, "stopping": False, "times": [{"train": 9.0}]}
    choices = {**first_choices(), "objects": [{"clicks": [mark], "beside": [other]}], "contacts": [mark], "start": 0.5, "end": 2.0}
    project = {
        "version": 1, "name": "walk.mp4", "made": 1e9, "choices": choices, "ran": choices, "waiting": ["export html"], "task": task,
        "end": {"what": "run", "state": "failed", "message": "It failed."},
    }  # fmt: skip
    write_json(root / "walk" / "studio.json", project)
    (root / "walk" / "run.log").write_text(
        "$ flowsplat run x\nShot 1 of 2: x\nOrbit: 4 degrees to either side\nTraining: 3 of 10, 2 s left\n"
    )


def _read_studio(folder: Path) -> None:
    """As a server that is started: what cannot be read is left out, what can be is shown and looked after."""
    project = Project(folder / "walk")
    assert project.clip.parent == folder / "walk" / "clip"
    describe_project(project, StandingReader(), ())
    Tasks().end(project)
    describe_project(project, StandingReader(), ())


READERS = (
    Reader("studio.json", "studio", ("walk/*",), _read_studio),
    Reader("shots.json", "shots", ("*",), _read_shots),
    Reader("run.json, metrics.json", "run", ("run.json", "metrics.json"), _read_run),
    Reader("report", "run", ("metrics.json", "training/history.json", "renders/renders.json"), _read_report),
    Reader("scene.json, views.json", "run", ("scene/scene.json", "scene/views.json"), _read_scene),
    Reader("cameras.json", "run", ("scene/cameras.json", "scene/truth/cameras.json"), _read_scene),
    Reader("objects", "run", ("scene/objects.*",), _read_scene),
    Reader("tracks of a scene", "run", ("scene/tracks.npz",), _read_scene),
    Reader("depth of a scene", "run", ("scene/depth/*",), _read_scene),
    Reader("flow of a scene", "run", ("scene/flow/*",), _read_flow_of_scene),
    Reader("images of a scene", "run", tuple(f"scene/{n}/*" for n in ("frames", "masks", "heldout/*", "views")), _read_scene),
    Reader("what is burnt in", "run", ("scene/overlay/*",), _read_scene),
    Reader("model", "run", ("model/*",), _read_model),
    Reader("static Gaussians", "splats", ("*",), _read_splats),
    Reader("page that plays a scene", "page", ("*",), _read_page),
    Reader("checkpoint to look at", "training", ("training/*",), _read_checkpoint),
    Reader("checkpoint to go on from", "training", ("training/*",), _train_on),
    Reader("model that shares parameters", "sharing", ("bases/*", "deformation/*"), _read_sharing),
    Reader("checkpoint that shares parameters", "sharing", ("training/*",), _go_on_sharing),
    *(Reader(f"images, {kind}", kind, ("images/*",), _ingest) for kind in ("png", "jpg", "webp", "tif", "bmp")),
    Reader("masks beside images", "png", ("masks/*",), _ingest),
    Reader("films", "films", ("*",), _ingest_films),
    Reader("rig", "rig", ("*.json", "*.npz", "*/*"), _ingest),
    Reader("rig's arrays", "rig", ("*.npz",), _ingest),
    Reader("NVIDIA, raw", "raw", ("*.npy", "mv_images/*/*"), _ingest),
    Reader("NVIDIA, twelve", "twelve", ("*.npy", "*/*"), _ingest),
    Reader("DyCheck", "dycheck", ("keypoint/2x/train/*", "covisible/2x/val/*"), _read_dycheck),
    Reader("nerfies", "nerfies", ("splits/*", "camera/*", "*.json"), _ingest),
    *(
        Reader(f"given {name}, {Path(place).name}", f"given/{place}", ("*",), _given_of(name, file))
        for name, place, file in (
            ("cameras", "own", "own.json"), ("cameras", "cameras", ""), ("cameras", "text", ""), ("cameras", "binary", ""),
            ("cameras", "lens", ""), ("cameras", "fisheye", ""),
            ("cameras", "megasam", "a.npz"), ("depth", "depth", ""), ("depth", "depth_png", ""),
            ("depth", "disparity_disp", ""), ("depth", "mosca_depth", ""),
            ("depth", "megasam", "a.npz"), ("masks", "masks", ""), ("flow", "flow", ""), ("flow", "flo", ""), ("flow", "kitti", ""),
            ("flow", "mosca_flow", ""), ("flow", "cache", ""), ("tracks", "tracks/tapir", ""), ("tracks", "tracks/marbles", ""),
            ("tracks", "tracks/mosca", ""), ("tracks", "tracks/cotracker", "a.npz"), ("tracks", "tracks/tapnet", "a.npz"),
            ("depth", "millimeters", ""), ("cameras", "depth_anything_3", "a.npz"), ("depth", "depth_anything_3", "a.npz"),
            ("masks", "sav", "a.json"), ("tracks", "tracks/spatialtracker2", "clip_result.npz"),
            ("cameras", "vggt", "a.npz"), ("depth", "vggt", "a.npz"),
        )
    ),
    Reader("given cameras, vipe", "given/vipe", ("pose/*", "intrinsics/*"), _given_of("cameras", "")),
    Reader("given depth, vipe", "given/vipe", ("depth/*",), _given_of("depth", "")),
    Reader("given masks, vipe", "given/vipe", ("mask/*",), _given_of("masks", "")),
    Reader("camera paths", CAMERAS, ("own.json", "transforms.json", "nerfstudio.json"), _read_camera_files),
    Reader("queries", CAMERAS, ("queries.*",), _read_queries),
    Reader("messages of a browser", "messages", ("*",), _hear),
    Reader("flowsplat info", "run", RUN_FILES, _command("info", "RUN")),
    Reader("flowsplat export", "run", RUN_FILES, _command("export", "RUN", "--to", "splat")),
    Reader("flowsplat tracks", "run", RUN_FILES, _command("tracks", "RUN", "--at", "9,9,0")),
)  # fmt: skip
