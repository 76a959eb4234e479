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
    whose doubts fall into the same one of the buckets keep their order.
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
            j, squared = neighbors[i, place], 0.0
            for axis in range(3):
                squared += (points[j, axis] - points[i, axis]) ** 2
            length = np.sqrt(squared) / (radius[i] + radius[j])
            doubt = 1 - agreement + length_weight * length
            number = buckets if agreement < least else min(int(max(doubt, 0.0) * scale), buckets - 1)
            bucket[i * count + place] = number
            filled[number] += 1


@compiled
def _sort_by_bucket(bucket: NDArray[np.uint16], start: Ints, order: NDArray[Any]) -> None:
    """Write the edges of all buckets but the last, one bucket after the other; start says where each begins."""
    for edge in range(len(bucket)):
        if bucket[edge] < len(start) - 1:
            order[start[bucket[edge]]] = edge
            start[bucket[edge]] += 1


@compiled
def join_edges(
    order: NDArray[Any], neighbors: Neighbors, edges: Edges, largest: int, size: Ints, root: Ints, flips: Bools
) -> None:
    """Join the ends of edges to trees of at most `largest` points.

    order (E,): rows of the flat array of edges (N, k), which are negative where the signs of a point and its neighbor
    (N, k) differ. size (N,): at first 1. root (N,): at first each point itself, at last the root of its tree; flips
    (N,), at first False: whether a point's sign is opposite to its root's.
    """
    for number in range(len(order)):
        edge = np.int64(order[number])
        i, place = edge // neighbors.shape[1], edge % neighbors.shape[1]
        a, odd_a = i, False
        while root[a] != a:
            odd_a ^= flips[a]
            a = root[a]
        b, odd_b = neighbors[i, place], False
        while root[b] != b:
            odd_b ^= flips[b]
            b = root[b]
        for end, top, odd in ((i, a, odd_a), (np.int64(neighbors[i, place]), b, odd_b)):
            if end != top:  # the next climb from here is short
                root[end], flips[end] = top, odd
        if a == b or size[a] + size[b] > largest:
            continue
        if size[a] < size[b] or (size[a] == size[b] and b < a):
            a, b = b, a
        root[b] = a
        flips[b] = odd_a ^ odd_b ^ (edges[i, place] < 0)
        size[a] += size[b]
    for i in range(len(root)):  # trees are at most as deep as the logarithm of their size
        a, odd = i, False
        while root[a] != a:
            odd ^= flips[a]
            a = root[a]
        flips[i] = odd  # a flattened tree: what comes later still climbs through i to a, with the right parity
        root[i] = a
