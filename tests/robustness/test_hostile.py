from __future__ import annotations

import pytest
from robustness.hostile import Case, cases, score

CASES = list(cases(1200))
PARAMETERS = [pytest.param(case, id=case.name) for case in CASES]
STRAYS_AND_COPIES = [param for param in PARAMETERS if "point" in param.id or "1e6" in param.id]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("case", PARAMETERS)
def test_jets_on_hostile_clouds(case: Case):
    assert score(case, "jet").faults == ()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("case", STRAYS_AND_COPIES)
def test_the_network_on_strays_and_copies(case: Case):
    assert score(case, "cloudfit").faults == ()
