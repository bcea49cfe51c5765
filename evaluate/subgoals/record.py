"""Subgoals of a rollout in the run's folder: a line for each, with what the model was asked."""

from collections.abc import Iterable
from pathlib import Path

from robomme_interference_data.evaluate.log import item_name
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.evaluate.subgoals.writer import Turn
from robomme_interference_data.files import atomic_path, canonical_json
from robomme_interference_data.rows import to_dict


def write_turns(folder: Path, item: WorkItem, turns: Iterable[Turn]) -> None:
    """Write the subgoals of a rollout to `subgoals/<rollout>.jsonl`, whole or not at all."""
    with atomic_path(folder / "subgoals" / f"{item_name(item)}.jsonl") as partial:
        lines = (canonical_json(to_dict(turn)) + "\n" for turn in turns)
        partial.write_text("".join(lines), encoding="utf-8", errors="backslashreplace")
