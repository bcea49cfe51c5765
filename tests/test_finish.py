"""Our columns, identity and report in a dataset, and what LeRobot's own tools make of them."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from recordings import MemorySource, build, images_of, listed, opened, run_here, vectors_of

from robomme_interference_data.build_dataset import build as build_module
from robomme_interference_data.build_dataset import finish
from robomme_interference_data.build_dataset.encode import CODECS
from robomme_interference_data.build_dataset.finish import finish_dataset, revision_of
from robomme_interference_data.build_dataset.plan import plan_dataset
from robomme_interference_data.build_dataset.stage import stage_episode
from robomme_interference_data.build_dataset.writer import write_dataset
from robomme_interference_data.errors import BuildError

pytestmark = pytest.mark.filterwarnings("ignore:Cannot enable progress bars")

FRONT, WRIST = "observation.images.front", "observation.images.wrist"
FEATURES = (FRONT, WRIST, "observation.state", "action")
TABLE = "meta/episodes/chunk-000/file-000.parquet"

EPISODES = [
    listed("MoveCube/val/12", lesson=4, length=300, seed=None, difficulty=None, simulator=None),
    listed("Drawer/test/0", lesson=2, length=280, seed=2**40, exact=False, goals=("open it",)),
    listed("MoveCube/test/3", lesson=3, length=249, seed=0, difficulty="hard"),
    listed("MoveCube/train/0", lesson=0, length=248),
]


@pytest.fixture(scope="module", autouse=True)
def _here():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build_module, "run_tasks", run_here)
        yield


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finish") / "demonstrations"
    source = MemorySource(EPISODES, provenance={"kind": "memory", "revision": "abc"})
    build("demonstrations", source, out, version="2.1.0")
    return out


@pytest.fixture(scope="module")
def units(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finish") / "units"
    build("distractors", MemorySource(EPISODES), out)
    return out


def rows(root: Path) -> list[dict]:
    table = pq.read_table(root / TABLE)
    return table.select([n for n in table.column_names if not n.startswith("stats/")]).to_pylist()


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


# --- columns ------------------------------------------------------------------------------------

COLUMNS = [
    ("episode_id", pa.string()),
    ("family", pa.string()),
    ("split", pa.string()),
    ("source_episode", pa.int64()),
    ("goals", pa.list_(pa.string())),
    ("seed", pa.int64()),
    ("difficulty", pa.string()),
    ("simulator", pa.string()),
    ("raw_length", pa.int64()),
    ("exec_start_idx", pa.int64()),
    ("exact", pa.bool_()),
    ("sha256", pa.string()),
    ("lesson_sha256", pa.string()),
    *((f"sha256/{name}", pa.string()) for name in FEATURES),
]
LESSON_COLUMNS = [(f"lesson_sha256/{name}", pa.string()) for name in FEATURES]


def test_names_and_types(demonstrations: Path, units: Path) -> None:
    for root, expected in ((demonstrations, COLUMNS + LESSON_COLUMNS), (units, COLUMNS)):
        schema = pq.read_schema(root / TABLE)
        own = [(field.name, field.type) for field in schema][-len(expected) :]
        assert own == expected
        others = schema.names[: -len(expected)]
        prefixes = ("data/", "videos/", "meta/", "stats/", "dataset_")
        assert all(n.startswith(prefixes) for n in others[3:])
        assert others[:3] == ["episode_index", "tasks", "length"]


def test_values_of_demonstrations(demonstrations: Path) -> None:
    first, second, third = rows(demonstrations)
    assert [row["episode_id"] for row in (first, second, third)] == [
        "MoveCube/val/12",
        "MoveCube/test/3",
        "Drawer/test/0",
    ]
    expected = {
        "episode_index": 0,
        "length": 5,
        "family": "MoveCube",
        "split": "val",
        "source_episode": 12,
        "tasks": ["do MoveCube"],
        "goals": ["do MoveCube", "another wording"],
        "seed": None,
        "difficulty": None,
        "simulator": None,
        "raw_length": 300,
        "exec_start_idx": 4,
        "exact": True,
    }
    assert {name: first[name] for name in expected} == expected
    expected = {
        "episode_index": 2,
        "length": 3,
        "goals": ["open it"],
        "seed": 2**40,
        "difficulty": "easy",
        "simulator": "made-up",
        "raw_length": 280,
        "exec_start_idx": 2,
        "exact": False,
    }
    assert {name: third[name] for name in expected} == expected
    assert (second["seed"], second["difficulty"], second["exact"]) == (0, "hard", True)
    assert [row["meta/episodes/file_index"] for row in (first, second, third)] == [0, 0, 0]


def test_values_of_units(units: Path) -> None:
    for row in rows(units):
        assert row["length"] == 32
        assert row["exec_start_idx"] is None
        assert row["lesson_sha256"] is None
    assert [row["raw_length"] for row in rows(units)] == [300, 249, 280]


@pytest.mark.parametrize("prefix", ["", "lesson_"])
def test_hashes(demonstrations: Path, prefix: str) -> None:
    for row, lesson in zip(rows(demonstrations), (4, 3, 2), strict=True):
        episode = next(e for e in EPISODES if str(e.id) == row["episode_id"])
        frames = lesson + (prefix == "")
        parts = {
            FRONT: images_of(episode, "front"),
            WRIST: images_of(episode, "wrist"),
            "observation.state": vectors_of(episode, "state", 8),
            "action": vectors_of(episode, "action", 8),
        }
        digests = {name: sha256(values[:frames].tobytes()) for name, values in parts.items()}
        assert {name: row[f"{prefix}sha256/{name}"] for name in parts} == digests
        text = ",".join(f'"{name}":"{digests[name]}"' for name in sorted(digests))
        assert row[f"{prefix}sha256"] == sha256(f"{{{text}}}".encode())


def test_row_groups_are_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finish, "_ROW_GROUP", 2)
    build("distractors", MemorySource(EPISODES), tmp_path / "out", cameras=("front",))
    file = pq.ParquetFile(tmp_path / "out" / TABLE)
    assert [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)] == [2, 1]


# --- identity and report -------------------------------------------------------------------------


def test_identity(demonstrations: Path) -> None:
    own = [name for name, _ in COLUMNS + LESSON_COLUMNS]
    lines = [
        json.dumps(
            {name: row[name] for name in own},
            sort_keys=True,
            separators=(",", ":"),
            ensure_ascii=False,
        )
        for row in rows(demonstrations)
    ]
    assert json.loads((demonstrations / "meta/interference.json").read_text()) == {
        "format_version": 1,
        "kind": "demonstrations",
        "name": "demonstrations",
        "version": "2.1.0",
        "revision": sha256("".join(line + "\n" for line in lines).encode()),
        "exact": False,
        "codec": "av1-lossless",
        "cameras": ["front", "wrist"],
        "unit": None,
        "simulators": ["made-up"],
        "sources": [{"kind": "memory", "revision": "abc"}],
        "counts": {"episodes": 3, "frames": 12, "families": {"MoveCube": 2, "Drawer": 1}},
    }


def test_identity_of_units(units: Path) -> None:
    identity = opened(units).identity
    assert identity["unit"] == {"frames": 32, "stride": 8}
    assert identity["kind"] == "distractors"
    assert identity["counts"] == {
        "episodes": 3,
        "frames": 96,
        "families": {"MoveCube": 2, "Drawer": 1},
    }


def test_report(demonstrations: Path, units: Path) -> None:
    report = json.loads((demonstrations / "meta/build_report.json").read_text())
    assert report == {
        "format_version": 1,
        "kind": "demonstrations",
        "counts": {
            "episodes": 3,
            "frames": 12,
            "families": {"MoveCube": 2, "Drawer": 1},
            "skipped": 1,
        },
        "skipped": [
            {"episode_id": "MoveCube/train/0", "raw_length": 248, "why": "no demonstration frame"}
        ],
    }
    (skipped,) = json.loads((units / "meta/build_report.json").read_text())["skipped"]
    assert skipped["why"] == "248 raw frames; a unit needs 249"


def test_json_files_are_for_people(demonstrations: Path) -> None:
    for name in ("interference", "build_report"):
        text = (demonstrations / f"meta/{name}.json").read_text()
        value = json.loads(text)
        assert text == json.dumps(value, indent=2, sort_keys=True, ensure_ascii=False) + "\n"


@pytest.mark.parametrize(
    "change",
    [{"seed": 7}, {"goals": ["a"]}, {"exact": False}, {"sha256": "0"}, {"new column": None}],
    ids=lambda change: next(iter(change)),
)
def test_the_revision_depends_on_every_column(change: dict) -> None:
    first = {"episode_id": "A/train/0", "seed": None, "goals": ["b"], "exact": True, "sha256": "1"}
    other = {**first, "episode_id": "A/train/1"}
    revisions = {
        revision_of([first, other]),
        revision_of([{**first, **change}, other]),
        revision_of([first, {**other, **change}]),
    }
    assert len(revisions) == 3
    assert revision_of([dict(reversed(first.items())), other]) in revisions


def test_everything_is_recorded_as_not_exact_with_the_lossy_codec(tmp_path: Path) -> None:
    episodes = [listed("Drawer/train/0", size=(64, 64)), listed("Drawer/train/1", size=(64, 64))]
    build("distractors", MemorySource(episodes), tmp_path / "out", codec="lerobot-default")
    dataset = opened(tmp_path / "out")
    assert dataset.identity["exact"] is False
    assert dataset.identity["codec"] == "lerobot-default"
    assert [record.exact for record in dataset.records()] == [False, False]
    # The hashes are over what a reader decodes.
    for record in dataset.records():
        assert dataset.span_digests(record.episode_index, 0, 32) == record.feature_sha256
        assert record.feature_sha256[FRONT] != sha256(
            images_of(episodes[record.episode_index], "front")[:256:8].tobytes()
        )


# --- videos that are not the staged ones ---------------------------------------------------------


@pytest.mark.parametrize("harm", ["other frames", "one frame less", "other order"])
def test_a_video_that_lerobot_wrote_otherwise_is_found(tmp_path: Path, harm: str) -> None:
    episodes = [listed(f"Drawer/test/{i}", lesson=3) for i in range(3)]
    plan = plan_dataset("demonstrations", [episodes])
    source = MemorySource([*episodes, listed("Drawer/test/9", lesson=3)])
    codec = CODECS["av1-lossless"]
    staged = [
        stage_episode(source, item, ("front",), codec, 10, tmp_path / str(item.episode.id.index))
        for item in plan.episodes
    ]
    pairs = list(zip(plan.episodes, staged, strict=True))
    for _ in write_dataset(tmp_path / "out", "demonstrations", pairs, ("front",), codec, 10):
        pass
    if harm == "other order":
        videos = [tmp_path / f"{i}/front.mp4" for i in (0, 1)]
        contents = [path.read_bytes() for path in videos]
        videos[0].write_bytes(contents[1])
        videos[1].write_bytes(contents[0])
    else:
        other = listed("Drawer/test/9", lesson=3 if harm == "other frames" else 2)
        item = plan_dataset("demonstrations", [[other]]).episodes[0]
        stage_episode(source, item, ("front",), codec, 10, tmp_path / "other")
        shutil.copy(tmp_path / "other/front.mp4", tmp_path / "1/front.mp4")
    with pytest.raises(BuildError, match=r"file-000.mp4 of observation.images.front") as raised:
        finish_dataset(tmp_path / "out", "demonstrations", "1.0.0", plan, pairs, codec, [])
    assert "Drawer/test/0, Drawer/test/1, Drawer/test/2" in str(raised.value)
    assert not (tmp_path / "out/meta/interference.json").exists()


# --- LeRobot's own reader and tools --------------------------------------------------------------


def lerobot(root: Path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("local/test", root=root, video_backend="pyav")


def test_lerobot_reads_and_selects_by_the_columns(demonstrations: Path) -> None:
    meta = lerobot(demonstrations).meta
    assert list(meta.episodes["family"]) == ["MoveCube", "MoveCube", "Drawer"]
    assert list(meta.episodes["exec_start_idx"]) == [4, 3, 2]
    assert meta.episodes[2]["goals"] == ["open it"]
    assert meta.filter_episodes(lambda row: row["family"] == "MoveCube") == [0, 1]
    assert meta.filter_episodes(lambda row: row["exact"] and row["seed"] is None) == [0]
    with_selection = type(lerobot(demonstrations))(
        "local/test", root=demonstrations, episodes=[1], video_backend="pyav"
    )
    assert len(with_selection) == 4


def own(root: Path) -> list[dict]:
    """Our columns of a dataset that lerobot wrote."""
    (path,) = sorted(root.glob("meta/episodes/*/*.parquet"))
    table = pq.read_table(path)
    names = [name for name, _ in COLUMNS + LESSON_COLUMNS if name in table.column_names]
    return table.select(names).to_pylist()


def test_merging_keeps_our_columns(demonstrations: Path, units: Path, tmp_path: Path) -> None:
    from lerobot.datasets.dataset_tools import merge_datasets

    merge_datasets([lerobot(demonstrations), lerobot(units)], "local/merged", tmp_path / "out")
    assert own(tmp_path / "out")[:3] == own(demonstrations)
    merged = [{k: v for k, v in row.items() if v is not None} for row in own(tmp_path / "out")]
    assert merged[3:] == [{k: v for k, v in row.items() if v is not None} for row in own(units)]
    # Integers beside nulls have become floats, and there is no identity: it is no dataset of ours.
    schema = pq.read_schema(tmp_path / "out" / TABLE)
    assert schema.field("exec_start_idx").type == pa.float64()
    assert schema.field("raw_length").type == pa.int64()
    assert not (tmp_path / "out/meta/interference.json").exists()
    # The frames are still the same.
    dataset = lerobot(tmp_path / "out")
    pixels = np.round(dataset[12]["observation.images.front"].numpy() * 255).transpose(1, 2, 0)
    assert np.array_equal(pixels, images_of(EPISODES[0], "front")[0])


def test_changing_features_and_tasks_keeps_our_columns(units: Path, tmp_path: Path) -> None:
    from lerobot.datasets.dataset_tools import modify_tasks, remove_feature

    remove_feature(lerobot(units), "action", tmp_path / "out", "local/removed")
    assert own(tmp_path / "out") == own(units)
    modify_tasks(lerobot(tmp_path / "out"), new_task="do it")
    assert own(tmp_path / "out") == own(units)


def test_deleting_and_splitting_drops_our_columns(tmp_path: Path) -> None:
    from lerobot.datasets.dataset_tools import delete_episodes, split_dataset

    episodes = [listed(f"{f}/train/0", size=(64, 64)) for f in ("MoveCube", "Drawer")]
    root = tmp_path / "out"
    build("distractors", MemorySource(episodes), root, codec="lerobot-default", cameras=("front",))
    delete_episodes(lerobot(root), [1], tmp_path / "deleted", "local/deleted")
    split_dataset(lerobot(root), {"a": [0], "b": [1]}, tmp_path / "split")
    for folder in ("deleted", "split/a", "split/b"):
        (path,) = sorted((tmp_path / folder).glob("meta/episodes/*/*.parquet"))
        names = pq.read_schema(path).names
        assert "dataset_to_index" in names
        assert not {name for name, _ in COLUMNS + LESSON_COLUMNS} & set(names)


def test_deleting_and_splitting_is_refused_for_the_lossless_codec(
    units: Path, tmp_path: Path
) -> None:
    from lerobot.datasets.dataset_tools import delete_episodes, split_dataset

    # info.json names the codec "av1", which these tools take for SVT-AV1; that cannot do RGB.
    with pytest.raises(ValueError, match="gbrp"):
        delete_episodes(lerobot(units), [1], tmp_path / "deleted", "local/deleted")
    with pytest.raises(ValueError, match="gbrp"):
        split_dataset(lerobot(units), {"a": [0], "b": [1, 2]}, tmp_path / "split")


def test_the_codec_does_not_hide_that_the_source_was_lossy(units: Path) -> None:
    exact = {row["episode_id"]: row["exact"] for row in rows(units)}
    assert exact == {"MoveCube/val/12": True, "MoveCube/test/3": True, "Drawer/test/0": False}
