"""Settings declared once: the fields of a frozen dataclass are the Python API and the options.

```python
@dataclass(frozen=True)
class Config:
    out: Path = setting(help="Folder of the run.")
    workers: int = setting(1, help="Worker processes.")
```

`cli.options.with_settings` gives a command the options `--out` and `--workers` of it.
"""

import dataclasses
from typing import Any

SETTING = "setting"
"""Key of a declaration in the metadata of its field."""


def setting(
    default: Any = dataclasses.MISSING,
    *,
    help: str,
    name: str | None = None,
    metavar: str | None = None,
    env: str | None = None,
    shown: str | None = None,
    whole: bool = False,
    group: str | None = None,
) -> Any:
    """Declare a field that is also an option.

    Args:
        default: Its value if it is not given; without one, the option is required.
        help: Its help, in a line.
        name: Its option, where that is not the field's name; `-` stands for an argument.
        metavar: Placeholder for its value in the help.
        env: Environment variable that can give it.
        shown: What the help shows as its default, where that says more than the value.
        whole: Values of a list may contain commas, which do not separate them.
        group: Title under which the help lists it; by default among the plain options.
    """
    declared = {
        "help": help,
        "name": name,
        "metavar": metavar,
        "env": env,
        "shown": shown,
        "whole": whole,
        "group": group,
    }
    return dataclasses.field(default=default, metadata={SETTING: declared})
