"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from jetnormal.errors import UsageError
from jetnormal.support.report import configure_logging


def parse_vector(text: str) -> tuple[float, float, float]:
    """Turn "X,Y,Z" into three numbers."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not X,Y,Z: three numbers with commas between them") from None
    return x, y, z


def _parse_names(text: str) -> tuple[str, ...]:
    """Turn "X,Y,Z" into three names."""
    names = tuple(part.strip() for part in text.split(","))
    if len(names) != 3 or not all(names):
        raise typer.BadParameter(f"{text!r} is not X,Y,Z: three names of attributes with commas between them")
    return names


Viewpoint = Annotated[
    Any, typer.Option(parser=parse_vector, metavar="X,Y,Z", help="Position that the normals look towards.")
]
ViewpointAttribute = Annotated[
    Any, typer.Option(parser=_parse_names, metavar="X,Y,Z", help="Attributes that hold this position for each point.")
]
Device = Annotated[str, typer.Option(metavar="auto|cpu|cuda[:N]", help="Where the network runs.")]
Threads = Annotated[int | None, typer.Option(min=1, metavar="T", help="CPU threads.", show_default="all cores")]
Json = Annotated[bool, typer.Option("--json", help="Print a summary as one JSON object on stdout.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show errors only.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Show debug messages, and tracebacks of errors.")]


def set_verbosity(quiet: bool, verbose: bool) -> None:
    """Apply `-q` and `-v`.

    Raises:
        UsageError: both were given.
    """
    if quiet and verbose:
        raise UsageError("-q and -v contradict each other: give one of them")
    configure_logging(int(verbose) - int(quiet))
