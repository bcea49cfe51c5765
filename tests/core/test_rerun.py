"""The Rerun recording of a buffer: what is logged at each frame, and that Rerun can read it."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.buffer_sets import GOLDEN, QUERIES

from robomme_interference_data import load_buffer_set
from robomme_interference_data.errors import MissingExtraError
from robomme_interference_data.schema.sampling import even_sample
from robomme_interference_data.storage.video.encode import decode_image
from robomme_interference_data.viz.rerun_file import write_recording

BUFFER = load_buffer_set(GOLDEN).load(QUERIES[1], "k3")
LIVE = {"wrist": BUFFER.query.frame("wrist")}
Run = Callable[..., tuple[int, str, str]]


class Recorder:
    """Stands in for a recording: keeps what is logged, by entity and frame."""

    def __init__(self, name: str, recording_id: str):
        self.logged: dict[tuple[str, int], Any] = {}
        self.frame = -1

    def save(self, path: str) -> None:
        Path(path).write_bytes(b"recording")

    def set_time(self, timeline: str, sequence: int) -> None:
        assert timeline == "frame"
        self.frame = sequence

    def log(self, entity: str, value: Any) -> None:
        self.logged[entity, self.frame] = value

    def __getattr__(self, name: str) -> Any:
        return lambda *values: None


def test_every_frame_is_logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Recorder] = []

    def recording(*values: Any, **named: Any) -> Recorder:
        made.append(Recorder(*values, **named))
        return made[-1]

    fake = SimpleNamespace(
        RecordingStream=recording,
        EncodedImage=lambda contents, media_type: decode_image(contents),
        Scalars=lambda values: values,
        TextLog=lambda text: text,
    )
    monkeypatch.setitem(sys.modules, "rerun", fake)
    write_recording(BUFFER, tmp_path / "a.rrd", LIVE)
    assert (tmp_path / "a.rrd").read_bytes() == b"recording"
    [recorder] = made
    logged, frames = recorder.logged, BUFFER.frames("wrist")
    for index in range(len(BUFFER)):
        np.testing.assert_array_equal(logged["wrist", index], frames[index])
        np.testing.assert_array_equal(logged["state", index], BUFFER.states[index])
        assert logged["session", index] == BUFFER.session_index[index]
        assert logged["sample", index] == (index in even_sample(len(BUFFER)))
    assert not any(entity == "front" for entity, _ in logged)
    np.testing.assert_array_equal(logged["wrist", len(BUFFER)], LIVE["wrist"])
    texts = {frame: text for (entity, frame), text in logged.items() if entity == "text"}
    assert texts[BUFFER.sessions[2].start].startswith("session 2: distractor ")


def test_rerun_reads_the_file(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    out = tmp_path / "a.rrd"
    write_recording(BUFFER, out, LIVE)
    program = Path(sys.executable).with_name("rerun")
    subprocess.run([program, "rrd", "verify", out], check=True, timeout=180)


def test_errors_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    wrong = ("--out", tmp_path / "strip.png", "--rerun", tmp_path / "a.png")
    code, _, err = run("show", GOLDEN, QUERIES[1], "k3", *wrong)
    assert code == 1 and ".rrd" in err
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError) as missing:
        write_recording(BUFFER, tmp_path / "a.rrd", LIVE)
    assert missing.value.hint == "Install it: pip install rerun-sdk"
    code, _, err = run("show", GOLDEN, QUERIES[1], "k3", "--rerun", tmp_path / "a.rrd")
    assert code == 1 and "pip install rerun-sdk" in err
    assert list(tmp_path.iterdir()) == []
