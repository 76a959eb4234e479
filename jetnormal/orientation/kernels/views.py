"""Loops that draw pictures of points and tell which points they show."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.support.compiled import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@compiled
def pixel_code(row: int, column: int, level: int, label: int) -> Any:
    """Mix four integers to a uint64 that is not zero; two pixels have the same one with a chance of 2^-64."""
    code = np.uint64(row) * np.uint64(0x9E3779B97F4A7C15)
    for value in (column, level, label):
        code ^= code >> np.uint64(29)
        code = (code + np.uint64(value)) * np.uint64(0xBF58476D1CE4E5B9)
    code ^= code >> np.uint64(32)
    return code if code != 0 else np.uint64(1)


@compiled
def project(points: Floats, i: int, axes: Floats, unit: float) -> Any:
    """The row and column of point i in a picture with such axes and pixels, and its height over the picture."""
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    row = np.int64(np.floor((x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2]) / unit))
    column = np.int64(np.floor((x * axes[1, 0] + y * axes[1, 1] + z * axes[1, 2]) / unit))
    return row, column, x * axes[2, 0] + y * axes[2, 1] + z * axes[2, 2]


@compiled
def see(
    points: Floats, normals: Floats, axes: Floats, unit: float, least: float, slack: Floats, rough: float,
    level: NDArray[np.int16], hides: Bools, label: NDArray[np.int32], lowest: Ints, highest: Ints,
    key: Any, top: Floats, bottom: Floats, votes: Floats,
) -> None:  # fmt: skip
    """Look at N points along one direction D and against it, and add to their votes.

    The pictures of all labels and levels are in one hash table of pixels. A point that hides others is drawn into the
    picture of its own level; every point is compared with the pictures of all levels of its label.

    Args:
        points, normals: (N, 3).
        axes: (3, 3) two directions across D, and D.
        unit: side of a pixel at level 0; it doubles from level to level.
        least: cosine between normal and D up to which a point does not vote.
        slack: (N,) how far below the topmost point of a pixel a point is still seen, at least,
        rough: and at least this share of the pixel's side.
        level: (N,) of each point's own pixel.
        hides: (N,) whether a point hides others.
        label: (N,) in [0, L): which points share pictures.
        lowest, highest: (L,) the levels of each label's pictures.
        key, top, bottom: (S,) uint64 and float64 tables, overwritten; S is a power of two, above the points that hide.
        votes: (N, 3) sums of n.D and of |n.D| over the views that see a point, and of n.D over D alone.
    """
    mask = np.uint64(len(key) - 1)
    key[:] = 0
    for i in range(len(points)):
        if not hides[i]:
            continue
        row, column, height = project(points, i, axes, unit)
        own = np.int64(level[i])
        code = pixel_code(row >> own, column >> own, own, np.int64(label[i]))
        slot = code & mask
        while key[slot] != 0 and key[slot] != code:
            slot = (slot + np.uint64(1)) & mask
        if key[slot] == 0:
            key[slot] = code
            top[slot] = bottom[slot] = height
        else:
            top[slot] = max(top[slot], height)
            bottom[slot] = min(bottom[slot], height)
    for i in range(len(points)):
        cosine = normals[i, 0] * axes[2, 0] + normals[i, 1] * axes[2, 1] + normals[i, 2] * axes[2, 2]
        if abs(cosine) <= least:
            continue
        row, column, height = project(points, i, axes, unit)
        above, below = True, True
        for at in range(lowest[label[i]], highest[label[i]] + 1):
            code = pixel_code(row >> at, column >> at, at, np.int64(label[i]))
            slot = code & mask
            while key[slot] != 0 and key[slot] != code:
                slot = (slot + np.uint64(1)) & mask
            if key[slot] != 0:
                reach = max(slack[i], rough * unit * 2.0**at)
                above = above and height >= top[slot] - reach
                below = below and height <= bottom[slot] + reach
        if above:
            votes[i, 0] += cosine
            votes[i, 1] += abs(cosine)
            votes[i, 2] += cosine
        if below:
            votes[i, 0] -= cosine
            votes[i, 1] += abs(cosine)
