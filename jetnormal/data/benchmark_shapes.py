"""The shapes of a benchmark, and the clouds that are drawn of each."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from jetnormal.data.corruption import DENSE_FACTOR, NOISE_LEVELS, Surface, add_noise, thin
from jetnormal.data.mesh_sampler import MeshSampler, load_mesh
from jetnormal.data.scanners.draw import FAMILIES, scan
from jetnormal.data.scanners.scenes import SCENE_SCANNERS, SceneTarget
from jetnormal.data.scanners.targets import MeshTarget, SolidTarget, Target
from jetnormal.data.scenes.draw import SCENES, random_scene
from jetnormal.data.solids.draw import random_solid
from jetnormal.data.sources import meshes_in
from jetnormal.errors import InputError
from jetnormal.formats.meshes import MESH_SUFFIXES
from jetnormal.formats.pcpnet import CATEGORIES

Floats = NDArray[np.float64]
Rng = np.random.Generator


@dataclass(frozen=True)
class DrawnCloud:
    """A cloud of a benchmark.

    Attributes:
        name: without blanks.
        category: a key of `formats.pcpnet.CATEGORIES`, of `FAMILIES` or of `SCENES`, or "scene".
        points: (N, 3).
        normals: (N, 3) true unit normals.
        labeled: (N,) bool, which points lie on a surface and may be evaluated; None for all.
        sensors: (N, 3) where each point was seen from; None where no scanner was.
    """

    name: str
    category: str
    points: Floats
    normals: Floats
    labeled: NDArray[np.bool_] | None = None
    sensors: Floats | None = None


@dataclass(frozen=True)
class Shape:
    """Something that clouds are drawn of.

    Attributes:
        name: of the shape.
        clouds: number of clouds that are drawn.
        draw: draws clouds of about so many points.
    """

    name: str
    clouds: int
    draw: Callable[[int, Rng], Iterator[DrawnCloud]]


def mesh_shapes(folder: Path, scans: bool) -> list[Shape]:
    """Return a shape for each mesh of a folder: its scans, or PCPNet's six categories.

    Raises:
        InputError: there are no meshes, or two of one name.
    """
    named = _named(folder, _meshes(folder))
    if scans:
        return [Shape(n, len(FAMILIES), partial(_scanned, n, partial(_mesh_target, p))) for n, p in named.items()]
    return [Shape(n, len(CATEGORIES), partial(_corrupted, n, partial(_mesh_surface, p))) for n, p in named.items()]


def solid_shapes(count: int, scans: bool) -> list[Shape]:
    """Return a shape for each of so many procedural solids: its scans, or PCPNet's six categories."""
    names = _numbered("solid", count)
    if scans:
        return [Shape(name, len(FAMILIES), partial(_scanned, name, _solid_target)) for name in names]
    return [Shape(name, len(CATEGORIES), partial(_corrupted, name, random_solid)) for name in names]


def scene_mesh_shapes(folder: Path) -> list[Shape]:
    """Return a shape for each reconstructed scene: a mesh in a folder, or in a folder of it as SceneNN has them.

    Raises:
        InputError: there are no meshes, or two of one name.
    """
    named = _named(folder, _meshes(folder, deep=True))
    return [Shape(name, 1, partial(_sampled, name, partial(_mesh_surface, path))) for name, path in named.items()]


def procedural_scene_shapes(count: int, scans: bool) -> list[Shape]:
    """Return rooms, streets and terrain in turn: a scan by each of their scanners, or sampled points."""
    shapes = []
    for number, name in enumerate(_numbered("", count)):
        kind = list(SCENES)[number % len(SCENES)]
        clouds = len(SCENE_SCANNERS[kind]) if scans else 1
        shapes.append(Shape(kind + name, clouds, partial(_of_scene, kind + name, kind, scans)))
    return shapes


def _meshes(folder: Path, deep: bool = False) -> list[Path]:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    paths = meshes_in(folder)
    if deep:
        paths += [path for inner in sorted(folder.iterdir()) if inner.is_dir() for path in meshes_in(inner)]
    if not paths:
        raise InputError(f"{folder}: holds no meshes ({' '.join(MESH_SUFFIXES)})")
    return paths


def _named(folder: Path, paths: list[Path]) -> dict[str, Path]:
    """Meshes by the names of their files; blanks, which separate the names in lists, become underscores."""
    named: dict[str, Path] = {}
    for path in paths:
        name = re.sub(r"\s+", "_", path.stem)
        if name in named:
            raise InputError(f"{path}: would become the shape {name}, as {named[name].name}; rename one of them")
        named[name] = path
    return named


def _numbered(name: str, count: int) -> list[str]:
    width = max(3, len(str(count)))
    return [f"{name}_{number:0{width}d}" for number in range(1, count + 1)]


def _mesh_surface(path: Path, _: Rng) -> Surface:
    return MeshSampler(load_mesh(path))


def _mesh_target(path: Path, _: Rng) -> Target:
    return MeshTarget(MeshSampler(load_mesh(path)))


def _solid_target(rng: Rng) -> Target:
    return SolidTarget(random_solid(rng))


def _corrupted(name: str, load: Callable[[Rng], Surface], count: int, rng: Rng) -> Iterator[DrawnCloud]:
    """The clouds of PCPNet's six categories.

    The normals of a noisy cloud are those of the clean points that it came from, as in PCPNet.
    """
    dense, dense_normals = load(rng).sample(DENSE_FACTOR * count, rng)
    clean, normals = dense[:count], dense_normals[:count]

    def cloud(category: str, points: Floats, normals: Floats) -> DrawnCloud:
        return DrawnCloud(name + CATEGORIES[category].ending, category, points, normals)

    yield cloud("none", clean, normals)
    for level, sigma in NOISE_LEVELS.items():
        yield cloud(level, add_noise(clean, sigma, rng), normals)
    patterns: tuple[Literal["gradient", "striped"], ...] = ("gradient", "striped")
    for pattern in patterns:
        kept = thin(dense, pattern, count, rng)
        yield cloud(pattern, dense[kept], dense_normals[kept])


def _scanned(name: str, load: Callable[[Rng], Target], count: int, rng: Rng) -> Iterator[DrawnCloud]:
    """A scan by each family of scanners."""
    target = load(rng)
    for family in FAMILIES:
        seen = scan(target, family, count, rng)
        yield DrawnCloud(f"{name}_{family}", family, seen.points, seen.normals, seen.labeled, seen.sensors)


def _sampled(name: str, load: Callable[[Rng], Surface], count: int, rng: Rng) -> Iterator[DrawnCloud]:
    """Points uniform over a surface, as the paper's experiment on real scenes has them."""
    points, normals = load(rng).sample(count, rng)
    yield DrawnCloud(name, "scene", points, normals)


def _of_scene(name: str, kind: str, scans: bool, count: int, rng: Rng) -> Iterator[DrawnCloud]:
    scene = random_scene(rng, kind)
    if not scans:
        points, normals = scene.sampler().sample(count, rng)
        known = normals.any(axis=1)  # leaves have no normal
        yield DrawnCloud(name, kind, points[known], normals[known])
        return
    target = SceneTarget(scene)
    for scanner in SCENE_SCANNERS[kind]:
        seen = scan(target, scanner, count, rng)
        yield DrawnCloud(f"{name}_{scanner}", kind, seen.points, seen.normals, seen.labeled, seen.sensors)
