"""What a run reports, and when."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs.evaluation import error, rate
from envs.grasp.evaluation.evaluator import GraspEvaluator
from trainers.experience.episodes import EpisodeBatch
from trainers.reporting.summary import Summary, metric_tag
from trainers.reporting.terminal import RunStatus
from trainers.session import Session

MakeSession = Callable[..., Session]


class Log:
    """Keeps what a `RunLog` would write."""

    def __init__(self) -> None:
        self.points: dict[int, dict[str, float]] = {}
        self.pictures: list[tuple[str, tuple[int, ...], int]] = []
        self.statuses: list[dict[str, Any]] = []

    def scalars(self, values: dict[str, float], step: int) -> None:
        self.points[step] = dict(values)

    def image(self, tag: str, image: np.ndarray, step: int) -> None:
        self.pictures.append((tag, image.shape, step))

    def status(self, values: dict[str, Any]) -> None:
        self.statuses.append(values)


class Display:
    def __init__(self) -> None:
        self.lines: list[RunStatus] = []

    def update(self, line: RunStatus) -> None:
        self.lines.append(line)

    def advance(self, line: RunStatus) -> None:
        pass


def summary_of(log: Log, session: Session, start_step: int = 0, summary_freq: int = 100) -> Summary:
    env = session.env_runner.env
    quiet: Any = log
    return Summary(quiet, "run", env, 1000, summary_freq, start_step)


def report(summary: Summary, session: Session, step: int) -> Display:
    display = Display()
    session.env_runner.step_count = step
    observations = session.env_runner.observations
    summary.report(session.position, observations, display)  # type: ignore[arg-type]
    return display


def episodes(rewards: list[float], **episode_metrics: list[float]) -> EpisodeBatch:
    values = np.array(rewards)
    arrays = {name: np.array(numbers) for name, numbers in episode_metrics.items()}
    terms = {"near": values / 2, "far": values / 4}
    return EpisodeBatch(np.arange(len(values)), values, 10 * values, terms, arrays)


def test_episodes_weigh_alike_however_they_arrive(make_session: MakeSession) -> None:
    log, session = Log(), make_session()
    summary = summary_of(log, session)
    summary.add_episodes(episodes([1.0, 1.0, 1.0], success=[0, 0, 1], error_m=[1, 1, 1]))
    summary.add_episodes(episodes([], success=[], error_m=[]))
    summary.add_episodes(episodes([5.0], success=[1], error_m=[9]))
    summary.add({"Losses/Policy Loss": 1.0})
    summary.add({"Losses/Policy Loss": 2.0})
    report(summary, session, 100)
    points = log.points[100]
    assert points.pop("Performance/Steps Per Second") > 0
    assert points == {
        "Environment/Cumulative Reward": 2.0,
        "Environment/Episode Length": 20.0,
        "Environment/Success Rate": 0.5,
        "Environment/Error M": 3.0,
        "Reward/near": 1.0,
        "Reward/far": 0.5,
        "Losses/Policy Loss": 1.5,
    }


def test_metrics_have_the_names_of_their_figures() -> None:
    figures = (rate("crash", "crashes", key="crash_rate"), error("gap_m", "gap", "mm", 1000.0))
    assert metric_tag("success", figures) == "Environment/Success Rate"
    assert metric_tag("crash", figures) == "Environment/Crash Rate"
    assert metric_tag("gap_m", figures) == "Environment/Gap M"
    assert metric_tag("laps_driven", figures) == "Environment/Laps Driven"


def test_grasping_keeps_its_tags() -> None:
    tags = [metric_tag(name, GraspEvaluator.figures) for name in ("collision", "position_error_m")]
    assert tags == ["Environment/Collision Rate", "Environment/Position Error M"]


def test_summaries_come_at_multiples_of_their_frequency(make_session: MakeSession) -> None:
    log, session = Log(), make_session()
    summary = summary_of(log, session)
    for step in range(32, 480, 32):
        report(summary, session, step)
    # The first update at once, and then the first step at or after 100, 200, 300 and 400.
    assert list(log.points) == [32, 128, 224, 320, 416]
    resumed = summary_of(log2 := Log(), session, start_step=320)
    for step in range(352, 480, 32):
        report(resumed, session, step)
    assert list(log2.points) == [416]  # as if it had never stopped


def test_a_resumed_run_goes_on_with_what_it_had_gathered(make_session: MakeSession) -> None:
    log, session = Log(), make_session()
    before = summary_of(log, session)
    before.add_episodes(episodes([1.0, 3.0], success=[0, 1]))
    report(before, session, 100)
    before.add_episodes(episodes([4.0], success=[0]))
    before.add({"Losses/Value Loss": math.inf, "Losses/Policy Loss": 0.5})
    state = before.state_dict()
    after = summary_of(log2 := Log(), session, start_step=150)
    after.load_state_dict(state)
    after.status(session.position, "running")
    assert (log2.statuses[-1]["reward"], log2.statuses[-1]["success"]) == (2.0, 0.5)
    after.add_episodes(episodes([5.0, 6.0], success=[1, 1]))
    after.add({"Losses/Policy Loss": 1.5})
    report(after, session, 200)
    assert log2.points[200]["Environment/Cumulative Reward"] == 5.0
    assert log2.points[200]["Losses/Policy Loss"] == 1.0
    assert "Losses/Value Loss" not in log2.points[200]  # a checkpoint has no infinite means
    for name in state:
        summary_of(Log(), session).load_state_dict({name: state[name]})
    summary_of(Log(), session).load_state_dict({})  # of a former version


def test_a_summary_starts_anew_and_the_status_remembers(make_session: MakeSession) -> None:
    log, session = Log(), make_session()
    summary = summary_of(log, session)
    summary.add_episodes(episodes([1.0, 3.0], success=[0, 1]))
    report(summary, session, 100)
    display = report(summary, session, 200)  # no episode has ended in between
    assert "Environment/Cumulative Reward" not in log.points[200]
    assert display.lines[0].reward == 2.0
    assert display.lines[0].success == 0.5
    assert log.statuses[-1]["reward"] == 2.0
    summary.add_episodes(episodes([7.0], success=[1]))
    report(summary, session, 300)
    assert log.statuses[-1]["reward"] == 7.0


def test_the_status_says_where_the_run_stands(make_session: MakeSession) -> None:
    log, session = Log(), make_session()
    summary = summary_of(log, session)
    summary.status(session.position, "running")
    before = log.statuses[-1]
    assert before.pop("elapsed_s") >= 0
    assert before == {
        "run_id": "run",
        "state": "running",
        "step": 0,
        "max_steps": 1000,
        "lesson": 1,
        "lessons": 1,
        "reward": None,
        "success": None,
        "steps_per_second": None,
        "last_checkpoint": None,
        "reason": None,
        "evaluation": None,
    }
    summary.note_checkpoint(Path("/somewhere/step-9"))
    session.env_runner.step_count = 64
    summary.status(session.position, "finished")
    assert log.statuses[-1]["state"] == "finished"
    assert log.statuses[-1]["step"] == 64
    assert log.statuses[-1]["last_checkpoint"] == "/somewhere/step-9"


LESSONS = {
    "type": "lessons",
    "measure": "reward",
    "smoothing_episodes": 1,
    "min_lesson_length": 1,
    "lessons": [{"threshold": -9.0, "parameters": {"scale": 2.0}}, {"parameters": {"scale": 1.0}}],
}


def test_the_reward_is_that_of_the_last_summary(make_session: MakeSession) -> None:
    log, session = Log(), make_session("target", curriculum=LESSONS)
    summary = summary_of(log, session)
    summary.add_episodes(episodes([1.0, 2.0], success=[1, 0]))
    report(summary, session, 100)
    assert log.statuses[-1]["reward"] == 1.5
    assert log.points[100]["Environment/Lesson Number/lesson"] == 1
    session.advance_curriculum(episodes([1.0]), 0.5)
    summary.add_episodes(episodes([-3.0]))
    report(summary, session, 200)
    assert log.statuses[-1]["reward"] == -3.0
    assert log.points[200]["Environment/Lesson Number/lesson"] == 2
    assert log.statuses[-1]["lesson"] == log.statuses[-1]["lessons"] == 2


def test_no_lesson_is_logged_without_a_curriculum(make_session: MakeSession) -> None:
    log, session = Log(), make_session()
    report(summary_of(log, session), session, 100)
    assert not [tag for tag in log.points[100] if "Lesson" in tag]


def test_every_tenth_summary_shows_what_the_cameras_see(make_session: MakeSession) -> None:
    log = Log()
    camera = {"camera": {"type": "conv", "layers": [[2, 3, 1]]}}
    session = make_session("picture", encoders=camera)
    summary = summary_of(log, session, summary_freq=10)
    for step in range(10, 220, 10):
        report(summary, session, step)
    shown = ("Observations/camera", (240, 240, 3))
    assert log.pictures == [(*shown, 10), (*shown, 100), (*shown, 200)]
    resumed = summary_of(log2 := Log(), session, start_step=130, summary_freq=10)
    for step in range(140, 220, 10):
        report(resumed, session, step)
    assert log2.pictures == [(*shown, 200)]


def test_time_left_is_that_of_the_steps_that_are_left(
    make_session: MakeSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [50.0]
    monkeypatch.setattr("trainers.reporting.summary.time.monotonic", lambda: now[0])
    log, session = Log(), make_session()
    summary = summary_of(log, session, start_step=200)
    now[0] += 10.0
    line = report(summary, session, 400).lines[0]
    assert line.seconds_left == pytest.approx(30.0)  # 600 steps at 20 a second
    assert line.steps_per_second == pytest.approx(20.0)
    now[0] += 10.0
    line = report(summary, session, 800).lines[0]
    assert line.steps_per_second == pytest.approx(40.0)  # since the last summary
    assert line.seconds_left == pytest.approx(200 / 40)  # at the speed of the later half
    assert log.statuses[-1]["elapsed_s"] == 20.0
