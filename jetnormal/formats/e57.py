"""E57, the ASTM format of terrestrial scans (E2807), through pye57's binding of libE57Format.

A file holds scans, each with the pose of its scanner. The points come into the common frame, and go back into those of
their scans. Normals are the extension ``nor:normalX nor:normalY nor:normalZ``
(http://www.libe57.org/E57_NOR_surface_normals.txt). Fields are read by their description in the file, so that none is
lost that pye57 itself does not know.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats.columns import COORDINATES, Columns
from jetnormal.formats.e57_tree import (
    CARTESIAN,
    FIELDS,
    OWN_URI,
    SPHERICAL,
    Details,
    buffer_type,
    children_of,
    tree_of,
)
from jetnormal.formats.e57_writer import write
from jetnormal.formats.registry import Format, library_errors
from jetnormal.formats.scans import (
    Pose,
    Scan,
    cloud_from_scans,
    rotation_of,
    stream_of_scans,
)
from jetnormal.formats.storage import COLORS
from jetnormal.formats.streams import CloudStream
from jetnormal.support.extras import require

ENCODINGS = ("binary",)

_RECOMPUTED = ("points", "pose", "cartesianBounds", "sphericalBounds", "pointGroupingSchemes")
_CHUNK = 1 << 20


def read(path: Path) -> Cloud:
    """Read an E57 file: every scan and every field. Points that the file calls invalid are left out and counted.

    Raises:
        InputError: the file is no E57 file, or is damaged.
        ResourceError: pye57 is missing.
    """
    with _opened(path) as (e57, image, nodes):
        scans = [_read_scan(e57, image, node, path) for node in nodes]
        details = _read_details(e57, image, nodes)
    return cloud_from_scans(scans, Source(format="e57", encoding="binary"), path, details)


def stream(path: Path) -> CloudStream:
    """Open an E57 file to be read scan by scan.

    Raises:
        InputError, ResourceError: as `read`.
    """
    with _opened(path) as (e57, image, nodes):
        details = _read_details(e57, image, nodes)

    def scans() -> Iterator[Scan]:
        with _opened(path) as (e57, image, nodes):
            for node in nodes:
                yield _read_scan(e57, image, node, path)

    return stream_of_scans(scans, Source(format="e57", encoding="binary"), path, details)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any, list[Any]]]:
    """The library, an open file, and the nodes of its scans."""
    with path.open("rb") as stream:
        if stream.read(8) != b"ASTM-E57":
            raise InputError(f"{path}: does not begin with 'ASTM-E57'; is this an E57 file?")
    e57 = require("pye57", str(path)).libe57
    with library_errors(path, "pye57"):
        image = e57.ImageFile(str(path), "r")
        try:
            yield e57, image, list(children_of(e57, children_of(e57, image.root()).get("data3D")).values())
        finally:
            image.close()


def _read_details(e57: Any, image: Any, nodes: list[Any]) -> Details:
    root = children_of(e57, image.root())
    kept = ("guid", "coordinateMetadata", "creationDateTime", "images2D")
    extensions = [(image.extensionsPrefix(i), image.extensionsUri(i)) for i in range(image.extensionsCount())]
    scans, fields = [], []
    for node in nodes:
        children = children_of(e57, node)
        scans.append({name: tree_of(e57, child) for name, child in children.items() if name not in _RECOMPUTED})
        fields.append(tree_of(e57, e57.StructureNode(children["points"].prototype())))
    return Details(
        {"images2D": []} | {name: tree_of(e57, root[name]) for name in kept if name in root},
        tuple(scans),
        tuple(fields),
        tuple((prefix, uri) for prefix, uri in extensions if prefix),
    )


def _read_scan(e57: Any, image: Any, node: Any, path: Path) -> Scan:
    children = children_of(e57, node)
    points = children["points"]
    fields = children_of(e57, e57.StructureNode(points.prototype()))
    kinds = {name: kind for name, field in fields.items() if (kind := _kind(e57, field)) is not None}
    columns, invalid = _read_points(e57, image, points, kinds, path)
    own = {image.extensionsPrefix(i) for i in range(image.extensionsCount()) if image.extensionsUri(i) == OWN_URI}
    named = {FIELDS.get(name, _without(own, name)): values for name, values in columns.items()}
    if not set(CARTESIAN) <= set(columns):
        if not set(SPHERICAL) <= set(columns):
            raise InputError(f"{path}: a scan has no coordinates, neither cartesian nor spherical")
        named = _to_cartesian(named)
    for name in COLORS:
        values = named.get(name)
        if (
            values is not None
            and values.dtype.kind in "iu"
            and values.size
            and 0 <= values.min() <= values.max() < 2**16
        ):
            named[name] = values.astype(np.uint8 if values.max() <= 255 else np.uint16, copy=False)
    return Scan(named, _read_pose(e57, children.get("pose")), invalid)


def _without(prefixes: set[str], name: str) -> str:
    prefix, _, rest = name.rpartition(":")
    return rest if prefix in prefixes else name


def _kind(e57: Any, field: Any) -> np.dtype[Any] | None:
    """The type of the numbers of a field, None if it holds none."""
    if isinstance(field, e57.IntegerNode):
        low, high = field.minimum(), field.maximum()
        return np.dtype(np.min_scalar_type(high if low >= 0 else min(low, -high - 1)))
    if isinstance(field, e57.FloatNode):
        return np.dtype(np.float32 if field.precision() == e57.E57_SINGLE else np.float64)
    return np.dtype(np.float64) if isinstance(field, e57.ScaledIntegerNode) else None


def _read_points(e57: Any, image: Any, points: Any, kinds: dict[str, np.dtype[Any]], path: Path) -> tuple[Columns, int]:
    """The fields of all valid points, and how many are invalid."""
    if points.childCount() == 0:  # which libE57Format has no reader for
        return {name: np.empty(0, kind) for name, kind in kinds.items()}, 0
    capacity = min(_CHUNK, points.childCount())
    arrays = {name: np.empty(capacity, buffer_type(kind)) for name, kind in kinds.items()}
    buffers = e57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(e57.SourceDestBuffer(image, name, array, capacity, True, True))
    flag = next((name for name in ("cartesianInvalidState", "sphericalInvalidState") if name in kinds), None)
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in kinds if name != flag}
    invalid = total = 0
    reader = points.reader(buffers)
    try:
        while count := reader.read():
            total += count
            valid = np.ones(count, bool) if flag is None else arrays[flag][:count] == 0
            invalid += int(np.sum(~valid))
            for name, chunks in parts.items():
                chunks.append(arrays[name][:count][valid].astype(kinds[name], copy=False))
    finally:
        reader.close()
    if total != points.childCount():
        raise InputError(f"{path}: declares {points.childCount()} points but holds {total}; is it truncated?")
    empty = {name: np.empty(0, kinds[name]) for name in parts}
    return {name: np.concatenate(chunks) if chunks else empty[name] for name, chunks in parts.items()}, invalid


def _to_cartesian(columns: Columns) -> Columns:
    """Replace range, azimuth (from x to y) and elevation (from the xy plane)."""
    distance, azimuth, elevation = (columns.pop(name).astype(np.float64) for name in SPHERICAL)
    level = distance * np.cos(elevation)
    place = (level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation))
    return dict(zip(COORDINATES, place, strict=True)) | columns


def _read_pose(e57: Any, node: Any) -> Pose:
    parts = children_of(e57, node)
    rotation, translation = (
        {name: child.value() for name, child in children_of(e57, parts.get(part)).items()}
        for part in ("rotation", "translation")
    )
    quaternion = [rotation.get(name, float(name == "w")) for name in "wxyz"]
    position = np.array([translation.get(name, 0.0) for name in "xyz"], dtype=np.float64)
    return Pose(rotation_of(quaternion), position)


FORMATS = (
    Format("e57", (".e57",), read, write, ENCODINGS, keeps_viewpoint=True, stream=stream, stream_reads_all=True),
)
