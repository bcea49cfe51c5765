"""What docs/results/robomme.md states is what its rows say."""

import csv
import json
import runpy
from collections import Counter
from functools import cache
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from support import scoring as made
from support.pages import RESULTS, table

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.score.compare import compare
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.paper import by_family
from robomme_interference_data.evaluate.shortcuts import Cues, Shortcut, shortcuts
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.simulators.robomme.recorded_scene import read_scene
from robomme_interference_data.simulators.robomme.scenes import OfficialScene
from robomme_interference_data.stats.intervals import newcombe, wilson

ROBOMME = (RESULTS / "robomme.md").read_text(encoding="utf-8")
LESSONS: list[dict[str, Any]] = pq.read_table(RESULTS / "robomme/lessons.parquet").to_pylist()
ROLLOUTS: list[dict[str, Any]] = pq.read_table(RESULTS / "robomme/rollouts.parquet").to_pylist()


def rows(head: str) -> list[list[str]]:
    """The rows of the page's table with a column."""
    return [[*row.values()] for row in table(ROBOMME, head)]


def family_of(lesson: dict[str, Any]) -> str:
    return str(lesson["episode_id"]).partition("/")[0]


def scene_of(lesson: dict[str, Any]) -> OfficialScene:
    scene = read_scene(family_of(lesson), lesson["scene"], lesson["difficulty"])
    assert scene is not None
    return scene


def kept_frames(lesson: dict[str, Any], memory: str, sessions: int, live: int = 0) -> set[int]:
    """The frames that a memory keeps: of the lesson, sessions of 32 frames, and live ones."""
    return {*Memory(memory).kept(range(lesson["lesson_frames"] + 32 * sessions + live))}


def chance(lesson: dict[str, Any], memory: str, sessions: int, frames: int = 1) -> float:
    """The ideal observer's, if a part is known from so many kept frames of the lesson."""
    kept = kept_frames(lesson, memory, sessions)
    seen, texts = Counter[int](), {}
    for span in lesson["evidence"]:
        seen[span["part"]] += len(kept.intersection(range(span["start"], span["stop"])))
        texts[span["part"]] = span["text"]
    known = {part: text for part, text in texts.items() if seen[part] >= frames}
    if known == texts:
        return 1.0
    return 1 / len(_agreeing(lesson["episode_id"], tuple(known.items())))


@cache
def _agreeing(episode: str, known: tuple[tuple[int, str], ...]) -> list[Any]:
    return scene_of(next(one for one in LESSONS if one["episode_id"] == episode)).agreeing(
        dict(known)
    )


def test_all_lessons_of_the_benchmark_are_there() -> None:
    assert len({one["episode_id"] for one in LESSONS}) == 450
    assert Counter(map(family_of, LESSONS)) == dict.fromkeys(FAMILIES, 50)


@pytest.mark.slow
def test_ceilings_follow_from_the_lessons() -> None:
    for lesson in LESSONS:  # every part together tells the answer, in all families
        scene = scene_of(lesson)
        parts = {span["part"]: span["text"] for span in lesson["evidence"]}
        assert scene.agreeing(parts) == [scene.own_answer(0)]
        assert {chance(lesson, "framesamp", k) for k in (0, 1, 3, 7, 15)} == {1.0}
        assert {chance(lesson, "full", k) for k in (0, 31)} == {1.0}
    *families, _ = rows("lesson frames")
    for family, frames, _, _, _, by_chance, two, k31, window in families:
        lessons = [one for one in LESSONS if family_of(one) == family]
        lengths = [one["lesson_frames"] for one in lessons]
        assert frames == f"{min(lengths)} to {max(lengths)}"
        rates = (
            [1 / len(scene_of(one).answers) for one in lessons],
            [chance(one, "framesamp", 7, frames=2) for one in lessons],
            [chance(one, "framesamp", 31) for one in lessons],
            [chance(one, "window", 0) for one in lessons],
        )
        told = (by_chance, two, k31, window)
        assert told == tuple(f"{100 * sum(one) / 50:.1f}%" for one in rates)
        # From k1 on, `window` is at the level of chance.
        assert [chance(one, "window", 1) for one in lessons] == rates[0]


CEILINGS = (RESULTS / "robomme/ceilings.csv").read_text(encoding="utf-8")


@pytest.mark.slow
def test_ceilings_of_published_memories_follow_from_the_lessons() -> None:
    assert runpy.run_path(str(RESULTS / "make_ceilings.py"))["ceilings"]() == CEILINGS


def test_ceilings_of_published_memories_are_those_of_the_file() -> None:
    made = {
        (row["memory"], row["condition"], int(row["live_frames"])): row
        for row in csv.DictReader(CEILINGS.splitlines())
        if row["family"] == "all"
    }
    listed = table(ROBOMME, "k7, 800 live")
    for row in listed:
        memory = row.pop("memory").strip("`")
        del row["keeps"]
        for head, text in row.items():
            condition, _, live = head.partition(", ")
            found = made[memory, condition, int(live.removesuffix(" live") or 0)]
            assert text == f"{100 * float(found['success']):.1f}%", (memory, head)
    assert len(listed) * 6 == len(made)
    for memory in ("framesamp:32", "window:120@1"):
        assert made[memory, "k7", 0]["all_parts"] == "450"
    chance = sum(1 / len(scene_of(one).answers) for one in LESSONS) / 450
    assert f"Chance is {100 * chance:.1f}%" in ROBOMME
    assert float(made["window:6@1", "k7", 0]["success"]) == pytest.approx(chance, abs=1e-6)


def test_ceilings_of_a_few_lessons_by_position() -> None:
    """The file's numbers for a family, with sets of frames instead of the rule's code."""
    rows = {
        (row["memory"], row["condition"]): float(row["success"])
        for row in csv.DictReader(CEILINGS.splitlines())
        if row["family"] == "VideoPlaceOrder" and row["live_frames"] == "0"
    }
    lessons = [one for one in LESSONS if family_of(one) == "VideoPlaceOrder"]
    for condition, later in (("k15", 480), ("k31", 992), ("raw-k3", 768)):
        for memory, step, frames in (("window:120@1", 10, 120), ("window:60@2", 5, 120)):
            found = 0.0
            for one in lessons:
                live = one["lesson_frames"] + later
                kept = {live - step * j for j in range(1, frames)}
                known = tuple(
                    {
                        span["part"]: span["text"]
                        for span in one["evidence"]
                        if kept.intersection(range(span["start"], span["stop"]))
                    }.items()
                )
                found += 1 / len(_agreeing(one["episode_id"], known))
            assert rows[memory, condition] == pytest.approx(found / 50, abs=1e-6)


def test_frames_of_the_least_shown_part() -> None:
    lessons = [one for one in LESSONS if family_of(one) == "PatternLock"]
    means = []
    for sessions in (0, 7):
        fewest = []
        for one in lessons:
            kept = kept_frames(one, "framesamp", sessions)
            spans = (range(span["start"], span["stop"]) for span in one["evidence"])
            fewest.append(min(len(kept.intersection(span)) for span in spans))
        means.append(sum(fewest) / len(fewest))
    assert f"has {means[0]:.1f} of them on average at k0, and {means[1]:.1f} at k7" in ROBOMME


def test_live_frames_thin_out_the_evidence() -> None:
    for live, *told in rows("live frames"):
        whole, middle = 0, 0
        for one in LESSONS:
            kept = kept_frames(one, "framesamp", 7, int(live))
            spans = [(span["start"], span["stop"]) for span in one["evidence"]]
            whole += all(any(a <= frame < b for frame in kept) for a, b in spans)
            middle += all(
                any(3 * a + b <= 4 * frame <= a + 3 * b for frame in kept) for a, b in spans
            )
        assert told == [f"{100 * count / 450:.1f}%" for count in (whole, middle)], live


def test_rollouts_are_counted() -> None:
    listed = table(ROBOMME, "successes")
    assert {(row["policy"].strip("`"), row["condition"]) for row in listed} == {
        (one["system"], one["condition"]) for one in ROLLOUTS
    }
    for row in listed:
        assert row["successes"] == counted(row["policy"].strip("`"), row["condition"]), row
    assert Counter(one["status"] for one in ROLLOUTS)["error"] == 1


def counted(*key: str) -> str:
    """The successes of a system under a condition, as the page writes them."""
    states = Counter(one["status"] for one in ROLLOUTS if (one["system"], one["condition"]) == key)
    del states["error"]
    low, high = wilson(states["success"], states.total())
    return f"{states['success']} of {states.total()}, {100 * low:.0f} to {100 * high:.0f}%"


@pytest.mark.slow
def test_played_and_computed_agree() -> None:
    """Of 18 cells of ten rollouts each, the 99.9% intervals contain the computed mean."""
    for system, condition in (("framesamp", 7), ("framesamp", 31), ("window", 0), ("window", 1)):
        for family in FAMILIES:
            played = [
                one
                for one in ROLLOUTS
                if (one["system"], one["condition"], one["family"])
                == (f"recall-{system}", f"k{condition}", family)
                and one["status"] != "error"
            ]
            names = {f"{family}/test/{one['episode']}" for one in played}
            lessons = [one for one in LESSONS if one["episode_id"] in names]
            expected = sum(chance(one, system, condition) for one in lessons) / len(lessons)
            low, high = wilson(
                sum(one["status"] == "success" for one in played), len(played), 0.999
            )
            assert low - 1e-9 <= expected <= high + 1e-9, (system, condition, family)


def test_published_rates() -> None:
    rates = {(one.system, one.condition, one.part): round(one.rate * 50) for one in by_family()}
    systems = [("perceptual-framesamp-modul", k) for k in ("k0", "k7")]
    systems.append(("retrieval-framesamp-modul", "k7"))
    *families, total = rows("retrieval, k7")
    for family, _, *cells in families:
        assert cells[:3] == [f"{2 * rates[(*one, family)]}%" for one in systems]
    won = [sum(rates[(*one, family)] for family in FAMILIES) for one in systems]
    assert total[2:5] == [f"{100 * one / 450:.1f}%" for one in won]
    assert [row[0] for row in families] == list(FAMILIES)


PARTS = {
    ("MoveCube", "the manner"): "0",
    ("InsertPeg", "the end"): "0",
    ("InsertPeg", "the side"): "1",
    ("PatternLock", "the first move"): "0",
    ("RouteStick", "the first move"): "0",
    ("PatternLock", "number of moves"): "count",
    ("RouteStick", "number of moves"): "count",
    ("VideoUnmaskSwap", "number of swaps"): "count",
    ("VideoRepick", "number of swaps"): "count",
    ("VideoPlaceOrder", "number of placements and swaps"): "count",
    ("VideoPlaceButton", "number of swaps"): "count",
}
"""What the list names, and the parts of `shortcuts`, which count the swaps or the placements."""


def test_what_else_reveals_the_answer() -> None:
    def measured(lessons: list[dict[str, Any]]) -> dict[tuple[str, str], Shortcut]:
        cues = [
            Cues(
                family_of(one),
                [EvidenceSpan(**span) for span in one["evidence"]],
                one["lesson_frames"],
                one["goal"],
                one["live_view"] and np.frombuffer(one["live_view"], np.uint8).reshape(8, 8, 3),
            )
            for one in lessons
        ]
        return {(one.family, one.part): one for one in shortcuts(cues)}

    everything = measured(LESSONS)
    viewed = measured([one for one in LESSONS if one["live_view"]])
    text = (RESULTS / "robomme/shortcuts.csv").read_text(encoding="utf-8")
    listed = [*csv.DictReader(text.splitlines())]
    assert {(row["family"], row["guessed"]) for row in listed} == {*PARTS}
    for row in listed:
        family, guessed = row.pop("family"), row.pop("guessed")
        key = family, PARTS[family, guessed]
        found, seen = everything[key], viewed[key]
        assert {name: int(value) for name, value in row.items()} == {
            "most_frequent": found.most_frequent,
            "length": found.length,
            "goal": found.goal,
            "n": found.queries,
            "live_view": seen.view,
            "live_view_most_frequent": seen.most_frequent,
            "live_view_n": seen.queries,
        }, key
    manner = everything["MoveCube", "0"]
    assert f"{manner.length} of 50 episodes ({manner.most_frequent} by the most" in ROBOMME
    for one in LESSONS:
        if family_of(one) == "InsertPeg":
            assert json.loads(one["scene"])["answer"][0] == 0


# --- rollouts of replay ---

FILES = sorted(RESULTS.glob("*.csv"))


@pytest.fixture(scope="module")
def robomme() -> Score:
    return made.score(*FILES, paper=True)


def test_successes_are_those_of_the_rows(robomme: Score) -> None:
    cells = {(cell.system, cell.condition, cell.part): cell for cell in robomme.cells if cell.n}
    told = set()
    for row in table(ROBOMME, "system"):
        system, condition = row.pop("system").strip("`"), row.pop("condition")
        for family, text in row.items():
            cell = cells[system, condition, family]
            low, high = (round(100 * end) for end in cell.interval)
            assert text == f"{cell.counts[0]}, {low} to {high}%", (system, condition, family)
            assert cell.n == 50
            told.add((system, condition, family))
    cubes = {key for key in cells if key[2] == "MoveCube"}
    assert told == {key for key in cells if key[2] in FAMILIES} - cubes
    for key in cubes:
        low, high = (round(100 * end) for end in cells[key].interval)
        assert f"({cells[key].counts[0]} of {cells[key].n}, {low} to {high}%, under" in ROBOMME
    assert all(row.counts[3] == 0 for row in robomme.cells)  # no error


def test_retracing_beside_the_released_policy_with_the_same_memory(robomme: Score) -> None:
    ours = {(cell.system, cell.condition, cell.part): cell for cell in robomme.cells if cell.n}
    theirs = {(cell.system, cell.condition, cell.part): cell for cell in by_family()}
    for row in table(ROBOMME, "− released, k0"):
        for condition in ("k0", "k7"):
            where = condition, row["family"]
            own = ours["replay-framesamp", *where]
            published = theirs["perceptual-framesamp-modul", *where]
            won = round(published.rate * published.n)
            ends = (own.rate - published.rate, *newcombe(own.counts[0], own.n, won, published.n))
            change, low, high = (f"{100 * end:+.0f}" for end in ends)
            assert row[f"− released, {condition}"] == f"{change} ({low} to {high})", where


def test_changes_by_family_are_those_of_the_score() -> None:
    path = RESULTS / "replay-framesamp-robomme_rollouts.csv"
    changes = {row["family"]: row for row in compare(path, conditions=("k0", "k7")).table.records()}
    listed = table(ROBOMME, "k7 − k0")
    for row in listed:
        change = changes[row["family"]]
        ends = (change["difference"], change["low"], change["high"])
        difference, low, high = (f"{100 * end:+.0f}" for end in ends)
        assert change["n"] == 50
        assert row["k7 − k0"] == f"{difference} ({low} to {high})"
        assert row["p holm"] == f"{change['p_holm']:.2g}"
    assert len(listed) == 3


def test_retrieval_and_extrapolation_as_the_page_says(robomme: Score) -> None:
    solved = {
        (row.system, row.condition, row.family, row.episode): row.status == "success"
        for row in robomme.rows
        if row.family != "MoveCube"
    }
    for extra in ("", "-extrapolate"):
        alone, retrieved = (
            [well for key, well in sorted(solved.items()) if key[:2] == cell]
            for cell in (
                (f"replay-framesamp{extra}", "k0"),
                (f"retrieval-replay-framesamp{extra}", "k7"),
            )
        )
        assert alone == retrieved and len(alone) == 150
    assert sum(alone) == 148
