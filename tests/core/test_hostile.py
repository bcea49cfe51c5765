"""Untrusted data: reading any file ends, within bounds of memory and time."""

import json
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.bombs import BOMBS
from support.buffer_sets import (
    GOLDEN,
    QUERIES,
    contents,
    copy_buffer_set,
    expected_frames,
    with_sessions,
)
from support.hostile import TARGETS, mutated, places
from support.messages import raises

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.errors import FormatError, HashMismatchError
from robomme_interference_data.schema.codec import from_dict, to_dict
from robomme_interference_data.schema.manifest import BufferManifest, SessionEntry

MEGABYTES = 700
"""What reading a bomb may add to the memory of a process: the largest frame that is read, more than
once, and the threads of libraries. Each bomb needs more, or raises at once."""

_CHILD = """
import json, resource, sys
from pathlib import Path

import av, numpy, pyarrow.compute, pyarrow.parquet
from support.bombs import read

from robomme_interference_data.errors import InterferenceError

def size(field):
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(field)).split()[1]) // 1024

limit = size("VmSize") + int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_AS, (limit << 20, limit << 20))
for line in Path(sys.argv[1]).read_text().splitlines():
    name, kind, path = json.loads(line)
    try:
        read(kind, Path(path))
        message = "nothing was wrong"
    except InterferenceError as error:
        message = error.message
    print(json.dumps([name, message]), flush=True)
"""


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The error of reading each bomb, in one process with little memory."""
    folder = tmp_path_factory.mktemp("bombs")
    lines = []
    for number, (name, bomb) in enumerate(BOMBS.items()):
        path = folder / f"{number}"
        bomb.write(path)
        lines.append(json.dumps([name, bomb.kind, str(path)]))
    (folder / "list").write_text("\n".join(lines))
    done = subprocess.run(
        [sys.executable, "-c", _CHILD, str(folder / "list"), str(MEGABYTES)],
        env={"PYTHONPATH": str(Path(__file__).parents[1]), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return dict(map(json.loads, done.stdout.splitlines()))


@pytest.mark.slow
@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_raises_before_it_is_decoded(outcomes: dict[str, str], name: str) -> None:
    assert BOMBS[name].message in outcomes[name]


@pytest.mark.parametrize(
    "change", [{"repeat": 2**40}, {"start": 0, "stop": 2**18 + 1}, {"start": -1}, {"repeat": 0}]
)
def test_a_session_has_a_bounded_number_of_frames(change: dict[str, int]) -> None:
    session = to_dict(load_buffer(QUERIES[0], "k1", buffer_set=GOLDEN).manifest.sessions[0])
    assert from_dict(SessionEntry, session, "here")
    with raises(FormatError):
        from_dict(SessionEntry, session | change, "here")


@pytest.mark.parametrize("change", [{"repeat": 2**13}, {"repeat": 1}])
def test_a_buffer_has_a_bounded_number_of_frames_and_sessions(change: dict[str, int]) -> None:
    manifest = to_dict(load_buffer(QUERIES[0], "k1", buffer_set=GOLDEN).manifest)
    many = [manifest["sessions"][1] | change] * (2**13 // change["repeat"])
    with raises(FormatError):
        from_dict(BufferManifest, manifest | {"sessions": many * 2}, "here")


@pytest.mark.parametrize("digest", ["../../written", "/written", "0" * 64, "", "x\0"])
def test_the_cache_stores_nothing_under_a_digest_that_is_only_claimed(
    tmp_path: Path, digest: str
) -> None:
    """Else a buffer set could write elsewhere, or give another one its frames."""
    root = copy_buffer_set(tmp_path / "buffer_set")
    path = root / "distractors/meta/interference.parquet"
    rows = pq.read_table(path).to_pylist()
    for row in rows:
        row["feature_sha256"]["observation.images.front"] = digest
    pq.write_table(pa.Table.from_pylist(rows), path)
    before = contents(tmp_path)
    cache = tmp_path / "cache" / "inner"
    for _ in range(2):
        buffer = load_buffer(QUERIES[0], "k1", buffer_set=root, cache=cache)
        with raises(HashMismatchError):
            buffer.frames()
        with raises(HashMismatchError):
            list(buffer.stream(cameras=["front"]))
    lesson = load_buffer(QUERIES[0], "k0", buffer_set=root, cache=cache).frames()
    assert len(list(cache.iterdir())) == 1  # the lesson, whose digest is right
    assert {name for name in contents(tmp_path) if not name.startswith("cache/")} == set(before)
    buffer = load_buffer(QUERIES[0], "k1", buffer_set=root)  # without a cache, and not verified
    expected = expected_frames(buffer.manifest.sessions, "front")
    assert np.array_equal(buffer.frames(), expected)
    assert np.array_equal(lesson, expected[: len(lesson)])


def test_frames_that_need_too_much_memory_raise(tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "buffer_set")
    info = root / "demonstrations/meta/info.json"
    declared = json.loads(info.read_text())
    declared["features"]["observation.images.front"]["shape"] = [4096, 4096, 3]
    info.write_text(json.dumps(declared))
    buffer = load_buffer(QUERIES[0], "k7", buffer_set=root)
    short = load_buffer(QUERIES[0], "no-history", buffer_set=root)
    assert len(buffer) * 4096 * 4096 * 3 <= 16 * 2**30  # so its videos are looked at
    with raises(FormatError):
        buffer.frames()
    assert short.frames().shape == (0, 4096, 4096, 3)
    many = with_sessions(buffer.manifest, *buffer.manifest.sessions * 8)
    held = Buffer(many, buffer.query, load_buffer_set(root).datasets)
    with raises(FormatError) as caught:
        held.frames()
    assert "stream" in str(caught.value.hint)


@pytest.mark.parametrize("name", TARGETS)
def test_a_sound_file_is_read_and_a_truncated_one_raises_one_error(
    tmp_path: Path, name: str
) -> None:
    target, root = TARGETS[name], places(tmp_path)
    for data in target.sound(root):
        assert target(root, data) is None
        for share in range(8):
            target(root, data[: len(data) * share // 8])


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_a_damaged_file_ends_in_an_error_or_a_sound_value(
    tmp_path_factory: pytest.TempPathFactory, name: str
) -> None:
    target, root = TARGETS[name], places(tmp_path_factory.mktemp("places"))
    sound, errors = target.sound(root), []

    @settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
    @given(st.integers(0, 2**32))
    def check(seed: int) -> None:
        error = target(root, mutated(sound, random.Random(seed)))
        errors.append(error is not None)

    check()
    assert any(errors)


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("index", b'"two-sums"', b'"\\ud800"'),
        ("index", b'"size": 3', b'"size": 9999999'),
        ("record", b'"goal":"', b'"goal":"\\udfff'),
        ("record", b'"attempt":1', b'"attempt":99999999999999999999'),
        ("run", b'"episodes": {', b'"episodes": {"MoveCube/val": "0-99999999",'),
        ("manifest", b'"seed": 0', b'"seed": 99999999999999999999'),
        ("manifest", b'"seed": 0', b'"seed": ' + b"9" * 5000),
    ],
)
def test_values_that_once_crashed(tmp_path: Path, name: str, before: bytes, after: bytes) -> None:
    target, root = TARGETS[name], places(tmp_path)
    [sound] = target.sound(root)
    assert before in sound
    assert isinstance(target(root, sound.replace(before, after, 1)), FormatError)


def test_half_a_character_in_a_header(tmp_path: Path) -> None:
    target, root = TARGETS["manifest"], places(tmp_path)
    [sound] = target.sound(root)
    assert target(root, sound.replace(b'"k7"', b'"\\ud800"')) is None


def test_messages_are_short_and_escape_control_characters() -> None:
    error = FormatError.damaged("a\x1b[2Jb", "x" * 10_000 + "\n")
    assert str(error).startswith(r"a\x1b[2Jb: xxx")
    assert len(str(error)) < 5_000
    assert "(10,009 characters)" in str(error)
