"""What README and docs show must work: examples run, and every command line is a valid one."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import factories
import pytest
import rollout_doubles
import typer

from robomme_interference_data.build_dataset.sample import write_sample
from robomme_interference_data.cli import app, spread

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMAND = Path(sys.executable).parent / "robomme-interference"


def command_lines(page: Path) -> list[str]:
    """Return the command lines in the code blocks of a page, without the command's own name."""
    # Every second part lies between fences; its first line is the language.
    blocks = page.read_text(encoding="utf-8").split("```")[1::2]
    shell = [block.partition("\n") for block in blocks]
    text = "\n".join(code for language, _, code in shell if language in ("bash", ""))
    lines = text.replace("\\\n", " ").splitlines()
    pattern = re.compile(r"robomme-interference (.*?)(?:\s+#.*)?$")
    return [match[1] for line in lines if (match := pattern.match(line.strip()))]


ALL = [(page.name, line) for page in PAGES for line in command_lines(page)]


def test_there_are_commands_to_check() -> None:
    assert {name for name, _ in ALL} >= {"README.md", "sources.md", "simulators.md"}
    assert len([name for name, _ in ALL if name == "README.md"]) == 7


@pytest.mark.parametrize(("page", "line"), ALL)
def test_command_lines_are_understood(page: str, line: str) -> None:
    words = spread(shlex.split(line))
    command = typer.main.get_command(app)
    context = command.make_context("robomme-interference", list(words))
    name, found, rest = command.resolve_command(context, words)  # type: ignore[attr-defined]
    while hasattr(found, "resolve_command"):
        context = found.make_context(name, list(rest), parent=context)
        name, found, rest = found.resolve_command(context, rest)
    found.make_context(name, list(rest), parent=context)  # raises if an option is unknown


def test_the_readmes_commands_run(tmp_path: Path) -> None:
    # RoboMME's recordings are not at hand everywhere: made-up ones take their place.
    sample = tmp_path / "recordings"
    families = factories.FAMILIES
    for _ in write_sample(sample, families=families, train=3, test=1, size=64, demonstration=20):
        pass
    for line in command_lines(ROOT / "README.md"):
        given = line.replace("robomme-h5:recordings/", f"frames:{sample}")
        # `make demo` runs it on the embedded simulator.
        given = given.replace("demo/tabletop", "S --simulator rollout_doubles:World")
        done = subprocess.run(
            [str(COMMAND), *shlex.split(given)],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT / "tests"), rollout_doubles.SPLIT: "S"},
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
        )
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    assert (tmp_path / "strip.png").stat().st_size > 10_000
    assert (tmp_path / "S" / "manifests" / "manifest.json").is_file()


def test_the_readmes_python_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    found = re.search(r"<!-- example: load -->\n```python\n(.*?)```", text, flags=re.S)
    assert found is not None
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "split").symlink_to(factories.split())
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(found[1], names)
    buffer = names["buffer"]
    assert len(buffer) == 20 + 3 * 32  # type: ignore[arg-type]
    assert str(buffer.episode_id) == "VideoRepick/test/0"  # type: ignore[attr-defined]


def test_links_lead_somewhere() -> None:
    for page in [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name}: {target}"
