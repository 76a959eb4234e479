"""A large cloud in blocks, each with a halo around it: what else of the cloud its points may need as neighbors.

Blocks are for clouds in memory, and tiles for clouds on the disk; both are the same cells and see the same halos.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.cells import cut_into_cells, halvings, in_sample, near_boxes
from jetnormal.geometry.neighbors import NeighborIndex, distinct

TOGETHER = 1_000_000  # points that are looked at together, about: a larger cloud is cut into blocks
HALO_SHARE = 1.0  # points of the halo for each point of the core, at most
CORE = round(TOGETHER / (1 + HALO_SHARE))  # points of a block, about, whose results are kept
SPACING_NEIGHBORS = 16
SAMPLE = 4096  # points, at least, that tell the spacing of a cell, where there are as many
WIDEST = 8.0  # spacing, over that of as many points evenly across the box


def blocks(
    points: NDArray[np.float64], reach: float, threads: int | None = None
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Cut a cloud into blocks.

    Args:
        points: (N, 3) finite, different points.
        reach: how far a point looks, in root mean square distances of a point's 16 neighbors.
        threads: CPU threads of the neighbor search; None for all cores.

    Yields:
        The rows of a block's core (n,), ascending, and those of its halo (h,). Each point is in one core.
    """
    cores = _cores(points)
    boxes = np.array([(points[core].min(axis=0), points[core].max(axis=0)) for core in cores])
    spacings = [Spacing.of(points[core], threads) for core in cores]
    widths = reach * np.array([spacing.largest for spacing in spacings])
    for number, core in enumerate(cores):
        others = near_boxes(boxes, number, widths)
        seen = [seen_from(boxes[number], points[cores[other]], spacings[other], reach) for other in others]
        halo = [cores[other][rows] for other, rows in zip(others, nearest(seen, len(core)), strict=True)]
        yield core, np.concatenate([core[:0], *halo])


def _cores(points: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """The rows of each block's core."""
    times = halvings(len(points))
    cells = cut_into_cells(points[in_sample(points, times)], times, CORE)
    block_of = cells.of(points)
    cores = [np.flatnonzero(block_of == number) for number in range(len(cells))]
    return [core for core in cores if len(core)]


@dataclass(frozen=True)
class Spacing:
    """How far apart the points of a cell are, from place to place: the root mean square distance of 16 neighbors.

    At the border of a cell, where halos are, neighbors lie on one side only, so that up to 1.7 times as much is told.

    Attributes:
        sample: (S, 3) some points of the cell.
        values: (S,) the spacing around each.
        threads: CPU threads of the neighbor search; None for all cores.
    """

    sample: NDArray[np.float64]
    values: NDArray[np.float64]
    threads: int | None = None

    @classmethod
    def of(cls, points: NDArray[np.float64], threads: int | None = None) -> Spacing:
        """Measure the spacing of a cell with (N, 3) points, N >= 1."""
        sample = points[in_sample(points, max(0, (len(points) // SAMPLE).bit_length() - 1))]
        sample = sample[distinct(sample)[0]] if len(sample) else points[:1]  # of a cell of copies of one point
        neighbors = min(SPACING_NEIGHBORS + 1, len(points))
        _, distances = NeighborIndex(points, threads=threads).query(sample, neighbors)
        limit = widest(np.ptp(points, axis=0), len(points))
        return cls(sample, np.minimum(np.sqrt(np.square(distances).mean(axis=1)), limit), threads)

    @property
    def largest(self) -> float:
        """The largest spacing of all points."""
        return float(self.values.max())

    @cached_property
    def _index(self) -> NeighborIndex:
        return NeighborIndex(self.sample, threads=self.threads)

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Find the spacing (n,) at points (n, 3) of the cell."""
        return np.asarray(self.values[self._index.query(points, 1)[0][:, 0]])


def widest(extent: NDArray[np.float64], count: int) -> float:
    """Bound the spacing of a cell of so many points in a box of this extent (3,); strays may be farther apart."""
    return WIDEST * float(np.linalg.norm(extent)) / np.sqrt(count)


def seen_from(
    box: NDArray[np.float64], points: NDArray[np.float64], spacing: Spacing, reach: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find the points of another cell that a core sees: nearer to its box than `reach` times their spacing.

    Args:
        box: (2, 3) least and largest coordinates of the core.
        points: (N, 3) of the other cell.
        spacing: of the other cell.
        reach: as for `blocks`.

    Returns:
        Their rows (n,), and how near they are in units of their spacing (n,).
    """
    low, high = box - [[reach * spacing.largest], [-reach * spacing.largest]]
    rows = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    near = points[rows]
    outside = np.maximum(np.maximum(box[0] - near, near - box[1]), 0)
    apart = np.sqrt(np.square(outside).sum(axis=1)) / np.maximum(spacing.at(near), 1e-300)
    inside = apart <= reach
    return rows[inside], apart[inside]


def nearest(seen: list[tuple[NDArray[np.int64], NDArray[np.float64]]], core: int) -> list[NDArray[np.int64]]:
    """Choose the rows that there is room for of what a core of so many points sees of each other cell (`seen_from`)."""
    apart = np.concatenate([np.zeros(0), *(distances for _, distances in seen)])
    most = round(HALO_SHARE * core)
    if len(apart) <= most:
        return [rows for rows, _ in seen]
    limit = np.partition(apart, most)[most]
    return [rows[distances < limit] for rows, distances in seen]
