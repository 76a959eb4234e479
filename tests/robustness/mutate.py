"""Damage to files: what a broken disk, a cut transfer, an editor or a careless program does to them."""

from __future__ import annotations

import random
import re
from collections.abc import Callable

NUMBERS = (
    b"0", b"-1", b"1", b"2", b"255", b"256", b"65535", b"2147483647", b"2147483648", b"4294967295", b"4294967296",
    b"-2147483648", b"9223372036854775807", b"-9223372036854775808", b"18446744073709551616", b"1e5", b"0.5", b"-0",
    b"nan", b"inf", b"-inf", b"1e308", b"1e-320", b"1e400", b"", b"9" * 30, b"9" * 5000, b"x",
)  # fmt: skip
WORDS = tuple(
    value.to_bytes(size, order, signed=value < 0)
    for size in (1, 2, 4, 8)
    for order in ("little", "big")
    for value in (0, 1, -1, 2 ** (8 * size - 1) - 1, -(2 ** (8 * size - 1)))
)
LONGEST = 40_000  # bytes of a mutated file

Mutator = Callable[[bytes, random.Random], bytes]


def mutated(seeds: list[bytes], rng: random.Random) -> bytes:
    """One of the files with one to four damages."""
    data = rng.choice(seeds)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        data = rng.choice(MUTATORS)(data, rng) if rng.random() < 0.95 else _splice(data, rng.choice(seeds), rng)
        data = data[:LONGEST]  # after each damage: two that repeat something would fill the memory
    return data


def _span(data: bytes, rng: random.Random, longest: int = 64) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    return start, min(len(data), start + rng.randrange(1, longest))


def _flip(data: bytes, rng: random.Random) -> bytes:
    if not data:
        return data
    out = bytearray(data)
    out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _overwrite(data: bytes, rng: random.Random) -> bytes:
    start, end = _span(data, rng, 8)
    return data[:start] + rng.randbytes(end - start) + data[end:]


def _insert(data: bytes, rng: random.Random) -> bytes:
    start, _ = _span(data, rng)
    return data[:start] + rng.randbytes(rng.randrange(1, 32)) + data[start:]


def _delete(data: bytes, rng: random.Random) -> bytes:
    start, end = _span(data, rng)
    return data[:start] + data[end:]


def _double(data: bytes, rng: random.Random) -> bytes:
    start, end = _span(data, rng)
    return data[:end] + data[start:end] * rng.choice((1, 1, 2, 1000)) + data[end:]


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _word(data: bytes, rng: random.Random) -> bytes:
    value = rng.choice(WORDS)
    start = rng.randrange(len(data) + 1)
    return data[:start] + value + data[start + len(value) :]


def _number(data: bytes, rng: random.Random) -> bytes:
    """Another number in the place of one; in the first lines, where the counts are, as often as in all the rest."""
    found = list(re.finditer(rb"-?\d[\d.eE+-]*", data[: rng.choice((400, len(data)))]))
    if not found:
        return data
    chosen = rng.choice(found)
    return data[: chosen.start()] + rng.choice(NUMBERS) + data[chosen.end() :]


def _token(data: bytes, rng: random.Random) -> bytes:
    """A word of the file in the place of another."""
    found = list(re.finditer(rb"[A-Za-z_][\w.]*", data[:4000]))
    if len(found) < 2:
        return data
    old, new = rng.choice(found), rng.choice(found)
    return data[: old.start()] + new.group() + data[old.end() :]


def _lines(data: bytes, rng: random.Random) -> bytes:
    """A line gone, twice, many times, or in another place."""
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    line = lines[at]
    action = rng.randrange(4)
    if action < 2:
        lines[at : at + 1] = [line] * action * 2
    elif action == 2:
        lines[at:at] = [line] * rng.choice((2, 50, 500))
    else:
        lines.insert(rng.randrange(len(lines)), lines.pop(at))
    return b"\n".join(lines)


def _line_ends(data: bytes, rng: random.Random) -> bytes:
    return data.replace(b"\n", rng.choice((b"\r\n", b"\r", b"\n\n", b" \n", b"\0")))


def _splice(data: bytes, other: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


MUTATORS: tuple[Mutator, ...] = (
    _flip, _overwrite, _insert, _delete, _double, _cut, _word, _number, _number, _token, _lines, _line_ends,
)  # fmt: skip
