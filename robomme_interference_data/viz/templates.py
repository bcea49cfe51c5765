"""Text from templates. This is the only module that imports jinja2."""

from collections.abc import Mapping
from importlib import resources
from typing import Any

from robomme_interference_data.errors import MissingExtraError


def load_jinja2(what: str) -> Any:
    """Import jinja2; the error names `what` needs it, such as `the report`."""
    try:
        import jinja2
    except ImportError as error:
        raise MissingExtraError.needs(what, "jinja2", "score") from error
    return jinja2


def fill(
    package: str, name: str, values: Mapping[str, Any], *, what: str = "a template", **options: Any
) -> str:
    """Render the template `name` in `templates/` of a package, which may include others there.

    Names that are not in `values` are errors. `options` are those of `jinja2.Environment`, and
    `filters`.
    """
    jinja2 = load_jinja2(what)
    folder = resources.files(package).joinpath("templates")
    filters = options.pop("filters", {})
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(
            lambda name: folder.joinpath(name).read_text(encoding="utf-8")
        ),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        **options,
    )
    environment.filters.update(filters)
    text: str = environment.get_template(name).render(values)
    return text
