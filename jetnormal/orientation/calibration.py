"""Confidence of signs as a probability.

The methods return scores that rank signs well but are no probabilities. An increasing curve, one for each kind of
evidence, maps a score to the share of right signs that was measured: on procedural solids in PCPNet's six categories,
    on simulated scans of other solids, and on simulated rooms, streets and terrain, each cloud with the same weight. On
    shapes that a curve was not fitted to, the expected calibration error fell from 0.14 to 0.03 (outward), from 0.12 to
    0.02 (mst) and from 0.34 to 0.002 (viewpoint); on eight noisy meshes, thin plates among them, from 0.19 to 0.015
    (outward). For terrain and single views the calibration did not change it (0.02 and 0.13): there whole clouds are
    right or wrong, and there were few.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Kind = Literal["outward", "view", "terrain", "mst", "sight", "guess"]

SURE = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 0.96, 0.99, 1.0)
RIGHT = {
    "outward": (0.5, 0.5, 0.735, 0.908, 0.928, 0.966, 0.974, 0.974, 0.994, 0.998),
    "view": (0.5, 0.5, 0.85, 0.85, 0.85, 0.85, 0.85, 0.85, 0.85, 0.98),
    "terrain": (0.63, 0.63, 0.63, 0.925, 0.925, 0.925, 0.925, 0.945, 0.945, 0.991),
    "mst": (0.5, 0.5, 0.506, 0.56, 0.56, 0.684, 0.684, 0.709, 0.713, 0.892),
}
COSINE = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 1.0)
RIGHT_SIGHT = (0.7, 0.88, 0.977, 0.984, 0.992, 0.993, 0.997, 0.997, 0.9995)


def probability(sure: NDArray[Any], kind: Kind) -> NDArray[np.float64]:
    """Find the probability that each sign is right (N,), 0.5 to 1.

    Args:
        sure: (N,) score of the method, 0 to 1; for "sight", the cosine between normal and sight line.
        kind: of the evidence. "guess": there is none.
    """
    if kind == "guess":
        return np.full(len(sure), 0.5)
    known, right = (COSINE, RIGHT_SIGHT) if kind == "sight" else (SURE, RIGHT[kind])
    return np.interp(sure, known, right)
