"""Publish into a folder: the same files, without a network."""

from pathlib import Path

import numpy as np
import pytest
from support.hub_server import HubServer
from support.publishing import UNITS, files, plain_cards, publish
from support.splits import GOLDEN, contents, copy_split

from robomme_interference_data import load_buffer, load_split
from robomme_interference_data.build_dataset.verify import verify_split
from robomme_interference_data.cards.export import exported_tree, write_tree
from robomme_interference_data.cards.publish_config import PublishConfig
from robomme_interference_data.errors import PublishError


@pytest.fixture(autouse=True)
def _cards(monkeypatch: pytest.MonkeyPatch) -> None:
    plain_cards(monkeypatch)


def export(root: Path, out: Path, **options: str) -> bool:
    return write_tree(exported_tree(load_split(root), PublishConfig(UNITS, **options)), out)


def test_an_export_is_a_split(tmp_path: Path) -> None:
    assert export(GOLDEN, tmp_path / "out")
    here, there = load_split(GOLDEN), load_split(tmp_path / "out")
    assert there.revision == here.revision
    assert [*verify_split(there)] == []
    mine = load_buffer("MoveCube/test/0", "k7", split=here).frames("front")
    theirs = load_buffer("MoveCube/test/0", "k7", split=there, verify=True).frames("front")
    assert np.array_equal(mine, theirs)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


def test_it_is_what_would_be_published(hub: HubServer, login: object, tmp_path: Path) -> None:
    login("someone")  # type: ignore[operator]
    publish(GOLDEN)
    export(GOLDEN, tmp_path / "out")
    found = contents(tmp_path / "out")
    lessons = {path: data for path, data in found.items() if path.startswith("demonstrations/")}
    units = {path: data for path, data in found.items() if path not in lessons}
    names = {"README.md", "manifests/manifest.json"}  # which name the demonstrations' commit
    there = files(hub, UNITS)
    assert units.keys() == there.keys()
    assert {path for path in units if units[path] != there[path]} == names
    assert {path.partition("/")[2]: data for path, data in lessons.items()} == files(
        hub, f"{UNITS}-demonstrations"
    )


def test_an_export_can_be_exported(tmp_path: Path) -> None:
    export(GOLDEN, tmp_path / "one")
    export(tmp_path / "one", tmp_path / "two")
    assert contents(tmp_path / "two") == contents(tmp_path / "one")


def test_a_second_time_changes_nothing(tmp_path: Path) -> None:
    assert export(GOLDEN, tmp_path / "out")
    assert not export(GOLDEN, tmp_path / "out")
    before = contents(tmp_path / "out")
    assert export(GOLDEN, tmp_path / "out", version="1.0.1")
    assert contents(tmp_path / "out").keys() == before.keys()
    (tmp_path / "out" / "data" / "more").write_bytes(b"")
    assert export(GOLDEN, tmp_path / "out")
    assert contents(tmp_path / "out") == before


@pytest.mark.parametrize("other", ["file", "split", ".git/config", "LICENSE"])
def test_what_is_something_else_is_kept(tmp_path: Path, other: str) -> None:
    out = tmp_path / "out"
    if other == "split":
        copy_split(out)
    elif other == "file":
        out.write_bytes(b"mine")
    else:
        export(GOLDEN, out, version="1.0.1")
        (out / other).parent.mkdir(exist_ok=True)
        (out / other).write_bytes(b"mine")
    before = contents(tmp_path)
    with pytest.raises(PublishError, match="nothing that was exported"):
        export(GOLDEN, out)
    assert contents(tmp_path) == before


def test_an_export_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    export(GOLDEN, tmp_path / "out")
    before = contents(tmp_path)
    tree = exported_tree(load_split(GOLDEN), PublishConfig(UNITS, version="1.0.1"))
    (tmp_path / "gone").write_bytes(b"")
    broken = dict(tree)
    broken["data/last"] = type(tree["README.md"])(tmp_path / "gone")
    (tmp_path / "gone").unlink()
    with pytest.raises(FileNotFoundError):
        write_tree(broken, tmp_path / "out")
    assert contents(tmp_path) == before
