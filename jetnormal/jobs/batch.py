"""Estimate the normals of many files with one model, into one folder. A file that fails does not stop the others."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from jetnormal import formats
from jetnormal.errors import JetnormalError, ResourceError, UsageError, is_out_of_memory
from jetnormal.formats.atomic import make_folder
from jetnormal.jobs.estimate import run_file
from jetnormal.jobs.files import check_file
from jetnormal.jobs.memory import room_for_tiles
from jetnormal.jobs.options import BatchOptions, EstimateOptions, FileOptions, LargeOptions
from jetnormal.jobs.prediction import prepare_estimator
from jetnormal.support.report import StageTimer, peak_memory_mb, progress

Report = Callable[[dict[str, Any]], None]


def estimate_files(
    sources: Sequence[Path],
    folder: Path,
    options: EstimateOptions,
    files: FileOptions = FileOptions(),  # noqa: B008 - frozen
    batch: BatchOptions = BatchOptions(),  # noqa: B008 - frozen
    *,
    overwrite: bool = False,
    finished: Report = lambda summary: None,
) -> dict[str, Any]:
    """Estimate the normals of many clouds, each as `jobs.estimate.estimate_file` does.

    The clouds are computed one after the other, each with all threads. Meanwhile others are read and written.

    Args:
        sources: the files to read.
        folder: where the files to write go, under the names of the sources; it is made if it is missing.
        options: how normals are estimated.
        files: how files are read and written; `format` is that of the written ones.
        batch: what is written, and how many clouds are in memory at a time.
        overwrite: whether existing outputs may be replaced.
        finished: called with the summary or the failure of each file as soon as it is done.

    Returns:
        A summary: folder, files (the summaries of those that are done), skipped (outputs that were there), failed
        (input, error and code of each), seconds (by stage, added up), peak_memory_mb.

    Raises:
        UsageError: two sources would be written to one file, or options contradict each other.
        InputError: the folder cannot be created, or a target cannot be written.
        ModelError, ResourceError: as `jetnormal.estimate`.
    """
    if overwrite and batch.skip_existing:
        raise UsageError("`skip_existing` contradicts `overwrite`: leave one of them out")
    targets = [target_for(source, folder, files, batch) for source in sources]
    _check_names(sources, targets)
    skipped = [target for target in targets if batch.skip_existing and _size(target) is not None]
    todo = [(source, target) for source, target in zip(sources, targets, strict=True) if target not in skipped]
    make_folder(folder)
    for _, target in todo:
        check_file(target, files, overwrite=overwrite)
    timer = StageTimer()
    with timer.stage("model"):
        estimator = prepare_estimator(options)

    def run_one(source: Path, target: Path) -> dict[str, Any]:
        room = room_for_tiles(source, files, LargeOptions(), options.orient)
        if room is not None:
            from jetnormal.jobs.tiled.run import estimate_in_tiles

            with turn:
                return estimate_in_tiles(source, target, options, files, room=room, overwrite=overwrite)
        return run_file(source, target, options, files, estimator, StageTimer(), overwrite=overwrite, turn=turn)

    turn = threading.Lock()
    done, failed = _run(todo, run_one, batch.jobs, finished)
    for summary in done:
        for stage, seconds in summary["seconds"].items():
            timer.seconds[stage] = timer.seconds.get(stage, 0.0) + seconds
    return {
        "folder": str(folder),
        "files": done,
        "skipped": [str(target) for target in skipped],
        "failed": failed,
        "seconds": timer.seconds,
        "peak_memory_mb": peak_memory_mb(),
    }


def target_for(source: Path, folder: Path, files: FileOptions, batch: BatchOptions) -> Path:
    """Tell where the result for a source goes. What cannot hold normals becomes PLY."""
    if files.format is not None and formats.find_format(Path("-"), files.format).write is not None:
        ending = f".{files.format.lower().removeprefix('.')}"
    else:
        known = formats.find_format(source, formats.format_for(source, files.format))
        ending = ".ply" if known.write is None else source.suffix
    stem = source.name.removesuffix(source.suffix).removesuffix(".copc")  # the octree of a COPC file is not written
    return folder / f"{stem}{batch.suffix}{ending}"


def _check_names(sources: Sequence[Path], targets: Sequence[Path]) -> None:
    taken: dict[Path, Path] = {}
    inputs = {os.path.realpath(source) for source in sources}  # which a loop of links does not stop
    for source, target in zip(sources, targets, strict=True):
        if target in taken:
            raise UsageError(f"{source} and {taken[target]} would both become {target}; run them into two folders")
        if os.path.realpath(target) in inputs:
            raise UsageError(f"{target} is an input itself: choose another folder, or give `suffix=_n`")
        taken[target] = source


def _size(path: Path) -> int | None:
    """Bytes of a file; None if there is none, or if its name is none, as when it is too long."""
    try:
        return path.stat().st_size
    except OSError:
        return None


def _run(
    todo: Sequence[tuple[Path, Path]], run_one: Callable[[Path, Path], dict[str, Any]], jobs: int, finished: Report
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The summaries of the files that are done, and what failed, in the order of the files."""
    sizes = [_size(source) or 0 for source, _ in todo]
    done: dict[int, dict[str, Any]] = {}
    failed: dict[int, dict[str, Any]] = {}
    with progress("files", max(1, sum(sizes)), "bytes") as advance, ThreadPoolExecutor(jobs) as pool:
        waiting: dict[Future[dict[str, Any]], int] = {
            pool.submit(run_one, source, target): index for index, (source, target) in enumerate(todo)
        }
        try:
            for future in as_completed(waiting):
                index, error = waiting[future], future.exception()
                if error is None:
                    done[index] = future.result()
                else:
                    failed[index] = {"input": str(todo[index][0]), **_failure(error)}
                finished(done.get(index) or failed[index])
                advance(sizes[index], f"{len(done) + len(failed)} of {len(todo)} files")
        except BaseException:  # Ctrl-C: files that have begun are finished, no others begin
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [done[index] for index in sorted(done)], [failed[index] for index in sorted(failed)]


def _failure(error: BaseException) -> dict[str, Any]:
    """The message about a file that failed, and the exit code of its error."""
    if isinstance(error, JetnormalError):
        return {"error": " ".join(str(error).split()), "code": error.exit_code}
    if is_out_of_memory(error):
        return {"error": "out of memory: try fewer `jobs` or a smaller `batch_size`", "code": ResourceError.exit_code}
    return {"error": f"{type(error).__name__}: {error}", "code": JetnormalError.exit_code}
