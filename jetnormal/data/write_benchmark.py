"""Set of clouds in PCPNet's layout, drawn from meshes or procedural solids.

Of each shape come PCPNet's six categories: clean points; the same points under three levels of noise; and two clouds
of uneven density, a gradient and stripes.
"""

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
from jetnormal.data.solids.recipes import random_solid
from jetnormal.data.sources import meshes_in
from jetnormal.errors import InputError, UsageError
from jetnormal.formats.atomic import atomic_folder
from jetnormal.formats.meshes import MESH_SUFFIXES
from jetnormal.formats.pcpnet import CATEGORIES, TEST_LIST, write_cloud
from jetnormal.support.report import progress

Split = Literal["test", "training", "validation"]
MARKER = ".jetnormal-dataset"  # lists the files of a folder that was written here: no others may be replaced
MARKER_TITLE = "# written by jetnormal dataset; its option --force replaces these files"


@dataclass(frozen=True)
class DatasetOptions:
    """What is drawn.

    Attributes:
        points: of each cloud.
        queries: points of each cloud that its .pidx file names, at most.
        split: "test" for lists that `jetnormal evaluate` knows, "training" and "validation" for those that
            `jetnormal train` knows.
        seed: of all that is random.

    Raises:
        UsageError: a number is out of range.
    """

    points: int = 100_000
    queries: int = 5_000
    split: Split = "test"
    seed: int = 1

    def __post_init__(self) -> None:
        for name, least in (("points", 3), ("queries", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise UsageError(f"{name} must be at least {least}, not {getattr(self, name)}")


@dataclass(frozen=True)
class _Shape:
    name: str
    load: Callable[[np.random.Generator], Surface]


def write_dataset(
    folder: Path,
    options: DatasetOptions,
    *,
    meshes: Path | None = None,
    solids: int = 0,
    overwrite: bool = False,
) -> list[str]:
    """Write clouds and lists of them. The same arguments give the same bytes.

    Everything is written beside the folder first, and takes its name when it is complete.

    Args:
        folder: to create; an empty one may exist.
        options: what is drawn.
        meshes: folder with meshes, each of which becomes a shape.
        solids: number of procedural solids, each of which becomes a shape.
        overwrite: whether a folder is replaced that this function wrote and that holds nothing else.

    Returns:
        Names of the clouds.

    Raises:
        UsageError: there is neither a mesh nor a solid to draw from.
        InputError: the folder exists or cannot be written, or a mesh cannot be used.
    """
    shapes = [*_mesh_shapes(meshes), *_solid_shapes(solids)]
    if not shapes:
        raise UsageError("there is nothing to draw points from: give a folder of meshes or a number of solids")
    old = _replaceable(folder, overwrite) if folder.exists() else []
    names: dict[str, list[str]] = {category: [] for category in CATEGORIES}
    total = len(shapes) * len(CATEGORIES)
    with atomic_folder(folder, old) as unfinished, progress("drawing", total, "clouds") as advance:
        for index, shape in enumerate(shapes):
            rng = np.random.default_rng([options.seed, index])
            for category, points, normals in draw(shape.load(rng), options.points, rng):
                name = shape.name + CATEGORIES[category].ending
                queries = rng.choice(len(points), min(options.queries, len(points)), replace=False)
                write_cloud(unfinished, name, points, normals, np.sort(queries))
                names[category].append(name)
                advance(1)
        for list_file, members in _lists(names, options.split).items():
            (unfinished / list_file).write_bytes("".join(f"{name}\n" for name in members).encode())
        listing = sorted(path.name for path in unfinished.iterdir())
        (unfinished / MARKER).write_bytes("".join(f"{line}\n" for line in (MARKER_TITLE, *listing)).encode())
    return [name for members in names.values() for name in members]


def draw(
    surface: Surface, count: int, rng: np.random.Generator
) -> Iterator[tuple[str, NDArray[np.float64], NDArray[np.float64]]]:
    """Draw clouds of `count` points from a surface: category, points (count, 3) and normals (count, 3) of each.

    The normals of a noisy cloud are those of the clean points that it came from, as in PCPNet.
    """
    dense, dense_normals = surface.sample(DENSE_FACTOR * count, rng)
    clean, normals = dense[:count], dense_normals[:count]
    yield "none", clean, normals
    for level, sigma in NOISE_LEVELS.items():
        yield level, add_noise(clean, sigma, rng), normals
    patterns: tuple[Literal["gradient", "striped"], ...] = ("gradient", "striped")
    for pattern in patterns:
        kept = thin(dense, pattern, count, rng)
        yield pattern, dense[kept], dense_normals[kept]


def _mesh_shapes(folder: Path | None) -> list[_Shape]:
    """A shape for each mesh, named after its file; blanks, which separate the names in lists, become underscores."""
    if folder is None:
        return []
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    paths = meshes_in(folder)
    if not paths:
        raise InputError(f"{folder}: holds no meshes ({' '.join(MESH_SUFFIXES)})")
    named: dict[str, Path] = {}
    for path in paths:
        name = re.sub(r"\s+", "_", path.stem)
        if name in named:
            raise InputError(f"{path}: would become the shape {name}, as {named[name].name}; rename one of them")
        named[name] = path
    return [_Shape(name, partial(_load_mesh, path)) for name, path in named.items()]


def _load_mesh(path: Path, _: np.random.Generator) -> Surface:
    return MeshSampler(load_mesh(path))


def _solid_shapes(count: int) -> list[_Shape]:
    width = max(3, len(str(count)))
    return [_Shape(f"solid_{number:0{width}d}", random_solid) for number in range(1, count + 1)]


def _lists(names: dict[str, list[str]], split: Split) -> dict[str, list[str]]:
    """The clouds that each list of a split names, by the list's name in PCPNet."""
    everything = [name for members in names.values() for name in members]
    if split == "test":
        return {category.list_file: names[key] for key, category in CATEGORIES.items()} | {TEST_LIST: everything}
    noise = [name for category in ("none", *NOISE_LEVELS) for name in names[category]]
    return {
        f"{split}set_no_noise.txt": names["none"],
        f"{split}set_whitenoise.txt": noise,
        f"{split}set_vardensity_whitenoise.txt": everything,
    }


def _replaceable(folder: Path, overwrite: bool) -> list[str]:
    """The names of the files in a folder if it may be replaced: it is empty, or `write_dataset` wrote all it holds."""
    if not folder.is_dir():
        raise InputError(f"{folder}: exists and is no folder; choose another `out`")
    content = sorted(path.name for path in folder.iterdir())
    if content and not overwrite:
        raise InputError(f"{folder}: already exists; use `overwrite` to replace it or choose another `out`")
    marker = folder / MARKER
    lines = marker.read_text(errors="replace").splitlines() if marker.is_file() else []
    listed = lines[1:] if lines[:1] == [MARKER_TITLE] else []
    strange = [name for name in content if name not in (*listed, MARKER) or not (folder / name).is_file()]
    if strange:
        raise InputError(f"{folder}: holds what jetnormal did not write ({strange[0]}); choose another `out`")
    return content
