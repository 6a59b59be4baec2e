"""Files that somebody else made: what they name is not imported, what they hold is checked."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from trainers import calibrate, compare, evaluate, export, learn, predict
from trainers.common.errors import UserError
from trainers.inference.policy import Policy
from trainers.learn import DONE, MISTAKE

RUN_FILE = """
environment: {type: gymnasium, id: CartPole-v1, num_envs: 2, max_episode_steps: 20}
trainer:
  trainer_type: ppo
  hyperparameters: {batch_size: 16, buffer_size: 32, num_epoch: 1}
  network_settings: {hidden_units: 4, num_layers: 1}
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
