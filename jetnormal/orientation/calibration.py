"""Confidence of signs as a probability.

The methods return scores that rank signs well but are no probabilities. An increasing curve, one for each kind of
evidence, maps a score to the share of right signs that was measured: on procedural solids in PCPNet's six categories,
on simulated scans of other solids, and on simulated rooms, streets and terrain, each cloud with the same weight. On
clouds of shapes that a curve was not fitted to, the expected calibration error falls from 0.12 to 0.017 (outward), from
0.14 to 0.004 (mst) and from 0.32 to 0.003 (viewpoint). For terrain and single views the calibration changes it little
(0.10 to 0.09 and 0.17 to 0.10): there whole clouds are right or wrong, and there were few.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Kind = Literal["outward", "view", "lean", "terrain", "mst", "sight", "guess"]

SURE = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 0.96, 0.99, 1.0)
RIGHT = {
    "outward": (0.535, 0.629, 0.692, 0.847, 0.949, 0.966, 0.991, 0.991, 0.998, 0.999),
    "view": (0.5, 0.6, 0.78, 0.92, 0.955, 0.955, 0.955, 0.965, 0.98, 0.99),
    "lean": (0.5, 0.55, 0.75, 0.91, 0.92, 0.93, 0.93, 0.94, 0.95, 0.96),
    "terrain": (0.63, 0.63, 0.63, 0.925, 0.925, 0.925, 0.925, 0.945, 0.945, 0.991),
    "mst": (0.594, 0.594, 0.594, 0.594, 0.624, 0.658, 0.7, 0.718, 0.776, 0.864),
}
COSINE = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 1.0)
RIGHT_SIGHT = (0.7, 0.88, 0.977, 0.984, 0.992, 0.993, 0.997, 0.997, 0.9995)


def probability(sure: NDArray[Any], kind: Kind) -> NDArray[np.float64]:
    """Find the probability that each sign is right (N,), 0.5 to 1.

    Args:
        sure: (N,) score of the method, 0 to 1; for "sight", the cosine between normal and sight line.
        kind: of the evidence. "lean": a view whose borders lean too little to be certain, or one of several sides.
            "guess": there is none.
    """
    if kind == "guess":
        return np.full(len(sure), 0.5)
    known, right = (COSINE, RIGHT_SIGHT) if kind == "sight" else (SURE, RIGHT[kind])
    return np.interp(sure, known, right)
