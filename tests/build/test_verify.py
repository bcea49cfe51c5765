"""`verify` finds and locates damage to the files of a buffer set."""

import json
import os
import re
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.buffer_sets import GOLDEN, QUERIES, UNITS, violations
from support.damage import HEADER, flipped_bits
from support.messages import raises
from support.retrieval import QUIET, TwoSums, make_index
from support.verifying import DATA, VIDEO, expect

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.errors import MissingFileError
from robomme_interference_data.retrieval.index import build_index
from robomme_interference_data.storage.staging import staging_path


def test_a_clean_buffer_set() -> None:
    counted: list[int] = []
    shown = SimpleNamespace(start=lambda text, frames: None, advance=counted.append)
    assert list(verify_buffer_set(load_buffer_set(GOLDEN), progress=shown)) == []
    assert counted == [49] * len(QUERIES) + [32] * UNITS
    assert violations(GOLDEN, decode=False) == []


def test_unmanaged_files_are_no_violation(own_buffers: Path) -> None:
    for name in ("README.md", "README-strip.png", "LICENSE"):
        (own_buffers / "distractors" / name).write_text("mine")
    (own_buffers / "demonstrations" / ".gitattributes").write_text("")
    assert violations(own_buffers, decode=False) == []


HIDDEN = (
    ".DS_Store",
    "distractors/.DS_Store",
    "distractors/meta/episodes/chunk-000/._file-000.parquet",
    "distractors/meta/.ipynb_checkpoints/info-checkpoint.json",
    "demonstrations/data/chunk-000/._file-000.parquet",
    "demonstrations/index/.DS_Store",
    "manifests/._buffers.parquet",
    "manifests/.ipynb_checkpoints/manifest-checkpoint.json",
)


def test_hidden_files_are_no_violation(own_buffers: Path) -> None:
    """Other programs leave them anywhere."""
    make_index(own_buffers)
    for name in HIDDEN:
        (own_buffers / name).parent.mkdir(exist_ok=True)
        (own_buffers / name).write_bytes(b"Mac OS X")
    assert violations(own_buffers, decode=False) == []
    buffer = load_buffer_set(own_buffers).load(QUERIES[0], "k1", verify=True)
    assert buffer.embeddings("thumbnail").shape[0] == len(buffer)


FILES = sorted(str(path.relative_to(GOLDEN)) for path in GOLDEN.rglob("*") if path.is_file())
ONE_OF_EACH = [name for name in FILES if "file-0" not in name or "file-000" in name]
ONE_OF_EACH.remove(HEADER)  # its hash is the buffer set's revision


@pytest.mark.slow
@pytest.mark.parametrize("path", ONE_OF_EACH)
def test_a_flipped_bit_anywhere(own_buffers: Path, path: str) -> None:
    for _ in flipped_bits(own_buffers / path, 3):
        expect(own_buffers, re.escape(Path(path).name) + "|" + path.split("/", maxsplit=1)[0])


@pytest.mark.slow
def test_a_flipped_bit_in_the_header_of_an_index(own_buffers: Path) -> None:
    make_index(own_buffers)
    assert violations(own_buffers, decode=False) == []
    path = own_buffers / "distractors/index/thumbnail/index.json"
    header = json.loads(path.read_text())
    for changes in ({"typical_cosine": 0.5}, {"computed": {}}, {"encoder": {"name": "thumbnail"}}):
        path.write_text(json.dumps(header | changes))
        expect(own_buffers, "index/thumbnail: .*")
    path.write_text(json.dumps(header, indent=2))
    for _ in flipped_bits(path, 4):
        expect(own_buffers, "distractors/index/thumbnail: .*")


def test_indexes_of_different_encoders(own_buffers: Path) -> None:
    make_index(own_buffers)
    build_index([own_buffers / "demonstrations"], TwoSums(), QUIET)
    expect(own_buffers, "demonstrations/index/thumbnail: .*another encoder")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("distractors/data/x.parquet", "is not listed"),
        ("distractors/more/README.md", "is not part of the buffer set"),
        ("multiprocessing.py", "is not part of the buffer set"),
        ("demonstrations/manifests/x.py", "is not part of the buffer set"),
        ("distractors/index/x.npy", "is not listed"),
        ("distractors/index/other", "index.json is missing"),
        ("manifests/x.parquet", "is not listed"),
    ],
)
def test_unlisted_file(own_buffers: Path, path: str, message: str) -> None:
    file = own_buffers / path
    file = file / "x.npy" if path.endswith("other") else file
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("?")
    expect(own_buffers, f"{path}: .*{message}")


def test_an_unfinished_build_is_one_violation(own_buffers: Path) -> None:
    folder = staging_path(own_buffers / "distractors")
    for number in range(3):
        (folder / "episodes" / str(number)).mkdir(parents=True)
        (folder / "episodes" / str(number) / "record.json").write_text("{}")
    checks = verify_buffer_set(load_buffer_set(own_buffers), decode=False)
    [found] = checks
    assert found.where == ".distractors.building"
    assert shlex.split(found.what)[-3:] == ["rm", "-r", str(folder)]


def test_links_that_lead_nowhere(own_buffers: Path) -> None:
    for path in ("distractors/videos/x.mp4", "demonstrations/index/other/x.npy"):
        (own_buffers / path).parent.mkdir(parents=True, exist_ok=True)
        (own_buffers / path).symlink_to("nowhere")
    expect(own_buffers, r"videos/x\.mp4: is not listed", r"index/other/x\.npy: is a broken link")
    (own_buffers / VIDEO).unlink()
    (own_buffers / VIDEO).symlink_to("nowhere")
    expect(own_buffers, f"{VIDEO}: is missing")


def test_what_is_no_file_or_no_folder(own_buffers: Path) -> None:
    (own_buffers / VIDEO).unlink()
    os.mkfifo(own_buffers / VIDEO)
    expect(own_buffers, f"{VIDEO}: is not a regular file")
    (own_buffers / "distractors/data").rename(own_buffers / "data")
    (own_buffers / "distractors/data").symlink_to(own_buffers / "data")
    expect(own_buffers, f"{DATA}: is in data, a link; expected a folder")


def test_a_folder_that_is_named_with_a_letter_that_looks_alike(own_buffers: Path) -> None:
    (own_buffers / "distractors").rename(own_buffers / "distr\u0430ctors")
    with pytest.raises(MissingFileError) as error:
        load_buffer_set(own_buffers).check_tables(["k1"])
    assert "distractors is missing" in error.value.message
    assert r"distr\u0430ctors" in error.value.message
    expect(own_buffers, "distractors: .*missing")


def test_a_dataset_that_is_gone(own_buffers: Path) -> None:
    shutil.rmtree(own_buffers / "distractors")
    expect(own_buffers, "distractors: .*missing")
    shutil.rmtree(own_buffers / "manifests")
    with raises(MissingFileError):
        violations(own_buffers)
