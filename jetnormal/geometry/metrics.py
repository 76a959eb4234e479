"""Errors of estimated normals, as the PCPNet benchmark and its successors measure them.

An estimate without a direction (NaN, infinite or zero) counts as the worst possible: 90 degrees regardless of sign, 180
degrees with signs. So no method gains by leaving a point out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def angles(estimated: NDArray[Any], true: NDArray[Any], *, oriented: bool = False) -> NDArray[np.float64]:
    """Compute the angles between normals.

    They are accurate down to rounding; an arc cosine would lose angles below 1e-6 degrees.

    Args:
        estimated: (N, 3) directions of any length.
        true: (N, 3) directions of any length, finite and not zero.
        oriented: whether opposite directions are 180 degrees apart rather than 0.

    Returns:
        (N,) degrees, 0 to 90, or 0 to 180 if oriented.

    Raises:
        ValueError: the shapes differ, or a true normal has no direction.
    """
    estimated, true = _directions(estimated), _directions(true)
    if estimated.shape != true.shape:
        raise ValueError(f"{estimated.shape} estimated normals cannot be compared with {true.shape} true ones")
    if np.isnan(true).any():
        raise ValueError("a true normal is zero or not finite")
    sine = np.linalg.norm(np.cross(estimated, true), axis=1)
    cosine = np.einsum("nd,nd->n", estimated, true)
    degrees = np.degrees(np.arctan2(sine, cosine if oriented else np.abs(cosine)))
    return np.where(np.isnan(degrees), 180.0 if oriented else 90.0, degrees)


def rmse(angles: NDArray[Any]) -> float:
    """Compute the root mean square of angles (N,), in their unit; NaN if there are none."""
    return float(np.sqrt(np.mean(np.square(angles)))) if len(angles) else float("nan")


def pgp(angles: NDArray[Any], threshold: float) -> float:
    """Compute the proportion of good points: the share of angles (N,) below the threshold; NaN if there are none."""
    return float(np.mean(angles < threshold)) if len(angles) else float("nan")


def auc(angles: NDArray[Any], max_angle: float) -> float:
    """Compute the area under the curve of PGP over the threshold, from 0 to max_angle: a number from 0 to 1.

    In closed form it is the mean of max(0, 1 - a / max_angle) over the angles a; NaN if there are none.

    Raises:
        ValueError: max_angle is not positive.
    """
    if not max_angle > 0:
        raise ValueError(f"max_angle is {max_angle}, but must be positive")
    return float(np.mean(np.clip(1 - angles / max_angle, 0, None))) if len(angles) else float("nan")


def oriented_accuracy(estimated: NDArray[Any], true: NDArray[Any]) -> tuple[float, float]:
    """Compute the share of right signs, as they are and after flipping the whole cloud if that is better.

    A sign is right if the angle is below 90 degrees; at 90 degrees, or without a direction, it is wrong either
    way. Both shares are NaN where there are no normals.

    Args:
        estimated: (N, 3) directions of any length.
        true: (N, 3) directions of any length, finite and not zero.

    Raises:
        ValueError: as `angles`.
    """
    if len(angles(estimated, true)) == 0:  # which also checks the two
        return float("nan"), float("nan")
    cosine = np.einsum("nd,nd->n", _directions(estimated), _directions(true))
    right, wrong = float(np.mean(cosine > 0)), float(np.mean(cosine < 0))
    return right, max(right, wrong)


def _directions(normals: NDArray[Any]) -> NDArray[np.float64]:
    """Scale normals (N, 3) to length 1; NaN where there is no direction. No length overflows or underflows."""
    normals = np.asarray(normals, dtype=np.float64)
    if normals.ndim != 2 or normals.shape[1] != 3:
        raise ValueError(f"normals have shape {normals.shape}, but must be (N, 3)")
    with np.errstate(invalid="ignore", divide="ignore"):
        scaled = normals / np.abs(normals).max(axis=1, keepdims=True)
        return scaled / np.linalg.norm(scaled, axis=1, keepdims=True)
