"""docs/systems.md and docs/evaluate.md against the code: table, commands, policy, settings."""

import re
import sys
from pathlib import Path

import pytest
from support import worlds
from support.runs import run

from robomme_interference_data import evaluate
from robomme_interference_data.evaluate.systems import SYSTEMS, System

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "systems.md").read_text(encoding="utf-8")
GUARD = 'if __name__ == "__main__":'


def row(system: System) -> list[str]:
    conditions = {
        (True, True): "all",
        (True, False): "`no-history`",
        (False, True): "with history",
    }[system.applies("no-history"), system.applies("k0")]
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


def test_the_policy_of_the_page_runs(
    tmp_path: Path, world: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = re.search(r"<!-- example: policy -->\n```python\n(.*?)```", PAGE, flags=re.S)
    assert found is not None
    (tmp_path / "retrace.py").write_text(found[1], encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "retrace", raising=False)
    result = run(tmp_path / "run", policy="python:retrace:make", families=("MoveCube",))
    # The world asks for the lesson's pose 3: the fourth action of the first chunk.
    assert [(row.condition, row.status, row.steps) for row in result.rows] == [
        ("no-history", "fail", worlds.STEPS),
        ("k0", "success", 4),
    ]


def test_examples_in_python_have_the_guard_and_are_the_code() -> None:
    page = (DOCS / "evaluate.md").read_text(encoding="utf-8")
    for text in (page, evaluate.__doc__ or ""):
        snippet = text.split("```python\n")[1].split("```")[0]
        assert snippet.index(GUARD) < snippet.index("run_evaluation(")
        compile(snippet, "example", "exec")
        assert "RunConfig(" in snippet
