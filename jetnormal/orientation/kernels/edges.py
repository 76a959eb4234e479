"""Loops over the edges between points and their neighbors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.support.compiled import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Edges = NDArray[np.float32]
Neighbors = NDArray[np.int32]
Bools = NDArray[np.bool_]


def third_smallest_height(points: Floats, normals: Floats, neighbors: Neighbors) -> Floats:
    """Find the third smallest height (N,) of the neighbors (N, k), k >= 3, over each point's tangent plane."""
    result = np.empty(len(points))
    _third_smallest_height(points, normals, neighbors, result)
    return result


@compiled
def _third_smallest_height(points: Floats, normals: Floats, neighbors: Neighbors, result: Floats) -> None:
    for i in range(len(points)):
        first, second, third = np.inf, np.inf, np.inf
        for j in neighbors[i]:
            height = 0.0
            for axis in range(3):
                height += normals[i, axis] * (points[j, axis] - points[i, axis])
            height = abs(height)
            if height < first:
                first, second, third = height, first, second
            elif height < second:
                second, third = height, second
            elif height < third:
                third = height
        result[i] = third


@compiled
def edge_agreement(
    points: Floats,
    normals: Floats,
    roughness: Floats,
    radius: Floats,
    neighbors: Neighbors,
    scale: float,
    bridge: float,
    out: Edges,
) -> None:
    """Write how sure the signs of i and its neighbor j agree (1: surely, 0: unknown, -1: surely not) to out (N, k).

    n_j is mirrored in the bisector plane of the edge e before it is compared with n_i, which gives
    n_i.n_j - 2 (n_i.e)(n_j.e) / |e|^2; roughness adds to |e|^2. An edge longer than `bridge` times the radius (N,) of j
    tells nothing.
    """
    for i in range(len(points)):
        for place in range(neighbors.shape[1]):
            j = neighbors[i, place]
            squared, along_i, along_j, dot = 0.0, 0.0, 0.0, 0.0
            for axis in range(3):
                step = points[j, axis] - points[i, axis]
                squared += step * step
                along_i += normals[i, axis] * step
                along_j += normals[j, axis] * step
                dot += normals[i, axis] * normals[j, axis]
            blur = scale * (roughness[i] + roughness[j])
            agreement = dot - 2 * along_i * along_j / (squared + blur * blur)
            out[i, place] = agreement if squared <= (bridge * radius[j]) ** 2 else 0.0


@compiled
def turn_all(flips: Bools, neighbors: Neighbors, normals: Floats, edges: Edges) -> None:
    """Turn the normals (N, 3) that are to flip (N,), and the agreement (N, k) of the edges that join one to another."""
    for i in range(len(flips)):
        if flips[i]:
            for axis in range(3):
                normals[i, axis] = -normals[i, axis]
        for place in range(neighbors.shape[1]):
            if flips[i] != flips[neighbors[i, place]]:
                edges[i, place] = -edges[i, place]


def edge_votes(edges: Edges) -> tuple[Floats, Floats]:
    """Sum the squares of the edges of each point, with their signs (N,) and without (N,)."""
    net, total = np.zeros(len(edges)), np.zeros(len(edges))
    _add_votes(edges, net, total)
    return net, total


@compiled
def _add_votes(edges: Edges, net: Floats, total: Floats) -> None:
    for i in range(len(edges)):
        for place in range(edges.shape[1]):
            edge = float(edges[i, place])
            net[i] += edge * abs(edge)
            total[i] += edge * edge


def surest_first(
    points: Floats, edges: Edges, radius: Floats, neighbors: Neighbors, least: float, length_weight: float, buckets: int
) -> NDArray[Any]:
    """Find the order of the edges (N, k) of least agreement or more, as rows of the flat array, the surest first.

    An edge's doubt is 1 - |agreement|, plus `length_weight` times its length over the radii (N,) of its ends. Edges
    whose doubts fall into the same one of the buckets keep their order. Of two points that are neighbors of each
    other, one edge is taken, that of the first.
    """
    bucket, filled = np.empty(edges.size, np.uint16), np.zeros(buckets + 1, np.int64)
    _fill_buckets(points, edges, radius, neighbors, least, length_weight, bucket, filled)
    order = np.empty(filled[:buckets].sum(), np.uint32 if edges.size < 2**32 else np.int64)
    _sort_by_bucket(bucket, np.cumsum(filled) - filled, order)
    return order


@compiled
def _fill_buckets(
    points: Floats, edges: Edges, radius: Floats, neighbors: Neighbors, least: float, length_weight: float,
    bucket: NDArray[np.uint16], filled: Ints,
) -> None:  # fmt: skip
    """Write the bucket of each edge, the last one for those that are left out, and how many each bucket has."""
    count, buckets = edges.shape[1], len(filled) - 1
    scale = buckets / (1 - least + length_weight)
    for i in range(len(edges)):
        for place in range(count):
            agreement = abs(float(edges[i, place]))
            j, squared, taken = neighbors[i, place], 0.0, agreement >= least
            for axis in range(3):
                squared += (points[j, axis] - points[i, axis]) ** 2
            if taken and j < i:
                for back in range(count):
                    taken &= neighbors[j, back] != i or abs(edges[j, back]) < least
            length = np.sqrt(squared) / (radius[i] + radius[j])
            doubt = 1 - agreement + length_weight * length
            number = min(int(max(doubt, 0.0) * scale), buckets - 1) if taken else buckets
            bucket[i * count + place] = number
            filled[number] += 1


@compiled
def _sort_by_bucket(bucket: NDArray[np.uint16], start: Ints, order: NDArray[Any]) -> None:
    """Write the edges of all buckets but the last, one bucket after the other; start says where each begins."""
    for edge in range(len(bucket)):
        if bucket[edge] < len(start) - 1:
            order[start[bucket[edge]]] = edge
            start[bucket[edge]] += 1


def join_edges(order: NDArray[Any], neighbors: Neighbors, edges: Edges, largest: int) -> tuple[Ints, Bools]:
    """Join the ends of edges to trees of at most `largest` points.

    Args:
        order: (E,) rows of the flat array of edges (N, k), which are negative where the signs of a point and its
            neighbor (N, k) differ.
        neighbors, edges: (N, k).
        largest: points of a tree.

    Returns:
        The root of each point's tree (N,), and whether its sign is opposite to its root's (N,).
    """
    kind = np.int32 if len(edges) < 2**30 else np.int64
    size = np.ones(len(edges), kind)
    up: NDArray[Any] = 2 * np.arange(len(edges), dtype=kind)
    _join_edges(order, neighbors, edges, largest, size, up)
    return up >> 1, (up & 1).astype(np.bool_)


@compiled
def _climb(up: NDArray[Any], i: Any) -> Any:
    """The root of i, in the form of `_join_edges`."""
    top = np.int64(up[i])
    while up[top >> 1] >> 1 != top >> 1:
        top = up[top >> 1] ^ (top & 1)
    return top


@compiled
def _join_edges(
    order: NDArray[Any], neighbors: Neighbors, edges: Edges, largest: int, size: NDArray[Any], up: NDArray[Any]
) -> None:
    """`join_edges`. up (N,): twice the number of a point above each, plus 1 where their signs are opposite; at first
    twice its own, at last twice its root's. size (N,): at first 1."""
    for number in range(len(order)):
        edge = np.int64(order[number])
        i, place = edge // neighbors.shape[1], edge % neighbors.shape[1]
        j = np.int64(neighbors[i, place])
        one, other = _climb(up, i), _climb(up, j)
        up[i], up[j] = one, other  # the next climb from here is short
        a, b = one >> 1, other >> 1
        if a == b or size[a] + size[b] > largest:
            continue
        if size[a] < size[b] or (size[a] == size[b] and b < a):
            a, b = b, a
        up[b] = 2 * a + ((one ^ other ^ (edges[i, place] < 0)) & 1)
        size[a] += size[b]
    for i in range(len(up)):  # trees are at most as deep as the logarithm of their size
        up[i] = _climb(up, i)
