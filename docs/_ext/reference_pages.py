"""Writes the reference pages from the code's own declarations, before Sphinx reads the sources.

The command line comes from its parser, tables and files from their dataclasses, conditions, systems
and errors from their registries, and the Python API from `__all__` of the public modules.
"""

import inspect
import re
from collections.abc import Iterable, Iterator, Sequence
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Any, get_args, get_type_hints

OUT = Path(__file__).parent.parent / "reference" / "generated"

PUBLIC_MODULES = {
    "robomme_interference_data": "Load buffers, buffer sets and datasets.",
    "robomme_interference_data.evaluate": "Evaluate policies; write a policy.",
    "robomme_interference_data.training": "Train on history buffers.",
    "robomme_interference_data.simulators": "Run a simulator; write a simulator.",
    "robomme_interference_data.errors": "Errors that this package raises.",
}
"""Modules whose `__all__` is the public API, and what each is for."""

ROWS = {
    "Buffers: `manifests/buffers.parquet`": "schema.manifest:BufferManifest",
    "Sessions of a buffer": "schema.manifest:SessionEntry",
    "Header of the manifests: `manifests/manifest.json`": "schema.manifest:ManifestHeader",
    "Datasets in that header": "schema.manifest:ManifestDataset",
    "Files of a copy: `manifests/fetched.json`": "schema.manifest:FetchRecord",
    "Episodes: `meta/interference.parquet` of a dataset": "schema.records:EpisodeRecord",
    "Evidence spans of an episode": "schema.records:EvidenceSpan",
    "Content of a day": "schema.records:Day",
    "Spans of a day": "schema.records:DaySpan",
    "Queries of a day": "schema.records:DayQuery",
    "Identity of a dataset: `meta/interference.json`": "schema.records:DatasetIdentity",
    "Reference plan, such as `official.json`": "schema.reference_plan:ReferencePlan",
    "Episodes of a reference plan": "schema.reference_plan:ReferenceEpisode",
    "Queries of a reference plan": "schema.reference_plan:ReferenceQuery",
    "Rollouts: `rollouts.jsonl`, `.csv`, `.parquet`": "evaluate.run.row:Rollout",
    "Questions: `questions.parquet`": "data.questions:Question",
}
"""Titles of tables and files to the dataclass that declares them."""


def command_pages() -> Iterator[str]:
    """Yield the Markdown of each command: usage, what it does, options by group, examples."""
    from typer.main import get_command

    from robomme_interference_data.cli.main import app

    yield "# Command line\n"
    yield (
        "Every command prints this page's text with `--help`. `--json` writes machine-readable "
        "output to standard output; messages go to standard error, and an error is the last line "
        "there: a JSON object with `type`, `message`, `hint` and `command`.\n"
    )
    yield from _commands("robomme-interference", get_command(app), level=2)


def _commands(name: str, command: Any, level: int) -> Iterator[str]:
    inner = getattr(command, "commands", None)
    if inner is not None:
        for word, child in inner.items():
            yield from _commands(f"{name} {word}", child, level)
        return
    arguments = [one for one in command.params if not one.opts[0].startswith("-")]
    options = [one for one in command.params if one.opts[0].startswith("-")]
    usage = " ".join([name, *(_argument(one) for one in arguments), "[OPTIONS]"])
    prose, _, examples = (command.help or "").partition("\nExample")
    yield f"{'#' * level} `{name.removeprefix('robomme-interference ')}`\n"
    yield f"```text\n{usage}\n```\n"
    yield _paragraphs(prose)
    groups: dict[str, list[Any]] = {}
    for one in [*arguments, *options]:
        kind = "Arguments" if one in arguments else "Options"
        groups.setdefault(getattr(one, "rich_help_panel", None) or kind, []).append(one)
    for title, members in groups.items():
        rows = [(_names(one), _cell(one.help), _default(one)) for one in members]
        yield table((title, "meaning", "default"), rows)
    if blocks := re.findall(r"```\n(.*?)```", examples, flags=re.S):
        yield "\n".join(f"```bash\n{inspect.cleandoc(block)}\n```" for block in blocks) + "\n"


def _argument(parameter: Any) -> str:
    name = (parameter.metavar or parameter.name.upper()).strip("{}")
    return name if parameter.required else f"[{name}]"


def _names(parameter: Any) -> str:
    if not parameter.opts[0].startswith("-"):
        return f"`{_argument(parameter)}`"
    names = [*parameter.opts, *parameter.secondary_opts]
    value = "" if parameter.is_flag else f" {parameter.metavar or _type(parameter)}"
    return ", ".join(f"`{_cell(name + value)}`" for name in names)


def _type(parameter: Any) -> str:
    kind = parameter.type_descriptor.annotation
    kind = next(iter(get_args(kind)), kind)
    if issubclass(kind, Enum):
        return " or ".join(one.value for one in kind)
    return {int: "N", float: "X", str: "TEXT"}.get(kind, "PATH")


def _default(parameter: Any) -> str:
    shown = parameter.show_default
    if isinstance(shown, str):
        return shown
    if parameter.required:
        return "required"
    if shown is False or parameter.default in (None, (), []):
        return ""
    value = getattr(parameter.default, "value", parameter.default)
    if isinstance(value, list | tuple):
        value = ",".join(map(str, value))
    return f"`{value}`" if not isinstance(value, bool) else ("on" if value else "off")


def format_pages() -> Iterator[str]:
    """Yield the columns of every table, and the fields of every JSON file, with their meaning."""
    from robomme_interference_data.schema.codec import descriptions

    yield "# Columns and fields\n"
    yield (
        "Each table and JSON file is declared once, as a dataclass, from which readers, writers "
        "and this page follow. [File layout](../file-layout.md) shows where the files are.\n"
    )
    for title, where in ROWS.items():
        record = _load(where)
        hints = get_type_hints(record)
        rows = [
            (f"`{name}`", _kind(hints.get(name, int if name == "index" else str)), _cell(text))
            for name, text in descriptions(record).items()
        ]
        yield f"## {title}\n"
        yield table(("name", "type", "meaning"), rows)


def _kind(hint: Any) -> str:
    text = hint.__name__ if isinstance(hint, type) and not get_args(hint) else str(hint)
    return f"`{re.sub(r'[a-z_]+[.]', '', text).replace('|', 'or')}`"


def condition_pages() -> Iterator[str]:
    """Yield the table of all kinds of conditions."""
    from robomme_interference_data.evaluate.score.tables.contrast import COMPARISONS
    from robomme_interference_data.schema.conditions import KINDS

    yield "# Conditions\n"
    yield (
        "A condition names the history that a policy gets before a query episode. `no-history` "
        "and `k0`, `k1`, `k3`, `k7` are the paper's; the others are additions of this project. "
        "`<n>` is the number of distractor units, 0 to 63, of a day that of tasks. Units are "
        "nested in `n`, and the same in every row but `same-k<n>`. The table `effects` of a "
        "score compares a condition with that of the last column, with as many units.\n"
    )
    rows = []
    for kind in KINDS.values():
        needs = ", ".join(f"`{need}`" for need in kind.needs)
        compared = COMPARISONS.get(kind.name)
        against = f"`{KINDS[compared.reference].pattern}`" if compared else ""
        rows.append((f"`{kind.pattern}`", kind.holds, kind.asks, needs, against))
    titles = ("condition", "sessions, in order", "question", "further datasets", "compared with")
    yield table(titles, rows)


def system_pages() -> Iterator[str]:
    """Yield the table of all systems whose names are reserved."""
    from robomme_interference_data.evaluate.systems import PAPER_SYSTEMS, SYSTEMS

    yield "# Systems\n"
    yield (
        "A system is the label under which results are reported: a policy together with its "
        "memory. These names are reserved; any other name of letters, digits, `.`, `_` and `-` "
        "is free for your own. Names of the paper are for policy servers and `python:` policies; "
        "the others are built-in controls and may not be used for anything else.\n"
    )
    paper = {one.name for one in PAPER_SYSTEMS}
    rows = [
        (
            f"`{one.name}`",
            one.display,
            one.representation,
            "paper" if one.name in paper else "control",
        )
        for one in SYSTEMS.values()
    ]
    yield table(("name", "in tables", "memory", "source"), rows)


def api_pages() -> Iterator[str]:
    """Yield the public API: what each public module exports, with its docstring."""
    yield "# Python API\n"
    yield (
        "Names on this page are public. Everything else is internal and may change. Types and "
        "shapes are those of NumPy; ranges exclude their end unless stated otherwise.\n"
    )
    for name, purpose in PUBLIC_MODULES.items():
        module = import_module(name)
        yield f"## `{name}`\n\n{purpose}\n"
        for exported in _exported(module):
            value = getattr(module, exported)
            yield f"### `{exported}`\n"
            if not callable(value) or not hasattr(value, "__module__"):
                continue  # a plain value or an alias of a type, which its uses explain
            is_class = inspect.isclass(value)
            options = "\n   :members:" * is_class + "\n   :noindex:"
            kind = "autoclass" if is_class else "autofunction"
            directive = f".. {kind}:: {value.__module__}.{value.__qualname__}{options}"
            yield f"```{{eval-rst}}\n{directive}\n```\n"


def _exported(module: Any) -> Sequence[str]:
    if module.__name__.endswith(".errors"):
        base = module.InterferenceError
        classes = inspect.getmembers(module, inspect.isclass)
        return [name for name, one in classes if issubclass(one, base)]
    return list(module.__all__)


def error_pages() -> Iterator[str]:
    """Yield the table of all errors: when each is raised, and what else it can be caught as."""
    from robomme_interference_data import errors

    yield "# Errors\n"
    yield (
        "Every error that this package raises on purpose is an `InterferenceError` and also a "
        "built-in exception. The message states what was given and what was expected; `hint` "
        "states what to do; the command line also prints the command to run next.\n"
    )
    rows = []
    for name in _exported(errors):
        error = getattr(errors, name)
        builtin = next(one for one in error.__mro__ if one.__module__ == "builtins")
        when, _, fix = inspect.getdoc(error).partition("\n\nFix: ")
        fix = fix.partition("\n\n")[0]
        rows.append(
            (f"`{name}`", f"`{builtin.__name__}`", _cell(when.partition("\n\n")[0]), _cell(fix))
        )
    yield table(("error", "also a", "raised for", "what to do"), rows)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; columns that are empty in all rows are left out."""
    cells = [[*map(str, row)] for row in rows]
    used = [n for n in range(len(head)) if any(row[n] for row in cells)]
    lines = [
        [head[n] for n in used],
        ["---"] * len(used),
        *([row[n] for n in used] for row in cells),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _cell(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", "\\|")


def _paragraphs(text: str) -> str:
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n") if part.strip()) + "\n"


def _load(where: str) -> Any:
    module, _, name = where.partition(":")
    return getattr(import_module(f"robomme_interference_data.{module}"), name)


PAGES = {
    "commands": command_pages,
    "columns": format_pages,
    "conditions": condition_pages,
    "systems": system_pages,
    "api": api_pages,
    "errors": error_pages,
}


def write(out: Path = OUT) -> None:
    """Write all pages."""
    out.mkdir(parents=True, exist_ok=True)
    for name, page in PAGES.items():
        text, path = "\n".join(page()), out / f"{name}.md"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


_FENCE = re.compile(r"^(\s*)```(\w*)$")


def _as_rst(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Turn the fenced code of a docstring into reStructuredText's code blocks."""
    inside, result = False, []
    for line in lines:
        match = _FENCE.match(line)
        if match:
            inside = not inside
            result += [f"{match[1]}.. code-block:: {match[2] or 'text'}", ""] if inside else [""]
        else:
            result.append(f"   {line}" if inside and line else line)
    lines[:] = result


def setup(app: Any) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("builder-inited", lambda app: write())
    app.connect("autodoc-process-docstring", _as_rst, priority=100)
    return {"parallel_read_safe": True}
