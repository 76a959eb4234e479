from __future__ import annotations

import csv
import dataclasses
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from jetnormal.data.sources import LabeledCloud
from jetnormal.errors import InputError, ModelError, UsageError
from jetnormal.networks.checkpoint import load_model, load_tensors, save_tensors
from jetnormal.networks.patchfit.network import PatchFit, PatchFitConfig
from jetnormal.training import loop
from jetnormal.training.batches import PatchSampler
from jetnormal.training.loop import TrainOptions, learning_rate, train, validate
from jetnormal.training.run import Run

CONFIG = PatchFitConfig(neighbors=16, width=0.125)
OPTIONS = TrainOptions(epochs=2, batch_size=8, patches_per_cloud=32, learning_rate=3e-3)
BATCHES = 8  # in an epoch of two clouds


class Spheres:
    """Two spheres of 400 points, new ones in each epoch."""

    clouds_per_epoch = 2

    def __init__(self, points: int = 400):
        self.points = points

    def cloud(self, epoch: int, index: int, seed: int) -> LabeledCloud:
        rng = np.random.default_rng([epoch, index, seed])
        normals = rng.normal(size=(self.points, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return LabeledCloud(f"sphere {index}", normals, normals)


def hasten():
    """One thread, and few patches to validate on: networks as small as these spend their time elsewhere."""
    torch.set_num_threads(1)
    loop.VALIDATION_QUERIES = 20


@pytest.fixture(scope="module", autouse=True)
def small_scale():
    before = torch.get_num_threads(), loop.VALIDATION_QUERIES
    hasten()
    yield
    torch.set_num_threads(before[0])
    loop.VALIDATION_QUERIES = before[1]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a run without interruption, and what it returned."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    return folder, train(CONFIG, Spheres(), folder, OPTIONS)


def metrics(folder) -> list[dict[str, str]]:
    """The rows of a run but for the time they took."""
    with (folder / "metrics.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:
        assert float(row.pop("seconds")) >= 0
    return rows


def assert_same_run(first, second):
    for name in ("model.safetensors", "state.safetensors"):
        a, b = load_tensors(first / name)[0], load_tensors(second / name)[0]
        assert a.keys() == b.keys()
        assert all(torch.equal(a[key], b[key]) for key in a)
    assert metrics(first) == metrics(second)


def test_a_run_leaves_a_network_a_state_and_metrics(finished):
    folder, summary = finished
    assert sorted(path.name for path in folder.iterdir()) == [
        "metrics.csv",
        "model.safetensors",
        "state.safetensors",
    ]
    rows = metrics(folder)
    assert [(row["epoch"], row["patches"]) for row in rows] == [("1", "64"), ("2", "128")]
    terms = ["normal", "consistency", "z_direction", "regularisation", "loss"]
    assert list(rows[0]) == ["epoch", "patches", *terms, "rmse", "rmse_rough", "rmse_z"]
    assert all(np.isfinite(float(value)) for row in rows for value in row.values())
    total = float(rows[0]["normal"]) + 0.25 * float(rows[0]["consistency"])
    total += 2 * float(rows[0]["z_direction"]) + 0.1 * float(rows[0]["regularisation"])
    assert float(rows[0]["loss"]) == pytest.approx(total, rel=1e-4)

    assert summary["model"] == str(folder / "model.safetensors")
    assert summary["epoch"] == 2 and summary["patches"] == 128
    assert load_model(folder / "model.safetensors").config == CONFIG
    training = load_tensors(folder / "model.safetensors")[1]["training"]
    assert training["patches"] == 128 and training["options"]["learning_rate"] == 3e-3
    assert training["rmse"] == float(rows[-1]["rmse"])


@pytest.mark.parametrize("weights", ["adafit", "graphfit"])
def test_every_weight_predictor_trains_and_resumes(tmp_path, weights):
    config = dataclasses.replace(CONFIG, weights=weights, neighbors=32, order=1, offsets=True)
    losses = dataclasses.replace(OPTIONS.losses, offsets=0.5)
    options = dataclasses.replace(OPTIONS, patches_per_cloud=16, losses=losses)
    train(config, Spheres(), tmp_path / "whole", options)
    row = {name: float(value) for name, value in metrics(tmp_path / "whole")[-1].items()}
    total = row["normal"] + 0.25 * row["consistency"] + 2 * row["z_direction"]
    total += 0.1 * row["regularisation"] + 0.5 * row["offsets"]
    assert row["loss"] == pytest.approx(total, rel=1e-4)
    assert row["offsets"] > 0

    def stop(self, row):
        if self.position.epoch == 2:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Run, "record", stop)
        with pytest.raises(KeyboardInterrupt):
            train(config, Spheres(), tmp_path / "halves", options)
    train(config, Spheres(), tmp_path / "halves", options, resume=True)
    whole, halves = (load_tensors(tmp_path / name / "model.safetensors")[0] for name in ("whole", "halves"))
    assert all(torch.equal(whole[name], halves[name]) for name in whole)


def test_the_same_arguments_give_the_same_run(finished, tmp_path):
    train(CONFIG, Spheres(), tmp_path / "run", OPTIONS)
    assert_same_run(finished[0], tmp_path / "run")


def test_another_seed_gives_another_run(finished, tmp_path):
    train(CONFIG, Spheres(), tmp_path / "run", dataclasses.replace(OPTIONS, seed=2, epochs=1))
    assert metrics(tmp_path / "run")[0] != metrics(finished[0])[0]


@pytest.mark.parametrize("stop", [3, BATCHES, BATCHES + 5])
def test_an_interrupted_run_goes_on_as_if_nothing_had_happened(finished, tmp_path, monkeypatch, stop):
    """Ctrl-C after some steps, saved before the last of them: the lost step is done again."""
    steps = []

    def step(*args, original=loop._step):
        if len(steps) == stop:
            raise KeyboardInterrupt
        steps.append(1)
        return original(*args)

    def save_if_due(run):
        if len(steps) % 2 == 0:
            run.save()

    with monkeypatch.context() as patched:
        patched.setattr(loop, "_step", step)
        patched.setattr(Run, "save_if_due", save_if_due)
        with pytest.raises(KeyboardInterrupt):
            train(CONFIG, Spheres(), tmp_path / "run", OPTIONS)
    summary = train(CONFIG, Spheres(), tmp_path / "run", OPTIONS, resume=True)
    assert_same_run(finished[0], tmp_path / "run")
    assert summary["loss"] == finished[1]["loss"] and summary["patches"] == 128


def test_an_interruption_between_metrics_and_state_leaves_no_second_row(finished, tmp_path, monkeypatch):
    save = Run.save

    def interrupted(run):
        if run.position.epoch == 2:
            raise KeyboardInterrupt
        save(run)

    with monkeypatch.context() as patched:
        patched.setattr(Run, "save", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train(CONFIG, Spheres(), tmp_path / "run", OPTIONS)
    assert len(metrics(tmp_path / "run")) == 2
    train(CONFIG, Spheres(), tmp_path / "run", OPTIONS, resume=True)
    assert_same_run(finished[0], tmp_path / "run")


KILLED = """
import importlib.util, sys, time
from pathlib import Path
spec = importlib.util.spec_from_file_location("case", {case!r})
case = importlib.util.module_from_spec(spec)
spec.loader.exec_module(case)
case.hasten()
case.loop.Run.save_if_due = lambda run: (run.save(), time.sleep(0.2))
case.train(case.CONFIG, case.Spheres(), Path(sys.argv[1]), case.OPTIONS)
"""


@pytest.mark.skipif(os.name == "nt", reason="there is no kill -9")
def test_a_killed_run_goes_on_as_if_nothing_had_happened(finished, tmp_path):
    folder = tmp_path / "run"
    process = subprocess.Popen([sys.executable, "-c", KILLED.format(case=__file__), str(folder)])
    try:
        deadline = time.monotonic() + 60
        while not (folder / "state.safetensors").exists():
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        time.sleep(0.5)
    finally:
        process.kill()
    assert process.wait() == -signal.SIGKILL
    assert 0 < load_tensors(folder / "state.safetensors")[1]["position"]["batch"] < BATCHES
    train(CONFIG, Spheres(), folder, OPTIONS, resume=True)
    assert_same_run(finished[0], folder)


def test_a_finished_run_resumed_returns_its_result(finished):
    folder, summary = finished
    again = train(CONFIG, Spheres(), folder, OPTIONS, resume=True)
    assert again.pop("model") == str(folder / "model.safetensors")
    assert again == pytest.approx({name: summary[name] for name in again}, rel=1e-5)
    assert list(again) == list(summary)[1:]
    assert len(metrics(folder)) == 2


def test_a_run_is_not_resumed_with_other_options(finished):
    folder, _ = finished
    with pytest.raises(UsageError, match=r"other options \(learning_rate was 0.003\)"):
        train(CONFIG, Spheres(), folder, dataclasses.replace(OPTIONS, learning_rate=0.01), resume=True)
    with pytest.raises(UsageError, match=r"other options \(z_direction was 2.0\)"):
        losses = dataclasses.replace(OPTIONS.losses, z_direction=1.0)
        train(CONFIG, Spheres(), folder, dataclasses.replace(OPTIONS, losses=losses), resume=True)
    with pytest.raises(UsageError, match=r"other options \(epochs was 2, order was 3\)"):
        other = dataclasses.replace(CONFIG, order=2)
        train(other, Spheres(), folder, dataclasses.replace(OPTIONS, epochs=3), resume=True)


def test_a_run_that_began_before_an_option_existed_is_resumed(finished, tmp_path):
    tensors, description = load_tensors(finished[0] / "state.safetensors")
    del description["facts"]["config"]["light"]
    del description["facts"]["options"]["losses"]["offsets"]
    description["facts"]["options"]["obsolete"] = 1
    save_tensors(tmp_path / "state.safetensors", tensors, description)
    train(CONFIG, Spheres(), tmp_path, OPTIONS, resume=True)
    with pytest.raises(UsageError, match="order was 3"):
        train(dataclasses.replace(CONFIG, order=2), Spheres(), tmp_path, OPTIONS, resume=True)


def test_a_new_run_does_not_overwrite_one(finished):
    folder, _ = finished
    before = (folder / "model.safetensors").read_bytes()
    with pytest.raises(InputError, match="holds a run already; go on with --resume"):
        train(CONFIG, Spheres(), folder, OPTIONS)
    assert (folder / "model.safetensors").read_bytes() == before


def test_there_must_be_a_run_to_resume(tmp_path):
    with pytest.raises(InputError, match="there is no run to resume"):
        train(CONFIG, Spheres(), tmp_path, OPTIONS, resume=True)


def test_a_damaged_state_is_refused(finished, tmp_path):
    state = tmp_path / "state.safetensors"
    state.write_bytes((finished[0] / "state.safetensors").read_bytes()[:1000])
    with pytest.raises(ModelError, match="damaged"):
        train(CONFIG, Spheres(), tmp_path, OPTIONS, resume=True)
    state.write_bytes((finished[0] / "model.safetensors").read_bytes())
    with pytest.raises(ModelError, match="is not the state of a run"):
        train(CONFIG, Spheres(), tmp_path, OPTIONS, resume=True)
    tensors, description = load_tensors(finished[0] / "state.safetensors")
    del tensors["network.weights.weight.bias"]
    save_tensors(state, tensors, description)
    with pytest.raises(ModelError, match=r"damaged .*; start the run anew"):
        train(CONFIG, Spheres(), tmp_path, OPTIONS, resume=True)


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be created"):
        train(CONFIG, Spheres(), tmp_path / "file" / "run", OPTIONS)


def test_an_epoch_must_fill_a_batch(tmp_path):
    with pytest.raises(UsageError, match="lower --batch-size"):
        train(CONFIG, Spheres(), tmp_path / "run", dataclasses.replace(OPTIONS, batch_size=65))
    assert not (tmp_path / "run").exists()


def test_clouds_must_fill_a_patch(tmp_path):
    with pytest.raises(InputError, match="sphere 0: 15 points; a patch needs 16"):
        train(CONFIG, Spheres(points=15), tmp_path / "run", OPTIONS)


def test_a_loss_that_is_no_number_ends_the_run(tmp_path, monkeypatch):
    def spoiled(self, *args, original=PatchSampler._batch):
        batch = original(self, *args)
        if self.spoil:
            batch.points[0, 3] = torch.nan
        self.spoil = True  # from the second batch on
        return batch

    monkeypatch.setattr(PatchSampler, "spoil", False, raising=False)
    monkeypatch.setattr(PatchSampler, "_batch", spoiled)
    monkeypatch.setattr(Run, "save_if_due", Run.save)
    with pytest.raises(ModelError, match=r"the loss is nan .* after 8 patches; lower --learning-rate"):
        train(CONFIG, Spheres(), tmp_path / "run", OPTIONS)
    for tensor in load_tensors(tmp_path / "run" / "state.safetensors")[0].values():
        assert torch.isfinite(tensor).all()


def test_a_gradient_that_is_no_number_ends_the_run_before_the_weights_are_spoiled(tmp_path, monkeypatch):
    def steep(*args, original=loop.total_loss):
        terms = original(*args)
        spoiled = torch.zeros_like(terms["loss"]) * terms["loss"]
        spoiled.register_hook(lambda gradient: gradient * torch.nan)
        return terms | {"loss": terms["loss"] + spoiled}

    monkeypatch.setattr(loop, "total_loss", steep)
    networks = []
    monkeypatch.setattr(loop, "PatchFit", lambda config: networks.append(PatchFit(config)) or networks[-1])
    with pytest.raises(ModelError, match="its gradient nan"):
        train(CONFIG, Spheres(), tmp_path / "run", OPTIONS)
    assert all(torch.isfinite(parameter).all() for parameter in networks[0].parameters())


def test_the_rate_follows_the_schedule_of_the_paper():
    options = TrainOptions()
    epochs = {0: 1e-3, 299: 1e-3, 300: 1e-4, 549: 1e-4, 550: 1e-5, 699: 1e-5}
    for epoch, rate in epochs.items():
        assert learning_rate(epoch / 700, options) == pytest.approx(rate)


def test_the_cosine_falls_from_the_rate_to_zero():
    options = TrainOptions(learning_rate=0.02, schedule="cosine")
    rates = [learning_rate(share, options) for share in (0, 1 / 3, 0.5, 2 / 3, 1)]
    assert rates == pytest.approx([0.02, 0.015, 0.01, 0.005, 0], abs=1e-9)


def test_the_rate_reaches_the_optimizer(tmp_path, monkeypatch):
    rates = []

    def step(run, batch, rate, options, original=loop._step):
        terms = original(run, batch, rate, options)
        rates.append(run.optimizer.param_groups[0]["lr"])
        return terms

    monkeypatch.setattr(loop, "_step", step)
    train(CONFIG, Spheres(), tmp_path / "run", dataclasses.replace(OPTIONS, schedule="cosine"))
    steps = 2 * BATCHES
    assert rates == pytest.approx([0.003 * (1 + np.cos(np.pi * i / steps)) / 2 for i in range(steps)])


def test_validation_measures_angles_in_degrees():
    batches = loop._validation_batches(Spheres(), CONFIG.neighbors, 1)
    assert [len(batch.points) for batch in batches] == [20, 20]
    network = PatchFit(dataclasses.replace(CONFIG, correction=False, order=1))
    errors = validate(network, batches)
    assert not network.training
    true = torch.cat([batch.normals[:, 0] for batch in batches])
    # the transform starts as the identity, so that z is its direction
    expected = torch.rad2deg(torch.acos(true[:, 2].abs().clamp(max=1))).square().mean().sqrt().item()
    assert errors["rmse_z"] == pytest.approx(expected, rel=1e-4)
    assert errors["rmse"] == errors["rmse_rough"]  # nothing corrects
    assert 0 < errors["rmse"] < 10


def test_a_validation_set_of_its_own(tmp_path):
    class Planes(Spheres):
        def cloud(self, epoch, index, seed):
            points = np.random.default_rng(index).uniform(-1, 1, (400, 3)) * [1, 1, 0]
            return LabeledCloud("plane", points, np.tile([0.0, 0, 1], (400, 1)))

    options = dataclasses.replace(OPTIONS, epochs=1)
    train(CONFIG, Spheres(), tmp_path / "run", options, validation=Planes())
    assert float(metrics(tmp_path / "run")[0]["rmse_rough"]) < 0.1  # a plane is fitted whatever was learned


def test_training_in_bfloat16_lowers_the_loss(tmp_path):
    train(CONFIG, Spheres(), tmp_path / "run", dataclasses.replace(OPTIONS, bfloat16=True, epochs=4))
    losses = [float(row["loss"]) for row in metrics(tmp_path / "run")]
    assert losses[-1] < 0.8 * losses[0]
    assert load_tensors(tmp_path / "run" / "model.safetensors")[0]["weights.weight.weight"].dtype == torch.float32


def test_training_starts_from_the_weights_of_another_model(finished, tmp_path):
    options = dataclasses.replace(OPTIONS, epochs=1, learning_rate=0.0, initial=str(finished[0] / "model.safetensors"))
    train(dataclasses.replace(CONFIG, weights="adafit"), Spheres(), tmp_path / "run", options)
    before, after = (load_model(folder / "model.safetensors") for folder in (finished[0], tmp_path / "run"))
    torch.testing.assert_close(after.transform.conv1.last.weight, before.transform.conv1.last.weight, rtol=0, atol=0)
    assert after.weights.head[0].linear.weight.shape == before.weights.head[0].linear.weight.shape
    assert after.weights.first.linear.weight.shape != before.weights.first.linear.weight.shape


def test_model_without_a_fitting_weight_is_refused(tmp_path):
    save_tensors(tmp_path / "other.safetensors", {"unknown": torch.zeros(3)}, {})
    options = dataclasses.replace(OPTIONS, initial=str(tmp_path / "other.safetensors"))
    with pytest.raises(ModelError, match="shares no weights"):
        train(CONFIG, Spheres(), tmp_path / "run", options)
    assert not (tmp_path / "run").exists()
