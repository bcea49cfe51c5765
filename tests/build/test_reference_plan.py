"""Reference plans: the package's own follow from the planner, and differences are reported."""

import json
import random
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buffer_sets import GOLDEN, plan_again
from support.make_plans import planned
from support.messages import raises

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.verify.against import PlanComparison, compare
from robomme_interference_data.build_dataset.verify.reference import (
    PLANS,
    plan_text,
    read_plan,
    reference_plan,
    write_plan,
)
from robomme_interference_data.constants import FAMILIES, STATE
from robomme_interference_data.errors import FormatError, InvalidOptionError
from robomme_interference_data.ids import EpisodeId, parse_numbers
from robomme_interference_data.schema.reference_plan import ReferencePlan
from robomme_interference_data.storage.arrays import FeatureDigests

ROOT = Path(__file__).parents[2]
LARGEST = 1_000_000
"""Bytes of a plan in the package."""


@cache
def golden_plan() -> ReferencePlan:
    """The plan of the golden buffer set."""
    return reference_plan(load_buffer_set(GOLDEN))


@pytest.fixture
def plan() -> ReferencePlan:
    """The same."""
    return golden_plan()


# --- the plans of the package -------------------------------------------------------------------


@pytest.mark.parametrize("name", PLANS)
def test_a_plan_of_the_package_is_what_the_planner_gives_today(name: str, tmp_path: Path) -> None:
    """Else a new rule of the draw could pass unnoticed: `support/make_plans.py` makes them."""
    plan = read_plan(name)
    assert plan == planned(plan, tmp_path)
    text = resource(name).read_text(encoding="utf-8")
    assert text == plan_text(plan) and len(text.encode()) < LARGEST


def resource(name: str) -> Path:
    from robomme_interference_data.build_dataset.verify import reference

    return Path(reference.__file__).with_name("plans") / f"{name}.json"


def test_the_official_plan_is_of_the_benchmark() -> None:
    plan = read_plan("official")
    assert len(plan.queries) == 450 and plan.conditions == ("no-history", "k0", "k1", "k3", "k7")
    assert {query.episode.family for query in plan.queries} == {*FAMILIES}
    assert {query.episode.split for query in plan.queries} == {"test"}
    units = [episode for episode in plan.episodes if episode.dataset == "distractors"]
    assert {unit.episode.split for unit in units} == {"train"}
    # The script records these train episodes; some are too short for a unit.
    script = (ROOT / "scripts" / "official_set.sh").read_text(encoding="utf-8")
    [numbers] = re.findall(r"--source robomme .*--unit-episodes (\S+)\)", script)
    assert {unit.episode.index for unit in units} == {*parse_numbers(numbers)}
    lessons = [episode for episode in plan.episodes if episode.dataset == "demonstrations"]
    digests = [lesson for lesson in lessons if "observation.images.front" in lesson.digests]
    assert len(digests) >= 45 and plan.renderers["demonstrations"]


def test_units_are_used_about_equally_often() -> None:
    plan = read_plan("official")
    used = [session for query in plan.queries for session in query.buffer("k7")[1:]]
    families = {session.source.family for session in used}
    assert families == {*FAMILIES} and len(used) == 450 * 7
    assert all(
        len({session.source.family for session in query.buffer("k7")}) == 8
        for query in plan.queries
    )


def test_recorded_lessons_have_the_states_of_the_official_plan(shared_data: Path) -> None:
    """They were recorded on another machine, with RoboMME's own fork of ManiSkill.

    Their images are not compared: a few pixels differ where bins are moved.
    """
    lessons = {episode.episode: episode for episode in read_plan("official").episodes}
    compared = 0
    for path in sorted((shared_data / "lessons").glob("*.npz")):
        with np.load(path) as arrays:
            frames = int(arrays["exec_start_idx"])
            episode = EpisodeId(str(arrays["env_id"]), "test", int(arrays["episode"]))
            digests = FeatureDigests()
            digests.update(STATE, arrays["state"][:frames])
        assert lessons[episode].frames == frames
        if lessons[episode].digests:
            assert lessons[episode].digests[STATE] == digests.current()[STATE]
            compared += 1
    assert compared == 7


# --- a buffer set against a plan ----------------------------------------------------------------


def test_a_plan_is_written_once_and_read_back(plan: ReferencePlan, tmp_path: Path) -> None:
    write_plan(plan, tmp_path / "plan.json")
    assert read_plan(str(tmp_path / "plan.json")) == plan
    assert read_plan(str(GOLDEN)) == plan
    assert compare(plan, plan) == PlanComparison((), (), len(plan.episodes))


@given(st.randoms(use_true_random=False))
def test_no_order_has_an_effect(draw: random.Random) -> None:
    plan = golden_plan()

    def shuffled(values: Any) -> Any:
        return tuple(draw.sample(values, len(values)))

    other = replace(
        plan,
        episodes=shuffled(plan.episodes),
        queries=shuffled(plan.queries),
        conditions=shuffled(plan.conditions),
    )
    assert not compare(other, plan).differences and not compare(plan, other).differences


def test_the_order_of_the_episodes_does_not_change_the_plan(
    plan: ReferencePlan, tmp_path: Path
) -> None:
    backwards = replace(plan, episodes=plan.episodes[::-1])
    assert planned(plan, tmp_path / "one") == planned(backwards, tmp_path / "other") == plan


def other_digest(plan: ReferencePlan, feature: str) -> ReferencePlan:
    """Change the digest of a feature of the first lesson."""
    first, *others = plan.episodes
    digests = first.digests | {feature: "0" * 64}
    return replace(plan, episodes=(replace(first, digests=digests), *others))


def other_unit(plan: ReferencePlan) -> ReferencePlan:
    """Exchange the first two units of the first query under all conditions."""
    first, *others = plan.queries
    lesson, one, two, *further = first.sessions
    sessions = (lesson, two, one, *further)
    return replace(plan, queries=(replace(first, sessions=sessions), *others))


TAMPERED: dict[str, tuple[Callable[[ReferencePlan], ReferencePlan], dict[str, str]]] = {
    "seed": (lambda plan: replace(plan, seed=1), {"seed": "is 0; the plan has 1"}),
    "rule": (lambda plan: replace(plan, rule_version=2), {"rule_version": "is 1; the plan has 2"}),
    "simulator": (
        lambda plan: replace(plan, simulators=("robomme",)),
        {"simulators": "is ('sample',); the plan has ('robomme',)"},
    ),
    "condition": (
        lambda plan: replace(plan, conditions=(*plan.conditions, "k15")),
        {"conditions": "k15 are in the plan only"},
    ),
    "length": (
        lambda plan: replace(
            plan, episodes=(replace(plan.episodes[0], frames=49), *plan.episodes[1:])
        ),
        {"demonstrations VideoRepick/test/0": "has 48 frames; the plan has 49"},
    ),
    "unit that is not in the plan": (
        lambda plan: replace(plan, episodes=plan.episodes[:-1]),
        {"distractors": "RouteStick/train/1 are not in the plan, and change which units are drawn"},
    ),
    "query": (
        lambda plan: replace(
            plan,
            queries=(*plan.queries, replace(plan.queries[0], episode=plan.episodes[-1].episode)),
        ),
        {"queries": "RouteStick/train/1 are in the plan only"},
    ),
    "order of units": (
        other_unit,
        {
            "VideoRepick/test/0 under k1, k3, k7": "session 1 is distractor PatternLock/train/1 "
            "(distractors); the plan has distractor VideoUnmaskSwap/train/1 (distractors)"
        },
    ),
    "buffer": (
        lambda plan: replace(
            plan,
            queries=(
                replace(plan.queries[0], buffers=plan.queries[0].buffers | {"k0": ()}),
                *plan.queries[1:],
            ),
        ),
        {"VideoRepick/test/0 under k0": "1 session; the plan has 0"},
    ),
    "states": (
        lambda plan: other_digest(plan, "observation.state"),
        {
            "demonstrations VideoRepick/test/0": "observation.state differs from the plan, though "
            "the renderer is the same"
        },
    ),
    "images of the same renderer": (
        lambda plan: other_digest(plan, "observation.images.front"),
        {
            "demonstrations VideoRepick/test/0": "observation.images.front differs from the plan, "
            "though the renderer is the same"
        },
    ),
}


@pytest.mark.parametrize("what", TAMPERED)
def test_every_difference_is_reported_once(what: str, plan: ReferencePlan) -> None:
    tamper, expected = TAMPERED[what]
    found = compare(plan, tamper(plan)).differences
    assert {difference.where: difference.what for difference in found} == expected
    assert len(found) == len(expected)


@pytest.mark.parametrize("feature", ["observation.images.front", "observation.state"])
def test_digests_of_another_renderer_are_noted_only(feature: str, plan: ReferencePlan) -> None:
    """States, too: a software renderer is named by its processor, whose maker they depend on."""
    drawn = replace(plan, renderers={"demonstrations": "a GPU", "distractors": None})
    comparison = compare(plan, other_digest(drawn, feature))
    [note] = comparison.notes
    assert not comparison.differences and "1 of 3 compared episodes" in note and "a GPU" in note
    without = [replace(episode, digests={}) for episode in plan.episodes]
    assert compare(plan, replace(plan, episodes=tuple(without))) == PlanComparison((), (), 0)


def test_a_camera_that_is_lacking_is_noted(plan: ReferencePlan) -> None:
    """Else a buffer set without images would equal a plan with their digests."""
    feature = "observation.images.front"
    episodes = [
        replace(
            episode,
            digests={name: episode.digests[name] for name in episode.digests if name != feature},
        )
        for episode in plan.episodes
    ]
    comparison = compare(replace(plan, episodes=tuple(episodes)), plan)
    assert not comparison.differences
    assert [note.split(", which")[0] for note in comparison.notes] == [
        f"Not compared: {feature} of 3 episodes of the demonstrations",
        f"Not compared: {feature} of {len(plan.episodes) - 3} episodes of the distractors",
    ]


def test_more_than_the_plan_is_no_difference(plan: ReferencePlan) -> None:
    fewer = replace(plan, conditions=("k0", "k1"), queries=plan.queries[1:])
    comparison = compare(plan, fewer)
    assert not comparison.differences and len(comparison.notes) == 2


# --- the command --------------------------------------------------------------------------------


def test_the_command_compares_and_writes(own_buffers: Path, tmp_path: Path, run: Any) -> None:
    file = tmp_path / "plan.json"
    code, _, _ = run("verify", own_buffers, "--no-decode", "--write-plan", file)
    assert code == 0
    code, out, _ = run("verify", own_buffers, "--no-decode", "--against", file, "--json")
    assert code == 0 and json.loads(out)["against"] == {
        "plan": str(file),
        "differences": [],
        "notes": [],
        "digests_compared": 20,
    }
    plan_again(own_buffers, ("no-history", "k0", "k1"), seed=7)
    code, out, err = run("verify", own_buffers, "--no-decode", "--against", file)
    assert code == 1 and "seed: is 7; the plan has 0" in out and "differences from the plan" in err
    # Damage is no difference from a plan: nothing is compared, and no plan is written.
    (own_buffers / "manifests" / "notes.txt").touch()
    code, out, err = run("verify", own_buffers, "--against", file, "--write-plan", tmp_path / "no")
    assert code == 1 and "seed" not in out and "correct the violations first" in err
    assert not (tmp_path / "no").exists()


def test_what_is_no_plan_is_one_error(tmp_path: Path, plan: ReferencePlan, run: Any) -> None:
    with raises(InvalidOptionError) as unknown:
        read_plan("offical")
    assert unknown.value.option == "against" and "'official'" in (unknown.value.hint or "")
    file = tmp_path / "plan.json"
    for damage in ({"format_version": 2}, {"seed": "0"}, {"more": 1}):
        file.write_text(json.dumps(json.loads(plan_text(plan)) | damage))
        with raises(FormatError):
            read_plan(str(file))
    value = json.loads(plan_text(plan))
    value["queries"][0]["buffers"]["k0"] = [99]
    file.write_text(json.dumps(value))
    with raises(FormatError):
        read_plan(str(file))
    code, _, err = run("verify", "--source", "sample", "--against", "official")
    assert code == 1 and "--against has no effect" in err
