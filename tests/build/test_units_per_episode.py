"""Several units of one long recording: where they begin, their ids, and buffers of them."""

import itertools
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buffer_sets import plan_again, violations
from support.made_up import MadeUpSource
from support.made_up import record as record_of
from support.messages import raises

from robomme_interference_data import EpisodeId, load_buffer_set
from robomme_interference_data.build_dataset.config import BuffersConfig, BuildConfig
from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.dataset.frame_selection import (
    select_episodes,
    unit_starts,
)
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan, PlannedEpisode
from robomme_interference_data.build_dataset.plan.checks import check_plans
from robomme_interference_data.build_dataset.plan.datasets import plan_dataset
from robomme_interference_data.build_dataset.plan.episodes import choose_episodes
from robomme_interference_data.build_dataset.plan.parts import plan_alone
from robomme_interference_data.build_dataset.verify.audit import audit_buffer_set
from robomme_interference_data.build_dataset.verify.dataset import start_violations
from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    PAPER_UNIT,
    RAW_DISTRACTORS,
    UNITS,
    Unit,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import BuildError, InvalidOptionError, SourceError
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.schema.draw import UnitPool
from robomme_interference_data.storage.files import LocalFiles

QUERIES = {"Lift/test/0": (12, 5), "Stack/test/0": (12, 5)}
TRAIN: dict[str, Any] = {
    "Lift/train/0": (40, None),
    "Lift/train/1": (9, None),  # too short
    "Stack/train/0": (22, None),
    "Stack/train/1": (12, None),
}
THREE = Unit(4, 3, 3)
"""Raw frames 0, 3, 6, 9 from each start; at full rate 12. At most 3 of an episode."""


@pytest.mark.parametrize(
    ("length", "most", "starts"),
    [
        (248, 1, []),
        (248, 9, []),
        (249, 9, [0]),
        (504, 9, [0]),  # a second one would begin at 255, within the first one's 256
        (505, 9, [0, 256]),
        (1000, 1, [0]),
        (1000, 2, [0, 751]),
        (1000, 3, [0, 375, 751]),
        (1000, 4, [0, 375, 751]),
        (36_000, 4, [0, 11_917, 23_834, 35_751]),  # an hour at 10 frames per second
    ],
)
def test_starts_by_hand(length: int, most: int, starts: list[int]) -> None:
    assert unit_starts(length, PAPER_UNIT._replace(per_episode=most)) == starts


@given(st.integers(0, 400), st.integers(1, 5), st.integers(1, 5), st.integers(1, 40))
def test_starts(length: int, frames: int, stride: int, most: int) -> None:
    unit = Unit(frames, stride, most)
    starts = unit_starts(length, unit)
    assert len(starts) <= most and (not starts) == (length < unit.raw_frames)
    span = frames * stride
    assert all(after - before >= span for before, after in itertools.pairwise(starts))
    if starts:
        assert starts[0] == 0 and starts[-1] + unit.raw_frames <= length
        # As many as fit, and evenly spaced: gaps differ by one at most.
        assert len(starts) == min(most, 1 + (length - unit.raw_frames) // span)
        gaps = {after - before for before, after in itertools.pairwise(starts)}
        assert not gaps or max(gaps) - min(gaps) <= 1
        assert len(starts) == 1 or starts[-1] + unit.raw_frames == length


def stored_steps(kind: str, length: int, unit: Unit) -> dict[int, list[int]]:
    """The raw frames that each unit of an episode stores, by the unit's start."""
    source = MadeUpSource({"Lift/train/0": (length, None)})
    [episode] = source.episodes()
    recording = source.read(episode, ())
    return {
        start: [int(frame.state[0]) for frame in frames]
        for start, frames in select_episodes(kind, recording, unit, unit_starts(length, unit))
    }


@given(st.integers(1, 120), st.integers(1, 4), st.integers(1, 4), st.integers(1, 6))
def test_no_frame_is_in_two_units(length: int, frames: int, stride: int, most: int) -> None:
    unit = Unit(frames, stride, most)
    units, raw = (stored_steps(kind, length, unit) for kind in UNITS)
    assert units.keys() == raw.keys()
    for start, steps in units.items():
        assert steps == [start + stride * number for number in range(frames)]
        assert raw[start] == [*range(start, min(start + frames * stride, length))]
    every = [step for steps in raw.values() for step in steps]
    assert len(every) == len({*every})


def build(root: Path, kind: str, lengths: dict[str, Any], unit: Unit = THREE) -> Dataset:
    source = MadeUpSource(lengths)
    episodes = tuple(PlannedEpisode(0, episode) for episode in source.episodes())
    plan = DatasetPlan(kind, (source,), episodes, unit=unit)
    build_dataset(plan, root / kind, Serial(), WorkProgress(quiet=True))
    return Dataset(LocalFiles(root / kind))


@pytest.fixture(scope="module")
def buffers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("units")
    for kind in (DEMONSTRATIONS, *UNITS):
        build(root, kind, QUERIES if kind == DEMONSTRATIONS else TRAIN)
    plan_again(root, ("k0", "k1", "k3", "raw-k3"))
    return root


def test_a_dataset_of_several_units(buffers: Path) -> None:
    for kind in UNITS:
        dataset = Dataset(LocalFiles(buffers / kind))
        # 40 frames: room for starts 0 to 30, three at 0, 15 and 30. 22: 0 and 12. 12: 0.
        names = ["Lift/train/0", "Lift/train/0@15", "Lift/train/0@30"]
        names += ["Stack/train/0", "Stack/train/0@12", "Stack/train/1"]
        assert [str(record.episode_id) for record in dataset.records()] == names
        assert dataset.unit == THREE.in_dataset(kind)
        assert (dataset.identity.unit or {})["per_episode"] == 3
        for number, first in enumerate((0, 15, 30, 0, 12, 0)):
            record = dataset.record(number)
            states = dataset.read_vectors(number, "observation.state", 0, record.length)
            steps = range(first, first + 12, 3)
            if kind == RAW_DISTRACTORS:
                steps = range(first, first + record.length)
            assert states[:, 0].tolist() == [*steps]
    assert [record.length for record in dataset.records()] == [12, 12, 10, 12, 10, 12]


def test_buffers_of_them(buffers: Path) -> None:
    assert violations(buffers) == []
    opened = load_buffer_set(buffers)
    buffer = opened.load("Stack/test/0", "k3", verify=True)
    # Three units of other families: all of the one long recording.
    assert sorted(str(session.source) for session in buffer.sessions[1:]) == [
        *("Lift/train/0", "Lift/train/0@15", "Lift/train/0@30")
    ]
    raw = opened.load("Stack/test/0", "raw-k3", verify=True)
    assert [s.source for s in raw.sessions] == [s.source for s in buffer.sessions]
    kinds = {leak.kind for leak in audit_buffer_set(opened).leaks}
    assert kinds == {"same scene"}  # all made-up episodes have one seed


def test_own_units_are_of_other_recordings() -> None:
    names = ["Lift/train/0", "Lift/train/0@15", "Lift/train/1", "Lift/train/1@20"]
    pool = UnitPool(map(EpisodeId.parse, names))
    drawn = pool.draw_own(EpisodeId.parse("Lift/train/0"), 2)
    assert {str(unit.scene) for unit in drawn} == {"Lift/train/1"}
    with raises(BuildError):
        pool.draw_own(EpisodeId.parse("Lift/train/0"), 3)


def test_a_dataset_is_extended_with_as_many_units(buffers: Path, tmp_path: Path) -> None:
    some = {name: TRAIN[name] for name in ("Lift/train/0", "Stack/train/1")}
    build(tmp_path, DISTRACTORS, some)
    for other in (THREE._replace(per_episode=2), THREE._replace(per_episode=1)):
        with raises(BuildError) as caught:
            build(tmp_path, DISTRACTORS, TRAIN, other)
        assert "units_per_episode=3" in str(caught.value.hint)
    extended, whole = (
        build(tmp_path, DISTRACTORS, TRAIN),
        Dataset(LocalFiles(buffers / DISTRACTORS)),
    )
    assert extended.revision == whole.revision
    assert extended.identity.sums == whole.identity.sums


def test_one_unit_is_not_mentioned(tmp_path: Path) -> None:
    one = build(tmp_path, DISTRACTORS, TRAIN, THREE._replace(per_episode=1))
    assert one.identity.unit == {"frames": 4, "stride": 3}
    assert [record.episode_id.start for record in one.records()] == [0, 0, 0]


def test_units_that_overlap_are_found() -> None:
    def problems(unit: Unit, *names: str, kind: str = DISTRACTORS) -> int:
        return len([*start_violations(kind, [record_of(kind, name) for name in names], unit)])

    two = PAPER_UNIT._replace(per_episode=2)
    assert problems(two, "Lift/train/0", "Lift/train/0@256", "Lift/train/1") == 0
    assert problems(two, "Lift/train/0", "Lift/train/0@255") == 1
    assert problems(two, "Lift/train/0", "Lift/train/0@256", "Lift/train/0@512") == 1
    assert problems(two, "Lift/train/0@256") == 1
    assert problems(PAPER_UNIT, "Lift/train/0", "Lift/train/0@256") == 1
    assert problems(two, "Lift/test/0", "Lift/test/0@256", kind=DEMONSTRATIONS) == 1


def test_settings(tmp_path: Path) -> None:
    def config(**changes: Any) -> BuildConfig:
        return BuildConfig(source=("sample",), buffer_set=tmp_path / "set", **changes)

    assert plan_dataset(DISTRACTORS, config(units_per_episode=4)).unit == Unit(32, 8, 4)
    with raises(InvalidOptionError) as caught:
        plan_dataset(DISTRACTORS, config(units_per_episode=0))
    assert caught.value.option == "units_per_episode"
    with raises(InvalidOptionError) as caught:
        plan_alone(DEMONSTRATIONS, config(units_per_episode=4))
    assert caught.value.option == "units_per_episode"
    # 2 episodes with up to 3 units each may suffice for 3; with one each they cannot.
    source = MadeUpSource(TRAIN)
    plan = DatasetPlan(DISTRACTORS, (source,), choose_episodes((source,)), unit=THREE)
    queries, request = {EpisodeId.parse("Lift/test/0")}, BuffersConfig(conditions=("k3",))
    check_plans(queries, {DISTRACTORS: plan}, tmp_path / "set", None, request)
    fewer = DatasetPlan(DISTRACTORS, plan.sources, plan.episodes, unit=Unit(4, 3))
    with raises(BuildError):
        check_plans(queries, {DISTRACTORS: fewer}, tmp_path / "set", None, request)


def test_a_unit_is_no_recording() -> None:
    source = MadeUpSource({"Lift/train/0@30": (300, None)})
    with raises(SourceError):
        choose_episodes((source,))
