"""`jetnormal export`: a patch network as an ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jetnormal.cli.options import Json, Quiet, Verbose, set_verbosity
from jetnormal.networks.packaged import complete_network
from jetnormal.support.report import logger, print_json


def export(
    model: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE", help="A packaged patch network, or a model file.", autocompletion=complete_network
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUTPUT", help="File to write: .onnx.")],
    force: Annotated[bool, typer.Option("--force", help="Overwrite OUTPUT where it exists.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write a patch network as ONNX, for programs without PyTorch.

    The graph takes patches, (B, k, 3) float32: the k nearest points of each query, the query first, in the frame that
    jetnormal.geometry.patches.build_patches describes. It returns their normals in that frame, signs arbitrary.
    cloudfit, which looks at whole clouds, cannot be exported.

    \b
    Examples:
      jetnormal export deepfit-small -o deepfit.onnx
      jetnormal export run/model.safetensors -o mine.onnx --json
    """
    set_verbosity(quiet, verbose)
    from jetnormal.jobs.export import export_model

    summary = export_model(model, output, overwrite=force)
    logger.info("wrote %s: patches of %d points, opset %d", output, summary["neighbors"], summary["opset"])
    if json:
        print_json(summary)
