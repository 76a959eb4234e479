"""The main job: a cloud in, the same cloud with oriented unit normals out.

finite, distinct points -> estimator -> signs -> normals and what else was asked for
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, check_coordinates
from jetnormal.errors import InputError
from jetnormal.estimators.base import Estimator
from jetnormal.jobs.files import check_file, check_format, read_file, write_file
from jetnormal.jobs.memory import room_for_tiles
from jetnormal.jobs.options import EstimateOptions, FileOptions, LargeOptions, NormalOptions
from jetnormal.jobs.prediction import predict, prepare_estimator, turned_curvatures
from jetnormal.support.report import StageTimer, peak_memory_mb, progress

if TYPE_CHECKING:
    from jetnormal.orientation.decision import Decision


@dataclass(frozen=True, repr=False)
class Result:
    """The normals of N points and what is known about them.

    A row is NaN where a point is not finite or its neighbors are collinear or coincide.

    Attributes:
        normals: (N, 3) float64 unit vectors.
        confidence: (N,) float32, 0 to 1, how good each normal is (`estimators.base.Prediction`).
        curvatures: (N, 2) float32 principal curvatures, the larger first, in the inverse of the cloud's unit, positive
            where the surface bends towards the normal; None of a plane.
        sign_confidence: (N,) float32, how probably each sign is right (`orientation.methods.Orientation`).
        model: name of the estimator, with its settings.
        decision: the method that chose the signs, the reason for it, and its confidence.
        warnings: messages for the user.
        seconds: wall-clock time by stage: clean, estimate, orient.
    """

    normals: NDArray[np.float64]
    confidence: NDArray[np.float32]
    curvatures: NDArray[np.float32] | None
    sign_confidence: NDArray[np.float32]
    model: str
    decision: Decision
    warnings: tuple[str, ...]
    seconds: dict[str, float]

    @property
    def orient(self) -> str:
        """The method that chose the signs."""
        return self.decision.used

    @property
    def reason(self) -> str:
        """Why that method chose the signs."""
        return self.decision.reason

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(N,) bool: which points have a normal."""
        return np.asarray(np.isfinite(self.normals).all(axis=-1))

    def shaped(self, shape: tuple[int, ...]) -> Result:
        """Return the same, with arrays of rows in a shape such as (H, W)."""
        curvatures = None if self.curvatures is None else self.curvatures.reshape(*shape, 2)
        return replace(
            self,
            normals=self.normals.reshape(*shape, 3),
            confidence=self.confidence.reshape(shape),
            curvatures=curvatures,
            sign_confidence=self.sign_confidence.reshape(shape),
        )

    def __repr__(self) -> str:
        seconds = sum(self.seconds.values())
        return f"<Result: {self.normals.size // 3:,} normals by {self.model}, signs by {self.orient}, {seconds:.2f} s>"


def estimate_file(
    source: Path,
    target: Path,
    options: EstimateOptions,
    files: FileOptions = FileOptions(),  # noqa: B008 - frozen
    large: LargeOptions = LargeOptions(),  # noqa: B008
    *,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Read a cloud, estimate its normals and write it with them; in tiles, if it would take too much memory.

    Args:
        source: the file to read, or "-" for standard input.
        target: the file to write, whose suffix tells the format, or "-" for standard output.
        options: how normals are estimated.
        files: how the files are read and written.
        large: how a cloud larger than memory is computed.
        overwrite: whether an existing output may be replaced.

    Returns:
        A summary: input, output, points, valid (with a normal), model, orient, seconds (by stage),
        points_per_second (of estimation and orientation), peak_memory_mb, warnings.

    Raises:
        InputError: a file cannot be read or written, or as `jetnormal.estimate`.
        UsageError, ModelError, ResourceError: as `jetnormal.estimate`.
    """
    timer = StageTimer()
    check_format(files, source, target)
    check_file(target, files, overwrite=overwrite)
    room = room_for_tiles(source, files, large, options.orient)
    if room is not None:
        from jetnormal.jobs.tiled.run import estimate_in_tiles

        return estimate_in_tiles(
            source,
            target,
            options,
            files,
            room=room,
            resume=large.resume,
            cluster=large.cluster,
            overwrite=overwrite,
        )
    with timer.stage("model"):
        estimator = prepare_estimator(options)  # before the cloud, which may take minutes to read
    return run_file(source, target, options, files, estimator, timer, overwrite=overwrite)


def run_file(
    source: Path,
    target: Path,
    options: EstimateOptions,
    files: FileOptions,
    estimator: Estimator,
    timer: StageTimer,
    *,
    overwrite: bool = False,
    turn: AbstractContextManager[Any] | None = None,
) -> dict[str, Any]:
    """Do what `estimate_file` does with an estimator that is there already.

    Args:
        source, target, options, files, overwrite: as for `estimate_file`.
        estimator: what `prepare_estimator` made of the options.
        timer: takes the stages read, clean, estimate, orient and write.
        turn: a context that is entered for the computation, so that one file is computed at a time while others are
            read and written.
    """
    with timer.stage("read"):
        cloud = read_file(source, files)
    try:
        with turn or nullcontext():
            result = find_normals(cloud, options, estimator, timer)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    finished, replaced = with_normals(cloud, result, options)
    with timer.stage("write"):
        losses = write_file(finished, target, files, overwrite=overwrite)
    notes = [f"{source}: {note}" for note in cloud.source.notes]
    busy = timer.seconds["estimate"] + timer.seconds["orient"]
    valid = int(result.valid.sum())
    return {
        "input": str(source),
        "output": str(target),
        "points": len(cloud),
        "valid": valid,
        "model": result.model,
        "orient": result.decision.facts(),
        "seconds": timer.seconds,
        "points_per_second": round(valid / busy) if busy else None,
        "peak_memory_mb": peak_memory_mb(),
        "warnings": [*notes, *result.warnings, *replaced, *losses],
    }


def find_normals(cloud: Cloud, options: NormalOptions, estimator: Estimator, timer: StageTimer) -> Result:
    """Estimate the normals of a cloud, for other jobs that begin with it.

    Args:
        cloud: the cloud; its own normals are ignored.
        options: how.
        estimator: what `prepare_estimator` made of the same options.
        timer: takes the stages clean, estimate and orient.

    Raises:
        InputError, UsageError: as `jetnormal.estimate`.
    """
    from jetnormal.orientation.policy import find_sensors, settle

    sensors = find_sensors(options, cloud)
    with timer.stage("clean"):
        chosen, copy_of = _distinct_rows(cloud)
    with timer.stage("estimate"), progress("estimating normals", len(chosen)) as advance:
        prediction, name, warnings = predict(cloud.points[chosen], estimator, options, advance)
    prediction = replace(prediction, rough=prediction.normals)  # nobody asks for it any more
    with timer.stage("orient"):
        known = None if sensors is None else sensors.of(chosen)
        orientation, decision = settle(cloud.points[chosen], prediction.normals, options.orient, known, cloud.source)
    warnings += decision.warnings()

    def spread(values: NDArray[Any]) -> NDArray[Any]:
        """Values of the distinct points as values of all rows of the cloud, NaN where there are none."""
        full = values[copy_of]
        full[copy_of < 0] = np.nan
        return full

    normals = spread(orientation.normals.astype(np.float64))
    curvatures = prediction.curvatures
    if curvatures is not None:
        turned = (orientation.normals * prediction.normals).sum(axis=1) < 0
        curvatures = turned_curvatures(curvatures, turned)
    valid = int((copy_of >= 0).sum())
    warnings += gaps(len(cloud) - valid, valid - int(np.isfinite(normals).all(axis=1).sum()))
    return Result(
        normals,
        spread(prediction.confidence),
        None if curvatures is None else spread(curvatures),
        spread(orientation.confidence),
        name,
        decision,
        tuple(warnings),
        {stage: timer.seconds[stage] for stage in ("clean", "estimate", "orient")},
    )


def _distinct_rows(cloud: Cloud) -> tuple[NDArray[Any], NDArray[Any]]:
    """The rows (M,) of a cloud's distinct finite points, and which of these each row (N,) is a copy of, -1 for none.

    Raises:
        InputError: the points are fewer than three, or have coordinates that cannot be computed with.
    """
    from jetnormal.geometry.neighbors import distinct

    rows = np.flatnonzero(cloud.valid)
    points = cloud.points[rows]
    check_coordinates(points)
    first, copies = distinct(points)
    if len(first) < 3:
        raise InputError(f"{len(first)} different finite points of {len(cloud)}: a normal needs at least 3")
    index = np.min_scalar_type(-max(1, len(cloud)))  # half the memory of int64
    copy_of = np.full(len(cloud), -1, index)
    copy_of[rows] = copies
    return rows[first].astype(index), copy_of


def with_normals(cloud: Cloud, result: Result, options: EstimateOptions) -> tuple[Cloud, list[str]]:
    """Return a cloud with its normals and the attributes asked for, and warnings about attributes that they replace."""
    found: dict[str, NDArray[Any]] = {}
    if options.curvature and result.curvatures is not None:
        high, low = result.curvatures.T
        found |= {"curvature": (high + low) / 2, "curvature_max": high, "curvature_min": low}
    if options.confidence:
        found["confidence"] = result.confidence
    if options.sign_confidence:
        found["sign_confidence"] = result.sign_confidence
    replaced = [f"attribute {name!r} of the input is replaced" for name in found if name in cloud.attributes]
    source = cloud.source
    if source.normal_dtype is not None:  # the old normals' precision; the new ones are float32
        source = replace(source, normal_dtype=np.dtype(np.float32))
    return Cloud(cloud.points, result.normals, cloud.attributes | found, source), replaced


def gaps(non_finite: int, degenerate: int) -> list[str]:
    """Warn about points without a normal."""
    warnings = []
    if non_finite:
        warnings.append(f"{non_finite} points have no finite coordinates; their normals are NaN")
    if degenerate:
        warnings.append(
            f"{degenerate} points are alone or have collinear neighbors, which span no plane; their normals are NaN"
        )
    return warnings
