"""LZF, the byte compression inside ``binary_compressed`` PCD files.

The stream is Marc Lehmann's LibLZF format. A control byte below 32 announces that many plus one literal
bytes; any other holds a match: its length minus two in the upper three bits (7 means that one more byte is
added) and the upper five bits of the distance minus one, whose lower byte follows. Working run by run instead
of byte by byte makes plain Python fast enough (about 25 MB/s unpacking and 5 MB/s packing), which saves a
compiled dependency.
"""

from __future__ import annotations

MAX_RATIO = 88
"""The longest match unpacks 3 bytes to 264, so no stream can grow more than this."""

_WINDOW = 8192
_REMEMBERED = 8 * _WINDOW  # most of these sequences are out of reach by then
_LONGEST_MATCH = 264
_LONGEST_LITERAL = 32


def decompress(packed: bytes, size: int) -> bytes:
    """Unpack a stream that must give exactly `size` bytes.

    Raises:
        ValueError: if the stream is damaged.
    """
    out = bytearray()
    position, end = 0, len(packed)
    try:
        while position < end and len(out) <= size:
            control = packed[position]
            position += 1
            if control < _LONGEST_LITERAL:
                out += packed[position : position + control + 1]
                position += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[position]
                position += 1
            distance = ((control & 31) << 8) + packed[position] + 1
            position += 1
            length += 2
            start = len(out) - distance
            if start < 0:
                raise ValueError("a match points before the beginning")
            if distance >= length:
                out += out[start : start + length]
            else:  # the match overlaps what it produces: the last `distance` bytes repeat
                out += (out[start:] * (length // distance + 1))[:length]
    except IndexError:
        raise ValueError("the stream ends inside a match") from None
    if position > end or len(out) != size:
        raise ValueError(f"the stream unpacks to {len(out)} bytes instead of {size}")
    return bytes(out)


def compress(data: bytes) -> bytes:
    """Pack bytes greedily: the most recent match of three or more bytes is taken.

    The longer nothing has matched, the longer are the steps, as in LZ4: noise is not worth the time.
    """
    out = bytearray()
    recent: dict[bytes, int] = {}  # the last position of each three-byte sequence
    position = literals = 0
    end = len(data)
    while position < end - 2:
        key = data[position : position + 3]
        match = recent.get(key, -_WINDOW - 1)
        recent[key] = position
        if position - match > _WINDOW:
            position += 1 + (position - literals >> 6)
            if len(recent) > _REMEMBERED:
                recent.clear()
            continue
        length, longest = 3, min(_LONGEST_MATCH, end - position)
        while length < longest and data[match + length] == data[position + length]:
            length += 1
        _append_literals(out, data[literals:position])
        _append_match(out, length - 2, position - match - 1)
        position += length
        literals = position
    _append_literals(out, data[literals:])
    return bytes(out)


def _append_match(out: bytearray, length: int, distance: int) -> None:
    if length < 7:
        out.append(length << 5 | distance >> 8)
    else:
        out.append(7 << 5 | distance >> 8)
        out.append(length - 7)
    out.append(distance & 255)


def _append_literals(out: bytearray, literals: bytes) -> None:
    for start in range(0, len(literals), _LONGEST_LITERAL):
        run = literals[start : start + _LONGEST_LITERAL]
        out.append(len(run) - 1)
        out += run
