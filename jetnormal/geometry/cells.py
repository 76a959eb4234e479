"""A k-d tree over a sample of a cloud, whose cells hold about equally many points however dense they are.

Which points are in the sample depends on their coordinates, not on their order or unit of length. So a cloud in memory
and the same cloud read piece by piece get the same cells.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SAMPLE = 1_000_000  # points, at least, where there are as many
FEWEST = 8  # points of the sample in a cell
_MANTISSA = np.uint64((1 << 52) - 1)
_MIXERS = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)


@dataclass(frozen=True)
class Cells:
    """A k-d tree whose leaves are the cells.

    Attributes:
        axis: of the cut of each node; -1 for a leaf.
        cut: points with a smaller coordinate go left; 0 for a leaf.
        left, right: number of the next node; of a leaf, `left` is the number of its cell.
    """

    axis: list[int]
    cut: list[float]
    left: list[int]
    right: list[int]

    def __len__(self) -> int:
        return self.axis.count(-1)

    def of(self, points: Floats) -> NDArray[np.int64]:
        """Find the cell (N,) of each point (N, 3)."""
        axis, cut, left, right = (np.asarray(column) for column in asdict(self).values())
        node = np.zeros(len(points), dtype=np.int64)
        rows = np.arange(len(points)) if axis[0] >= 0 else np.arange(0)
        while len(rows):
            here = node[rows]
            is_left = points[rows, axis[here]] < cut[here]
            node[rows] = np.where(is_left, left[here], right[here])
            rows = rows[axis[node[rows]] >= 0]
        return np.asarray(left[node])


def halvings(points: int) -> int:
    """Tell how many times a cloud of so many points is halved to the sample that tells its cells."""
    return max(0, (points // SAMPLE).bit_length() - 1)


def in_sample(points: Floats, times: int) -> Bools:
    """Tell which points (N, 3) are in a sample: one of 2^times, by the digits of their coordinates."""
    return np.asarray(mixed_digits(points) & np.uint64((1 << times) - 1) == 0)


def mixed_digits(points: Floats) -> NDArray[np.uint64]:
    """Mix the digits of the coordinates of each point (N, 3) to a number (N,) that looks random.

    It does not depend on the unit of length, if that changes by powers of two.
    """
    digits = np.ascontiguousarray(points).view(np.uint64) & _MANTISSA  # without sign and unit
    mixed = np.zeros(len(points), dtype=np.uint64)
    for axis in range(3):
        mixed = (mixed ^ digits[:, axis]) * np.uint64(_MIXERS[0])
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(_MIXERS[1])
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(_MIXERS[2])
        mixed ^= mixed >> np.uint64(31)
    return mixed


def cut_into_cells(sample: Floats, times: int, largest: int) -> Cells:
    """Halve a cloud across the longest side of its box until no cell has many more points than `largest`.

    Args:
        sample: (S, 3) those of the cloud's different points that are in the sample.
        times: as for `in_sample`.
        largest: points of a cell.
    """
    tree: dict[str, list[Any]] = {"axis": [], "cut": [], "left": [], "right": []}
    most = max(FEWEST, largest / 2**times)

    def grow(rows: Floats) -> int:
        number = len(tree["axis"])
        axis, cut = _cut(rows) if len(rows) > most else (-1, 0.0)
        for name, value in (("axis", axis), ("cut", cut), ("left", -1), ("right", -1)):
            tree[name].append(value)
        if axis >= 0:
            is_left = rows[:, axis] < cut
            tree["left"][number] = grow(rows[is_left])
            tree["right"][number] = grow(rows[~is_left])
        return number

    grow(sample)
    leaves = [node for node, axis in enumerate(tree["axis"]) if axis < 0]
    for cell, node in enumerate(leaves):
        tree["left"][node] = cell
    return Cells(**tree)


def near_boxes(boxes: Floats, box: int, widths: Floats | float) -> list[int]:
    """Find the other boxes that are nearer to a box, along each axis, than their own widths.

    Args:
        boxes: (T, 2, 3) least and largest coordinates.
        box: number of the box.
        widths: (T,), or one for all.
    """
    width = np.broadcast_to(widths, len(boxes))[:, None]
    meets = ((boxes[:, 0] - width <= boxes[box, 1]) & (boxes[:, 1] + width >= boxes[box, 0])).all(axis=1)
    return [int(other) for other in np.flatnonzero(meets) if other != box]


def _cut(points: Floats) -> tuple[int, float]:
    """The axis and the place of a cut that leaves points on both sides; -1 if all are one point."""
    axis = int(np.argmax(np.ptp(points, axis=0)))
    along = points[:, axis]
    cut = float(np.partition(along, len(along) // 2)[len(along) // 2])
    if not (along < cut).any():  # half of the points share the least coordinate
        above = along[along > cut]
        return (axis, float(above.min())) if len(above) else (-1, 0.0)
    return axis, cut
