"""The evaluation itself: a folder of clouds and a list of models in, scores out."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError, UsageError
from jetnormal.estimators.base import Estimator
from jetnormal.evaluation.clouds import BenchmarkCloud, clean_normals, read_benchmark_cloud
from jetnormal.evaluation.options import EvaluateOptions
from jetnormal.evaluation.scores import THRESHOLDS, Scores, good_points_curve, mean_scores, score
from jetnormal.evaluation.store import Estimate, ResultStore, digest
from jetnormal.evaluation.zangles import ZAngles, measure_z_angles
from jetnormal.formats.pcpnet import (
    CATEGORIES,
    TEST_LIST,
    categorize,
    cloud_names,
    query_count,
    read_normals,
    write_normals,
)
from jetnormal.support.report import Advance, logger, progress


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


def evaluate(data: Path | str, models: Sequence[str | Estimator], options: EvaluateOptions) -> Evaluation:
    """Compare estimators by the PCPNet protocol: see `jetnormal.evaluate`."""
    folder = Path(data)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    list_file = options.list_file
    if list_file is None and (folder / TEST_LIST).is_file():
        list_file = TEST_LIST
    clouds = categorize(folder, cloud_names(folder, list_file))
    trials = _make_trials(models, options)
    if options.export_normals is not None:
        _check_exports(options.export_normals, [trial.name for trial in trials], clouds, options.overwrite)
    logger.info("evaluating %d models on %d clouds", len(trials), len(clouds))
    found: dict[str, dict[str, CloudResult]] = {trial.name: {} for trial in trials}
    total = sum(query_count(folder, cloud, options.all_points or options.orient != "none") for cloud in clouds)
    with progress("evaluating", len(trials) * total) as advance:
        for name in clouds:
            cloud = read_benchmark_cloud(folder, name, options.all_points, sensors=options.orient == "viewpoint")
            clean = clean_normals(folder, cloud)
            for trial in trials:
                found[trial.name][name] = trial.run(cloud, clean, options, advance)
    names = _by_category(clouds)
    results = [ModelResult(model, found[model], names) for model in found]
    return Evaluation(folder, clouds, results, options.all_points)


def _by_category(clouds: dict[str, str]) -> dict[str, list[str]]:
    """Group the names of the clouds by category; PCPNet's categories come first."""
    order = [category for category in CATEGORIES if category in clouds.values()]
    order += sorted(set(clouds.values()) - set(order))
    return {category: [name for name, own in clouds.items() if own == category] for category in order}


def _make_trials(models: Sequence[str | Estimator], options: EvaluateOptions) -> list[_Trial]:
    from jetnormal.estimators.factory import spelled_out

    store = None if options.results is None else ResultStore(options.results)
    trials = [_model_trial(model, options, store) for model in spelled_out(models)]
    trials += [_Given(*_named_folder(text)) for text in options.normals]
    names = [trial.name for trial in trials]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"model {name} is given twice")
    if not trials:
        raise UsageError("there is no model to evaluate: give at least one, or `normals`")
    return trials


def _model_trial(model: str | Estimator, options: EvaluateOptions, store: ResultStore | None) -> _Trial:
    from jetnormal.estimators.factory import make_estimator, model_file

    if not isinstance(model, str):
        return _Estimated(model.name, model, {}, None)
    estimator = make_estimator(model, device=options.device, threads=options.threads)
    file = model_file(model)
    facts = {name: getattr(options, name) for name in ("orient", "all_points", "device", "threads")}
    facts |= {"model": estimator.name, "file": digest(file) if file and store else None}
    return _Estimated(model, estimator, facts, store)


def _named_folder(text: str) -> tuple[str, Path]:
    name, _, folder = text.partition("=")
    if not Path(folder).is_dir():
        raise InputError(f"{folder}: no such folder of normals")
    return name, Path(folder)


@dataclass(frozen=True)
class _Trial:
    """Something that has normals for the clouds of a benchmark."""

    name: str

    def run(
        self, cloud: BenchmarkCloud, clean: NDArray[np.float64] | None, options: EvaluateOptions, advance: Advance
    ) -> CloudResult:
        """Score a cloud; `clean` are the normals (Q, 3) of its clean version."""
        estimate = self.estimate(cloud, options, advance)
        if options.export_normals is not None:
            path = _exported(options.export_normals, self.name, cloud.name)
            write_normals(path, estimate.normals, overwrite=options.overwrite)
        scores, errors = score(estimate.normals, cloud.true_normals, clean, signs=options.orient != "none")
        logger.debug("%s, %s: RMSE %.2f degrees", cloud.name, self.name, scores.rmse)
        angles = self.z_angles(cloud) if options.z_angles else None
        return CloudResult(scores, errors, estimate.points, estimate.seconds, angles)

    def estimate(self, cloud: BenchmarkCloud, options: EvaluateOptions, advance: Advance) -> Estimate:
        """Return the normals at the points evaluated."""
        raise NotImplementedError

    def z_angles(self, cloud: BenchmarkCloud) -> ZAngles | None:
        """Measure what the learned transform of a patch network does; None without one."""
        return None


@dataclass(frozen=True)
class _Given(_Trial):
    """The normals of another program, in a folder."""

    folder: Path

    def estimate(self, cloud: BenchmarkCloud, options: EvaluateOptions, advance: Advance) -> Estimate:
        """See `_Trial`."""
        normals = read_normals(self.folder / f"{cloud.name}.normals")
        if len(normals) == len(cloud.points):
            normals = normals[cloud.queries]
        elif len(normals) != len(cloud.queries):
            raise InputError(
                f"{self.folder / cloud.name}.normals: {len(normals)} rows for {len(cloud.points)} points, "
                f"{len(cloud.queries)} of them evaluated"
            )
        advance(len(cloud.points) if options.orient != "none" else len(cloud.queries))
        return Estimate(normals, len(normals), None)


@dataclass(frozen=True)
class _Estimated(_Trial):
    """A model, and where its estimates are kept: `facts` are what they depend on beside the cloud."""

    estimator: Estimator
    facts: dict[str, Any]
    store: ResultStore | None

    def z_angles(self, cloud: BenchmarkCloud) -> ZAngles | None:
        """See `_Trial`."""
        return measure_z_angles(self.estimator, cloud)

    def estimate(self, cloud: BenchmarkCloud, options: EvaluateOptions, advance: Advance) -> Estimate:
        """See `_Trial`: the estimate that was kept, or a new one, which is kept."""
        if self.store is None:
            return self._estimate(cloud, options.orient, advance)
        path = self.store.path(cloud.name, self.facts | {"cloud": digest(*cloud.files)})
        estimate = self.store.load(path, len(cloud.queries))
        if estimate:
            advance(estimate.points)
            return estimate
        estimate = self._estimate(cloud, options.orient, advance)
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


def _exported(folder: Path, model: str, cloud: str) -> Path:
    """Where the normals of a model, whose name may be a path, for a cloud are written."""
    return folder / re.sub(r"[^\w.,=-]+", "_", model)[-100:] / f"{cloud}.normals"


def _check_exports(folder: Path, models: Sequence[str], clouds: Iterable[str], overwrite: bool) -> None:
    """Find out, before the long work, whether each file of normals has a place of its own.

    Raises:
        UsageError: two models would write the same file.
        InputError: one exists and may not be overwritten.
    """
    taken: dict[Path, str] = {}
    for path, model in ((_exported(folder, model, cloud), model) for cloud in clouds for model in models):
        if path in taken:
            raise UsageError(f"{taken[path]} and {model} would both be exported to {path}; export them one by one")
        if path.exists() and not overwrite:
            raise InputError(f"{path}: already exists; use `overwrite` to replace it or choose another folder")
        taken[path] = model
