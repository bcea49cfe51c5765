"""Copy cells of the tutorial into the notebook for Colab, which shows what needs no simulator.

A cell of examples/colab.ipynb that has the id of a cell of docs/tutorial.ipynb has its text, too:
change it in the tutorial, then run this.
"""

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TUTORIAL = ROOT / "docs" / "tutorial.ipynb"
COLAB = ROOT / "examples" / "colab.ipynb"


def updated() -> str:
    """Return the notebook for Colab with the tutorial's present cells."""
    sources = {cell["id"]: cell["source"] for cell in read(TUTORIAL)["cells"]}
    notebook = read(COLAB)
    for cell in notebook["cells"]:
        cell["source"] = sources.get(cell["id"], cell["source"])
    return json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"


def read(path: Path) -> dict[str, Any]:
    """Return a notebook."""
    notebook: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return notebook


if __name__ == "__main__":
    COLAB.write_text(updated(), encoding="utf-8")
