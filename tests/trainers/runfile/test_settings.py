"""Reading, overriding, validating and writing run files."""

from __future__ import annotations

import dataclasses
import errno
import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, Field, model_validator
from torch import nn

from curricula.samplers import UniformSampler
from envs.environment import Environment
from trainers.common.trainer_settings import TrainerSettings
from trainers.hookspecs import hookimpl
from trainers.loggers.base import Logger
from trainers.loggers.tensorboard import TensorBoard
from trainers.runfile.registry import Registries, load_registries, plugin_manager
from trainers.runfile.settings import RunSettings, SettingsError, dump_yaml, load_run, resolved
from trainers.runfile.yaml_document import LARGEST_INTEGER, dump, parse


class Model(BaseModel, frozen=True, extra="forbid"):
    pass


class DepthCamera(Model):
    type: Literal["depth"]
    width: int = Field(80, ge=1, description="Pixels in a row.")
    range_m: tuple[float, float] = (0.4, 2.0)


class ColorCamera(Model):
    type: Literal["rgb"]
    height: int = 80


class World(Environment):
    class Settings(Model):
        num_envs: int = Field(1, ge=1, description="How many.")
        frame_grab: bool = False
        simulator: str = "pybullet"
        cameras: dict[str, Annotated[DepthCamera | ColorCamera, Field(discriminator="type")]] = {}


class Gym(Environment):
    class Settings(Model):
        id: str = Field(description="Name of a registered environment.")


class Touch:
    class Settings(Model):
        amount: float = 0.1

    def __call__(self, transition: Any) -> None: ...


class Collision(Touch):
    pass


class Conv(nn.Module):
    class Settings(Model):
        layers: tuple[tuple[int, int, int], ...] = ((16, 8, 4),)


class Steps:
    initial_state = advance = lesson = lesson_name = lambda self: None
    parameters = final_parameters = lambda self: None

    class Settings(Model):
        count: int = 1


class Memory(Model):
    size: int = 8


class Hyperparameters(Model):
    learning_rate: float = Field(3e-4, gt=0)
    schedule: Literal["linear", "constant"] = "linear"
    batch_size: int = 64
    buffer_size: int = 1024

    @model_validator(mode="after")
    def fits(self) -> Self:
        if self.batch_size > self.buffer_size:
            raise ValueError(
                f"batch_size {self.batch_size} is over buffer_size {self.buffer_size}: lower it"
            )
        return self


class Ppo:
    build_policy = collect = update = lambda self: None
    state_dict = load_state_dict = lambda self: None

    class Settings(TrainerSettings, frozen=True, extra="forbid"):
        hyperparameters: Hyperparameters = Hyperparameters()
        memory: Memory | None = None
        decay: float | Memory = 0.5
        max_steps: int = Field(description="Steps of training in all.")


class Note(Logger):
    class Settings(BaseModel, frozen=True, extra="forbid"):
        project: str = "none"


class Fakes:
    @hookimpl
    def ventosa_environments(self) -> dict[str, type]:
        return {"grasp": World, "gym": Gym}

    @hookimpl
    def ventosa_rewards(self) -> dict[str, type]:
        return {"touch": Touch, "collision": Collision}

    @hookimpl
    def ventosa_encoders(self) -> dict[str, type]:
        return {"conv": Conv}

    @hookimpl
    def ventosa_curricula(self) -> dict[str, type]:
        return {"lessons": Steps}

    @hookimpl
    def ventosa_trainers(self) -> dict[str, type]:
        return {"ppo": Ppo}

    @hookimpl
    def ventosa_loggers(self) -> dict[str, type]:
        return {"tensorboard": TensorBoard, "note": Note}


REGISTRIES: Registries = load_registries(plugin_manager([Fakes()]))

FULL = """\
environment:
  type: grasp
  num_envs: 16
  frame_grab: true
  cameras:
    depth: {type: depth, width: 40, range_m: [1, 2]}
rewards:
  - {type: touch, weight: 2}
  - type: collision
    amount: -1e-1
encoders:
  depth: {type: conv, layers: [[16, 8, 4], [32, 4, 2]]}
curriculum:
  type: lessons
  count: 19
environment_parameters:
  goal_m: 0.1
  yaw_deg: {sampler_type: uniform, sampler_parameters: {min_value: -30, max_value: 30}}
trainer:
  trainer_type: ppo
  max_steps: 5e6
  hyperparameters:
    learning_rate: 1e-3
    batch_size: 32
seed: 7
device: cuda
"""

SMALL = """\
environment: {type: grasp}
trainer:
  trainer_type: ppo
  max_steps: 10
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def load(text: str | bytes, *overrides: str) -> RunSettings:
    Path("run.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_run(Path("run.yaml"), overrides, REGISTRIES)


def refused(text: str | bytes, *overrides: str) -> list[str]:
    """Return the lines of the message."""
    with pytest.raises(SettingsError) as caught:
        load(text, *overrides)
    return str(caught.value).splitlines()


pytestmark = pytest.mark.usefixtures("folder")


class TestGood:
    def test_everything_arrives(self) -> None:
        run = load(FULL)
        assert (run.environment.name, run.environment.cls) == ("grasp", World)
        assert run.environment.settings == World.Settings(
            num_envs=16,
            frame_grab=True,
            cameras={"depth": DepthCamera(type="depth", width=40, range_m=(1.0, 2.0))},
        )
        assert [(r.component.name, r.component.settings, r.weight) for r in run.rewards] == [
            ("touch", Touch.Settings(amount=0.1), 2.0),
            ("collision", Touch.Settings(amount=-0.1), 1.0),
        ]
        assert run.encoders["depth"].settings == Conv.Settings(layers=((16, 8, 4), (32, 4, 2)))
        assert run.curriculum is not None
        assert run.curriculum.settings == Steps.Settings(count=19)
        assert run.environment_parameters["goal_m"] == 0.1
        assert isinstance(run.environment_parameters["yaw_deg"], UniformSampler)
        assert run.trainer.cls is Ppo
        assert run.trainer.settings == Ppo.Settings(
            max_steps=5_000_000, hyperparameters=Hyperparameters(learning_rate=0.001, batch_size=32)
        )
        assert (run.seed, run.device) == (7, "cuda")

    def test_what_may_be_left_out(self) -> None:
        run = load(SMALL)
        assert run.rewards == ()
        assert run.encoders == {}
        assert run.curriculum is None
        assert run.environment_parameters == {}
        assert (run.seed, run.device) == (0, "cpu")

    def test_a_section_whose_lines_are_commented_out_is_as_if_left_out(self) -> None:
        empty = "rewards:\nencoders:\n#  depth: {}\ncurriculum:\nenvironment_parameters:\n"
        assert load(SMALL + empty) == load(SMALL)

    def test_it_is_frozen(self) -> None:
        with pytest.raises(dataclasses.FrozenInstanceError):
            load(SMALL).seed = 1  # type: ignore[misc]

    def test_a_byte_order_mark_is_harmless(self) -> None:
        assert load(b"\xef\xbb\xbf" + SMALL.encode()) == load(SMALL)

    def test_windows_line_ends_are_harmless(self) -> None:
        assert load(FULL.replace("\n", "\r\n")) == load(FULL)

    def test_anchors_and_merge_keys(self) -> None:
        run = load(
            "environment:\n"
            "  type: grasp\n"
            "  cameras:\n"
            "    left: &camera {type: depth, width: 40}\n"
            "    right: *camera\n"
            "    top: {<<: *camera, width: 20}\n"
            "    again: {<<: *camera}\n"
            "trainer: {trainer_type: ppo, max_steps: 1}\n"
        )
        cameras = run.environment.settings.model_dump()["cameras"]
        widths = {name: camera["width"] for name, camera in cameras.items()}
        assert widths == {"left": 40, "right": 40, "top": 20, "again": 40}


TEXT = st.text(st.characters(codec="utf-8")) | st.sampled_from(
    ["1e-3", "yes", "010", "0o7", "<<", "null", "", "=", "1:30", ".inf", "- a", "# b", "\x85"]
)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False) | st.integers(
    -LARGEST_INTEGER, LARGEST_INTEGER
)
PLAIN = st.recursive(
    st.none() | st.booleans() | NUMBERS | TEXT,
    lambda inner: st.lists(inner) | st.dictionaries(TEXT, inner),
    max_leaves=12,
)


class TestScalars:
    @pytest.mark.parametrize(
        ("text", "value"),
        [
            ("1e-3", 0.001),
            ("1E+2", 100),
            ("-.5", -0.5),
            ("5e6", 5_000_000),
            ("1.5e6", 1_500_000),
            ("5.0", 5.0),
            ("010", 10),
            ("0o10", 8),
            ("0x1F", 31),
            ("true", True),
            ("False", False),
            ("~", None),
            ("yes", "yes"),
            ("off", "off"),
            ("1:30", "1:30"),
            ("1_000", "1_000"),
            ("2024-01-01", "2024-01-01"),
            ("'5'", "5"),
            ("!!str 5", "5"),
        ],
    )
    def test_core_schema(self, text: str, value: Any) -> None:
        found = parse(text, "text").data
        assert found == value
        assert type(found) is type(value)

    def test_infinity_and_nan_are_read_to_be_refused(self) -> None:
        assert parse("-.inf", "text").data == -math.inf
        assert math.isnan(parse(".NaN", "text").data)

    @given(PLAIN)
    def test_what_is_written_is_read_back(self, data: Any) -> None:
        assert parse(dump({"key": data}), "text").data == {"key": data}


class TestUnreadable:
    def test_a_missing_file(self) -> None:
        with pytest.raises(SettingsError, match=r"^nowhere\.yaml: there is no such file$"):
            load_run(Path("nowhere.yaml"), [], REGISTRIES)

    def test_a_directory(self, folder: Path) -> None:
        (folder / "runs").mkdir()
        with pytest.raises(SettingsError, match=r"^runs: is a directory; name a YAML file$"):
            load_run(Path("runs"), [], REGISTRIES)

    def test_a_file_that_may_not_be_read(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def deny(path: Path) -> bytes:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))

        monkeypatch.setattr(Path, "read_bytes", deny)
        with pytest.raises(SettingsError, match=r"^run\.yaml: cannot be read: Permission denied$"):
            load_run(Path("run.yaml"), [], REGISTRIES)

    @pytest.mark.parametrize("text", ["", "\n\n", "# nothing yet\n", "---\n", "null"])
    def test_an_empty_file(self, text: str) -> None:
        assert refused(text) == [
            "run.yaml: is empty; it needs at least the sections environment and trainer"
        ]

    def test_bytes_that_are_no_text(self) -> None:
        assert refused(b"seed: 1\ndevice: \xff\n") == [
            "run.yaml:2: is not UTF-8: byte 0xff; save the file as UTF-8"
        ]

    def test_a_character_that_yaml_forbids(self) -> None:
        assert refused("seed: 1\ndevice: a\x07\n") == [
            "run.yaml:2: the character U+0007 is not allowed in YAML"
        ]

    @pytest.mark.parametrize(
        ("text", "where", "what"),
        [
            ("seed: 1\nrewards: [1, 2\ndevice: cpu\n", "run.yaml:3", "column 7"),
            ("seed: 1\n\tdevice: cpu\n", "run.yaml:2", "column 1"),
            ("a: b: c\n", "run.yaml:1", "mapping values are not allowed"),
            ("seed: *nobody\n", "run.yaml:1", "undefined alias 'nobody'"),
            ("seed: 1\n---\nseed: 2\n", "run.yaml:2", "another document"),
            ("<<: 3\n", "run.yaml:1", "expected a mapping"),
        ],
    )
    def test_syntax(self, text: str, where: str, what: str) -> None:
        (line,) = refused(text)
        assert line.startswith(f"{where}: not YAML: column ")
        assert what in line

    @pytest.mark.parametrize(
        ("text", "written"), [("- a\n- b\n", "['a', 'b']"), ("hello", "'hello'"), ("3", "3")]
    )
    def test_no_mapping_at_the_top(self, text: str, written: str) -> None:
        assert refused(text) == [
            f"run.yaml:1: must be a mapping (key: value) at the top, not {written}"
        ]

    def test_duplicate_keys_name_both_lines(self) -> None:
        text = SMALL + "  max_steps: 20\nseed: 1\n'seed': 2\n"
        assert refused(text) == [
            "run.yaml:7: seed: duplicate key, first at run.yaml:6; remove one",
            "run.yaml:5: trainer.max_steps: duplicate key, first at run.yaml:4; remove one",
        ]

    @pytest.mark.parametrize("key", ["1", "true", "null", "2.5"])
    def test_keys_are_text(self, key: str) -> None:
        assert refused(f"{SMALL}  hyperparameters: {{{key}: 3}}\n") == [
            f"run.yaml:5: trainer.hyperparameters: a key must be text, not {key}; quote it"
        ]

    def test_a_list_is_no_key(self) -> None:
        assert "a key must be text" in refused("? [a]\n: b\n")[0]

    @pytest.mark.parametrize(
        "value",
        [
            *("!!python/object/apply:os.getcwd []", "!own 3", "!!int many", "!!set {a}"),
            *("!!null no", "!!bool yes", "!!float [1]", "!!str {a: 1}", "<<"),
        ],
    )
    def test_tags_outside_the_core_schema(self, value: str) -> None:
        (line,) = refused(f"seed: {value}\n")
        assert line.startswith("run.yaml:1: seed: a value of the type '")

    def test_tags_of_keys(self) -> None:
        assert refused(SMALL + "  !own a: 3\n  ? !!set {b}\n  : 4\n")[:2] == [
            "run.yaml:5: trainer: a key must be text, not a; quote it",
            "run.yaml:6: trainer: a key must be text, not this; quote it",
        ]

    @pytest.mark.parametrize(
        ("number", "written"),
        [
            ("9223372036854775808", "'9223372036854775808'"),
            ("-9223372036854775808", "'-9223372036854775808'"),
            ("0x8000000000000000", "'0x8000000000000000'"),
            ("1" + 309 * "0", "'1" + 55 * "0" + "..."),  # infinite as a float
            (5000 * "9", "'" + 56 * "9" + "..."),  # more digits than Python reads
            ("0x" + 5000 * "f", "'0x" + 54 * "f" + "..."),
        ],
        ids=["a bit more", "below", "hexadecimal", "infinite", "thousands", "hex thousands"],
    )
    def test_whole_numbers_have_64_bits(self, number: str, written: str) -> None:
        expected = f"should be within +-9223372036854775807, not {written}"
        for key in ("seed", "rewards"):
            assert refused(f"{key}: {number}\n")[0] == f"run.yaml:1: {key}: {expected}"

    def test_the_largest_whole_numbers(self) -> None:
        assert parse("[9223372036854775807, -9223372036854775807]", "x").data == [
            *(2**63 - 1, 1 - 2**63)
        ]

    def test_half_a_character(self) -> None:
        assert refused('device: "\\ud83d"\n')[0].startswith("run.yaml:1: device: has half a char")
        assert "half a character" in refused('"\\ud83d": 1\n')[0]

    def test_an_alias_that_contains_itself(self) -> None:
        assert refused("seed: &all [*all]\n") == [
            "run.yaml: is nested too deeply; does an alias contain itself?"
        ]

    def test_nesting_without_end(self) -> None:
        assert "nested too deeply" in refused("[" * 5000)[0]

    @pytest.mark.parametrize("grown", ["[{}]", "{{<<: [{}]}}"])
    def test_aliases_that_grow_to_billions(self, grown: str) -> None:
        lines = ["a0: &a0 {x: 1}"]
        for level in range(1, 11):
            nine = ", ".join([f"*a{level - 1}"] * 9)
            lines.append(f"a{level}: &a{level} {grown.format(nine)}")
        assert refused("\n".join(lines)) == [
            "run.yaml: has over 100000 values, aliases written out: too many for a run file"
        ]

    def test_aliases_count_as_often_as_they_stand(self) -> None:
        # 155 numbers in a list are 156 values; 641 of those, a list around 640, two keys, the top.
        text = "a: &a [{}]\nb: [{}]\n".format(", ".join(["1"] * 155), ", ".join(["*a"] * 640))
        assert 156 * 641 + 4 == 100_000
        assert len(parse(text, "text").data["b"]) == 640
        with pytest.raises(SettingsError, match="too many for a run file"):
            parse(text.replace("b: [", "b: [1, "), "text")

    def test_aliases_that_grow_deep(self) -> None:
        chain = "".join(f"- &a{n + 1} [*a{n}]\n" for n in range(200))
        assert refused(f"- &a0 []\n{chain}") == [
            "run.yaml: is nested over 100 deep, aliases written out: too deep for a run file"
        ]


class TestInvalid:
    @pytest.mark.parametrize(
        ("extra", "expected"),
        [
            ("seeed: 3", "run.yaml:5: seeed: unknown key; did you mean 'seed'?"),
            ("seed: -1", "run.yaml:5: seed: should be greater than or equal to 0, not -1"),
            ("seed: '1'", "run.yaml:5: seed: should be a whole number, not '1'"),
            ("seed: 1.0", "run.yaml:5: seed: should be a whole number, not 1.0"),
            ("seed: true", "run.yaml:5: seed: should be a whole number, not true"),
            ("seed: 1e30", "run.yaml:5: seed: should be a whole number, not 1e+30"),
            ("device: 3", "run.yaml:5: device: should be text, not 3"),
            ("rewards: touch", "run.yaml:5: rewards: should be a list, not 'touch'"),
            (
                "rewards: [touch]",
                "run.yaml:5: rewards.0: should be a mapping (key: value), not 'touch'",
            ),
            ("encoders: 3", "run.yaml:5: encoders: should be a mapping (key: value), not 3"),
            (
                "encoders: {depth: conv}",
                "run.yaml:5: encoders.depth: should be a mapping (key: value), not 'conv'",
            ),
            (
                "environment_parameters: {goal_m: far}",
                "run.yaml:5: environment_parameters.goal_m: should be a number or a sampler: "
                "{sampler_type: ..., sampler_parameters: ...}, not 'far'",
            ),
            (
                "environment_parameters: {a: {sampler_type: unifrom}}",
                "run.yaml:5: environment_parameters.a.sampler_type: "
                "unknown name 'unifrom'; did you mean 'uniform'?",
            ),
            (
                "environment_parameters: {a: {sampler_type: gaussian, "
                "sampler_parameters: {mean: 0, st_dev: 1, st_dve: 1}}}",
                "run.yaml:5: environment_parameters.a.sampler_parameters.st_dve: "
                "unknown key; did you mean 'st_dev'?",
            ),
        ],
    )
    def test_the_top(self, extra: str, expected: str) -> None:
        assert refused(f"{SMALL}{extra}\n") == [expected]

    @pytest.mark.parametrize(
        ("extra", "expected"),
        [
            ("max_stpes: 3", "max_stpes: unknown key; did you mean 'max_steps'?"),
            ("trainer_typ: ppo", "trainer_typ: unknown key; did you mean 'trainer_type'?"),
            (
                "hyperparameters: {learning_rat: 1}",
                "hyperparameters.learning_rat: unknown key; did you mean 'learning_rate'?",
            ),
            (
                "hyperparameters: {zzz: 1}",
                "hyperparameters.zzz: unknown key; "
                "known: batch_size, buffer_size, learning_rate, schedule",
            ),
            (
                "hyperparameters: {learning_rate: fast}",
                "hyperparameters.learning_rate: should be a number, not 'fast'",
            ),
            (
                "hyperparameters: {learning_rate: 0}",
                "hyperparameters.learning_rate: should be greater than 0, not 0",
            ),
            (
                "hyperparameters: {schedule: liner}",
                "hyperparameters.schedule: should be 'linear' or 'constant', not 'liner'",
            ),
            (
                "hyperparameters: {batch_size: 2048}",
                "hyperparameters: batch_size 2048 is over buffer_size 1024: lower it",
            ),
            ("hyperparameters: 3", "hyperparameters: should be a mapping (key: value), not 3"),
            ("hyperparameters: {learning_rate: .inf}", None),
            (
                "hyperparameters: {learning_rate: 1e39}",
                "hyperparameters.learning_rate: should be within +-3.4e+38, not 1e+39",
            ),
            ("memory: {sise: 3}", "memory.sise: unknown key; did you mean 'size'?"),
            ("decay: {sise: 3}", "decay.sise: unknown key; did you mean 'size'?"),
            (
                "decay: no",
                "decay: should be a number, not 'no'; "
                "or should be a mapping (key: value), not 'no'",
            ),
        ],
    )
    def test_a_component(self, extra: str, expected: str | None) -> None:
        expected = expected or "hyperparameters.learning_rate: should be a finite number"
        assert refused(f"{SMALL}  {extra}\n") == [f"run.yaml:5: trainer.{expected}"]

    @pytest.mark.parametrize(
        ("settings", "expected"),
        [
            ("frame_grab: yes", "frame_grab: should be true or false, not 'yes'"),
            ("frame_grab: 1", "frame_grab: should be true or false, not 1"),
            ("simulator: 3", "simulator: should be text, not 3"),
            ("num_envs: 2.0", "num_envs: should be a whole number, not 2.0"),
            (
                "cameras: {d: {type: depht}}",
                "cameras.d.type: unknown name 'depht'; did you mean 'depth'?",
            ),
            ("cameras: {d: {width: 3}}", "cameras.d: needs the key 'type', which says what it is"),
            (
                "cameras: {d: {type: depth, height: 3}}",
                "cameras.d.height: unknown key; known: range_m, type, width",
            ),
            (
                "cameras: {depth: {type: depth, widht: 3}}",
                "cameras.depth.widht: unknown key; did you mean 'width'?",
            ),
            (
                "cameras: {d: {type: depth, range_m: [1]}}",
                "cameras.d.range_m.1: missing: the list has 1 items, which is too few",
            ),
            (
                "cameras: {d: {type: depth, range_m: [1, far]}}",
                "cameras.d.range_m.1: should be a number, not 'far'",
            ),
            (
                "cameras: {d: {type: depth, range_m: [1, 2, 3]}}",
                "cameras.d.range_m: should have at most 2 items, not [1, 2, 3]",
            ),
        ],
    )
    def test_nested_values_of_an_environment(self, settings: str, expected: str) -> None:
        trainer = "trainer: {trainer_type: ppo, max_steps: 1}\n"
        text = f"environment:\n  type: grasp\n\n  {settings}\n{trainer}"
        assert refused(text) == [f"run.yaml:4: environment.{expected}"]

    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            (
                "environment: {type: gras}",
                "environment.type: unknown environment 'gras'; did you mean 'grasp'? "
                "(`python -m trainers.plugins` lists all)",
            ),
            (
                "environment: {}",
                "environment.type: missing: names the environment; known: grasp, gym",
            ),
            (
                "environment: {type: 3}",
                "environment.type: should be text, not 3: names the environment; known: grasp, gym",
            ),
            (
                "environment: {type: gym}",
                "environment.id: missing: Name of a registered environment.",
            ),
        ],
    )
    def test_the_type_of_a_component(self, text: str, expected: str) -> None:
        trainer = "trainer: {trainer_type: ppo, max_steps: 1}\n"
        assert refused(f"{trainer}{text}\n") == [f"run.yaml:2: {expected}"]

    def test_the_trainers_key_is_its_own(self) -> None:
        text = "environment: {type: grasp}\ntrainer: {type: ppo, max_steps: 1}\n"
        assert refused(text) == [
            "run.yaml:2: trainer.trainer_type: missing: names the trainer; known: ppo"
        ]

    def test_required_sections(self) -> None:
        lines = refused("seed: 1\n")
        assert lines[0].startswith("run.yaml:1: environment: missing: The environment")
        assert lines[1].startswith("run.yaml:1: trainer: missing: The algorithm")

    def test_a_required_setting_says_what_it_is_for(self) -> None:
        assert refused("environment: {type: grasp}\ntrainer: {trainer_type: ppo}\n") == [
            "run.yaml:2: trainer.max_steps: missing: Steps of training in all."
        ]

    @pytest.mark.parametrize(
        ("reward", "expected"),
        [
            ("{type: tuoch}", "rewards.0.type: unknown reward 'tuoch'; did you mean 'touch'? "),
            ("{type: touch, weigth: 2}", "rewards.0.weigth: unknown key; did you mean 'weight'?"),
            ("{type: touch, weight: big}", "rewards.0.weight: should be a number, not 'big'"),
            ("{type: touch, weight: .nan}", "rewards.0.weight: should be a finite number"),
            ("{weight: 1}", "rewards.0.type: missing: names the reward; known: collision, touch"),
        ],
    )
    def test_rewards(self, reward: str, expected: str) -> None:
        (line,) = refused(f"{SMALL}rewards:\n  - {reward}\n")
        assert line.startswith(f"run.yaml:6: {expected}")

    def test_a_reward_given_twice(self) -> None:
        text = f"{SMALL}rewards:\n  - type: touch\n  - type: collision\n  - type: touch\n"
        assert refused(text) == [
            "run.yaml:8: rewards.2.type: 'touch' is there already, as rewards.0; keep one"
        ]

    @pytest.mark.parametrize(
        ("loggers", "expected"),
        [
            ("[{type: nite}]", "loggers.0.type: unknown logger 'nite'; did you mean 'note'? "),
            ("[{type: note, projct: x}]", "loggers.0.projct: unknown key; did you mean 'project'?"),
            (
                "[{type: note}, {type: note, project: x}]",
                "loggers.1.type: 'note' is there already, as loggers.0; keep one",
            ),
            ("note", "loggers: should be a list, not 'note'"),
        ],
    )
    def test_loggers(self, loggers: str, expected: str) -> None:
        (line,) = refused(f"{SMALL}loggers: {loggers}\n")
        assert line.startswith(f"run.yaml:5: {expected}")

    def test_everything_that_is_wrong_is_told_at_once(self) -> None:
        lines = refused(
            "environment:\n"
            "  type: grasp\n"
            "  num_envs: 0\n"
            "rewards:\n"
            "  - type: tuch\n"
            "encoders:\n"
            "  depth: {type: conv, layer: []}\n"
            "curriculum: {type: lesson}\n"
            "trainer: {trainer_type: ppo, max_steps: few}\n"
            "seed: x\n"
        )
        assert {line.split(": ")[0] for line in lines} == {
            f"run.yaml:{number}" for number in (3, 5, 7, 8, 9, 10)
        }

    def test_a_long_value_is_cut(self) -> None:
        (line,) = refused(f"{SMALL}seed: {'x' * 500}\n")
        assert len(line) < 120
        assert "xxx..." in line


class TestOverrides:
    def settings(self, *overrides: str) -> dict[str, Any]:
        return resolved(load(FULL, *overrides))

    @pytest.mark.parametrize(
        ("override", "path", "value"),
        [
            ("seed=3", ["seed"], 3),
            (
                "trainer.hyperparameters.learning_rate=1e-5",
                ["trainer", "hyperparameters", "learning_rate"],
                1e-5,
            ),
            ("trainer.max_steps=1e3", ["trainer", "max_steps"], 1000),
            ("rewards.1.weight=0.5", ["rewards", 1, "weight"], 0.5),
            ("encoders.depth.layers.0.2=2", ["encoders", "depth", "layers", 0, 2], 2),
            (
                "rewards=[{type: touch}]",
                ["rewards"],
                [{"type": "touch", "weight": 1, "amount": 0.1}],
            ),
            ("curriculum=", ["curriculum"], None),
            ("environment.simulator=a=b", ["environment", "simulator"], "a=b"),
            ("trainer.memory.size=3", ["trainer", "memory", "size"], 3),
            ("environment_parameters.new=2", ["environment_parameters", "new"], 2.0),
            (
                "environment={type: gym, id: Pole-v1}",
                ["environment"],
                {"type": "gym", "id": "Pole-v1"},
            ),
        ],
    )
    def test_they_set_values(self, override: str, path: list[str | int], value: Any) -> None:
        found: Any = self.settings(override)
        for step in path:
            found = found[step]
        assert found == value

    def test_the_last_one_wins(self) -> None:
        assert self.settings("seed=1", "seed=2")["seed"] == 2

    def test_they_come_before_validation(self) -> None:
        text = "environment: {type: nothing}\n"
        run = load(
            text, "environment.type=grasp", "trainer.trainer_type=ppo", "trainer.max_steps=1"
        )
        assert (run.environment.name, run.trainer.name) == ("grasp", "ppo")

    def test_the_type_can_be_changed(self) -> None:
        changed = self.settings("rewards.0.type=collision", "rewards.1.type=touch")["rewards"]
        assert [reward["type"] for reward in changed] == ["collision", "touch"]

    def test_one_use_of_an_anchor_can_be_changed(self) -> None:
        text = SMALL.replace(
            "{type: grasp}",
            "{type: grasp, cameras: {a: &a {type: depth, width: 3}, b: *a}}",
        )
        cameras = resolved(load(text, "environment.cameras.b.width=9"))["environment"]["cameras"]
        assert (cameras["a"]["width"], cameras["b"]["width"]) == (3, 9)

    @pytest.mark.parametrize(
        ("override", "expected"),
        [
            (
                "trainer.hyperparameters.learning_rat=1",
                "trainer.hyperparameters.learning_rat: unknown key; did you mean 'learning_rate'?",
            ),
            ("trainr.max_steps=1", "trainr: unknown key; did you mean 'trainer'?"),
            ("device=", "device: should be text, not null"),
            ("seed=x", "seed: should be a whole number, not 'x'"),
            ("seed.deep=1", "seed: is 7, which has no key 'deep'"),
            ("rewards.2.weight=1", "rewards: has 2 items, counted from 0: there is no 2"),
            ("rewards.-1.weight=1", "rewards: is a list: '-1' must be a number, as in rewards.0"),
            ("rewards.touch=1", "rewards: is a list: 'touch' must be a number, as in rewards.0"),
            ("seed", "not KEY=VALUE; write for example trainer.max_steps=1000"),
            ("=3", "not KEY=VALUE; write for example trainer.max_steps=1000"),
            ("trainer..max_steps=3", "not KEY=VALUE; write for example trainer.max_steps=1000"),
            ("seed=.nan", "seed: should be a finite number"),
            ("trainer.memory={size: 1, size: 2}", None),
        ],
    )
    def test_mistakes_name_the_override(self, override: str, expected: str | None) -> None:
        place = f"command line '{override}'"
        expected = expected or f"size: duplicate key, first at {place}; remove one"
        assert refused(FULL, override) == [f"{place}: {expected}"]

    def test_a_value_that_is_no_yaml(self) -> None:
        (line,) = refused(FULL, "rewards=[1")
        assert line.startswith("command line 'rewards=[1': not YAML: column ")

    def test_a_mistake_beside_an_override_keeps_its_line(self) -> None:
        text = SMALL + "  hyperparameters:\n    learning_rate: x\n"
        lines = refused(text, "trainer.hyperparameters.batch_size=y")
        assert lines == [
            "run.yaml:6: trainer.hyperparameters.learning_rate: should be a number, not 'x'",
            "command line 'trainer.hyperparameters.batch_size=y': "
            "trainer.hyperparameters.batch_size: should be a whole number, not 'y'",
        ]

    def test_a_replaced_section_is_the_command_lines(self) -> None:
        override = "trainer.hyperparameters={learning_rate: x}"
        text = SMALL + "  hyperparameters:\n    learning_rate: 1\n"
        (line,) = refused(text, override)
        assert line.startswith(
            f"command line '{override}': trainer.hyperparameters.learning_rate: "
        )

    def test_settings_left_over_from_another_type_are_left_out(self) -> None:
        run = load(FULL, "environment.type=gym", "environment.id=Pole-v1")
        assert run.environment.settings == Gym.Settings(id="Pole-v1")


class TestResolved:
    @pytest.mark.parametrize("text", [FULL, SMALL])
    def test_it_reproduces_the_run(self, text: str) -> None:
        run = load(text)
        assert load(dump_yaml(run)) == run

    def test_defaults_are_written_out(self) -> None:
        data = resolved(load(SMALL))
        assert data["trainer"] == {
            "trainer_type": "ppo",
            "hyperparameters": {
                "learning_rate": 3e-4,
                "schedule": "linear",
                "batch_size": 64,
                "buffer_size": 1024,
            },
            "memory": None,
            "decay": 0.5,
            "max_steps": 10,
            "summary_freq": 10_000,
            "checkpoint_interval": 100_000,
            "keep_checkpoints": 5,
        }
        assert data["seed"] == 0

    @pytest.mark.parametrize(
        ("loggers", "expected"),
        [
            ("", [{"type": "tensorboard"}]),
            ("loggers:\n", [{"type": "tensorboard"}]),
            ("loggers: []\n", []),
            ("loggers: [{type: note}]\n", [{"type": "note", "project": "none"}]),
        ],
    )
    def test_loggers_are_tensorboard_alone_unless_they_are_named(
        self, loggers: str, expected: list[dict[str, Any]]
    ) -> None:
        run = load(SMALL + loggers)
        assert resolved(run)["loggers"] == expected
        assert load(dump_yaml(run)) == run

    def test_it_is_plain_yaml(self) -> None:
        run = load(FULL)
        assert yaml.safe_load(dump_yaml(run)) == resolved(run)

    @given(
        rate=st.floats(
            min_value=0, exclude_min=True, allow_infinity=False, allow_nan=False, width=32
        ),
        weight=st.floats(allow_infinity=False, allow_nan=False, width=32),
        simulator=st.text(st.characters(codec="utf-8")),
        device=st.sampled_from(["cpu", "1e-3", "yes", "null", "0o7", "~", "cuda:0"]),
        seed=st.integers(0, 2**32 - 1),
    )
    def test_any_values_come_back_exactly(
        self, rate: float, weight: float, simulator: str, device: str, seed: int
    ) -> None:
        values = {
            "environment": {"type": "grasp", "simulator": simulator},
            "rewards": [{"type": "touch", "weight": weight}],
            "trainer": {
                "trainer_type": "ppo",
                "max_steps": 1,
                "hyperparameters": {"learning_rate": rate},
            },
            "device": device,
            "seed": seed,
        }
        run = load(dump(values))
        assert run.rewards[0].weight == weight
        assert run.trainer.settings.model_dump()["hyperparameters"]["learning_rate"] == rate
        assert run.environment.settings.model_dump()["simulator"] == simulator
        assert (run.device, run.seed) == (device, seed)
        assert load(dump_yaml(run)) == run
