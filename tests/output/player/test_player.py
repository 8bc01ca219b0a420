"""The player in a real browser, from disk and without network: images, controls, and what it says where it cannot work."""

from __future__ import annotations

import base64
from dataclasses import replace

import cv2
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.gaussians.visibility import with_seen
from flowsplat.geometry.paths import CameraPath, dolly_zoom, orbit, shift_camera
from flowsplat.output.player import write_player
from flowsplat.output.player.camera_paths import LOOP_TIMES
from flowsplat.output.videos.amplitudes import LoopWidths
from flowsplat.output.videos.options import RenderOptions
from flowsplat.output.videos.shots import subject_distance
from flowsplat.output.viewer.elastic import MAX_PULL, resist
from tests.output.small import (
    FIRST,
    HEIGHT,
    LAST,
    LINEAR,
    OTHERS,
    OURS,
    PAPER,
    WIDTH,
    five_pairs,
    psnr,
    small_cameras,
    small_model,
    small_player,
    small_times,
)

NO_FLOATS = """
const original = WebGL2RenderingContext.prototype.getExtension;
WebGL2RenderingContext.prototype.getExtension = function (name) {
  return name.startsWith("EXT_color_buffer") ? null : original.call(this, name);
};
"""


def image_of(page, camera, seconds: float) -> np.ndarray:
    """[H, W, 3] what the page draws."""
    asked = {
        "viewmat": camera.viewmat.tolist(), "K": camera.K.tolist(), "width": camera.width, "height": camera.height, "time": seconds,
    }  # fmt: skip
    address = page.page.evaluate("(asked) => flowsplat.show(asked)", asked)
    data = np.frombuffer(base64.b64decode(address.split(",")[1]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1] / 255


def seen(page) -> np.ndarray:
    """What stands on the page in place of the scene."""
    page.settle()
    return cv2.imdecode(np.frombuffer(page.page.locator("#stage").screenshot(), np.uint8), cv2.IMREAD_COLOR).astype(float)


def test_it_loads_without_network_and_without_complaints(open_page, player_file):
    page = open_page(player_file)
    page.pause()
    assert page.page.evaluate("document.body.className") == "shown"
    assert page.page.title() == "small </script> scene"
    assert page.page.locator("#message").is_hidden()
    assert seen(page).std() > 10
    assert page.complaints == []
    outside = [url for url in page.requests if not url.startswith(("file:", "blob:", "data:"))]
    assert outside == []


@pytest.mark.parametrize(
    ("config", "options"),
    [
        (OURS, {}), (OURS, {"fill": True}), (OURS, {"fill": True, "is_thin": True}), (PAPER, {}), (LINEAR, {}),
        (OURS, {"moving": 0}), (OURS, {"moving": 1}), (OURS, {"resting": 0}), (OURS, {"focal": 20.0}),
        *((config, {}) for config in OTHERS.values()),
    ],
    ids=[
        "ours", "filled", "half filled", "paper", "linear", "nothing moves", "one moves", "all move", "trained on coarse pixels",
        *OTHERS,
    ],
)  # fmt: skip
def test_images_are_those_of_our_own_renderer(open_page, tmp_path, config, options):
    model = small_model(config, **options)
    page = open_page(small_player(tmp_path / "player.html", model))
    for camera, seconds in five_pairs(model):
        assert psnr(image_of(page, camera, seconds), model.render(camera, seconds).color) > 37
    large = five_pairs(model)[3][0].resize(2 * WIDTH + 1, 2 * HEIGHT - 1)
    assert psnr(image_of(page, large, 1.3), model.render(large, 1.3).color) > 37
    assert page.complaints == []


def test_guesses_fade_as_in_our_own_renderer(open_page, tmp_path):
    """Along the clip's path nothing does; from aside it is our own image without guesses, as far as 8 bits tell reaches."""
    model = small_model(fill=True)
    known = with_seen(model, small_cameras(model), small_times())
    known.gaussians.seen[~known.gaussians.dynamic, 1] *= 0.1
    confidence_fade = known.fade_by_confidence(small_times(), small_cameras(model))
    page = open_page(small_player(tmp_path / "player.html", known))
    page.page.locator("#confidence-fade").check()
    own, seconds = small_cameras(model)[4], small_times()[4]
    away = replace(own, viewmat=own.viewmat + np.array([[0, 0, 0, 0.5], *np.zeros((3, 4))]))
    for camera in (own, away):
        assert psnr(image_of(page, camera, seconds), confidence_fade.render(camera, seconds).color) > 34
    assert psnr(image_of(page, away, seconds), known.render(away, seconds).color) < 25
    page.page.locator("#confidence-fade").uncheck()
    assert psnr(image_of(page, away, seconds), known.render(away, seconds).color) > 34
    assert page.complaints == []


def test_pages_of_scenes_that_do_not_know_do_not_offer_to_fade(open_page, player_file):
    assert open_page(player_file).page.locator("#confidence-fade").is_hidden()


def test_a_portrait_clip_fits_the_page(open_page, tmp_path):
    model, path = small_model(), tmp_path / "player.html"
    cameras = small_cameras(model, HEIGHT, WIDTH)
    page = open_page(write_player(path, model, small_times(), cameras, "portrait"))
    page.pause()
    box = page.page.locator("#canvas").bounding_box()
    stage = page.page.locator("#stage").bounding_box()
    assert box["width"] / box["height"] == pytest.approx(HEIGHT / WIDTH, abs=0.01)
    assert box["height"] == pytest.approx(stage["height"], abs=2)
    assert psnr(image_of(page, cameras[4], 1.5), model.render(cameras[4], 1.5).color) > 37


def test_images_without_float_targets_and_without_workers(open_page, player_file):
    model = small_model()
    page = open_page(player_file, NO_FLOATS + "window.Worker = class { constructor() { throw new Error('none'); } };")
    for camera, seconds in five_pairs(model):
        assert psnr(image_of(page, camera, seconds), model.render(camera, seconds).color) > 30
    assert page.complaints == []


def test_a_worker_that_does_not_start_is_not_waited_for(open_page, player_file):
    silent = "window.Worker = class { postMessage() {} terminate() {} constructor() { setTimeout(() => this.onerror(), 200); } };"
    page = open_page(player_file, silent)
    model = small_model()
    camera, seconds = five_pairs(model)[0]
    assert psnr(image_of(page, camera, seconds), model.render(camera, seconds).color) > 30
    assert page.complaints == []


def test_keys_reach_the_player_out_of_a_list(open_page, player_file):
    page = open_page(player_file)
    page.pause()
    for field, key, mode in (("#camera", "KeyW", "fly"), ("#camera", "KeyS", "fly"), ("#speed", "Digit1", "clip")):
        speed = page.page.locator("#speed").input_value()
        page.page.locator(field).focus()
        page.page.keyboard.press(key)
        assert page.page.locator("#camera").input_value() == mode
        assert page.page.locator("#speed").input_value() == speed


def test_the_slider_changes_the_image(open_page, player_file):
    page = open_page(player_file)
    page.pause()
    page.page.locator("#time").fill("0.1")
    early = seen(page)
    page.page.locator("#time").fill("0.8")
    late = seen(page)
    assert np.abs(early - late).mean() > 2
    assert page.page.locator("#seconds").inner_text() == f"{FIRST + 0.8 * (LAST - FIRST):.2f} s"
    page.page.locator("#time").fill("0.1")
    assert np.abs(early - seen(page)).mean() < 0.5


def test_it_plays_pauses_and_slows_down(open_page, player_file):
    page = open_page(player_file)
    page.page.locator("#speed").select_option("0.1")
    assert page.page.evaluate("flowsplat.state.isPlaying")
    before = page.page.evaluate("flowsplat.state.time")
    page.page.wait_for_function("(before) => flowsplat.state.time !== before", arg=before)
    page.page.locator("#play").click()
    stopped = page.page.evaluate("flowsplat.state.time")
    page.settle()
    assert page.page.evaluate("flowsplat.state.time") == stopped
    page.page.locator("#canvas").focus()
    page.page.keyboard.press("ArrowRight")
    step = page.page.evaluate("flowsplat.state.time") - stopped
    assert step == pytest.approx(1 / (len(small_times()) - 1), abs=1e-6)
    # Steps of simulated time: a tenth of a second at a tenth of the speed.
    page.page.evaluate("flowsplat.state.setPlaying(true); flowsplat.state.setTime(0.5); flowsplat.state.step(0.1)")
    page.page.evaluate("flowsplat.state.setPlaying(false)")
    assert 0.5 + 0.01 / (LAST - FIRST) <= page.page.evaluate("flowsplat.state.time") < 0.6


def test_mouse_and_keys_move_the_camera_and_bring_it_back(open_page, player_file):
    page = open_page(player_file)
    page.pause()
    page.page.locator("#time").fill("0.5")
    home = seen(page)
    mouse = page.page.mouse
    mouse.move(240, 150)
    mouse.down()
    mouse.move(300, 170, steps=3)
    mouse.up()
    assert page.page.locator("#camera").input_value() == "clip", "it stays near the clip's camera"
    turned = seen(page)
    assert np.abs(turned - home).mean() > 2
    mouse.wheel(0, -300)
    assert np.abs(seen(page) - turned).mean() > 1
    mouse.dblclick(240, 150)
    page.page.wait_for_function("() => flowsplat.state.elastic.zoom === 1 && !flowsplat.state.elastic.isReturning")
    assert np.abs(seen(page) - home).mean() < 0.5
    page.page.locator("#canvas").focus()
    page.page.keyboard.down("KeyW")
    page.page.wait_for_timeout(200)
    page.page.keyboard.up("KeyW")
    assert page.page.locator("#camera").input_value() == "fly"
    page.page.keyboard.press("KeyR")
    assert page.page.locator("#camera").input_value() == "clip"
    assert np.abs(seen(page) - home).mean() < 0.5
    assert page.complaints == []


def test_looking_farther_lets_go_and_fades_guesses(open_page, tmp_path):
    model = small_model(fill=True)
    page = open_page(small_player(tmp_path / "player.html", with_seen(model, small_cameras(model), small_times())))
    page.pause()
    state = "[flowsplat.state.mode, flowsplat.state.guesses]"
    assert page.page.evaluate(state) == ["clip", "masked"]
    page.page.locator("#farther").click()
    assert page.page.evaluate(state) == ["orbit", "removed"]
    assert page.page.locator("#farther").get_attribute("aria-pressed") == "true"
    page.page.mouse.dblclick(240, 150)
    assert page.page.evaluate(state) == ["clip", "masked"]
    assert page.page.locator("#farther").get_attribute("aria-pressed") == "false"
    assert page.complaints == []


def test_pulling_reaches_the_loop_and_no_farther_than_was_measured(open_page, tmp_path):
    """Whatever is pulled and whenever, and released it springs back to where it stays."""
    angle, times = 8.0, [0.0, 0.2, 0.5, 1.0]
    pulls = ((0.5, 0.8, 1.5, 0.8, 0.6, 0.4, 0.3, 0.4), (1.0, 1.2, 1.5, 1.2, 0.9, 0.4, 0.5, 0.6))
    model, path = small_model(resting=40, moving=10), tmp_path / "player.html"
    page = open_page(write_player(path, model, small_times(), small_cameras(model), "pulls", LoopWidths(angle, 1.5, pulls)))
    page.pause()
    pull = """([times, steps, count, size]) => times.map((time) => [...Array(steps).keys()].map((k) => {
      const elastic = new ElasticView(flowsplat.about.reach);
      elastic.isPulled = true;
      const around = (2 * Math.PI * k) / steps;
      for (let n = 0; n < count; n++) elastic.drag(size * Math.cos(around), (size / 2) * Math.sin(around));
      const most = elastic.turn(time);
      elastic.isPulled = false;
      for (let n = 0; n < 200; n++) elastic.step(0.02, time);
      return [...most, ...elastic.turn(time)].map((radians) => (radians * 180) / Math.PI);
    }))"""
    steps = 72
    found = np.array(page.page.evaluate(pull, [times, steps, 100, 0.1])) / angle * [1, 2, 1, 2]
    turned, stays = (np.hypot(found[..., k], found[..., k + 1]) for k in (0, 2))
    at_nodes = np.array([np.array(pulls[0]) + t * (np.array(pulls[1]) - pulls[0]) for t in times])
    limits = np.array([np.interp(np.arange(steps), np.arange(9) * steps / 8, [*row, row[0]]) for row in at_nodes])
    phases = np.linspace(0, np.pi, 1000)
    loop = np.stack([np.sin(phases), (1 - np.cos(phases)) / 2])
    around = np.arctan2(loop[1], loop[0])
    half = np.interp(np.arange(steps // 4 + 1) * 2 * np.pi / steps, around, np.hypot(*loop))
    floor = np.zeros(steps)
    floor[: steps // 4 + 1] = half
    floor[steps // 4 : steps // 2 + 1] = half[::-1]
    assert (turned <= np.maximum(limits, floor) + 1e-3).all()
    assert (turned >= 0.99 * np.maximum(limits, floor) - 0.01).all()
    assert (stays >= 0.99 * np.maximum(floor, 0.8 * limits) - 0.01).all()
    assert (stays <= turned + 1e-9).all()
    # The viewer resists by the same formula.
    shares = np.linspace(0, MAX_PULL, 50).tolist()
    assert page.page.evaluate("(shares) => shares.map(resist)", shares) == pytest.approx([resist(share) for share in shares])
    # A small pull is followed as it is, and stays.
    small = np.array(page.page.evaluate(pull, [times, steps, 1, 0.06]))
    np.testing.assert_array_equal(small[..., :2], small[..., 2:])
    np.testing.assert_allclose(np.hypot(small[..., 0], 2 * small[..., 1]), 0.2 * angle)
    # The image moves no farther where the lens has brought it nearer, and the lens shows nothing from beside it.
    nearer = page.page.evaluate("""() => {
      const elastic = new ElasticView(flowsplat.about.reach);
      elastic.isPulled = true;
      elastic.drag(50, 0);
      const far = elastic.turn(0)[0];
      elastic.zoomBy(100);
      elastic.shiftBy(-100, 100);
      const { lens } = elastic.beside(cameraOnPath(flowsplat.about.clipPath, 0), 0, flowsplat.about.width, flowsplat.about.height);
      const [, , cx, cy] = cameraOnPath(flowsplat.about.clipPath, 0).lens;
      const corner = (x, y, width, height) => [(x - lens[2]) / 4 + cx, (y - lens[3]) / 4 + cy];
      const { width, height } = flowsplat.about;
      return { share: elastic.turn(0)[0] / far, corners: [...corner(0, 0), ...corner(width, height)], size: [width, height] };
    }""")
    assert nearer["share"] == pytest.approx(1 / 4)
    assert nearer["corners"] == pytest.approx([0.75 * WIDTH, 0, WIDTH, 0.25 * HEIGHT], abs=1e-3)


def test_an_orbit_keeps_its_target_in_the_middle(open_page, player_file):
    page = open_page(player_file)
    page.pause()
    shown = page.page.evaluate("""() => {
      const free = flowsplat.state.free;
      flowsplat.state.setMode("orbit");
      const target = plus(free.center, rowsOf(free.rotation)[2], free.distance);
      free.orbit(0.4, 5);  // more than the poles allow
      free.zoom(0.5);
      const { rotation, translation } = free.camera;
      return rowsOf(rotation).map((row, k) => dot(row, target) + translation[k]);
    }""")
    assert shown == pytest.approx([0, 0, 0.5], abs=1e-5)


def test_two_fingers_bring_it_nearer(open_page, player_file):
    page = open_page(player_file, has_touch=True)
    page.pause()
    fingers = page.page.context.new_cdp_session(page.page)

    def touch(kind: str, *places: tuple[int, int]) -> None:
        points = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(places)]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", (200, 150), (280, 150))
    touch("touchMove", (160, 150), (320, 150))
    touch("touchEnd")
    assert page.page.evaluate("flowsplat.state.elastic.zoom") == pytest.approx(2, rel=0.1)
    page.page.evaluate("flowsplat.state.setMode('orbit')")
    touch("touchStart", (200, 150), (280, 150))
    touch("touchMove", (160, 150), (320, 150))
    touch("touchEnd")
    assert page.page.evaluate("flowsplat.state.free.distance") == pytest.approx(0.5, rel=0.1)


def test_the_clips_camera_is_followed(open_page, player_file):
    page = open_page(player_file)
    model = small_model()
    path = CameraPath(small_times(), small_cameras(model))
    for t in (0.0, 0.31, 0.77, 1.0):
        found = page.page.evaluate("(t) => cameraOnPath(flowsplat.about.clipPath, t)", t)
        camera = model.similarity.camera(path.at(FIRST + t * (LAST - FIRST)))
        np.testing.assert_allclose(np.reshape(found["rotation"], (3, 3)), camera.viewmat[:3, :3], atol=2e-4)
        np.testing.assert_allclose(found["translation"], camera.viewmat[:3, 3], atol=2e-4)
        np.testing.assert_allclose(found["lens"], camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], atol=1e-4)


@pytest.mark.parametrize("part", ["background", "objects"])
def test_parts_are_those_of_our_own_renderer(open_page, tmp_path, part):
    model = small_model(fill=True)
    page = open_page(small_player(tmp_path / "player.html", model))
    page.page.locator("#part").select_option(part)
    for camera, seconds in five_pairs(model)[1:4]:
        assert psnr(image_of(page, camera, seconds), model.part(part).render(camera, seconds).color) > 37
    assert page.complaints == []


@pytest.mark.parametrize("init", [None, NO_FLOATS], ids=["floats", "no floats"])
def test_objects_farther_away_and_nearer_are_those_of_our_own_renderer(open_page, tmp_path, init):
    """What of an object rests goes with it."""
    model = small_model()
    model.gaussians.object_ids[:40] = 2  # of the wall
    factors = {1: 1.6, 2: 0.8}
    page = open_page(small_player(tmp_path / "player.html", model), init)
    for number, factor in factors.items():
        page.page.evaluate("([number, factor]) => flowsplat.state.setDistance(number, factor)", [number, factor])
    moved = model.at_distances(factors, small_times(), small_cameras(model))
    for camera, seconds in five_pairs(model):
        found = image_of(page, camera, seconds)
        assert psnr(found, moved.render(camera, seconds).color) > (30 if init else 37)
        assert psnr(found, model.render(camera, seconds).color) < 28
    assert page.complaints == []


def test_one_object_alone_looks_the_same_to_the_clips_camera_however_far_it_is(open_page, player_file):
    page = open_page(player_file)
    model = small_model()
    page.page.locator("#part").select_option("objects:2")
    clip, aside = five_pairs(model)[1], five_pairs(model)[3]
    before = [image_of(page, *pair) for pair in (clip, aside)]
    assert psnr(before[0], model.part("objects:2").render(*clip).color) > 37
    page.page.evaluate("flowsplat.state.setDistance(1, 2.0); flowsplat.state.setDistance(9, 2.0)")
    assert psnr(image_of(page, *aside), before[1]) > 60, "the other one, and one that is not there"
    page.page.evaluate("flowsplat.state.setDistance(2, 1.8)")
    assert psnr(image_of(page, *clip), before[0]) > 45
    assert psnr(image_of(page, *aside), before[1]) < 25
    assert page.complaints == []


def test_sliders_push_objects_away_and_bring_them_back(open_page, player_file):
    page = open_page(player_file)
    page.pause()
    page.page.locator("#time").fill("0.5")
    page.page.locator("#camera").select_option("orbit")
    page.page.evaluate("flowsplat.state.free.orbit(0.3, 0)")
    home = seen(page)
    page.page.locator("#distances summary").click()
    bar_open = seen(page)
    page.page.locator("#distance2").fill("1.5")
    assert page.page.evaluate("flowsplat.state.factors") == [1, 1, 1.5]
    assert page.page.locator("#distances output").all_inner_texts() == ["1.00", "1.50"]
    assert np.abs(seen(page) - bar_open).mean() > 1
    page.page.locator("#trained").click()
    assert page.page.evaluate("flowsplat.state.factors") == [1, 1, 1]
    page.page.locator("#distances summary").click()
    assert np.abs(seen(page) - home).mean() < 0.5
    assert page.complaints == []


def test_a_scene_without_objects_offers_no_distances(open_page, tmp_path):
    model = small_model()
    model.gaussians.object_ids[:] = 0
    page = open_page(small_player(tmp_path / "player.html", model))
    assert page.page.locator("#distances").is_hidden()
    assert page.page.locator("#part option").count() == 3
    assert page.complaints == []


def test_parts_are_not_offered_where_there_is_only_one(open_page, tmp_path):
    page = open_page(small_player(tmp_path / "player.html", small_model(moving=0)))
    assert page.page.locator("#part").is_hidden()


def test_two_eyes_see_the_scene_from_their_own_places(open_page, player_file):
    """The page's image at rest against images of two cameras of ours."""
    page = open_page(player_file)
    page.pause()
    page.page.locator("#time").fill("0.5")
    page.page.locator("#stereo").check()
    page.settle()
    both, height = page.page.evaluate("[element('canvas').width, element('canvas').height]")
    width = both // 2
    found = seen(page)
    model = small_model()
    camera = small_cameras(model)[4].resize(width, height)
    depth = 1 / model.similarity.scale
    top, left = (found.shape[0] - height) // 2, (found.shape[1] - 2 * width) // 2
    for k, side in enumerate((-1, 1)):
        eye = shift_camera(camera, side * RenderOptions.eye_distance / 2 * depth, depth)
        half = found[top : top + height, left + k * width : left + (k + 1) * width, ::-1] / 255
        assert psnr(half, model.render(eye, (FIRST + LAST) / 2).color) > 35
    assert page.complaints == []


def subject_at(model, share: float) -> float:
    """Planar depth of what moves in the coordinates of the page, as it interpolates it between the times that it is told."""
    path, scale = CameraPath(small_times(), small_cameras(model)), model.similarity.scale
    depths = [scale * subject_distance(model, path.at(float(t)), float(t), 1 / scale) for t in np.linspace(FIRST, LAST, LOOP_TIMES)]
    return float(np.interp(share, np.linspace(0, 1, LOOP_TIMES), depths))


def test_a_path_that_somebody_adds_is_in_the_menu_and_flown(open_page, tmp_path, climb):
    page = open_page(small_player(tmp_path / "player.html", small_model()))
    page.page.locator("#time").fill("0.3")
    own = page.page.evaluate("centerOf(flowsplat.state.camera())")
    page.page.locator("#camera").select_option(label="up & away")
    np.testing.assert_allclose(page.page.evaluate("centerOf(flowsplat.state.camera())"), np.array(own) - [0, climb, 0], atol=1e-4)
    assert page.complaints == []


def test_cameras_that_move_by_themselves(open_page, player_file):
    """Each is where ``render`` puts it, and time stands still until it is told to play."""
    page = open_page(player_file)
    model = small_model()
    camera = model.similarity.camera(CameraPath(small_times(), small_cameras(model)).at(FIRST + 0.4 * (LAST - FIRST)))
    page.page.locator("#time").fill("0.4")
    subject = subject_at(model, 0.4)
    expected = {
        "path:bullet": orbit(camera, 1.0, 8)[1],
        "path:dolly": dolly_zoom(camera, subject, 1.5 ** ((1 - np.cos(np.pi / 4)) / 2)),
        "path:wiggle": shift_camera(camera, 0.015 * np.sin(np.pi / 4), subject),
    }
    for mode, there in expected.items():
        page.page.evaluate("flowsplat.state.setPlaying(true)")
        page.page.locator("#camera").select_option(mode)
        page.page.evaluate("flowsplat.state.setTime(0.4)")
        assert not page.page.evaluate("flowsplat.state.isPlaying")
        found = page.page.evaluate("flowsplat.state.phase = Math.PI / 4; flowsplat.state.camera()")
        np.testing.assert_allclose(np.reshape(found["rotation"], (3, 3)), there.viewmat[:3, :3], atol=3e-3)
        np.testing.assert_allclose(found["translation"], there.viewmat[:3, 3], atol=3e-3)
        np.testing.assert_allclose(found["lens"], there.K[[0, 1, 0, 1], [0, 1, 2, 2]], rtol=1e-4)
        first = seen(page)  # a slow machine may show the next ones a whole turn later, where they look alike
        assert any(np.abs(seen(page) - first).mean() > 0.05 for _ in range(20)), mode
    page.page.locator("#camera").select_option("path:stabilized")
    row = page.page.evaluate("flowsplat.state.path.rows[flowsplat.state.path.rows.length - 1]")
    page.page.locator("#time").fill("1")
    np.testing.assert_allclose(page.page.evaluate("centerOf(flowsplat.state.camera())"), row[1:4], atol=1e-5)
    assert page.complaints == []


@pytest.mark.parametrize(
    ("init", "word"),
    [
        ("delete window.WebGL2RenderingContext;", "WebGL2"),
        ("HTMLCanvasElement.prototype.getContext = () => null;", "WebGL2"),
        ("delete window.DecompressionStream;", "DecompressionStream"),
    ],
)
def test_a_browser_that_is_too_old_is_told_so(open_page, player_file, init, word):
    page = open_page(player_file, init)
    message = page.page.locator("#message")
    assert message.is_visible()
    assert word in message.inner_text()
    assert page.page.locator("#poster").is_visible()
    assert page.page.locator("#wait").is_hidden()


def test_a_page_that_cannot_be_written_is_refused(tmp_path):
    model = small_model(resting=4, moving=2)
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="file"):
        small_player(tmp_path / "file" / "player.html", model)
    empty = small_model(resting=0, moving=0)
    with pytest.raises(InputError, match="no Gaussians"):
        small_player(tmp_path / "player.html", empty)
    assert not (tmp_path / "player.html").exists()
