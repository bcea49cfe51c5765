"""The example notebooks, run cell by cell; what buffers and buffer sets show in one."""

import json
import os
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest
from IPython.core.interactiveshell import InteractiveShell
from support.buffer_sets import GOLDEN
from support.hub import push_buffer_set

from robomme_interference_data import load_buffer
from robomme_interference_data.notebooks import register

ROOT = Path(__file__).parents[2]
NOTEBOOK = ROOT / "examples" / "buffers.ipynb"
COLAB = ROOT / "examples" / "colab.ipynb"


@pytest.fixture
def shell() -> InteractiveShell:
    shell = InteractiveShell.instance()
    register()  # as importing the package in a notebook does
    return shell


def outputs(shell: InteractiveShell, notebook: Path, replaced: str = "", by: str = "") -> list[str]:
    """Run a notebook; return the formats in which its cells show their values."""
    shown = []
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            result = shell.run_cell("".join(cell["source"]).replace(replaced, by))
            result.raise_error()
            if result.result is not None:
                formats, _ = shell.display_formatter.format(result.result)
                shown.append(" ".join(sorted(formats)))
    return shown


@pytest.mark.slow
def test_the_example_runs(shell: InteractiveShell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BUFFER_SET", str(GOLDEN))
    assert {"text/html text/plain", "image/png text/plain"} <= {*outputs(shell, NOTEBOOK)}


@pytest.mark.slow
@pytest.mark.parametrize("buffer_set", ["", "namespace/name@data-1.0.0"])
def test_the_notebook_for_colab_runs(
    shell: InteractiveShell,
    hub: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    buffer_set: str,
) -> None:
    """Offline, beside a clone: with the repository's sample, and with a set from the Hub."""
    push_buffer_set(hub, GOLDEN, tmp_path / "work", "namespace/name")
    (tmp_path / "robomme-interference-data").symlink_to(ROOT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("BUFFER_SET", "")  # the notebook sets it
    monkeypatch.setenv("HF_ENDPOINT", hub.endpoint)
    monkeypatch.setenv("HF_HUB_OFFLINE", "0")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    empty = 'os.environ["BUFFER_SET"] = ""'
    shown = outputs(shell, COLAB, empty, empty.replace('""', f'"{buffer_set}"'))
    assert shown == ["image/png text/plain"] * 2  # the film strip, and the figure of the score
    assert (tmp_path / "tutorial" / "score" / "report.html").is_file()


def test_the_notebook_for_colab_has_the_cells_of_the_tutorial() -> None:
    script = runpy.run_path(str(ROOT / "scripts" / "colab_notebook.py"))
    assert script["updated"]() == COLAB.read_text(encoding="utf-8")
    tutorial = {cell["id"] for cell in script["read"](script["TUTORIAL"])["cells"]}
    shared = [one["id"] for one in script["read"](COLAB)["cells"] if one["id"] in tutorial]
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
