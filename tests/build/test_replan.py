"""Planning a planned buffer set again: what stays, what is added, what is lost if confirmed."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.buffer_sets import GOLDEN, QUERIES, build, contents, copy_buffer_set, plan_again

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.config import BuffersConfig
from robomme_interference_data.build_dataset.plan.buffers import next_buffers
from robomme_interference_data.build_dataset.plan.planned import PlannedBuffers
from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.cli import console
from robomme_interference_data.errors import InvalidIdError, InvalidOptionError
from robomme_interference_data.ids import EpisodeId

NOW = ("no-history", "k0", "k1", "raw-k7")
IDS = frozenset(map(EpisodeId.parse, QUERIES))
PLANNED = PlannedBuffers(
    replace(load_buffer_set(GOLDEN).header, conditions=NOW, seed=3, position_limit=5000), IDS
)


def names(conditions: Any) -> tuple[str, ...]:
    return tuple(condition.name for condition in conditions)


def test_a_first_plan_has_the_defaults() -> None:
    change = next_buffers(None, BuffersConfig())
    assert names(change.conditions) == change.added == ("no-history", "k0", "k1", "k3", "k7")
    assert (change.seed, change.position_limit, change.loses) == (0, 4096, False)
    chosen = next_buffers(None, BuffersConfig(("k3", "k0"), seed=2, position_limit="none"))
    assert (names(chosen.conditions), chosen.seed, chosen.position_limit) == (("k0", "k3"), 2, None)


@pytest.mark.parametrize(
    ("request_", "conditions", "added", "dropped", "redrawn"),
    [
        (BuffersConfig(), NOW, (), (), ()),
        (BuffersConfig(("k1", "k0")), NOW, (), (), ()),
        (BuffersConfig(("k3",)), ("no-history", "k0", "k1", "k3", "raw-k7"), ("k3",), (), ()),
        (BuffersConfig(drop=("k1", "raw-k7")), ("no-history", "k0"), (), ("k1", "raw-k7"), ()),
        (BuffersConfig(seed=3), NOW, (), (), ()),
        (BuffersConfig(seed=0), NOW, (), (), ("k1", "raw-k7")),
        (BuffersConfig(seed=0, drop=("k1",)), ("no-history", "k0", "raw-k7"), (), ("k1",), NOW[3:]),
    ],
)
def test_what_is_planned_stays(
    request_: BuffersConfig,
    conditions: tuple[str, ...],
    added: tuple[str, ...],
    dropped: tuple[str, ...],
    redrawn: tuple[str, ...],
) -> None:
    change = next_buffers(PLANNED, request_, queries=IDS)
    assert names(change.conditions) == conditions
    assert (change.added, change.dropped, change.redrawn) == (added, dropped, redrawn)
    assert change.loses == bool(dropped or redrawn)
    assert change.position_limit == 5000
    assert len(change.lines()) == sum(map(bool, (added, dropped, redrawn)))


def test_other_units_and_fewer_queries_lose_buffers() -> None:
    assert next_buffers(PLANNED, BuffersConfig(), units_change=True).redrawn == ("k1", "raw-k7")
    fewer = next_buffers(PLANNED, BuffersConfig(), queries=IDS - {min(IDS)})
    assert fewer.dropped_queries == (min(IDS),) and fewer.loses
    more = next_buffers(
        PLANNED, BuffersConfig(), queries={*IDS, EpisodeId.parse("MoveCube/test/9")}
    )
    assert not more.loses


@pytest.mark.parametrize(
    ("planned", "request_", "error"),
    [
        (PLANNED, BuffersConfig(drop=("k3",)), InvalidOptionError),
        (PLANNED, BuffersConfig(("k1",), drop=("k1",)), InvalidOptionError),
        (PLANNED, BuffersConfig(drop=("nothing",)), InvalidIdError),
        (PLANNED, BuffersConfig(drop=NOW), InvalidOptionError),
        (None, BuffersConfig(drop=("k1",)), InvalidOptionError),
    ],
)
def test_invalid_requests(
    planned: PlannedBuffers | None, request_: BuffersConfig, error: Any
) -> None:
    with pytest.raises(error):
        next_buffers(planned, request_)


def test_manifests_are_kept_unless_the_loss_is_confirmed(own_buffers: Path, run: Any) -> None:
    conditions = load_buffer_set(own_buffers).conditions
    before = contents(own_buffers)
    assert run("build", own_buffers, "--only", "manifests", "--json")[0] == 0
    assert contents(own_buffers) == before
    for options in (("--drop", "k7"), ("--seed", "5")):
        code, out, err = run("build", own_buffers, "--only", "manifests", *options)
        assert (code, out) == (1, "") and "--yes" in err
        assert contents(own_buffers) == before
    assert run("build", own_buffers, "--only", "manifests", "--conditions", "before-k1")[0] == 0
    assert load_buffer_set(own_buffers).conditions == (*conditions, "before-k1")
    dropped = ("--drop", "k7,before-k1", "--yes")
    assert run("build", own_buffers, "--only", "manifests", *dropped)[0] == 0
    assert load_buffer_set(own_buffers).conditions == conditions[:-1]


@pytest.mark.parametrize(("answer", "code"), [("n", 1), ("y", 0)])
def test_a_terminal_is_asked(
    answer: str, code: int, own_buffers: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console.sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(console.typer, "confirm", lambda *_, **__: answer == "y" or _abort())
    assert run("build", own_buffers, "--only", "manifests", "--drop", "k7")[0] == code
    assert ("k7" in load_buffer_set(own_buffers).conditions) == (code == 1)


def _abort() -> None:
    raise console.typer.Abort


@pytest.mark.slow
def test_more_units_need_a_confirmation(tmp_path: Path, run: Any) -> None:
    """Of the distractors, of everything and, for units that are built, of the manifests alone."""
    root = copy_buffer_set(tmp_path / "set")
    families = ("Cup", "Drawer")
    build(root, "executions", SampleSource(size=32), families=("MoveCube",), split="test")
    plan_again(root, ("k0", "k1"))
    before = contents(root)
    source = ("--source", "sample:Cup,Drawer", "--workers", "1")
    for part in (("--only", "distractors"), ()):
        code, _, err = run("build", root, *part, *source)
        assert code == 1 and "--yes" in err
        assert contents(root) == before
    build(root, "distractors", SampleSource(",".join(families), size=32), split="train")
    assert run("build", root, "--only", "manifests")[0] == 1
    code, out, _ = run("build", root, "--only", "manifests", "--yes", "--json")
    assert code == 0 and json.loads(out)["manifests"]["redrawn"] == ["k1"]


def test_a_request_for_buffers_alone_needs_no_source(own_buffers: Path, run: Any) -> None:
    conditions = load_buffer_set(own_buffers).conditions
    assert run("build", own_buffers, "--drop", "k7", "--yes")[0] == 0
    assert load_buffer_set(own_buffers).conditions == conditions[:-1]
    assert run("build", own_buffers, "--conditions", "k7")[0] == 0
    assert load_buffer_set(own_buffers).conditions == conditions
    before = contents(own_buffers)
    for options in ((), ("--drop", "k7", "--families", "MoveCube")):
        code, _, err = run("build", own_buffers, *options, "--json")
        error = json.loads(err)
        assert (code, error["type"]) == (1, "InvalidOptionError")
        assert error["command"] == f"robomme-interference build {own_buffers} --only manifests"
    assert contents(own_buffers) == before


def test_the_files_of_a_repository_are_not_planned_again(tmp_path: Path, run: Any) -> None:
    root = tmp_path / "exported"
    words = ("publish", GOLDEN, "--repo-id", "someone/tiny", "--to", root)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("robomme_interference_data.cards.checks.check_buffer_set", lambda *_: None)
        code, _, err = run(*words)
        assert code == 0, err
    before = contents(root)
    code, _, err = run("build", root, "--drop", "k7", "--yes", "--json")
    error = json.loads(err)
    assert (code, error["type"]) == (1, "BuildError")
    assert f"--demonstrations {root / 'demonstrations'} " in error["command"]
    assert contents(root) == before
