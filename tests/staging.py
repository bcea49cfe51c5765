"""An episode made up in memory, staged."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from recordings import MemorySource

from robomme_interference_data.build_dataset.encode import CODECS
from robomme_interference_data.build_dataset.plan import PlannedEpisode, plan_dataset
from robomme_interference_data.build_dataset.sources.base import SourceEpisode
from robomme_interference_data.build_dataset.stage import StagedEpisode, stage_episode

LOSSLESS = CODECS["av1-lossless"]
LOSSY = CODECS["lerobot-default"]


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


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """Where the episode is staged; whatever happens, nothing else may be left beside it."""
    (tmp_path / "episodes").mkdir()
    yield tmp_path / "episodes" / "one"
    assert {path.name for path in (tmp_path / "episodes").iterdir()} <= {"one"}
