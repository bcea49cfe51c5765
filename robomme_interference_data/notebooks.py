"""What buffers and buffer sets show in notebooks: a film strip, and a table.

IPython asks these functions by the names of the classes, so `data/` needs to know no pictures.
"""

import logging
from typing import TYPE_CHECKING

from .errors import MissingExtraError, counted

if TYPE_CHECKING:
    from .data.buffer import Buffer
    from .data.buffer_set import BufferSet


def register() -> None:
    """Tell IPython, if it runs, how to show buffers and buffer sets."""
    from IPython.core.getipython import get_ipython

    shell = get_ipython()
    if shell is not None and shell.display_formatter is not None:
        formatters, data = shell.display_formatter.formatters, f"{__package__}.data"
        formatters["image/png"].for_type_by_name(f"{data}.buffer", "Buffer", buffer_png)
        formatters["text/html"].for_type_by_name(f"{data}.buffer_set", "BufferSet", buffer_set_html)


def buffer_png(buffer: "Buffer") -> bytes | None:
    """Return the film strip of a buffer; without matplotlib None, and notebooks show the text."""
    from .viz.filmstrip import strip_png

    try:
        return strip_png(buffer)
    except MissingExtraError as error:
        logging.getLogger(__name__).warning("%s", error)
        return None


def buffer_set_html(buffer_set: "BufferSet") -> str:
    """Return the table of a buffer set's buffers by family."""
    from .viz.tables import Columns, Table

    columns: Columns = {"family": "text"}
    columns |= dict.fromkeys(buffer_set.conditions, "count")
    counts = buffer_set.counts()
    return Table(
        "buffers",
        f"{buffer_set.name}: {counted(len(buffer_set), 'buffer')} of "
        f"{counted(len(buffer_set.episode_ids), 'query episode')}",
        columns,
        [
            (family, *(counts[family, condition] for condition in buffer_set.conditions))
            for family in buffer_set.families
        ],
        f"Buffers by family and condition. Cameras: {', '.join(buffer_set.cameras)}.",
    ).html()
