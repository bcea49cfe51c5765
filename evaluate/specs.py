"""Options of policies and models: typed as `NAME=VALUE`, checked against what these take."""

import inspect
import json
import types
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Union, get_args, get_origin, get_type_hints

from robomme_interference_data.errors import InvalidOptionError

_WORDS = {
    str: "text",
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    type(None): "null",
}


def _split(what: str, texts: Iterable[str]) -> dict[str, str]:
    options: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not name.isidentifier() or not equals:
            raise InvalidOptionError.expected(
                f"--{what}-option", text, "NAME=VALUE, such as device=cpu"
            )
        if name in options:
            raise InvalidOptionError(f"--{what}-option {name} is given twice", "Give it once.")
        options[name] = value
    return options


def bind_options(
    text: str,
    factory: Callable[..., Any],
    fixed: Mapping[str, Any],
    texts: Iterable[str],
    what: str = "policy",
    also: Iterable[str] = (),
) -> dict[str, Any]:
    """Return all options that a factory is called with, defaults included.

    Text stays text where the factory declares it. Elsewhere it is read as JSON (`3`, `0.5`,
    `true`, `null`) if it is that.

    Args:
        text: The policy or model as it is written, for the error.
        factory: What makes it.
        fixed: Arguments that the text gives; they are no options.
        texts: Options as they are typed, `NAME=VALUE`.
        what: What has options: `--policy-option`.
        also: Options that something else takes from the same place, for the error.

    Raises:
        InvalidOptionError: A text is something else, a name comes twice, or the factory takes no
            such option, needs another, or declares another type.
    """
    signature, declared = signature_of(factory), _declared(factory)
    given: dict[str, Any] = {}
    for name, typed in _split(what, texts).items():
        kinds = declared.get(name)
        value = typed if kinds and str in kinds else _read(typed)
        if kinds and float in kinds and type(value) is int:
            value = float(value)
        if kinds and type(value) not in kinds:  # bool is none of the numbers here
            raise InvalidOptionError.expected(
                f"{what} {text!r}: its option {name} is",
                value,
                " or ".join(_WORDS[kind] for kind in kinds),
            )
        given[name] = value
    try:
        bound = signature.bind(**fixed, **given)
    except TypeError as error:
        names = [*(name for name in signature.parameters if name not in fixed), *also]
        raise InvalidOptionError(
            f"{what} {text!r}: {error}", f"Its options: {', '.join(names) or 'none'}."
        ) from error
    bound.apply_defaults()
    taken: dict[str, Any] = {}
    for name, value in bound.arguments.items():
        if signature.parameters[name].kind is inspect.Parameter.VAR_KEYWORD:
            taken |= value
        elif signature.parameters[name].kind is not inspect.Parameter.VAR_POSITIONAL:
            taken[name] = value
    return {name: value for name, value in taken.items() if name not in fixed}


def signature_of(factory: Callable[..., Any]) -> inspect.Signature:
    """Return a factory's parameters; of one that does not tell, that it takes any by name."""
    try:
        return inspect.signature(factory)
    except ValueError:  # something built in
        return inspect.signature(lambda **options: None)


def _read(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _declared(factory: Callable[..., Any]) -> dict[str, tuple[type, ...]]:
    """Return the types of the parameters that are declared as plain values."""
    try:
        hints = get_type_hints(factory.__init__ if inspect.isclass(factory) else factory)
    except (AttributeError, NameError, TypeError):  # nothing can be known of it
        return {}
    declared = {}
    for name, hint in hints.items():
        union = get_origin(hint) in (Union, types.UnionType)
        kinds = get_args(hint) if union else (hint,)
        if all(kind in _WORDS for kind in kinds):
            declared[name] = kinds
    return declared
