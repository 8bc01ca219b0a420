"""Controls for what a client exports: screenshots, and camera paths that are made here or read from a file."""

from __future__ import annotations

import shlex
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import viser

from flowsplat.common.errors import InputError
from flowsplat.common.files import plain_name
from flowsplat.geometry import Camera
from flowsplat.output.camera_files import read_camera_file, write_camera_file
from flowsplat.output.videos.options import RenderOptions
from flowsplat.output.videos.paths import PATHS
from flowsplat.output.videos.plans import plan_videos
from flowsplat.output.videos.shots import GIF_FPS
from flowsplat.output.viewer.browser_frame import BrowserFrame
from flowsplat.output.viewer.controls import Controls
from flowsplat.output.viewer.drawing import Wish, draw_shot
from flowsplat.output.viewer.keys import CameraKeys
from flowsplat.output.viewer.layout import Box, empty, fit_box, place
from flowsplat.output.viewer.messages import MAX_UPLOAD_BYTES
from flowsplat.output.viewer.notifications import Notifications
from flowsplat.output.viewer.recording import (
    OWN_RATE,
    OWN_SIZE,
    RATES,
    RECORDINGS,
    SIZES,
    Recording,
    next_file,
    record_path,
    take_screenshot,
)
from flowsplat.output.viewer.session import Session
from flowsplat.output.viewer.source import Source
from flowsplat.output.viewer.worker import Worker

_JPEG_QUALITY = 75
"""Of the JPEGs of a path that is played. Chosen by eye."""
_READY_HINT = "The paths that flowsplat render knows, at the speed set above; where time stands still, at this moment of the clip. "
_RECORDINGS_HINT = "mp4 and gif: what is shown, for two eyes if so set. webm: what moves, on transparent."
_SIZE_HINT = "The shorter side in pixels. Larger than the clip shows no more detail."
_RATE_HINT = f"A GIF has {GIF_FPS:g} where nothing is chosen."


def render_command(source: Source, path: Path) -> str:
    """Return the command that renders a camera file: a run beside its other videos, a file of static Gaussians it alone."""
    of = [source.folder] if source.file is None else [source.file, "-o", source.folder]
    alone = [] if source.file is None else ["--render.paths"]
    return shlex.join(map(str, ["flowsplat", "render", *of, "--render.camera-file", path, *alone]))


class ExportPanel:
    """The folder of controls for screenshots and camera paths of one client."""

    def __init__(self, client: viser.ClientHandle, notifications: Notifications, source: Source, worker: Worker, session: Session):
        self._client, self._notifications = client, notifications
        self._source, self._worker, self._session = source, worker, session
        self._browser = BrowserFrame(source.scene.similarity)
        self._keys = CameraKeys()
        self._planned: object | None = None
        self._fps = float(source.scene.info.source_fps)
        gui, controls = client.gui, Controls(client.gui)
        with gui.add_folder("Export", expand_by_default=False):
            screenshot = gui.add_button("Screenshot", icon=viser.Icon.CAMERA)
            self._count = gui.add_markdown("No keys yet.")
            hint = _READY_HINT + PATHS.describe()
            self._ready = controls.add_dropdown("Ready-made path", PATHS.names(), initial_value="orbit", hint=hint)
            ready = gui.add_button("Take this path", icon=viser.Icon.ROUTE)
            add = gui.add_button("Add a key here", icon=viser.Icon.PLUS)
            self._spacing = controls.add_slider("Seconds a key", min=0.1, max=10.0, step=0.1, initial_value=1.0)
            preview = gui.add_button("Play the path", icon=viser.Icon.PLAYER_PLAY)
            self._suffix = controls.add_dropdown("Record as", RECORDINGS, initial_value=".mp4", hint=_RECORDINGS_HINT)
            self._size = controls.add_dropdown("Size", SIZES, initial_value=OWN_SIZE, hint=_SIZE_HINT)
            self._rate = controls.add_dropdown("Frames a second", RATES, initial_value=OWN_RATE, hint=_RATE_HINT)
            record = gui.add_button("Record it", icon=viser.Icon.VIDEO)
            save = gui.add_button("Save the path", icon=viser.Icon.DEVICE_FLOPPY)
            self._load = gui.add_upload_button("Load a path", mime_type="application/json", icon=viser.Icon.UPLOAD)
            clear = gui.add_button("Clear the path", icon=viser.Icon.TRASH)
        for button, action in (
            (screenshot, self._take_screenshot), (ready, self._take_ready), (add, self._add_key), (preview, self._preview),
            (record, self._record), (save, self._save_path), (clear, self._clear),
        ):  # fmt: skip
            button.on_click(notifications.callback(action))
        self._load.on_upload(notifications.callback(self._load_path))
        self._spacing.on_update(notifications.callback(self._set_spacing))

    @property
    def _folder(self) -> Path:
        return self._source.folder / "viewer"

    def _finish(self, path: Path) -> None:
        """Tell where a file is, and offer it to the browser, which may be on another machine."""
        self._notifications.show("Written", str(path))
        self._client.send_file_download(path.name, path.read_bytes())

    def _begin(self, task: Iterator[None]) -> None:
        def guarded() -> Iterator[None]:
            try:
                yield from task
            except InputError as error:
                self._notifications.show_error(error)

        self._worker.begin(self._client.client_id, guarded())

    def _take_screenshot(self) -> None:
        session = self._session
        with self._worker.change():
            assert session.canvas is not None
            now = time.monotonic()
            wish = Wish(session.resolution.still(session.canvas), session.clock.at(now), session.look, *session.view(now))
        path = next_file(self._folder, "screenshot", ".png")
        self._begin(take_screenshot(self._source, self._browser, wish, path, self._finish))

    def _camera_here(self) -> Camera:
        """Return what the client sees, as a camera with the size of the clip."""
        now = time.monotonic()
        pose, turn = self._session.view(now)
        if pose is None:
            return self._source.input_camera(self._session.clock.at(now), turn)
        return self._browser.camera(pose, *self._source.size)

    def _add_key(self) -> None:
        self._planned = None
        with self._worker.change():
            self._keys.add(self._camera_here(), self._session.clock.at(time.monotonic()))
        self._count_keys()

    def _count_keys(self) -> None:
        keys = self._keys
        number = "1 key" if len(keys.keys) == 1 else f"{len(keys.keys)} keys"
        self._count.content = f"{number}, {keys.seconds:.1f} s." if keys.keys else "No keys yet."

    def _take_ready(self) -> None:
        clock = self._session.clock
        now = clock.at(time.monotonic())
        options = RenderOptions(paths=(self._ready.value,), slow_motion=1 / clock.speed, bullet_time=now)
        self._keys = CameraKeys(float(self._spacing.value))
        self._count.content = "Working it out ..."
        self._planned = planned = object()
        self._begin(self._plan(options, planned))

    def _plan(self, options: RenderOptions, planned: object) -> Iterator[None]:
        """Take the path, if it is still what the user wants then."""
        try:
            (plan,) = plan_videos(self._source.loaded.part("all"), self._source.scene, options)
            if self._planned is planned:
                self._keys = CameraKeys.of_shots(plan.shots, plan.fps)
        finally:
            if self._planned is planned:
                self._planned = None
            self._count_keys()
        yield

    def _set_spacing(self) -> None:
        self._keys.spacing = float(self._spacing.value)
        self._count_keys()

    def _clear(self) -> None:
        self._planned = None
        self._keys = CameraKeys(float(self._spacing.value))
        self._count_keys()

    def _begin_with_keys(self, use: Callable[[CameraKeys], Iterator[None]]) -> None:
        """Do something with the path: once it is worked out, where it was only asked for."""

        def wait() -> Iterator[None]:
            while self._planned is not None:
                yield
            if not self._keys.keys:
                raise InputError("The path has no keys yet: move the camera and the time, and add some.")
            yield from use(self._keys)

        self._begin(wait())

    def _preview(self) -> None:
        self._begin_with_keys(self._play)

    def _play(self, keys: CameraKeys) -> Iterator[None]:
        session, shot_at, started = self._session, keys.shot_at(), time.monotonic()
        with self._worker.change():
            session.is_held = True
        try:
            while (passed := time.monotonic() - started) <= keys.seconds:
                camera, t = shot_at(passed)
                size = session.resolution.choose_moving_size((camera.width, camera.height))
                before = time.monotonic()
                image = draw_shot(self._source, self._browser, camera.resize(*size), t, session.look)
                session.resolution.learn(size, time.monotonic() - before)
                self._client.scene.set_background_image(self._add_bars(image), format="jpeg", jpeg_quality=_JPEG_QUALITY)
                yield
        finally:
            with self._worker.change():
                session.is_held = False
                session.change(time.monotonic())

    def _add_bars(self, image: np.ndarray) -> np.ndarray:
        """Return an image with bars, so that it has the shape of the window."""
        height, width = image.shape[:2]
        shape = self._client.camera.image_width / self._client.camera.image_height
        size = (max(width, round(height * shape)), max(height, round(width / shape)))
        canvas = empty(size)
        place(canvas, image, fit_box((width, height), Box(0, 0, *size)))
        return canvas

    def _record(self) -> None:
        suffix, size, rate, look = self._suffix.value, self._size.value, self._rate.value, self._session.look

        def tell(text: str) -> None:
            self._count.content = text

        def finished(path: Path) -> None:
            self._count_keys()
            self._finish(path)

        def record(keys: CameraKeys) -> Iterator[None]:
            recording = Recording(next_file(self._folder, "recording", suffix), size, rate)
            return record_path(self._source, self._browser, keys, self._fps, look, recording, tell, finished)

        self._begin_with_keys(record)

    def _save_path(self) -> None:
        self._begin_with_keys(self._save)

    def _save(self, keys: CameraKeys) -> Iterator[None]:
        shots = keys.shots(self._fps)
        path = next_file(self._folder, "path", ".json")
        write_camera_file(path, shots, self._fps)
        self._finish(path)
        distances = [f"{number}={factor:g}" for number, factor in self._session.look.distances]
        options = "".join(f" {word}" for word in ("--render.object-depth", *distances) if distances)
        options += " --render.confidence-fade" if self._session.look.confidence_fade else ""
        self._notifications.show("Render it", render_command(self._source, path) + options)
        if self._session.look.crop is not None:
            self._notifications.show(
                "Without the box", "flowsplat render draws all of the scene; what is recorded here is cropped."
            )
        yield

    def _load_path(self) -> None:
        name, content = plain_name(self._load.value.name, "The file"), self._load.value.content
        if not content:
            raise InputError(f"{name} is empty, or has more than the {MAX_UPLOAD_BYTES / 2**20:g} MiB that can be loaded here.")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_bytes(content)
            found = read_camera_file(path, self._source.size, self._source.clip)
        self._planned = None
        self._keys = CameraKeys.of_shots(found.shots, found.fps or self._fps)
        self._count_keys()
