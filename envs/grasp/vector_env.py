"""The grasp environment: N robots before N scenes, stepped together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from curricula.samplers import ParameterValue, draw
from encoders.spaces import DepthImage, RgbImage
from envs.environment import Environment, Observations, StepResult
from envs.grasp.camera import Views, sample_views
from envs.grasp.scene import Scenes, SceneSampler
from envs.grasp.settings import Camera, GraspSettings
from envs.grasp.simulators.factory import make_simulator
from envs.grasp.task import Arm, GoalRegion, Motion, Progress, Tools, advance, judge
from rewards.reward import RewardTerm, weigh
from rewards.transition import Transition

PRIVILEGED = "privileged"
PRIVILEGED_SIZE = 22
# Brings the privileged numbers near 1: positions are decimetres off the workspace's middle.
WORKSPACE_MIDDLE_M = np.array([1.05, 0.0, 0.75])
DECIMETRES_PER_M = 10.0
OVERVIEW = Camera(
    type="rgb",
    width=640,
    height=480,
    fov_deg=55.0,
    position_m=(1.9, -1.5, 1.7),
    target_m=(0.75, 0.0, 0.75),
    near_m=(0.1, 0.1),
    far_m=(10.0, 10.0),
)
GOAL_PARAMETERS = ("lateral_limit_m", "vertical_limit_m", "gap_limit_m", "yaw_limit_deg")


class GraspVectorEnv(Environment):
    """N KUKA KR 16 with suction cups, each before its own blocks. See `Environment`.

    Observations: one image for each camera by its name, (N, H, W, 1) depth or (N, H, W, 3) RGB, and
    `privileged` (N, 22) where the settings ask for it. Actions: (N, 4) in [-1, 1], the tooltip's
    x, y, z and yaw over the workspace.

    Args:
        settings: the task.
        rewards: the terms whose weighted sum is the reward.
        seed: of everything that is drawn.
        render_mode: None, `rgb_array`, or `human` for PyBullet's window.
    """

    Settings = GraspSettings
    parameter_names: ClassVar[frozenset[str]] = frozenset(
        {*GOAL_PARAMETERS, "noise_sigma_m", "block_yaw_limit_deg"}
    )
    metadata: dict[str, Any] = {  # noqa: RUF012
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "render_modes": ["human", "rgb_array"],
        "render_fps": 5,
    }

    def __init__(
        self,
        settings: GraspSettings,
        rewards: Sequence[RewardTerm],
        seed: int = 0,
        render_mode: str | None = None,
    ):
        self._settings, self._rewards, self.render_mode = settings, tuple(rewards), render_mode
        self.num_envs = settings.num_envs
        self.single_action_space = Box(-1.0, 1.0, (4,), np.float32)
        self.single_observation_space = observation_space(settings)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._parameters: dict[str, ParameterValue] = {}
        self._arm = Arm(settings.workspace, settings.motion_checks)
        self._sampler = SceneSampler(settings)
        self._goal = GoalRegion.like(settings.goal, self.num_envs)
        self._rng = np.random.default_rng(seed)
        self._simulator = make_simulator(settings, self.num_envs, render_mode == "human")
        self._begun = False

    # -- gymnasium's interface -------------------------------------------------------------------

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begins new episodes, in all environments or where `options["reset_mask"]` (N,) is set."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        mask = (options or {}).get("reset_mask")
        if mask is None or not self._begun:
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
        terms = weigh(self._rewards, transition)
        terminated = transition.rotation_right
        truncated = ~terminated & (self._progress.steps >= self._settings.episode_steps)
        if not self._settings.frame_grab:
            self._take_pictures(np.arange(self.num_envs))
        infos = {
            "reward_terms": terms,
            "measures": self._measures(transition),
            "same_frame": np.full(self.num_envs, self._settings.frame_grab),
        }
        reward = sum(terms.values(), np.zeros(self.num_envs))
        return self._observations(), reward, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Pictures (480, 640, 3) of all environments; None where PyBullet's window shows them."""
        if self.render_mode != "rgb_array":
            return None
        still = np.random.default_rng(0)
        views = sample_views(OVERVIEW, still, self.num_envs, position_m=0.0, rotation_deg=0.0)
        return tuple(self._simulator.render(np.arange(self.num_envs), views))

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the simulator."""
        self._simulator.close()

    # -- training's interface --------------------------------------------------------------------

    def set_parameters(self, parameters: Mapping[str, ParameterValue]) -> None:
        """See `Environment.set_parameters`."""
        super().set_parameters(parameters)
        self._parameters = dict(parameters)

    def state_dict(self) -> dict[str, Any]:
        """See `Environment.state_dict`."""
        return {
            "rng": self._rng.bit_generator.state,
            "scenes": self._scenes.arrays(),
            "views": {name: views.arrays() for name, views in self._views.items()},
            "tools": self._tools.arrays(),
            "region": self._region.arrays(),
            "progress": self._progress.arrays(),
            "images": dict(self._images),
        }

    def load_state_dict(self, state: dict[str, Any]) -> Observations:
        """See `Environment.load_state_dict`."""
        self._rng.bit_generator.state = state["rng"]
        self._scenes = Scenes(**state["scenes"])
        self._views = {
            name: Views(camera, **state["views"][name])
            for name, camera in self._settings.cameras.items()
        }
        self._tools = Tools(**state["tools"])
        self._region = GoalRegion(**state["region"])
        self._progress = Progress(**state["progress"])
        self._images = dict(state["images"])
        self._begun = True
        self._simulator.load(np.arange(self.num_envs), self._scenes, self._tools.joints_rad)
        return self._observations()

    # -- the task --------------------------------------------------------------------------------

    @property
    def scenes(self) -> Scenes:
        """The running episodes' scenes."""
        return self._scenes

    def action_for(self, tooltip_m: NDArray[Any], yaw_rad: NDArray[Any]) -> NDArray[np.float64]:
        """The actions (N, 4) that lead to tooltips (N, 3) and yaws (N,)."""
        return self._arm.action(tooltip_m, yaw_rad)

    def _move(self, actions: NDArray[np.float64]) -> Transition:
        """Moves all robots, and brings the episodes' progress up to date."""
        before = self._tools
        after, path, duration_s = self._arm.reach(before, actions)
        contacts = self._simulator.move(np.arange(self.num_envs), path)
        motion = Motion(before, after, duration_s, contacts)
        transition = judge(motion, self._scenes, self._region, self._progress)
        self._tools, self._progress = after, advance(self._progress, transition)
        return transition

    def _begin(self, indices: NDArray[np.int64]) -> None:
        """Begins new episodes in some environments.

        What observations were made of is replaced, never written to: they may still be in use.
        """
        n = len(indices)
        goal = GoalRegion.like(self._settings.goal, n)
        given = {name: draw(value, self._rng, n) for name, value in self._parameters.items()}
        region = goal.with_arrays({name: given[name] for name in GOAL_PARAMETERS if name in given})
        yaw_limit_rad = np.radians(given.get("block_yaw_limit_deg", np.full(n, 180.0)))
        scenes, views = self._sampler.sample(self._rng, yaw_limit_rad)
        if "noise_sigma_m" in given:
            sigma_m = np.maximum(given["noise_sigma_m"], 0.0)
            views = {n: view.with_arrays({"noise_sigma_m": sigma_m}) for n, view in views.items()}
        tools, progress = self._arm.home(n), Progress.start(n)
        if self._begun:
            self._scenes = self._scenes.with_rows(indices, scenes)
            self._views = {
                name: self._views[name].with_rows(indices, view) for name, view in views.items()
            }
            self._region = self._region.with_rows(indices, region)
            self._tools = self._tools.with_rows(indices, tools)
            self._progress = self._progress.with_rows(indices, progress)
        else:
            self._scenes, self._views, self._region = scenes, views, region
            self._tools, self._progress = tools, progress
            self._images = {
                name: np.zeros((n, *space.shape), space.dtype)
                for name, space in self._image_spaces().items()
            }
            self._begun = True
        self._simulator.load(indices, scenes, tools.joints_rad)
        self._take_pictures(indices)

    def _take_pictures(self, indices: NDArray[np.int64]) -> None:
        for name, space in self._image_spaces().items():
            views = self._views[name][indices]
            pictures: NDArray[Any]
            if isinstance(space, DepthImage):
                seeds = self._rng.integers(2**63, size=len(indices), dtype=np.uint64)
                pictures = self._simulator.sense(indices, views, space, seeds)
            else:
                pictures = self._simulator.render(indices, views)
            self._images[name] = _with_rows(self._images[name], indices, pictures)

    def _image_spaces(self) -> dict[str, Any]:
        spaces = self.single_observation_space.spaces
        return {name: spaces[name] for name in self._settings.cameras}

    def _observations(self) -> Observations:
        observations: Observations = dict(self._images)
        if self._settings.privileged:
            observations[PRIVILEGED] = self._privileged()
        return observations

    def _privileged(self) -> NDArray[np.float32]:
        """True state (N, 22): tool and target pose, goal limits, the episode's progress."""
        scenes, tools, region, progress = self._scenes, self._tools, self._region, self._progress
        yaw = scenes.target_yaw_rad
        columns = [
            (tools.tooltip_m - WORKSPACE_MIDDLE_M) * DECIMETRES_PER_M,
            np.sin(tools.yaw_rad),
            tools.axis[:, 2],
            (scenes.target_m - WORKSPACE_MIDDLE_M) * DECIMETRES_PER_M,
            np.sin(yaw),
            (tools.tooltip_m - scenes.target_m) * DECIMETRES_PER_M,
            np.sin(tools.yaw_rad - yaw),
            region.lateral_limit_m * DECIMETRES_PER_M,
            region.vertical_limit_m * DECIMETRES_PER_M,
            region.gap_limit_m * DECIMETRES_PER_M,
            np.radians(region.yaw_limit_deg) * DECIMETRES_PER_M,
            progress.steps / self._settings.episode_steps,
            progress.steps == 0,
            progress.touched,
            progress.position_right,
            progress.rotation_right,
        ]
        return np.column_stack(columns).astype(np.float32)

    def _measures(self, transition: Transition) -> dict[str, NDArray[Any]]:
        """What to report: errors to the middle of the final goal region, and how it went."""
        goal = self._settings.goal
        middle = np.array([0.0, 0.0, (goal.gap_min_m + goal.gap_limit_m) / 2])
        error = np.abs(transition.offset_m - middle)
        return {
            "success": transition.rotation_right,
            "collision": self._progress.collided,
            "position_error_m": np.linalg.norm(error, axis=1),
            "position_error_x_m": error[:, 0],
            "position_error_y_m": error[:, 1],
            "position_error_z_m": error[:, 2],
            "yaw_error_deg": np.degrees(np.abs(transition.yaw_error_rad)),
        }


def observation_space(settings: GraspSettings) -> gymnasium.spaces.Dict:
    """The space of one environment's observations."""
    spaces: dict[str, gymnasium.Space[Any]] = {}
    for name, camera in settings.cameras.items():
        if camera.type == "depth":
            spaces[name] = DepthImage(camera.height, camera.width, camera.range_m, camera.encoding)
        else:
            spaces[name] = RgbImage(camera.height, camera.width)
    if settings.privileged:
        spaces[PRIVILEGED] = Box(-np.inf, np.inf, (PRIVILEGED_SIZE,), np.float32)
    return gymnasium.spaces.Dict(spaces)


def _with_rows(array: NDArray[Any], indices: NDArray[np.int64], rows: NDArray[Any]) -> NDArray[Any]:
    """A copy of an array with other rows at `indices`."""
    copy = array.copy()
    copy[indices] = rows
    return copy
