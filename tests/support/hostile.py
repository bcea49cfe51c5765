"""Readers of untrusted files as targets of tests and fuzzing, and damaged files to feed them.

A target puts the bytes of one file among valid files, and reads it. It returns, or raises an
`InterferenceError`; anything else is a finding.
"""

import io
import json
import random
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from support import eval_info
from support.buffer_sets import GOLDEN
from support.damage import renew_header
from support.recordings import encode_image
from support.tabletop import TABLETOP

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.verify.against import compare
from robomme_interference_data.build_dataset.verify.reference import (
    read_plan,
    reference_plan,
    write_plan,
)
from robomme_interference_data.constants import RUN_HEADER, RUN_RECORD
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.embeddings import EmbeddingIndex
from robomme_interference_data.data.questions import digest_questions, read_questions
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.evaluate.leaderboard.entries import read_entries
from robomme_interference_data.evaluate.run.log import read_run
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.schema.reference_plan import ReferencePlan
from robomme_interference_data.simulators.robomme.recorded_scene import read_scene
from robomme_interference_data.storage.arrays import read_array
from robomme_interference_data.storage.files import LocalFiles, read_sums
from robomme_interference_data.storage.video.encode import decode_image
from robomme_interference_data.storage.video.frames import iter_frames

_VIDEO = "demonstrations/videos/observation.images.front/chunk-000/file-000.mp4"
_ROWS = "demonstrations/data/chunk-000/file-000.parquet"
_EPISODES = "demonstrations/meta/interference.parquet"
_SCENES = {
    one["episode"].partition("/")[0]: json.dumps(one["scene"])
    for one in json.loads((GOLDEN.parent / "robomme" / "scenes.json").read_text())
}
"""Family to the recorded scene of an episode."""

_EPISODE = {"episode_id": 0, "metrics": {"success": True}, "steps": 9}
_RESULTS = {
    "benchmark": "LIBERO",
    "seed": 7,
    "config": {"params": {"suite": "spatial"}},
    "tasks": [{"task": "pick up the bowl", "episodes": [_EPISODE]}],
}
"""Results of vla-eval with another benchmark."""

_LEADERBOARD = GOLDEN.parents[2] / "docs" / "leaderboard" / "results.yaml"

_MAX_LISTED = 64  # of what a file lists, so many are looked at: there may be any number


@dataclass(frozen=True)
class Target:
    """A reader: its file in a folder of `places`, what reads it, and further valid files."""

    path: str
    read: Callable[[Path], object]
    seeds: Callable[[bytes], list[bytes]] = lambda sound: []

    def __call__(self, root: Path, data: bytes) -> InterferenceError | None:
        """Read given bytes; return the error that they end in, if any."""
        (root / self.path).write_bytes(data)
        try:
            self.read(root)
        except InterferenceError as error:
            assert len(str(error)) < 10_000
            return error
        return None

    def sound(self, root: Path) -> list[bytes]:
        """Return the bytes of sound files, given a folder in which all are sound."""
        kept = (root / self.path).read_bytes()
        return [kept, *self.seeds(kept)]


def places(root: Path) -> Path:
    """Make a folder in which every target finds its file and what it reads beside it; all sound."""
    shutil.copytree(GOLDEN, root / "buffer_set")
    shutil.copytree(GOLDEN.parent / "index/golden/index", root / "buffer_set/distractors/index")
    shutil.copytree(GOLDEN.parent / "run", root / "run")
    shutil.copytree(TABLETOP, root / "asked")
    (root / "single").mkdir()
    np.save(root / "single/a.npy", np.ones((3, 8), np.float16))
    image = encode_image(np.arange(8 * 6 * 3, dtype=np.uint8).reshape(8, 6, 3), "png")
    (root / "single/a.png").write_bytes(image)
    shutil.copy(GOLDEN / "demonstrations/meta/SHA256SUMS", root / "single")
    (root / "single/scene.json").write_text(_SCENES["VideoUnmaskSwap"])
    shutil.copyfile(_LEADERBOARD, root / "single/results.yaml")
    eval_info.write(root / "single/eval_info.json", {("pusht", 0): "sf", ("pusht", 1): "fs"})
    (root / "single/results.json").write_text(json.dumps(_RESULTS))
    write_plan(_golden_plan(), root / "single/plan.json")
    return root


@cache
def _golden_plan() -> ReferencePlan:
    return reference_plan(load_buffer_set(GOLDEN))


def _plan(root: Path) -> None:
    comparison = compare(_golden_plan(), read_plan(str(root / "single/plan.json")))
    assert all(difference.where and difference.what for difference in comparison.differences)


def _header(root: Path) -> None:
    buffer_set = load_buffer_set(root / "buffer_set")
    assert len(buffer_set.revision) == 64
    assert buffer_set.datasets.keys() == buffer_set.header.datasets.keys()


def _buffers(root: Path) -> None:
    buffer_set = load_buffer_set(root / "buffer_set")
    buffer_set.datasets = _sound_datasets(root)
    assert len(buffer_set.families) <= len(buffer_set.episode_ids)
    for manifest in list(buffer_set.manifests())[-1:]:
        buffer = buffer_set.load(manifest.episode_id, manifest.condition)
        assert len(buffer) == len(buffer.session_index) == manifest.history_frames


@cache
def _sound_datasets(root: Path) -> dict[str, Dataset]:
    """Return datasets of which no file but what is asked of them is read again."""
    names = ("demonstrations", "distractors")
    return {name: Dataset(LocalFiles(root / "buffer_set" / name)) for name in names}


def _dataset(root: Path) -> None:
    dataset = Dataset(LocalFiles(root / "buffer_set/demonstrations"))
    for index, record in zip(range(_MAX_LISTED), dataset.records(), strict=False):
        assert dataset.index_of(record.episode_id) in range(len(dataset))
        assert dataset.lerobot.locate(index).length == record.length
    for camera in dataset.cameras:
        [frame] = dataset.iter_frames(0, camera, 0, 1)
        assert frame.shape == dataset.shape(camera)


def _rows(root: Path) -> None:
    dataset = _sound_datasets(root)["demonstrations"]
    values = dataset.read_vectors(0, "observation.state", 0, 48)
    assert values.shape == (48, 8)
    dataset.lerobot.rows(0).table()


def _scene(root: Path) -> None:
    """Read a text as the scene of each family."""
    text = (root / "single/scene.json").read_text("utf-8", "replace")
    scenes, errors = [], []
    for family in _SCENES:
        try:
            scenes.append(read_scene(family, text, "hard"))
        except InterferenceError as error:
            errors.append(error)
    for scene in scenes:
        assert 0 < len(scene.agreeing({})) < 1 << 17
    if not scenes:
        raise errors[0]


def _other_scenes(sound: bytes) -> list[bytes]:
    return [text.encode() for text in _SCENES.values()]


def _video(root: Path) -> None:
    path = root / "buffer_set" / _VIDEO
    count = 0
    for frame in iter_frames(path, 0, 49, 10, (32, 32, 3)):
        assert frame.shape == (32, 32, 3) and frame.dtype == np.uint8
        count += 1
    assert count == 49
    [_] = iter_frames(path, 30, 31, 10, (32, 32, 3))


def _array(root: Path) -> None:
    found = read_array(root / "single/a.npy", np.float16, (-1, 8))
    assert found.dtype == np.float16 and found.shape[1:] == (8,)


def _index(root: Path) -> None:
    dataset = _sound_datasets(root)["distractors"]
    index = EmbeddingIndex(dataset.files, dataset.revision, "thumbnail", "front")
    assert index.span(0, 0, 1).shape == (1, index.header.size)
    index.check({index: 32 for index in range(len(dataset))}, units=True)


def _run(root: Path) -> None:
    header, rows = read_run(root / "run")
    assert header.planned >= 0 and sum(header.counts.values()) == len(rows)


def _record(root: Path) -> None:
    path = root / "run" / RUN_RECORD
    with suppress(InterferenceError):  # which is told again below
        read_rows([path], ["mine"], lenient=True)
    read_run(root / "run")


def _outcomes(name: str) -> Callable[[Path], object]:
    """Return a reader of results of another program."""
    return lambda root: read_rows([root / "single" / name], ["mine"])


def _image(root: Path) -> None:
    image = decode_image((root / "single/a.png").read_bytes())
    assert image.ndim == 3 and image.shape[2] == 3


def _questions(root: Path) -> None:
    renew_header(root / "asked")  # else the SHA-256 tells before anything is parsed
    buffer_set = load_buffer_set(root / "asked")
    questions = read_questions(buffer_set)
    assert tuple(sorted(questions)) == buffer_set.episode_ids
    for one in questions.values():
        assert one.letters[one.right] in one.letters and one.chance <= 0.5
    assert len(digest_questions(questions.values())) == 64
    decode_image(next(iter(questions.values())).picture)


def rewritten(data: bytes) -> list[bytes]:
    """Return a parquet file as others would write it: what is compressed hides all behind it."""
    table = pq.read_table(pa.BufferReader(data))
    ways: list[dict[str, Any]] = [
        {"compression": "none"},
        {"compression": "none", "use_dictionary": False, "store_schema": False},
        {"compression": "none", "data_page_version": "2.0", "row_group_size": 7},
    ]
    found = []
    for way in ways:
        written = io.BytesIO()
        pq.write_table(table, written, **way)
        found.append(written.getvalue())
    return found


TARGETS = {
    "manifest": Target("buffer_set/manifests/manifest.json", _header),
    "buffers": Target("buffer_set/manifests/buffers.parquet", _buffers, rewritten),
    "info": Target("buffer_set/demonstrations/meta/info.json", _dataset),
    "identity": Target("buffer_set/demonstrations/meta/interference.json", _dataset),
    "episodes": Target(f"buffer_set/{_EPISODES}", _dataset, rewritten),
    "rows": Target(f"buffer_set/{_ROWS}", _rows, rewritten),
    "video": Target(f"buffer_set/{_VIDEO}", _video),
    "array": Target("single/a.npy", _array),
    "image": Target("single/a.png", _image),
    "plan": Target("single/plan.json", _plan),
    "scene": Target("single/scene.json", _scene, _other_scenes),
    "questions": Target("asked/questions.parquet", _questions, rewritten),
    "sums": Target("single/SHA256SUMS", lambda root: read_sums(root / "single/SHA256SUMS")),
    "index": Target("buffer_set/distractors/index/thumbnail/index.json", _index),
    "run": Target(f"run/{RUN_HEADER}", _run),
    "record": Target(f"run/{RUN_RECORD}", _record),
    "lerobot-eval": Target("single/eval_info.json", _outcomes("eval_info.json")),
    "vla-eval": Target("single/results.json", _outcomes("results.json")),
    "leaderboard": Target(
        "single/results.yaml", lambda root: read_entries(root / "single/results.yaml")
    ),
}
"""All readers of untrusted files, by name."""

_NUMBERS = [0, 1, 127, 128, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1]
_JSON = [
    *(b"null", b"true", b"-1", b"1e999", b"NaN", b"9" * 30, b"9" * 5000, b'""', b"[]", b"{}"),
    *(b'"../../etc/passwd"', b'"\\u0000"', b'"\\ud800"', b"[" * 200, b'"{x.__class__}"', b"0.5"),
]


def mutated(sound: list[bytes], draw: random.Random, bombs: Sequence[bytes] = ()) -> bytes:
    """Return a sound file, or one of the bombs, with one to six things wrong in it."""
    place = draw.randrange(len(sound) + len(bombs))
    chosen = [*sound, *bombs][place]
    # A bomb must not be read here.
    if place < len(sound) and chosen[:4] == b"PAR1" and draw.random() < 0.3:
        return _with_other_values(chosen, draw)
    data = bytearray(chosen)
    for _ in range(draw.randint(1, 6)):
        _damage(data, draw)
    return bytes(data[: 1 << 20])


def _damage(data: bytearray, draw: random.Random) -> None:
    """Change a bit, a byte, a number or a value of JSON, or remove or repeat a part."""
    place = draw.randrange(len(data) + 1)
    match draw.choice(("bit", "byte", "number", "value") * 2 + ("cut", "copy")):
        case "bit" if data:
            data[place % len(data)] ^= 1 << draw.randrange(8)
        case "byte" if data:
            data[place % len(data)] = draw.choice((0, 1, 0x7F, 0x80, 0xFF, draw.randrange(256)))
        case "number":
            size, order = draw.choice((2, 4, 8)), draw.choice(("little", "big"))
            value = draw.choice(_NUMBERS) & ((1 << 8 * size) - 1)
            data[place : place + size] = value.to_bytes(size, order)  # type: ignore[arg-type]
        case "cut":
            del data[place : place + draw.choice((1, 4, 16, 256, len(data)))]
        case "copy":
            start = draw.randrange(len(data) + 1)
            data[place:place] = data[start : start + draw.choice((1, 8, 64, 1024))]
        case "value":
            start = data.find(b":", place) + 1
            stops = [at for at in (data.find(end, start) for end in (b",", b"}", b"\n")) if at >= 0]
            if start and stops:
                data[start : min(stops)] = draw.choice(_JSON)


_TEXTS = ("", "x", "../../x", "/x", "\0", "\x1b[2J", "x" * 70_000, "MoveCube/test/0", "lesson")


@lru_cache
def _table(data: bytes) -> pa.Table:
    """Read a table; its columns may be empty anywhere."""
    table = pq.read_table(pa.BufferReader(data))
    fields = [(field.name, _with_gaps(field.type)) for field in table.schema]
    return pa.Table.from_pylist(table.to_pylist(), pa.schema(fields))


def _with_gaps(kind: pa.DataType) -> pa.DataType:
    if pa.types.is_struct(kind):
        return pa.struct([(field.name, _with_gaps(field.type)) for field in kind])
    return pa.list_(_with_gaps(kind.value_type)) if pa.types.is_list(kind) else kind


def _with_other_values(data: bytes, draw: random.Random) -> bytes:
    """Return a parquet file with other values, rows, types or columns: itself, it is sound."""
    table = _table(data)
    for _ in range(draw.randint(1, 3)):
        way, place = draw.randrange(6), draw.randrange(table.num_columns)
        name, column = table.column_names[place], table.column(place)
        values = column.to_pylist()
        if way == 0:
            table = table.remove_column(place)
        elif way == 1:
            table = table.set_column(place, name, pa.nulls(len(table), column.type))
        elif way == 2:
            other = draw.choice(([0] * len(table), ["x"] * len(table), [[1.5]] * len(table)))
            table = table.set_column(place, name, pa.array(other))
        elif way == 3:
            rows = [draw.randrange(len(table)) for _ in range(draw.randint(1, 9))]
            table = table.take(rows)
        else:
            row = draw.randrange(len(values))
            values[row] = _other(values[row], draw)
            with suppress(pa.ArrowException, OverflowError):
                table = table.set_column(place, name, pa.array(values, column.type))
        if not table.num_columns:
            break
    written = io.BytesIO()
    pq.write_table(table, written)
    return written.getvalue()


def _other(value: Any, draw: random.Random) -> Any:
    """Return another value of the same kind, or none."""
    if isinstance(value, dict) and value:
        name = draw.choice(list(value))
        return value | {name: _other(value[name], draw)}
    if isinstance(value, list) and value:
        place = draw.randrange(len(value))
        changed = [*value[:place], _other(value[place], draw), *value[place + 1 :]]
        return draw.choice((changed, [], value * draw.choice((2, 9, 600))))
    if isinstance(value, str):
        return draw.choice((*_TEXTS, None))
    if isinstance(value, float):
        return draw.choice((0.0, -1.0, 1e308, float("nan"), float("inf"), None))
    return draw.choice((*_NUMBERS[:-1], -1, -(2**63), True, None))
