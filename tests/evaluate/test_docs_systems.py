"""docs/systems.md: its table is the one in the code, its policy runs, its servers' order holds."""

import re
import sys
from pathlib import Path

import factories
import policy_server
import pytest
import rollout_doubles

from robomme_interference_data import load_split
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate import run_evaluation
from robomme_interference_data.evaluate.policies.connection import API_KEY_VARIABLE
from robomme_interference_data.evaluate.systems import PAPER_SYSTEMS, SYSTEMS, System
from robomme_interference_data.ids import EpisodeId

pytestmark = pytest.mark.usefixtures("world")

PAGE = (Path(__file__).parent.parent / "docs" / "systems.md").read_text(encoding="utf-8")


def row(system: System) -> list[str]:
    conditions = {
        (True, True): "all",
        (True, False): "`no-history`",
        (False, True): "with history",
    }[system.no_history, system.with_history]
    return [
        f"`{system.name}`",
        system.display,
        system.representation,
        system.integration or "–",
        conditions,
        str(system.position_limit or "–"),
    ]


def test_the_table_is_that_of_the_code() -> None:
    section = PAGE.split("\n## ")[1]
    lines = [line for line in section.splitlines() if line.startswith("| `")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert cells == [row(system) for system in SYSTEMS.values()]


def test_it_says_how_to_start_the_server_of_every_system_of_the_paper() -> None:
    section = PAGE.split("\n## Released servers")[1].split("\n## ")[0]
    lines = re.findall(r"^\| `(\S+)` \| `(\S+)/79999` \| `(\S+)` \|$", section, flags=re.M)
    subgoals = {"simple_subgoal": "simple-subgoal", "grounded_subgoal": "grounded-subgoal"}
    expected = []
    for system in PAPER_SYSTEMS:
        config = "mme_vla_suite" if system.with_history else "pi05_baseline"
        folder = system.name.replace("retrieval-", "perceptual-")
        if system.subgoals is not None:
            folder = f"symbolic-{subgoals[system.subgoals]}"
        expected.append((system.name, f"{config}/{folder}", config))
    assert lines == expected
    # The example is a line of that table.
    example = re.search(r"--policy\.dir=runs/ckpts/(\S+)/79999 \\\n +--policy\.config=(\S+)", PAGE)
    assert example is not None
    assert example.groups() in [line[1:] for line in lines]


def test_the_names_that_it_gives_are_the_codes() -> None:
    assert API_KEY_VARIABLE in PAGE


def test_the_policy_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = re.search(r"<!-- example: policy -->\n```python\n(.*?)```", PAGE, flags=re.S)
    assert found is not None
    (tmp_path / "retrace.py").write_text(found[1], encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "retrace", raising=False)
    result = run_evaluation(
        "python:retrace:make",
        factories.split(),
        tmp_path / "run",
        simulator="rollout_doubles:World",
        conditions=["no-history", "k0"],
        families=["PatternLock"],
        episodes="0",
        system="retrace",
    )
    # The world asks for the lesson's pose 3: the fourth action of the first chunk.
    assert [(row.condition, row.status, row.steps) for row in result.rows] == [
        ("no-history", "fail", rollout_doubles.STEPS),
        ("k0", "success", 4),
    ]


def test_a_run_over_servers_keeps_their_account(tmp_path: Path) -> None:
    """Two servers, two workers, with history: every server checks the order of its calls."""
    with (
        policy_server.PolicyServer().running() as one,
        policy_server.PolicyServer().running() as other,
    ):
        policy = f"{one.url},{other.url.removeprefix('websocket://')}"
        result = run_evaluation(
            policy,
            factories.split(),
            tmp_path / "run",
            simulator="rollout_doubles:World",
            conditions=["no-history", "k1"],
            families=["MoveCube", "PatternLock"],
            episodes="0",
            system="perceptual-framesamp-modul",
            workers=2,
        )
        calls = [*one.calls, *other.calls]
    # The policy holds still, so every episode ends after 40 steps.
    assert [(row.status, row.error) for row in result.rows] == [("fail", None)] * 4
    split = load_split(factories.split(), threads=1)
    lengths = {
        len(split.load(EpisodeId(family, "test", 0), 1)) for family in ("MoveCube", "PatternLock")
    }
    assert {call["exec_start_idx"] for call in calls if "exec_start_idx" in call} == {0, *lengths}
    assert [call["call"] for call in calls].count("reset") == 4
    # 40 steps in chunks of 16: asked three times a rollout.
    assert [call["call"] for call in calls].count("infer") == 4 * 3


def test_fewer_servers_than_workers_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidOptionError, match="2 workers need 2 policy servers"):
        run_evaluation(
            "websocket://127.0.0.1:9",
            factories.split(),
            tmp_path / "run",
            simulator="rollout_doubles:World",
            system="mine",
            workers=2,
        )
