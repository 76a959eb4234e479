"""Trains and evaluates the networks of the paper's ablations from one configuration file, and writes its tables.

    jetnormal dataset --synthetic 4 -o benchmark
    python benchmarks/ablation.py benchmarks/ablation.toml -o ablation

All networks get the same budget; one that several tables ask for is trained once. An interrupted run goes on when it
is started again. `ablation/tables.md` holds the tables as far as they are known, `ablation/NETWORK` the runs.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jetnormal.training.loop import TrainOptions, train

from jetnormal.data.sources import open_dataset
from jetnormal.errors import JetnormalError
from jetnormal.evaluation import ModelResult, evaluate
from jetnormal.formats.atomic import atomic_write
from jetnormal.networks.patchfit.network import CONFIGS, PatchFitConfig
from jetnormal.support.device import resolve_device
from jetnormal.support.report import configure_logging, logger
from jetnormal.training.losses import LossWeights, published_losses

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # mypy and pytest bring it along

ADDITIONS = {  # the paper's, as settings of the network
    "none": {"transform": "qstn", "correction": False},
    "z": {"transform": "ztransform", "correction": False},
    "correction": {"transform": "qstn", "correction": True},
    "both": {"transform": "ztransform", "correction": True},
}
LAMBDAS = {
    "lambda_z": "z_direction",
    "lambda_consistency": "consistency",
    "lambda_sparsity": "sparsity",
    "lambda_regularisation": "regularisation",
    "lambda_offsets": "offsets",
}
Settings = dict[str, Any]


@dataclass(frozen=True)
class Trial:
    """A row of a table: a network, how it is trained, and how often it iterates when it is evaluated."""

    settings: Settings
    config: PatchFitConfig
    losses: LossWeights
    iterations: int

    @property
    def run(self) -> str:
        """Name of the folder of its training: all that decides on it, so that no two trainings share one."""
        chosen = self.settings | {"neighbors": self.config.neighbors, "order": self.config.order}
        published = published_losses(self.config)
        for key, value in self.settings.items():
            if key == "iterations" or (key in LAMBDAS and value == getattr(published, LAMBDAS[key])):
                del chosen[key]
        return "_".join(f"{key}-{value}".replace("_", "-") for key, value in sorted(chosen.items()))


def trials(table: dict[str, Any], plan: dict[str, Any]) -> Iterator[Trial]:
    """All combinations of the settings of a table."""
    grid = {key: value if isinstance(value, list) else [value] for key, value in table.items() if key != "title"}
    for values in itertools.product(*grid.values()):
        settings: Settings = {"weights": "deepfit", "additions": "both"} | dict(zip(grid, values, strict=True))
        rest = {key: value for key, value in settings.items() if key not in LAMBDAS}
        iterations = rest.pop("iterations", 1)
        base = CONFIGS[plan.get("config", "small")][rest["weights"]]
        config = replace(base, **plan.get("network", {}) | ADDITIONS[rest.pop("additions")] | rest)
        factors = {LAMBDAS[key]: value for key, value in settings.items() if key in LAMBDAS}
        yield Trial(settings, config, replace(published_losses(config), **factors), iterations)


def trained(trial: Trial, plan: dict[str, Any], folder: Path) -> Path:
    """The model file of a trial, which is trained first, or trained on, where need be."""
    data = plan["data"]
    source = open_dataset(
        [Path(name) for name in data.get("train", [])],
        synthetic=data.get("synthetic", False),
        weights=data.get("weights"),
        clouds_per_epoch=data.get("clouds_per_epoch", 24),
        points=data.get("points_per_cloud", 100_000),
    )
    device = resolve_device(plan.get("device", "auto"))
    options = TrainOptions(**plan["training"], losses=trial.losses, device=device)
    run = folder / trial.run
    logger.info("training %s", trial.run)
    resume = (run / "state.safetensors").is_file()
    return Path(train(trial.config, source, run, options, resume=resume)["model"])


def scores(trial: Trial, plan: dict[str, Any], folder: Path) -> ModelResult:
    """What a trained network reaches on the test clouds."""
    model = f"{trained(trial, plan, folder)}:iterations={trial.iterations}"
    data = plan["data"]
    kept = folder / trial.run / "results"
    return evaluate(data["test"], [model], list_file=data.get("test_list"), results=kept).models[0]


def markdown(table: dict[str, Any], rows: list[tuple[Trial, ModelResult]]) -> str:
    """A table in Markdown: the settings that vary, then the RMSE by category and on average."""
    varying = [key for key, value in table.items() if isinstance(value, list) and len(value) > 1]
    categories = list(rows[0][1].categories)
    lines = [f"**{table['title']}** (RMSE in degrees)", ""]
    lines.append("| " + " | ".join([*varying, *categories, "average"]) + " |")
    lines.append("|---" * len(varying) + "|---:" * (len(categories) + 1) + "|")
    for trial, result in rows:
        errors = [scores.rmse for scores in result.categories.values()] + [result.average.rmse]
        cells = [str(trial.settings[key]) for key in varying] + [f"{error:.2f}" for error in errors]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plan", type=Path, help="the configuration file")
    parser.add_argument("-o", "--out", type=Path, default=Path("ablation"), help="folder of runs and tables")
    arguments = parser.parse_args()
    configure_logging(0)
    plan = tomllib.loads(arguments.plan.read_text())
    tables = [(table, list(trials(table, plan))) for table in plan["table"]]  # all of them, so that errors show first
    arguments.out.mkdir(parents=True, exist_ok=True)
    finished: list[str] = []
    for table, rows in tables:
        done = []
        for trial in rows:
            done.append((trial, scores(trial, plan, arguments.out)))
            text = "\n".join([*finished, markdown(table, done)])
            with atomic_write(arguments.out / "tables.md", overwrite=True) as stream:
                stream.write(text.encode())
        finished.append(markdown(table, done))
    print("\n".join(finished))


if __name__ == "__main__":
    try:
        main()
    except JetnormalError as error:
        sys.exit(f"ablation: {error}")
