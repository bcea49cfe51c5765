"""The example notebooks, run cell by cell; what buffers and buffer sets show in one."""

import json
import os
import runpy
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from IPython.core.interactiveshell import InteractiveShell
from support.buffer_sets import GOLDEN
from support.hub import push_buffer_set

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.notebooks import register

ROOT = Path(__file__).parents[2]
NOTEBOOK = ROOT / "examples" / "buffers.ipynb"
COLAB = ROOT / "examples" / "colab.ipynb"


@pytest.fixture
def shell() -> InteractiveShell:
    shell = InteractiveShell.instance()
    register()  # as importing the package in a notebook does
    return shell


def code_cells(notebook: Path) -> dict[str, str]:
    """The code of a notebook's cells by their ids."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return {
        cell.get("id", str(number)): "".join(cell["source"])
        for number, cell in enumerate(cells)
        if cell["cell_type"] == "code"
    }


def outputs(shell: InteractiveShell, codes: Iterable[str]) -> list[str]:
    """Run code cell by cell; return the formats in which cells show their values."""
    shown = []
    for code in codes:
        result = shell.run_cell(code)
        result.raise_error()
        if result.result is not None:
            formats, _ = shell.display_formatter.format(result.result)
            shown.append(" ".join(sorted(formats)))
    return shown


@pytest.mark.slow
def test_the_example_runs(shell: InteractiveShell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BUFFER_SET", str(GOLDEN))
    shown = outputs(shell, code_cells(NOTEBOOK).values())
    assert {"text/html text/plain", "image/png text/plain"} <= {*shown}


@pytest.fixture
def beside_a_clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder as it is on Colab when the package has been installed."""
    (tmp_path / "robomme-interference-data").symlink_to(ROOT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("BUFFER_SET", "")  # the notebook sets it
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    return tmp_path


@pytest.mark.slow
def test_the_notebook_for_colab_runs(shell: InteractiveShell, beside_a_clone: Path) -> None:
    """Offline, with the repository's sample."""
    shown = outputs(shell, code_cells(COLAB).values())
    assert shown == ["image/png text/plain"] * 2  # the film strip, and the figure of the score
    assert (beside_a_clone / "tutorial" / "score" / "report.html").is_file()


@pytest.mark.slow
def test_the_notebook_for_colab_fetches_a_published_set(
    shell: InteractiveShell, beside_a_clone: Path, hub: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    push_buffer_set(hub, GOLDEN, beside_a_clone / "work", "namespace/name")
    monkeypatch.setenv("HF_ENDPOINT", hub.endpoint)
    monkeypatch.setenv("HF_HUB_OFFLINE", "0")
    cells = code_cells(COLAB)
    named = cells["colab-3"].replace('= ""', '= "namespace/name@data-1.0.0"')
    assert named != cells["colab-3"]
    outputs(shell, (named, cells["colab-4"]))
    fetched = load_buffer_set(beside_a_clone / "tutorial" / "buffers")
    assert fetched.episode_ids == load_buffer_set(GOLDEN).episode_ids


def test_the_notebook_for_colab_has_the_cells_of_the_tutorial() -> None:
    script = runpy.run_path(str(ROOT / "scripts" / "colab_notebook.py"))
    assert script["updated"]() == COLAB.read_text(encoding="utf-8")
    tutorial = {cell["id"] for cell in script["read"](script["TUTORIAL"])["cells"]}
    shared = [cell["id"] for cell in script["read"](COLAB)["cells"] if cell["id"] in tutorial]
    assert len(shared) == 7


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
