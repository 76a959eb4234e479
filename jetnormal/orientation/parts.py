"""The parts of a surface: regions of consistent signs, and the components that hang together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.orientation.agreement import Labels, Surface, couplings, regions

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

SPECK = 16  # points; a smaller component tells nothing of its outside


@dataclass(frozen=True)
class Parts:
    """A surface in regions and components.

    Attributes:
        region: (N,) in [0, M), the region of each point.
        owner: (M,) in [0, C), the component of each region.
        component: (N,) the component of each point.
        coupling: sparse (M, M), how far regions agree (`agreement.couplings`).
        speck: (C,) whether a component is too small to tell its outside; not if all are.
    """

    region: Labels
    owner: Labels
    component: Labels
    coupling: Any
    speck: Bools

    @property
    def sizes(self) -> Ints:
        """Points of each component (C,)."""
        return np.bincount(self.component)

    def by_region(self, values: NDArray[Any]) -> Floats:
        """Sum values of the points (N,) over each region (M,)."""
        return np.asarray(np.bincount(self.region, values, len(self.owner)), dtype=np.float64)

    def by_component(self, values: Floats) -> Floats:
        """Sum values of the regions (M,) over each component (C,)."""
        return np.asarray(np.bincount(self.owner, values, len(self.speck)), dtype=np.float64)


def divide(surface: Surface) -> tuple[Bools, Parts]:
    """Divide a surface into regions and components.

    Returns:
        Which normals (N,) to flip so that they are consistent in every region, and the parts that there are then.
    """
    from scipy.sparse.csgraph import connected_components

    flips, region = regions(surface)
    coupling = couplings(surface, region, flips)
    owner = connected_components(coupling, directed=False)[1].astype(np.int32)
    component = owner[region]
    small = np.bincount(component) < SPECK
    return flips, Parts(region, owner, component, coupling, small & ~small.all())
