"""Settings declared once: the fields of a frozen dataclass are also command-line options.

```python
@dataclass(frozen=True)
class Config:
    out: Path = setting(help="Folder of the run.")
    workers: int = setting(1, help="Worker processes.")
```

`cli.options.with_settings` gives a command the options `--out` and `--workers`.
"""

import dataclasses
from collections.abc import Container
from typing import Any

SETTING = "setting"
"""Key of the declaration in a field's metadata."""

PYTHON_HELP = "Python of a simulator that needs its own, such as robomme."
PYTHON_SHOWN = "ROBOMME_PYTHON for robomme, NAME_PYTHON for the simulator NAME"
SIMULATOR_OPTION_HELP = "Options of the simulator, arguments of its class."


def setting(
    default: Any = dataclasses.MISSING,
    *,
    help: str,
    name: str | None = None,
    metavar: str | None = None,
    shown: str | None = None,
    whole: bool = False,
    group: str | None = None,
    rare: bool = False,
) -> Any:
    """Declare a field that is also a command-line option.

    Args:
        default: Its default value; without one, the option is required.
        help: One line of help.
        name: The option, if it is not derived from the field's name; `-` for an argument.
        metavar: Placeholder for the value in the help.
        shown: Default to show in the help instead of the value.
        whole: Whether values of a list may contain commas, which do not separate them then.
        group: Title of the help section that lists it.
        rare: Whether it has no option of its own: a command sets it with `--set NAME=VALUE`.
    """
    declared = dict(
        help=help, name=name, metavar=metavar, shown=shown, whole=whole, group=group, rare=rare
    )
    return dataclasses.field(default=default, metadata={SETTING: declared})


def changed_settings(config: Any, without: Container[str] = ()) -> list[str]:
    """Return the names of settings that differ from their defaults, in order.

    Args:
        config: Settings; those without a default count as changed.
        without: Names to leave out.
    """
    return [
        field.name
        for field in dataclasses.fields(config)
        if field.name not in without
        if getattr(config, field.name) != field.default
    ]
