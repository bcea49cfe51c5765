"""Options and arguments that commands share, and options from dataclasses of settings.

A list is an option that is repeated, or has values separated by commas.
"""

import dataclasses
import inspect
from collections import Counter
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from robomme_interference_data.errors import InvalidOptionError, named, naming_options, option_names
from robomme_interference_data.runtime.specs import bind_options
from robomme_interference_data.schema.settings import SETTING


def split_commas(values: Sequence[str] | None) -> list[str] | None:
    """Return the values of a list option.

    Raises:
        typer.BadParameter: One is empty: `--conditions ""` is a mistake, such as an unset variable;
            or one is given twice.
    """
    if values is None:
        return None
    parts = [part.strip() for text in values for part in text.split(",")]
    if not all(parts):
        given = ",".join(values)
        raise typer.BadParameter(
            f"{given!r} has an empty name. Leave out the option for its default."
        )
    for part, times in Counter(parts).items():
        if times > 1:
            raise typer.BadParameter(f"{part!r} is given {times} times. Give it once.")
    return parts


_LIST: dict[str, Any] = {"callback": split_commas, "metavar": "NAME,…"}

AsJson = Annotated[bool, typer.Option("--json", help="Write JSON to standard output.")]
Yes = Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")]
BufferSetFolder = Annotated[
    str, typer.Argument(metavar="BUFFER_SET", help="Folder of the buffer set, or NAMESPACE/NAME.")
]
EpisodeName = Annotated[str, typer.Argument(help="Episode id, such as VideoRepick/test/7.")]
ConditionName = Annotated[str, typer.Argument(help="Condition, such as k3.")]
Families = Annotated[list[str], typer.Option(help="Families.", show_default="all", **_LIST)]
Conditions = Annotated[
    list[str], typer.Option(help="Conditions, such as k3.", show_default="all", **_LIST)
]
Picture = Annotated[Path | None, typer.Option(help="Image to write, .png or .svg.")]


def with_settings[**P, R](function: Callable[P, R]) -> Callable[..., R]:
    """Replace a command's parameters that are dataclasses of settings by their options.

    A tuple becomes a list option, a bool a flag. Settings that are rarely used share `--set`.
    """
    signature = inspect.signature(function, eval_str=True)
    parameters: list[inspect.Parameter] = []
    configs: dict[str, tuple[type, list[str]]] = {}
    rare: dict[str, type] = {}
    for parameter in signature.parameters.values():
        kind = parameter.annotation
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            options = _options(kind)
            configs[parameter.name] = kind, [option.name for option in options]
            parameters += options
            if (further := _rare_settings(kind)) is not None:
                rare[parameter.name] = further
                parameters.append(_set_option(further))
        else:
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
    parameters.sort(key=lambda parameter: parameter.default is not inspect.Parameter.empty)

    @wraps(function)
    def command(**values: Any) -> R:
        texts, settings = values.pop(_SET, []), {}
        for name, (config, fields) in configs.items():
            given = {field: _as_tuple(values.pop(field)) for field in fields}
            if name in rare:
                _check_rare(texts, config)
                given |= bind_options(f"--{_SET}", rare[name], {}, texts)
            settings[name] = config(**given)
        rare_names = {
            field.name: f"--{_SET} {field.name}"
            for further in rare.values()
            for field in dataclasses.fields(further)  # type: ignore[arg-type]
        }
        with naming_options({**option_names(), **rare_names}):
            return function(**settings, **values)  # type: ignore[call-arg]

    command.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


_SET = "set"


def _rare_settings(config: Any) -> type | None:
    """Return a dataclass of the settings without an option of their own; None without any."""
    hints = get_type_hints(config)
    fields: list[Any] = [
        (
            field.name,
            hints[field.name],
            dataclasses.field(default=field.default, metadata=field.metadata),
        )
        for field in dataclasses.fields(config)
        if SETTING in field.metadata and field.metadata[SETTING]["rare"]
    ]
    return dataclasses.make_dataclass("Rare", fields) if fields else None


def _check_rare(texts: Sequence[str], config: Any) -> None:
    """Reject a setting that has an option of its own: it would be set twice."""
    own = {option.name for option in _options(config)}
    for name in (text.partition("=")[0] for text in texts):
        if name in own:
            raise InvalidOptionError(
                f"--{_SET} {name}: this setting has an option of its own",
                f"Set {named(name)} instead.",
            )


def _set_option(rare: Any) -> inspect.Parameter:
    settings = [
        f"{field.name}: {field.metadata[SETTING]['help']}" for field in dataclasses.fields(rare)
    ]
    option: Any = typer.Option(
        f"--{_SET}",
        metavar="NAME=VALUE",
        help=f"Rarely used settings. {' '.join(settings)}",
        show_default=False,
    )
    annotation = Annotated[list[str], option]
    return inspect.Parameter(
        _SET, inspect.Parameter.KEYWORD_ONLY, default=[], annotation=annotation
    )


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _options(config: Any) -> list[inspect.Parameter]:
    """Return a parameter for each setting of a dataclass, keyword-only fields last."""
    hints = get_type_hints(config)
    fields = [
        field
        for field in dataclasses.fields(config)
        if SETTING in field.metadata and not field.metadata[SETTING]["rare"]
    ]
    fields.sort(key=lambda field: field.kw_only is True)
    return [_option(field, hints[field.name]) for field in fields]


def _option(field: dataclasses.Field[Any], kind: Any) -> inspect.Parameter:
    declared, default = field.metadata[SETTING], field.default
    attributes = {
        "help": declared["help"],
        "metavar": declared["metavar"],
        "rich_help_panel": declared["group"],
    }
    plain = _without_none(kind)
    if get_origin(plain) is tuple:
        listed: Any = list.__class_getitem__(get_args(plain)[0])
        kind = listed if plain is kind else listed | None
        if not declared["whole"]:
            attributes |= _LIST | {"metavar": attributes["metavar"] or _LIST["metavar"]}
    if declared["shown"] is not None:
        attributes["show_default"] = declared["shown"]
    elif default in (None, ()):
        attributes["show_default"] = False
    name = declared["name"] or "--" + field.name.replace("_", "-")
    option: Any = typer.Argument(**attributes) if name == "-" else typer.Option(name, **attributes)
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
