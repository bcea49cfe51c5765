"""Pages of the documentation as scripts: their code blocks, in order, step by step."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PROGRAM = "robomme-interference"


@dataclass(frozen=True)
class Step:
    """One step of a page.

    Attributes:
        kind: `command` of this package, `other` program, `python`, or `file` to be saved.
        text: The command line without the program's name, the code, or the file's content.
        name: Of a file, its name; of a command, the folder that the page puts on PYTHONPATH.
    """

    kind: str
    text: str
    name: str = ""


def steps_of(text: str) -> Iterator[Step]:
    """Yield the steps of a page, given its Markdown."""
    for language, code in re.findall(r"^```(\w+)\n(.*?)^```", text, flags=re.S | re.M):
        if language == "python":
            saved = re.match(r'"""(\w+\.py)"""', code)
            yield Step("file", code, saved[1]) if saved else Step("python", code)
        elif language in ("bash", "text"):
            for line in re.sub(r" *\\\n *", " ", code).splitlines():
                yield from _command(line.strip())


def _command(line: str) -> Iterator[Step]:
    line = re.sub(r"\s+# .*$", "", line)
    match = re.fullmatch(rf"(?:PYTHONPATH=(\S+) )?{PROGRAM} (.*)", line)
    if match:
        yield Step("command", match[2], match[1] or "")
    elif line and not line.startswith("#"):
        yield Step("other", line)


def folder_on_path(step: Step, root: Path) -> Path | None:
    """Return the folder that a command's page puts on PYTHONPATH; those of examples are ours."""
    if not step.name:
        return None
    return root / step.name if step.name.startswith("examples") else Path(step.name).absolute()


def words_of(step: Step) -> list[str]:
    """Return the words of a command, with what a test adds so that it asks nothing."""
    words = shlex.split(step.text)
    if words[0] == "build" and not {"manifests", "questions"} & {*words}:
        words += ["--workers", "1"]
    if words[0].startswith("publish") and not {"--dry-run", "--to"} & {*words}:
        words.append("--yes")
    return words
