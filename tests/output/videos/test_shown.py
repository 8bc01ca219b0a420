"""Which video is shown: the same one on every page."""

from __future__ import annotations

from flowsplat.output.videos.shown import ShownVideo, choose_video, order_videos


def test_the_clips_own_path_comes_first_and_in_color():
    videos = {
        "orbit": "a.mp4",
        "orbit_color": "b.mp4",
        "input_path_slow2": "c.mp4",
        "input_path": "d.mp4",
        "input_path_color": "e.mp4",
    }
    assert order_videos(videos) == [
        ("input_path", "input_path_color", "input_path"), ("orbit", "orbit_color", "orbit"),
        ("input_path_slow2", "input_path_slow2", None),
    ]  # fmt: skip
    assert choose_video(videos) == ShownVideo("input_path", "input_path_color", "input_path")


def test_a_gif_is_not_chosen_and_there_may_be_none():
    assert choose_video({"input_path": "a.gif", "orbit": "b.mp4"}) == ("orbit", "orbit", None)
    assert choose_video({"input_path": "a.gif"}) is None
    assert choose_video({}) is None
