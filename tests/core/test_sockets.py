"""Folders for sockets below a long folder for temporary files."""

import socket
import tempfile
from pathlib import Path

import pytest

from robomme_interference_data.errors import WorkerError
from robomme_interference_data.runtime.sockets import socket_folder


@pytest.mark.parametrize("length", [40, 80, 90])
def test_a_socket_fits_or_the_error_says_what_to_set(
    monkeypatch: pytest.MonkeyPatch, length: int
) -> None:
    # pytest's own folder may be too long already.
    base = Path(tempfile.mkdtemp(dir="/tmp"))
    folder = base / ("x" * (length - len(str(base)) - 1))
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    try:
        if length < 80:
            made = socket_folder("policies-")
            with socket.socket(socket.AF_UNIX) as bound:
                bound.bind(str(made / "999"))
            (made / "999").unlink()
            made.rmdir()
        else:
            with pytest.raises(WorkerError) as caught:
                socket_folder("p" * 15)
            assert "TMPDIR" in str(caught.value.hint)
            assert not any(folder.iterdir())
    finally:
        folder.rmdir()
        base.rmdir()
