from __future__ import annotations

import io
import json
import logging
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest

from jetnormal import __version__
from jetnormal.support import report


@pytest.mark.parametrize(
    ("verbosity", "shown"),
    [
        (-1, ["error"]),
        (0, ["information", "warning", "error"]),
        (1, ["detail", "information", "warning", "error"]),
    ],
)
def test_verbosity_decides_what_reaches_stderr(verbosity, shown, capsys):
    report.configure_logging(verbosity)
    report.configure_logging(verbosity)  # a second call must not double the lines
    report.logger.debug("detail")
    report.logger.info("information")
    logging.getLogger("jetnormal.formats").warning("warning")
    report.logger.error("error")
    captured = capsys.readouterr()
    assert [line.split()[-1] for line in captured.err.splitlines()] == shown
    assert captured.out == ""


def test_warning_names_its_level(capsys):
    report.configure_logging(0)
    report.logger.warning("no colors in %s", "scan.xyz")
    assert capsys.readouterr().err == "jetnormal: warning: no colors in scan.xyz\n"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_on_a_terminal_shows_rate_and_time_left(monkeypatch):
    report.configure_logging(0)
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with report.progress("estimating", 1000) as advance:
        advance(400)
        time.sleep(0.15)  # the bar is drawn ten times a second
        advance(100, "loss 0.25")
        time.sleep(0.15)
    assert "estimating" in terminal.getvalue()
    assert "50 %" in terminal.getvalue()
    assert "points/s" in terminal.getvalue()
    assert "left" in terminal.getvalue()
    assert "loss 0.25" in terminal.getvalue()


def test_progress_without_terminal_logs_sparse_lines(monkeypatch, capsys):
    report.configure_logging(0)
    clock = iter([0.0, 4.0, 12.0, 15.0, 20.0])
    monkeypatch.setattr(report.time, "monotonic", lambda: next(clock))
    with report.progress("estimating", 1000) as advance:
        for count in (100, 500, 100, 300):
            advance(count)
    assert capsys.readouterr().err == "jetnormal: estimating: 60 %, 50 points/s, 8 s left\n"


def test_progress_line_ends_with_the_note(monkeypatch, capsys):
    report.configure_logging(0)
    clock = iter([0.0, 20.0])
    monkeypatch.setattr(report.time, "monotonic", lambda: next(clock))
    with report.progress("epoch 1", 100, unit="patches") as advance:
        advance(50, "loss 0.25")
    assert capsys.readouterr().err == "jetnormal: epoch 1: 50 %, 2.5 patches/s, 20 s left, loss 0.25\n"


@pytest.mark.parametrize("configured", [True, False])
def test_progress_is_silent_when_quiet_or_used_as_library(configured, monkeypatch):
    if configured:
        report.configure_logging(-1)
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    with report.progress("estimating", 10) as advance:
        advance(10)
    assert terminal.getvalue() == ""


class ZMQInteractiveShell:
    """What a notebook's cells run in, by its name."""


@pytest.mark.parametrize(("total", "shown"), [(10, False), (report.NOTEBOOK_LEAST, True)])
def test_a_notebook_has_a_bar_for_long_work(total, shown, monkeypatch):
    monkeypatch.setitem(sys.modules, "IPython", types.SimpleNamespace(get_ipython=ZMQInteractiveShell))
    bars = []

    def bar(description, total, unit):
        bars.append(description)
        yield lambda count, note="": None

    monkeypatch.setattr(report, "_bar", bar)
    with report.progress("estimating", total) as advance:
        advance(total)
    assert bars == (["estimating"] if shown else [])


def test_stage_timer_adds_up_and_keeps_order():
    timer = report.StageTimer()
    with timer.stage("read"):
        time.sleep(0.02)
    with timer.stage("fit"):
        pass
    first = timer.seconds["read"]
    with timer.stage("read"):
        time.sleep(0.02)
    assert list(timer.seconds) == ["read", "fit"]
    assert first >= 0.02
    assert timer.seconds["read"] >= first + 0.02


def test_stage_timer_counts_a_stage_that_fails():
    timer = report.StageTimer()
    with pytest.raises(ValueError, match="bad"), timer.stage("read"):
        raise ValueError("bad")
    assert timer.seconds["read"] > 0


def test_peak_memory_covers_an_allocation():
    block = np.ones(25_000_000)  # 200 MB
    peak = report.peak_memory_mb()
    if peak is None:
        pytest.skip("this system does not tell")
    assert block.nbytes / 1e6 < peak < 64_000


def test_json_is_headed_by_its_version_and_takes_numpy_and_paths(capsys):
    summary = {"output": Path("a.ply"), "points": np.int64(3), "spread": np.array([1.5, np.nan]), "share": 1 / 3}
    report.print_json(summary)
    captured = capsys.readouterr()
    assert json.loads(captured.out) == {
        "jetnormal": __version__, "schema": 1, "output": "a.ply", "points": 3, "spread": [1.5, None], "share": 0.333333,
    }  # fmt: skip
    assert captured.err == ""
