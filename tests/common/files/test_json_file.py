"""JSON from anywhere: understood, or refused with a line."""

from __future__ import annotations

import json
from typing import Any

import pytest
from typing_extensions import TypedDict

from flowsplat.common.errors import InputError
from flowsplat.common.files.json_file import MAX_JSON_DEPTH, Count, Number, Pixels, Row3, check_json, read_json


class Small(TypedDict):
    """A schema for these tests."""

    width: Pixels
    frames: Count
    place: Row3
    weight: Number | None


GOOD: dict[str, Any] = {"width": 64, "frames": 0, "place": [1, 2.5, -3], "weight": None, "unknown": ["kept"]}


def written(folder, text):
    path = folder / "file.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_what_fits_is_given_back_as_it_is(tmp_path):
    assert read_json(written(tmp_path, json.dumps(GOOD)), Small) == GOOD
    assert read_json(written(tmp_path, b"\xef\xbb\xbf[1]")) == [1]


@pytest.mark.parametrize(
    "text",
    [
        "", "{", "[1,]", "nothing", '"\udcff"'.encode("utf-8", "surrogatepass"), b'"\xff"', b"\0\0\0\0", "[1] [2]", "{1: 2}", "01",
        '"\\ud800"', '{"\\udfff": 1}', '["x\\ud83d\\u0041"]',
    ],
)  # fmt: skip
def test_what_is_no_json_is_refused(tmp_path, text):
    with pytest.raises(InputError, match="not readable JSON") as error:
        read_json(written(tmp_path, text))
    assert str(error.value).isprintable()


@pytest.mark.parametrize("text", ['{"a": NaN}', "[Infinity]", "[1, -Infinity]"])
def test_numbers_that_are_not_finite_are_named(tmp_path, text):
    with pytest.raises(InputError, match="not finite"):
        read_json(written(tmp_path, text))


def test_a_whole_character_of_two_halves_is_text(tmp_path):
    assert read_json(written(tmp_path, '"\\ud83d\\ude00"')) == "\U0001f600"


def test_half_a_character_that_another_reader_let_pass_is_refused(tmp_path):
    for value in ({**GOOD, "\ud800": 1}, {"\ud800": 1}):
        with pytest.raises(InputError, match="half a character") as error:
            check_json(tmp_path, value, Small)
        assert str(error.value).isprintable()


@pytest.mark.parametrize("text", ["[1e999]", "[" + "9" * 5000 + "]", "[-" + "9" * 5000 + "]", "[9007199254740993]"])
def test_numbers_that_no_float_holds_are_refused(tmp_path, text):
    with pytest.raises(InputError) as error:
        read_json(written(tmp_path, text))
    assert len(str(error.value)) < 300


def test_depth_is_bounded(tmp_path):
    assert read_json(written(tmp_path, "[" * (MAX_JSON_DEPTH - 1) + "1" + "]" * (MAX_JSON_DEPTH - 1)))
    for depth in (MAX_JSON_DEPTH, 500, 100_000, 5_000_000):
        with pytest.raises(InputError) as error:
            read_json(written(tmp_path, "[" * depth + "1" + "]" * depth))
        assert "file.json is " in str(error.value)
    with pytest.raises(InputError):
        read_json(written(tmp_path, '{"a":' * 100_000 + "1" + "}" * 100_000))


def test_size_is_bounded(tmp_path):
    path = written(tmp_path, json.dumps("x" * 100))
    assert read_json(path, most=102) == "x" * 100
    with pytest.raises(InputError, match="102 bytes, more than the 101 bytes"):
        read_json(path, most=101)


@pytest.mark.parametrize(
    "wrong",
    [
        {"width": 0}, {"width": 10**6}, {"width": 1.5}, {"width": "64"}, {"width": None}, {"width": True}, {"frames": -1},
        {"place": [1, 2]}, {"place": [1, 2, 3, 4]}, {"place": {"0": 1}}, {"place": 1}, {"weight": 1e300}, {"weight": "1"},
    ],
)  # fmt: skip
def test_what_is_not_as_the_schema_says_is_named(tmp_path, wrong):
    with pytest.raises(InputError, match=rf"damaged: .*\$\.{next(iter(wrong))}"):
        read_json(written(tmp_path, json.dumps({**GOOD, **wrong})), Small)


@pytest.mark.parametrize("value", [None, [], 3, "text", {}, {k: v for k, v in GOOD.items() if k != "frames"}])
def test_what_lacks_something_is_refused(tmp_path, value):
    with pytest.raises(InputError, match="is damaged"):
        check_json(tmp_path, value, Small)
