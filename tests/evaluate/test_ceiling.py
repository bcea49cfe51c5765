"""The evidence that a memory keeps, and the chance of the ideal observer, by hand."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.buffer_sets import copy_buffer_set
from support.made_up import record
from support.messages import raises
from support.retrieval import make_index
from support.shifted import add_shifted
from support.tabletop import TABLETOP

from robomme_interference_data import load_buffer_set
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.query import Query
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.evaluate.ceiling import ALL, ceiling, chance
from robomme_interference_data.evaluate.run.config import CeilingConfig
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.simulators.tabletop.episodes import difficulty_of, seed_of
from robomme_interference_data.simulators.tabletop.families import draw_episode


def kept(buffer_set: Path, **settings: Any) -> dict[tuple[str, str], float | None]:
    cells = ceiling(load_buffer_set(buffer_set), CeilingConfig(**settings))
    assert all(cell.success is None for cell in cells)  # made-up episodes have no answers
    return {(cell.part, cell.condition): cell.evidence_kept for cell in cells}


def test_evidence_kept_by_hand(tiny_buffers: Path) -> None:
    """Lessons of 48 frames show the answer in frames 0 to 3, and in eight round 20, 35 and 41."""
    families = ("VideoRepick", "MoveCube", "PatternLock")
    window = kept(tiny_buffers, memory="window", conditions=("k0", "k1"))
    # Of 48 frames the last 31 begin with 17; of 80 none is of the lesson.
    assert window == {
        **{(family, "k0"): 0.5 for family in (*families, ALL)},
        **{(family, "k1"): 0 for family in (*families, ALL)},
    }
    # In seconds: of 48 frames 38, which is 1 s old, and 28; or of those 2 s apart 28 and 8.
    for memory, share in (("window:3@1", 0.5), ("window:6@0.5", 0)):
        assert kept(tiny_buffers, memory=memory, conditions=("k0",))["MoveCube", "k0"] == share
    # Of 272 frames every ninth: 0, 8, 17, 26, 35, 43.
    assert set(kept(tiny_buffers, conditions=("k7",)).values()) == {1}
    # Without a lesson nothing is known.
    assert set(kept(tiny_buffers, conditions=("no-history",)).values()) == {None}


def test_a_retrieval_step(tmp_path: Path) -> None:
    buffer_set = copy_buffer_set(tmp_path / "buffer_set")
    make_index(buffer_set)
    found = kept(buffer_set, memory="window", retrieval="thumbnail", retrieval_rule="oracle")
    assert {condition for _, condition in found} == {"k0", "k1", "k3", "k7"}  # without a history
    assert set(found.values()) == {0.5}  # of the lesson alone, whatever follows it
    last = kept(buffer_set, memory="full", retrieval="thumbnail", retrieval_rule="last")
    assert last["MoveCube", "k7"] == 0


def test_retrieval_under_a_shift(tmp_path: Path) -> None:
    buffer_set = copy_buffer_set(tmp_path / "buffer_set")
    add_shifted(buffer_set)
    make_index(buffer_set, names=("demonstrations", "distractors", "shifted"))
    options: dict[str, Any] = {"memory": "full", "retrieval": "thumbnail", "conditions": ("k7",)}
    plain, same, black = (
        kept(buffer_set, shift=s, **options) for s in ("none", "light:1", "clutter:3")
    )
    assert plain == same != black  # light:1 looks as always, clutter:3 is black
    with raises(InvalidOptionError):
        ceiling(load_buffer_set(buffer_set), CeilingConfig(shift="light:1"))


def test_invalid_settings_are_errors(tiny_buffers: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    buffer_set = load_buffer_set(tiny_buffers)
    with raises(UnknownNameError):
        ceiling(buffer_set, CeilingConfig("framesmap"))
    with raises(InvalidOptionError):
        ceiling(buffer_set, CeilingConfig(frames=0))
    with raises(UnknownNameError):
        ceiling(buffer_set, CeilingConfig(conditions=("k9",)))
    with raises(InvalidOptionError):
        ceiling(buffer_set, CeilingConfig(retrieval_rule="last"))
    with raises(InvalidOptionError):
        ceiling(buffer_set, CeilingConfig(retrieval="thumbnail", conditions=("no-history", "k0")))
    unknown = SimpleNamespace(record=SimpleNamespace(evidence=None))
    monkeypatch.setattr(BufferSet, "query", lambda *_: unknown)
    with raises(InvalidOptionError):
        ceiling(buffer_set, CeilingConfig())


def test_a_part_that_needs_more_frames_than_are_kept_is_unknown() -> None:
    buffer_set = load_buffer_set(TABLETOP)
    rates = {
        frames: {
            cell.condition: cell.success
            for cell in ceiling(buffer_set, CeilingConfig(memory="full", frames=frames))
            if cell.part == ALL
        }
        for frames in (1, 1000)
    }
    assert rates[1]["k0"] == rates[1]["k1"] == 1
    assert rates[1000]["k0"] == rates[1000]["no-history"] < 1


# --- the ideal observer --------------------------------------------------------------------------


def query(family: str, index: int, answer: int) -> tuple[Query, tuple[str, ...]]:
    """A query of the tabletop whose lesson showed an answer; and the parts of that."""
    seed = seed_of(EpisodeId(family, "test", index))
    scene = draw_episode(family, seed, difficulty_of(seed))
    parts = scene.parts(scene.answers[answer])
    spans = tuple(EvidenceSpan(part, text, part, part + 1) for part, text in enumerate(parts))
    metadata: dict[str, Any] = {"seed": seed, "difficulty": difficulty_of(seed), "evidence": spans}
    known = record("demonstrations", f"{family}/test/{index}", simulator="tabletop", **metadata)
    return Query(None, known), parts  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("family", "index", "known", "expected"),
    [
        ("MoveCube", 0, (), 1 / 3),
        ("MoveCube", 0, (0,), 1),
        ("InsertPeg", 2, (), 1 / 16),  # four pegs, two ends, two sides
        ("InsertPeg", 2, (0, 2), 1 / 2),
        ("VideoRepick", 2, (0,), 1 / 4),  # of five cubes each ends elsewhere
        ("PatternLock", 0, (), 1 / 1764),
    ],
)
def test_the_chance_among_the_remaining_answers(
    family: str, index: int, known: tuple[int, ...], expected: float
) -> None:
    asked, parts = query(family, index, 1)
    assert chance(asked, {part: parts[part] for part in known}) == expected


def test_a_wrong_lesson_leaves_no_chance() -> None:
    asked, _ = query("MoveCube", 0, 0)
    _, wrong = query("MoveCube", 0, 1)
    assert chance(asked, dict(enumerate(wrong))) == 0


def test_in_a_day_nothing_known_is_nothing_done() -> None:
    asked, parts = query("MoveCube", 0, 1)

    def of_day(ability: str, known: dict[int, str]) -> float | None:
        return chance(replace(asked, record=replace(asked.record, ability=ability)), known)

    everything = dict(enumerate(parts))
    assert (of_day("recall", {}), of_day("recall", everything)) == (0, 1)
    assert (of_day("absent", {}), of_day("absent", everything)) == (1, 0)


@pytest.mark.parametrize("unknown", ["simulator", "seed", "difficulty", "evidence"])
def test_no_chance_where_answers_are_unknown(unknown: str) -> None:
    asked, _ = query("MoveCube", 0, 0)
    assert chance(replace(asked, record=replace(asked.record, **{unknown: None})), {}) is None


def test_a_ceiling_needs_no_simulator_and_no_weights() -> None:
    code = (
        "import sys\n"
        "for name in ('sapien', 'mani_skill', 'torch', 'gymnasium', 'transformers'):\n"
        "    sys.modules[name] = None\n"
        "import robomme_interference_data.evaluate.ceiling\n"
        "from robomme_interference_data.simulators.tabletop.families import draw_episode\n"
        "print(len(draw_episode('VideoUnmaskSwap', 3, 'hard').agreeing({})))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    assert done.stdout == "20\n"
