"""From the texts of the command line to the values of options. This module imports nothing heavy."""

from __future__ import annotations

import math
import re
from typing import Literal

from jetnormal.support.options import Vector

Names = tuple[str, str, str]


def parse_vector(text: str) -> Vector:
    """Turn "X,Y,Z" into three numbers."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{text!r} is not X,Y,Z: three numbers with commas between them") from None
    return x, y, z


def parse_direction(text: str) -> Vector:
    """Turn "X,Y,Z" into three finite numbers, not all of them zero."""
    direction = parse_vector(text)
    if not all(map(math.isfinite, direction)) or not any(direction):
        raise ValueError(f"{text!r} is no direction: give three finite numbers, not all of them zero")
    return direction


def parse_names(text: str) -> Names:
    """Turn "X,Y,Z" into three names."""
    names = tuple(part.strip() for part in text.split(","))
    if len(names) != 3 or not all(names):
        raise ValueError(f"{text!r} is not X,Y,Z: three names of attributes with commas between them")
    return names


def parse_words(text: str) -> tuple[str, ...]:
    """Turn "A,B,..." into words."""
    return tuple(part.strip() for part in text.split(","))


def parse_up(text: str) -> Vector | Literal["auto"]:
    """Turn "X,Y,Z" into three numbers; "auto" stays."""
    return "auto" if text == "auto" else parse_direction(text)


def parse_component(text: str) -> int | Literal["largest"]:
    """Turn the text of `min_component` into a number of points, or "largest"."""
    if text == "largest":
        return "largest"
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"{text!r} is no number of points and not the word largest") from None


def parse_bytes(text: str) -> int:
    """Turn "4GB", "500 MB" or a number of bytes into bytes."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)(i?)B?", text.strip(), re.IGNORECASE)
    if match is None:
        raise ValueError(f"{text!r} is no size such as 4GB or 500MB")
    unit = 1024 if match[3] else 1000
    size = float(match[1]) * unit ** " KMGT".index(match[2].upper() or " ")
    if not math.isfinite(size):
        raise ValueError("no size has so many digits")
    return round(size)


def complete_model(text: str) -> list[str]:
    """List the models, networks and classical fits, whose names begin with a text."""
    from jetnormal.estimators.factory import model_names

    return [name for name in model_names() if name.startswith(text)]
