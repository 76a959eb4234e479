"""Signs of normals nearly at a right angle to their sight line, where a small error of the direction changes the sign.

Two things vote: the cosine between normal and sight line, and the neighbors that the sensor sees at a steeper angle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.neighbors import NeighborIndex

Floats = NDArray[np.float64]

GRAZING = 0.25  # cosine below which a sign is in doubt: 75 degrees
UNCLEAR = 0.1  # cosine of a neighbor up to which it does not vote
NEIGHBORS = 16
CHUNK = 50_000  # points asked for their neighbors at a time
NEIGHBOR_WEIGHT = 2.0  # of neighbors that all agree, over a cosine of GRAZING


def grazing_flips(points: Floats, normals: Floats, cosine: Floats) -> NDArray[np.bool_]:
    """Find normals that their neighbors contradict more than their own sight lines support them.

    Args:
        points: (N, 3), finite.
        normals: (N, 3) unit vectors, turned towards the sensor.
        cosine: (N,) between each and its sight line, 0 or more.
    """
    flips = np.zeros(len(points), dtype=np.bool_)
    rows = np.flatnonzero((cosine > 0) & (cosine < GRAZING))
    if not len(rows) or len(points) <= NEIGHBORS:
        return flips
    index = NeighborIndex(points)
    for some in (rows[start : start + CHUNK] for start in range(0, len(rows), CHUNK)):
        near = index.query(points[some], NEIGHBORS + 1)[0][:, 1:]
        agreement = np.einsum("nd,nkd->nk", normals[some], normals[near])
        weight = np.maximum(cosine[near] - UNCLEAR, 0)
        total = weight.sum(axis=1)
        vote = (agreement * np.abs(agreement) * weight).sum(axis=1) / np.where(total > 0, total, 1)
        flips[some] = cosine[some] / GRAZING + NEIGHBOR_WEIGHT * vote < 0
    return flips
