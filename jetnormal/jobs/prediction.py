"""From points to directions, by the estimator that the options ask for; for whole clouds and for tiles."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import UsageError
from jetnormal.estimators.base import Estimator, Prediction, joined
from jetnormal.jobs.options import EstimateOptions, NormalOptions
from jetnormal.support.report import Advance

FEW_NEIGHBORS = 10  # of a jet for a cloud too small for a network: a sphere of 45 points has 2.7 degrees, with 45 39
KEPT_MODELS = 4  # in memory


def prepare_estimator(options: NormalOptions) -> Estimator:
    """Make the estimator that the options ask for, and refuse options that no cloud could be estimated with.

    Raises:
        UsageError, ModelError, ResourceError: as `jetnormal.estimate`.
    """
    from jetnormal.estimators.factory import make_estimator

    settings: dict[str, Any] = {"k": options.k, "order": options.order, "iterations": options.iterations}
    estimator = make_estimator(options.model_name, **settings, **_resources(options))
    if isinstance(options, EstimateOptions) and options.curvature and not estimator.has_curvature:
        raise UsageError(f"{estimator.name} has no curvature: leave out `curvature`, or choose a network or jet")
    return estimator


def kept_estimator(options: EstimateOptions) -> Estimator:
    """Return the estimator of `prepare_estimator`, kept from an earlier call unless the model file has changed."""
    from jetnormal.estimators.factory import model_file

    file = model_file(options.model_name)
    stamp = None if file is None else (str(file), file.stat().st_mtime_ns, file.stat().st_size)
    signs = {"orient": "auto", "viewpoint": None, "viewpoint_attribute": None, "trajectory": None}
    return _kept(replace(options, confidence=False, sign_confidence=False, **signs), stamp)  # type: ignore[arg-type]


@lru_cache(maxsize=KEPT_MODELS)
def _kept(options: EstimateOptions, stamp: tuple[str, int, int] | None) -> Estimator:
    return prepare_estimator(options)


def _resources(options: NormalOptions) -> dict[str, Any]:
    return {"batch_size": options.batch_size, "device": options.device, "threads": options.threads}


def predict(
    points: NDArray[np.float64],
    estimator: Estimator,
    options: NormalOptions,
    advance: Advance,
    queries: NDArray[np.int64] | None = None,
) -> tuple[Prediction, str, list[str]]:
    """Ask an estimator for the directions of a cloud, part by part.

    Args:
        points: (N, 3) finite, different points.
        estimator: what `prepare_estimator` made of the options.
        options: how.
        advance: called with the number of points just done.
        queries: (Q,) rows of the points to estimate, ascending, where these are a part of a cloud that was cut out
            to be looked at as a whole; None for all.

    Returns:
        The prediction for the queries, the name of the estimator that looked at most of the cloud, and warnings.
    """
    from jetnormal.geometry.parts import far_apart
    from jetnormal.geometry.scale import unit_scale

    asked = np.full(len(points), queries is None)
    if queries is not None:
        asked[queries] = True
    parts = [rows for rows in far_apart(points) if asked[rows].any()]
    predictions: list[Prediction] = []
    names: list[str] = []
    warnings: list[str] = []
    for rows in parts:
        mine = np.flatnonzero(asked[rows])
        if len(rows) < 3:
            predictions.append(_nothing(len(mine)))
            continue
        suited, said = _suited_to(len(rows), estimator, options)
        scaled, exponent = unit_scale(points[rows])
        found = suited(scaled, None if queries is None else mine, advance)
        if found.curvatures is not None:
            with np.errstate(over="ignore"):  # parts of less than 1e-38 have curvatures beyond float32
                found = replace(found, curvatures=np.ldexp(found.curvatures, exponent))
        predictions.append(found)
        names.append(suited.name)
        warnings += said
    if not estimator.has_curvature:
        predictions = [replace(found, curvatures=None) for found in predictions]
    done = np.concatenate([rows[asked[rows]] for rows in parts])
    together = joined(predictions)[np.argsort(done)]
    return together, (names or [estimator.name])[0], list(dict.fromkeys(warnings))


def _nothing(count: int) -> Prediction:
    """The prediction for so few points that they span no plane: none."""
    unknown = np.full((count, 3), np.nan, dtype=np.float32)
    return Prediction(unknown, unknown, np.zeros(count, np.float32), unknown[:, :2])


def _suited_to(count: int, estimator: Estimator, options: NormalOptions) -> tuple[Estimator, list[str]]:
    """The estimator for a cloud of so many points, and a warning if it is not the one asked for."""
    from jetnormal.estimators.factory import make_estimator

    if count < estimator.min_points:
        jet = make_estimator("jet", k=FEW_NEIGHBORS, **_resources(options))
        fitted = f"jets of {min(jet.neighbors, count)} neighbors were fitted instead"
        return jet, [f"{count} points are too few for {estimator.name}: {fitted}"]
    if count >= estimator.neighbors:
        return estimator, []
    return estimator, [f"{count} points are fewer than a patch of {estimator.neighbors}: each patch has all of them"]


def turned_curvatures(curvatures: NDArray[np.float32], turned: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Turn principal curvatures (N, 2), the larger first, with normals (N,) that were turned: their signs change."""
    return np.where(turned[:, None], -curvatures[:, ::-1], curvatures)
