"""What a grasp policy bears: its figures under each fault of a depth camera, alone and together.

    python -m benchmarks.robustness policies/grasp [--simulators fast pybullet] [--page FILE]

The faults are in `benchmarks/robustness.yaml`. Each row is `trainers.evaluate` on the same scenes,
without anything around the table unless the fault says so.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

from benchmarks.tables import table, write_between
from envs.grasp.settings import GraspSettings
from trainers.common.command import require_extra, tells_failures
from trainers.common.errors import UserError
from trainers.comparison.tables import markdown
from trainers.evaluation import evaluate, find_run
from trainers.reporting.figures import SURE, SURE_RIGHT
from trainers.runfile.settings import RunSettings

FAULTS_FILE = Path(__file__).with_suffix(".yaml")
HEAD = (
    "fault",
    "strength",
    "simulator",
    "first action",
    "position (mm)",
    "yaw (deg)",
    "sure",
    "of which right",
)
SIMULATORS = ("fast", "pybullet")


@dataclass(frozen=True)
class Fault:
    """A row of the table.

    Attributes:
        text: for people.
        strength: the same.
        overrides: of the run file, with CAMERA for a depth camera's settings.
    """

    text: str
    strength: str
    overrides: Sequence[str]

    def of_cameras(self, names: Sequence[str]) -> list[str]:
        """The overrides for all the depth cameras there are."""
        everywhere = (
            text.replace("CAMERA", f"environment.cameras.{name}")
            for name in names
            for text in self.overrides
        )
        return ["environment.randomize.surroundings=null", *dict.fromkeys(everywhere)]


def load_faults() -> list[Fault]:
    """The faults at all strengths, in the order of the table."""
    known = yaml.safe_load(FAULTS_FILE.read_text())
    faults = [Fault("as trained", "", [])]
    for entry in known["faults"]:
        sensors = [known["faultless"] | sensor for sensor in entry.get("sensor", ())]
        choices = entry.get("overrides") or [[f"CAMERA.sensor={json.dumps(s)}"] for s in sensors]
        faults += [
            Fault(entry["text"], strength, overrides)
            for strength, overrides in zip(known["strengths"], choices, strict=True)
        ]
    return faults


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluates under every fault, and prints the table; returns the exit code."""
    options = parse(arguments)
    if options.plot is not None:
        require_extra("render", "matplotlib")
    cameras = depth_cameras(find_run(options.policy, [], options.results_dir)[1])
    measured = list(measure(options, cameras))
    rows = [row(fault, simulator, report) for fault, simulator, report in measured]
    Console().print(table(f"{options.policy}: seed {options.seed}", HEAD, rows, left=3))
    if options.page is not None:
        write_between(options.page, "robustness", markdown(HEAD, rows))
    if options.plot is not None:
        plot(measured, options.plot)
    return 0


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robustness", description=__doc__)
    parser.add_argument("policy", help="a run (its best checkpoint) or a checkpoint's folder")
    parser.add_argument("--episodes", type=int, default=1000, help="of each row")
    parser.add_argument("--seed", type=int, default=0, help="of the scenes")
    parser.add_argument("--simulators", nargs="+", choices=SIMULATORS, default=["fast"])
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the table as Markdown")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw the first actions' success")
    parser.add_argument("--results-dir", type=Path, default=Path("results"))
    return parser.parse_args(arguments)


def depth_cameras(run: RunSettings) -> list[str]:
    """Names of a run's cameras that measure depth.

    Raises:
        UserError: the policy is none whose first action is to be right, or sees no depth.
    """
    settings = run.environment.settings
    if not isinstance(settings, GraspSettings):
        raise UserError("only a policy of `environment: {type: grasp}` has first actions to judge")
    names = [name for name, camera in settings.cameras.items() if camera.type != "rgb"]
    if not names:
        raise UserError("the policy sees no depth, and the faults are those of depth cameras")
    return names


def measure(
    options: argparse.Namespace, cameras: Sequence[str]
) -> Iterator[tuple[Fault, str, dict[str, Any]]]:
    """The reports under each fault in each simulator."""
    for fault in load_faults():
        for simulator in options.simulators:
            overrides = [*fault.of_cameras(cameras), f"environment.simulator={simulator}"]
            evaluation = evaluate(
                options.policy,
                episodes=options.episodes,
                seed=options.seed,
                overrides=overrides,
                results_dir=options.results_dir,
            )
            yield fault, simulator, evaluation.report


def row(fault: Fault, simulator: str, report: dict[str, Any]) -> list[str]:
    """The cells of a fault: success, medians / 95th percentiles of the errors, and sureness.

    The last two are empty where the policy has not learned how sure it is, or is never sure.
    """
    position, yaw = report["position_error_m"], report["yaw_error_deg"]
    return [
        fault.text,
        fault.strength,
        simulator,
        f"{report['first_action_success']:.1%}",
        f"{position['median'] * 1000.0:.1f} / {position['p95'] * 1000.0:.1f}",
        f"{yaw['median']:.2f} / {yaw['p95']:.2f}",
        *(f"{report[name]:.1%}" if name in report else "" for name in (SURE, SURE_RIGHT)),
    ]


def plot(measured: Sequence[tuple[Fault, str, dict[str, Any]]], path: Path) -> None:
    """Draws the success of the first action as bars, a group for each fault."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    reports = {
        (fault.text, fault.strength): report["first_action_success"]
        for fault, simulator, report in measured
        if simulator == measured[0][1]
    }
    texts = list(dict.fromkeys(text for text, _ in reports))
    strengths = list(dict.fromkeys(strength for _, strength in reports))
    figure = Figure(figsize=(8.0, 0.45 * len(texts) + 1.0), layout="constrained")
    axes = figure.subplots()
    height = 0.8 / max(len(strengths) - 1, 1)
    for number, strength in enumerate(strengths):
        places = [place for place, text in enumerate(texts) if (text, strength) in reports]
        values = [100.0 * reports[texts[place], strength] for place in places]
        offsets = [place + (number - len(strengths) / 2) * height for place in places]
        axes.barh(offsets, values, height, label=strength or "as trained")
    axes.set_yticks(range(len(texts)), texts)
    axes.invert_yaxis()
    axes.set_xlabel("first actions that succeed (%)")
    figure.legend(loc="outside upper center", ncols=len(strengths))
    figure.savefig(path)


if __name__ == "__main__":
    raise SystemExit(main())
