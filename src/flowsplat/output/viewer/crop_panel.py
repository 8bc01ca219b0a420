"""Controls for the box that a client crops the scene to, and the command that exports the same."""

from __future__ import annotations

import math
import shlex
import threading
from collections.abc import Callable

import numpy as np
import viser

from flowsplat.gaussians.crop import CropBox, compute_bounds, parse_crop
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.viewer.browser_frame import BrowserFrame
from flowsplat.output.viewer.controls import Control, Controls, as_code
from flowsplat.output.viewer.notifications import Notifications
from flowsplat.output.viewer.source import Source

_EDGE_SHARE = 0.01
"""Share of the Gaussians that may lie beyond the ends of the sliders, on each side of each axis: stray ones would make all of the
scene a hair on them. Chosen by eye."""
_SLIDER_MARGIN = 0.05
"""Of the scene's side, by which the sliders reach beyond it. Chosen by eye."""
_MIN_SIDE_SHARE = 0.05
"""Of the longest side that a slider spans, at least: a flat scene can be cropped, too. Chosen by eye."""
_SLIDER_STEPS = 200
"""Steps of a slider, at least. Chosen by eye."""
_SHOWN_SECONDS = 3.0
"""For which the box is drawn after a change. Chosen by eye."""
_AXES = ("x", "y", "z")
_CROP_HINT = (
    "Draws what lies in the box alone: a Gaussian by its center, one that moves by where it is when it is most there. "
    "At their ends the sliders leave out what lies farthest out."
)


def choose_ends(model: SceneModel) -> tuple[CropBox, tuple[float, ...]]:
    """Return the box of the sliders' ends, a little beyond all but stray Gaussians, and the step of each axis: a round number, of
    which the ends are multiples.

    Raises:
        ValueError: the scene has no Gaussians.
    """
    if not len(model.gaussians):
        raise ValueError("a scene without Gaussians has no ends")
    found = compute_bounds(model, _EDGE_SHARE)
    low, high = np.array(found.low), np.array(found.high)
    sides = (1 + 2 * _SLIDER_MARGIN) * np.maximum(high - low, _MIN_SIDE_SHARE * (high - low).max())
    middle, steps = (low + high) / 2, [_round_down(side / _SLIDER_STEPS) for side in sides]
    ends = [
        (_multiple(math.floor((place - side / 2) / step), step), _multiple(math.ceil((place + side / 2) / step), step))
        for place, side, step in zip(middle, sides, steps, strict=True)
    ]
    return CropBox(*zip(*ends, strict=True)), tuple(steps)


def export_command(source: Source, box: CropBox) -> str:
    """Return the command that exports what lies in a box, here as a page."""
    return shlex.join(["flowsplat", "export", str(source.folder), "--to", "html", f"--crop={box}"])


class CropPanel:
    """The folder of controls for the box of one client."""

    def __init__(
        self,
        client: viser.ClientHandle,
        notifications: Notifications,
        source: Source,
        browser: BrowserFrame,
        changed: Callable[[], None],
    ):
        """``changed`` is called when there is another box, or none any more."""
        self._client, self._source, self._browser, self._changed = client, source, browser, changed
        self._drawn: viser.LineSegmentsHandle | None = None
        self._timer: threading.Timer | None = None
        self.box: CropBox | None = None
        """What is drawn lies in it; None = all is drawn."""
        self._ends, steps = choose_ends(source.loaded.part("all"))
        gui, controls = client.gui, Controls(client.gui)
        with gui.add_folder("Crop", expand_by_default=False):
            self._is_on = controls.add_checkbox("Crop to a box", False, hint=_CROP_HINT)
            self._sliders: list[tuple[Control, Control]] = []
            for axis, low, high, step in zip(_AXES, self._ends.low, self._ends.high, steps, strict=True):
                least = controls.add_slider(f"{axis} from", min=low, max=high, step=step, initial_value=low)
                most = controls.add_slider(f"{axis} to", min=low, max=high, step=step, initial_value=high)
                self._sliders.append((least, most))
            reset = gui.add_button("Reset the box", icon=viser.Icon.ARROW_BACK)
            self._told = gui.add_markdown("")
        self._steps = steps
        self._is_on.on_update(notifications.callback(self.update))
        for pair in self._sliders:
            for slider in pair:
                slider.on_update(notifications.callback(self.update))
        reset.on_click(notifications.callback(self._reset))

    def end(self) -> None:
        """Change no box any more: the client has gone, or is shown another scene."""
        if self._timer is not None:
            self._timer.cancel()

    @property
    def is_drawn(self) -> bool:
        """Whether the box is drawn at this moment, into the scene and behind what is in front of it."""
        return self._drawn is not None and self._drawn.visible

    def update(self) -> None:
        """Take what is set."""
        box = self._read() if self._is_on.value else None
        is_new, self.box = box != self.box, box
        self.tell()
        if is_new:
            self._draw()
            self._changed()

    def tell(self) -> None:
        """Show what the box holds of the newest model, and the command."""
        box = self.box
        if box is None:
            self._told.content = ""
            return
        # Sliders move faster than large scenes are cropped: calls that wait find the newest box, and its scene, which is kept.
        total, kept = (len(self._source.loaded.crop("all", which).gaussians) for which in (None, box))
        self._told.content = f"{kept:,} of {total:,} Gaussians. To export them:\n\n{as_code(export_command(self._source, box))}"

    def _read(self) -> CropBox:
        """The box of the sliders, as its text says it: what is drawn is what is exported."""
        sides = []
        for (least, most), end, step in zip(self._sliders, self._ends.high, self._steps, strict=True):
            low, high = sorted((least.value, most.value))  # One may be drawn past the other.
            if high - low < step / 2:
                low, high = (low, low + step) if high + step / 2 < end else (high - step, high)
            sides.append((low, high))
        low, high = zip(*sides, strict=True)
        return parse_crop(str(CropBox(low, high)))

    def _reset(self) -> None:
        for (least, most), low, high in zip(self._sliders, self._ends.low, self._ends.high, strict=True):
            least.value, most.value = low, high
        self.update()

    def _draw(self) -> None:
        """Draw the edges of the box for a while."""
        if self.box is None:
            self._hide()
            return
        if self._timer is not None:
            self._timer.cancel()
        ends = self._browser.from_scene.points(self.box.edges).astype(np.float32)
        if self._drawn is None:
            self._drawn = self._client.scene.add_line_segments(
                "/crop", ends, (255, 190, 60), thickness=2.0, thickness_units="screen"
            )
        else:
            self._drawn.points, self._drawn.visible = ends, True
        self._timer = threading.Timer(_SHOWN_SECONDS, self._hide)
        self._timer.daemon = True
        self._timer.start()

    def _hide(self) -> None:
        if self._drawn is not None:
            self._drawn.visible = False


def _round_down(value: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not more."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= value * (1 + 1e-9))


def _multiple(count: int, step: float) -> float:
    """Return so many steps as the number that people write."""
    return float(f"{count * step:.12g}")
