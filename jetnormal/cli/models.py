"""`jetnormal models`: what is packaged, and what networks cost."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from jetnormal.cli.options import Device, Json, Quiet, Threads, Verbose, set_verbosity
from jetnormal.errors import UsageError
from jetnormal.networks.packaged import complete_network
from jetnormal.support.report import print_json

if TYPE_CHECKING:
    from jetnormal.evaluation.cost import Complexity
    from jetnormal.evaluation.tables import Table


def models(
    model: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME|FILE",
            help="Models to list.",
            show_default="all packaged ones",
            autocompletion=complete_network,
        ),
    ] = None,
    complexity: Annotated[
        bool,
        typer.Option("--complexity", help="List the networks of the paper instead, with random weights."),
    ] = False,
    measure: Annotated[
        bool, typer.Option("--measure/--no-measure", help="Measure the time that a point takes.")
    ] = True,
    device: Device = "auto",
    threads: Threads = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """List models: parameters, size, operations, time and error.

    GFLOP/point counts the matrix products for a patch, or for a cloud divided by its points; a multiply-add is two
    operations. ms/point is the whole estimation on this machine. RMSE is what the file records of its training: degrees
    on the validation clouds.

    \b
    Examples:
      jetnormal models
      jetnormal models run/model.safetensors --no-measure
      jetnormal models --complexity --json
    """
    set_verbosity(quiet, verbose)
    if complexity and model:
        raise UsageError("--complexity lists the paper's networks: leave it or the models out")
    from jetnormal.evaluation.cost import of_model, of_packaged, of_paper

    if complexity:
        found = of_paper(measure=measure, device=device, threads=threads)
    elif model:
        found = [of_model(name, measure=measure, device=device, threads=threads) for name in model]
    else:
        found = of_packaged(measure=measure, device=device, threads=threads)
    if json:
        print_json({"models": [asdict(one) for one in found]})
        return
    from jetnormal.evaluation.tables import print_tables

    print_tables([_table("the paper's networks" if complexity else "models", found)], sys.stdout)


def _table(title: str, found: list[Complexity]) -> Table:
    """One row a network; columns that are empty in all rows are left out."""
    from jetnormal.evaluation.tables import Table

    columns: list[tuple[str, str, list[float | None]]] = [
        ("parameters (M)", "{:.3f}", [one.parameters / 1e6 for one in found]),
        ("MB", "{:.2f}", [one.megabytes for one in found]),
        ("GFLOP/point", "{:.3g}", [one.gflop_per_point for one in found]),
        ("ms/point", "{:.3g}", [one.ms_per_point for one in found]),
        ("RMSE (°)", "{:.2f}", [one.rmse for one in found]),
    ]
    columns = [column for column in columns if any(value is not None for value in column[2])]
    rows = [list(row) for row in zip(*(values for *_, values in columns), strict=True)]
    names = [f"{one.name}: {one.architecture}" for one in found]
    formats: list[Callable[[float], str]] = [pattern.format for _, pattern, _ in columns]
    return Table(title, ["model", *(name for name, *_ in columns)], names, rows, formats, [True] * len(columns))
