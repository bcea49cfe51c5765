"""Buffer sets: list, filter and load; mistyped names raise one error."""

import json
import pickle
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.buffer_sets import CONDITIONS, GOLDEN, QUERIES, UNITS
from support.damage import HEADER
from support.messages import raises
from support.package import imported_modules

from robomme_interference_data import (
    DecodedCache,
    EpisodeId,
    InterferenceError,
    load_buffer,
    load_buffer_set,
)
from robomme_interference_data.errors import (
    InvalidIdError,
    InvalidOptionError,
    MissingExtraError,
    MissingFileError,
    UnknownNameError,
)
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.conditions import parse_condition


def test_manifests_as_a_data_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    buffer_set = load_buffer_set(GOLDEN)
    frame = buffer_set.to_pandas()
    assert frame.to_dict("records")[0]["sessions"].tolist() == []  # no-history
    listed = [to_dict(one) for one in buffer_set.manifests()]
    for name in ("episode_id", "family", "condition", "k", "lesson_share", "exact"):
        assert frame[name].tolist() == [one[name] for one in listed]
    sessions = frame["sessions"].iloc[-1].tolist()
    assert sessions == listed[-1]["sessions"] and len(sessions) == 8
    some = buffer_set.to_pandas(family="MoveCube", condition=["k3", "k7"])
    assert (some["family"] + some["condition"]).tolist() == ["MoveCubek3", "MoveCubek7"]
    with pytest.raises(UnknownNameError):
        buffer_set.to_pandas(k=5)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError) as raised:
        buffer_set.to_pandas()
    assert raised.value.hint == "Install it: pip install pandas"


def test_what_a_buffer_set_lists() -> None:
    buffer_set = load_buffer_set(GOLDEN)
    assert tuple(map(str, buffer_set.episode_ids)) == QUERIES
    assert buffer_set.families == ("VideoRepick", "MoveCube", "PatternLock")
    assert buffer_set.conditions == CONDITIONS
    assert buffer_set.cameras == ("front", "wrist")
    assert (len(buffer_set), buffer_set.name) == (15, "buffer_set")
    assert [str(manifest) for manifest in buffer_set.manifests()] == [
        f"{episode} under {condition}" for episode in QUERIES for condition in CONDITIONS
    ]
    assert repr(buffer_set) == f"BufferSet(buffer_set, buffers=15, conditions={list(CONDITIONS)})"


@pytest.mark.parametrize(
    ("filters", "count"),
    [
        ({}, 15),
        ({"k": 0}, 3),
        ({"condition": ["k3", parse_condition("k0"), "k3"], "family": ("MoveCube",) * 2}, 2),
        ({"condition": (), "family": ("PatternLock", "MoveCube")}, 10),
        ({"difficulty": "easy"}, 15),  # the sample's index 0
    ],
)
def test_filters(filters: dict[str, Any], count: int) -> None:
    buffer_set = load_buffer_set(GOLDEN)
    found = list(buffer_set.manifests(**filters))
    assert len(found) == count
    assert [buffer.manifest for buffer in buffer_set.buffers(**filters)] == found


@pytest.mark.parametrize(
    ("filters", "message"),
    [
        ({"family": ("MoveCube", "MoveCub")}, "Did you mean 'MoveCube'?"),
        ({"difficulty": "hard"}, "Known: easy"),
        ({"condition": "k2"}, "k1"),
    ],
)
def test_unknown_filters(filters: dict[str, Any], message: str) -> None:
    with pytest.raises(UnknownNameError) as caught:
        load_buffer_set(GOLDEN).manifests(**filters)
    assert message in str(caught.value)


def test_a_buffer_by_its_key() -> None:
    buffer_set = load_buffer_set(GOLDEN)
    expected = buffer_set.load("MoveCube/test/0", "k3").manifest
    name = EpisodeId("MoveCube", "test", 0)
    for found in (
        load_buffer("MoveCube/test/0", "k3", buffer_set=GOLDEN),
        load_buffer(name, parse_condition("k3"), buffer_set=buffer_set),
        load_buffer("MoveCube/test/0", k=3, buffer_set=str(GOLDEN), verify=True),
        buffer_set.load(name, k=3),
    ):
        assert found.manifest == expected
    assert to_dict(expected)["episode_id"] == "MoveCube/test/0"
    assert (to_dict(expected)["family"], to_dict(expected)["condition"]) == ("MoveCube", "k3")


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((), InvalidOptionError, "expected exactly one"),
        (("k3", 3), InvalidOptionError, "expected exactly one"),
        ((None, True), InvalidOptionError, "k True; expected an integer"),
        ((None, -1), InvalidIdError, "'k-1' is not a condition"),
        (("k5",), UnknownNameError, "Planned there: no-history k0 k1 k3 k7"),
    ],
)
def test_conditions_that_cannot_be_loaded(
    arguments: tuple[Any, ...], error: type[InterferenceError], message: str
) -> None:
    given = dict(zip(("condition", "k"), arguments, strict=False))
    with pytest.raises(error) as caught:
        load_buffer("MoveCube/test/0", buffer_set=GOLDEN, **given)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("condition", "missing"),
    [
        ("before-k7", None),
        ("k40", f"{40 - (UNITS - 1)} too few"),  # one is of the query's family
        ("same-k2", "1 too few"),
        ("stale-k0", "contradictions"),
    ],
)
def test_a_condition_is_suggested_only_where_it_can_be_planned(
    condition: str, missing: str | None, own_buffers: Path
) -> None:
    with pytest.raises(UnknownNameError) as caught:
        load_buffer_set(own_buffers).planned(condition)
    if missing is None:
        assert (
            caught.value.command == f"build {own_buffers} --only manifests --conditions {condition}"
        )
    else:
        assert caught.value.command is None and missing in str(caught.value.hint)


@pytest.mark.parametrize(
    ("episode", "error", "message"),
    [
        ("MoveCub/test/0", UnknownNameError, "Did you mean 'MoveCube'?"),
        ("MoveCube/test/1", UnknownNameError, "Did you mean 'MoveCube/test/0'"),
        ("MoveCube", InvalidIdError, "Expected <Family>/<split>/<index>"),
    ],
)
def test_episodes_that_cannot_be_loaded(
    episode: Any, error: type[InterferenceError], message: str
) -> None:
    buffer_set = load_buffer_set(GOLDEN)
    for load in (lambda: buffer_set.load(episode, "k3"), lambda: buffer_set.query(episode)):
        with pytest.raises(error) as caught:
            load()
        assert message in str(caught.value)


@pytest.mark.parametrize(
    ("option", "values"),
    [
        ("cache", (3, ["x"], b"x", "", "a\0b")),
        ("threads", (0, -3, True, "2", 1.5)),
        ("buffer_set", (None, 3, b"g", "", "a\0b")),
    ],
)
def test_no_such_option(option: str, values: tuple[Any, ...]) -> None:
    for value in values:
        with raises(InvalidOptionError):
            load_buffer_set(**{"buffer_set": GOLDEN, option: value})


def test_numbers_may_be_numpys() -> None:
    buffer_set = load_buffer_set(GOLDEN, threads=np.int64(2))  # type: ignore[arg-type]
    buffer = buffer_set.load("MoveCube/test/0", k=np.int64(1))  # type: ignore[arg-type]
    np.testing.assert_array_equal(buffer.frame(np.uint8(60)), buffer.frames()[60])


def test_caches_by_folder_or_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    for cache, folder in (
        (str(tmp_path / "a"), tmp_path / "a"),
        (tmp_path / "b", tmp_path / "b"),
        (DecodedCache(tmp_path / "c"), tmp_path / "c"),
        (True, tmp_path / "home" / "robomme-interference" / "decoded"),
    ):
        load_buffer_set(GOLDEN, cache=cache).load("MoveCube/test/0", "k0").frames()
        assert len(list(folder.iterdir())) == 1


def test_a_buffer_set_travels_between_processes() -> None:
    buffer_set = pickle.loads(pickle.dumps(load_buffer_set(GOLDEN)))
    assert buffer_set.load("MoveCube/test/0", "k0").frames().shape == (48, 32, 32, 3)


def test_datasets_are_opened_on_first_use(own_buffers: Path) -> None:
    header = json.loads((own_buffers / HEADER).read_text())
    for name in ("shifted", "contradictions"):
        header["datasets"][name] = header["datasets"]["distractors"] | {"kind": name}
    (own_buffers / HEADER).write_text(json.dumps(header))
    buffer_set = load_buffer_set(own_buffers)
    assert buffer_set.load("MoveCube/test/0", "k3").frames().any()
    assert "shifted" in buffer_set.datasets
    with pytest.raises(MissingFileError):
        buffer_set.datasets["shifted"]


@pytest.mark.slow
def test_imports_are_lazy_and_loading_needs_light_libraries_only() -> None:
    code = (
        "import sys\n"
        "from robomme_interference_data import EpisodeId, InterferenceError\n"
        "from robomme_interference_data.errors import FormatError\n"
        "print(sorted({'pyarrow', 'av', 'numpy', 'huggingface_hub'} & sys.modules.keys()))\n"
        "from robomme_interference_data import load_buffer\n"
        f"buffer = load_buffer('MoveCube/test/0', 'k3', buffer_set={str(GOLDEN)!r}, verify=True)\n"
        "print(len(buffer.frames()), sorted({'torch', 'lerobot', 'datasets', 'typer',"
        " 'rich', 'scipy', 'matplotlib', 'sapien', 'h5py'} & sys.modules.keys()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout == "[]\n144 []\n"


def test_unknown_cameras_are_an_error_in_a_folder_too(tiny_buffers: Path) -> None:
    load = partial(load_buffer, QUERIES[0], "k1", buffer_set=tiny_buffers)
    assert len(load(cameras=["front"])) > 0
    for cameras, error in ((["top"], UnknownNameError), ("front", InvalidOptionError)):
        with pytest.raises(error):
            load(cameras=cameras)


def test_loading_from_a_folder_imports_little() -> None:
    """No Hub, no rules, no copies, no pictures."""
    code = f"""
from robomme_interference_data import load_buffer
load_buffer("MoveCube/test/0", "k7", buffer_set={str(GOLDEN)!r}).frames("front")
"""
    modules = imported_modules(code, GOLDEN)
    folders = {name.partition(".")[0] for name in modules if "." in name}
    assert folders == {"data", "schema", "storage"}
    unneeded = {
        "storage.hub",
        "storage.video.encode",
        "storage.cache",
        "schema.draw",
        "data.query_sessions",
        "data.fetched_copy",
        "data.verified",
        "data.embeddings",
        "data.questions",
    }
    assert not unneeded & {*modules}
