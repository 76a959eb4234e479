"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

from jetnormal.cli.failures import spell
from jetnormal.errors import UsageError
from jetnormal.support.options import MAX_THREADS
from jetnormal.support.report import configure_logging

CLOUDS = ".ply .pcd .las .laz .e57 .ptx .pts .xyz .xyzn .txt .asc .csv .npy .npz"  # all that `formats` reads

Device = Annotated[str, typer.Option(metavar="auto|cpu|cuda[:N]", help="Where the network runs.")]
Threads = Annotated[
    int | None, typer.Option(min=1, max=MAX_THREADS, metavar="T", help="CPU threads.", show_default="all cores")
]
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
    configure_logging(int(verbose) - int(quiet), spell)
