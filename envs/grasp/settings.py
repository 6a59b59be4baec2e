"""Settings of the grasp environment: everything TASK leaves to the run file, with its default."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import (
    BaseModel,
    Field,
    field_validator,
    model_validator,
)

from envs.cameras import Intrinsics, Point, SamplingSettings
from envs.grasp.ranges import Range
from envs.grasp.scene.blocks import MIN_BAR_M
from envs.grasp.sensors.structured_light import Gaussian, StructuredLight

MIN_CONTACT_RESOLUTION_M = 1e-6
# Well under the thinnest bar of a block, so that nothing is passed through.
MAX_CONTACT_RESOLUTION_M = 0.02
MAX_GOAL_M, MAX_GOAL_DEG = 100.0, 360.0
MAX_YAW_DEG = 180.0
MAX_NOISE_SIGMA_M = 1.0
# About as far as the arm can go straight ahead at all.
MAX_STANDOFF_M = 1.0
MAX_BACKDROP_YAW_DEG = 45.0
MAX_CABLE_M = 0.02


def check_resolution(resolution_m: float) -> float:
    """The resolution of a look for contacts, in metres, if it is one.

    Raises:
        ValueError: it is so fine that a motion has no end of looks, or so coarse that the robot
            could pass through a block between two of them.
    """
    if not MIN_CONTACT_RESOLUTION_M <= resolution_m <= MAX_CONTACT_RESOLUTION_M:
        raise ValueError(
            f"contacts can't be looked for every {resolution_m} m: a motion would have no end of "
            "looks, or blocks between two of them; give "
            f"{MIN_CONTACT_RESOLUTION_M:g} to {MAX_CONTACT_RESOLUTION_M:g} m, such as 0.005"
        )
    return resolution_m


FieldOfView = Annotated[float, Field(gt=1.0, lt=170.0)]


class Cloud(BaseModel, frozen=True, extra="forbid"):
    """The points that are made of a depth image."""

    points: int = Field(
        512,
        ge=1,
        le=65536,
        description="Points of a cloud; where fewer pixels are seen, the others are missing.",
    )
    frame: Literal["base", "camera"] = Field(
        "base",
        description="Frame of the points: the robot's base, by where the camera stands when "
        "nothing is drawn (a robot knows no better), or the camera.",
    )
    choice: Literal["random", "farthest"] = Field(
        "random",
        description="Which of the pixels that are seen: any, or always the point that is farthest "
        "from those before, which takes milliseconds a cloud.",
    )


class Camera(BaseModel, frozen=True, extra="forbid"):
    """A pinhole camera, sampled at pixel centres."""

    type: Literal["depth", "rgb", "points"] = Field(
        description="What the camera delivers: images of depths or colours, or points made of "
        "depths."
    )
    cloud: Cloud = Field(Cloud(), description="Points only: how they are made of depths.")
    width: int = Field(80, ge=1, le=4096, description="Width of the sensor in pixels.")
    height: int = Field(80, ge=1, le=4096, description="Height of the sensor in pixels.")
    fov_deg: FieldOfView | tuple[FieldOfView, FieldOfView] = Field(
        44.0,
        description="Field of view of the sensor in degrees: horizontal, where pixels are square; "
        "or [horizontal, vertical]. The optical axis goes through the middle.",
    )
    intrinsics: Intrinsics | None = Field(
        None, description="The camera as it was calibrated, in place of fov_deg."
    )
    sampling: SamplingSettings = Field(
        SamplingSettings(), description="Which of the sensor's pixels the network sees."
    )
    position_m: Point = Field((0.36, 0.25, 0.95), description="Optical centre, world frame.")
    target_m: Point = Field((1.10, 0.0, 0.75), description="The point it looks at, world frame.")
    roll_deg: float = Field(
        0.0,
        ge=-180.0,
        le=180.0,
        description="How far it is turned about its optical axis, clockwise seen from behind it.",
    )
    near_m: Range = Field((0.05, 0.10), description="Near clip plane, drawn at every reset.")
    far_m: Range = Field((2.5, 3.0), description="Far clip plane, drawn at every reset.")
    range_m: Range = Field(
        (0.4, 2.0), description="Depth and points: the sensor's measuring range."
    )
    noise_sigma_m: float = Field(
        0.002,
        ge=0.0,
        le=MAX_NOISE_SIGMA_M,
        description="Depth and points, with sensor: gaussian only: sigma of the noise.",
    )
    missing_fraction: Range = Field(
        (0.0, 0.0),
        description="Depth and points: probability of each pixel to be missing, drawn at every "
        "reset.",
    )
    sensor: (
        Literal["gaussian", "structured_light"]
        | Annotated[Gaussian | StructuredLight, Field(discriminator="type")]
    ) = Field(
        Gaussian(),
        description="Depth and points: how the camera errs, `gaussian` or `structured_light`, by "
        "its name alone or with settings beside its `type`.",
    )
    encoding: Literal["uint16", "uint8"] = Field(
        "uint16", description="Depth and points: uint16 millimetres, or uint8 over the range."
    )

    @field_validator("sensor")
    @classmethod
    def _name_means_the_defaults(cls, value: str | BaseModel) -> BaseModel:
        # Not before validation: what that returns is no JSON any more, whose lists are tuples.
        sensors: dict[str, type[BaseModel]] = {
            "gaussian": Gaussian,
            "structured_light": StructuredLight,
        }
        return sensors[value]() if isinstance(value, str) else value

    @model_validator(mode="after")
    def _is_possible(self) -> Camera:
        if self.position_m == self.target_m:
            raise ValueError("position_m and target_m are the same point: the camera looks nowhere")
        if self.intrinsics is not None and "fov_deg" in self.model_fields_set:
            raise ValueError("intrinsics and fov_deg say the same thing: leave one of them out")
        left, top, width, height = self.sampling.crop or (0, 0, self.width, self.height)
        if left + width > self.width or top + height > self.height:
            raise ValueError(
                f"sampling.crop {[left, top, width, height]} leaves the sensor, which has "
                f"{self.width}x{self.height} pixels (width x height)"
            )
        if self.near_m[0] <= 0.0 or self.near_m[1] >= self.far_m[0]:
            raise ValueError(
                f"near_m {list(self.near_m)} must be over 0 and lie before far_m {list(self.far_m)}"
            )
        if self.range_m[0] < 0.0 or self.range_m[0] == self.range_m[1]:
            raise ValueError(f"range_m {list(self.range_m)} must be a non-empty, positive range")
        if self.missing_fraction[0] < 0.0 or self.missing_fraction[1] > 1.0:
            raise ValueError(
                f"missing_fraction {list(self.missing_fraction)} is of probabilities: keep it "
                "within 0 and 1"
            )
        if self.encoding == "uint16" and self.range_m[1] > 65.535:
            raise ValueError(
                f"range_m reaches {self.range_m[1]} m, over uint16's 65.535 m: lower it, or use "
                "encoding: uint8"
            )
        return self

    @model_validator(mode="after")
    def _has_pixels_for_the_points(self) -> Camera:
        pixels = self.sampling.of_sensor(self.width, self.height)
        if self.type == "points" and self.cloud.points > pixels.width * pixels.height:
            raise ValueError(
                f"cloud.points {self.cloud.points} of {pixels.width}x{pixels.height} pixels (width "
                "x height): some would always be missing; lower it, or let the camera have more"
            )
        return self


class Workspace(BaseModel, frozen=True, extra="forbid"):
    """Range that actions from -1 to 1 map onto: the tooltip's position and the tool's yaw."""

    x_m: Range = Field((0.82, 1.35), description="Tooltip x, forward from the robot's base.")
    y_m: Range = Field((-0.45, 0.45), description="Tooltip y, to the left.")
    z_m: Range = Field((0.60, 1.00), description="Tooltip z, up.")
    yaw_deg: Range = Field((-40.0, 40.0), description="Yaw of the tool about the vertical.")

    @model_validator(mode="after")
    def _is_not_flat(self) -> Workspace:
        for name, (low, high) in self:
            if low == high:
                raise ValueError(f"{name} [{low}, {high}] has no width, so no action could vary it")
        return self

    @model_validator(mode="after")
    def _turns_once_at_most(self) -> Workspace:
        if max(map(abs, self.yaw_deg)) > MAX_YAW_DEG:
            raise ValueError(
                f"yaw_deg {list(self.yaw_deg)}: keep it within +-{MAX_YAW_DEG:g}, which is all "
                "around"
            )
        return self


class Support(BaseModel, frozen=True, extra="forbid"):
    """The table's top, a box; what carries it is left out."""

    x_m: Range = Field((0.88, 1.50), description="From the robot's side to the far side.")
    y_m: Range = Field((-0.50, 0.50), description="From the right to the left side.")
    top_m: float = Field(0.60, gt=0.0, description="Height of the upper side.")
    thickness_m: float = Field(0.05, gt=0.0, description="From the lower to the upper side.")


Shape = Literal["parallelepiped", "L", "U"]
Thing = Literal["T", "cross", "plate", "post", "cube", "slab", "tilted", "column"]
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
MAX_THINGS = 2


class Surroundings(BaseModel, frozen=True, extra="forbid"):
    """What there is beside the robot, the table's top and the blocks, drawn at every reset.

    None of it is a block: no box, L or U whose face has sides of `block_size_m`.
    """

    present: Probability = Field(
        1.0, description="Probability that there is anything of this at all in a scene."
    )
    floor: Probability = Field(1.0, description="Probability of a floor, at height 0.")
    frame: Probability = Field(0.9, description="Probability that legs carry the table's top.")
    wall: Probability = Field(0.4, description="Probability of a wall behind the table.")
    rack: Probability = Field(
        0.4, description="Probability of a rack in the wall's place: posts and shelves."
    )
    distance_m: Range = Field(
        (0.10, 0.60), description="From the table to the wall or the rack behind it."
    )
    yaw_deg: Range = Field((-15.0, 15.0), description="Yaw of the wall or the rack.")
    cable: Probability = Field(
        0.5, description="Probability of a cable that lies on the table or hangs from it."
    )
    cable_m: Range = Field((0.005, 0.012), description="Thickness of the cable.")
    things: tuple[int, int] = Field(
        (0, MAX_THINGS),
        description=f"Fewest and most things on the table that are no blocks, {MAX_THINGS} at "
        "most; one that finds no room is left out.",
    )
    kinds: tuple[Thing, ...] = Field(
        ("T", "cross", "plate", "post", "cube", "slab", "tilted", "column"),
        min_length=1,
        description="Kinds of such things.",
    )

    @model_validator(mode="after")
    def _is_possible(self) -> Surroundings:
        if self.wall + self.rack > 1.0:
            raise ValueError(
                f"wall {self.wall} and rack {self.rack}: there is one of them at most, so the sum "
                "of their probabilities is 1 at most"
            )
        if self.distance_m[0] < 0.0:
            raise ValueError(
                f"distance_m {list(self.distance_m)}: wall and rack stand behind the table, 0 m or "
                "more"
            )
        if max(map(abs, self.yaw_deg)) > MAX_BACKDROP_YAW_DEG:
            raise ValueError(
                f"yaw_deg {list(self.yaw_deg)}: keep it within +-{MAX_BACKDROP_YAW_DEG:g}, or the "
                "wall comes round to the robot"
            )
        if self.cable_m[0] <= 0.0 or self.cable_m[1] > MAX_CABLE_M:
            raise ValueError(
                f"cable_m {list(self.cable_m)} must lie over 0 and up to {MAX_CABLE_M:g} m"
            )
        if not 0 <= self.things[0] <= self.things[1] <= MAX_THINGS:
            raise ValueError(
                f"things {list(self.things)} goes from the fewest, 0 or more, to the most, "
                f"{MAX_THINGS} at most"
            )
        return self


class Randomize(BaseModel, frozen=True, extra="forbid"):
    """Ranges drawn from at every reset; a zero range is a fixed value."""

    shapes: tuple[Shape, ...] = Field(
        ("parallelepiped", "L", "U"), min_length=1, description="Shapes a block may have."
    )
    block_x_m: Range = Field((0.95, 1.32), description="Centre of a block's face, forward.")
    block_y_m: Range = Field((-0.28, 0.28), description="Centre of a block's face, sideways.")
    block_yaw_deg: Range = Field((-30.0, 30.0), description="Yaw of a block's face.")
    block_size_m: Range = Field((0.12, 0.24), description="Width and height of a block's face.")
    block_depth_m: Range = Field((0.08, 0.12), description="Depth of a block behind its face.")
    camera_position_m: float = Field(
        0.01, ge=0.0, le=0.5, description="Half range of each camera coordinate."
    )
    camera_rotation_deg: float = Field(
        1.0, ge=0.0, le=45.0, description="Half range of each of the camera's three rotations."
    )
    light_azimuth_deg: Range = Field((-180.0, 180.0), description="RGB: where the light stands.")
    light_elevation_deg: Range = Field((30.0, 80.0), description="RGB: the light's elevation.")
    light_intensity: Range = Field((0.4, 0.9), description="RGB: diffuse share of the light.")
    surroundings: Surroundings | None = Field(
        None,
        description="What stands around: floor, wall or rack, the table's frame, a cable, things "
        "that are no blocks. null: nothing; {}: all of it, as by default.",
    )

    @model_validator(mode="after")
    def _blocks_can_be_built(self) -> Randomize:
        if self.block_size_m[0] <= MIN_BAR_M:
            raise ValueError(
                f"block_size_m starts at {self.block_size_m[0]} m: a face needs more than "
                f"{MIN_BAR_M} m, the room for the cup"
            )
        if self.block_depth_m[0] <= 0.0:
            raise ValueError(f"block_depth_m {list(self.block_depth_m)} must lie over 0")
        return self


class Goal(BaseModel, frozen=True, extra="forbid"):
    """The goal region in the block frame; also the environment parameters lessons set."""

    lateral_limit_m: float = Field(
        0.01, gt=0.0, le=MAX_GOAL_M, description="Lateral x within +- this."
    )
    vertical_limit_m: float = Field(
        0.01, gt=0.0, le=MAX_GOAL_M, description="Vertical y within +- this."
    )
    gap_min_m: float = Field(
        0.01, ge=0.0, le=MAX_GOAL_M, description="Smallest gap z from cup to face."
    )
    gap_limit_m: float = Field(
        0.02, gt=0.0, le=MAX_GOAL_M, description="Largest gap z from cup to face."
    )
    yaw_limit_deg: float = Field(
        2.0, gt=0.0, le=MAX_GOAL_DEG, description="Yaw error within +- this."
    )

    @model_validator(mode="after")
    def _gap_is_a_range(self) -> Goal:
        if self.gap_limit_m <= self.gap_min_m:
            raise ValueError(
                f"gap_limit_m {self.gap_limit_m} must be over gap_min_m {self.gap_min_m}"
            )
        return self


class Pick(BaseModel, frozen=True, extra="forbid"):
    """The physical pick, with which a policy is judged and never trained."""

    density_kg_m3: float = Field(
        600.0, gt=0.0, description="Density of the blocks; wood, of which the heaviest has 4 kg."
    )
    friction: float = Field(
        0.5, ge=0.0, description="Of blocks and support each; PyBullet multiplies the two."
    )
    approach_s: float = Field(
        0.5,
        gt=0.0,
        le=60.0,
        description="How long the straight way from the stand-off to the pose takes.",
    )
    advance_m: float = Field(
        0.05,
        gt=0.0,
        le=1.0,
        description="How far the cup looks for the face from where it was sent.",
    )
    advance_speed_m_s: float = Field(0.05, ge=0.001, description="Speed of the cup on that way.")
    seal_m: float = Field(
        0.003, gt=0.0, description="The rim's largest distance to the face that still seals."
    )
    vacuum_pa: float = Field(60_000.0, gt=0.0, description="Pressure in the cup below the air's.")
    cup_friction: float = Field(
        0.5,
        gt=0.0,
        description="Of the cup on the face. The face is upright: friction carries the weight.",
    )
    lift_m: float = Field(0.2, gt=0.0, le=2.0, description="How far the block is lifted.")
    lift_s: float = Field(1.0, gt=0.0, le=60.0, description="How long that takes.")
    hold_s: float = Field(1.0, ge=0.0, le=600.0, description="How long the block is held up there.")


class GraspSettings(BaseModel, frozen=True, extra="forbid"):
    """The grasp task: a KUKA KR 16 brings its suction cup in front of the nearest block."""

    # What became of keys that run files of before have.
    dropped_keys: ClassVar[Mapping[str, str]] = {
        "motion_checks": "contacts are looked for all along a motion, every contact_resolution_m; "
        "`motion: direct` is the motion of before"
    }
    renamed_keys: ClassVar[Mapping[str, str]] = {
        "pick.standoff_m": "standoff_m",
        "pick.standoff_s": "pick.approach_s",
    }
    # What a run may go on with other values of.
    changeable_keys: ClassVar[frozenset[str]] = frozenset({"workers"})

    simulator: Literal["pybullet", "fast"] = Field(
        "pybullet",
        description="The engine underneath: PyBullet, or compiled loops over all worlds.",
    )
    num_envs: int = Field(64, ge=1, le=65536, description="Environments stepped together.")
    workers: int | None = Field(
        None,
        ge=0,
        le=1024,
        description="Threads of compiled loops, and PyBullet's worker processes; 0: none beside "
        "this one; null: one per core, which torchrun's processes share.",
    )
    episode_steps: int = Field(10, ge=1, description="Actions before an episode is truncated.")
    end_on_success: bool = Field(
        True,
        description="Whether an episode ends once position and rotation are right, or is always "
        "episode_steps long: as many tries at every scene.",
    )
    frame_grab: bool = Field(
        True, description="Observe the image taken at reset for the whole episode, or a stream."
    )
    cameras: dict[str, Camera] = Field(
        default_factory=lambda: {"depth": Camera(type="depth")},
        min_length=1,
        description="Cameras by the name of their observation.",
    )
    privileged: bool = Field(
        False, description="Offer the observation `privileged` (true state), meant for a critic."
    )
    privileged_limits: bool = Field(
        True,
        description="Whether `privileged` has the goal's limits; with rewards that ignore them, "
        "they are noise that jumps at every lesson.",
    )
    blocks: int = Field(3, ge=1, le=6, description="Blocks on the support.")
    target_lead_m: float = Field(
        0.05, ge=0.0, description="How much nearer to the robot the first block is."
    )
    grasp_point: Literal["largest_disc", "centroid"] = Field(
        "largest_disc", description="Where to grasp a face."
    )
    motion: Literal["standoff", "direct"] = Field(
        "standoff",
        description="How the robot moves: back along the tool's axis, through joint space to a "
        "stand-off behind the commanded pose, and straight ahead to it; or all the way through "
        "joint space, as the paper has it.",
    )
    standoff_m: float = Field(
        0.10,
        gt=0.0,
        le=MAX_STANDOFF_M,
        description="How far behind a pose the stand-off is, or as far as the joint limits allow.",
    )
    contact_resolution_m: float = Field(
        0.005,
        description="No point of the robot that could touch anything moves more than this between "
        "two looks for contacts.",
    )
    workspace: Workspace = Field(default_factory=Workspace, description="Range of the actions.")
    support: Support = Field(default_factory=Support, description="The table.")
    goal: Goal = Field(default_factory=Goal, description="Goal region unless a lesson sets it.")
    randomize: Randomize = Field(
        default_factory=Randomize, description="What is drawn at every reset."
    )
    pick: Pick = Field(
        default_factory=Pick, description="The physical pick of `trainers.evaluate --pick`."
    )

    @field_validator("contact_resolution_m")
    @classmethod
    def _resolution_is_possible(cls, value: float) -> float:
        return check_resolution(value)

    @model_validator(mode="after")
    def _names_are_free(self) -> GraspSettings:
        if "privileged" in self.cameras:
            raise ValueError("cameras: the name 'privileged' is taken by the observation of it")
        return self

    @property
    def threads(self) -> int | None:
        """Of this process's compiled loops; None: one for each core that may be used."""
        return None if self.workers is None else max(self.workers, 1)
