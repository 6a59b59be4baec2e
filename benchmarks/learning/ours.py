"""This project's side."""

from __future__ import annotations

from contextlib import closing

from benchmarks.learning.evaluation import Act, Referee
from trainers.inference.policy import Policy
from trainers.runfile.registry import Registries
from trainers.runfile.settings import RunSettings
from trainers.session import Session


def learn(run: RunSettings, registries: Registries, referee: Referee) -> Act:
    """Learns as the run file says; returns the final policy."""
    steps = run.trainer.settings.max_steps  # type: ignore[attr-defined]
    with closing(Session(run, registries)) as session:
        session.reset()
        act = policy_of(session)
        referee.start()
        while session.env_runner.step_count < steps:
            progress = session.env_runner.step_count / steps
            session.algorithm.collect()
            session.algorithm.update(progress)
            session.env_runner.pop_finished()
            referee.look(session.env_runner.step_count, act)
        return act


def policy_of(session: Session) -> Act:
    """The session's deterministic policy, which goes on learning with it."""
    env = session.env_runner.env
    policy = Policy(session.algorithm.policy, env.single_observation_space, env.single_action_space)
    return lambda observations: policy.predict(observations)[0]
