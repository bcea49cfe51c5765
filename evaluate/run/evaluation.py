"""Run an evaluation: check the settings, run what is not finished, and write each row to disk.

A run has these steps, each of which takes values and returns values:

1. settings: `run_evaluation` checks what rollouts and questions share;
2. plan and workers: `open_rollouts` or `open_questions` identifies the policy or model, plans the
   run (`plan_run`), and opens workers for what is not finished;
3. folder: `open_log` creates it, or compares it with the run that it holds;
4. probe: `probe_run` plays rollouts to find a state that survives a reset, then the header is
   written;
5. rows: `_write_rows` writes each as it comes;
6. close: workers end, tables are exported, and the header gets its status.
"""

import dataclasses
import logging
from collections.abc import Generator, Iterable, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.errors import InterferenceError, NoRendererError, first_line
from robomme_interference_data.evaluate.probe.result import Probe, probe_text
from robomme_interference_data.runtime.executor import (
    Executor,
    Outcome,
    WorkerPool,
    end_if_starting,
    make_executor,
)
from robomme_interference_data.schema.codec import arrow_schema, to_pandas, to_table
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.storage.files import atomic_path

from .config import AskConfig, RunConfig, check_shared, with_camera
from .faults import error_text, first_fault, first_trace
from .identity import invocation, now, plain, run_identity
from .log import RunLog, count_statuses, open_log
from .plan import WorkItem, shuffle_work
from .row import Rollout, is_done, row_line, row_of
from .worker import WORTH_REPEATING, Job, PlannedRun, RunContext

if TYPE_CHECKING:
    import pandas

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunResult:
    """The result of a run.

    Attributes:
        folder: The folder of the run.
        rows: Rows of all planned rollouts that ended, in canonical order.
        planned: Number of planned rollouts.
        counts: Number of rows by status.
        stopped: Why the run ended early, or None.
        probe: What the leak probe found, now or earlier; None if the run was not probed.
    """

    folder: Path
    rows: tuple[Rollout, ...]
    planned: int
    counts: dict[str, int]
    stopped: str | None
    probe: Probe | None

    def to_pandas(self) -> "pandas.DataFrame":
        """Return the rows as a pandas `DataFrame`; its columns are those of `rollouts.parquet`.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        return to_pandas(to_table(self.rows, arrow_schema(Rollout)))


class ProgressCallback(Protocol):
    """Shows the progress of a run."""

    def note(self, text: str) -> None:
        """Receive a sentence about the probe, before the plan."""

    def start(self, items: Sequence[WorkItem], done: Sequence[Rollout]) -> None:
        """Receive the plan, and the rows of earlier invocations."""

    def row(self, row: Rollout, node: str | None) -> None:
        """Receive a row that was written, and the node of a cluster that it comes from."""


def run_evaluation(
    config: RunConfig | AskConfig,
    *,
    executor: Executor | None = None,
    progress: ProgressCallback | None = None,
    command: Sequence[str] = (),
) -> RunResult:
    """Roll out a policy, or ask questions, under the benchmark's protocol; one row each.

    Rows are on disk as rollouts end. With the same `out`, a run resumes: it skips finished
    rollouts, repeats errors, and adds newly planned ones. Rows of questions are like those of
    rollouts: `simulator` is `questions`, and `success` is whether the answer is right.

    Worker processes import the running script: call this under `if __name__ == "__main__":`.

    Args:
        config: What to roll out or to ask, and how.
        executor: What executes it; by default according to `config`.
        progress: Called while the run proceeds.
        command: The command line, for the record.

    Raises:
        UnknownNameError, InvalidOptionError, InvalidIdError: A setting is invalid.
        InvalidOptionError: A buffer exceeds the system's position limit.
        MissingFileError: The buffer set does not exist, or has no questions.
        HashMismatchError: Its manifests or episode records do not have their recorded hashes.
        RunError: `out` holds another run, or other files.
        PolicyError: The policy cannot be made.
        LeakError: A policy, simulator or subgoal writer keeps a state after a reset.
        PolicyServerError: No policy server can be reached, another run drives it, or it serves
            another kind of model than the system's.
        ModelError: The model cannot be reached, or does not exist.
        WorkerError: The worker processes cannot start.
        HubError: The Hub does not have the model, or cannot be reached.
        FormatError: Files of a run in `out`, or the questions, are damaged.
        MissingExtraError: A library is not installed.
    """
    end_if_starting()  # a worker that imports a script without the guard
    check_shared(config)  # before anything is loaded
    if config.track is not None:
        from .tracking import check_tracker

        check_tracker(config.track)
    buffer_set, folder = load_buffer_set(config.buffer_set), Path(config.out)
    config = with_camera(config, buffer_set)
    config = dataclasses.replace(config, buffer_set=buffer_set.location)
    with (
        _open_run(config, buffer_set, executor or make_executor(config)) as (planned, pool),
        ExitStack() as stack,
    ):
        run, plan = planned.run, planned.plan
        if run.unfinished_training is not None:
            logger.warning("%s", run.unfinished_training)
        identity = run_identity(run, plan, buffer_set)
        log = stack.enter_context(
            open_log(folder, identity, buffer_set.name, resume=not config.no_resume)
        )
        probe = _probe(run, buffer_set, planned.items, pool, log, progress)
        log.begin(invocation(run, plan, command), probe)
        # The buffer set may have moved to another folder: its label in rows stays the same.
        run = dataclasses.replace(run, buffer_set=log.header.buffer_set)
        callbacks = [] if progress is None else [progress]
        if config.track is not None:
            from .tracking import Tracking, open_tracker

            opened = partial(open_tracker, config.track, folder, plain(identity))
            callbacks.append(stack.enter_context(Tracking(config.track, opened)))
        return _write_rows(run, planned.items, pool, buffer_set, log, callbacks)


def _open_run(
    config: RunConfig | AskConfig, buffer_set: BufferSet, executor: Executor
) -> AbstractContextManager[tuple[PlannedRun[Any], WorkerPool | None]]:
    """Plan a run, and keep its workers in the block; None if there is nothing to do for them."""
    # Here, because a run of one kind imports nothing of the other.
    if isinstance(config, AskConfig):
        from robomme_interference_data.evaluate.language.question_run import open_questions

        return open_questions(config, buffer_set, executor)
    from robomme_interference_data.evaluate.rollout.runner import open_rollouts

    return open_rollouts(config, buffer_set, executor)


def _probe(
    run: RunContext[Any],
    buffer_set: BufferSet,
    items: Sequence[WorkItem],
    pool: WorkerPool | None,
    log: RunLog,
    progress: ProgressCallback | None,
) -> Probe | None:
    """Probe a run of rollouts, once; None if it is not probed now."""
    config, earlier = run.config, log.header.probe
    if not isinstance(config, RunConfig) or config.no_probe or (earlier and earlier.done):
        return None
    if pool is None or all(item in log.rows and is_done(log.rows[item]) for item in items):
        return None
    # Here, because questions have no probe.
    from robomme_interference_data.evaluate.probe.probe import probe_run

    note = (lambda text: None) if progress is None else progress.note
    probe = probe_run(run, buffer_set, items, pool, note)
    note(probe_text(probe))
    return probe


def _write_rows(
    run: RunContext[Any],
    items: Sequence[WorkItem],
    pool: WorkerPool | None,
    buffer_set: BufferSet,
    log: RunLog,
    callbacks: Sequence[ProgressCallback],
) -> RunResult:
    """Run what is not finished, and write its rows as they come."""
    done = {item: row for item, row in log.rows.items() if is_done(row)}
    for callback in callbacks:
        callback.start(items, [done[item] for item in items if item in done])
    stopped: str | None = "interrupted"  # unless the loop ends in another way than by Ctrl-C
    todo = shuffle_work(item for item in items if item not in done)
    outcomes = _outcomes(run, pool, todo)
    errors, disk_full = 0, False
    try:
        for outcome in outcomes:
            if isinstance(outcome.error, NoRendererError):  # no rollout can be drawn
                raise outcome.error
            row, trace = _save_files(run, outcome, buffer_set, log)
            log.append(row, trace)
            for callback in callbacks:
                callback.row(row, outcome.node)
            errors = 0 if is_done(row) else errors + 1
            if errors >= run.config.max_errors:
                stopped = f"{errors} in a row broke; the last: {row.error}"
                break
        else:
            stopped = None
    except InterferenceError as error:  # no worker is left, or none can draw
        stopped = error.message
        raise
    except OSError:  # a disk without space for a row has none for tables
        disk_full = True
        raise
    finally:
        outcomes.close()  # ends workers that have a task, before the tables are exported
        *earlier, last = log.header.invocations
        last = dataclasses.replace(last, ended=now(), stopped=stopped)
        if not disk_full:
            log.end(dataclasses.replace(log.header, invocations=(*earlier, last)))
    rows = tuple(log.rows[item] for item in items if item in log.rows)
    return RunResult(log.folder, rows, len(items), count_statuses(rows), stopped, log.header.probe)


def _outcomes(
    run: RunContext[Any], pool: WorkerPool | None, items: Iterable[WorkItem]
) -> Generator[Outcome]:
    """Yield the outcomes of work items as they arrive; none without workers."""
    again: tuple[type[Exception], ...] = WORTH_REPEATING
    if isinstance(run.config, RunConfig) and run.config.policies is not None:
        # A shared policy that hangs delays all its rollouts: which of them it hung at is unknown.
        again += (TimeoutError,)
    if pool is not None:
        jobs = [Job(item, run) for item in items]
        yield from pool.run(jobs, time_limit=run.config.rollout_timeout_s, again=again)


def _save_files(
    run: RunContext[Any], outcome: Outcome, buffer_set: BufferSet, log: RunLog
) -> tuple[Rollout, str | None]:
    """Write the files of an outcome; return its row, and the traceback of an error or None.

    A row that could not be read again, such as one with a number of 100 bits, becomes an error:
    no run could resume from such a line.
    """
    item: WorkItem = outcome.task.item
    error, trace = outcome.error, outcome.trace
    if error is None:
        row, trace = outcome.value
        try:
            row_of(row_line(row))
        except (ValueError, OverflowError, RecursionError) as unstorable:
            error = RuntimeError(f"its row cannot be stored: {first_line(unstorable)}")
    if error is not None:
        row = _error_row(run, outcome, error, buffer_set)
    for path in (item.clip, item.page):  # of an earlier attempt
        (log.folder / path).unlink(missing_ok=True)
    # Rows matter more than clips: a full disk costs a clip only.
    problems = [_write(log.folder, path, data) for path, data in outcome.files.items()]
    lost = [problem for problem in problems if problem is not None]
    row = dataclasses.replace(
        row,
        video=item.clip if (log.folder / item.clip).exists() else None,
        attempt=(log.rows[item].attempt if item in log.rows else 0) + outcome.attempts,
        repeated_because=first_fault(log.rows.get(item), outcome),
        finished_at=now(),
    )
    return row, "\n".join(filter(None, (trace, first_trace(outcome), *lost))) or None


def _error_row(
    run: RunContext[Any], outcome: Outcome, error: BaseException, buffer_set: BufferSet
) -> Rollout:
    item: WorkItem = outcome.task.item
    query = buffer_set.query(item.episode)
    # A rollout that broke reports how far it came; a worker that died cannot.
    columns: dict[str, Any] = {"steps": 0} | dict(outcome.progress)
    return run.row(
        item,
        Status.ERROR,
        seed=query.seed,
        difficulty=query.difficulty,
        ability=query.record.ability,
        goal=None,
        history_frames=0,
        lesson_frames=0,
        lesson_share=None,
        error=error_text(error),
        **columns,
    )


def _write(folder: Path, path: str, data: bytes) -> str | None:
    """Write a file of a task atomically; return the problem, or None."""
    try:
        with atomic_path(folder / path) as partial:
            partial.write_bytes(data)
    except OSError as error:
        return f"{path} could not be written: {error}"
    return None
