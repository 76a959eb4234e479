"""Loops over a k-d tree, in which `neighbors` looks for the nearest points.

The tree is complete and has no pointers: node 1 is the root, and nodes 2 n and 2 n + 1 are the halves of node n, cut at
the median along its longest side. Of as many nodes as there are leaves, node `leaves` + i is leaf i, which holds the
points of one part of `order`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.support.compiled import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LEAF = 16  # points, at most: of 8 to 32, as quick as any
DEPTH = 64  # of a tree, at most


@compiled
def _bounds(points: Floats, start: Any, end: Any, low: Floats, high: Floats, node: Any) -> Any:
    """Write the box of the points from start to end, and return its longest side."""
    longest = 0
    for axis in range(3):
        least = most = points[start, axis]
        for i in range(start + 1, end):
            least = min(least, points[i, axis])
            most = max(most, points[i, axis])
        low[node, axis], high[node, axis] = least, most
        if most - least > high[node, longest] - low[node, longest]:
            longest = axis
    return longest


@compiled
def _cut(points: Floats, order: Ints, axis: Any, start: Any, end: Any, middle: Any) -> None:
    """Sort a part of the points so far that those before its middle lie below those after it (Hoare, 1961)."""
    left, right = start, end - 1
    while left < right:
        pivot = points[(left + right) // 2, axis]
        i, j = left, right
        while i <= j:
            while points[i, axis] < pivot:
                i += 1
            while points[j, axis] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                for each in range(3):
                    points[i, each], points[j, each] = points[j, each], points[i, each]
                i += 1
                j -= 1
        if middle <= j:
            right = j
        elif middle >= i:
            left = i
        else:
            left = right


@compiled
def grow(points: Floats, order: Ints, low: Floats, high: Floats) -> None:
    """Build a tree.

    Args:
        points: (N, 3), sorted here; there are no fewer than leaves.
        order: (N,) their rows, sorted with them.
        low, high: (2 leaves, 3) the boxes of the nodes, written here; leaves is a power of two.
    """
    count, leaves, nodes = len(points), len(low) // 2, 1
    while nodes <= leaves:  # of a level
        for number in range(nodes):
            start, end = count * number // nodes, count * (number + 1) // nodes
            axis = _bounds(points, start, end, low, high, nodes + number)
            if nodes < leaves:
                _cut(points, order, axis, start, end, count * (2 * number + 1) // (2 * nodes))
        nodes *= 2


@compiled
def _apart(low: Floats, high: Floats, node: Any, x: Any, y: Any, z: Any) -> Any:
    """The squared distance of a place from the box of a node."""
    a = max(max(low[node, 0] - x, x - high[node, 0]), 0.0)
    b = max(max(low[node, 1] - y, y - high[node, 1]), 0.0)
    c = max(max(low[node, 2] - z, z - high[node, 2]), 0.0)
    return a * a + b * b + c * c


@compiled
def _insert(near: Floats, found: Ints, q: Any, filled: Any, square: Any, point: Any) -> None:
    """Insert a point into row q, of which so many places are filled, by ascending (distance, index)."""
    r = min(filled, near.shape[1] - 1)
    while r > 0 and near[q, r - 1] > square:
        near[q, r] = near[q, r - 1]
        found[q, r] = found[q, r - 1]
        r -= 1
    while r > 0 and near[q, r - 1] == square and found[q, r - 1] > point:
        near[q, r] = near[q, r - 1]
        found[q, r] = found[q, r - 1]
        r -= 1
    near[q, r], found[q, r] = square, point


@compiled
def search(
    points: Floats, order: Ints, low: Floats, high: Floats, queries: Floats,
    ahead: Ints, apart: Floats, square: Floats, found: Ints, near: Floats,
) -> None:  # fmt: skip
    """Find the nearest points of each query, the nearer half of a node first.

    Args:
        points: (3, N) of the tree, in its order.
        order, low, high: of `grow`.
        queries: (Q, 3).
        ahead, apart: (DEPTH,) overwritten: the nodes still to be visited, and their squared distances.
        square: (LEAF,) overwritten.
        found, near: (Q, k) indices and distances, by ascending (distance, index), written here; k <= N.
    """
    count, leaves, k = len(order), len(low) // 2, near.shape[1]
    for q in range(len(queries)):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        farthest, filled, waiting = np.inf, 0, 1
        if q > 0:  # nothing that is found is farther than from the query before, with a margin for rounding
            a, b, c = x - queries[q - 1, 0], y - queries[q - 1, 1], z - queries[q - 1, 2]
            farthest = (near[q - 1, k - 1] + np.sqrt(a * a + b * b + c * c)) ** 2 * (1 + 1e-12)
        ahead[0], apart[0] = 1, 0.0
        while waiting > 0:
            waiting -= 1
            node, distance = ahead[waiting], apart[waiting]
            while node < leaves and distance <= farthest:
                node = 2 * node
                distance, other = _apart(low, high, node, x, y, z), _apart(low, high, node + 1, x, y, z)
                if other < distance:
                    distance, other = other, distance
                    node += 1
                if other <= farthest:
                    ahead[waiting], apart[waiting] = node ^ 1, other
                    waiting += 1
            if distance > farthest:
                continue
            start, end = count * (node - leaves) // leaves, count * (node - leaves + 1) // leaves
            for i in range(end - start):
                a, b, c = points[0, start + i] - x, points[1, start + i] - y, points[2, start + i] - z
                square[i] = a * a + b * b + c * c
            for i in range(end - start):
                point = order[start + i]
                if square[i] > farthest or (filled >= k and square[i] == near[q, k - 1] and point > found[q, k - 1]):
                    continue
                _insert(near, found, q, filled, square[i], point)
                filled += 1
                if filled >= k:
                    farthest = min(farthest, near[q, k - 1])
        for r in range(k):
            near[q, r] = np.sqrt(near[q, r])
