"""The main job: a cloud in, the same cloud with oriented unit normals out.

finite, distinct points -> estimator -> signs -> normals and what else was asked for
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from jetnormal import formats
from jetnormal.cloud import Cloud
from jetnormal.errors import InputError, UsageError
from jetnormal.estimators.base import Estimator, Prediction
from jetnormal.support.report import StageTimer, peak_memory_mb, progress

if TYPE_CHECKING:
    from jetnormal.orientation.methods import Orientation

DEFAULT_MODEL = "cloudfit"
MAX_COORDINATE = 1e150  # squares of differences must be finite

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class EstimateOptions:
    """How normals are estimated.

    Attributes:
        model: "auto" (the default network), a packaged network, "pca", "jet", or a model file; settings may follow
            a colon (`estimators.factory.make_estimator`).
        k: neighbors in a patch; None takes the model's.
        order: of the jet, for "jet".
        iterations: of a network: from the second on, each normal found replaces the learned z-direction.
        orient: "auto", "global", "mst", "viewpoint", "up" or "none" (`orientation.methods`). "auto" takes the
            viewpoint, given or in the file, and "global" without one.
        viewpoint: the sensor's position in the cloud's coordinates.
        viewpoint_attribute: names of three attributes that hold the sensor's position for each point.
        curvature: whether to add the attributes curvature (mean), curvature_max and curvature_min.
        confidence: whether to add the attribute confidence (`estimators.base.Prediction`).
        sign_confidence: whether to add the attribute sign_confidence (`orientation.methods.Orientation`).
        batch_size: patches at a time; None takes the estimator's.
        device: "auto", "cpu", "cuda" or "cuda:N".
        threads: CPU threads; None for all cores.
        encoding: of the written file; None keeps the input's.
        force: whether an existing output is overwritten.
    """

    model: str = "auto"
    k: int | None = None
    order: int | None = None
    iterations: int = 1
    orient: str = "auto"
    viewpoint: Vector | None = None
    viewpoint_attribute: tuple[str, str, str] | None = None
    curvature: bool = False
    confidence: bool = False
    sign_confidence: bool = False
    batch_size: int | None = None
    device: str = "auto"
    threads: int | None = None
    encoding: str | None = None
    force: bool = False


@overload
def estimate(points: NDArray[Any], **options: Any) -> NDArray[np.float64]: ...
@overload
def estimate(points: Cloud, **options: Any) -> Cloud: ...
def estimate(points: NDArray[Any] | Cloud, **options: Any) -> NDArray[np.float64] | Cloud:
    """Estimates oriented unit normals.

    Args:
        points: (N, 3) coordinates, or a cloud.
        **options: the fields of `EstimateOptions`, such as `model="jet"` or `orient="up"`.

    Returns:
        For coordinates, (N, 3) float64 normals; for a cloud, a new one with normals and the attributes asked for.
        A row is NaN where a point is not finite or its neighbors are collinear or coincide.

    Raises:
        InputError: fewer than three different finite points, or coordinates beyond 1e150.
        UsageError: an option is out of range or contradicts another.
        ModelError: there is no such model.
        ResourceError: the device is not there.
    """
    cloud = points if isinstance(points, Cloud) else Cloud(np.asarray(points, dtype=np.float64))
    chosen = EstimateOptions(**options)
    result, _ = estimate_cloud(cloud, chosen, prepare_estimator(chosen), StageTimer())
    if isinstance(points, Cloud):
        return result
    assert result.normals is not None
    return result.normals


def estimate_file(source: Path, target: Path, options: EstimateOptions) -> dict[str, Any]:
    """Reads a cloud, estimates its normals and writes it with them.

    Args:
        source: the file to read.
        target: the file to write; its suffix tells the format.
        options: how.

    Returns:
        A summary: input, output, points, valid (with a normal), model, orient, seconds (by stage),
        points_per_second (of estimation and orientation), peak_memory_mb, warnings.

    Raises:
        InputError: a file cannot be read or written, or as `estimate`.
        UsageError, ModelError, ResourceError: as `estimate`.
    """
    timer = StageTimer()
    formats.check_target(target, encoding=options.encoding, overwrite=options.force)
    with timer.stage("model"):
        estimator = prepare_estimator(options)  # before the cloud, which may take minutes to read
    with timer.stage("read"):
        cloud = formats.read(source)
    try:
        result, facts = estimate_cloud(cloud, options, estimator, timer)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    busy = timer.seconds["estimate"] + timer.seconds["orient"]
    with timer.stage("write"):
        losses = formats.write(result, target, encoding=options.encoding, overwrite=options.force)
    notes = [f"{source}: {note}" for note in cloud.source.notes]
    return {
        "input": str(source),
        "output": str(target),
        "points": len(cloud),
        **facts,
        "seconds": {name: round(seconds, 3) for name, seconds in timer.seconds.items()},
        "points_per_second": round(facts["valid"] / busy) if busy else None,
        "peak_memory_mb": peak_memory_mb(),
        "warnings": [*notes, *facts["warnings"], *losses],
    }


def estimate_cloud(
    cloud: Cloud, options: EstimateOptions, estimator: Estimator, timer: StageTimer
) -> tuple[Cloud, dict[str, Any]]:
    """Estimates the normals of a cloud, for other jobs that begin with it.

    Args:
        cloud: the cloud; its own normals do not count.
        options: how.
        estimator: what `prepare_estimator` made of the same options.
        timer: takes the stages clean, estimate and orient.

    Returns:
        The cloud with normals and attributes, and valid, model, orient and warnings of the summary.

    Raises:
        InputError, UsageError: as `estimate`.
    """
    from jetnormal.geometry.neighbors import distinct
    from jetnormal.orientation.methods import choose_signs
    from jetnormal.orientation.policy import seen_from_origin, sign_method, sign_warnings

    method, viewpoint = sign_method(options, cloud)
    with timer.stage("clean"):
        rows = np.flatnonzero(cloud.valid)
        points = cloud.points[rows]
        largest = max(points.max(initial=0), -points.min(initial=0))
        if largest > MAX_COORDINATE:
            raise InputError(f"coordinates as large as {largest:.3g} cannot be computed with; remove those points")
        first, copies = distinct(points)
        points = points[first]
        if viewpoint is not None and viewpoint.ndim == 2:
            viewpoint = viewpoint[rows][first]
    if len(points) < 3:
        raise InputError(f"{len(points)} different finite points of {len(cloud)}: a normal needs at least 3")
    estimator, warnings = _suited_to(len(points), estimator, options)
    with timer.stage("estimate"), progress("estimating normals", len(points)) as advance:
        prediction = estimator(points, advance=advance)
    with timer.stage("orient"):
        orientation = choose_signs(points, prediction.normals, method, viewpoint=viewpoint)
        from_origin = seen_from_origin(orientation, points, options, cloud)
    orientation = from_origin or orientation
    normals = orientation.normals
    warnings += sign_warnings(orientation, viewpoint, from_origin is not None)

    full_normals = _spread(normals.astype(np.float64), copies, rows, len(cloud))
    found = _attributes(prediction, orientation, options)
    warnings += [f"attribute {name!r} of the input is replaced" for name in found if name in cloud.attributes]
    attributes = cloud.attributes | {name: _spread(values, copies, rows, len(cloud)) for name, values in found.items()}
    valid = int(np.isfinite(full_normals).all(axis=1).sum())
    warnings += _gaps(len(cloud) - len(rows), len(rows) - valid)
    source = cloud.source
    if source.normal_dtype is not None:  # the old normals' precision; the new ones are float32
        source = replace(source, normal_dtype=np.dtype(np.float32))
    result = Cloud(cloud.points, full_normals, attributes, source)
    return result, {"valid": valid, "model": estimator.name, "orient": method, "warnings": warnings}


def prepare_estimator(options: EstimateOptions) -> Estimator:
    """The estimator asked for. What is wrong with the options, whatever the cloud, shows here.

    Raises:
        UsageError, ModelError, ResourceError: as `estimate`.
    """
    from jetnormal.estimators.factory import make_estimator
    from jetnormal.orientation.policy import check_sign_options

    check_sign_options(options)
    model = DEFAULT_MODEL if options.model == "auto" else options.model
    iterations = options.iterations if options.iterations != 1 else None
    estimator = make_estimator(model, k=options.k, order=options.order, iterations=iterations, **_resources(options))
    if options.curvature and not estimator.has_curvature:
        raise UsageError(f"{estimator.name} has no curvature: leave curvature out, or choose a network or jet")
    return estimator


def _resources(options: EstimateOptions) -> dict[str, Any]:
    return {"batch_size": options.batch_size, "device": options.device, "threads": options.threads}


def _suited_to(count: int, estimator: Estimator, options: EstimateOptions) -> tuple[Estimator, list[str]]:
    """The estimator for a cloud of so many points, and what to say if it is not quite the one asked for."""
    from jetnormal.estimators.factory import make_estimator

    if count < estimator.min_points:
        jet = make_estimator("jet", k=max(3, count), **_resources(options))
        return jet, [f"{count} points are too few for {estimator.name}: a jet was fitted to all of them instead"]
    if count >= estimator.neighbors:
        return estimator, []
    return estimator, [f"{count} points are fewer than a patch of {estimator.neighbors}: each patch has all of them"]


def _spread(values: NDArray[Any], copies: NDArray[np.int64], rows: NDArray[np.int64], count: int) -> NDArray[Any]:
    """Values of the distinct points as values of all rows of the cloud, NaN where there are none."""
    full = np.full((count, *values.shape[1:]), np.nan, dtype=values.dtype)
    full[rows] = values[copies]
    return full


def _attributes(
    prediction: Prediction, orientation: Orientation, options: EstimateOptions
) -> dict[str, NDArray[np.float32]]:
    """The per-point results asked for beside the normals."""
    found = {}
    if options.curvature and prediction.curvatures is not None:
        # a normal that was turned round sees every bend from the other side
        turned = (orientation.normals * prediction.normals).sum(axis=1) < 0
        high, low = prediction.curvatures.T
        found["curvature"] = (high + low) / 2 * np.where(turned, -1, 1).astype(np.float32)
        found["curvature_max"] = np.where(turned, -low, high)
        found["curvature_min"] = np.where(turned, -high, low)
    if options.confidence:
        found["confidence"] = prediction.confidence
    if options.sign_confidence:
        found["sign_confidence"] = orientation.confidence
    return found


def _gaps(non_finite: int, degenerate: int) -> list[str]:
    warnings = []
    if non_finite:
        warnings.append(f"{non_finite} points have no finite coordinates; their normals are NaN")
    if degenerate:
        warnings.append(f"{degenerate} points have collinear neighbors, which span no plane; their normals are NaN")
    return warnings
