from __future__ import annotations

import numpy as np
import pytest

from jetnormal.estimators.base import Prediction


@pytest.fixture
def write_sphere():
    """Writes a sphere in PCPNet's layout: the normals are the directions of the points."""

    def write(folder, name, radius=1.0, count=400, queries=None):
        normals = np.random.default_rng(len(name)).normal(size=(count, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        np.savetxt(folder / f"{name}.xyz", radius * normals, fmt="%.9f")
        np.savetxt(folder / f"{name}.normals", normals, fmt="%.9f")
        if queries is not None:
            np.savetxt(folder / f"{name}.pidx", queries, fmt="%d")

    return write


class Turned:
    """The true normals of a sphere of radius r, turned by r times an angle, some of them upside down."""

    neighbors = 10

    def __init__(self, degrees, name="turned", flipped=slice(None, None, 2)):
        self.degrees, self.name, self.flipped = degrees, name, flipped

    def z_axes(self, points, queries):
        return None

    def __call__(self, points, queries=None, advance=None):
        points = points[queries]
        radius = np.linalg.norm(points, axis=1, keepdims=True)
        aside = np.cross(points, np.roll(points, 1, axis=1))
        aside /= np.linalg.norm(aside, axis=1, keepdims=True)
        angle = np.radians(self.degrees * radius)
        normals = np.cos(angle) * points / radius + np.sin(angle) * aside
        normals[self.flipped] *= -1
        advance(len(points))
        normals = normals.astype(np.float32)
        return Prediction(normals, normals, np.ones(len(points), np.float32), None)


@pytest.fixture
def turned():
    return Turned


@pytest.fixture
def folder(tmp_path, write_sphere):
    """Two clouds without noise, radius 1 and 3, and one of each other kind, radius 4 to 8."""
    write_sphere(tmp_path, "a", 1)
    write_sphere(tmp_path, "bb", 3)
    endings = ["_noise_white_1.25e-03", "_noise_white_6.00e-03", "_noise_white_1.20e-02"]
    for radius, ending in enumerate([*endings, "_ddist_minmax", "_ddist_minmax_layers"], start=4):
        write_sphere(tmp_path, f"a{ending}", radius)
    return tmp_path
