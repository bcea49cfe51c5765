"""Settings declared once: the fields of a frozen dataclass are the Python API and the options.

```python
@dataclass(frozen=True)
class Config:
    out: Path = setting(help="Folder of the run.")
    workers: int = setting(1, help="Worker processes.")

@app.command()
@with_settings
def evaluate(config: Config, as_json: AsJson = False) -> None: ...
```

gives the command the options `--out` and `--workers`. A tuple is an option that takes several
values, with spaces or, unless they are whole, commas between them; a truth value is a flag.
"""

import dataclasses
import inspect
from collections.abc import Callable, Sequence
from functools import wraps
from types import NoneType, UnionType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

_SETTING = "setting"


def setting(
    default: Any = dataclasses.MISSING,
    *,
    help: str,
    name: str | None = None,
    metavar: str | None = None,
    env: str | None = None,
    shown: str | None = None,
    whole: bool = False,
) -> Any:
    """Declare a field that is also an option.

    Args:
        default: Its value if it is not given; without, it has to be.
        help: What it says, in a line.
        name: Its option, where that is not the field's name; `-` stands for an argument.
        metavar: What its value is called.
        env: Environment variable that can give it.
        shown: What is shown as its default, where that says more than the value.
        whole: Values may hold commas, which do not part them.
    """
    told = {
        "help": help,
        "name": name,
        "metavar": metavar,
        "env": env,
        "shown": shown,
        "whole": whole,
    }
    return dataclasses.field(default=default, metadata={_SETTING: told})


def with_settings[**P, R](function: Callable[P, R]) -> Callable[..., R]:
    """Give a command the options of the dataclass that one of its parameters is."""
    signature = inspect.signature(function, eval_str=True)
    parameters: list[inspect.Parameter] = []
    configs: dict[str, tuple[type, dict[str, bool]]] = {}
    for parameter in signature.parameters.values():
        kind = parameter.annotation
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            configs[parameter.name] = kind, {one[0]: one[2]["whole"] for one in _declared(kind)}
            parameters += _options(kind)
        else:
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
    parameters.sort(key=lambda one: one.default is not inspect.Parameter.empty)

    @wraps(function)
    def command(**given: Any) -> R:
        built = {
            name: config(**{one: _value(given.pop(one), whole) for one, whole in fields.items()})
            for name, (config, fields) in configs.items()
        }
        return function(**built, **given)  # type: ignore[call-arg]

    command.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {one.name: one.annotation for one in parameters}
    return command


def spread_values(arguments: Sequence[str], several: Sequence[str]) -> list[str]:
    """Repeat an option before each of its values: click's options take one value each.

    Args:
        arguments: The command line, such as `--families A B`.
        several: Options that take several values, such as `--families`.

    Returns:
        The command line as click reads it: `--families A --families B`.
    """
    spread: list[str] = []
    option: str | None = None
    for argument in arguments:
        name, equals, _ = argument.partition("=")
        if argument.startswith("--"):
            option = name if name in several else None
        elif option is not None and spread[-1] != option:
            spread.append(option)
        spread += argument.split("=", 1) if option == name and equals else [argument]
    return spread


def _declared(config: Any) -> list[tuple[str, Any, dict[str, Any], Any]]:
    """Return name, type, what was told, and default of each setting, keyword-only ones last."""
    hints = get_type_hints(config)
    return [
        (field.name, hints[field.name], field.metadata[_SETTING], field.default)
        for field in sorted(dataclasses.fields(config), key=lambda field: field.kw_only is True)
        if _SETTING in field.metadata
    ]


def _options(config: type) -> list[inspect.Parameter]:
    import typer

    found = []
    for name, hint, told, default in _declared(config):
        plain = _without_none(hint)
        if get_origin(plain) is tuple:
            listed: Any = list.__class_getitem__(get_args(plain)[0])
            kind: Any = listed if plain is hint else listed | None
            metavar = told["metavar"] or "NAME…"
        else:
            kind, metavar = hint, told["metavar"]
        about: dict[str, Any] = {"help": told["help"], "metavar": metavar, "envvar": told["env"]}
        if told["shown"] is not None:
            about["show_default"] = told["shown"]
        elif default in (None, ()):
            about["show_default"] = False
        option = told["name"] or "--" + name.replace("_", "-")
        declared: Any = typer.Argument(**about) if option == "-" else typer.Option(option, **about)
        parameter = inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, annotation=Annotated[kind, declared]
        )
        if default is not dataclasses.MISSING:
            value = list(default) if isinstance(default, tuple) else default
            parameter = parameter.replace(default=value)
        found.append(parameter)
    return found


def _without_none(hint: Any) -> Any:
    if get_origin(hint) is UnionType:
        return next(part for part in get_args(hint) if part is not NoneType)
    return hint


def _value(given: Any, whole: bool) -> Any:
    if not isinstance(given, list):
        return given
    if whole:
        return tuple(given)
    return tuple(part for text in given for part in text.split(",") if part)
