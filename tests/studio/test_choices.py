"""What is chosen becomes the options that a run would be typed with."""

from __future__ import annotations

import pytest

from flowsplat.common.errors import InputError
from flowsplat.pipeline.shot_places import take_places
from flowsplat.studio.choices import (
    first_choices,
    keep_marks,
    list_arguments,
    list_idle_marks,
    list_places,
    read_choices,
    read_config,
    split_options,
)
from tests.studio.serving import mark


def test_clicks_are_numbered_as_the_command_line_counts_them():
    """An object without a click on it is none, and the next one takes its number."""
    choices = {
        **first_choices(), "start": 1.25, "end": 3.0, "preset": "default", "contacts": [mark(0.5, 0.9, 4)],
        "objects": [
            {"clicks": [mark(0.25, 0.5), mark(0.3, 0.5, 2)], "beside": [mark(0.1, 0.1)]},
            {"clicks": [], "beside": [mark(0.2, 0.2)]},
            {"clicks": [mark(0.75, 0.5)], "beside": []},
        ],
    }  # fmt: skip
    words = list_arguments(read_choices(choices), ["--train.iterations", "7"])
    assert words == [
        "--train.iterations", "7", "--preset", "default", "--start", "1.25", "--end", "3",
        "--mask-click", "0.25,0.5@0", "--mask-click", "0.3,0.5@2=1", "--mask-negative", "0.1,0.1@0=1",
        "--mask-click", "0.75,0.5@0", "--contact", "0.5,0.9@4",
    ]  # fmt: skip
    config = read_config(words)
    assert (config.input.start, config.input.end, config.train.iterations) == (1.25, 3.0, 7)
    assert config.priors.mask_click == ("0.25,0.5@0", "0.3,0.5@2=1", "0.75,0.5@0")
    assert config.priors.contact == ("0.5,0.9@4",)


def test_settings_are_those_of_the_preset():
    assert read_config(["--preset", "fast"]).input.resize == 427
    assert read_config(["--preset", "default"]).input.resize is None


@pytest.mark.parametrize(
    "change",
    [
        {"preset": "best"}, {"start": -1}, {"start": "1"}, {"start": 2.0, "end": 1.0}, {"objects": [{"clicks": [mark(1.5, 0)]}]},
        {"objects": [{"clicks": [mark(0.5, 0.5)] * 101, "beside": []}]}, {"contacts": "all"}, {"objects": None},
        {"contacts": [{"x": 0.5, "y": 0.5, "frame": -1, "second": 0}]}, {"shots": "some"},
        *({"contacts": [{**mark(0.5, 0.5), "frame": frame}]} for frame in ("0/1", "1/", "2", "1/2\n", "1/2=3", "1/123456")),
    ],
)  # fmt: skip
def test_choices_that_cannot_be_are_refused(change):
    with pytest.raises(InputError):
        read_choices({**first_choices(), **change})


def test_what_is_no_choice_at_all_is_refused():
    for value in (None, [], "x", {}, {"preset": "fast"}):
        with pytest.raises(InputError):
            read_choices(value)


def test_other_things_that_a_page_sends_are_left_out():
    assert "out" not in read_choices({**first_choices(), "out": "/etc"})


@pytest.mark.parametrize("text", ["--nothing 1", "--train.iterations", "'", "--preset fast", "--resize 5", "INPUT"])
def test_options_that_no_run_takes_are_refused_before_anything_is_served(text):
    with pytest.raises(InputError, match="--run-options"):
        split_options(text)


def test_clicks_stay_on_their_moment_when_the_cut_changes():
    choices = read_choices({
        **first_choices(), "contacts": [mark(0.5, 0.5, 9)],
        "objects": [
            {"clicks": [mark(0.1, 0.1, 2), mark(0.2, 0.2, 6)], "beside": []}, {"clicks": [mark(0.3, 0.3, 1)], "beside": []},
        ],
    })  # fmt: skip
    seconds = {k: (k + 4) / 8 for k in range(4)}  # the cut begins with what was frame 4, and ends with frame 7
    kept, lost = keep_marks(choices, seconds, 0.002)
    assert lost == 3
    assert kept["contacts"] == []
    assert [[each["frame"] for each in one["clicks"]] for one in kept["objects"]] == [[2]]
    assert kept["objects"][0]["clicks"][0]["second"] == 0.75
    assert keep_marks(kept, seconds, 0.002) == (kept, 0)


def test_each_shot_counts_its_own_objects():
    """What is clicked on in two shots is an object of each; what is none says nothing where no click shows it: that is said."""
    choices = {
        **first_choices(), "contacts": [mark(0.5, 0.9, "2/4")],
        "objects": [
            {"clicks": [mark(0.1, 0.5, "1/0"), mark(0.2, 0.5, "1/3")], "beside": [mark(0.9, 0.1, "2/1")]},
            {"clicks": [mark(0.3, 0.5, "2/0"), mark(0.4, 0.5, "1/2"), mark(0.6, 0.5, "2/8")], "beside": [mark(0.7, 0.1, "2/0")]},
        ],
    }  # fmt: skip
    choices = read_choices(choices)
    assert list_places(choices) == [
        "--mask-click", "0.1,0.5@1/0", "--mask-click", "0.2,0.5@1/3=1", "--mask-click", "0.4,0.5@1/2",
        "--mask-click", "0.3,0.5@2/0", "--mask-click", "0.6,0.5@2/8=1", "--mask-negative", "0.7,0.1@2/0=1",
        "--contact", "0.5,0.9@2/4",
    ]  # fmt: skip
    assert list_idle_marks(choices) == ["What is not object 1 in shot 2 says nothing: click on the object itself there, too."]
    second = take_places(read_config(list_places(choices)).priors, 2)
    assert second.mask_click == ("0.3,0.5@0", "0.6,0.5@8=1")
    assert (second.mask_negative, second.contact) == (("0.7,0.1@0=1",), ("0.5,0.9@4",))


def test_clicks_stay_on_their_moment_when_shots_become_one_scene():
    choices = {**first_choices(), "contacts": [mark(0.5, 0.5, 9)]}
    kept, lost = keep_marks(choices, {"1/0": 0.0, "2/1": 9 / 8}, 0.002)
    assert (kept["contacts"][0]["frame"], lost) == ("2/1", 0)
    assert keep_marks(kept, {k: k / 8 for k in range(12)}, 0.002) == (choices, 0)
