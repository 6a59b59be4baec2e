"""The command line: `python -m trainers.predict results/run image.png`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from trainers.common.command import DONE, tells_failures
from trainers.common.options import add_results_option, add_trust_option, command_parser
from trainers.inference.real_camera import add_camera_options


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Predicts; returns the exit code."""
    options = parse(arguments)
    # Imported late, so that `--help` answers at once.
    from trainers.deployment.prediction import predict  # noqa: PLC0415

    predictions = predict(options)
    if options.json:
        print(json.dumps([one.plain() for one in predictions], indent=2))
    else:
        print("\n".join(f"{one.file}: {one.caption()}" for one in predictions))
    return DONE


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = command_parser(
        "predict",
        description="Say what a policy does before images as a camera delivers them.",
    )
    parser.add_argument("policy", help="a run, a checkpoint's or an exported folder, or FILE.onnx")
    parser.add_argument("images", nargs="+", type=Path, metavar="IMAGE", help="PNG or .npy files")
    add_camera_options(parser)
    parser.add_argument("--json", action="store_true", help="for programs, in SI units")
    parser.add_argument(
        "--draw",
        type=Path,
        metavar="OUT",
        help="draw it over the image: a PNG for one image, a folder for several",
    )
    add_trust_option(parser)
    add_results_option(parser)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
