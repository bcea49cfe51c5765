"""Manifests: contents of buffers, reproducible bytes, and invalid inputs."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from support.buffer_sets import CONDITIONS, GOLDEN, QUERIES, contents, copy_buffer_set
from support.made_up import record, write_metadata
from support.messages import raises

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.manifests import (
    plan_manifests,
    planned_buffers,
    write_manifests,
)
from robomme_interference_data.build_dataset.plan.planned import datasets_in
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.errors import (
    BuildError,
    FormatError,
    InvalidOptionError,
    MissingFileError,
    SourceError,
)
from robomme_interference_data.storage.files import sha256_file

FAMILIES = ("MoveCube", "InsertPeg", "PatternLock", "Drawer")


def made_up(root: Path, *, queries: Any = None, units: Any = None) -> Path:
    """A buffer set of metadata alone: four families, two queries and three units each."""
    asked = queries or [
        record("demonstrations", f"{family}/test/{n}", lesson=20 + 13 * n)
        for family in FAMILIES
        for n in range(2)
    ]
    pool = units or [
        record("distractors", f"{family}/train/{n}", seed=n)
        for family in FAMILIES
        for n in range(3)
    ]
    write_metadata(root / "demonstrations", "demonstrations", asked)
    write_metadata(root / "distractors", "distractors", pool)
    return root


@pytest.mark.parametrize("name", ["buffer_set", "not-utf-8-\udcff"])
def test_the_golden_manifests_come_out_again(tmp_path: Path, name: str) -> None:
    root = copy_buffer_set(tmp_path / name)
    assert (
        sum(write_manifests(plan_manifests(datasets_in(root), tuple(reversed(CONDITIONS))), root))
        == 15
    )
    assert contents(root) == contents(GOLDEN)


def test_buffers_of_train_episodes(tmp_path: Path) -> None:
    """Units are of other families, or of the own one, and never of the query's own episode."""
    names = [f"{family}/train/{number}" for family in FAMILIES for number in range(3)]
    queries = [record("demonstrations", name) for name in names]
    root = made_up(tmp_path, queries=queries)
    conditions = ("k7", "before-k7", "absent-k7", "same-k2")
    buffers = [*planned_buffers(plan_manifests(datasets_in(root), conditions))]
    assert len(buffers) == len(names) * len(conditions)
    for one in buffers:
        units = [session.source for session in one.sessions if session.role == "distractor"]
        same = one.condition == "same-k2"
        assert len({*units}) == len(units) == (2 if same else 7)
        assert one.episode_id not in units
        assert all((unit.family == one.episode_id.family) == same for unit in units)


def test_lesson_parts_without_digests_are_an_error(tmp_path: Path) -> None:
    queries = [record("demonstrations", "MoveCube/test/0", span_sha256=None)]
    root = made_up(tmp_path, queries=queries)
    assert len(list(planned_buffers(plan_manifests(datasets_in(root), ("k1",))))) == 1
    for name in ("parts-k1", "held-k1"):
        with raises(FormatError):
            list(planned_buffers(plan_manifests(datasets_in(root), (name,))))


def test_datasets_that_conditions_need(tmp_path: Path) -> None:
    root = made_up(tmp_path)
    for name, needed in (("raw-k1", "distractors-raw"), ("misled-k0", "contradictions")):
        with raises(SourceError) as caught:
            plan_manifests(datasets_in(root), ("k1", name))
        assert f"--only {needed}" in str(caught.value.command)
    records = [record("contradictions", "PatternLock/test/1/2", lesson=40)]
    write_metadata(root / "contradictions", "contradictions", records)
    plan = plan_manifests(datasets_in(root), ("stale-k1",))
    assert list(plan.datasets) == ["demonstrations", "distractors", "contradictions"]
    with raises(SourceError):
        list(planned_buffers(plan))
    queries = [record("demonstrations", "PatternLock/test/1")]
    one = made_up(tmp_path / "one", queries=queries)
    write_metadata(one / "contradictions", "contradictions", records)
    [found] = planned_buffers(plan_manifests(datasets_in(one), ("stale-k1",)))
    roles = [(one.role, str(one.source), one.stop) for one in found.sessions[:2]]
    assert roles == [
        ("contradiction", "PatternLock/test/1/2", 40),
        ("lesson", "PatternLock/test/1", 20),
    ]
    assert (found.lesson_frames, found.history_frames) == (20, 92)


def test_a_buffer_is_exact_where_all_of_it_is(tmp_path: Path) -> None:
    units = [record("distractors", f"X{n}/train/0", exact=n != 1) for n in range(3)]
    queries = [record("demonstrations", "MoveCube/test/0")]
    plan = plan_manifests(
        datasets_in(made_up(tmp_path, queries=queries, units=units)), ("k0", "k3")
    )
    assert [one.exact for one in planned_buffers(plan)] == [True, False]


def test_a_pool_too_small(tmp_path: Path) -> None:
    root = made_up(tmp_path)
    with raises(BuildError):
        list(write_manifests(plan_manifests(datasets_in(root), ("k10",)), root))
    assert list((root / "manifests").iterdir()) == []


@pytest.mark.parametrize(("limit", "fits"), [(33 + 32 + 1300, True), (33 + 32 + 1299, False)])
def test_the_position_limit(tmp_path: Path, limit: int, fits: bool) -> None:
    plan = plan_manifests(datasets_in(made_up(tmp_path)), ("k1",), position_limit=limit)
    if fits:
        assert len(list(planned_buffers(plan))) == 8
        return
    with raises(InvalidOptionError) as caught:
        list(planned_buffers(plan))
    assert 'position_limit="none"' in str(caught.value.hint)


def test_units_must_be_of_train_episodes(tmp_path: Path) -> None:
    units = [record("distractors", "InsertPeg/test/0"), record("distractors", "Drawer/val/0")]
    with raises(SourceError):
        plan_manifests(datasets_in(made_up(tmp_path, units=units)))


def test_datasets_that_do_not_fit(tmp_path: Path) -> None:
    root = made_up(tmp_path)
    info = root / "distractors" / "meta" / "info.json"
    info.write_text(info.read_text().replace("      4,\n", "      8,\n"))
    with raises(SourceError):
        plan_manifests(datasets_in(root))
    info.write_text(info.read_text().replace("      8,\n", "      4,\n"))
    plan_manifests(datasets_in(root))
    info.write_text(info.read_text().replace('"fps": 10', '"fps": 12.5'))
    with pytest.raises(SourceError) as caught:
        plan_manifests(datasets_in(root))
    rates = "frames per second: 10 in the demonstrations, 12.5 in the distractors"
    assert rates in caught.value.message
    (root / "distractors").rename(root / "units")
    with pytest.raises(MissingFileError):
        plan_manifests(datasets_in(root))
    (root / "demonstrations").rename(root / "distractors")
    (root / "units").rename(root / "demonstrations")
    with raises(InvalidOptionError):
        plan_manifests(datasets_in(root))


@pytest.mark.slow
@pytest.mark.parametrize("steps", range(4))
def test_an_interrupted_build_leaves_the_old_manifests_or_the_new_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int
) -> None:
    """A kill between any two files that appear; then the same command finishes."""
    root, replace, left = copy_buffer_set(tmp_path / "buffer_set"), Path.replace, [steps]

    def killed(path: Path, target: Path) -> Path:
        if target.parent == root / "manifests":
            if not left[0]:
                raise KeyboardInterrupt
            left[0] -= 1
        return replace(path, target)

    plan = plan_manifests(datasets_in(root), ("k0",))
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", killed)
        with suppress(KeyboardInterrupt):
            list(write_manifests(plan, root))
    buffer_set = load_buffer_set(root)
    assert buffer_set.conditions == (CONDITIONS if steps < 2 else ("k0",))
    assert (
        len(list(buffer_set.manifests()))
        == len(buffer_set)
        == len(QUERIES) * len(buffer_set.conditions)
    )
    assert buffer_set.load(QUERIES[0], "k0", verify=True).frames().any()
    assert list(verify_buffer_set(buffer_set, decode=False)) == []
    assert sha256_file(buffer_set.rows_path) == buffer_set.header.rows  # what `publish` sends
    list(write_manifests(plan, root))
    assert sorted(contents(root / "manifests")) == ["buffers.parquet", "manifest.json"]
    assert len(load_buffer_set(root)) == len(QUERIES)


def test_unknown_files_are_kept(tmp_path: Path) -> None:
    other = made_up(tmp_path / "other")
    (other / "manifests").mkdir()
    (other / "manifests" / "notes.txt").write_text("mine")
    with raises(BuildError):
        list(write_manifests(plan_manifests(datasets_in(other)), other))
