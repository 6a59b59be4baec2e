"""How fast the grasp environment is under random actions: `python -m benchmarks.throughput`."""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from envs.grasp.env import make_vector_env
from envs.grasp.settings import Camera
from rewards.plugin import ventosa_rewards

MODES = {"frame grab": True, "stream": False}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints a table, and writes JSON where asked."""
    options = parse(arguments)
    rows = [
        measure(mode, size, num_envs, options)
        for size in options.sizes
        for mode in MODES
        for num_envs in options.num_envs
    ]
    report = {"cores": len(os.sched_getaffinity(0)), "simulator": options.simulator, "rows": rows}
    if options.json is not None:
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    Console().print(table(report))
    return 0


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.throughput", description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[80], help="image sides in pixels")
    parser.add_argument("--num-envs", type=int, nargs="+", default=[64])
    parser.add_argument("--simulator", choices=("pybullet", "fast"), default="pybullet")
    parser.add_argument("--repeats", type=int, default=5, help="the median of them is reported")
    parser.add_argument("--seconds", type=float, default=5.0, help="of one repeat, at least")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here, too")
    return parser.parse_args(arguments)


def measure(mode: str, size: int, num_envs: int, options: argparse.Namespace) -> dict[str, Any]:
    """Environment steps and frames per second of one configuration, all rewards computed."""
    env = make_vector_env(
        num_envs,
        rewards=dict.fromkeys(ventosa_rewards(), 1.0),
        cameras={"depth": Camera(type="depth", width=size, height=size)},
        frame_grab=MODES[mode],
        simulator=options.simulator,
    )
    rng, stream = np.random.default_rng(0), not MODES[mode]
    speeds = []
    try:
        env.reset()
        play(env, rng, 1.0, stream=stream)
        for _ in range(options.repeats):
            speeds.append(play(env, rng, options.seconds, stream=stream))
    finally:
        env.close()
    steps, frames = (statistics.median(values) for values in zip(*speeds, strict=True))
    slowest, fastest = min(speed for speed, _ in speeds), max(speed for speed, _ in speeds)
    return {
        "mode": mode,
        "size": size,
        "num_envs": num_envs,
        "steps_per_second": steps,
        "steps_per_second_range": [slowest, fastest],
        "frames_per_second": frames,
    }


def play(
    env: Any, rng: np.random.Generator, seconds: float, *, stream: bool
) -> tuple[float, float]:
    """Takes random actions for a while; returns steps and frames per second.

    A stream has two frames where an episode ends: its last, and the first of the next.
    """
    start, steps, frames = time.perf_counter(), 0, 0
    while (elapsed := time.perf_counter() - start) < seconds:
        *_, infos = env.step(rng.uniform(-1.0, 1.0, (env.num_envs, 4)))
        steps += env.num_envs
        frames += int(np.count_nonzero(~infos["same_frame"]))
        if stream and "_final_obs" in infos:
            frames += int(np.count_nonzero(infos["_final_obs"]))
    return steps / elapsed, frames / elapsed


def table(report: dict[str, Any]) -> Table:
    """The figures for people."""
    result = Table(title=f"{report['simulator']}, {report['cores']} cores, random actions")
    for column in ("mode", "image", "environments", "steps/s (min to max)", "frames/s"):
        result.add_column(column, justify="left" if column == "mode" else "right")
    for row in report["rows"]:
        low, high = row["steps_per_second_range"]
        result.add_row(
            row["mode"],
            f"{row['size']}x{row['size']}",
            str(row["num_envs"]),
            f"{row['steps_per_second']:,.0f} ({low:,.0f} to {high:,.0f})",
            f"{row['frames_per_second']:,.0f}",
        )
    return result


if __name__ == "__main__":
    raise SystemExit(main())
