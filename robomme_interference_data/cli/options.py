"""Options and arguments of commands: those that several have, and those that settings declare.

A list is an option that is repeated, or whose values are separated by commas.
"""

import dataclasses
import inspect
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from robomme_interference_data.schema.settings import SETTING


def split_commas(values: Sequence[str] | None) -> list[str] | None:
    """Return the values of a list, which were repeated or separated by commas."""
    if values is None:
        return None
    return [part for text in values for part in text.split(",") if part]


_LIST: dict[str, Any] = {"callback": split_commas, "metavar": "NAME,…"}

AsJson = Annotated[bool, typer.Option("--json", help="Write JSON to standard output.")]
BufferSetFolder = Annotated[
    Path, typer.Argument(metavar="BUFFER_SET", help="Folder of the buffer set.")
]
QueryName = Annotated[str, typer.Argument(help="Episode id, such as VideoRepick/test/7.")]
ConditionName = Annotated[str, typer.Argument(help="Condition, such as k3.")]
Families = Annotated[list[str], typer.Option(help="Families.", show_default="all", **_LIST)]
Conditions = Annotated[
    list[str], typer.Option(help="Conditions, such as k3.", show_default="all", **_LIST)
]
Picture = Annotated[Path | None, typer.Option(help="Picture to write, .png or .svg.")]


def with_settings[**P, R](function: Callable[P, R]) -> Callable[..., R]:
    """Give a command the options of the dataclasses that its parameters are.

    ```python
    @app.command()
    @with_settings
    def evaluate(config: Config, as_json: AsJson = False) -> None: ...
    ```

    A tuple is an option that takes several values; a truth value is a flag.
    """
    signature = inspect.signature(function, eval_str=True)
    parameters: list[inspect.Parameter] = []
    configs: dict[str, tuple[type, list[str]]] = {}
    for parameter in signature.parameters.values():
        kind = parameter.annotation
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            options = _options(kind)
            configs[parameter.name] = kind, [option.name for option in options]
            parameters += options
        else:
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
    parameters.sort(key=lambda one: one.default is not inspect.Parameter.empty)

    @wraps(function)
    def command(**given: Any) -> R:
        built = {
            name: config(**{field: _as_tuple(given.pop(field)) for field in fields})
            for name, (config, fields) in configs.items()
        }
        return function(**built, **given)  # type: ignore[call-arg]

    command.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {one.name: one.annotation for one in parameters}
    return command


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _options(config: Any) -> list[inspect.Parameter]:
    """Return a parameter for each setting of a dataclass, those of its keyword-only fields last."""
    hints = get_type_hints(config)
    fields = [field for field in dataclasses.fields(config) if SETTING in field.metadata]
    fields.sort(key=lambda field: field.kw_only is True)
    return [_option(field, hints[field.name]) for field in fields]


def _option(field: dataclasses.Field[Any], kind: Any) -> inspect.Parameter:
    declared, default = field.metadata[SETTING], field.default
    about = {
        "help": declared["help"],
        "metavar": declared["metavar"],
        "envvar": declared["env"],
        "rich_help_panel": declared["group"],
    }
    plain = _without_none(kind)
    if get_origin(plain) is tuple:
        listed: Any = list.__class_getitem__(get_args(plain)[0])
        kind = listed if plain is kind else listed | None
        if not declared["whole"]:
            about |= _LIST | ({"metavar": about["metavar"]} if about["metavar"] else {})
    if declared["shown"] is not None:
        about["show_default"] = declared["shown"]
    elif default in (None, ()):
        about["show_default"] = False
    name = declared["name"] or "--" + field.name.replace("_", "-")
    option: Any = typer.Argument(**about) if name == "-" else typer.Option(name, **about)
    parameter = inspect.Parameter(
        field.name, inspect.Parameter.KEYWORD_ONLY, annotation=Annotated[kind, option]
    )
    if default is dataclasses.MISSING:
        return parameter
    return parameter.replace(default=list(default) if isinstance(default, tuple) else default)


def _without_none(hint: Any) -> Any:
    if get_origin(hint) is UnionType:
        return next(part for part in get_args(hint) if part is not NoneType)
    return hint
