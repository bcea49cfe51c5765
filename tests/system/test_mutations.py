"""Every value of every file of a buffer set is covered: changed alone, `verify` reports it.

The checksums of files are recomputed after each change, so only digests and rules that mean
something can tell. Fast tests try a sample, slow ones all.
"""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.buffer_sets import GOLDEN, copy_buffer_set
from support.mutations import Place, mutate, places, renew
from support.retrieval import make_index
from support.tabletop import TABLETOP, copy_tabletop

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.errors import InterferenceError

UNREAD = {
    "manifests/manifest.json": {
        ("position_limit",): "a bound that the buffers keep; only a build reads it"
    },
    "*/meta/build_report.json": {("skipped", 0, "why"): "words for people"},
    "*/index/*/index.json": {("computed", "*"): "words for people"},
}
"""Values that nothing reads, by file, with the reason."""

STATISTICS = "stats"
"""Prefix of LeRobot's statistics, which only the digests of their files cover."""

SEEN = 61
"""In fast tests, one of so many values is changed."""


def files_of(root: Path) -> list[str]:
    """The files with values: of those of episodes, the second one of each folder."""
    paths = (path.relative_to(root) for path in root.rglob("*") if path.is_file())
    return sorted(
        str(path)
        for path in paths
        if path.suffix in (".json", ".parquet")
        and path.stem != STATISTICS
        and ("data" not in path.parts or path.name == "file-001.parquet")
    )


ALL = [
    (root, path, place)
    for root in (GOLDEN, TABLETOP)
    for path in files_of(root)
    if root == GOLDEN or path == "questions.parquet"
    for place in places(root / path)
    if not str(place[0]).startswith(f"{STATISTICS}/")
]


def matches(place: Place, pattern: Place) -> bool:
    return len(place) == len(pattern) and all(
        one in ("*", other) for one, other in zip(pattern, place, strict=True)
    )


def is_unread(path: str, place: Place) -> bool:
    return any(
        Path(path).match(file) and matches(place, pattern)
        for file, patterns in UNREAD.items()
        for pattern in patterns
    )


def reported(root: Path) -> bool:
    """Whether `verify` reports something; it decodes only if it must."""
    try:
        opened = load_buffer_set(root)
        return any(any(verify_buffer_set(opened, decode=decode)) for decode in (False, True))
    except InterferenceError:
        return True


@pytest.fixture(scope="module")
def copies(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[Path, Path]]:
    """A copy of each golden buffer set, to be changed and restored."""
    folder = tmp_path_factory.mktemp("mutations")
    yield {GOLDEN: copy_buffer_set(folder / "golden"), TABLETOP: copy_tabletop(folder / "tabletop")}
    shutil.rmtree(folder)


def check(root: Path, path: str, place: Place) -> None:
    restored = {one: (root / one).read_bytes() for one in covering(root, path)}
    try:
        mutate(root / path, place)
        renew(root, path)
        assert reported(root) != is_unread(path, place)
    finally:
        for one, data in restored.items():
            (root / one).write_bytes(data)


def covering(root: Path, path: str) -> set[str]:
    """The file, and those with checksums that cover it."""
    top = path.split("/", maxsplit=1)[0]
    found = {path, "manifests/manifest.json"}
    if (root / top / "meta").is_dir():
        found |= {f"{top}/meta/SHA256SUMS", f"{top}/meta/interference.json"}
    if "/index/" in path:
        found |= {f"{Path(path).parent}/{one}" for one in ("SHA256SUMS", "index.json")}
    return found


@pytest.mark.slow
def test_the_golden_buffer_sets_are_whole(copies: dict[Path, Path]) -> None:
    assert not any(map(reported, copies.values()))


@pytest.mark.parametrize(
    ("root", "path", "place"),
    [
        pytest.param(*one, marks=[pytest.mark.slow] if number % SEEN else [])
        for number, one in enumerate(ALL)
    ],
)
def test_a_changed_value_is_reported(
    copies: dict[Path, Path], root: Path, path: str, place: Place
) -> None:
    check(copies[root], path, place)


@pytest.mark.slow
def test_a_changed_value_of_an_index_is_reported(tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "buffer_set")
    make_index(root)
    for dataset in ("demonstrations", "distractors"):
        path = f"{dataset}/index/thumbnail/index.json"
        for place in places(root / path):
            if place != ("sha256",):  # recomputed
                check(root, path, place)
