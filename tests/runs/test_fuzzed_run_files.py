"""Bad run files, made at random from good ones: each is refused in a line, or it trains."""

from __future__ import annotations

import contextlib
import copy
import io
import os
import random
import resource
import shutil
import signal
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from trainers.common.command import DONE, FAILED, MISTAKE, TERMINATED
from trainers.learn import main
from trainers.runfile.registry import Registries
from trainers.runfile.settings import load_run, resolved
from trainers.runfile.yaml_document import dump

CONFIG = Path(__file__).parents[2] / "config"
FILES = sorted(
    path
    for path in CONFIG.rglob("*.yaml")
    # Those are no run files, and the paper's sizes are one run at several costs.
    if path.parent.name != "sweeps" and not path.name.startswith("size_")
)
NEEDS_NO_EXTRA = {True: "CartPole-v1", False: "Pendulum-v1"}
"""Environments of gymnasium's own in place of those that need a package: by discrete actions."""

QUICK = CONFIG / "quick.yaml"
OTHERS = [
    *((QUICK, [f"encoders.depth={{type: {name}}}"]) for name in ("simple", "resnet")),
    (QUICK, ["encoders.depth={type: fully_connected, num_layers: 2, hidden_units: 8}"]),
    (QUICK, ["encoders.depth={type: conv, layers: [[4, 8, 4], [4, 3, 2]]}"]),
    (QUICK, ["encoders.depth={type: keypoints}", "trainer.network_settings.memory={type: gru}"]),
    (CONFIG / "run.yaml", ["environment.cameras.above={type: rgb, width: 40, height: 40}"]),
]
"""What none of the run files has, to be spoilt as well: a file and what is other in it."""

SAMPLE = 50
STOP_AFTER_CPU_S = 1.5
MOST_CPU_S = 10.0
ROOM_BYTES = 6 * 2**30

INTEGERS = (
    *(-1, 0, 1, 2, 3, 5, 17, 100, 10**4, 10**5, 10**6, 10**9),
    *(2**31, 2**53, 2**62, 2**63, 10**309),
)
FLOATS = (
    *(-1e9, -1.0, 0.0, 1e-300, 1e-9, 0.3, 0.999, 1.0, 1.5, 45.0, 1e4, 1e38, 1e300),
    *(float("inf"), float("-inf"), float("nan")),
)
ODD: tuple[Any, ...] = (
    *(None, True, False, "", "x", "é\0", "null", "a" * 5000, "../..", "1e3", [], {}, [[]], [{}]),
    *([1, 2], [2.0, 1.0], [0, 0, 1, 1], {"type": "x"}, {"x": 1}, {"type": []}, ["L"]),
    {"sampler_type": "gaussian", "sampler_parameters": {"mean": 1e300, "st_dev": 1e300}},
    {"sampler_type": "uniform", "sampler_parameters": {"min_value": 0.02, "max_value": 1e308}},
    {"type": "linear"},
    {"type": "lstm", "memory_size": 10**6},
)
TEXTS = (
    *("!!python/object:os.system x", "!unknown [1]", "!!binary aGk=", "!!set {a}", "!!timestamp 1"),
    *("*nowhere", "&a [*a]", "0x" + "f" * 400, "9" * 5000, "-0o17", "? [1]", "{1: 2}", "{{}: 1}"),
    *('"\\ud800"', "[" * 3000, "{<<: 1}", "{<<: [1]}", "!!int x", "!!float []", "\t", "%", "|"),
    *("{a: 1, a: 2}", "2026-01-01", "1_000", ".inf", "-.NaN", "!!str 5", "[" * 120 + "]" * 120),
)
"""Put in the place of a value in the text of a file."""


class TookTooLongError(BaseException):
    """A run file kept the process busy for too long; no `except Exception` takes it for its own."""


@pytest.fixture(scope="session")
def good(registries: Registries) -> list[dict[str, Any]]:
    """The run files that ventosa brings along, in full, made small enough to train in no time."""
    whole = [resolved(load_run(path, [], registries)) for path in FILES]
    whole += [resolved(load_run(*other, registries)) for other in OTHERS]
    return [_small(run) for run in whole]


@pytest.fixture(scope="session")
def trained(
    good: list[dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> list[dict[str, Any]]:
    """The same, which all train, without a limit of time: loops are compiled."""
    path = tmp_path_factory.mktemp("good") / "run.yaml"
    for run in good:
        path.write_text(dump(run))
        assert main([str(path), "--force", "--results-dir", str(path.parent / "results")]) == DONE
    return good


def _small(run: dict[str, Any]) -> dict[str, Any]:
    environment, trainer = run["environment"], run["trainer"]
    environment["num_envs"] = 2
    if environment["type"] == "gymnasium":
        environment["id"] = NEEDS_NO_EXTRA[environment["id"].startswith(("CartPole", "Lunar"))]
        environment["kwargs"] = {}
        if trainer["trainer_type"] == "ddpg":
            environment["id"] = "Pendulum-v1"
    else:
        environment |= {"simulator": "fast", "workers": 0, "episode_steps": 2}
    trainer |= {"max_steps": 4, "summary_freq": 2, "checkpoint_interval": 100}
    sizes = {"batch_size": 4, "buffer_size": 8, "num_epoch": 1, "buffer_init_steps": 4}
    sizes |= {"updates_per_step": 0.5, "policy_delay": 1, "cg_iterations": 2}
    hyper = trainer["hyperparameters"]
    hyper |= {key: value for key, value in sizes.items() if key in hyper}
    trainer["network_settings"]["hidden_units"] = 8
    if "time_horizon" in trainer:
        trainer["time_horizon"] = 2
    if run["curriculum"]:
        run["curriculum"] |= {"count": 3}
    if run["evaluation"]:
        run["evaluation"] |= {"interval": 100, "episodes": 2}
    return run


def places(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all values."""
    if path:
        yield path
    if isinstance(data, dict):
        for key, value in data.items():
            yield from places(value, (*path, key))
    elif isinstance(data, list):
        for index, value in enumerate(data):
            yield from places(value, (*path, index))


def at(data: Any, path: tuple[Any, ...]) -> Any:
    for step in path:
        data = data[step]
    return data


def put(data: Any, path: tuple[Any, ...], value: Any) -> None:
    at(data, path[:-1])[path[-1]] = value


def spoil(run: dict[str, Any], good: list[dict[str, Any]], rng: random.Random) -> None:
    """Changes one thing."""
    path = rng.choice(list(places(run)))
    value = at(run, path)
    match rng.randrange(14):
        case 0 if isinstance(at(run, path[:-1]), dict):
            put(run, (*path[:-1], f"{path[-1]}{rng.choice(('s', '', '.x', ' '))}"), value)
        case 1:
            del at(run, path[:-1])[path[-1]]
        case 2 if isinstance(value, list):
            value.append(copy.deepcopy(rng.choice(value or [1])))
        case 3 | 4 | 5:
            graft(run, rng.choice(good), rng)
        case 6:
            put(run, path, rng.choice((*ODD, *INTEGERS, *FLOATS)))
        case _:
            put(run, path, other_value(value, rng))


def graft(run: dict[str, Any], other: dict[str, Any], rng: random.Random) -> None:
    """Puts a part of another run file in its place in this one, if there is such a place."""
    path = rng.choice([path for path in places(other) if len(path) <= 3])
    with contextlib.suppress(LookupError, TypeError):
        put(run, path, copy.deepcopy(at(other, path)))


def other_value(value: Any, rng: random.Random) -> Any:
    """Something of the same type, or a number times a power of ten."""
    match value:
        case bool():
            return not value
        case int():
            return rng.choice((*INTEGERS, value * 10 ** rng.randrange(1, 13)))
        case float():
            return rng.choice((*FLOATS, value * 10.0 ** rng.randrange(-12, 13)))
        case list():
            return [other_value(item, rng) for item in value]
        case dict():
            return {key: other_value(item, rng) for key, item in value.items()}
    return rng.choice(ODD)


def bad_text(good: list[dict[str, Any]], seed: int) -> str:
    """The run file of a seed."""
    rng = random.Random(seed)
    run = copy.deepcopy(rng.choice(good))
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        spoil(run, good, rng)
    if rng.random() > 0.15:
        return dump(run)
    run_of_text = dump(_marked(run, rng))
    return run_of_text.replace("HERE", rng.choice(TEXTS), 1)


def _marked(run: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    put(run, rng.choice(list(places(run))), "HERE")
    return run


@contextlib.contextmanager
def limits() -> Iterator[None]:
    """Bounds what this process may use: some more memory than now, and some time.

    A signal asks the run to stop after a while, as a user's would.
    """

    def stop(*_: Any) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    def give_up(*_: Any) -> None:
        raise TookTooLongError

    now = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    before, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (now + ROOM_BYTES, hard))
    timers = {
        signal.SIGVTALRM: (signal.ITIMER_VIRTUAL, stop, STOP_AFTER_CPU_S),
        signal.SIGPROF: (signal.ITIMER_PROF, give_up, MOST_CPU_S),
    }
    handlers = {number: signal.signal(number, act) for number, (_, act, _) in timers.items()}
    # Before a run hears signals, and when it does no more, one would end all tests.
    unheard = signal.signal(signal.SIGTERM, lambda *_: None)
    for timer, _, seconds in timers.values():
        signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        for number, (timer, *_) in timers.items():
            signal.setitimer(timer, 0.0)
            signal.signal(number, handlers[number])
        signal.signal(signal.SIGTERM, unheard)
        resource.setrlimit(resource.RLIMIT_AS, (before, hard))


def outcome(text: str, directory: Path) -> tuple[int, str]:
    """Exit code of `trainers.learn` for a run file, and what it says of errors."""
    path, errors = directory / "run.yaml", io.StringIO()
    path.write_text(text, errors="surrogatepass")
    arguments = [str(path), "--results-dir", str(directory / "results")]
    with limits(), contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(errors):
        code = main(arguments)
    return code, errors.getvalue()


def check(seed: int, good: list[dict[str, Any]], directory: Path) -> int:
    """Exit code for a seed's run file, which is one of those that README knows."""
    code, errors = outcome(bad_text(good, seed), directory)
    assert code in (DONE, FAILED, MISTAKE, TERMINATED)
    assert (code in (FAILED, MISTAKE)) == ("error: " in errors)
    assert "Traceback" not in errors
    return code


def test_a_sample(good: list[dict[str, Any]], tmp_path: Path) -> None:
    codes = Counter(_checked(range(SAMPLE), good, tmp_path))
    assert codes[DONE] + codes[TERMINATED] > SAMPLE / 10
    assert codes[MISTAKE] > SAMPLE / 2


@pytest.mark.soak
@pytest.mark.parametrize("first", range(0, 10_000, 500))
def test_ten_thousand(trained: list[dict[str, Any]], tmp_path: Path, first: int) -> None:
    _checked(range(first, first + 500), trained, tmp_path)


def _checked(seeds: range, good: list[dict[str, Any]], directory: Path) -> list[int]:
    codes = []
    for seed in seeds:
        own = directory / str(seed)
        own.mkdir()
        try:
            codes.append(check(seed, good, own))
        except BaseException as error:
            error.add_note(f"seed {seed}; `bad_text(good, {seed})` is its run file")
            raise
        shutil.rmtree(own)
    return codes
