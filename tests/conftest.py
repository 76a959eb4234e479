from __future__ import annotations

import logging

import numpy as np
import pytest

from jetnormal.support import report


@pytest.fixture(autouse=True)
def default_logging():
    """Give every test, and those after it, the logger of a program that has not configured it."""
    yield
    report.logger.handlers.clear()
    report.logger.propagate = True
    report.logger.setLevel(logging.NOTSET)


@pytest.fixture
def depth_picture() -> np.ndarray:
    """(19600, 3): what a noisy depth camera at the origin, looking along z, sees of three balls before a wall."""
    side = np.linspace(-0.6, 0.6, 140)
    sights = np.stack([*np.meshgrid(side, side), np.ones((140, 140))], axis=-1).reshape(-1, 3)
    square = (sights**2).sum(axis=1)
    depth = np.full(len(sights), 3.0)
    for *middle, radius in ((-0.5, 0.2, 2.0, 0.4), (0.4, -0.3, 1.2, 0.25), (0.3, 0.5, 2.4, 0.35)):
        along = sights @ middle
        inside = along**2 - square * (np.dot(middle, middle) - radius**2)
        depth = np.where(inside > 0, np.minimum(depth, (along - np.sqrt(np.maximum(inside, 0))) / square), depth)
    return sights * (depth + np.random.default_rng(0).normal(scale=0.003, size=len(depth)))[:, None]
