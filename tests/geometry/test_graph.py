from __future__ import annotations

import numpy as np
import pytest
import torch

from jetnormal.geometry.graph import build_graph, cloud_spacing


def test_offsets_are_in_spacings_and_start_at_the_point_itself():
    points = np.random.default_rng(0).random((100, 3)) + 1e6
    graph = build_graph(points, 8, 0.5)
    found = graph.offsets(slice(3, 9))
    expected = (points[graph.neighbors[3:9].numpy()] - points[3:9, None]) / 0.5
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)
    assert torch.equal(graph.neighbors[:, 0], torch.arange(100))


def test_a_point_is_its_own_first_neighbor_also_among_copies():
    graph = build_graph(np.repeat(np.eye(3), 2, axis=0), 2, 1.0)
    assert torch.equal(graph.neighbors[:, 0], torch.arange(6))


def test_spacing_of_a_grid_and_of_a_grid_with_stray_points():
    grid = np.stack(np.meshgrid(np.arange(60), np.arange(60), [0]), axis=-1).reshape(-1, 3) * 0.25
    inner = cloud_spacing(grid)
    squares = [1] * 4 + [2] * 4 + [4] * 4 + [5] * 4  # of the 16 nearest; the point itself counts, too
    assert inner == pytest.approx(0.25 * np.sqrt(sum(squares) / 17 / 3), rel=1e-9)
    strays = np.vstack([grid, [[1e6, 0, 0], [0, 1e7, 0]]])
    assert cloud_spacing(strays) == pytest.approx(inner, rel=1e-9)


def test_coincident_points_have_a_unit_of_their_own():
    assert cloud_spacing(np.zeros((50, 3))) == 1.0
