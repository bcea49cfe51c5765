"""LeRobot datasets as sources: episodes, families, column names, and invalid values."""

import json
import time
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.goal_texts import GOALS
from support.lerobot_layouts import DATA, TABLE, edit_columns, edit_info, write_lerobot
from support.messages import raises
from support.recordings import EPISODES, MOVE, PEG, Episode, check_recording, make_episode

from robomme_interference_data.build_dataset.config import BuildConfig
from robomme_interference_data.build_dataset.plan.datasets import plan_dataset
from robomme_interference_data.build_dataset.sources import Recording, Robot, open_source
from robomme_interference_data.build_dataset.sources.robomme_families import BLOCKS
from robomme_interference_data.errors import (
    FormatError,
    InvalidOptionError,
    MissingFileError,
    SourceError,
    UnknownNameError,
)
from robomme_interference_data.schema.records import EvidenceSpan

VERSIONS = ("v3.0", "v2.1", "v2.0")
NAME = "MoveCube/train/0"
FOUR = make_episode(1, 4, MOVE, 2)


def read(root: Path, index: int = 0, **options: Any) -> Recording:
    source = open_source(f"lerobot:{root}", **options)
    return source.read(source.episodes()[index], None)


def one(episode: Episode = FOUR) -> dict[str, Episode]:
    return {NAME: episode}


@pytest.fixture
def v21(tmp_path: Path) -> Path:
    return write_lerobot(tmp_path / "v21", version="v2.1")


def test_jpeg_is_not_exact(tmp_path: Path) -> None:
    recording = read(write_lerobot(tmp_path, one(), stored="jpg"))
    assert not recording.exact
    assert next(recording.frames).images["front"].shape == (16, 24, 3)


@pytest.mark.parametrize("version", VERSIONS)
def test_what_per_episode_columns_say(tmp_path: Path, version: str) -> None:
    """The columns of this project's own datasets."""
    columns = {
        "simulator": ["tabletop"],  # which has goals of its own
        "exact": [False],
        "exec_start_idx": [2],
        "goals": [["fold the towel", "fold it"]],
    }
    folded = one(replace(FOUR, goal="fold the towel"))
    recording = read(write_lerobot(tmp_path, folded, version=version, marked=False, **columns))
    assert (recording.simulator, recording.exact) == ("tabletop", False)
    assert recording.goals == ("fold the towel", "fold it")
    assert [frame.is_demonstration for frame in recording.frames] == [True, True, False, False]


def test_a_part_of_a_dataset_can_be_used(v21: Path) -> None:
    (v21 / "data/chunk-000/episode_000001.parquet").unlink()
    check_recording(read(v21), EPISODES[NAME])
    with raises(MissingFileError):
        read(v21, 1)


# --- families and goals --------------------------------------------------------------------------


def test_1600_episodes_are_named_by_block_and_quickly(tmp_path: Path) -> None:
    by_family = {family: goal for goal, fits in GOALS.items() for family in fits}
    goals = [by_family[family] for family in BLOCKS for _ in range(100)]
    episodes = {str(number): replace(FOUR, goal=goal) for number, goal in enumerate(goals)}
    root = write_lerobot(tmp_path / "d", episodes, stored=None, episode_id=None)
    start = time.perf_counter()
    listed = open_source(f"lerobot:{root}").episodes()
    assert time.perf_counter() - start < 60  # 0.5 s on an idle machine
    found = {index: (str(one.id), simulator) for one in listed for index, simulator, _ in [one.key]}
    assert (len(found), found[950]) == (1600, ("MoveCube/train/50", "robomme"))
    assert [episode.id for episode in listed] == sorted(episode.id for episode in listed)

    edit_columns(root / TABLE, tasks=[[g] for g in [*goals[:950], PEG, *goals[951:]]])
    listed = open_source(f"lerobot:{root}").episodes()
    [wrong] = [episode for episode in listed if episode.problem is not None]
    assert str(wrong.id) == "MoveCube/train/50"
    with raises(SourceError) as caught:
        wrong.check()
    assert "`families_from`" in str(caught.value.hint)
    families = [name.split("/")[0] for _, (name, _) in sorted(found.items())]
    families[950] = "InsertPeg"
    names = tmp_path / "families.csv"
    lines = [f"{number},{family}" for number, family in enumerate(families)]
    names.write_text("\n".join(["episode_index,family", *lines]))
    listed = open_source(f"lerobot:{root}", families_from=str(names)).episodes()
    ids = {episode.key[0]: str(episode.id) for episode in listed}
    assert (ids[950], ids[1000]) == ("InsertPeg/train/0", "InsertPeg/train/1")


def test_families_that_are_not_told_or_do_not_fit(tmp_path: Path) -> None:
    root = write_lerobot(tmp_path / "nameless", episode_id=None)
    with raises(SourceError):
        read(root)
    root = write_lerobot(tmp_path / "towel", one(make_episode(0, 2, "fold the towel")))
    with raises(SourceError):
        read(root)


def test_columns_by_other_names(v21: Path) -> None:
    given = {"front": "wrist_image", "wrist": "image", "action": "state"}
    known = EPISODES[NAME]
    images = {"front": known.images["wrist"], "wrist": known.images["front"]}
    expected = replace(known, images=images, action=known.state)
    check_recording(read(v21, columns=given), expected)
    edit_info(v21, lambda info: [info["features"].pop(one) for one in ("image", "wrist_image")])
    with raises(SourceError):  # lists all columns
        read(v21)


def test_another_robot_keeps_its_cameras_rate_names_and_type(tmp_path: Path) -> None:
    cameras = ("front", "left", "right")
    episode = make_episode(1, 4, MOVE, 2, cameras=cameras)
    root = write_lerobot(tmp_path, one(episode))
    names = {"motors": [f"m{number}" for number in range(8)]}
    changes: dict[str, Any] = {"fps": 12.5, "robot_type": "aloha"}
    edit_info(root, lambda i: i["features"]["action"].update(names=names), **changes)
    recording = read(root)
    assert recording.robot == Robot(12.5, "aloha", {"action": tuple(names["motors"])})
    check_recording(recording, episode)
    top = read(root, columns={"top": "observation.images.front"})
    assert set(next(top.frames).images) == {"top", "left", "right"}
    with raises(InvalidOptionError):
        read(root, columns={"../x": "observation.images.front"})


def test_a_given_column_takes_precedence_over_the_one_of_its_name(tmp_path: Path) -> None:
    episode = make_episode(1, 4, MOVE, 2, cameras=("front", "left", "right"))
    root = write_lerobot(tmp_path, one(episode))
    for name in ("front", "left"):
        chosen = read(root, columns={name: "observation.images.right"})
        seen = next(chosen.frames).images
        np.testing.assert_array_equal(seen[name], episode.images["right"][0])
        assert "right" not in seen
    with raises(UnknownNameError):
        read(root, columns={"left": "nothing"})
    copy = {"left": {"dtype": "image", "shape": [48, 64, 3]}}
    edit_info(root, lambda info: info["features"].update(copy))
    with raises(SourceError):
        read(root)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_families_file_can_mark_the_demonstrations(tmp_path: Path, version: str) -> None:
    root = write_lerobot(tmp_path / "d", one(), version=version, marked=False, episode_id=None)
    config = BuildConfig(source=(f"lerobot:{root}",), buffer_set=tmp_path / "out")
    file = tmp_path / "families.csv"
    file.write_text("episode_index,family\n0,MoveCube\n")
    named = replace(config, families_from=str(file))
    assert plan_dataset("distractors", named).episodes
    with raises(SourceError):
        plan_dataset("demonstrations", named)  # before anything is read
    file.write_text("episode_index,family,exec_start_idx\n0,MoveCube,3\n")
    assert plan_dataset("demonstrations", named).episodes
    shown = [frame.is_demonstration for frame in read(root, families_from=str(file)).frames]
    assert shown == [True] * 3 + [False]


def test_families_of_one_build_are_not_those_of_another(tmp_path: Path, run: Any) -> None:
    """A file that lists episodes by number would give those of other recordings false families."""
    recorded = {"0": make_episode(0, 250, "fold"), "1": make_episode(1, 250, "open")}
    data = write_lerobot(tmp_path / "d", recorded, stored="png", marked=False, episode_id=None)
    root, units = tmp_path / "set", ("--only", "distractors", "--workers", "1")
    file = tmp_path / "families.csv"
    file.write_text("episode_index,family\n0,Fold\n1,Open\n")
    source = ("--source", f"lerobot:{data}")
    assert run("build", root, *units, *source, "--families-from", file)[0] == 0
    assert [path.name for path in root.iterdir()] == ["distractors"]
    others = {"0": make_episode(2, 250, "push"), "1": make_episode(3, 250, "pull")}
    other = write_lerobot(tmp_path / "e", others, stored="png", marked=False, episode_id=None)
    code, _, err = run("build", root, *units, "--source", f"lerobot:{other}", "--json")
    hint = json.loads(err)["hint"].splitlines()
    assert code == 1 and hint[1:] == ["task,family", "push,<family>", "pull,<family>"]


@pytest.mark.parametrize(
    ("columns", "error"),
    [
        ({"is_dem": "is_demo"}, SourceError),
        ({"front": "imge"}, UnknownNameError),
        ({"front": "state"}, SourceError),
        ({"wrist": "depth"}, SourceError),
    ],
)
def test_columns_that_do_not_fit(v21: Path, columns: Any, error: Any) -> None:
    depth = {"dtype": "image", "shape": [48, 64, 1]}
    edit_info(v21, lambda info: info["features"].update(depth=depth))
    with raises(error):
        read(v21, columns=columns)


@pytest.mark.parametrize(
    ("columns", "lesson"),
    [
        ({"is_demo": [True, True, True, False], "exec_start_idx": [3] * 4}, 3),  # not as lists
        ({"is_demo": ["True", "true", "False", "0"]}, 2),
        ({"is_demo": [1.0, 1.0, 0.0, 0.0]}, 2),
        ({"is_demo": [1, 1, 0, 0], "exec_start_idx": [2.0] * 4}, 2),
        ({"is_demo": [1.0, 1.0, float("nan"), 0.0]}, "nan"),
        ({"is_demo": [1, 2, 0, 0]}, "2"),
        ({"is_demo": [True, None, False, False]}, "None"),
        ({"is_demo": [True, False, True, False]}, "true in 2 frames, not all of them at the"),
        ({"exec_start_idx": [2, 2, 3, 2]}, "'exec_start_idx' holds 2, 3; expected one number"),
        ({"exec_start_idx": [3] * 4}, "not clear: 2 by is_demo and 3 by exec_start_idx"),
        ({"exec_start_idx": [2, None, 2, 2]}, "1 empty values"),
        ({"is_demo": ["yes"] * 4}, "column 'is_demo' is of type string"),
    ],
)
def test_marks(tmp_path: Path, columns: Any, lesson: int | str) -> None:
    root = write_lerobot(tmp_path, one())
    edit_columns(root / DATA, **dict.fromkeys(columns))  # away with the old type
    edit_columns(root / DATA, **columns)
    if isinstance(lesson, int):
        shown = [frame.is_demonstration for frame in read(root).frames]
        assert shown == [step < lesson for step in range(4)]
        return
    with raises((SourceError, FormatError)):
        read(root)


@pytest.mark.parametrize("column", ["simple_subgoal", "grounded_subgoal"])
def test_subgoals_of_the_demonstration_are_evidence(tmp_path: Path, column: str) -> None:
    root = write_lerobot(tmp_path, one(make_episode(1, 6, MOVE, 4)))
    assert read(root).evidence is None
    edit_columns(root / DATA, **{column: [None, "hook it", "hook it", "put it", "put it", "done"]})
    assert read(root).evidence is None  # no column that info.json tells
    declared = {column: {"dtype": "string", "shape": [1]}}
    edit_info(root, lambda info: info["features"].update(declared))
    assert read(root).evidence == (
        EvidenceSpan(0, "hook it", 1, 3),
        EvidenceSpan(1, "put it", 3, 4),  # cut by the end of the lesson
    )
    edit_columns(root / DATA, **{column: None})
    edit_columns(root / DATA, **{column: [1] * 6})
    with raises(FormatError):
        read(root)


def test_evidence_of_this_projects_datasets_goes_before_subgoals(tmp_path: Path) -> None:
    spans = [{"part": 0, "text": "hooks it", "start": 0, "stop": 2}]
    root = write_lerobot(tmp_path, one(), evidence=[spans])
    assert read(root).evidence == (EvidenceSpan(0, "hooks it", 0, 2),)
    other = write_lerobot(tmp_path / "other", one(), evidence=[[spans[0] | {"stop": 0}]])
    with raises(SourceError):
        read(other)


# --- invalid values -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "columns",
    [
        {"seed": ["seventeen"]},
        {"seed": [1e300]},
        {"seed": [float("inf")]},
        {"seed": [True]},
        {"difficulty": [3]},
        {"difficulty": ["0"]},
        {"exact": [0.5]},
        {"exact": ["maybe"]},
        {"exec_start_idx": [2.5]},
        {"exec_start_idx": [3]},  # the rows say 2
        {"goals": [7]},
        {"tasks": [["something else"]]},
        {"tasks": [7]},
        {"episode_id": [None]},
        {"episode_id": [7]},
        {"evidence": ["x"]},
        {"seed": [Decimal("7.5")]},
    ],
)
def test_invalid_values(tmp_path: Path, columns: dict[str, Any]) -> None:
    root = write_lerobot(tmp_path, one(), **columns)
    with raises(SourceError):
        read(root)


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({"seed": [7.0]}, {"seed": 7}),
        ({"seed": ["7"]}, {"seed": 7}),
        ({"seed": [float("nan")]}, {"seed": None}),
        ({"seed": [""]}, {"seed": None}),
        ({"seed": [Decimal("7.00")]}, {"seed": 7}),
        ({"seed": [-(2**62)]}, {"seed": -(2**62)}),
        ({"difficulty": [float("nan")]}, {"difficulty": None}),
        ({"difficulty": [""]}, {"difficulty": None}),
        ({"exact": [1]}, {"exact": True}),
        ({"exact": [0.0]}, {"exact": False}),
        ({"exact": ["False"]}, {"exact": False}),
        ({"exact": [float("nan")]}, {"exact": True}),  # by the images
        ({"simulator": [float("nan")]}, {"simulator": None}),
        ({"goals": [MOVE]}, {"goals": (MOVE,)}),
        ({"goals": [float("nan")]}, {"goals": (MOVE,)}),
        ({"tasks": [MOVE]}, {"goals": (MOVE,)}),
        ({"evidence": [float("nan")]}, {"evidence": None}),
    ],
)
def test_values_as_other_programs_store_them(
    tmp_path: Path, columns: dict[str, Any], expected: dict[str, Any]
) -> None:
    recording = read(write_lerobot(tmp_path, one(), **columns))
    assert {name: getattr(recording, name) for name in expected} == expected


def test_pandas_makes_floats_of_the_columns_of_merged_datasets(tmp_path: Path) -> None:
    """Episodes without a value have NaN, and the others floats."""
    episodes = {"MoveCube/train/0": FOUR, "MoveCube/test/1": replace(FOUR)}
    columns = {
        "exec_start_idx": [2.0, float("nan")],
        "family": ["MoveCube", "MoveCube"],
        "split": ["train", "test"],
        "index": [0.0, 1.0],
        "episode_id": None,
    }
    root = write_lerobot(tmp_path, episodes, marked=False, **columns)
    source = open_source(f"lerobot:{root}")
    listed = source.episodes()
    assert [(str(episode.id), episode.marked) for episode in listed] == [
        ("MoveCube/train/0", True),
        ("MoveCube/test/1", False),
    ]
    first = source.read(listed[0], None)
    assert [frame.is_demonstration for frame in first.frames] == [True, True, False, False]


def test_images_that_are_wrong(tmp_path: Path) -> None:
    root = write_lerobot(tmp_path, one())
    column = "observation.images.front"
    cells = pq.read_table(root / DATA)[column].to_pylist()
    wrong = [*cells[:2], {"bytes": cells[2]["bytes"][:60], "path": None}, cells[3]]
    edit_columns(root / DATA, **{column: wrong})
    frames = read(root).frames
    assert [next(frames).is_demonstration for _ in range(2)] == [True, True]  # read one by one
    with raises(FormatError):
        next(frames)


def test_an_image_of_another_kind_is_named_with_its_file(tmp_path: Path) -> None:
    root = write_lerobot(tmp_path, one())
    column = "observation.images.front"
    cells = pq.read_table(root / DATA)[column].to_pylist()
    edit_columns(root / DATA, **{column: [{"bytes": b"BM6$", "path": None}, *cells[1:]]})
    with raises(FormatError) as caught:
        read(root)
    assert DATA in caught.value.message
    assert column in caught.value.message


def test_a_recording_without_frames_is_left_out(tmp_path: Path) -> None:
    root = write_lerobot(tmp_path, {NAME: FOUR, "MoveCube/train/1": make_episode(2, 0)})
    first, second = open_source(f"lerobot:{root}").episodes()
    first.check()
    with raises(SourceError):
        second.check()


def test_features_without_values_that_are_not_used(tmp_path: Path) -> None:
    """Some datasets declare sensors that their robot has not."""
    root = write_lerobot(tmp_path, one())

    def declare(info: dict[str, Any]) -> None:
        info["features"]["observation.force"] = {"dtype": "float32", "shape": [0]}

    edit_info(root, declare)
    check_recording(read(root), FOUR)


@pytest.mark.parametrize(
    ("columns", "splits"),
    [({}, ["train", "test", "train"]), ({"split": ["val", "", None]}, ["val", "test", "train"])],
)
def test_splits_of_the_dataset(tmp_path: Path, columns: Any, splits: list[str]) -> None:
    """A per-episode column comes first, then those in info.json."""
    episodes = {f"Fold/train/{index}": make_episode(index, 4, "fold it") for index in range(3)}
    root = write_lerobot(tmp_path, episodes, episode_id=None, family=["Fold"] * 3, **columns)
    edit_info(root, splits={"train": "0:1", "test": "1:2"})
    listed = {
        episode.key[0]: episode.id.split for episode in open_source(f"lerobot:{root}").episodes()
    }
    assert [listed[index] for index in range(3)] == splits
