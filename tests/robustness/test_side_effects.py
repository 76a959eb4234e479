"""What a call leaves behind in the process, and what a forked process can do."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import pytest
import torch
from shapes import sphere

import jetnormal

FORKED = """
import os, sys
import numpy as np
import jetnormal

points = np.random.default_rng(0).normal(size=(400, 3))
points /= np.linalg.norm(points, axis=1, keepdims=True)
before = jetnormal.estimate(points, model=sys.argv[1])
child = os.fork()
if child == 0:
    after = jetnormal.estimate(points, model=sys.argv[1])
    os._exit(0 if np.allclose(before, after, atol=1e-3) else 1)  # one thread sums in another order
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
@pytest.mark.parametrize("model", ["cloudfit", "deepfit-small"])
def test_a_forked_child_estimates_as_its_parent(model):
    """OpenMP's threads stay in the parent: a child that waits for them never ends."""
    subprocess.run([sys.executable, "-c", FORKED, model], check=True, timeout=300)


@pytest.mark.parametrize("model", ["cloudfit", "jet"])
def test_an_estimate_leaves_threads_and_random_numbers_alone(model):
    torch.manual_seed(0)
    state = torch.get_rng_state()
    threads = []
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        jetnormal.estimate(sphere(300), model=model)
        other = threading.Thread(target=lambda: threads.append(torch.get_num_threads()))
        other.start()
        other.join()
    finally:
        torch.set_num_threads(before)
    assert threads == [2]
    assert torch.equal(torch.get_rng_state(), state)
