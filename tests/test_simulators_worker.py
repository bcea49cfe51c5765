"""Worker processes: a crash, a hang or an error there never takes us along."""

import os
import signal
import subprocess
import sys
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest

from robomme_interference_data.errors import SimulatorCrashError, UnknownNameError
from robomme_interference_data.simulators import Status
from robomme_interference_data.simulators.worker import RemoteSimulator

DOUBLE = "simulator_doubles:make"


def test_serves_what_the_simulator_serves() -> None:
    with RemoteSimulator(DOUBLE) as remote:
        lesson, first, info = remote.reset("MoveCube/test/9")
        assert lesson.images["front"].shape == (5, 4, 4, 3)
        assert lesson.images["front"].dtype == np.uint8
        assert (lesson.images["front"] == 9).all()
        assert (lesson.actions == 1).all()
        assert first.state.tolist() == [3.0] * 8
        assert info.seed == 9
        assert remote.chance == 0.25
        statuses = [remote.step(remote.act("oracle"))[1] for _ in range(3)]
    assert statuses == [Status.ONGOING, Status.ONGOING, Status.SUCCESS]


def test_frames_from_a_worker_can_be_written_to() -> None:
    with RemoteSimulator(DOUBLE) as remote:
        lesson, _, _ = remote.reset("MoveCube/test/9")
        lesson.images["front"][0] = 1


def test_an_error_there_is_the_same_error_here_and_the_worker_lives_on() -> None:
    with RemoteSimulator(DOUBLE) as remote:
        with pytest.raises(UnknownNameError, match="no such episode") as caught:
            remote.reset("MoveCube/test/3")
        assert caught.value.hint == "Take another."
        pid = remote.pid
        remote.reset("MoveCube/test/0")
        assert remote.pid == pid


def test_a_dead_worker_is_an_error_and_the_next_reset_starts_another() -> None:
    with RemoteSimulator(DOUBLE) as remote:
        with pytest.raises(SimulatorCrashError, match="died during reset, exit code 7"):
            remote.reset("MoveCube/test/1")
        assert remote.pid is None
        with pytest.raises(SimulatorCrashError, match="has ended"):
            remote.step(np.zeros(8, np.float32))
        assert len(remote.reset("MoveCube/test/0")[0]) == 5


def test_a_worker_that_dies_in_mid_message_is_an_error_too() -> None:
    with RemoteSimulator(DOUBLE) as remote:
        with pytest.raises(SimulatorCrashError, match="died during reset, exit code 9"):
            remote.reset("MoveCube/test/49")
        assert remote.pid is None
        assert remote.reset("MoveCube/test/0")[2].seed == 0


class Interruption(BaseException):
    """Stands for whatever interrupts a call: Ctrl-C, a timer."""


def test_after_an_interrupted_call_no_answer_is_that_of_another_call(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with RemoteSimulator(DOUBLE) as remote:
        remote.reset("MoveCube/test/0")
        pid = remote.pid or 0

        def interrupted(pipe: Connection) -> None:
            assert pipe.poll(60)  # the answer is there, and is not read
            raise Interruption

        with monkeypatch.context() as patch:
            patch.setattr("robomme_interference_data.simulators.worker._receive", interrupted)
            with pytest.raises(Interruption):
                remote.reset("MoveCube/test/5")
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
        with pytest.raises(SimulatorCrashError, match="has ended"):
            remote.step(np.zeros(8, np.float32))
        lesson, _, info = remote.reset("MoveCube/test/7")
        assert (lesson.images["front"] == 7).all()
        assert info.seed == 7


def test_ctrl_c_is_not_for_the_worker() -> None:
    with RemoteSimulator(DOUBLE) as remote:
        remote.reset("MoveCube/test/0")
        os.kill(remote.pid or 0, signal.SIGINT)
        assert remote.reset("MoveCube/test/5")[2].seed == 5


CTRL_C = f"""
import sys

from robomme_interference_data.simulators.worker import RemoteSimulator

if __name__ == "__main__":
    with RemoteSimulator("{DOUBLE}", marks=sys.argv[1]) as remote:
        try:
            remote.reset("MoveCube/test/2")  # hangs
        except KeyboardInterrupt:
            print("stopped", remote.pid)
"""


def test_ctrl_c_during_a_call_ends_the_worker_without_a_word(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(CTRL_C)
    running = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        start_new_session=True,
    )
    killer = threading.Timer(120, os.killpg, (running.pid, signal.SIGKILL))
    killer.start()
    try:
        while running.poll() is None and not (tmp_path / "2").exists():
            time.sleep(0.05)  # until the worker hangs
        os.killpg(running.pid, signal.SIGINT)  # as a terminal does: to parent and worker
        assert running.communicate() == ("stopped None\n", "")
        assert running.returncode == 0
    finally:
        killer.cancel()


def test_a_hanging_worker_is_ended_in_time() -> None:
    with RemoteSimulator(DOUBLE, episode_s=20.0) as remote:
        remote.reset("MoveCube/test/0")
        pid = remote.pid
        with pytest.raises(SimulatorCrashError, match="more than 20 s"):
            remote.reset("MoveCube/test/2")
        with pytest.raises(ProcessLookupError):
            os.kill(pid or 0, 0)


def test_close_ends_the_worker() -> None:
    remote = RemoteSimulator(DOUBLE)
    remote.reset("MoveCube/test/0")
    pid = remote.pid or 0
    remote.close()
    remote.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    for call in (
        lambda: remote.reset("MoveCube/test/0"),
        lambda: remote.step(np.zeros(8, np.float32)),
        lambda: remote.act("oracle"),
        lambda: remote.chance,
    ):
        with pytest.raises(SimulatorCrashError, match="the simulator is closed"):
            call()
    assert remote.pid is None


def test_an_unknown_simulator_is_told_by_the_worker() -> None:
    with (
        RemoteSimulator("tabeltop") as remote,
        pytest.raises(UnknownNameError, match="tabletop"),
    ):
        remote.reset("MoveCube/test/0")
