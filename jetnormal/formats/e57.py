"""E57, the ASTM format of terrestrial scans (E2807), through pye57's binding of libE57Format.

A file holds scans, each with the pose of its scanner. The points come into the common frame, and go back into those of
their scans. Normals are the extension ``nor:normalX nor:normalY nor:normalZ``
(http://www.libe57.org/E57_NOR_surface_normals.txt). Fields are read by their description in the file, so that none is
lost that pye57 itself does not know.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats.columns import COORDINATES, NORMALS, Columns, columns_from_cloud
from jetnormal.formats.registry import Format, library, library_errors
from jetnormal.formats.scans import (
    SCAN,
    Pose,
    Scan,
    ScansExtra,
    cloud_from_scans,
    quaternion_of,
    rotation_of,
    split_scans,
    stream_of_scans,
)
from jetnormal.formats.storage import COLORS, to_storable, unpack_colors
from jetnormal.formats.streams import CloudStream

ENCODINGS = ("binary",)

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
_NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
_OWN_URI = "urn:jetnormal:attributes"
_FIELDS = {
    **dict(zip(_CARTESIAN, COORDINATES, strict=True)),
    **dict(zip(_NORMALS, NORMALS, strict=True)),
    **dict(zip(("colorRed", "colorGreen", "colorBlue"), COLORS, strict=True)),
    "rowIndex": "row",
    "columnIndex": "column",
}
"""The format's names, and ours."""
_STANDARD = (*_FIELDS, *_SPHERICAL, "intensity", "returnIndex", "returnCount", "timeStamp")
_STANDARD += ("isColorInvalid", "isIntensityInvalid", "isTimeStampInvalid")
_RECOMPUTED = ("points", "pose", "cartesianBounds", "sphericalBounds", "pointGroupingSchemes")
_CHUNK = 1 << 20
_TYPES = frozenset(("i1", "i2", "i4", "i8", "u1", "u2", "u4", "f4", "f8"))


@dataclass(frozen=True)
class _Details:
    """What an E57 file held besides its points and poses: trees of values (`_tree`)."""

    root: dict[str, Any]
    scans: tuple[dict[str, Any], ...]
    fields: tuple[dict[str, Any], ...]
    """For each scan, how its fields were stored."""
    extensions: tuple[tuple[str, str], ...]

    def losses(self) -> list[str]:
        pictures = len(self.root["images2D"])
        return [f"{pictures} pictures are not kept"] if pictures else []


def read(path: Path) -> Cloud:
    """Read an E57 file: every scan and every field. Points that the file calls invalid are left out and counted.

    Raises:
        InputError: the file is no E57 file, is damaged, or pye57 is missing.
    """
    with _opened(path) as (e57, image, nodes):
        scans = [_read_scan(e57, image, node, path) for node in nodes]
        details = _read_details(e57, image, nodes)
    return cloud_from_scans(scans, Source(format="e57", encoding="binary"), path, details)


def stream(path: Path) -> CloudStream:
    """Open an E57 file to be read scan by scan.

    Raises:
        InputError: as `read`.
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
    e57 = library("pye57", "e57", path).libe57
    with library_errors(path, "pye57"):
        image = e57.ImageFile(str(path), "r")
        try:
            yield e57, image, list(_children(e57, _children(e57, image.root()).get("data3D")).values())
        finally:
            image.close()


def _children(e57: Any, node: Any) -> dict[str, Any]:
    """The children of a structure or vector, each as its own class."""
    if node is None or not isinstance(node, (e57.StructureNode, e57.VectorNode)):
        return {}
    kinds = {
        e57.E57_STRUCTURE: e57.StructureNode,
        e57.E57_VECTOR: e57.VectorNode,
        e57.E57_COMPRESSED_VECTOR: e57.CompressedVectorNode,
        e57.E57_INTEGER: e57.IntegerNode,
        e57.E57_SCALED_INTEGER: e57.ScaledIntegerNode,
        e57.E57_FLOAT: e57.FloatNode,
        e57.E57_STRING: e57.StringNode,
        e57.E57_BLOB: e57.BlobNode,
    }
    found = {}
    for index in range(node.childCount()):
        child = node.get(index)
        found[child.elementName()] = kinds[child.type()](child) if type(child) is e57.Node else child
    return found


def _tree(e57: Any, node: Any) -> Any:
    """A node's values without the library: a dict, a list, or the class of a node and its arguments."""
    if isinstance(node, e57.StructureNode):
        return {name: _tree(e57, child) for name, child in _children(e57, node).items()}
    if isinstance(node, e57.VectorNode):
        return [_tree(e57, child) for child in _children(e57, node).values()]
    if isinstance(node, e57.IntegerNode):
        return ("IntegerNode", node.value(), node.minimum(), node.maximum())
    if isinstance(node, e57.ScaledIntegerNode):
        return ("ScaledIntegerNode", node.rawValue(), node.minimum(), node.maximum(), node.scale(), node.offset())
    if isinstance(node, e57.FloatNode):
        return ("FloatNode", node.value(), node.precision(), node.minimum(), node.maximum())
    if isinstance(node, e57.StringNode):
        return ("StringNode", node.value())
    if isinstance(node, e57.BlobNode):
        data = np.empty(node.byteCount(), np.uint8)
        node.read(data, 0, len(data))
        return ("BlobNode", data)
    return None  # tables belong to the points and groups of them


def _read_details(e57: Any, image: Any, nodes: list[Any]) -> _Details:
    root = _children(e57, image.root())
    kept = ("guid", "coordinateMetadata", "creationDateTime", "images2D")
    extensions = [(image.extensionsPrefix(i), image.extensionsUri(i)) for i in range(image.extensionsCount())]
    scans, fields = [], []
    for node in nodes:
        children = _children(e57, node)
        scans.append({name: _tree(e57, child) for name, child in children.items() if name not in _RECOMPUTED})
        fields.append(_tree(e57, e57.StructureNode(children["points"].prototype())))
    return _Details(
        {"images2D": []} | {name: _tree(e57, root[name]) for name in kept if name in root},
        tuple(scans),
        tuple(fields),
        tuple((prefix, uri) for prefix, uri in extensions if prefix),
    )


def _read_scan(e57: Any, image: Any, node: Any, path: Path) -> Scan:
    children = _children(e57, node)
    points = children["points"]
    fields = _children(e57, e57.StructureNode(points.prototype()))
    kinds = {name: kind for name, field in fields.items() if (kind := _kind(e57, field)) is not None}
    columns, invalid = _read_points(e57, image, points, kinds, path)
    own = {image.extensionsPrefix(i) for i in range(image.extensionsCount()) if image.extensionsUri(i) == _OWN_URI}
    named = {_FIELDS.get(name, _without(own, name)): values for name, values in columns.items()}
    if not set(_CARTESIAN) <= set(columns):
        if not set(_SPHERICAL) <= set(columns):
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
    capacity = max(1, min(_CHUNK, points.childCount()))
    arrays = {name: np.empty(capacity, _buffer_type(kind)) for name, kind in kinds.items()}
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


def _buffer_type(kind: np.dtype[Any]) -> np.dtype[Any]:
    """What the library takes: integers of at most 2 bytes or C's long long, and floats.

    NumPy's int64 is C's long where that has 8 bytes, which the library takes for one of 4.
    """
    return np.dtype(np.longlong) if kind.kind in "iu" and kind.itemsize > 2 else kind


def _to_cartesian(columns: Columns) -> Columns:
    """Replace range, azimuth (from x to y) and elevation (from the xy plane)."""
    distance, azimuth, elevation = (columns.pop(name).astype(np.float64) for name in _SPHERICAL)
    level = distance * np.cos(elevation)
    place = (level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation))
    return dict(zip(COORDINATES, place, strict=True)) | columns


def _read_pose(e57: Any, node: Any) -> Pose:
    parts = _children(e57, node)
    rotation, translation = (
        {name: child.value() for name, child in _children(e57, parts.get(part)).items()}
        for part in ("rotation", "translation")
    )
    quaternion = [rotation.get(name, float(name == "w")) for name in "wxyz"]
    position = np.array([translation.get(name, 0.0) for name in "xyz"], dtype=np.float64)
    return Pose(rotation_of(quaternion), position)


def write(cloud: Cloud, stream: BinaryIO, encoding: str) -> list[str]:
    """Write an E57 file with the scans that the cloud was read with, or one.

    Fields keep their type in the file; points and normals go into the frames of their scanners.

    Returns:
        What could not be kept.
    """
    e57 = library("pye57", "e57", "E57 output").libe57
    columns, renamed = columns_from_cloud(cloud, NORMALS, np.dtype(np.float32))
    columns = unpack_colors(columns) if cloud.source.format == "pcd" else columns
    columns, changed = to_storable(columns, _TYPES, vectors=False)
    rows = np.flatnonzero(cloud.valid)
    warnings = []
    if len(rows) < len(cloud):
        warnings.append(f"{len(cloud) - len(rows)} points without finite coordinates cannot be held and are left out")
    extra = cloud.source.extra
    details = extra.details if isinstance(extra, ScansExtra) and isinstance(extra.details, _Details) else None
    scans = [(pose, part[cloud.valid[part]]) for pose, part in split_scans(cloud)]
    if isinstance(extra, ScansExtra) and len(scans) == len(extra.poses):
        columns.pop(SCAN, None)  # the scans themselves tell it
    place = Path(stream.name).parent if isinstance(stream.name, str) else None
    with tempfile.TemporaryDirectory(dir=place, prefix=".jetnormal-") as folder:  # the library wants a file of its own
        path = Path(folder) / "cloud.e57"
        image = e57.ImageFile(str(path), "w")
        try:
            _write_image(e57, image, columns, scans, details)
        finally:
            image.close()
        with path.open("rb") as written:
            shutil.copyfileobj(written, stream)
    return warnings + renamed + changed


def _write_image(
    e57: Any, image: Any, columns: Columns, scans: list[tuple[Pose, NDArray[np.int64]]], details: _Details | None
) -> None:
    image.extensionsAdd("", e57.E57_V1_0_URI)
    known = dict(details.extensions) if details else {}
    prefixes = {uri: prefix for prefix, uri in (known | {"nor": _NORMALS_URI, "jn": _OWN_URI}).items()}
    for uri, prefix in prefixes.items():
        image.extensionsAdd(prefix, uri)
    identity = _identity(columns)
    root = {
        "formatName": ("StringNode", "ASTM E57 3D Imaging Data File"),
        "guid": ("StringNode", f"{{{identity}}}"),
        "versionMajor": ("IntegerNode", e57.E57_FORMAT_MAJOR),
        "versionMinor": ("IntegerNode", e57.E57_FORMAT_MINOR),
        "e57LibraryVersion": ("StringNode", e57.E57_LIBRARY_ID),
        "coordinateMetadata": ("StringNode", ""),
        "images2D": [],
        **(details.root if details else {}),
    }
    for name, tree in root.items():
        image.root().set(name, _node(e57, image, tree))
        _fill_blobs(e57, _children(e57, image.root())[name], tree)
    vector = e57.VectorNode(image, True)
    image.root().set("data3D", vector)
    for index, (pose, rows) in enumerate(scans):
        guid = uuid.uuid5(identity, str(index))
        about = {"guid": ("StringNode", f"{{{guid}}}"), "name": ("StringNode", f"scan {index}")}
        about |= details.scans[index] if details else {}
        fields = details.fields[index] if details else {}
        part = {name: values[rows] for name, values in columns.items()}
        _write_scan(e57, image, vector, about, _local(part, pose), pose, fields, prefixes[_OWN_URI])


def _identity(columns: Columns) -> uuid.UUID:
    """The same for the same points on any day, and different for others."""
    digest = hashlib.sha256()
    for name in COORDINATES:
        digest.update(np.ascontiguousarray(columns[name]).tobytes())
    return uuid.uuid5(uuid.NAMESPACE_OID, digest.hexdigest())


def _node(e57: Any, image: Any, tree: Any) -> Any:
    """The node that `_tree` describes."""
    if isinstance(tree, dict):
        node = e57.StructureNode(image)
        for name, child in tree.items():
            if child is not None:
                node.set(name, _node(e57, image, child))
        return node
    if isinstance(tree, list):
        node = e57.VectorNode(image, True)
        for child in tree:
            if child is not None:
                node.append(_node(e57, image, child))
        return node
    kind, *arguments = tree
    if kind == "BlobNode":
        return e57.BlobNode(image, len(arguments[0]))
    return getattr(e57, kind)(image, *arguments)


def _fill_blobs(e57: Any, node: Any, tree: Any) -> None:
    """Write the bytes of blobs, which the library takes only once they have their place in the file."""
    if isinstance(tree, tuple) and tree[0] == "BlobNode":
        node.write(tree[1], 0, len(tree[1]))
    elif isinstance(tree, (dict, list)):
        children = _children(e57, node)
        for name, child in tree.items() if isinstance(tree, dict) else enumerate(filter(None, tree)):
            if child is not None:
                _fill_blobs(e57, children[str(name)], child)


def _local(columns: Columns, pose: Pose) -> Columns:
    local = dict(columns)
    for names, move in ((COORDINATES, pose.to_local), (NORMALS, Pose(pose.rotation.T).turn)):
        if all(name in columns for name in names):
            table = move(np.stack([columns[name] for name in names], axis=1).astype(np.float64))
            kinds = [np.dtype(np.float64) if pose.is_moved else columns[name].dtype for name in names]
            local |= {name: values.astype(kind) for name, values, kind in zip(names, table.T, kinds, strict=True)}
    return local


def _write_scan(
    e57: Any, image: Any, vector: Any, about: dict[str, Any], columns: Columns, pose: Pose, fields: Any, own: str
) -> None:
    node = _node(e57, image, about)
    node.set("pose", _node(e57, image, _pose_tree(pose)))
    for name, tree in _bounds(columns, about).items():
        node.set(name, _node(e57, image, tree))
    stored = {_field_name(name, fields, own): np.ascontiguousarray(values) for name, values in columns.items()}
    prototype = {name: _field(e57, name, values, fields.get(name)) for name, values in stored.items()}
    points = e57.CompressedVectorNode(image, _node(e57, image, prototype), e57.VectorNode(image, True))
    node.set("points", points)
    vector.append(node)
    count = len(columns["x"])
    buffers = e57.VectorSourceDestBuffer()
    held = [values.astype(_buffer_type(values.dtype)) for values in stored.values()]
    held = [values if count else np.empty(1, values.dtype) for values in held]  # the library wants some capacity
    for name, values in zip(stored, held, strict=True):
        buffers.append(e57.SourceDestBuffer(image, name, values, len(values), True, True))
    writer = points.writer(buffers)
    if count:
        writer.write(count)
    writer.close()


def _pose_tree(pose: Pose) -> dict[str, Any]:
    quaternion = quaternion_of(pose.rotation)
    return {
        "rotation": {name: ("FloatNode", float(value)) for name, value in zip("wxyz", quaternion, strict=True)},
        "translation": {name: ("FloatNode", float(value)) for name, value in zip("xyz", pose.translation, strict=True)},
    }


def _bounds(columns: Columns, about: dict[str, Any]) -> dict[str, Any]:
    """The limits that readers ask for: of the coordinates, and of colors and intensities where none are known."""

    def limits(name: str, kind: str, values: NDArray[Any]) -> dict[str, Any]:
        convert: Callable[[Any], Any] = int if kind == "IntegerNode" else float
        ends = (("Minimum", values.min()), ("Maximum", values.max())) if len(values) else ()
        return {f"{name}{end}": (kind, convert(value)) for end, value in ends}

    found: dict[str, Any] = {"cartesianBounds": {}}
    for name in COORDINATES:
        found["cartesianBounds"] |= limits(name, "FloatNode", columns[name])
    if "intensity" in columns and "intensityLimits" not in about:
        found["intensityLimits"] = limits("intensity", "FloatNode", columns["intensity"])
    if all(name in columns and columns[name].dtype.kind == "u" for name in COLORS) and "colorLimits" not in about:
        found["colorLimits"] = {}
        for name in COLORS:
            reach = np.array([0, np.iinfo(columns[name].dtype).max])
            found["colorLimits"] |= limits(f"color{name.capitalize()}", "IntegerNode", reach)
    if all(name in columns and columns[name].dtype.kind in "iu" for name in ("row", "column")) and (
        "indexBounds" not in about
    ):
        found["indexBounds"] = limits("row", "IntegerNode", columns["row"])
        found["indexBounds"] |= limits("column", "IntegerNode", columns["column"])
    return found


def _field_name(name: str, fields: dict[str, Any], own: str) -> str:
    """The format's name for a column; what the standard does not know stands in an extension of our own."""
    standard = {ours: theirs for theirs, ours in _FIELDS.items()}.get(name, name)
    if standard in _STANDARD or standard in fields:
        return standard
    return f"{own}:" + re.sub(r"[^A-Za-z0-9_.-]|^(?![A-Za-z_])", "_", name)


def _field(e57: Any, name: str, values: NDArray[Any], known: Any) -> Any:
    """How to store a column: as in the input where it fits, else by its type."""
    if known is not None and known[0] == "ScaledIntegerNode" and values.size and np.isfinite(values).all():
        _, _, low, high, scale, offset = known
        raw = np.rint((values.astype(np.float64) - offset) / scale)
        if np.abs(raw).max() < 2.0**53:
            return ("ScaledIntegerNode", 0, min(low, int(raw.min())), max(high, int(raw.max())), scale, offset)
    if known is not None and known[0] == "FloatNode" and name in (*_CARTESIAN, *_NORMALS):
        return ("FloatNode", 0.0, known[2])
    if values.dtype.kind in "iu":
        low, high = (int(values.min()), int(values.max())) if values.size else (0, 0)
        if known is not None and known[0] == "IntegerNode":
            low, high = min(low, known[2]), max(high, known[3])
        elif values.dtype.itemsize <= 2:  # as many bits as the type has, so that it is read as this type
            low, high = int(np.iinfo(values.dtype).min), int(np.iinfo(values.dtype).max)
        return ("IntegerNode", low, low, high)
    return ("FloatNode", 0.0, e57.E57_SINGLE if values.dtype == np.float32 else e57.E57_DOUBLE)


FORMATS = (
    Format("e57", (".e57",), read, write, ENCODINGS, keeps_viewpoint=True, stream=stream, stream_reads_all=True),
)
