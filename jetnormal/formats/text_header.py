"""What precedes the numbers in a text file: comments, column names, the number of points."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from jetnormal.errors import InputError
from jetnormal.formats.columns import COORDINATES

COMMENT = re.compile(r"((?:#|//)[ \t]?)(.*)")

_LONGEST_LINE = 1 << 20


@dataclass
class Preamble:
    """The lines before the first row of numbers, and how that row is laid out.

    Attributes:
        offset: position of the first row in the file.
        line: its line number.
        columns: how many numbers it holds; 0 if there is no row.
        delimiter: what stands between them: a comma, semicolon, tab or blank.
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
    names: list[str] | None = None
    header: str = ""
    count: int | None = None
    comments: list[tuple[str, str]] = field(default_factory=list)


def read_preamble(stream: BinaryIO, path: Path) -> Preamble:
    """Reads up to the first row of numbers.

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
            _interpret(text, found, path)
    _names_from_comment(found)
    if found.names and found.columns and len(found.names) != found.columns:
        raise InputError(
            f"{path}: line {found.line}: {found.columns} values under {len(found.names)} column names; "
            "correct the line of names"
        )
    return found


def _interpret(text: str, found: Preamble, path: Path) -> None:
    values, delimiter = split_line(re.split("#|//", text)[0])
    numeric = [_is_number(value, delimiter) for value in values]
    if len(values) == 1 and values[0].isdecimal() and found.count is None:
        found.count = int(values[0])
    elif all(numeric):
        if len(values) < 3:
            raise InputError(f"{path}: line {found.line}: {len(values)} values; x, y and z are needed")
        found.columns, found.delimiter = len(values), delimiter
    elif any(numeric) or found.names:
        wrong = values[numeric.index(False)]
        raise InputError(f"{path}: line {found.line}: {wrong[:40]!r} is not a number; correct the file")
    else:
        found.names, found.header, found.delimiter = values, "plain", delimiter


def _names_from_comment(found: Preamble) -> None:
    """Takes the last comment that reads like column names, such as CloudCompare's ``//X Y Z R G B``."""
    if found.names:
        return
    for marker, text in reversed(found.comments):
        names, _ = split_line(text)
        known = [name.lower() for name in names]
        if all(name in known for name in COORDINATES) and found.columns in (0, len(names)):
            found.names, found.header = names, marker
            found.comments.remove((marker, text))
            return


def split_line(text: str) -> tuple[list[str], str]:
    """The values of a line, without quotes, and the delimiter: a semicolon, comma, tab or blank.

    Numbers may be parted by tabs and blanks in any mixture; between names, a tab keeps the blanks within them.
    """
    for delimiter in ";,\t":
        if delimiter == "\t" and all(_is_number(word, delimiter) for word in text.split()):
            return text.split(), delimiter if delimiter in text else " "
        if delimiter in text:
            return [value.strip().strip('"').strip() for value in text.split(delimiter)], delimiter
    return [value.strip('"') for value in text.split()], " "


def _is_number(text: str, delimiter: str) -> bool:
    if delimiter == ";":
        text = text.replace(",", ".")
    try:
        float(re.sub(r"(?<=[\d.])[dD]", "e", text))
    except ValueError:
        return False
    return True
