"""The hooks of plugins: six, one per kind of component.

A plugin is a module, named by an entry point of the group `ventosa`, that implements one or more
of these hooks with `hookimpl`. Each hook returns a mapping from the component's name, which the run
file uses as its `type`, to the component's class. Every class has a nested pydantic model
`Settings`, frozen and forbidding extra keys. Hooks are called once, at start-up.

This module imports pluggy alone, so that every package may import it.
"""

from __future__ import annotations

import pluggy

PROJECT_NAME = "ventosa"
"""The pluggy project and the entry-point group."""

hookspec = pluggy.HookspecMarker(PROJECT_NAME)
hookimpl = pluggy.HookimplMarker(PROJECT_NAME)


@hookspec
def ventosa_encoders() -> dict[str, type]:  # type: ignore[empty-body]
    """Offer encoders: name -> `torch.nn.Module` subclass.

    It is built as `cls(space, settings)` from a `gymnasium.spaces.Box`, has the attribute
    `features_dim`, and maps a tensor (B, *space.shape) of the space's own dtype to a float32 tensor
    (B, features_dim).
    """


@hookspec
def ventosa_rewards() -> dict[str, type]:  # type: ignore[empty-body]
    """Offer rewards: name -> class whose instances are callable.

    It is built as `cls(settings)`, and maps the environment's snapshot of N transitions, whose type
    it declares in `snapshot`, to an array (N,) of floats. The environment applies the run file's
    weight.
    """


@hookspec
def ventosa_curricula() -> dict[str, type]:  # type: ignore[empty-body]
    """Offer curricula: name -> class that follows `curricula.curriculum.Curriculum`.

    It is built as `cls(settings)`, and is pure: its state is plain data, made by `initial_state()`,
    replaced by `advance(state, episodes)`, and read by `lesson(state)`, `lesson_name(state)` and
    `parameters(state)`. Policies are judged on `final_parameters()`.
    """


@hookspec
def ventosa_environments() -> dict[str, type]:  # type: ignore[empty-body]
    """Offer environments: name -> class that builds a `gymnasium.vector.VectorEnv`.

    The class says which environment parameters a curriculum or a sampler may set.
    """


@hookspec
def ventosa_trainers() -> dict[str, type]:  # type: ignore[empty-body]
    """Offer trainers (algorithms): name -> class; the run file's `trainer_type` names it.

    It follows `trainers.algorithms.base.Algorithm`, and its settings extend
    `trainers.algorithms.base.TrainerSettings`.
    """


@hookspec
def ventosa_loggers() -> dict[str, type]:  # type: ignore[empty-body]
    """Offer loggers: name -> `trainers.loggers.base.Logger` subclass.

    It is built as `cls(settings, run)` when a run begins, and is given what the run reports. What
    it raises does not end the run.
    """
