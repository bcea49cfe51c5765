"""Damage to the metadata of a dataset is named; that to all else is in test_loader_damage.py."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import factories
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from factories import CAMERAS

from robomme_interference_data import Dataset
from robomme_interference_data.errors import FormatError, InterferenceError, MissingFileError
from robomme_interference_data.files import LocalFiles

EPISODES = "meta/episodes/chunk-000/file-000.parquet"


def edit_json(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def edit_table(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    pq.write_table(change(pq.ParquetFile(path).read()), path)


def use_everything(root: Path) -> None:
    dataset = Dataset(LocalFiles(root))
    for record in dataset.records():
        dataset.span_digests(record.episode_index, 0, 1)


REQUIRED_COLUMNS = [
    "episode_index",
    "length",
    "episode_id",
    "goals",
    "seed",
    "raw_length",
    "exec_start_idx",
    "exact",
    "sha256",
    "lesson_sha256",
    "sha256/observation.images.wrist",
    "sha256/action",
    "data/chunk_index",
    "data/file_index",
    "videos/observation.images.front/chunk_index",
    "videos/observation.images.front/file_index",
    "videos/observation.images.front/from_timestamp",
]

DAMAGES: dict[str, tuple[Callable[[Path], object], type[InterferenceError], str]] = {
    "no info": (
        lambda root: (root / "meta/info.json").unlink(),
        MissingFileError,
        r"meta/info\.json is missing in .*demonstrations",
    ),
    "info is no JSON": (
        lambda root: (root / "meta/info.json").write_text("{"),
        FormatError,
        r"info\.json is not JSON",
    ),
    "info is a list": (
        lambda root: (root / "meta/info.json").write_text("[]"),
        FormatError,
        r"info\.json holds no JSON object",
    ),
    "another LeRobot version": (
        lambda root: edit_json(
            root / "meta/info.json", lambda v: v.update(codebase_version="v2.1")
        ),
        FormatError,
        "LeRobot dataset of version 'v2.1'; this package reads v3.0",
    ),
    **{
        f"info without {key}": (
            lambda root, key=key: edit_json(root / "meta/info.json", lambda v: v.pop(key)),
            FormatError,
            rf"info\.json lacks {key}",
        )
        for key in ("features", "fps", "total_episodes", "data_path", "video_path")
    },
    "another number of episodes": (
        lambda root: edit_json(root / "meta/info.json", lambda v: v.update(total_episodes=9)),
        FormatError,
        "meta/episodes does not list the episodes 0 to 8",
    ),
    "another image size": (
        lambda root: edit_json(
            root / "meta/info.json",
            lambda v: v["features"][CAMERAS[0]].update(shape=[32, 64, 3]),
        ),
        FormatError,
        r"frames are 64×64 pixels; the dataset's info\.json says 64×32",
    ),
    "another state size": (
        lambda root: edit_json(
            root / "meta/info.json", lambda v: v["features"]["observation.state"].update(shape=[7])
        ),
        FormatError,
        r"observation\.state of episode 0 has 168 values; expected 21 × 7",
    ),
    "no identity": (
        lambda root: (root / "meta/interference.json").unlink(),
        MissingFileError,
        r"not one of history sessions: meta/interference\.json is missing\n"
        "Build one from it: robomme-interference build distractors --source lerobot:",
    ),
    "an unknown format version": (
        lambda root: edit_json(
            root / "meta/interference.json", lambda v: v.update(format_version=2)
        ),
        FormatError,
        "has format version 2; this package reads 1\nInstall the version",
    ),
    "identity without a revision": (
        lambda root: edit_json(root / "meta/interference.json", lambda v: v.pop("revision")),
        FormatError,
        r"interference\.json lacks revision",
    ),
    "no episode table": (
        lambda root: (root / EPISODES).unlink(),
        MissingFileError,
        "meta/episodes holds no parquet file in .*demonstrations\nThe dataset is not complete",
    ),
    "episode table is garbage": (
        lambda root: (root / EPISODES).write_bytes(b"garbage" * 100),
        FormatError,
        r"file-000\.parquet cannot be read: .*\nThe file is damaged",
    ),
    "episode table is empty": (
        lambda root: (root / EPISODES).write_bytes(b""),
        FormatError,
        r"file-000\.parquet cannot be read",
    ),
    "episode table is cut": (
        lambda root: (root / EPISODES).write_bytes((root / EPISODES).read_bytes()[:-100]),
        FormatError,
        r"file-000\.parquet cannot be read",
    ),
    "episode table without a row": (
        lambda root: edit_table(root / EPISODES, lambda table: table.slice(1)),
        FormatError,
        "does not list the episodes 0 to 7, one row each and in order",
    ),
    "episode table in another order": (
        lambda root: edit_table(root / EPISODES, lambda table: table.take([1, 0, *range(2, 8)])),
        FormatError,
        "does not list the episodes 0 to 7, one row each and in order",
    ),
    "a second table that does not fit": (
        lambda root: pq.write_table(
            pq.ParquetFile(root / EPISODES)
            .read()
            .drop_columns(["goals"])
            .append_column("goals", pa.array(range(8))),
            root / "meta/episodes/chunk-000/file-001.parquet",
        ),
        FormatError,
        "cannot be read",
    ),
    **{
        f"episode table without {column}": (
            lambda root, column=column: edit_table(
                root / EPISODES, lambda table: table.drop_columns([column])
            ),
            FormatError,
            f"lacks {column}",
        )
        for column in REQUIRED_COLUMNS
    },
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_named(name: str, tmp_path: Path) -> None:
    damage, error, message = DAMAGES[name]
    root = tmp_path / "demonstrations"
    shutil.copytree(factories.split() / "demonstrations", root)
    use_everything(root)
    damage(root)
    with pytest.raises(error, match=message):
        use_everything(root)


def test_a_table_in_several_files_is_one(tmp_path: Path) -> None:
    """LeRobot's own writer begins a new file when one grows large."""
    root = tmp_path / "demonstrations"
    shutil.copytree(factories.split() / "demonstrations", root)
    whole = list(Dataset(LocalFiles(root)).records())
    table = pq.ParquetFile(root / EPISODES).read()
    for number, start in enumerate((0, 3, 7)):
        part = table.slice(start, (3, 4, 1)[number])
        pq.write_table(part, root / f"meta/episodes/chunk-000/file-00{number}.parquet")
    assert list(Dataset(LocalFiles(root)).records()) == whole
    use_everything(root)
