"""The manifests of a split: their rows, their files, and what is refused."""

import itertools
import json
from pathlib import Path

import made_splits
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_splits import metadata_only, named, queries, units, write
from recordings import contents, listed

from robomme_interference_data import Dataset
from robomme_interference_data.build_dataset.manifest_rows import check_history
from robomme_interference_data.build_dataset.manifests import expected_rows, plan_manifests
from robomme_interference_data.errors import (
    HistoryTooLongError,
    InvalidOptionError,
    PoolTooSmallError,
    SourceError,
)
from robomme_interference_data.ids import EpisodeId

K = (0, 1, 3)
FILES = ["buffers.jsonl", "buffers.parquet", "manifest.json"]


@pytest.fixture(name="pair")
def _pair() -> tuple[Dataset, Dataset]:
    return made_splits.pair()


# --- rows ---------------------------------------------------------------------------------------


def test_every_field_by_hand(tmp_path: Path) -> None:
    demonstrations = metadata_only(
        tmp_path / "d",
        "demonstrations",
        [
            listed("MoveCube/test/0", lesson=9),
            listed("MoveCube/test/3", lesson=5, seed=None, difficulty="hard", simulator=None),
        ],
    )
    distractors = units(tmp_path / "u", ["MoveCube/train/0", "PatternLock/train/4"], exact=False)
    rows = write(plan_manifests(demonstrations, distractors, (0, 1)), tmp_path / "out")
    record, unit = demonstrations.record(1), distractors.record(1)
    lesson = {
        "role": "lesson",
        "family": "MoveCube",
        "source": "MoveCube/test/3",
        "dataset": "demonstrations",
        "revision": demonstrations.revision,
        "episode_index": 1,
        "start": 0,
        "stop": 5,
        "repeat": 1,
        "sha256": record.lesson_sha256,
    }
    distractor = {
        "role": "distractor",
        "family": "PatternLock",
        "source": "PatternLock/train/4",
        "dataset": "distractors",
        "revision": distractors.revision,
        "episode_index": 1,
        "start": 0,
        "stop": 32,
        "repeat": 1,
        "sha256": unit.sha256,
    }
    row = {
        "episode_id": "MoveCube/test/3",
        "family": "MoveCube",
        "split": "test",
        "index": 3,
        "k": 0,
        "condition": "k0",
        "goals": ["do MoveCube", "another wording"],
        "seed": None,
        "difficulty": "hard",
        "simulator": None,
        "exact": True,
        "lesson_frames": 5,
        "history_frames": 5,
        "lesson_share": 5 / 6,  # five lesson frames and the first live observation
        "query": {
            "dataset": "demonstrations",
            "revision": demonstrations.revision,
            "episode_index": 1,
            "frame": 5,
        },
        "sessions": [lesson],
    }
    assert rows[2] == row
    assert rows[3] == {
        **row,
        "k": 1,
        "condition": "k1",
        "exact": False,
        "history_frames": 37,
        # Sample j is frame ⌊37j / 31⌋: 0, 1, 2, 3, 4 for j = 0 … 4, then 5.
        "lesson_share": 5 / 32,
        "sessions": [lesson, distractor],
    }
    assert record.lesson_sha256 != record.sha256


def test_rows_come_in_canonical_order(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    rows = write(plan_manifests(*pair, (3, 0, 1)), tmp_path)
    assert [(row["episode_id"], row["k"]) for row in rows] == list(
        itertools.product(
            [
                "MoveCube/val/1",
                "MoveCube/test/0",
                "MoveCube/test/2",
                "InsertPeg/test/9",
                "InsertPeg/test/10",
                "Drawer/test/0",
            ],
            (0, 1, 3),
        )
    )


def test_the_rules_hold(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    rows = write(plan_manifests(*pair, (0, 1, 2, 3, 6), seed=4), tmp_path)
    pool = set(pair[1].episodes["episode_id"].to_pylist())
    for _, buffers in itertools.groupby(rows, lambda row: row["episode_id"]):
        nested = list(buffers)
        largest = nested[-1]["sessions"]
        for row in nested:
            assert row["sessions"] == largest[: 1 + row["k"]]
            assert row["history_frames"] == 5 + 32 * row["k"]
        sources = [session["source"] for session in largest[1:]]
        families = [session["family"] for session in largest[1:]]
        assert len(set(sources)) == 6
        assert set(sources) <= pool
        assert largest[0]["family"] not in families
        assert len(set(families[:3])) == 3  # four families, less the query's own


def test_sessions_name_the_stored_episodes(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    datasets = {dataset.kind: dataset for dataset in pair}
    for row in write(plan_manifests(*pair, (3,)), tmp_path):
        for session in row["sessions"]:
            dataset = datasets[session["dataset"]]
            record = dataset.record(session["episode_index"])
            assert str(record.id) == session["source"]
            assert record.id.family == session["family"]
            assert session["revision"] == dataset.revision
            if session["role"] == "lesson":
                assert session["sha256"] == record.lesson_sha256
                assert session["stop"] == record.exec_start_idx
            else:
                assert session["sha256"] == record.sha256


def test_a_buffer_is_exact_if_all_its_sessions_are(tmp_path: Path) -> None:
    demonstrations = metadata_only(
        tmp_path / "d",
        "demonstrations",
        [listed("MoveCube/test/0"), listed("MoveCube/test/1", exact=False)],
    )
    distractors = metadata_only(
        tmp_path / "u",
        "distractors",
        [listed("InsertPeg/train/0", exact=False), listed("PatternLock/train/0")],
    )
    for row in write(plan_manifests(demonstrations, distractors, (0, 1, 2)), tmp_path / "out"):
        sources = {session["source"] for session in row["sessions"]}
        lossy = {"MoveCube/test/1", "InsertPeg/train/0"}
        assert row["exact"] == (not sources & lossy)


@given(
    sizes=st.dictionaries(
        st.sampled_from(["MoveCube", "InsertPeg", "PatternLock", "Drawer"]),
        st.integers(1, 4),
        min_size=2,
    ),
    seed=st.integers(0, 2**32),
)
@settings(max_examples=15)
def test_any_pool(
    tmp_path_factory: pytest.TempPathFactory, sizes: dict[str, int], seed: int
) -> None:
    folder = tmp_path_factory.mktemp("pool")
    datasets = queries(folder / "d", ["MoveCube/test/1"]), units(folder / "u", named(sizes))
    others = {family: size for family, size in sizes.items() if family != "MoveCube"}
    total = sum(others.values())
    empty, full = expected_rows(plan_manifests(*datasets, (0, total), seed))
    assert empty["sessions"] == full["sessions"][:1]
    drawn = [session["source"] for session in full["sessions"][1:]]
    assert sorted(drawn) == sorted(named(others))  # each once, none of the query's own family
    families = [session["family"] for session in full["sessions"][1:]]
    assert len(set(families[: len(others)])) == len(others)
    with pytest.raises(PoolTooSmallError, match=f"needs {total + 1} .* the pool has {total}"):
        list(expected_rows(plan_manifests(*datasets, (0, total + 1), seed)))


def test_the_draw_does_not_depend_on_how_the_datasets_are_ordered(tmp_path: Path) -> None:
    tests = [listed(f"MoveCube/test/{i}") for i in range(3)]
    train = [listed(name) for name in named({"InsertPeg": 3, "PatternLock": 2, "Drawer": 2})]
    found = []
    for backwards in (False, True):
        folder = tmp_path / str(backwards)
        plan = plan_manifests(
            metadata_only(folder / "d", "demonstrations", tests, backwards=backwards),
            metadata_only(folder / "u", "distractors", train, backwards=backwards),
        )
        rows = write(plan, folder / "out")
        for row in rows:  # where an episode stands is named, and so is the dataset's revision
            for place in (row["query"], *row["sessions"]):
                del place["revision"], place["episode_index"]
        found.append(rows)
    assert found[0] == found[1]


def test_the_seed_changes_the_draw_and_nothing_else(
    pair: tuple[Dataset, Dataset], tmp_path: Path
) -> None:
    one = write(plan_manifests(*pair, K, seed=0), tmp_path / "0")
    other = write(plan_manifests(*pair, K, seed=1), tmp_path / "1")
    drawn = [[[s["source"] for s in row["sessions"]] for row in rows] for rows in (one, other)]
    assert drawn[0] != drawn[1]
    assert [row["sessions"][0] for row in one] == [row["sessions"][0] for row in other]


def test_many_distractors(tmp_path: Path) -> None:
    demonstrations = queries(tmp_path / "d", ["MoveCube/test/0", "MoveCube/test/1"])
    distractors = units(tmp_path / "u", named({"MoveCube": 5, "InsertPeg": 40, "Drawer": 23}))
    rows = write(plan_manifests(demonstrations, distractors, (0, 63)), tmp_path / "out")
    assert [len(row["sessions"]) for row in rows] == [1, 64, 1, 64]
    # All 63 units of the other families, each once.
    assert all(len({s["source"] for s in row["sessions"]}) == 64 for row in rows[1::2])
    assert rows[1]["history_frames"] == 5 + 32 * 63


# --- what is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize(("lesson", "k"), [(2796, 0), (2764, 1), (2572, 7), (780, 63)])
def test_position_limit(lesson: int, k: int) -> None:
    query = EpisodeId("MoveCube", "test", 0)
    assert lesson + 32 * k + 1300 == 4096
    check_history(query, lesson, k, 4096)
    with pytest.raises(HistoryTooLongError) as raised:
        check_history(query, lesson + 1, k, 4096)
    assert str(raised.value) == (
        f"MoveCube/test/0 at k={k} needs 4097 positions ({lesson + 1} lesson + 32·{k} distractor "
        "frames + 1300 steps); the released servers hold 4096\n"
        "Plan a smaller k, or --position-limit none for systems without such a limit."
    )
    check_history(query, lesson + 1, k, None)


@pytest.mark.parametrize(("lesson", "limit", "fits"), [(2732, 4096, True), (2733, 4096, False)])
def test_the_limit_holds_for_the_largest_k(
    tmp_path: Path, lesson: int, limit: int, fits: bool
) -> None:
    demonstrations = queries(tmp_path / "d", ["MoveCube/test/0"], lesson=lesson, length=3000)
    distractors = units(tmp_path / "u", named({"Drawer": 2}))
    plan = plan_manifests(demonstrations, distractors, (0, 2), position_limit=limit)
    if fits:
        assert len(write(plan, tmp_path / "out")) == 2
        return
    with pytest.raises(HistoryTooLongError, match="MoveCube/test/0 at k=2 needs 4097"):
        write(plan, tmp_path / "out")
    assert contents(tmp_path / "out") == {}
    lifted = plan_manifests(demonstrations, distractors, (0, 2), position_limit=None)
    assert len(write(lifted, tmp_path / "out")) == 2
    assert json.loads((tmp_path / "out/manifest.json").read_text())["position_limit"] is None


@pytest.mark.parametrize("k", [(), (0, 0), (1, 3, 1), (-1,), (64,), (0, 100)])
def test_numbers_of_distractors(pair: tuple[Dataset, Dataset], k: tuple[int, ...]) -> None:
    with pytest.raises(InvalidOptionError, match="expected distinct numbers from 0 to 63"):
        plan_manifests(*pair, k)


def test_datasets_of_the_wrong_kind(pair: tuple[Dataset, Dataset]) -> None:
    with pytest.raises(
        InvalidOptionError, match=r"--demonstrations .* is a dataset of distractors"
    ):
        plan_manifests(pair[1], pair[1])
    with pytest.raises(InvalidOptionError, match=r"--distractors .* of demonstrations") as raised:
        plan_manifests(pair[0], pair[0])
    assert "robomme-interference build distractors" in str(raised.value)


@pytest.mark.parametrize(("split", "found"), [("test", "test, train"), ("val", "train, val")])
def test_units_of_other_splits(tmp_path: Path, split: str, found: str) -> None:
    demonstrations = queries(tmp_path / "d", ["MoveCube/test/0"])
    distractors = units(tmp_path / "u", ["InsertPeg/train/0", f"InsertPeg/{split}/1"])
    with pytest.raises(SourceError, match=f"train episodes.*found {found}") as raised:
        plan_manifests(demonstrations, distractors)
    assert "--split train" in str(raised.value)


@pytest.mark.parametrize(
    "values", [{"cameras": ("front",)}, {"size": (8, 8)}, {"state_size": 7}], ids=str
)
def test_datasets_with_other_features(tmp_path: Path, values: dict) -> None:
    demonstrations = queries(tmp_path / "d", ["MoveCube/test/0"])
    distractors = units(tmp_path / "u", ["InsertPeg/train/0"], **values)
    with pytest.raises(SourceError, match="cannot follow one another in a buffer") as raised:
        plan_manifests(demonstrations, distractors)
    assert "--cameras" in str(raised.value)


@pytest.mark.parametrize("size", [None, 7])
def test_actions_may_differ_as_no_buffer_shows_them(tmp_path: Path, size: int | None) -> None:
    demonstrations = queries(tmp_path / "d", ["MoveCube/test/0"])
    distractors = units(tmp_path / "u", ["InsertPeg/train/0"], action_size=size)
    assert len(write(plan_manifests(demonstrations, distractors, (1,)), tmp_path / "out")) == 1


def test_a_pool_that_is_too_small(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    # MoveCube has three of the nine units, so its queries can have six.
    with pytest.raises(PoolTooSmallError, match=r"MoveCube/val/1 needs 7 .* the pool has 6"):
        write(plan_manifests(*pair, (0, 7)), tmp_path / "out")
    assert contents(tmp_path) == {}
