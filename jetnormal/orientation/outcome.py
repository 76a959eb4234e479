"""What the methods find of the signs that they choose, beside the signs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jetnormal.orientation.single_view import View

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Outcome:
    """What was found of N points.

    Attributes:
        sure: (N,) how sure the signs are, 0 to 1.
        open: (N,) which points are on a surface without an outside.
        view: the side from which the open surfaces were seen; None if that was not asked for, or not found.
        tree: (N,) which signs a spanning tree carried; None for none.
    """

    sure: Floats
    open: Bools
    view: View | None = None
    tree: Bools | None = None
