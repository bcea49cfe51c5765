"""Results of vla-eval as rows: of this benchmark, and of others, of which less is known."""

import json
from pathlib import Path
from typing import Any

import pytest
from support import scoring as made
from support.messages import raises
from support.scoring import OWN, REVISION

from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.schema.codec import to_dict

KEY = {"system": OWN, "simulator": "tabletop", "buffer_set": "made", "revision": REVISION}
KEY |= {"family": "MoveCube", "condition": "k0", "split": "test", "shift": "none"}
KEY |= {"training_seed": None, "model_seed": 0, "protocol_version": 1} | to_dict(SystemFacts())
TASK = KEY | {"name": "MoveCube/k0", "episode": "0,3-5"}
ROW = KEY | {"episode": 0, "status": "success", "success": True}


def write(path: Path, *episodes: Any) -> Path:
    path.write_text(json.dumps({"tasks": [{"episodes": episodes}]}))
    return path


def failed(index: Any, **changed: Any) -> dict[str, Any]:
    """An episode as vla-eval records one that raised."""
    reason = {"failure_reason": "env_step", "metrics": {"success": False}, "episode_idx": index}
    return TASK | reason | changed


def test_an_episode_that_failed_is_an_error_of_its_own_number(tmp_path: Path) -> None:
    rows = read_rows([write(tmp_path / "a.json", TASK | {"metrics": ROW}, failed(2))])
    assert [(row.episode, row.status, row.success) for row in rows] == [
        (0, "success", True),
        (4, "error", None),
    ]


def test_episodes_beyond_the_last_are_bad_rows(tmp_path: Path) -> None:
    path = write(tmp_path / "a.json", TASK | {"metrics": ROW}, failed(4))
    with raises(FormatError):
        read_rows([path])
    assert [row.episode for row in read_rows([path], lenient=True)] == [0]


@pytest.mark.parametrize(
    "episode",
    [
        *("text", None, {}, {"metrics": None}, {"metrics": [ROW]}),
        {"metrics": {"success": True}},  # of another benchmark
        {"metrics": ROW | {"status": ["success"]}},
        *(failed("0"), failed(None), failed(0, episode=0), failed(0, episode=None)),
        {"metrics": {"success": False}, "failure_reason": "env_step", "episode_idx": 0},
    ],
)
def test_other_files_are_no_results(tmp_path: Path, episode: Any) -> None:
    with raises(FormatError):
        read_rows([write(tmp_path / "a.json", episode)])


# --- other benchmarks --------------------------------------------------------------------------


def of_libero(
    path: Path, letters: str, seed: int | None = 7, suite: str = "spatial", **changed: Any
) -> Path:
    """Results of one task of LIBERO, a letter for each episode, as vla-eval 0.8 writes them."""
    episodes = [
        {"episode_id": n, "metrics": {"success": letter == "s"}, "steps": 2000, "elapsed_sec": 3.2}
        for n, letter in enumerate(letters)
    ]
    for episode, letter in zip(episodes, letters, strict=True):
        if letter == "e":
            episode["failure_reason"] = "server_unreachable"
    task = {"task": "pick up the bowl", "episodes": episodes, "num_episodes": len(letters)}
    results = {"benchmark": "LIBEROBenchmark", "mode": "sync", "tasks": [task]}
    results["config"] = {"params": {"suite": suite, "seed": seed}}
    if seed is not None:
        results["seed"] = seed
    path.write_text(json.dumps(results | changed))
    return path


def test_episodes_of_other_benchmarks(tmp_path: Path) -> None:
    rows = read_rows([of_libero(tmp_path / "a.json", "sfe")], ["act"])
    shared = ("act", "LIBEROBenchmark", "no-history", "pick_up_the_bowl", 7)
    assert [
        (
            row.system,
            row.simulator,
            row.condition,
            row.family,
            row.model_seed,
            row.episode,
            row.status,
        )
        for row in rows
    ] == [(*shared, n, status) for n, status in enumerate(("success", "fail", "error"))]


@pytest.mark.parametrize(
    ("changed", "paired"),
    [({}, True), ({"seed": 8}, False), ({"suite": "goal"}, False), ({"seed": None}, False)],
)
def test_systems_are_paired_in_the_same_evaluation(
    tmp_path: Path, changed: dict[str, Any], paired: bool
) -> None:
    first = of_libero(tmp_path / "a.json", "sfff")
    second = of_libero(tmp_path / "b.json", "ssff", **changed)
    found = made.score(first, second, system=("act", "smolvla"))
    assert (made.record(found, "matrix")["gained"] is not None) is paired


def test_seeds_in_the_results_keep_repeats_apart(tmp_path: Path) -> None:
    paths = [of_libero(tmp_path / "a.json", "sfff"), of_libero(tmp_path / "b.json", "ssff", seed=8)]
    found = made.score(*paths, system=("act",))
    assert made.record(found, "main")["rate"] == 3 / 8
    with raises(FormatError):
        read_rows([paths[0], of_libero(tmp_path / "c.json", "ssff")], ["act"])


@pytest.mark.parametrize(
    "changed",
    [
        {"benchmark": None},
        {"seed": "7"},
        {"tasks": [{"task": "x", "episodes": [{"episode_id": 0, "metrics": {"success": 0.5}}]}]},
        {"tasks": [{"task": "x", "episodes": [{"episode_id": 0, "metrics": {}}]}]},
        {"tasks": [{"task": "x", "episodes": [{"episode_id": "0", "metrics": {"success": True}}]}]},
        {"tasks": [{"task": "a b", "episodes": []}, {"task": "a_b", "episodes": []}]},
    ],
)
def test_other_results_that_are_no_outcomes(tmp_path: Path, changed: dict[str, Any]) -> None:
    with raises(FormatError):
        read_rows([of_libero(tmp_path / "a.json", "sf", **changed)], ["act"], lenient=True)


def test_results_without_episodes_are_no_score(tmp_path: Path) -> None:
    path = of_libero(tmp_path / "a.json", "s", tasks=[])
    with raises(FormatError):
        made.score(path, system=("act",))
