"""`trainers/` names nothing that is peculiar to grasping: the environment declares it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from envs.grasp.settings import GraspSettings
from envs.grasp.vector_env import GraspVectorEnv
from rewards.plugin import ventosa_rewards

ROOT = Path(__file__).parents[2]
ELSEWHERE: set[str] = set()
FILES = [
    path.relative_to(ROOT).as_posix()
    for path in sorted((ROOT / "trainers").rglob("*.py"))
    if path.relative_to(ROOT).as_posix() not in ELSEWHERE
]
# Not target, table, pixel, touched and camera: networks, terminals, images, memory and commands
# have them, too.
WORDS = set(
    re.findall(
        r"\w+",
        "grasp grasped grasping pick picked picker suction cup tool tooltip robot arm kuka joint "
        "yaw pose lateral gap block workspace scene collision collided simulator pybullet urdf "
        "depth rgb mm deg degree metre",
    )
)
SHARED_NAMES = {"success", "num_envs"}


def words(file: str) -> set[str]:
    """The words of a file, of its names' parts and of its text; in the singular."""
    text = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", (ROOT / file).read_text())
    found = set(re.findall(r"[a-z]+", text.lower()))
    return found | {word.removesuffix("s") for word in found}


def strings(file: str) -> Iterator[str]:
    """The constants of a file that are text."""
    for node in ast.walk(ast.parse((ROOT / file).read_text())):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


@pytest.fixture(scope="module")
def names() -> set[str]:
    """What the grasp environment calls its observations, figures, parameters and options."""
    env = GraspVectorEnv(GraspSettings(num_envs=1, simulator="fast", privileged=True), ())
    try:
        figures = env.evaluator().figures
        check = env.evaluator().check_name
        observations = set(env.single_observation_space)
    finally:
        env.close()
    return (
        observations
        | {name for figure in figures for name in (figure.name, figure.metric, figure.label)}
        | {check, f"{check}_rate", f"{check}_failures"}
        | env.parameter_names
        | {option.flag for option in env.evaluation_options}
        | set(GraspSettings.model_fields)
        | {name for name, cls in ventosa_rewards().items() if ".grasp." in cls.__module__}
    ) - SHARED_NAMES


@pytest.mark.parametrize("file", FILES)
def test_no_word_is_of_grasping(file: str) -> None:
    assert words(file) & WORDS == set()


@pytest.mark.parametrize("file", FILES)
def test_no_text_is_a_name_of_the_grasp_environment(file: str, names: set[str]) -> None:
    assert names.intersection(strings(file)) == set()


def test_the_words_and_names_are_those_of_the_grasp_environment(names: set[str]) -> None:
    grasp = {path.relative_to(ROOT).as_posix() for path in (ROOT / "envs/grasp").rglob("*.py")}
    assert set().union(*map(words, grasp)) >= WORDS - {"grasping"}
    assert {"privileged", "position_error_m", "collision", "--pick", "frame_grab"} <= names
    assert len(FILES) > 40
