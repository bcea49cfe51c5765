"""Every kind of damage to every kind of file: `verify` reports it, and no run has another result.

A buffer set that is loaded may be damaged where nothing that is loaded lies: then all its buffers
are as before.
"""

import os
import random
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.asking import ask
from support.buffer_sets import GOLDEN, copy_buffer_set, renew_sums
from support.damage import reverse_sessions
from support.messages import raises
from support.own_policies import Hashing
from support.runs import run as evaluate
from support.runs import untimed
from support.tabletop import copy_tabletop
from support.worlds import BUFFER_SET

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.errors import HashMismatchError, InterferenceError
from robomme_interference_data.evaluate.ceiling import ceiling
from robomme_interference_data.evaluate.run.config import CeilingConfig
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.retrieval.measure import measure_all
from robomme_interference_data.storage.files import sha256_file, write_json
from robomme_interference_data.storage.text import read_json

pytestmark = pytest.mark.slow

MANIFEST, ROWS = "manifests/manifest.json", "manifests/buffers.parquet"
CONDITIONS = ("no-history", "k1")
POLICY = "python:support.own_policies:Hashing"

# --- damages -------------------------------------------------------------------------------------


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[random.Random(path.name).randrange(len(data))] ^= 0xFF
    path.write_bytes(data)


def renamed(path: Path) -> None:
    path.rename(path.with_name(f"x{path.name}"))


def fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def linked(path: Path) -> None:
    """A link out of the buffer set, to a file that differs."""
    out = Path(os.environ["DAMAGE_OUTSIDE"])
    out.write_bytes(path.read_bytes() + b" ")
    path.unlink()
    path.symlink_to(out)


def another(path: Path) -> None:
    """Replaced by the next file of its kind, or by the other dataset's."""
    others = [one for one in sorted(path.parent.iterdir()) if one.suffix == path.suffix]
    other = others[(others.index(path) + 1) % len(others)]
    if other == path or "meta" in path.parts:
        name = {"demonstrations": "distractors", "distractors": "demonstrations"}
        other = Path(*(name.get(part, part) for part in path.parts))
    path.write_bytes(other.read_bytes() if other != path else b"{}")


def edited(change: Callable[[pa.Table], pa.Table]) -> Callable[[Path], None]:
    def apply(path: Path) -> None:
        pq.write_table(change(pq.read_table(path)), path)

    return apply


def changed(value: Any) -> Any:
    """Another value of the same type; of None, None."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return f"{value}x"
    if isinstance(value, list):
        others = [value[::-1], [*map(changed, value)]]
        return next((one for one in others if one != value), value)
    if isinstance(value, dict):
        return {name: changed(one) for name, one in value.items()}
    return None if value is None else value + 1


def column(name: str) -> Callable[[Path], None]:
    """Change all values of a column: reverse lists, or else change what is in them."""

    def change(table: pa.Table) -> pa.Table:
        place, kind = table.column_names.index(name), table.schema.field(name).type
        values = pa.array([*map(changed, table[name].to_pylist())], kind)
        return table.set_column(place, table.field(place), values)

    return edited(change)


def retyped(table: pa.Table) -> pa.Table:
    place = next(n for n, one in enumerate(table.schema) if pa.types.is_integer(one.type))
    return table.set_column(place, table.column_names[place], table.column(place).cast("double"))


def field(name: str) -> Callable[[Path], None]:
    return lambda path: write_json(path, (was := read_json(path)) | {name: changed(was[name])})


def json_retyped(path: Path) -> None:
    write_json(path, {key: str(value) for key, value in read_json(path).items()})


ANY = {
    "cut": cut,
    "empty": empty,
    "flip": flip,
    "removed": Path.unlink,
    "renamed": renamed,
    "fifo": fifo,
    "folder": folder,
    "linked": linked,
    "another": another,
}
TABLE = {
    "extra column": edited(lambda t: t.append_column("x", pa.array(range(len(t))))),
    "rows twice": edited(lambda t: pa.concat_tables([t, t])),
    "rows reversed": edited(lambda t: t.take(list(range(len(t)))[::-1])),
    "type": edited(retyped),
}

FILES = [
    MANIFEST,
    ROWS,
    *(
        f"{kind}/{name}"
        for kind in ("demonstrations", "distractors")
        for name in (
            "meta/info.json",
            "meta/interference.json",
            "meta/interference.parquet",
            "meta/stats.json",
            "meta/tasks.parquet",
            "meta/build_report.json",
            "meta/SHA256SUMS",
            "meta/episodes/chunk-000/file-000.parquet",
            "data/chunk-000/file-001.parquet",
            "videos/observation.images.front/chunk-000/file-001.mp4",
            "videos/observation.images.wrist/chunk-000/file-001.mp4",
        )
    ),
]


STATISTICS = "stats/"
"""Prefix of the columns of LeRobot's statistics of each feature."""


def columns_of(path: str) -> list[str]:
    """The columns of a table: of statistics, which are all read alike, one of each feature.

    Each feature's is another one, so that all statistics are among them.
    """
    names: list[str] = pq.read_schema(GOLDEN / path).names
    of_features = defaultdict[str, list[str]](list)
    for name in names:
        if name.startswith(STATISTICS):
            of_features[name.rpartition("/")[0]].append(name)
    tried = {each[place % len(each)] for place, each in enumerate(of_features.values())}
    return [name for name in names if not name.startswith(STATISTICS) or name in tried]


def damages_of(path: str) -> dict[str, Callable[[Path], Any]]:
    """Return the damages of a file by name: those of its format, and of each column or field."""
    if path.endswith(".parquet"):
        columns = {f"column {name}": column(name) for name in columns_of(path)}
        return {**ANY, **TABLE, **columns}
    if path.endswith(".json"):
        names = read_json(GOLDEN / path)
        return {**ANY, "types": json_retyped, **{f"field {name}": field(name) for name in names}}
    return ANY


ALL = [
    (path, name, renew)
    for path in FILES
    for name in damages_of(path)
    for renew in (False, True)
    if not renew or (name not in ANY and "manifest.json" not in path) or name == "another"
]
"""File, damage, and whether checksums are then computed again."""


def damaged(root: Path, path: str, name: str, *, renew: bool) -> None:
    damages_of(path)[name](root / path)
    if renew and path == ROWS:
        write_json(root / MANIFEST, read_json(root / MANIFEST) | {"rows": sha256_file(root / path)})
    elif renew and path != MANIFEST:
        renew_sums(root / path.split("/", maxsplit=1)[0])


# --- what must hold ------------------------------------------------------------------------------


def buffers(root: Path) -> list[Any]:
    """Everything that buffers hold."""
    made: list[Any] = []
    for one in load_buffer_set(root).buffers():
        made += [str(one.manifest), one.goal, one.query.seed, one.evidence, one.states]
        for camera in one.cameras:
            made += [one.frames(camera), one.query.frame(camera)]
    return made


def results(root: Path, out: Path) -> list[dict[str, Any]] | None:
    """The rows of a run, without the buffer set's revision; None if it does not start."""
    try:
        rows = evaluate(out, policy=POLICY, conditions=CONDITIONS, buffer_set=root).rows
    except InterferenceError:
        return None
    finally:
        shutil.rmtree(out, ignore_errors=True)
    return [row | {"revision": None} for row in untimed(rows)]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A sound copy, to be damaged and restored, and what it holds."""
    root = copy_buffer_set(tmp_path_factory.mktemp("damage") / "buffer_set")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(BUFFER_SET, str(GOLDEN))
        patch.setenv("DAMAGE_OUTSIDE", str(root.parent / "outside"))
        rows = results(root, root.parent / "run")
        assert rows is not None and len(Hashing.digests) == len(rows) == 4
        yield root, buffers(root), rows, {*Hashing.digests}


@pytest.mark.parametrize(("path", "name", "renew"), ALL)
def test_damage(sound: Any, path: str, name: str, *, renew: bool) -> None:
    root, held, rows, digests = sound
    try:
        damaged(root, path, name, renew=renew)
        if not reported(root):
            for one, before in zip(buffers(root), held, strict=True):
                assert np.array_equal(one, before) if isinstance(one, np.ndarray) else one == before
        ran = results(root, root.parent / "run")
        if renew and path == ROWS:  # with another manifest.json it is another buffer set
            assert load_buffer_set(root).revision != load_buffer_set(GOLDEN).revision
            return
        for row, before in zip(ran or [], rows, strict=ran is not None):
            assert row["status"] == "error" or row == before
        assert Hashing.digests == digests
    finally:
        Hashing.digests &= digests
        shutil.rmtree(root)
        copy_buffer_set(root)


def reported(root: Path) -> bool:
    """Whether `verify` reports something, or that it is no buffer set."""
    try:
        return any(
            any(verify_buffer_set(load_buffer_set(root), decode=decode)) for decode in (False, True)
        )
    except InterferenceError:
        return True


@pytest.mark.parametrize("reader", ["evaluate", "ask", "ceiling", "train", "grade"])
def test_no_reader_takes_rows_that_the_rules_do_not_give(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str
) -> None:
    """The sums are renewed, so only the rules tell; all readers share one check."""
    copy = copy_buffer_set if reader == "evaluate" else copy_tabletop
    root = copy(tmp_path / "buffer_set")
    reverse_sessions(root)
    monkeypatch.setenv(BUFFER_SET, str(root))

    def train() -> object:
        from robomme_interference_data.training import HistoryDataset

        return HistoryDataset(
            root, conditions=("k1",), split="test", cameras=("front",), chunk=0, quiet=True
        )

    read: dict[str, Callable[[], object]] = {
        "evaluate": lambda: evaluate(tmp_path / "run", conditions=("k1",), families=("MoveCube",)),
        "ask": lambda: ask(tmp_path / "run", buffer_set=root, conditions=("k1",)),
        "ceiling": lambda: ceiling(load_buffer_set(root), CeilingConfig(conditions=("k1",))),
        "train": train,
        "grade": lambda: measure_all(
            load_buffer_set(root),
            "thumbnail",
            "front",
            None,
            conditions=("k1",),
            progress=WorkProgress(quiet=True),
        ),
    }
    with raises(HashMismatchError):
        read[reader]()
