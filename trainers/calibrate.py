"""The command line: `python -m trainers.calibrate results/run`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from trainers.calibration import calibrate
from trainers.common.command import DONE, tells_failures
from trainers.evaluate import add_trust_option, positive, seed_number
from trainers.inference.confidence import NEVER, Card, Measured

EPISODES = 80_000


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Calibrates a policy; returns the exit code."""
    options = parse(arguments)
    path, card = calibrate(
        options.policy,
        episodes=options.episodes,
        seed=options.seed,
        results_dir=options.results_dir,
        trust=options.trust,
    )
    print(f"{path}: {card.episodes} episodes, seed {card.seed}")
    print("\n".join(told(card)))
    return DONE


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m trainers.calibrate",
        description="Learn how sure a trained policy is of its first actions, from episodes never "
        "used for training, and store that beside its weights.",
    )
    parser.add_argument(
        "policy", help="a run (its best checkpoint), a checkpoint's or an exported folder"
    )
    parser.add_argument(
        "--episodes", type=positive, default=EPISODES, help="how many (default: %(default)s)"
    )
    parser.add_argument("--seed", type=seed_number, default=0, help="of the episodes")
    add_trust_option(parser)
    parser.add_argument(
        "--results-dir", type=Path, default=Path("results"), help="where runs are kept"
    )
    return parser.parse_args(arguments)


def told(card: Card) -> Iterator[str]:
    """What a card says, in lines."""
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
        yield from _measured(card.measured)


def _measured(measured: Measured) -> Iterator[str]:
    for name, counts in {"as trained": measured.ordinary, **measured.harder}.items():
        right = f", of which {counts.sure_right / counts.sure:.2%} right" if counts.sure else ""
        yield (
            f"  {name}: {counts.right / counts.actions:.2%} of {counts.actions} right; "
            f"sure {counts.sure / counts.actions:.2%}{right}"
        )
    for kind, counts in measured.unanswerable.items():
        yield f"  {kind}: sure {counts.sure} of {counts.actions}"


if __name__ == "__main__":
    sys.exit(main())
