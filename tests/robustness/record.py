"""Tables of benchmarks/robustness.md, written by the programs that measure them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def record_rows(document: Path, table: str, rows: Sequence[tuple[str, Sequence[str]]]) -> None:
    """Replace rows of a table, or add them.

    Args:
        document: Markdown file.
        table: stands below the line ``<!-- TABLE -->``, with an empty line and its two head lines.
        rows: name and cells of each; a row of the same name is replaced.
    """
    lines = document.read_text().splitlines()
    first = lines.index(f"<!-- {table} -->") + 4  # an empty line and the head follow
    end = next((at for at in range(first, len(lines)) if not lines[at].startswith("|")), len(lines))
    kept = {line.split("|")[1].strip(): line for line in lines[first:end]}
    kept |= {name: f"| {' | '.join([name, *cells])} |" for name, cells in rows}
    document.write_text("\n".join([*lines[:first], *kept.values(), *lines[end:]]) + "\n")
