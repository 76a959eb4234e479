from __future__ import annotations

import pytest
import torch

from jetnormal.errors import ResourceError, UsageError
from jetnormal.support.device import resolve_device


@pytest.fixture
def cuda(monkeypatch):
    """Sets how many CUDA devices PyTorch sees."""

    def pretend(count: int) -> None:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: count)

    return pretend


def test_auto_takes_cuda_where_there_is_one(cuda):
    cuda(2)
    assert resolve_device("auto") == "cuda"
    cuda(0)
    assert resolve_device("auto") == "cpu"


def test_present_devices_are_taken_as_named(cuda):
    cuda(2)
    assert [resolve_device(name) for name in ("cpu", "cuda", "cuda:0", "cuda:1")] == ["cpu", "cuda", "cuda:0", "cuda:1"]


@pytest.mark.parametrize(("count", "name"), [(0, "cuda"), (0, "cuda:0"), (2, "cuda:2")])
def test_absent_devices_are_refused(cuda, count, name):
    cuda(count)
    with pytest.raises(ResourceError, match=f"no device {name}"):
        resolve_device(name)


@pytest.mark.parametrize("name", ["", "gpu", "cuda:", "cuda:-1", "cuda:x", "CPU"])
def test_other_words_are_refused(name):
    with pytest.raises(UsageError, match="no device"):
        resolve_device(name)
