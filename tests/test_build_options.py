"""What a build is told and tells: filters, cameras, codecs, progress; what it imports."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import pytest
from recordings import EPISODES, MemorySource, build, listed, opened

from robomme_interference_data.build_dataset.build import Filters, Settings, build_dataset
from robomme_interference_data.build_dataset.encode import CODECS
from robomme_interference_data.errors import BuildError, InvalidOptionError, SourceError
from robomme_interference_data.progress import BuildProgress

# --- options -------------------------------------------------------------------------------------


def test_too_short_episodes_are_reported(tmp_path: Path, here: None) -> None:
    episodes = [listed("Drawer/train/0"), listed("Drawer/train/1", length=248)]
    result = build("distractors", MemorySource(episodes), tmp_path / "out")
    assert [(item.episode_id, item.raw_length) for item in result.skipped] == [
        ("Drawer/train/1", 248)
    ]
    assert (result.episodes, result.frames) == (1, 32)
    again = build("distractors", MemorySource(episodes), tmp_path / "out")
    assert again == dataclasses.replace(result, existed=True)


def test_nothing_to_build(tmp_path: Path) -> None:
    episodes = [listed("Drawer/train/0", length=200), listed("Drawer/test/0")]
    with pytest.raises(SourceError) as raised:
        build(
            "distractors", MemorySource(episodes), tmp_path / "out", filters=Filters(split="train")
        )
    assert str(raised.value) == (
        "no episode yields distractors: 2 listed, 1 selected, 1 unusable "
        "(Drawer/train/0: 200 raw frames; a unit needs 249)\n"
        "Check --families, --split and --episodes against the sources."
    )
    assert list(tmp_path.iterdir()) == []


def test_filters_come_before_cameras(tmp_path: Path, here: None) -> None:
    episodes = [listed("MoveCube/train/0"), listed("Drawer/train/0", cameras=("front",))]
    chosen = Filters(families=("MoveCube",))
    build(
        "distractors", MemorySource(episodes), tmp_path / "out", filters=chosen, cameras=("wrist",)
    )
    assert opened(tmp_path / "out").cameras == ("observation.images.wrist",)
    with pytest.raises(InvalidOptionError, match="--cameras wrist: Drawer/train/0 has no such"):
        build("distractors", MemorySource(episodes), tmp_path / "none", cameras=("wrist",))


def test_unknown_camera(tmp_path: Path) -> None:
    with pytest.raises(InvalidOptionError, match="--cameras frnt: ") as raised:
        build("distractors", MemorySource(EPISODES), tmp_path / "out", cameras=("frnt",))
    assert "Did you mean 'front'?" in str(raised.value)
    assert list(tmp_path.iterdir()) == []


def test_no_workers(tmp_path: Path) -> None:
    with pytest.raises(InvalidOptionError, match="--workers 0; expected 1 or more"):
        build("distractors", MemorySource(EPISODES), tmp_path / "out", workers=0)
    assert not (tmp_path / "out").exists()


def test_too_small_frames_for_the_lossy_codec(tmp_path: Path, here: None) -> None:
    with pytest.raises(BuildError, match="too small for lerobot-default"):
        build("distractors", MemorySource(EPISODES[:1]), tmp_path / "out", codec="lerobot-default")


# --- progress ------------------------------------------------------------------------------------


def test_progress_counts_what_was_staged_before(tmp_path: Path, here: None) -> None:
    settings = Settings(codec=CODECS["av1-lossless"])
    broken = MemorySource(EPISODES, breaks={"Drawer/train/1": 9})
    for source, expected in ((broken, [(96, 128)]), (MemorySource(EPISODES), [(128, 128)] * 2)):
        with BuildProgress(quiet=True) as progress:
            if source is broken:
                with pytest.raises(SourceError):
                    build_dataset(
                        "distractors", [source], tmp_path / "out", Filters(), settings, progress
                    )
            else:
                build_dataset(
                    "distractors", [source], tmp_path / "out", Filters(), settings, progress
                )
            bars = progress._progress.tasks
            assert [(task.completed, task.total) for task in bars] == expected
    assert bars[0].description == "Encoding 4 episodes"
    assert bars[1].description == "Writing the LeRobot dataset"


def test_progress_shows_frames_and_speed(capfd: pytest.CaptureFixture[str]) -> None:
    with BuildProgress() as progress:
        with progress.status("Listing episodes"):
            pass
        progress.start("Encoding 2 episodes", 64)
        progress.advance(32, before=True)
        progress.advance(32)
    out, err = capfd.readouterr()
    assert out == ""
    assert "Encoding 2 episodes" in err
    assert "64/64 frames" in err


# --- libraries -----------------------------------------------------------------------------------


def test_heavy_libraries_are_imported_only_when_needed() -> None:
    script = (
        "import sys\n"
        "from robomme_interference_data.build_dataset import (\n"
        "    audit, build, commands, encode, finish, manifests, plan, sample, verify, writer)\n"
        "from robomme_interference_data.build_dataset.sources import open_source\n"
        "print(sorted({'lerobot', 'torch', 'datasets', 'h5py', 'pandas'} & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=os.environ
    )
    assert done.stdout == "[]\n"
