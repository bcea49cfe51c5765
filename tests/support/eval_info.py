"""Files as lerobot-eval writes them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def task(group: Any, number: Any, successes: Any) -> dict[str, Any]:
    """A task of `per_task`."""
    metrics = {"sum_rewards": [0.5], "max_rewards": [1.0], "successes": successes}
    return {"task_group": group, "task_id": number, "metrics": metrics | {"video_paths": []}}


def write(path: Path, outcomes: Mapping[tuple[str, int], str]) -> Path:
    """Write successes by group and number of the task: a letter for each episode, s if it won."""
    tasks = [
        task(group, number, [letter == "s" for letter in letters])
        for (group, number), letters in outcomes.items()
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"per_task": tasks, "per_group": {}, "overall": {}}, indent=2))
    return path
