"""The made-up sample: a frames folder that every machine makes alike."""

import hashlib
import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from recordings import contents
from typer.testing import CliRunner

from robomme_interference_data.build_dataset.sample import write_sample
from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.cli import app
from robomme_interference_data.errors import BuildError, SourceError
from robomme_interference_data.ids import EpisodeId

FAMILIES = ("VideoRepick", "Drawer")


def write(folder: Path, **options) -> list[int]:
    values = {"families": FAMILIES, "train": 2, "test": 1, "size": 32, "demonstration": 20}
    return list(write_sample(folder, **{**values, **options}))


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sample") / "sample"
    assert write(folder) == [260, 200, 260, 260, 260, 260]
    return folder


def test_episodes(sample: Path) -> None:
    listed = open_source(f"frames:{sample}").episodes()
    assert [(str(e.id), e.raw_length, e.demonstration_length) for e in listed] == [
        ("VideoRepick/train/0", 260, 20),
        ("VideoRepick/train/1", 200, 36),
        ("VideoRepick/test/0", 260, 20),
        ("Drawer/train/0", 260, 20),
        ("Drawer/train/1", 260, 36),
        ("Drawer/test/0", 260, 20),
    ]
    for episode in listed:
        assert episode.cameras == {"front": (32, 32), "wrist": (32, 32)}
        assert (episode.exact, episode.simulator) == (True, "sample")
        assert (episode.state_size, episode.action_size) == (8, 8)
        assert episode.difficulty == ("easy", "medium")[episode.id.index]
        goal = f"watch the video carefully, then do the {episode.id.family} task again"
        assert episode.goals == (goal,)
        seed = int.from_bytes(hashlib.sha256(str(episode.id).encode()).digest()[:4])
        assert episode.seed == seed


def test_frames(sample: Path) -> None:
    source = open_source(f"frames:{sample}")
    seen: set[bytes] = set()
    for episode in source.episodes():
        frames = list(source.read(episode))
        assert len(frames) == episode.raw_length
        for number, frame in enumerate(frames):
            assert frame.is_demonstration == (number < episode.demonstration_length)
            assert (frame.state * 1024 == np.round(frame.state * 1024)).all()
            assert frame.state[7] in (0, 40 / 1024)
        # An action is the state that follows.
        for one, other in pairwise(frames):
            assert np.array_equal(one.action, other.state)
        views = {frame.images[camera].tobytes() for frame in frames[::8] for camera in frame.images}
        assert not views & seen, "two episodes have a frame in common"
        seen |= views


def test_every_machine_makes_the_same_pixels(sample: Path) -> None:
    source = open_source(f"frames:{sample}")
    digests = {}
    for episode in source.episodes():
        if episode.id == EpisodeId("Drawer", "train", 1):
            running = {name: hashlib.sha256() for name in ("front", "wrist", "state")}
            for frame in source.read(episode):
                for name in ("front", "wrist"):
                    running[name].update(frame.images[name].tobytes())
                running["state"].update(frame.state.tobytes())
            digests = {name: digest.hexdigest()[:16] for name, digest in running.items()}
    # Golden: they change only if the sample is meant to look different.
    assert digests == {
        "front": "5e1ff77bcfeb026a",
        "wrist": "0c6252ee62df9aac",
        "state": "4623d88fac5a73f0",
    }


def test_the_same_bytes_every_time(sample: Path, tmp_path: Path) -> None:
    write(tmp_path / "other")
    first, second = contents(sample), contents(tmp_path / "other")
    table = "frames.parquet"
    assert pq.read_table(sample / table) == pq.read_table(tmp_path / "other" / table)
    assert first.pop(table) == second.pop(table)
    # The container holds a random number, the frames are compared above.
    assert first.keys() == second.keys()
    assert len(first) == 2 * 6


def test_an_interrupted_sample_is_no_source(tmp_path: Path) -> None:
    running = write_sample(tmp_path / "sample", families=FAMILIES, size=16)
    next(running)
    running.close()
    with pytest.raises(SourceError, match=r"frames.parquet is missing"):
        open_source(f"frames:{tmp_path / 'sample'}")
    with pytest.raises(BuildError, match="is not empty") as raised:
        write(tmp_path / "sample")
    assert "Choose another --out, or remove it first." in str(raised.value)


def test_an_empty_folder_is_taken(tmp_path: Path) -> None:
    (tmp_path / "sample").mkdir()
    assert write(tmp_path / "sample", families=("MoveCube",), train=1, test=0, size=16) == [260]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_command_and_everything_after(tmp_path: Path) -> None:
    runner = CliRunner()
    sample, split = tmp_path / "sample", tmp_path / "split"
    done = runner.invoke(app, ["build", "sample", "--out", str(sample), "--train", "1"])
    assert done.exit_code == 0
    assert f"--source frames:{sample}" in " ".join(done.stderr.split())
    done = runner.invoke(app, ["build", "all", "--source", f"frames:{sample}", "--out", str(split)])
    assert done.exit_code == 0, done.stderr
    counts = json.loads((split / "manifests/manifest.json").read_text())["counts"]
    assert counts == {"queries": 18, "buffers": 72, "sessions": 18 * (1 + 2 + 4 + 8)}
    assert runner.invoke(app, ["verify", str(split)]).exit_code == 0
    assert runner.invoke(app, ["audit", str(split)]).exit_code == 0
