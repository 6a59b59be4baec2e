"""A captured function does what the function itself does."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from trainers.algorithms import captured
from trainers.algorithms.captured import WARM_UP, Captured
from trainers.algorithms.optimization import adam, optimizer_step, set_learning_rates

ROUNDS = WARM_UP + 5


def rounds(device: torch.device, rates: list[float]) -> tuple[list[float], Tensor]:
    """A line fitted to noisy points: the loss of each round with its rate, and the weights."""
    generator = torch.Generator(device).manual_seed(3)
    weights = nn.Parameter(torch.zeros(2, device=device))
    optimizer = adam([[weights]], device)

    def step(x: Tensor) -> dict[str, Tensor]:
        noise = torch.randn(x.shape, generator=generator, device=device)
        loss = (weights[0] * x + weights[1] - 3.0 * x - 1.0 - 0.1 * noise).square().mean()
        return {"loss": optimizer_step(optimizer, loss, [weights], 1.0)[0]}

    improve, losses = Captured(step, generator, device), []
    for number, rate in enumerate(rates):
        set_learning_rates(optimizer, [rate])
        losses.append(improve(torch.linspace(-1.0, number, 5, device=device))["loss"])
    return [loss.item() for loss in losses], weights.detach().cpu()


def test_on_the_cpu_it_is_the_function_itself() -> None:
    seen: list[Tensor] = []

    def function(argument: Tensor) -> dict[str, Tensor]:
        seen.append(argument)
        return {"sum": argument.sum()}

    total = Captured(function, torch.Generator(), torch.device("cpu"))
    arguments = [torch.full((2,), float(number)) for number in range(ROUNDS)]
    assert [total(each)["sum"].item() for each in arguments] == [2.0 * n for n in range(ROUNDS)]
    assert all(a is b for a, b in zip(arguments, seen, strict=True))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU: captured steps on CUDA")
def test_a_graph_repeats_the_function_with_new_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    rates = [0.1 / (1 + number) for number in range(ROUNDS)]
    losses, weights = rounds(torch.device("cuda"), rates)
    monkeypatch.setattr(captured, "WARM_UP", ROUNDS)  # never captured
    plain_losses, plain_weights = rounds(torch.device("cuda"), rates)
    assert losses == pytest.approx(plain_losses, rel=1e-5)
    torch.testing.assert_close(weights, plain_weights)
    assert len(set(losses)) == ROUNDS
