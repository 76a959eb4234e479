"""Solids with known outward normals, at random points."""

from __future__ import annotations

import numpy as np


def scrambled(normals):
    return normals * np.random.default_rng(7).choice([-1.0, 1.0], (len(normals), 1))


def joined(parts):
    return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))


def sphere(rng, count, radius=1.0, center=(0.0, 0.0, 0.0)):
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return radius * normals + center, normals


def ring(rng, count, radius=1.0, tube=0.25):
    around, across = rng.uniform(0, 2 * np.pi, (2, count))
    spoke = np.stack([np.cos(around), np.sin(around), np.zeros(count)], axis=1)
    normals = np.cos(across)[:, None] * spoke + np.sin(across)[:, None] * [0, 0, 1]
    return radius * spoke + tube * normals, normals


def rectangle(rng, density, corner, side, other):
    """Points on a parallelogram, with the normal side x other."""
    normal = np.cross(side, other)
    area = np.linalg.norm(normal)
    count = round(density * area)
    u, v = rng.uniform(size=(2, count, 1))
    return corner + u * np.asarray(side) + v * np.asarray(other), np.tile(normal / area, (count, 1))


def box(rng, density, low, high):
    x, y, z = np.diag(np.subtract(high, low))
    pairs = ((low, y, x), (low, z, y), (low, x, z), (high, -x, -y), (high, -y, -z), (high, -z, -x))
    return joined([rectangle(rng, density, np.asarray(corner), a, b) for corner, a, b in pairs])


def drilled_block(rng, density):
    """A step of two coplanar levels with three blind holes, whose walls and bottoms are part of the surface."""
    centers, radius, depth = np.array([[0.5, 0.5], [1.1, 0.4], [1.6, 0.7]]), 0.15, 0.4
    points, normals = joined([box(rng, density, (0, 0, 0), (2, 1, 0.5)), box(rng, density, (0, 1, 0), (2, 1.6, 0.25))])
    y, z = points.T[1:]
    hidden = (y == 1) & (z <= 0.25)  # where the two boxes touch
    above = (np.linalg.norm(points[:, None, :2] - centers, axis=2) < radius).any(axis=1) & (z == 0.5)
    points, normals = points[~(hidden | above)], normals[~(hidden | above)]
    parts = [(points, normals)]
    for center in centers:
        angle = rng.uniform(0, 2 * np.pi, round(density * 2 * np.pi * radius * depth))
        spoke = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
        height = rng.uniform(0.5 - depth, 0.5, len(angle))
        parts.append((np.append(center, 0) + radius * spoke + height[:, None] * [0, 0, 1], -spoke))
        flat = rng.uniform(-radius, radius, (round(density * 4 * radius**2), 2))
        flat = flat[np.linalg.norm(flat, axis=1) < radius]
        bottom = np.column_stack([flat + center, np.full(len(flat), 0.5 - depth)])
        parts.append((bottom, np.tile([0.0, 0.0, 1.0], (len(flat), 1))))
    return joined(parts)
