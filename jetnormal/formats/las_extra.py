"""What a LAS file holds besides its points, and the library that reads it."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jetnormal.formats.las_records import Record
from jetnormal.support.extras import require

WITHOUT_WAVES = {9: 6, 10: 8}
"""The point formats whose wave packets lazrs reads and writes wrongly (0.8.2), and the same ones without packets."""


@dataclass(frozen=True)
class LasExtra:
    """What a LAS file held besides its points' numbers.

    Attributes:
        header: laspy's header, without the records.
        records: of the header (VLRs).
        late_records: behind the points (EVLRs).
        spelling: the file's own names of the normals, by ``nx ny nz``.
        copc: whether the points were in the order of an octree.
    """

    header: Any
    records: tuple[Record, ...]
    late_records: tuple[Record, ...]
    spelling: dict[str, str]
    copc: bool

    def losses(self) -> list[str]:
        """Name what other formats cannot hold."""
        count = len(self.records) + len(self.late_records)
        kept = f"the LAS header and its {count} records, which tell the coordinate system," if count else "the header"
        return [f"{kept} is not kept"]


def import_laspy(path: Path | str) -> Any:
    """Import laspy, once lazrs is found to be there, too.

    Raises:
        ResourceError: one of them is not installed.
    """
    require("lazrs", str(path))
    logging.getLogger("laspy").setLevel(logging.CRITICAL)  # it logs what it then raises
    return require("laspy", str(path))
