"""`ventosa init`: what comes with ventosa is copied, and nothing is lost by it."""

from __future__ import annotations

from pathlib import Path

import pytest

from trainers.common.command import DONE, FAILED, MISTAKE
from trainers.common.shadowing import HOME
from trainers.console import shipped
from trainers.console.init import main
from trainers.console.shipped import policies, run_files, with_named_files
from trainers.runfile.registry import Registries
from trainers.runfile.settings import load_run


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def files(folder: Path) -> dict[str, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def test_without_a_name_all_are_listed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    assert main([]) == DONE
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [*run_files(HOME), *policies(HOME)]
    assert "quick                        The grasp task made small, with" in lines
    assert max(map(len, lines)) == 60


def test_a_run_file_comes_with_those_it_extends(
    here: Path, capsys: pytest.CaptureFixture[str], registries: Registries
) -> None:
    assert main(["paper/lstm", "mine"]) == DONE
    names = ("paper/lstm.yaml", "paper/stream.yaml", "schema.json")
    assert capsys.readouterr().out == "".join(f"mine/{name}\n" for name in names)
    config = HOME / "config"
    assert files(here) == {f"mine/{name}": (config / name).read_bytes() for name in names}
    copied = load_run(here / "mine/paper/lstm.yaml", [], registries)
    assert copied == load_run(config / "paper/lstm.yaml", [], registries)


@pytest.mark.parametrize("name", run_files(HOME))
def test_whatever_a_run_file_names_is_under_config(name: str) -> None:
    for path in with_named_files(run_files(HOME)[name]):
        assert path.is_file()
        assert path.is_relative_to(HOME / "config")


def test_a_sweep_comes_with_its_run_file(here: Path) -> None:
    assert main(["sweeps/cartpole.yaml"]) == DONE
    ours = {"sweeps/cartpole.yaml", "gymnasium/cartpole_ppo.yaml"}
    assert set(files(here)) == ours | {"schema.json", "sweeps/schema.json"}


def test_a_policy_is_copied_whole(here: Path) -> None:
    assert main(["policies/grasp_gaussian"]) == DONE
    ours = files(HOME / "policies/grasp_gaussian")
    assert files(here / "policies/grasp_gaussian") == {
        name: data for name, data in ours.items() if "/" not in name
    }


def test_nothing_is_overwritten_unasked(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = HOME / "config/run.yaml"
    (here / "run.yaml").write_text("mine")
    assert main(["ppo"]) == MISTAKE
    assert capsys.readouterr().err == (
        "error: run.yaml is there already, and differs: name a FOLDER, or say --force\n"
    )
    assert files(here) == {"run.yaml": b"mine"}
    assert main(["ppo", "--force"]) == DONE
    assert files(here)["run.yaml"] == run.read_bytes()
    before = (here / "run.yaml").stat().st_mtime_ns
    assert main(["ppo"]) == DONE  # what is the same is in nobody's way, and left alone
    assert (here / "run.yaml").stat().st_mtime_ns == before


def test_what_there_is_not_is_a_mistake(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["quik"]) == MISTAKE
    assert capsys.readouterr().err == (
        "error: 'quik' does not come with ventosa; did you mean 'quick'?\n"
    )


def test_a_file_in_the_place_of_a_folder_is_told(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "paper").touch()
    assert main(["paper/curriculum"]) == FAILED
    assert "error: paper/curriculum.yaml: cannot write: File exists" in capsys.readouterr().err


def test_without_a_clone_they_are_where_the_wheel_was_installed(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(shipped, "HOME", here)
    monkeypatch.setattr(shipped, "files", lambda name: None)
    assert main([]) == FAILED
    assert "not here: install it anew" in capsys.readouterr().err
