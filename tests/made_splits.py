"""Splits of made-up recordings, and tables without frames; some to be damaged."""

import atexit
import json
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from recordings import MemorySource, build, digest_of, listed, opened, run_here

from robomme_interference_data import Dataset
from robomme_interference_data.build_dataset import build as build_module
from robomme_interference_data.build_dataset.encode import get_codec
from robomme_interference_data.build_dataset.features import features_of
from robomme_interference_data.build_dataset.finish import columns_of, revision_of
from robomme_interference_data.build_dataset.manifests import (
    ManifestPlan,
    plan_manifests,
    write_manifests,
)
from robomme_interference_data.build_dataset.plan import plan_dataset
from robomme_interference_data.build_dataset.sources.base import SourceEpisode
from robomme_interference_data.build_dataset.stage import StagedEpisode
from robomme_interference_data.build_dataset.verify import verify_split
from robomme_interference_data.constants import (
    ACTION,
    CAMERA_PREFIX,
    EPISODES_DIR,
    IDENTITY_PATH,
    INFO_PATH,
    MANIFEST_JSON,
    MANIFEST_JSONL,
    MANIFEST_PARQUET,
    MANIFESTS,
    STATE,
)
from robomme_interference_data.files import read_json, sha256_file, write_json
from robomme_interference_data.manifest_io import SCHEMA


@cache
def split() -> Path:
    """A split with k 0, 1 and 3, made once per process; treat it as read-only.

    Queries MoveCube/test/0, MoveCube/test/1 and Drawer/test/0, with lessons of 5, 20 and 5 frames;
    two train units each of MoveCube, PatternLock and Drawer.
    """
    folder = _temporary()
    queries = [
        listed("MoveCube/test/0"),
        listed("MoveCube/test/1", lesson=20),
        listed("Drawer/test/0"),
    ]
    units = [
        listed(f"{family}/train/{i}", seed=2000 + i)
        for family in ("MoveCube", "PatternLock", "Drawer")
        for i in range(2)
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build_module, "run_tasks", run_here)
        build("demonstrations", MemorySource(queries), folder / "demonstrations")
        build("distractors", MemorySource(units), folder / "distractors")
    datasets = opened(folder / "demonstrations"), opened(folder / "distractors")
    for _ in write_manifests(plan_manifests(*datasets, (0, 1, 3)), folder / "manifests"):
        pass
    return folder


def edit_manifests(folder: Path, change: Callable[[list[dict[str, Any]]], Any]) -> None:
    """Change the rows of a split's manifests as a careful forger would: everywhere.

    Args:
        folder: The split.
        change: Changes the list of rows in place.
    """
    out = folder / MANIFESTS
    rows = pq.read_table(out / MANIFEST_PARQUET).to_pylist()
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows, schema=SCHEMA), out / MANIFEST_PARQUET)
    lines = "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows)
    (out / MANIFEST_JSONL).write_text(lines, encoding="utf-8")
    vouch(folder)


def violations_of(root: Path, **options: Any) -> list[tuple[str, str]]:
    return [(violation.where, violation.what) for violation in verify_split(root, **options)]


def check_violations(root: Path, *expected: tuple[str, str], **options: Any) -> None:
    """Expect these violations and no other: place, and a pattern for what is said."""
    violations = violations_of(root, **options)
    assert [where for where, _ in violations] == [where for where, _ in expected], violations
    for (_, what), (_, pattern) in zip(violations, expected, strict=True):
        assert re.search(pattern, what), what


def edit_table(path: Path, change: Callable[[list[dict[str, Any]]], Any]) -> None:
    """Change the rows of a parquet file in place."""
    table = pq.read_table(path)
    rows = table.to_pylist()
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows, schema=table.schema), path)


def vouch(folder: Path) -> None:
    """Make a split's manifest.json name the files that are there."""
    out = folder / MANIFESTS
    edit_json(
        out / MANIFEST_JSON,
        lambda header: header.update(
            files={
                name: {"sha256": sha256_file(out / name), "bytes": (out / name).stat().st_size}
                for name in (MANIFEST_PARQUET, MANIFEST_JSONL)
            }
        ),
    )


def edit_json(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change a JSON file's object in place."""
    value = read_json(path)
    change(value)
    write_json(path, value)


def metadata_only(
    folder: Path, kind: str, episodes: list[SourceEpisode], *, backwards: bool = False
) -> Dataset:
    """The tables of a dataset, without frames and with made-up digests: large ones are cheap.

    Args:
        folder: Where to write.
        kind: `demonstrations` or `distractors`.
        episodes: What it holds, in canonical order.
        backwards: Store the episodes in the opposite order, as no build would.
    """
    codec = get_codec("av1-lossless")
    planned = plan_dataset(kind, [episodes]).episodes[:: -1 if backwards else 1]
    rows = []
    for number, item in enumerate(planned):
        names = [CAMERA_PREFIX + camera for camera in sorted(item.episode.cameras)]
        names += [STATE] if item.episode.action_size is None else [STATE, ACTION]
        digests = {name: digest_of(item.episode, name).hex() for name in names}
        lesson = (
            {}
            if kind == "distractors"
            else {n: digest_of(item.episode, n + "!").hex() for n in names}
        )
        staged = StagedEpisode(folder, len(item.indices), digests, lesson, {})
        lerobot = {
            "episode_index": number,
            "tasks": list(item.episode.goals[:1]),
            "length": len(item.indices),
            "data/chunk_index": 0,
            "data/file_index": 0,
        }
        for camera in item.episode.cameras:
            key = f"videos/{CAMERA_PREFIX}{camera}/"
            lerobot |= {key + "chunk_index": 0, key + "file_index": 0, key + "from_timestamp": 0.0}
        rows.append((lerobot, columns_of(item, staged, codec)))
    own = [row for _, row in rows]
    names = [*rows[0][0], *own[0]]
    schema = pa.schema([(name, _TYPES.get(name.rpartition("/")[2], pa.string())) for name in names])
    table = pa.Table.from_pylist([{**lerobot, **row} for lerobot, row in rows], schema=schema)
    path = folder / EPISODES_DIR / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    pq.write_table(table, path)
    first = planned[0].episode
    features = features_of(first, tuple(sorted(first.cameras)))
    info = {"codebase_version": "v3.0", "total_episodes": len(rows), "features": features}
    write_json(folder / INFO_PATH, {**info, "fps": 10, "data_path": "-", "video_path": "-"})
    identity = {
        "format_version": 1,
        "kind": kind,
        "name": kind,
        "version": "1.0.0",
        "revision": revision_of(own),
        "exact": all(row["exact"] for row in own),
        "codec": codec.name,
        "cameras": sorted(first.cameras),
        "simulators": sorted({row["simulator"] for row in own} - {None}),
        "counts": {
            "episodes": len(rows),
            "frames": sum(lerobot["length"] for lerobot, _ in rows),
            "families": dict(Counter(row["family"] for row in own)),
        },
    }
    write_json(folder / IDENTITY_PATH, identity)
    return opened(folder)


_TYPES = {
    **dict.fromkeys(("episode_index", "length", "chunk_index", "file_index"), pa.int64()),
    **dict.fromkeys(("source_episode", "seed", "raw_length", "exec_start_idx"), pa.int64()),
    **dict.fromkeys(("tasks", "goals"), pa.list_(pa.string())),
    "from_timestamp": pa.float64(),
    "exact": pa.bool_(),
}


def queries(folder: Path, names: list[str], lesson: int = 5, **values: Any) -> Dataset:
    episodes = [listed(name, lesson=lesson, **values) for name in names]
    return metadata_only(folder, "demonstrations", episodes)


def units(folder: Path, names: list[str], **values: Any) -> Dataset:
    return metadata_only(folder, "distractors", [listed(name, **values) for name in names])


def named(families: dict[str, int], split: str = "train") -> list[str]:
    return [f"{family}/{split}/{i}" for family, count in families.items() for i in range(count)]


def write(plan: ManifestPlan, out: Path) -> list[dict[str, Any]]:
    """Write the manifests, and return the rows of the parquet file."""
    for _ in write_manifests(plan, out):
        pass
    return pq.read_table(out / "buffers.parquet").to_pylist()


@cache
def pair() -> tuple[Dataset, Dataset]:
    """Six queries of three families and nine units of four, tables only; read-only."""
    folder = _temporary()
    tests = ["MoveCube/test/0", "MoveCube/test/2", "InsertPeg/test/10", "InsertPeg/test/9"]
    return (
        queries(folder / "d", [*tests, "Drawer/test/0", "MoveCube/val/1"]),
        units(folder / "u", named({"MoveCube": 3, "InsertPeg": 2, "PatternLock": 3, "Drawer": 1})),
    )


def _temporary() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="interference-tests-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
