"""A cloud of a benchmark, with its true normals."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jetnormal.formats.pcpnet import clean_twin, file_of, read_cloud, read_sensors
from jetnormal.geometry.neighbors import NeighborIndex


@dataclass(frozen=True)
class BenchmarkCloud:
    """A cloud with N points, Q of which are evaluated.

    Attributes:
        name: of the cloud.
        files: that estimates depend on.
        points: (N, 3).
        normals: (N, 3) true unit normals.
        queries: (Q,) indices of the points evaluated.
        sensors: (N, 3) where each point was seen from, if that is needed.
    """

    name: str
    files: list[Path]
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    queries: NDArray[np.int64]
    sensors: NDArray[np.float64] | None = None

    @property
    def true_normals(self) -> NDArray[np.float64]:
        """(Q, 3) of the points evaluated."""
        return self.normals[self.queries]


def read_benchmark_cloud(folder: Path, name: str, all_points: bool = False, *, sensors: bool = False) -> BenchmarkCloud:
    """Read a cloud; all its points are evaluated if asked for, or if it has no .pidx file.

    `sensors` asks for the places of the sensors, which NAME.ply holds in a set of scans.

    Raises:
        InputError: a file is unreadable or does not match the others.
    """
    points, normals, queries = read_cloud(folder, name)
    files = [file_of(folder, name, "xyz")]
    if queries is None or all_points:
        queries = np.arange(len(points))
    else:
        files.append(file_of(folder, name, "pidx"))
    if not sensors:
        return BenchmarkCloud(name, files, points, normals, queries)
    files.append(file_of(folder, name, "ply"))
    return BenchmarkCloud(name, files, points, normals, queries, read_sensors(folder, name, len(points)))


def clean_normals(folder: Path, cloud: BenchmarkCloud) -> NDArray[np.float64] | None:
    """Find the true normals (Q, 3) of the nearest points of the clean cloud that a noisy one was made from, if present.

    Raises:
        InputError: a file of that cloud is unreadable or does not match the other.
    """
    twin = clean_twin(folder, cloud.name)
    if twin is None:
        return None
    points, normals, _ = read_cloud(folder, twin)
    nearest, _ = NeighborIndex(points).query(cloud.points[cloud.queries], 1)
    return normals[nearest[:, 0]]
