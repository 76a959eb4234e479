"""The results of an evaluation: of a model on a cloud, of a model, of several models."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.evaluation.scores import THRESHOLDS, Scores, good_points_curve, mean_scores
from jetnormal.evaluation.zangles import ZAngles


@dataclass(frozen=True)
class CloudResult:
    """The scores of one model on one cloud.

    Attributes:
        scores: of the cloud.
        errors: (Q,) float32 angles to the true normals at the points evaluated, in degrees, signs left aside.
        points: number of normals estimated, at least Q.
        seconds: that took; None for normals of another program.
        z_angles: before and after the learned transform, of a patch network and if asked for.
    """

    scores: Scores
    errors: NDArray[np.float32]
    points: int
    seconds: float | None
    z_angles: ZAngles | None = None


@dataclass(frozen=True)
class ModelResult:
    """The scores of one model.

    Attributes:
        model: its name.
        clouds: result on each cloud, by name.
        names: the clouds of each category, in PCPNet's order.
    """

    model: str
    clouds: dict[str, CloudResult]
    names: dict[str, list[str]]

    @cached_property
    def categories(self) -> dict[str, Scores]:
        """Means over the clouds of each category."""
        return {key: mean_scores(self.clouds[name].scores for name in names) for key, names in self.names.items()}

    @cached_property
    def curves(self) -> dict[str, NDArray[np.float64]]:
        """Curves of good points over `THRESHOLDS`, (61,) each, by category."""
        return {key: good_points_curve(self.clouds[name].errors for name in names) for key, names in self.names.items()}

    @property
    def average(self) -> Scores:
        """The mean of the categories."""
        return mean_scores(self.categories.values())

    @property
    def points(self) -> int:
        """Number of normals estimated."""
        return sum(result.points for result in self.clouds.values())

    @property
    def seconds(self) -> float | None:
        """Seconds of the estimates, without reading files and choosing signs; None if unknown."""
        times = [result.seconds for result in self.clouds.values() if result.seconds is not None]
        return sum(times) if len(times) == len(self.clouds) else None

    @property
    def points_per_second(self) -> float | None:
        """Normals estimated in a second; None if unknown."""
        return self.points / self.seconds if self.seconds else None


@dataclass(frozen=True)
class Evaluation:
    """Results of several models on the same clouds.

    Attributes:
        data: the folder.
        clouds: the category of each cloud, by name.
        models: results in the order in which the models were given.
        all_points: whether all points were evaluated, whatever .pidx says.
    """

    data: Path
    clouds: dict[str, str]
    models: list[ModelResult]
    all_points: bool = False

    def summary(self) -> dict[str, Any]:
        """Return everything but the errors of single points as plain values, for JSON."""
        models = [
            {
                "model": result.model,
                "average": asdict(result.average),
                "categories": {name: asdict(scores) for name, scores in result.categories.items()},
                "clouds": {name: asdict(one.scores) for name, one in result.clouds.items()},
                "good_points": {name: curve.round(6).tolist() for name, curve in result.curves.items()},
                "points": result.points,
                "seconds": result.seconds,
                "points_per_second": result.points_per_second,
            }
            for result in self.models
        ]
        return {
            "data": str(self.data),
            "all_points": self.all_points,
            "clouds": self.clouds,
            "thresholds": THRESHOLDS.tolist(),
            "models": models,
        }
