"""Families, simulators and splits of LeRobot datasets, and goals that do not fit them."""

import json
import time
from pathlib import Path

import pytest
from goal_texts import GOALS
from lerobot_factory import PEG, write_v3_metadata

from robomme_interference_data.build_dataset.sources.families import BLOCK_FAMILIES
from robomme_interference_data.build_dataset.sources.lerobot import LeRobotSource
from robomme_interference_data.errors import SourceError


def block_goals() -> list[str]:
    """A fitting goal for each of the 1,600 episodes, in RoboMME's order of families."""
    by_family = {family: goal for goal, fits in GOALS.items() for family in fits}
    return [by_family[family] for family in BLOCK_FAMILIES for _ in range(100)]


def test_1600_episodes_are_named_by_block_and_quickly(tmp_path: Path) -> None:
    write_v3_metadata(tmp_path, block_goals())
    source = LeRobotSource(str(tmp_path))
    start = time.perf_counter()
    episodes = source.episodes()
    assert time.perf_counter() - start < 3  # about 0.1 s
    assert len(episodes) == 1600
    found = {episode.key.place.index: str(episode.id) for episode in episodes}
    assert found[0] == "PatternLock/train/0"
    assert found[950] == "MoveCube/train/50"
    assert found[1599] == "VideoUnmask/train/99"
    assert [episode.id for episode in episodes] == sorted(episode.id for episode in episodes)
    assert {episode.simulator for episode in episodes} == {"robomme"}
    assert {episode.exact for episode in episodes} == {False}
    assert {episode.demonstration_length for episode in episodes} == {None}


def test_goal_that_cannot_belong_to_its_family(tmp_path: Path) -> None:
    goals = block_goals()
    goals[950] = PEG
    write_v3_metadata(tmp_path, goals)
    with pytest.raises(SourceError) as caught:
        LeRobotSource(str(tmp_path)).episodes()
    text = str(caught.value)
    assert f"episode 950 would be MoveCube/train/50, but its goal {PEG!r} cannot be" in text
    assert "it fits InsertPeg" in text
    assert "--families-file" in text
    names = tmp_path / "families.json"
    source = LeRobotSource(str(tmp_path))
    blocks = source._ids()[0]
    named = {str(index): name.family for index, name in blocks.items()} | {"950": "InsertPeg"}
    names.write_text(json.dumps(named))
    episodes = LeRobotSource(str(tmp_path), families_file=names).episodes()
    found = {episode.key.place.index: str(episode.id) for episode in episodes}
    assert found[950] == "InsertPeg/train/0"  # MoveCube's block comes before InsertPeg's
    assert found[1000] == "InsertPeg/train/1"
    assert found[951] == "MoveCube/train/50"


def test_goal_of_no_family(tmp_path: Path) -> None:
    write_v3_metadata(tmp_path, ["fold the towel"], family=["MoveCube"])
    with pytest.raises(SourceError, match="it fits no family of RoboMME"):
        LeRobotSource(str(tmp_path)).episodes()


def test_another_simulator_has_its_own_goals(tmp_path: Path) -> None:
    write_v3_metadata(
        tmp_path,
        ["fold the towel"],
        episode_id=["MoveCube/val/3"],
        simulator=["tabletop"],
        seed=[17],
        difficulty=["hard"],
        exact=[True],
        exec_start_idx=[1],
        goals=[["fold the towel", "fold it"]],
    )
    (episode,) = LeRobotSource(str(tmp_path)).episodes()
    assert str(episode.id) == "MoveCube/val/3"
    assert (episode.simulator, episode.seed, episode.difficulty) == ("tabletop", 17, "hard")
    assert episode.exact
    assert episode.demonstration_length == 1
    assert episode.goals == ("fold the towel", "fold it")


def test_simulator_of_the_whole_dataset(tmp_path: Path) -> None:
    write_v3_metadata(tmp_path, ["fold the towel"], family=["Towel"])
    assert LeRobotSource(str(tmp_path)).episodes()[0].simulator is None
    (tmp_path / "meta/interference.json").write_text('{"simulator": "tabletop"}')
    assert LeRobotSource(str(tmp_path)).episodes()[0].simulator == "tabletop"


def test_split_given_for_all(tmp_path: Path) -> None:
    write_v3_metadata(tmp_path, ["fold it", "fold it"], family=["Towel", "Towel"])
    episodes = LeRobotSource(str(tmp_path), split="val").episodes()
    assert [str(episode.id) for episode in episodes] == ["Towel/val/0", "Towel/val/1"]
