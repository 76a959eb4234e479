"""The metrics of a training run as a table, one row an epoch."""

from __future__ import annotations

import csv
import math
from pathlib import Path

from jetnormal.formats.atomic import atomic_write


class Metrics:
    """A CSV file that grows by a row an epoch.

    Args:
        path: of the file; the first row makes it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def append(self, row: dict[str, float]) -> None:
        """Append the metrics of an epoch; the cell of one that is not a number stays empty."""
        known = {name: value for name, value in row.items() if not math.isnan(value)}
        cells = {name: value if isinstance(value, int) else f"{value:.6g}" for name, value in known.items()}
        with self._path.open("a", newline="") as stream:
            writer = csv.DictWriter(stream, self._columns() or row, lineterminator="\n")
            if stream.tell() == 0:
                writer.writeheader()
            writer.writerow(cells)

    def last(self) -> dict[str, float]:
        """Return the metrics of the last epoch; none before the first."""
        if not self._path.exists():
            return {}
        with self._path.open(newline="") as stream:
            *_, last = [{}, *csv.DictReader(stream)]
        return {name: int(value) if value.isdigit() else float(value) for name, value in last.items() if value}

    def keep(self, epochs: int) -> None:
        """Remove the rows after so many epochs, which a resumed run will do again."""
        if self._path.exists():
            lines = self._path.read_text().splitlines(keepends=True)
            with atomic_write(self._path, overwrite=True) as stream:
                stream.write("".join(lines[: epochs + 1]).encode())  # a header and a row an epoch

    def clear(self) -> None:
        """Remove the file."""
        self._path.unlink(missing_ok=True)

    def _columns(self) -> list[str]:
        """The columns so far: a resumed run has its loss terms in another order."""
        if not self._path.exists():
            return []
        with self._path.open(newline="") as stream:
            return next(csv.reader(stream), [])
