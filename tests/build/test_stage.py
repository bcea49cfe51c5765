"""Staging an episode: frame selection, encoding, hashes, and frames that cannot be stored."""

import dataclasses
import gc
import hashlib
import sys
from collections.abc import Generator, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from support.made_up import MadeUpSource, picture
from support.messages import raises

from robomme_interference_data.build_dataset.dataset import stage
from robomme_interference_data.build_dataset.dataset.frame_selection import (
    NothingToStore,
    select_demonstration,
    select_unit,
)
from robomme_interference_data.build_dataset.dataset.lerobot_writer import StoredEpisode
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan
from robomme_interference_data.build_dataset.dataset.stage import StageTask
from robomme_interference_data.build_dataset.dataset.staged import (
    Staged,
    keep_staged,
    read_staged,
    staged_name,
)
from robomme_interference_data.build_dataset.sources import Frame
from robomme_interference_data.constants import DISTRACTORS
from robomme_interference_data.errors import BuildError, SourceError
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.schema.records import EvidenceSpan, SpanDigests
from robomme_interference_data.storage.arrays import combine
from robomme_interference_data.storage.lerobot.statistics import ImageStats
from robomme_interference_data.storage.video.encode import CODECS, VideoEncoder
from robomme_interference_data.storage.video.frames import iter_frames

NAME = "MoveCube/test/0"


def digest(values: NDArray[Any]) -> str:
    return hashlib.sha256(values.tobytes()).hexdigest()


def plan(source: MadeUpSource, kind: str = "demonstrations", **options: Any) -> DatasetPlan:
    return DatasetPlan(kind, (source,), (), **options)


def staged(
    folder: Path, source: MadeUpSource, kind: str = "demonstrations", **options: Any
) -> tuple[Staged, Path]:
    [episode] = source.episodes()
    made = plan(source, kind, **options)
    place = folder / staged_name(made, (0, episode))
    [outcome] = Serial().run(StageTask(made), [(0, episode)])
    if outcome.error is not None:
        raise outcome.error
    keep_staged(place, outcome.value, outcome.files)
    return outcome.value, place


def stored(folder: Path, source: MadeUpSource, **options: Any) -> StoredEpisode:
    made, place = staged(folder, source, **options)
    [episode] = made.stored(place)
    return episode


@pytest.mark.parametrize("kind", ["demonstrations", "distractors"])
def test_evidence_is_of_a_lesson(tmp_path: Path, kind: str) -> None:
    shown = (EvidenceSpan(0, "lifts cube 2", 5, 20),)
    source = MadeUpSource({NAME: (260, 20)}, evidence=shown)
    made, place = staged(tmp_path, source, kind)
    [episode] = made.episodes
    assert read_staged(place) == made
    assert episode.record.evidence == (shown if kind == "demonstrations" else None)


def test_a_demonstration(tmp_path: Path) -> None:
    made = stored(tmp_path, MadeUpSource({NAME: (40, 20)}))
    known = made.record
    assert (known.length, known.exec_start_idx) == (21, 20)
    assert known.goals == (f"do {NAME}",)
    facts = (known.seed, known.difficulty, known.simulator, known.exact)
    assert facts == (7, "easy", "made-up", True)
    front = np.stack([picture(f"{NAME} front", number) for number in range(21)])
    states = np.arange(21, dtype=np.float32)[:, None].repeat(8, 1)
    whole = {"observation.images.front": front, "observation.state": states, "action": 0 - states}
    assert known.feature_sha256 == {name: digest(v[:20]) for name, v in whole.items()}
    shown = {"observation.images.front": front, "observation.state": states}
    spans = {"first": (0, 10), "second": (10, 20), "last": (19, 20), "query": (20, 21)}
    assert known.spans == spans
    assert known.span_sha256 == SpanDigests(
        **{
            span: combine({name: digest(v[start:stop]) for name, v in shown.items()})
            for span, (start, stop) in spans.items()
        }
    )
    assert made.features == {name: v.shape[1:] for name, v in whole.items()}
    decoded = np.stack(list(iter_frames(made.videos["observation.images.front"], 0, None, 10)))
    np.testing.assert_array_equal(decoded, front)
    np.testing.assert_array_equal(made.vectors("action"), 0 - states)
    pixels = front[:, ::4, ::4]  # every fourth row and column
    mean = made.stats["observation.images.front"]["mean"]
    np.testing.assert_allclose(mean, pixels.mean((0, 1, 2)))


def test_an_episode_that_yields_nothing_is_remembered(tmp_path: Path) -> None:
    source = MadeUpSource({NAME: (200, None)})
    made, place = staged(tmp_path, source, "distractors")
    assert made.skipped == "200 raw frames; a unit needs 249"
    assert read_staged(place) == made


@pytest.mark.parametrize(
    "change", [{"cameras": ("front",)}, {"codec": "lerobot-default"}, {"kind": "distractors"}]
)
def test_what_decides_the_content_decides_the_folder(change: dict[str, Any]) -> None:
    source = MadeUpSource({NAME: (300, 20)})
    [episode] = source.episodes()
    one = plan(source)
    other = dataclasses.replace(one, **change)
    assert staged_name(one, (0, episode)) != staged_name(other, (0, episode))
    moved = dataclasses.replace(episode, key=(300, 21))
    assert staged_name(one, (0, episode)) != staged_name(one, (0, moved))


def test_of_a_lossy_codec_the_decoded_frames_are_hashed(tmp_path: Path) -> None:
    source = MadeUpSource({NAME: (9, 4)})
    big = {
        number: Frame(
            {"front": np.kron(frame.images["front"], np.ones((5, 4, 1), np.uint8))},
            *(frame.state, frame.action, frame.is_demonstration),
        )
        for number in range(5)
        for frame in [source.frame(NAME, number, 4)]
    }
    source.wrong[NAME] = big
    made = stored(tmp_path, source, codec="lerobot-default")
    decoded = np.stack(list(iter_frames(made.videos["observation.images.front"], 0, None, 10)))
    digests = made.record.feature_sha256
    assert digests["observation.images.front"] == digest(decoded[:4])
    assert not made.record.exact


def wrong_frame(**changes: Any) -> Frame:
    right = MadeUpSource({}).frame(NAME, 3, 20)
    return dataclasses.replace(right, **changes)


@pytest.mark.parametrize(
    ("number", "frame"),
    [
        (3, wrong_frame(state=np.full(8, np.nan, np.float32))),
        (3, wrong_frame(state=np.zeros(7, np.float32))),
        (3, wrong_frame(images={"front": picture("x", 1)[:8]})),
        (0, wrong_frame(images={"front": picture("x", 1)[..., 0]})),
        (3, SourceError("broke off", "record it again")),
    ],
)
def test_frames_that_cannot_be_stored(tmp_path: Path, number: int, frame: Any) -> None:
    source = MadeUpSource({NAME: (40, 20)}, {NAME: {number: frame}})
    with raises(SourceError) as caught:
        staged(tmp_path, source)
    assert caught.value.message.startswith(f"{NAME}: ")
    assert list(tmp_path.iterdir()) == []  # nothing half-made


def test_more_values_than_are_read_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 8 values, 80 are 10 frames, as many as the demonstration with its query frame has."""
    monkeypatch.setattr(stage, "MAX_READ_VALUES", 80)
    assert stored(tmp_path, MadeUpSource({NAME: (20, 9)})).record.length == 10
    with raises(SourceError):
        staged(tmp_path, MadeUpSource({NAME: (20, 10)}))


def test_a_video_that_decodes_to_something_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def other(path: Path, start: int, stop: int | None, fps: float) -> Iterator[Any]:
        for number, image in enumerate(iter_frames(path, start, stop, fps)):
            yield image if number != 7 else 255 - image

    monkeypatch.setattr(stage, "iter_frames", other)
    with raises(BuildError):
        staged(tmp_path, MadeUpSource({NAME: (40, 20)}))
    assert list(tmp_path.iterdir()) == []


IMAGES = st.tuples(st.integers(1, 5), st.integers(1, 13), st.integers(1, 13), st.just(3))


@given(arrays(np.uint8, IMAGES))
def test_statistics_against_numpy_in_any_order(images: NDArray[np.uint8]) -> None:
    stats, backward = ImageStats(), ImageStats()
    for image, last in zip(images, images[::-1], strict=True):
        stats.add(image)
        backward.add(last)
    result = stats.result()
    assert all(v.tobytes() == backward.result()[name].tobytes() for name, v in result.items())
    pixels = images[:, ::4, ::4].reshape(-1, 3).astype(np.float64)  # every fourth row and column
    assert result["count"].tolist() == [len(pixels)]
    np.testing.assert_array_equal(result["min"], pixels.min(0))
    np.testing.assert_array_equal(result["max"], pixels.max(0))
    np.testing.assert_allclose(result["mean"], pixels.mean(0), rtol=1e-12)
    np.testing.assert_allclose(result["std"], pixels.std(0), rtol=1e-9, atol=1e-9)
    for name, quantile in (("q01", 0.01), ("q10", 0.1), ("q50", 0.5), ("q90", 0.9), ("q99", 0.99)):
        # The smallest value that at least so many of the pixels do not exceed.
        expected = np.quantile(pixels, quantile, axis=0, method="inverted_cdf")
        np.testing.assert_array_equal(result[name], expected)


def marks(lesson: int | None, length: int) -> Generator[Frame]:
    """Yield frames with their number as state, marked as demonstration or not."""
    for step in range(length):
        shown = None if lesson is None else step < lesson
        yield Frame({}, np.array([step], np.float32), None, shown)


SELECT_UNIT = partial(select_unit, kind=DISTRACTORS)


def steps(frames: Any) -> list[int]:
    return [int(frame.state[0]) for frame in frames]


@given(lesson=st.none() | st.integers(0, 400), length=st.integers(0, 400))
def test_nothing_is_read_beyond_the_last_frame_that_is_needed(
    lesson: int | None, length: int
) -> None:
    for select, needed in ((SELECT_UNIT, 249), (select_demonstration, (lesson or 0) + 1)):
        read = marks(lesson, length)
        try:
            found = steps(select(read))
        except (NothingToStore, SourceError):
            assert length < needed or not lesson
            continue
        assert found == list(range(0, needed, 8 if select is SELECT_UNIT else 1))
        assert steps(read) == list(range(needed, length))  # what is left


@pytest.mark.parametrize(
    ("select", "lesson", "length"),
    [(SELECT_UNIT, None, 248), (select_demonstration, 0, 100), (select_demonstration, 100, 100)],
)
def test_nothing_to_store(select: Any, lesson: int | None, length: int) -> None:
    with raises(NothingToStore):
        list(select(marks(lesson, length)))
    with raises(SourceError):
        list(select_demonstration(marks(None, 10)))


def test_an_unfinished_video_that_cannot_be_written_ends_quietly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """PyAV would close it during garbage collection, and print a traceback."""
    full, printed = Path("/dev/full"), list[object]()
    if not full.exists():
        pytest.skip("no device that is always full")
    monkeypatch.setattr(sys, "unraisablehook", printed.append)
    encoder = VideoEncoder(full, CODECS["av1-lossless"], 10, 64, 64, container="matroska")
    with suppress(BuildError):
        for _ in range(40):
            encoder.add(np.zeros((64, 64, 3), np.uint8))
    encoder.abandon()
    del encoder
    gc.collect()
    assert not printed
