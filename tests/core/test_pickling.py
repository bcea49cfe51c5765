"""Buffer sets and buffers in other processes: pickled and copied, they read the same data or raise.

Loaders of PyTorch pickle the user's dataset, except on Linux before Python 3.14.
"""

import copy
import json
import multiprocessing
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.buffer_sets import GOLDEN, QUERIES, copy_buffer_set, plan_again
from support.hub import BUFFER_SET, push_buffer_set
from support.hub_server import HubServer
from support.messages import raises

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.errors import HashMismatchError

QUERY = QUERIES[0]
WAYS: dict[str, Callable[[Any], Any]] = {
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
    "the oldest protocol": lambda value: pickle.loads(pickle.dumps(value, 0)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
}


@pytest.fixture(params=WAYS.values(), ids=WAYS)
def copied(request: pytest.FixtureRequest) -> Callable[[Any], Any]:
    way: Callable[[Any], Any] = request.param
    return way


def check_same(found: Buffer, expected: Buffer) -> None:
    assert (found.manifest, found.goal, repr(found)) == (
        expected.manifest,
        expected.goal,
        repr(expected),
    )
    np.testing.assert_array_equal(found.states, expected.states)
    np.testing.assert_array_equal(found.frame(60), expected.frame(60))
    np.testing.assert_array_equal(found.query.frame("wrist"), expected.query.frame("wrist"))
    assert found.evidence == expected.evidence


@pytest.mark.parametrize("used", [False, True])
def test_a_buffer(copied: Callable[[Any], Any], used: bool, tmp_path: Path) -> None:
    buffer = load_buffer(QUERY, "k3", buffer_set=GOLDEN, cache=tmp_path, threads=1)
    if used:
        check_same(buffer, buffer)
    found = copied(buffer)
    check_same(found, buffer)
    np.testing.assert_array_equal(found.frames(), buffer.frames())
    found.verify()


@pytest.mark.parametrize("used", [False, True])
def test_a_buffer_set(copied: Callable[[Any], Any], used: bool) -> None:
    buffer_set = load_buffer_set(GOLDEN)
    if used:
        list(buffer_set.manifests())
        buffer_set.load(QUERY, "k3").verify()
    found: BufferSet = copied(buffer_set)
    assert (found.header, found.episode_ids, found.revision) == (
        buffer_set.header,
        buffer_set.episode_ids,
        buffer_set.revision,
    )
    assert [*found.manifests()] == [*buffer_set.manifests()]
    check_same(found.load(QUERY, "k3"), buffer_set.load(QUERY, "k3"))


def test_what_they_consist_of(copied: Callable[[Any], Any]) -> None:
    buffer_set = load_buffer_set(GOLDEN)
    buffer = buffer_set.load(QUERY, "k1")
    query, dataset = buffer_set.query(QUERY), buffer_set.datasets["distractors"]
    for value in (buffer.manifest, buffer.sessions, buffer.episode_id, buffer.evidence):
        assert copied(value) == value
    found = copied(query)
    assert found.record == query.record
    np.testing.assert_array_equal(found.state(), query.state())
    assert [*copied(dataset).records()] == [*dataset.records()]
    chunk = next(buffer.stream(4))
    np.testing.assert_array_equal(copied(chunk).frames["front"], chunk.frames["front"])
    assert {*copied(buffer_set.datasets)} == {*buffer_set.datasets}


def test_objects_stay_one(tmp_path: Path) -> None:
    """A user's dataset that holds both is not twice as large in every worker."""
    buffer_set = load_buffer_set(GOLDEN)
    query, buffer = buffer_set.query(QUERY), buffer_set.load(QUERY, "k1")
    found = pickle.loads(pickle.dumps([buffer_set, query, buffer]))
    assert found[1].dataset is found[2].query.dataset
    size = len(pickle.dumps(buffer))
    buffer.frames()
    assert buffer.states.nbytes > 1000
    assert len(pickle.dumps(buffer)) <= size < 50_000  # no frames, states or tables


def test_a_relative_folder_is_found_from_another_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = copy_buffer_set(tmp_path / "here" / "buffers")
    monkeypatch.chdir(root.parent)
    buffer = load_buffer(QUERY, "k1", buffer_set="buffers")
    data = pickle.dumps(buffer)
    monkeypatch.chdir(tmp_path)
    check_same(pickle.loads(data), load_buffer(QUERY, "k1", buffer_set=root))


def test_a_set_that_was_planned_anew_is_not_the_same(tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "buffers")
    buffer_set = load_buffer_set(root)
    kept = [pickle.dumps(buffer_set), pickle.dumps(buffer_set.load(QUERY, "k1"))]
    plan_again(root, ["k0", "k1"])
    for data in kept:
        with raises(HashMismatchError):
            pickle.loads(data)


def test_a_dataset_that_was_built_anew_is_not_the_same(tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "buffers")
    query = pickle.dumps(load_buffer_set(root).query(QUERY))
    path = root / "demonstrations/meta/interference.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"revision": "0" * 64}))
    with raises(HashMismatchError):
        pickle.loads(query)


def test_a_branch_of_the_hub_stays_at_its_commit(hub: HubServer, tmp_path: Path) -> None:
    push_buffer_set(hub, GOLDEN, tmp_path / "work")
    buffer_set = load_buffer_set(BUFFER_SET)
    found = pickle.loads(pickle.dumps(buffer_set))
    assert found.location == buffer_set.location and "@" in found.location
    check_same(found.load(QUERY, "k1"), load_buffer(QUERY, "k1", buffer_set=GOLDEN))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_in_another_process(method: str) -> None:
    buffer = load_buffer(QUERY, "k3", buffer_set=GOLDEN)
    with multiprocessing.get_context(method).Pool(1) as pool:
        assert pool.map(len, [buffer]) == [len(buffer)]
