"""The text of a report's first screen, as a reader sees it."""

from html.parser import HTMLParser

_LINES = {"p", "h3", "tr", "dt", "figcaption"}
_SKIPPED = {"svg", "style", "script"}
_EMPTY = {"meta", "link", "input", "br"}


class _Screen(HTMLParser):
    """Collects the lines of the sections whose id begins with `screen-`."""

    def __init__(self) -> None:
        super().__init__()
        self.lines = list[str]()
        self._inside = 0  # depth in the section; 0 outside
        self._skipped = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in _EMPTY:
            return
        if self._inside or (dict(attrs).get("id") or "").startswith("screen-"):
            self._inside += 1
        if tag in _SKIPPED:
            self._skipped += 1
        if self._inside and tag in _LINES:
            self.lines.append("## " if tag == "h3" else "")
        elif self._inside and tag in ("td", "th", "dd") and self.lines[-1]:
            self.lines[-1] += " | " if tag != "dd" else ": "

    def handle_endtag(self, tag: str) -> None:
        if tag in _EMPTY:
            return
        if self._inside:
            self._inside -= 1
        if tag in _SKIPPED:
            self._skipped -= 1

    def handle_data(self, data: str) -> None:
        if self._inside and not self._skipped and data.strip():
            self.lines[-1] += data.replace("\n", " ")


def first_screen(page: str) -> str:
    """Return the lines of the first screen: sentences, tables with `|`, captions and checks."""
    parser = _Screen()
    parser.feed(page)
    return "".join(f"{line.strip()}\n" for line in parser.lines if line.strip())
