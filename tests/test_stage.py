"""One episode: encoded, decoded again, hashed, and kept under a name of its own."""

import dataclasses
import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import recordings
import staging
from recordings import MemorySource, images_of, listed, vectors_of
from staging import LOSSLESS, LOSSY, planned, run

from robomme_interference_data.build_dataset.sources.base import Frame, SourceEpisode
from robomme_interference_data.build_dataset.stage import StagedEpisode, read_staged, stage_name
from robomme_interference_data.video import iter_frames

folder = staging.folder  # the fixture

FRONT, WRIST = "observation.images.front", "observation.images.wrist"
STATE, ACTION = "observation.state", "action"
UNIT = slice(0, 256, 8)


def sha256(values: np.ndarray) -> str:
    return hashlib.sha256(values.tobytes()).hexdigest()


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
