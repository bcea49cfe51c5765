"""Worker processes: a crash, a hang or an error there never takes us along."""

import os

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


def test_an_unknown_simulator_is_told_by_the_worker() -> None:
    with (
        RemoteSimulator("tabeltop") as remote,
        pytest.raises(UnknownNameError, match="tabletop"),
    ):
        remote.reset("MoveCube/test/0")
