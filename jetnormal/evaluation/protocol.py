"""The evaluation itself: a folder of clouds and a list of models in, scores out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError, UsageError
from jetnormal.estimators.base import Estimator
from jetnormal.evaluation.clouds import BenchmarkCloud, clean_normals, read_benchmark_cloud
from jetnormal.evaluation.scores import THRESHOLDS, Scores, good_points_curve, mean_scores, score
from jetnormal.evaluation.store import Estimate, ResultStore, digest
from jetnormal.evaluation.zangles import ZAngles, measure_z_angles
from jetnormal.formats.pcpnet import CATEGORIES, TEST_LIST, categorize, cloud_names, query_count
from jetnormal.support.report import Advance, logger, progress


@dataclass(frozen=True)
class CloudResult:
    """The scores of one model on one cloud.

    Attributes:
        scores: of the cloud.
        errors: (Q,) float32 angles to the true normals at the points evaluated, in degrees, signs left aside.
        points: number of normals estimated, at least Q.
        seconds: that took.
        z_angles: before and after the learned transform, of a patch network and if asked for.
    """

    scores: Scores
    errors: NDArray[np.float32]
    points: int
    seconds: float
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
    def seconds(self) -> float:
        """Seconds of the estimates: with the neighbor search, without reading files and choosing signs."""
        return sum(result.seconds for result in self.clouds.values())

    @property
    def points_per_second(self) -> float:
        """Normals estimated in a second."""
        return self.points / self.seconds


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


def evaluate(
    data: Path | str,
    models: Sequence[str | Estimator],
    *,
    list_file: str | None = None,
    all_points: bool = False,
    orient: str = "none",
    results: Path | str | None = None,
    z_angles: bool = False,
    device: str = "auto",
    threads: int | None = None,
) -> Evaluation:
    """Compare estimators by the PCPNet protocol. One cloud is in memory at a time, and all models see it.

    Args:
        data: folder in PCPNet's layout: NAME.xyz, NAME.normals and, where not all points count, NAME.pidx.
        models: names or files, with settings as in "jet:k=122,order=2" (see `estimators.factory.make_estimator`), or
            estimators.
        list_file: name of the list in the folder, one NAME per line; None takes `testset_all.txt` where there is
            one, else all clouds with normals.
        all_points: whether all points count, whatever .pidx says.
        orient: "none", or how signs are chosen (`orientation.methods`), which are then scored, too. Signs spread from
            point to point, so that the normals of all points are estimated. "viewpoint" turns them to the sensors,
            whose places are attributes of NAME.ply.
        results: folder that keeps the normals of models given by name, and gives them back when nothing that they
            depend on has changed; the seconds are those of the first time.
        z_angles: whether to measure the angles between true normals and z axis before and after the learned
            transform of patch networks.
        device: "auto", "cpu", "cuda" or "cuda:N", for the models given by name.
        threads: of the CPU, for the models given by name; None takes all.

    Raises:
        InputError: the list or a file of a cloud is missing, unreadable or does not fit the others.
        UsageError: there is no model, one is given twice, or its settings are wrong.
        ModelError: a model is unknown or damaged.
        ResourceError: there is no such device.
    """
    from jetnormal.orientation.methods import Method

    folder = Path(data)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    if orient not in get_args(Method):
        raise UsageError(f"there is no orientation {orient!r} here; choose from {', '.join(get_args(Method))}")
    if list_file is None and (folder / TEST_LIST).is_file():
        list_file = TEST_LIST
    clouds = categorize(folder, cloud_names(folder, list_file))
    store = None if results is None else ResultStore(Path(results))
    settings = {"orient": orient, "all_points": all_points, "device": device, "threads": threads}
    trials = _make_trials(models, settings, store)
    logger.info("evaluating %d models on %d clouds", len(trials), len(clouds))
    found: dict[str, dict[str, CloudResult]] = {trial.name: {} for trial in trials}
    total = sum(query_count(folder, cloud, all_points or orient != "none") for cloud in clouds)
    with progress("evaluating", len(trials) * total) as advance:
        for name in clouds:
            cloud = read_benchmark_cloud(folder, name, all_points, sensors=orient == "viewpoint")
            clean = clean_normals(folder, cloud)
            for trial in trials:
                found[trial.name][name] = trial.run(cloud, clean, orient, advance, z_angles)
    names = _by_category(clouds)
    return Evaluation(folder, clouds, [ModelResult(model, found[model], names) for model in found], all_points)


def _by_category(clouds: dict[str, str]) -> dict[str, list[str]]:
    """Group the names of the clouds by category; PCPNet's categories come first."""
    order = [category for category in CATEGORIES if category in clouds.values()]
    order += sorted(set(clouds.values()) - set(order))
    return {category: [name for name, own in clouds.items() if own == category] for category in order}


def _make_trials(
    models: Sequence[str | Estimator], settings: dict[str, Any], store: ResultStore | None
) -> list[_Trial]:
    from jetnormal.estimators.factory import make_estimator, model_file

    trials: dict[str, _Trial] = {}
    for model in models:
        if isinstance(model, str):
            estimator: Estimator = make_estimator(model, device=settings["device"], threads=settings["threads"])
            file = model_file(model)
            facts = settings | {"model": estimator.name, "file": digest(file) if file and store else None}
            trial = _Trial(model, estimator, facts, store)
        else:
            trial = _Trial(model.name, model, {}, None)
        if trial.name in trials:
            raise UsageError(f"model {trial.name} is given twice")
        trials[trial.name] = trial
    if not trials:
        raise UsageError("there is no model to evaluate: give at least one")
    return list(trials.values())


@dataclass(frozen=True)
class _Trial:
    """A model, and where its estimates are kept: `facts` are what they depend on beside the cloud."""

    name: str
    estimator: Estimator
    facts: dict[str, Any]
    store: ResultStore | None

    def run(
        self, cloud: BenchmarkCloud, clean: NDArray[np.float64] | None, orient: str, advance: Advance, z_angles: bool
    ) -> CloudResult:
        """Score the model on a cloud; `clean` are the normals (Q, 3) of its clean version."""
        estimate = self._kept(cloud, orient, advance)
        scores, errors = score(estimate.normals, cloud.true_normals, clean, signs=orient != "none")
        logger.debug("%s, %s: RMSE %.2f degrees", cloud.name, self.name, scores.rmse)
        angles = measure_z_angles(self.estimator, cloud) if z_angles else None
        return CloudResult(scores, errors, estimate.points, estimate.seconds, angles)

    def _kept(self, cloud: BenchmarkCloud, orient: str, advance: Advance) -> Estimate:
        """Return the estimate that was kept, or make and keep a new one."""
        if self.store is None:
            return self._estimate(cloud, orient, advance)
        path = self.store.path(cloud.name, self.facts | {"cloud": digest(*cloud.files)})
        estimate = self.store.load(path, len(cloud.queries))
        if estimate:
            advance(estimate.points)
            return estimate
        estimate = self._estimate(cloud, orient, advance)
        self.store.save(path, estimate)
        return estimate

    def _estimate(self, cloud: BenchmarkCloud, orient: str, advance: Advance) -> Estimate:
        from jetnormal.orientation.methods import orient as choose_signs

        rows = cloud.queries if orient == "none" else np.arange(len(cloud.points))
        start = time.perf_counter()
        normals = self.estimator(cloud.points, rows, advance).normals
        seconds = time.perf_counter() - start
        if orient != "none":
            normals = choose_signs(cloud.points, normals, orient, viewpoint=cloud.sensors)[cloud.queries]  # type: ignore[arg-type]
        return Estimate(normals, len(rows), seconds)
