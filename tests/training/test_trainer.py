from __future__ import annotations

import csv
import dataclasses
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from jetnormal.data.sources import LabeledCloud
from jetnormal.errors import InputError, ModelError, UsageError
from jetnormal.networks.checkpoint import load_model, load_tensors, save_tensors
from jetnormal.networks.patchfit.network import PatchFitConfig
from jetnormal.training.batches import PatchSampler
from jetnormal.training.options import DataOptions, LossWeights, PatchTraining
from jetnormal.training.patch_task import PatchTask
from jetnormal.training.recipe import Recipe, read_recipe
from jetnormal.training.run import Run
from jetnormal.training.train import train as train_recipe
from jetnormal.training.trainer import all_finite, learning_rate, uninterrupted

CONFIG = PatchFitConfig(neighbors=16, width=0.125)
OPTIONS = PatchTraining(epochs=2, batch_size=8, patches_per_cloud=32, learning_rate=3e-3, validation_patches=20)
RECIPE = Recipe("patchfit", CONFIG, DataOptions(), OPTIONS, LossWeights())
BATCHES = 8  # in an epoch of two clouds


def changed(network=None, losses=None, **training) -> Recipe:
    """The recipe with some options changed."""
    return dataclasses.replace(
        RECIPE,
        network=dataclasses.replace(CONFIG, **network or {}),
        losses=dataclasses.replace(RECIPE.losses, **losses or {}),
        training=dataclasses.replace(OPTIONS, **training),
    )


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


def train(recipe, source, folder, **options):
    return train_recipe(recipe, folder, source=source, device="cpu", threads=1, **options)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a run without interruption, and what it returned."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    return folder, train(RECIPE, Spheres(), folder)


def metrics(folder) -> list[dict[str, str]]:
    """The rows of a run but for the time they took."""
    with (folder / "metrics.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:
        assert float(row.pop("seconds")) >= 0
    return rows


def assert_same_run(first, second):
    assert (first / "model.safetensors").read_bytes() == (second / "model.safetensors").read_bytes()
    for name in ("model.safetensors", "state.safetensors"):
        a, b = load_tensors(first / name)[0], load_tensors(second / name)[0]
        assert a.keys() == b.keys()
        assert all(torch.equal(a[key], b[key]) for key in a)
    assert metrics(first) == metrics(second)


def test_a_run_leaves_a_network_a_state_and_metrics(finished):
    folder, summary = finished
    assert sorted(path.name for path in folder.iterdir() if path.name != ".lock") == [
        "config.toml",
        "metrics.csv",
        "model.safetensors",
        "state.safetensors",
    ]
    rows = metrics(folder)
    assert [(row["epoch"], row["samples"]) for row in rows] == [("1", "64"), ("2", "128")]
    terms = ["normal", "consistency", "z_direction", "regularization", "loss"]
    assert list(rows[0]) == ["epoch", "samples", *terms, "rmse", "rmse_rough", "rmse_z"]
    assert all(np.isfinite(float(value)) for row in rows for value in row.values())
    total = float(rows[0]["normal"]) + 0.25 * float(rows[0]["consistency"])
    total += 2 * float(rows[0]["z_direction"]) + 0.1 * float(rows[0]["regularization"])
    assert float(rows[0]["loss"]) == pytest.approx(total, rel=1e-4)

    assert summary["model"] == str(folder / "model.safetensors")
    assert summary["epoch"] == 2 and summary["samples"] == 128
    assert load_model(folder / "model.safetensors").config == CONFIG
    training = load_tensors(folder / "model.safetensors")[1]["training"]
    assert training["samples"] == 128 and training["training"]["learning_rate"] == 3e-3
    assert training["rmse"] == float(rows[-1]["rmse"])


@contextmanager
def interrupted(number: int, step: int, original=PatchTask.backward):
    """Send this process a signal in the middle of a step."""
    steps = []

    def backward(task, batch):
        terms = original(task, batch)
        steps.append(1)
        if len(steps) == step:
            signal.raise_signal(number)
        return terms

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PatchTask, "backward", backward)
        yield


@pytest.mark.parametrize("weights", ["adafit", "graphfit"])
def test_every_weight_predictor_trains_and_resumes(tmp_path, weights):
    network = {"weights": weights, "neighbors": 32, "order": 1, "offsets": True}
    recipe = changed(network, {"offsets": 0.5}, patches_per_cloud=16)
    train(recipe, Spheres(), tmp_path / "whole")
    row = {name: float(value) for name, value in metrics(tmp_path / "whole")[-1].items()}
    total = row["normal"] + 0.25 * row["consistency"] + 2 * row["z_direction"]
    total += 0.1 * row["regularization"] + 0.5 * row["offsets"]
    assert row["loss"] == pytest.approx(total, rel=1e-4)
    assert row["offsets"] > 0
    with interrupted(signal.SIGINT, 5), pytest.raises(KeyboardInterrupt):
        train(recipe, Spheres(), tmp_path / "halves")
    train(recipe, Spheres(), tmp_path / "halves", resume=True)
    assert_same_run(tmp_path / "whole", tmp_path / "halves")


def test_the_same_recipe_gives_the_same_bytes(finished, tmp_path):
    train(RECIPE, Spheres(), tmp_path / "run")
    assert_same_run(finished[0], tmp_path / "run")


def test_another_seed_gives_another_run(finished, tmp_path):
    train(changed(seed=2, epochs=1), Spheres(), tmp_path / "run")
    assert metrics(tmp_path / "run")[0] != metrics(finished[0])[0]


@pytest.mark.parametrize("step", [1, 3, BATCHES, BATCHES + 5])
def test_ctrl_c_finishes_the_step_and_saves(finished, tmp_path, step, caplog):
    with interrupted(signal.SIGINT, step), pytest.raises(KeyboardInterrupt):
        train(RECIPE, Spheres(), tmp_path / "run")
    assert "interrupted; saved in" in caplog.text
    position = load_tensors(tmp_path / "run" / "state.safetensors")[1]["position"]
    assert position["samples"] == 8 * step
    summary = train(RECIPE, Spheres(), tmp_path / "run", resume=True)
    assert_same_run(finished[0], tmp_path / "run")
    assert summary["loss"] == finished[1]["loss"] and summary["samples"] == 128


@pytest.mark.parametrize("stop", [3, BATCHES, BATCHES + 5])
def test_a_run_that_breaks_off_does_the_lost_steps_again(finished, tmp_path, monkeypatch, stop):
    """It was saved after each second step."""
    steps = []

    def backward(*arguments, original=PatchTask.backward):
        if len(steps) == stop:
            raise RuntimeError("the machine breaks down")
        steps.append(1)
        return original(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(PatchTask, "backward", backward)
        patched.setattr(Run, "save_if_due", lambda run: len(steps) % 2 or run.save())
        with pytest.raises(RuntimeError):
            train(RECIPE, Spheres(), tmp_path / "run")
    train(RECIPE, Spheres(), tmp_path / "run", resume=True)
    assert_same_run(finished[0], tmp_path / "run")


def test_an_interrupted_validation_is_done_again(finished, tmp_path, monkeypatch):
    def errors(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(PatchTask, "errors", errors)
        with pytest.raises(KeyboardInterrupt):
            train(RECIPE, Spheres(), tmp_path / "run")
    assert not (tmp_path / "run" / "metrics.csv").exists()
    train(RECIPE, Spheres(), tmp_path / "run", resume=True)
    assert_same_run(finished[0], tmp_path / "run")


def test_a_break_between_metrics_and_state_leaves_no_second_row(finished, tmp_path, monkeypatch):
    def broken(run, save=Run.save):
        if run.position.epoch == 2:
            raise RuntimeError
        save(run)

    with monkeypatch.context() as patched:
        patched.setattr(Run, "save", broken)
        with pytest.raises(RuntimeError):
            train(RECIPE, Spheres(), tmp_path / "run")
    assert len(metrics(tmp_path / "run")) == 2
    train(RECIPE, Spheres(), tmp_path / "run", resume=True)
    assert_same_run(finished[0], tmp_path / "run")


def test_signals_wait_for_the_end_of_the_block():
    done = []
    with pytest.raises(KeyboardInterrupt), uninterrupted():
        signal.raise_signal(signal.SIGINT)
        done.append(1)
    assert done == [1]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


KILLED = """
import importlib.util, sys, time
from pathlib import Path
spec = importlib.util.spec_from_file_location("case", {case!r})
case = importlib.util.module_from_spec(spec)
spec.loader.exec_module(case)
case.Run.save_if_due = lambda run: (run.save(), time.sleep(0.2))
case.train(case.RECIPE, case.Spheres(), Path(sys.argv[1]))
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
    train(RECIPE, Spheres(), folder, resume=True)
    assert_same_run(finished[0], folder)


def test_a_finished_run_resumed_returns_its_result(finished):
    folder, summary = finished
    again = train(RECIPE, Spheres(), folder, resume=True)
    assert again.pop("model") == str(folder / "model.safetensors")
    assert again == pytest.approx({name: summary[name] for name in again}, rel=1e-5)
    assert list(again) == list(summary)[1:]
    assert len(metrics(folder)) == 2


def test_a_run_is_not_resumed_with_other_options(finished):
    folder, _ = finished
    for other, message in [
        (changed(learning_rate=0.01), r"other options \(learning_rate was 0.003\)"),
        (changed(losses={"z_direction": 1.0}), r"other options \(z_direction was 2.0\)"),
        (changed({"order": 2}, seed=3), r"other options \(order was 3, seed was 1\)"),
    ]:
        with pytest.raises(UsageError, match=message):
            train(other, Spheres(), folder, resume=True)


def test_a_resumed_run_may_have_more_epochs(finished, tmp_path):
    """The rate of "step" is the same in the first two of four epochs as in two of two but for its drops."""
    train(changed(epochs=1), Spheres(), tmp_path / "run")
    train(changed(epochs=2), Spheres(), tmp_path / "run", resume=True)
    rows = metrics(tmp_path / "run")
    assert [row["epoch"] for row in rows] == ["1", "2"]
    assert read_recipe(str(tmp_path / "run" / "config.toml")).training.epochs == 2
    assert load_tensors(tmp_path / "run" / "model.safetensors")[1]["training"]["training"]["epochs"] == 2


def test_a_run_that_has_more_epochs_than_asked_for_stays_as_it_is(finished):
    folder, _ = finished
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(UsageError, match="the run has 2 epochs already, more than `epochs=1`; ask for more, or leave"):
        train(changed(epochs=1), Spheres(), folder, resume=True)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_run_that_began_before_an_option_existed_is_resumed(finished, tmp_path):
    tensors, description = load_tensors(finished[0] / "state.safetensors")
    del description["facts"]["network"]["light"]
    del description["facts"]["losses"]["offsets"]
    description["facts"]["training"]["obsolete"] = 1
    save_tensors(tmp_path / "state.safetensors", tensors, description)
    train(RECIPE, Spheres(), tmp_path, resume=True)
    with pytest.raises(UsageError, match="order was 3"):
        train(changed({"order": 2}), Spheres(), tmp_path, resume=True)


def test_one_process_at_a_time_trains_in_a_folder(finished):
    from filelock import FileLock

    folder, _ = finished
    with FileLock(folder / ".lock"), pytest.raises(InputError, match="another process trains here"):
        train(RECIPE, Spheres(), folder, resume=True)
    train(RECIPE, Spheres(), folder, resume=True)


def test_a_new_run_does_not_overwrite_one(finished):
    folder, _ = finished
    before = (folder / "model.safetensors").read_bytes()
    with pytest.raises(InputError, match="holds a run already; `resume` goes on"):
        train(RECIPE, Spheres(), folder)
    assert (folder / "model.safetensors").read_bytes() == before


@pytest.mark.parametrize("name", ["config.toml", "model.safetensors", "metrics.csv"])
def test_a_new_run_does_not_overwrite_the_files_of_others(tmp_path, name):
    (tmp_path / name).write_text("precious")
    with pytest.raises(InputError, match=f"{name}: would be overwritten; choose another folder"):
        train(RECIPE, Spheres(), tmp_path)
    assert [path.read_text() for path in tmp_path.iterdir() if path.suffix] == ["precious"]


def test_a_finished_run_says_that_it_is_done(finished, caplog):
    folder, summary = finished
    with caplog.at_level("INFO", "jetnormal"):
        assert train(RECIPE, Spheres(), folder, resume=True) == summary
    assert "all 2 epochs of the run are done; a larger number of epochs extends it" in caplog.messages


def test_there_must_be_a_run_to_resume(tmp_path):
    with pytest.raises(InputError, match="there is no run to resume"):
        train(RECIPE, Spheres(), tmp_path, resume=True)


def test_a_damaged_state_is_refused(finished, tmp_path):
    state = tmp_path / "state.safetensors"
    state.write_bytes((finished[0] / "state.safetensors").read_bytes()[:1000])
    with pytest.raises(ModelError, match="damaged"):
        train(RECIPE, Spheres(), tmp_path, resume=True)
    state.write_bytes((finished[0] / "model.safetensors").read_bytes())
    with pytest.raises(ModelError, match="is not the state of a run"):
        train(RECIPE, Spheres(), tmp_path, resume=True)
    tensors, description = load_tensors(finished[0] / "state.safetensors")
    del tensors["network.weights.weight.bias"]
    save_tensors(state, tensors, description)
    with pytest.raises(ModelError, match=r"damaged .*; start the run anew"):
        train(RECIPE, Spheres(), tmp_path, resume=True)


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be created"):
        train(RECIPE, Spheres(), tmp_path / "file" / "run")


def test_an_epoch_must_fill_a_batch(tmp_path):
    with pytest.raises(UsageError, match="lower the batch size"):
        train(changed(batch_size=65), Spheres(), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_clouds_must_fill_a_patch(tmp_path):
    with pytest.raises(InputError, match="sphere 0: 15 points; a patch needs 16"):
        train(RECIPE, Spheres(points=15), tmp_path / "run")


def test_a_loss_that_is_no_number_ends_the_run(tmp_path, monkeypatch):
    def spoiled(self, *args, original=PatchSampler.join):
        batch = original(self, *args)
        if self.spoil:
            batch.points[0, 3] = torch.nan
        self.spoil = True  # from the second batch on
        return batch

    monkeypatch.setattr(PatchSampler, "spoil", False, raising=False)
    monkeypatch.setattr(PatchSampler, "join", spoiled)
    with pytest.raises(ModelError, match=r"the loss is nan .* after 8 samples; lower the learning rate"):
        train(RECIPE, Spheres(), tmp_path / "run", save_interval=0)
    for tensor in load_tensors(tmp_path / "run" / "state.safetensors")[0].values():
        assert torch.isfinite(tensor).all()


def test_a_gradient_that_is_no_number_ends_the_run_before_the_weights_are_spoiled(tmp_path, monkeypatch):
    tasks = []

    def backward(task, batch, original=PatchTask.backward):
        terms = original(task, batch)
        next(task.network.parameters()).grad[0] = torch.nan
        tasks.append(task)
        return terms

    monkeypatch.setattr(PatchTask, "backward", backward)
    with pytest.raises(ModelError, match="its gradient nan"):
        train(RECIPE, Spheres(), tmp_path / "run")
    assert all_finite(tasks[0].network)


def test_weights_that_are_no_numbers_are_never_saved(tmp_path, monkeypatch):
    def step(optimizer, closure=None):
        optimizer.param_groups[0]["params"][0].data[0] = torch.inf

    monkeypatch.setattr(torch.optim.Adam, "step", step)
    with pytest.raises(ModelError, match="a step made weights that are not finite after 0 samples"):
        train(changed(epochs=1), Spheres(), tmp_path / "run", save_interval=0)
    assert not (tmp_path / "run" / "model.safetensors").exists()


def test_the_rate_follows_the_schedule_of_the_paper():
    epochs = {0: 1e-3, 299: 1e-3, 300: 1e-4, 549: 1e-4, 550: 1e-5, 699: 1e-5}
    for epoch, rate in epochs.items():
        assert learning_rate(epoch / 700, PatchTraining()) == pytest.approx(rate)


def test_the_cosine_falls_from_the_rate_to_zero():
    options = PatchTraining(learning_rate=0.02, schedule="cosine")
    rates = [learning_rate(share, options) for share in (0, 1 / 3, 0.5, 2 / 3, 1)]
    assert rates == pytest.approx([0.02, 0.015, 0.01, 0.005, 0], abs=1e-9)


def test_the_warm_cosine_rises_first():
    options = PatchTraining(learning_rate=1.0, schedule="warm-cosine")
    rates = [learning_rate(share, options) for share in np.linspace(0, 0.999, 200)]
    assert rates[0] == pytest.approx(0.01)
    assert max(rates) > 0.99
    assert rates[-1] < 1e-3
    top = int(np.argmax(rates))
    assert rates[top:] == sorted(rates[top:], reverse=True)


def test_the_rate_reaches_the_optimizer(tmp_path, monkeypatch):
    rates = []

    def update(run, original=Run.update_average):
        rates.append(run.optimizer.param_groups[0]["lr"])
        original(run)

    monkeypatch.setattr(Run, "update_average", update)
    train(changed(schedule="cosine"), Spheres(), tmp_path / "run")
    steps = 2 * BATCHES
    assert rates == pytest.approx([0.003 * (1 + np.cos(np.pi * i / steps)) / 2 for i in range(steps)])


def test_the_average_of_the_weights_is_saved_and_resumed(finished, tmp_path):
    recipe = changed(average=0.9)
    plain = load_tensors(finished[0] / "state.safetensors")[0]
    train(recipe, Spheres(), tmp_path / "whole")
    state = load_tensors(tmp_path / "whole" / "state.safetensors")[0]
    saved = load_tensors(tmp_path / "whole" / "model.safetensors")[0]
    name = "transform.conv1.last.weight"
    assert torch.equal(state[f"network.{name}"], plain[f"network.{name}"])  # the training itself is the same
    assert torch.equal(saved[name], state[f"average.module.{name}"])
    assert not torch.equal(saved[name], plain[f"network.{name}"])
    with interrupted(signal.SIGINT, 11), pytest.raises(KeyboardInterrupt):
        train(recipe, Spheres(), tmp_path / "halves")
    train(recipe, Spheres(), tmp_path / "halves", resume=True)
    assert_same_run(tmp_path / "whole", tmp_path / "halves")


def test_the_average_follows_its_recursion(tmp_path, monkeypatch):
    seen = []

    def update(run, original=Run.update_average):
        original(run)
        seen.append([next(network.parameters()).detach().clone() for network in (run.network, run.result)])

    monkeypatch.setattr(Run, "update_average", update)
    train(changed(average=0.75, epochs=1), Spheres(), tmp_path / "run")
    average = seen[0][0]
    for weights, found in seen:
        average = 0.75 * average + 0.25 * weights
        torch.testing.assert_close(found, average, rtol=1e-4, atol=1e-6)


def test_validation_may_be_rarer_than_epochs(tmp_path):
    train(changed(epochs=5, validate_every=2, patches_per_cloud=8), Spheres(), tmp_path / "run")
    rows = metrics(tmp_path / "run")
    assert [row["epoch"] for row in rows if row["rmse"]] == ["2", "4", "5"]
    assert all(row["loss"] for row in rows)


def test_validation_measures_angles_in_degrees():
    task = PatchTask(dataclasses.replace(CONFIG, correction=False, order=1), OPTIONS, LossWeights())
    batches = task.held_out(Spheres())
    assert [len(batch.points) for batch in batches] == [20, 20]
    refined, rough, z_direction = task.errors(task.network, batches)
    assert not task.network.training
    true = torch.cat([batch.normals[:, 0] for batch in batches])
    # the transform starts as the identity, so that z is its direction
    expected = torch.rad2deg(torch.acos(true[:, 2].abs().clamp(max=1))).square().mean().sqrt().item()
    assert z_direction == pytest.approx(expected, rel=1e-4)
    assert refined == rough  # nothing corrects
    assert 0 < refined < 10


def test_a_validation_set_of_its_own(tmp_path):
    class Planes(Spheres):
        def cloud(self, epoch, index, seed):
            points = np.random.default_rng(index).uniform(-1, 1, (400, 3)) * [1, 1, 0]
            return LabeledCloud("plane", points, np.tile([0.0, 0, 1], (400, 1)))

    train(changed(epochs=1), Spheres(), tmp_path / "run", validation=Planes())
    assert float(metrics(tmp_path / "run")[0]["rmse_rough"]) < 0.1  # a plane is fitted whatever was learned


def test_training_in_bfloat16_lowers_the_loss(tmp_path):
    train(changed(bfloat16=True, epochs=4), Spheres(), tmp_path / "run")
    losses = [float(row["loss"]) for row in metrics(tmp_path / "run")]
    assert losses[-1] < 0.8 * losses[0]
    assert load_tensors(tmp_path / "run" / "model.safetensors")[0]["weights.weight.weight"].dtype == torch.float32


def test_training_starts_from_the_weights_of_another_model(finished, tmp_path):
    initial = str(finished[0] / "model.safetensors")
    recipe = changed({"weights": "adafit"}, epochs=1, learning_rate=0.0, initial=initial)
    train(recipe, Spheres(), tmp_path / "run")
    before, after = (load_model(folder / "model.safetensors") for folder in (finished[0], tmp_path / "run"))
    torch.testing.assert_close(after.transform.conv1.last.weight, before.transform.conv1.last.weight, rtol=0, atol=0)
    assert after.weights.head[0].linear.weight.shape == before.weights.head[0].linear.weight.shape
    assert after.weights.first.linear.weight.shape != before.weights.first.linear.weight.shape


def test_model_without_a_fitting_weight_is_refused(tmp_path):
    save_tensors(tmp_path / "other.safetensors", {"unknown": torch.zeros(3)}, {})
    with pytest.raises(ModelError, match="shares no weights"):
        train(changed(initial=str(tmp_path / "other.safetensors")), Spheres(), tmp_path / "run")
    assert not (tmp_path / "run").exists()
