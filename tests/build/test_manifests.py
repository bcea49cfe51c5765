"""Manifests: what every buffer holds, the same bytes from the same inputs, and what is refused."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from support.buffer_sets import CONDITIONS, GOLDEN, QUERIES, contents, copy_buffer_set
from support.made_up import record, write_metadata

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.manifests import (
    in_folder,
    plan_manifests,
    planned_buffers,
    write_manifests,
)
from robomme_interference_data.build_dataset.verify import verify_buffer_set
from robomme_interference_data.data.query_sessions import QuerySessions, SessionSource
from robomme_interference_data.errors import (
    BuildError,
    FormatError,
    InvalidOptionError,
    MissingFileError,
    SourceError,
)
from robomme_interference_data.schema.conditions import parse_condition

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
        sum(write_manifests(plan_manifests(in_folder(root), tuple(reversed(CONDITIONS))), root))
        == 15
    )
    assert contents(root) == contents(GOLDEN)


def test_what_buffers_beyond_the_paper_hold(tmp_path: Path) -> None:
    """The stored spans of each session; the draws are held by test_draw."""
    root = made_up(tmp_path)
    names = ("k2", "before-k2", "middle-k3", "held-k2", "same-k1", "parts-k2", "absent-k2")
    plan = plan_manifests(in_folder(root), names)
    found = {
        one.condition: one
        for one in planned_buffers(plan)
        if str(one.episode_id) == "PatternLock/test/1"
    }
    lesson, *units = found["k2"].sessions
    assert found["before-k2"].sessions == (*units, lesson)
    assert found["absent-k2"].sessions == (*units,)
    assert (found["absent-k2"].lesson_frames, found["absent-k2"].lesson_share) == (0, 0.0)
    first, second, *rest = found["middle-k3"].sessions
    assert [first, second] == units
    assert [one.role for one in rest] == ["lesson", "distractor"]
    start, *held = found["held-k2"].sessions
    assert start == lesson
    assert held[0] == held[1]
    one = held[0]
    assert (one.role, one.start, one.stop, one.repeat, one.sha256) == ("filler", 32, 33, 32, "l")
    assert (one.source, one.dataset) == (lesson.source, "demonstrations")
    assert (found["held-k2"].history_frames, found["held-k2"].lesson_frames) == (97, 33)
    own = found["same-k1"].sessions[1]
    assert (own.role, own.family, own.source.split) == ("distractor", "PatternLock", "train")
    begin, *middle, end = found["parts-k2"].sessions
    assert middle == units
    assert [(one.role, one.start, one.stop) for one in (begin, end)] == [
        ("lesson", 0, 16),
        ("lesson", 16, 33),
    ]
    assert (begin.sha256, end.sha256) == ("1", "2")
    assert found["parts-k2"].lesson_frames == 33


def test_a_lesson_whose_parts_have_no_digests_is_refused(tmp_path: Path) -> None:
    queries = [record("demonstrations", "MoveCube/test/0", span_sha256=None)]
    root = made_up(tmp_path, queries=queries)
    assert len(list(planned_buffers(plan_manifests(in_folder(root), ("k1",))))) == 1
    for name in ("parts-k1", "held-k1"):
        with pytest.raises(FormatError, match="MoveCube/test/0: no digests of its parts"):
            list(planned_buffers(plan_manifests(in_folder(root), (name,))))


def test_datasets_that_conditions_need(tmp_path: Path) -> None:
    root = made_up(tmp_path)
    for name, needed in (("raw-k1", "distractors-raw"), ("misled-k0", "contradictions")):
        with pytest.raises(SourceError, match=f"{name} needs the dataset {needed}") as caught:
            plan_manifests(in_folder(root), ("k1", name))
        assert f"build {needed}" in str(caught.value.command)
    records = [record("contradictions", "PatternLock/test/1/2", lesson=40)]
    write_metadata(root / "contradictions", "contradictions", records)
    plan = plan_manifests(in_folder(root), ("stale-k1",))
    assert list(plan.datasets) == ["demonstrations", "distractors", "contradictions"]
    with pytest.raises(SourceError, match=r"contradictions lacks \w+/test/0"):
        list(planned_buffers(plan))
    queries = [record("demonstrations", "PatternLock/test/1")]
    one = made_up(tmp_path / "one", queries=queries)
    write_metadata(one / "contradictions", "contradictions", records)
    [found] = planned_buffers(plan_manifests(in_folder(one), ("stale-k1",)))
    roles = [(one.role, str(one.source), one.stop) for one in found.sessions[:2]]
    assert roles == [
        ("contradiction", "PatternLock/test/1/2", 40),
        ("lesson", "PatternLock/test/1", 20),
    ]
    assert (found.lesson_frames, found.history_frames) == (20, 92)


def test_a_buffer_is_exact_where_all_of_it_is(tmp_path: Path) -> None:
    units = [record("distractors", f"X{n}/train/0", exact=n != 1) for n in range(3)]
    queries = [record("demonstrations", "MoveCube/test/0")]
    plan = plan_manifests(in_folder(made_up(tmp_path, queries=queries, units=units)), ("k0", "k3"))
    assert [one.exact for one in planned_buffers(plan)] == [True, False]


def test_a_pool_too_small(tmp_path: Path) -> None:
    root = made_up(tmp_path)
    with pytest.raises(BuildError, match="needs 10 distractor units"):
        list(write_manifests(plan_manifests(in_folder(root), ("k10",)), root))
    assert list((root / "manifests").iterdir()) == []


@pytest.mark.parametrize(("limit", "fits"), [(33 + 32 + 1300, True), (33 + 32 + 1299, False)])
def test_the_position_limit(tmp_path: Path, limit: int, fits: bool) -> None:
    plan = plan_manifests(in_folder(made_up(tmp_path)), ("k1",), position_limit=limit)
    if fits:
        assert len(list(planned_buffers(plan))) == 8
        return
    with pytest.raises(InvalidOptionError, match="under k1 needs 1365 positions") as caught:
        list(planned_buffers(plan))
    assert 'position_limit="none"' in str(caught.value.hint)


def test_units_must_be_of_train_episodes(tmp_path: Path) -> None:
    units = [record("distractors", "InsertPeg/test/0"), record("distractors", "Drawer/val/0")]
    with pytest.raises(SourceError, match="must come from train episodes.* test, val"):
        plan_manifests(in_folder(made_up(tmp_path, units=units)))


def test_datasets_that_do_not_fit(tmp_path: Path) -> None:
    root = made_up(tmp_path)
    info = root / "distractors" / "meta" / "info.json"
    info.write_text(info.read_text().replace("      4,\n", "      8,\n"))
    with pytest.raises(SourceError, match="cannot follow one another"):
        plan_manifests(in_folder(root))
    (root / "distractors").rename(root / "units")
    with pytest.raises(MissingFileError):
        plan_manifests(in_folder(root))
    (root / "demonstrations").rename(root / "distractors")
    (root / "units").rename(root / "demonstrations")
    with pytest.raises(InvalidOptionError, match="is a dataset of distractors"):
        plan_manifests(in_folder(root))


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

    plan = plan_manifests(in_folder(root), ("k0",))
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
    list(write_manifests(plan, root))
    assert sorted(contents(root / "manifests")) == ["buffers.parquet", "manifest.json"]
    assert len(load_buffer_set(root)) == len(QUERIES)


def test_a_buffer_is_planned_without_manifests() -> None:
    buffer_set = load_buffer_set(GOLDEN)
    record = buffer_set.query(QUERIES[1]).record
    sessions = QuerySessions(SessionSource(buffer_set.datasets), record)
    for name in CONDITIONS:
        assert sessions.buffer(parse_condition(name)) == buffer_set.manifest(QUERIES[1], name)


def test_earlier_manifests_are_replaced_and_strangers_kept(tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "buffer_set")
    assert sum(write_manifests(plan_manifests(in_folder(root), ("k0",)), root)) == len(QUERIES)
    assert load_buffer_set(root).conditions == ("k0",)
    other = made_up(tmp_path / "other")
    (other / "manifests").mkdir()
    (other / "manifests" / "notes.txt").write_text("mine")
    with pytest.raises(BuildError, match=r"holds notes\.txt"):
        list(write_manifests(plan_manifests(in_folder(other)), other))
