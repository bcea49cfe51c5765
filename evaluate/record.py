"""What models were asked and answered, in a run's folder: a file a rollout, to be read."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from robomme_interference_data.evaluate.log import item_name
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.files import atomic_path, canonical_json


def write_record(
    folder: Path, kind: str, item: WorkItem, lines: Iterable[Mapping[str, Any]]
) -> str | None:
    """Write `<kind>/<rollout>.jsonl` in a run's folder, whole or not at all.

    Returns:
        What went wrong, or None: rows matter more than what is to be read beside them.
    """
    try:
        with atomic_path(folder / kind / f"{item_name(item)}.jsonl") as partial:
            text = "".join(canonical_json(dict(line)) + "\n" for line in lines)
            partial.write_text(text, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        return f"the {kind} could not be written: {error}"
    return None
