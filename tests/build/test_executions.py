"""Executions: what follows the lesson in a recording, from every source that has actions."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.buffer_sets import build, dataset, plan_again, violations
from support.lerobot_layouts import write_lerobot
from support.made_up import MadeUpSource, record, write_metadata
from support.messages import raises
from support.recordings import EPISODES, write_frames, write_h5

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.build_dataset.dataset.frame_selection import (
    NothingToStore,
    select_execution,
)
from robomme_interference_data.build_dataset.manifests import plan_manifests
from robomme_interference_data.build_dataset.plan.planned import datasets_in
from robomme_interference_data.build_dataset.sources import Frame, open_source
from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    EXECUTIONS,
    IDENTITY_PATH,
    STATE,
)
from robomme_interference_data.errors import InvalidOptionError, SourceError, UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.storage.text import read_json

QUERY = "MoveCube/test/0"
QUERIES = {QUERY: (9, 5), "PatternLock/test/0": (8, 5)}
UNITS = {f"{family}/train/0": (249, None) for family in ("MoveCube", "PatternLock")}


def buffer_set(root: Path, source: MadeUpSource) -> Path:
    """Build a buffer set of two queries, with executions from `source`."""
    build(root, DEMONSTRATIONS, MadeUpSource(QUERIES))
    build(root, DISTRACTORS, MadeUpSource(UNITS))
    build(root, EXECUTIONS, source)
    plan_again(root, ("k0", "k1"))
    return root


@pytest.mark.parametrize(
    ("kind", "write"),
    [
        ("robomme-h5", lambda folder: write_h5(folder, EPISODES)),
        ("lerobot", write_lerobot),
        ("frames", lambda folder: write_frames(folder, EPISODES)),
    ],
)
def test_live_frames_of_every_source(
    tmp_path: Path, kind: str, write: Callable[[Path], Any]
) -> None:
    """MoveCube/train/0 has 12 frames, of them 5 of the demonstration; others have none or only."""
    write(tmp_path / "recorded")
    recorded = EPISODES["MoveCube/train/0"]
    build(tmp_path, EXECUTIONS, open_source(f"{kind}:{tmp_path}/recorded"))
    made = dataset(tmp_path, EXECUTIONS)
    # RoboMME records the observation after each action: the next action follows it.
    first, stop = (6, 11) if kind == "robomme-h5" else (5, 12)
    assert [str(one.episode_id) for one in made.records()] == ["MoveCube/train/0"]
    length = made.record(0).length
    assert length == stop - 5
    for camera, images in recorded.images.items():
        assert np.array_equal([*made.iter_frames(0, camera, 0, length)], images[5:stop])
    assert np.array_equal(made.read_vectors(0, STATE, 0, length), recorded.state[5:stop])
    assert recorded.action is not None
    actions = recorded.action[first : first + length]
    assert np.array_equal(made.read_vectors(0, "action", 0, length), actions)
    skipped = read_json(tmp_path / EXECUTIONS / "meta/build_report.json")["skipped"]
    assert {one["episode_id"]: one["why"] for one in skipped} == {
        "MoveCube/train/1": "no demonstration frame",
        "InsertPeg/train/0": "0 live frames; an execution needs 2",
    }


def frame(shown: bool | None, action: float | None = 1.0) -> Frame:
    vector = None if action is None else np.full(8, action, np.float32)
    return Frame({}, np.zeros(8, np.float32), vector, shown)


@pytest.mark.parametrize(
    ("frames", "error"),
    [
        ([frame(True), frame(False)], NothingToStore),
        ([frame(None), frame(None)], SourceError),
        ([frame(True), frame(False, None)], InvalidOptionError),
    ],
)
def test_episodes_without_an_execution(frames: list[Frame], error: type[Exception]) -> None:
    with raises(error):
        list(select_execution(frames))


def test_a_source_without_actions_is_one_error(tmp_path: Path) -> None:
    with raises(InvalidOptionError):
        build(tmp_path, EXECUTIONS, MadeUpSource(QUERIES, actions=False))
    assert not (tmp_path / EXECUTIONS).exists()


@pytest.mark.slow
def test_a_buffer_set_with_executions(tmp_path: Path) -> None:
    source = MadeUpSource(QUERIES)
    root = buffer_set(tmp_path, source)
    assert violations(root) == []
    opened = load_buffer_set(root)
    made = opened.datasets[EXECUTIONS]
    index = made.index_of(opened.query(QUERY).episode_id)
    first, *others = made.iter_frames(index, "front", 0, 4)
    assert np.array_equal(first, opened.query(QUERY).frame("front")) and len(others) == 3
    assert np.array_equal(others[2], source.frame(QUERY, 8, 5).images["front"])
    assert made.read_vectors(index, "action", 0, 4)[:, 0].tolist() == [-5, -6, -7, -8]
    with raises(UnknownNameError):
        made.read_vectors(index, "actoin", 0, 4)
    (root / EXECUTIONS / IDENTITY_PATH).unlink()  # buffers do not need them
    assert len(load_buffer(QUERY, "k1", buffer_set=root, verify=True)) == 5 + 32


@pytest.mark.slow
def test_executions_begin_with_the_query_frame(tmp_path: Path) -> None:
    other = MadeUpSource(QUERIES)
    shown = other.frame(QUERY, 5, 5)
    image = shown.images["front"].copy()
    image[3, 4, 1] ^= 1
    for changes in ({"images": {"front": image}}, {"state": shown.state + np.float32(1)}):
        other.wrong = {QUERY: {5: replace(shown, **changes)}}
        root = buffer_set(tmp_path / next(iter(changes)), other)
        assert violations(root) == [
            f"executions {QUERY}: does not begin with the first live observation of the "
            "demonstrations"
        ]
    other.wrong = {QUERY: {5: replace(shown, action=shown.action + np.float32(1))}}
    assert violations(buffer_set(tmp_path / "action", other)) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 8},
        {"goals": ("do it", "again")},
        {"difficulty": "hard"},
        {"episode_id": EpisodeId("MoveCube", "test", 1)},
    ],
)
def test_executions_of_other_episodes(tmp_path: Path, changes: dict[str, Any]) -> None:
    known = {"seed": 7, "goals": ("do it",)}
    write_metadata(tmp_path / DEMONSTRATIONS, DEMONSTRATIONS, [record("", QUERY, **known)])
    write_metadata(
        tmp_path / DISTRACTORS, DISTRACTORS, [record(DISTRACTORS, "PatternLock/train/0")]
    )
    live = {"exec_start_idx": None, "span_sha256": None}
    executions = [record("", QUERY, **live | known | changes)]
    write_metadata(tmp_path / EXECUTIONS, EXECUTIONS, executions)
    with raises(SourceError):
        plan_manifests(datasets_in(tmp_path), ("k0",))
