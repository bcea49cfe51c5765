"""Run an evaluation: check everything, then roll out what is not done yet, and never lose a row."""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.evaluate.checks import (
    applicable,
    check_plan,
    check_settings,
    check_simulator,
    describe_policy,
)
from robomme_interference_data.evaluate.config import RunConfig, default_system, identity
from robomme_interference_data.evaluate.header import begun, ended, now, plan_record
from robomme_interference_data.evaluate.log import RunLog, open_log, read_log, summary
from robomme_interference_data.evaluate.plan import (
    WorkItem,
    parse_episodes,
    parse_shard,
    plan_work,
    select_families,
    shuffle_work,
    take_shard,
)
from robomme_interference_data.evaluate.policies.options import bind_options, policy_identity
from robomme_interference_data.evaluate.policies.registry import (
    parse_policy,
    pin_policy,
    policy_factory,
)
from robomme_interference_data.evaluate.retrieval import retrieval_identity
from robomme_interference_data.evaluate.rollout import base_row
from robomme_interference_data.evaluate.rows import KEY_COLUMNS, Rollout
from robomme_interference_data.evaluate.watchdog import last_words
from robomme_interference_data.evaluate.worker import RolloutWorker, error_row
from robomme_interference_data.loader import load_split
from robomme_interference_data.simulators.base import Status
from robomme_interference_data.simulators.registry import simulator_versions
from robomme_interference_data.workers import Outcome, end_if_starting, run_tasks

__all__ = ["Listener", "RunResult", "run_evaluation"]

_TABLES_S = 30.0
"""Seconds between two writings of the tables while a run goes on."""


@dataclass(frozen=True)
class RunResult:
    """What a run came to.

    Attributes:
        folder: The run's folder.
        rows: Rows of all rollouts that were asked for and have ended, in plan order.
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

    def start(self, plan: Sequence[WorkItem], done: Sequence[Rollout]) -> None:
        """Take the plan, and the rows that an earlier run finished."""
        ...

    def row(self, row: Rollout) -> None:
        """Take a row that has just been written."""
        ...


def run_evaluation(
    policy: str,
    split: str | Path,
    out: str | Path,
    *,
    simulator: str = "tabletop",
    conditions: Sequence[str] | None = None,
    families: Sequence[str] = ("all",),
    episodes: str = "0-49",
    episode_split: str = "test",
    shard: str = "1/1",
    system: str | None = None,
    memory: str | None = None,
    policy_options: Mapping[str, Any] | None = None,
    model_seed: int = 0,
    retrieval: str | None = None,
    retrieval_rule: str = "max",
    retrieval_camera: str = "front",
    robomme_python: str | None = None,
    check_lesson: bool = False,
    videos: bool = False,
    workers: int = 1,
    rollout_s: float = 3600.0,
    simulator_s: float = 1800.0,
    cache: bool = False,
    history_chunk: int = 64,
    max_errors: int = 10,
    resume: bool = True,
    command: Sequence[str] = (),
    listener: Listener | None = None,
) -> RunResult:
    """Roll out a policy under the benchmark's protocol and write one row per rollout.

    Rows are on the disk as rollouts end. Run again with the same `out`, it skips finished
    rollouts, repeats errors, and adds what is newly asked for.

    Worker processes import the script that runs: call it under `if __name__ == "__main__":`.

    Args:
        policy: `replay`, `oracle`, `guess`, `hold`, `websocket://host:port[,…]`,
            `lerobot:REPO[@REVISION]`, `lerobot:FOLDER` or `python:module:factory`.
        split: Folder of the split of buffers.
        out: Folder of the run.
        simulator: `tabletop`, `robomme`, or `module:function` of your own.
        conditions: `no-history`, `k0`, `k1`, …; None for all that the split has and the system
            takes.
        families: Task families, or `all`.
        episodes: Indices, such as `0-49` or `0,3,10-12`; ends are included.
        episode_split: `train`, `val` or `test`.
        shard: Which part of the plan to run, such as `2/8`; `merge_runs` joins the parts.
        system: Name for the rows; by default the policy's own, `retrieval-…` with retrieval.
        memory: Memory of `replay`: `full`, `framesamp` or `window`.
        policy_options: Other options of the policy by name: text, numbers, True, False or None.
        model_seed: Seed for the policy.
        retrieval: Encoder of a retrieval step in front of the policy, or None.
        retrieval_rule: How it chooses, `METHOD` or `METHOD/CUT` as `Rule.parse` reads it.
        retrieval_camera: Camera whose frames it compares.
        robomme_python: Interpreter in which the official simulator is installed.
        check_lesson: Compare each lesson of the dataset with the simulator's, bit for bit.
        videos: Write a video of each rollout.
        workers: Worker processes, each with a simulator and a policy.
        rollout_s: Seconds that a rollout may take before it is an error.
        simulator_s: Seconds that a reset, or up to 16 steps, may take before the simulator counts
            as hung: its process is replaced, and the rollout tried once more.
        cache: Keep decoded history frames on disk (20 GiB at most): later conditions and runs
            need not decode them again.
        history_chunk: Frames of history that are handed over at a time.
        max_errors: Errors in a row after which the run stops.
        resume: Go on with a run that is in `out` already.
        command: The command line, for the record.
        listener: Hears how the run goes.

    Raises:
        UnknownNameError, InvalidOptionError, InvalidIdError: An option is not what it may be.
        HistoryTooLongError: A buffer exceeds the system's position limit.
        MissingFileError: The split is not there.
        RunFolderError: `out` holds another run, or something else.
        PolicyError: The policy cannot be made.
        PolicyServerError: A policy server cannot be reached, or no longer any of them.
        WorkerError: The worker processes cannot start.
        HubError: The Hub does not know the policy's model, or cannot be reached.
        FormatError: Files of a run in `out` are damaged.
    """
    end_if_starting()
    opened = load_split(split)
    label = system or default_system(policy, memory, retrieval, retrieval_rule, retrieval_camera)
    config = RunConfig(
        system=label,
        policy=pin_policy(policy),
        memory=memory,
        simulator=simulator,
        split=str(split),
        split_name=opened.name,
        revision=opened.revision,
        episode_split=episode_split,
        model_seed=model_seed,
        retrieval=retrieval,
        retrieval_rule=retrieval_rule,
        retrieval_camera=retrieval_camera,
        robomme_python=robomme_python,
        check_lesson=check_lesson,
        videos=videos,
        workers=workers,
        rollout_s=rollout_s,
        simulator_s=simulator_s,
        cache=cache,
        history_chunk=history_chunk,
        max_errors=max_errors,
        policy_options=dict(policy_options or {}),
    )
    options = bind_options(policy, *policy_factory(config.policy), config.policy_arguments)
    about = describe_policy(config)
    check_settings(config, opened, about)
    plan = plan_work(
        opened.episode_ids,
        episode_split=episode_split,
        families=select_families(families, opened.families),
        episodes=parse_episodes(episodes),
        conditions=applicable(config, opened, about) if conditions is None else conditions,
    )
    check_plan(config, opened, about, plan)
    mine = take_shard(plan, parse_shard(shard))
    rows = read_log(Path(out))
    done = {key for key, row in rows.items() if row.status != Status.ERROR}
    if any(_key(config, item) not in done for item in mine):
        check_simulator(config, about)
    versions = simulator_versions(simulator, robomme_python)
    told = policy_identity(parse_policy(policy).kind, policy, options, about.metadata)
    known = identity(config, told, versions.get(simulator), retrieval_identity(config, opened))
    with open_log(Path(out), known, resume) as log:
        # The same split may be in another folder by now: rows keep one label for it.
        label = log.header.setdefault("split", config.split_name)
        config = dataclasses.replace(config, split_name=label)
        start = begun(
            log.header,
            config,
            plan_record(plan, shard),
            command=command,
            policy=about.metadata,
            simulator=versions,
        )
        log.write_header(**start)
        return _run(config, mine, log, listener)


def _run(
    config: RunConfig, plan: Sequence[WorkItem], log: RunLog, listener: Listener | None
) -> RunResult:
    keys = {_key(config, item): item for item in plan}
    order = {key: number for number, key in enumerate(keys)}
    finished = log.finished
    done = [log.rows[key] for key in keys if key in finished]
    todo = shuffle_work(item for key, item in keys.items() if key not in finished)
    if listener is not None:
        listener.start(plan, done)
    log.write_tables(order)
    stopped: str | None = "interrupted"
    written = time.monotonic()
    errors = 0
    outcomes = run_tasks(
        RolloutWorker(config, log.folder), todo, workers=config.workers, time_limit=config.rollout_s
    )
    try:
        for outcome in outcomes:
            row, traceback = _row(config, outcome, log)
            log.append(row, traceback)
            if listener is not None:
                listener.row(row)
            errors = errors + 1 if row.status == Status.ERROR else 0
            if errors >= config.max_errors:
                stopped = f"{errors} rollouts in a row broke; the last: {row.error}"
                break
            if time.monotonic() - written > _TABLES_S:
                log.write_tables(order)
                written = time.monotonic()
        else:
            stopped = None
    except InterferenceError as error:  # no worker is left
        stopped = error.message
        raise
    finally:
        outcomes.close()
        log.reread()  # Ctrl-C may have come between a row's writing and its counting
        log.write_tables(order)
        rows = tuple(log.rows[key] for key in keys if key in log.rows)
        counts = summary(rows)
        mine = {"stopped": stopped, "planned": len(plan), "counts": counts}
        log.write_header(**ended(log.header, mine, log.rows.values()))
    return RunResult(log.folder, rows, len(plan), counts, stopped)


def _row(config: RunConfig, outcome: Outcome, log: RunLog) -> tuple[Rollout, str | None]:
    """Return the row of an outcome, with its attempt and time, and the traceback of an error."""
    traceback: str | None = None
    if outcome.error is None:
        row, traceback = outcome.value
    else:
        # The process died or hung: its last words are all there is.
        late = isinstance(outcome.error, TimeoutError)
        traceback = None if late else last_words(log.folder, outcome.worker)
        text = f"{type(outcome.error).__name__}: {outcome.error}"
        if traceback is not None:
            text = f"the simulator hung: no answer for {config.simulator_s:g} s"
        row = error_row(config, outcome.task, text)
    before = log.rows[row.key].attempt if row.key in log.rows else 0
    return (
        dataclasses.replace(row, attempt=before + outcome.attempts, finished_at=now()),
        traceback,
    )


def _key(config: RunConfig, item: WorkItem) -> tuple[object, ...]:
    columns = base_row(config, item)
    return tuple(columns[name] for name in KEY_COLUMNS)
