"""Sources of clouds with known normals: PCPNet folders, meshes and procedural solids, sampled or scanned.

A source is a pure function: `source.cloud(epoch, index, seed)` is the same cloud whenever it is asked for,
so that a resumed training sees the data it would have seen, and clouds may be made ahead in a thread.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from jetnormal.data.corruption import Surface, scan
from jetnormal.data.mesh_sampler import MeshSampler, load_mesh
from jetnormal.data.options import CLOUDS_PER_EPOCH, POINTS_PER_CLOUD
from jetnormal.data.scanners.draw import random_scan
from jetnormal.data.scanners.scenes import SceneTarget
from jetnormal.data.scanners.targets import MeshTarget, SolidTarget, Target
from jetnormal.data.scenes.draw import random_scene
from jetnormal.data.solids.draw import random_solid
from jetnormal.errors import InputError
from jetnormal.formats.meshes import MESH_SUFFIXES
from jetnormal.formats.pcpnet import cloud_names, read_cloud

TRAINING_LIST = "trainingset_whitenoise.txt"
VALIDATION_LIST = "validationset_whitenoise.txt"
SCANNED_SHARES = {"mesh": 0.5, "solid": 0.2, "scene": 0.3}  # of the clouds that are scanned
CLOUDS_PER_SCENE = 16  # in a sequence of so many clouds those of scenes are of one scene, which takes a while to build


@dataclass(frozen=True)
class LabeledCloud:
    """Points with their true normals.

    Attributes:
        name: where the cloud comes from, for messages.
        points: (N, 3) float64.
        normals: (N, 3) float64, outward unit normals of the clean surface.
        queries: (Q,) int64 indices of the points to evaluate; None means all.
        sensors: (N, 3) float64 place of the sensor that saw each point; None where there was none.
        labeled: (N,) bool, False for outliers and other points that lie on no surface, whose normals nothing should
            be learned from; None means that all are labeled.
    """

    name: str
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    queries: NDArray[np.int64] | None = None
    sensors: NDArray[np.float64] | None = None
    labeled: NDArray[np.bool_] | None = None


class DataSource(Protocol):
    """Labeled clouds by epoch and index."""

    @property
    def clouds_per_epoch(self) -> int:
        """Indices run from 0 to this number."""
        ...

    def cloud(self, epoch: int, index: int, seed: int) -> LabeledCloud:
        """Return the cloud at `index` of `epoch`; equal arguments give equal clouds."""
        ...


class PcpnetFolder:
    """Clouds of a folder in PCPNet's layout: NAME.xyz, NAME.normals and, where there is one, NAME.pidx.

    With a list file the clouds are those that it names, the same in each epoch. Without one they are all that
    have normals, and each epoch draws a new corruption of each, as for a mesh.
    """

    def __init__(self, directory: Path | str, list_file: str | None = TRAINING_LIST) -> None:
        """Find the clouds; each is read when it is first asked for and kept.

        Args:
            directory: the folder. It is only read.
            list_file: name of the list in the folder, one NAME per line; None takes all clouds with normals.

        Raises:
            InputError: the list or a cloud that it names is missing, or there are no clouds.
        """
        self._directory = Path(directory)
        self._augment = list_file is None
        self.names = cloud_names(self._directory, list_file)
        self._load = lru_cache(maxsize=None)(self._read)

    @property
    def clouds_per_epoch(self) -> int:
        return len(self.names)

    def cloud(self, epoch: int, index: int, seed: int) -> LabeledCloud:
        """See `DataSource.cloud`.

        Raises:
            InputError: a file of the cloud is unreadable or does not match the others.
        """
        cloud = self._load(self.names[index])
        if not self._augment:
            return cloud
        rng = np.random.default_rng([seed, epoch, index])
        return _drawn(cloud.name, _Subset(cloud), len(cloud.points), rng)

    def _read(self, name: str) -> LabeledCloud:
        return LabeledCloud(name, *read_cloud(self._directory, name))


class MeshFolder:
    """Clouds drawn anew in each epoch from the meshes of a folder, each mesh equally often."""

    def __init__(
        self, directory: Path | str, clouds_per_epoch: int = CLOUDS_PER_EPOCH, points: int = POINTS_PER_CLOUD
    ) -> None:
        """Find the meshes; the 64 used last are kept in memory.

        Raises:
            InputError: there is no mesh in the folder.
        """
        self.directory = Path(directory)
        self.paths = meshes_in(self.directory)
        if not self.paths:
            raise InputError(f"{directory}: holds no meshes ({' '.join(MESH_SUFFIXES)})")
        self.clouds_per_epoch = clouds_per_epoch
        self._points = points
        self._sampler = lru_cache(maxsize=64)(_load_sampler)

    def cloud(self, epoch: int, index: int, seed: int) -> LabeledCloud:
        """See `DataSource.cloud`.

        Raises:
            InputError: the mesh cannot be used.
        """
        path = _toured(self.paths, epoch * self.clouds_per_epoch + index, seed)
        rng = np.random.default_rng([seed, epoch, index])
        return _drawn(path.stem, self._sampler(path), self._points, rng)


class SyntheticSolids:
    """Clouds drawn anew in each epoch from random procedural solids."""

    def __init__(self, clouds_per_epoch: int = CLOUDS_PER_EPOCH, points: int = POINTS_PER_CLOUD) -> None:
        self.clouds_per_epoch = clouds_per_epoch
        self._points = points

    def cloud(self, epoch: int, index: int, seed: int) -> LabeledCloud:
        """See `DataSource.cloud`."""
        rng = np.random.default_rng([seed, epoch, index])
        return _drawn("solid", random_solid(rng), self._points, rng)


class ScannedSurfaces:
    """Clouds scanned anew in each epoch by virtual scanners: of meshes, each equally often, solids and scenes."""

    def __init__(
        self,
        directories: Sequence[Path | str] = (),
        clouds_per_epoch: int = CLOUDS_PER_EPOCH,
        points: int = POINTS_PER_CLOUD,
    ) -> None:
        """Find the meshes; the 64 used last are kept in memory.

        Args:
            directories: folders of meshes. Without any all clouds are of procedural solids and scenes.
            clouds_per_epoch: clouds drawn in an epoch.
            points: largest number of points of a cloud.

        Raises:
            InputError: there is no mesh in a folder.
        """
        for directory in directories:
            if not meshes_in(Path(directory)):
                raise InputError(f"{directory}: holds no meshes ({' '.join(MESH_SUFFIXES)})")
        self.paths = [path for directory in directories for path in meshes_in(Path(directory))]
        self.clouds_per_epoch = clouds_per_epoch
        self._points = points
        self._mesh_target = lru_cache(maxsize=64)(_load_target)
        self._scene_target = lru_cache(maxsize=2)(_random_scene_target)

    def cloud(self, epoch: int, index: int, seed: int) -> LabeledCloud:
        """See `DataSource.cloud`.

        Raises:
            InputError: the mesh cannot be used.
            ResourceError: Open3D, which casts the rays, cannot be loaded.
        """
        rng = np.random.default_rng([seed, epoch, index])
        name, target = self._drawn(epoch * self.clouds_per_epoch + index, seed, rng)
        scan = random_scan(target, self._points, rng)
        return LabeledCloud(
            f"{name}_{scan.kind}", scan.points, scan.normals, sensors=scan.sensors, labeled=scan.labeled
        )

    def _drawn(self, position: int, seed: int, rng: np.random.Generator) -> tuple[str, Target]:
        """Name and surface of the cloud at a position in the sequence of all clouds."""
        kinds = [kind for kind in SCANNED_SHARES if kind != "mesh" or self.paths]
        shares = np.array([SCANNED_SHARES[kind] for kind in kinds])
        kind = kinds[rng.choice(len(kinds), p=shares / shares.sum())]
        if kind == "mesh":
            path = _toured(self.paths, position, seed)
            return path.stem, self._mesh_target(path)
        if kind == "solid":
            return "solid", SolidTarget(random_solid(rng))
        target = self._scene_target(seed, position // CLOUDS_PER_SCENE)
        return target.kind, target


class _Subset:
    """A labeled cloud as a surface: draws among its points without replacement, at most all of them."""

    def __init__(self, cloud: LabeledCloud) -> None:
        self._cloud = cloud

    def sample(self, count: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        size = len(self._cloud.points)
        drawn = rng.choice(size, min(count, size), replace=False)
        return self._cloud.points[drawn], self._cloud.normals[drawn]


def _drawn(name: str, surface: Surface, largest: int, rng: np.random.Generator) -> LabeledCloud:
    points, normals, kind = scan(surface, largest, rng)
    return LabeledCloud(f"{name}_{kind}", points, normals)


def _toured(paths: Sequence[Path], position: int, seed: int) -> Path:
    """The path at a position of tours that visit all paths, each in an order of its own."""
    tour, stop = divmod(position, len(paths))
    return paths[np.random.default_rng([seed, tour]).permutation(len(paths))[stop]]


def _random_scene_target(seed: int, number: int) -> SceneTarget:
    return SceneTarget(random_scene(np.random.default_rng([seed, number, 1])))


def _load_target(path: Path) -> Target:
    return MeshTarget(_load_sampler(path))


def _load_sampler(path: Path) -> MeshSampler:
    return MeshSampler(load_mesh(path))


def meshes_in(directory: Path) -> list[Path]:
    """Return the mesh files of a folder, by name."""
    return sorted(path for path in directory.glob("*") if path.suffix.lower() in MESH_SUFFIXES)
