"""What a folder says of its run: each start, all plans, and what may differ from start to start."""

import json
import shutil
from pathlib import Path
from typing import Any

import factories
import own_policies
import pyarrow.parquet as pq
import pytest
import rollout_doubles
from policy_server import PolicyServer
from run_calls import CHEAT, WORLD, run, untimed

from robomme_interference_data.errors import FormatError, RunFolderError
from robomme_interference_data.evaluate import merge_runs, run_evaluation, runner
from robomme_interference_data.evaluate.log import check_tables, read_log
from robomme_interference_data.evaluate.score.read import find_sources
from robomme_interference_data.progress import BuildProgress
from robomme_interference_data.retrieval.commands import datasets_in
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.index import build_index

pytestmark = pytest.mark.usefixtures("world")

ONE: dict[str, Any] = {"families": ["MoveCube"], "episodes": "0", "conditions": ["no-history"]}


def header(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "run.json").read_text())


class _Impatient:
    """A listener that presses Ctrl-C at the first row."""

    def start(self, plan: Any, done: Any) -> None: ...

    def row(self, row: Any) -> None:
        raise KeyboardInterrupt


def test_every_start_is_on_record_and_the_folder_stands_for_all_its_plans(tmp_path: Path) -> None:
    out = tmp_path / "run"
    two = {"families": ["MoveCube", "PatternLock"], "episodes": "0"}
    with pytest.raises(KeyboardInterrupt):
        run(out, listener=_Impatient(), command=["first"], history_chunk=7, **two)
    (row,) = read_log(out).values()
    cut = header(out)
    assert (cut["status"], cut["planned"], sum(cut["counts"].values())) == ("incomplete", 4, 1)

    # A smaller plan that is all there does not make the folder complete.
    small = {"families": [row.family], "conditions": [row.condition], "episodes": "0"}
    assert run(out, command=["second"], **small).planned == 1
    second = header(out)
    assert (second["status"], second["planned"]) == ("incomplete", 4)
    assert second["counts"] == cut["counts"]

    run(out, command=["third"], check_lesson=True, **two)
    third = header(out)
    assert (third["status"], third["planned"], third["stopped"]) == ("complete", 4, None)
    assert third["counts"] == {"success": 2, "fail": 2, "timeout": 0, "error": 0}
    assert len(third["plans"]) == 2
    starts = third["invocations"]
    assert [one["command"] for one in starts] == [["first"], ["second"], ["third"]]
    assert [one["stopped"] for one in starts] == ["interrupted", None, None]
    assert [one["planned"] for one in starts] == [4, 1, 4]
    assert [sum(one["counts"].values()) for one in starts] == [1, 1, 4]
    assert [one["settings"]["history_chunk"] for one in starts] == [7, 64, 64]
    assert [one["settings"]["check_lesson"] for one in starts] == [False, False, True]
    assert starts[0]["settings"]["split"] == str(factories.split())
    assert starts[0]["plan"] == {
        "families": ["MoveCube", "PatternLock"],
        "episodes": [0],
        "conditions": ["no-history", "k0"],
        "shard": "1/1",
    }
    for one in starts:
        assert one["started"] <= one["ended"]
        assert one["policy"] == {"policy": "cheat"} and "numpy" in one["versions"]


def test_a_shard_is_complete_when_its_part_is(tmp_path: Path) -> None:
    run(tmp_path / "run", shard="2/3")
    found = header(tmp_path / "run")
    assert (found["status"], found["planned"]) == ("complete", len(read_log(tmp_path / "run")))
    assert found["planned"] in (4, 6)  # of 8 episodes, 2 or 3, under two conditions
    run(tmp_path / "run", shard="1/3")
    both = header(tmp_path / "run")
    assert (both["status"], both["planned"]) == ("complete", len(read_log(tmp_path / "run")))
    merged = merge_runs([tmp_path / "run"], tmp_path / "merged")
    whole = header(tmp_path / "merged")
    assert (
        (whole["status"], whole["planned"])
        == ("incomplete", merged.planned)
        == (
            "incomplete",
            16,
        )
    )
    assert whole["invocations"] == both["invocations"]


# --- what makes the run ------------------------------------------------------------------------


def serve(out: Path, server: PolicyServer, **changes: Any) -> Any:
    address = f"websocket://127.0.0.1:{server.port}"
    return run(out, policy=address, episodes="0", conditions=["k0"], **changes)


def test_where_a_server_listens_makes_no_other_run(tmp_path: Path) -> None:
    with PolicyServer().running() as first, PolicyServer().running() as second:
        first.metadata = second.metadata = {"model": "a"}
        serve(tmp_path / "one", first, shard="1/2")
        serve(tmp_path / "two", second, shard="2/2")
        merged = merge_runs([tmp_path / "one", tmp_path / "two"], tmp_path / "merged")
        assert merged.missing == merged.double == ()
        again = serve(tmp_path / "merged", second, policy_options={"response_s": 30.0})
        assert again.counts["fail"] == 4
        addresses = {one["policy"]["server"] for one in header(tmp_path / "merged")["invocations"]}
        assert addresses == {f"127.0.0.1:{first.port}", f"127.0.0.1:{second.port}"}
        before = (tmp_path / "one" / "run.json").read_bytes()
        first.metadata = {"model": "b"}
        with pytest.raises(RunFolderError) as raised:
            serve(tmp_path / "one", first, shard="1/2")
        assert (
            "policy_metadata.server_metadata.model is 'a' there, 'b' here" in raised.value.message
        )
        assert (tmp_path / "one" / "run.json").read_bytes() == before


def test_another_checkpoint_behind_the_same_words_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = "python:own_policies:from_checkpoint"
    for name in ("a", "b"):
        monkeypatch.setenv(own_policies.CHECKPOINT, name)
        run(tmp_path / name, policy=policy, **ONE)
    with pytest.raises(RunFolderError, match=r"policy_metadata\.checkpoint is 'b' there, 'a' here"):
        merge_runs([tmp_path / "a", tmp_path / "b"], tmp_path / "merged")
    with pytest.raises(RunFolderError, match=r"policy_metadata\.checkpoint is 'a' there, 'b' here"):
        run(tmp_path / "a", policy=policy, **ONE)


def test_options_of_the_policy_make_the_run(tmp_path: Path) -> None:
    policy = "python:own_policies:Still"
    run(tmp_path / "run", policy=policy, policy_options={"gripper": -1.0}, **ONE)
    found = header(tmp_path / "run")
    assert found["identity"]["policy_options"] == {"gripper": -1.0}
    assert found["invocations"][0]["settings"]["policy_options"] == {"gripper": -1.0}
    with pytest.raises(RunFolderError, match=r"policy_options.gripper is -1.0 there, 1.0 here"):
        run(tmp_path / "run", policy=policy, **ONE)


def test_the_same_split_may_be_under_another_name(tmp_path: Path) -> None:
    moved = shutil.copytree(factories.split(), tmp_path / "moved")
    options: dict[str, Any] = {"simulator": WORLD, "system": "mine", "episodes": "0"}
    options |= {"conditions": ["k0"]}
    run(tmp_path / "one", families=["MoveCube"], episodes="0", conditions=["k0"])
    run_evaluation(CHEAT, moved, tmp_path / "two", families=["PatternLock"], **options)
    for order, label in ((("one", "two"), "split"), (("two", "one"), "moved")):
        folders = [tmp_path / name for name in order]
        merged = merge_runs(folders, tmp_path / f"merged-{label}")
        assert {row.split for row in merged.rows} == {label} == {header(merged.folder)["split"]}
    both = run_evaluation(
        CHEAT, moved, tmp_path / "one", families=["MoveCube", "PatternLock"], **options
    )
    assert [(row.family, row.split) for row in both.rows] == [
        ("MoveCube", "split"),
        ("PatternLock", "split"),
    ]
    assert len((tmp_path / "one" / "rollouts.jsonl").read_text().splitlines()) == 2


def test_another_version_of_the_suite_is_another_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    version = {WORLD: "1", "numpy_there": "1.26.4"}
    monkeypatch.setattr(runner, "simulator_versions", lambda *_: dict(version))
    run(tmp_path / "run", **ONE)
    found = header(tmp_path / "run")
    assert found["identity"]["simulator_version"] == "1"
    assert found["versions"]["numpy_there"] == "1.26.4"
    version[WORLD] = "2"
    with pytest.raises(RunFolderError, match="simulator_version is '1' there, '2' here"):
        run(tmp_path / "run", **ONE)


def test_another_retrieval_step_is_another_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    split = factories.copy_of_split(tmp_path / "split")

    def again(**changes: Any) -> dict[str, Any]:
        build_index(datasets_in(split), Thumbnail(), BuildProgress(quiet=True))
        out = tmp_path / "run"
        step = {"system": "mine", "retrieval": "thumbnail"} | changes
        run_evaluation(CHEAT, split, out, simulator=WORLD, **step, **ONE)
        return header(out)["identity"]["retrieval_index"]

    told = again()
    assert told.pop("fingerprint") and -1 < told.pop("threshold") < 1
    assert told == {"encoder": "thumbnail", "camera": "front", "method": "max", "cut": "adaptive"}
    with pytest.raises(RunFolderError, match=r"retrieval_index\.method is 'max' there, 'oracle'"):
        again(retrieval_rule="oracle")
    with pytest.raises(RunFolderError, match=r"retrieval_index.cut is 'adaptive' there, 0\.5 here"):
        again(retrieval_rule="max/0.5")
    other = Thumbnail().fingerprint | {"version": 99}
    monkeypatch.setattr(Thumbnail, "fingerprint", property(lambda _: other))
    with pytest.raises(RunFolderError, match=r"retrieval_index.fingerprint is '\w+' there, '\w+'"):
        again()


# --- a folder that has lost a file ---------------------------------------------------------------


def test_a_lost_record_is_made_again_from_the_table(tmp_path: Path) -> None:
    out = tmp_path / "run"
    first = run(out, families=["MoveCube", "PatternLock"], episodes="0")
    (out / "rollouts.jsonl").unlink()
    assert merge_runs([out], tmp_path / "merged").missing == ()
    run(out, families=["MoveCube"], episodes="0")
    assert untimed(tuple(read_log(out).values())) == untimed(first.rows)
    assert pq.read_metadata(out / "rollouts.parquet").num_rows == 4
    assert len((out / "rollouts.jsonl").read_text().splitlines()) == 4


PARQUET = "rollouts.parquet"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finished") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(rollout_doubles.SPLIT, str(factories.split()))
        run(out, **ONE)
    return out


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        ("missing", r"has rollouts\.csv, but no rollouts\.jsonl"),
        ("damaged", r"has rollouts\.parquet and rollouts\.csv, but no rollouts\.jsonl"),
        ("columns", "its columns are not those of rollouts"),
        ("value", "success True contradicts status 'fail'"),
        ("double", "has several rows of one rollout"),
    ],
)
def test_a_record_that_cannot_be_made_again_is_refused(
    finished: Path, tmp_path: Path, spoil: str, message: str
) -> None:
    out = shutil.copytree(finished, tmp_path / "run")
    (out / "rollouts.jsonl").unlink()
    table = pq.read_table(out / "rollouts.parquet")
    if spoil == "missing":
        (out / "rollouts.parquet").unlink()
    elif spoil == "damaged":
        (out / "rollouts.parquet").write_bytes(b"PAR1")
    elif spoil == "columns":
        pq.write_table(table.drop_columns(["steps"]), out / "rollouts.parquet")
    elif spoil == "value":
        values = table.to_pylist()
        values[0]["success"] = True
        pq.write_table(table.from_pylist(values, schema=table.schema), out / "rollouts.parquet")
    else:
        pq.write_table(table.from_pylist(table.to_pylist() * 2, schema=table.schema), out / PARQUET)
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.name[0] != "."}
    for attempt in (
        lambda: run(out, **ONE),
        lambda: merge_runs([out], tmp_path / "merged"),
    ):
        with pytest.raises(FormatError, match=message) as raised:
            attempt()
        assert "rollouts.jsonl" in str(raised.value.hint)
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.name[0] != "."} == before
    assert not (tmp_path / "merged").exists()


@pytest.mark.parametrize("plans", [None, {}, [{"families": ["MoveCube"]}]])
def test_a_header_without_plans_is_one_clear_error(
    finished: Path, tmp_path: Path, plans: Any
) -> None:
    out = shutil.copytree(finished, tmp_path / "run")
    changed = header(out) | {"plans": plans}
    (out / "run.json").write_text(json.dumps({k: v for k, v in changed.items() if v is not None}))
    for attempt in (lambda: run(out, **ONE), lambda: merge_runs([out], tmp_path / "merged")):
        with pytest.raises(FormatError, match=r"run\.json lacks the plans of the run"):
            attempt()


def test_tables_behind_the_record_are_not_scored(finished: Path, tmp_path: Path) -> None:
    out = shutil.copytree(finished, tmp_path / "run")
    check_tables(out)
    assert find_sources([out])[0].path == out / PARQUET
    table = pq.read_table(out / PARQUET)
    pq.write_table(table.slice(0, 0), out / PARQUET)  # as a killed run leaves it
    with pytest.raises(
        FormatError, match=r"^1 of 1 rollouts in .* are not in the tables"
    ) as raised:
        find_sources([out])
    hint = str(raised.value.hint)
    assert f"robomme-interference merge {out} --out {out}-merged" in hint
    merged = merge_runs([out], f"{out}-merged")
    assert pq.read_table(merged.folder / PARQUET).equals(table)
    # Once an error, now mended: as many rows, and not the same.
    old = table.to_pylist()
    old[0] |= {"status": "error", "success": None}
    pq.write_table(table.from_pylist(old, schema=table.schema), out / PARQUET)
    with pytest.raises(FormatError, match="1 of 1 rollouts"):
        find_sources([out])
