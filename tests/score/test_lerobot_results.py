"""`eval_info.json` of lerobot-eval: read, told apart, and paired only where scenes are the same."""

import json
from pathlib import Path
from typing import Any

import pytest
from support import eval_info
from support import scoring as made
from support.eval_info import task
from support.messages import raises

from robomme_interference_data.errors import FormatError, InvalidIdError, InvalidOptionError
from robomme_interference_data.evaluate.score.compare import compare
from robomme_interference_data.evaluate.score.config import Expected
from robomme_interference_data.evaluate.score.rows.reading import read_rows

SUCCESSES = {("pusht", 0): "sssf", ("pusht", 3): "sfff"}  # 4 of 8
BETTER = {("pusht", 0): "ssss", ("pusht", 3): "sfsf"}  # 6 of 8


def write(path: Path, outcomes: dict[tuple[str, int], str] = SUCCESSES) -> Path:
    return eval_info.write(path, outcomes)


def test_episodes_are_read_by_task_and_position(tmp_path: Path) -> None:
    rows = read_rows([write(tmp_path / "eval_info.json")], ["act"])
    assert [
        (row.system, row.simulator, row.condition, row.family, row.episode, row.status)
        for row in rows
    ] == [
        ("act", "pusht", "no-history", family, episode, status)
        for family, letters in (("task_0", "sssf"), ("task_3", "sfff"))
        for episode, status in enumerate(made.STATUS[letter] for letter in letters)
    ]


def test_the_system_is_stated(tmp_path: Path) -> None:
    path = write(tmp_path / "eval_info.json")
    with raises(FormatError):
        read_rows([path])
    with raises(InvalidIdError):
        read_rows([path], ["my act"])
    other = write(tmp_path / "other.json", BETTER)
    with raises(InvalidOptionError):
        read_rows([path, other], ["act", "act", "smolvla"])
    for seed in (-1, 10**18):
        with raises(InvalidOptionError) as raised:
            read_rows([path], ["act"], model_seeds=[seed])
        assert raised.value.option == "model_seed"
    assert read_rows([path, other], ["act", "smolvla"]).names("system") == ["act", "smolvla"]


def test_systems_are_paired_only_with_the_same_known_seeds(tmp_path: Path) -> None:
    paths = [write(tmp_path / "act.json"), write(tmp_path / "smolvla.json", BETTER)]
    systems = ("act", "smolvla")
    for seeds, paired in (((), False), ((1000,), True), ((1000, 2000), False)):
        found = made.score(*paths, system=systems, model_seed=seeds)
        row = made.record(found, "matrix", system="act")
        assert (row["rate"], row["against_rate"], row["n"]) == (0.5, 0.75, 8)
        # Two episodes are won by smolvla alone, and none by act.
        assert (row["gained"], row["lost"]) == ((0, 2) if paired else (None, None))
        assert len(found.notes) == (1 if paired else 2)


def test_several_seeds_of_a_system_are_repeats_of_its_episodes(tmp_path: Path) -> None:
    outcomes = {"a": SUCCESSES, "b": BETTER, "c": SUCCESSES, "d": SUCCESSES}
    paths = [write(tmp_path / f"{name}.json", given) for name, given in outcomes.items()]
    systems, seeds = ("act", "act", "smolvla", "smolvla"), (1000, 2000, 1000, 2000)
    found = made.score(*paths, system=systems, model_seed=seeds)
    own = made.record(found, "main", system="act")
    assert (own["n"], own["successes"], own["rate"]) == (8, 10, 10 / 16)
    # The other seed may be another scene: flips are no noise between repeats of one rollout.
    assert found.outcomes["pusht"].repeat_flips == (0, 0)
    assert made.record(found, "matrix", system="act")["gained"] is not None
    # With other seeds than act, smolvla has other scenes.
    found = made.score(*paths, system=systems, model_seed=(1000, 2000, 1000, 3000))
    assert made.record(found, "matrix", system="act")["gained"] is None
    # Of unknown seeds, the same episodes would count twice.
    for stated in ((), (1000,)):
        with raises(FormatError):
            read_rows(paths, systems, model_seeds=stated)


def test_files_of_several_suites_make_one_system(tmp_path: Path) -> None:
    paths = [
        write(tmp_path / "spatial.json", {("libero_spatial", 0): "sf"}),
        write(tmp_path / "object.json", {("libero_object", 0): "ss"}),
    ]
    found = made.score(*paths, system=("act",))
    assert [(row["simulator"], row["rate"]) for row in made.records(found, "main")] == [
        ("libero_object", 1.0),
        ("libero_spatial", 0.5),
    ]


def test_compare_pairs_known_scenes_alone(tmp_path: Path) -> None:
    paths = [write(tmp_path / "act.json"), write(tmp_path / "smolvla.json", BETTER)]
    with raises(InvalidOptionError):
        compare(*paths, systems=("act", "smolvla"))
    compared = compare(*paths, systems=("act", "smolvla"), model_seed=1000)
    overall = compared.table.records()[0]
    assert (overall["n"], overall["difference"], overall["gained"], overall["lost"]) == (
        8,
        0.25,
        2,
        0,
    )
    assert len(compared.notes) == 1


def test_the_grid_is_that_of_the_files(tmp_path: Path) -> None:
    """The benchmark's nine families are not expected of another benchmark."""
    path = write(tmp_path / "eval_info.json")
    found = made.score(path, system=("act",), expected=Expected.BENCHMARK)
    assert [(row["n"], row["complete"]) for row in made.records(found, "main")] == [(8, True)]


BROKEN = {
    "truncated": '{"per_task": [{"task_group": "pusht"',
    "list": "[]",
    "nan": json.dumps({"per_task": [task("pusht", 0, [float("nan")])]}),
    "null": {"per_task": [task("pusht", 0, [True, None])]},
    "number": {"per_task": [task("pusht", 0, [0.5])]},
    "text": {"per_task": [task("pusht", 0, ["true"])]},
    "nested": {"per_task": [task("pusht", 0, [[True]])]},
    "no episodes": {"per_task": [task("pusht", 0, [])]},
    "no tasks": {"per_task": []},
    "tasks by name": {"per_task": {"pusht": []}},
    "no task": {"per_task": ["pusht"]},
    "no metrics": {"per_task": [{"task_group": "pusht", "task_id": 0}]},
    "no group": {"per_task": [task(None, 0, [True])]},
    "a number as group": {"per_task": [task(3, 0, [True])]},
    "text as number": {"per_task": [task("pusht", "0", [True])]},
    "twice": {"per_task": [task("pusht", 0, [True]), task("pusht", 0, [False])]},
    "of two programs": {"per_task": [task("pusht", 0, [True])], "tasks": []},
    "another": {"per_episode": [{"episode_ix": 0, "success": True}]},
}


@pytest.mark.parametrize("content", BROKEN.values(), ids=BROKEN.keys())
def test_other_files_are_one_error(tmp_path: Path, content: Any) -> None:
    path = tmp_path / "eval_info.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with raises(FormatError):
        read_rows([path], ["act"], lenient=True)


@pytest.mark.slow
def test_it_is_what_lerobot_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With its own function for all tasks, whose result lerobot-eval dumps."""
    from lerobot.scripts import lerobot_eval

    class Stub:
        training = False

        def eval(self) -> None: ...
        def train(self, mode: bool) -> None: ...
        def close(self) -> None: ...

    def eval_one(env: Any, **_: Any) -> dict[str, Any]:
        letters = SUCCESSES["pusht", env.number]
        wins = [letter == "s" for letter in letters]
        return {"sum_rewards": [0.0] * 4, "max_rewards": [0.0] * 4, "successes": wins}

    environments = {number: Stub() for _, number in SUCCESSES}
    for number, environment in environments.items():
        environment.number = number  # type: ignore[attr-defined]
    monkeypatch.setattr(lerobot_eval, "eval_one", eval_one)
    parts = dict.fromkeys(("env_preprocessor", "env_postprocessor", "preprocessor"))
    info = lerobot_eval.eval_policy_all(
        {"pusht": environments}, Stub(), **parts, postprocessor=None, n_episodes=4
    )
    path = tmp_path / "eval_info.json"
    path.write_text(json.dumps(info, indent=2))
    expected = read_rows([write(tmp_path / "ours.json")], ["act"])
    assert read_rows([path], ["act"]).rows == expected.rows
