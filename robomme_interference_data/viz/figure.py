"""Reproducible PNG and SVG figures, and a page whose coordinates are inches.

Only `open_figure` sets up matplotlib. On a page, the origin is the upper left corner and y points
down; font sizes and line widths are points.
"""

import warnings
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from robomme_interference_data.errors import InvalidOptionError, MissingExtraError
from robomme_interference_data.storage.files import atomic_path

INK, GRAY = "#222222", "#767676"


class Hue:
    """The color-blind-safe colors of Okabe and Ito."""

    BLUE, SKY, GREEN, YELLOW = "#0072B2", "#56B4E9", "#009E73", "#F0E442"
    ORANGE, VERMILION, PINK = "#E69F00", "#D55E00", "#CC79A7"


_DPI = 180
MAKER = "robomme-interference"
"""Recorded in each file as the program that wrote it."""

_METADATA: dict[str, dict[str, str | None]] = {
    ".png": {"Software": MAKER},
    ".svg": {"Creator": MAKER, "Date": None, "Format": None, "Type": None},
    ".pdf": {"Creator": MAKER, "Producer": None, "CreationDate": None},
}
"""Metadata written for each supported suffix, without matplotlib's version and the date."""


@contextmanager
def open_page(out: Path, width: float) -> Iterator["Page"]:
    """Yield a page of this width, in inches, and write it atomically if the block succeeds.

    The block sets the page's height. The user's matplotlib settings have no effect.
    """
    _suffix(out)  # before anything is drawn
    with open_figure() as figure:
        page = Page(figure, width)
        yield page
        figure.set_size_inches(width, page.height)
        page.axes.set(xlim=(0, width), ylim=(page.height, 0))
        save_figure(figure, out)


@contextmanager
def open_figure() -> Iterator[Any]:
    """Yield an empty white matplotlib `Figure`; the user's settings have no effect.

    Draw it, and save it with `save_figure`, inside the block.
    """
    try:
        import matplotlib.style
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError.needs("drawing", "matplotlib", "score") from error
    # Without a salt, ids in SVG files are random; composed, all its pictures would become one.
    settings: dict[str, Any] = {"svg.hashsalt": MAKER, "image.composite_image": False}
    names = ("text.color", "axes.labelcolor", "xtick.color", "ytick.color")
    settings |= dict.fromkeys(names, INK)
    settings |= {
        "svg.fonttype": "none"
    }  # small files, and text that can be searched and read aloud
    settings |= {"font.sans-serif": ["DejaVu Sans", "Verdana"]}  # recorded with each text
    with (
        matplotlib.style.context("default"),
        matplotlib.rc_context(settings),
        warnings.catch_warnings(),
    ):
        # A goal may have letters that no installed font has: boxes are drawn for them.
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
        yield Figure(facecolor="white")


def save_figure(figure: Any, out: Path) -> None:
    """Write a figure to `.png` or `.svg`, atomically, without date and version."""
    suffix = _suffix(out)
    try:
        with atomic_path(out) as partial:
            figure.savefig(partial, format=suffix[1:], dpi=_DPI, metadata=_METADATA[suffix])
    except OSError as error:
        raise InvalidOptionError(
            f"{out} cannot be written: {error.strerror or error}",
            "Check the path, its permissions and the free disk space, or choose another file.",
        ) from error


def _suffix(out: Path) -> str:
    suffix = out.suffix.lower()
    if suffix not in _METADATA:
        raise InvalidOptionError.expected(
            "picture",
            str(out),
            f"a name that ends in {' or '.join(_METADATA)}",
            f"For example: {out.with_suffix('.png') if out.name else out / 'strip.png'}",
        )
    return suffix


class Page:
    """A page made by `open_page`; set its `height`, in inches, before the block ends."""

    def __init__(self, figure: Any, width: float):
        self.figure = figure
        self.height = width
        self.axes = figure.add_axes((0, 0, 1, 1))
        self.axes.set_axis_off()

    def text_width(self, text: str, size: float, *, bold: bool = False) -> float:
        """Return the width of a line of text in inches."""
        from matplotlib.font_manager import FontProperties
        from matplotlib.textpath import text_to_path

        font = FontProperties(size=size, weight="bold" if bold else "normal")
        return text_to_path.get_text_width_height_descent(text, font, ismath=False)[0] / 72

    def wrap(self, text: str, size: float, width: float, *, most: int) -> list[str]:
        """Break a text into at most `most` lines; the last may be too long."""
        lines: list[str] = []
        for word in _printable(text).split():
            longer = f"{lines[-1]} {word}" if lines else word
            if lines and (len(lines) == most or self.text_width(longer, size) <= width):
                lines[-1] = longer
            else:
                lines.append(word)
        return lines

    def text(
        self,
        x: float,
        y: float,
        text: str,
        size: float,
        *,
        width: float | None = None,
        align: str = "center",
        bold: bool = False,
        color: str = "black",
    ) -> None:
        """Write a line below `y`; text wider than `width` shrinks by a quarter, or is cut."""
        text = _printable(text)
        if width is not None and (measured := self.text_width(text, size, bold=bold)) > width:
            # Smaller letters than that cannot be read.
            size *= max(0.75, width / measured)
            if 0.75 * measured > width:
                text = self._shortened(text, size, width, bold)
        self.axes.text(
            x,
            y,
            text,
            size=size,
            weight="bold" if bold else "normal",
            color=color,
            horizontalalignment=align,
            verticalalignment="top",
            parse_math=False,  # a goal may contain dollar signs
        )

    def _shortened(self, text: str, size: float, width: float, bold: bool) -> str:
        def keep(count: int) -> str:
            return text[: (count + 1) // 2] + "…" + text[len(text) - count // 2 :]

        fitting = bisect_right(
            range(1, len(text)), width, key=lambda n: self.text_width(keep(n), size, bold=bold)
        )
        return keep(fitting)

    def picture(
        self, image: NDArray[Any], x: float, y: float, width: float, *, line: float = 0.5
    ) -> float:
        """Draw an image, `(H, W, 3) uint8` RGB, with an outline; returns its height."""
        height = width * image.shape[0] / image.shape[1]
        extent = (x, x + width, y + height, y)
        self.axes.imshow(image, extent=extent, aspect="auto", zorder=1)
        self.box(x, y, width, height, fill="none", edge="black", line=line)
        return height

    def box(
        self, x: float, y: float, width: float, height: float, *, fill: str, edge: str, line: float
    ) -> None:
        """Draw a rectangle."""
        from matplotlib.patches import Rectangle

        self.axes.add_patch(
            Rectangle((x, y), width, height, facecolor=fill, edgecolor=edge, linewidth=line)
        )

    def tick(self, x: float, top: float, bottom: float) -> None:
        """Draw a short vertical line."""
        self.axes.vlines(x, top, bottom, color="black", linewidth=0.7)

    def arrow(self, left: float, right: float, y: float) -> None:
        """Draw an arrow to the right."""
        style = {"arrowstyle": "-|>", "facecolor": "black", "linewidth": 0.8, "shrinkA": 0}
        self.axes.annotate(
            "", (right, y), (left, y), arrowprops=style | {"shrinkB": 0, "mutation_scale": 7}
        )


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)


def tidy(axes: Any) -> None:
    """Remove the decoration of axes, and add horizontal grid lines."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GRAY)
    axes.tick_params(colors=INK, labelsize=8, length=3)
    axes.grid(axis="y", color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)


def tint(color: str, share: float) -> str:
    """Return a mixture of white and a share of a color, as `#rrggbb`."""
    return "#" + "".join(f"{round(255 * (1 - share * (1 - v))):02x}" for v in _rgb(color))


def ink_on(color: str) -> str:
    """Return black or white, whichever has the higher contrast (WCAG 2) with a color."""
    linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in _rgb(color)]
    luminance = sum(w * v for w, v in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
    # Contrast with black is (l + 0.05) / 0.05, with white 1.05 / (l + 0.05).
    return "black" if (luminance + 0.05) ** 2 > 1.05 * 0.05 else "white"


def mapped(color_map: str, share: float) -> str:
    """Return the color of a matplotlib color map at a value from 0 to 1, as `#rrggbb`."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return str(to_hex(colormaps[color_map](share)))


def cell_box(x: float, y: float) -> Any:
    """Return the light gray box of a cell of a picture, whose center is given."""
    from matplotlib.patches import Rectangle

    return Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor="#f0f0f0", edgecolor="white", zorder=0)


def right_of(axes: Any, inches: float) -> Any:
    """Return the transform for artists some inches right of axes; y is in data units."""
    from matplotlib.transforms import ScaledTranslation

    return axes.get_yaxis_transform() + ScaledTranslation(inches, 0, axes.figure.dpi_scale_trans)


def connect_right(axes: Any, value: float, label: float, inches: float, **line: Any) -> Any:
    """Draw a line from a value at the right edge of axes to the height of its label."""
    from matplotlib.patches import ConnectionPatch

    ends = {"coordsA": right_of(axes, 0), "coordsB": right_of(axes, inches)}
    return axes.add_artist(ConnectionPatch((1, value), (1, label), **ends, **line, clip_on=False))


def _rgb(color: str) -> list[float]:
    return [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
