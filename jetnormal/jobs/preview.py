"""Pictures of a cloud or a mesh in a file, and a page in which it turns."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal import formats
from jetnormal.cloud import Cloud
from jetnormal.errors import InputError, ResourceError, UsageError
from jetnormal.formats import atomic
from jetnormal.formats.meshes import MESH_SUFFIXES, read_mesh
from jetnormal.formats.ply_header import read_header
from jetnormal.jobs.files import check_format, read_file
from jetnormal.jobs.memory import SHARE, machine_memory
from jetnormal.jobs.options import PreviewOptions, ReadOptions
from jetnormal.mesh import Mesh
from jetnormal.rendering.light import BACKGROUNDS
from jetnormal.rendering.scene import Scene, cloud_scene, mesh_scene
from jetnormal.rendering.upright import guess_up
from jetnormal.support.report import StageTimer

SUPERSAMPLING = 2
BYTES_PER_PIXEL = 1000  # while a view is drawn, four pixels for one
BYTES_PER_FINISHED_PIXEL = 20  # of each view, until the picture is written
GAP = 0.03  # between views, of the size
ROW = 3  # pictures that stand in one row; more make a square


def preview_file(
    source: Path,
    picture: Path | None,
    page: Path | None,
    options: PreviewOptions,
    files: ReadOptions = ReadOptions(),  # noqa: B008 - frozen
    *,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Draw a cloud or a mesh.

    Args:
        source: a cloud, or a mesh: .obj, .stl, .off, .glb, .gltf, .npz, or .ply with faces.
        picture: the PNG file to write, or None.
        page: the HTML file to write, or None.
        options: how.
        files: how a cloud is read.
        overwrite: whether existing files may be replaced.

    Returns:
        A summary: input, picture, page, points (or vertices), faces (0 for a cloud), seconds (by stage).

    Raises:
        InputError: a file cannot be read or written, or there is nothing to draw.
        UsageError: neither a picture nor a page is asked for.
        ResourceError: the picture is of a mesh, and Open3D is not there; or it is larger than memory.
    """
    if picture is None and page is None:
        raise UsageError("give `output` (a picture, .png) or `html` (a page), or both")
    for target, suffixes in ((picture, (".png",)), (page, (".html", ".htm"))):
        if target is not None:
            if target.suffix.lower() not in suffixes:
                raise InputError(f"{target}: {target.suffix!r} is not {' or '.join(suffixes)}")
            atomic.check_target(target, overwrite)
    if picture is not None:
        _check_memory(options)
    check_format(files, source)
    timer = StageTimer()
    with timer.stage("read"):
        subject = _read(source, files)
    try:
        up = guess_up(_places(subject)) if options.up == "auto" else np.array(options.up)
        scenes = [_scene(subject, colors).turned_up(up) for colors in options.colors]
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    if picture is not None:
        from jetnormal.rendering.png import encode_png

        with timer.stage("picture"):
            content = encode_png(draw(scenes, options))
        _write(picture, content, overwrite)
    if page is not None:
        from jetnormal.rendering.page import encode_page

        with timer.stage("page"):
            content = encode_page(scenes[0], source.name, options.views[0], options.background)
        _write(page, content, overwrite)
    return {
        "input": str(source),
        "picture": None if picture is None else str(picture),
        "page": None if page is None else str(page),
        "points": len(subject.vertices if isinstance(subject, Mesh) else subject),
        "faces": len(subject.faces) if isinstance(subject, Mesh) else 0,
        "seconds": timer.seconds,
    }


def _check_memory(options: PreviewOptions) -> None:
    """Refuse a picture that is larger than memory, before any work is done."""
    views = len(options.views) * len(options.colors)
    needed = options.size**2 * (BYTES_PER_PIXEL + views * BYTES_PER_FINISHED_PIXEL)
    limit = SHARE * machine_memory()
    if needed > limit:
        raise ResourceError(
            f"`size={options.size}` would take up to {needed / 1e9:.2g} GB of memory, more than {limit / 1e9:.2g} GB; "
            "choose a smaller one"
        )


def draw(scenes: list[Scene], options: PreviewOptions) -> NDArray[np.uint8]:
    """Draw all views of all scenes in a grid, (H, W, 3); a row for each scene if there are several of both."""
    from jetnormal.rendering.camera import make_camera, view_direction
    from jetnormal.rendering.light import develop
    from jetnormal.rendering.surfels import see

    images = []
    for scene, view in itertools.product(scenes, options.views):
        towards = view_direction(view, scene.points, scene.normals)
        camera = make_camera(scene.points, towards, options.size * SUPERSAMPLING)
        images.append(develop(see(scene, camera), camera, scene.radius, SUPERSAMPLING, options.background))
    background = np.round(np.array(BACKGROUNDS[options.background]) * 255).astype(np.uint8)
    return in_grid(images, _columns(len(scenes), len(options.views)), background, round(GAP * options.size))


def _columns(scenes: int, views: int) -> int:
    if scenes > 1 and views > 1:
        return views
    count = scenes * views
    return count if count <= ROW else math.ceil(math.sqrt(count))


def in_grid(
    images: list[NDArray[np.uint8]], columns: int, background: NDArray[np.uint8], gap: int
) -> NDArray[np.uint8]:
    """Join images (h, w, 3) of any sizes into one, (H, W, 3), each in the middle of its cell."""
    rows = [images[start : start + columns] for start in range(0, len(images), columns)]
    widths = [
        max(row[column].shape[1] for row in rows if column < len(row)) for column in range(min(columns, len(images)))
    ]
    heights = [max(image.shape[0] for image in row) for row in rows]
    picture = np.empty((sum(heights) + gap * (len(rows) - 1), sum(widths) + gap * (len(widths) - 1), 3), dtype=np.uint8)
    picture[:] = background
    top = 0
    for row, height in zip(rows, heights, strict=True):
        left = 0
        for image, width in zip(row, widths, strict=False):
            y, x = top + (height - image.shape[0]) // 2, left + (width - image.shape[1]) // 2
            picture[y : y + image.shape[0], x : x + image.shape[1]] = image
            left += width + gap
        top += height + gap
    return picture


def _places(subject: Cloud | Mesh) -> NDArray[np.float64]:
    return subject.vertices if isinstance(subject, Mesh) else subject.points[subject.valid]


def _scene(subject: Cloud | Mesh, coloring: str) -> Scene:
    return mesh_scene(subject, coloring) if isinstance(subject, Mesh) else cloud_scene(subject, coloring)


def _read(path: Path, files: ReadOptions) -> Cloud | Mesh:
    """The mesh in a file, or the cloud if it is one."""
    suffix = path.suffix.lower()
    if (suffix in formats.suffixes() or files.format is not None) and not (suffix == ".ply" and _has_faces(path)):
        return read_file(path, files)
    if suffix not in MESH_SUFFIXES:
        known = sorted({*formats.suffixes(), *MESH_SUFFIXES})
        raise InputError(f"{path}: unknown suffix {path.suffix!r}; supported are {' '.join(known)}")
    return read_mesh(path)


def _has_faces(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            elements = read_header(stream, path).elements
    except OSError:
        return False  # reading the cloud tells what is wrong
    return any(element.name == "face" and element.count for element in elements)


def _write(path: Path, content: bytes, overwrite: bool) -> None:
    with atomic.atomic_write(path, overwrite=overwrite) as stream:
        stream.write(content)
