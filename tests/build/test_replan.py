"""Planning a planned buffer set again: what stays, what is added, what is lost if confirmed."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.buffer_sets import GOLDEN, QUERIES, build, contents, copy_buffer_set, plan_again

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.config import PlanConfig
from robomme_interference_data.build_dataset.replan import Planned, replan
from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.cli import console
from robomme_interference_data.errors import InvalidIdError, InvalidOptionError
from robomme_interference_data.ids import EpisodeId

NOW = ("no-history", "k0", "k1", "raw-k7")
IDS = frozenset(map(EpisodeId.parse, QUERIES))
PLANNED = Planned(
    replace(load_buffer_set(GOLDEN).header, conditions=NOW, seed=3, position_limit=5000), IDS
)


def names(conditions: Any) -> tuple[str, ...]:
    return tuple(condition.name for condition in conditions)


def test_a_first_plan_has_the_defaults() -> None:
    change = replan(None, PlanConfig())
    assert names(change.conditions) == change.added == ("no-history", "k0", "k1", "k3", "k7")
    assert (change.seed, change.position_limit, change.loses) == (0, 4096, False)
    chosen = replan(None, PlanConfig(("k3", "k0"), seed=2, position_limit="none"))
    assert (names(chosen.conditions), chosen.seed, chosen.position_limit) == (("k0", "k3"), 2, None)


@pytest.mark.parametrize(
    ("request_", "conditions", "added", "dropped", "redrawn"),
    [
        (PlanConfig(), NOW, (), (), ()),
        (PlanConfig(("k1", "k0")), NOW, (), (), ()),
        (PlanConfig(("k3",)), ("no-history", "k0", "k1", "k3", "raw-k7"), ("k3",), (), ()),
        (PlanConfig(drop=("k1", "raw-k7")), ("no-history", "k0"), (), ("k1", "raw-k7"), ()),
        (PlanConfig(seed=3), NOW, (), (), ()),
        (PlanConfig(seed=0), NOW, (), (), ("k1", "raw-k7")),
        (PlanConfig(seed=0, drop=("k1",)), ("no-history", "k0", "raw-k7"), (), ("k1",), NOW[3:]),
    ],
)
def test_what_is_planned_stays(
    request_: PlanConfig,
    conditions: tuple[str, ...],
    added: tuple[str, ...],
    dropped: tuple[str, ...],
    redrawn: tuple[str, ...],
) -> None:
    change = replan(PLANNED, request_, queries=IDS)
    assert names(change.conditions) == conditions
    assert (change.added, change.dropped, change.redrawn) == (added, dropped, redrawn)
    assert change.loses == bool(dropped or redrawn)
    assert change.position_limit == 5000
    assert len(change.lines()) == sum(map(bool, (added, dropped, redrawn)))


def test_other_units_and_fewer_queries_lose_buffers() -> None:
    assert replan(PLANNED, PlanConfig(), units_change=True).redrawn == ("k1", "raw-k7")
    fewer = replan(PLANNED, PlanConfig(), queries=IDS - {min(IDS)})
    assert fewer.dropped_queries == (min(IDS),) and fewer.loses
    more = replan(PLANNED, PlanConfig(), queries={*IDS, EpisodeId.parse("MoveCube/test/9")})
    assert not more.loses


@pytest.mark.parametrize(
    ("planned", "request_", "error"),
    [
        (PLANNED, PlanConfig(drop=("k3",)), InvalidOptionError),
        (PLANNED, PlanConfig(("k1",), drop=("k1",)), InvalidOptionError),
        (PLANNED, PlanConfig(drop=("nothing",)), InvalidIdError),
        (PLANNED, PlanConfig(drop=NOW), InvalidOptionError),
        (None, PlanConfig(drop=("k1",)), InvalidOptionError),
    ],
)
def test_invalid_requests(planned: Planned | None, request_: PlanConfig, error: Any) -> None:
    with pytest.raises(error):
        replan(planned, request_)


def test_manifests_are_kept_unless_the_loss_is_confirmed(own_buffers: Path, run: Any) -> None:
    conditions = load_buffer_set(own_buffers).conditions
    before = contents(own_buffers)
    assert run("build", "manifests", own_buffers, "--json")[0] == 0
    assert contents(own_buffers) == before
    for options in (("--drop", "k7"), ("--seed", "5")):
        code, out, err = run("build", "manifests", own_buffers, *options)
        assert (code, out) == (1, "") and "--yes" in err
        assert contents(own_buffers) == before
    assert run("build", "manifests", own_buffers, "--conditions", "before-k1")[0] == 0
    assert load_buffer_set(own_buffers).conditions == (*conditions, "before-k1")
    dropped = ("--drop", "k7,before-k1", "--yes")
    assert run("build", "manifests", own_buffers, *dropped)[0] == 0
    assert load_buffer_set(own_buffers).conditions == conditions[:-1]


@pytest.mark.parametrize(("answer", "code"), [("n", 1), ("y", 0)])
def test_a_terminal_is_asked(
    answer: str, code: int, own_buffers: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console.sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(console.typer, "confirm", lambda *_, **__: answer == "y" or _abort())
    assert run("build", "manifests", own_buffers, "--drop", "k7")[0] == code
    assert ("k7" in load_buffer_set(own_buffers).conditions) == (code == 1)


def _abort() -> None:
    raise console.typer.Abort


def test_more_units_need_a_confirmation(tmp_path: Path, run: Any) -> None:
    """In `build distractors`, in `build all` and, for units that are built, `build manifests`."""
    root = copy_buffer_set(tmp_path / "set")
    families = ("Cup", "Drawer")
    build(root, "executions", SampleSource(size=32), families=("MoveCube",), split="test")
    plan_again(root, ("k0", "k1"))
    before = contents(root)
    source = ("--source", "sample:Cup,Drawer", "--workers", "1")
    for command in ("distractors", "all"):
        code, _, err = run("build", command, root, *source)
        assert code == 1 and "--yes" in err
        assert contents(root) == before
    build(root, "distractors", SampleSource(",".join(families), size=32), split="train")
    assert run("build", "manifests", root)[0] == 1
    code, out, _ = run("build", "manifests", root, "--yes", "--json")
    assert code == 0 and '"redrawn": [\n    "k1"\n  ]' in out
