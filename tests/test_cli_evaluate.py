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


def test_tables_have_a_row_per_category_and_a_column_per_model(folder, monkeypatch, capsys):
    assert run(monkeypatch, "--data", folder, "--model", "pca:k=9", "--model", "jet") == 0
    captured = capsys.readouterr()
    rmse, pgp5, pgp10, speed = captured.out.strip().split("\n\n")
    assert [line.split() for line in rmse.splitlines()] == [
        ["RMSE", "(degrees)", "pca:k=9", "jet"],
        ["none", "0.00", "0.00"],
        ["gradient", "45.00", "45.00"],
        ["average", "22.50", "22.50"],
    ]
    for table in (pgp5, pgp10):
        assert [line.split()[1:] for line in table.splitlines()[1:]] == [["100.0"] * 2, ["75.0"] * 2, ["87.5"] * 2]
    assert len(speed.split()) == 3
    assert len({len(line) for line in captured.out.splitlines() if line}) == 1
    assert "2 models on 2 clouds" in captured.err


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
