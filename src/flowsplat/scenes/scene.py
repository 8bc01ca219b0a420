"""The scene: a clip, its split, its priors, and (where they exist) truth and held-out views.

A scene is a folder. ``scene.json`` says what it is; the layers (see ``layers``) lie beside it; training frames are in
``frames/``, held-out frames in ``heldout/``, truth in ``truth/`` and held-out views in ``views/``:

    scene.json  frames/00000.png  cameras.json  depth/ flow/ masks/ tracks.npz
    heldout/frames/00009.png  heldout/masks/00009.png
    overlay/mask.png  overlay/00000.png
    views.json  views/<name>.png  views/<name>_mask.png  views/<name>_covisible.png
    truth/cameras.json  truth/depth/ ...

The split is law: what trains or computes a prior calls ``frame``, ``mask``, ``depth`` and ``flow``, which refuse held-out
frames. Only ``ingest`` and the camera stage call ``any_frame``; ``heldout_frame`` is for the evaluation, the report, the viewer,
and the final fit after all of them.

What is burnt into the clip (``overlay``) is part of no layer: the ``write_*`` methods see to that, whoever computed the layer. In
the frames it is filled smoothly from around it, so that nobody finds edges there, and what was filled counts for nothing either.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import TypedDict

from flowsplat.common.errors import InputError, SplitError
from flowsplat.common.files import check_json, make_folder, plain_name, read_json, write_json
from flowsplat.common.files.json_file import Count, Text, Versioned
from flowsplat.common.progress import report_once
from flowsplat.geometry import Camera, Similarity
from flowsplat.geometry.lens import Lens
from flowsplat.images.html import format_facts
from flowsplat.scenes.info import SceneInfo
from flowsplat.scenes.layers import CameraFile, Depth, Flow, Layers, StoredFlow, Tracks, read_image, write_image
from flowsplat.scenes.overlay import hide_overlay, look_up_mask

VERSION = 1


def split_frames(count: int, holdout: int | None, chosen: Sequence[int] = ()) -> tuple[list[int], list[int]]:
    """Return (training, held-out) frame numbers: every ``holdout``-th frame is held out (9, 19, ... for 10), never the last.

    Args:
        chosen: numbers of frames that are held out instead; none = those.

    Raises:
        InputError: too few frames remain for training, or there is no frame of such a number.
    """
    if chosen and not 0 <= min(chosen) <= max(chosen) < count:
        raise InputError(f"Held-out frames are numbers from 0 to {count - 1}, not {min(chosen)} to {max(chosen)}.")
    heldout = sorted(set(chosen)) or [i for i in range(count - 1) if holdout and i % holdout == holdout - 1]
    kept_back = set(heldout)
    train = [i for i in range(count) if i not in kept_back]
    if len(train) < 2:
        raise InputError(f"{len(train)} training frame(s): a moving scene needs at least two frames.")
    return train, heldout


@dataclass(frozen=True)
class HeldoutView:
    """An image by another camera, known to the evaluation only.

    Attributes:
        name: file name of the image without suffix.
        frame: the frame of the clip that was taken at the same time.
        camera: in the coordinates of the truth.
    """

    name: str
    frame: int
    camera: Camera


class ViewFile(TypedDict):
    """One held-out view in ``views.json``."""

    name: Text
    frame: Count
    camera: CameraFile


class Scene(Layers):
    """A prepared (or half prepared) scene folder. Its own layers are the priors; ``truth`` holds the true ones.

    Attributes:
        timestamps: [T] float64 seconds of the frames, rising.
        train_frames: numbers of the training frames.
        heldout_frames: numbers of the held-out frames.

    Examples:
        >>> scene = flowsplat.Scene("out/clip/scene")
        >>> scene.num_frames, scene.heldout_frames
        (12, [9])
        >>> scene.frame(0).shape, scene.depth(0).depth.shape
        ((48, 64, 3), (48, 64))
    """

    def __init__(self, folder: str | Path):
        """Open a scene.

        Raises:
            InputError: not a scene, damaged, or written by a newer version.
        """
        path = Path(folder) / "scene.json"
        if not path.exists():
            raise InputError(f"{folder} is not a prepared scene: it has no scene.json.")
        values: dict[str, Any] = read_json(path, Versioned)
        if values["version"] > VERSION:
            raise InputError(
                f"{folder} was written by a newer flowsplat (scene version {values['version']}, this one reads {VERSION}). "
                "Update flowsplat."
            )
        check_json(path, values, SceneInfo)
        self._info = info = SceneInfo.from_json(values)
        try:
            if info.similarity is not None:
                Similarity.from_json(info.similarity)
        except ValueError as error:
            raise InputError(f"{path} is damaged: {error}.") from error
        super().__init__(Path(folder), info.width, info.height)
        self.timestamps = np.array(info.timestamps, np.float64)
        self.train_frames, self.heldout_frames = list(info.train), list(info.heldout)
        if len(self.timestamps) < 2 or not (np.diff(self.timestamps) > 0).all():
            raise InputError(f"{path} is damaged: there must be two timestamps or more, finite and rising.")
        if sorted(self.train_frames + self.heldout_frames) != list(range(len(self.timestamps))):
            raise InputError(f"{path} is damaged: every frame must be either a training or a held-out frame.")
        if len(self.train_frames) < 2:
            raise InputError(f"{path} has {len(self.train_frames)} training frame(s): a moving scene needs at least two.")
        if sorted(self.train_frames) != self.train_frames or sorted(self.heldout_frames) != self.heldout_frames:
            raise InputError(f"{path} is damaged: the numbers of training and of held-out frames must rise.")
        self._train = set(self.train_frames)

    def __repr__(self) -> str:
        frames = f"{self.num_frames} frames of {self.width}x{self.height}, {len(self.heldout_frames)} held out"
        return f"Scene({str(self.folder)!r}, {frames}, {self.timestamps[0]:.3g} to {self.timestamps[-1]:.3g} s)"

    def _repr_html_(self) -> str:
        """For notebooks: a training frame from the middle of the clip, and what is known of it."""
        facts = {
            "clip": f"{self.num_frames} frames of {self.width}x{self.height}, {len(self.heldout_frames)} held out",
            "time": f"{self.timestamps[0]:.3g} to {self.timestamps[-1]:.3g} s",
            "priors": ", ".join(self.info.priors) or "none yet",
        }
        middle = self.train_frames[len(self.train_frames) // 2]
        image = self.frame(middle) if self.has_frame(middle) else None
        return format_facts(f"{self.name} ({self.folder})", facts, image)

    @staticmethod
    def create(
        folder: str | Path,
        *,
        name: str,
        source: str,
        width: int,
        height: int,
        timestamps: Sequence[float],
        holdout: int | None,
        source_fps: float,
        heldout: Sequence[int] = (),
        notes: Sequence[str] = (),
        audio: str | None = None,
        audio_start: float = 0.0,
        input_frames: int | None = None,
    ) -> Scene:
        """Start a scene folder with its split; frames and layers are written into it afterwards.

        Args:
            timestamps: seconds, rising, one a frame.
            holdout: every how many frames one is held out; None = none.
            source_fps: frames a second of the source, which the final videos keep.
            heldout: numbers of frames that are held out instead; none = those that ``holdout`` says.
            notes: what was done to the input, in sentences for the user.
            audio: the name of the file in the folder with the sound, and at which second of it the clip starts.
            input_frames: frames that these were thinned out from; None = all were taken.
        """
        train, heldout = split_frames(len(timestamps), holdout, heldout)
        make_folder(Path(folder))
        info = SceneInfo(
            version=VERSION, name=name, source=source, width=width, height=height,
            source_fps=source_fps, timestamps=list(map(float, timestamps)), train=train, heldout=heldout,
            notes=list(notes), audio=audio, audio_start=audio_start, priors={}, similarity=None,
            input_frames=input_frames,
        )  # fmt: skip
        write_json(Path(folder) / "scene.json", info.to_json())
        return Scene(folder)

    # -- the record

    @property
    def info(self) -> SceneInfo:
        """What ``scene.json`` says; the methods of this class change it."""
        return self._info

    @property
    def name(self) -> str:
        """What the scene is called."""
        return self._info.name

    def _change(self, **changes: Any) -> None:
        """Set fields of the record, all at once: a kill leaves the file with all of them or with none."""
        self._info = replace(self._info, **changes)
        write_json(self.folder / "scene.json", self._info.to_json())

    def mark_ingested(self, sound: str | None = None, notes: Sequence[str] = ()) -> None:
        """Note that everything of the input is here.

        Args:
            sound: the name of the file in the folder with the sound of the clip, from its first frame on.
            notes: what more was done to the input, in sentences for the user.
        """
        changes = {} if sound is None else {"audio": sound, "audio_start": 0.0}
        self._change(ingested=True, notes=[*self._info.notes, *notes], **changes)

    def mark_oracle(self, name: str, identity: Mapping[str, Any]) -> None:
        """Note that this copy of a scene gets true priors in the place of some of its own.

        Args:
            name: what it is called from now on.
            identity: which oracle of which scene it is.
        """
        self._change(name=name, oracle=identity)

    def begin_straightening(self, lens: Mapping[str, Any], cameras: Mapping[str, Any]) -> None:
        """Note that a lens is being taken out of the images.

        Args:
            cameras: how the cameras were made, which are complete once the images are straight.
        """
        self._change(lens=lens, straightening=cameras)

    def mark_images_complete(self) -> None:
        """Note that all straightened images are there, and take the places of the others from now on."""
        self._change(images_replaced=True)

    def finish_straightening(self, note: str) -> None:
        """Note that the images are straight and the cameras complete; ``note`` tells the user."""
        pending = self._info.straightening
        assert pending is not None
        self._change(
            straightening=None, images_replaced=False, notes=[*self._info.notes, note],
            priors={**self._info.priors, "cameras": pending},
        )  # fmt: skip

    @property
    def sound(self) -> tuple[Path, float] | None:
        """The file of the clip's sound, and at which second of it the clip starts.

        It lies in the folder of the scene: a scene may come from anybody, so a file elsewhere is left alone.
        """
        audio, start = self._info.audio, float(self._info.audio_start or 0.0)
        if not audio:
            return None
        if Path(audio).name != audio or not (self.folder / audio).is_file():
            report_once(f"The sound of {self.name} does not lie in {self.folder} and is left out: prepare it again to have it.")
            return None
        return self.folder / plain_name(audio, "The sound"), start

    @property
    def lens(self) -> Lens | None:
        """The lens that was, or is being, taken out of the images; None while they are as they came.

        Raises:
            InputError: what is noted of it is damaged.
        """
        if self._info.lens is None:
            return None
        try:
            lens = Lens.from_json(self._info.lens)
            if (lens.width, lens.height) != (self.width, self.height):
                raise ValueError("it is of other images")
        except (KeyError, TypeError, ValueError, ArithmeticError) as error:
            raise InputError(f"{self.folder / 'scene.json'} does not hold the lens of its images: {error}.") from error
        return lens

    # -- time and split

    @property
    def num_frames(self) -> int:
        """Frames of the clip, held-out ones included."""
        return len(self.timestamps)

    @property
    def times(self) -> np.ndarray:
        """[T] float64: the timestamps in clip units, first frame 0, last frame 1."""
        first, last = self.timestamps[0], self.timestamps[-1]
        return (self.timestamps - first) / (last - first)

    def _require_training(self, *frames: int) -> None:
        for i in frames:
            if i not in self._train:
                raise SplitError(f"frame {i} of {self.folder} is not a training frame")

    # -- images

    def _frame_path(self, i: int) -> Path:
        return (self.folder if i in self._train else self.folder / "heldout") / "frames" / f"{i:05d}.png"

    def write_frame(self, i: int, image: np.ndarray) -> None:
        """Write an RGB image [H, W, 3] uint8; the split decides where it lands."""
        write_image(self._frame_path(i), image)

    def has_frame(self, i: int) -> bool:
        """Return whether the image of frame ``i`` is there."""
        return self._frame_path(i).exists()

    def any_frame(self, i: int) -> np.ndarray:
        """Return RGB [H, W, 3] uint8 of any frame. For the camera stage, and for ``ingest``, which writes them."""
        image = read_image(self._frame_path(i), (self.width, self.height))
        if image.shape != (self.height, self.width, 3):
            raise InputError(f"{self._frame_path(i)} has shape {image.shape}, expected {(self.height, self.width, 3)}.")
        return image

    def frame(self, i: int) -> np.ndarray:
        """Return RGB [H, W, 3] uint8 of a training frame."""
        self._require_training(i)
        return self.any_frame(i)

    def heldout_frame(self, i: int) -> np.ndarray:
        """Return RGB [H, W, 3] uint8 of a held-out frame. For what comes after the training only."""
        if i in self._train:
            raise SplitError(f"frame {i} is a training frame")
        return self.any_frame(i)

    # -- what is burnt in

    @property
    def _overlay_path(self) -> Path:
        return self.folder / "overlay" / "mask.png"

    @property
    def overlay(self) -> np.ndarray | None:
        """[H, W] bool: pixels of a logo, clock or watermark, which show nothing of the scene; None where there are none."""
        if not self._overlay_path.exists():
            return None
        mask = read_image(self._overlay_path, (self.width, self.height))
        if mask.shape != (self.height, self.width):
            raise InputError(f"{self._overlay_path} is in color, but a mask is expected.")
        return mask > 0

    def overlay_frame(self, i: int) -> np.ndarray | None:
        """Return RGB [H, W, 3] uint8 of what is burnt into any frame, black elsewhere; None where it is not known.

        It shows nothing of the scene, so the split does not guard it.
        """
        path = self._overlay_path.with_name(f"{i:05d}.png")
        if not path.exists():
            return None
        image = read_image(path, (self.width, self.height))
        if image.shape != (self.height, self.width, 3):
            raise InputError(f"{path} is no image in color.")
        return image

    def write_overlay_frame(self, i: int, image: np.ndarray) -> None:
        """Keep RGB [H, W, 3] uint8 of what is burnt into frame ``i``, black elsewhere."""
        write_image(self._overlay_path.with_name(f"{i:05d}.png"), image)

    def write_overlay(self, overlay: np.ndarray) -> None:
        """Note which pixels [H, W] bool are burnt in; layers that are written before are not changed."""
        write_image(self._overlay_path, overlay.astype(np.uint8) * 255)

    # -- layers, guarded by the split

    @property
    def cameras(self) -> list[Camera]:
        """One camera a frame.

        Raises:
            InputError: missing, damaged, not finite, or not one for every frame.
        """
        cameras = super().cameras
        if len(cameras) != self.num_frames:
            raise InputError(f"{self.folder / 'cameras.json'} has {len(cameras)} cameras for {self.num_frames} frames.")
        return cameras

    def depth(self, i: int) -> Depth:
        self._require_training(i)
        return super().depth(i)

    def read_stored_flow(self, i: int, j: int) -> StoredFlow:
        self._require_training(i, j)
        return super().read_stored_flow(i, j)

    def mask(self, i: int) -> np.ndarray:
        self._require_training(i)
        return super().mask(i)

    def write_depth(self, i: int, depth: Depth) -> None:
        self._require_training(i)
        overlay = self.overlay
        super().write_depth(i, depth if overlay is None else replace(depth, confidence=np.where(overlay, 0, depth.confidence)))

    def write_flow(self, flow: Flow) -> None:
        self._require_training(flow.i, flow.j)
        super().write_flow(replace(flow, confidence=hide_overlay(self.overlay, flow.flow, flow.confidence)))

    def write_mask(self, i: int, mask: np.ndarray) -> None:
        self._require_training(i)
        overlay = self.overlay
        super().write_mask(i, mask if overlay is None else np.where(overlay, 0, mask))

    def write_tracks(self, tracks: Tracks) -> None:
        if tracks.visible[:, self.heldout_frames].any():
            raise SplitError("tracks are visible in held-out frames")
        overlay = self.overlay
        if overlay is not None:
            seen = tracks.visible & ~look_up_mask(overlay, tracks.points)
            tracks = replace(tracks, visible=seen, confidence=np.where(seen, tracks.confidence, 0))
        super().write_tracks(tracks)

    @property
    def heldout_masks(self) -> Layers:
        """Masks that came with the input for held-out frames. For the evaluation only."""
        return Layers(self.folder / "heldout", self.width, self.height)

    # -- priors as a whole

    def prior(self, name: str) -> Mapping[str, Any] | None:
        """Return how a prior was made; None while it is missing or unfinished. ``priors/graph.py`` lists their names."""
        return self._info.priors.get(name)

    def finish_prior(self, name: str, **how: Any) -> None:
        """Note that a prior is complete, and how it was made (at least ``method``)."""
        self._change(priors={**self._info.priors, name: how})

    def amend_prior(self, name: str, **how: Any) -> None:
        """Note more, or other things, of how a prior was made."""
        self.finish_prior(name, **{**(self.prior(name) or {}), **how})

    def forget_priors(self, names: Collection[str]) -> None:
        """Note that priors are not there; their files stay. Without depth nothing says how large the scene is, either."""
        priors = {name: how for name, how in self._info.priors.items() if name not in names}
        self._change(priors=priors, similarity=None if "depth" in names else self._info.similarity)

    # -- scale

    @property
    def similarity(self) -> Similarity:
        """World to the normalized coordinates of training: median depth of the training pixels 1, first camera near the origin.

        Raises:
            InputError: the scene has no depth yet.
        """
        if self._info.similarity is None:
            samples = [self.depth(i) for i in self.train_frames[:: max(1, len(self.train_frames) // 16)]]
            trusted = np.concatenate([d.depth[d.trusted][::17] for d in samples])
            median = float(np.median(trusted if len(trusted) else np.concatenate([d.depth.ravel() for d in samples])))
            centers = np.array([self.cameras[i].center for i in self.train_frames])
            self.write_similarity(Similarity(1 / median, np.eye(3), -centers.mean(0) / median))
        assert self._info.similarity is not None
        return Similarity.from_json(self._info.similarity)

    def write_similarity(self, similarity: Similarity | None) -> None:
        """Set it; None = it is computed again when it is asked for, from depth that changed."""
        self._change(similarity=None if similarity is None else similarity.to_json())

    # -- truth and held-out views

    @property
    def truth(self) -> Layers | None:
        """The true layers of a rendered scene. For the evaluation, and for ``--priors true``."""
        folder = self.folder / "truth"
        return Layers(folder, self.width, self.height) if folder.exists() else None

    def create_truth(self) -> Layers:
        """Start the folder of truth."""
        return Layers(make_folder(self.folder / "truth"), self.width, self.height)

    @property
    def views(self) -> list[HeldoutView]:
        """The held-out views, if any."""
        path = self.folder / "views.json"
        if not path.exists():
            return []
        found = []
        for value in read_json(path, list[ViewFile]):
            view = HeldoutView(plain_name(value["name"], f"{path}: the view"), value["frame"], Camera.from_json(value["camera"]))
            if view.frame >= self.num_frames or not view.camera.is_valid:
                raise InputError(f"{path}: the view {view.name} is of no frame of the clip, or has a camera that is none.")
            found.append(view)
        return found

    def write_view(
        self, view: HeldoutView, image: np.ndarray, mask: np.ndarray | None = None, covisible: np.ndarray | None = None
    ) -> None:
        """Add a held-out view; ``mask`` marks objects in it, ``covisible`` what the clip itself saw ([H, W] bool)."""
        plain_name(view.name, "The held-out view")
        write_image(self.folder / "views" / f"{view.name}.png", image)
        for suffix, extra in (("mask", mask), ("covisible", covisible)):
            if extra is not None:
                write_image(self.folder / "views" / f"{view.name}_{suffix}.png", (extra > 0).astype(np.uint8) * 255)
        views = [v for v in self.views if v.name != view.name] + [view]
        values = [{"name": v.name, "frame": v.frame, "camera": v.camera.to_json()} for v in views]
        write_json(self.folder / "views.json", values)

    def view_image(self, view: HeldoutView) -> np.ndarray:
        """Return RGB [H, W, 3] uint8 of a held-out view. For the evaluation only."""
        path = self.folder / "views" / f"{view.name}.png"
        image = read_image(path, (view.camera.width, view.camera.height))
        if image.ndim != 3 or image.shape[2] != 3:
            raise InputError(f"{path} is no image in color.")
        return image

    def view_mask(self, view: HeldoutView, kind: str = "mask") -> np.ndarray | None:
        """Return [H, W] bool: objects (``mask``) or pixels that the clip saw (``covisible``); None where not given."""
        path = self.folder / "views" / f"{view.name}_{kind}.png"
        return read_image(path, (view.camera.width, view.camera.height)) > 0 if path.exists() else None
