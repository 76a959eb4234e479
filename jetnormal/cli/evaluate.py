"""`jetnormal evaluate`: the errors of models on clouds with known normals."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jetnormal.cli.options import Device, Json, Quiet, Threads, Verbose, set_verbosity
from jetnormal.report import print_json

if TYPE_CHECKING:
    from jetnormal.evaluation import Evaluation, Scores


def evaluate(
    data: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder in PCPNet's layout: NAME.xyz, NAME.normals, NAME.pidx.")
    ],
    model: Annotated[
        list[str],
        typer.Option(
            metavar="NAME|FILE", help="pca, jet, a packaged network or a checkpoint; repeat it to compare several."
        ),
    ],
    list_file: Annotated[
        str | None,
        typer.Option(
            "--list", metavar="FILE", help="List of the clouds, in DIR.", show_default="testset_all.txt, else all"
        ),
    ] = None,
    device: Device = "auto",
    threads: Threads = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Compare models on clouds with known normals.

    The protocol is that of the PCPNet benchmark: the error of a cloud is the RMSE, in degrees, of the angle
    between estimated and true normals without signs, over the points in NAME.pidx (all where there is none).
    Clouds are averaged by category, and the categories once more. PGP is the share of points whose error is
    below 5 or 10 degrees.

    Settings of a model follow a colon: k, order (jet) and iterations (networks).

    \b
    Examples:
      jetnormal evaluate --data pcpnet --model deepfit
      jetnormal evaluate --data pcpnet --model deepfit --model pca:k=112 --model jet:k=122,order=2
      jetnormal evaluate --data pcpnet --list testset_no_noise.txt --model run/model.safetensors --json
    """
    set_verbosity(quiet, verbose)
    from jetnormal.evaluation import evaluate

    evaluation = evaluate(data, model, list_file=list_file, device=device, threads=threads)
    if json:
        print_json(evaluation.summary())
    else:
        typer.echo("\n\n".join(tables(evaluation)))


def tables(evaluation: Evaluation) -> list[str]:
    """Tables of RMSE, PGP5, PGP10 and speed, one column per model."""
    measures: dict[str, Callable[[Scores], str]] = {
        "RMSE (degrees)": lambda scores: f"{scores.rmse:.2f}",
        "PGP5 (%)": lambda scores: f"{100 * scores.pgp5:.1f}",
        "PGP10 (%)": lambda scores: f"{100 * scores.pgp10:.1f}",
    }
    models = evaluation.models
    found = []
    for title, show in measures.items():
        rows = [[title, *(one.model for one in models)]]
        rows += [[name, *(show(one.categories[name]) for one in models)] for name in models[0].categories]
        rows.append(["average", *(show(one.average) for one in models)])
        found.append(rows)
    found.append([["points/s", *(f"{one.points_per_second:,.0f}" for one in models)]])
    widths = [max(len(row[column]) for rows in found for row in rows) for column in range(1 + len(models))]
    return ["\n".join(_line(row, widths) for row in rows) for rows in found]


def _line(cells: list[str], widths: list[int]) -> str:
    """The first cell to the left and the others to the right of their columns."""
    others = (cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True))
    return "  ".join([cells[0].ljust(widths[0]), *others])
