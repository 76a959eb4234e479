"""Set of clouds in PCPNet's layout, drawn from meshes, procedural solids or scenes.

A shape gives PCPNet's six categories (clean points; the same points under three levels of noise; two clouds of uneven
density, a gradient and stripes), or scans by virtual scanners. A scene gives points sampled from it, or scans.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jetnormal.cloud import Cloud
from jetnormal.data.benchmark_shapes import (
    DrawnCloud,
    Shape,
    mesh_shapes,
    procedural_scene_shapes,
    scene_mesh_shapes,
    solid_shapes,
)
from jetnormal.data.options import DatasetOptions, Split
from jetnormal.errors import InputError, UsageError
from jetnormal.formats import write
from jetnormal.formats.atomic import atomic_folder
from jetnormal.formats.pcpnet import CATEGORIES, SENSOR_ATTRIBUTES, TEST_LIST, category_list, file_of, write_cloud
from jetnormal.support.report import progress

MARKER = ".jetnormal-dataset"  # lists the files of a folder that was written here: no others may be replaced
MARKER_TITLE = "# written by jetnormal dataset; its option --force replaces these files"


def write_dataset(
    folder: Path,
    options: DatasetOptions,
    *,
    meshes: Path | None = None,
    solids: int = 0,
    scene_meshes: Path | None = None,
    scenes: int = 0,
    scans: bool = False,
    overwrite: bool = False,
) -> list[str]:
    """Write clouds and lists of them. The same arguments give the same bytes.

    Everything is written beside the folder first, and takes its name when it is complete.

    Args:
        folder: to create; an empty one may exist.
        options: what is drawn.
        meshes: folder with meshes, each of which becomes a shape.
        solids: number of procedural solids, each of which becomes a shape.
        scene_meshes: folder with meshes of scenes, or with a folder for each as SceneNN has them.
        scenes: number of procedural scenes.
        scans: whether the clouds are scans by virtual scanners. NAME.ply then holds the points once more, with the
            place of the sensor of each.
        overwrite: whether a folder is replaced that this function wrote and that holds nothing else.

    Returns:
        Names of the clouds.

    Raises:
        UsageError: there is nothing to draw from.
        InputError: the folder exists or cannot be written, or a mesh cannot be used.
        ResourceError: Open3D, which casts the rays of the scanners, cannot be loaded.
    """
    shapes = mesh_shapes(meshes, scans) if meshes else []
    shapes += solid_shapes(solids, scans)
    shapes += scene_mesh_shapes(scene_meshes) if scene_meshes else []
    shapes += procedural_scene_shapes(scenes, scans)
    if not shapes:
        raise UsageError("there is nothing to draw points from: give a folder of meshes or a number of solids")
    old = _replaceable(folder, overwrite) if folder.exists() else []
    with atomic_folder(folder, old) as unfinished:
        names = _write_clouds(unfinished, shapes, options)
        for list_file, members in _lists(names, options.split).items():
            (unfinished / list_file).write_bytes("".join(f"{name}\n" for name in members).encode())
        listing = sorted(path.name for path in unfinished.iterdir())
        (unfinished / MARKER).write_bytes("".join(f"{line}\n" for line in (MARKER_TITLE, *listing)).encode())
    return [name for members in names.values() for name in members]


def _write_clouds(folder: Path, shapes: Sequence[Shape], options: DatasetOptions) -> dict[str, list[str]]:
    """The names of the clouds written, by category; PCPNet's come first."""
    names: dict[str, list[str]] = {category: [] for category in CATEGORIES}
    with progress("drawing", sum(shape.clouds for shape in shapes), "clouds") as advance:
        for index, shape in enumerate(shapes):
            rng = np.random.default_rng([options.seed, index])
            for cloud in shape.draw(options.points, rng):
                _write(folder, cloud, options.queries, rng)
                names.setdefault(cloud.category, []).append(cloud.name)
                advance(1)
    return {category: members for category, members in names.items() if members}


def _write(folder: Path, cloud: DrawnCloud, queries: int, rng: np.random.Generator) -> None:
    candidates = np.arange(len(cloud.points)) if cloud.labeled is None else np.flatnonzero(cloud.labeled)
    chosen = rng.choice(candidates, min(queries, len(candidates)), replace=False)
    write_cloud(folder, cloud.name, cloud.points, cloud.normals, np.sort(chosen))
    if cloud.sensors is not None:
        places = dict(zip(SENSOR_ATTRIBUTES, cloud.sensors.T, strict=True))
        write(Cloud(cloud.points, attributes=places), file_of(folder, cloud.name, "ply"))


def _lists(names: dict[str, list[str]], split: Split) -> dict[str, list[str]]:
    """The clouds that each list of a split names, by the list's name."""
    everything = [name for members in names.values() for name in members]
    if split == "test":
        return {category_list(category): members for category, members in names.items()} | {TEST_LIST: everything}
    uneven = ("gradient", "striped")
    lists = {
        f"{split}set_no_noise.txt": names.get("none", []),
        f"{split}set_whitenoise.txt": [n for category in names if category not in uneven for n in names[category]],
        f"{split}set_vardensity_whitenoise.txt": everything,
    }
    return {list_file: members for list_file, members in lists.items() if members}


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
