"""The build command, killed at any moment: no half-made output, and nothing is done twice."""

import contextlib
import os
import random
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.buffer_sets import contents
from support.build_server import BuildServer

from robomme_interference_data.build_dataset.dataset.staged import read_staged
from robomme_interference_data.storage.staging import staging_path

pytestmark = pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc")

HASH_SEED = "4711"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BuildServer]:
    log = tmp_path_factory.mktemp("server") / "log"
    with BuildServer(log, hash_seed=int(HASH_SEED)) as running:
        yield running


def command(out: Path, workers: int = 2) -> list[str]:
    """Build six units and one that is too short, of small cameras."""
    options = f"--source sample:MoveCube,PatternLock --cameras front --workers {workers}"
    return ["build", str(out.parent), "--only", "distractors", *options.split()]


@pytest.fixture(scope="module")
def undisturbed(
    server: BuildServer, tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, bytes], float]:
    """The files of a build that nothing disturbed, and the seconds that it took."""
    out = tmp_path_factory.mktemp("undisturbed") / "distractors"
    begin = time.monotonic()
    finished = server.run(*command(out, workers=1))
    assert finished.code == 0, finished.stderr
    assert "5 added; 5 episodes, 160 frames" in finished.stderr
    assert "skipped MoveCube/train/1: 200 raw frames" in finished.stderr
    return contents(out), time.monotonic() - begin


def staged(out: Path) -> dict[Path, int]:
    """The files of finished staged episodes, with their times."""
    folders = staging_path(out).glob("episodes/[0-9a-f]*")
    return {
        path: path.stat().st_mtime_ns
        for folder in folders
        if read_staged(folder) is not None
        for path in folder.iterdir()
    }


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 12])
@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_stopped_at_random_moments(
    server: BuildServer,
    undisturbed: tuple[dict[str, bytes], float],
    tmp_path: Path,
    sent: signal.Signals,
    times: int,
) -> None:
    """Stop builds of one output at random moments, then let one complete."""
    out = tmp_path / "distractors"
    expected, duration = undisturbed
    moments = random.Random(sent)
    for _ in range(times):
        before = staged(out)
        pid = server.start(*command(out))
        time.sleep(moments.uniform(0.1, 1.0) * duration)
        with contextlib.suppress(ProcessLookupError):  # it may have ended meanwhile
            # Ctrl-C in a terminal reaches the workers, too.
            (os.killpg if sent == signal.SIGINT else os.kill)(pid, sent)
        finished = server.wait(pid)
        assert server.survivors(30) == {}
        if out.exists():
            assert contents(out) == expected
            shutil.rmtree(out)
            shutil.rmtree(staging_path(out), ignore_errors=True)
            continue
        codes = {signal.SIGINT: 130, signal.SIGTERM: 143}
        assert finished.code in (codes.get(sent, -sent), -sent), finished.stderr
        assert before.items() <= staged(out).items(), "finished episodes were made again"
        if finished.code > 0 and staged(out) != before:  # else it may not have begun yet
            assert "Stopped. " in finished.stderr, finished.stderr
            message = finished.stderr.split("Stopped. ")[1]
            assert message.startswith(
                "Finished episodes are kept; resume with:\nrobomme-interference"
            )
    finished = server.run(*command(out))
    assert finished.code == 0, finished.stderr
    assert contents(out) == expected
    assert [path.name for path in out.parent.iterdir()] == ["distractors"]


def started(server: BuildServer, out: Path) -> int:
    """Start a build, and return its process once it has staged an episode."""
    pid, end = server.start(*command(out, workers=1)), time.monotonic() + 60
    while not staged(out) and time.monotonic() < end:
        time.sleep(0.01)
    return pid


@pytest.mark.slow
def test_a_worker_that_is_killed_is_replaced(
    server: BuildServer, undisturbed: tuple[dict[str, bytes], float], tmp_path: Path
) -> None:
    pid = started(server, tmp_path / "distractors")
    workers = [p for p, text in server.survivors(0).items() if "multiprocessing-fork" in text]
    for worker in workers:
        os.kill(worker, signal.SIGKILL)
    finished = server.wait(pid)
    assert len(workers) == 1
    assert finished.code == 0, finished.stderr
    assert contents(tmp_path / "distractors") == undisturbed[0]
    assert server.survivors(30) == {}
