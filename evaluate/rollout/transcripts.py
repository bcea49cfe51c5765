"""What models were asked and answered, in a run's folder: a file a rollout, to be read."""

from collections.abc import Iterable, Mapping
from typing import Any

from robomme_interference_data.evaluate.run.log import item_name
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.storage.files import canonical_json


def transcript_file(
    kind: str, item: WorkItem, lines: Iterable[Mapping[str, Any]]
) -> tuple[str, bytes]:
    """Return path and bytes of a rollout's `<kind>/<rollout>.jsonl` in a run's folder."""
    text = "".join(canonical_json(dict(line)) + "\n" for line in lines)
    return f"{kind}/{item_name(item)}.jsonl", text.encode("utf-8", "backslashreplace")
