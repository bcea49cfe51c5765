"""Manifest files: golden ones, written and read; how rows are found; damage.

The golden files in `golden/manifests/` were written for the two episode tables below. They may
change only on purpose, with a new format or rule version: then remove the folder and run
`UPDATE_GOLDEN=1 pytest tests/test_manifest_io.py`.
"""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from robomme_interference_data import Dataset, EpisodeId
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.errors import FormatError, InterferenceError, UnknownNameError
from robomme_interference_data.files import LocalFiles, read_json, write_json
from robomme_interference_data.manifest_io import SCHEMA, ManifestReader

GOLDEN = Path(__file__).parent / "golden" / "manifests"
FEATURES = {
    "observation.images.front": {"dtype": "video", "shape": [256, 256, 3]},
    "observation.state": {"dtype": "float32", "shape": [8]},
    "action": {"dtype": "float32", "shape": [8]},
}

# id, goals, seed, difficulty, simulator, lesson frames (None: a unit), exact
Row = tuple[str, list[str], int | None, str | None, str | None, int | None, bool]
QUERIES: list[Row] = [  # not in canonical order: the manifests are, all the same
    ("RouteStick/test/10", ["follow the route"], 691000, "hard", "robomme", 150, True),
    ("RouteStick/test/9", ["follow the route"], 690900, "easy", "robomme", 33, True),
    ("VideoRepick/test/7", ["pick it again", "grasp it again"], 7, "medium", "robomme", 257, True),
    ("my-robot/test/0", ['öffne die "Schublade"\n', "open it"], None, None, None, 25, False),
    ("VideoRepick/val/0", ["pick it again"], 0, "easy", "tabletop", 1077, True),
]
UNITS: list[Row] = [
    *(
        (f"{family}/train/{index}", [f"do {family}"], 100 + index, "easy", "robomme", None, True)
        for family, count in (("VideoRepick", 3), ("MoveCube", 3), ("RouteStick", 2))
        for index in range(count)
    ),
    ("PatternLock/train/5", ["draw the pattern"], None, None, None, None, False),
    ("my-robot/train/0", ["open it"], None, None, None, None, True),
]


def digest(*parts: object) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def episode_table(rows: list[Row]) -> pa.Table:
    """A table as in meta/episodes, with made-up digests."""
    columns: list[dict[str, Any]] = []
    for number, (name, goals, seed, difficulty, simulator, lesson, exact) in enumerate(rows):
        episode = EpisodeId.parse(name)
        columns.append(
            {
                "episode_index": number,
                "length": 32 if lesson is None else lesson + 1,
                "data/chunk_index": 0,
                "data/file_index": number,
                "videos/observation.images.front/chunk_index": 0,
                "videos/observation.images.front/file_index": number,
                "videos/observation.images.front/from_timestamp": 0.0,
                "episode_id": name,
                "family": episode.family,
                "split": episode.split,
                "source_episode": episode.index,
                "goals": goals,
                "seed": seed,
                "difficulty": difficulty,
                "simulator": simulator,
                "raw_length": 400,
                "exec_start_idx": lesson,
                "exact": exact,
                "sha256": digest(name),
                "lesson_sha256": None if lesson is None else digest(name, "lesson"),
                **{f"sha256/{feature}": digest(name, feature) for feature in FEATURES},
            }
        )
    strings = ("difficulty", "simulator", "lesson_sha256")
    numbers = ("seed", "exec_start_idx")
    table = pa.Table.from_pylist(columns)
    for field, kind in (*((s, pa.string()) for s in strings), *((n, pa.int64()) for n in numbers)):
        place = table.schema.get_field_index(field)
        table = table.set_column(place, field, table[field].cast(kind))
    return table


def write_dataset(root: Path, kind: str, rows: list[Row]) -> Dataset:
    """A dataset without videos and data: all that manifests are made of."""
    table = episode_table(rows)
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    path.parent.mkdir(parents=True)
    pq.write_table(table, path)
    write_json(
        root / "meta/info.json",
        {
            "codebase_version": "v3.0",
            "features": FEATURES,
            "fps": 10,
            "total_episodes": len(rows),
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        },
    )
    families = [EpisodeId.parse(row[0]).family for row in rows]
    write_json(
        root / "meta/interference.json",
        {
            "format_version": 1,
            "kind": kind,
            "name": f"golden-{kind}",
            "version": "1.0.0",
            "revision": digest(kind),
            "exact": all(row[-1] for row in rows),
            "cameras": ["front"],
            "simulators": ["robomme"],
            "counts": {
                "episodes": len(rows),
                "frames": sum(table["length"].to_pylist()),
                "families": {family: families.count(family) for family in dict.fromkeys(families)},
            },
        },
    )
    return Dataset(LocalFiles(root))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The manifests of the tables above, as they are written today."""
    root = tmp_path_factory.mktemp("golden")
    plan = plan_manifests(
        write_dataset(root / "demonstrations", "demonstrations", QUERIES),
        write_dataset(root / "distractors", "distractors", UNITS),
        k=(0, 1, 3, 7),
        seed=20,
    )
    out = root / "manifests"
    assert sum(write_manifests(plan, out)) == len(QUERIES)
    if os.environ.get("UPDATE_GOLDEN") and not GOLDEN.exists():
        GOLDEN.mkdir(parents=True)
        for path in out.iterdir():
            (GOLDEN / path.name).write_bytes(path.read_bytes())
    return out


# --- golden files --------------------------------------------------------------------------------


def test_json_lines_are_byte_for_byte_the_golden_ones(written: Path) -> None:
    assert (written / "buffers.jsonl").read_bytes() == (GOLDEN / "buffers.jsonl").read_bytes()


def test_header_is_byte_for_byte_the_golden_one(written: Path) -> None:
    """But for the digest and size of the parquet file, whose footer names pyarrow's version."""

    def comparable(folder: Path) -> str:
        text = (folder / "manifest.json").read_text(encoding="utf-8")
        recorded = json.loads(text)["files"]["buffers.parquet"]
        data = (folder / "buffers.parquet").read_bytes()
        assert recorded == {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
        return text.replace(recorded["sha256"], "…").replace(f": {len(data)},", ": …,")

    assert comparable(written) == comparable(GOLDEN)


def test_rows_are_the_golden_ones(written: Path) -> None:
    golden = pq.ParquetFile(GOLDEN / "buffers.parquet").read()
    assert pq.ParquetFile(written / "buffers.parquet").read().equals(golden)
    assert golden.schema.equals(SCHEMA)


@pytest.mark.parametrize("folder", ["golden", "today"])
def test_golden_files_are_read(folder: str, written: Path) -> None:
    """What was published with this format version stays readable."""
    root = GOLDEN if folder == "golden" else written
    reader = ManifestReader(LocalFiles(root))
    lines = (root / "buffers.jsonl").read_text(encoding="utf-8").splitlines()
    assert list(reader.rows()) == [json.loads(line) for line in lines]
    assert [manifest.as_dict() for manifest in reader.select({})] == list(reader.rows())
    assert reader.k_values == (0, 1, 3, 7)
    assert list(map(str, reader.episode_ids)) == [
        "VideoRepick/val/0",
        "VideoRepick/test/7",
        "RouteStick/test/9",
        "RouteStick/test/10",
        "my-robot/test/0",
    ]
    manifest = reader.get(EpisodeId("my-robot", "test", 0), 3)
    assert manifest.goals == ('öffne die "Schublade"\n', "open it")
    assert (manifest.seed, manifest.difficulty, manifest.simulator) == (None, None, None)
    assert (manifest.lesson_frames, manifest.history_frames) == (25, 25 + 3 * 32)
    # ⌊j·121/31⌋ < 25 for j ≤ 6 (23.4 → 23; 27.3): 7 of 32
    assert manifest.lesson_share == 7 / 32
    assert not manifest.exact
    assert manifest.query.frame == 25
    assert manifest.query.episode_index == manifest.sessions[0].episode_index == 3
    assert [session.role for session in manifest.sessions] == ["lesson", *["distractor"] * 3]


def test_exact_is_that_of_all_sessions(written: Path) -> None:
    inexact = {row[0] for row in (*QUERIES, *UNITS) if not row[-1]}
    found = set()
    for manifest in ManifestReader(LocalFiles(written)).select({}):
        sources = {str(session.source) for session in manifest.sessions}
        assert manifest.exact == (not sources & inexact)
        found.add(manifest.exact)
    assert found == {True, False}


def test_files_of_the_header(written: Path) -> None:
    header = read_json(written / "manifest.json")
    assert header["counts"] == {"buffers": 20, "queries": 5, "sessions": 5 * (1 + 2 + 4 + 8)}
    assert (header["seed"], header["rule_version"], header["format_version"]) == (20, 1, 1)
    assert sorted(path.name for path in written.iterdir()) == [
        "buffers.jsonl",
        "buffers.parquet",
        "manifest.json",
    ]


# --- finding rows ------------------------------------------------------------------------------


def test_get_finds_every_row(written: Path) -> None:
    reader = ManifestReader(LocalFiles(written))
    for manifest in reader.select({}):
        assert reader.get(manifest.episode_id, manifest.k) == manifest
        assert ManifestReader(LocalFiles(written)).get(manifest.episode_id, manifest.k) == manifest


@pytest.mark.parametrize(
    ("equal", "count"),
    [
        ({}, 20),
        ({"k": 7}, 5),
        ({"family": "VideoRepick"}, 8),
        ({"family": "VideoRepick", "split": "val"}, 4),
        ({"family": "VideoRepick", "split": "val", "k": 3}, 1),
        ({"exact": False, "k": 0}, 1),
        ({"difficulty": "easy"}, 8),
        ({"episode_id": "RouteStick/test/9"}, 4),
        ({"episode_id": "RouteStick/test/9", "k": 2}, 0),
    ],
)
def test_select(equal: dict[str, Any], count: int, written: Path) -> None:
    rows = list(ManifestReader(LocalFiles(written)).rows())
    found = list(ManifestReader(LocalFiles(written)).rows(equal))
    assert len(found) == count
    assert found == [row for row in rows if all(row[k] == v for k, v in equal.items())]


def test_values(written: Path) -> None:
    reader = ManifestReader(LocalFiles(written))
    assert reader.values("family") == ["VideoRepick", "RouteStick", "my-robot"]
    assert set(reader.values("difficulty")) == {"easy", "medium", "hard", None}


def test_unknown_names(written: Path) -> None:
    reader = ManifestReader(LocalFiles(written))
    with pytest.raises(UnknownNameError, match="family 'RouteStik' is not in") as caught:
        reader.get(EpisodeId("RouteStik", "test", 9), 0)
    assert caught.value.hint == "Did you mean 'RouteStick'?"
    with pytest.raises(UnknownNameError, match="RouteStick/test/90 is not in") as caught:
        reader.get(EpisodeId("RouteStick", "test", 90), 0)
    assert str(caught.value.hint).startswith("Did you mean 'RouteStick/test/9'")
    with pytest.raises(UnknownNameError, match="k=2 is not in") as caught:
        reader.get(EpisodeId("RouteStick", "test", 9), 2)
    assert str(caught.value.hint).startswith("Planned there: 0, 1, 3, 7. ")


# --- damage ------------------------------------------------------------------------------------


@pytest.mark.timeout(60)
def test_damaged_tables_neither_hang_nor_crash(written: Path, tmp_path: Path) -> None:
    """Damage in the footer too, where pyarrow ends the process over some of it."""
    data = (written / "buffers.parquet").read_bytes()
    (tmp_path / "manifest.json").write_bytes((written / "manifest.json").read_bytes())
    rng = np.random.default_rng(1)
    footer = int.from_bytes(data[-8:-4], "little") + 8
    errors = 0
    for turn in range(150):
        damaged = bytearray(data)
        place = int(rng.integers(len(data) - footer if turn % 2 else 0, len(data)))
        damaged[place] ^= 1 << int(rng.integers(8))
        path = tmp_path / "buffers.parquet"
        path.unlink(missing_ok=True)
        path.write_bytes(damaged)
        try:
            ManifestReader(LocalFiles(tmp_path)).get(EpisodeId("RouteStick", "test", 9), 3)
            list(ManifestReader(LocalFiles(tmp_path)).rows())
        except InterferenceError as error:
            errors += isinstance(error, FormatError)
    assert errors > 30
