"""The manifests of a split: their rows, their files, and what is refused."""

import fcntl
import hashlib
import itertools
import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_splits import metadata_only
from recordings import contents, listed
from typer.testing import CliRunner

from robomme_interference_data import Dataset
from robomme_interference_data.build_dataset import manifests
from robomme_interference_data.build_dataset.manifests import (
    check_history,
    expected_rows,
    plan_manifests,
    write_manifests,
)
from robomme_interference_data.cli import app
from robomme_interference_data.errors import (
    BuildError,
    HistoryTooLongError,
    InvalidOptionError,
    PoolTooSmallError,
    SourceError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.manifest_io import SCHEMA

K = (0, 1, 3)
FILES = ["buffers.jsonl", "buffers.parquet", "manifest.json"]


def queries(folder: Path, names: list[str], lesson: int = 5, **values) -> Dataset:
    episodes = [listed(name, lesson=lesson, **values) for name in names]
    return metadata_only(folder, "demonstrations", episodes)


def units(folder: Path, names: list[str], **values) -> Dataset:
    return metadata_only(folder, "distractors", [listed(name, **values) for name in names])


def named(families: dict[str, int], split: str = "train") -> list[str]:
    return [f"{family}/{split}/{i}" for family, count in families.items() for i in range(count)]


def write(plan: manifests.ManifestPlan, out: Path) -> list[dict]:
    """Write the manifests, and return the rows of the parquet file."""
    for _ in write_manifests(plan, out):
        pass
    return pq.read_table(out / "buffers.parquet").to_pylist()


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, Dataset]:
    """Queries of three families and nine units of four: tables only."""
    folder = tmp_path_factory.mktemp("manifests")
    tests = ["MoveCube/test/0", "MoveCube/test/2", "InsertPeg/test/10", "InsertPeg/test/9"]
    return (
        queries(folder / "d", [*tests, "Drawer/test/0", "MoveCube/val/1"]),
        units(folder / "u", named({"MoveCube": 3, "InsertPeg": 2, "PatternLock": 3, "Drawer": 1})),
    )


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
    demonstrations = queries(folder / "d", ["MoveCube/test/1", "RouteStick/test/0"])
    plan = plan_manifests(demonstrations, units(folder / "u", named(sizes)), (0, 1), seed)
    others = {"MoveCube": sum(sizes.values()) - sizes.get("MoveCube", 0)}
    if others["MoveCube"] == 0:
        with pytest.raises(PoolTooSmallError):
            list(expected_rows(plan))
        return
    rows = list(expected_rows(plan))
    assert [row["k"] for row in rows] == [0, 1, 0, 1]
    assert all(row["sessions"][-1]["family"] != row["family"] for row in rows if row["k"])


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


# --- files --------------------------------------------------------------------------------------


def test_header(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    write(plan_manifests(*pair, (1, 3), seed=7), tmp_path)
    files = {name: (tmp_path / name).read_bytes() for name in FILES[:2]}
    assert json.loads((tmp_path / "manifest.json").read_text()) == {
        "format_version": 1,
        "rule_version": 1,
        "seed": 7,
        "k": [1, 3],
        "position_limit": 4096,
        "datasets": {
            "demonstrations": {
                "name": "demonstrations",
                "version": "1.0.0",
                "revision": pair[0].revision,
                "exact": True,
                "simulators": ["made-up"],
                "counts": {
                    "episodes": 6,
                    "frames": 36,
                    "families": {"MoveCube": 3, "InsertPeg": 2, "Drawer": 1},
                },
            },
            "distractors": {
                "name": "distractors",
                "version": "1.0.0",
                "revision": pair[1].revision,
                "exact": True,
                "simulators": ["made-up"],
                "counts": {
                    "episodes": 9,
                    "frames": 288,
                    "families": {"MoveCube": 3, "InsertPeg": 2, "PatternLock": 3, "Drawer": 1},
                },
            },
        },
        # Six queries, two buffers each, of 2 and 4 sessions.
        "counts": {"queries": 6, "buffers": 12, "sessions": 36},
        "files": {
            name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            for name, data in files.items()
        },
    }


def test_json_lines_are_the_rows(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    rows = write(plan_manifests(*pair, K), tmp_path)
    lines = (tmp_path / "buffers.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line) for line in lines] == rows
    assert all(list(json.loads(line)) == SCHEMA.names for line in lines)
    assert pq.read_schema(tmp_path / "buffers.parquet") == SCHEMA


def test_json_lines_with_letters_of_all_kinds(tmp_path: Path) -> None:
    goal = 'place the „Würfel"\n立方体'
    demonstrations = queries(tmp_path / "d", ["MoveCube/test/0"], goals=(goal,))
    plan = plan_manifests(demonstrations, units(tmp_path / "u", ["Drawer/train/0"]), (0, 1))
    rows = write(plan, tmp_path / "out")
    lines = (tmp_path / "out/buffers.jsonl").read_text(encoding="utf-8").split("\n")
    assert [json.loads(line) for line in lines if line] == rows
    assert rows[0]["goals"] == [goal]
    assert "立方体" in lines[0]


def test_the_same_inputs_give_the_same_bytes(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    write(plan_manifests(*pair, (0, 1, 3)), tmp_path / "one")
    reopened = [Dataset(dataset.files) for dataset in pair]
    write(plan_manifests(*reopened, (3, 1, 0)), tmp_path / "two")
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    assert sorted(contents(tmp_path)) == [f"{n}/{f}" for n in ("one", "two") for f in FILES]


def test_batches_do_not_show(
    pair: tuple[Dataset, Dataset], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_manifests(*pair, K)
    assert list(write_manifests(plan, tmp_path / "one")) == [6]
    monkeypatch.setattr(manifests, "_BATCH", 4)
    assert list(write_manifests(plan, tmp_path / "two")) == [4, 2]
    jsonl = [(tmp_path / name / "buffers.jsonl").read_bytes() for name in ("one", "two")]
    assert jsonl[0] == jsonl[1]
    tables = [pq.read_table(tmp_path / name / "buffers.parquet") for name in ("one", "two")]
    assert tables[0] == tables[1]
    groups = pq.ParquetFile(tmp_path / "two/buffers.parquet").metadata
    assert max(groups.row_group(i).num_rows for i in range(groups.num_row_groups)) == 4


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


# --- interrupted writing ------------------------------------------------------------------------


def vouched(out: Path) -> None:
    """If there is a manifest.json, the files that it names are the ones that it names."""
    assert set(contents(out)) <= set(FILES)
    if (out / "manifest.json").exists():
        for name, recorded in json.loads((out / "manifest.json").read_text())["files"].items():
            data = (out / name).read_bytes()
            assert recorded == {
                "bytes": len(data),
                "sha256": hashlib.sha256(data).hexdigest(),
            }


def test_an_abandoned_run_leaves_nothing(
    pair: tuple[Dataset, Dataset], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(manifests, "_BATCH", 2)
    running = write_manifests(plan_manifests(*pair, K), tmp_path / "out")
    assert next(running) == 2
    running.close()
    assert contents(tmp_path) == {}
    write(plan_manifests(*pair, K), tmp_path / "out")
    before = contents(tmp_path)
    running = write_manifests(plan_manifests(*pair, K, seed=1), tmp_path / "out")
    next(running)
    running.close()
    assert contents(tmp_path) == before
    vouched(tmp_path / "out")


@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.parametrize("step", range(5))
def test_a_failure_at_any_step_vouches_for_nothing_wrong(
    pair: tuple[Dataset, Dataset],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    step: int,
    existing: bool,
) -> None:
    """The steps: the files are renamed, then hashed, then manifest.json is renamed."""
    out = tmp_path / "out"
    if existing:
        write(plan_manifests(*pair, K), out)
    calls = itertools.count()

    def failing(real):
        def call(*arguments):
            if next(calls) == step:
                raise OSError("no more space")
            return real(*arguments)

        return call

    plan = plan_manifests(*pair, K, seed=1)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", failing(Path.replace))
        patch.setattr(manifests, "sha256_file", failing(manifests.sha256_file))
        with pytest.raises(OSError, match="no more space"):
            write(plan, out)
    vouched(out)
    assert not (out / "manifest.json").exists()
    # The same command completes.
    write(plan, out)
    vouched(out)
    write(plan, tmp_path / "undisturbed")
    assert contents(out) == contents(tmp_path / "undisturbed")
    assert {path.name for path in tmp_path.iterdir()} == {"out", "undisturbed"}


def test_what_a_killed_run_left_is_cleared(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / ".buffers.parquet.a1b2c3d4.partial").write_bytes(b"half")
    (out / ".buffers.jsonl.a1b2c3d4.partial").write_bytes(b"half")
    (tmp_path / ".out.building").mkdir()
    (tmp_path / ".out.building/lock").touch()
    write(plan_manifests(*pair, K), out)
    assert sorted(contents(out)) == FILES
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_old_files_are_replaced(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    write(plan_manifests(*pair, (0, 1, 3)), tmp_path / "out")
    write(plan_manifests(*pair, (1,), seed=1), tmp_path / "out")
    write(plan_manifests(*pair, (1,), seed=1), tmp_path / "other")
    assert contents(tmp_path / "out") == contents(tmp_path / "other")


def test_foreign_places_are_refused(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/notes.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    before = contents(tmp_path)
    for name, message in (("folder", "holds no manifests, but notes.txt"), ("file", "is a file")):
        with pytest.raises(BuildError, match=message) as raised:
            write(plan_manifests(*pair, K), tmp_path / name)
        assert "Choose another --out." in str(raised.value)
    assert contents(tmp_path) == before


def test_two_runs_at_once(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    work = tmp_path / ".out.building"
    work.mkdir()
    with (work / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(BuildError, match=r"another build of .*/out is running"):
            write(plan_manifests(*pair, K), tmp_path / "out")
    assert not (tmp_path / "out").exists()


# --- the command --------------------------------------------------------------------------------


def run(pair: tuple[Dataset, Dataset], out: Path, *arguments: str):
    demonstrations, distractors = (str(dataset.files.describe()) for dataset in pair)
    places = ["--demonstrations", demonstrations, "--distractors", distractors, "--out", str(out)]
    return CliRunner().invoke(app, ["build", "manifests", *places, *arguments])


def test_command(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    done = run(pair, tmp_path / "out", "--k", "0", "3", "--seed", "5", "--json")
    assert done.exit_code == 0
    assert json.loads(done.stdout) == {
        "out": str(tmp_path / "out"),
        "queries": 6,
        "buffers": 12,
        "sessions": 30,
    }
    write(plan_manifests(*pair, (0, 3), seed=5), tmp_path / "other")
    assert contents(tmp_path / "out") == contents(tmp_path / "other")


def test_command_with_defaults(tmp_path: Path, pair: tuple[Dataset, Dataset]) -> None:
    distractors = units(tmp_path / "u", named({"PatternLock": 7}))
    done = run((pair[0], distractors), tmp_path / "out")
    assert done.exit_code == 0
    header = json.loads((tmp_path / "out/manifest.json").read_text())
    assert (header["k"], header["seed"], header["position_limit"]) == ([0, 1, 3, 7], 0, 4096)


def test_command_without_a_limit(pair: tuple[Dataset, Dataset], tmp_path: Path) -> None:
    assert run(pair, tmp_path, "--k", "1", "--position-limit", "none").exit_code == 0
    assert json.loads((tmp_path / "manifest.json").read_text())["position_limit"] is None


@pytest.mark.parametrize("limit", ["0", "-5", "many", "4096.0", "²", ""])
def test_command_with_a_limit_that_is_none(
    pair: tuple[Dataset, Dataset], tmp_path: Path, limit: str
) -> None:
    done = run(pair, tmp_path / "out", "--k", "1", "--position-limit", limit)
    assert isinstance(done.exception, InvalidOptionError)
    assert "expected a positive number or none" in str(done.exception)
    assert not (tmp_path / "out").exists()
