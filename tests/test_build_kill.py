"""The build command, killed at any moment: no half-made output, and nothing is done twice."""

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from build_server import BuildServer
from recordings import contents

from robomme_interference_data.build_dataset.build import Filters, Settings, build_dataset
from robomme_interference_data.build_dataset.encode import CODECS
from robomme_interference_data.build_dataset.sample import write_sample
from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.build_dataset.stage import read_staged
from robomme_interference_data.build_dataset.writer import load_lerobot
from robomme_interference_data.progress import BuildProgress

pytestmark = pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc")

HASH_SEED = "4711"
STOPPED = "Stopped. Finished episodes are kept: run the same command again to go on."


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BuildServer]:
    with BuildServer(
        tmp_path_factory.mktemp("server") / "log", hash_seed=int(HASH_SEED)
    ) as running:
        yield running


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven train episodes that yield a unit, and one that does not."""
    folder = tmp_path_factory.mktemp("recorded") / "sample"
    for _ in write_sample(
        folder, families=("MoveCube", "PatternLock"), train=4, test=0, size=32, frames=249
    ):
        pass
    return folder


def command(recorded: Path, out: Path, workers: int = 2) -> list[str]:
    source = f"frames:{recorded}"
    options = ["--source", source, "--out", str(out), "--workers", str(workers)]
    return ["build", "distractors", *options]


@pytest.fixture(scope="module")
def undisturbed(
    recorded: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, bytes], float]:
    """The files of a build that nothing disturbed, and the seconds that it took.

    It is made in this process, whose hash seed is not the server's.
    """
    assert os.environ.get("PYTHONHASHSEED") != HASH_SEED
    load_lerobot()
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    begin = time.monotonic()
    result = build_dataset(
        "distractors",
        [open_source(f"frames:{recorded}")],
        out,
        Filters(split="train"),
        Settings(codec=CODECS["av1-lossless"], workers=2),
        BuildProgress(quiet=True),
    )
    seconds = time.monotonic() - begin
    assert (result.episodes, result.frames, len(result.skipped)) == (7, 224, 1)
    return contents(out), seconds


def staged(out: Path) -> dict[Path, int]:
    """The files of finished staged episodes, with their times."""
    folders = out.parent.glob(f".{out.name}.building/episodes/[0-9a-f]*")
    return {
        path: path.stat().st_mtime_ns
        for folder in folders
        if read_staged(folder) is not None
        for path in folder.iterdir()
    }


def disturb(
    server: BuildServer,
    recorded: Path,
    out: Path,
    undisturbed: tuple[dict[str, bytes], float],
    sent: signal.Signals,
    seconds: float,
    seed: int,
) -> None:
    """Stop builds of one output at random moments for so many seconds, then let one complete."""
    expected, duration = undisturbed
    moments = random.Random(seed)
    end = time.monotonic() + seconds
    stopped = 0
    while time.monotonic() < end or stopped < 3:
        before = staged(out)
        pid = server.start(*command(recorded, out))
        time.sleep(moments.uniform(0, 1.1 * duration))
        with contextlib.suppress(ProcessLookupError):  # it may have ended meanwhile
            # Ctrl-C in a terminal reaches the workers, too.
            (os.killpg if sent == signal.SIGINT else os.kill)(pid, sent)
        finished = server.wait(pid)
        assert server.survivors(30) == {}
        stopped += finished.code != 0
        if out.exists():
            assert contents(out) == expected
            shutil.rmtree(out)
            shutil.rmtree(out.parent / f".{out.name}.building", ignore_errors=True)
        else:
            assert finished.code == (130 if sent == signal.SIGINT else -sent), finished.stderr
            assert before.items() <= staged(out).items(), "finished episodes were made again"
            if sent == signal.SIGINT and "Encoding" in finished.stderr:
                assert finished.stderr.rstrip().endswith(STOPPED)
    finished = server.run(*command(recorded, out))
    assert finished.code == 0, finished.stderr
    assert contents(out) == expected
    assert [path.name for path in out.parent.iterdir()] == ["out"]


def test_another_process_and_hash_seed_do_not_change_a_byte(
    server: BuildServer,
    recorded: Path,
    undisturbed: tuple[dict[str, bytes], float],
    tmp_path: Path,
) -> None:
    finished = server.run(*command(recorded, tmp_path / "out"))
    assert finished.code == 0, finished.stderr
    assert "built, 7 episodes, 224 frames" in finished.stderr
    assert contents(tmp_path / "out") == undisturbed[0]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGINT], ids=lambda sent: sent.name)
def test_killed_at_random_moments(
    server: BuildServer,
    recorded: Path,
    undisturbed: tuple[dict[str, bytes], float],
    tmp_path: Path,
    sent: signal.Signals,
) -> None:
    disturb(server, recorded, tmp_path / "out", undisturbed, sent, seconds=8, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_killed_at_many_random_moments(
    server: BuildServer,
    recorded: Path,
    undisturbed: tuple[dict[str, bytes], float],
    tmp_path: Path,
    sent: signal.Signals,
) -> None:
    disturb(server, recorded, tmp_path / "out", undisturbed, sent, seconds=40, seed=2)


def test_a_worker_that_is_killed_is_replaced(
    server: BuildServer,
    recorded: Path,
    undisturbed: tuple[dict[str, bytes], float],
    tmp_path: Path,
) -> None:
    pid = server.start(*command(recorded, tmp_path / "out", workers=1))
    end = time.monotonic() + 60
    while not staged(tmp_path / "out") and time.monotonic() < end:
        time.sleep(0.01)
    workers = [p for p, text in server.survivors(0).items() if "multiprocessing-fork" in text]
    for worker in workers:
        os.kill(worker, signal.SIGKILL)
    finished = server.wait(pid)
    assert len(workers) == 1
    assert finished.code == 0, finished.stderr
    assert contents(tmp_path / "out") == undisturbed[0]
    assert server.survivors(30) == {}


@pytest.mark.slow
def test_the_installed_command(
    server: BuildServer,
    recorded: Path,
    undisturbed: tuple[dict[str, bytes], float],
    tmp_path: Path,
) -> None:
    """A whole interpreter each time, killed while it imports libraries, too."""
    out = tmp_path / "out"
    main = "from robomme_interference_data.cli import main; main()"
    arguments = [sys.executable, "-c", main, *command(recorded, out)]
    moments = random.Random(2)
    for _ in range(5):
        before = staged(out)
        with subprocess.Popen(arguments, stderr=subprocess.DEVNULL) as process:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(moments.uniform(0, 20))
            process.kill()
        if out.exists():
            break
        assert before.items() <= staged(out).items()
    done = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert contents(out) == undisturbed[0]
