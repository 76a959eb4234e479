from __future__ import annotations

import csv
import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from shapes import sphere

from jetnormal.cli.app import main
from jetnormal.data.dataset import Mixture
from jetnormal.data.sources import MeshFolder, PcpnetFolder, SyntheticSolids
from jetnormal.estimators.factory import make_estimator
from jetnormal.networks.patchfit.network import CONFIGS
from jetnormal.training import train as training
from jetnormal.training.options import DataOptions, LossWeights, PatchTraining
from jetnormal.training.patch_task import PatchTask
from jetnormal.training.recipe import read_recipe, recipe_names

SMALL = {"width": 0.125, "transform_width": 0.125, "neighbors": 16, "batch_size": 16, "patches_per_cloud": 32}
SMALL |= {"clouds_per_epoch": 1, "points_per_cloud": 300, "validation_patches": 20, "bfloat16": "false"}
TINY = ["--recipe", "deepfit-small", "--epochs", "1", "--threads", "1"]
TINY += [part for name, value in SMALL.items() for part in ("--set", f"{name}={value}")]


@pytest.fixture
def pcpnet(tmp_path) -> Path:
    folder = tmp_path / "pcpnet"
    folder.mkdir()
    normals = sphere(300)
    for name in ("ball", "other"):
        np.savetxt(folder / f"{name}.xyz", normals)
        np.savetxt(folder / f"{name}.normals", normals)
    (folder / "trainingset_whitenoise.txt").write_text("ball\n")
    (folder / "validationset_whitenoise.txt").write_text("other\n")
    return folder


@pytest.fixture
def meshes(tmp_path) -> Path:
    folder = tmp_path / "meshes"
    folder.mkdir()
    (folder / "tetrahedron.off").write_text(
        "OFF\n4 4 0\n1 1 1\n1 -1 -1\n-1 1 -1\n-1 -1 1\n3 0 1 2\n3 0 3 1\n3 0 2 3\n3 1 3 2\n"
    )
    return folder


@pytest.fixture
def handed_over(monkeypatch):
    """What the command gives to the training, which does not happen."""
    calls = []

    def train(recipe, folder, **others):
        calls.append((recipe, folder, others))
        return {"model": "model.safetensors"}

    monkeypatch.setattr(training, "train", train)
    return calls


def run(monkeypatch, *arguments) -> int:
    monkeypatch.setattr(sys, "argv", ["jetnormal", "train", *map(str, arguments)])
    with pytest.raises(SystemExit) as leaving:
        main()
    return leaving.value.code or 0


def metrics(folder: Path) -> list[dict[str, float]]:
    with (folder / "metrics.csv").open() as stream:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(stream)]


@pytest.mark.parametrize("data", ["solids", "pcpnet", "meshes", "mixture"])
def test_trained_model_is_usable(data, pcpnet, meshes, tmp_path, monkeypatch, capsys):
    sources = {"solids": ["--synthetic"], "pcpnet": ["--data", pcpnet], "meshes": ["--data", meshes]}
    sources["mixture"] = [part for source in sources.values() for part in source] + ["--weights", "1,1,1"]
    folder = tmp_path / "run"
    assert run(monkeypatch, *sources[data], *TINY, "-o", folder, "--device", "cpu", "--json") == 0
    captured = capsys.readouterr()
    summary = json.loads(captured.out)
    assert "epoch 1 of 1: loss " in captured.err
    (row,) = metrics(folder)
    assert row["samples"] == summary["samples"] == (96 if data == "mixture" else 32)
    assert 0 < row["rmse"] < 90
    assert row["loss"] == pytest.approx(summary["loss"], rel=1e-4)
    points = np.random.default_rng(1).uniform(size=(50, 3)) * [1, 1, 0.1]
    normals = make_estimator(summary["model"], device="cpu")(points).normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)


def test_trained_cloudfit_is_usable(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    small = {"clouds_per_epoch": 2, "points_per_cloud": 600, "crop_points": 200, "crops_per_cloud": 2}
    settings = [part for name, value in small.items() for part in ("--set", f"{name}={value}")]
    arguments = ["--synthetic", *settings, "--epochs", "1", "-o", folder, "--json", "--threads", "1"]
    assert run(monkeypatch, *arguments) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["parameters"] == 4_354_435
    assert 0 < metrics(folder)[0]["rmse"] < 90
    points = np.random.default_rng(1).uniform(size=(200, 3)) * [1, 1, 0.01]
    normals = make_estimator(summary["model"])(points).normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)


def test_an_interrupted_run_is_resumed_from_its_folder_alone(pcpnet, tmp_path, monkeypatch, capsys):
    arguments = ["--data", pcpnet, *TINY, "--epochs", "2", "--device", "cpu"]
    assert run(monkeypatch, *arguments, "-o", tmp_path / "whole") == 0

    def errors(*given, original=PatchTask.errors):
        if validated:
            raise KeyboardInterrupt
        validated.append(1)
        return original(*given)

    validated: list[int] = []
    with monkeypatch.context() as patch:
        patch.chdir(tmp_path)
        patch.setattr(PatchTask, "errors", errors)
        arguments[1] = pcpnet.name
        assert run(patch, *arguments, "-o", "halves") == 130
    message = capsys.readouterr().err
    assert "interrupted; saved in halves" in message
    assert "jetnormal train -o halves --resume goes on" in message
    assert run(monkeypatch, "-o", tmp_path / "halves", "--resume", "--threads", "1") == 0
    whole, halves = (tmp_path / name / "model.safetensors" for name in ("whole", "halves"))
    assert whole.read_bytes() == halves.read_bytes()
    assert run(monkeypatch, "-o", tmp_path / "halves", "--resume", "--epochs", "3", "--threads", "1") == 0
    assert [row["epoch"] for row in metrics(tmp_path / "halves")] == [1, 2, 3]


def test_a_run_whose_data_moved_is_resumed(pcpnet, tmp_path, monkeypatch):
    assert run(monkeypatch, "--data", pcpnet, *TINY, "-o", tmp_path / "run") == 0
    (tmp_path / "elsewhere").mkdir()
    moved = pcpnet.rename(tmp_path / "elsewhere" / "pcpnet")
    assert run(monkeypatch, "-o", tmp_path / "run", "--resume", "--epochs", "2") == 3
    assert run(monkeypatch, "-o", tmp_path / "run", "--resume", "--epochs", "2", "--data", moved, "--threads", "1") == 0


@pytest.mark.parametrize("arguments", ["--recipe cloudfit", "--seed 2", "--set order=2", "--synthetic", "--show"])
def test_a_resumed_run_takes_no_other_options(arguments, pcpnet, tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, "--data", pcpnet, *TINY, "-o", tmp_path / "run") == 0
    assert run(monkeypatch, "-o", tmp_path / "run", "--resume", *arguments.split()) == 2
    assert arguments.split()[0].strip("-") in capsys.readouterr().err


def test_tensorboard_events_hold_the_metrics(pcpnet, tmp_path, monkeypatch):
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    assert run(monkeypatch, "--data", pcpnet, *TINY, "-o", tmp_path / "run", "--tensorboard", "--device", "cpu") == 0
    (row,) = metrics(tmp_path / "run")
    found = events.EventAccumulator(str(tmp_path / "run"))
    found.Reload()
    for name in ("loss", "rmse", "samples"):
        (event,) = found.Scalars(name)
        assert event.step == 1
        assert event.value == pytest.approx(row[name], rel=1e-4)


def test_tensorboard_that_is_absent_is_named(pcpnet, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tensorboard", None)  # makes its import fail
    assert run(monkeypatch, "--data", pcpnet, *TINY, "-o", tmp_path / "run", "--tensorboard", "--device", "cpu") == 5
    assert "jetnormal[tensorboard]" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_the_default_is_cloudfit(handed_over, monkeypatch):
    assert run(monkeypatch, "--synthetic") == 0
    ((recipe, folder, others),) = handed_over
    assert recipe == read_recipe("cloudfit", {"data": {"synthetic": True}})
    assert folder == Path("run")
    assert others == {"resume": False, "device": "auto", "threads": None, "tensorboard": False}


@pytest.mark.parametrize("model", ["deepfit", "adafit", "graphfit"])
def test_published_networks_are_recipes(model):
    both, baseline = read_recipe(f"{model}-paper"), read_recipe(f"{model}-baseline")
    assert both.network == CONFIGS["paper"][model]
    assert both.losses == LossWeights()
    assert both.training == baseline.training == PatchTraining()
    assert baseline.network == dataclasses.replace(both.network, transform="qstn", correction=False)
    assert baseline.losses == LossWeights(z_direction=0)
    small = read_recipe(f"{model}-small").network
    assert dataclasses.replace(small, width=CONFIGS["small"][model].width) == CONFIGS["small"][model]


def test_options_reach_the_training(handed_over, pcpnet, meshes, monkeypatch):
    arguments = f"--data {meshes} --data {pcpnet} --synthetic --weights 20,2,8 --validation {pcpnet} --epochs 9"
    arguments += " --recipe adafit-small --seed 3 --validate-every 2 --initial deepfit-small --tensorboard -o folder"
    arguments += " --device cpu --threads 1 --set network.order=2 --set z_direction=1 --set transform=qstn"
    arguments += " --set average=0.9 --set list_file=validationset_whitenoise.txt"
    assert run(monkeypatch, *arguments.split()) == 0
    ((recipe, folder, others),) = handed_over
    base = read_recipe("adafit-small")
    assert recipe.network == dataclasses.replace(base.network, order=2, transform="qstn")
    assert recipe.losses == LossWeights(z_direction=1)
    assert recipe.training == dataclasses.replace(
        base.training, epochs=9, seed=3, validate_every=2, initial="deepfit-small", average=0.9
    )
    assert recipe.data == DataOptions(
        folders=(str(meshes), str(pcpnet)),
        synthetic=True,
        weights=(20, 2, 8),
        validation=str(pcpnet),
        list_file="validationset_whitenoise.txt",
    )
    assert folder == Path("folder")
    assert others == {"resume": False, "device": "cpu", "threads": 1, "tensorboard": True}


def test_the_sources_are_opened_as_the_recipe_says(pcpnet, meshes):
    data = DataOptions((str(meshes), str(pcpnet)), synthetic=True, weights=(20, 2, 8), clouds_per_epoch=7)
    source = training.open_training(dataclasses.replace(data, points_per_cloud=90))
    assert isinstance(source, Mixture)
    assert source.clouds_per_epoch == 7 + 1 + 7
    names = [source.cloud(0, index, 0).name for index in range(15)]
    assert sum(name.startswith("tetrahedron") for name in names) == 10
    assert sum(name.startswith("solid") for name in names) == 4
    assert names.count("ball") == 1
    validation = training.open_validation(data)
    assert isinstance(validation, PcpnetFolder)
    assert validation.names == ["other"]
    assert training.open_validation(DataOptions((str(meshes),))) is None
    assert isinstance(training.open_training(DataOptions(synthetic=True)), SyntheticSolids)
    source = training.open_training(DataOptions((str(meshes),), clouds_per_epoch=3, points_per_cloud=90))
    assert isinstance(source, MeshFolder)
    assert source.clouds_per_epoch == 3
    assert max(len(source.cloud(epoch, 0, 0).points) for epoch in range(8)) <= 90


@pytest.mark.parametrize("name", recipe_names())
def test_a_shown_recipe_is_the_recipe(name, tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, "--recipe", name, "--show") == 0
    (tmp_path / "shown.toml").write_text(capsys.readouterr().out)
    assert read_recipe(str(tmp_path / "shown.toml")) == read_recipe(name)


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ("-o run", 2),
        ("--synthetic -o run --recipe absent", 3),
        ("--synthetic -o run --recipe pcpnet/ball.xyz", 3),
        ("--synthetic -o run --set order=5", 2),
        ("--synthetic -o run --set order", 2),
        ("--synthetic -o run --set width=inf --recipe deepfit-small", 2),
        ("--synthetic -o run --set batch_size=1 --recipe deepfit-small", 2),
        ("--synthetic -o run --set crop_points=500 --recipe deepfit-small", 2),
        ("--synthetic -o run --set z_direction=1", 2),
        ("--synthetic -o run --set batch_size=99 --set clouds_per_epoch=1 --set points_per_cloud=600", 2),
        ("--synthetic -o run --weights 1,a", 2),
        ("--synthetic -o run --weights 1,2", 2),
        ("--synthetic -o run --epochs 0", 2),
        ("--data absent -o run", 3),
        ("--data pcpnet --set list_file=absent.txt -o run", 3),
        ("--data pcpnet --recipe deepfit-small --set neighbors=301 -o run", 3),
        ("--data pcpnet --validation absent -o run", 3),
        ("--data pcpnet -o run --resume", 3),
        ("--data pcpnet -o pcpnet/ball.xyz", 3),
    ],
)
def test_failures_have_their_exit_codes(arguments, code, pcpnet, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *arguments.split(), "--device", "cpu") == code
    assert capsys.readouterr().out == ""
    assert not (tmp_path / "run" / "metrics.csv").exists()


def test_run_is_not_started_over_another(pcpnet, tmp_path, monkeypatch, capsys):
    arguments = ["--data", pcpnet, *TINY, "-o", tmp_path, "--device", "cpu"]
    assert run(monkeypatch, *arguments) == 0
    assert run(monkeypatch, *arguments) == 3
    assert "holds a run already; --resume goes on with it" in capsys.readouterr().err


def test_absent_device_exits_5(pcpnet, tmp_path, monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert run(monkeypatch, "--data", pcpnet, *TINY, "-o", tmp_path / "run", "--device", "cuda:7") == 5
