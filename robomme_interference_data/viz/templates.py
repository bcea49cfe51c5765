"""Text from templates: the one place for jinja2."""

from collections.abc import Mapping
from importlib import resources
from typing import Any

from robomme_interference_data.errors import MissingExtraError


def load_jinja2(what: str) -> Any:
    """Return the library that fills templates in.

    Args:
        what: What is filled in, such as `the report`, for the message.
    """
    try:
        import jinja2
    except ImportError as error:
        raise MissingExtraError.needs(what, "jinja2", "score") from error
    return jinja2


def fill(
    package: str, name: str, values: Mapping[str, Any], *, what: str = "a template", **options: Any
) -> str:
    """Fill in a template that lies in `templates/` of a package; it may include others of there.

    Args:
        package: The package, such as `robomme_interference_data.cards`.
        name: File of the template.
        values: What it may name; it fails on any other name.
        what: What is filled in, for the message.
        options: Further ones of `jinja2.Environment`, such as `autoescape`, and `filters`.
    """
    jinja2 = load_jinja2(what)
    folder = resources.files(package).joinpath("templates")
    filters = options.pop("filters", {})
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda one: folder.joinpath(one).read_text(encoding="utf-8")),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        **options,
    )
    environment.filters.update(filters)
    text: str = environment.get_template(name).render(values)
    return text
