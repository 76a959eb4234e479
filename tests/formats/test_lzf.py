from __future__ import annotations

import numpy as np
import pytest

from jetnormal.formats import lzf

RANDOM = np.random.default_rng(1)
SAMPLES = {
    "empty": b"",
    "one byte": b"a",
    "a run": b"a" * 1000,
    "incompressible": RANDOM.bytes(5000),
    "periods": b"abc" * 500 + b"0123456789" * 300,
    "smooth floats": np.linspace(0, 1, 3000, dtype="f4").tobytes(),
    "matches beyond the window": RANDOM.bytes(9000) * 2,
}


@pytest.mark.parametrize("name", SAMPLES)
def test_what_is_packed_unpacks_to_the_same(name):
    data = SAMPLES[name]
    assert lzf.decompress(lzf.compress(data), len(data)) == data


def test_runs_shrink_to_the_longest_possible_matches():
    assert len(lzf.compress(b"a" * 26_400)) < 26_400 // lzf.MAX_RATIO + 10


def test_a_stream_written_by_hand():
    # two literals, a match of 3 at distance 2 (overlapping), a match of 9 at distance 1
    assert lzf.decompress(b"\x01ab\x20\x01\xe0\x00\x00", 14) == b"ab" + b"aba" + b"a" * 9


@pytest.mark.parametrize("packed", [b"\x05ab", b"\x01ab\x20\x09", b"\x01ab\xe0", b"\x01ab", b"\x03abcd"])
def test_damaged_streams(packed):
    with pytest.raises(ValueError, match=r"stream|match"):
        lzf.decompress(packed, 3)
