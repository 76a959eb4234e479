from __future__ import annotations

import builtins
import csv
import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from jetnormal.cli.app import main
from jetnormal.data.sources import MeshFolder, Mixture, PcpnetFolder, SyntheticSolids
from jetnormal.estimators.factory import make_estimator
from jetnormal.networks.checkpoint import load_model
from jetnormal.networks.patchfit.network import CONFIGS
from jetnormal.training import loop
from jetnormal.training.losses import LossWeights

TINY = ["--config", "small", "--width", "0.125", "--transform-width", "0.125", "--neighbors", "16", "--epochs", "1"]
TINY += ["--batch-size", "16", "--patches-per-cloud", "32", "--clouds-per-epoch", "1", "--points-per-cloud", "300"]


@pytest.fixture
def pcpnet(tmp_path) -> Path:
    folder = tmp_path / "pcpnet"
    folder.mkdir()
    normals = np.random.default_rng(0).normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
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

    def train(config, source, folder, options, **others):
        calls.append((config, source, folder, options, others))
        return {"model": "model.safetensors"}

    monkeypatch.setattr(loop, "train", train)
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
    assert row["patches"] == summary["patches"] == (96 if data == "mixture" else 32)
    assert 0 < row["rmse"] < 90
    assert row["loss"] == pytest.approx(summary["loss"], rel=1e-4)
    points = np.random.default_rng(1).uniform(size=(50, 3)) * [1, 1, 0.1]
    normals = make_estimator(summary["model"], device="cpu")(points).normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)


def test_trained_cloudfit_is_usable(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    small = ["--clouds-per-epoch", "2", "--points-per-cloud", "600", "--crop-points", "200", "--crops-per-cloud", "2"]
    arguments = ["--model", "cloudfit", "--synthetic", *small, "--epochs", "1", "--order", "3", "-o", folder, "--json"]
    assert run(monkeypatch, *arguments) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["parameters"] == 2_129_273
    assert 0 < metrics(folder)[0]["rmse"] < 90
    points = np.random.default_rng(1).uniform(size=(200, 3)) * [1, 1, 0.01]
    normals = make_estimator(summary["model"])(points).normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)


def test_resumed_run_continues_where_it_stopped(pcpnet, tmp_path, monkeypatch):
    arguments = ["--data", pcpnet, *TINY, "--epochs", "2", "--device", "cpu"]
    assert run(monkeypatch, *arguments, "-o", tmp_path / "whole") == 0

    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(loop.Run, "record", lambda self, row: self.position.epoch == 2 and stop())
        assert run(patch, *arguments, "-o", tmp_path / "halves") == 130
    assert run(monkeypatch, *arguments, "-o", tmp_path / "halves", "--resume") == 0
    whole, halves = (load_model(tmp_path / name / "model.safetensors") for name in ("whole", "halves"))
    for name, value in whole.state_dict().items():
        np.testing.assert_array_equal(value, halves.state_dict()[name])


def test_tensorboard_events_hold_the_metrics(pcpnet, tmp_path, monkeypatch):
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    assert run(monkeypatch, "--data", pcpnet, *TINY, "-o", tmp_path / "run", "--tensorboard", "--device", "cpu") == 0
    (row,) = metrics(tmp_path / "run")
    found = events.EventAccumulator(str(tmp_path / "run"))
    found.Reload()
    for name in ("loss", "rmse", "patches"):
        (event,) = found.Scalars(name)
        assert event.step == 1
        assert event.value == pytest.approx(row[name], rel=1e-4)


def test_tensorboard_that_is_absent_is_named(pcpnet, tmp_path, monkeypatch, capsys):
    real = builtins.__import__

    def refuse(name, *arguments):
        if name.startswith("torch.utils.tensorboard"):
            raise ImportError("No module named 'tensorboard'")
        return real(name, *arguments)

    monkeypatch.setattr(builtins, "__import__", refuse)
    assert run(monkeypatch, "--data", pcpnet, *TINY, "-o", tmp_path / "run", "--tensorboard", "--device", "cpu") == 2
    assert "jetnormal[tensorboard]" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_defaults_are_the_papers(handed_over, monkeypatch):
    assert run(monkeypatch, "--synthetic", "--device", "cpu") == 0
    ((config, source, folder, options, others),) = handed_over
    assert config == CONFIGS["paper"]["deepfit"]
    assert isinstance(source, SyntheticSolids)
    assert source.clouds_per_epoch == SyntheticSolids().clouds_per_epoch
    assert vars(source) == vars(SyntheticSolids())
    assert folder == Path("run")
    assert options == loop.TrainOptions(data="synthetic")
    assert others == {"validation": None, "resume": False, "tensorboard": False}


@pytest.mark.parametrize("model", ["deepfit", "adafit", "graphfit"])
def test_published_baselines_are_a_matter_of_two_options(model, handed_over, monkeypatch):
    arguments = ["--synthetic", "--model", model, "--device", "cpu"]
    assert run(monkeypatch, *arguments) == 0
    assert run(monkeypatch, *arguments, "--transform", "qstn", "--no-correction") == 0
    (both, *_, options, _), (baseline, *_, without, _) = handed_over
    assert both == CONFIGS["paper"][model]
    assert options.losses == LossWeights()
    assert baseline == dataclasses.replace(both, transform="qstn", correction=False)
    assert without.losses == LossWeights(z_direction=0)


def test_options_reach_the_training(handed_over, pcpnet, meshes, monkeypatch):
    arguments = (
        f"--data {meshes} --data {pcpnet} --synthetic --weights 20,2,8 --clouds-per-epoch 7 --points-per-cloud 90"
    )
    arguments += f" --list validationset_whitenoise.txt --validation {pcpnet} --config small --neighbors 64 --order 2"
    arguments += " --transform qstn --no-correction --width 0.75 --transform-width 0.5 --epochs 9 --batch-size 8"
    arguments += " --model adafit --no-offsets --lambda-z 1 --lambda-consistency 2 --lambda-sparsity 3"
    arguments += " --lambda-regularisation 4 --lambda-offsets 5 --initial deepfit-small"
    arguments += " --patches-per-cloud 5 --learning-rate 2e-4 --schedule cosine --bfloat16 --seed 3 --resume -o run"
    assert run(monkeypatch, *arguments.split(), "--device", "cpu", "--tensorboard") == 0
    ((config, source, _, options, others),) = handed_over
    assert vars(config) == vars(CONFIGS["small"]["adafit"]) | {
        "neighbors": 64,
        "order": 2,
        "transform": "qstn",
        "correction": False,
        "width": 0.75,
        "transform_width": 0.5,
        "offsets": False,
    }
    assert vars(options) == vars(loop.TrainOptions()) | {
        "epochs": 9,
        "batch_size": 8,
        "patches_per_cloud": 5,
        "learning_rate": 2e-4,
        "schedule": "cosine",
        "bfloat16": True,
        "losses": LossWeights(z_direction=1, consistency=2, sparsity=3, regularisation=4, offsets=5),
        "seed": 3,
        "data": f"{meshes.name} {pcpnet.name} synthetic",
        "initial": "deepfit-small",
    }
    assert isinstance(source, Mixture)
    assert source.clouds_per_epoch == 7 + 1 + 7
    names = [source.cloud(0, index, 0).name for index in range(15)]
    assert sum(name.startswith("tetrahedron") for name in names) == 10
    assert sum(name.startswith("solid") for name in names) == 4
    assert names.count("other") == 1
    assert isinstance(others["validation"], PcpnetFolder)
    assert others["validation"].names == ["other"]
    assert others["resume"]
    assert others["tensorboard"]


def test_mesh_folder_takes_its_sizes_from_the_options(handed_over, meshes, monkeypatch):
    arguments = ["--clouds-per-epoch", "3", "--points-per-cloud", "90", "-o", "run", "--device", "cpu"]
    assert run(monkeypatch, "--data", meshes, *arguments) == 0
    source = handed_over[0][1]
    assert isinstance(source, MeshFolder)
    assert source.clouds_per_epoch == 3
    assert max(len(source.cloud(epoch, 0, 0).points) for epoch in range(8)) <= 90


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ("-o run", 2),
        ("--synthetic -o run --config large", 2),
        ("--synthetic -o run --order 5", 2),
        ("--synthetic -o run --batch-size 1", 2),
        ("--synthetic -o run --crop-points 500", 2),
        ("--synthetic -o run --model cloudfit --lambda-z 1", 2),
        ("--synthetic -o run --model cloudfit --bfloat16", 2),
        ("--synthetic -o run --model cloudfit --batch-size 99 --clouds-per-epoch 1 --points-per-cloud 600", 2),
        ("--synthetic -o run --weights 1,a", 2),
        ("--synthetic -o run --weights 1,2", 2),
        ("--synthetic -o run --batch-size 1000 --clouds-per-epoch 1 --patches-per-cloud 9 --points-per-cloud 600", 2),
        ("--data absent -o run", 3),
        ("--data pcpnet --list absent.txt -o run", 3),
        ("--data pcpnet --neighbors 301 -o run", 3),
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
    assert "--resume" in capsys.readouterr().err
    assert run(monkeypatch, *arguments, "--resume", "--seed", "2") == 2
    assert "seed was 1" in capsys.readouterr().err


def test_absent_device_exits_5(pcpnet, tmp_path, monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert run(monkeypatch, "--data", pcpnet, *TINY, "-o", tmp_path / "run", "--device", "cuda:7") == 5
