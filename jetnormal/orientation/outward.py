"""Outward signs that neither a wrong edge nor a wrong component can turn over.

Patches of consistent signs (`agreement.patches`) are told by visibility where outside is. Their votes and their
agreement with the patches around them are weighed in one linear system. A surface hidden inside another is looked at
after that one has been taken away, and turned by whether it lies in matter or in a hole. Where the votes for both
sides are about as many, a surface is open: it has no outside, and is turned up, by what is seen of it from above.
Where noise is not small against the spacing, the dipole field of all normals (`dipole_field.DipoleField`) has the last
word on single points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.orientation.agreement import (
    PATCH_SPACINGS,
    Surface,
    couplings,
    patch_forest,
    patches,
    relax,
    revote,
    spread_signs,
)
from jetnormal.orientation.dipole_field import MARGIN, DipoleField
from jetnormal.orientation.visibility import VIEWS, look

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

FULL_VOTE = VIEWS / 4  # of a point that all views see from outside
MIN_SEEN = 0.04  # of the full votes, for a component; less comes through holes between points
MAX_LAYERS = 4  # of surfaces inside surfaces
OPEN_PURITY = 0.5  # |sum| over sum of a patch's votes: nearly 1 on closed surfaces, 0.3 on a hemisphere
# The votes for up of a patch count up to as many sure edges as lie along its side. In a smooth sheet, several times
# that many join two patches; in the noisy crease between a wall and the ground, fewer.
MAX_UPRIGHT = PATCH_SPACINGS
NOISY = 0.15  # roughness over spacing
CELL_SPACINGS = 1.5  # side of the field's cells
MAX_CELL_SPACINGS = 4.0  # a coarser field knows less than the neighbors
MIN_CELLS, MAX_CELLS = 16, 256  # along the field's side
CELLS_PER_POINT = 20.0
ROUNDS = 4


def turn_outward(surface: Surface) -> tuple[Floats, Bools]:
    """Turns the normals of a surface outward.

    Returns:
        How sure the signs are (N,), 0 to 1, and which points (N,) are on a surface without an outside.
    """
    from scipy.sparse.csgraph import connected_components

    patch = patches(surface)
    coupling = couplings(surface, patch)
    component = connected_components(coupling, directed=False)[1].astype(np.int64)[patch]
    belief, is_open = _Jury(surface, patch, component, coupling).decide()
    surface.turn((belief < 0)[patch])
    sure = revote(surface) * np.abs(belief)[patch]
    return sure * _refine(surface), is_open[component]


class _Jury:
    """M patches of N points in C components, and what is known about their outside.

    Args:
        surface: the points; normals are consistent in every patch.
        patch: (N,) the patch of each point.
        component: (N,) the component of each.
        coupling: (M, M) how far patches agree.
    """

    def __init__(self, surface: Surface, patch: Ints, component: Ints, coupling: Any) -> None:
        self._surface, self._patch, self._component, self._coupling = surface, patch, component, coupling
        self._sizes = np.bincount(component)
        self._outward, self._total, self._upward = np.zeros((3, len(patch)))

    def decide(self) -> tuple[Floats, Bools]:
        """Signs of the patches (M,) between -1 and 1, and which components (C,) are open."""
        self._collect()
        owner = self._component[np.unique(self._patch, return_index=True)[1]]
        pure = np.bincount(owner, np.abs(np.bincount(self._patch, self._outward)), len(self._sizes))
        is_open = pure < OPEN_PURITY * np.bincount(self._component, self._total)
        belief = self._weigh(self._outward)
        return np.where(is_open[owner], self._upright(), belief) if is_open.any() else belief, is_open

    def _collect(self) -> None:
        """Looks at the surface, then at what it hid, and so on."""
        hidden = np.ones(len(self._sizes), dtype=bool)
        for layer in range(MAX_LAYERS):
            rows = np.flatnonzero(hidden[self._component])
            if len(rows) == 0:
                break
            votes = look(self._surface, rows)
            inside = self._inside(~hidden) if layer else np.zeros(len(hidden), dtype=bool)
            side = np.where(inside[self._component[rows]], -1.0, 1.0)
            self._outward[rows], self._total[rows], self._upward[rows] = side * votes.outward, votes.total, votes.upward
            hidden = hidden & (np.bincount(self._component, self._total) < MIN_SEEN * FULL_VOTE * self._sizes)

    def _inside(self, known: Bools) -> Bools:
        """Which components (C,) lie inside of those that are known."""
        surface, component = self._surface, self._component
        belief = self._weigh(np.where(known[component], self._outward, 0))
        areas = np.where(belief[self._patch] < 0, -1, 1) * known[component] * surface.spacing**2
        field = DipoleField(surface.points, surface.normals * areas[:, None], _cells(surface))
        return np.bincount(component, field.at(surface.points)) > 0.5 * self._sizes

    def _weigh(self, votes: Floats) -> Floats:
        """Signs of patches (M,) by the votes of points (N,), which count as much as the couplings if all agree."""
        told = np.bincount(self._patch, votes).astype(np.float64)
        strength, total = abs(self._coupling).sum() / 2, self._total.sum()
        return relax(self._coupling, told * (strength / total) if strength > 0 and total > 0 else told)

    def _upright(self) -> Floats:
        """Signs of patches (M,) by what is seen from above, as `decide`.

        A tree of the strongest links, of which the votes are one kind, stands all of a smooth sheet up by its clearest
        part: a mean of all votes would fold it where it hangs over.
        """
        from scipy.sparse import bmat, csr_matrix

        told = np.clip(np.bincount(self._patch, self._upward) / FULL_VOTE, -MAX_UPRIGHT, MAX_UPRIGHT)
        votes = csr_matrix(told)
        flips, _ = spread_signs(patch_forest(bmat([[self._coupling, votes.T], [votes, None]], format="csr")))
        signs = np.where(flips[:-1] ^ flips[-1], -1.0, 1.0)
        support = signs * (self._coupling @ signs + told)
        total = np.asarray(abs(self._coupling).sum(axis=1)).ravel() + np.abs(told)
        return signs * np.clip(support / np.where(total > 0, total, 1), 1e-3, 1)


def _refine(surface: Surface) -> Floats:
    """Turns noisy points that the field of all points contradicts; returns how sure the field is (N,), 0 to 1."""
    strength = np.ones(len(surface.points))
    if not (surface.roughness > NOISY * surface.spacing).any():
        return strength
    cells = _cells(surface)
    for _ in range(ROUNDS):
        areas = strength * surface.spacing**2
        field = DipoleField(surface.points, surface.normals * areas[:, None], cells)
        fine = surface.spacing * MAX_CELL_SPACINGS > field.cell
        noisy = np.flatnonzero(fine & (surface.roughness > NOISY * surface.spacing))
        drop = field.drop(surface.points[noisy], surface.normals[noisy])
        scale = np.median(np.abs(drop)) if len(noisy) else 0.0
        strength[noisy] = np.clip(drop / scale, -1, 1) if scale > 0 else 1
    surface.turn(strength < 0)
    return np.abs(strength)


def _cells(surface: Surface) -> int:
    """Cells along a field's side: as many as the spacing asks for, but not many more in all than there are points."""
    from scipy.fft import next_fast_len

    extent = float(np.ptp(surface.points, axis=0).max())
    wanted = MARGIN * extent / (CELL_SPACINGS * float(np.median(surface.spacing)))
    most = min(MAX_CELLS, np.cbrt(CELLS_PER_POINT * len(surface.points)))
    return int(next_fast_len(int(np.clip(wanted, MIN_CELLS, max(MIN_CELLS, most))), real=True))
