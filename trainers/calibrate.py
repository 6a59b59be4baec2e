"""The command line: `python -m trainers.calibrate results/run`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from envs.environment import EnvironmentFailure
from trainers.calibration import calibrate
from trainers.common.errors import UserError
from trainers.evaluate import positive, seed_number
from trainers.experience.env_runner import NonFiniteError
from trainers.inference.confidence import NEVER, Card, Measured
from trainers.learn import DONE, FAILED, MISTAKE

EPISODES = 80_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Calibrates a policy; returns the exit code."""
    options = parse(arguments)
    try:
        path, card = calibrate(
            options.policy,
            episodes=options.episodes,
            seed=options.seed,
            results_dir=options.results_dir,
        )
    except UserError as mistake:
        print(f"error: {mistake}", file=sys.stderr)
        return MISTAKE
    except (NonFiniteError, EnvironmentFailure) as failure:
        print(f"error: {failure}", file=sys.stderr)
        return FAILED
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
        yield from _measured(card.measured, card.target)


def _measured(measured: Measured, target: float) -> Iterator[str]:
    yield f"of {measured.episodes} unseen first actions {measured.right:.2%} are right"
    right = "none" if measured.sure_right is None else f"{measured.sure_right:.2%}"
    yield f"sure: {measured.coverage:.2%}, of which {right} are right (wanted: {target:.1%})"
    for kind, (count, sure) in measured.unanswerable.items():
        yield f"sure before {kind}: {sure} of {count}"


if __name__ == "__main__":
    sys.exit(main())
