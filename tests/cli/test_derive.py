from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import pytest
import typer
from typer.testing import CliRunner

from jetnormal.cli.derive import GroupedCommand, with_options
from jetnormal.cli.options import Json
from jetnormal.support.options import Nested, Option, OptionSet, Vector


def parse_vector(text: str) -> Vector:
    x, y, z = (float(part) for part in text.split(","))
    return x, y, z


@dataclass(frozen=True)
class Inner(OptionSet):
    model: Annotated[str, Option("The model.", metavar="NAME|FILE", group="Model")] = "auto"
    k: Annotated[int | None, Option("Neighbors.", low=1, metavar="K", default="the model's", group="Model")] = None
    orient: Annotated[Literal["auto", "up"], Option("Signs.", group="Signs")] = "auto"
    viewpoint: Annotated[Vector | None, Option("Position.", parse=parse_vector, metavar="X,Y,Z", group="Signs")] = None
    curvature: Annotated[bool, Option("Curvatures.")] = False
    folders: Annotated[tuple[str, ...], Option("Folders.", names=("--data", "-d"), metavar="DIR")] = ()
    scale: Annotated[float, Option("Scale.", low=1, high=10)] = 1.5
    rare: Annotated[int, Option("In recipes only.", flag=False)] = 7


@dataclass(frozen=True)
class Outer(OptionSet):
    depth: Annotated[int | None, Option("Depth.", low=4, high=12)] = None
    normals: Annotated[Inner, Nested(only=("model", "orient"))] = field(default_factory=Inner)


@pytest.fixture
def calls() -> list[tuple[Any, ...]]:
    return []


@pytest.fixture
def invoke(calls):
    app = typer.Typer(rich_markup_mode=None, pretty_exceptions_enable=False)

    @app.command(cls=GroupedCommand)
    @with_options
    def estimate(
        source: Annotated[str, typer.Argument(metavar="INPUT", help="Cloud.")], options: Inner, json: Json = False
    ) -> None:
        """Estimate normals."""
        calls.append((source, options, json))

    @app.command(cls=GroupedCommand)
    @with_options
    def reconstruct(options: Outer) -> None:
        """Make a mesh."""
        calls.append((options,))

    return lambda text: CliRunner().invoke(app, text.split())


def test_defaults_are_those_of_the_dataclass(invoke, calls):
    assert invoke("estimate in.ply").exit_code == 0
    assert invoke("reconstruct").exit_code == 0
    assert calls == [("in.ply", Inner(), False), (Outer(),)]


def test_options_reach_the_instance(invoke, calls):
    text = "estimate in.ply --json --k 9 --orient up --viewpoint 1,2,3 --curvature --data a -d b --scale 3 --model jet"
    assert invoke(text).exit_code == 0
    expected = Inner(model="jet", k=9, orient="up", viewpoint=(1, 2, 3), curvature=True, folders=("a", "b"), scale=3)
    assert calls == [("in.ply", expected, True)]


def test_a_nested_set_shows_the_chosen_options_only(invoke, calls):
    assert invoke("reconstruct --depth 5 --model pca").exit_code == 0
    assert calls == [(Outer(depth=5, normals=Inner(model="pca")),)]
    assert invoke("reconstruct --k 5").exit_code == 2
    assert invoke("estimate in.ply --rare 5").exit_code == 2


@pytest.mark.parametrize("text", ["--k 0", "--k x", "--scale 11", "--orient down", "--viewpoint 1,2", "--no-curvature"])
def test_values_that_do_not_fit_are_usage_errors_that_name_the_option(invoke, text):
    result = invoke(f"estimate in.ply {text}")
    assert result.exit_code == 2
    assert text.split()[0] in result.output


def test_the_help_is_grouped(invoke):
    output = invoke("estimate --help").output
    headings = [line for line in output.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert headings == ["Arguments:", "Model:", "Signs:", "Options:"]
    model, signs, options = (output.index(heading) for heading in headings[1:])
    assert model < output.index("--k K") < signs < output.index("--orient") < options < output.index("--json")
    assert "the model's" in output and "[default: 1.5; 1<=x<=10]" in output
    assert "--rare" not in output
