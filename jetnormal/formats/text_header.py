"""What precedes the numbers in a text file: comments, column names, the number of points."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from jetnormal.errors import InputError

COMMENT = re.compile(r"((?:#|//)[ \t]?)(.*)")

_LONGEST_LINE = 1 << 20
_SPELLINGS = {
    "x": ("x", "easting", "east", "rechtswert", "ostwert", "e"),
    "y": ("y", "northing", "north", "hochwert", "nordwert", "n"),
    "z": ("z", "height", "elevation", "altitude", "hoehe", "höhe", "h"),
}
"""What files call the coordinates, without regard to case and to units in brackets."""


@dataclass
class Preamble:
    """The lines before the first row of numbers, and how that row is laid out.

    Attributes:
        offset: position of the first row in the file.
        line: its line number.
        columns: how many numbers it holds; 0 if there is no row.
        delimiter: what stands between them: a comma, semicolon, tab or blank.
        decimal_comma: whether numbers have commas for decimal points.
        names: the names of the columns, if the file gives them.
        header: ``"plain"`` if a line of its own gives the names, what begins the comment if one does, else
            ``""``.
        count: the number of points, if the file gives it.
        comments: pairs of marker and text.
    """

    offset: int = 0
    line: int = 0
    columns: int = 0
    delimiter: str = " "
    decimal_comma: bool = False
    names: list[str] | None = None
    header: str = ""
    count: int | None = None
    comments: list[tuple[str, str]] = field(default_factory=list)


def read_preamble(stream: BinaryIO, path: Path, decimal: str | None = None) -> Preamble:
    """Read up to the first row of numbers.

    Args:
        stream: at the beginning of the text.
        path: the file, for messages.
        decimal: "point", "comma", or None: a comma between semicolons.

    Raises:
        InputError: if a line is neither a comment, nor names, nor numbers; or if the names do not match the
            rows.
    """
    found = Preamble()
    while not found.columns:
        found.offset = stream.tell()
        raw = stream.readline(_LONGEST_LINE)
        if not raw:
            break
        found.line += 1
        text = raw.decode("utf-8", "surrogateescape").strip()
        comment = COMMENT.match(text)
        if comment:
            found.comments.append((comment[1], comment[2]))
        elif text:
            _interpret(text, found, path, decimal)
    _names_from_comment(found)
    if found.names and found.columns and len(found.names) != found.columns:
        raise InputError(
            f"{path}: line {found.line}: {found.columns} values under {len(found.names)} column names; "
            "correct the line of names"
        )
    return found


def _interpret(text: str, found: Preamble, path: Path, decimal: str | None) -> None:
    values, delimiter = split_line(re.split("#|//", text)[0], decimal == "comma")
    decimal_comma = decimal == "comma" or (delimiter == ";" and decimal is None)
    numeric = [is_number(value, decimal_comma) for value in values]
    if len(values) == 1 and values[0].isdecimal() and len(values[0]) < 19 and found.count is None:
        found.count = int(values[0])
    elif all(numeric):
        if len(values) < 3:
            raise InputError(f"{path}: line {found.line}: {len(values)} values; x, y and z are needed")
        found.columns, found.delimiter, found.decimal_comma = len(values), delimiter, decimal_comma
    elif (any(numeric) and find_coordinates(values) is None) or found.names:
        wrong = values[numeric.index(False)]
        raise InputError(f"{path}: line {found.line}: {wrong[:40]!r} is not a number; correct the file")
    else:
        found.names, found.header, found.delimiter = values, "plain", delimiter


def _names_from_comment(found: Preamble) -> None:
    """Take the last comment that reads like column names, such as CloudCompare's ``//X Y Z R G B``."""
    if found.names:
        return
    for marker, text in reversed(found.comments):
        names, _ = split_line(text)
        if find_coordinates(names) is not None and found.columns in (0, len(names)):
            found.names, found.header = names, marker
            found.comments.remove((marker, text))
            return


def find_coordinates(names: Sequence[str]) -> dict[str, str] | None:
    """Find which of the names are those of coordinates, in the words that surveyors use, in any case.

    Returns:
        These names mapped to ``x y z``; None if one is missing.
    """
    plain = {re.sub(r"\s*[\[(].*", "", name).strip().lower(): name for name in reversed(names)}
    found = {}
    for axis, spellings in _SPELLINGS.items():
        name = next((plain[spelling] for spelling in spellings if spelling in plain), None)
        if name is None:
            return None
        found[name] = axis
    return found


def split_line(text: str, decimal_comma: bool = False) -> tuple[list[str], str]:
    """Return the values of a line, without quotes, and the delimiter: a semicolon, comma, tab or blank.

    Numbers may be parted by tabs and blanks in any mixture; between names, a tab keeps the blanks within them.
    """
    for delimiter in ";\t" if decimal_comma else ";,\t":
        if delimiter == "\t" and all(is_number(word, decimal_comma) for word in text.split()):
            return text.split(), delimiter if delimiter in text else " "
        if delimiter in text:
            return [value.strip().strip('"').strip() for value in text.split(delimiter)], delimiter
    return [value.strip('"') for value in text.split()], " "


def is_number(text: str, decimal_comma: bool = False) -> bool:
    """Tell whether a word is a number, perhaps with Fortran's exponent."""
    if decimal_comma:
        text = text.replace(",", ".")
    try:
        float(re.sub(r"(?<=[\d.])[dD]", "e", text))
    except ValueError:
        return False
    return True
