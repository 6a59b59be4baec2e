"""SAC from outside: found by its entry point, its mathematics by hand, and its runs."""

from __future__ import annotations

import math
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor, nn
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

from trainers import run as run_module
from trainers.common.errors import UserError
from trainers.experience.env_runner import EnvRunner
from trainers.export import main as export
from trainers.inference.onnx_policy import OnnxPolicy
from trainers.inference.policy import Policy
from trainers.networks.factory import NetworkFactory
from trainers.networks.observations import Observations
from trainers.runfile.registry import Registries, load_registries
from trainers.saving.checkpoint import Checkpoints

EXAMPLE = Path(__file__).parents[2] / "examples/ventosa-sac-plugin"
LINE = gymnasium.spaces.Dict({"x": Box(-99.0, 99.0, (1,), np.float32)})
SMALL = {"hidden_units": 8, "num_layers": 1}
SAC_RUN: dict[str, Any] = {
    "trainer_type": "sac",
    "max_steps": 320,
    "checkpoint_interval": 160,
    "hyperparameters": {"save_replay_buffer": True},
}


@pytest.fixture(scope="module", autouse=True)
def with_sac(
    registries: Registries, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Registries]:
    """What is built in, the toys, and the plugin, laid out as pip would for this module alone."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    folder = tmp_path_factory.mktemp("site")
    info = folder / "ventosa_sac_plugin.dist-info"
    info.mkdir()
    name, version = project["name"], project["version"]
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    points = "\n".join(f"{k} = {v}" for k, v in project["entry-points"]["ventosa"].items())
    (info / "entry_points.txt").write_text(f"[ventosa]\n{points}\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLE))
        patch.syspath_prepend(str(folder))
        yield replace(registries, trainers=load_registries().trainers)
    for module in [name for name in sys.modules if name.startswith("ventosa_sac")]:
        del sys.modules[module]


# -- the algorithm -------------------------------------------------------------------------------


class Q(nn.Module):
    """A critic whose values are `slope` x + `worth` a."""

    def __init__(self, slope: float, worth: float = 1.0):
        super().__init__()
        self.slope, self.worth = slope, worth

    def forward(self, observations: Observations, actions: Tensor) -> Tensor:
        return (self.slope * observations.vectors["x"] + self.worth * actions).squeeze(1)


@pytest.fixture
def on_a_line(
    scripted: Any, make_factory: Callable[..., NetworkFactory], with_sac: Registries
) -> Callable[..., Any]:
    """SAC with the experience of two steps, in two environments at x = 0 to 2 and 10 to 12.

    At the second step the first environment terminates, and the second is cut off at x = 50.
    """

    def make(**network: Any) -> Any:
        ends = np.array([[0, 0], [1, 1]])
        env = scripted(
            LINE,
            {"x": np.arange(3.0)[:, None, None] + np.array([[[0.0], [10.0]]])},
            reward=[[1.0, 2.0], [4.0, 8.0]],
            terminated=ends * [1, 0],
            truncated=ends * [0, 1],
            final={"x": np.full((2, 2, 1), 50.0)},
        )
        env_runner = EnvRunner(env)
        env_runner.reset()
        sac = with_sac.trainers.get("sac").cls
        hyper = {"batch_size": 4, "buffer_size": 4, "buffer_init_steps": 4, "gamma": 0.1}
        hyper["updates_per_step"] = 0.1  # none yet: the optimizers are new
        settings = sac.Settings(
            time_horizon=2, hyperparameters=hyper, network_settings=SMALL | network
        )
        torch.manual_seed(0)
        generator, device = torch.Generator().manual_seed(0), torch.device("cpu")
        algorithm = sac(make_factory(LINE.spaces), settings, env_runner, generator, device)
        algorithm.collect()
        algorithm.update(0.0)
        return algorithm

    return make


def test_log_densities_are_those_of_a_squashed_normal() -> None:
    from ventosa_sac.networks import sample

    generator = torch.Generator().manual_seed(0)
    mean, log_std, noise = (
        torch.randn(500, 3, generator=generator, dtype=torch.float64) for _ in range(3)
    )
    actions, log_probs = sample(mean, log_std, noise)
    expected = TransformedDistribution(
        Independent(Normal(mean, log_std.exp()), 1), TanhTransform(cache_size=1)
    )
    # By way of u: from an action near 1 it can't be had back.
    u = mean + log_std.exp() * noise
    squashed = expected.transforms[0](u)
    torch.testing.assert_close(actions, squashed)
    torch.testing.assert_close(log_probs, expected.log_prob(squashed))


def test_densities_stay_finite_where_tanh_is_flat() -> None:
    from ventosa_sac.networks import sample

    mean = torch.tensor([[40.0], [-40.0]], requires_grad=True)
    _, log_probs = sample(mean, torch.zeros(2, 1), torch.zeros(2, 1))
    # log(1 - tanh(u)^2) = log 4 - 2 |u| for large |u|
    expected = -0.5 * math.log(2.0 * math.pi) - (math.log(4.0) - 80.0)
    torch.testing.assert_close(log_probs, torch.full((2,), expected))
    log_probs.sum().backward()
    assert mean.grad is not None
    assert mean.grad.ravel().tolist() == [2.0, -2.0]


def test_targets_take_the_lesser_critic_less_the_weighted_density(
    on_a_line: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    algorithm = on_a_line()

    def drawn(observations: Observations, *_: Any) -> tuple[Tensor, Tensor]:
        x = observations.vectors["x"].squeeze(1)
        return torch.full((len(x), 1), 0.5), 3.0 * torch.ones_like(x)

    monkeypatch.setattr(algorithm, "_sample", drawn)
    algorithm.policy.targets = nn.ModuleList([Q(100.0), Q(90.0)])
    algorithm.policy.critics = nn.ModuleList()  # they are not asked
    with torch.no_grad():
        algorithm.policy.log_alpha.fill_(math.log(2.0))
    # r + 0.1 (min(100 x', 90 x') + 0.5 - 2 * 3); nothing follows where it terminated
    expected = [1.0 + 0.1 * 84.5, 2.0 + 0.1 * 984.5, 4.0, 8.0 + 0.1 * 4494.5]
    assert algorithm._targets(np.arange(4)).tolist() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("worth", [1.0, -1.0])
def test_the_actor_goes_where_the_critics_say(on_a_line: Callable[..., Any], worth: float) -> None:
    algorithm = on_a_line()
    policy = algorithm.policy
    policy.critics = nn.ModuleList([Q(0.0, worth), Q(0.0, 2.0 * worth)])
    indices = np.zeros(256, np.int64)
    observations = algorithm._buffer.observations(indices[:1], ("x",))
    before = policy.actor(observations)[0].item()
    algorithm._improve_actor(indices)
    assert (policy.actor(observations)[0].item() - before) * worth > 0.0


def test_the_temperature_widens_the_actor(on_a_line: Callable[..., Any]) -> None:
    algorithm = on_a_line()
    policy = algorithm.policy
    policy.critics = nn.ModuleList([Q(0.0, 0.0), Q(0.0, 0.0)])
    with torch.no_grad():  # narrow, so that more of it is more entropy
        policy.actor.head.bias[1] = -3.0
    indices = np.zeros(256, np.int64)
    observations = algorithm._buffer.observations(indices[:1], ("x",))
    before = policy.actor(observations)[1].item()
    algorithm._improve_actor(indices)
    assert policy.actor(observations)[1].item() > before


@pytest.mark.parametrize(("log_std", "direction"), [(-5.0, 1.0), (0.0, -1.0)])
def test_the_temperature_rises_where_the_entropy_is_below_its_target(
    on_a_line: Callable[..., Any], log_std: float, direction: float
) -> None:
    algorithm = on_a_line()
    head = algorithm.policy.actor.head
    with torch.no_grad():  # mean 0, and a deviation whose entropy is -3.6, or 0.6; the target is -1
        head.weight.zero_()
        head.bias.copy_(torch.tensor([0.0, log_std]))
    before = algorithm.policy.log_alpha.item()
    statistics = algorithm._improve_actor(np.zeros(256, np.int64))
    assert (statistics["Policy/Entropy"].item() < -1.0) == (direction > 0)
    # Adam's first step is of the learning rate's length.
    rate = algorithm._hyperparameters.learning_rate
    assert algorithm.policy.log_alpha.item() - before == pytest.approx(direction * rate, rel=1e-3)


def test_each_loss_moves_its_own_parameters_alone(on_a_line: Callable[..., Any]) -> None:
    algorithm = on_a_line()
    policy = algorithm.policy

    def moved(improve: Callable[..., Any]) -> set[str]:
        before = {name: weights.clone() for name, weights in policy.state_dict().items()}
        improve(np.arange(4))
        after = policy.state_dict()
        return {k.split(".")[0] for k in before if not torch.equal(before[k], after[k])}

    assert moved(algorithm._improve_critic) == {"critics"}
    assert moved(algorithm._improve_actor) == {"actor", "log_alpha"}


def test_the_critics_layers_calculate_in_the_precision_of_the_settings(
    on_a_line: Callable[..., Any],
) -> None:
    policy = on_a_line(precision="bfloat16").policy
    types: dict[str, torch.dtype] = {}
    for name, layer in policy.named_modules():
        if isinstance(layer, nn.Linear):
            layer.register_forward_hook(
                lambda _, __, out, name=name: types.__setitem__(name, out.dtype)
            )
    observations = Observations({}, {"x": torch.zeros(3, 1)})
    values = policy.value(observations, torch.zeros(3, 1), target=False)
    policy.actor(observations)
    assert types == {
        "actor.network.trunk.0": torch.bfloat16,
        "actor.head": torch.float32,
        **{f"critics.{k}.layers.0": torch.bfloat16 for k in range(2)},
        **{f"critics.{k}.layers.2": torch.float32 for k in range(2)},
    }
    assert values.dtype == torch.float32


# -- its runs ------------------------------------------------------------------------------------


@pytest.fixture
def learn_sac(
    learn: Callable[..., Any],
    write_run: Callable[..., Path],
    with_sac: Registries,
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., Any]:
    """Runs the command line with SAC on a toy: `learn_sac("--run-id", "one")`."""
    monkeypatch.setattr(run_module, "load_registries", lambda: with_sac)
    config = write_run("target", SAC_RUN)

    def run(*arguments: Any) -> Any:
        done = learn(config, *arguments)
        assert done.code == 0, done.errors
        return done

    return run


def test_it_is_found_by_its_entry_point(with_sac: Registries) -> None:
    entry = with_sac.trainers.get("sac")
    assert (entry.origin.plugin, entry.origin.distribution) == ("sac", "ventosa-sac-plugin 0.1.0")


def test_a_run_taken_up_again_ends_exactly_as_one_that_was_not_stopped(
    learn_sac: Callable[..., Any],
) -> None:
    results = learn_sac("--run-id", "whole").results
    learn_sac("--run-id", "halves", "trainer.max_steps=160")
    learn_sac("--run-id", "halves", "--resume")
    whole, halves = (
        Checkpoints(results / name / "checkpoints", keep=1).load_latest()
        for name in ("whole", "halves")
    )
    assert whole.weights.keys() == halves.weights.keys()
    for name, weights in whole.weights.items():
        assert torch.equal(weights, halves.weights[name]), name
    assert "log_alpha" in whole.weights
    assert whole.weights["log_alpha"].item() < 0.0  # it has learned: it began with log 1


def test_every_statistic_that_a_run_logs_is_explained(
    learn_sac: Callable[..., Any], with_sac: Registries
) -> None:
    log = EventAccumulator(str(learn_sac().results / "toy")).Reload()
    logged = {tag for tag in log.Tags()["scalars"] if tag.startswith(("Losses/", "Policy/"))}
    assert logged == with_sac.trainers.get("sac").cls.tags.keys()  # type: ignore[attr-defined]


def test_an_exported_policy_acts_and_names_the_plugin_where_that_is_missing(
    learn_sac: Callable[..., Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    results, folder = learn_sac().results, tmp_path / "policy"
    assert export(["toy", str(folder), "--results-dir", str(results)]) == 0
    goals = np.random.default_rng(0).uniform(-1.0, 1.0, (5, 2)).astype(np.float32)
    policy = Policy.load(folder, seed=3)
    best, _ = policy.predict(goals)
    drawn, _ = policy.predict(goals, deterministic=False)
    assert best.shape == drawn.shape == (5, 2)
    assert np.abs([best, drawn]).max() <= 1.0
    assert not np.array_equal(best, drawn)
    np.testing.assert_array_equal(best, policy.predict(goals)[0])
    file = tmp_path / "policy.onnx"
    assert export(["toy", str(file), "--results-dir", str(results)]) == 0
    said = capfd.readouterr().out  # the toy is not installed
    assert "on 100 observations drawn at random (" in said
    assert "unknown environment 'target'" in said
    told, _ = OnnxPolicy.load(file).predict(goals)
    np.testing.assert_allclose(told, best, atol=1e-5)
    without = [path for path in sys.path if not list(Path(path).glob("ventosa_sac_plugin*"))]
    assert len(without) < len(sys.path)
    monkeypatch.setattr(sys, "path", without)
    with pytest.raises(
        UserError, match=r"needs the trainer 'sac' of ventosa-sac-plugin 0\.1\.0, which is not"
    ):
        Policy.load(folder)
