"""Staging finds recordings that are not what their source says, and encoders that lose frames."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import staging
from recordings import MemorySource, frames_of, listed
from staging import LOSSY, run

from robomme_interference_data.build_dataset import stage
from robomme_interference_data.build_dataset.encode import VideoEncoder
from robomme_interference_data.build_dataset.sources.base import Frame, SourceEpisode
from robomme_interference_data.build_dataset.stage import read_staged
from robomme_interference_data.errors import BuildError, MissingFileError, SourceError

folder = staging.folder  # the fixture


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
