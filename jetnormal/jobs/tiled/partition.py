"""Where a cloud is cut into tiles: a k-d tree over a sample of its points."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SAMPLE = 1_000_000  # points that tell where a cloud is cut
FEWEST = 8  # points of the sample in a tile


@dataclass(frozen=True)
class Partition:
    """A k-d tree whose leaves are the tiles.

    Attributes:
        axis: of the cut of each node; -1 for a leaf.
        cut: points with a smaller coordinate go left; 0 for a leaf.
        left, right: number of the next node; of a leaf, `left` is the number of its tile.
    """

    axis: list[int]
    cut: list[float]
    left: list[int]
    right: list[int]

    @property
    def tiles(self) -> int:
        """How many tiles there are."""
        return self.axis.count(-1)

    def tile_of(self, points: Floats) -> NDArray[np.int64]:
        """Find the tile (N,) of each point (N, 3)."""
        axis, cut, left, right = (np.asarray(column) for column in asdict(self).values())
        node = np.zeros(len(points), dtype=np.int64)
        rows = np.arange(len(points)) if axis[0] >= 0 else np.arange(0)
        while len(rows):
            here = node[rows]
            is_left = points[rows, axis[here]] < cut[here]
            node[rows] = np.where(is_left, left[here], right[here])
            rows = rows[axis[node[rows]] >= 0]
        return np.asarray(left[node])


def cut_into_tiles(sample: Floats, points: int, largest: int) -> Partition:
    """Halve a cloud across the longest side of its box until no tile has many more points than `largest`.

    Where points are dense, tiles are small. Copies of a point are in one tile.

    Args:
        sample: (S, 3) some of the points.
        points: how many there are in all.
        largest: points of a tile.
    """
    tree: dict[str, list[Any]] = {"axis": [], "cut": [], "left": [], "right": []}
    most = max(FEWEST, largest * len(sample) / max(1, points))

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
    for tile, node in enumerate(leaves):
        tree["left"][node] = tile
    return Partition(**tree)


def _cut(points: Floats) -> tuple[int, float]:
    """The axis and the place of a cut that leaves points on both sides; -1 if all are one point."""
    axis = int(np.argmax(np.ptp(points, axis=0)))
    along = points[:, axis]
    cut = float(np.partition(along, len(along) // 2)[len(along) // 2])
    if not (along < cut).any():  # half of the points share the least coordinate
        above = along[along > cut]
        return (axis, float(above.min())) if len(above) else (-1, 0.0)
    return axis, cut
