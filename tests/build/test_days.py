"""Days in a buffer set: what is stored, which buffers are spans of it, and what `verify` finds.

On days of a simulator without physics; `docs/how-to/days.md` builds one on the embedded simulator,
which `system/test_how_to.py` runs.
"""

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from support import days
from support.buffer_sets import contents, dataset, plan_again
from support.damage import edit, put, renew_header
from support.days import CONDITIONS, IDLE, build_days, lesson, plan_of, playing_days
from support.hub_server import HubServer
from support.messages import raises
from support.publishing import UNITS, plain_cards, publish
from support.verifying import expect, first_changed

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.sources import day as day_source
from robomme_interference_data.cards.dataset_facts import buffer_set_facts
from robomme_interference_data.cards.publication import Publication
from robomme_interference_data.cards.render import card_text
from robomme_interference_data.constants import ABILITIES
from robomme_interference_data.errors import BuildError, InvalidOptionError, SourceError
from robomme_interference_data.evaluate.ceiling import ceiling
from robomme_interference_data.evaluate.day_shortcuts import day_cues
from robomme_interference_data.evaluate.run.config import CeilingConfig
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.schema.records import DaySpan
from robomme_interference_data.viz.filmstrip import draw_strip

RECORDS = "days/meta/interference.parquet"
UPDATE, PIECES, ABSENT = "VideoUnmask/test/1", "RouteStick/test/6", "VideoPlaceOrder/test/1"
QUIET = WorkProgress(quiet=True)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("days") / "buffers"
    build_days(folder)
    return folder


@pytest.fixture
def own(root: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(root, tmp_path / "buffers"))


def frames_of(span: DaySpan) -> Any:
    """The images that a span must show."""
    if span.part == "transition":
        return np.full((span.stop - span.start, 32, 32, 3), 255, np.uint8)
    if span.part == "idle":
        return np.zeros((IDLE, 32, 32, 3), np.uint8)
    piece = {"lesson": slice(6), "first": slice(3), "second": slice(3, 6)}[span.part]
    return lesson(span.source)[piece]


# --- what is stored -----------------------------------------------------------------------------


def test_spans_are_the_day_frame_by_frame(root: Path) -> None:
    held = dataset(root, "days")
    assert [str(record.episode_id) for record in held.records()] == ["Day8/test/1", "Day8/test/6"]
    for record in held.records():
        assert record.day is not None
        frames = np.stack([*held.iter_frames(record.episode_index, "front", 0, record.length)])
        states = np.repeat(np.arange(record.length, dtype=np.float32)[:, None], 8, 1)
        stop = 0
        for span in record.day.spans:
            assert span.start == stop
            stop = span.stop
            assert np.array_equal(frames[span.start : stop], frames_of(span))
            digests = {
                name: hashlib.sha256(values[span.start : stop].tobytes()).hexdigest()
                for name, values in (
                    ("observation.images.front", frames),
                    ("observation.state", states),
                )
            }
            text = json.dumps(digests, sort_keys=True, separators=(",", ":"))
            assert span.sha256 == hashlib.sha256(text.encode()).hexdigest()
        assert stop == record.length


def test_queries_have_their_abilities(root: Path) -> None:
    abilities = {
        str(record.episode_id): record.ability
        for record in dataset(root, "demonstrations").records()
    }
    assert abilities == {
        "VideoPlaceOrder/test/1": "absent",
        "VideoPlaceButton/test/1": "recall",
        "VideoUnmask/test/1": "update",
        "VideoUnmaskSwap/test/1": "recall",
        "InsertPeg/test/6": "order-first",
        "PatternLock/test/6": "absent",
        "RouteStick/test/6": "several",
    }
    for name in ("days", "distractors"):
        assert {record.ability for record in dataset(root, name).records()} == {None}


def test_lerobot_opens_the_days(root: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    opened = LeRobotDataset("any/name", root=root / "days", video_backend="pyav")
    record = dataset(root, "days").record(0)
    assert opened.num_episodes == 2 and record.day is not None
    span = next(span for span in record.day.spans if span.part == "lesson")
    item = opened[span.start + 1]
    image = (item["observation.images.front"].permute(1, 2, 0) * 255).round().byte().numpy()
    assert np.array_equal(image, lesson(span.source)[1])
    assert item["task"] == "do the 8 tasks of the day"


def test_holding_still_does_not_outweigh_other_executions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(day_source, "STILL_FRAMES", 2)
    with playing_days():
        build_dataset(plan_of("executions"), tmp_path / "executions", Serial(), QUIET)
    records = dataset(tmp_path, "executions").records()
    lengths = {str(record.episode_id): record.length for record in records}
    assert lengths.pop(ABSENT) == lengths.pop("PatternLock/test/6") == 2
    assert len(lengths) == 5 and {*lengths.values()} == {3}


# --- buffers ------------------------------------------------------------------------------------


def test_buffers_are_spans_of_the_day(root: Path) -> None:
    """The day's own plan is held by `core/test_days.py`."""
    sessions = {
        (str(manifest.episode_id), manifest.condition): [
            (entry.role, str(entry.source), entry.start, entry.stop) for entry in manifest.sessions
        ]
        for manifest in load_buffer_set(root).manifests()
    }
    assert [role for role, *_ in sessions[UPDATE, "day-k2"]][1::2] == [
        "contradiction",
        "distractor",
        "lesson",
        "distractor",
        "distractor",
    ]
    for query, condition in sessions:
        if condition != "day-k2":
            continue
        short, long, cut_short, cut_long, alone = (
            sessions[query, name]
            for name in ("day-k0", "day-k2", "day-cut-k0", "day-cut-k2", "day-alone")
        )
        assert long[: len(short)] == short and len(long) == len(short) + 4
        assert cut_short == [entry for entry in short if entry[0] != "transition"]
        assert cut_long == [entry for entry in long if entry[0] != "transition"]
        assert alone == [entry for entry in short if entry[0] in ("lesson", "contradiction")]
        assert [entry[0] for entry in long[::2]] == ["transition"] * (len(long) // 2)
        # Without a border: every session begins where the last one ends.
        assert [entry[2] for entry in long] == [0, *(entry[3] for entry in long[:-1])]
        assert (alone == []) == (query in (ABSENT, "PatternLock/test/6"))
        assert sessions[query, "no-history"] == []
    assert [entry[:2] for entry in sessions[PIECES, "day-alone"]] == [("lesson", PIECES)] * 2


@pytest.mark.parametrize("condition", ["day-k0", "day-cut-k2", "day-alone"])
def test_a_buffer_shows_its_spans(root: Path, condition: str) -> None:
    buffer = load_buffer(PIECES, condition, buffer_set=root, verify=True)
    day = dataset(root, "days").record(1).day
    assert day is not None
    spans = {span.start: span for span in day.spans}
    expected = [frames_of(spans[entry.start]) for entry in buffer.manifest.sessions]
    assert np.array_equal(buffer.frames("front"), np.concatenate(expected))
    chunks = [*buffer.stream(chunk=7)]
    streamed = np.concatenate([chunk.frames["front"] for chunk in chunks])
    assert np.array_equal(streamed, buffer.frames("front"))
    assert np.array_equal(np.concatenate([chunk.states for chunk in chunks]), buffer.states)
    assert buffer.manifest.lesson_frames == 6


@pytest.mark.parametrize("condition", ["day-k2", "day-alone", "no-history"])
def test_the_picture_of_a_day_names_the_ability(root: Path, tmp_path: Path, condition: str) -> None:
    """Also where nothing is shown."""
    pytest.importorskip("matplotlib")
    out = tmp_path / "strip.svg"
    draw_strip(load_buffer(ABSENT, condition, buffer_set=root), out)
    assert f"{ABSENT}   {condition}   absent" in out.read_text(encoding="utf-8")


def test_abilities_have_ceilings(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Its lessons show other parts than the scenes of the simulator whose name it has.
    monkeypatch.setattr("robomme_interference_data.evaluate.ceiling.recorded_scene", lambda _: None)
    config = CeilingConfig("full", conditions=("day-k2",))
    found = {
        cell.part: (cell.queries, cell.evidence_kept)
        for cell in ceiling(load_buffer_set(root), config)
    }
    assert {part: found[part] for part in found if part in ABILITIES} == {
        "recall": (2, 1.0),
        "several": (1, 1.0),
        "update": (1, 1.0),
        "order-first": (1, 1.0),
        "absent": (2, None),
    }
    assert found["all"] == (7, 1.0)


def test_what_a_policy_sees_of_a_query_without_a_memory(root: Path, run: Any) -> None:
    found = {
        cues.condition: cues
        for cues in day_cues(load_buffer_set(root))
        if (cues.family, cues.ability) == ("VideoUnmask", "update")
    }
    whole, cut, short = (found[name] for name in ("day-k2", "day-cut-k2", "day-k0"))
    assert whole.task == 2 and short.delay == 0
    assert cut.length == 5 * 6 and cut.delay == 2 * 6  # of five tasks, without transitions
    assert cut.clock == whole.clock == whole.length == short.length + whole.delay
    code, out, _ = run("verify", root, "--audit", "--json")
    report = json.loads(out)
    assert code == 0 and not report["violations"]
    assert {row["condition"] for row in report["day_shortcuts"]} == {*found}


def test_its_card_counts_the_days(root: Path) -> None:
    card = card_text(buffer_set_facts(load_buffer_set(root)), Publication("a/b", "1.0.0"))
    assert "days" in card and "day-cut-k2" in card


# --- what is refused ----------------------------------------------------------------------------


def test_no_lesson_without_one_before_anything_is_built(tmp_path: Path, run: Any) -> None:
    out = tmp_path / "buffers"
    code, _, err = run(
        *("build", out, "--source", "tabletop-day:8", "--split", "test", "--episodes", "1"),
        *("--unit-episodes", "0", "--conditions", "k0,day-k0"),
    )
    assert code == 1 and ABSENT in err and "day-k0" in err
    assert not out.exists()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        # Its last lesson is task 5 of 0 to 7.
        (("--conditions", "no-history,day-k3", "--position-limit", "none"), "day-k2"),
        (("--conditions", "day-k2", "--position-limit", "2000"), "--position-limit none"),
    ],
)
def test_what_no_day_holds_before_anything_is_built(
    options: tuple[str, ...], expected: str, tmp_path: Path, run: Any
) -> None:
    out = tmp_path / "buffers"
    code, _, err = run(
        *("build", out, "--source", "tabletop-day:8", "--split", "test", "--episodes", "1"),
        *("--unit-episodes", "0", *options),
    )
    assert code == 1 and "VideoPlaceButton/test/1" in err and expected in err
    assert not out.exists()


@pytest.mark.parametrize(
    ("conditions", "limit", "error"),
    [
        (("k0",), None, BuildError),  # one of the queries has no lesson
        (("day-k63",), None, BuildError),
        (("day-k2",), 1400, InvalidOptionError),  # of 169 frames and 1300 steps
    ],
)
def test_what_days_do_not_hold_is_not_planned(
    own: Path, conditions: tuple[str, ...], limit: int | None, error: type[Exception]
) -> None:
    before = contents(own)
    with raises(error):
        plan_again(own, conditions, position_limit=limit)
    assert contents(own) == before


def test_days_that_lack_a_query(own: Path) -> None:
    shutil.rmtree(own / "days")
    with playing_days():
        build_dataset(plan_of("days", (6,)), own / "days", Serial(), QUIET)
    with raises(SourceError):
        plan_again(own, CONDITIONS)


@pytest.mark.parametrize("tasks", ["7", "61", "08", "abc"])
def test_no_such_number_of_tasks(tasks: str, tmp_path: Path, run: Any) -> None:
    code, _, err = run("build", tmp_path / "buffers", "--source", f"tabletop-day:{tasks}")
    assert code == 1 and f"tabletop-day:{tasks}" in err
    assert ("8 to 60" in err) == (tasks in ("7", "61"))


@pytest.mark.parametrize(
    "options", [("--conditions", "no-history,day-k0"), ("--only", "days"), ("--with", "days")]
)
def test_a_source_without_days_before_anything_is_built(
    options: tuple[str, ...], tmp_path: Path, run: Any
) -> None:
    out = tmp_path / "buffers"
    code, _, err = run("build", out, "--source", "tabletop", "--split", "test", *options)
    assert code == 1 and "tabletop has no days" in err
    assert not out.exists()


# --- verify -------------------------------------------------------------------------------------


def changed_day(root: Path, change: Any) -> None:
    """Change the first day's record, which is stored twice."""

    def changed(table: pa.Table) -> pa.Table:
        values = table["day"].to_pylist()
        values[0] = change(values[0])
        return put(table, "day", values)

    for path in (RECORDS, "days/meta/episodes/chunk-000/file-000.parquet"):
        edit(root / path, changed)


def earlier(day: dict[str, Any]) -> dict[str, Any]:
    day["spans"][0]["stop"] -= 1
    return day


def exchanged(day: dict[str, Any]) -> dict[str, Any]:
    first, second, *_ = day["spans"]
    first["sha256"], second["sha256"] = second["sha256"], first["sha256"]
    return day


def outside(day: dict[str, Any]) -> dict[str, Any]:
    seen = next(span for span in day["spans"] if span["evidence"])
    seen["evidence"][0]["stop"] = seen["stop"] + 1
    return day


def too_late(day: dict[str, Any]) -> dict[str, Any]:
    day["queries"][0]["task"] = 8
    return day


def usual_look(day: dict[str, Any]) -> dict[str, Any]:
    day["spans"][0]["shift"] = "none"
    return day


def longer_transition(day: dict[str, Any]) -> dict[str, Any]:
    transition, task, *_ = day["spans"]
    transition["stop"] += 1
    task["start"] += 1
    return day


def without_an_end(day: dict[str, Any]) -> dict[str, Any]:
    del day["spans"][-2:]
    return day


def sooner(day: dict[str, Any]) -> dict[str, Any]:
    day["queries"][0]["task"] -= 1
    return day


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        (earlier, "days Day8/test/1: its spans are not its"),
        (exchanged, "days Day8/test/1: frames 0 to [0-9]+ do not have the recorded SHA-256"),
        (outside, "days Day8/test/1: evidence of .* is outside of its frames"),
        (too_late, "days Day8/test/1: VideoPlaceOrder/test/1 is asked after task 8 of 8"),
        (usual_look, "days Day8/test/1: a span is .*'none'.* at 0; the plan gives .*'light:2'"),
        (longer_transition, "days Day8/test/1: a span is {'frames': .* at 0; the plan gives"),
        (without_an_end, "days Day8/test/1: has 14 spans; the plan gives 16"),
        (sooner, "days Day8/test/1: queries are {'task': 2} at 0; the plan gives {'task': 3}"),
        (lambda day: None, "days Day8/test/1: has no tasks"),
    ],
)
def test_a_changed_day_is_found(own: Path, change: Any, pattern: str) -> None:
    changed_day(own, change)
    expect(own, pattern, decode=change is exchanged)


def test_another_ability_is_found(own: Path) -> None:
    for path in ("interference.parquet", "episodes/chunk-000/file-000.parquet"):
        edit(own / "demonstrations/meta" / path, first_changed("ability", "recall"))
    expect(own, f"demonstrations {ABSENT}: ability is recall; the plan gives absent")


@pytest.mark.parametrize(("name", "version"), [("tabletop-day", "0"), ("robomme", "None")])
def test_days_of_another_version_are_not_planned_again(name: str, version: str, own: Path) -> None:
    """Nor those that claim to be of a simulator that plays none."""
    path = own / "days/meta/interference.json"
    text = path.read_text().replace('"tabletop-day": "1"', f'"{name}": "{version}"')
    path.write_text(text.replace('"tabletop-day"', f'"{name}"'))
    expect(own, "days/meta/interference.json: .*; days of these cannot be planned here")


def test_a_buffer_with_another_role_is_found(own: Path) -> None:
    """The update as if it were the old lesson."""

    def change(table: pa.Table) -> pa.Table:
        rows = table["sessions"].to_pylist()
        for sessions in rows:
            for entry in sessions:
                if entry["role"] == "contradiction":
                    entry["role"] = "distractor"
        return put(table, "sessions", rows)

    edit(own / "manifests/buffers.parquet", change)
    renew_header(own)
    expect(own, f"{UPDATE} under day-k0: sessions is .*; the rules give .*contradiction")


# --- the same bytes -----------------------------------------------------------------------------


def test_a_build_that_was_stopped_gives_the_same_bytes(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last day first, the other one interrupted in its middle and built later."""
    plan, played = plan_of("days"), []
    plan = replace(plan, episodes=plan.episodes[::-1])
    frames = days.PlayedDouble.frames

    def stopping(self: Any) -> Any:
        played.append(str(self.plan.day))
        for number, frame in enumerate(frames(self)):
            if len(played) == 2 and number == 30:
                raise KeyboardInterrupt
            yield frame

    monkeypatch.setattr(days.PlayedDouble, "frames", stopping)
    with playing_days():
        with pytest.raises(KeyboardInterrupt):
            build_dataset(plan, tmp_path / "days", Serial(), QUIET)
        assert not (tmp_path / "days").exists()
        build_dataset(plan, tmp_path / "days", Serial(), QUIET)
    assert played == ["Day8/test/6", "Day8/test/1", "Day8/test/1"]
    assert contents(tmp_path / "days") == contents(root / "days")


# --- published ----------------------------------------------------------------------------------


def test_of_published_days_only_the_one_that_is_loaded_is_downloaded(
    root: Path, hub: HubServer, login: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    login("someone")
    plain_cards(monkeypatch)
    publish(root)
    hub.requests.clear()
    theirs = load_buffer(PIECES, "day-k0", buffer_set=UNITS, verify=True)
    mine = load_buffer(PIECES, "day-k0", buffer_set=root)
    assert theirs.manifest == mine.manifest
    assert np.array_equal(theirs.frames("front"), mine.frames("front"))
    videos = [path for path in hub.downloads() if path.endswith(".mp4")]
    assert sorted(videos) == [  # the second day, and the first live observation
        "days/videos/observation.images.front/chunk-000/file-001.mp4",
        "videos/observation.images.front/chunk-000/file-006.mp4",
    ]
