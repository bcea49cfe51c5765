"""Run an evaluation: check everything, then roll out what is not done yet, and never lose a row."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from robomme_interference_data.data.buffer_set import Split
from robomme_interference_data.data.loading import load_split
from robomme_interference_data.errors import (
    InterferenceError,
    ServerDiedError,
    ServerKeepaliveError,
    SimulatorCrashError,
)
from robomme_interference_data.evaluate.policies.identity import (
    check_kind,
    describe_policy,
    describe_served,
    hold_servers,
    plain,
)
from robomme_interference_data.evaluate.policies.registry import pin_policy, served_policy
from robomme_interference_data.evaluate.rollout.worker import RolloutTask
from robomme_interference_data.evaluate.subgoals.registry import describe_subgoals, pin_subgoals
from robomme_interference_data.evaluate.systems import name_system
from robomme_interference_data.runtime.executor import (
    Executor,
    Outcome,
    Task,
    end_if_starting,
    make_executor,
)
from robomme_interference_data.schema.rollouts import Rollout, Status
from robomme_interference_data.simulators.registry import simulator_versions
from robomme_interference_data.storage.files import atomic_path

from .checks import (
    applicable,
    check_plan,
    check_settings,
    check_simulator,
    default_system,
)
from .config import AskConfig, Run, RunConfig
from .identity import now, run_identity, start_of
from .log import (
    RunLog,
    clip_name,
    count_statuses,
    is_done,
    open_log,
    read_record,
)
from .plan import WorkItem, plan_work, shuffle_work

_ERROR_LETTERS = 2000
"""Most letters of what broke that a row has."""


@dataclass(frozen=True)
class RunResult:
    """What a run came to.

    Attributes:
        rows: Rows of all rollouts that were asked for and have ended, in canonical order.
        planned: Rollouts that were asked for.
        counts: Rows by status.
        stopped: Why the run ended early, or None.
    """

    folder: Path
    rows: tuple[Rollout, ...]
    planned: int
    counts: dict[str, int]
    stopped: str | None


class Listener(Protocol):
    """Hears how a run goes, to show it."""

    def start(self, items: Sequence[WorkItem], done: Sequence[Rollout]) -> None:
        """Take what was asked for, and the rows that an earlier run finished."""

    def row(self, row: Rollout, node: str | None) -> None:
        """Take a row that has just been written, and the node of a cluster that it is from."""


def run_evaluation(
    config: RunConfig,
    *,
    executor: Executor | None = None,
    listener: Listener | None = None,
    command: Sequence[str] = (),
) -> RunResult:
    """Roll out a policy under the benchmark's protocol and write one row per rollout.

    Rows are on the disk as rollouts end. Run again with the same `out`, it skips finished
    rollouts, repeats errors, and adds what is newly asked for.

    Worker processes import the script that runs: call it under `if __name__ == "__main__":`.

    Args:
        config: What to roll out, and how.
        executor: Who runs the rollouts; by default what `config` says.
        listener: Hears how the run goes.
        command: The command line, for the record.

    Raises:
        UnknownNameError, InvalidOptionError, InvalidIdError: A setting is not what it may be.
        HistoryTooLongError: A buffer exceeds the system's position limit.
        MissingFileError: The split is not there.
        RunFolderError: `out` holds another run, or something else.
        PolicyError: The policy cannot be made.
        PolicyServerError: A policy server cannot be reached, or no longer any of them; another run
            drives it; or it is not what the system's is.
        WorkerError: The worker processes cannot start.
        HubError: The Hub does not know the policy's model, or cannot be reached.
        FormatError: Files of a run in `out` are damaged.
    """
    end_if_starting()
    split, folder = load_split(config.split), Path(config.out)
    config = dataclasses.replace(config, policy=served_policy(config.policy, config.serve))
    name = config.system or default_system(config)
    # One commit for all workers: of the split, if it is on the Hub, and of models.
    config = dataclasses.replace(
        config,
        policy=pin_policy(config.policy),
        subgoals=pin_subgoals(config.subgoals),
        split=split.location,
    )
    with hold_servers(config.policy, folder):
        policy, said = describe_policy(config.policy, config.policy_options, workers=config.workers)
        check_settings(config, name, split, policy)
        system = name_system(name)
        config, written = describe_subgoals(config, system)
        plan = plan_work(
            split.episode_ids,
            conditions=config.conditions or applicable(config, system, split, policy),
            families=config.families,
            episodes=config.episodes,
            episode_split=config.episode_split,
            shard=config.shard,
        )
        items = check_plan(config, system, split, policy, plan)
        executor = executor or make_executor(config)
        there = read_record(folder)
        if any(item not in there or not is_done(there[item]) for item in items):
            check_simulator(config, policy.cameras, executor)
            check_kind(config.policy, config.policy_options, system)
        if config.serve is not None:
            said = describe_served(config.policy, config.policy_options, system, executor)
        versions = simulator_versions(config.simulator, config.robomme_python)
        identity = run_identity(config, name, split, plan, said, written, versions)
        with open_log(folder, identity, split.name, resume=not config.no_resume) as log:
            # The same split may be in another folder by now: rows keep one label for it.
            run = Run(config, name, log.header.split, split.revision)
            log.begin(start_of(config, plan, said | written, versions, command))
            return run_items(run, RolloutTask(run, said), items, split, log, executor, listener)


def run_items[C: RunConfig | AskConfig](
    run: Run[C],
    task: Task,
    items: Sequence[WorkItem],
    split: Split,
    log: RunLog,
    executor: Executor,
    listener: Listener | None,
) -> RunResult:
    """Do what is not done yet, and write its rows as they come.

    Args:
        run: The run.
        task: Makes an item's row, and hands in what is written beside it; also returns what befell
            that, or None.
        items: What was asked for, checked.
        split: The split.
        log: The run's folder.
        executor: Who does it.
        listener: Hears how it goes.
    """
    done = {item: row for item, row in log.rows.items() if is_done(row)}
    if listener is not None:
        listener.start(items, [done[item] for item in items if item in done])
    outcomes = executor.run(
        task,
        shuffle_work(item for item in items if item not in done),
        time_limit=run.config.rollout_timeout,
        again=(SimulatorCrashError, ServerKeepaliveError, ServerDiedError),
    )
    stopped: str | None = "interrupted"
    errors, full = 0, False
    try:
        for outcome in outcomes:
            row, trace = _row(run, outcome, split, log)
            log.append(row, trace)
            if listener is not None:
                listener.row(row, outcome.node)
            errors = 0 if is_done(row) else errors + 1
            if errors >= run.config.max_errors:
                stopped = f"{errors} in a row broke; the last: {row.error}"
                break
        else:
            stopped = None
    except InterferenceError as error:  # no worker is left
        stopped = error.message
        raise
    except OSError:  # what cannot take a row cannot take tables
        full = True
        raise
    finally:
        outcomes.close()
        *earlier, last = log.header.starts
        last = dataclasses.replace(last, ended=now(), stopped=stopped)
        if not full:
            log.end(dataclasses.replace(log.header, starts=(*earlier, last)))
    rows = tuple(log.rows[item] for item in items if item in log.rows)
    return RunResult(log.folder, rows, len(items), count_statuses(rows), stopped)


def _row[C: RunConfig | AskConfig](
    run: Run[C], outcome: Outcome, split: Split, log: RunLog
) -> tuple[Rollout, str | None]:
    """Write what an outcome's task handed in; return its row, with its attempt and time.

    And what broke, with its traceback, or None.
    """
    item: WorkItem = outcome.task
    if outcome.error is None:
        row, trace = outcome.value
    else:
        trace = outcome.trace
        query = split.query(item.episode)
        row = run.row(
            item,
            seed=query.seed,
            difficulty=query.difficulty,
            goal=None,
            status=str(Status.ERROR),
            success=None,
            steps=0,
            history_frames=0,
            lesson_frames=0,
            lesson_share=None,
            error=_told(outcome.error),
        )
    clip = clip_name(item)
    (log.folder / clip).unlink(missing_ok=True)  # of an earlier attempt
    # Rows matter more than what is to be looked at beside them: a full disk costs a clip.
    lost = [problem for one in outcome.files.items() if (problem := _write(log.folder, *one))]
    row = dataclasses.replace(
        row,
        video=clip if (log.folder / clip).exists() else None,
        attempt=(log.rows[item].attempt if item in log.rows else 0) + outcome.attempts,
        finished_at=now(),
    )
    return row, "\n".join(filter(None, (trace, *lost))) or None


def _write(folder: Path, path: str, data: bytes) -> str | None:
    """Write a file that a task handed in, whole or not at all; return what went wrong, or None."""
    try:
        with atomic_path(folder / path) as partial:
            partial.write_bytes(data)
    except OSError as error:
        return f"{path} could not be written: {error}"
    return None


def _told(error: BaseException) -> str:
    """Return what an error says in one line, with its hint, as text that any file can hold."""
    text = str(error)
    if isinstance(error, InterferenceError):
        hint = f" ({error.hint})" if error.hint else ""
        text = f"{type(error).__name__}: {error.message}{hint}"
    return str(plain(" ".join(text.split())[:_ERROR_LETTERS]))
