"""`verify --audit` finds leaks of the answer into a buffer set."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from support.buffer_sets import GOLDEN, plan_again
from support.damage import HEADER, ROWS, edit, put, renew_header
from support.made_up import record, write_metadata
from support.messages import raises

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.verify.audit import Audit, Leak, audit_buffer_set
from robomme_interference_data.errors import FormatError


def audited(root: Path, queries: list[Any], units: list[Any], *conditions: str) -> Audit:
    write_metadata(root / "demonstrations", "demonstrations", queries)
    write_metadata(root / "distractors", "distractors", units)
    plan_again(root, conditions or ("k0",))
    return audit_buffer_set(load_buffer_set(root))


query, unit = partial(record, "demonstrations"), partial(record, "distractors")


def test_use_by_hand(tmp_path: Path) -> None:
    # MoveCube's queries can only draw Drawer's unit, and Drawer's only MoveCube's.
    report = audited(
        tmp_path,
        [query("MoveCube/test/0"), query("MoveCube/test/1"), query("Drawer/test/0")],
        [unit("MoveCube/train/0"), unit("Drawer/train/5")],
        *("no-history", "k0", "k1"),
    )
    assert report.leaks == []
    used = {name: list(uses.values()) for name, uses in report.uses.items()}
    assert used == {"no-history": [0, 0], "k0": [0, 0], "k1": [1, 2]}
    uses, families = report.tables()
    assert uses.rows[2] == ("k1", 2, 1, 1.5, 2, 0)
    assert families.rows == [("MoveCube", 1, 1, 1, 1, 1), ("Drawer", 1, 2, 2, 2, 2)]
    units = json.loads(json.dumps(report.as_dict()))["units"]
    assert units == {"MoveCube/train/0": 1, "Drawer/train/5": 2}


def test_the_golden_buffer_set_leaks_nothing() -> None:
    report = audit_buffer_set(load_buffer_set(GOLDEN))
    assert report.leaks == []
    assert sum(report.uses["k7"].values()) == 3 * 7


def test_leaks_in_the_pool(tmp_path: Path) -> None:
    same = {"observation.images.front": "same", "observation.state": "x"}
    report = audited(
        tmp_path,
        [query("MoveCube/test/0", seed=3, simulator="s"), query("Drawer/test/0", seed=3)],
        [
            unit("MoveCube/train/7", seed=3, simulator="s"),
            unit("InsertPeg/train/0", feature_sha256=same),
            unit("PatternLock/train/0", feature_sha256=same),
        ],
    )
    assert report.leaks == [
        Leak("same scene", "unit MoveCube/train/7 and query MoveCube/test/0 (seed 3)"),
        Leak(
            "identical frames",
            "InsertPeg/train/0 and PatternLock/train/0 (observation.images.front)",
        ),
    ]


@pytest.mark.parametrize(
    ("condition", "sources", "role", "leaks"),
    [
        ("held-k1", "MoveCube/test/0", "filler", []),
        ("held-k1", "MoveCube/test/1", "filler", ["not a train episode"]),
        ("same-k1", "MoveCube/train/5", "distractor", []),
        ("same-k1", "InsertPeg/train/0", "distractor", ["other family"]),
        ("stale-k0", "MoveCube/test/0/1", "contradiction", []),
        ("stale-k0", "MoveCube/test/0", "contradiction", ["not a train episode"]),
        ("misled-k0", "MoveCube/test/1/1", "contradiction", ["not a train episode"]),
        ("before-k1", "MoveCube/train/1", "distractor", ["same family"]),
        ("before-k1", "InsertPeg/test/1", "distractor", ["not a train episode"]),
        ("before-k1", "InsertPeg/val/1", "filler", ["not a train episode"]),
        ("before-k1", "InsertPeg/test/1", "lesson", ["not a train episode"]),
        ("before-k1", "InsertPeg/train/0 InsertPeg/train/0", "distractor", ["repeated unit"]),
        ("before-k1", "MoveCube/test/0", "filler", ["not a train episode"]),
        ("before-k1", "MoveCube/test/0/1", "contradiction", ["not a train episode"]),
    ],
)
def test_leaks_in_a_buffer(
    own_buffers: Path, condition: str, sources: str, role: str, leaks: list[str]
) -> None:
    """A buffer of the first condition, renamed, gets further sessions."""
    header = own_buffers / HEADER
    header.write_text(header.read_text().replace('"k0"', f'"{condition}"'))

    def change(table: pa.Table) -> pa.Table:
        names, rows = table["condition"].to_pylist(), table["sessions"].to_pylist()
        number = names.index("k0", 5)  # MoveCube's
        frames, lesson = table["history_frames"].to_pylist(), rows[number][0]
        for source in sources.split():
            more = {"source": source, "family": source.split("/", maxsplit=1)[0], "role": role}
            rows[number].append(lesson | more)
        frames[number] *= len(rows[number])
        names = [condition if name == "k0" else name for name in names]
        changed = put(put(table, "sessions", rows), "history_frames", frames)
        return put(changed, "condition", names)

    edit(own_buffers / ROWS, change)
    found = audit_buffer_set(load_buffer_set(own_buffers)).leaks
    assert [leak.kind for leak in found] == leaks
    assert all(leak.where.startswith("MoveCube/test/0 under") for leak in found)


def test_a_header_without_a_condition_of_the_rows(own_buffers: Path) -> None:
    renew_header(own_buffers, conditions=["no-history", "k0"])
    with raises(FormatError):
        audit_buffer_set(load_buffer_set(own_buffers))
