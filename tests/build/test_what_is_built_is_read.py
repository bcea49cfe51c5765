"""Whatever a build accepts, every reader reads: shapes, values, goals and names at their bounds."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.made_up import MadeUpSource, picture
from support.messages import raises

from robomme_interference_data import load_buffer
from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.dataset.frame_checks import check_shapes
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan
from robomme_interference_data.build_dataset.plan.episodes import choose_episodes
from robomme_interference_data.build_dataset.sources import Frame, Recording, Robot, SourceEpisode
from robomme_interference_data.constants import ACTION, CAMERA_PREFIX, STATE, Unit
from robomme_interference_data.errors import SourceError
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.storage.lerobot.statistics import vector_statistics
from robomme_interference_data.storage.limits import MAX_VECTOR
from robomme_interference_data.storage.parquet import RowSpan

QUERY, UNIT = "Drawer/test/0", "Cups/train/0"
LONG = "a" * (1 << 16)
NO_READING = float(np.finfo(np.float32).max)


@dataclass
class Shaped(MadeUpSource):
    """A source of vectors of given sizes, goals and values."""

    state: int = 2
    action: int | None = 2
    goals: tuple[str, ...] = ("do it",)
    value: float = 0.5
    seed: int | None = 7
    robot: Robot = field(default_factory=lambda: Robot(10))

    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        frames = self._frames(str(episode.id), self.cameras)
        return Recording(self.goals, self.seed, "easy", "made-up", True, frames, None, self.robot)

    def frame(
        self, name: str, number: int, lesson: int | None, cameras: tuple[str, ...] = ("front",)
    ) -> Frame:
        action = None if self.action is None else vector(self.action, -number, self.value)
        images = {camera: picture(name, number) for camera in cameras}
        shown = None if lesson is None else number < lesson
        return Frame(images, vector(self.state, number, self.value), action, shown)


def vector(size: int, number: int, value: float) -> NDArray[np.float32]:
    values = np.arange(size, dtype=np.float32) / 8 + number
    values[:1] = value if number % 2 else number
    return values


def build(root: Path, source: Shaped) -> None:
    """Build a buffer set with one query and one unit."""
    unit = Unit(3, 1)
    for kind, name in (("demonstrations", QUERY), ("distractors", UNIT)):
        family, split, _ = name.split("/")
        tasks = choose_episodes([source], families=(family,), split=split)
        plan = DatasetPlan(kind, (source,), tasks, unit=unit)
        build_dataset(plan, root / kind, Serial(), WorkProgress(quiet=True))


def made(**options: Any) -> Shaped:
    return Shaped({QUERY: (6, 4), UNIT: (4, None)}, **options)


CASES: dict[str, dict[str, Any]] = {
    "one value each": {"state": 1, "action": 1},
    "one value and no action": {"state": 1, "action": None},
    "no state": {"state": 0},
    "a gripper's action": {"state": 8, "action": 1},
    "no reading": {"value": NO_READING},
    "the smallest": {"value": -NO_READING, "state": 1},
    "text": {
        "goals": ("  Öffne 🗄️\r\n\tdann\u2028 \x00 'so' \"", "zweite"),
        "cameras": ("Käm-1 .x",),
    },
    "long": {"goals": (LONG,), "cameras": ("x" * 181,)},
    "names": {"robot": Robot(1e-3, "r\n", {STATE: ("ä" * 200, ""), ACTION: ("a/b", "{x}")})},
    "large seed": {"seed": -(2**63), "robot": Robot(1e3)},
}
LARGE = {
    "5,000 values": {"state": 5000, "action": 4097},
    "the most values": {"state": MAX_VECTOR, "action": MAX_VECTOR},
}


@pytest.mark.parametrize(
    "options",
    [
        *(pytest.param(options, id=name) for name, options in CASES.items()),
        *(
            pytest.param(options, id=name, marks=pytest.mark.slow)
            for name, options in LARGE.items()
        ),
    ],
)
def test_it_is_read_and_verified(tmp_path: Path, run: Any, options: dict[str, Any]) -> None:
    source = made(**options)
    build(tmp_path, source)
    assert run("build", tmp_path, "--only", "manifests", "--conditions", "k0,k1")[0] == 0
    assert run("verify", tmp_path)[0] == 0
    buffer = load_buffer(QUERY, "k1", buffer_set=tmp_path, verify=True)
    lesson = [vector(source.state, number, source.value) for number in range(4)]
    unit = [vector(source.state, number, source.value) for number in range(3)]
    np.testing.assert_array_equal(buffer.states, np.stack([*lesson, *unit]))
    assert (buffer.query.record.goals, buffer.cameras) == (source.goals, source.cameras)
    actions = buffer.query.dataset.read_vectors(0, ACTION, 0, 2) if source.action else None
    if actions is not None and source.action is not None:
        expected = [vector(source.action, -number, source.value) for number in range(2)]
        np.testing.assert_array_equal(actions, np.stack(expected))


NOT_STORED: dict[str, dict[str, Any]] = {
    "too many values": {"state": MAX_VECTOR + 1},
    "too many of an action": {"action": MAX_VECTOR + 1},
    "a longer goal": {"goals": (LONG, "b")},
    "half of a character": {"goals": ("\ud83d",)},
    "a slash in a camera": {"cameras": ("a/b",)},
    "a camera's name": {"cameras": ("{front}",)},
    "a camera's long name": {"cameras": ("x" * 182,)},
    "a long name": {"robot": Robot(10, names={STATE: ("a" * 201, "b")})},
    "a slow rate": {"robot": Robot(9e-4)},
    "a fast rate": {"robot": Robot(10_001.0)},
    "a seed of 64 bits": {"seed": 2**63},
}


@pytest.mark.parametrize("options", NOT_STORED.values(), ids=NOT_STORED)
def test_what_no_reader_would_accept_is_not_staged(tmp_path: Path, options: dict[str, Any]) -> None:
    with raises(SourceError) as raised:
        build(tmp_path / "set", made(**options))
    assert raised.value.hint
    assert not (tmp_path / "set" / "demonstrations").exists()


# --- the same of any shape, without lerobot ------------------------------------------------------


@given(st.integers(1, 5000), st.integers(1, 4))
def test_vectors_of_any_size_as_lerobot_stores_them(
    tmp_path_factory: pytest.TempPathFactory, size: int, frames: int
) -> None:
    values = np.arange(size * frames, dtype=np.float32).reshape(frames, size)
    check_shapes({}, {STATE: values[0]})
    # LeRobot stores vectors of one value as the value.
    column = pa.array(values[:, 0]) if size == 1 else pa.array([*values], pa.list_(pa.float32()))
    path = tmp_path_factory.mktemp("vectors") / "t.parquet"
    pq.write_table(pa.table({STATE: column}), path)
    np.testing.assert_array_equal(RowSpan(path).vectors(STATE), values)


@given(st.text(max_size=190))
def test_a_camera_name_is_accepted_or_one_clear_error(name: str) -> None:
    image = np.zeros((2, 2, 3), np.uint8)
    try:
        check_shapes({CAMERA_PREFIX + name: image}, {})
    except SourceError as error:
        assert error.hint is not None
        return
    assert not {*name} & {*"/\\{}[]*?:,<>|\"'\0\n"}
    assert len(CAMERA_PREFIX + name) <= 200


# --- statistics ----------------------------------------------------------------------------------


def test_statistics_by_hand() -> None:
    """Of 0, 2, 4, …, 198: mean 99, variance (100² − 1) / 12 · 4 = 3333; ranks 1, 10, 50, 90, 99."""
    values = 2.0 * np.random.default_rng(0).permutation(100).astype(np.float32)
    stats = vector_statistics(values)
    assert {name: value.tolist() for name, value in stats.items() if name != "std"} == {
        "min": [0.0],
        "max": [198.0],
        "mean": [99.0],
        "count": [100],
        "q01": [0.0],
        "q10": [18.0],
        "q50": [98.0],
        "q90": [178.0],
        "q99": [196.0],
    }
    np.testing.assert_allclose(stats["std"], [3333**0.5], rtol=1e-12)


@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=1, max_size=9))
def test_statistics_of_any_finite_values_are_finite(values: list[float]) -> None:
    stats = vector_statistics(np.array([values, values[::-1]], np.float32).T)
    for name, array in stats.items():
        assert np.isfinite(array).all(), name
        assert array.shape == ((1,) if name == "count" else (2,))
