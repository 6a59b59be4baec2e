"""The command that shows a policy an image: what it prints, draws and refuses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from trainers.common.command import DONE, MISTAKE
from trainers.evaluation import evaluation_environment, find_run
from trainers.inference.policy import Policy
from trainers.predict import main

SHIPPED = Path(__file__).parents[2] / "policies" / "grasp_gaussian"
CONFIGURATION = yaml.safe_load((SHIPPED / "configuration.yaml").read_text())
((CAMERA, MOUNTED),) = CONFIGURATION["environment"]["cameras"].items()
SIZE = MOUNTED["height"], MOUNTED["width"]

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Run:
    """Runs the command; returns its exit code, its output and its errors."""

    def predict(*arguments: Any) -> tuple[int, str, str]:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        captured = capfd.readouterr()
        return code, captured.out, captured.err

    return predict


@pytest.fixture
def image(tmp_path: Path) -> Path:
    """A wall at 1.2 m before which something stands, in millimetres."""
    depth = np.full(SIZE, 1200, np.uint16)
    depth[SIZE[0] // 2 :, SIZE[1] // 3 : SIZE[1] // 2] = 1000
    path = tmp_path / "image.png"
    assert cv2.imwrite(str(path), depth)
    return path


def test_folders_and_files_say_the_same(run: Run, image: Path, shipped_onnx: Path) -> None:
    poses = []
    for policy in (SHIPPED, shipped_onnx):
        code, output, _ = run(policy, image, image, "--json")
        first, second = json.loads(output)
        assert code == DONE
        assert first == second
        assert first["file"] == str(image)
        poses.append(first["pose"])
    assert list(poses[0]) == ["x_m", "y_m", "z_m", "yaw_rad"]
    assert poses[1] == pytest.approx(poses[0], abs=1e-5)
    workspace = CONFIGURATION["environment"]["workspace"]
    for axis in "xyz":
        low, high = workspace[f"{axis}_m"]
        assert low <= poses[0][f"{axis}_m"] <= high
    code, output, _ = run(shipped_onnx, image)
    x_mm = 1000 * poses[0]["x_m"]
    assert output.startswith(f"{image}: x {x_mm:.2f} mm   y ")
    assert f"yaw {np.degrees(poses[0]['yaw_rad']):.2f} deg   NOT SURE (position error " in output


def test_it_is_said_how_sure_the_answer_is(
    run: Run, image: Path, shipped_onnx: Path, tmp_path: Path
) -> None:
    _, settings = find_run(str(SHIPPED), (), Path("results"))
    with closing(evaluation_environment(settings, 8)) as env:
        shown, _ = env.reset(seed=5)
    for number, depth in enumerate(shown[CAMERA]):
        assert cv2.imwrite(str(tmp_path / f"{number}.png"), depth)
    files = [tmp_path / f"{number}.png" for number in range(8)]
    answer = Policy.load(SHIPPED, full_precision=True).answer(shown)
    assert answer.sure.sum() >= 6
    for policy in (SHIPPED, shipped_onnx):
        told = json.loads(run(policy, *files, "--json")[1])
        assert [one["sure"] for one in told] == answer.sure.tolist()
        assert [one["probability"] for one in told] == pytest.approx(answer.probability, abs=1e-3)
        for name, values in answer.errors.items():
            expected = [one["expected_errors"][name] for one in told]
            assert expected == pytest.approx(values, rel=0.02)
    row = int(answer.sure.argmax())
    _, output, _ = run(shipped_onnx, files[row])
    error_mm = 1000 * answer.errors["position_error_m"][row]
    assert f"   sure (position error {error_mm:.1f}"[:-2] in output
    assert output.rstrip().endswith(" deg expected)")
    wall = json.loads(run(SHIPPED, image, "--json")[1])[0]
    assert not wall["sure"]


def test_units_are_told_or_known(run: Run, image: Path, tmp_path: Path) -> None:
    depth = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(tmp_path / "tenths.png"), depth * np.uint16(10))
    np.save(tmp_path / "metres.npy", depth / 1000)
    _, expected, _ = run(SHIPPED, image, "--json")
    pose = json.loads(expected)[0]["pose"]
    for name, options in (("tenths.png", ["--unit", "10000"]), ("metres.npy", [])):
        code, output, errors = run(SHIPPED, tmp_path / name, "--json", *options)
        assert code == DONE, errors
        assert json.loads(output)[0]["pose"] == pytest.approx(pose, abs=1e-6)


def test_a_camera_that_was_moved_moves_the_pose(run: Run, image: Path, tmp_path: Path) -> None:
    height, width = SIZE
    focal = width / 2 / np.tan(np.radians(MOUNTED["fov_deg"]) / 2)
    content = {
        "intrinsics": {"fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2},
        "position_m": [x + d for x, d in zip(MOUNTED["position_m"], (0.1, 0, 0.05), strict=True)],
        "target_m": [x + d for x, d in zip(MOUNTED["target_m"], (0.1, 0, 0.05), strict=True)],
        "roll_deg": MOUNTED["roll_deg"],
    }
    file = tmp_path / "camera.yaml"
    file.write_text(yaml.safe_dump(jsonable(content)))
    pose = json.loads(run(SHIPPED, image, "--json")[1])[0]["pose"]
    code, output, errors = run(SHIPPED, image, "--json", "--camera", file)
    assert code == DONE, errors
    expected = pose | {"x_m": pose["x_m"] + 0.1, "z_m": pose["z_m"] + 0.05}
    assert json.loads(output)[0]["pose"] == pytest.approx(expected, abs=1e-6)


def jsonable(content: Any) -> Any:
    return json.loads(json.dumps(content, default=float))


def test_it_is_drawn_into_a_file_or_a_folder(
    run: Run, image: Path, shipped_onnx: Path, tmp_path: Path
) -> None:
    drawn = tmp_path / "drawn.png"
    assert run(shipped_onnx, image, "--draw", drawn)[0] == DONE
    picture = cv2.imread(str(drawn))
    assert picture.shape[1] >= 480
    assert ((picture == (255, 0, 255)).all(axis=-1)).sum() > 50
    other = shutil.copy(image, tmp_path / "other.png")
    assert run(shipped_onnx, image, other, "--draw", tmp_path / "new")[0] == DONE
    assert {file.name for file in (tmp_path / "new").iterdir()} == {"image.png", "other.png"}
    code, _, errors = run(shipped_onnx, image, other, "--draw", drawn)
    assert (code, "one file for several images: name a folder" in errors) == (MISTAKE, True)
    code, _, errors = run(shipped_onnx, image, image, "--draw", tmp_path / "new")
    assert (code, "two images have the same name" in errors) == (MISTAKE, True)
    code, _, errors = run(shipped_onnx, image, "--draw", image / "below" / "drawn.png")
    assert (code, "can't be written" in errors) == (MISTAKE, True)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("width: 640\n", "camera.yaml:1: intrinsics: missing"),
        ("intrinsics: {fx: 1, fy: 1, cx: 1}\n", "intrinsics.cy: missing"),
        ("intrinsics: {fx: 1, fy: 1, cx: 1, cy: 1}\nfov: 60\n", "camera.yaml:2: fov: "),
        (
            "intrinsics: {fx: 1, fy: 1, cx: 1, cy: 1}\ndistortion: {k4: 1}\n",
            "camera.yaml:2: distortion.k4: unknown key; known: k1, k2",
        ),
        ("intrinsics: {fx: a, fy: 1, cx: 1, cy: 1}\n", "should be a number"),
        ("intrinsics: {fx: 1, fy: 1, cx: 1, cy: 1}\nposition_m: [0, 0, 1]\n", "goes with target_m"),
        ("- 1\n", "must be a mapping"),
    ],
)
def test_camera_files_that_do_not_fit_are_named(
    content: str, said: str, run: Run, image: Path, tmp_path: Path
) -> None:
    (tmp_path / "camera.yaml").write_text(content)
    code, _, errors = run(SHIPPED, image, "--camera", tmp_path / "camera.yaml")
    assert code == MISTAKE
    assert str(tmp_path / "camera.yaml") in errors
    assert said in errors


def test_what_can_not_be_shown_is_the_users_mistake(
    run: Run, image: Path, shipped_onnx: Path, tmp_path: Path
) -> None:
    missing = tmp_path / "no.png"
    for arguments, said in (
        ((SHIPPED, missing), f"{missing}: can't be read: No such file"),
        ((tmp_path / "no.onnx", image), "no.onnx: can't be read: No such file"),
        ((tmp_path / "no", image), "neither a run nor a checkpoint"),
        ((SHIPPED, image, "--camera", missing), f"{missing}: there is no such file"),
        ((shipped_onnx, image, "--unit", "10000"), "has its camera and its unit inside"),
        ((SHIPPED, image, "--unit", "10000"), "are they millimetres?"),
    ):
        code, _, errors = run(*arguments)
        assert code == MISTAKE
        assert said in errors


def test_a_policy_without_images_is_refused(
    run: Run, learn: Callable[..., Any], write_run: Callable[..., Path], image: Path
) -> None:
    results = learn(write_run("target")).results
    code, _, errors = run("toy", image, "--results-dir", results)
    assert code == MISTAKE
    assert "the policy sees goal, and images alone can be given here" in errors


def test_of_any_other_policy_the_action_is_told(
    run: Run, learn: Callable[..., Any], write_run: Callable[..., Path], tmp_path: Path
) -> None:
    encoders = {"camera": {"type": "conv", "layers": [[4, 4, 2]]}}
    results = learn(write_run("picture", encoders=encoders)).results
    np.save(tmp_path / "bar.npy", np.full((8, 8), 3.0))
    code, output, errors = run(
        "toy",
        tmp_path / "bar.npy",
        "--json",
        "--draw",
        tmp_path / "a.png",
        "--results-dir",
        results,
    )
    assert code == DONE, errors
    (told,) = json.loads(output)
    assert list(told) == ["file", "action"]
    assert -1.0 <= told["action"][0] <= 1.0
    assert (tmp_path / "a.png").is_file()
    _, output, _ = run("toy", tmp_path / "bar.npy", "--results-dir", results)
    assert output.startswith(f"{tmp_path / 'bar.npy'}: action [")
