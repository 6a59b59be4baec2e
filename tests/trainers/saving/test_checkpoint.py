from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch

from trainers.saving import checkpoint
from trainers.saving.checkpoint import CheckpointError, Checkpoints, Loaded

FILES = ["weights.safetensors", "state.safetensors", "state.json", "manifest.json"]


def save(
    checkpoints: Checkpoints, step: int, score: float | None = None, score_of: str = "reward"
) -> Path:
    weights = {"w": torch.full((2, 3), float(step)), "n": torch.tensor(step)}
    state = {"step": step, "rng": np.arange(5, dtype=np.uint64), "adam": {0: torch.ones(2)}}
    return checkpoints.save(step, weights, state, score, score_of)


def names(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def marked(directory: Path, name: str) -> str:
    return json.loads((directory / f"{name}.json").read_text())["checkpoint"]


def steps(checkpoints: Checkpoints) -> list[int]:
    return [info.step for info in checkpoints.list_checkpoints()]


def test_what_is_saved_comes_back(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path / "run" / "checkpoints", keep=2)
    path = save(checkpoints, 100, score=0.5)
    assert path == tmp_path / "run" / "checkpoints" / "step-100"
    assert names(path) == sorted(FILES)
    for loaded in (checkpoints.load_latest(), checkpoints.load_best(), checkpoints.load(path)):
        assert (loaded.step, loaded.score, loaded.path, loaded.notes) == (100, 0.5, path, [])
        assert loaded.weights["w"].tolist() == [[100.0] * 3] * 2
        assert loaded.weights["n"].dtype == torch.int64
        assert loaded.state["step"] == 100
        assert loaded.state["rng"].dtype == np.uint64
        assert loaded.state["adam"][0].tolist() == [1, 1]


def test_other_programs_can_read_the_weights(tmp_path: Path) -> None:
    path = save(Checkpoints(tmp_path, 1), 7)
    assert safetensors.torch.load_file(path / "weights.safetensors")["n"].item() == 7


def test_tied_and_transposed_weights(tmp_path: Path) -> None:
    w = torch.arange(6.0).reshape(2, 3)
    checkpoints = Checkpoints(tmp_path, keep=1)
    checkpoints.save(1, {"a": w, "tied": w, "t": w.T, "p": torch.nn.Parameter(w)}, None, None)
    weights = checkpoints.load_latest().weights
    assert weights["a"].tolist() == weights["tied"].tolist() == weights["p"].tolist() == w.tolist()
    assert weights["t"].tolist() == w.T.tolist()


def test_adam_goes_on_bit_for_bit(tmp_path: Path) -> None:
    def build() -> tuple[torch.nn.Module, torch.optim.Adam]:
        module = torch.nn.Linear(7, 3)
        groups: list[dict[str, Any]] = [
            {"params": [module.weight]},
            {"params": [module.bias], "lr": 2e-3},
        ]
        return module, torch.optim.Adam(groups, lr=1e-3, betas=(0.8, 0.99))

    def train(module: torch.nn.Module, optimizer: torch.optim.Adam, generator: Any) -> None:
        optimizer.zero_grad()
        module(torch.rand(5, 7, generator=generator)).square().mean().backward()
        optimizer.step()

    generator = torch.Generator().manual_seed(1)
    module, optimizer = build()
    for _ in range(3):
        train(module, optimizer, generator)
    checkpoints = Checkpoints(tmp_path, keep=1)
    state = {"optimizer": optimizer.state_dict(), "generator": generator.get_state()}
    checkpoints.save(3, module.state_dict(), state, None)
    train(module, optimizer, generator)

    loaded = checkpoints.load_latest()
    other_module, other_optimizer = build()
    other_generator = torch.Generator()
    other_module.load_state_dict(loaded.weights)
    other_optimizer.load_state_dict(loaded.state["optimizer"])
    other_generator.set_state(loaded.state["generator"])
    train(other_module, other_optimizer, other_generator)
    for a, b in zip(module.parameters(), other_module.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.5, 0.99, "last byte", "missing"])
def test_a_cut_short_file_falls_back_to_the_one_before(
    tmp_path: Path, name: str, fraction: float | str
) -> None:
    checkpoints = Checkpoints(tmp_path, keep=3)
    save(checkpoints, 100, score=1.0)
    path = save(checkpoints, 200, score=2.0)
    content = (path / name).read_bytes()
    if fraction == "missing":
        (path / name).unlink()
    else:
        kept = len(content) - 1 if isinstance(fraction, str) else int(len(content) * fraction)
        (path / name).write_bytes(content[:kept])
    for loaded in (checkpoints.load_latest(), checkpoints.load_best()):
        assert loaded.step == 100
        assert loaded.weights["n"].item() == 100
    (note,) = checkpoints.load_latest().notes
    assert str(path) in note
    assert name in note
    with pytest.raises(CheckpointError, match=name):
        checkpoints.load(path)


@pytest.mark.parametrize("load", [Checkpoints.load_best, Checkpoints.load_latest])
def test_one_that_is_pruned_while_it_is_read_is_no_damaged_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, load: Callable[[Checkpoints], Loaded]
) -> None:
    checkpoints = Checkpoints(tmp_path, keep=1)
    save(checkpoints, 100, score=1.0)
    read = checkpoint._read

    def late(path: Path, with_state: bool) -> Loaded:
        monkeypatch.setattr(checkpoint, "_read", read)
        save(checkpoints, 200, score=2.0)
        return read(path, with_state)

    monkeypatch.setattr(checkpoint, "_read", late)
    loaded = load(checkpoints)
    assert (loaded.step, loaded.notes) == (200, [])


@pytest.mark.parametrize("name", FILES[:3])
def test_a_flipped_bit_is_noticed(tmp_path: Path, name: str) -> None:
    checkpoints = Checkpoints(tmp_path, keep=3)
    save(checkpoints, 100)
    path = save(checkpoints, 200)
    content = bytearray((path / name).read_bytes())
    content[-1] ^= 1
    (path / name).write_bytes(content)
    loaded = checkpoints.load_latest()
    assert loaded.step == 100
    assert f"the content of {name} doesn't match" in loaded.notes[0]


def test_several_damaged_ones_are_all_named(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=3)
    paths = [save(checkpoints, step) for step in (100, 200, 300)]
    (paths[1] / "state.json").write_text("")
    shutil.rmtree(paths[2])
    paths[2].mkdir()
    loaded = checkpoints.load_latest()
    assert loaded.step == 100
    assert len(loaded.notes) == 2
    assert str(paths[2]) in loaded.notes[0]
    assert str(paths[1]) in loaded.notes[1]
    assert "there is no manifest.json" in loaded.notes[0]
    assert "state.json is cut short: 0 bytes" in loaded.notes[1]


def test_none_good_is_an_error_with_directory_and_reasons(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=3)
    for path in [save(checkpoints, step) for step in (100, 200)]:
        (path / "weights.safetensors").write_bytes(b"")
    with pytest.raises(CheckpointError) as caught:
        checkpoints.load_latest()
    message = str(caught.value)
    assert f"no checkpoint in {tmp_path} can be used" in message
    assert "start the run afresh" in message
    assert message.count("weights.safetensors is cut short") == 2


@pytest.mark.parametrize("exists", [True, False])
def test_none_at_all_is_an_error(tmp_path: Path, exists: bool) -> None:
    directory = tmp_path if exists else tmp_path / "nowhere"
    with pytest.raises(CheckpointError, match=f"there is no checkpoint in {directory}"):
        Checkpoints(directory, keep=1).load_latest()
    assert Checkpoints(directory, keep=1).list_checkpoints() == []


def test_weights_alone_do_without_the_state(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=1)
    path = save(checkpoints, 100)
    (path / "state.json").write_text("?")
    (path / "state.safetensors").unlink()
    loaded = checkpoints.load(path, with_state=False)
    assert loaded.weights["n"].item() == 100
    assert loaded.state is None
    assert checkpoints.load_latest(with_state=False).step == 100
    assert checkpoints.load_best(with_state=False).step == 100


def test_pruning_keeps_the_newest_and_the_best(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=2)
    for step, score in [(100, 0.1), (200, 0.9), (300, 0.2), (400, None), (500, 0.3)]:
        save(checkpoints, step, score)
    assert names(tmp_path) == ["best.json", "latest.json", "step-200", "step-400", "step-500"]
    assert marked(tmp_path, "best") == "step-200"
    assert marked(tmp_path, "latest") == "step-500"
    assert checkpoints.load_best().step == 200
    assert checkpoints.load_latest().step == 500


def test_a_better_one_takes_the_place_of_the_best(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=1)
    for step, score in [(100, 0.5), (200, 0.4), (300, 0.6), (400, 0.6), (500, 0.1)]:
        save(checkpoints, step, score)
    assert steps(checkpoints) == [400, 500]  # of two equal ones, the later


def test_scores_of_something_else_than_the_newests_are_not_compared(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=9)
    save(checkpoints, 100, score=18.5, score_of="")  # before it was said of what
    assert marked(tmp_path, "best") == "step-100"
    save(checkpoints, 200, score=0.4, score_of="evaluation.success")
    assert marked(tmp_path, "best") == "step-200"
    save(checkpoints, 300, score=0.3, score_of="evaluation.success")
    save(checkpoints, 400, score_of="evaluation.success")  # between two evaluations
    assert marked(tmp_path, "best") == "step-200"
    assert checkpoints.load_best().score_of == "evaluation.success"
    save(checkpoints, 500, score_of="age")  # nothing compares: the newest
    assert marked(tmp_path, "best") == "step-500"


def test_a_manifest_need_not_say_what_its_score_is_of(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=9)
    for step, score in ((100, 0.7), (200, 0.6)):
        path = save(checkpoints, step, score) / "manifest.json"
        manifest = json.loads(path.read_text())
        assert manifest.pop("score_of") == "reward"
        path.write_text(json.dumps(manifest))
    assert checkpoints.load_best().step == 100
    assert checkpoints.load_best().score_of == ""


def test_without_a_score_none_is_best_unless_there_is_nothing_else(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=3)
    save(checkpoints, 100)
    save(checkpoints, 200, float("nan"))
    assert marked(tmp_path, "best") == "step-200"
    save(checkpoints, 300, -5.0)
    assert marked(tmp_path, "best") == "step-300"
    save(checkpoints, 400)
    assert marked(tmp_path, "best") == "step-300"
    assert checkpoints.load_best().step == 300


def test_scores_survive_a_restart(tmp_path: Path) -> None:
    save(Checkpoints(tmp_path, keep=1), 100, 0.9)
    save(Checkpoints(tmp_path, keep=1), 200, 0.1)
    restarted = Checkpoints(tmp_path, keep=1)
    save(restarted, 300, 0.2)
    assert [(info.step, info.score) for info in restarted.list_checkpoints()] == [
        (100, 0.9), (300, 0.2),
    ]  # fmt: skip
    assert marked(tmp_path, "best") == "step-100"


def test_the_same_step_is_replaced(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=2)
    checkpoints.save(100, {"w": torch.zeros(1)}, {"try": 1}, 0.5)
    checkpoints.save(100, {"w": torch.ones(1)}, {"try": 2}, 0.1)
    assert names(tmp_path) == ["best.json", "latest.json", "step-100"]
    loaded = checkpoints.load_latest()
    assert (loaded.state, loaded.weights["w"].item(), loaded.score) == ({"try": 2}, 1.0, 0.1)


def test_a_score_is_not_lost_where_the_same_weights_are_saved_again_without_one(
    tmp_path: Path,
) -> None:
    checkpoints = Checkpoints(tmp_path, keep=1)
    save(checkpoints, 100, 0.9)
    save(checkpoints, 200, 0.5)
    save(checkpoints, 200)
    assert checkpoints.load_latest().score == 0.5
    assert marked(tmp_path, "best") == "step-100"
    save(checkpoints, 200, 0.6)
    assert checkpoints.load_latest().score == 0.6
    save(checkpoints, 200, None, "evaluation.success")  # another kind of score
    assert checkpoints.load_latest().score is None
    save(checkpoints, 300, 0.7)
    checkpoints.save(300, {"w": torch.zeros(1)}, {}, None, "reward")  # another policy
    assert checkpoints.load_latest().score is None


def test_after_going_back_the_latest_is_the_one_saved_last(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=2)
    for step in (100, 200, 300):
        save(checkpoints, step)
    (tmp_path / "step-300" / "state.json").write_text("")
    assert checkpoints.load_latest().step == 200
    save(checkpoints, 250)
    loaded = checkpoints.load_latest()
    assert (loaded.step, loaded.notes) == (250, [])
    assert steps(checkpoints) == [200, 250]  # the damaged one takes no good one's place


def test_a_damaged_best_leaves_the_mark_to_the_next(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=3)
    for step, score in [(100, 0.5), (200, 0.9), (300, 0.1)]:
        save(checkpoints, step, score)
    (tmp_path / "step-200" / "weights.safetensors").write_bytes(b"")
    loaded = checkpoints.load_best()
    assert loaded.step == 100
    assert "step-200" in loaded.notes[0]
    save(checkpoints, 400, 0.2)
    assert marked(tmp_path, "best") == "step-100"


def test_leftovers_of_interrupted_saves_are_ignored_then_removed(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=2)
    path = save(checkpoints, 100)
    shutil.copytree(path, tmp_path / ".step-200.tmp-0a1b2c3d")
    shutil.copytree(path, tmp_path / ".step-100.old-0a1b2c3d")
    loaded = checkpoints.load_latest()
    assert (loaded.path, loaded.notes) == (path, [])
    save(checkpoints, 300)
    assert names(tmp_path) == ["best.json", "latest.json", "step-100", "step-300"]


def test_one_put_aside_for_a_replacement_that_never_came_still_counts(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=2)
    assert checkpoints.empty
    save(checkpoints, 100).rename(tmp_path / ".step-100.old-0a1b2c3d")
    assert not checkpoints.empty
    assert checkpoints.load_latest().step == 100
    save(checkpoints, 200)
    assert steps(checkpoints) == [100, 200]
    assert names(tmp_path) == ["best.json", "latest.json", "step-100", "step-200"]


def test_other_files_and_folders_are_left_alone(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=1)
    (tmp_path / "step-best").mkdir()
    (tmp_path / "notes.txt").write_text("mine")
    save(checkpoints, 100)
    save(checkpoints, 200)
    assert {"step-best", "notes.txt"} <= set(names(tmp_path))
    assert "step-100" not in names(tmp_path)


def test_checkpoints_behind_links_are_read_pruned_and_replaced(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (tmp_path / "linked").symlink_to(elsewhere)
    checkpoints = Checkpoints(tmp_path / "linked", keep=1)
    for step in (1, 2):
        save(checkpoints, step)
        (elsewhere / f"step-{step}").rename(tmp_path / f"moved-{step}")
        (elsewhere / f"step-{step}").symlink_to(tmp_path / f"moved-{step}")
    assert checkpoints.load_latest().step == 2
    assert not (elsewhere / "step-1").is_symlink()  # the second save pruned it
    save(checkpoints, 2)
    assert not (elsewhere / "step-2").is_symlink()
    assert names(elsewhere) == ["best.json", "latest.json", "step-2"]
    assert names(tmp_path) == ["elsewhere", "linked", "moved-1", "moved-2"]
    (elsewhere / "step-3").symlink_to(tmp_path / "nowhere")
    assert save(checkpoints, 3).is_dir()
    assert Checkpoints.load(tmp_path / "moved-1").step == 1


def test_a_failed_save_leaves_nothing_and_names_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoints = Checkpoints(tmp_path, keep=2)
    save(checkpoints, 100)
    before = names(tmp_path)

    def full(*_: Any) -> None:
        raise safetensors.SafetensorError("I/O error: No space left on device (os error 28)")

    monkeypatch.setattr(safetensors.numpy, "save_file", full)
    with pytest.raises(OSError, match="No space left") as caught:
        save(checkpoints, 200)
    assert caught.value.filename == str(tmp_path / "step-200")
    assert names(tmp_path) == before
    assert checkpoints.load_latest().step == 100


def test_a_state_that_cannot_be_saved_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"state\.policy"):
        Checkpoints(tmp_path / "c", keep=1).save(1, {}, {"policy": object()}, None)
    assert not (tmp_path / "c").exists()


def test_a_kill_at_any_moment_loses_no_earlier_checkpoint(tmp_path: Path) -> None:
    """The process dies at every single step of the file system, one run after another."""
    program = """
import os, sys
from pathlib import Path
import torch
from trainers.saving.checkpoint import Checkpoints
directory, survive = Path(sys.argv[1]), int(sys.argv[2])
Checkpoints(directory, 1).save(100, {"w": torch.ones(1)}, {"try": 1}, None)
calls = 0
def audit(event, arguments):
    global calls
    changes = ("os.rename", "os.remove", "os.rmdir", "os.mkdir", "shutil.rmtree")
    writes = event == "open" and arguments[1] and any(c in str(arguments[1]) for c in "wx+")
    if event in changes or writes:
        calls += 1
        if calls > survive:
            os._exit(9)
sys.addaudithook(audit)
Checkpoints(directory, 1).save(int(sys.argv[3]), {"w": torch.zeros(1)}, {"try": 2}, None)
"""
    # Forked, because importing torch anew for each takes seconds.
    source = compile(program, "program", "exec")
    for step in (100, 200):
        for survive in range(100):
            directory = tmp_path / f"{step}-{survive}"
            child = os.fork()
            if child == 0:
                sys.argv = ["program", str(directory), str(survive), str(step)]
                try:
                    exec(source, {})
                    os._exit(0)
                finally:  # never back into pytest
                    os._exit(1)
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            assert code in (0, 9)
            loaded = Checkpoints(directory, 1).load_latest()
            assert loaded.notes == []
            assert loaded.weights["w"].item() == (1.0 if loaded.state["try"] == 1 else 0.0)
            save(Checkpoints(directory, 1), 300)
            assert names(directory) == ["best.json", "latest.json", "step-300"]
            if code == 0:
                assert loaded.state == {"try": 2}
                break
        assert survive > 8, "too few moments tried"


def test_everything_is_on_the_disk_before_the_rename(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    monkeypatch.setattr(checkpoint, "sync", lambda path: synced.append(path.name))
    rename = Path.rename

    def renamed(self: Path, target: Path) -> Path:
        synced.append(f"renamed to {target.name}")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", renamed)
    save(Checkpoints(tmp_path, keep=1), 100)
    at = synced.index("renamed to step-100")
    assert sorted(synced[: at - 1]) == sorted(FILES)
    assert synced[at - 1].startswith(".step-100.tmp-")
    assert synced[at + 1] == tmp_path.name


def test_another_format_is_refused_with_both_numbers(tmp_path: Path) -> None:
    path = save(Checkpoints(tmp_path, keep=1), 100)
    manifest = json.loads((path / "manifest.json").read_text())
    (path / "manifest.json").write_text(json.dumps(manifest | {"format": 99}))
    with pytest.raises(CheckpointError, match="format 99, this version reads 1"):
        Checkpoints.load(path)


def test_a_path_that_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"there is no manifest\.json"):
        Checkpoints.load(tmp_path / "step-1")


def test_keep_must_be_at_least_one(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="keep is 0"):
        Checkpoints(tmp_path, keep=0)
