"""The controls of one client: what is set here becomes its ``Session``, what is rendered for it is shown here."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import viser

from flowsplat.common.spread import spread
from flowsplat.gaussians.renderer import PARTS
from flowsplat.output.viewer.browser_frame import SCENE_DEPTH, BrowserFrame, Pose
from flowsplat.output.viewer.controls import Control, Controls, as_text
from flowsplat.output.viewer.crop_panel import CropPanel
from flowsplat.output.viewer.drawing import Compare, Drawing, ImageKind, Look
from flowsplat.output.viewer.export_panel import ExportPanel
from flowsplat.output.viewer.layout import Box, fit_box
from flowsplat.output.viewer.notifications import Notifications
from flowsplat.output.viewer.session import ImageJob, Mode, Session
from flowsplat.output.viewer.source import Source
from flowsplat.output.viewer.trails import trails
from flowsplat.output.viewer.worker import Worker
from flowsplat.priors.objects import load_objects
from flowsplat.priors.objects.description import describe_objects, word_hint
from flowsplat.scenes import Scene

_SPEEDS = {"1/10": 0.1, "1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0}
_MAX_FRUSTA = 24
"""Cameras of the path that are drawn, at most. Chosen by eye."""
_FRUSTUM_SIZE = 0.25
"""Size of a frustum in the browser's coordinates. Chosen by eye."""
_PIVOT_DISTANCE = {"orbit": SCENE_DEPTH, "fly": 0.05}
"""How far ahead of the camera the point lies round which dragging turns it."""
_KEPT_PLACES = 32
"""Of those where the browser's camera was put: as many may be on their way. Chosen by eye."""
_TIME_STEP = 0.001
"""Seconds. Chosen by eye."""
_MAX_ENLARGEMENT = 2
"""Times the size of the clip. Beyond that, the gaps between Gaussians are seen rather than the scene. Chosen by eye."""
_MODE_HINT = "The input camera follows the clip. Orbit turns round the scene, fly looks about; W A S D Q E move."
_FARTHER_HINT = "Let go of the input camera, to turn and fly as far as you like: what the clip does not tell fades."
_DOUBLE_CLICK_SECONDS, _DOUBLE_CLICK_REACH = 0.4, 0.02
"""Between two clicks that are one double click, and how far they may be apart, as a share of the window. Chosen by eye."""
_MAX_OBJECTS = 16
"""Objects that can be chosen: those with the most Gaussians. Chosen by eye."""
_DISTANCE_RANGE, _DISTANCE_STEP = (0.3, 3.0), 0.01
"""Times as far from the clip's camera as trained. Chosen by eye."""
_CONFIDENCE_FADE_HINT = "What the clip has not seen well enough to tell what it looks like from here is black."
_DISTANCE_HINT = (
    "Times as far from the clip's camera. The clip's own frames stay as they are, except for which object covers which."
)
_STILL_QUALITY, _MOVING_QUALITY = 92, 75
"""Of the JPEGs. Chosen by eye."""


class Panel:
    """The controls of one client."""

    def __init__(self, client: viser.ClientHandle, source: Source, worker: Worker, largest: int):
        """``largest``: pixels of the longer side of a still image."""
        self.client = client
        self._source, self._worker = source, worker
        self.scene = source.scene
        self._is_over = False
        self._browser = BrowserFrame(source.scene.similarity)
        self._session = Session(source.clip, min(largest, _MAX_ENLARGEMENT * max(source.size)))
        self._notifications = Notifications(client)
        self._clicked = float("-inf"), (0.0, 0.0)
        self._overlays: dict[str, Any] = {}
        self._stood: deque[np.ndarray] = deque(maxlen=_KEPT_PLACES)
        self._is_there = False
        """The browser has told that its camera is where it was put since the input camera is looked through: from elsewhere no hand
        has pulled it."""
        counts = source.loaded.part("all").gaussians.object_counts
        self._objects = sorted(sorted(counts, key=lambda number: -counts[number])[:_MAX_OBJECTS])
        self._build()
        ExportPanel(client, self._notifications, source, worker, self._session)

    def begin(self) -> None:
        """Stand where the clip begins, and get images from now on."""
        self._stand(self._find_input_pose(), _PIVOT_DISTANCE["orbit"])
        self.client.camera.on_update(self._follow_camera)
        self.client.scene.on_click()(lambda event: self._follow_click(event.screen_pos))
        self._worker.add(self.client.client_id, self._session, self._show)
        self._follow_camera(self.client.camera, is_told=False)

    def leave(self) -> None:
        """Send nothing more: the client has gone."""
        self._is_over = True
        if self._crop is not None:
            self._crop.end()

    def end(self) -> None:
        """Take away what was made for the client: another scene is shown to it."""
        self.leave()
        self.client.gui.reset()
        self.client.scene.reset()

    def reload(self) -> None:
        """There is a newer model."""
        self._status.content = self._state()
        if self._crop is not None:
            self._crop.tell()
        if self._trails.value:
            self._draw_trails()

    # -- the controls

    def _build(self) -> None:
        gui, controls, (first, last) = self.client.gui, Controls(self.client.gui), self._source.clip
        self._status = gui.add_markdown(self._state())
        with gui.add_folder("Time"):
            self._time = controls.add_slider("Seconds", min=first, max=last, step=_TIME_STEP, initial_value=first)
            self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
            self._speed = controls.add_dropdown("Speed", tuple(_SPEEDS), initial_value="1")
            self._loop = controls.add_checkbox("Loop", True)
        with gui.add_folder("Camera"):
            self._mode = controls.add_dropdown("Mode", get_args(Mode), initial_value="input camera", hint=_MODE_HINT)
            self._farther = controls.add_checkbox("Look farther", False, hint=_FARTHER_HINT)
            home = gui.add_button("To the input camera", icon=viser.Icon.HOME)
        with gui.add_folder("Image"):
            self._what = controls.add_dropdown("Show", get_args(ImageKind), initial_value="color")
            self._part = controls.add_dropdown("Part", (*PARTS, *(f"objects:{n}" for n in self._objects)), initial_value="all")
            self._compare = controls.add_dropdown("Input frame", get_args(Compare), initial_value="off")
            self._wipe = controls.add_slider("Wipe", min=0.0, max=1.0, step=0.01, initial_value=0.5, visible=False)
            self._stereo = controls.add_checkbox("Stereo pair", False, hint="For two eyes, left beside right.")
            self._confidence_fade = controls.add_checkbox("Only what the clip tells", False, hint=_CONFIDENCE_FADE_HINT)
        self._distances: dict[int, Control] = {}
        self._crop: CropPanel | None = None
        self._fades_for_now = False
        """Guesses fade because of "Look farther", and will not when it is off."""
        if self._objects:
            with gui.add_folder("Distance of objects", expand_by_default=False):
                gui.add_markdown(_DISTANCE_HINT)
                hints = _list_suggested_hints(self._source.scene)
                for number in self._objects:
                    if number in hints:
                        gui.add_markdown(word_hint(number, hints[number]))
                    near, far = _DISTANCE_RANGE
                    slider = controls.add_slider(f"Object {number}", min=near, max=far, step=_DISTANCE_STEP, initial_value=1.0)
                    self._distances[number] = slider
                trained = gui.add_button("As trained", icon=viser.Icon.ARROW_BACK)
            trained.on_click(self._notifications.callback(self._reset_distances))
        if len(self._source.loaded.part("all").gaussians):
            self._crop = CropPanel(self.client, self._notifications, self._source, self._browser, self._set_look)
        with gui.add_folder("Drawn into it"):
            self._cameras = controls.add_checkbox("Cameras", False)
            self._trails = controls.add_checkbox("Paths of Gaussians", False)
            self._tracks = controls.add_checkbox("Tracks of the clip", False, hint="Seen from the input camera.",
                                            visible=self._source.scene.has_tracks)  # fmt: skip
        for button, action in ((self._play, self._toggle), (home, self._go_home)):
            button.on_click(self._notifications.callback(action))
        for control, action in (
            (self._time, self._seek), (self._speed, self._set_speed), (self._loop, self._set_loop),
            (self._mode, self._take_mode), (self._farther, self._look_farther), (self._cameras, self._draw_cameras),
            (self._trails, self._draw_trails),
        ):  # fmt: skip
            control.on_update(self._notifications.callback(action))
        for control in (self._what, self._part, self._compare, self._wipe, self._stereo, self._confidence_fade, self._tracks):
            control.on_update(self._notifications.callback(self._set_look))
        for slider in self._distances.values():
            slider.on_update(self._notifications.callback(self._set_look))

    def _state(self) -> str:
        source = self._source
        count = len(source.loaded.part("all").gaussians)
        return f"**{as_text(source.scene.name)}** · {source.loaded.state} · {count:,} Gaussians"

    # -- time

    def _toggle(self) -> None:
        now = time.monotonic()
        with self._worker.change():
            self._session.clock.play(not self._session.clock.playing, now)
        self._label_play()

    def _label_play(self) -> None:
        label = "Pause" if self._session.clock.playing else "Play"
        if self._play.label != label:
            self._play.label = label
            self._play.icon = viser.Icon.PLAYER_PAUSE if label == "Pause" else viser.Icon.PLAYER_PLAY

    def _seek(self) -> None:
        seconds, now = float(self._time.take()), time.monotonic()
        with self._worker.change():
            self._session.clock.set(seconds, now)
            self._session.change(now)

    def _set_speed(self) -> None:
        with self._worker.change():
            self._session.clock.set_speed(_SPEEDS[self._speed.value], time.monotonic())

    def _set_loop(self) -> None:
        with self._worker.change():
            self._session.clock.loop = self._loop.value

    # -- camera

    def _follow_camera(self, camera: viser.CameraHandle, is_told: bool = True) -> None:
        """``is_told``: by the browser."""
        if self._is_over:
            return
        with self._worker.change():  # also while it is read: it may be brought elsewhere at this moment
            now, session = time.monotonic(), self._session
            pose = Pose(np.array(camera.wxyz), np.array(camera.position), float(camera.fov))
            session.move(pose, (camera.image_width, camera.image_height), now)
            # Where it was put itself, a browser may tell of late.
            is_where_put = any(np.abs(pose.position - each).max() <= 1e-3 for each in self._stood)
            self._is_there |= is_where_put and is_told
            is_moved = session.mode == "input camera" and not is_where_put
            # While it plays, the browser's camera is always a little behind.
            is_pulled = is_moved and self._is_there and not session.clock.playing and session.look.compare != "wipe"
            if is_pulled:
                turn = self._browser.turn_between(self._browser.pose(self._source.path.at(session.clock.at(now))), pose)
                session.elastic.pull(turn, self._source.reach, now)
                session.change(now)
        if is_moved and not is_pulled:
            self._stand(self._find_input_pose(), _PIVOT_DISTANCE["orbit"])

    def _follow_click(self, place: tuple[float, float]) -> None:
        """Two clicks on one place, as shares of the window, lead back to the input camera, as in the exported page."""
        now, (before, at) = time.monotonic(), self._clicked
        is_second = now - before <= _DOUBLE_CLICK_SECONDS and np.abs(np.subtract(place, at)).max() <= _DOUBLE_CLICK_REACH
        self._clicked = (float("-inf") if is_second else now), place
        if is_second and not self._is_over:
            self._go_home()

    def _stand(self, pose: Pose, reach: float) -> None:
        """Bring the browser's camera to a pose, turning about a point ``reach`` ahead of it."""
        self._stood.append(pose.position)
        camera = self.client.camera
        up = -self._browser.from_scene.camera(self._browser.camera(pose, 2, 2)).viewmat[1, :3]
        with self.client.atomic():
            camera.position = pose.position
            camera.up_direction = up
            camera.look_at = pose.position + pose.forward * reach
            camera.fov = pose.fov

    def _find_input_pose(self) -> Pose:
        """Return the input camera at this time, turned as it is looked past, all of its image inside the window."""
        now = time.monotonic()
        shown = self._source.input_camera(self._session.clock.at(now), self._session.elastic.turn(now))
        canvas = (self.client.camera.image_width, self.client.camera.image_height)
        box = fit_box(self._source.size, Box(0, 0, *canvas))
        pose = self._browser.pose(shown)
        return Pose(pose.wxyz, pose.position, 2 * float(np.arctan(np.tan(pose.fov / 2) * canvas[1] / box.height)))

    def _look_farther(self) -> None:
        """Let go of the input camera, without guesses; and back."""
        is_farther = self._farther.take()
        if is_farther and not self._confidence_fade.value:
            _set_value(self._confidence_fade, True)
            self._fades_for_now = True
        self._set_mode("orbit" if is_farther else "input camera")
        self._set_look()
        if not is_farther:
            self._go_home()

    def _go_home(self) -> None:
        with self._worker.change():
            self._session.elastic.reset()
            self._session.change(time.monotonic())
            self._stand(self._find_input_pose(), _PIVOT_DISTANCE.get(self._session.mode, SCENE_DEPTH))

    def _take_mode(self) -> None:
        self._set_mode(self._mode.take())

    def _set_mode(self, mode: Mode) -> None:
        _set_value(self._mode, mode)
        with self._worker.change():
            self._is_there &= self._session.mode == mode
            self._session.mode = mode
            self._session.change(time.monotonic())
        _set_value(self._farther, mode != "input camera")
        if mode == "input camera" and self._fades_for_now:
            _set_value(self._confidence_fade, False)
            self._fades_for_now = False
            self._set_look()
        if mode != "input camera":
            camera = self.client.camera
            here = Pose(np.array(camera.wxyz), np.array(camera.position), float(camera.fov))
            self._stand(here, _PIVOT_DISTANCE[mode])
            if self._session.look.compare == "wipe":
                _set_value(self._compare, "off")
                self._set_look()

    # -- image

    def _set_look(self) -> None:
        distances = tuple((number, float(slider.value)) for number, slider in self._distances.items() if slider.value != 1)
        look = Look(
            self._what.value, self._part.value, self._compare.value, float(self._wipe.value), self._tracks.value,
            self._stereo.value, distances, self._confidence_fade.value, None if self._crop is None else self._crop.box,
        )  # fmt: skip
        before = self._session.look
        are_moved = (look.distances, look.crop) != (before.distances, before.crop)
        self._wipe.visible = look.compare == "wipe"
        if look.compare == "wipe" and self._mode.value != "input camera":
            # A frame can only lie over what was seen from the same place.
            self._set_mode("input camera")
            look = replace(look, confidence_fade=self._confidence_fade.value)
        with self._worker.change():
            if look.compare == "wipe":
                self._session.elastic.reset()
            self._session.look = look
            self._session.change(time.monotonic())
        if are_moved and self._trails.value:
            self._draw_trails()

    def _reset_distances(self) -> None:
        for slider in self._distances.values():
            _set_value(slider, 1.0)
        self._set_look()

    def _show(self, job: ImageJob, drawing: Drawing) -> None:
        """Bring an image to the browser; called by the worker."""
        drawn_into = self._cameras.value or self._trails.value or (self._crop is not None and self._crop.is_drawn)
        quality = _STILL_QUALITY if job.is_still else _MOVING_QUALITY
        depth = drawing.depth if drawn_into else None
        self.client.scene.set_background_image(drawing.image, format="jpeg", jpeg_quality=quality, depth=depth)
        # A hand that pulls is told where it is at the end alone: each word of it would end what it does.
        if job.wish.pose is None and not self._session.elastic.is_held(time.monotonic()):
            self._stand(drawing.pose, _PIVOT_DISTANCE["orbit"])
        _set_value(self._time, float(np.clip(round(job.wish.t, 3), *self._source.clip)))
        self._label_play()

    # -- drawn by the browser

    def _draw_cameras(self) -> None:
        if "cameras" not in self._overlays and self._cameras.value:
            self._overlays["cameras"] = self._add_cameras()
        if "cameras" in self._overlays:
            self._overlays["cameras"].visible = self._cameras.value
        self._redraw()

    def _add_cameras(self) -> viser.FrameHandle:
        scene, cameras = self.client.scene, self._source.path.cameras
        parent = scene.add_frame("/cameras", show_axes=False)
        heldout = set(self._source.scene.heldout_frames)
        for i in spread(len(cameras), _MAX_FRUSTA):
            pose = self._browser.pose(cameras[i])
            scene.add_camera_frustum(
                f"/cameras/{i}", pose.fov, cameras[i].width / cameras[i].height, scale=_FRUSTUM_SIZE, thickness=1.5,
                thickness_units="screen", color=(255, 190, 60) if i in heldout else (90, 200, 255), wxyz=pose.wxyz,
                position=pose.position,
            )  # fmt: skip
        centers = np.array([self._browser.pose(camera).position for camera in cameras])
        ends = np.stack([centers[:-1], centers[1:]], axis=1)
        scene.add_line_segments("/cameras/path", ends, (255, 255, 255), thickness=2.0, thickness_units="screen")
        return parent

    def _draw_trails(self) -> None:
        if (old := self._overlays.pop("trails", None)) is not None:
            old.remove()
        if self._trails.value:
            look = self._session.look
            ends, colors = trails(self._source.model("all", look.distances, crop=look.crop))
            if not len(ends):
                where = "of this scene" if look.crop is None else "in the box"
                self._notifications.show("Nothing to draw", f"No Gaussian {where} moves.")
            else:
                there = self._browser.from_scene.points(ends.astype(np.float64))
                self._overlays["trails"] = self.client.scene.add_line_segments(
                    "/trails", there, colors, thickness=1.5, thickness_units="screen"
                )
        self._redraw()

    def _redraw(self) -> None:
        with self._worker.change():
            self._session.change(time.monotonic())


def _list_suggested_hints(scene: Scene) -> dict[int, str]:
    """By number, ``ObjectDescription.hint`` of the objects whose distance is a guess; none in scenes without objects' files."""
    return {obj.number: obj.hint for obj in describe_objects(scene, load_objects(scene)) if obj.hint is not None}


def _set_value(control: Any, value: Any) -> None:
    """Set the value of a control (viser's types call it read-only)."""
    control.value = value
