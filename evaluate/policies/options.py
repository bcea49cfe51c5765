"""Options of policies: read from text, and which of them can change a result."""

import inspect
import json
import types
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Union, get_args, get_origin, get_type_hints

from robomme_interference_data.errors import InvalidOptionError

__all__ = ["bind_options", "policy_identity", "read_options", "signature_of", "split_options"]

_WITHOUT_EFFECT = {
    "websocket": ("connect_s", "response_s", "attempts", "backoff_s"),
    "lerobot": ("device",),
}
"""Options that no result depends on, by the kind of policy."""

_PLACES = {"websocket": ("server",), "lerobot": ("source", "device")}
"""What policies say of themselves that tells only where they run, or lie, by their kind."""


def split_options(texts: Iterable[str]) -> dict[str, str]:
    """Read options as they are typed, `NAME=VALUE`.

    Raises:
        InvalidOptionError: A text is something else, or a name is given twice.
    """
    options: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not name.isidentifier() or not equals:
            raise InvalidOptionError(
                f"--policy-option {text} is not an option",
                "Expected NAME=VALUE, such as --policy-option device=cpu.",
            )
        if name in options:
            raise InvalidOptionError(f"--policy-option {name} is given twice", "Give it once.")
        options[name] = value
    return options


def read_options(factory: Callable[..., Any], texts: Mapping[str, str]) -> dict[str, Any]:
    """Give options that were typed the types that the policy's factory declares.

    Text stays text where that is declared. Elsewhere it is read as JSON (`3`, `0.5`, `true`,
    `null`) if it is that.
    """
    declared = _declared(factory)
    return {
        name: text if str in declared.get(name, ()) else _json(text) for name, text in texts.items()
    }


def _json(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def _is_json(value: Any) -> bool:
    try:
        json.dumps(value)
    except (TypeError, ValueError):
        return False
    return True


_WORDS = {
    str: "text",
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    type(None): "null",
}


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


def bind_options(
    text: str, factory: Callable[..., Any], fixed: Mapping[str, Any], options: Mapping[str, Any]
) -> dict[str, Any]:
    """Check that a factory takes the options; return all that it takes, defaults included.

    Args:
        text: The policy as it is written, for the error.
        factory: What makes it.
        fixed: Arguments that the policy's text gives; they are no options.
        options: Options by name.

    Raises:
        InvalidOptionError: It takes no such option, needs another, or declares another type.
    """
    signature, given = signature_of(factory), dict(options)
    for name, kinds in _declared(factory).items():
        if name not in given:
            continue
        if float in kinds and type(given[name]) is int:
            given[name] = float(given[name])
        if type(given[name]) not in kinds:  # bool is none of the numbers here
            raise InvalidOptionError(
                f"policy {text!r}: its option {name} is {given[name]!r}",
                f"Expected {' or '.join(_WORDS[kind] for kind in kinds)}.",
            )
    try:
        bound = signature.bind(**fixed, **given)
    except TypeError as error:
        names = [name for name in signature.parameters if name not in fixed]
        raise InvalidOptionError(
            f"policy {text!r}: {error}", f"Its options: {', '.join(names) or 'none'}."
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


def policy_identity(
    kind: str, text: str, options: Mapping[str, Any], said: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what of a policy can change a result, as plain values.

    Where a server listens or a checkpoint lies is no part of it, nor is the device: what a
    server says of itself, and the digest of a checkpoint's files, are.

    Args:
        kind: `PolicySpec.kind`.
        text: The policy as it is written.
        options: All options that it is made with, defaults included; those that are objects of
            the policy's own are left out.
        said: What it says of itself.
    """
    places = _PLACES.get(kind, ())
    return {
        "policy": kind if kind in _PLACES else text,
        "policy_options": {
            name: value
            for name, value in sorted(options.items())
            if name not in _WITHOUT_EFFECT.get(kind, ()) and _is_json(value)
        },
        "policy_metadata": {name: value for name, value in said.items() if name not in places},
    }
