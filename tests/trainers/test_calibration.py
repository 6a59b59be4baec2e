"""Calibrating a policy: from the command to the answers, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from envs.evaluation import Evaluator
from trainers.calibrate import main
from trainers.common.command import DONE, MISTAKE
from trainers.common.errors import UserError
from trainers.common.options import SEED_LIMIT
from trainers.deployment import calibration
from trainers.deployment.calibration import FIRST_SEED
from trainers.evaluation import FIRST_SEED as FIRST_EVALUATED
from trainers.evaluation import (
    SEEDS_PER_BATCH,
    RecordedPolicy,
    evaluate,
    evaluation_environment,
    find_run,
)
from trainers.export import main as export
from trainers.inference.confidence import FILE, Card, JudgedError
from trainers.inference.confidence_fit import Examples
from trainers.inference.fitting import load_raw_policy
from trainers.inference.onnx_policy import OnnxPolicy
from trainers.inference.policy import Policy
from trainers.networks.actor_critic import ActorCritic
from trainers.reporting.figures import SURE, SURE_RIGHT
from trainers.runfile.registry import Registries
from trainers.saving.run_folder import find_checkpoint

EPISODES = "2000"


@pytest.fixture
def learned(learned: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """The same, with a target that can be shown in hundreds of episodes."""
    monkeypatch.setattr(calibration, "TARGET", 0.9)

    def results(environment: str = "darts", trainer: Any = None) -> Path:
        return learned(environment, trainer)

    return results


def calibrate(results: Path, *options: str, name: str = "toy") -> int:
    return main([name, "--results-dir", str(results), "--episodes", EPISODES, *options])


@pytest.mark.parametrize("trainer", ["ppo", "ddpg"])
def test_a_policy_knows_when_it_hits(
    learned: Callable[..., Path],
    trainer: str,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Hardly trained it hits what is near the middle, and what is off the board never."""
    results = learned(trainer={"trainer_type": trainer})
    with pytest.raises(UserError, match=r"has not been learned: run `python -m trainers.calibrate"):
        Policy.load("toy", results_dir=results).answer(np.zeros((1, 2), np.float32))
    assert calibrate(results, "--episodes", "8000") == DONE
    said = capfd.readouterr().out
    assert "right is at most: distance 70.00 cm" in said
    assert "  elsewhere: sure 0 of 800\n" in said
    assert "  off the board: sure 0 of 120\n" in said
    assert "  on the wall: 0.00% of 120 right; sure " in said  # learned from, and not refused
    assert "  one throw: " in said
    assert "  no throw: " not in said
    assert "no throw: left out, for it can't be had here: nobody may throw" in caplog.text
    policy = Policy.load("toy", results_dir=results)
    goals = np.random.default_rng(0).uniform(-0.8, 0.8, (400, 2)).astype(np.float32)
    answer = policy.answer(goals)
    np.testing.assert_array_equal(answer.actions, policy.predict(goals)[0])
    distance = np.linalg.norm(answer.actions - goals, axis=1)
    assert answer.sure.any()
    assert (distance[answer.sure] <= 0.7).mean() >= 0.9
    assert np.corrcoef(answer.errors["distance_m"], distance)[0, 1] > 0.9
    assert policy.confidence is not None
    np.testing.assert_array_equal(
        answer.sure, answer.probability >= np.float32(policy.confidence.card.threshold)
    )
    one = policy.answer(goals[0])
    assert one.actions.shape == (2,)
    assert one.sure.shape == one.probability.shape == one.errors["distance_m"].shape == ()
    assert not policy.answer(10.0 * goals).sure[np.abs(goals).max(1) > 0.5].any()


def test_an_evaluation_says_how_often_a_policy_is_sure_and_then_right(
    learned: Callable[..., Path],
) -> None:
    results = learned(trainer={"trainer_type": "ddpg"})
    before = evaluate("toy", episodes=300, results_dir=results).report
    assert before.keys().isdisjoint({SURE, SURE_RIGHT})
    assert calibrate(results) == DONE
    evaluation = evaluate("toy", episodes=300, results_dir=results)
    assert {k: v for k, v in evaluation.report.items() if k not in (SURE, SURE_RIGHT)} == before
    _, run = find_run("toy", (), results)
    policy = Policy.load("toy", results_dir=results)
    with closing(evaluation_environment(run, 300)) as env:
        answers, distances = [], []
        for batch in range(300 // env.num_envs):
            goals, _ = env.reset(seed=FIRST_EVALUATED + batch * SEEDS_PER_BATCH)
            answers.append(policy.answer(goals))
            metrics = env.step(answers[-1].actions)[-1]["episode_metrics"]
            distances.append(metrics["distance_m"])
    sure, right = np.concatenate([a.sure for a in answers]), np.concatenate(distances) <= 0.7
    assert evaluation.report[SURE] == pytest.approx(sure.mean())
    assert evaluation.report[SURE_RIGHT] == pytest.approx(right[sure].mean())
    assert 0.0 < sure.mean() < 1.0
    assert evaluation.figures[SURE].shown(0.5) == "50.0%"


def test_each_part_of_the_episodes_serves_one_purpose(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Examples are numbered by a feature; what is fitted with is not measured with."""
    error = JudgedError(metric="size", limit=1.0, label="size")
    card = Card(features=1, errors=(error,), weights_sha256="", target=0.9, episodes=0, seed=0)
    seen: dict[str, list[float]] = {}

    def numbered(first: int, right: bool) -> Examples:
        return Examples(
            torch.arange(first, first + 200.0)[:, None],
            torch.zeros(200, 1),
            torch.full((200,), right),
        )

    def recorded(name: str, at: int) -> Any:
        original = getattr(calibration, name)

        def record(*arguments: Any) -> Any:
            for examples in arguments[1:at]:
                seen.setdefault(name, []).extend(examples.features[:, 0].tolist())
            return original(*arguments)

        return record

    for name, at in (("fit", 3), ("rescale", 2), ("_counts", 2)):
        monkeypatch.setattr(calibration, name, recorded(name, at))
    calibration.learned(
        card,
        numbered(0, right=True),
        numbered(500, right=True),
        {"windy": numbered(1000, right=True)},
        {"dark": numbered(2000, right=False)},
        {"odd": numbered(3000, right=False)},
    )
    fitted, chosen, measured = (set(seen[name]) for name in ("fit", "rescale", "_counts"))
    assert not fitted & chosen
    assert not fitted & measured
    assert not chosen & measured
    assert set(numbered(0, right=True).features[:, 0].tolist()) < fitted
    assert chosen | measured > set(numbered(500, right=True).features[:, 0].tolist())
    assert set(numbered(3000, right=False).features[:, 0].tolist()) < measured
    assert len(fitted & set(map(float, range(1000, 1200)))) == 110


def test_the_promise_may_be_of_another_task(
    learned: Callable[..., Path], capfd: pytest.CaptureFixture[str]
) -> None:
    """An easier one, so that more can be called sure of it."""
    results = learned(trainer={"trainer_type": "ddpg"})
    near, confidences = "environment.episode_steps=2", []
    for overrides in ([], [near]):
        assert calibrate(results, *overrides) == DONE
        confidences.append(Policy.load("toy", results_dir=results).confidence)
    trained, promised = (found.card for found in confidences if found is not None)
    assert (trained.overrides, promised.overrides) == ((), (near,))
    assert promised.threshold < trained.threshold
    assert trained.measured is not None
    assert promised.measured is not None
    assert promised.measured.ordinary.actions == trained.measured.ordinary.actions == 300
    of = {name: counts.sure / counts.actions for name, counts in promised.measured.harder.items()}
    easy = promised.measured.ordinary
    assert easy.sure / easy.actions > of["as trained"]
    assert easy.sure_right / easy.sure >= 0.9
    assert "as trained" not in trained.measured.harder
    said = capfd.readouterr().out
    assert f"  {near}: " in said
    assert said.count("  as trained: ") == 2
    assert calibrate(results, "environment.episode_step=2") == MISTAKE
    assert "episode_steps" in capfd.readouterr().err


def test_it_goes_where_the_weights_go(
    learned: Callable[..., Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    results, folder = learned(), tmp_path / "mine"
    assert export(["toy", str(folder), "--results-dir", str(results)]) == DONE
    assert calibrate(results, name=str(folder)) == DONE
    own = (folder / FILE).read_bytes()
    assert calibrate(results) == DONE
    assert (find_checkpoint("toy", results).path / FILE).read_bytes() == own
    again = tmp_path / "again"
    assert export(["toy", str(again), "--results-dir", str(results)]) == DONE
    assert f"{again}: weights.safetensors, " in (said := capfd.readouterr().out)
    assert said.rstrip().endswith(f"{FILE}, manifest.json")
    assert (again / FILE).read_bytes() == own
    find_checkpoint("toy", results).path.joinpath(FILE).unlink()
    assert export(["toy", str(again), "--results-dir", str(results), "--force"]) == DONE
    assert Policy.load(again).confidence is None


def test_an_onnx_file_says_how_sure_it_is(learned: Callable[..., Path], tmp_path: Path) -> None:
    results, file = learned(), tmp_path / "policy.onnx"
    assert calibrate(results) == DONE
    assert export(["toy", str(file), "--results-dir", str(results)]) == DONE
    raw, exported = load_raw_policy("toy", results), OnnxPolicy.load(file)
    assert exported.card == raw.card
    assert raw.card is not None
    policy = Policy.load("toy", results_dir=results)
    for goal in np.random.default_rng(1).uniform(-1.5, 1.5, (40, 1, 2)).astype(np.float32):
        own, theirs, answer = raw.run({"goal": goal}), exported.run({"goal": goal}), None
        answer = policy.answer(goal)
        np.testing.assert_allclose(theirs["probability"], own["probability"], atol=1e-5)
        np.testing.assert_allclose(theirs["expected_errors"], own["expected_errors"], rtol=1e-4)
        np.testing.assert_allclose(own["probability"], answer.probability, atol=1e-6)
        np.testing.assert_array_equal(own["sure"], answer.sure)
        if abs(own["probability"][0] - raw.card.threshold) > 1e-4:
            np.testing.assert_array_equal(theirs["sure"], own["sure"])
    with pytest.raises(SystemExit):
        main(["--help"])
    assert main([str(file), "--episodes", EPISODES]) == MISTAKE


def test_equal_seeds_make_equal_files(learned: Callable[..., Path]) -> None:
    results = learned()
    contents = []
    for seed in ("0", "0", "1"):
        assert calibrate(results, "--seed", seed) == DONE
        contents.append((find_checkpoint("toy", results).path / FILE).read_bytes())
    assert contents[0] == contents[1]
    assert contents[0] != contents[2]


def test_no_seed_is_a_runs_or_an_evaluations() -> None:
    batch = SEEDS_PER_BATCH
    for seed in (0, SEED_LIMIT - 1):
        assert FIRST_SEED + seed >= FIRST_EVALUATED  # runs' are below
        # Evaluations' are in the other half of each batch's range.
        assert (FIRST_SEED + seed) % batch < FIRST_EVALUATED
        assert (FIRST_EVALUATED + 2 * seed + 1) % batch >= FIRST_EVALUATED


def test_nothing_is_sure_where_it_can_not_be_shown(
    learned: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    results = learned()
    monkeypatch.setattr(calibration, "TARGET", 0.9999)
    assert calibrate(results) == DONE
    said = capfd.readouterr().out
    assert "NOTHING IS SURE: 100.0% right could not be shown" in said
    assert "right; sure 0.00%\n" in said
    assert (
        not Policy.load("toy", results_dir=results).answer(np.zeros((9, 2), np.float32)).sure.any()
    )


@pytest.mark.parametrize(
    ("environment", "trainer", "options", "said"),
    [
        ("target", None, (), "does not say when an action is right: declare `answer_limits`"),
        (
            "darts",
            {"network_settings": {"memory": {"type": "lstm", "memory_size": 4}}},
            (),
            "the policy has memory",
        ),
        ("darts", None, ("--episodes", "99"), "--episodes 99: nothing can be learned from under"),
    ],
)
def test_what_can_not_be_calibrated_is_refused(
    learned: Callable[..., Path],
    environment: str,
    trainer: Any,
    options: tuple[str, ...],
    said: str,
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert calibrate(learned(environment, trainer), *options) == MISTAKE
    assert said in capfd.readouterr().err


def test_networks_with_an_act_of_their_own_are_refused(
    learned: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    results = learned()
    monkeypatch.delattr(ActorCritic, "features")
    assert calibrate(results) == MISTAKE
    said = capfd.readouterr().err
    assert "network (ActorCritic) doesn't tell the features" in said
    assert "implement `features` and `act_on` in place of `act`" in said


def test_limits_of_what_is_not_measured_are_refused(
    learned: Callable[..., Path], registries: Registries, capfd: pytest.CaptureFixture[str]
) -> None:
    results = learned()
    evaluator = registries.environments.get("darts").cls.evaluator
    limited = pytest.MonkeyPatch()
    with limited.context() as patch:

        def misspelt(self: Any) -> Evaluator:
            made: Evaluator = evaluator(self)
            patch.setattr(made, "answer_limits", {"distance": 1.0})
            return made

        patch.setattr(registries.environments.get("darts").cls, "evaluator", misspelt)
        assert calibrate(results) == MISTAKE
    said = capfd.readouterr().err
    assert "limits 'distance', which is not among its episode metrics; did you mean" in said


def test_recorded_features_are_those_of_the_actions(learned: Callable[..., Path]) -> None:
    policy = Policy.load("toy", results_dir=learned())
    recorded = RecordedPolicy(policy)
    goals = np.random.default_rng(0).uniform(-0.8, 0.8, (6, 2)).astype(np.float32)
    actions, _ = recorded.predict({"goal": goals})
    np.testing.assert_array_equal(actions, policy.predict(goals)[0])
    (features,) = recorded.features
    again = policy.network.act_on(features, deterministic=True, generator=torch.Generator())
    np.testing.assert_array_equal(again.detach().numpy().clip(-1.0, 1.0), actions)
    assert not features.requires_grad
    assert json.dumps(features.tolist())
