from __future__ import annotations

import pytest
from robustness.hostile import Case, cases, score

CASES = list(cases(1200))


# Signs are chosen for the whole cloud at once, on pictures scaled by all of it.
APART = pytest.mark.xfail(reason="the signs of an object depend on how far away another one is", strict=False)
MARKED = [
    pytest.param(case, id=case.name, marks=[APART] if case.name.startswith("two spheres") else []) for case in CASES
]
STRAYS_AND_COPIES = [param for param in MARKED if "point" in param.id or "1e6" in param.id]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("case", MARKED)
def test_jets_on_hostile_clouds(case: Case):
    assert score(case, "jet").faults == ()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("case", STRAYS_AND_COPIES)
def test_the_network_on_strays_and_copies(case: Case):
    assert score(case, "cloudfit").faults == ()
