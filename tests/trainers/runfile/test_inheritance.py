"""Run files that extend another."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from trainers.runfile.inheritance import read_run_file
from trainers.runfile.registry import Registries
from trainers.runfile.settings import load_run, resolved
from trainers.runfile.yaml_document import SettingsError

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def file(name: str, text: str) -> Path:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        return path

    return file


def test_mappings_are_added_to_and_everything_else_replaced(write: Write) -> None:
    write("base.yaml", "a: {x: 1, y: {z: 2, w: 3}}\nlist: [1, 2, 3]\nkept: 4\ngone: {k: 1}\n")
    path = write(
        "own.yaml", "extends: base.yaml\na: {y: {z: 5}, new: 6}\nlist: [9]\ngone: null\nmore: 7\n"
    )
    assert read_run_file(path).data == {
        "a": {"x": 1, "y": {"z": 5, "w": 3}, "new": 6},
        "list": [9],
        "kept": 4,
        "gone": None,
        "more": 7,
    }


@pytest.mark.parametrize("key", ["type", "trainer_type"])
def test_what_is_of_another_type_has_none_of_the_old_one_s_keys(write: Write, key: str) -> None:
    write("base.yaml", f"part: {{{key}: one, size: 1, deep: {{x: 1}}}}\n")
    other = write("other.yaml", f"extends: base.yaml\npart: {{{key}: two, deep: {{y: 2}}}}\n")
    assert read_run_file(other).data == {"part": {key: "two", "deep": {"y": 2}}}
    same = write("same.yaml", f"extends: base.yaml\npart: {{{key}: one, deep: {{y: 2}}}}\n")
    assert read_run_file(same).data["part"] == {key: "one", "size": 1, "deep": {"x": 1, "y": 2}}
    silent = write("silent.yaml", "extends: base.yaml\npart: {size: 2}\n")
    assert read_run_file(silent).data["part"] == {key: "one", "size": 2, "deep": {"x": 1}}


def test_a_base_has_a_base_and_each_is_named_as_seen_from_its_file(write: Write) -> None:
    write("first.yaml", "a: 1\nb: 1\nc: 1\n")
    write("sub/second.yaml", "extends: ../first.yaml\nb: 2\nc: 2\n")
    path = write("third.yaml", "extends: sub/second.yaml\nc: 3\n")
    assert read_run_file(path).data == {"a": 1, "b": 2, "c": 3}


def test_everything_is_where_it_was_written(write: Write) -> None:
    base = write("base.yaml", "a:\n  x: 1\n  y: 2\nlist:\n- {z: 1}\n- {z: 2}\n")
    path = write("own.yaml", "extends: base.yaml\na:\n  y: 3\nlist:\n- {w: 1}\n")
    document = read_run_file(path)
    assert document.where(("a", "x")) == f"{base}:2"
    assert document.where(("a", "y")) == f"{path}:3"
    assert document.where(("list", 0, "w")) == f"{path}:5"
    # The base's list is gone, and so are its lines.
    assert document.where(("list", 1, "z")) == f"{path}:4"


def test_a_mistake_in_the_base_is_told_where_it_is(
    write: Write, write_run: Callable[..., Path], registries: Registries
) -> None:
    base = write_run("target")
    text = base.read_text()
    base.write_text(text + "\nno_such_section: 1\n")
    path = write("own.yaml", f"extends: {base}\nseed: 3\n")
    with pytest.raises(SettingsError, match="no_such_section") as caught:
        load_run(path, [], registries)
    assert f"{base}:{len(base.read_text().splitlines())}" in str(caught.value)
    base.write_text(text)
    run = load_run(path, [], registries)
    assert run.seed == 3
    assert "extends" not in resolved(run)
    assert resolved(run) == resolved(load_run(base, [], registries)) | {"seed": 3}


def test_a_circle_is_told_with_all_that_are_in_it(write: Write) -> None:
    write("a.yaml", "extends: b.yaml\n")
    write("b.yaml", "x: 1\nextends: c.yaml\n")
    path = write("c.yaml", "extends: a.yaml\n")
    with pytest.raises(SettingsError, match=r"b\.yaml:2: extends: goes round in a circle: ") as e:
        read_run_file(path)
    assert str(e.value).count("c.yaml") == 2
    alone = write("alone.yaml", "extends: alone.yaml\n")
    with pytest.raises(SettingsError, match="goes round in a circle"):
        read_run_file(alone)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("missing.yaml", r"own\.yaml:1: extends: there is no file .*missing\.yaml; write it as"),
        (".", r"own\.yaml:1: extends: there is no file"),
        ("3", r"own\.yaml:1: extends: must be the name of a run file, not 3"),
        ("[a.yaml]", r"extends: must be the name of a run file, not \['a\.yaml'\]"),
        ("null", r"extends: must be the name of a run file, not null"),
        ("''", r"extends: must be the name of a run file, not ''"),
    ],
)
def test_a_base_that_is_none_is_refused(write: Write, name: str, message: str) -> None:
    path = write("own.yaml", f"extends: {name}\n")
    with pytest.raises(SettingsError, match=message):
        read_run_file(path)


def test_keys_that_begin_with_x_are_for_anchors(write: Write) -> None:
    write("base.yaml", "x-small: &small {size: 1}\nx-list: [1]\na: *small\n")
    path = write(
        "own.yaml", "extends: base.yaml\nx-deep: &deep {b: {x-in: 2}}\n<<: *deep\nc: x-a\n"
    )
    document = read_run_file(path)
    assert document.data == {"a": {"size": 1}, "b": {"x-in": 2}, "c": "x-a"}
