"""Specs, such as `kind:target`, with `NAME=VALUE` options, and the factories that they select.

Policies, models, encoders and simulators are named by such texts. A factory is imported on first
use, because it may import large libraries.
"""

import inspect
import json
import re
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Union, get_args, get_origin, get_type_hints

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, nearest
from robomme_interference_data.lazy import load_extra

Factory = Callable[..., Any]

OWN = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
"""`MODULE:NAME`, a class or function of the user."""

_TYPES = {
    str: "text",
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    type(None): "null",
}


@dataclass(frozen=True)
class SpecKind:
    """One kind of a registry.

    Attributes:
        form: Its syntax, for messages.
        factory: Its factory, `package.module:name`.
        target: Regular expression of the target; its named groups are arguments of the factory.
        default: The target of a spec without one.
        arguments: Further arguments of the factory.
        extra: The extra that has its libraries.
        not_in_identity: Options, and keys of metadata, that change no result.
        valid: Further check of the target.
        hint: Returns what to do about an invalid target; None if its syntax says it all.
        spelled: The one spelling of a target that has several; it may reject the target.
        on_hub: Whether the target is a folder, or a model on the Hub that `pin` pins.
    """

    form: str
    factory: str
    target: str = ""
    default: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    extra: str = ""
    not_in_identity: tuple[str, ...] = ()
    valid: Callable[[str], bool] = lambda target: True
    hint: Callable[[str], str | None] = lambda target: None
    spelled: Callable[[str], str] = lambda target: target
    on_hub: bool = False


@dataclass(frozen=True)
class Spec:
    """A parsed text: its kind, what follows the colon, and the arguments in that."""

    kind: str
    target: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict, compare=False)

    def __str__(self) -> str:
        return f"{self.kind}:{self.target}" if self.target else self.kind


class Registry[K: SpecKind]:
    """Kinds by name; messages call them `what`, such as `policy`.

    `also` is the form of texts that the caller parses itself, for messages.
    """

    def __init__(self, what: str, kinds: Mapping[str, K], also: str = ""):
        self._what, self.kinds, self._also = what, kinds, also

    def parse(self, text: str) -> Spec:
        """Parse a text: `UnknownNameError` for an unknown kind, else `InvalidOptionError`."""
        name, colon, target = text.partition(":")
        if name not in self.kinds:
            hint = nearest(name, self.kinds, more="")
            if "python" in self.kinds and OWN.fullmatch(text):
                hint = f"For a class or function of your own, write python:{text}."
            if "websocket" in self.kinds and name in ("ws", "wss"):
                hint = f"Write websocket:{target}" if name == "ws" else f"Write websocket:{text}"
            raise UnknownNameError(
                f"there is no {self._what} {text!r}; expected {self.forms}", hint
            )
        kind = self.kinds[name]
        target = target if colon else kind.default
        match = re.fullmatch(kind.target, target, re.DOTALL)
        # The comparison is true for `policy:` with nothing behind the colon.
        if match is None or bool(colon) > bool(target) or not kind.valid(target):
            raise InvalidOptionError.expected(self._what, text, kind.form, kind.hint(target))
        # All that is recorded has the one spelling, so that equal runs look equal.
        if kind.spelled(target) != target:
            return self.parse(f"{name}:{kind.spelled(target)}")
        return Spec(name, target, {**kind.arguments, **match.groupdict()})

    @property
    def forms(self) -> str:
        """The syntax of all kinds, for messages."""
        return ", ".join(filter(None, [*(kind.form for kind in self.kinds.values()), self._also]))

    def pin(self, text: str) -> str:
        """Return the full text, with the commit of a model on the Hub: a branch may move."""
        spec = self.parse(text)
        if self.kinds[spec.kind].on_hub:
            from robomme_interference_data.storage.hub import HubFiles, locate

            files = locate(spec.target, "model")
            if isinstance(files, HubFiles):
                return f"{spec.kind}:{files.location}"
        return str(spec)

    def factory(self, spec: Spec, name: str | None = None) -> Factory:
        """Import the factory of a spec, or another name of the same module."""
        kind = self.kinds[spec.kind]
        module, _, default = kind.factory.partition(":")
        return load_extra(module, name or default, f"the {self._what} {spec}", kind.extra)

    def options(
        self, text: str, options: Iterable[str], also: Iterable[str] = ()
    ) -> dict[str, Any]:
        """Return all options, defaults included; see `bind_options`."""
        spec = self.parse(text)
        what = f"{self._what} {text!r}"
        return bind_options(what, self.factory(spec), spec.arguments, options, also)

    def make(self, text: str, options: Iterable[str] = (), also: Iterable[str] = ()) -> Any:
        """Make what a text and its `NAME=VALUE` options describe; see `bind_options`."""
        spec = self.parse(text)
        return self.factory(spec)(**spec.arguments, **self.options(text, options, also))

    def identity(self, spec: Spec, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the options, or entries of metadata, that can change a result."""
        without = self.kinds[spec.kind].not_in_identity
        return {name: value for name, value in sorted(values.items()) if name not in without}


def import_factory(what: str, target: str) -> Factory:
    """Import a function or class by `module:name`; messages begin with `what`, which is made."""
    module, _, name = target.partition(":")
    if module == "__main__":
        raise InvalidOptionError(
            f"{what}: worker processes run another program, which has no such function",
            "Put the function into a module, a .py file beside the script or on PYTHONPATH, and "
            "write MODULE:FUNCTION.",
        )
    try:
        loaded = import_module(module)
    except Exception as error:
        raise InvalidOptionError(
            f"{what}: importing {module} failed: {type(error).__name__}: {error}",
            f"Install {module}, or set PYTHONPATH to the folder that contains it.",
        ) from error
    factory: Any = getattr(loaded, name, None)
    if not callable(factory):
        known = [key for key, value in vars(loaded).items() if callable(value)]
        raise UnknownNameError.among("function", name, f"module {module!r}", known)
    return factory  # type: ignore[no-any-return]


def bind_options(
    what: str,
    factory: Factory,
    given: Mapping[str, Any],
    options: Iterable[str],
    also: Iterable[str] = (),
) -> dict[str, Any]:
    """Return all options of a call of a factory, including defaults.

    A value is text where the factory declares text, else JSON (`3`, `0.5`, `true`, `null`) where it
    parses as JSON. Invalid options raise `InvalidOptionError`; its message names `what` is made,
    such as `policy 'replay:full'`, and lists options that something else takes, `also`.
    """
    signature, declared = signature_of(factory), _declared_types(factory)
    parameters = _options_of(signature, given)
    known = f"Its options: {', '.join([*parameters, *also]) or 'none'}."
    values: dict[str, Any] = {}
    for name, text in _split_options(what, options, parameters.values()).items():
        if name in given or (name not in parameters and not _takes_any(signature)):
            hint = f"{nearest(name, [*parameters, *also], more='')} {known}"
            raise InvalidOptionError(f"{what}: there is no option {name}", hint.lstrip())
        kinds = declared.get(name)
        # `checkpoint=7` is text where text is declared: only the factory knows what it is.
        value = text if kinds and str in kinds else _parse_json(text)
        if kinds and float in kinds and type(value) is int:
            value = float(value)
        if kinds and type(value) not in kinds:  # here, bool is not a number
            expected = " or ".join(_TYPES[kind] for kind in kinds)
            expected += _example(parameters.get(name))
            raise InvalidOptionError.expected(f"{what}: option {name} is", value, expected)
        values[name] = value
    for name, parameter in parameters.items():
        if parameter.default is inspect.Parameter.empty and name not in values:
            raise InvalidOptionError(f"{what}: the option {name} is missing", known)
    bound = signature.bind(**given, **values)
    bound.apply_defaults()
    arguments: dict[str, Any] = {}
    for name, value in bound.arguments.items():
        if signature.parameters[name].kind is inspect.Parameter.VAR_KEYWORD:
            arguments |= value
        elif signature.parameters[name].kind is not inspect.Parameter.VAR_POSITIONAL:
            arguments[name] = value
    return {name: value for name, value in arguments.items() if name not in given}


def signature_of(factory: Factory) -> inspect.Signature:
    """Return a factory's signature, or one that accepts any options if it has none."""
    try:
        return inspect.signature(factory)
    except ValueError:  # a builtin
        return inspect.signature(lambda **options: None)


_NAMED = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


def _options_of(
    signature: inspect.Signature, given: Mapping[str, Any]
) -> dict[str, inspect.Parameter]:
    """Return the parameters that options set, by name."""
    return {
        name: parameter
        for name, parameter in signature.parameters.items()
        if parameter.kind in _NAMED and name not in given
    }


def _takes_any(signature: inspect.Signature) -> bool:
    """Whether a factory takes options of any name."""
    kinds = [parameter.kind for parameter in signature.parameters.values()]
    return inspect.Parameter.VAR_KEYWORD in kinds


def _example(parameter: inspect.Parameter | None) -> str:
    """Return `, such as NAME=DEFAULT`; empty without a default that shows a value."""
    if parameter is None or not isinstance(parameter.default, str | int | float):
        return ""
    text = parameter.default
    if not isinstance(text, str):
        text = json.dumps(text)
    return f", such as {parameter.name}={text}"


def _split_options(
    what: str, options: Iterable[str], parameters: Iterable[inspect.Parameter]
) -> dict[str, str]:
    values: dict[str, str] = {}
    for option in options:
        name, equals, value = option.partition("=")
        if not name.isidentifier() or not equals:
            example = next(filter(None, map(_example, parameters)), ", such as device=cpu")
            raise InvalidOptionError.expected(f"{what}: option", option, f"NAME=VALUE{example}")
        if name in values:
            raise InvalidOptionError(f"{what}: option {name} is set twice", "Set it once.")
        values[name] = value
    return values


def _parse_json(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _declared_types(factory: Factory) -> dict[str, tuple[type, ...]]:
    """Return the types of the parameters that are declared with plain types."""
    try:
        hints = get_type_hints(factory.__init__ if inspect.isclass(factory) else factory)
    except (AttributeError, NameError, TypeError):  # no readable annotations
        return {}
    declared = {}
    for name, hint in hints.items():
        union = get_origin(hint) in (Union, types.UnionType)
        kinds = get_args(hint) if union else (hint,)
        if all(kind in _TYPES for kind in kinds):
            declared[name] = kinds
    return declared
