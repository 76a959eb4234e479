"""Tiles as tasks of Ray, on one machine or many that share the folder of tiles."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from jetnormal.errors import ResourceError
from jetnormal.jobs.options import EstimateOptions
from jetnormal.jobs.tiled.work import run_task
from jetnormal.support.extras import require

RETRIES = 5  # of a tile whose worker was lost


def run_on_cluster(
    address: str, folder: Path, options: EstimateOptions, kind: str, tiles: Iterable[int]
) -> Iterator[int]:
    """Do a task for many tiles on a cluster; yield the points of each that is done, in any order.

    A tile whose worker is lost is computed again. Results are files that appear complete or not at all, so a tile may
    be computed several times, even by several workers.

    Args:
        address: "local" starts Ray on this machine; "auto" finds the cluster that this machine belongs to;
            "ray://HOST:10001" is one elsewhere.
        folder: of the tiles, at the same path on all machines.
        options, kind: as for `work.run_task`.
        tiles: their numbers.

    Raises:
        ResourceError: Ray is not installed, there is no such cluster, or a tile failed on it too often.
    """
    ray = _connected(address)
    task = ray.remote(num_cpus=options.threads or 1, max_retries=RETRIES)(run_task)
    single = replace(options, threads=options.threads or 1)
    waiting = [task.remote(folder.resolve(), kind, tile, single) for tile in tiles]
    try:
        while waiting:
            done, waiting = ray.wait(waiting)
            yield from ray.get(done)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error
    except ray.exceptions.RayError as error:
        raise ResourceError(
            f"the cluster {address} lost a tile too often ({type(error).__name__}); try `resume`"
        ) from error
    finally:
        for task_left in waiting:
            ray.cancel(task_left)


def _connected(address: str) -> Any:
    ray: Any = require("ray", "`cluster`")
    if not ray.is_initialized():
        try:
            ray.init(address=address, log_to_driver=False, logging_level="error")
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise ResourceError(f"there is no cluster at {address} ({error}); start one: ray start --head") from error
    return ray
