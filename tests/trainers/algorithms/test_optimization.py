"""One step of gradient descent."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
from torch import Tensor, nn

from trainers.algorithms.optimization import (
    adam,
    check_finite,
    load_generator,
    load_optimizer,
    optimizer_state,
    optimizer_step,
    set_learning_rates,
)
from trainers.common.errors import NonFiniteError

INFINITE = float("inf")


def stepped(slope: float, most: float) -> float:
    """How far a step of plain descent with rate 1 moves a weight whose loss has this slope."""
    weight = nn.Parameter(torch.zeros(()))
    optimizer_step(torch.optim.SGD([weight], lr=1.0, fused=True), slope * weight, [weight], most)
    return weight.item()


def test_a_step_goes_down_the_gradient_and_no_further_than_its_norm_may_be() -> None:
    assert stepped(3.0, INFINITE) == -3.0
    assert stepped(3.0, 0.5) == pytest.approx(-0.5, rel=1e-4)


def test_other_parameters_get_no_gradient() -> None:
    own, other = nn.Parameter(torch.ones(())), nn.Parameter(torch.ones(()))
    optimizer_step(torch.optim.SGD([own], lr=1.0, fused=True), own * other, [own], INFINITE)
    assert (own.item(), other.item()) == (0.0, 1.0)
    assert other.grad is None


def test_frozen_parameters_stay_as_they_are() -> None:
    learned, frozen = nn.Parameter(torch.ones(())), nn.Parameter(torch.ones(()), False)
    parameters = [frozen, learned]
    optimizer = torch.optim.SGD(parameters, 1.0, fused=True)
    optimizer_step(optimizer, 3.0 * learned * frozen, parameters, 0.5)
    assert (learned.item(), frozen.item()) == (pytest.approx(0.5, rel=1e-4), 1.0)


@pytest.mark.parametrize("scale", [float("nan"), INFINITE, 1e30])
def test_what_is_not_finite_changes_nothing(scale: float) -> None:
    """The last one's loss is finite, its gradient's norm is not."""
    weight = nn.Parameter(torch.full((), 1e-25))
    optimizer = adam([[weight]], torch.device("cpu"))
    set_learning_rates(optimizer, [1.0])
    step = optimizer_step(optimizer, weight * scale * 1e9, [weight], 1.0).tolist()
    assert weight.item() == pytest.approx(1e-25)
    with pytest.raises(NonFiniteError, match=r"^step 7: the loss is .*, its gradient's norm"):
        check_finite(step, 7)
    loss, norm = optimizer_step(optimizer, 2.0 * weight, [weight], 1.0).tolist()
    check_finite((loss, norm), 7)
    assert (weight.item(), norm) == (pytest.approx(-1.0), 2.0)


def test_what_the_loss_does_not_know_stays_as_it_is() -> None:
    known, unknown = nn.Parameter(torch.ones(())), nn.Parameter(torch.ones(()))
    optimizer = adam([[known, unknown]], torch.device("cpu"))
    set_learning_rates(optimizer, [0.1])
    for _ in range(2):  # the second time, too, when it could have a gradient of the first
        optimizer_step(optimizer, 2.0 * known, [known, unknown], INFINITE)
    assert known.item() == pytest.approx(0.8)
    assert (unknown.item(), unknown.grad) == (1.0, None)


def test_of_many_processes_each_sends_a_gradient_of_all_parameters() -> None:
    known, unknown = nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(3))
    optimizer = adam([[known, unknown]], torch.device("cpu"))
    sent: list[list[int]] = []

    def mean(own: Sequence[Tensor]) -> Sequence[Tensor]:
        sent.append([part.numel() for part in own])
        return own

    optimizer_step(optimizer, known.sum(), [known, unknown], INFINITE, mean, alone=False)
    assert sent == [[1, 2, 3]]


def stepped_adam(*shape: int) -> torch.optim.Adam:
    """An optimizer that took one step."""
    parameter = nn.Parameter(torch.zeros(shape))
    parameter.grad = torch.ones(shape)
    optimizer = torch.optim.Adam([parameter])
    optimizer.step()
    return optimizer


def test_an_optimizer_goes_back_to_its_own_state_alone() -> None:
    state = stepped_adam(2).state_dict()
    load_optimizer(other := stepped_adam(2), state)
    assert other.state_dict()["state"][0]["exp_avg"].tolist() == pytest.approx([0.1, 0.1])
    with pytest.raises(ValueError, match=r"state of a parameter \(\(3,\), torch.float32\) has"):
        load_optimizer(stepped_adam(3), state)
    del state["state"][0]["exp_avg"]
    with pytest.raises(ValueError, match=r"has \{'step'"):
        load_optimizer(stepped_adam(2), state)
    state = stepped_adam(2).state_dict()
    del state["param_groups"][0]["betas"]
    with pytest.raises(ValueError, match="the optimizer's state has no betas"):
        load_optimizer(stepped_adam(2), state)


def test_each_weight_of_a_convolution_goes_down_its_own_gradient() -> None:
    """Its images lie with their channels last, and so does its gradient as autograd gives it."""
    torch.manual_seed(0)
    convolution = nn.Conv2d(3, 4, 2)
    images = torch.randn(5, 6, 6, 3).permute(0, 3, 1, 2)
    loss = convolution(images).square().mean()
    (gradient,) = torch.autograd.grad(loss, [convolution.weight], retain_graph=True)
    before = convolution.weight.detach().clone()
    assert gradient.stride() != before.stride()
    optimizer = torch.optim.SGD([convolution.weight], lr=1.0, fused=True)
    optimizer_step(optimizer, loss, [convolution.weight], INFINITE)
    assert torch.equal(convolution.weight, before - gradient)


def test_a_generator_goes_on_where_it_was_and_that_of_another_device_is_a_seed() -> None:
    generator, other = torch.Generator().manual_seed(3), torch.Generator()
    load_generator(other, generator.get_state())
    assert torch.equal(torch.rand(5, generator=generator), torch.rand(5, generator=other))
    of_a_gpu = torch.arange(16, dtype=torch.uint8)
    drawn = []
    for seed in (1, 2):
        generator.manual_seed(seed)
        load_generator(generator, of_a_gpu)
        drawn.append(torch.rand(5, generator=generator).tolist())
    assert drawn[0] == drawn[1]
    with pytest.raises(RuntimeError):
        load_generator(generator, torch.zeros(17, dtype=torch.uint8))


def test_an_optimizer_s_state_is_of_the_same_kinds_on_every_device() -> None:
    optimizer = stepped_adam(2)
    optimizer.param_groups[0]["lr"] = torch.tensor(0.25)  # as it is on a GPU
    assert optimizer_state(optimizer)["param_groups"][0]["lr"] == 0.25
    assert isinstance(optimizer.param_groups[0]["lr"], torch.Tensor)
