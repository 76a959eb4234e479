"""The whole way of a cloud larger than memory, from file to file, and where to go on after an interruption."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from jetnormal import formats
from jetnormal._version import __version__
from jetnormal.cloud import Source
from jetnormal.errors import InputError, UsageError
from jetnormal.formats import CloudStream
from jetnormal.jobs.estimate import gaps
from jetnormal.jobs.memory import check_disk
from jetnormal.jobs.options import EstimateOptions, FileOptions
from jetnormal.jobs.tiled.cluster import run_on_cluster
from jetnormal.jobs.tiled.merge import Merge
from jetnormal.jobs.tiled.plan import Plan, distribute
from jetnormal.jobs.tiled.store import Store
from jetnormal.jobs.tiled.thinning import MOST, settle_signs
from jetnormal.jobs.tiled.work import FIND, SIGN, run_task, signs_are_local
from jetnormal.orientation.policy import Decision
from jetnormal.support.report import StageTimer, logger, peak_memory_mb, progress

JOB = "job"
_NOT_IN_RESULTS = ("threads", "device", "batch_size")  # options that change how a result is reached


def estimate_in_tiles(
    source: Path,
    target: Path,
    options: EstimateOptions,
    files: FileOptions,
    *,
    largest: int,
    thinned: int = MOST,
    resume: bool = False,
    cluster: str | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Estimate the normals of a cloud of any size, tile by tile.

    Args:
        source, target, options, files, overwrite: as for `jobs.estimate.estimate_file`.
        largest: points of a tile, about.
        thinned: points of the cloud that tells the signs, about.
        resume: whether to go on with the tiles that an interrupted run has left.
        cluster: where the tiles are computed: None for here, else see `cluster.run_on_cluster`.

    Returns:
        A summary as that of `estimate_file`, and under tiles: their number, the points of the largest, bytes on disk.

    Raises:
        InputError: as `estimate_file`; a file cannot be read or written in pieces; the disk is too small; there is
            nothing to resume, or it was made of another input or with other options.
    """
    timer = StageTimer()
    formats.check_pieces(target, format=formats.format_for(target, files.format))
    with timer.stage("read"):
        form = formats.format_for(source, files.format)
        stream = formats.open_stream(source, format=form, columns=files.columns, decimal=files.decimal)
    folder = target.with_name(f"{target.name}.tiles")
    if not resume:
        check_disk(folder.parent, stream, source)
    store = _open_store(folder, _identity(source, options, files), resume)
    try:
        summary = _run(store, stream, source, target, options, files, timer, largest, thinned, cluster, overwrite)
    except BaseException:
        if Plan.of(store) is None:
            shutil.rmtree(folder, ignore_errors=True)
        else:
            logger.warning("%s is kept: the same command with `resume` goes on from there", folder)
        raise
    shutil.rmtree(folder)
    return summary


def _run(
    store: Store,
    stream: CloudStream,
    source: Path,
    target: Path,
    options: EstimateOptions,
    files: FileOptions,
    timer: StageTimer,
    largest: int,
    thinned: int,
    cluster: str | None,
    overwrite: bool,
) -> dict[str, Any]:
    with timer.stage("clean"):
        plan = Plan.of(store) or distribute(stream, store, options, largest)
    tiles = len(plan.counts)
    logger.info("%s: %s points in %d tiles in %s", source, f"{plan.points:,}", tiles, store.folder)
    work = _runner(store.folder, options, cluster)
    with timer.stage("estimate"), progress("estimating normals", sum(plan.counts)) as advance:
        for done in work(FIND, range(tiles)):
            advance(done)
    first = next(stream.pieces(1)).source
    with timer.stage("orient"), progress("choosing signs", sum(plan.counts)) as advance:
        decision = _decide(store, plan, options, first, thinned)
        for done in work(SIGN, range(tiles)):
            advance(done)
    said = [store.read_json(f"{tile:05}") or {} for tile in range(tiles)]
    merge = Merge(store, plan, options, decision, has_curvature=any(each["has_curvature"] for each in said))
    on_disk = sum(file.stat().st_size for file in store.folder.iterdir())
    with timer.stage("write"):
        merge.write(stream, target, files, overwrite=overwrite)
    if signs_are_local(plan, options):
        decision = replace(decision, confidence=merge.confidence)
    busy = timer.seconds["estimate"] + timer.seconds["orient"]
    warnings = dict.fromkeys(warning for each in said for warning in each["warnings"])
    missing = gaps(plan.points - sum(plan.counts), sum(each["degenerate"] for each in said))
    return {
        "input": str(source),
        "output": str(target),
        "points": plan.points,
        "valid": merge.valid,
        "model": said[0]["model"],
        "orient": decision.facts(),
        "seconds": timer.seconds,
        "points_per_second": round(merge.valid / busy) if busy else None,
        "peak_memory_mb": peak_memory_mb(),
        "warnings": [
            *(f"{source}: {note}" for note in first.notes),
            *warnings,
            *decision.warnings(),
            *missing,
            *merge.warnings,
        ],
        "tiles": {"count": tiles, "largest": max(plan.counts), "bytes_on_disk": on_disk},
    }


def _decide(store: Store, plan: Plan, options: EstimateOptions, source: Source, thinned: int) -> Decision:
    if plan.sensors is not None:
        return Decision(options.orient, "viewpoint", plan.sensors, unseen=plan.unseen)
    if signs_are_local(plan, options):
        return Decision(options.orient, options.orient, "it was asked for")
    return settle_signs(store, plan, options, source, thinned)


def _runner(
    folder: Path, options: EstimateOptions, cluster: str | None
) -> Callable[[str, Iterable[int]], Iterable[int]]:
    """What does a task for many tiles, and yields the points of each that is done."""
    if cluster is not None:
        return partial(run_on_cluster, cluster, folder, options)
    return lambda kind, tiles: (run_task(folder, kind, tile, options) for tile in tiles)


def _open_store(folder: Path, identity: dict[str, Any], resume: bool) -> Store:
    """The folder of tiles: a new one, or the one that an interrupted run has left.

    Raises:
        UsageError: there is one, and it is not to be resumed; or there is none, or it belongs to something else.
    """
    store = Store(folder)
    known = store.read_json(JOB) if folder.is_dir() else None
    if resume:
        if known is None:
            raise UsageError(f"{folder}: there is nothing to go on with; leave `resume` out")
        changed = [key for key in identity if known.get(key) != identity[key]]
        if changed:
            raise UsageError(
                f"{folder}: was made with another {' and '.join(changed)}; remove it, or leave `resume` out"
            )
        return store
    if known is not None:
        raise UsageError(f"{folder}: an interrupted run has left this; go on with `resume`, or remove it")
    try:
        folder.mkdir()
    except OSError as error:
        raise InputError(f"{folder}: the folder of the tiles cannot be made ({error.strerror or error})") from error
    store.write_json(JOB, identity)
    return store


def _identity(source: Path, options: EstimateOptions, files: FileOptions) -> dict[str, Any]:
    """What results depend on."""
    state = source.stat()
    settings = {name: value for name, value in asdict(options).items() if name not in _NOT_IN_RESULTS}
    described: dict[str, Any] = {
        "version": __version__,
        "input": [str(source.resolve()), state.st_size, state.st_mtime_ns],
        "options": settings | asdict(files),
    }
    return {key: _plain(value) for key, value in described.items()}


def _plain(value: Any) -> Any:
    """Tuples as lists, as they come back from JSON."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value
