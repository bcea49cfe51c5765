"""Contradicting lessons: the scene of a query with another answer."""

import sys
from collections import Counter

import numpy as np
import pytest
from support.families import families
from support.messages import raises

from robomme_interference_data.build_dataset.sources.base import SourceEpisode
from robomme_interference_data.build_dataset.sources.simulator import SimulatorSource
from robomme_interference_data.errors import SourceError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.tabletop.episodes import (
    difficulty_of,
    episode_ids,
    seed_of,
    turn_of,
)
from robomme_interference_data.simulators.tabletop.families import draw_episode, other_answer
from robomme_interference_data.simulators.tabletop.simulator import TabletopSimulator

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("family", families("MoveCube", "VideoUnmaskSwap"))
def test_goal_and_first_view_are_the_querys(tabletop: TabletopSimulator, family: str) -> None:
    episode = EpisodeId(family, "test", 1)
    other = SimulatorSource("tabletop").contradict(SourceEpisode(episode)).id
    assert other.scene == episode
    assert other.answer is not None
    lesson, first, info = tabletop.reset(str(episode), demonstration=False)
    answer = tabletop.env.answer
    contradicting, again, other_info = tabletop.reset(str(other), demonstration=False)
    assert tabletop.env.answer != answer
    assert tabletop.env.answer == tabletop.env.episode.answers[other.answer]
    assert other_info == info
    for camera, image in first.images.items():
        np.testing.assert_array_equal(again.images[camera], image)
    np.testing.assert_array_equal(again.state, first.state)
    if not family.startswith("VideoUnmask"):  # there the arm does not move in the lesson
        shorter = min(len(lesson), len(contradicting))
        assert not np.array_equal(lesson.states[:shorter], contradicting.states[:shorter])


def test_other_answers_occur_equally_often() -> None:
    """Over the episodes of a family, split and difficulty."""
    uses: dict[tuple[str, str, str], Counter[int]] = {}
    counts: dict[tuple[str, str, str], set[int]] = {}
    for episode in (one for one in episode_ids() if one.split == "test"):
        seed = seed_of(episode)
        number = other_answer(episode)
        count = len(draw_episode(episode.family, seed, difficulty_of(seed)).answers)
        own = turn_of(seed, count)
        assert number != own
        assert 0 <= number < count
        group = episode.family, episode.split, difficulty_of(seed)
        counts.setdefault(group, set()).add(count)
        uses.setdefault(group, Counter())[number - (number > own)] += 1
    for group, found in uses.items():
        (count,) = counts[group]
        if count - 1 <= found.total():
            assert max(found.values()) - min(found.values()) <= 1
            assert len(found) == count - 1


def test_official_episodes_have_no_other_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOMME_PYTHON", sys.executable)
    with raises(SourceError):
        SimulatorSource("robomme").contradict(SourceEpisode(EpisodeId("MoveCube", "test", 0)))
