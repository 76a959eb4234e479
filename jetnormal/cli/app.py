"""The command line: registers the commands and turns failures into exit codes."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from jetnormal._version import __version__
from jetnormal.cli.dataset import dataset
from jetnormal.cli.derive import GroupedCommand
from jetnormal.cli.estimate import estimate
from jetnormal.cli.evaluate import evaluate
from jetnormal.cli.export import export
from jetnormal.cli.failures import report_failure, report_json
from jetnormal.cli.models import models
from jetnormal.cli.preview import preview
from jetnormal.cli.reconstruct import reconstruct
from jetnormal.cli.train import train
from jetnormal.errors import INTERRUPTED, ResourceError
from jetnormal.support.extras import named_extras

LEAST_ADDRESS_SPACE = 700 * 2**20  # bytes; with less, LLVM or OpenBLAS may abort the process instead of raising

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help: importing Rich would take longer than all the rest
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
)
app.command(cls=GroupedCommand)(estimate)
app.command(cls=GroupedCommand)(reconstruct)
app.command(cls=GroupedCommand)(preview)
app.command(cls=GroupedCommand)(evaluate)
app.command(cls=GroupedCommand)(train)
app.command(cls=GroupedCommand)(models)
app.command(cls=GroupedCommand)(export)
app.command(cls=GroupedCommand)(dataset)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"jetnormal {__version__}")
        raise typer.Exit


@app.callback()
def describe(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Oriented surface normals for point clouds.

    \b
    Examples:
      jetnormal estimate scan.ply -o scan_normals.ply
      jetnormal reconstruct scan.ply -o mesh.ply
      jetnormal preview mesh.ply -o picture.png
      jetnormal evaluate --data pcpnet --model cloudfit --model pca:k=112
      jetnormal train --data meshes -o run
      jetnormal dataset --synthetic 8 -o benchmark
      jetnormal estimate --help

    \b
    Exit codes:
      0 done, 1 closed pipe or an error to report, 2 wrong usage, 3 unusable file,
      4 unusable model, 5 not enough memory, or no such device or library, 130 interrupted
    """
    _check_address_space()


def _check_address_space() -> None:
    """Refuse a limit on memory (`ulimit -v`) under which compiled libraries abort as they are loaded."""
    try:
        import resource
    except ImportError:  # Windows
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < LEAST_ADDRESS_SPACE:
        raise ResourceError(
            f"the limit on memory (ulimit -v {limit // 1024}) is too low to load the libraries; "
            f"set it to {LEAST_ADDRESS_SPACE // 1024} or more"
        )


def program() -> NoReturn:
    """Run the command line and end the process at once.

    By then everything is written and closed, and an ordinary end of the interpreter takes another third of a second.
    """
    code: Any = 0
    try:
        main()
    except SystemExit as end:
        code = end.code
    except KeyboardInterrupt:  # while a failure is being reported
        code = INTERRUPTED
    with suppress(OSError):  # nobody reads what is left in it
        sys.stderr.flush()
    os._exit(code if isinstance(code, int) else code is not None)


def main() -> None:
    """Run the command line; it ends by SystemExit with the exit code."""
    _replace_closed_streams()
    _clean_up_when_ended()
    try:
        with named_extras():
            code = app(prog_name="jetnormal", standalone_mode=False) or 0  # ends here with 1 on a closed pipe
        if code == INTERRUPTED:
            report_json("interrupted", code)
        sys.stdout.flush()  # a full disk behind stdout shows here, where it can be handled
        sys.exit(code)
    except Exception as error:
        sys.exit(report_failure(error))


def _replace_closed_streams() -> None:
    """Open the null device for stdout and stderr where whoever started the program closed them (`2>&-`).

    Nobody reads them then, and the next file opened, perhaps the output, must not become stderr in their place.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115 - as long as the program runs


def _clean_up_when_ended() -> None:
    """Leave by way of an exception, which removes unfinished files, when the process or its terminal is ended."""

    def leave(number: int, _: Any) -> None:
        sys.exit(128 + number)

    for name in ("SIGTERM", "SIGHUP"):  # Windows has no SIGHUP; nohup ignores it
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, leave)
