"""Shapes that many tests need, and whose normals are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jetnormal.cloud import Cloud


def sphere(count: int, seed: int = 0) -> np.ndarray:
    """(count, 3) random points on the unit sphere, which are their own outward normals."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def sphere_cloud(count: int = 5000) -> Cloud:
    """A rounded sphere with an attribute; two of its points are one, and a third is not finite."""
    points = np.round(sphere(count), 4)
    points[7], points[8] = points[6], np.nan
    return Cloud(points, None, {"label": np.arange(count, dtype=np.int32) % 9})


def even_sphere(count: int) -> np.ndarray:
    """(count, 3) evenly spread points on the unit sphere (a Fibonacci lattice), their own outward normals."""
    index = np.arange(count) + 0.5
    z, angle = 1 - 2 * index / count, index * np.pi * (1 + np.sqrt(5))
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)


def plane(side: int) -> tuple[np.ndarray, np.ndarray]:
    """A grid of side x side points of the unit square, and their normals along z."""
    grid = np.stack(np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side), [0.0]), axis=-1).reshape(-1, 3)
    return grid, np.tile([0.0, 0.0, 1.0], (len(grid), 1))


def normals_by_differences(lift: Callable[[np.ndarray], np.ndarray], points: np.ndarray) -> np.ndarray:
    """(N, 3) unit normals of a plane whose points `lift` moves along z."""
    step = 1e-6
    ahead = [lift(points + step * np.eye(3)[axis]) for axis in (0, 1)]
    slope = np.column_stack([moved[:, 2] - lift(points)[:, 2] for moved in ahead]) / step
    normals = np.column_stack([-slope, np.ones(len(points))])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def cube() -> tuple[np.ndarray, np.ndarray]:
    """(8, 3) vertices and (12, 3) faces of the unit cube, counter-clockwise seen from outside."""
    vertices = np.array([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)])
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return vertices, np.array(faces)
