from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from jetnormal.data.sources import DataSource
from jetnormal.networks.checkpoint import load_model
from jetnormal.training.recipe import Recipe
from jetnormal.training.train import train


@pytest.fixture(autouse=True)
def interruptible() -> Iterator[None]:
    """Let SIGINT interrupt: a shell that starts the tests in the background has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def resumed_equals_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, Any]]:
    """Train a whole run and one that is interrupted in its fifth step; both end with the same weights, to the bit."""

    def check(recipe: Recipe, task: type, source: DataSource, threads: int) -> dict[str, Any]:
        summary = train(recipe, tmp_path / "whole", source=source, threads=threads)
        steps = []

        def stop_in_the_fifth_step(*arguments, backward=task.backward):
            steps.append(1)
            if len(steps) == 5:
                raise KeyboardInterrupt
            return backward(*arguments)

        with monkeypatch.context() as patched:
            patched.setattr(task, "backward", stop_in_the_fifth_step)
            with pytest.raises(KeyboardInterrupt):
                train(recipe, tmp_path / "parts", source=source, threads=threads)
        train(recipe, tmp_path / "parts", source=source, threads=threads, resume=True)
        whole, parts = (load_model(tmp_path / name / "model.safetensors").state_dict() for name in ("whole", "parts"))
        assert all(torch.equal(value, parts[name]) for name, value in whole.items())
        return summary

    return check
