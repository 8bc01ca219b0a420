"""The glTF export: by the rules of the format, and read by readers that are not ours."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from flowsplat.gaussians.gaussians4d import NEAR_PLANE
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import OPENGL
from flowsplat.output.export import ExportOptions, export_scene
from flowsplat.output.export.formats import EXPORTERS
from flowsplat.output.export.still import still_at
from flowsplat.scenes import Scene
from flowsplat.splatting import rasterize
from flowsplat.splatting.harmonics import colors_from_harmonics
from tests.output.small import FRAMES, LINEAR, OURS, PAPER, flat, psnr, rendered, small_cameras, small_model, small_run, small_times

EXTENSION = "KHR_gaussian_splatting"
SECONDS = small_times()[4]
COMPONENTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def exported(folder: Path, model: SceneModel, name: str = "scene.glb") -> Path:
    small_run(folder, model)
    return export_scene(model, Scene(folder / "scene"), "gltf", folder / name, ExportOptions(time=SECONDS))


def parse(path: Path) -> tuple[dict, bytes]:
    """Document and binary data, the container checked."""
    raw = path.read_bytes()
    if path.suffix == ".gltf":
        document = json.loads(raw)
        head, data = document["buffers"][0]["uri"].split(",")
        assert head == "data:application/octet-stream;base64"
        return document, base64.b64decode(data)
    magic, version, total, size, kind = struct.unpack_from("<4sIII4s", raw)
    assert (magic, version, total, kind) == (b"glTF", 2, len(raw), b"JSON")
    assert size % 4 == 0
    length, kind = struct.unpack_from("<I4s", raw, 20 + size)
    assert (kind, 28 + size + length) == (b"BIN\0", len(raw))
    return json.loads(raw[20 : 20 + size]), raw[28 + size :]


def array(document: dict, data: bytes, accessor: int) -> np.ndarray:
    """[N, C] what an accessor shows, its box checked."""
    entry = document["accessors"][accessor]
    view = document["bufferViews"][entry["bufferView"]]
    assert entry["componentType"] == 5126
    assert view["byteOffset"] % 4 == 0
    columns = COMPONENTS[entry["type"]]
    assert view["byteLength"] == 4 * entry["count"] * columns
    values = np.frombuffer(data, "<f4", entry["count"] * columns, view["byteOffset"]).reshape(-1, columns)
    if "min" in entry:
        np.testing.assert_array_equal(values.min(0), np.float32(entry["min"]))
        np.testing.assert_array_equal(values.max(0), np.float32(entry["max"]))
    return values


def turned(camera: Camera) -> Camera:
    """The camera in a world with y up and z backward."""
    return Camera(camera.viewmat @ OPENGL, camera.K, camera.width, camera.height)


def drawn(document: dict, data: bytes, camera: Camera, model: SceneModel) -> np.ndarray:
    """[H, W, 3] the splats of all meshes, drawn by the oracle."""
    parts: dict[str, list[np.ndarray]] = {}
    for mesh in document["meshes"]:
        for name, accessor in mesh["primitives"][0]["attributes"].items():
            parts.setdefault(name.removeprefix(f"{EXTENSION}:"), []).append(array(document, data, accessor))
    all_of = {name: torch.from_numpy(np.concatenate(values).astype(np.float64)) for name, values in parts.items()}
    degree = max(int(name.split("_")[2]) for name in all_of if name.startswith("SH_"))
    sh = torch.stack([all_of[f"SH_DEGREE_{k}_COEF_{i}"] for k in range(degree + 1) for i in range(2 * k + 1)], 1)
    inside = turned(camera)
    means = all_of["POSITION"]
    colors = colors_from_harmonics(sh, means - torch.as_tensor(inside.center), degree)
    return rasterize(
        means, all_of["ROTATION"].roll(1, 1), all_of["SCALE"], all_of["OPACITY"][:, 0], colors, *inside.tensors(torch.float64),
        camera.width, camera.height, near_plane=NEAR_PLANE / model.similarity.scale, backend="reference",
    )[0].numpy()  # fmt: skip


@pytest.mark.parametrize("name", ["scene.glb", "scene.gltf"])
@pytest.mark.parametrize("config", [OURS, PAPER, LINEAR], ids=["ours", "paper", "linear"])
def test_its_splats_show_the_scene_at_its_time(tmp_path, config, name):
    model = small_model(config)
    document, data = parse(exported(tmp_path, model, name))
    for camera in small_cameras(model)[::4]:
        assert psnr(drawn(document, data, camera, model), rendered(flat(model), camera, SECONDS)) > 50


def test_it_keeps_the_rules_of_the_format(tmp_path):
    model = small_model()
    document, data = parse(exported(tmp_path, model))
    assert document["asset"]["version"] == "2.0"
    assert document["buffers"] == [{"byteLength": len(data)}]
    assert document["extensionsUsed"] == [EXTENSION]
    assert [node["name"] for node in document["nodes"]] == ["background", "object 1", "object 2", "camera"]
    still = still_at(model, SECONDS, flip_axes=True)
    for node in document["nodes"][:3]:
        (primitive,) = document["meshes"][node["mesh"]]["primitives"]
        assert primitive["mode"] == 0
        assert (
            primitive["extensions"][EXTENSION] | {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
            == (primitive["extensions"][EXTENSION])
        )
        counts = {document["accessors"][accessor]["count"] for accessor in primitive["attributes"].values()}
        assert counts == {int((still.object_ids == node["extras"]["object_id"]).sum())}
        assert {"min", "max"} <= document["accessors"][primitive["attributes"]["POSITION"]].keys()
        colors = array(document, data, primitive["attributes"]["COLOR_0"])
        assert 0 <= colors.min() <= colors.max() <= 1
    ends = [view["byteOffset"] + view["byteLength"] for view in document["bufferViews"]]
    assert [view["byteOffset"] for view in document["bufferViews"]] == [0, *ends[:-1]]
    assert ends[-1] == len(data)


def test_its_camera_moves_as_that_of_the_clip(tmp_path):
    model = small_model(rotation=np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]]))
    document, data = parse(exported(tmp_path, model))
    (animation,) = document["animations"]
    paths = {channel["target"]["path"]: animation["samplers"][channel["sampler"]] for channel in animation["channels"]}
    assert {document["nodes"][channel["target"]["node"]]["name"] for channel in animation["channels"]} == {"camera"}
    times = array(document, data, paths["rotation"]["input"])[:, 0]
    np.testing.assert_allclose(times, np.array(small_times()) - model.first, atol=1e-6)
    places, quats = array(document, data, paths["translation"]["output"]), array(document, data, paths["rotation"]["output"])
    assert len(places) == len(quats) == FRAMES
    assert ((quats[1:] * quats[:-1]).sum(1) > 0).all()
    view = document["cameras"][0]["perspective"]
    points = still_at(model, SECONDS, flip_axes=True).means.numpy()[::20]
    for camera, place, (x, y, z, w) in zip(small_cameras(model), places, quats, strict=True):
        turn = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        seen = (points - place) @ turn  # y up, looking along -z
        focal = camera.height / 2 / np.tan(view["yfov"] / 2)
        across = camera.width / 2 / (np.tan(view["yfov"] / 2) * view["aspectRatio"])
        u, v = across * seen[:, 0] / -seen[:, 2] + camera.K[0, 2], -focal * seen[:, 1] / -seen[:, 2] + camera.K[1, 2]
        inside = points @ turned(camera).viewmat[:3, :3].T + turned(camera).viewmat[:3, 3]
        expected = inside[:, :2] / inside[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
        np.testing.assert_allclose(np.stack([u, v], 1), expected, atol=0.01)


def test_what_it_does_not_hold_is_told(tmp_path, capsys):
    exported(tmp_path, small_model())
    told = " ".join(capsys.readouterr().err.split())
    assert "it is of one time, the camera of the whole clip" in told
    assert "looks through the middle of the image, which is 1.0 pixels from where the clip's does" in told


def test_the_estimate_is_near_the_size(tmp_path):
    model = small_model(resting=3000, moving=1000)
    path, scene = exported(tmp_path, model), Scene(tmp_path / "scene")
    assert 0.8 < EXPORTERS["gltf"].estimate_bytes(model, scene, ExportOptions(time=SECONDS)) / path.stat().st_size < 1.2


@pytest.mark.parametrize("name", ["scene.glb", "scene.gltf"])
def test_trimesh_reads_points_and_colors(tmp_path, name):
    trimesh = pytest.importorskip("trimesh", reason="no independent reader of glTF is installed: pip install trimesh")
    model = small_model()
    found = trimesh.load_scene(exported(tmp_path, model, name))
    still = still_at(model, SECONDS, flip_axes=True)
    for number, title in enumerate(("background", "object 1", "object 2")):
        points = found.geometry[title]
        mine = still.object_ids == number
        np.testing.assert_allclose(points.vertices, still.means[mine], atol=1e-6)
        assert points.colors.shape == (int(mine.sum()), 4)


def test_pygltflib_reads_the_animation(tmp_path):
    pygltflib = pytest.importorskip("pygltflib", reason="pygltflib is not installed")
    found = pygltflib.GLTF2().load(str(exported(tmp_path, small_model())))
    assert [channel.target.path for channel in found.animations[0].channels] == ["translation", "rotation"]
    assert found.cameras[0].perspective.yfov == pytest.approx(2 * np.arctan(32 / 82))
    assert found.meshes[0].primitives[0].mode == pygltflib.POINTS


def test_another_reader_of_the_extension_reads_the_splats(tmp_path):
    fourdgs = pytest.importorskip("fourdgs", reason="no reader of the extension is installed: pip install fourdgs")
    model = small_model()
    found = fourdgs.from_gltf(str(exported(tmp_path, model)))
    gaussians = found.gaussians if hasattr(found, "gaussians") else found
    still = still_at(model, SECONDS, flip_axes=True)
    order = np.argsort(still.object_ids.numpy(), kind="stable")
    np.testing.assert_allclose(gaussians.positions, still.means.numpy()[order], atol=1e-5)
    np.testing.assert_allclose(gaussians.scales, np.exp(still.log_scales.numpy()[order]), rtol=1e-4)
    np.testing.assert_allclose(gaussians.colors[:, 3], still.opacities.numpy()[order], atol=1e-5)
    np.testing.assert_allclose(np.abs((gaussians.rotations * np.roll(still.quats.numpy()[order], -1, axis=1)).sum(1)), 1, atol=1e-5)
