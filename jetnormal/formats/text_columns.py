"""What the columns of a text file are: said by the user, named in the file, or guessed from their values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import UsageError
from jetnormal.formats.columns import COORDINATES, NORMALS, UniqueNames
from jetnormal.formats.storage import COLORS
from jetnormal.formats.text_header import find_coordinates

SKIPPED = "-"
"""The name of a column that is left out."""
POINT_NUMBER = "point_number"

_UNIT_TOLERANCE = 0.02  # normals in text have been rounded, often to two decimals
_FEWEST_NUMBERS = 10  # a few points on a line may have x = 0, 1, 2


@dataclass(frozen=True)
class Layout:
    """What the user says about the columns.

    Attributes:
        names: of all columns in order; "-" for one that is left out.
        meant: x, y, z or other names, by the names in the file that they stand for.
    """

    names: tuple[str, ...] = ()
    meant: tuple[tuple[str, str], ...] = ()

    @classmethod
    def parse(cls, text: str | None) -> Layout:
        """Understand "id,x,y,z,intensity,-" or "x=Rechtswert,y=Hochwert,z=Hoehe".

        Raises:
            UsageError: it is neither, or names something twice.
        """
        if text is None:
            return cls()
        parts = [part.strip() for part in text.split(",")]
        assigned = [tuple(word.strip() for word in part.partition("=")[::2]) for part in parts if "=" in part]
        names = [name for name, _ in assigned] if assigned else [part for part in parts if part != SKIPPED]
        if len(assigned) not in (0, len(parts)) or not all(names) or not all(there for _, there in assigned):
            raise UsageError(f"`columns={text}`: give names like id,x,y,z,- or assignments like x=East,y=North,z=Up")
        lower = [name.lower() for name in names]
        twice = next((name for name in lower if lower.count(name) > 1), None)
        missing = [name for name in COORDINATES if name not in lower]
        if twice or (missing and not assigned):
            raise UsageError(f"`columns={text}`: {f'{twice!r} comes twice' if twice else f'{missing[0]!r} is missing'}")
        if assigned:
            return cls(meant=tuple((name, there) for name, there in assigned))
        return cls(tuple(parts))

    def apply(
        self, named: Sequence[str] | None, columns: Sequence[NDArray[Any]], suffix: str, path: Path
    ) -> tuple[list[str], tuple[str, ...]]:
        """Name the columns of a file.

        Args:
            named: the names in the file, if it has any.
            columns: the numbers.
            suffix: whose conventions the file follows.
            path: the file, for messages.

        Returns:
            A name for each column, and what to tell the user.

        Raises:
            UsageError: the names do not fit the file.
        """
        if self.names:
            if len(self.names) != len(columns):
                raise UsageError(f"{path}: `columns` names {len(self.names)} columns, but there are {len(columns)}")
            return list(self.names), ()
        if self.meant:
            return self._rename(named, path), ()
        if named is not None:
            return _with_names(named, find_coordinates(named) or {}), ()
        names = guess_names(columns, suffix)
        if names[0] != POINT_NUMBER:
            return names, ()
        return names, ("the first column counts the points: it is taken as their number; `columns` tells otherwise",)

    def _rename(self, named: Sequence[str] | None, path: Path) -> list[str]:
        if named is None:
            raise UsageError(f"{path}: has no line of names; give `columns` as a list, such as x,y,z,-")
        lower = {name.lower(): name for name in reversed(named)}
        meant = find_coordinates(named) or {}
        for name, there in self.meant:
            spelled = there if there in named else lower.get(there.lower())
            if spelled is None:
                raise UsageError(f"{path}: `columns`: there is no column {there!r} among {', '.join(named)}")
            meant = {key: value for key, value in meant.items() if value != name} | {spelled: name}
        return _with_names(named, meant)


def _with_names(named: Sequence[str], meant: dict[str, str]) -> list[str]:
    """The names with some replaced by what they mean, and what else has such a name numbered."""
    unique = UniqueNames(meant.values())
    done: set[str] = set()
    names = []
    for name in named:
        is_first = name in meant and name not in done
        done.add(name)
        clashes = name.lower() in meant.values()
        names.append(meant[name] if is_first else unique.add(name.lower()) if clashes else name)
    return names


def guess_names(columns: Sequence[NDArray[Any]], suffix: str) -> list[str]:
    """Name columns by their place and their values.

    A first column of at least four that counts from 0 or 1 is the number of the point. The next three are the
    coordinates. Normals follow if all have unit length (NaN rows aside), or end a PTS file. The last three of the
    others are colors if they are all that is left, or all but one, and hold integers from 0 to 255. Any other is called
    ``column_4`` and so on, or ``intensity`` in a PTS file.
    """
    if len(columns) >= 4 and _counts(columns[0]):
        return [POINT_NUMBER, *_numbered(guess_names(columns[1:], suffix), 1)]
    start, end = 3, len(columns)
    normals_follow = end >= 6 and (suffix == ".xyzn" or _are_unit(columns[3:6]))
    normals_end = suffix == ".pts" and end >= 6 and _are_unit(columns[-3:]) and not (end == 6 and normals_follow)
    if normals_end:
        end -= 3
    elif normals_follow:
        start += 3
    rest = [f"column_{index + 1}" for index in range(start, end)]
    if suffix == ".pts" and len(rest) in (1, 4):
        rest[0] = "intensity"
    if len(rest) in (3, 4) and all(are_bytes(column) for column in columns[end - 3 : end]):
        rest[-3:] = COLORS
    before, after = ((), NORMALS) if normals_end else (NORMALS if start == 6 else (), ())
    return [*COORDINATES, *before, *rest, *after]


def _numbered(names: list[str], offset: int) -> list[str]:
    """Names of columns that stand behind `offset` others."""
    return [f"column_{int(name[7:]) + offset}" if name.startswith("column_") else name for name in names]


def _counts(values: NDArray[Any]) -> bool:
    return len(values) >= _FEWEST_NUMBERS and values[0] in (0, 1) and bool((np.diff(values) == 1).all())


def _are_unit(columns: Sequence[NDArray[Any]]) -> bool:
    vectors = np.stack(columns, axis=1)
    known = vectors[~np.isnan(vectors).all(axis=1)]
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(known, axis=1)
    return len(known) > 0 and bool((np.abs(lengths - 1) < _UNIT_TOLERANCE).all())


def are_bytes(values: NDArray[Any]) -> bool:
    """Tell whether all values are integers from 0 to 255."""
    return values.size > 0 and bool(((values >= 0) & (values <= 255) & (values == np.rint(values))).all())


def by_position(names: Sequence[str], suffix: str) -> list[str]:
    """Order columns as readers expect them that go by position."""
    normals = [name for name in NORMALS if name in names]
    rest = [name for name in names if name not in (*COORDINATES, *NORMALS)]
    if suffix != ".pts":
        return [*COORDINATES, *normals, *rest]
    first = [name for name in ("intensity", *COLORS) if name in rest]
    return [*COORDINATES, *first, *(name for name in rest if name not in first), *normals]
