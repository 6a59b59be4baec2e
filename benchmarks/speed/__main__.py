"""How fast everything is, side by side with its peers: `python -m benchmarks.speed`.

Simulators and environments are compared with PyBullet's, the training loop with Stable-Baselines3's
PPO on the same environment. All are measured in turn in one run: the median over the rounds counts,
and the slowest and the fastest round are shown beside it. All of it takes about an hour, most of
which is training on the largest images; `--sizes 80` takes minutes. The part `limits` compares the
simulator's pieces and the updates with what the machine can do, in some two minutes.

With `--device cuda` the run files of `config/` are measured on the CPU and on that device instead,
in some three minutes.

With `--track FILE` a fixed set is measured instead, in some two minutes, and added to the file as
one line of JSON. What fell by more than 10 % since the last line of a like machine is said, and the
exit code is 1 if that is a ratio to a peer; speeds alone move with whatever else a machine does.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from benchmarks.command import EXTRA, missing
from trainers.common import process
from trainers.common.command import require_extra, tells_failures

PARTS = ("simulator", "environment", "training", "memory", "runs", "limits")
SIZES = (32, 80, 128, 256)
# A batch is 512 transitions, and there are 32 of each environment in a buffer.
MIN_ENVS = 16


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, and prints tables or tracks a history."""
    options = parse(arguments)
    process.prepare()  # as `trainers.learn` does, and before torch is imported
    from benchmarks.speed.parts import PARTS as MEASURES  # noqa: PLC0415
    from benchmarks.speed.track import track  # noqa: PLC0415
    from benchmarks.speed.training import PEER_PACKAGES  # noqa: PLC0415

    if options.track is not None:
        require_extra(EXTRA, *PEER_PACKAGES)
        return track(options.track)
    if missing(*PEER_PACKAGES) and {"training", "memory"} & set(options.parts):
        print(
            "stable_baselines3 is not installed, training is measured without it: pip install "
            f"'ventosa[{EXTRA}]'"
        )
    for part in options.parts:
        Console().print(MEASURES[part](options))
    return 0


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--parts", nargs="+", choices=PARTS, help="default: all; with --device: runs"
    )
    parser.add_argument("--device", default="cpu", help="of the part `runs`, beside the CPU")
    parser.add_argument("--sizes", type=int, nargs="+", choices=SIZES, default=SIZES, help="pixels")
    parser.add_argument(
        "--num-envs",
        type=int,
        default=256,
        metavar="N",
        help="worlds and environments; environments are measured with N/4 (PyBullet's) and 4N, too",
    )
    parser.add_argument(
        "--ranks",
        type=int,
        default=1,
        metavar="K",
        help="of the part `training`: torchrun's processes of ventosa, a thread of torch each",
    )
    parser.add_argument("--repeats", type=int, default=3, help="rounds, of which the median counts")
    parser.add_argument("--seconds", type=float, default=2.0, help="of a measurement, at least")
    parser.add_argument("--track", type=Path, metavar="FILE", help="add a line to this history")
    options = parser.parse_args(arguments)
    options.parts = options.parts or (PARTS if options.device == "cpu" else ("runs",))
    if options.num_envs % max(options.ranks, 1):
        parser.error(f"--ranks {options.ranks} must divide --num-envs {options.num_envs}")
    for name, least in (("num_envs", MIN_ENVS), ("ranks", 1), ("repeats", 1)):
        if getattr(options, name) < least:
            parser.error(f"--{name.replace('_', '-')} must be at least {least}")
    return options


if __name__ == "__main__":
    raise SystemExit(main())
