"""`jetnormal train`: a network from clouds with known normals, from meshes, or from procedural solids."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jetnormal.cli.derive import Given, with_options
from jetnormal.cli.options import Device, Json, Quiet, Threads, Verbose, set_verbosity
from jetnormal.errors import UsageError
from jetnormal.support.report import logger, print_json
from jetnormal.training.options import EXTENDABLE, DataOptions, TrainOptions

if TYPE_CHECKING:
    from jetnormal.training.recipe import Recipe

MOVABLE = ("folders", "validation")  # where the same data lie now


def _complete_recipe(text: str) -> list[str]:
    from jetnormal.training.recipe import recipe_names

    return [name for name in recipe_names() if name.startswith(text)]


@with_options
def train(
    data: Annotated[dict[str, Any], Given(DataOptions)],
    recipe: Annotated[
        str | None,
        typer.Option(
            "--recipe",
            "-r",
            metavar="NAME|FILE",
            help="Recipe of the training: network, data, losses, schedule.",
            show_default="cloudfit",
            autocompletion=_complete_recipe,
            rich_help_panel="Training",
        ),
    ] = None,
    *,
    training: Annotated[dict[str, Any], Given(TrainOptions, default="the recipe's")],
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change another setting of the recipe; repeatable.",
            rich_help_panel="Training",
        ),
    ] = None,
    show: Annotated[
        bool,
        typer.Option("--show", help="Print the recipe, every setting explained, and stop.", rich_help_panel="Training"),
    ] = False,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="RUN", help="Folder of the run.", rich_help_panel="Run")
    ] = Path("run"),
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Continue the run in RUN; --epochs may extend it.", rich_help_panel="Run"),
    ] = False,
    tensorboard: Annotated[
        bool, typer.Option("--tensorboard", help="Also write TensorBoard events into RUN.", rich_help_panel="Run")
    ] = False,
    device: Device = "auto",
    threads: Threads = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Train a network on clouds with known normals.

    They come from a folder in PCPNet's layout, from meshes, or from procedural solids.

    A recipe is a TOML file, or the name of a packaged one: cloudfit; deepfit, adafit and graphfit, each as
    -paper (with the paper's two additions), -baseline (without them) and -small (narrow, for a CPU); and pcpnet-paper,
    nestinet-paper, iternet and others, which docs/training.md lists.
    --recipe NAME --show prints one, from which you can start your own.

    RUN gets config.toml (the whole recipe), model.safetensors (for jetnormal estimate --model), metrics.csv and what
    --resume needs. It is saved every 45 seconds, after each epoch and on Ctrl-C. The same recipe on the same machine
    gives the same bytes, interrupted or not.

    \b
    Examples:
      jetnormal train --data meshes -o run
      jetnormal train -o run --resume
      jetnormal train --recipe cloudfit --initial cloudfit --data forest --epochs 5 --set learning_rate=5e-4 -o run
      jetnormal train --recipe graphfit-paper --data pcpnet -o run
      jetnormal train --recipe mine.toml --data meshes --data pcpnet --synthetic --weights 20,2,8 -o run
    """
    set_verbosity(quiet, verbose)
    from jetnormal.training.recipe import recipe_text

    if resume:
        if recipe is not None or settings or show:
            raise UsageError("--resume takes the recipe of the run: leave --recipe, --set and --show out")
        chosen = _resumed(out, data, training)
    else:
        chosen = _chosen(recipe or "cloudfit", data, training, settings or [])
    if show:
        typer.echo(recipe_text(chosen, explained=True), nl=False)
        return
    from jetnormal.training.train import train as run_training

    try:
        summary = run_training(chosen, out, resume=resume, device=device, threads=threads, tensorboard=tensorboard)
    except KeyboardInterrupt:
        if (out / "state.safetensors").is_file():
            logger.warning("jetnormal train -o %s --resume goes on", out)
        raise
    logger.info("the network is %s", summary["model"])
    if json:
        print_json(summary)


def _chosen(name: str, data: dict[str, Any], training: dict[str, Any], settings: list[str]) -> Recipe:
    """A recipe with the changes of the command line."""
    from jetnormal.training.recipe import make_recipe, merged, parse_changes, read_recipe, read_tables

    tables = merged(read_tables(name), parse_changes(settings, read_recipe(name).tables()))
    return make_recipe(merged(tables, {"data": data, "training": training}), f"{name}: ")


def _resumed(folder: Path, data: dict[str, Any], training: dict[str, Any]) -> Recipe:
    """The recipe of a run, with those changes that a run allows."""
    from jetnormal.training.recipe import make_recipe, merged
    from jetnormal.training.train import recipe_of_run

    foreign = [*(training.keys() - set(EXTENDABLE)), *(data.keys() - set(MOVABLE))]
    if foreign:
        raise UsageError(f"--resume takes the run's own {', '.join(sorted(foreign))}: leave it out")
    return make_recipe(merged(recipe_of_run(folder).tables(), {"data": data, "training": training}))
