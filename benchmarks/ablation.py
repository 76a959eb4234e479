"""Train and evaluate the networks of a plan, and write its tables: the paper's, or those of a small budget.

    jetnormal dataset --synthetic 4 -o benchmark
    python benchmarks/ablation.py benchmarks/ablation.toml -o ablation
    python benchmarks/ablation.py benchmarks/paper/additions.toml -o paper      # with PCPNet in pcpnet/ and a GPU

A plan is a TOML file. Each row of a table is a recipe of `jetnormal train` with some settings changed; equal recipes
are trained once, also those of several plans with the same folder. An interrupted run goes on when it is started again.
The folder gets NETWORK/ with the run of each network, and PLAN.md with the tables as far as they are known. With --show
the rows are printed, each with the folder of its network, and nothing is trained.

    [test]                   # clouds in PCPNet's layout
    data = "benchmark"
    list = "testset_all.txt"
    [changes.TABLE]          # what all recipes have in common
    [[table]]                # a row for each combination of the values below
    title = "Order of the jet"
    recipe = "deepfit-paper"
    additions = ["none", "both"]
    order = [1, 2, 3]        # any setting of the recipe

`additions` are the paper's: "none", "z" (z-direction transform), "correction" (normal error estimation), "both".
`iterations` are those of the evaluation, else the network's own. `measure` is "rmse", or a list with "pgp5" and
"pgp10". Over a list of `seeds` a row tells the mean and the standard deviation.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import statistics
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jetnormal import evaluate
from jetnormal.errors import JetnormalError
from jetnormal.evaluation.results import ModelResult
from jetnormal.formats.atomic import atomic_write
from jetnormal.support.report import configure_logging, logger
from jetnormal.training.recipe import Recipe, make_recipe, merged, placed, read_tables
from jetnormal.training.train import train

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ADDITIONS = {  # the paper's, as settings of a recipe
    "none": {"transform": "qstn", "correction": False, "z_direction": 0.0},
    "z": {"transform": "ztransform", "correction": False, "z_direction": 2.0},
    "correction": {"transform": "qstn", "correction": True, "z_direction": 0.0},
    "both": {"transform": "ztransform", "correction": True, "z_direction": 2.0},
}
NO_ROWS = ("title", "measure", "seeds")  # entries of a table that are no settings of its rows
UNITS = {"rmse": "RMSE in degrees", "pgp5": "PGP5 in %", "pgp10": "PGP10 in %"}
SCALES = {"rmse": 1.0, "pgp5": 100.0, "pgp10": 100.0}


@dataclass(frozen=True)
class Row:
    """A row of a table: what its cells name, its recipe, and iterations of the evaluation (None: the network's own)."""

    settings: dict[str, Any]
    recipe: Recipe
    iterations: int | None


def rows(table: dict[str, Any], plan: dict[str, Any]) -> Iterator[Row]:
    """All combinations of the settings of a table."""
    grid = {key: value if isinstance(value, list) else [value] for key, value in table.items() if key not in NO_ROWS}
    for values in itertools.product(*grid.values()):
        settings = dict(zip(grid, values, strict=True))
        rest = dict(settings)
        iterations = rest.pop("iterations", None)
        tables = merged(read_tables(rest.pop("recipe", "deepfit-small")), plan.get("changes", {}))
        chosen = ADDITIONS.get(rest.pop("additions", ""), {}) | rest
        changes = placed(chosen, make_recipe(tables).tables())
        yield Row(settings, make_recipe(merged(tables, changes)), iterations)


def recipes(row: Row, table: dict[str, Any]) -> list[Recipe]:
    """The recipe of a row, with each of the seeds of its table."""
    training = row.recipe.training
    return [replace(row.recipe, training=replace(training, seed=n)) for n in table.get("seeds", [training.seed])]


def run_name(recipe: Recipe) -> str:
    """Name of the folder of a training: the kind of network, and a hash of all that decides on it."""
    facts = json.dumps(recipe.facts(), sort_keys=True).encode()
    return f"{getattr(recipe.network, 'weights', recipe.family)}-{hashlib.sha256(facts).hexdigest()[:10]}"


def result(row: Row, recipe: Recipe, plan: dict[str, Any], folder: Path) -> ModelResult:
    """What a network reaches on the test clouds; it is trained first, or trained on, where need be."""
    run = folder / run_name(recipe)
    logger.info("training %s: %s", run.name, row.settings)
    resume = (run / "state.safetensors").is_file()
    device = plan.get("device", "auto")
    summary = train(recipe, run, resume=resume, device=device)
    test = plan["test"]
    model = summary["model"] if row.iterations is None else f"{summary['model']}:iterations={row.iterations}"
    models = evaluate(test["data"], [model], list_file=test.get("list"), results=run / "results", device=device).models
    return models[0]


def cells(results: list[ModelResult], measure: str) -> list[str]:
    """One cell for each category and the average, over the seeds."""
    columns = [[*one.categories.values(), one.average] for one in results]
    found = []
    for scores in zip(*columns, strict=True):
        values = [getattr(score, measure) * SCALES[measure] for score in scores]
        spread = f" ± {statistics.stdev(values):.2f}" if len(values) > 1 else ""
        found.append(f"{statistics.mean(values):.2f}{spread}")
    return found


def markdown(table: dict[str, Any], done: list[tuple[Row, list[ModelResult]]]) -> str:
    """A table in Markdown: the settings that vary, then a measure by category and on average."""
    varying = [key for key, value in table.items() if key not in NO_ROWS and isinstance(value, list) and len(value) > 1]
    categories = list(done[0][1][0].categories)
    measures = table.get("measure", "rmse")
    lines = []
    for measure in [measures] if isinstance(measures, str) else measures:
        lines += [f"**{table['title']}** ({UNITS[measure]})", ""]
        lines.append("| " + " | ".join([*varying, *categories, "average"]) + " |")
        lines.append("|---" * len(varying) + "|---:" * (len(categories) + 1) + "|")
        for row, results in done:
            names = [str(row.settings[key]) for key in varying]
            lines.append("| " + " | ".join(names + cells(results, measure)) + " |")
        lines.append("")
    return "\n".join(lines)


def overview(tables: list[tuple[dict[str, Any], list[Row]]]) -> str:
    """The titles of tables, and of each row the folders of its networks and its settings."""
    lines = []
    for table, planned in tables:
        lines.append(table["title"])
        for row in planned:
            settings = ", ".join(f"{key} = {value}" for key, value in row.settings.items())
            lines += [f"  {run_name(recipe)}: {settings}" for recipe in recipes(row, table)]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plan", type=Path, help="the TOML file")
    parser.add_argument("-o", "--out", type=Path, default=Path("ablation"), help="folder of runs and tables")
    parser.add_argument("--show", action="store_true", help="print what would be trained, and train nothing")
    arguments = parser.parse_args()
    configure_logging(0)
    plan = tomllib.loads(arguments.plan.read_text())
    tables = [(table, list(rows(table, plan))) for table in plan["table"]]  # all of them, so that errors show first
    if arguments.show:
        print(overview(tables))
        return
    arguments.out.mkdir(parents=True, exist_ok=True)
    finished: list[str] = []
    for table, planned in tables:
        done = []
        for row in planned:
            done.append((row, [result(row, one, plan, arguments.out) for one in recipes(row, table)]))
            text = "\n".join([*finished, markdown(table, done)])
            with atomic_write(arguments.out / f"{arguments.plan.stem}.md", overwrite=True) as stream:
                stream.write(text.encode())
        finished.append(markdown(table, done))
    print("\n".join(finished))


if __name__ == "__main__":
    try:
        main()
    except JetnormalError as error:
        sys.exit(f"ablation: {error}")
