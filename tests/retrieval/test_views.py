"""Retrieval under shifts: the query is the stored first live observation of the changed scene."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.buffer_sets import GOLDEN, QUERIES, dataset
from support.messages import raises
from support.retrieval import make_index
from support.shifted import add_shifted

from robomme_interference_data import EpisodeId, load_buffer_set
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.constants import SHIFTED
from robomme_interference_data.errors import SourceError

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden buffer set with views under shifts, indexed; read-only."""
    folder = shutil.copytree(GOLDEN, tmp_path_factory.mktemp("seen") / "buffer_set")
    add_shifted(folder)
    make_index(folder, names=("demonstrations", "distractors", SHIFTED))
    return folder


@pytest.mark.slow
def test_views_are_frames_in_the_order_of_shifts(seen: Path) -> None:
    views, buffer_set = dataset(seen, SHIFTED), load_buffer_set(seen)
    assert (views.kind, len(views), views.identity.counts.frames) == ("shifted", 3, 36)
    assert views.identity.unit is None
    for episode in QUERIES:
        index, query = views.index_of(EpisodeId.parse(episode)), buffer_set.query(episode)
        record = views.record(index)
        assert (record.length, record.exec_start_idx, record.seed) == (12, None, query.seed)
        for place, image in enumerate(views.iter_frames(index, "front", 0, 12)):
            assert np.array_equal(image, query.frame() >> place)
    assert buffer_set.revision != load_buffer_set(GOLDEN).revision
    assert list(verify_buffer_set(buffer_set)) == []


def test_the_query_frame_is_that_of_the_shift(run: Run, seen: Path) -> None:
    def scored(*options: str) -> dict[str, object]:
        value: dict[str, object] = json.loads(run("retrieval-score", seen, "--json", *options)[1])
        return value

    plain, first, last = (scored("--shift", name) for name in ("none", "light:1", "clutter:3"))
    assert [one["shift"] for one in (plain, first, last)] == ["none", "light:1", "clutter:3"]
    assert plain == scored()
    assert first["cells"] == plain["cells"]  # the view that looks as always
    assert last["cells"] != plain["cells"]  # a black one
    title = run("retrieval-score", seen, "--shift", "camera:2")[1].splitlines()[0]
    assert title.endswith("encoder thumbnail, camera front, shift camera:2, rule max/adaptive")


def test_missing_views_and_unknown_shifts(run: Run, seen: Path, own_buffers: Path) -> None:
    code, _, err = run("retrieval-score", own_buffers, "--shift", "light:2")
    assert code == 1 and f"build {own_buffers} --only shifted --source" in err
    built = own_buffers / "shifted/meta/interference.json"
    built.parent.mkdir(parents=True)
    built.write_text("{}")  # built, but not in the manifests
    code, _, err = run("retrieval-score", own_buffers, "--shift", "light:2")
    assert code == 1 and f"build {own_buffers} --only manifests" in err and "--source" not in err
    assert "such as light:2" in run("retrieval-score", seen, "--shift", "dark")[2]


@pytest.mark.parametrize(("families", "kind"), [(("MoveCube",), "sample"), ((), "other")])
def test_views_of_other_scenes_are_an_error(
    own_buffers: Path, families: tuple[str, ...], kind: str
) -> None:
    with raises(SourceError):
        add_shifted(own_buffers, *families, kind=kind)


@pytest.mark.slow
def test_retrieve_shows_what_the_robot_sees_under_a_shift(
    run: Run, seen: Path, tmp_path: Path
) -> None:
    pictures = []
    for shift in ("none", "clutter:3"):
        words = ("retrieve", seen, QUERIES[0], "k1", "--shift", shift)
        out = tmp_path / f"{shift[:5]}.png"
        assert run(*words, "--out", out)[0] == 0
        pictures.append((out.read_bytes(), json.loads(run(*words, "--json")[1])["cosine"]))
    (plain, same), (shifted, other) = pictures
    assert plain != shifted and same != other
