"""Tables as text, and JSON line by line."""

from __future__ import annotations

import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json_lines, read_rows


def test_a_table_as_a_spreadsheet_writes_it(tmp_path):
    (tmp_path / "a.csv").write_bytes('﻿path, id ,note\r\n"a,b.mp4",x,"two\nlines"\r\n\r\n,,\r\nc.mp4,y\r\n'.encode())
    assert read_rows(tmp_path / "a.csv") == [
        (3, {"path": "a,b.mp4", "id": "x", "note": "two\nlines"}), (6, {"path": "c.mp4", "id": "y"}),
    ]  # fmt: skip
    (tmp_path / "a.tsv").write_text("path\tid\na,b\tx\n")
    assert read_rows(tmp_path / "a.tsv") == [(2, {"path": "a,b", "id": "x"})]


@pytest.mark.parametrize("text", ["", "\n\n", "a,a\n1,2\n", "a\n1,2\n", 'a\n"1', "a\n" + "x" * 200_000])
def test_what_is_no_table_is_a_line(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=r"a\.csv"):
        read_rows(tmp_path / "a.csv")


def test_json_line_by_line(tmp_path):
    path = tmp_path / "a.jsonl"
    path.write_text('{"path": "a"}\r\n\n{"path": "b"}')
    assert read_json_lines(path, dict[str, str]) == [(1, {"path": "a"}), (3, {"path": "b"})]
    for text in ('{"path": "a"}\n{"path": 1}', '{"path": "a"}\n{"path"', '{"path": "a"}\n{"path": NaN}'):
        path.write_text(text)
        with pytest.raises(InputError, match="line 2"):
            read_json_lines(path, dict[str, str])
