"""One run from its run file to its end: what `trainers.learn` does between parsing and exiting."""

from __future__ import annotations

import argparse
import json
import logging
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext
from pathlib import Path

import torch

from envs.environment import EnvironmentFailure
from envs.memory import adding_up, machine_bytes
from trainers.algorithms.base import TrainerSettings
from trainers.common.averager import Averager
from trainers.common.command import told
from trainers.common.errors import UserError, first_lines
from trainers.common.files import write_atomically
from trainers.common.origin import blaming_plugins
from trainers.common.stopping import StopRequested
from trainers.common.timers import Timer, recording
from trainers.distributed.processes import restarts
from trainers.distributed.world import ALONE, World
from trainers.held_out import HeldOutEvaluation
from trainers.inference.construction import check_weights, load_weights
from trainers.inference.metadata import FILE as METADATA
from trainers.reporting.compilation import Compilation, telling_of_compilation
from trainers.reporting.event_log import RunLog
from trainers.reporting.overview import (
    aligned,
    memory,
    networks,
    parameter_count,
    policy_commands,
    resume_command,
    spaces,
)
from trainers.reporting.pace import Pace
from trainers.reporting.silent import SilentLog
from trainers.reporting.summary import LATEST, SINCE_SUMMARY, Summary
from trainers.reporting.terminal import make_display
from trainers.runfile.changes import changeable, changes
from trainers.runfile.registry import Registries, load_registries
from trainers.runfile.settings import RunSettings, dump_yaml, load_run, resolved
from trainers.runfile.trust import needs_trust
from trainers.saving.checkpoint import Checkpoints, Loaded
from trainers.saving.run_folder import (
    CHECKPOINTS,
    CONFIGURATION,
    begin,
    claim,
    find_checkpoint,
    has_checkpoints,
    run_name,
)
from trainers.saving.serialization import mismatch
from trainers.session import Session
from trainers.training import SCORING, Ending, Training

TIMERS = "timers.json"

_logger = logging.getLogger("ventosa")


def run_file(
    options: argparse.Namespace, stop_requested: Callable[[], bool], world: World = ALONE
) -> bool:
    """Trains as the command line asks for.

    Args:
        options: as `trainers.learn.parse` returns them.
        stop_requested: asked before every step of the environments.
        world: the processes that run it together.

    Returns:
        Whether the run is finished; False if it was stopped and saved.

    Raises:
        UserError: the user's mistake.
        Exception: the run can't go on; a note names its last checkpoint.
    """
    with world.together():
        run, registries = _load_run(options)
    world.check_same(f"the run file {options.config}", dump_yaml(run))
    settings = run.trainer.settings
    assert isinstance(settings, TrainerSettings)  # the registry sees to it
    run_id = run_name(options.config.stem if options.run_id is None else options.run_id)
    directory = options.results_dir / run_id
    checkpoints = Checkpoints(directory / CHECKPOINTS, settings.keep_checkpoints)
    options = _after_restart(options, directory)
    with ExitStack() as stack:
        compilation = stack.enter_context(telling_of_compilation(_tell))
        resumed = None
        with world.together():
            if world.writes:
                lock = claim(directory, resume=options.resume, force=options.force)
                stack.enter_context(closing(lock))
                resumed = _resumed(options, directory, checkpoints, run, registries)
        resumed = world.first(resumed)
        with world.together():
            session = stack.enter_context(closing(Session(run, registries, stop_requested, world)))
        try:
            # Nothing is replaced before it is certain that the run can begin.
            with world.together():
                notes = _start(session, options, resumed)
            if resumed is None:
                session.share_weights()
            start = session.env_runner.step_count
            held_out = stack.enter_context(_held_out(session, run, start, stop_requested))
        except StopRequested:
            return False  # there is nothing to save yet that is not saved
        if resumed is not None and (reason := _finished(resumed, settings, held_out)):
            print(f"{run_id}: finished already, at step {start} ({reason}): raise that to go on")
            return True
        with world.together():
            if world.writes:
                files = {CONFIGURATION: dump_yaml(run), METADATA: session.metadata.to_json()}
                begin(directory, files, resume=options.resume)
        _tell(*_banner(run, session, directory))
        pace = _pace(run, settings, start, held_out, compilation)
        ending = _learn(run, session, checkpoints, held_out, resumed, notes, pace)
        step = session.env_runner.step_count
        _tell(*_farewell(options, run, checkpoints, ending, step))
        return ending.finished


def _learn(
    run: RunSettings,
    session: Session,
    checkpoints: Checkpoints,
    held_out: HeldOutEvaluation | None,
    resumed: Loaded | None,
    notes: Sequence[str],
    pace: Pace,
) -> Ending:
    """Trains a session that can begin, and reports into its run's folder and on the terminal."""
    settings, start = run.trainer.settings, session.env_runner.step_count
    assert isinstance(settings, TrainerSettings)
    directory = checkpoints.directory.parent
    run_id, writes = directory.name, session.world.writes
    with (
        closing(_log(run, directory, start if resumed else None, writes)) as log,
        make_display(run_id, settings.max_steps, session.lesson_count, start) as display,
        _timers_written(directory) if writes else nullcontext(),
    ):
        log.text("configuration", f"```yaml\n{dump_yaml(run)}```", start)
        for note in notes:
            display.message(note)
        env = session.env_runner.env
        steps = (settings.max_steps, settings.summary_freq, start)
        summary = Summary(log, run_id, env, *steps, pace)
        tags = (*summary.compared_tags, *(held_out.tags if held_out is not None else ()))
        log.hyperparameters(resolved(run), tags)
        if held_out is not None:
            # A checkpoint has no score where its evaluation was cut off: it is made up for.
            if held_out.begins_due and (resumed is None or resumed.score is None):
                held_out.log(log)
            summary.note_evaluation(held_out.latest)
        if resumed is not None:
            summary.load_state_dict(resumed.state)
            summary.note_checkpoint(resumed.path)
        summary.status(session.position, "running")
        training = Training(
            session, settings, log, summary, checkpoints, display, held_out, resumed
        )
        return _train(training, session, summary, checkpoints)


def check_file(options: argparse.Namespace, stop_requested: Callable[[], bool]) -> bool:
    """Builds what the command line asks for, and prints what that is; writes nothing.

    Args:
        options: as `trainers.learn.parse` returns them.
        stop_requested: asked before every step of the evaluation.

    Returns:
        Whether all was built; False if that was stopped.

    Raises:
        UserError: the user's mistake: all those that keep a run from beginning.
    """
    run, registries = _load_run(options)
    with ExitStack() as stack:
        stack.enter_context(telling_of_compilation(_tell))
        needs = stack.enter_context(adding_up())
        session = stack.enter_context(closing(Session(run, registries, stop_requested)))
        try:
            notes = _start(session, options, None)
            stack.enter_context(_held_out(session, run, 0, stop_requested))
        except StopRequested:
            return False
        _tell(
            dump_yaml(run),
            *notes,
            *spaces(session.env_runner.env),
            *networks(session.algorithm.policy),
            *memory(needs, machine_bytes()),
            "all of it can be built; nothing was written",
        )
    return True


def _load_run(options: argparse.Namespace) -> tuple[RunSettings, Registries]:
    registries = load_registries()
    run = load_run(options.config, options.overrides + _flags(options), registries)
    for logger in run.loggers:
        logger.cls.check(logger.settings)
    return run, registries


def _tell(*lines: str) -> None:
    print(*lines, sep="\n", flush=True)


def _banner(run: RunSettings, session: Session, directory: Path) -> list[str]:
    """What is trained, on what, and where to watch it."""
    return aligned(
        {
            "environment": f"{run.environment.name}, {session.env_runner.num_envs} in parallel",
            "trainer": run.trainer.name,
            "parameters": f"{parameter_count(session.algorithm.policy):,}",
            "device": f"{run.device}, {torch.get_num_threads()} threads",
            "run folder": str(directory),
            "TensorBoard": f"tensorboard --logdir {shlex.quote(str(directory.parent))}",
        }
    )


def _farewell(
    options: argparse.Namespace,
    run: RunSettings,
    checkpoints: Checkpoints,
    ending: Ending,
    step: int,
) -> list[str]:
    """How a run ended, at that step, where everything is, and the commands to go on with."""
    best, settings = checkpoints.best, run.trainer.settings
    assert isinstance(settings, TrainerSettings)
    directory = checkpoints.directory.parent
    score = "" if best.score is None else f" ({best.score_of} {best.score:.3g})"
    entries = {
        "run folder": str(directory),
        "best": f"{best.path}{score}",
        **policy_commands(directory, trust=needs_trust(run)),
    }
    if not ending.finished:
        entries["go on"] = resume_command(options)
    elif step >= settings.max_steps:
        entries["train on"] = resume_command(options, 2 * settings.max_steps)
    return [f"finished: {ending.reason}" if ending.finished else ending.reason, *aligned(entries)]


def _pace(
    run: RunSettings,
    settings: TrainerSettings,
    start: int,
    held_out: HeldOutEvaluation | None,
    compilation: Compilation,
) -> Pace:
    """Estimates the time left; the first evaluation is none to go by if kernels were compiled."""
    if run.evaluation is None or held_out is None:
        return Pace(start, settings.max_steps)
    evaluation_s = 0.0 if compilation.happened else held_out.took_s
    return Pace(start, settings.max_steps, run.evaluation.interval, evaluation_s)


def _log(run: RunSettings, directory: Path, start: int | None, writes: bool) -> RunLog:
    if not writes:
        return SilentLog()
    loggers = {logger.name: (logger.cls, logger.settings) for logger in run.loggers}
    return RunLog(directory, start, loggers)


def _after_restart(options: argparse.Namespace, directory: Path) -> argparse.Namespace:
    """The command line of a run that torchrun has started again: it goes on where it was saved."""
    if not restarts():
        return options
    saved = has_checkpoints(directory)
    again = {"resume": True, "force": False, "initialize_from": None}
    return argparse.Namespace(**vars(options) | (again if saved else {"force": True}))


def _resumed(
    options: argparse.Namespace,
    directory: Path,
    checkpoints: Checkpoints,
    run: RunSettings,
    registries: Registries,
) -> Loaded | None:
    """The checkpoint to go on from; None where the run begins.

    Raises:
        UserError: there is none, or it is another run's.
    """
    if not options.resume:
        return None
    resumed = checkpoints.load_latest()
    _check_unchanged(directory, run, registries)
    return resumed


@contextmanager
def _timers_written(directory: Path) -> Iterator[None]:
    """Records where the time goes, and leaves it in the run's folder however the run ends."""
    root = Timer()
    try:
        with recording(root):
            yield
    finally:
        try:
            write_atomically(directory / TIMERS, json.dumps(root.tree(), indent=2) + "\n")
        except OSError as error:
            _logger.warning("%s", error)


@contextmanager
def _held_out(
    session: Session, run: RunSettings, start: int, stop_requested: Callable[[], bool]
) -> Iterator[HeldOutEvaluation | None]:
    """Evaluation while the run learns; None unless the run file asks for it."""
    if run.evaluation is None:
        yield None
        return
    with closing(
        HeldOutEvaluation(session, run, run.evaluation, start, stop_requested)
    ) as held_out:
        yield held_out


def _train(
    training: Training,
    session: Session,
    summary: Summary,
    checkpoints: Checkpoints,
) -> Ending:
    """Trains, and leaves the run's state in status.json however it ends."""
    state, reason = "failed", None
    try:
        with blaming_plugins():
            ending = training.run()
        state, reason = "finished" if ending.finished else "interrupted", ending.reason
        return ending
    except KeyboardInterrupt:
        state, reason = "interrupted", f"stopped at once; {_last_good(checkpoints)}"
        raise
    except Exception as error:
        error.add_note(_last_good(checkpoints))
        reason = told(error)
        raise
    finally:
        saved = checkpoints.list_checkpoints()
        if saved:
            summary.note_checkpoint(saved[-1].path)
        summary.status(session.position, state, reason)


def _last_good(checkpoints: Checkpoints) -> str:
    saved = checkpoints.list_checkpoints()
    if not saved:
        return "no checkpoint was saved yet"
    return f"the last good checkpoint is {saved[-1].path}"


def _check_unchanged(directory: Path, run: RunSettings, registries: Registries) -> None:
    """Sees to it that a run that is taken up is the one that was begun.

    Raises:
        UserError: it is another; or its run file can't be read.
    """
    begun = load_run(directory / CONFIGURATION, [], registries)
    if changed := changes(begun, run):
        lines = "".join(f"\n  {line}" for line in changed)
        raise UserError(
            f"{directory}: the run was begun with other settings:{lines}\n--resume goes on with "
            f"the run that was begun; only {', '.join(sorted(changeable(run)))} may change. To "
            f"begin another run with its weights, use --initialize-from {directory}"
        )


def _finished(
    resumed: Loaded, settings: TrainerSettings, held_out: HeldOutEvaluation | None
) -> str | None:
    """In words, why there is nothing left to do for a run that is taken up; None if there is."""
    if held_out is not None and resumed.score is None:
        return None  # its evaluation was cut off
    if resumed.step >= settings.max_steps:
        return f"trainer.max_steps: {settings.max_steps}"
    return held_out.target_reached if held_out is not None and held_out.begins_due else None


def _start(session: Session, options: argparse.Namespace, resumed: Loaded | None) -> list[str]:
    """Begins afresh, from other weights, or where the run stopped; returns what is to be said."""
    if resumed is not None:
        _go_on(session, resumed)
        return resumed.notes
    notes: list[str] = []
    if options.initialize_from:
        given = find_checkpoint(options.initialize_from, options.results_dir)
        try:
            load_weights(session.algorithm.policy, given.weights)
        except ValueError as error:
            raise UserError(
                f"--initialize-from {options.initialize_from}: these weights do not fit the run "
                f"file's networks: {error}. The {CONFIGURATION} that they "
                "came with has the observations and the networks that they are for"
            ) from error
        notes = [
            *given.notes,
            f"begins with all weights of {given.path}, and what the networks normalize "
            "observations by; optimizers, steps, lesson, replay buffer and random numbers are new",
        ]
    session.reset()
    return notes


def _go_on(session: Session, resumed: Loaded) -> None:
    """Takes a session to where the run stopped.

    Raises:
        UserError: the state does not fit it.
        EnvironmentFailure: its environments broke down.
    """
    session.reset()  # so that there is a state which the saved one should be like
    try:
        _load(session, resumed)
    except EnvironmentFailure as failure:
        raise EnvironmentFailure(f"{resumed.path}: when played again, {failure}") from failure
    except Exception as error:  # the state is a file's: it may be wrong in any way
        run = resumed.path.parents[1]
        raise UserError(
            f"{resumed.path}: the run can't go on from here: {type(error).__name__}: "
            f"{first_lines(error, 2)}. --resume needs the run file, and the version of ventosa, "
            f"that the run began with; to begin another run with its weights, use "
            f"--initialize-from {run}"
        ) from error


def _load(session: Session, resumed: Loaded) -> None:
    """Takes a session to a saved state.

    Raises:
        ValueError: the state is not of the session's kind, or of another step than it is said to
            be; whatever else a state leads to that is of the right kind, and doesn't fit.
    """
    state = session.own_state(resumed.state)
    averagers = {name: Averager() for name in (SCORING, SINCE_SUMMARY, LATEST)}
    means = {name: averager.state_dict() for name, averager in averagers.items()}
    own = {"step": 0, **means, **session.state_dict()}
    weights = session.algorithm.policy.current_weights(resumed.weights)
    if wrong := mismatch(state, own) or mismatch(weights, session.weights(), "weights"):
        raise ValueError(wrong)
    session.load_state_dict(weights, state)
    check_weights(session.algorithm.policy)
    steps = {state["step"], session.env_runner.step_count, resumed.step}
    if len(steps) > 1:
        raise ValueError(f"it is said to be of several steps: {', '.join(map(str, sorted(steps)))}")
    for name in averagers.keys() & state.keys():  # not all are in those of former versions
        averagers[name].load_state_dict(state[name])


def _flags(options: argparse.Namespace) -> list[str]:
    """The command line's flags that stand for keys of the run file."""
    flags = {
        "seed": options.seed,
        "environment.num_envs": options.num_envs,
        "device": options.device,
    }
    return [f"{key}={value}" for key, value in flags.items() if value is not None]
