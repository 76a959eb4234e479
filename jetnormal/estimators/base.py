"""The interface of all estimators."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import ModelError
from jetnormal.support.report import Advance

NETWORK_POINTS = 64  # a smaller cloud is less than a network has ever seen: a jet does better
Axes = tuple[NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True)
class Prediction:
    """The output of an estimator for Q queries.

    Attributes:
        normals: (Q, 3) float32 unit vectors of arbitrary sign; NaN where the neighbors are collinear or coincide.
        rough: (Q, 3) float32 unit vectors before the last step: of the plane for `jet`, of the weighted jet for a
            corrected network; their sign is that of the normals.
        confidence: (Q,) float32 in [0, 1]: how far the last step agreed with the one before it, 1 - angle / 90
            degrees between rough and final normal; for `pca`, 1 - 3 times the surface variation.
        curvatures: (Q, 2) float32 principal curvatures, the larger first, in the inverse of the cloud's unit,
            positive where the surface bends towards the normal; None for a plane.
    """

    normals: NDArray[np.float32]
    rough: NDArray[np.float32]
    confidence: NDArray[np.float32]
    curvatures: NDArray[np.float32] | None

    def __getitem__(self, rows: NDArray[np.int64]) -> Prediction:
        """The prediction of the queries at (R,) rows."""
        curvatures = None if self.curvatures is None else self.curvatures[rows]
        return Prediction(self.normals[rows], self.rough[rows], self.confidence[rows], curvatures)


def joined(parts: list[Prediction]) -> Prediction:
    """Join predictions into one."""

    def join(name: str) -> Any:
        arrays = [getattr(part, name) for part in parts]
        return None if not arrays or arrays[0] is None else np.concatenate(arrays)

    return Prediction(join("normals"), join("rough"), join("confidence"), join("curvatures"))


def scattered(parts: Iterable[tuple[NDArray[np.int64], Prediction]], count: int) -> Prediction:
    """Put predictions for some rows each into one for all `count` rows, each of which is in one part, as they come."""
    whole: dict[str, Any] = {}
    for rows, part in parts:
        for field in fields(part):
            values = getattr(part, field.name)
            if values is not None:
                whole.setdefault(field.name, np.empty((count, *values.shape[1:]), values.dtype))[rows] = values
    return Prediction(whole["normals"], whole["rough"], whole["confidence"], whole.get("curvatures"))


def no_finite_normals(model: str) -> ModelError:
    """Return the error of a model whose weights are finite but give no normals."""
    return ModelError(f"{model}: its weights lead to no finite normals; train it anew or choose another model")


class Estimator(Protocol):
    """Points in, unoriented normals out. Its properties tell what an estimator can do, not its class or name."""

    @property
    def name(self) -> str:
        """What the estimator is called, with its settings."""
        ...

    @property
    def neighbors(self) -> int:
        """Points in a patch; a smaller cloud gets patches of all its points."""
        ...

    @property
    def has_curvature(self) -> bool:
        """Whether `Prediction.curvatures` is there: a plane has none."""
        ...

    @property
    def min_points(self) -> int:
        """Points of the smallest cloud that the estimator is suited to; it works from 3 points on."""
        ...

    @property
    def whole_cloud(self) -> bool:
        """Whether most of the work is done once for the whole cloud, however few the queries are."""
        ...

    @property
    def reach(self) -> float:
        """How far around a point the estimator looks, in root mean square distances of a point's 16 neighbors.

        Infinite where it depends on the size of the cloud.
        """
        ...

    def __call__(
        self, points: NDArray[np.float64], queries: NDArray[np.int64] | None = None, advance: Advance | None = None
    ) -> Prediction:
        """Estimate normals.

        Args:
            points: (N, 3) finite coordinates, N >= 3.
            queries: (Q,) indices of the points to estimate, for which the points are looked at as a whole; None means
                all, for which a large cloud may be cut into blocks.
            advance: called with the number of points just done.
        """
        ...

    def cost(self, points: NDArray[np.float64]) -> float:
        """Count 10^9 floating point operations a point, in matrix products, a multiply-add being two.

        Args:
            points: (N, 3), a cloud of the usual kind.
        """
        ...

    def z_axes(self, points: NDArray[np.float64], queries: NDArray[np.int64]) -> Axes | None:
        """Find the z axes (Q, 3) of patches before and after a learned transform; None without such a transform."""
        ...
