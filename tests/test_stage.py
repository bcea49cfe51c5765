"""One episode: encoded, decoded again, hashed, and kept under a name of its own."""

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import recordings
from recordings import MemorySource, frames_of, images_of, listed, vectors_of

from robomme_interference_data.build_dataset import stage
from robomme_interference_data.build_dataset.encode import CODECS, VideoEncoder
from robomme_interference_data.build_dataset.plan import PlannedEpisode, plan_dataset
from robomme_interference_data.build_dataset.sources.base import Frame, SourceEpisode
from robomme_interference_data.build_dataset.stage import (
    StagedEpisode,
    read_staged,
    stage_episode,
    stage_name,
)
from robomme_interference_data.errors import BuildError, MissingFileError, SourceError
from robomme_interference_data.video import iter_frames

LOSSLESS = CODECS["av1-lossless"]
LOSSY = CODECS["lerobot-default"]
FRONT, WRIST = "observation.images.front", "observation.images.wrist"
STATE, ACTION = "observation.state", "action"
UNIT = slice(0, 256, 8)


def planned(episode: SourceEpisode, kind: str = "demonstrations") -> PlannedEpisode:
    return plan_dataset(kind, [[episode]]).episodes[0]


def run(
    folder: Path,
    episode: SourceEpisode,
    kind: str = "demonstrations",
    *,
    source: MemorySource | None = None,
    codec=LOSSLESS,
) -> StagedEpisode:
    cameras = tuple(sorted(episode.cameras))
    item = planned(episode, kind)
    return stage_episode(source or MemorySource([episode]), item, cameras, codec, 10, folder)


def sha256(values: np.ndarray) -> str:
    return hashlib.sha256(values.tobytes()).hexdigest()


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """Where the episode is staged; whatever happens, nothing else may be left beside it."""
    (tmp_path / "episodes").mkdir()
    yield tmp_path / "episodes" / "one"
    assert {path.name for path in (tmp_path / "episodes").iterdir()} <= {"one"}


# --- what is written ----------------------------------------------------------------------------


def test_digests_of_a_demonstration(folder: Path) -> None:
    episode = listed("MoveCube/test/3", length=50, lesson=7)
    staged = run(folder, episode)
    assert staged.length == 8
    values = {
        FRONT: images_of(episode, "front"),
        WRIST: images_of(episode, "wrist"),
        STATE: vectors_of(episode, "state", 8),
        ACTION: vectors_of(episode, "action", 8),
    }
    assert staged.feature_sha256 == {name: sha256(v[:8]) for name, v in values.items()}
    assert staged.lesson_feature_sha256 == {name: sha256(v[:7]) for name, v in values.items()}


def test_digests_of_a_unit(folder: Path) -> None:
    episode = listed("MoveCube/train/3", length=249, lesson=None)
    staged = run(folder, episode, "distractors")
    assert staged.length == 32
    assert staged.feature_sha256 == {
        FRONT: sha256(images_of(episode, "front")[UNIT]),
        WRIST: sha256(images_of(episode, "wrist")[UNIT]),
        STATE: sha256(vectors_of(episode, "state", 8)[UNIT]),
        ACTION: sha256(vectors_of(episode, "action", 8)[UNIT]),
    }
    assert staged.lesson_feature_sha256 == {}


def test_files(folder: Path) -> None:
    episode = listed("MoveCube/train/0")
    staged = run(folder, episode, "distractors")
    assert sorted(path.name for path in folder.iterdir()) == [
        "action.npy",
        "front.mp4",
        "record.json",
        "state.npy",
        "wrist.mp4",
    ]
    for camera in ("front", "wrist"):
        decoded = np.stack(list(iter_frames(staged.video(camera), 0, None, 10)))
        assert np.array_equal(decoded, images_of(episode, camera)[UNIT])
    for feature, what in ((STATE, "state"), (ACTION, "action")):
        assert staged.vectors(feature).dtype == np.float32
        assert np.array_equal(staged.vectors(feature), vectors_of(episode, what, 8)[UNIT])


def test_statistics_are_of_the_stored_frames(folder: Path) -> None:
    episode = listed("MoveCube/test/0", lesson=4)
    staged = run(folder, episode)
    pixels = images_of(episode, "front")[:5, ::4, ::4].reshape(-1, 3).astype(float)
    np.testing.assert_allclose(staged.stats[FRONT]["mean"], pixels.mean(0))
    np.testing.assert_allclose(staged.stats[FRONT]["std"], pixels.std(0))
    assert staged.stats[FRONT]["count"] == [5 * 4 * 6]  # of 16 × 24 pixels
    assert set(staged.stats) == {FRONT, WRIST}


def test_vectors_of_other_sizes_and_no_actions(folder: Path) -> None:
    episode = listed("MoveCube/train/0", state_size=3, action_size=None, cameras=("front",))
    staged = run(folder, episode, "distractors")
    assert set(staged.feature_sha256) == {FRONT, STATE}
    assert staged.vectors(STATE).shape == (32, 3)
    assert not (folder / "action.npy").exists()


def test_no_frame_after_the_last_is_read(folder: Path) -> None:
    episode = listed("MoveCube/test/0", length=300, lesson=7)
    seen: list[int] = []

    def note(index: int, frame: Frame) -> Frame:
        seen.append(index)
        return frame

    run(folder, episode, source=MemorySource([episode], alter=note))
    assert seen == list(range(8))


# --- staging twice ------------------------------------------------------------------------------


def test_a_staged_episode_is_read_back_and_not_made_again(folder: Path) -> None:
    episode = listed("MoveCube/test/0")
    first = run(folder, episode)
    times = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    source = MemorySource([episode])
    assert run(folder, episode, source=source) == first == read_staged(folder)
    assert source.reads == []
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == times


def test_nothing_is_staged_yet(folder: Path) -> None:
    assert read_staged(folder) is None
    folder.mkdir()
    assert read_staged(folder) is None


def test_leftovers_of_a_killed_worker_do_no_harm(tmp_path: Path) -> None:
    episodes = tmp_path / "episodes"
    leftover = episodes / ".one.abcdefgh"
    leftover.mkdir(parents=True)
    (leftover / "front.mp4").write_bytes(b"half a video")
    episode = listed("MoveCube/test/0")
    assert run(episodes / "one", episode).feature_sha256[FRONT] == sha256(
        images_of(episode, "front")[:6]
    )
    assert (leftover / "front.mp4").read_bytes() == b"half a video"


def test_another_process_may_stage_the_same_episode_meanwhile(folder: Path) -> None:
    episode = listed("MoveCube/test/0")

    def overtake(index: int, frame: Frame) -> Frame:
        if index == 3:
            run(folder, episode)
        return frame

    staged = run(folder, episode, source=MemorySource([episode], alter=overtake))
    assert staged == dataclasses.replace(read_staged(folder), folder=folder)


def test_the_same_episode_gives_the_same_bytes(tmp_path: Path) -> None:
    episode = listed("MoveCube/test/0")
    run(tmp_path / "one", episode)
    run(tmp_path / "two", episode)
    assert recordings.contents(tmp_path / "one") == recordings.contents(tmp_path / "two")


# --- the name -----------------------------------------------------------------------------------

EPISODE = listed("MoveCube/train/0")


@pytest.mark.parametrize(
    "changed",
    [
        {"id": listed("MoveCube/train/1").id},
        {"goals": ("other",)},
        {"raw_length": 261},
        {"demonstration_length": 6},
        {"seed": None},
        {"difficulty": None},
        {"simulator": None},
        {"exact": False},
        {"cameras": {"front": (16, 24)}},
        {"key": ("recording", "changed since")},
        {"state_size": 7},
        {"action_size": None},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_the_name_depends_on_everything_that_is_known_of_the_episode(changed: dict) -> None:
    other = dataclasses.replace(EPISODE, **changed)
    names = {stage_name(planned(e), ("front",), LOSSLESS) for e in (EPISODE, other)}
    assert len(names) == 2


def test_every_field_of_an_episode_is_in_the_list_above() -> None:
    marks = test_the_name_depends_on_everything_that_is_known_of_the_episode.pytestmark
    fields = {name for changed in marks[0].args[1] for name in changed}
    assert fields == {field.name for field in dataclasses.fields(SourceEpisode)}


def test_the_name_depends_on_how_it_is_stored() -> None:
    names = [
        stage_name(planned(EPISODE), ("front", "wrist"), LOSSLESS),
        stage_name(planned(EPISODE), ("front",), LOSSLESS),
        stage_name(planned(EPISODE), ("front", "wrist"), LOSSY),
        stage_name(planned(EPISODE, "distractors"), ("front", "wrist"), LOSSLESS),
        stage_name(
            planned(EPISODE),
            ("front", "wrist"),
            dataclasses.replace(LOSSLESS, options={**LOSSLESS.options, "cpu-used": "7"}),
        ),
    ]
    assert len(set(names)) == 5


def test_the_name_does_not_depend_on_which_source_it_is() -> None:
    item = planned(EPISODE)
    assert stage_name(dataclasses.replace(item, source=3), ("front",), LOSSLESS) == stage_name(
        item, ("front",), LOSSLESS
    )


def test_the_name_is_the_same_on_every_machine() -> None:
    # A golden value: it changes only if a new layout of staged episodes is meant.
    assert stage_name(planned(EPISODE), ("front",), LOSSLESS) == "64f605eb901b55cef9ea039f"


# --- recordings that are not what their source says ---------------------------------------------


def refused(
    folder: Path, alter: Callable[[int, Frame], Frame], kind: str = "demonstrations"
) -> str:
    """Stage an episode with altered frames, and return why that fails."""
    episode = listed("MoveCube/train/0", lesson=5)
    with pytest.raises(SourceError) as raised:
        run(folder, episode, kind, source=MemorySource([episode], alter=alter))
    assert read_staged(folder) is None
    return str(raised.value)


def changing(index: int, **values) -> Callable[[int, Frame], Frame]:
    """Change what the source says of one raw frame."""
    return lambda i, frame: dataclasses.replace(frame, **values) if i == index else frame


def test_a_source_that_ends_early(folder: Path) -> None:
    episode = listed("MoveCube/train/0", length=250)
    source = MemorySource([episode])
    source.read = lambda _: (f for i, f in enumerate(frames_of(episode)) if i < 240)
    with pytest.raises(SourceError, match="ends after 30 of the 32 frames that are needed"):
        run(folder, episode, "distractors", source=source)


def test_a_source_that_raises(folder: Path) -> None:
    episode = listed("MoveCube/train/0")
    source = MemorySource([episode], breaks={"MoveCube/train/0": 100})
    with pytest.raises(SourceError, match="cannot read frame 100"):
        run(folder, episode, "distractors", source=source)


def test_the_source_is_closed_when_something_fails(folder: Path) -> None:
    closed = []

    def read(episode: SourceEpisode):
        try:
            yield from frames_of(dataclasses.replace(episode, state_size=3))
        finally:
            closed.append(True)

    episode = listed("MoveCube/train/0")
    source = MemorySource([episode])
    source.read = read
    with pytest.raises(SourceError):
        run(folder, episode, source=source)
    assert closed == [True]


def test_an_image_of_another_size(folder: Path) -> None:
    images = {name: np.zeros((24, 16, 3), np.uint8) for name in ("front", "wrist")}
    message = refused(folder, changing(4, images=images))
    assert "MoveCube/train/0: front of frame 4 is (24, 16, 3) uint8" in message
    assert "the source says (16, 24, 3) uint8" in message


def test_a_missing_camera(folder: Path) -> None:
    images = {"front": np.zeros((16, 24, 3), np.uint8)}
    message = refused(folder, changing(16, images=images), "distractors")
    assert "wrist of frame 16 is None" in message


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"state": np.zeros(7, np.float32)},
            "state of frame 2 is (7,) float32; the source says (8,)",
        ),
        ({"state": np.zeros(8)}, "state of frame 2 is (8,) float64; the source says (8,) float32"),
        ({"action": np.zeros((8, 1), np.float32)}, "action of frame 2 is (8, 1) float32"),
        ({"action": np.zeros(8, np.int64)}, "action of frame 2 is (8,) int64"),
        ({"action": None}, "action of frame 2 is None; the source says (8,) float32"),
        (
            {"images": dict.fromkeys(("front", "wrist"), np.zeros((16, 24, 3), np.float32))},
            "front of frame 2 is (16, 24, 3) float32; the source says (16, 24, 3) uint8",
        ),
    ],
)
def test_values_of_another_shape_or_type(folder: Path, values: dict, message: str) -> None:
    assert message in refused(folder, changing(2, **values))


def test_actions_that_the_source_does_not_list(folder: Path) -> None:
    episode = listed("MoveCube/train/0", action_size=None)
    action = np.zeros(8, np.float32)
    source = MemorySource([episode], alter=changing(0, action=action))
    with pytest.raises(SourceError, match=r"action of frame 0 is \(8,\) float32; .* says None"):
        run(folder, episode, source=source)


@pytest.mark.parametrize(("index", "flag"), [(0, False), (4, False), (5, True)])
def test_a_flag_that_contradicts_the_length(folder: Path, index: int, flag: bool) -> None:
    message = refused(folder, changing(index, is_demonstration=flag))
    assert f"frame {index} contradicts the demonstration length of 5" in message


def test_flags_do_not_matter_to_a_unit(folder: Path) -> None:
    episode = listed("MoveCube/train/0", lesson=5)
    source = MemorySource([episode], alter=changing(0, is_demonstration=False))
    assert run(folder, episode, "distractors", source=source).length == 32


def test_flags_that_the_source_does_not_give_are_no_contradiction(folder: Path) -> None:
    episode = listed("MoveCube/train/0", lesson=5)
    source = MemorySource(
        [episode], alter=lambda _, frame: dataclasses.replace(frame, is_demonstration=None)
    )
    assert run(folder, episode, source=source).length == 6


# --- encoders that lose something ---------------------------------------------------------------


def tampered(monkeypatch: pytest.MonkeyPatch, change: Callable) -> None:
    """Let the encoder of the wrist camera get other frames: `change(count, image) -> images`."""

    class Tampered(VideoEncoder):
        def __init__(self, path: Path, *rest):
            super().__init__(path, *rest)
            self._tamper = path.stem == "wrist"
            self._seen = -1

        def add(self, image: np.ndarray) -> None:
            self._seen += 1
            for given in change(self._seen, image) if self._tamper else [image]:
                super().add(given)

    monkeypatch.setattr(stage, "VideoEncoder", Tampered)


def one_value_off(image: np.ndarray) -> np.ndarray:
    changed = image.copy()
    changed[15, 23, 2] ^= 1
    return changed


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda i, image: [one_value_off(image)] if i == 3 else [image], "does not decode to the"),
        (lambda i, image: [image[::-1]] if i == 3 else [image], "does not decode to the frames"),
        (lambda i, image: [] if i == 3 else [image], "decodes to 5 frames; 6 were encoded"),
        (lambda i, image: [] if i == 5 else [image], "decodes to 5 frames; 6 were encoded"),
        (lambda i, image: [image] * 2 if i == 3 else [image], "decodes to 7 frames; 6 were"),
    ],
    ids=["altered", "flipped", "dropped", "last dropped", "doubled"],
)
def test_what_the_encoder_loses_is_found(
    folder: Path, monkeypatch: pytest.MonkeyPatch, change: Callable, message: str
) -> None:
    tampered(monkeypatch, change)
    with pytest.raises(BuildError, match=message) as raised:
        run(folder, listed("MoveCube/test/0", lesson=5))
    assert str(raised.value).startswith("MoveCube/test/0: observation.images.wrist ")
    assert read_staged(folder) is None


def test_frames_in_another_order_are_found(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held = []

    def swap(i: int, image: np.ndarray) -> list[np.ndarray]:
        if i == 2:
            held.append(image)
            return []
        return [image, held[0]] if i == 3 else [image]

    tampered(monkeypatch, swap)
    with pytest.raises(BuildError, match="does not decode to the frames"):
        run(folder, listed("MoveCube/test/0", lesson=5))


def test_an_empty_video_is_found(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tampered(monkeypatch, lambda i, image: [])
    with pytest.raises(MissingFileError, match=r"wrist\.mp4 does not exist"):
        run(folder, listed("MoveCube/test/0", lesson=5))
    assert read_staged(folder) is None


@pytest.mark.parametrize("dropped", [0, 3, 5])
def test_the_lossy_codec_may_not_drop_frames_either(
    folder: Path, monkeypatch: pytest.MonkeyPatch, dropped: int
) -> None:
    tampered(monkeypatch, lambda i, image: [] if i == dropped else [image])
    with pytest.raises(BuildError, match="decodes to 5 frames; 6 were encoded"):
        run(folder, listed("MoveCube/test/0", lesson=5, size=(64, 64)), codec=LOSSY)


def test_the_lossy_codec_records_what_is_decoded(folder: Path) -> None:
    episode = listed("MoveCube/test/0", lesson=5, size=(64, 72))
    staged = run(folder, episode, codec=LOSSY)
    for feature, camera in ((FRONT, "front"), (WRIST, "wrist")):
        decoded = np.stack(list(iter_frames(staged.video(camera), 0, None, 10)))
        assert decoded.shape == (6, 64, 72, 3)
        assert staged.feature_sha256[feature] == sha256(decoded)
        assert staged.lesson_feature_sha256[feature] == sha256(decoded[:5])
        assert staged.feature_sha256[feature] != sha256(images_of(episode, camera)[:6])
    assert staged.feature_sha256[STATE] == sha256(vectors_of(episode, "state", 8)[:6])
    assert staged.lesson_feature_sha256[ACTION] == sha256(vectors_of(episode, "action", 8)[:5])


def test_a_record_is_json_that_reads_back(folder: Path) -> None:
    staged = run(folder, listed("MoveCube/test/0"))
    record = json.loads((folder / "record.json").read_text())
    assert StagedEpisode(folder=folder, **record) == staged
    shutil.rmtree(folder)
    assert read_staged(folder) is None
