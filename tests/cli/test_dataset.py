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


def test_scans_with_their_sensors_can_be_evaluated(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "scans"
    arguments = ["--synthetic", "1", "--synthetic-scenes", "1", "--points", "3000", "--queries", "100", "-o", folder]
    assert run(monkeypatch, "dataset", *arguments, "--scans", "--json") == 0
    clouds = json.loads(capsys.readouterr().out)["clouds"]
    families = ["stripe", "depth", "lidar", "station", "fused", "photogrammetry"]
    assert clouds[:6] == [f"solid_001_{family}" for family in families]
    assert all(name.startswith("room_001_") for name in clouds[6:])
    evaluation = ["evaluate", "--data", folder, "--model", "jet:k=30", "--orient", "viewpoint", "--json"]
    assert run(monkeypatch, *evaluation) == 0
    (model,) = json.loads(capsys.readouterr().out)["models"]
    assert sorted(model["categories"]) == sorted([*families, "room"])
    assert all(scores["sign_accuracy"] > 0.9 for scores in model["categories"].values())
    attributes = ["--viewpoint-attribute", "sensor_x,sensor_y,sensor_z", "--model", "pca:k=20"]
    cloud = folder / "solid_001_station.ply"
    assert run(monkeypatch, "estimate", cloud, "-o", tmp_path / "out.ply", *attributes, "-q") == 0


def test_scenes_of_a_folder_in_the_layout_of_scenenn(tmp_path, monkeypatch, capsys):
    inner = tmp_path / "scenes" / "005"
    inner.mkdir(parents=True)
    (inner / "005.obj").write_text("v 0 0 0\nv 2 0 0\nv 0 3 0\nv 2 3 1\nf 1 2 3\nf 2 4 3\n")
    folder = tmp_path / "set"
    assert run(monkeypatch, "dataset", "--scenes", tmp_path / "scenes", "--points", "500", "-o", folder, "--json") == 0
    assert json.loads(capsys.readouterr().out)["clouds"] == ["005"]
    assert (folder / "testset_scene.txt").read_text() == "005\n"
    assert not (folder / "testset_no_noise.txt").exists()
    assert run(monkeypatch, "evaluate", "--data", folder, "--model", "pca:k=10", "--json") == 0
    (model,) = json.loads(capsys.readouterr().out)["models"]
    assert list(model["categories"]) == ["scene"] and model["categories"]["scene"]["rmse"] < 15
    assert run(monkeypatch, "dataset", "--scenes", inner, "--scans", "-o", tmp_path / "no") == 2
    assert run(monkeypatch, "evaluate", "--data", folder, "--model", "pca:k=10", "--orient", "viewpoint") == 3
    assert "005.ply" in capsys.readouterr().err
