"""The evaluation itself: a folder of clouds and a list of models in, scores out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from jetnormal.errors import InputError, UsageError
from jetnormal.estimators.base import Estimator
from jetnormal.evaluation.clouds import clean_normals, read_benchmark_cloud
from jetnormal.evaluation.options import EvaluateOptions
from jetnormal.evaluation.results import CloudResult, Evaluation, ModelResult
from jetnormal.evaluation.store import ResultStore, digest
from jetnormal.evaluation.trials import Estimated, Given, Trial, exported_to
from jetnormal.formats.pcpnet import CATEGORIES, TEST_LIST, categorize, cloud_names, query_count
from jetnormal.support.report import logger, progress


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


def _make_trials(models: Sequence[str | Estimator], options: EvaluateOptions) -> list[Trial]:
    from jetnormal.estimators.factory import spelled_out

    store = None if options.results is None else ResultStore(options.results)
    trials = [_model_trial(model, options, store) for model in spelled_out(models)]
    trials += [Given(*_named_folder(text)) for text in options.normals]
    names = [trial.name for trial in trials]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"model {name} is given twice")
    if not trials:
        raise UsageError("there is no model to evaluate: give at least one, or `normals`")
    return trials


def _model_trial(model: str | Estimator, options: EvaluateOptions, store: ResultStore | None) -> Trial:
    from jetnormal.estimators.factory import make_estimator, model_file

    if not isinstance(model, str):
        return Estimated(model.name, model, {}, None)
    estimator = make_estimator(model, device=options.device, threads=options.threads)
    file = model_file(model)
    facts = {name: getattr(options, name) for name in ("orient", "all_points", "device", "threads")}
    facts |= {"model": estimator.name, "file": digest(file) if file and store else None}
    return Estimated(model, estimator, facts, store)


def _named_folder(text: str) -> tuple[str, Path]:
    name, _, folder = text.partition("=")
    if not Path(folder).is_dir():
        raise InputError(f"{folder}: no such folder of normals")
    return name, Path(folder)


def _check_exports(folder: Path, models: Sequence[str], clouds: Iterable[str], overwrite: bool) -> None:
    """Find out, before the long work, whether each file of normals has a place of its own.

    Raises:
        UsageError: two models would write the same file.
        InputError: one exists and may not be overwritten.
    """
    taken: dict[Path, str] = {}
    for path, model in ((exported_to(folder, model, cloud), model) for cloud in clouds for model in models):
        if path in taken:
            raise UsageError(f"{taken[path]} and {model} would both be exported to {path}; export them one by one")
        if path.exists() and not overwrite:
            raise InputError(f"{path}: already exists; use `overwrite` to replace it or choose another folder")
        taken[path] = model
