"""Settings of gymnasium's environments."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import BaseModel, Field, model_validator

MOST_PROCESSES = 1024


class GymSettings(BaseModel, frozen=True, extra="forbid"):
    """Any environment that is registered with gymnasium."""

    # What a run may go on with other values of.
    changeable_keys: ClassVar[frozenset[str]] = frozenset(
        {
            "timeout_s",
            "max_lifetime_restarts",
            "restarts_rate_limit_n",
            "restarts_rate_limit_period_s",
        }
    )

    id: str = Field(
        min_length=1,
        description="Its id, such as Pendulum-v1; MODULE:ID imports the module that registers it.",
    )
    num_envs: int = Field(1, ge=1, le=65536, description="Environments stepped together.")
    vectorization: Literal["sync", "async"] = Field(
        "sync", description="All in this process one after the other, or each in a process."
    )
    timeout_s: float = Field(
        60.0,
        gt=0.0,
        le=86_400.0,
        description="Seconds that a step or a reset of an environment in a process of its own may "
        "take; one that does not answer hangs.",
    )
    max_lifetime_restarts: int = Field(
        10,
        ge=-1,
        description="Times that the process of an environment is started again, each for itself, "
        "where it died or hangs, before the run ends with an error; -1: no limit.",
    )
    restarts_rate_limit_n: int = Field(
        1,
        ge=-1,
        description="The same within restarts_rate_limit_period_s: what dies at once again and "
        "again ends the run; -1: no limit.",
    )
    restarts_rate_limit_period_s: float = Field(
        60.0, gt=0.0, le=86_400.0, description="Seconds of restarts_rate_limit_n."
    )
    max_episode_steps: int | None = Field(
        None, ge=1, description="Steps before an episode is truncated; null: the environment's own."
    )
    flatten_observations: bool = Field(
        False, description="Make one vector of an observation, whatever its space is."
    )
    channels: Literal["first", "last"] | None = Field(
        None,
        description="Which axis of images has the channels; null: the first or the last, whichever "
        "is shorter than the others.",
    )
    frame_stack: int = Field(
        1,
        ge=1,
        le=64,
        description="The latest observations that are seen as one, the oldest first: images along "
        "their channels, vectors end to end. An episode's first stands for those before it.",
    )
    kwargs: dict[str, Any] = Field(
        default_factory=dict, description="What else gymnasium.make is given."
    )

    @model_validator(mode="after")
    def _processes_can_be_had(self) -> GymSettings:
        if self.vectorization == "async" and self.num_envs > MOST_PROCESSES:
            raise ValueError(
                f"num_envs {self.num_envs} and vectorization: async are as many processes: use "
                f"{MOST_PROCESSES} at most, or vectorization: sync"
            )
        return self
