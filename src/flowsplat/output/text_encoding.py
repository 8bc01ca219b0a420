"""Bytes as text inside a page: seven bits a character, where base64 has six.

A page is UTF-8, in which the characters 0 to 127 take one byte each. Of these, ``FORBIDDEN`` are what a parser of HTML, an editor
or a transfer of texts might change; where seven bits are one of them, they are written together with the next seven as one
character from 128 on, which takes two bytes: nothing is lost (the idea is that of base122, http://blog.kevinalbs.com/base122).
"""

from __future__ import annotations

import numpy as np

FORBIDDEN = (0, 9, 10, 11, 12, 13, 26, 27, 32, 34, 38, 60, 62, 92, 127)
"""The k-th of them, followed by seven bits v, is the character 128 + 128 k + v: 15 are as many as two bytes have room for."""


def encode_text(data: bytes) -> str:
    """Return bytes as text; ``decode_text`` and the page know them again if they are told how many there are."""
    bits = np.unpackbits(np.frombuffer(data, np.uint8))
    rows = np.append(bits, np.zeros(-len(bits) % 7, np.uint8)).reshape(-1, 7)
    groups = np.append(
        (rows << np.arange(6, -1, -1, dtype=np.uint8)).sum(1, dtype=np.uint8), np.uint8(0)
    )  # one that may be taken along
    places = np.full(128, -1)
    places[list(FORBIDDEN)] = np.arange(len(FORBIDDEN))
    found = places[groups] >= 0
    # Of forbidden ones in a row, the first takes the second along, the third the fourth.
    index = np.arange(len(groups))
    last_other = np.maximum.accumulate(np.where(found, -1, index))
    pairs = found & ((index - last_other) % 2 == 1)
    pairs[-1] = False
    taken = np.append(False, pairs[:-1])
    characters = np.where(pairs, 128 + 128 * places[groups] + np.append(groups[1:], 0), groups)
    taken[-1] = True  # it was taken along, or is not needed
    return characters[~taken].astype("<u4").tobytes().decode("utf-32-le")


def decode_text(text: str, count: int) -> bytes:
    """Return the first ``count`` bytes of what ``encode_text`` made a text of.

    Raises:
        ValueError: there is another character in it, or too little.
    """
    characters = np.frombuffer(text.encode("utf-32-le", "surrogatepass"), "<u4")
    first_of = np.concatenate([np.arange(128), np.repeat(FORBIDDEN, 128)]).astype(np.uint8)
    if (characters >= len(first_of)).any() or np.isin(characters, FORBIDDEN).any():
        raise ValueError("a character that it cannot have")
    are_two = characters >= 128
    kept = np.stack([np.ones_like(are_two), are_two], 1)
    groups = np.stack([first_of[characters], (characters & 127).astype(np.uint8)], 1)[kept]
    if len(groups) * 7 < count * 8:
        raise ValueError("too little of it")
    bits = np.unpackbits(groups[:, None], axis=1)[:, 1:].reshape(-1)
    return np.packbits(bits[: 8 * count]).tobytes()
