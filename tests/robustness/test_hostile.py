from __future__ import annotations

import pytest
from robustness.hostile import Case, cases, score

CASES = list(cases(1200))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_jets_on_hostile_clouds(case: Case):
    assert score(case, "jet").faults == ()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "case", [case for case in CASES if "point" in case.name or "1e6" in case.name], ids=lambda case: case.name
)
def test_the_network_on_strays_and_copies(case: Case):
    assert score(case, "cloudfit").faults == ()
