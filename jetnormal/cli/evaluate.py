"""`jetnormal evaluate`: the errors of models on clouds with known normals."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from jetnormal.cli.derive import one_of, with_options
from jetnormal.cli.options import Json, Quiet, Verbose, set_verbosity
from jetnormal.errors import UsageError
from jetnormal.evaluation.options import EvaluateOptions
from jetnormal.jobs.parsing import complete_model, parse_direction
from jetnormal.support.report import logger, print_json


@with_options
def evaluate(
    data: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder in PCPNet's layout: NAME.xyz, NAME.normals, NAME.pidx.",
            rich_help_panel="Data",
        ),
    ],
    options: EvaluateOptions,
    model: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME|FILE",
            help="pca, jet, traditional, a packaged network or a model file; repeatable.",
            autocompletion=complete_model,
            rich_help_panel="Data",
        ),
    ] = None,
    plots: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Draw error heatmaps and curves into this folder.", rich_help_panel="Output"),
    ] = None,
    plots_format: Annotated[
        Any,
        typer.Option(help="Format of the pictures.", rich_help_panel="Output", **one_of("png", "pdf", "svg")),
    ] = "png",
    up: Annotated[
        Any,
        typer.Option(
            parser=parse_direction,
            metavar="X,Y,Z",
            help="Direction that is up in the heatmaps.",
            rich_help_panel="Output",
        ),
    ] = "0,1,0",
    force: Annotated[
        bool,
        typer.Option(
            "--force", help="Overwrite the pictures and the normals of an earlier evaluation.", rich_help_panel="Output"
        ),
    ] = False,
    table: Annotated[
        Any,
        typer.Option(
            "--format",
            help="Format of the tables: rich, markdown, latex or csv.",
            show_default="rich",
            rich_help_panel="Output",
            **one_of("rich", "markdown", "latex", "csv") | {"metavar": "NAME"},
        ),
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Compare models on clouds with known normals.

    The protocol is that of the PCPNet benchmark: the error of a cloud is the RMSE, in degrees, of the angle
    between estimated and true normals without signs, over the points in NAME.pidx (all where there is none).
    Clouds are averaged by category, and the categories once more. A list testset_CATEGORY.txt in DIR makes a
    category; PCPNet's are known by the ends of the names, too.

    PGP is the share of points whose error is below 5 or 10 degrees, and AUC30 the area under the curve of that
    share up to 30 degrees. The RMSE to clean compares noisy clouds with the nearest normal of their clean twin.
    --orient adds the RMSE with signs and the share of right signs; if flipping the whole cloud makes them better, it is
    flipped. Points/s is the number of estimated normals over the seconds from points to normals. Use --all-points to
    measure speed: with the few points of NAME.pidx, work that is done once for each cloud takes most of the time.

    Settings of a model follow a colon: k, order (jet) and iterations (networks), or small, medium or large for the
    neighborhoods of the literature (pca: 18, 112, 450 points; jet of order 2: 18, 122, 450). --model traditional
    compares these six.

    --results keeps estimated normals. They are used again if the model file, the cloud files, the settings and the
    version of jetnormal are the same.

    \b
    Examples:
      jetnormal evaluate --data pcpnet --model cloudfit
      jetnormal evaluate --data pcpnet --model cloudfit --model pca:medium --model jet:medium --plots plots
      jetnormal evaluate --data pcpnet --model traditional --format markdown
      jetnormal evaluate --data pcpnet --list testset_no_noise.txt --model run/model.safetensors --json
      jetnormal evaluate --data pcpnet --model cloudfit --results kept --format csv > scores.csv
      jetnormal evaluate --data pcpnet --model cloudfit --normals theirs=their_results --format latex
      jetnormal evaluate --data pcpnet --model cloudfit --plots figures --plots-format pdf --up 0,0,1
    """
    set_verbosity(quiet, verbose)
    if json and table:
        raise UsageError(f"--json contradicts --format {table}: leave one of them out")
    from jetnormal.evaluation.plots import check_plots, write_plots
    from jetnormal.evaluation.protocol import evaluate
    from jetnormal.evaluation.tables import comma_separated, latex, make_tables, markdown, print_tables

    if plots:
        check_plots(plots, overwrite=force, suffix=plots_format)
    evaluation = evaluate(data, model or [], replace(options, overwrite=force, z_angles=plots is not None))
    if json:
        print_json(evaluation.summary())
    elif table == "csv":
        typer.echo(comma_separated(evaluation), nl=False)
    elif table in ("markdown", "latex"):
        typer.echo((markdown if table == "markdown" else latex)(make_tables(evaluation)), nl=False)
    else:
        print_tables(make_tables(evaluation), sys.stdout)
    if plots:
        paths = write_plots(evaluation, plots, plots_format, up)
        logger.info("%d pictures in %s", len(paths), plots)
