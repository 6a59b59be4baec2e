"""Files that somebody else made: what they name is not imported, what they hold is checked."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from envs.environment import EnvironmentFailure
from trainers import calibrate, compare, evaluate, export, learn, predict
from trainers.common.command import DONE, MISTAKE
from trainers.common.errors import UserError
from trainers.comparison.results import read_status
from trainers.inference.policy import Policy
from trainers.run import run_file
from trainers.saving.checkpoint import MANIFEST, STATE, WEIGHTS, Checkpoints

RUN_FILE = """
environment: {type: gymnasium, id: CartPole-v1, num_envs: 2, max_episode_steps: 20}
trainer:
  trainer_type: ppo
  hyperparameters: {batch_size: 16, buffer_size: 32, num_epoch: 1}
  network_settings: {hidden_units: 5, num_layers: 1}
  max_steps: 64
  summary_freq: 32
"""
MODULE = "a_strangers_code"
PLUGIN = """
from trainers.hookspecs import hookimpl

@hookimpl
def ventosa_rewards():
    return {}
"""


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run."""
    folder = tmp_path_factory.mktemp("cartpole")
    (folder / "run.yaml").write_text(RUN_FILE)
    assert learn.main([str(folder / "run.yaml"), "--results-dir", str(folder)]) == DONE
    return folder / "run"


@pytest.fixture
def run(cartpole: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(cartpole, tmp_path / "run"))


class TestTrust:
    @pytest.fixture
    def stranger(self, run: Path) -> Path:
        """A run that names a module, and was made before policies said what they are."""
        file = run / "configuration.yaml"
        file.write_text(file.read_text().replace("CartPole-v1", f"'{MODULE}:CartPole-v1'"))
        assert MODULE in file.read_text()
        (run / "policy.json").unlink()
        return run

    @pytest.fixture(autouse=True)
    def was_imported(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], bool]:
        """Whether the module was imported."""
        (tmp_path / f"{MODULE}.py").write_text("open(__file__ + '.ran', 'w').close()\n")
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.delitem(sys.modules, MODULE, raising=False)
        return (tmp_path / f"{MODULE}.py.ran").exists

    @pytest.mark.parametrize(
        ("command", "rest", "code"),
        [
            (evaluate.main, ["--episodes", "2"], DONE),
            (evaluate.main, ["--episodes", "2", "environment.max_episode_steps=3"], DONE),
            (export.main, ["OUT"], DONE),
            (export.main, ["OUT/policy.onnx"], DONE),
            # These go on until they find that it has no answers to be sure of, and sees no images.
            (calibrate.main, ["--episodes", "100"], MISTAKE),
            (predict.main, ["image.png"], MISTAKE),
        ],
    )
    def test_no_command_imports_what_a_run_names_unless_it_is_told_to(
        self,
        stranger: Path,
        tmp_path: Path,
        was_imported: Callable[[], bool],
        capfd: pytest.CaptureFixture[str],
        command: Callable[[list[str]], int],
        rest: list[str],
        code: int,
    ) -> None:
        words = [word.replace("OUT", str(tmp_path / "out")) for word in rest]
        assert command([str(stranger), *words]) == MISTAKE
        assert capfd.readouterr().err == (
            f"error: {stranger}/configuration.yaml: its environment imports the module "
            f"{MODULE!r}, and whatever code is there runs: if you trust it, say --trust, or in "
            "Python import it before\n"
        )
        assert not was_imported()
        assert command([str(stranger), *words, "--trust"]) == code
        assert was_imported()

    def test_what_needs_no_environment_needs_no_trust(
        self, stranger: Path, cartpole: Path, tmp_path: Path, was_imported: Callable[[], bool]
    ) -> None:
        shutil.copy(cartpole / "policy.json", stranger)
        Policy.load(stranger)
        assert export.main([str(stranger), str(tmp_path / "out")]) == DONE
        own = tmp_path / "own.yaml"
        own.write_text(RUN_FILE)
        words = [str(own), "--results-dir", str(tmp_path), "--initialize-from", str(stranger)]
        assert learn.main(words) == DONE
        assert compare.main([str(stranger), "--report", str(tmp_path / "report")]) == DONE
        assert not was_imported()

    def test_an_onnx_file_is_a_strangers_too(
        self,
        stranger: Path,
        cartpole: Path,
        tmp_path: Path,
        was_imported: Callable[[], bool],
        capfd: pytest.CaptureFixture[str],
    ) -> None:
        shutil.copy(cartpole / "policy.json", stranger)
        file = tmp_path / "policy.onnx"
        assert export.main([str(stranger), str(file)]) == DONE
        assert f"imports the module {MODULE!r}" in capfd.readouterr().out  # why it was not asked
        assert evaluate.main([str(file), "--episodes", "2"]) == MISTAKE
        assert f"{file}: configuration.yaml: its environment" in capfd.readouterr().err
        assert not was_imported()
        assert evaluate.main([str(file), "--episodes", "2", "--trust"]) == DONE
        assert was_imported()

    def test_a_module_that_was_imported_may_be_named(self, stranger: Path) -> None:
        with pytest.raises(UserError, match="say --trust"):
            Policy.load(stranger)
        __import__(MODULE)
        Policy.load(stranger)

    def test_so_may_one_of_an_installed_plugin(self, stranger: Path, tmp_path: Path) -> None:
        package, info = tmp_path / "a_plugin", tmp_path / "a_plugin-1.0.dist-info"
        for folder in (package, info):
            folder.mkdir()
        (package / "plugin.py").write_text(PLUGIN)
        (package / "environments.py").write_text("")
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: a-plugin\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text("[ventosa]\na_plugin = a_plugin.plugin\n")
        file = stranger / "configuration.yaml"
        file.write_text(file.read_text().replace(MODULE, "a_plugin.environments"))
        Policy.load(stranger)
        assert "a_plugin.environments" in sys.modules
        file.write_text(file.read_text().replace("a_plugin.environments", "a_plugins"))
        with pytest.raises(UserError, match="imports the module 'a_plugins'"):
            Policy.load(stranger)

    def test_what_can_not_be_imported_is_said(
        self, stranger: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / f"{MODULE}.py").write_text("raise OSError('no such device')\n")
        assert evaluate.main([str(stranger), "--trust"]) == MISTAKE
        assert f"the module {MODULE!r}, which its environment needs" in (
            said := capfd.readouterr().err
        )
        assert said.endswith("can't be imported: OSError: no such device\n")

    def test_ones_own_run_file_may_name_what_it_likes(
        self, stranger: Path, tmp_path: Path, was_imported: Callable[[], bool]
    ) -> None:
        words = [str(stranger / "configuration.yaml"), "--results-dir", str(tmp_path / "results")]
        assert learn.main(words) == DONE
        assert was_imported()


DEEP = "as deep as can be"
WRONG: tuple[Any, ...] = ("text", True, 10**400, [], {}, DEEP)
"""In the place of values of another kind."""
PERHAPS = (None, -1)
"""Wrong in most places."""
Forged = tuple[str, bool, Any]
"""Where and what, whether it has to be noticed, and the data with it."""


def forgeries(data: Any, path: str = "", whole: Callable[[Any], Any] = lambda it: it) -> Any:
    """Yields plain data with one thing changed: a key that is missing, or another value."""
    keys = list(data) if isinstance(data, dict) else range(len(data))
    for key in keys:
        place, own = f"{path}.{key}", data[key]

        def around(part: Any, key: Any = key) -> Any:
            changed = data.copy()
            changed[key] = part
            return whole(changed)

        if isinstance(data, dict):
            yield f"{place} missing", False, whole({k: data[k] for k in keys if k != key})
        for wrong in WRONG:
            if type(own) is not type(wrong) or wrong in (DEEP, 10**400):
                yield f"{place}: {str(wrong)[:20]}", own is not None, around(wrong)
        yield from ((f"{place}: {value}", False, around(value)) for value in PERHAPS)
        if isinstance(own, dict | list):
            yield from forgeries(own, place, around)


def write(file: Path, data: Any) -> None:
    """Writes what was forged; whoever does so writes its checksum, too."""
    file.write_text(json.dumps(data).replace(f'"{DEEP}"', "[" * 100_000 + "]" * 100_000))
    if file.name == STATE:
        seal(file)


def seal(file: Path) -> None:
    manifest = file.parent / MANIFEST
    sealed = json.loads(manifest.read_text())
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    sealed["files"][file.name] = {"size": file.stat().st_size, "sha256": digest}
    manifest.write_text(json.dumps(sealed))


def resume(run: Path) -> None:
    """Goes on with a run; raises what it is refused with."""
    command = [str(run / "configuration.yaml"), "trainer.max_steps=96", "--resume"]
    options = learn.parse([*command, "--run-id", run.name, "--results-dir", str(run.parent)])
    assert run_file(options, lambda: False)


NAME = "actor.trunk.0.weight"
CHECKPOINT = "checkpoints/step-64"
OPENED: dict[str, Callable[[Path], Any]] = {
    "status.json": read_status,
    "policy.json": Policy.load,
    f"{CHECKPOINT}/{MANIFEST}": lambda run: Checkpoints.load(run / CHECKPOINT),
    f"{CHECKPOINT}/{STATE}": resume,
}
NOT_READ = re.compile(r"\.(run_id|max_steps|reward|steps_per_second|elapsed_s|last_checkpoint)\b")
"""Of status.json."""


class TestForged:
    def refusal(self, run: Path, name: str, place: str) -> str | None:
        try:
            OPENED[name](run)
        except (UserError, EnvironmentFailure) as error:
            return str(error)
        except Exception as error:
            raise AssertionError(f"{name}{place}") from error
        return None

    def check(self, cartpole: Path, run: Path, name: str, forged: Iterable[Forged]) -> int:
        """Opens forged files; returns how many there were."""
        count = 0
        for place, has_to_be_noticed, data in forged:
            count += 1
            shutil.rmtree(run)
            shutil.copytree(cartpole, run)
            write(run / name, data)
            if (said := self.refusal(run, name, place)) is None:
                assert not has_to_be_noticed or NOT_READ.match(place), place
            else:
                assert str(run) in said, place
                assert len(said) < 1000, place
        return count

    @pytest.mark.parametrize(
        ("name", "every"),
        [("status.json", 3), ("policy.json", 15), (f"{CHECKPOINT}/{MANIFEST}", 3)],
    )
    def test_a_forged_file_is_refused_with_its_name(
        self, cartpole: Path, run: Path, name: str, every: int
    ) -> None:
        forged = forgeries(json.loads((cartpole / name).read_text()))
        assert self.check(cartpole, run, name, itertools.islice(forged, 0, None, every)) > 15

    def test_a_forged_state_is_refused_with_its_name(self, cartpole: Path, run: Path) -> None:
        name = f"{CHECKPOINT}/{STATE}"
        forged = forgeries(json.loads((cartpole / name).read_text()))
        assert self.check(cartpole, run, name, itertools.islice(forged, 7, None, 89)) > 10

    @pytest.mark.soak
    @pytest.mark.parametrize("name", OPENED)
    def test_all_that_is_forged_is_refused(self, cartpole: Path, run: Path, name: str) -> None:
        assert self.check(cartpole, run, name, forgeries(json.loads((run / name).read_text()))) > 99

    @pytest.mark.parametrize(
        ("forge", "said"),
        [
            (lambda w: {NAME: w[NAME] * math.nan}, f"{NAME} has values that are not numbers"),
            (lambda w: {NAME: w[NAME] / 0}, f"{NAME} has values that are not finite"),
            (lambda w: {NAME: w[NAME].T.contiguous()}, f"size mismatch for {NAME}"),
            (
                lambda w: {NAME: w[NAME].double()},
                f"weights.{NAME} is an array of 2 axes of float64",
            ),
            (
                lambda w: {NAME: w[NAME].flatten()},
                f"weights.{NAME} is an array of 1 axis of float32",
            ),
            (lambda w: {"more": torch.zeros(1)}, 'Unexpected key(s) in state_dict: "more"'),
        ],
    )
    def test_weights_of_another_network_are_refused(
        self, run: Path, tmp_path: Path, forge: Callable[[Any], Any], said: str
    ) -> None:
        file = run / CHECKPOINT / WEIGHTS
        weights = load_file(file)
        save_file(weights | forge(weights), file)
        seal(file)
        own = tmp_path / "own.yaml"
        own.write_text(RUN_FILE)
        words = [str(own), "--results-dir", str(tmp_path), "--initialize-from", str(run)]
        begin = partial(run_file, learn.parse(words), bool)
        for opened in (partial(Policy.load, run), begin, partial(resume, run)):
            with pytest.raises(UserError, match=re.escape(said)) as refused:
                opened()
            assert str(run) in str(refused.value)

    @pytest.mark.parametrize("name", [WEIGHTS, "state.safetensors"])
    def test_arrays_cut_short_are_refused(self, run: Path, name: str) -> None:
        file = run / CHECKPOINT / name
        content = file.read_bytes()
        for length in (len(content) - 1, 100, 8, 7, 0):
            file.write_bytes(content[:length])
            with pytest.raises(UserError, match=f"{name} is cut short"):
                Checkpoints.load(run / CHECKPOINT)
            seal(file)
            with pytest.raises(UserError, match=f"the content of {name} can't be used"):
                Checkpoints.load(run / CHECKPOINT)

    def test_files_have_the_modes_of_the_users_umask(self, run: Path, tmp_path: Path) -> None:
        before = os.umask(0o027)
        try:
            resume(run)
            assert export.main([str(run), str(tmp_path / "out")]) == DONE
        finally:
            os.umask(before)
        made = [*(run / "checkpoints/step-96").iterdir(), *(tmp_path / "out").iterdir()]
        assert len(made) == 8
        assert {file.stat().st_mode & 0o777 for file in made} == {0o640}
