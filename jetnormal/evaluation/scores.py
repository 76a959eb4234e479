"""Scores of the normals of a cloud, and their means."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.metrics import angles, auc, oriented_accuracy, pgp, rmse

AUC_LIMIT = 30.0  # degrees: where the curves of good points end
THRESHOLDS = np.arange(61) * (AUC_LIMIT / 60)  # (61,) degrees, at which they are sampled


@dataclass(frozen=True)
class Scores:
    """Errors of a cloud, or their means over several. Angles are in degrees, shares from 0 to 1.

    Attributes:
        rmse: root mean square of the angle to the true normal, signs left aside.
        median: of that angle.
        pgp5, pgp10: shares of the points with an angle below 5 and 10 degrees.
        auc: area under the curve of that share over the threshold, up to 30 degrees.
        clean_rmse: as `rmse`, to the normal of the nearest point of the clean cloud; None without one.
        oriented_rmse: as `rmse`, but with signs, the whole cloud flipped if that is better; None for normals without.
        sign_accuracy: share of right signs, the whole cloud flipped if that is better; None for normals without.
    """

    rmse: float
    median: float
    pgp5: float
    pgp10: float
    auc: float
    clean_rmse: float | None = None
    oriented_rmse: float | None = None
    sign_accuracy: float | None = None


def score(
    estimated: NDArray[Any], true: NDArray[np.float64], clean: NDArray[np.float64] | None = None, signs: bool = False
) -> tuple[Scores, NDArray[np.float32]]:
    """Score the normals of a cloud.

    Args:
        estimated: (Q, 3) directions; NaN where there is none, which counts as the worst.
        true: (Q, 3) directions.
        clean: (Q, 3) directions of the clean surface next to the points.
        signs: whether the signs of the estimated normals mean something.

    Returns:
        The scores, and the angles (Q,) to the true normals in degrees, signs left aside.
    """
    errors = angles(estimated, true)
    oriented: dict[str, float] = {}
    if signs:
        ways = [angles(way, true, oriented=True) for way in (estimated, -estimated)]
        oriented = {
            "oriented_rmse": min(rmse(way) for way in ways),
            "sign_accuracy": oriented_accuracy(estimated, true)[1],
        }
    scores = Scores(
        rmse=rmse(errors),
        median=float(np.median(errors)),
        pgp5=pgp(errors, 5.0),
        pgp10=pgp(errors, 10.0),
        auc=auc(errors, AUC_LIMIT),
        clean_rmse=None if clean is None else rmse(angles(estimated, clean)),
        **oriented,
    )
    return scores, errors.astype(np.float32)


def mean_scores(scores: Iterable[Scores]) -> Scores:
    """Average each score over the clouds that have it."""
    scores = list(scores)
    means: dict[str, Any] = {}
    for field in fields(Scores):
        values = [value for one in scores if (value := getattr(one, field.name)) is not None]
        means[field.name] = float(np.mean(values)) if values else None
    return Scores(**means)


def good_points_curve(errors: Iterable[NDArray[np.float32]]) -> NDArray[np.float64]:
    """Compute the share of good points (61,) below each of `THRESHOLDS`: the mean over clouds of errors (Q,)."""
    return np.mean([[pgp(one, threshold) for threshold in THRESHOLDS] for one in errors], axis=0)
