"""What README and docs show must work: examples run, and every command line is a valid one.

How-tos run from top to bottom in `test_how_to.py`.
"""

import json
import re
import runpy
import shlex
import sys
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from support import eval_info, worlds
from support.buffer_sets import GOLDEN, QUERIES
from support.chat_server import ChatServer
from support.command_lines import parse
from support.hub import push_buffer_set, running_hub
from support.runs import run as evaluate_world
from support.tabletop import copy_tabletop

from robomme_interference_data import load_buffer
from robomme_interference_data.evaluate import Observation, RolloutInfo
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.run import evaluation as run_module
from robomme_interference_data.runtime.executor import Serial

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
TUTORIAL = DOCS / "tutorial.ipynb"
PAGES = sorted(one for one in DOCS.rglob("*.md") if "generated" not in one.parts)
OTHER_PAGES = [page for page in PAGES if page.parent.name != "how-to"]
README = ROOT / "README.md"


def text_of(page: Path) -> str:
    """The Markdown of a page; of a notebook, its sources, commands as blocks of code."""
    text = page.read_text(encoding="utf-8")
    if page.suffix != ".ipynb":
        return text
    cells = ((one["cell_type"], "".join(one["source"])) for one in json.loads(text)["cells"])
    return "\n\n".join(
        source
        if kind == "markdown"
        else f"```{'bash' if source.startswith('%%bash') else 'ipython'}\n{source}\n```"
        for kind, source in cells
    )


def command_lines(page: Path) -> list[str]:
    """Return the command lines in the code blocks of a page, without the command's own name."""
    # Every second part lies between fences; its first line is the language.
    blocks = text_of(page).split("```")[1::2]
    shell = [block.partition("\n") for block in blocks]
    return shell_lines(
        "\n".join(code for language, _, code in shell if language in ("bash", "text", ""))
    )


def shell_lines(code: str) -> list[str]:
    """Return the command lines in shell code, without the command's own name."""
    lines = re.sub(r" *\\\n *", " ", code).splitlines()
    pattern = re.compile(r"(?:PYTHONPATH=\S+ )?robomme-interference (.*?)(?:\s+#.*)?$")
    return [match[1] for line in lines if (match := pattern.match(line.strip()))]


DEMO = runpy.run_path(str(ROOT / "scripts" / "demo.py"))
ALL = [(page.name, line) for page in (README, TUTORIAL, *PAGES) for line in command_lines(page)]
SCRIPTS = sorted((ROOT / "examples").rglob("*.sh"))
ALL += [(path.name, line) for path in SCRIPTS for line in shell_lines(path.read_text("utf-8"))]
ALL += [("demo.py", line) for line in DEMO["STEPS"].values()]
ALL += [("demo.py", line.removeprefix("robomme-interference ")) for line in DEMO["NEXT"]]


@pytest.mark.parametrize(("page", "line"), ALL)
def test_command_lines_are_understood(page: str, line: str) -> None:
    parse(shlex.split(line))


ELSEWHERE = (
    "--simulator robomme",  # the official simulator
    "simulate ",  # a renderer
    "--source tabletop",  # a renderer
    "--source robomme",  # recordings
    "--source lerobot",  # a dataset on the Hub
    "--source frames",  # recordings
    "--replay ",  # a renderer
    "--shift ",  # a renderer
    "k31",  # more units than the golden buffer set has
)
"""What marks command lines of the pages that need what is not available: they are parsed only."""


def test_no_mark_is_left_over() -> None:
    lines = [line for page in (README, *OTHER_PAGES) for line in command_lines(page)]
    assert [mark for mark in ELSEWHERE if not any(mark in line for line in lines)] == []


BEFORE = {
    "score-tables.md": [
        f"evaluate my-buffers --policy replay:{name} --out runs/{name}"
        for name in ("window", "framesamp")
    ]
}
"""Runs that pages use without making them."""


@pytest.mark.slow
@pytest.mark.parametrize("page", [README, *OTHER_PAGES], ids=lambda page: page.name)
def test_the_commands_of_the_pages_run(
    page: Path,
    own_buffers: Path,
    tiny_buffers: Path,
    tmp_path: Path,
    run: Any,
    login: Any,
    hub: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a golden buffer set, in a world without a renderer, in this process, with a loopback Hub.

    Where pages name a chat endpoint, one answers that knows one letter; prompts are the page's own.
    """
    lines = [line for line in command_lines(page) if not any(mark in line for mark in ELSEWHERE)]
    if not lines:
        return
    login("my-name")
    push_buffer_set(hub, GOLDEN, tmp_path / "work", "namespace/name")
    asked = any(line.startswith("ask ") or "--only questions" in line for line in lines)
    buffer_set = copy_tabletop(tmp_path / "tabletop") if asked else own_buffers
    (tmp_path / "docs").symlink_to(ROOT / "docs")  # rows that a page scores
    (tmp_path / "demo").mkdir()
    for name in ("my-buffers", "my-training", "acting-buffers", "ceilings", "demo/buffers"):
        (tmp_path / name).symlink_to(buffer_set)
    for name, letters in (("act", "ssff"), ("pi0", "sssf")):
        eval_info.write(tmp_path / name / "eval_info.json", {("pusht", 0): letters})
    monkeypatch.chdir(tmp_path)
    world = buffer_set if asked else tiny_buffers
    monkeypatch.setenv(worlds.BUFFER_SET, str(world))
    monkeypatch.setattr(run_module, "make_executor", lambda config: Serial())
    for name, prompt in re.findall(r"```toml\n# (\S+)\n(.*?)```", text_of(page), flags=re.S):
        (tmp_path / name).write_text(prompt)
    with ChatServer(lambda seen: "A") as chat:
        for line in (*BEFORE.get(page.name, ()), *lines):
            given = line
            if not line.startswith("power"):
                given = re.sub(r"--episodes [0-9-]+", "--episodes 0", given)
            given = re.sub(r"openai:\S+", f"openai:{chat.url}#tiny", given)
            if not asked:
                given = given.replace("RouteStick", "PatternLock").replace("Unmask/", "Repick/")
            if given.startswith("evaluate "):
                given += " --simulator support.worlds:World"
            if given.startswith("publish") and "--dry-run" not in given:
                given += " --yes"
            code, out, err = run(*shlex.split(given))
            assert code == 0, f"{line}\n{out}\n{err}"


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_tutorial_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a reader runs it, on the embedded simulator; the numbers that its text states come out."""
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:/usr/bin:/bin")
    notebook = nbformat.read(TUTORIAL, 4)
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=580, kernel_name="python3", resources=resources).execute()
    rates = {}
    for name in ("framesamp", "retrieval"):
        lines = (tmp_path / f"tutorial/runs/{name}/rollouts.jsonl").read_text().splitlines()
        rows = [json.loads(line) for line in lines]
        for condition in ("k0", "k7", "raw-k7"):
            solved = [row["success"] for row in rows if row["condition"] == condition]
            rates[name, condition] = (sum(solved), len(solved))
    assert rates["framesamp", "k0"] == rates["framesamp", "k7"] == (6, 6)
    assert rates["framesamp", "raw-k7"] == (0, 6)
    assert rates["retrieval", "raw-k7"] == (6, 6)
    assert (tmp_path / "tutorial/score/report.html").is_file()


def test_the_demo_ends_with_what_its_rollouts_show(tmp_path: Path) -> None:
    def write(run: str, *rows: tuple[str, int, str]) -> Path:
        (tmp_path / run).mkdir()
        lines = (
            json.dumps({"family": "MoveCube", "condition": under, "episode": at, "status": status})
            for under, at, status in rows
        )
        (tmp_path / run / "rollouts.jsonl").write_text("\n".join(lines))
        return tmp_path / run

    framesamp = write(
        "framesamp",
        ("k0", 0, "error"),
        ("k0", 1, "success"),
        ("k0", 0, "success"),  # the error, tried again
        ("raw-k7", 0, "timeout"),
        ("raw-k7", 1, "fail"),
    )
    retrieval = write("retrieval", ("raw-k7", 0, "success"), ("raw-k7", 1, "fail"))
    sentence = DEMO["summary"](framesamp, retrieval)
    assert re.findall(r"\d+ of \d+", sentence) == ["2 of 2", "0 of 2", "1 of 2"]


def example(page: Path, name: str) -> str:
    found = re.search(rf"<!-- example: {name} -->\n```python\n(.*?)```", text_of(page), flags=re.S)
    assert found is not None
    return found[1]


@pytest.mark.parametrize("name", ["hub", "load"])
def test_the_readmes_python_examples(
    name: str, tmp_path: Path, tiny_buffers: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "buffers").symlink_to(tiny_buffers)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    with running_hub(tmp_path / "cache", monkeypatch) as hub:
        push_buffer_set(hub, tiny_buffers, tmp_path / "work", "namespace/name")
        exec(example(README, name), names)
    buffer = names["buffer"]
    assert len(buffer) == 48 + 3 * 32  # type: ignore[arg-type]
    assert str(buffer.episode_id) in QUERIES  # type: ignore[attr-defined]


def test_the_example_of_a_policy_runs(
    tmp_path: Path, tiny_buffers: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = example(DOCS / "how-to" / "your-own-policy.md", "policy")
    (tmp_path / "retrace.py").write_text(code, encoding="utf-8")
    monkeypatch.setenv(worlds.BUFFER_SET, str(tiny_buffers))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "retrace", raising=False)
    families, conditions = ("MoveCube",), ("no-history", "k0")
    policy = "python:retrace:make"
    result = evaluate_world(
        tmp_path / "run", policy=policy, families=families, conditions=conditions
    )
    # The world asks for the lesson's pose 3: the fourth action of the first chunk.
    assert [(row.condition, row.status, row.steps) for row in result.rows] == [
        ("no-history", "fail", worlds.STEPS),
        ("k0", "success", 4),
    ]


def test_the_example_of_a_batch_acts_as_the_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = DOCS / "how-to" / "your-own-policy.md"
    for name, module in (("policy", "retrace"), ("batch", "retrace_batch")):
        (tmp_path / f"{module}.py").write_text(example(page, name), encoding="utf-8")
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    policy: Any = make_policy("python:retrace_batch:make")
    seen = [Observation({}, np.full(8, number, np.float32)) for number in (0.0, 1.0)]
    sessions = [policy.session() for _ in seen]
    for session, number in zip(sessions, (2.0, 3.0), strict=True):
        session.reset(RolloutInfo("go", 1, 0))
        session.add_history({}, np.full((1, 8), number, np.float32), 1)
    for numbers in ((2.0, 3.0), (0.0, 1.0)):  # the history, then the current pose
        chunks = policy.act_batch(sessions, seen, ["go", "go"])
        assert [chunk[0, 0] for chunk in chunks] == list(numbers)


@pytest.mark.slow
def test_the_example_of_recordings_becomes_buffers(
    tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = DOCS / "how-to" / "your-own-recordings.md"
    monkeypatch.chdir(tmp_path)
    exec(example(page, "frames"), {})
    [line] = [one for one in command_lines(page) if "k0,k1" in one and one.startswith("build ")]
    code, _, err = run(*shlex.split(line), "--workers", "1")
    assert code == 0, err
    buffer = load_buffer("OpenDrawer/test/0", "k1", buffer_set=tmp_path / "my-buffers", verify=True)
    assert [len(buffer), *(one.family for one in buffer.sessions)] == [
        72,
        "OpenDrawer",
        "StackCups",
    ]


@pytest.mark.slow
def test_another_benchmark_goes_the_whole_way(
    tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every command of the page as it stands, with the rates that its table shows.

    Those in another interpreter are left out: see test_remote.py.
    """
    page = DOCS / "how-to" / "another-benchmark.md"
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(ROOT / "examples" / "own_simulator")
    for line in [line for line in command_lines(page) if "--simulator-python" not in line]:
        code, out, err = run(*shlex.split(line), *["--workers", "1"] * line.startswith("build "))
        assert code == 0, f"{line}\n{out}\n{err}"
    rows = [
        json.loads(line)
        for name in ("oracle", "guess", "first", "last")
        for line in (tmp_path / f"runs/{name}/rollouts.jsonl").read_text().splitlines()
    ]
    assert {(row["simulator"], row["error"]) for row in rows} == {("lamp:LampSimulator", None)}
    won = Counter((row["system"], row["condition"]) for row in rows if row["success"])
    assert won["oracle", "no-history"] == 12 > won["guess", "no-history"]
    for name in ("first", "last"):
        cells = [f"{won[name, one]}/12" for one in ("no-history", "k0", "k1", "k3")]
        assert f"| {name} | {' | '.join(cells)} |" in text_of(page)
    assert (tmp_path / "scores/lamp/report.html").is_file()
    assert (tmp_path / "scores/lamp/figures/families-lamp:LampSimulator.svg").is_file()
    videos = sorted((tmp_path / "runs/last/videos").glob("*.mp4"))
    assert len(videos) == 48
    with av.open(str(videos[0])) as video:
        frame = next(video.decode(video=0)).to_ndarray(format="rgb24")
    # The ground of the only camera, below the heading and beside lesson and history; then nothing.
    assert abs(frame[24 + 40, 256 * 2 + 8].astype(int) - 200).max() < 10
    assert frame[24 + 40, 256 * 3 + 8].min() > 240


def test_python_in_pages_compiles_and_names_exist() -> None:
    for page in PAGES:
        for code in re.findall(r"```python\n(.*?)```", text_of(page), flags=re.S):
            compile(code, page.name, "exec")
            for module, names in re.findall(
                r"^from (robomme_interference_data\S*) import ([\w, ]+)$", code, flags=re.M
            ):
                for name in names.split(", "):
                    exec(f"from {module} import {name}", {})


def test_the_readme_is_short_and_names_every_light_dependency() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 120
    for requirement in project["dependencies"]:
        assert re.split("[<>=~]", requirement)[0] in text


def test_the_pages_stay_short() -> None:
    """All but the generated reference and commands. A bar or a rule of a table is no word."""
    words = [
        word
        for page in (README, TUTORIAL, *PAGES)
        for word in re.sub(r"```.*?```", "", text_of(page), flags=re.DOTALL).split()
        if re.search(r"\w", word)
    ]
    assert len(words) <= 22_000


def test_links_lead_somewhere() -> None:
    for page in [README, TUTORIAL, *PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]:
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text_of(page)):
            if "://" not in target and "/generated/" not in target and "generated/" not in target:
                assert (page.parent / target).exists(), f"{page.name}: {target}"
