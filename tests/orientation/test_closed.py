"""Which counts more for the signs of regions, what is seen of them or how far neighbors agree."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.sparse import coo_matrix

from jetnormal.orientation import closed
from jetnormal.orientation.closed import weigh
from jetnormal.orientation.parts import Parts
from jetnormal.orientation.visibility import Votes

REGIONS, WIDTH = 600, 30


def grid(wrong_couplings, wrong_votes, roughness=0.0):
    """Signs (M,) of a grid of outward regions; a share of couplings and most votes of some regions (M,) are wrong."""
    rng = np.random.default_rng(0)
    number = np.arange(REGIONS).reshape(-1, WIDTH)
    row = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    col = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    value = np.where(rng.random(len(row)) < wrong_couplings, -1.0, 1.0)
    coupling = coo_matrix((value, (row, col)), (REGIONS, REGIONS)).tocsr()
    one = np.zeros(REGIONS, np.int32)
    parts = Parts(np.arange(REGIONS, dtype=np.int32), one, one, coupling + coupling.T, np.zeros(1, bool))
    surface = SimpleNamespace(roughness=np.full(REGIONS, roughness), spacing=np.ones(REGIONS))
    votes = Votes(np.where(wrong_votes, -0.4, 1.0), np.ones(REGIONS), np.zeros(REGIONS))
    return weigh(surface, votes, parts, np.zeros(1, bool))


def test_a_few_wrong_couplings_do_not_make_wrong_votes_count():
    through_a_hole = np.arange(REGIONS) < REGIONS // 10
    assert (grid(0.004, through_a_hole) > 0).all()


def test_votes_mend_what_wrong_couplings_spoil():
    assert (grid(0.3, np.zeros(REGIONS, bool)) > 0).mean() > 0.99


@pytest.mark.parametrize("whole", [True, False])
def test_winding_numbers_decide_where_noise_hides_walls_unless_surface_is_missing(monkeypatch, whole):
    by_winding = np.where(np.arange(REGIONS) % 2, -1.0, 1.0)
    monkeypatch.setattr(closed, "settle_by_winding", lambda *arguments: (by_winding, whole))
    found = grid(0.0, np.arange(REGIONS) < REGIONS // 10, roughness=1.0)
    np.testing.assert_array_equal(np.sign(found), by_winding if whole else np.ones(REGIONS))
