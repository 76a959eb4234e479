"""Writing of E57 files (`formats.e57`)."""

from __future__ import annotations

import hashlib
import re
import shutil
import tempfile
import uuid
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud
from jetnormal.formats.columns import COORDINATES, NORMALS, Columns, UniqueNames, columns_from_cloud
from jetnormal.formats.e57_tree import (
    CARTESIAN,
    FIELDS,
    NORMAL_FIELDS,
    NORMALS_URI,
    OWN_URI,
    SPHERICAL,
    Details,
    buffer_type,
    children_of,
    fill_blobs,
    node_of,
)
from jetnormal.formats.registry import WRITE_ADVICE, library_errors
from jetnormal.formats.scans import (
    SCAN,
    Pose,
    ScansExtra,
    quaternion_of,
    split_scans,
)
from jetnormal.formats.storage import COLORS, to_storable, unpack_colors
from jetnormal.support.extras import require

_STANDARD = frozenset((*SPHERICAL, "intensity", "returnIndex", "returnCount", "timeStamp", "isColorInvalid"))
_STANDARD |= {"isIntensityInvalid", "isTimeStampInvalid"}
_OURS = {ours: theirs for theirs, ours in FIELDS.items()}
_TYPES = frozenset(("i1", "i2", "i4", "i8", "u1", "u2", "u4", "f4", "f8"))


def write(cloud: Cloud, stream: BinaryIO, encoding: str) -> list[str]:
    """Write an E57 file with the scans that the cloud was read with, or one.

    Fields keep their type in the file; points and normals go into the frames of their scanners.

    Returns:
        What could not be kept.

    Raises:
        ResourceError: pye57 is missing.
    """
    e57 = require("pye57", "E57 output").libe57
    columns, renamed = columns_from_cloud(cloud, NORMALS, np.dtype(np.float32))
    columns = unpack_colors(columns) if cloud.source.format == "pcd" else columns
    columns, changed = to_storable(columns, _TYPES, vectors=False)
    extra = cloud.source.extra
    details = extra.details if isinstance(extra, ScansExtra) and isinstance(extra.details, Details) else None
    known = {name for fields in (details.fields if details else ()) for name in fields}
    columns, respelled = _respelled(columns, known)
    rows = np.flatnonzero(cloud.valid)
    warnings = []
    if len(rows) < len(cloud):
        warnings.append(f"{len(cloud) - len(rows)} points without finite coordinates cannot be held and are left out")
    scans = [(pose, part[cloud.valid[part]]) for pose, part in split_scans(cloud)]
    if isinstance(extra, ScansExtra) and len(scans) == len(extra.poses):
        columns.pop(SCAN, None)  # the scans themselves tell it
    place = Path(stream.name).parent if isinstance(stream.name, str) else None
    with tempfile.TemporaryDirectory(dir=place, prefix=".jetnormal-") as folder:  # the library wants a file of its own
        path = Path(folder) / "cloud.e57"
        with library_errors("E57 output", "pye57", WRITE_ADVICE):
            image = e57.ImageFile(str(path), "w")
            try:
                _write_image(e57, image, columns, scans, details)
            finally:
                image.close()
        with path.open("rb") as written:
            shutil.copyfileobj(written, stream)
    return warnings + renamed + changed + respelled


def _write_image(
    e57: Any, image: Any, columns: Columns, scans: list[tuple[Pose, NDArray[np.int64]]], details: Details | None
) -> None:
    image.extensionsAdd("", e57.E57_V1_0_URI)
    known = dict(details.extensions) if details else {}
    prefixes = {uri: prefix for prefix, uri in (known | {"nor": NORMALS_URI, "jn": OWN_URI}).items()}
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
        image.root().set(name, node_of(e57, image, tree))
        fill_blobs(e57, children_of(e57, image.root())[name], tree)
    vector = e57.VectorNode(image, True)
    image.root().set("data3D", vector)
    for index, (pose, rows) in enumerate(scans):
        guid = uuid.uuid5(identity, str(index))
        about = {"guid": ("StringNode", f"{{{guid}}}"), "name": ("StringNode", f"scan {index}")}
        about |= details.scans[index] if details else {}
        fields = details.fields[index] if details else {}
        part = {name: values[rows] for name, values in columns.items()}
        _write_scan(e57, image, vector, about, _local(part, pose), pose, fields, prefixes[OWN_URI])


def _identity(columns: Columns) -> uuid.UUID:
    """The same for the same points on any day, and different for others."""
    digest = hashlib.sha256()
    for name in COORDINATES:
        digest.update(np.ascontiguousarray(columns[name]).tobytes())
    return uuid.uuid5(uuid.NAMESPACE_OID, digest.hexdigest())


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
    node = node_of(e57, image, about)
    node.set("pose", node_of(e57, image, _pose_tree(pose)))
    for name, tree in _bounds(columns, about).items():
        node.set(name, node_of(e57, image, tree))
    stored = {_field_name(name, fields, own): np.ascontiguousarray(values) for name, values in columns.items()}
    prototype = {name: _field(e57, name, values, fields.get(name)) for name, values in stored.items()}
    points = e57.CompressedVectorNode(image, node_of(e57, image, prototype), e57.VectorNode(image, True))
    node.set("points", points)
    vector.append(node)
    count = len(columns["x"])
    buffers = e57.VectorSourceDestBuffer()
    held = [values.astype(buffer_type(values.dtype)) for values in stored.values()]
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


def _respelled(columns: Columns, known: Collection[str]) -> tuple[Columns, list[str]]:
    """Columns with names that XML allows, and a warning for each that changed; `known` are fields of the input."""
    unique = UniqueNames({*_OURS, *_STANDARD, *known})
    names = {}
    for name in columns:
        taken_as_it_is = name in _OURS or name in _STANDARD or name in known
        names[name] = name if taken_as_it_is else unique.add(re.sub(r"[^A-Za-z0-9_.-]|^(?![A-Za-z_])", "_", name))
    warnings = [f"attribute {name!r} is written as {new!r}" for name, new in names.items() if new != name]
    return {names[name]: values for name, values in columns.items()}, warnings


def _field_name(name: str, fields: dict[str, Any], own: str) -> str:
    """The format's name for a column; what the standard does not know stands in an extension of our own."""
    if name in _OURS:
        return _OURS[name]
    is_field = name in _STANDARD or name in fields
    return name if is_field and name not in FIELDS else f"{own}:{name}"  # an attribute may bear the name of another's


def _field(e57: Any, name: str, values: NDArray[Any], known: Any) -> Any:
    """How to store a column: as in the input where it fits, else by its type."""
    if known is not None and known[0] == "ScaledIntegerNode" and values.size and np.isfinite(values).all():
        _, _, low, high, scale, offset = known
        raw = np.rint((values.astype(np.float64) - offset) / scale)
        if np.abs(raw).max() < 2.0**53:
            return ("ScaledIntegerNode", 0, min(low, int(raw.min())), max(high, int(raw.max())), scale, offset)
    if known is not None and known[0] == "FloatNode" and name in (*CARTESIAN, *NORMAL_FIELDS):
        return ("FloatNode", 0.0, known[2])
    if values.dtype.kind in "iu":
        low, high = (int(values.min()), int(values.max())) if values.size else (0, 0)
        if known is not None and known[0] == "IntegerNode":
            low, high = min(low, known[2]), max(high, known[3])
        elif values.dtype.itemsize <= 2:  # as many bits as the type has, so that it is read as this type
            low, high = int(np.iinfo(values.dtype).min), int(np.iinfo(values.dtype).max)
        return ("IntegerNode", low, low, high)
    return ("FloatNode", 0.0, e57.E57_SINGLE if values.dtype == np.float32 else e57.E57_DOUBLE)
