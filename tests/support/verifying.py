"""What `verify` finds in a buffer set, and the files of one that tests damage."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
from support.buffer_sets import violations
from support.damage import put

EPISODES = "distractors/meta/episodes/chunk-000/file-000.parquet"
RECORDS = "distractors/meta/interference.parquet"
DATA = "distractors/data/chunk-000/file-003.parquet"
FRONT = "videos/observation.images.front"
VIDEO = f"distractors/{FRONT}/chunk-000/file-003.mp4"


def expect(root: Path, *patterns: str, decode: bool = False) -> None:
    """Check that violations match the patterns, each at least once, and nothing is raised."""
    found = violations(root, decode=decode)
    for pattern in patterns:
        assert any(re.search(pattern, one) for one in found), f"{pattern}: {found}"
    assert found


def first_changed(name: str, value: Any) -> Callable[[pa.Table], pa.Table]:
    return lambda table: put(table, name, [value, *table[name].to_pylist()[1:]])
