"""The method "auto" where nothing is known of the sensor: it decides by the shape of the cloud.

Steps 3 to 9 of `policy`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Source
from jetnormal.geometry.vectors import unit
from jetnormal.orientation.calibration import probability
from jetnormal.orientation.decision import RATHER, SUSPECT, Decision, decided
from jetnormal.orientation.methods import Orientation, choose_signs

Floats = NDArray[np.float64]

ONE_SIDE = 0.97  # of the open points: a surface that a sensor saw shows it one side
ENOUGH = 1_000_000  # points; from more, "auto" takes so many to decide by
BELOW = 0.08  # of the variance of density: so much better explained from below, it is no terrain
OPEN_SHARE = 0.05  # of the points; below it, they are specks beside a closed surface


def decide(
    points: Floats, normals: NDArray[Any], source: Source, *, copies: bool = False
) -> tuple[Orientation, Decision]:
    """Choose signs by the shape of a cloud.

    Args:
        points: (N, 3), finite.
        normals: (N, 3) of any sign.
        source: what the file says of itself.
        copies: whether some points may be copies of others.
    """
    if len(points) <= ENOUGH:
        return _by_evidence(points, normals, source)
    return _by_part(points, normals, source, copies)


def _by_evidence(points: Floats, normals: NDArray[Any], source: Source) -> tuple[Orientation, Decision]:
    """Decide by the shape of the cloud alone."""
    from jetnormal.orientation.inside import find_evidence
    from jetnormal.orientation.terrain import is_terrain
    from jetnormal.orientation.visibility import taken_from_origin

    orientation = choose_signs(points, normals, "view")
    is_open, view = orientation.open, orientation.view
    open_share = float(is_open.mean()) if len(is_open) else 0.0
    mostly_open = open_share > OPEN_SHARE
    if mostly_open and taken_from_origin(points):
        orientation = _towards_origin(points, orientation)
        reason = "its surfaces look as if a camera at the origin had taken them"
        return orientation, decided(orientation, "auto", "origin", reason)
    seen = mostly_open and view is not None and view.certain
    directions = unit(orientation.normals)
    found = find_evidence(points, directions, mostly_open)
    inside = 0.0 if found is None else found.probability
    below = found is not None and found.behind * np.sign(directions[:, 2].mean()) > BELOW
    if not (seen or below) and (mostly_open or inside < SUSPECT) and is_terrain(points, directions):
        orientation = choose_signs(points, normals, "terrain")
        return orientation, decided(orientation, "auto", "terrain", "the cloud is wide, flat and mostly level")
    if mostly_open and source.viewpoint is not None and _one_sided(points, orientation):
        orientation = _towards_origin(points, orientation)
        reason = "the file names the origin, which sees one side of its surfaces throughout"
        return orientation, decided(orientation, "auto", "origin", reason)
    if inside >= RATHER:
        return _inward(points, normals, inside)
    orientation = replace(orientation, confidence=_unless(inside, orientation.confidence))
    return orientation, replace(_from_outside(orientation, mostly_open), inside=inside)


def _inward(points: Floats, normals: NDArray[Any], inside: float) -> tuple[Orientation, Decision]:
    """Turn a cloud that was scanned from inside, with a probability, to places there."""
    orientation = choose_signs(points, normals, "inside")
    orientation = replace(orientation, confidence=_unless(1 - inside, orientation.confidence))
    reason = f"it was scanned from inside (probability {inside:.0%}); `orient=global` turns it outward"
    return orientation, replace(decided(orientation, "auto", "inside", reason), inside=inside)


def _from_outside(orientation: Orientation, mostly_open: bool) -> Decision:
    """How the signs of "view" came about."""
    if not mostly_open:
        return decided(orientation, "auto", "global", "its surfaces are closed")
    view, share = orientation.view, f"{orientation.open.mean():.0%} of the points lie on open surfaces"
    if view is not None and view.certain:
        return decided(orientation, "auto", "view", f"{share}, whose borders lean away from where they look to")
    if view is None:
        used, reason = "global", "up where open"
    elif view.several:
        used, reason = "global", "seen from several sides, outward"
    else:
        used, reason = "view", "whose borders lean a little away from where they look to"
    return replace(decided(orientation, "auto", used, f"a guess: {share}, {reason}"), guessed=True)


def _unless(wrong: float, confidence: NDArray[np.float32]) -> NDArray[np.float32]:
    """The probability that each sign is right (N,), if all may be wrong with a probability."""
    mixed = confidence * (1 - wrong) + (1 - confidence) * wrong
    return np.where(confidence > 0, mixed, 0).astype(np.float32)


def _by_part(points: Floats, normals: NDArray[Any], source: Source, copies: bool) -> tuple[Orientation, Decision]:
    """Decide by the shape of the thinned cloud, whose signs are carried to all points.

    What is open, or how borders lean, depends on how dense a cloud is. Clouds in tiles are thinned to the same points.
    """
    from jetnormal.geometry.neighbors import distinct
    from jetnormal.geometry.thinning import least, ranks
    from jetnormal.orientation.carrying import Thinned, carry_in_blocks

    directions = unit(normals).astype(np.float32)
    rows = np.flatnonzero(np.isfinite(points).all(axis=1) & directions.any(axis=1))
    first, copy_of = distinct(points[rows]) if copies else (np.arange(len(rows)),) * 2
    if len(first) < len(points):
        points, directions = points[rows[first]], directions[rows[first]]
    part = least(ranks(points, points[:0]), ENOUGH)
    told, decision = _by_evidence(points[part], directions[part], source)
    thinned = Thinned(points[part], told.normals, told.confidence.astype(np.float64))
    flips, sure = carry_in_blocks(points, directions, thinned)
    directions[flips] *= -1
    turned, confidence = normals.copy(), np.zeros(len(normals), np.float32)
    turned[rows[np.einsum("nd,nd->n", normals[rows], directions[copy_of]) < 0]] *= -1  # copies follow the first one
    confidence[rows] = sure[copy_of]
    is_open = np.zeros(len(normals), dtype=np.bool_)
    is_open[rows[first[part]]] = told.open
    orientation = Orientation(turned, confidence, is_open, told.view)
    return orientation, replace(decision, confidence=round(float(confidence.mean()), 4))


def _one_sided(points: Floats, orientation: Orientation) -> bool:
    """Whether the origin sees one side of the consistently signed open surfaces, as a sensor would."""
    facing = np.einsum("nd,nd->n", orientation.normals, points)[orientation.open] < 0
    return bool(max(facing.mean(), 1 - facing.mean()) >= ONE_SIDE)


def _towards_origin(points: Floats, orientation: Orientation) -> Orientation:
    """Turn open surfaces towards the origin, where a depth camera stands in its own frame."""
    along = np.einsum("nd,nd->n", orientation.normals, points)
    away = orientation.open & (along > 0)
    cosine = np.abs(along) / np.maximum(
        np.linalg.norm(points, axis=1) * np.linalg.norm(orientation.normals, axis=1), 1e-300
    )
    return replace(
        orientation,
        normals=np.where(away[:, None], -orientation.normals, orientation.normals),
        confidence=np.where(orientation.open, probability(cosine, "sight"), orientation.confidence).astype(np.float32),
    )
