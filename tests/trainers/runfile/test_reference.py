"""The page of all keys and tags: written anew it is the same, and nothing is missing from it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from envs.grasp.settings import GraspSettings
from envs.grasp.vector_env import GraspVectorEnv
from trainers import plugins as command
from trainers.reporting.summary import SUCCESS_TAG, metric_tag
from trainers.runfile.reference import COMMAND
from trainers.runfile.registry import Registries
from trainers.runfile.settings import RunFile
from trainers.sweep.plan import SweepSettings

REPOSITORY = Path(__file__).parents[3]
PAGE = (REPOSITORY / "docs/reference.md").read_text()


def section(heading: str) -> str:
    """Of a component, to the next heading."""
    found = re.search(rf"^### `{heading}`\n(.*?)(?=^##|\Z)", PAGE, re.DOTALL | re.MULTILINE)
    assert found is not None, heading
    return found[1]


def test_the_page_is_what_the_command_in_it_writes(
    built_in: Registries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert COMMAND in PAGE
    monkeypatch.setattr("trainers.runfile.registry.load_registries", lambda: built_in)
    assert command.main(["--reference", str(tmp_path / "reference.md")]) == 0
    written = (tmp_path / "reference.md").read_text()
    assert written == PAGE, f"out of date; write it anew: {COMMAND}"


def property_names(schema: Any) -> Iterator[str]:
    """Of a JSON schema, however deep."""
    if isinstance(schema, dict):
        yield from schema.get("properties", ())
        for part in schema.values():
            yield from property_names(part)
    elif isinstance(schema, list):
        for part in schema:
            yield from property_names(part)


def test_every_key_of_every_component_is_there(built_in: Registries) -> None:
    count = 0
    for kind in fields(built_in):
        for name, entry in getattr(built_in, kind.name).entries.items():
            keys = set(re.findall(r"^\| `(?:[^`]*\.)?(\w+)` \|", section(name), re.MULTILINE))
            expected = set(property_names(entry.settings.model_json_schema()))
            assert keys == expected, name
            count += len(keys)
    assert count > 250
    for model in (RunFile, SweepSettings):
        assert all(f"| `{key}` |" in PAGE for key in model.model_fields)


def tags_written(folder: Path) -> set[str]:
    """Tags of a run's event file."""
    log = EventAccumulator(str(folder)).Reload()
    tags = {tag for kind in ("scalars", "images", "tensors") for tag in log.Tags()[kind]}
    return {tag.removesuffix("/text_summary") for tag in tags}


def explained() -> list[str]:
    """Patterns of the tags on the page."""
    page = PAGE[PAGE.index("## TensorBoard") :]
    tags = re.findall(r"^\| `([^`]*)` \|", page, re.MULTILINE)
    return [re.sub("<.*?>", ".+", re.escape(tag)) for tag in tags]


@pytest.mark.parametrize("algorithm", ["ppo", "trpo", "ddpg"])
def test_every_tag_that_a_run_writes_is_explained(
    learn: Callable[..., Any],
    write_run: Callable[..., Path],
    built_in: Registries,
    algorithm: str,
) -> None:
    lessons = {"type": "lessons", "measure": "progress", "count": 2}
    lessons |= {"thresholds": {"first": 0.5, "last": 0.5}}
    lessons |= {"parameters": {"scale": {"first": 0.5, "last": 1.0}}}
    config = write_run(
        "picture",
        {"trainer_type": algorithm},
        encoders={"camera": {"type": "conv", "layers": [[2, 3, 2]]}},
        curriculum=lessons,
        evaluation={"interval": 32, "episodes": 4},
    )
    done = learn(config)
    assert done.code == 0, done.errors
    written = tags_written(done.results / "toy")
    assert {"Observations/camera", "Reward/near", "Evaluation/Success"} < written
    unexplained = {t for t in written if not any(re.fullmatch(p, t) for p in explained())}
    assert not unexplained
    own = {tag for tag in written if tag.startswith(("Losses/", "Policy/"))}
    assert own == set(built_in.trainers.get(algorithm).cls.tags)  # type: ignore[attr-defined]


def test_the_grasp_environment_explains_what_it_reports_of_episodes() -> None:
    env = GraspVectorEnv(GraspSettings(num_envs=1, simulator="fast"), ())
    try:
        env.reset(seed=0)
        *_, infos = env.step(np.zeros((1, 4)))
        figures = env.evaluator().figures
    finally:
        env.close()
    written = {metric_tag(metric, figures) for metric in infos["episode_metrics"]}
    assert written == {SUCCESS_TAG, *env.tags}
