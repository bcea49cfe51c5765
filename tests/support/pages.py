"""Pages of the documentation."""

from pathlib import Path

RESULTS = Path(__file__).parents[2] / "docs" / "results"


def table(page: str, head: str) -> list[dict[str, str]]:
    """Return the rows of the first table of a page whose head has these cells side by side."""
    blocks = (part.splitlines() for part in page.split("\n\n"))
    lines = next(one for one in blocks if one[0].startswith("|") and f"| {head} |" in one[0])
    names, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    return [dict(zip(names, row, strict=True)) for row in rows]
