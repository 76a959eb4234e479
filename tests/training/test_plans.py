"""The plans of benchmarks/ablation.py: every row is a recipe."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def ablation():
    spec = importlib.util.spec_from_file_location("ablation", BENCHMARKS / "ablation.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["ablation"] = module  # its dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("name", "rows", "networks"),
    [
        ("ablation", 46, 32),
        ("ablation_full", 4, 4),
        ("paper/main", 9, 9),
        ("paper/scenes", 9, 9),
        ("paper/additions", 12, 12),
        ("paper/order", 18, 18),
        ("paper/neighborhood", 18, 18),
        ("paper/z_loss", 12, 12),
        ("paper/iterations", 4, 2),
    ],
)
def test_a_plan_names_its_networks(ablation, name, rows, networks):
    plan = tomllib.loads((BENCHMARKS / f"{name}.toml").read_text())
    found = [row for table in plan["table"] for row in ablation.rows(table, plan)]
    assert len(found) == rows
    assert len({ablation.run_name(row.recipe) for row in found}) == networks


def test_plans_share_their_networks(ablation):
    """Tables 1 and 4 of the paper have six networks in common."""

    def names(plan: str) -> set[str]:
        tables = tomllib.loads((BENCHMARKS / "paper" / f"{plan}.toml").read_text())
        return {ablation.run_name(row.recipe) for table in tables["table"] for row in ablation.rows(table, tables)}

    assert len(names("main") & names("additions")) == 6
    assert names("main") == names("scenes")


def test_a_plan_can_be_read_before_it_is_run(ablation, monkeypatch, capsys, tmp_path):
    folder = tmp_path / "none"
    plan = BENCHMARKS / "paper" / "iterations.toml"
    monkeypatch.setattr(sys, "argv", ["ablation.py", str(plan), "-o", str(folder), "--show"])
    ablation.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "Iterative estimation" and len(lines) == 5
    assert lines[1].endswith(": recipe = deepfit-paper, additions = none, iterations = 1")
    assert lines[1].split(":")[0] == lines[2].split(":")[0] != lines[3].split(":")[0]  # the same network twice
    assert not folder.exists()
