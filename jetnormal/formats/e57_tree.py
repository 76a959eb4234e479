"""The nodes of an E57 file as trees of Python values, and the names of its fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jetnormal.formats.columns import COORDINATES, NORMALS
from jetnormal.formats.storage import COLORS

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
NORMAL_FIELDS = ("nor:normalX", "nor:normalY", "nor:normalZ")
NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
OWN_URI = "urn:jetnormal:attributes"
FIELDS = {
    **dict(zip(CARTESIAN, COORDINATES, strict=True)),
    **dict(zip(NORMAL_FIELDS, NORMALS, strict=True)),
    **dict(zip(("colorRed", "colorGreen", "colorBlue"), COLORS, strict=True)),
    "rowIndex": "row",
    "columnIndex": "column",
}
"""The format's names, and ours."""


@dataclass(frozen=True)
class Details:
    """What an E57 file held besides its points and poses: trees of values (`tree_of`)."""

    root: dict[str, Any]
    scans: tuple[dict[str, Any], ...]
    fields: tuple[dict[str, Any], ...]
    """For each scan, how its fields were stored."""
    extensions: tuple[tuple[str, str], ...]

    def losses(self) -> list[str]:
        """Name what other formats cannot hold."""
        pictures = len(self.root["images2D"])
        return [f"{pictures} pictures are not kept"] if pictures else []


def children_of(e57: Any, node: Any) -> dict[str, Any]:
    """Return the children of a structure or vector, each as its own class."""
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


def tree_of(e57: Any, node: Any) -> Any:
    """Return a node's values without the library: a dict, a list, or the class of a node and its arguments."""
    if isinstance(node, e57.StructureNode):
        return {name: tree_of(e57, child) for name, child in children_of(e57, node).items()}
    if isinstance(node, e57.VectorNode):
        return [tree_of(e57, child) for child in children_of(e57, node).values()]
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


def buffer_type(kind: np.dtype[Any]) -> np.dtype[Any]:
    """Find what the library takes: integers of at most 2 bytes or C's long long, and floats.

    NumPy's int64 is C's long where that has 8 bytes, which the library takes for one of 4.
    """
    return np.dtype(np.longlong) if kind.kind in "iu" and kind.itemsize > 2 else kind


def node_of(e57: Any, image: Any, tree: Any) -> Any:
    """Return the node that `tree_of` describes."""
    if isinstance(tree, dict):
        node = e57.StructureNode(image)
        for name, child in tree.items():
            if child is not None:
                node.set(name, node_of(e57, image, child))
        return node
    if isinstance(tree, list):
        node = e57.VectorNode(image, True)
        for child in tree:
            if child is not None:
                node.append(node_of(e57, image, child))
        return node
    kind, *arguments = tree
    if kind == "BlobNode":
        return e57.BlobNode(image, len(arguments[0]))
    return getattr(e57, kind)(image, *arguments)


def fill_blobs(e57: Any, node: Any, tree: Any) -> None:
    """Write the bytes of blobs, which the library takes only once they have their place in the file."""
    if isinstance(tree, tuple) and tree[0] == "BlobNode":
        node.write(tree[1], 0, len(tree[1]))
    elif isinstance(tree, (dict, list)):
        children = children_of(e57, node)
        for name, child in tree.items() if isinstance(tree, dict) else enumerate(filter(None, tree)):
            if child is not None:
                fill_blobs(e57, children[str(name)], child)
