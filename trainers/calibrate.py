"""The command line: `python -m trainers.calibrate results/run`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from trainers.common import process
from trainers.common.command import DONE, tells_failures
from trainers.common.options import (
    add_results_option,
    add_trust_option,
    command_parser,
    positive,
    seed_number,
)

if TYPE_CHECKING:
    from trainers.inference.confidence import Card, Measured

EPISODES = 200_000


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Calibrates a policy; returns the exit code."""
    options = parse(arguments)
    process.prepare()
    # Imported late, so that `--help` answers at once.
    from trainers.deployment.calibration import calibrate  # noqa: PLC0415

    path, card = calibrate(
        options.policy,
        episodes=options.episodes,
        seed=options.seed,
        overrides=options.overrides,
        results_dir=options.results_dir,
        trust=options.trust,
    )
    print(f"{path}: {card.episodes} episodes, seed {card.seed}")
    print("\n".join(told(card)))
    return DONE


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = command_parser(
        "calibrate",
        description="Learn how sure a trained policy is of its first actions, from episodes never "
        "used for training, and store that beside its weights.",
    )
    parser.add_argument(
        "policy", help="a run (its best checkpoint), a checkpoint's or an exported folder"
    )
    parser.add_argument(
        "overrides",
        nargs="*",
        default=[],
        metavar="KEY=VALUE",
        help="a dotted path into the run's file, such as environment.randomize.surroundings=null: "
        "the promise is of that task (default: as trained)",
    )
    parser.add_argument("--episodes", type=positive, default=EPISODES, help="how many")
    parser.add_argument("--seed", type=seed_number, default=0, help="of the episodes")
    add_trust_option(parser)
    add_results_option(parser)
    return parser.parse_intermixed_args(arguments)


def told(card: Card) -> Iterator[str]:
    """What a card says, in lines."""
    from trainers.inference.confidence import NEVER  # noqa: PLC0415

    limits = ", ".join(error.shown(error.limit) for error in card.errors)
    yield f"right is at most: {limits}"
    if card.threshold == NEVER:
        yield (
            f"NOTHING IS SURE: {card.target:.1%} right could not be shown even of the surest "
            "quarter; the policy has to become better, or --episodes more"
        )
    else:
        yield f"sure is a probability of that of {card.threshold:.4f} or more"
    if card.measured is not None:
        yield f"wanted: {card.target:.1%} of the sure are right; measured in other episodes:"
        yield from _measured(card.measured, " ".join(card.overrides) or "as trained")


def _measured(measured: Measured, promised: str) -> Iterator[str]:
    for name, counts in {promised: measured.ordinary, **measured.harder}.items():
        right = f", of which {counts.sure_right / counts.sure:.2%} right" if counts.sure else ""
        yield (
            f"  {name}: {counts.right / counts.actions:.2%} of {counts.actions} right; "
            f"sure {counts.sure / counts.actions:.2%}{right}"
        )
    for kind, counts in measured.unanswerable.items():
        yield f"  {kind}: sure {counts.sure} of {counts.actions}"


if __name__ == "__main__":
    sys.exit(main())
