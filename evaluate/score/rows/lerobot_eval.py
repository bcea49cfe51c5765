"""`eval_info.json`, which LeRobot's `lerobot-eval` writes (as of lerobot 0.6)."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from robomme_interference_data.errors import FormatError
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.schema.rollouts import Status

from .row_format import FileColumns, RowFile, Scenes, check_count, plain_name


def read(file: RowFile, names: Sequence[str]) -> FileColumns:
    """Read the episodes of all tasks.

    The file has the successes of each task in the order of its episodes. It names neither policy
    nor seed: `lerobot-eval --seed` gives the first episode of each task that seed, and the n-th
    after it that seed plus n. The policy sees nothing before an episode.
    """
    rows = list(_episodes(file))
    check_count(len(rows))
    return FileColumns(
        {
            "simulator": [group for group, _, _, _ in rows],
            "condition": [NO_HISTORY] * len(rows),
            "family": [family for _, family, _, _ in rows],
            "episode": [number for _, _, number, _ in rows],
            "status": [str(Status.SUCCESS if won else Status.FAIL) for _, _, _, won in rows],
            "success": [won for _, _, _, won in rows],
        },
        range(1, len(rows) + 1),
        scenes=Scenes("lerobot-eval", "lerobot-eval"),
    )


def _episodes(file: RowFile) -> Iterator[tuple[str, str, int, bool]]:
    """Yield group and task as simulator and family, number and success of each episode."""
    tasks = file.json.get("per_task")
    if not isinstance(tasks, list) or not tasks:
        raise _wrong(file, f"per_task is {_shown(tasks)}; expected a list of tasks")
    seen = set[tuple[str, int]]()
    for place, task in enumerate(tasks):
        group, number, successes = _task(file, f"per_task[{place}]", task)
        if (group, number) in seen:
            raise _wrong(file, f"task {number} of {group} occurs twice")
        seen.add((group, number))
        for episode, success in enumerate(successes):
            if not isinstance(success, bool):
                raise _wrong(
                    file,
                    f"success {success!r:.80} of episode {episode} of task {number} of {group}; "
                    "expected true or false",
                )
            yield plain_name(group), f"task_{number}", episode, success


def _task(file: RowFile, where: str, task: Any) -> tuple[str, int, list[Any]]:
    """Return group, number and successes of a task."""
    task = task if isinstance(task, Mapping) else {}
    metrics = task.get("metrics")
    group, number = task.get("task_group"), task.get("task_id")
    successes = metrics.get("successes") if isinstance(metrics, Mapping) else None
    if not isinstance(group, str) or not group:
        raise _wrong(file, f"task_group of {where} is {_shown(group)}; expected text")
    # Not `isinstance`: true is an int in Python.
    if type(number) is not int or number < 0:
        raise _wrong(file, f"task_id of {where} is {_shown(number)}; expected a number from 0")
    if not isinstance(successes, list) or not successes:
        raise _wrong(
            file,
            f"metrics.successes of {where} is {_shown(successes)}; expected a value per episode",
        )
    return group, number, successes


def _shown(value: Any) -> str:
    return "missing" if value is None else repr(value)[:80]


def _wrong(file: RowFile, problem: str) -> FormatError:
    return FormatError(
        f"{file.path}: {problem}",
        "Expected eval_info.json as lerobot-eval of lerobot 0.6 writes it.",
    )
