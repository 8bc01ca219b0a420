"""Cameras from a file or folder of any known layout."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json, read_npz
from flowsplat.geometry import Camera
from flowsplat.geometry.lens import Distortion, Lens
from flowsplat.priors.given import droid, feedforward, megasam, vipe
from flowsplat.priors.given.colmap import find_model, read_colmap
from flowsplat.priors.given.fitting import compute_max_bytes, require_frames, require_shape
from flowsplat.priors.given.lens import find_lens
from flowsplat.priors.given.nerfstudio import is_nerfstudio, read_nerfstudio
from flowsplat.scenes import Scene

KNOWN = (
    "a JSON list of cameras, nerfstudio's transforms.json, a COLMAP model (cameras and images, .bin or .txt), "
    "the .npz of Depth Anything 3 (extrinsics), VGGT (extrinsic) or MegaSaM (cam_c2w), "
    "the folder of ViPE's results (pose and intrinsics in it), DROID-SLAM's droid_recon .npy"
)


@dataclass(frozen=True)
class GivenCameras:
    """What a file holds.

    Attributes:
        cameras: one a frame, at its size; pinholes that see the straightened images, where there is a lens.
        maker: whose layout it was.
        told: what is to be said about them, in sentences.
        lens: of the frames; None where pinholes took them.
    """

    cameras: list[Camera]
    maker: str
    told: str = ""
    lens: Lens | None = None


def read_cameras(path: Path, scene: Scene, allow_pickle: bool) -> GivenCameras:
    """Read cameras of any known layout.

    Raises:
        InputError: missing, damaged, of no known layout, not one camera a frame, of another shape, or with
            several lenses.
    """
    given, distortions = _read(Path(path), scene, allow_pickle)
    for index, camera in enumerate(given.cameras):
        if not camera.is_valid:
            raise InputError(f"{path}: the camera of frame {index} is not finite or its viewmat is not a rotation.")
        require_shape(path, camera.width, camera.height, scene)
    cameras = [camera.resize(scene.width, scene.height) for camera in given.cameras]
    lens = find_lens(path, cameras, distortions)
    return replace(given, cameras=cameras if lens is None else list(map(lens.straighten_camera, cameras)), lens=lens)


def _read(path: Path, scene: Scene, allow_pickle: bool) -> tuple[GivenCameras, dict[int, Distortion]]:
    """Return what a file holds at the size that it has there, and how the lens bends frames; none of pinholes."""
    if path.is_dir():
        model = find_model(path)
        if (path / "transforms.json").is_file():
            path = path / "transforms.json"
        elif model is not None:
            cameras, told, distortions = read_colmap(model, scene)
            return GivenCameras(cameras, "COLMAP", told), distortions
        elif vipe.find_file(path, "pose", scene):
            cameras, told = vipe.read_cameras(path, scene)
            return GivenCameras(cameras, vipe.MAKER, told), {}
    suffix = path.suffix.lower()
    if suffix == ".json":
        content = read_json(path)
        if is_nerfstudio(content):
            cameras, told, distortions = read_nerfstudio(path, content, scene)
            return GivenCameras(cameras, "nerfstudio", told), distortions
        return GivenCameras(_read_own(path, content, scene), "flowsplat"), {}
    if suffix == ".npz":
        arrays = read_npz(path, {*megasam.ARRAYS, *feedforward.ARRAYS}, most=compute_max_bytes(scene))
        if megasam.is_megasam(arrays):
            return GivenCameras(megasam.read_cameras(path, arrays, scene), megasam.MAKER), {}
        if maker := feedforward.find_maker(arrays, with_cameras=True):
            return GivenCameras(feedforward.read_cameras(path, arrays, maker, scene), maker), {}
    if suffix == ".npy":
        return GivenCameras(droid.read_droid(path, scene, allow_pickle), droid.MAKER), {}
    if not path.exists():
        raise InputError(f"{path} does not exist.")
    raise InputError(f"{path} holds no cameras of a known layout. Looked for: {KNOWN}.")


def _read_own(path: Path, content: object, scene: Scene) -> list[Camera]:
    try:
        if not isinstance(content, list):
            raise TypeError("it is neither a list nor a transforms.json")
        cameras = [Camera.from_json(value) for value in content]
    except (KeyError, TypeError, ValueError, ArithmeticError) as error:
        raise InputError(f"{path} does not hold cameras (a list with viewmat, K, width, height each): {error}.") from error
    require_frames(path, len(cameras), scene, "cameras")
    return cameras
