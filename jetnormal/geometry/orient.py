"""Consistent signs for normals: directions stay bit for bit what they were, only signs change.

Four methods: `mst` needs nothing but the points, `viewpoint` and `up` use what is known about the scan,
`none` leaves the signs alone. No other looks at the signs that come in: scrambling those changes nothing.

`mst` follows Hoppe et al., "Surface reconstruction from unorganized points" (1992): signs spread along the
minimum spanning tree of the neighbor graph, over the edges most certain to keep them. The edge test is the
mirror test of Xie et al., "Piecewise C1 continuous surface reconstruction of noisy point clouds via local
implicit quadric regression" (2003), right across sharp edges and between the sides of thin plates, where
Hoppe's n.n' is a tie or wrong; it fades into Hoppe's as an edge drowns in noise, where the mirror misleads.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.neighbors import NeighborIndex, distinct

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Method = Literal["mst", "viewpoint", "up", "none"]

GRAPH_NEIGHBORS = 12
# Added to an edge's weight, times its length over the two points' neighborhood radii: among equally certain
# edges the shorter wins, and no weight is zero, which a SciPy sparse graph would take for a missing edge.
LENGTH_WEIGHT = 1e-3
# A point's roughness is the third smallest height of its neighbors over its tangent plane: with noise all
# heights are large, while on a clean edge or thin plate the neighbors on its own side have almost none.
ROUGHNESS_RANK = 2
# Edges much longer than this many roughnesses are judged by the mirror test, much shorter ones by n.n'.
# Of 4, 8 and 16 this was the best on noisy solids, and none of them cost anything on clean ones.
ROUGHNESS_SCALE = 16.0
VOTE_DIRECTIONS = 48
OUTLIER_RADIUS = 5.0  # neighborhood radius, over the median of the component
VOTE_SHARE = 0.01  # of a component's points, in each direction
# A component whose votes for outward and inward nearly cancel has no outside: it is an open sheet.
MIN_PURITY = 0.2


def orient(
    points: NDArray[Any],
    normals: NDArray[Any],
    method: Method = "mst",
    *,
    viewpoint: tuple[float, float, float] | None = None,
) -> NDArray[Any]:
    """Give normals consistent signs.

    Rows with a non-finite point or normal, or a zero normal, stay as they are and do not take part.

    Args:
        points: (N, 3) coordinates, of any offset.
        normals: (N, 3) directions of any length and sign.
        method: how signs are chosen:
            "mst": outward. Signs spread over a spanning tree of each connected component of the neighbor
            graph; then the component is turned so that its extreme points look out. A component without an
            outside (a terrain, a wall) is turned up. An inner shell looks out of itself, not of its solid.
            "viewpoint": towards `viewpoint`, for a scan from one position.
            "up": n_z > 0, for airborne scans; where n_z is 0, n_y > 0, and where that is 0 too, n_x > 0.
            "none": as they are.
        viewpoint: (x, y, z) in the frame of the points, for the method "viewpoint". A normal at a right angle
            to its sight line is turned up.

    Returns:
        (N, 3) new array of the normals' dtype.

    Raises:
        ValueError: shapes do not match, or the method is unknown or lacks its viewpoint.
    """
    if method not in get_args(Method):
        raise ValueError(
            f"unknown orientation method {method!r}: choose one of {', '.join(get_args(Method))}"
        )
    if points.ndim != 2 or points.shape[1] != 3 or points.shape != normals.shape:
        raise ValueError(f"points {points.shape} and normals {normals.shape} must both be (N, 3)")
    oriented = normals.copy()
    if method == "none":
        return oriented
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(normals.astype(np.float64), axis=1)
    rows = np.flatnonzero(np.isfinite(points).all(axis=1) & np.isfinite(length) & (length > 0))
    used_points = points[rows].astype(np.float64)
    used_normals = normals[rows] / length[rows, None]
    flip = _looks_down(used_normals)  # the common start, whatever signs came in
    used_normals[flip] *= -1
    if method == "mst" and len(rows):
        flip ^= _mst_flips(used_points, used_normals)
    elif method == "viewpoint":
        flip ^= _viewpoint_flips(used_points, used_normals, viewpoint)
    oriented[rows[flip]] *= -1
    return oriented


def choose_method(source_viewpoint: tuple[float, ...] | None) -> Method:
    """The method where the user names none: a file that says where its scanner stood decides, else "mst".

    Args:
        source_viewpoint: a PCD file's VIEWPOINT, position and then quaternion, or None. The origin is what
            writers put there when they know nothing.
    """
    if source_viewpoint is None:
        return "mst"
    position = np.asarray(source_viewpoint[:3], dtype=np.float64)
    return "viewpoint" if np.isfinite(position).all() and position.any() else "mst"


def _looks_down(normals: Floats) -> Bools:
    """Which normals (N, 3) have a negative z, or y where z is zero, or x where both are."""
    x, y, z = normals.T
    return np.where(z != 0, z, np.where(y != 0, y, x)) < 0


def _viewpoint_flips(points: Floats, normals: Floats, viewpoint: tuple[float, float, float] | None) -> Bools:
    if viewpoint is None or len(viewpoint) != 3 or not np.isfinite(viewpoint).all():
        raise ValueError(
            f"the method 'viewpoint' needs a viewpoint of three finite coordinates, not {viewpoint}"
        )
    return np.einsum("nd,nd->n", normals, np.asarray(viewpoint) - points) < 0


def _mst_flips(points: Floats, normals: Floats) -> Bools:
    """Which unit normals (N, 3) to flip so that they are consistent and look outward; N >= 1."""
    first, copy_of = distinct(points)
    surface = _Surface(points[first], normals[first])
    signs, component = _spread_signs(surface, _spanning_forest(surface))
    surface.normals *= signs[:, None]
    surface.normals[_looks_inward(surface, component)[component]] *= -1
    # Copies of a point follow the first one. In the graph, many of them would see nothing but each other.
    return np.einsum("nd,nd->n", normals, surface.normals[copy_of]) < 0


class _Surface:
    """Distinct points (N, 3), their unit normals, and what the neighbor graph says about them."""

    def __init__(self, points: Floats, normals: Floats) -> None:
        self.points, self.normals = points, normals
        count = min(GRAPH_NEIGHBORS + 1, len(points))
        neighbors, distances = NeighborIndex(points).query(points, count)
        self.neighbors: Ints = neighbors[:, 1:]  # (N, k): the nearest of distinct points is the point itself
        self.radius: Floats = distances[:, -1]
        self.roughness = self._measure_roughness()

    def _measure_roughness(self) -> Floats:
        if self.neighbors.shape[1] <= ROUGHNESS_RANK:
            return np.zeros(len(self.points))
        heights = np.zeros(self.neighbors.shape)
        for axis in range(3):
            step = self.points[self.neighbors, axis] - self.points[:, axis, None]
            heights += self.normals[:, axis, None] * step
        rank = np.partition(np.abs(heights), ROUGHNESS_RANK, axis=1)[:, ROUGHNESS_RANK]
        return rank[self.neighbors].mean(axis=1)

    def agreement(self, i: Ints, j: Ints) -> tuple[Floats, Floats]:
        """How sure the signs of i and j agree (1: surely, 0: unknown, -1: surely not), and their distance.

        n_j is mirrored in the bisector plane of the edge e before it is compared with n_i, which gives
        n_i.n_j - 2 (n_i.e)(n_j.e) / |e|^2; roughness adds to |e|^2.
        """
        squared, along_i, along_j, dot = (np.zeros(np.broadcast_shapes(i.shape, j.shape)) for _ in range(4))
        for axis in range(3):  # one axis at a time: a third of the memory
            step = self.points[j, axis] - self.points[i, axis]
            squared += step * step
            along_i += self.normals[i, axis] * step
            along_j += self.normals[j, axis] * step
            dot += self.normals[i, axis] * self.normals[j, axis]
        blur = ROUGHNESS_SCALE / 2 * (self.roughness[i] + self.roughness[j])
        return dot - 2 * along_i * along_j / (squared + blur * blur), np.sqrt(squared)


def _spanning_forest(surface: _Surface) -> Any:
    """The minimum spanning forest of the neighbor graph, a SciPy sparse (N, N) matrix."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import minimum_spanning_tree

    n, k = surface.neighbors.shape
    agreement, length = surface.agreement(np.arange(n)[:, None], surface.neighbors)
    weight = np.maximum(1 - np.abs(agreement), 0)
    weight += LENGTH_WEIGHT * length / (surface.radius[:, None] + surface.radius[surface.neighbors])
    graph = csr_matrix((weight.ravel(), surface.neighbors.ravel(), np.arange(n + 1) * k), (n, n))
    return minimum_spanning_tree(graph, overwrite=True)


def _spread_signs(surface: _Surface, forest: Any) -> tuple[Floats, Ints]:
    """Signs (N,) consistent along the forest, and the number of each point's tree (N,)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    n = len(surface.points)
    _, component = connected_components(forest, directed=False)
    roots = np.unique(component, return_index=True)[1]
    edges = forest.tocoo()
    # One more node above all roots, so that one search from it visits every tree.
    ends = np.append(edges.row, np.full(len(roots), n)), np.append(edges.col, roots)
    graph = coo_matrix((np.ones(len(ends[0])), ends), (n + 1, n + 1)).tocsr()
    parent = breadth_first_order(graph, n, directed=False)[1][:n].astype(np.int64)
    parent[roots] = roots
    signs = np.ones(n)
    below = np.flatnonzero(parent != np.arange(n))
    signs[below[surface.agreement(below, parent[below])[0] < 0]] = -1
    # Pointer doubling: a sign relative to the parent becomes one relative to the grandparent, and so on,
    # in as many steps as the logarithm of the tree's depth.
    while not np.array_equal(parent, grandparent := parent[parent]):
        signs *= signs[parent]
        parent = grandparent
    return signs, component.astype(np.int64)


def _looks_inward(surface: _Surface, component: Ints) -> Bools:
    """Which components (C,) to turn: their extreme points look inward or, without an outside, they look down.

    In every direction D, a component's farthest points vote n.D, which is positive for an outward normal
    whatever the shape: one point in 100, so that outliers near the surface are outvoted.
    """
    order = _without_outliers(surface, component)
    label, normals = component[order], surface.normals[order]
    sizes = np.bincount(label)
    starts = np.cumsum(sizes) - sizes
    voters = np.ceil(VOTE_SHARE * sizes).astype(np.int64)
    points = surface.points[order]
    points -= (points.min(axis=0) + points.max(axis=0)) / 2
    score, total = np.zeros(len(sizes)), np.zeros(len(sizes))
    for direction in _directions():
        height = points @ direction
        least = np.maximum.reduceat(height, starts)
        for c in np.flatnonzero(voters > 1):
            own = height[starts[c] : starts[c] + sizes[c]]
            least[c] = np.partition(own, -voters[c])[-voters[c]]
        extreme = np.flatnonzero(height >= least[label])
        vote = normals[extreme] @ direction
        count = np.bincount(label[extreme])  # more than the voters where a flat face is the extreme
        score += np.bincount(label[extreme], vote) / count
        total += np.bincount(label[extreme], np.abs(vote)) / count
    sheet = np.abs(score) < MIN_PURITY * total
    sums = np.add.reduceat(normals, starts, axis=0)
    return np.where(sheet, _looks_down(sums), score < 0)


def _without_outliers(surface: _Surface, component: Ints) -> Ints:
    """The points (M,), grouped by component, but for those with few others around them for their component."""
    order = np.lexsort((surface.radius, component))
    sizes = np.bincount(component)
    median = surface.radius[order[np.cumsum(sizes) - sizes + (sizes - 1) // 2]]
    return order[surface.radius[order] <= OUTLIER_RADIUS * median[component[order]]]


def _directions() -> Floats:
    """Unit vectors (VOTE_DIRECTIONS, 3): half a Fibonacci lattice of the sphere, and their opposites."""
    half = VOTE_DIRECTIONS // 2
    i = np.arange(half)
    z = (i + 0.5) / half
    angle = i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    upper = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    return np.concatenate([upper, -upper])
