"""Report to the user: log lines and progress on stderr, a JSON summary on stdout, timings."""

from __future__ import annotations

import json
import logging
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from typing import Any, Protocol

from jetnormal._version import __version__

logger = logging.getLogger("jetnormal")

JSON_SCHEMA = 1  # raised when a field is renamed, removed or changes its meaning; new fields may come at any time
JSON_DIGITS = 6  # significant
NOTEBOOK_LEAST = 20_000  # units of work, below which a notebook shows no bar
LOG_INTERVAL = 10.0  # seconds between the progress lines of a job that no terminal watches


class Advance(Protocol):
    """Tell a progress display that `count` more units are done, and what to show beside it, such as a loss."""

    def __call__(self, count: int, note: str = "") -> None: ...


class _StderrHandler(logging.Handler):
    """Write each record to the sys.stderr of that moment, which a progress bar may have redirected.

    A full disk or a closed pipe behind it loses messages, but not the job.
    """

    def __init__(self) -> None:
        super().__init__()
        self.spell: Callable[[str], str] = str

    def emit(self, record: logging.LogRecord) -> None:
        level = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        with suppress(OSError):
            sys.stderr.write(f"jetnormal: {level}{self.spell(self.format(record))}\n")
            sys.stderr.flush()


def configure_logging(verbosity: int, spell: Callable[[str], str] = str) -> None:
    """Send the package's log to stderr.

    Args:
        verbosity: errors only (-1), information too (0), or debug messages too (1).
        spell: applied to each message.
    """
    handler = next((each for each in logger.handlers if isinstance(each, _StderrHandler)), None)
    if handler is None:
        handler = _StderrHandler()
        logger.addHandler(handler)
        logger.propagate = False
    handler.spell = spell
    level = logging.ERROR if verbosity < 0 else logging.INFO if verbosity == 0 else logging.DEBUG
    logger.setLevel(level)


_shown = False
"""Whether some progress is on the screen now; a second one would overwrite it."""


@contextmanager
def progress(description: str, total: int, unit: str = "points") -> Iterator[Advance]:
    """Show how far a loop is, how fast, and how long it still needs; yield the function that advances it.

    On a terminal this is a bar that vanishes when done, elsewhere a log line every ten seconds. Nothing is
    shown where the package does not log information: under `-q`, and in programs that use it as a library; nor
    within another loop that is shown. But a notebook has the bar for long work.

    Args:
        description: what is being done, such as "estimating normals".
        total: number of units in all.
        unit: plural name of what is counted.
    """
    global _shown
    in_notebook = _in_notebook()
    wanted = logger.isEnabledFor(logging.INFO) or (in_notebook and total >= NOTEBOOK_LEAST)
    if _shown or not wanted:
        yield lambda count, note="": None
        return
    _shown = True
    try:
        if sys.stderr.isatty() or in_notebook:
            yield from _bar(description, total, unit)
        else:
            yield _log_lines(description, total, unit)
    finally:
        _shown = False


def _in_notebook() -> bool:
    """Whether the caller is a cell of Jupyter, or of something like it, which can show a bar."""
    ipython: Any = sys.modules.get("IPython")
    if ipython is None or type(ipython.get_ipython()).__name__ != "ZMQInteractiveShell":
        return False
    return find_spec("ipywidgets") is not None  # Rich draws with it, and warns where it is missing


def _bar(description: str, total: int, unit: str) -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
    from rich.text import Text

    class RateColumn(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(f"{_rate(task.speed or 0)} {unit}/s")

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        RateColumn(),
        TimeRemainingColumn(),
        TextColumn("left"),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(description, total=total, note="")
        yield lambda count, note="": bar.update(task, advance=count, note=note)


def _rate(rate: float) -> str:
    """A rate as a text: slow ones, as of large crops, with a digit behind the point."""
    return f"{rate:,.0f}" if rate >= 10 else f"{rate:.1f}"


def _log_lines(description: str, total: int, unit: str) -> Advance:
    start = last = time.monotonic()
    done = 0

    def advance(count: int, note: str = "") -> None:
        nonlocal last, done
        done += count
        now = time.monotonic()
        if now - last < LOG_INTERVAL or done >= total:
            return
        last = now
        rate = done / (now - start)
        left = (total - done) / rate if rate else float("inf")
        line = f"{description}: {100 * done / total:.0f} %, {_rate(rate)} {unit}/s, {left:.0f} s left"
        logger.info("%s", f"{line}, {note}" if note else line)

    return advance


class StageTimer:
    """Wall-clock seconds of a job's stages, in the order in which they first began.

    >>> timer = StageTimer()
    >>> with timer.stage("read"):
    ...     cloud = read(path)
    >>> timer.seconds
    {'read': 0.02}
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the body; a stage that is entered again adds up."""
        self.seconds.setdefault(name, 0.0)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] += time.perf_counter() - start
            logger.debug("%s: %.2f s", name, self.seconds[name])


def peak_memory_mb() -> float | None:
    """Most memory this process has held so far, in MB (10^6 bytes); None where the system does not tell."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 1 if sys.platform == "darwin" else 1024  # macOS counts bytes, the others KiB
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def print_json(summary: Mapping[str, Any]) -> None:
    """Print one JSON object on stdout, headed by the version of the program and of the schema (docs/json.md)."""
    content = {"jetnormal": __version__, "schema": JSON_SCHEMA, **summary}
    sys.stdout.write(json.dumps(_plain(content), indent=2, allow_nan=False) + "\n")
    sys.stdout.flush()  # a closed pipe shows here, where it can be handled, and not at exit


def _plain(value: Any) -> Any:
    """Convert a value for JSON: NumPy scalars and arrays to numbers with six digits, NaN to null, paths to text."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{JSON_DIGITS}g}") if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)
