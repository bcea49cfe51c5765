"""`verify --replay` plays episodes again, and compares them with what is stored."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support import simulator_doubles
from support.buffer_sets import build, dataset
from support.messages import raises
from support.simulator_doubles import Double

from robomme_interference_data.build_dataset.sources import open_source, simulator
from robomme_interference_data.build_dataset.verify.replay import plan_replay
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.simulators.episode import EpisodeStart

LESSONS = {"families": ("MoveCube",), "split": "test", "numbers": (0, 1)}
RECORDS = "demonstrations/meta/interference.parquet"
EPISODES = "demonstrations/meta/episodes/chunk-000/file-000.parquet"
QUERY = "demonstrations MoveCube/test/1"


class Shown(Double):
    """A simulator with evidence, of which one thing can be made different."""

    brighter = 0
    stop = 3
    words = ("goal",)
    state = 0.0

    def _begin(self, episode: Any, frame_step: int) -> EpisodeStart:
        lesson, first, info = super()._begin(episode, frame_step)
        evidence = (EvidenceSpan(0, "lifts cube 2", 1, self.stop),)
        states = lesson.states + np.float32(self.state)
        lesson = replace(lesson, evidence=evidence, states=states)
        return lesson, first, replace(info, goals=self.words)

    def _images(self, episode: Any) -> dict[str, np.ndarray]:
        images = super()._images(episode)
        return {name: image + np.uint8(self.brighter) for name, image in images.items()}


@pytest.fixture
def lessons(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with two demonstrations of the simulator above, under the name of tabletop."""
    monkeypatch.setattr(simulator, "make_simulator", lambda name, **rest: Shown(name=name, **rest))
    build(tmp_path, "demonstrations", open_source("tabletop"), **LESSONS)
    return tmp_path


def played(root: Path, numbers: Any = None) -> tuple[list[str], list[str]]:
    """Return the violations, and the datasets whose images were not compared."""
    datasets = {"demonstrations": dataset(root, "demonstrations")}
    plan = plan_replay(datasets, "tabletop", numbers)
    found = plan.run(Serial(), WorkProgress(quiet=True))
    return [f"{one.where}: {one.what}" for one in found], plan.without_frames


def test_what_was_recorded_is_played_again(lessons: Path) -> None:
    assert played(lessons) == ([], [])


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("stop", 4, ["evidence is {'stop': 3} at 0; played again it is {'stop': 4}"]),
        ("words", ("other",), ["goals is 'goal' at 0; played again it is 'other'"]),
        ("state", 0.5, ["observation.state is not what is seen when it is played again"]),
    ],
)
def test_what_is_played_otherwise_is_found(
    lessons: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: Any, expected: list[str]
) -> None:
    monkeypatch.setattr(Shown, name, value)
    assert played(lessons, {1}) == ([f"{QUERY}: {what}" for what in expected], [])


def test_images_and_states_count_on_the_recorded_renderer_only(
    lessons: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Shown, "brighter", 1)
    found, _ = played(lessons, {1})
    assert [one.split(": ")[1].split()[0] for one in found] == [
        "observation.images.front",
        "observation.images.wrist",
        "its",
    ]
    path = lessons / "demonstrations/meta/interference.json"
    identity = json.loads(path.read_text())
    identity["sources"][0]["renderer"] = "another"
    path.write_text(json.dumps(identity))
    monkeypatch.setattr(Shown, "state", 0.5)
    assert played(lessons, {1}) == ([], ["demonstrations"])
    identity["sources"][0]["versions"]["tabletop"] = "99"
    path.write_text(json.dumps(identity))
    [found], _ = played(lessons)
    assert found.startswith("demonstrations/meta/interference.json: sources are")


def test_an_episode_that_the_simulator_does_not_have(
    lessons: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulator_doubles, "UNKNOWN", 1)
    assert played(lessons)[0] == [f"{QUERY}: cannot be played again: no such episode"]


def test_what_cannot_be_played(lessons: Path, tiny_buffers: Path) -> None:
    with raises(InvalidOptionError):
        played(lessons, {7})
    with raises(InvalidOptionError):
        played(tiny_buffers)


@pytest.mark.slow
def test_evidence_that_was_moved_in_a_lesson_of_tabletop(tmp_path: Path) -> None:
    build(tmp_path, "demonstrations", open_source("tabletop"), **LESSONS | {"numbers": (0,)})
    for path in (RECORDS, EPISODES):
        table = pq.read_table(tmp_path / path)
        place, evidence = table.column_names.index("evidence"), table["evidence"].to_pylist()
        start = evidence[0][0]["start"]
        evidence[0][0]["start"] = start + 1
        moved = pa.array(evidence, table.schema.field("evidence").type)
        pq.write_table(table.set_column(place, "evidence", moved), tmp_path / path)
    [found], _ = played(tmp_path)
    assert f"evidence is {{'start': {start + 1}}} at 0; played again it is" in found


@pytest.mark.slow
def test_replay_on_the_command_line(tiny_buffers: Path, run: Any) -> None:
    code, _, err = run("verify", tiny_buffers, "--no-decode", "--replay", "tabletop")
    assert code == 1 and "no dataset was recorded on the simulator tabletop" in err
    assert run("verify", tiny_buffers, "--episodes", "0")[0] == 1
