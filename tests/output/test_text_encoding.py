"""Bytes as text in a page: every byte comes back, and nothing that a parser would change is in it."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.output.text_encoding import FORBIDDEN, decode_text, encode_text


@pytest.mark.parametrize("kind", ["random", "zeros", "forbidden", "counting"])
def test_bytes_come_back_as_they_were(kind):
    rng = np.random.default_rng(0)
    for count in (*range(30), 1000):
        values = {
            "random": rng.integers(0, 256, count),
            "zeros": np.zeros(count),
            "forbidden": np.packbits(
                np.unpackbits(rng.choice(FORBIDDEN, 2 * count).astype(np.uint8)[:, None], axis=1)[:, 1:].reshape(-1)[: 8 * count]
            ),
            "counting": np.arange(count) % 256,
        }[kind]
        data = values.astype(np.uint8).tobytes()
        text = encode_text(data)
        assert decode_text(text, count) == data
        assert not set(map(ord, text)) & set(FORBIDDEN)
        assert len(text.encode()) <= -(-8 * count // 7) + 1


@pytest.mark.parametrize(("text", "count"), [("A" * 7, 7), ("A<A", 1), ("A\x00A", 1), ("Aࠀ", 1), ("", 1), ("\ud800AAA", 1)])
def test_what_is_no_such_text_is_refused(text, count):
    with pytest.raises(ValueError, match=r"of it|cannot have"):
        decode_text(text, count)
