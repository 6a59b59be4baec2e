"""The grasp environment: N robots before N scenes, stepped together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from pydantic import BaseModel

from curricula.samplers import ParameterValue, draw
from envs.deployment import Deployment
from envs.environment import Environment, ObservationArrays, StepResult
from envs.evaluation import EvaluationOption
from envs.grasp.deployment import deployment
from envs.grasp.episode_state import RunningEpisodes
from envs.grasp.evaluation.evaluator import EVALUATION_OPTIONS, GraspEvaluator
from envs.grasp.evaluation.pose_commands import PoseCommands
from envs.grasp.harder import harder
from envs.grasp.observations import (
    PRIVILEGED,
    image_spaces,
    observation_space,
    observed,
    privileged_state,
    take_images,
)
from envs.grasp.parameters import (
    GOAL_PARAMETERS,
    SENSOR_PARAMETERS,
    YAW_LIMIT,
    parameter_ranges,
)
from envs.grasp.robot.arm import Arm
from envs.grasp.robot.urdf import load_robot
from envs.grasp.scene.sampler import Scenes, SceneSampler
from envs.grasp.sensors.camera import CameraPoses, overviews
from envs.grasp.settings import GraspSettings
from envs.grasp.simulators.factory import make_simulator
from envs.grasp.streams import EnvironmentStreams
from envs.grasp.task import EpisodeProgress, GoalRegion, Motion, advance, judge
from envs.memory import shortage, space_bytes
from rewards.grasp.transition import GraspTransition
from rewards.reward import RewardTerm, fitting, weigh

OBSERVATIONS_HELD = 4
"""By the environment at a time: the last two, and the two bounds that its batched space has."""


class GraspVectorEnv(Environment):
    """N KUKA KR 16 with suction cups, each before its own blocks. See `Environment`.

    Observations: one for each camera by its name, (N, H, W, 1) depth, (N, H, W, 3) RGB or (N, P, 4)
    points, and `privileged` (N, 22), or (N, 18) without limits, where the settings ask for it.
    Actions: (N, 4) in [-1, 1], the tooltip's x, y, z and yaw over the workspace.

    Args:
        settings: the task.
        rewards: the terms whose weighted sum is the reward.
        seed: of everything that is drawn.
        render_mode: None, `rgb_array`, or `human` for PyBullet's window.
    """

    Settings = GraspSettings
    snapshot: ClassVar[type[GraspTransition]] = GraspTransition
    state_axes: ClassVar[Mapping[str, Any]] = dict.fromkeys(
        ("streams", "scenes", "region", "tools", "progress", "views", "images"), 0
    )
    pays_by_itself: ClassVar[bool] = False
    parameter_names = frozenset({*GOAL_PARAMETERS, *SENSOR_PARAMETERS, YAW_LIMIT})
    evaluation_episodes: ClassVar[int] = 1000
    evaluation_options: ClassVar[tuple[EvaluationOption, ...]] = EVALUATION_OPTIONS
    tags: ClassVar[Mapping[str, str]] = {
        "Environment/Collision Rate": "Share of the finished episodes with a collision.",
        "Environment/Position Error M": "Distance of the tooltip, after an episode's last action, "
        "from the middle of the goal region, in metres.",
        "Environment/Position Error X M": "The same along the face's lateral axis.",
        "Environment/Position Error Y M": "The same upwards.",
        "Environment/Position Error Z M": "The same along the face's normal: the gap's.",
        "Environment/Yaw Error Deg": "Angle between cup and face about the vertical, in degrees.",
    }
    metadata: dict[str, Any] = {  # noqa: RUF012
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "render_modes": ["human", "rgb_array"],
        "render_fps": 5,
    }

    def __init__(
        self,
        settings: GraspSettings,
        rewards: Sequence[RewardTerm[Any]],
        seed: int = 0,
        render_mode: str | None = None,
    ):
        self._settings, self.render_mode = settings, render_mode
        self._rewards = fitting(rewards, self.snapshot)
        self.num_envs = settings.num_envs
        self.single_action_space = Box(-1.0, 1.0, (4,), np.float32)
        self.single_observation_space = observation_space(settings)
        self._image_spaces = image_spaces(settings)
        self.privileged = frozenset({PRIVILEGED}) & self.single_observation_space.keys()
        per_env = OBSERVATIONS_HELD * space_bytes(self.single_observation_space)
        if lack := shortage(self.num_envs * per_env, "environments"):
            raise ValueError(
                f"num_envs {self.num_envs}: to hold the images of so many cameras {lack}: lower "
                "it, or let the network see fewer pixels (cameras, sampling)"
            )
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._parameters: dict[str, ParameterValue] = {}
        self._parameter_ranges = parameter_ranges(settings)
        self._arm = Arm.of(settings, load_robot())
        self._sampler = SceneSampler(settings)
        self._everyone = np.arange(self.num_envs)
        self._episodes: RunningEpisodes | None = None
        self._seed, self._rng = seed, np.random.default_rng(seed)
        self._first = 0
        self._streams: EnvironmentStreams | None = None  # in the place of the generator
        self._simulator = make_simulator(
            settings, self._arm.robot, self.num_envs, render_mode == "human"
        )

    # -- gymnasium's interface -------------------------------------------------------------------

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationArrays, dict[str, Any]]:
        """Begins new episodes, in all environments or where `options["reset_mask"]` (N,) is set."""
        if seed is not None:
            self._seed, self._rng = seed, np.random.default_rng(seed)
            if self._streams is not None:
                self.number_from(self._first)
        mask = (options or {}).get("reset_mask")
        if mask is None or self._episodes is None:
            mask = np.ones(self.num_envs, bool)
        self._begin(np.flatnonzero(mask))
        return self._observations(), {}

    def step(self, actions: NDArray[Any]) -> StepResult:
        """Moves every robot; see `Environment` for the `infos`."""
        observations, reward, terminated, truncated, infos = self.step_without_reset(actions)
        done = terminated | truncated
        if done.any():
            infos["final_obs"], infos["_final_obs"] = observations, done
            self._begin(np.flatnonzero(done))
            observations = self._observations()
            infos["same_frame"] = infos["same_frame"] & ~done
        return observations, reward, terminated, truncated, infos

    def step_without_reset(self, actions: NDArray[Any]) -> StepResult:
        """As `step`, but leaves finished episodes as they are."""
        actions = np.asarray(actions, np.float64)
        if actions.shape != (self.num_envs, 4) or not np.isfinite(actions).all():
            raise ValueError(
                f"actions must be finite and of shape ({self.num_envs}, 4), not {actions.shape} "
                f"with {np.count_nonzero(~np.isfinite(actions))} values that are not finite"
            )
        transition = self._move(actions)
        terms = weigh(self._rewards, transition, self.num_envs)
        terminated = transition.rotation_right & self._settings.end_on_success
        steps = self._running().progress.steps
        truncated = ~terminated & (steps >= self._settings.episode_steps)
        infos = {
            "reward_terms": terms,
            "episode_metrics": self._episode_metrics(transition),
            "same_frame": np.full(self.num_envs, self._settings.frame_grab),
        }
        reward = sum(terms.values(), np.zeros(self.num_envs))
        return self._observations(), reward, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Pictures (480, 640, 3) of all environments; None where PyBullet's window shows them."""
        if self.render_mode != "rgb_array":
            return None
        return tuple(self._simulator.render(self._everyone, overviews(self.num_envs)))

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the simulator."""
        self._simulator.close()

    @classmethod
    def deployment(cls, settings: BaseModel) -> Deployment:
        """See `Environment.deployment`."""
        assert isinstance(settings, GraspSettings)
        return deployment(settings)

    @classmethod
    def harder(cls, settings: BaseModel) -> dict[str, GraspSettings]:
        """See `Environment.harder`."""
        assert isinstance(settings, GraspSettings)
        return harder(settings)

    # -- training's interface --------------------------------------------------------------------

    def number_from(self, first: int) -> None:
        """See `Environment.number_from`; each has a stream of random numbers from then on."""
        self._first, self._streams = first, EnvironmentStreams(self._seed, first, self.num_envs)

    def set_parameters(self, parameters: Mapping[str, ParameterValue]) -> None:
        """See `Environment.set_parameters`.

        Raises:
            ValueError: there is no such parameter, or a value makes no sense or success impossible;
                see `envs.grasp.parameters`.
        """
        super().set_parameters(parameters)
        for name, value in parameters.items():
            self._parameter_ranges[name].check(name, value)
        self._parameters = dict(parameters)

    def state_dict(self) -> dict[str, Any]:
        """See `Environment.state_dict`."""
        streams = None if self._streams is None else self._streams.state.copy()
        return {
            "rng": self._rng.bit_generator.state,
            "streams": streams,
            **self._running().state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> ObservationArrays:
        """See `Environment.load_state_dict`.

        Raises:
            ValueError: the state is of another task, or of one process alone.
        """
        if self._first and state.get("streams") is None:
            raise ValueError(
                "its environments draw from one generator, as they did before they were numbered "
                "through, and several processes would draw the same: go on in one"
            )
        episodes = RunningEpisodes.from_state_dict(state, self._settings.cameras)
        self._arm.check(episodes.tools)
        self._sampler.check(episodes.scenes)
        self._rng.bit_generator.state = state["rng"]
        self._streams = EnvironmentStreams.of(state.get("streams"))
        self._episodes = episodes
        self._simulator.load(self._everyone, episodes.scenes, episodes.tools.joints_rad)
        return self._observations()

    # -- evaluation's interface ------------------------------------------------------------------

    def evaluator(self) -> GraspEvaluator:
        """See `Environment.evaluator`."""
        return GraspEvaluator(self._settings, self._arm, self._pose_commands)

    # -- the task --------------------------------------------------------------------------------

    @property
    def settings(self) -> GraspSettings:
        """The task."""
        return self._settings

    @property
    def scenes(self) -> Scenes:
        """The running episodes' scenes."""
        return self._running().scenes

    @property
    def region(self) -> GoalRegion:
        """The running episodes' goal regions."""
        return self._running().region

    def action_for(self, tooltip_m: NDArray[Any], yaw_rad: NDArray[Any]) -> NDArray[np.float64]:
        """The actions (N, 4) that lead to tooltips (N, 3) and yaws (N,)."""
        return self._arm.action(tooltip_m, yaw_rad)

    def _pose_commands(self, actions: NDArray[Any]) -> PoseCommands:
        """Poses that actions (n, 4) command in the first n environments."""
        n, episodes = len(actions), self._running()
        tooltip_m, yaw_rad = self._arm.pose(np.asarray(actions, np.float64))
        return PoseCommands(
            scenes=episodes.scenes[:n],
            region=episodes.region[:n],
            tooltip_m=tooltip_m,
            yaw_rad=yaw_rad,
            views={name: views[:n] for name, views in episodes.views.items()},
            images={name: images[:n] for name, images in episodes.images.items()},
        )

    def _running(self) -> RunningEpisodes:
        if self._episodes is None:
            raise gymnasium.error.ResetNeeded("call reset() first: no episode has begun yet")
        return self._episodes

    def _move(self, actions: NDArray[np.float64]) -> GraspTransition:
        """Moves all robots, and brings the episodes up to date."""
        episodes = self._running()
        after, path, duration_s = self._arm.reach(episodes.tools, *self._arm.pose(actions))
        contacts = self._simulator.move(self._everyone, path, self._settings.contact_resolution_m)
        motion = Motion(episodes.tools, after, duration_s, contacts)
        transition = judge(motion, episodes.scenes, episodes.region, episodes.progress)
        images = episodes.images
        if not self._settings.frame_grab:
            images = self._pictures(self._everyone, episodes.views)
        progress = advance(episodes.progress, transition)
        self._episodes = replace(episodes, tools=after, progress=progress, images=images)
        return transition

    def _begin(self, indices: NDArray[np.int64]) -> None:
        """Begins new episodes in some environments."""
        n, rng = len(indices), self._draws(indices)
        given = {
            name: self._parameter_ranges[name].clip(draw(value, rng, n))
            for name, value in self._parameters.items()
        }
        limits = {name: given[name] for name in GOAL_PARAMETERS if name in given}
        sensor = {name: given[name] for name in SENSOR_PARAMETERS if name in given}
        whole_yaw = np.full(n, self._parameter_ranges[YAW_LIMIT].high)
        yaw_limit_rad = np.radians(given.get(YAW_LIMIT, whole_yaw))
        scenes, views = self._sampler.sample(rng, yaw_limit_rad)
        views = {name: view.with_arrays(sensor) for name, view in views.items()}
        tools = self._arm.home(n)
        self._simulator.load(indices, scenes, tools.joints_rad)
        begun = RunningEpisodes(
            scenes=scenes,
            region=GoalRegion.like(self._settings.goal, n).with_arrays(limits),
            tools=tools,
            progress=EpisodeProgress.start(n),
            views=views,
            images=self._pictures(indices, views),
        )
        # Where all begin anew, nothing of the others is left to be copied.
        whole = n == self.num_envs
        self._episodes = begun if whole else self._running().with_rows(indices, begun)

    def _pictures(
        self, indices: NDArray[np.int64], views: Mapping[str, CameraPoses]
    ) -> dict[str, NDArray[Any]]:
        """What each camera observes now in some worlds, by its name."""
        rng = self._draws(indices)
        images = take_images(self._simulator, indices, views, self._image_spaces, rng)
        return observed(images, views, rng)

    def _draws(self, indices: NDArray[np.int64]) -> np.random.Generator:
        """The source of randomness for some environments."""
        if self._streams is None:
            return self._rng
        return cast(np.random.Generator, self._streams.rows(indices))

    def _observations(self) -> ObservationArrays:
        episodes = self._running()
        observations: ObservationArrays = dict(episodes.images)
        if self._settings.privileged:
            observations[PRIVILEGED] = privileged_state(episodes, self._settings)
        return observations

    def _episode_metrics(self, transition: GraspTransition) -> dict[str, NDArray[Any]]:
        """Episode metrics (N,) by name: errors to the middles of the regions, and how it went."""
        error = np.abs(transition.offset_m - self._running().region.middle_m)
        return {
            "success": transition.rotation_right,
            "collision": self._running().progress.collided,
            "position_error_m": np.linalg.norm(error, axis=1),
            "position_error_x_m": error[:, 0],
            "position_error_y_m": error[:, 1],
            "position_error_z_m": error[:, 2],
            "yaw_error_deg": np.degrees(np.abs(transition.yaw_error_rad)),
        }
