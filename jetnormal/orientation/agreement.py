"""Agreement of the signs of neighbors, and regions of points whose signs all agree.

The edge test is the mirror test of Xie et al., "Piecewise C1 continuous surface reconstruction of noisy point clouds
via local implicit quadric regression" (2003). It is right across sharp edges and between the sides of thin plates,
where the test n.n' of Hoppe et al., "Surface reconstruction from unorganized points" (1992) is undecided or wrong. With
growing noise the mirror test becomes unreliable, so it is blended back to n.n'.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.orientation.kernels.edges import (
    edge_agreement,
    edge_votes,
    join_edges,
    surest_first,
    third_smallest_height,
    turn_all,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Labels = NDArray[np.int32]  # of regions and components
Bools = NDArray[np.bool_]

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
REGION_AGREEMENT = 0.8  # of the edges that join points to a region
BUCKETS = 4096  # edges of nearly the same weight are in the order of their points
REGION_POINTS = 200  # at most: a wrong edge inside of a region spoils no other
# An edge longer than this many radii of its other end starts at a stray point: it joins nothing.
BRIDGE_RADII = 3.0
REVOTES = 3
CHUNK = 100_000  # points


def chunks(count: int) -> Iterator[slice]:
    """Slices of so many points, for what takes much memory for each."""
    return (slice(start, start + CHUNK) for start in range(0, count, CHUNK))


class Surface:
    """Distinct points, their directions, and the graph of their neighbors.

    Attributes:
        points, normals: (N, 3), N >= 1; the normals are unit vectors of any sign.
        neighbors: (N, k) int32 indices of the nearest others.
        radius: (N,) distance of the farthest of these.
        spacing: (N,) distance between points on a flat surface of the density found there.
        roughness: (N,) noise, as a height over the tangent plane; it levels off as noise exceeds the spacing.
        edges: (N, k) float32 agreement of the signs of a point and its neighbors (`kernels.edges`); 0 from stray
            points.
    """

    def __init__(self, points: Floats, normals: Floats) -> None:
        self.points, self.normals = points, normals
        count = min(GRAPH_NEIGHBORS + 1, len(points))
        self.neighbors = np.empty((len(points), count - 1), np.int32)
        self.radius: Floats = np.empty(len(points))
        index = NeighborIndex(points)
        for rows in chunks(len(points)):
            near, distances = index.query(points[rows], count)
            self.neighbors[rows] = near[:, 1:]  # the nearest of distinct points is the point itself
            self.radius[rows] = distances[:, -1]
        self.spacing: Floats = self.radius * np.sqrt(np.pi / max(1, count - 1))
        self.roughness = self._measure_roughness()
        self.edges = np.empty(self.neighbors.shape, np.float32)
        edge_agreement(
            points, normals, self.roughness, self.radius, self.neighbors, ROUGHNESS_SCALE / 2, BRIDGE_RADII, self.edges
        )

    def _measure_roughness(self) -> Floats:
        if self.neighbors.shape[1] <= ROUGHNESS_RANK:
            return np.zeros(len(self.points))
        rank = third_smallest_height(self.points, self.normals, self.neighbors)
        return np.concatenate([rank[self.neighbors[rows]].mean(axis=1) for rows in chunks(len(rank))])

    def turn(self, flips: Bools) -> None:
        """Turn the normals (N,) that are to flip."""
        turn_all(flips, self.neighbors, self.normals, self.edges)


@dataclass(frozen=True)
class Forest:
    """Trees over M nodes: edges between row (E,) and col (E,), with the agreement (E,) of their ends."""

    row: Ints
    col: Ints
    agreement: Floats
    nodes: int

    def only(self, kept: Bools) -> Forest:
        """The forest of some of the edges (E,)."""
        return Forest(self.row[kept], self.col[kept], self.agreement[kept], self.nodes)


def region_forest(coupling: Any) -> Forest:
    """The spanning forest of regions over the strongest couplings, a symmetric sparse (M, M) matrix."""
    from scipy.sparse.csgraph import minimum_spanning_tree

    strength = abs(coupling)
    strength.data = 1 / strength.data
    tree = minimum_spanning_tree(strength).multiply(coupling).tocoo()
    return Forest(tree.row.astype(np.int64), tree.col.astype(np.int64), tree.data, coupling.shape[0])


def rooted(forest: Forest) -> tuple[Ints, Ints, Ints]:
    """Join the trees of a forest by one more node M above their roots, so that one search from it visits every node.

    Returns:
        The M + 1 nodes from the top down, level by level; the parent of each node (M + 1,), M being its own; and the
        number of each node's tree (M,).
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    n = forest.nodes
    matrix = coo_matrix((np.ones(len(forest.row)), (forest.row, forest.col)), (n, n))
    tree = connected_components(matrix, directed=False)[1].astype(np.int64)
    roots = np.unique(tree, return_index=True)[1]
    ends = np.append(forest.row, np.full(len(roots), n)), np.append(forest.col, roots)
    graph = coo_matrix((np.ones(len(ends[0])), ends), (n + 1, n + 1)).tocsr()
    order, parent = breadth_first_order(graph, n, directed=False)
    parent[n] = n
    return order.astype(np.int64), parent.astype(np.int64), tree


def spread_signs(forest: Forest) -> tuple[Bools, Ints]:
    """Which nodes (M,) to flip so that a forest is consistent, and the number of each node's tree (M,)."""
    _, parent, tree = rooted(forest)
    child = np.where(parent[forest.col] == forest.row, forest.col, forest.row)
    flips = np.zeros(len(parent), dtype=bool)
    flips[child] = forest.agreement < 0
    # Pointer doubling: a sign relative to the parent becomes one relative to the grandparent, and so on,
    # in as many steps as the logarithm of the tree's depth.
    while not np.array_equal(parent, grandparent := parent[parent]):
        flips ^= flips[parent]
        parent = grandparent
    return flips[:-1], tree


def regions(surface: Surface) -> tuple[Bools, Labels]:
    """Find regions of up to `REGION_POINTS` points that sure edges connect; the surest edges are taken first.

    Returns:
        Which normals (N,) to flip so that they are consistent in every region, and each point's region (N,).
    """
    points, radius, neighbors = surface.points, surface.radius, surface.neighbors
    order = surest_first(points, surface.edges, radius, neighbors, REGION_AGREEMENT, LENGTH_WEIGHT, BUCKETS)
    root, flips = join_edges(order, neighbors, surface.edges, REGION_POINTS)
    return flips, np.unique(root, return_inverse=True)[1].astype(np.int32)


def couplings(surface: Surface, region: Labels, flips: Bools) -> Any:
    """How far regions agree, a symmetric sparse (M, M) matrix.

    It is the sum of c |c| over the edges c between two regions, times the ratio of this sum to the sum of c^2: many
    edges that contradict each other count less than a few that agree. flips (N,): which normals are taken as flipped.
    """
    from scipy.sparse import coo_matrix, csr_matrix

    count = int(region.max()) + 1
    total = net = csr_matrix((count, count))
    for rows in chunks(len(region)):
        neighbors, edges = surface.neighbors[rows], surface.edges[rows]
        here, there = np.broadcast_to(region[rows, None], neighbors.shape), region[neighbors]
        between = (here != there) & (edges != 0)
        weight = np.where(flips[rows, None] ^ flips[neighbors], -edges, edges)[between].astype(np.float64)
        places = here[between], there[between]
        total = total + coo_matrix((weight * weight, places), (count, count)).tocsr()
        net = net + coo_matrix((weight * abs(weight), places), (count, count)).tocsr()
    total, net = (total + total.T) / 2, (net + net.T) / 2
    net.eliminate_zeros()
    return net.multiply(abs(net)).multiply(total.power(-1)).tocsr()


@dataclass(frozen=True)
class LeastSquares:
    """The sum of weight_r ((matrix @ x[among])_r - target)^2 over x (M,), of which `among` (K,) are meant.

    The matrix is dense (R, K); there are R weights.
    """

    matrix: NDArray[np.float32]
    weight: Floats
    target: float
    among: Ints
    unknowns: int

    def diagonal(self) -> Floats:
        """Of the quadratic form (M,)."""
        return self._of_all(np.einsum("r,rk,rk->k", self.weight, self.matrix, self.matrix))

    def votes(self) -> Floats:
        """The linear form (M,)."""
        return self._of_all((self.weight * self.target).astype(np.float32) @ self.matrix)

    def image(self, x: Floats) -> Floats:
        """The quadratic form's matrix times x (M,)."""
        values = self.matrix @ x[self.among].astype(np.float32)
        return self._of_all((self.weight * values).astype(np.float32) @ self.matrix)

    def _of_all(self, values: NDArray[Any]) -> Floats:
        result = np.zeros(self.unknowns)
        result[self.among] = values
        return result


def relax(
    coupling: Any, votes: Floats, demand: LeastSquares | None = None, *, steps: int = 400, tolerance: float = 1e-6
) -> Floats:
    """Find the signs of regions from couplings and votes, as numbers between -1 and 1.

    Minimizes the sum of |W_ab| (x_a - sign(W_ab) x_b)^2 / 2, |u_a| (x_a - sign(u_a))^2 and a demand by conjugate
    gradients. Where all of them are consistent, |x| is 1; where they contradict each other, it comes near 0.

    Args:
        coupling: W, a symmetric sparse (M, M) matrix.
        votes: u, (M,).
        demand: what else x has to meet.
    """
    own = np.asarray(abs(coupling).sum(axis=1)).ravel() + np.abs(votes)
    degree = own
    if demand is not None:
        degree, votes = own + demand.diagonal(), votes + demand.votes()
    degree = np.where(degree == 0, 1, degree)
    x = np.zeros(len(votes))
    residual = votes.copy()
    step = scaled = residual / degree
    energy = (residual * scaled).sum()  # NumPy's own sums: BLAS rounds differently on each number of threads
    stop = energy * tolerance**2
    for _ in range(steps):
        if energy <= stop:
            break
        image = own * step - coupling @ step
        if demand is not None:
            image += demand.image(step)
        length = energy / (step * image).sum()
        x += length * step
        residual = residual - length * image
        scaled = residual / degree
        energy, before = (residual * scaled).sum(), energy
        step = scaled + energy / before * step
    return np.clip(x, -1, 1)


def revote(surface: Surface, settled: Ints | None = None) -> Floats:
    """Turn points that most of their neighbors contradict; return how far the neighbors agree then (N,), 0 to 1.

    Rows `settled` (n,) stay as they are.
    """
    for _ in range(REVOTES):
        contradicted = edge_votes(surface.edges)[0] < 0
        if settled is not None:
            contradicted[settled] = False
        surface.turn(contradicted)
    vote, total = edge_votes(surface.edges)
    return np.clip(vote / np.where(total > 0, total, 1), 0, 1)
