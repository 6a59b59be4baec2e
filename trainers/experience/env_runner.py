"""Stepping the environments for a learner, with the books of the episodes kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from curricula.samplers import ParameterValue
from envs.environment import Environment, EnvironmentFailure
from trainers.common.averager import Averager
from trainers.common.errors import NonFiniteError
from trainers.common.stopping import StopRequested, may_be_given_up
from trainers.common.timers import timed
from trainers.distributed.world import ALONE, World
from trainers.experience.episodes import Cohorts, EpisodeBatch, concatenate, following


@dataclass(frozen=True)
class Step:
    """Result of one action in each of N environments.

    Attributes:
        reward: (N,).
        terminated: (N,) the episode reached an end of its own: nothing follows.
        truncated: (N,) the episode was stopped from outside, by a limit of steps for instance.
        same_frame: (N,) the images of the new observation are those of the one before.
        final_observations: (N, ...) as they were before the reset, right where an episode ended;
            None where none did. There wherever one was cut off.
    """

    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    same_frame: NDArray[np.bool_]
    final_observations: Mapping[str, NDArray[Any]] | None

    @property
    def done(self) -> NDArray[np.bool_]:
        """(N,) the episode ended, terminated or truncated."""
        return self.terminated | self.truncated

    @property
    def cut_off(self) -> NDArray[np.bool_]:
        """(N,) truncated and not terminated: what would follow has a value."""
        return self.truncated & ~self.terminated


class EnvRunner:
    """Steps the environments, checks what they return, and adds up the episodes.

    A run in several processes has one in each, for its share of the environments; the steps and the
    episodes that are counted are those of all.

    Args:
        env: the environments, n of the run's N.
        stop_requested: asked before every step, and in updates.
        world: the processes of the run.

    Attributes:
        share: which of the run's environments are stepped here.
        num_envs: N.
        observations: the present ones, as the environment gave them.
        step_count: steps taken in the run, over all environments.
        parameters_from: the number of the first episode with the environment's present parameters.
    """

    def __init__(
        self,
        env: Environment,
        stop_requested: Callable[[], bool] = lambda: False,
        world: World = ALONE,
    ):
        self.env, self._stop_requested, self.world = env, stop_requested, world
        self.share = world.share(env.num_envs)
        self.num_envs = self.share.total
        self.step_count = 0
        self.observations: Mapping[str, NDArray[Any]] = {}
        self._number = np.zeros(self.num_envs, np.int64)  # of everyone's running episodes
        self._begun = 0
        self.parameters_from = 0
        self._open_books()

    def _open_books(self) -> None:
        """Sums of the running episodes, and those that wait to be counted: none yet."""
        count = self.env.num_envs
        self._reward, self._length = np.zeros(count), np.zeros(count)
        self._terms: dict[str, NDArray[np.float64]] = {}
        self._ended: list[EpisodeBatch] = []  # since episodes were numbered last
        self._numbered_at = self.step_count
        self._cohorts = Cohorts(self.num_envs)

    def set_parameters(self, parameters: Mapping[str, ParameterValue]) -> None:
        """Sets environment parameters; they are those of all episodes that begin from now on.

        An environment draws them anew at its resets, which are where its episodes end. So all
        episodes from the number `parameters_from` on have them, and none before.

        Raises:
            ValueError: the environment has no such parameter.
        """
        self.env.set_parameters(parameters)
        self._number_episodes()
        self.parameters_from = self._begun

    def reset(self, seed: int | None = None) -> None:
        """Begins an episode everywhere; a seed says which ones.

        Nothing is left of episodes that ran, nor of those that `pop_finished` did not give yet.

        Raises:
            StopRequested: the run is to stop, and an environment did not return.
            EnvironmentFailure: one broke down.
        """
        with self._stoppable():
            self.observations, _ = self.env.reset(seed=seed)
        self._number_episodes()
        self._open_books()
        # All first episodes after a reset are of one cohort.
        self._begun = -(-self._begun // self.num_envs) * self.num_envs
        self._number = self._begun + np.arange(self.num_envs)
        self._begun += self.num_envs
        self._check_observations(self.observations)

    def step(self, actions: NDArray[Any]) -> Step:
        """Takes one action (N, ...) in every environment.

        Raises:
            StopRequested: the run is to stop: nothing was done, or an environment did not return.
            NonFiniteError: a reward or an observation is NaN or infinite.
            EnvironmentFailure: one broke down; or an episode was truncated, and its last
                observation is not there.
        """
        if self._stop_requested():
            raise StopRequested
        with timed("environment"), self._stoppable(self.num_envs):
            observations, reward, terminated, truncated, infos = self.env.step(actions)
        self.step_count += self.num_envs
        terms = infos.get("reward_terms", {})
        for name, values in terms.items():
            self._check(f"reward {name!r}", values)
        self._check("reward", reward)
        self._check_observations(observations)
        done = terminated | truncated
        final = infos.get("final_obs") if done.any() else None
        same_frame = infos.get("same_frame", np.zeros(len(reward), bool))
        step = Step(reward, terminated, truncated, same_frame, final or None)
        if step.final_observations is None and step.cut_off.any():
            raise EnvironmentFailure(
                f"step {self.step_count}: an episode was truncated, and the infos have no "
                "`final_obs`: what would follow can't be valued without its last observation"
            )
        self._check_observations(final or {}, done)
        self._add_up(reward, terms, infos.get("episode_metrics", {}), done)
        self.observations = observations
        return step

    def check_stop(self) -> None:
        """Lets the run stop here, in an update for instance; in all of its processes, or in none.

        Raises:
            StopRequested: it is to stop.
        """
        if self.world.any(self._stop_requested()):
            raise StopRequested

    def mean(self, tensors: Sequence[Tensor], weight: float) -> Sequence[Tensor]:
        """Means over all transitions of means over one's own; lets the run stop here, too.

        Args:
            tensors: alike in all processes, gradients for instance.
            weight: the share of all transitions that one's own are.

        Raises:
            StopRequested: it is to stop.
        """
        return self.world.mean(tensors, weight, stop=self._stop_requested())

    def means(self, averager: Averager) -> dict[str, float]:
        """Means over all that was added, in any process; an averager begins anew with it."""
        return self.world.means(averager)

    def all_rows(self, rows: Tensor) -> Tensor:
        """Everyone's (T N, ...), by step, then by environment, where one's own are (T n, ...)."""
        return self.world.all_rows(rows, self.env.num_envs)

    def all_groups(self, groups: Tensor) -> Tensor:
        """Everyone's groups (T N,), as `all_rows`; numbered as they come first."""
        return self.world.all_groups(groups, self.env.num_envs)

    @contextmanager
    def unstoppable(self) -> Iterator[None]:
        """Hears no request to stop meanwhile."""
        asked, self._stop_requested = self._stop_requested, lambda: False
        try:
            yield
        finally:
            self._stop_requested = asked

    @property
    def running(self) -> NDArray[np.int64]:
        """Numbers (N,) of the running episodes, in the order in which they began."""
        return self._number

    @property
    def longest_episode(self) -> int:
        """Steps of the longest of the running episodes."""
        return max(self.world.gather(int(self._length.max())))

    def pop_finished(self) -> EpisodeBatch:
        """The finished episodes of the cohorts that were completed since the last call.

        They come in the order in which they began; see `Cohorts` for why.
        """
        self._number_episodes()
        return self._cohorts.pop(int(self._number.min()))

    @property
    def state_axes(self) -> Mapping[str, Any]:
        """See `trainers.distributed.states`."""
        return {"env": self.env.state_axes, "reward": 0, "length": 0, "terms": 0}

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on exactly; of one's own environments."""
        self._number_episodes()
        return {
            "env": self.env.state_dict(),
            "step_count": self.step_count,
            "reward": self._reward.copy(),
            "length": self._length.copy(),
            "terms": {name: values.copy() for name, values in self._terms.items()},
            "number": self._number.copy(),
            "begun": self._begun,
            "parameters_from": self.parameters_from,
            "cohorts": self._cohorts.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state.

        One that was saved before episodes had numbers does not say which parameters those that run
        were begun with: the first to have the present ones are those that follow them.

        Raises:
            ValueError: it is the state of another number of environments.
        """
        for values in (state["reward"], state["length"], *state["terms"].values()):
            if values.shape != (self.env.num_envs,):
                raise ValueError(
                    f"it was saved with {len(values)} environments, not {self.env.num_envs}"
                )
        with self._stoppable():
            self.observations = self.env.load_state_dict(state["env"])
        self.step_count = state["step_count"]
        self._reward, self._length = state["reward"].copy(), state["length"].copy()
        self._terms = {name: values.copy() for name, values in state["terms"].items()}
        count = self.num_envs
        self._number = np.array(state.get("number", np.arange(count)))
        self._begun = state.get("begun", count)
        self.parameters_from = state.get("parameters_from", count)
        self._ended, self._numbered_at = [], self.step_count
        self._cohorts = Cohorts(count)
        if "cohorts" in state:
            self._cohorts.load_state_dict(state["cohorts"])

    @contextmanager
    def _stoppable(self, steps: int = 0) -> Iterator[None]:
        """Calls the environments, which need not come back where the run is to stop.

        What stops a run may have reached their processes, too: that they died is no failure then.

        Args:
            steps: that are taken; failures then say which.
        """
        with may_be_given_up():
            try:
                yield
            except EnvironmentFailure as failure:
                if self._stop_requested():
                    raise StopRequested from failure
                if not steps:
                    raise
                step = self.step_count + steps
                raise EnvironmentFailure(f"step {step}: {failure}") from failure

    def _number_episodes(self) -> None:
        """Numbers the episodes that began since it was done last, in all processes.

        By the step in which they began, then by environment, as if all were stepped here.
        """
        if self._numbered_at == self.step_count:
            return
        ended = concatenate(self.world.gather(concatenate(self._ended)))
        ended = ended[np.argsort(ended.number)]
        environment = ended.number % self.num_envs
        number = following(self._number, environment, self._begun)
        self._cohorts.add(replace(ended, number=number))
        self._begun += len(ended)
        self._ended, self._numbered_at = [], self.step_count

    def _add_up(
        self,
        reward: NDArray[np.float64],
        terms: Mapping[str, NDArray[np.float64]],
        episode_metrics: Mapping[str, NDArray[Any]],
        done: NDArray[np.bool_],
    ) -> None:
        self._reward += reward
        self._length += 1
        for name, values in terms.items():
            self._terms[name] = self._terms.get(name, 0.0) + values
        if done.any():
            # Their numbers are known as soon as it is known where else episodes ended before them.
            ended = self.step_count + self.share.first + np.flatnonzero(done)
            self._ended.append(
                EpisodeBatch(
                    ended,
                    self._reward[done],
                    self._length[done],
                    {name: total[done] for name, total in self._terms.items()},
                    {name: np.asarray(v, np.float64)[done] for name, v in episode_metrics.items()},
                )
            )
            for total in (self._reward, self._length, *self._terms.values()):
                total[done] = 0.0

    def _check_observations(
        self, observations: Mapping[str, NDArray[Any]], of: NDArray[np.bool_] | None = None
    ) -> None:
        for name, values in observations.items():
            if np.issubdtype(values.dtype, np.floating):
                self._check(f"observation {name!r}", values, of)

    def _check(self, what: str, values: NDArray[Any], of: NDArray[np.bool_] | None = None) -> None:
        """Refuses what is not finite, in all environments or in those where `of` (N,) is set."""
        finite = np.isfinite(values)
        if finite.all():
            return
        broken = ~finite
        if of is not None:
            broken[~of] = False
        if broken.any():
            environment = self.share.first + int(np.argwhere(broken)[0][0])
            value = np.asarray(values)[broken].flat[0]
            of_id = f" of {self.env.name!r}" if self.env.name else ""
            raise NonFiniteError(
                f"step {self.step_count}: the {what} of environment {environment}{of_id} is "
                f"{value}, and should be finite"
            )
