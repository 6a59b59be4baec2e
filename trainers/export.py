"""The command line: `python -m trainers.export results/run policies/mine`, or to one ONNX file."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from trainers.common.command import DONE, tells_failures
from trainers.common.errors import UserError
from trainers.common.options import add_results_option, add_trust_option, command_parser
from trainers.inference.real_camera import add_camera_options

FOLDER, ONNX = "folder", "onnx"


@tells_failures
def main(arguments: Sequence[str] | None = None) -> int:
    """Exports a policy; returns the exit code."""
    options = parse(arguments)
    # Imported late, so that `--help` answers at once.
    from trainers.deployment.exporting import export, export_onnx  # noqa: PLC0415
    from trainers.evaluation import find_run  # noqa: PLC0415
    from trainers.inference.onnx_policy import is_onnx  # noqa: PLC0415

    if options.trust:
        find_run(options.policy, (), options.results_dir, trust=True)
    if options.format == ONNX or is_onnx(options.folder):
        print("\n".join(export_onnx(options)))
    else:
        _refuse_camera(options)
        written = export(options.policy, options.folder, options.results_dir, force=options.force)
        print(f"{options.folder}: {', '.join(written)}")
    return DONE


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = command_parser(
        "export",
        description="Write what it takes to use a policy into a folder of its own, or one file.",
    )
    parser.add_argument("policy", help="a run (its best checkpoint) or a checkpoint's folder")
    parser.add_argument("folder", type=Path, help="where to; or a file FILE.onnx")
    parser.add_argument(
        "--format",
        choices=(FOLDER, ONNX),
        default=FOLDER,
        help="a folder of weights and run file, or FOLDER/policy.onnx, which needs no torch",
    )
    add_camera_options(parser)
    parser.add_argument("--force", action="store_true", help="replace a policy that is there")
    add_trust_option(parser)
    add_results_option(parser)
    return parser.parse_args(arguments)


def _refuse_camera(options: argparse.Namespace) -> None:
    if options.camera is not None or options.unit is not None:
        raise UserError("--camera and --unit are for --format onnx: a folder has neither")


if __name__ == "__main__":
    sys.exit(main())
