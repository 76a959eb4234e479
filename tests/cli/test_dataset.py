from __future__ import annotations

import json

import pytest

from jetnormal.cli.app import main


def run(monkeypatch, *arguments) -> int:
    monkeypatch.setattr("sys.argv", ["jetnormal", *map(str, arguments)])
    with pytest.raises(SystemExit) as leaving:
        main()
    return leaving.value.code or 0


def test_a_written_set_can_be_evaluated(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "set"
    arguments = ["--synthetic", "1", "--points", "800", "--queries", "60", "--seed", "3", "-o", folder]
    assert run(monkeypatch, "dataset", *arguments, "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["clouds"][:2] == ["solid_001", "solid_001_noise_white_1.25e-03"]
    assert run(monkeypatch, "evaluate", "--data", folder, "--model", "pca:k=20", "--json") == 0
    (model,) = json.loads(capsys.readouterr().out)["models"]
    assert list(model["categories"]) == ["none", "low", "medium", "high", "gradient", "striped"]
    rmse = {name: scores["rmse"] for name, scores in model["categories"].items()}
    assert 0 < rmse["none"] < rmse["high"]
    assert model["points"] == 6 * 60


def test_failures_have_their_exit_codes(tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, "dataset", "-o", tmp_path / "set") == 2
    assert run(monkeypatch, "dataset", "-o", tmp_path, "--synthetic", "1", "--points", "2") == 2
    assert run(monkeypatch, "dataset", "-o", tmp_path / "set", "--meshes", tmp_path) == 3
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a.txt").write_text("mine")
    assert run(monkeypatch, "dataset", "-o", tmp_path, "--synthetic", "1") == 3
    assert (tmp_path / "a.txt").read_text() == "mine"
    assert "--force" in capsys.readouterr().err
