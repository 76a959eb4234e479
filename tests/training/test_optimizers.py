from __future__ import annotations

import copy
from collections.abc import Iterator

import pytest
import torch

from jetnormal.errors import ResourceError
from jetnormal.training.optimizers import MuonAdamW, make_optimizer
from jetnormal.training.options import TrainOptions

OPTIONS = TrainOptions(optimizer="muon", learning_rate=1e-2, weight_decay=0.0)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Small matrices in one thread: two that wait for each other are slow on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def network() -> torch.nn.Module:
    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(40, 64), torch.nn.ReLU(), torch.nn.Linear(64, 3))


def take_step(module: torch.nn.Module, optimizer: torch.optim.Optimizer, seed: int) -> float:
    batch = torch.randn(100, 40, generator=torch.Generator().manual_seed(seed))
    optimizer.zero_grad()
    loss = ((module(batch) - batch[:, :3].sin()) ** 2).mean()
    loss.backward()
    optimizer.step()
    return loss.item()


def test_muon_steps_matrices_by_nearly_orthogonal_matrices_as_large_as_adamw_would():
    module = network()
    before = module[0].weight.detach().clone()
    take_step(module, make_optimizer(module, OPTIONS), 0)
    step = (module[0].weight.detach() - before) / 1e-2
    size = 0.2 * 64**0.5
    values = torch.linalg.svdvals(step) / size
    assert values.min() > 0.5 and values.max() < 1.3  # five Newton-Schulz steps come that near to 1


def test_all_other_parameters_are_stepped_as_by_adamw():
    modules = network(), network()
    ours = make_optimizer(modules[0], OPTIONS)
    adamw = torch.optim.AdamW(modules[1].parameters(), lr=1e-2, weight_decay=0.0)
    for module, optimizer in zip(modules, (ours, adamw), strict=True):
        take_step(module, optimizer, 0)
    for name in ("0.bias", "2.weight", "2.bias"):
        assert torch.equal(modules[0].get_parameter(name), modules[1].get_parameter(name)), name
    assert not torch.equal(modules[0][0].weight, modules[1][0].weight)


def test_it_learns_and_obeys_the_rate():
    module = network()
    optimizer = make_optimizer(module, OPTIONS)
    first = take_step(module, optimizer, 0)
    for step in range(40):
        last = take_step(module, optimizer, step)
    assert last < first / 3
    for group in optimizer.param_groups:
        group["lr"] = 0.0
    before = copy.deepcopy(module.state_dict())
    take_step(module, optimizer, 0)
    assert all(torch.equal(value, before[name]) for name, value in module.state_dict().items())


def test_a_restored_state_goes_on_as_if_nothing_had_happened():
    module = network()
    optimizer = make_optimizer(module, OPTIONS)
    for step in range(3):
        take_step(module, optimizer, step)
    other = network()
    other.load_state_dict(module.state_dict())
    resumed = make_optimizer(other, OPTIONS)
    resumed.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    for step in range(3, 6):
        assert take_step(module, optimizer, step) == take_step(other, resumed, step)


def test_a_network_without_large_matrices_is_stepped_too():
    module = torch.nn.Linear(40, 3)
    optimizer = MuonAdamW(module.parameters(), lr=1e-2, weight_decay=0.0)
    assert take_step(module, optimizer, 0) > take_step(module, optimizer, 0)


def test_an_old_pytorch_is_named(monkeypatch):
    monkeypatch.delattr(torch.optim, "Muon")
    with pytest.raises(ResourceError, match=r"needs PyTorch 2\.9 or newer"):
        make_optimizer(network(), OPTIONS)
