from __future__ import annotations

import json

import numpy as np
import pytest

from jetnormal.cli.app import main


@pytest.fixture
def folder(tmp_path):
    """Planes z = 0, one of them with wrong normals for a quarter of its points."""
    points = np.random.default_rng(0).uniform(size=(200, 3)) * [1, 1, 0]
    for name, wrong in [("flat", 0), ("flat_ddist_minmax", 50)]:
        np.savetxt(tmp_path / f"{name}.xyz", points)
        normals = np.tile([0.0, 0.0, -1.0], (200, 1))
        normals[:wrong] = [1, 0, 0]
        np.savetxt(tmp_path / f"{name}.normals", normals)
    return tmp_path


def run(monkeypatch, *arguments) -> int:
    monkeypatch.setattr("sys.argv", ["jetnormal", "evaluate", *map(str, arguments)])
    with pytest.raises(SystemExit) as leaving:
        main()
    return leaving.value.code or 0


def test_tables_have_a_column_per_category_and_a_row_per_model(folder, monkeypatch, capsys):
    assert run(monkeypatch, "--data", folder, "--model", "pca:k=9", "--model", "jet") == 0
    captured = capsys.readouterr()
    rows = [line.split() for line in captured.out.splitlines()]
    assert rows.count(["model", "none", "gradient", "average"]) == 3
    for model in ("pca:k=9", "jet"):
        assert [model, "0.00", "45.00", "22.50"] in rows  # RMSE
        assert rows.count([model, "100.0", "75.0", "87.5"]) == 2  # PGP5 and PGP10
    assert "2 models on 2 clouds" in captured.err


def test_formats_of_the_tables(folder, monkeypatch, capsys):
    models = ["--data", folder, "--model", "pca:k=9", "--model", "jet", "-q"]
    assert run(monkeypatch, *models, "--format", "markdown") == 0
    assert "| `jet` | **0.00** | **45.00** | **22.50** |" in capsys.readouterr().out.splitlines()
    assert run(monkeypatch, *models, "--format", "csv") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("model,category,cloud,rmse,median,pgp5,")
    assert len(lines) == 1 + 2 * (2 + 2 + 1)
    assert run(monkeypatch, *models, "--format", "csv", "--json") == 2


def test_options_reach_the_evaluation(folder, tmp_path_factory, monkeypatch, capsys):
    results = tmp_path_factory.mktemp("results")
    (folder / "flat.pidx").write_text("1\n")
    arguments = ["--data", folder, "--model", "jet", "--json", "-q", "--results", results, "--orient", "up"]
    assert run(monkeypatch, *arguments, "--all-points") == 0
    assert len(list(results.iterdir())) == 2
    average = json.loads(capsys.readouterr().out)["models"][0]["average"]
    assert average["sign_accuracy"] == pytest.approx((1 + 0.75) / 2)  # the true normals point down: all are flipped
    assert average["oriented_rmse"] == pytest.approx(22.5)


def test_json_replaces_the_tables(folder, monkeypatch, capsys):
    assert run(monkeypatch, "--data", folder, "--model", "pca:k=9", "--json", "-q") == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["models"][0]["average"]["rmse"] == pytest.approx(22.5)
    assert captured.err == ""


def test_failures_have_their_exit_codes(folder, monkeypatch, capsys):
    assert run(monkeypatch, "--data", folder) == 2
    assert run(monkeypatch, "--data", folder, "--model", "pca:k=1") == 2
    assert run(monkeypatch, "--data", folder / "absent", "--model", "pca") == 3
    assert run(monkeypatch, "--data", folder, "--model", "absent") == 4
    assert capsys.readouterr().out == ""


def test_plots_are_drawn_once_unless_forced(folder, tmp_path_factory, monkeypatch, capsys):
    plots = tmp_path_factory.mktemp("plots")
    arguments = ["--data", folder, "--model", "pca:k=9", "--plots", plots]
    assert run(monkeypatch, *arguments) == 0
    assert sorted(path.name for path in plots.iterdir()) == ["good_points.png", "heatmap_flat.png"]
    assert "2 pictures in" in capsys.readouterr().err
    assert run(monkeypatch, *arguments) == 3
    assert run(monkeypatch, *arguments, "--force", "-q") == 0
