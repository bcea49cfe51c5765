"""Results of `vla-eval run`: with this project's benchmark, or with another one."""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import nth_number
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.schema.rollouts import KEY_COLUMNS, Status

from .row_format import FileColumns, RowFile, Scenes, check_count, plain_name

_HINT = (
    "Expected a file of `vla-eval run` or `vla-eval export`: see docs/how-to/connect-a-policy.md."
)


_REQUIRED = {*KEY_COLUMNS} - {"training_seed"}
"""Columns that every episode has; vla-eval leaves out what is None, as an unknown seed is."""


def read(file: RowFile, names: Sequence[str]) -> FileColumns:
    """Read the episodes of all tasks.

    With the benchmark of `evaluate.vla_eval`, an episode's metrics are a row. An episode that has a
    reason of a failure is an error: it says nothing about the policy, though vla-eval counts it as
    no success.
    """
    try:
        episodes = [episode for task in file.json["tasks"] for episode in task["episodes"]]
        check_count(len(episodes))
        if any("buffer_set" in {**episode, **episode["metrics"]} for episode in episodes):
            return _own_rows(episodes, names)
        return _rows_of_others(file)
    except KeyError as error:
        raise FormatError(f"{file.path} has no key {error}, as vla-eval writes it", _HINT) from None
    except (TypeError, AttributeError, IndexError):
        raise FormatError(f"{file.path} holds no results of vla-eval", _HINT) from None


def _own_rows(episodes: Sequence[Mapping[str, Any]], names: Sequence[str]) -> FileColumns:
    rows: dict[int, list[Any]] = {}
    malformed: dict[int, str] = {}
    for line, episode in enumerate(episodes, 1):
        row = episode["metrics"]
        if episode.get("failure_reason"):
            number = nth_number(episode["episode"], episode["episode_idx"])
            if number is None:
                malformed[line] = f"{episode['name']} has fewer episodes: see episodes_per_task"
                continue
            row = {**episode, "episode": number, "status": Status.ERROR, "success": None}
        rows[line] = [row[name] if name in _REQUIRED else row.get(name) for name in names]
        if any(isinstance(value, list | dict) for value in rows[line]):
            raise TypeError
    columns = {name: [row[at] for row in rows.values()] for at, name in enumerate(names)}
    return FileColumns(columns, list(rows), malformed)


def _rows_of_others(file: RowFile) -> FileColumns:
    """Read results of a benchmark of which only tasks, episodes and successes are known."""
    results = file.json
    benchmark = plain_name(results["benchmark"])
    seed = results.get("seed")
    if not isinstance(seed, int | None):
        raise TypeError
    rows = list(_outcomes(file))
    columns: dict[str, list[Any]] = {
        "simulator": [benchmark] * len(rows),
        "condition": [NO_HISTORY] * len(rows),
        "family": [family for family, _, _ in rows],
        "episode": [number for _, number, _ in rows],
        "status": [str(status) for _, _, status in rows],
        "success": [None if s is Status.ERROR else s is Status.SUCCESS for _, _, s in rows],
    }
    if seed is not None:
        columns["model_seed"] = [seed] * len(rows)
    # Every parameter may change the scenes; the seed is a column of its own.
    settings = {**results.get("config", {}).get("params", {}), "seed": None}
    return FileColumns(
        columns,
        range(1, len(rows) + 1),
        scenes=Scenes("vla-eval", f"{benchmark} {json.dumps(settings, sort_keys=True)}"),
    )


def _outcomes(file: RowFile) -> Iterator[tuple[str, int, Status]]:
    """Yield family, number and status of each episode."""
    families: dict[str, str] = {}
    for task in file.json["tasks"]:
        family = plain_name(task["task"])
        if families.setdefault(family, task["task"]) != task["task"]:
            raise FormatError(
                f"{file.path} has tasks {families[family]!r} and {task['task']!r}, whose names "
                "differ in punctuation alone",
                "Rename one of them.",
            )
        for episode in task["episodes"]:
            number, success = episode["episode_id"], episode["metrics"].get("success")
            if not isinstance(number, int):
                raise TypeError
            if episode.get("failure_reason"):
                yield family, number, Status.ERROR
            elif isinstance(success, int | float) and success in (0, 1):
                yield family, number, Status.SUCCESS if success else Status.FAIL
            else:
                raise FormatError(
                    f"{file.path}, episode {number} of {task['task']}: success {success!r}; "
                    "expected true, false, 1 or 0",
                    _HINT,
                )
