"""Clean a reconstructed surface: find what no points support, cut it off, remove defects, transfer colors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.mesh import Mesh
from jetnormal.support.open3d_loader import import_open3d

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SUPPORT_NEIGHBORS = 8
NOISE_NEIGHBORS = 50
NOISE_SAMPLE = 500  # points at which the noise is measured
STRAY_RADII = 3.0  # neighborhood radius of a stray point, over the median of its neighbors
GAP_RADII = 3.0  # a surface that far from all points, in neighborhood radii of the nearest, bridges a gap
OPEN_SHARE = 0.02  # of the area that bridges gaps, from which on a surface is open
SPECK_POINTS = 30  # a component that fewer points belong to is a speck,
SPECK_SHARE = 0.002  # or one that a smaller share of all points does
MERGE_DISTANCE = 1e-9  # of the size of the mesh: vertices as close as this are one


def noise(points: Floats, quantile: float) -> float:
    """Measure how far points (N, 3), N > 7, are off a smooth surface: off a quadric through their neighbors.

    Many neighbors are taken, because close neighbors in the image of a depth camera lie in one layer of its quantized
    depths.
    """
    k = min(NOISE_NEIGHBORS, len(points))
    sample = np.random.default_rng(0).permutation(len(points))[:NOISE_SAMPLE]
    neighbors, _ = NeighborIndex(points).query(points[sample], k)
    patches = points[neighbors] - points[neighbors].mean(axis=1, keepdims=True)
    axes = np.linalg.svd(patches, full_matrices=False)[2]
    u, v, height = np.moveaxis(np.einsum("nkd,ned->nke", patches, axes), 2, 0)
    size = np.maximum(np.sqrt((u * u + v * v).mean(axis=1, keepdims=True)), 1e-300)
    u, v = u / size, v / size
    basis = np.linalg.qr(np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=2))[0]
    rest = height - np.einsum("nkm,nm->nk", basis, np.einsum("nkm,nk->nm", basis, height))
    return float(np.quantile(np.sqrt((rest * rest).sum(axis=1) / (k - 6)), quantile))


def remoteness(vertices: Floats, points: Floats) -> Floats:
    """Measure how far vertices (V, 3) are from the points (N, 3): (V,).

    The distance to the nearest point is divided by that point's own distance to its 8th neighbor. Stray points, as
    between the sky and a roof, do not count.
    """
    neighbors, radius = _radii(points)
    points = points[radius <= STRAY_RADII * np.median(radius[neighbors], axis=1)]
    _, radius = _radii(points)
    nearest, distance = NeighborIndex(points).query(vertices, 1)
    return np.asarray(distance[:, 0] / radius[nearest[:, 0]])


def _radii(points: Floats) -> tuple[Ints, Floats]:
    """Find the 8 nearest neighbors of points (N, 3), themselves included, and the distances (N,) to the last."""
    neighbors, distances = NeighborIndex(points).query(points, min(SUPPORT_NEIGHBORS + 1, len(points)))
    return neighbors, distances[:, -1]


def gap_share(mesh: Mesh, remote: Floats) -> float:
    """Compute the share of the area that bridges gaps: of faces with a vertex whose remoteness (V,) exceeds 3."""
    area = np.linalg.norm(mesh.area_vectors(), axis=1)
    bridging = (remote[mesh.faces] > GAP_RADII).any(axis=1)
    return float(area[bridging].sum() / max(area.sum(), 1e-300))


def clip(mesh: Mesh, values: Floats, threshold: float) -> Mesh:
    """Cut a mesh where values (V,), linear on each face, fall below the threshold; colors are dropped.

    Faces across the threshold are cut along it.
    """
    inside = values >= threshold
    count = inside[mesh.faces].sum(axis=1)
    one, two = mesh.faces[count == 1], mesh.faces[count == 2]
    # Turned so that the corner that differs from the other two comes first.
    one = _turned(one, inside[one].argmax(axis=1))
    two = _turned(two, inside[two].argmin(axis=1))
    edges = np.concatenate([one[:, [0, 1]], one[:, [0, 2]], two[:, [0, 1]], two[:, [0, 2]]])
    unique, cut = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    low, high = values[unique].T
    weight = ((threshold - low) / np.where(high != low, high - low, 1))[:, None]
    start, end = mesh.vertices[unique[:, 0]], mesh.vertices[unique[:, 1]]
    # cut[...] are the new vertices: two per cut face, on the edges from its first corner
    a, b, c, d = np.split(cut.reshape(-1) + len(mesh.vertices), np.cumsum([len(one), len(one), len(two)]))
    faces = [
        mesh.faces[count == 3],
        np.stack([one[:, 0], a, b], axis=1),
        np.stack([c, two[:, 1], two[:, 2]], axis=1),
        np.stack([c, two[:, 2], d], axis=1),
    ]
    return Mesh(np.concatenate([mesh.vertices, start + weight * (end - start)]), np.concatenate(faces))


def _turned(faces: Ints, first: Ints) -> Ints:
    """Rotate the corners of faces (F, 3) so that corner number `first` (F,) comes first."""
    return np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)


def cleaned(mesh: Mesh) -> Mesh:
    """Merge vertices at the same place; remove degenerate faces, copies of faces, and loose vertices."""
    vertices, faces, colors = mesh.vertices, mesh.faces, mesh.colors
    if len(vertices):
        cell = max(float(np.ptp(vertices, axis=0).max()) * MERGE_DISTANCE, 1e-300)
        _, first, merged = np.unique(
            np.round((vertices - vertices[0]) / cell), axis=0, return_index=True, return_inverse=True
        )
        faces = first[merged.reshape(-1)][faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    faces = faces[Mesh(vertices, faces).area_vectors().any(axis=1)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return _without_loose_vertices(Mesh(vertices, faces[np.sort(first)], colors))


def without_specks(mesh: Mesh, points: Floats, least: int | Literal["largest"] | None = None) -> Mesh:
    """Remove small components; the largest one stays.

    Args:
        mesh: the mesh.
        points: (N, 3); a component has those that are nearest to it.
        least: number of points of the smallest component that stays; None takes 30 or 0.2 % of the points.
    """
    labels = component_labels(mesh)
    if not len(labels):
        return mesh
    nearest, _ = NeighborIndex(mesh.vertices).query(points, 1)
    belonging = np.bincount(labels[nearest[:, 0]], minlength=labels.max() + 1)
    if least == "largest":
        keep = np.arange(len(belonging)) == belonging.argmax()
    else:
        least = max(SPECK_POINTS, round(SPECK_SHARE * len(points))) if least is None else least
        keep = belonging >= min(least, belonging.max())
    return _without_loose_vertices(replace(mesh, faces=mesh.faces[keep[labels[mesh.faces[:, 0]]]]))


def smoothed(mesh: Mesh, rounds: int) -> Mesh:
    """Return the mesh without colors after rounds of smoothing that does not shrink it (Taubin, SIGGRAPH 1995)."""
    found = _to_open3d(mesh).filter_smooth_taubin(number_of_iterations=rounds)
    return Mesh(np.array(found.vertices), mesh.faces)


def simplified(mesh: Mesh, faces: int) -> Mesh:
    """Return the mesh, without colors, with about so many faces where it has more (Garland and Heckbert, 1997)."""
    if len(mesh.faces) <= faces:
        return mesh
    found = _to_open3d(mesh).simplify_quadric_decimation(faces)
    return cleaned(Mesh(np.array(found.vertices), np.array(found.triangles, dtype=np.int64)))


def _to_open3d(mesh: Mesh) -> Any:
    open3d: Any = import_open3d()
    vertices = open3d.utility.Vector3dVector(mesh.vertices)
    return open3d.geometry.TriangleMesh(vertices, open3d.utility.Vector3iVector(mesh.faces.astype(np.int32)))


def _without_loose_vertices(mesh: Mesh) -> Mesh:
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces] = True
    number = np.cumsum(used) - 1
    colors = None if mesh.colors is None else mesh.colors[used]
    return Mesh(mesh.vertices[used], number[mesh.faces], colors)


def component_labels(mesh: Mesh) -> Ints:
    """Find the connected component of each vertex (V,), numbered from 0."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = mesh.faces.ravel(), np.roll(mesh.faces, 1, axis=1).ravel()
    graph = coo_matrix((np.ones(mesh.faces.size, dtype=np.int8), ends), (len(mesh.vertices),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def is_watertight(mesh: Mesh) -> bool:
    """Tell whether every edge has two faces, one on each side."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    ways = edges[:, 0] * len(mesh.vertices) + edges[:, 1]
    back = edges[:, 1] * len(mesh.vertices) + edges[:, 0]
    return bool(len(ways) and len(np.unique(ways)) == len(ways) and np.array_equal(np.sort(ways), np.sort(back)))


def carried(values: Floats, points: Floats, vertices: Floats) -> Floats:
    """Transfer values (N, C) from points (N, 3) to vertices (V, 3).

    The four nearest points count, weighted by the inverse squared distance.
    """
    index, distance = NeighborIndex(points).query(vertices, min(4, len(points)))
    weight = 1 / np.maximum(distance, 1e-3 * distance.mean(axis=1, keepdims=True) + 1e-300) ** 2
    weight /= weight.sum(axis=1, keepdims=True)
    return np.asarray(np.einsum("vk,vkc->vc", weight, values[index]))
