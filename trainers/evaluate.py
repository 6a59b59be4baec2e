"""The command line: `python -m trainers.evaluate results/run`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trainers.common import process
from trainers.common.command import DONE, tells_failures
from trainers.common.errors import UserError, suggestion
from trainers.common.files import write_atomically
from trainers.common.options import (
    add_results_option,
    add_trust_option,
    command_parser,
    positive,
    program,
    seed_number,
)

if TYPE_CHECKING:
    from rich.table import Table

    from envs.evaluation import EvaluationOption
    from trainers.evaluation import Evaluation
    from trainers.runfile.settings import Component

STANDARD_OUTPUT = Path("-")


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluates a policy; returns the exit code."""
    process.prepare()  # for it may take torch to read a command line
    options = parse(sys.argv[1:] if arguments is None else arguments)
    # Imported late, as below, so that `--help` answers at once.
    from rich.console import Console  # noqa: PLC0415

    from trainers.evaluation import evaluate  # noqa: PLC0415

    evaluation = evaluate(
        options.policy,
        episodes=options.episodes,
        seed=options.seed,
        overrides=options.overrides,
        results_dir=options.results_dir,
        check=options.check,
        window=options.window,
        render=options.render,
        trust=options.trust,
    )
    if options.json == STANDARD_OUTPUT:
        print(json.dumps(evaluation.report, indent=2))
        return DONE
    if options.json is not None:
        _write(options.json, evaluation.report)
    Console().print(table(options.policy, evaluation))
    return DONE


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Reads the command line; the policy's environment has options of its own.

    Returns:
        The options; `overrides` has those that stand for keys of the run file, too, and `check` and
        `window` say whether a physical check is asked for, and is to be seen.

    Raises:
        UserError: there is no such policy, or no such option.
    """
    generic = _generic_options()
    known, rest = generic.parse_known_args(arguments)
    policy = next((word for word in rest if not word.startswith("-")), None)
    environment = None
    if policy is not None:
        with _policy_first(rest[0]):
            environment = _environment(policy, known)
    offered = () if environment is None else environment.cls.evaluation_options
    parser = command_parser(
        "evaluate",
        description="Report how good a policy is, in episodes never used for training.",
        parents=[generic],
        epilog=None if policy else "POLICY --help lists the options of its environment, too.",
    )
    parser.add_argument(
        "policy", help="a run (its best checkpoint), a checkpoint's folder or an ONNX file"
    )
    parser.add_argument(
        "overrides",
        nargs="*",
        default=[],
        metavar="KEY=VALUE",
        help="a dotted path into the run's file, such as environment.num_envs=16",
    )
    if environment is not None:
        _add_options(parser, environment)
    options, unknown = parser.parse_known_intermixed_args(arguments)
    if unknown:
        _refuse(unknown, [*_flags(known), *(option.flag for option in offered)])
    return _resolved(options, offered)


def _generic_options() -> argparse.ArgumentParser:
    """Options that every environment's policies can be evaluated with."""
    parser = argparse.ArgumentParser(
        prog=program("evaluate"),
        usage="%(prog)s POLICY [KEY=VALUE ...] [options]",
        add_help=False,
    )
    parser.add_argument("--episodes", type=positive, help="how many (default: the environment's)")
    parser.add_argument("--seed", type=seed_number, default=0, help="of the episodes")
    parser.add_argument(
        "--render",
        nargs="?",
        const="",
        type=folder,
        metavar="DIR",
        help="draw pictures into DIR (default: evaluation/ in the run's folder)",
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write the figures here, too; - prints them alone"
    )
    add_trust_option(parser)
    add_results_option(parser)
    return parser


@contextmanager
def _policy_first(word: str) -> Iterator[None]:
    """Says what may be wrong where an option of the environment stands before the policy.

    Its value was taken for the policy then: which options have one is known from the policy.
    """
    try:
        yield
    except UserError as error:
        if not word.startswith("-"):
            raise
        raise UserError(f"{error}; the policy comes before {word}") from error


def _environment(policy: str, known: argparse.Namespace) -> Component:
    from trainers.evaluation import find_run  # noqa: PLC0415

    _, run = find_run(policy, (), known.results_dir, trust=known.trust)
    return run.environment


def _add_options(parser: argparse.ArgumentParser, environment: Component) -> None:
    """Adds what an environment offers."""
    from envs.evaluation import RunFileOption  # noqa: PLC0415

    group = parser.add_argument_group(f"options of the environment {environment.name!r}")
    for option in environment.cls.evaluation_options:
        takes: dict[str, Any] = {"action": "store_true"}
        if isinstance(option, RunFileOption):
            takes = {"metavar": "VALUE"}
        # Kept under its flag as it stands, where no option of evaluation's own can be in its way.
        about = {"dest": option.flag, "help": option.help.replace("%", "%%")}
        try:
            group.add_argument(option.flag, **about, **takes)
        except argparse.ArgumentError as error:
            raise UserError(
                f"the environment {environment.name!r} offers an option that there is already: "
                f"{option.flag}"
            ) from error


def _resolved(
    options: argparse.Namespace, offered: Sequence[EvaluationOption]
) -> argparse.Namespace:
    """The options, with what those of the environment mean in the place of them."""
    from envs.evaluation import RunFileOption  # noqa: PLC0415

    options.check = options.window = False
    for option in offered:
        given = vars(options)[option.flag]
        if isinstance(option, RunFileOption):
            options.overrides += [] if given is None else [f"{option.key}={given}"]
        elif given:
            options.check, options.window = True, options.window or option.window
    return options


def _flags(options: argparse.Namespace) -> list[str]:
    return ["--help", *(f"--{name.replace('_', '-')}" for name in vars(options))]


def _refuse(unknown: Sequence[str], flags: Sequence[str]) -> None:
    """Names the options that come nearest.

    Raises:
        UserError: always.
    """
    flag = next(word for word in unknown if word.startswith("-")).partition("=")[0]
    raise UserError(f"unknown option {flag}; {suggestion(flag, flags)}")


def table(name: str, evaluation: Evaluation) -> Table:
    """The figures for people."""
    from rich.table import Table  # noqa: PLC0415

    from envs.evaluation import Figure  # noqa: PLC0415
    from trainers.reporting.figures import figure_values  # noqa: PLC0415

    report = evaluation.report
    result = Table(title=f"{name}: {report['episodes']} episodes, seed {report['seed']}")
    result.add_column("figure")
    result.add_column("value", justify="right")
    result.add_column("better")
    for key, part, value in figure_values(report):
        figure = evaluation.figures.get(key, Figure(key, key.replace("_", " "), better=None))
        label = f"{figure.label}, {part}".replace("_", " ") if part else figure.label
        result.add_row(label, figure.shown(value), figure.better or "")
    return result


def _write(path: Path, report: dict[str, Any]) -> None:
    try:
        write_atomically(path, json.dumps(report, indent=2) + "\n")
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error


def folder(text: str) -> str:
    """A command line's folder.

    Raises:
        argparse.ArgumentTypeError: it is a KEY=VALUE, which was meant for the run file.
    """
    if "=" in text:
        raise argparse.ArgumentTypeError(f"{text} is taken for its DIR: write it before --render")
    return text


if __name__ == "__main__":
    sys.exit(main())
