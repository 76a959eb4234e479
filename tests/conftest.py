from __future__ import annotations

import logging

import pytest

from jetnormal import report


@pytest.fixture(autouse=True)
def default_logging():
    """Give every test, and those after it, the logger of a program that has not configured it."""
    yield
    report.logger.handlers.clear()
    report.logger.propagate = True
    report.logger.setLevel(logging.NOTSET)
