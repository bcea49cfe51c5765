"""How the episodes of a LeRobot dataset get their ids."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.build_dataset.sources.families import (
    ids_by_block,
    ids_by_columns,
    ids_by_file,
)
from robomme_interference_data.errors import SourceError


def written(folder: Path, text: str, name: str = "families.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def names(ids: dict) -> dict[int, str]:
    return {index: str(name) for index, name in ids.items()}


def test_block() -> None:
    ids = names(ids_by_block(range(1600), "train"))
    assert ids[0] == "PatternLock/train/0"
    assert ids[99] == "PatternLock/train/99"
    assert ids[100] == "ButtonUnmaskSwap/train/0"
    assert ids[345] == "VideoPlaceButton/train/45"
    assert ids[950] == "MoveCube/train/50"
    assert ids[1599] == "VideoUnmask/train/99"
    assert len(set(ids.values())) == 1600


def test_csv_counts_within_family_and_split(tmp_path: Path) -> None:
    text = (
        "episode_index, family, split\n"
        "2,InsertPeg,val\n\n"
        "0,MoveCube,train\n"
        "3,MoveCube,train\n"
        "1,MoveCube,val\n"
    )
    ids = ids_by_file(written(tmp_path, text), [0, 1, 2, 3], "train")
    assert names(ids) == {
        0: "MoveCube/train/0",
        1: "MoveCube/val/0",
        2: "InsertPeg/val/0",
        3: "MoveCube/train/1",
    }


def test_csv_with_index_and_byte_order_mark(tmp_path: Path) -> None:
    path = written(tmp_path, "\ufefffamily,index,episode_index\r\nA,7,0\r\nA,3,1\r\n")
    assert names(ids_by_file(path, [0, 1], "test")) == {0: "A/test/7", 1: "A/test/3"}


def test_json(tmp_path: Path) -> None:
    path = written(tmp_path, '{"1": "A", "0": "A"}', "families.json")
    assert names(ids_by_file(path, [0, 1], "train")) == {0: "A/train/0", 1: "A/train/1"}


@given(st.lists(st.sampled_from(["A", "B", "MoveCube"]), min_size=1, max_size=20), st.randoms())
def test_order_of_lines_does_not_matter(tmp_path_factory, families, random) -> None:
    folder = tmp_path_factory.mktemp("families")
    lines = [f"{index},{family}" for index, family in enumerate(families)]
    random.shuffle(lines)
    path = written(folder, "episode_index,family\n" + "\n".join(lines))
    as_json = written(folder, json.dumps(dict(map(str, p) for p in enumerate(families))), "f.json")
    ids = ids_by_file(path, range(len(families)), "train")
    assert ids == ids_by_file(as_json, range(len(families)), "train")
    for family in set(families):
        mine = [name.index for name in ids.values() if name.family == family]
        assert mine == list(range(len(mine)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: no column 'episode_index'"),
        ("episode_index\n0\n", "line 1: no column 'family'"),
        ("episode_index,famly\n0,A\n", "line 1: unknown column 'famly'"),
        ("episode_index,family,family\n0,A,A\n", "line 1: column 'family' comes twice"),
        ("episode_index,family\n0,A\n1\n", "line 3: 1 values; the first line has 2"),
        ("episode_index,family\n0,A\nx,A\n", "line 3: episode_index is 'x'"),
        ("episode_index,family\n0,A\n-1,A\n", "line 3: episode_index is '-1'"),
        ("episode_index,family\n0,A\n2,A\n", "line 3: the dataset has no episode 2"),
        ("episode_index,family\n0,A\n\n0,B\n", "line 4: episode 0 was named before, in"),
        ("episode_index,family\n0,A\n", "names 1 of 2 episodes; missing: 1"),
        ("episode_index,family\n0,A\n1,9lives\n", "line 3: '9lives' is not a family name"),
        ("episode_index,family,split\n0,A,train\n1,A,trian\n", "line 3: 'trian' is not a split"),
        ("episode_index,family,index\n0,A,0\n1,A,0\n", "line 3: A/train/0 is already the name of"),
        ("episode_index,family,index\n0,A,0\n1,A,one\n", "line 3: index is 'one'"),
    ],
)
def test_csv_problems_are_named_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(SourceError) as caught:
        ids_by_file(path, [0, 1], "train")
    assert message in str(caught.value)
    assert str(path) in caught.value.message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not JSON"),
        ('["A", "B"]', "holds no JSON object"),
        ('{"0": "A", "1": 2}', "key '1': the family is 2"),
        ('{"0": "A", "one": "B"}', "key 'one': episode_index is 'one'"),
        ('{"0": "A", "0": "B"}', "key '0': episode 0 was named before"),
        ('{"0": "A"}', "names 1 of 2 episodes; missing: 1"),
    ],
)
def test_json_problems_are_named_with_their_key(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SourceError, match=r"families\.json") as caught:
        ids_by_file(written(tmp_path, text, "families.json"), [0, 1], "train")
    assert message in str(caught.value)


def test_missing_file_says_what_it_should_hold(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"cannot be read(.|\n)*episode_index,family"):
        ids_by_file(tmp_path / "none.csv", [0], "train")


def test_columns_of_our_own_datasets() -> None:
    rows = {0: {"episode_id": "MoveCube/val/3"}, 1: {"episode_id": "InsertPeg/test/0"}}
    assert names(ids_by_columns(rows, "train", "here") or {}) == {
        0: "MoveCube/val/3",
        1: "InsertPeg/test/0",
    }


def test_columns_family_split_and_source_episode() -> None:
    rows = {
        0: {"family": "A", "split": "val", "source_episode": 12},
        1: {"family": "A", "split": None},
        2: {"family": "A"},
    }
    assert names(ids_by_columns(rows, "train", "here") or {}) == {
        0: "A/val/12",
        1: "A/train/0",
        2: "A/train/1",
    }


def test_no_columns() -> None:
    assert ids_by_columns({0: {"tasks": ["x"]}}, "train", "here") is None


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ({0: {"episode_id": "MoveCube"}}, "here: meta/episodes, episode 0: 'MoveCube' is not"),
        ({4: {"family": "A", "source_episode": "7"}}, "episode 4: source_episode is '7'"),
        (
            {0: {"episode_id": "A/val/1"}, 1: {"episode_id": "A/val/1"}},
            "episode 1: A/val/1 is already the name of here: meta/episodes, episode 0",
        ),
    ],
)
def test_columns_that_are_wrong(rows: dict, message: str) -> None:
    with pytest.raises(SourceError) as caught:
        ids_by_columns(rows, "train", "here")
    assert message in str(caught.value)
