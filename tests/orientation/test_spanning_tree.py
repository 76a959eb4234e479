"""A spanning tree with a wrong edge is mended by all the couplings that it left out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_matrix

from jetnormal.orientation.agreement import region_forest, spread_signs
from jetnormal.orientation.spanning_tree import mend

SIDE = 12


def grid(signs, wrong=()):
    """Couplings of a grid of nodes with true signs; those of `wrong` pairs are the strongest, and lie."""
    numbers = np.arange(SIDE**2).reshape(SIDE, SIDE)
    row = np.concatenate([numbers[1:].ravel(), numbers[:, 1:].ravel()])
    col = np.concatenate([numbers[:-1].ravel(), numbers[:, :-1].ravel()])
    strength = np.random.default_rng(0).uniform(0.5, 1, len(row)) * signs[row] * signs[col]
    for a, b in wrong:
        strength[(row == b) & (col == a)] = -1.1 * signs[a] * signs[b]
    matrix = coo_matrix((strength, (row, col)), (SIDE**2, SIDE**2)).tocsr()
    return matrix + matrix.T


def consistent(flips, signs) -> float:
    share = np.mean(np.where(flips, -1, 1) == signs)
    return max(share, 1 - share)


@pytest.mark.parametrize("wrong", [[20, 65, 75, 92], [28, 61, 73, 89], [41, 61, 69, 90], [16, 55, 77, 103]])
def test_branches_behind_wrong_edges_are_turned(wrong):
    signs = np.random.default_rng(1).choice([-1, 1], SIDE**2)
    coupling = grid(signs, [(node, node + 1) for node in wrong])
    forest = region_forest(coupling)
    flips, _ = spread_signs(forest)
    assert consistent(flips, signs) < 0.8
    assert consistent(mend(forest, coupling, flips), signs) == 1


def test_what_is_consistent_stays_and_trees_do_not_mix():
    signs = np.ones(SIDE**2)
    coupling = grid(signs).tolil()
    coupling[:60, 60:], coupling[60:, :60] = 0, 0  # two trees
    coupling = coupling.tocsr()
    coupling.eliminate_zeros()
    forest = region_forest(coupling)
    flips, tree = spread_signs(forest)
    assert len(np.unique(tree)) == 2
    np.testing.assert_array_equal(mend(forest, coupling, flips), flips)


def test_a_single_node_has_no_branches():
    coupling = coo_matrix((1, 1)).tocsr()
    forest = region_forest(coupling)
    assert mend(forest, coupling, np.array([True])).tolist() == [True]
