"""Make the images of the README, of the tutorial and of "Why does my clip fail?" anew, with the commands that a reader would use.

    python docs/tools/images.py WORK_FOLDER [--only result|tutorial|clips]

``result`` makes both images of the demo: the one that moves, for the README, and the still one.

All but ``result`` need chromium or chrome, and playwright and viser (extra ``dev``). What is in the work folder already is used
again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shutil
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from flowsplat import load
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import orbit
from flowsplat.images.colors import depth_range, depth_to_color, flow_to_color
from flowsplat.images.sheets import side_by_side, stack
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import read_image
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic_video
from flowsplat.scenes.synthetic.bodies import Body
from flowsplat.scenes.synthetic.textures import patchwork
from flowsplat.scenes.synthetic.world import TOYS, camera_at

IMAGES = Path(__file__).parent.parent / "images"
SIZE = (320, 180)
FRAMES, FPS = 24, 12.0
"""Of the clips that fail."""
MIDDLE = 1.0
"""Seconds of the clip's middle."""
PORT = 8137
PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
QUALITY = 82
TALL = 225
"""Pixels of an image of the result."""
MOVING_QUALITY = 64
"""Of the animated WebP, 0 to 100: it stays below a megabyte, so that it can stand in the README on PyPI."""

RenderCase = np.ndarray


# -- clips that fail


def _world() -> SyntheticScene:
    return SyntheticScene(*SIZE, frames=FRAMES, fps=FPS)


def _filmed(world: SyntheticScene, camera: Callable[[float], Camera]) -> list[RenderCase]:
    return [world.render(camera(t), t).image for t in world.timestamps]


def _usual(t: float) -> Camera:
    return camera_at(t, *SIZE)


def _turned(t: float) -> Camera:
    """From one place, looking about."""
    stands, turn = _usual(MIDDLE), np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.05 * np.sin(3 * t), 0.35 * (t - MIDDLE), 0.02 * t]).as_matrix()
    return Camera(turn @ stands.viewmat, stands.K, *SIZE)


def _hardly(t: float) -> Camera:
    """Turning, and traveling a few centimeters in front of things that are meters away."""
    turned, step = _turned(t), np.eye(4)
    step[:3, 3] = [-0.03 * t, 0.005 * np.sin(4 * t), 0]
    return Camera(step @ turned.viewmat, turned.K, *SIZE)


def _before_a_wall(t: float) -> Camera:
    """Sideways along the wall behind everything, a meter and a half from it."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    viewmat[:3, 3] = -viewmat[:3, :3] @ [-2.2 + t, 2.0 + 0.05 * np.sin(3 * t), 3.1]
    return Camera(viewmat, _usual(t).K, *SIZE)


def _turning() -> list[RenderCase]:
    world = _world()
    world.bodies[:] = [body for body in world.bodies if body.number == 0]
    return _filmed(world, _turned)


def _cut() -> list[RenderCase]:
    """After half of the clip, another room, looking to the side."""
    side = np.eye(4)
    side[:3, :3] = Rotation.from_rotvec([0, -1.1, 0]).as_matrix()
    other = SyntheticScene(*SIZE, frames=FRAMES, fps=FPS, seed=7)
    second = _filmed(other, lambda t: Camera(side @ _usual(t).viewmat, _usual(t).K, *SIZE))
    return _filmed(_world(), _usual)[: FRAMES // 2] + second[FRAMES // 2 :]


def _black() -> list[RenderCase]:
    frames = _filmed(_world(), _usual)
    return [np.zeros_like(frame) if 10 <= i < 13 else frame for i, frame in enumerate(frames)]


def _filled() -> list[RenderCase]:
    """Something large sways in front of a camera on a tripod."""
    world, size, camera = _world(), np.array([0.78, 0.1, 0.43]), _usual(MIDDLE)
    right, down, forward = camera.viewmat[:3, :3]

    def motion(t: float) -> tuple[np.ndarray, np.ndarray]:
        middle = camera.center + 1.5 * forward + 0.06 * np.sin(5 * t) * right + 0.04 * np.cos(7 * t) * down
        return np.stack([right, forward, -down], 1) * size, middle

    world.bodies.append(Body("box", size, motion, patchwork(np.random.default_rng(1), 0.3, TOYS), 4))
    return _filmed(world, lambda t: camera)[: FRAMES // 2]


def _plain() -> list[RenderCase]:
    """A white wall and the noise of the sensor."""
    rng = np.random.default_rng(0)
    return [np.clip(rng.normal(205, 6, (SIZE[1], SIZE[0], 3)), 0, 255).astype(np.uint8) for _ in range(FRAMES)]


CLIPS: dict[str, Callable[[], list[RenderCase]]] = {
    "standing_camera": lambda: _filmed(_world(), lambda t: _usual(MIDDLE)),
    "turning_camera": _turning,
    "hardly_travels": lambda: _filmed(_world(), _hardly),
    "one_wall": lambda: _filmed(_world(), _before_a_wall),
    "a_cut": _cut,
    "black_frames": _black,
    "fills_the_image": _filled,
    "nothing_to_follow": _plain,
}


def image_clips(work: Path, browser: Any) -> None:
    """Prepare every clip that fails, and image the top of its priors.html."""
    for name, make in CLIPS.items():
        frames, out = work / name, work / f"{name}_run"
        if not frames.exists():
            frames.mkdir(parents=True)
            for i, image in enumerate(make()):
                cv2.imwrite(str(frames / f"{i:05d}.png"), image[..., ::-1])
        if not (out / "priors.html").exists():
            _flowsplat("prepare", frames, "-o", out, "--fps", FPS)
        with _page(browser, 640, 700) as page:
            page.goto((out / "priors.html").as_uri())
            print(f"{name}: {page.inner_text('header p')}")
            print(page.inner_text(".stages table"))
            _hold(page, "video.strip")
            _shoot(page, f"clip_{name}", until="video.strip")


# -- the README


def image_result(work: Path) -> None:
    """What the demo makes, in one held-out frame: the frame, and what the scene that has not seen it renders."""
    out = work / "demo"
    if not (out / "true" / "report.html").exists():
        _flowsplat("demo", "-o", out)
    _image_moving(out / "own")
    scene, model = Scene(out / "own" / "scene"), load(out / "own" / "model")
    i = scene.heldout_frames[len(scene.heldout_frames) // 2]
    (camera, following), (time, later) = scene.cameras[i : i + 2], map(float, scene.timestamps[i : i + 2])
    seen = model.render(camera, time, (following, later))
    assert seen.flow is not None
    rendered = read_image(out / "own" / "evaluation" / "heldout" / f"{i:05d}.png")
    rows = [
        side_by_side([scene.heldout_frame(i), rendered], ["held-out frame", "rendered"], TALL),
        side_by_side(
            [flow_to_color(seen.flow), depth_to_color(seen.depth, *depth_range([seen.depth]))],
            ["rendered flow", "rendered depth"],
            TALL,
        ),
    ]
    cv2.imwrite(str(IMAGES / "result.png"), stack(rows)[..., ::-1])


def _image_moving(run: Path) -> None:
    """The clip, the scene from the same place, and the scene from aside, as one animation: of the model that is shown."""
    scene, model = Scene(run / "scene"), load(run)
    degrees = json.loads((run / "renders" / "renders.json").read_text())["orbit"]["swing"]["degrees"]
    aside = orbit(scene.cameras, 1 / scene.similarity.scale, scene.num_frames, degrees)
    labels = ["the clip", "the scene, from the same place", f"from aside, up to {degrees:g} degrees"]
    animation = cv2.Animation()
    frames = []
    for i, (time_, own, moved) in enumerate(zip(map(float, scene.timestamps), scene.cameras, aside, strict=True)):
        clip = scene.heldout_frame(i) if i in scene.heldout_frames else scene.frame(i)
        panels = [clip, model.render(own, time_).color, model.render(moved, time_).color]
        frames.append(np.ascontiguousarray(side_by_side(panels, labels)[..., ::-1]))
    animation.frames = frames
    animation.durations = np.full(len(frames), round(1000 / FPS), np.int32)
    cv2.imwriteanimation(str(IMAGES / "scene.webp"), animation, [cv2.IMWRITE_WEBP_QUALITY, MOVING_QUALITY])


# -- the tutorial


def image_tutorial(work: Path, browser: Any) -> None:
    """The tutorial's commands on the clip of ``demo --world floating``, and what a reader sees after each."""
    clip, out, export = work / "clip.mp4", work / "run", work / "clip.html"
    if not clip.exists():
        write_synthetic_video(clip, SyntheticScene(*SIZE))
    if not (out / "report.html").exists():
        _flowsplat("run", clip, "-o", out, "--preset", "fast")
    if not (out / "renders" / "wiggle_objects.gif").exists():
        _flowsplat("render", out, "--render.paths", "wiggle", "--render.parts", "all", "background", "objects")
    if not export.exists():
        _flowsplat("export", out, "--to", "html", "-o", export)
    with _page(browser, 900, 900) as page:
        page.goto((out / "priors.html").as_uri())
        _hold(page, "video.strip")
        _shoot(page, "tutorial_priors", until=".cameras, .cards")
    with _page(browser, 900, 900) as page:
        page.goto((out / "report.html").as_uri())
        page.wait_for_timeout(1500)
        row = page.locator(".compared .row").first
        row.screenshot(path=str(IMAGES / "tutorial_report.jpg"), type="jpeg", quality=QUALITY)
    with _page(browser, 900, 620) as page:
        page.goto(export.as_uri())
        page.wait_for_selector("body.shown", timeout=120_000)
        page.evaluate("flowsplat.state.seek(0.5)")
        page.wait_for_timeout(5000)
        _shoot(page, "tutorial_player")
    with _viewer(out), _page(browser, 1200, 640) as page:
        page.goto(f"http://127.0.0.1:{PORT}")
        page.wait_for_timeout(15_000)
        for button in page.locator("[class*=Notification] button").all():
            button.click()  # that this browser draws in software
        page.wait_for_timeout(5000)
        _shoot(page, "tutorial_view")
    parts = {"all": "wiggle", "background": "wiggle_background", "objects": "wiggle_objects"}
    images = [_first_frame(out / "renders" / f"{name}.gif") for name in parts.values()]
    _write("tutorial_parts", side_by_side(images, list(parts)))


@contextlib.contextmanager
def _viewer(out: Path) -> Iterator[None]:
    command = [sys.executable, "-m", "flowsplat.cli", "view", str(out), "--port", str(PORT)]
    running = subprocess.Popen(command)
    try:
        for _ in range(120):
            with contextlib.suppress(OSError):
                urllib.request.urlopen(f"http://127.0.0.1:{PORT}").close()
                break
            time.sleep(0.5)
        yield
    finally:
        running.terminate()
        running.wait()


def _first_frame(path: Path) -> RenderCase:
    found, image = cv2.VideoCapture(str(path)).read()
    if not found:
        raise ValueError(f"{path} has no image")
    return image[..., ::-1]


# -- how


def _flowsplat(*arguments: object) -> None:
    subprocess.run([sys.executable, "-m", "flowsplat.cli", *map(str, arguments)], check=True)


@contextlib.contextmanager
def _page(browser: Any, width: int, height: int) -> Iterator[Any]:
    context = browser.new_context(viewport={"width": width, "height": height}, color_scheme="light")
    try:
        yield context.new_page()
    finally:
        context.close()


def _hold(page: Any, video: str) -> None:
    """Show the middle of a video and nothing round it."""
    page.eval_on_selector(
        video,
        "(v) => new Promise((done) => { v.controls = false; v.pause(); v.onseeked = done; v.currentTime = v.duration / 2; })",
    )
    page.wait_for_timeout(300)


def _shoot(page: Any, name: str, until: str | None = None) -> None:
    """Image a page, down to the end of the first element ``until``."""
    options: dict[str, Any] = {}
    if until is not None:
        box = page.locator(until).first.bounding_box()
        height = box["y"] + box["height"] + 2
        options = {"full_page": True, "clip": {"x": 0, "y": 0, "width": page.viewport_size["width"], "height": height}}
    page.screenshot(path=str(IMAGES / f"{name}.jpg"), type="jpeg", quality=QUALITY, **options)


def _write(name: str, image: RenderCase) -> None:
    cv2.imwrite(str(IMAGES / f"{name}.jpg"), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def main() -> None:
    """Make the images."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--only", choices=("result", "tutorial", "clips"))
    arguments = parser.parse_args()
    work = arguments.work.resolve()
    if arguments.only in (None, "result"):
        image_result(work)
    if arguments.only == "result":
        return
    from playwright.sync_api import sync_playwright

    program = next(filter(None, map(shutil.which, PROGRAMS)), None)
    with sync_playwright() as running:
        browser = running.chromium.launch(executable_path=program, args=list(FLAGS))
        if arguments.only != "tutorial":
            image_clips(work, browser)
        if arguments.only != "clips":
            image_tutorial(work, browser)
        browser.close()


if __name__ == "__main__":
    main()
