"""What README and docs show must work: examples run, and every command line is a valid one."""

import re
import runpy
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
from support.buffer_sets import GOLDEN, QUERIES
from support.chat_server import ChatServer
from support.command_lines import parse
from support.hub import push_buffer_set, running_hub
from support.tabletop import copy_tabletop

from robomme_interference_data.evaluate.run import evaluation as run_module
from robomme_interference_data.runtime.executor import Serial

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def command_lines(page: Path) -> list[str]:
    """Return the command lines in the code blocks of a page, without the command's own name."""
    # Every second part lies between fences; its first line is the language.
    blocks = page.read_text(encoding="utf-8").split("```")[1::2]
    shell = [block.partition("\n") for block in blocks]
    text = "\n".join(code for language, _, code in shell if language in ("bash", ""))
    lines = text.replace("\\\n", " ").splitlines()
    pattern = re.compile(r"robomme-interference (.*?)(?:\s+#.*)?$")
    return [match[1] for line in lines if (match := pattern.match(line.strip()))]


DEMO = runpy.run_path(str(ROOT / "scripts" / "demo.py"))
ALL = [(page.name, line) for page in PAGES for line in command_lines(page)]
ALL += [("demo.py", line) for line in DEMO["STEPS"].values()]
ALL += [("demo.py", line.removeprefix("robomme-interference ")) for line in DEMO["NEXT"]]


@pytest.mark.parametrize(("page", "line"), ALL)
def test_command_lines_are_understood(page: str, line: str) -> None:
    parse(shlex.split(line))


@pytest.mark.slow
def test_the_readmes_commands_run(
    tmp_path: Path, run: Any, hub: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a folder with the buffer set of `make demo`, on made-up recordings, without a renderer."""
    push_buffer_set(hub, GOLDEN, tmp_path / "work", "namespace/name")
    demo = copy_tabletop(tmp_path / "demo" / "tabletop")
    (tmp_path / "demo" / "buffers").symlink_to(demo)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WORLDS_DATA", "S")
    monkeypatch.setattr(run_module, "make_executor", lambda config: Serial())
    for line in command_lines(ROOT / "README.md"):
        given = line.replace("robomme-h5:recordings/", "sample")
        if line.startswith("evaluate "):
            given = re.sub(r"demo/\w+ ", "S --simulator support.worlds:World ", given)
        code, out, err = run(*shlex.split(given))
        assert code == 0, f"{line}\n{out}\n{err}"
    assert (tmp_path / "strip.png").stat().st_size > 10_000
    assert (tmp_path / "S" / "manifests" / "manifest.json").is_file()


ELSEWHERE = (
    "--policy websocket",  # a policy server
    "--simulator robomme",  # the official simulator
    "simulate ",  # a renderer
    "--source ",  # recordings, or a renderer
    "--shift ",  # a renderer
    "k31",  # more units than the golden buffer set has
    "stale-k7",  # contradicting lessons, which a renderer plays
    "retrieval_rollouts.csv",  # the released rows
    "my-units",  # recordings, of which it is made
    "transformers:",  # a model on the Hub
    "--encoder siglip",  # weights
)
"""What marks command lines of the pages that need what is not at hand: they are parsed alone."""

BEFORE = {
    "evaluate.md": ["evaluate my-buffers --policy replay --out runs/shard-1 --shard 1/8"],
    "cluster.md": ["evaluate my-buffers --policy replay --out runs/part-2 --shard 2/8"],
    "score.md": [
        f"evaluate my-buffers --policy replay:{memory} --out runs/{name}"
        for name, memory in (
            *(("window", "window"), ("framesamp", "framesamp")),
            *(("retrieval", "framesamp"), ("window-light-2", "window")),
        )
    ],
    "publish.md": ["evaluate my-buffers --policy replay --out my-run --episodes 0"],
}
"""Runs that pages speak of without making them."""


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES[1:], ids=lambda page: page.name)
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
    """On a golden buffer set, in a world without a renderer, in this process, logged in to a Hub.

    Where pages name a chat endpoint, one answers that knows one letter; prompts are the page's own.
    """
    login("my-name")
    push_buffer_set(hub, GOLDEN, tmp_path / "work", "namespace/name")
    asked = page.name == "questions.md"
    buffer_set = copy_tabletop(tmp_path / "tabletop") if asked else own_buffers
    (tmp_path / "docs").symlink_to(ROOT / "docs")  # rows that a page scores
    for name in ("my-buffers", "S"):
        (tmp_path / name).symlink_to(buffer_set)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WORLDS_DATA", str(tiny_buffers))
    monkeypatch.setattr(run_module, "make_executor", lambda config: Serial())
    for name, prompt in re.findall(
        r"```toml\n# (\S+)\n(.*?)```", page.read_text("utf-8"), flags=re.S
    ):
        (tmp_path / name).write_text(prompt)
    lines = [line for line in command_lines(page) if not any(mark in line for mark in ELSEWHERE)]
    with ChatServer(lambda seen: "A") as chat:
        for line in (*BEFORE.get(page.name, ()), *lines):
            given = re.sub(r"--episodes [0-9-]+", "--episodes 0", line)
            given = re.sub(r"openai:\S+", f"openai:{chat.url}#tiny", given)
            given = given.replace("RouteStick", "PatternLock")
            given = given.replace("VideoUnmask/", "VideoRepick/")
            if given.startswith("evaluate "):
                given += " --simulator support.worlds:World"
            if given.startswith("publish") and "--dry-run" not in given:
                given += " --yes"
            code, out, err = run(*shlex.split(given))
            assert code == 0, f"{line}\n{out}\n{err}"


@pytest.mark.parametrize("example", ["hub", "load"])
def test_the_readmes_python_examples(
    example: str, tmp_path: Path, tiny_buffers: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    found = re.search(rf"<!-- example: {example} -->\n```python\n(.*?)```", text, flags=re.S)
    assert found is not None
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "buffers").symlink_to(tiny_buffers)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    with running_hub(tmp_path / "cache", monkeypatch) as hub:
        push_buffer_set(hub, tiny_buffers, tmp_path / "work", "namespace/name")
        exec(found[1], names)
    buffer = names["buffer"]
    assert len(buffer) == 48 + 3 * 32  # type: ignore[arg-type]
    assert str(buffer.episode_id) in QUERIES  # type: ignore[attr-defined]


def test_the_readme_names_every_light_dependency() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    section = text.split("## Load a buffer")[1].split("```")[0]
    for requirement in project["dependencies"]:
        assert re.split("[<>=~]", requirement)[0] in section


def test_links_lead_somewhere() -> None:
    for page in [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name}: {target}"
