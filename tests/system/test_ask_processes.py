"""The command `ask` in real processes: killed and stopped, it loses no answer."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.asking import look
from support.chat_server import ChatServer, Seen
from support.tabletop import QUERIES, TABLETOP

from robomme_interference_data.evaluate.run.log import read_record
from robomme_interference_data.schema.rollouts import Status

pytestmark = pytest.mark.slow

WORKERS = 2


def start(server: ChatServer, out: Path, *more: str) -> subprocess.Popen[str]:
    words = f"ask --model openai:{server.url}#tiny --system tiny --conditions k0 --frames 3"
    command = [sys.executable, "-m", "robomme_interference_data.cli.main", *words.split(), *more]
    return subprocess.Popen(
        [*command, "--workers", str(WORKERS), "--split", str(TABLETOP), "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def slowly(seen: Seen) -> str:
    time.sleep(0.1)
    return look(seen)


def test_killed_and_stopped_it_asks_nothing_twice(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with ChatServer(slowly) as server:
        for rows, number in ((3, signal.SIGKILL), (7, signal.SIGINT), (11, signal.SIGTERM)):
            running = start(server, out)
            end = time.monotonic() + 60
            record = out / "rollouts.jsonl"
            while not record.exists() or record.read_bytes().count(b"\n") < rows:
                assert running.poll() is None and time.monotonic() < end
                time.sleep(0.01)
            if number == signal.SIGKILL:
                running.kill()
            else:
                os.killpg(running.pid, number)
            _, err = running.communicate(timeout=60)
            assert rows <= len(read_record(out)) < len(QUERIES)
            if number != signal.SIGKILL:
                assert running.returncode == 128 + number
                assert f"Answers are in {out}; go on with:\nrobomme-interference ask" in err
                assert "Traceback" not in err
        running = start(server, out)
        _, err = running.communicate(timeout=120)
        assert running.returncode == 0, err
        assert {row.status for row in read_record(out).values()} == {Status.SUCCESS}
        assert len(read_record(out)) == len(QUERIES)
        # Only what was being asked as it ended was asked again.
        assert len(server.seen) <= len(QUERIES) + 3 * 2 * WORKERS
