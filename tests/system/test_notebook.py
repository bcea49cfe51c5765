"""The example notebook, run cell by cell; what buffers and buffer sets show in one."""

import json
import sys
from pathlib import Path

import pytest
from IPython.core.interactiveshell import InteractiveShell
from support.buffer_sets import GOLDEN

from robomme_interference_data import load_buffer
from robomme_interference_data.notebooks import register

NOTEBOOK = Path(__file__).parents[2] / "examples" / "buffers.ipynb"


@pytest.fixture
def shell() -> InteractiveShell:
    shell = InteractiveShell.instance()
    register()  # as importing the package in a notebook does
    return shell


@pytest.mark.slow
def test_the_example_runs(shell: InteractiveShell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BUFFER_SET", str(GOLDEN))
    shown = []
    for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            result = shell.run_cell("".join(cell["source"]))
            result.raise_error()
            if result.result is not None:
                formats, _ = shell.display_formatter.format(result.result)
                shown.append(sorted(formats))
    assert ["text/html", "text/plain"] in shown and ["image/png", "text/plain"] in shown


def test_without_matplotlib_a_buffer_is_text_and_the_extra_is_named(
    shell: InteractiveShell, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name in [one for one in sys.modules if one.partition(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    buffer = load_buffer("MoveCube/test/0", "k1", buffer_set=GOLDEN)
    formats, _ = shell.display_formatter.format(buffer)
    assert [*formats] == ["text/plain"] and "MoveCube/test/0" in formats["text/plain"]
    assert "[score]" in caplog.text
