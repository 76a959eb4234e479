"""Estimate a cloud larger than memory, from file to file; resume after an interruption."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from jetnormal import formats
from jetnormal._version import __version__
from jetnormal.cloud import Source
from jetnormal.errors import InputError, UsageError
from jetnormal.formats import CloudStream
from jetnormal.jobs.estimate import gaps
from jetnormal.jobs.memory import Room, check_disk
from jetnormal.jobs.options import EstimateOptions, FileOptions
from jetnormal.jobs.prediction import kept_estimator
from jetnormal.jobs.tiled.cluster import run_on_cluster
from jetnormal.jobs.tiled.merge import Merge
from jetnormal.jobs.tiled.plan import Plan, distribute
from jetnormal.jobs.tiled.store import Store
from jetnormal.jobs.tiled.thinning import settle_signs
from jetnormal.jobs.tiled.work import FIND, SIGN, run_task, signs_are_local
from jetnormal.orientation.decision import Decision
from jetnormal.orientation.policy import find_sensors
from jetnormal.support.report import StageTimer, logger, peak_memory_mb, progress

JOB, ROOM, LOCK = "job", "room", ".lock"
_NOT_IN_RESULTS = ("threads", "device", "batch_size")  # options that change how a result is reached


def estimate_in_tiles(
    source: Path,
    target: Path,
    options: EstimateOptions,
    files: FileOptions,
    *,
    room: Room,
    resume: bool = False,
    cluster: str | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Estimate the normals of a cloud of any size, tile by tile.

    Args:
        source, target, options, files, overwrite: as for `jobs.estimate.estimate_file`.
        room: points of a tile and of the thinned cloud; of a run that is resumed, they stay what they were.
        resume: whether to continue with the tiles that an interrupted run left.
        cluster: where the tiles are computed: None for here, else see `cluster.run_on_cluster`.

    Returns:
        A summary as that of `estimate_file`, and under tiles: their number, the points of the largest, bytes on disk.

    Raises:
        UsageError: the estimator needs the whole cloud; there is nothing to resume, or it was made of another input or
            with other options.
        InputError: as `estimate_file`; a file cannot be read or written in pieces; the disk is too small; another
            process computes the same tiles; a file of the tiles is damaged.
    """
    timer = StageTimer()
    formats.check_pieces(target, format=formats.format_for(target, files.format))
    with timer.stage("model"):
        estimator = kept_estimator(options)  # what is wrong with the options shows before the cloud is read
    if not math.isfinite(estimator.reach):
        raise UsageError(f"{estimator.name} looks at the whole cloud for each point, and cannot look at tiles of it")
    with timer.stage("read"):
        form = formats.format_for(source, files.format)
        stream = formats.open_stream(source, format=form, columns=files.columns, decimal=files.decimal)
    sensors = find_sensors(options, next(stream.pieces(1)))
    folder = target.with_name(f"{target.name}.tiles")
    if not resume:
        each_has_sensor = sensors is not None and sensors.places.ndim == 2
        check_disk(folder.parent, stream, source, each_has_sensor=each_has_sensor)
    _find_folder(folder, resume)
    with _locked(folder):
        store = _open_store(folder, _identity(source, options, files), resume)
        job = _Job(store, stream, source, options, cluster, timer)
        try:
            room = Room(*(store.read_json(ROOM) or asdict(room)).values())
            plan = job.distribute(room)
            job.find_directions(plan)
            decision = job.find_signs(plan, room.thinned)
            summary = job.write(plan, decision, target, files, overwrite=overwrite)
        except BaseException:
            if Plan.of(store) is None:
                shutil.rmtree(folder, ignore_errors=True)
            else:
                logger.warning("%s is kept: the same command with `resume` goes on from there", folder)
            raise
    shutil.rmtree(folder)
    return summary


def _find_folder(folder: Path, resume: bool) -> None:
    """Make the folder of the tiles, or see that an interrupted run has left it.

    Raises:
        UsageError: there is nothing to be resumed.
        InputError: the folder cannot be created.
    """
    if folder.is_dir() and Store(folder).read_json(JOB) is not None:
        return
    if resume:
        raise UsageError(f"{folder}: there is nothing to go on with; leave `resume` out")
    try:
        folder.mkdir(exist_ok=folder.is_dir() and all(path.name == LOCK for path in folder.iterdir()))
    except OSError as error:
        raise InputError(f"{folder}: the folder of the tiles cannot be created ({error.strerror or error})") from error


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep other processes out of the folder; the system lets them in again whichever way this one ends.

    Raises:
        InputError: another process is there.
    """
    lock = FileLock(folder / LOCK, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise InputError(f"{folder}: another process computes these tiles; wait for it or end it") from None
    try:
        yield
    finally:
        lock.release()


@dataclass(frozen=True)
class _Job:
    """The stages; each continues where an interrupted one ended."""

    store: Store
    stream: CloudStream
    source: Path
    options: EstimateOptions
    cluster: str | None
    timer: StageTimer

    def distribute(self, room: Room) -> Plan:
        """All points into their tiles."""
        plan = Plan.of(self.store)
        if plan is None:
            self.store.clear(f"{JOB}.json", LOCK)  # what an interrupted distribution has left
            self.store.write_json(ROOM, asdict(room))
            with self.timer.stage("clean"):
                plan = distribute(self.stream, self.store, self.options, room.tile)
        logger.info("%s points are in %d tiles in %s", f"{plan.points:,}", len(plan.counts), self.store.folder)
        return plan

    def find_directions(self, plan: Plan) -> None:
        with self.timer.stage("estimate"):
            self._work(FIND, plan, "estimating normals")

    def find_signs(self, plan: Plan, thinned: int) -> Decision:
        with self.timer.stage("orient"):
            decision = self._decide(plan, thinned)
            self._work(SIGN, plan, "choosing signs")
        return decision

    def _work(self, kind: str, plan: Plan, what: str) -> None:
        """Do a task for all tiles, here or on a cluster."""
        tiles, folder = range(len(plan.counts)), self.store.folder
        done: Iterator[int]
        if self.cluster is None:
            done = (run_task(folder, kind, tile, self.options) for tile in tiles)
        else:
            done = run_on_cluster(self.cluster, folder, self.options, kind, tiles)
        with progress(what, sum(plan.counts)) as advance:
            for count in done:
                advance(count)

    def _decide(self, plan: Plan, thinned: int) -> Decision:
        asked = self.options.orient
        if plan.sensors is not None:
            return Decision(asked, "viewpoint", plan.sensors, unseen=plan.unseen)
        if signs_are_local(plan, self.options):
            return Decision(asked, asked, "it was asked for")
        return settle_signs(self.store, plan, self.options, self._about, thinned)

    @property
    def _about(self) -> Source:
        """What the file says of itself."""
        return next(self.stream.pieces(1)).source

    def write(
        self, plan: Plan, decision: Decision, target: Path, files: FileOptions, *, overwrite: bool
    ) -> dict[str, Any]:
        """Write the output and tell what was done."""
        said = [self.store.read_json(f"{tile:05}") or {} for tile in range(len(plan.counts))]
        merge = Merge(self.store, plan, self.options, decision, any(each["has_curvature"] for each in said))
        on_disk = sum(file.stat().st_size for file in self.store.folder.iterdir())
        with self.timer.stage("write"):
            merge.write(self.stream, target, files, overwrite=overwrite)
        decision = replace(decision, confidence=merge.confidence)
        seconds = self.timer.seconds
        busy = seconds["estimate"] + seconds["orient"]
        warnings = [f"{self.source}: {note}" for note in self._about.notes]
        warnings += dict.fromkeys(warning for each in said for warning in each["warnings"])
        warnings += decision.warnings()
        warnings += gaps(plan.points - sum(plan.counts), sum(each["degenerate"] for each in said))
        return {
            "input": str(self.source),
            "output": str(target),
            "points": plan.points,
            "valid": merge.valid,
            "model": said[0]["model"],
            "orient": decision.facts(),
            "seconds": seconds,
            "points_per_second": round(merge.valid / busy) if busy else None,
            "peak_memory_mb": peak_memory_mb(),
            "warnings": warnings + merge.warnings,
            "tiles": {"count": len(plan.counts), "largest": max(plan.counts), "bytes_on_disk": on_disk},
        }


def _open_store(folder: Path, identity: dict[str, Any], resume: bool) -> Store:
    """The folder of tiles: a new one, or the one that an interrupted run has left.

    Raises:
        UsageError: there is one, and it is not to be resumed, or it belongs to something else.
    """
    store = Store(folder)
    known = store.read_json(JOB)
    if known is None:
        store.write_json(JOB, identity)
    elif not resume:
        raise UsageError(f"{folder}: an interrupted run has left this; go on with `resume`, or remove it")
    else:
        changed = [key for key in identity if known.get(key) != identity[key]]
        if changed:
            raise UsageError(
                f"{folder}: holds tiles of other {' and '.join(changed)}; remove it, or leave `resume` out"
            )
    return store


def _identity(source: Path, options: EstimateOptions, files: FileOptions) -> dict[str, Any]:
    """The input and the options that the results depend on."""
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
