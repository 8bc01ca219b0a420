"""Names from files and browsers become names of files, or are refused."""

from __future__ import annotations

import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.files import plain_name
from flowsplat.common.files.names import MAX_NAME_BYTES


@pytest.mark.parametrize("name", ["a", "camera 3", "v000_t000", "Straße", "a..b", "x" * MAX_NAME_BYTES, "-o"])
def test_plain_names_stay_as_they_are(name):
    assert plain_name(name) == name


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("../../evil", "another folder"), ("/etc/passwd", "another folder"), ("a\\b", "another folder"), ("a/", "another folder"),
        ("", "empty"), (".", "begins with a dot"), ("..", "begins with a dot"), (".hidden", "begins with a dot"),
        (" a", "a space"), ("a\0b", "cannot be shown"), ("a\nb", "cannot be shown"), ("\x1b[31m", "cannot be shown"),
        ("\udcff", "cannot be shown"), ("\u202egnp", "cannot be shown"), ("x" * 300, "longer than 150 bytes"),
        ("é" * 76, "longer than 150 bytes"), (None, "no text"), (7, "no text"), (["a"], "no text"), (b"a", "no text"),
    ],
)  # fmt: skip
def test_what_is_no_plain_name_is_refused(name, reason):
    with pytest.raises(InputError) as error:
        plain_name(name, "camera")
    said = str(error.value)
    assert said.startswith("camera ")
    assert reason in said
    assert said.isprintable()
    assert len(said) < 200
