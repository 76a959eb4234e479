"""The PCPNet protocol over any estimator: errors of unoriented normals per cloud, category and model.

The error of a cloud is taken over the points that its .pidx file names, that of a category is the mean over its
clouds, and the average is the mean over the categories (Guerrero et al., "PCPNet: Learning Local Shape Properties
from Raw Point Clouds", Eurographics 2018).
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError, UsageError
from jetnormal.geometry.metrics import angles, pgp, rmse
from jetnormal.pcpnet import cloud_names, query_count, read_cloud, read_list
from jetnormal.prediction import Estimator
from jetnormal.report import Advance, logger, progress

TEST_LIST = "testset_all.txt"
CATEGORY_LISTS = {
    "none": "testset_no_noise.txt",
    "low": "testset_low_noise.txt",
    "medium": "testset_med_noise.txt",
    "high": "testset_high_noise.txt",
    "gradient": "testset_vardensity_gradient.txt",
    "striped": "testset_vardensity_striped.txt",
}
# What the names of clouds end in that no category list names; the longer ending first.
CATEGORY_ENDINGS = {"_ddist_minmax_layers": "striped", "_ddist_minmax": "gradient"}
NOISE_INFIX = "_noise_white_"
NOISE_CATEGORIES = {"1.25e-03": "low", "6.00e-03": "medium", "1.20e-02": "high"}


@dataclass(frozen=True)
class Scores:
    """Errors of a cloud, or their means over several.

    Attributes:
        rmse: root mean square of the unoriented angle to the true normal, in degrees.
        pgp5, pgp10: shares, 0 to 1, of the points with an angle below 5 and 10 degrees.
    """

    rmse: float
    pgp5: float
    pgp10: float


@dataclass(frozen=True)
class ModelScores:
    """What one model reached.

    Attributes:
        model: its name.
        clouds: scores of each cloud, by name.
        categories: their means, by category.
        average: the mean of the categories.
        points: number of normals estimated.
        seconds: that took, neighbor search included, reading the files not.
    """

    model: str
    clouds: dict[str, Scores]
    categories: dict[str, Scores]
    average: Scores
    points: int
    seconds: float

    @property
    def points_per_second(self) -> float:
        """Normals estimated in a second."""
        return self.points / self.seconds


@dataclass(frozen=True)
class Evaluation:
    """Scores of several models on the same clouds.

    Attributes:
        data: the folder.
        clouds: the category of each cloud, by name.
        models: scores in the order in which the models were given.
    """

    data: Path
    clouds: dict[str, str]
    models: list[ModelScores]

    def summary(self) -> dict[str, Any]:
        """All of it as plain values, for JSON."""
        models = [asdict(scores) | {"points_per_second": scores.points_per_second} for scores in self.models]
        return {"data": str(self.data), "clouds": self.clouds, "models": models}


def evaluate(
    data: Path | str,
    models: Sequence[str | Estimator],
    *,
    list_file: str | None = None,
    device: str = "auto",
    threads: int | None = None,
) -> Evaluation:
    """Compares estimators by the PCPNet protocol. One cloud is in memory at a time, and all models see it.

    Args:
        data: folder in PCPNet's layout: NAME.xyz, NAME.normals and, where not all points count, NAME.pidx.
        models: names or files, with settings as in "jet:k=122,order=2" (see `estimators.make_estimator`), or
            estimators.
        list_file: name of the list in the folder, one NAME per line; None takes `testset_all.txt` where there is
            one, else all clouds with normals.
        device: "auto", "cpu", "cuda" or "cuda:N", for the models given by name.
        threads: of the CPU, for the models given by name; None takes all.

    Raises:
        InputError: the list or a file of a cloud is missing, unreadable or does not fit the others.
        UsageError: there is no model, one is given twice, or its settings are wrong.
        ModelError: a model is unknown or damaged.
        ResourceError: there is no such device.
    """
    folder = Path(data)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    if list_file is None and (folder / TEST_LIST).is_file():
        list_file = TEST_LIST
    clouds = categorize(folder, cloud_names(folder, list_file))
    trials = [_Trial(name, estimator) for name, estimator in _estimators(models, device, threads).items()]
    logger.info("evaluating %d models on %d clouds", len(trials), len(clouds))
    total = len(trials) * sum(query_count(folder, cloud) for cloud in clouds)
    with progress("evaluating", total) as advance:
        for cloud in clouds:
            points, normals, queries = read_cloud(folder, cloud)
            queries = np.arange(len(points)) if queries is None else queries
            for trial in trials:
                trial.run(cloud, points, normals, queries, advance)
    return Evaluation(folder, clouds, [trial.scores(clouds) for trial in trials])


def categorize(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """The category of each cloud: by the list of PCPNet's in the folder that names it, else by its own name."""
    listed: dict[str, str] = {}
    for category, list_file in CATEGORY_LISTS.items():
        if (folder / list_file).is_file():
            listed |= dict.fromkeys(read_list(folder / list_file), category)
    return {name: listed.get(name) or _category_by_ending(name) for name in names}


def _category_by_ending(name: str) -> str:
    for ending, category in CATEGORY_ENDINGS.items():
        if name.endswith(ending):
            return category
    _, infix, level = name.rpartition(NOISE_INFIX)
    return NOISE_CATEGORIES.get(level, f"noise {level}") if infix else "none"


def _estimators(models: Sequence[str | Estimator], device: str, threads: int | None) -> dict[str, Estimator]:
    """The estimators by name, in their order."""
    from jetnormal.estimators import make_estimator

    found: dict[str, Estimator] = {}
    estimator: Estimator
    for model in models:
        if isinstance(model, str):
            name, estimator = model, make_estimator(model, device=device, threads=threads)
        else:
            name, estimator = model.name, model
        if name in found:
            raise UsageError(f"model {name} is given twice")
        found[name] = estimator
    if not found:
        raise UsageError("there is no model to evaluate: give at least one")
    return found


class _Trial:
    """A model on its way through the clouds."""

    def __init__(self, name: str, estimator: Estimator) -> None:
        self._name = name
        self._estimator = estimator
        self._clouds: dict[str, Scores] = {}
        self._points = 0
        self._seconds = 0.0

    def run(
        self,
        cloud: str,
        points: NDArray[np.float64],
        normals: NDArray[np.float64],
        queries: NDArray[np.int64],
        advance: Advance,
    ) -> None:
        """Scores the model on the (Q,) queries of a cloud with (N, 3) points and true normals."""
        start = time.perf_counter()
        prediction = self._estimator(points, queries, advance)
        self._seconds += time.perf_counter() - start
        self._points += len(queries)
        errors = angles(prediction.normals, normals[queries])
        scores = Scores(rmse(errors), pgp(errors, 5.0), pgp(errors, 10.0))
        self._clouds[cloud] = scores
        logger.debug("%s, %s: RMSE %.2f degrees", cloud, self._name, scores.rmse)

    def scores(self, categories: Mapping[str, str]) -> ModelScores:
        """Scores of all clouds so far, and their means by category in PCPNet's order."""
        present = [category for category in CATEGORY_LISTS if category in categories.values()]
        present += sorted(set(categories.values()) - set(present))
        means = {
            category: _mean(scores for cloud, scores in self._clouds.items() if categories[cloud] == category)
            for category in present
        }
        return ModelScores(self._name, self._clouds, means, _mean(means.values()), self._points, self._seconds)


def _mean(scores: Iterable[Scores]) -> Scores:
    values = np.array([(one.rmse, one.pgp5, one.pgp10) for one in scores])
    return Scores(*values.mean(axis=0).tolist())
