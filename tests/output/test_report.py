"""The report of a made-up run: what it says, that it needs nothing else, and that names cannot break it."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np

from flowsplat.output.report import Comparison, FlowComparison, ReportData, Step, write_report

NASTY = 'a "clip" <script>alert(1)</script> & {{ 7 * 7 }}'


def scores(psnr: float, ssim: float, moving: float | None) -> dict:
    region = None if moving is None else {"psnr": moving, "ssim": 0.8, "lpips": None, "count": 6}
    return {"psnr": psnr, "ssim": ssim, "lpips": None, "count": 6, "moving": region}


def made_up_metrics() -> dict:
    return {
        "heldout_frames": scores(29.87, 0.912, 24.41),
        "heldout_views": {**scores(21.34, 0.731, 19.9), "covisible": scores(22.08, 0.75, None)},
        "training_frames": scores(31.02, 0.934, 27.7),
        "baselines": {
            "copy": scores(18.10, 0.364, 15.3), "blend": scores(20.08, 0.415, 17.0),
            "flow_interpolation": scores(26.08, 0.805, 21.2), "static": None,
        },
        "baselines_views": {"copy": scores(15.8, 0.3, 12.1), "warp_by_depth": scores(25.76, 0.82, 28.64), "static": None},
        "flow_epe": None,
        "flow_prior_epe": {"mean": 0.43, "median": 0.17, "moving": {"mean": 1.12, "median": 0.6}},
        "depth_abs_rel": {"all": {"mean": 0.041, "median": 0.02}, "static": {"mean": 0.03, "median": 0.02}, "moving": None},
        "lpips_reason": "LPIPS needs pip install flowsplat[metrics]",
        "seconds": {"prepare": 92.0, "train": 251.0, "evaluate": 31.5, "render": 44.0}, "wall_seconds": 431.0,
        "peak_memory_gib": 2.31,
        "gaussians": {"total": 184_201, "active_mean": 63_410.5, "objects": {"2": 9_021, "7": 314}},
    }  # fmt: skip


def made_up_images(shift: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A clip's frame (uint8), its rendering (float), rendered flow and prior flow."""
    y, x = np.mgrid[:240, :427] / 240
    ball = np.hypot(x - 0.6 - shift, y - 0.55) < 0.2
    frame = np.stack([0.35 + 0.3 * y, 0.45 + 0.2 * np.sin(9 * x), 0.55 - 0.2 * y], -1)
    frame[ball] = [0.85, 0.4, 0.15]
    noise = np.random.default_rng(3).normal(0, 0.02, frame.shape)
    flow = np.where(ball[..., None], [6.0, -3.0], [-1.0, 0.2]) + 0.1 * noise[..., :2]
    prior = np.where(ball[..., None], [7.0, -2.5], [-1.0, 0.2])
    prior[:20] = np.nan
    return (frame * 255).astype(np.uint8), np.clip(frame + noise, 0, 1).astype(np.float32), flow, prior


def made_up_run() -> ReportData:
    steps = np.arange(10, 1501, 10)
    random = np.random.default_rng(0)
    loss = 0.02 + 0.2 * np.exp(-steps / 200) + random.random(len(steps)) * 0.004
    history = [
        {
            "step": float(s), "loss": float(v), "color": float(v * 0.7), "flow": float(v * 8), "rigid": float(v / 50),
            "coverage": float(v / 99), "depth": 0.0, "psnr": 31 - 60 * float(v), "gaussians": 120_000.0 + 43 * int(s),
            "active": 60_000.0 + 3 * int(s),
        }
        for s, v in zip(steps, loss, strict=True)
    ]  # fmt: skip
    images = [made_up_images(shift) for shift in (0.0, 0.25, 0.5)]
    times = np.arange(48) / 24
    return ReportData(
        title="train",
        metrics=made_up_metrics(),
        history=history,
        comparisons=[Comparison(f"frame {9 + 10 * k}", a, b) for k, (a, b, _, _) in enumerate(images)],
        flows=[FlowComparison(f"frame {8 + 10 * k}", c, d) for k, (_, _, c, d) in enumerate(images[:2])],
        active=(times.tolist(), (60_000 + 4_000 * np.sin(times * 3)).tolist()),
        config={"train.iterations": 1500, "train.model.mean_poly": 3, "render.width": None, "render.paths": ("input",)},
        notes=["The clip was thinned from 240 to 80 frames.", "The camera hardly moves: depth is a guess."],
        videos={"input_path": "input_path.mp4", "input_path_color": "input_path_color.mp4", "orbit": "orbit.mp4"},
    )


def write(tmp_path, data: ReportData) -> str:
    path = write_report(tmp_path / "out", data)
    assert path == tmp_path / "out" / "report.html"
    return path.read_text(encoding="utf-8")


def words(page: str) -> str:
    """What a reader sees, without the images and the style."""
    page = re.sub(r"<style>.*?</style>", "", page, flags=re.S)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", page))


class Balance(HTMLParser):
    """Fails on tags that are closed in the wrong order."""

    def __init__(self):
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.sources += [value for name, value in attrs if name in ("src", "href", "poster")]
        if tag not in ("meta", "img", "line", "path"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in ("line", "path"):
            assert self.open.pop() == tag


def test_the_report_holds_the_figures(tmp_path):
    page = words(write(tmp_path, made_up_run()))
    for text in (
        "29.87 dB", "3.79 dB better than interpolating", "interpolation: 26.08 dB", "0.912", "24.41", "21.34", "22.08",
        "25.76", "0.43 px", "1.12", "0.041", "184,201", "63,410 active at a time", "7 min 11 s", "2.3 GiB", "31.02",
        "thinned from 240", "9,021", "train.model.mean_poly", "1500", "Parts of the loss", "Gaussians active over the clip",
        "Round the middle of the clip", "frame 29", "full color =",
    ):  # fmt: skip
        assert text in page, text
    assert "static scene" not in page, "what was not measured has no row"


def test_it_begins_with_a_sentence_and_the_video_and_ends_with_the_figures(tmp_path):
    data = replace(made_up_run(), steps=[Step("Look around:", "flowsplat view 'a <b>'")])
    page = write(tmp_path, data)
    order = (
        "<h1>",
        "Sharp along your path",
        "autoplay",
        "flowsplat view",
        "More videos",
        "better than",
        'class="card"',
        "<table",
        "<svg",
    )
    places = [page.index(text) for text in order]
    assert places == sorted(places)
    assert '<pre class="command">flowsplat view &#39;a &lt;b&gt;&#39;</pre>' in page
    without = write(tmp_path, replace(data, videos={}))
    assert without.index("<img") < without.index("flowsplat view"), "without videos, a frame and its rendering"


def test_videos_are_in_color_and_the_clips_own_path_plays(tmp_path):
    poster = np.full((90, 160, 3), 99, np.uint8)
    names = {"orbit": "o.mp4", "orbit_color": "oc.mp4", "input_path": "i.mp4", "input_path_color": "ic.mp4"}
    page = write(tmp_path, replace(made_up_run(), videos=names, posters={"input_path_color": poster, "orbit_color": poster}))
    first, second = re.findall(r"<video[^>]*>", page)
    assert all(text in first for text in (" autoplay", " muted", " loop", " playsinline", 'poster="data:image/jpeg'))
    assert 'src="renders/ic.mp4"' in first
    assert " autoplay" not in second
    assert 'preload="none"' in second, "nothing is loaded before it is asked for"
    assert 'src="renders/oc.mp4"' in second
    assert 'href="renders/o.mp4"' in page


def test_refined_poses_stand_beside_the_strict_figures(tmp_path):
    data = made_up_run()
    metrics = {**data.metrics, "heldout_frames_refined": scores(30.55, 0.923, 25.0)}
    page = words(write(tmp_path, replace(data, metrics=metrics)))
    assert "PSNR, pose refined" in page
    assert "30.55" in page
    assert page.index("29.87 dB") < page.index("30.55"), "the strict figure is the headline"
    assert "pose refined" not in words(write(tmp_path, data))


def test_null_figures_are_dashes_with_their_reason(tmp_path):
    page = write(tmp_path, made_up_run())
    assert '<span class="none" title="LPIPS needs pip install flowsplat[metrics]">–</span>' in page
    assert '<span class="none" title="no masks to tell which pixels move">–</span>' in page


def test_videos_of_every_kind(tmp_path):
    videos = {
        "orbit_background": "orbit_background.mp4", "orbit_background_color": "orbit_background_color.mp4",
        "orbit_background_stereo": "orbit_background_stereo.mp4", "input_path_objects": "input_path_objects.webm",
        "wiggle": "wiggle.gif", "orbit_distance_2x1.2_3x0.9_objects_2_3": "o.webm",
        "stabilized_slow2.5_objects": "stabilized_slow2.5_objects.webm", "custom_path_round-it": "custom_path_round-it.mp4",
        "custom_path_at_distance_x_slowly_color_distance_3x2": "custom_path_o.mp4",
    }  # fmt: skip
    page = write(tmp_path, replace(made_up_run(), videos=videos))
    assert "Round the middle of the clip, the background alone." in page
    assert 'href="renders/orbit_background.mp4">With flow and depth beside it' in page
    assert "Round the middle of the clip, the background alone, for two eyes." in page
    assert "the objects alone." in page
    assert "Round the middle of the clip, object 2 1.2 times as far, object 3 0.9 times as far, object 2, 3 alone." in page
    assert "Along the camera path round-it" in page
    assert "Along the camera path at_distance_x_slowly_color, object 3 2 times as far" in page
    assert "without the shaking, 2.5 times slower, the objects alone." in page
    assert '<img src="renders/wiggle.gif"' in page
    assert '<video controls muted loop playsinline preload="metadata" src="renders/input_path_objects.webm">' in page


def test_it_is_whole_without_a_network(tmp_path):
    page = write(tmp_path, made_up_run())
    parser = Balance()
    parser.feed(page)
    assert not parser.open
    videos = {"renders/input_path.mp4", "renders/input_path_color.mp4", "renders/orbit.mp4"}
    assert {source for source in parser.sources if not source.startswith("data:")} == videos
    assert "//" not in re.sub(r"data:[^\"]*", "", page), "no address of another machine"
    assert "<script" not in page
    assert "@import" not in page
    assert "url(" not in page
    assert len(page) < 3_000_000


def test_light_dark_and_print(tmp_path):
    page = write(tmp_path, made_up_run())
    assert "prefers-color-scheme: dark" in page
    assert "@media print" in page


def test_names_cannot_break_the_page(tmp_path):
    image = made_up_images(0)
    data = replace(
        made_up_run(),
        title=NASTY,
        notes=[NASTY],
        config={NASTY: NASTY},
        comparisons=[Comparison(NASTY, *image[:2])],
        flows=[FlowComparison(NASTY, *image[2:])],
        videos={NASTY: f"{NASTY}.mp4"},
    )
    page = write(tmp_path, data)
    parser = Balance()
    parser.feed(page)
    assert not parser.open
    assert "<script" not in page
    assert "49" not in re.findall(r"<h1>(.*?)</h1>", page)[0]


def test_an_almost_empty_run_is_reported(tmp_path):
    page = words(write(tmp_path, ReportData("bare", {})))
    assert "No frame was held out" in page
    assert "–" in page
    assert "Videos" not in page


def test_the_cards_show_the_path_and_what_is_beside_it(tmp_path):
    cards = re.findall(r'<div class="card">.*?</div><div.*?</div></div>', write(tmp_path, made_up_run()))
    assert all(text in cards[0] for text in ("29.87", "along the clip"))
    assert all(text in cards[1] for text in ("21.34", "from aside", "objects: 19.90 dB"))
    unmeasured = ReportData("bare", {"objects": [{"sigma": 0.07, "cues": ["contact"], "largest_step": 0.02, "depth": 2.0}]})
    cards = re.findall(r'<div class="card">.*?</div><div.*?</div></div>', write(tmp_path, unmeasured))
    assert all(text in cards[1] for text in ("from aside: not measured", "distance: sure to 7%"))


def test_the_same_run_gives_the_same_page(tmp_path):
    assert write(tmp_path / "a", made_up_run()) == write(tmp_path / "b", made_up_run())
