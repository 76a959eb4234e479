"""Compiled loops over points and edges. They run in one thread, so that results do not depend on the threads.

Arrays are C-contiguous: float64 unless said otherwise, indices int64; the edges of N points to k neighbors are float32,
and the neighbors int32.
"""

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


@compiled
def third_smallest_height(points: Floats, normals: Floats, neighbors: Neighbors) -> Any:
    """Find the third smallest height (N,) of the neighbors (N, k), k >= 3, over each point's tangent plane."""
    result = np.empty(len(points))
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
    return result


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


@compiled
def edge_votes(edges: Edges) -> Any:
    """Sum the squares of the edges of each point, with their signs (N,) and without (N,)."""
    net, total = np.zeros(len(edges)), np.zeros(len(edges))
    for i in range(len(edges)):
        for place in range(edges.shape[1]):
            edge = float(edges[i, place])
            net[i] += edge * abs(edge)
            total[i] += edge * edge
    return net, total


@compiled
def surest_first(
    points: Floats, edges: Edges, radius: Floats, neighbors: Neighbors, least: float, length_weight: float,
    buckets: int, kind: NDArray[Any],
) -> Any:  # fmt: skip
    """Find the order of the edges (N, k) of least agreement or more, as rows of the flat array, the surest first.

    An edge's doubt is 1 - |agreement|, plus `length_weight` times its length over the radii (N,) of its ends. Edges
    whose doubts fall into the same one of the buckets keep their order. The rows are of the type of the array `kind`.
    """
    scale = buckets / (1 - least + length_weight)
    bucket = np.empty(edges.size, np.uint16)
    start = np.zeros(buckets + 1, np.int64)
    count = edges.shape[1]
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
            start[number] += 1
    total = 0
    for number in range(buckets + 1):
        start[number], total = total, total + start[number]
    order = np.empty(start[buckets], kind.dtype)
    for edge in range(len(bucket)):
        if bucket[edge] < buckets:
            order[start[bucket[edge]]] = edge
            start[bucket[edge]] += 1
    return order


@compiled
def join_edges(order: NDArray[Any], neighbors: Neighbors, edges: Edges, largest: int, root: Ints, flips: Bools) -> None:
    """Join the ends of edges to trees of at most `largest` points.

    order (E,): rows of the flat array of edges (N, k), which are negative where the signs of a point and its neighbor
    (N, k) differ. root (N,): at first each point itself, at last the root of its tree; flips (N,), at first False:
    whether a point's sign is opposite to its root's.
    """
    size = np.ones(len(root), np.int64)
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


@compiled
def pixel_code(row: int, column: int, level: int, label: int) -> Any:
    """Mix four integers to a uint64 that is not zero; two pixels have the same one with a chance of 2^-64."""
    code = np.uint64(row) * np.uint64(0x9E3779B97F4A7C15)
    for value in (column, level, label):
        code ^= code >> np.uint64(29)
        code = (code + np.uint64(value)) * np.uint64(0xBF58476D1CE4E5B9)
    code ^= code >> np.uint64(32)
    return code if code != 0 else np.uint64(1)


@compiled
def see(
    points: Floats, normals: Floats, axes: Floats, unit: float, least: float, slack: Floats, rough: float,
    level: Ints, hides: Bools, label: Ints, lowest: Ints, highest: Ints,
    key: Any, top: Floats, bottom: Floats, votes: Floats,
) -> None:  # fmt: skip
    """Look at N points along one direction D and against it, and add to their votes.

    The pictures of all labels and levels are in one hash table of pixels. A point that hides others is drawn into the
    picture of its own level; every point is compared with the pictures of all levels of its label.

    Args:
        points, normals: (N, 3).
        axes: (3, 3) two directions across D, and D.
        unit: side of a pixel at level 0; it doubles from level to level.
        least: cosine between normal and D up to which a point does not vote.
        slack: (N,) how far below the topmost point of a pixel a point is still seen, at least,
        rough: and at least this share of the pixel's side.
        level: (N,) of each point's own pixel.
        hides: (N,) whether a point hides others.
        label: (N,) in [0, L): which points share pictures.
        lowest, highest: (L,) the levels of each label's pictures.
        key, top, bottom: (S,) uint64 and float64 tables, overwritten; S is a power of two, above the points that hide.
        votes: (N, 3) sums of n.D and of |n.D| over the views that see a point, and of n.D over D alone.
    """
    mask = np.uint64(len(key) - 1)
    depth = np.empty(len(points))
    row, column = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    key[:] = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        depth[i] = x * axes[2, 0] + y * axes[2, 1] + z * axes[2, 2]
        row[i] = np.int64(np.floor((x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2]) / unit))
        column[i] = np.int64(np.floor((x * axes[1, 0] + y * axes[1, 1] + z * axes[1, 2]) / unit))
        if not hides[i]:
            continue
        code = pixel_code(row[i] >> level[i], column[i] >> level[i], level[i], label[i])
        slot = code & mask
        while key[slot] != 0 and key[slot] != code:
            slot = (slot + np.uint64(1)) & mask
        if key[slot] == 0:
            key[slot] = code
            top[slot] = bottom[slot] = depth[i]
        else:
            top[slot] = max(top[slot], depth[i])
            bottom[slot] = min(bottom[slot], depth[i])
    for i in range(len(points)):
        cosine = normals[i, 0] * axes[2, 0] + normals[i, 1] * axes[2, 1] + normals[i, 2] * axes[2, 2]
        if abs(cosine) <= least:
            continue
        above, below = True, True
        for at in range(lowest[label[i]], highest[label[i]] + 1):
            code = pixel_code(row[i] >> at, column[i] >> at, at, label[i])
            slot = code & mask
            while key[slot] != 0 and key[slot] != code:
                slot = (slot + np.uint64(1)) & mask
            if key[slot] != 0:
                reach = max(slack[i], rough * unit * 2.0**at)
                above = above and depth[i] >= top[slot] - reach
                below = below and depth[i] <= bottom[slot] + reach
        if above:
            votes[i, 0] += cosine
            votes[i, 1] += abs(cosine)
            votes[i, 2] += cosine
        if below:
            votes[i, 0] -= cosine
            votes[i, 1] += abs(cosine)


@compiled
def solid_angle(places: Floats, q: int, points: Floats, moments: Floats, softening: Floats, i: int) -> Any:
    """Find the solid angle of the oriented point i, see `solid_angles`, at the place q."""
    squared, flux = softening[i], 0.0
    for axis in range(3):
        step = points[i, axis] - places[q, axis]
        squared += step * step
        flux += moments[i, axis] * step
    return flux / (squared * np.sqrt(squared))


@compiled
def solid_angles(places: Floats, points: Floats, moments: Floats, softening: Floats) -> Any:
    """Find the winding number (Q,) at places (Q, 3) of oriented points (N, 3) with moments (N, 3): normals times areas.

    softening (N,) is added to each squared distance: a point is no nearer than its patch is wide.
    """
    result = np.zeros(len(places))
    for q in range(len(places)):
        for i in range(len(points)):
            result[q] += solid_angle(places, q, points, moments, softening, i)
    return result / (4 * np.pi)


@compiled
def add_windings(
    places: Floats, receiver: Ints, points: Floats, moments: Floats, softening: Floats, sender: Ints, total: Any
) -> None:
    """Add the solid angles of oriented points (N, 3), see `solid_angles`, at places (Q, 3) to total (R, S), float32.

    receiver (Q,) and sender (N,): the row and the column to which a place and a point belong.
    """
    for q in range(len(places)):
        for i in range(len(points)):
            total[receiver[q], sender[i]] += solid_angle(places, q, points, moments, softening, i)


@compiled
def grid_axis(coordinate: float, corner: float, cell: float, cells: int) -> Any:
    """The two places around a coordinate along one axis of a periodic grid, each with its linear weight."""
    position = (coordinate - corner) / cell
    base = np.floor(position)
    low = np.int64(base) % cells
    return (low, base + 1 - position), ((low + 1) % cells, position - base)


@compiled
def add_dipoles(points: Floats, moments: Floats, corner: Floats, cell: float, grid: Any) -> None:
    """Add charges |m| a cell behind each point (N, 3), seen along its moment m (N, 3), and -|m| as far before it.

    Charges are spread over the eight nearest places of a periodic grid (G, G, G), float32, whose first is at `corner`.
    """
    for i in range(len(points)):
        charge = np.sqrt(moments[i, 0] ** 2 + moments[i, 1] ** 2 + moments[i, 2] ** 2)
        if charge == 0:
            continue
        for side in (charge, -charge):
            step = -cell / side
            across = grid_axis(points[i, 0] + step * moments[i, 0], corner[0], cell, len(grid))
            along = grid_axis(points[i, 1] + step * moments[i, 1], corner[1], cell, len(grid))
            up = grid_axis(points[i, 2] + step * moments[i, 2], corner[2], cell, len(grid))
            for x, in_x in across:
                for y, in_y in along:
                    for z, in_z in up:
                        grid[x, y, z] += side * in_x * in_y * in_z


@compiled
def read_grid(places: Floats, corner: Floats, cell: float, grid: Any) -> Any:
    """Interpolate a periodic grid (G, G, G), whose first place is at `corner`, at places (Q, 3)."""
    result = np.zeros(len(places))
    for i in range(len(places)):
        across = grid_axis(places[i, 0], corner[0], cell, len(grid))
        along = grid_axis(places[i, 1], corner[1], cell, len(grid))
        up = grid_axis(places[i, 2], corner[2], cell, len(grid))
        for x, in_x in across:
            for y, in_y in along:
                for z, in_z in up:
                    result[i] += in_x * in_y * in_z * grid[x, y, z]
    return result
