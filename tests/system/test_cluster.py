"""Work on a Ray cluster: nodes and drivers that are lost, and the bytes of one process."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from support import runs, worlds
from support.buffer_sets import GOLDEN, contents
from support.lazy import lazy
from support.made_up import MadeUpSource
from support.serve_policy import command
from support.shared_policies import FAULT
from support.worker_calls import Marked, behave, wait_until_gone

from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan, PlannedEpisode
from robomme_interference_data.errors import WorkerError
from robomme_interference_data.evaluate.run.row import read_record
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Executor, Serial

ray_cluster = lazy("support.ray_cluster")
ray_workers = lazy("robomme_interference_data.runtime.ray_cluster")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

CONDITIONS = ("no-history", "k0", "k1", "k3", "k7")
ROLLOUTS = 2 * len(CONDITIONS)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A cluster of one's own, for nodes are taken away; its workers know the tests' world."""
    variables = {
        worlds.BUFFER_SET: str(GOLDEN),
        worlds.PAUSE: "0.03",
        FAULT: str(tmp_path_factory.mktemp("faults")),
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in variables.items():
            patch.setenv(name, value)
        with ray_cluster.running_cluster(3) as made:
            yield made


def driver(
    out: Path, address: str, policy: str = f"--policy {runs.CHEAT} --workers 3"
) -> subprocess.Popen[str]:
    """The command, as a user runs it."""
    words = f"evaluate {GOLDEN} {policy} --simulator {runs.WORLD} --system mine"
    words += " --families VideoRepick,MoveCube"
    words += f" --executor ray:{address} --json"
    command = [sys.executable, "-m", "robomme_interference_data.cli.main", *words.split()]
    return subprocess.Popen(
        [*command, "--out", str(out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def raylets(node: Any) -> list[Any]:
    """What runs a node's workers."""
    found: list[Any] = node.all_processes["raylet"]
    return found


def workers_of(cluster: Any) -> list[int]:
    """Processes that hold a worker now; some of a run's may still be starting."""
    nodes = [one.process.pid for each in cluster.list_all_nodes() for one in raylets(each)]
    hosts = [child for pid in nodes for child in psutil.Process(pid).children(recursive=True)]
    found = []
    for each in hosts:
        with contextlib.suppress(psutil.NoSuchProcess):
            if "WorkerActor" in " ".join(each.cmdline()):
                found.append(each.pid)
    return found


def wait_until_no_worker_is_left(cluster: Any) -> None:
    deadline = time.monotonic() + 30
    while left := workers_of(cluster):
        assert time.monotonic() < deadline, f"still running: {left}"
        time.sleep(0.1)


def test_a_node_and_the_driver_are_killed_and_no_row_is_lost(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The paper's five conditions; in the end, the rows of one process."""
    monkeypatch.setenv(worlds.PAUSE, "0")
    runs.run(tmp_path / "one", conditions=CONDITIONS, videos=True)
    out = tmp_path / "run"
    first = driver(out, cluster.address)
    runs.wait_for_rows(out, 1, first)
    first.kill()
    first.communicate(timeout=180)
    before = read_record(out)
    assert 1 <= len(before) < ROLLOUTS
    second = driver(out, cluster.address)
    runs.wait_for_rows(out, len(before) + 1, second)
    cluster.remove_node(cluster.list_all_nodes()[1], allow_graceful=False)
    ray_cluster.add_node(cluster)
    answer, err = second.communicate(timeout=300)
    assert second.returncode == 0, err
    assert len(json.loads(answer)) == ROLLOUTS
    after = read_record(out)  # refuses a second row of a finished rollout
    assert all(after[item] == row for item, row in before.items())
    expected = [row | {"video": None} for row in runs.finished_rows(tmp_path / "one")]
    assert runs.finished_rows(out) == expected


def test_ctrl_c_gives_all_workers_back(cluster: Any, tmp_path: Path) -> None:
    running = driver(tmp_path / "run", cluster.address)
    runs.wait_for_rows(tmp_path / "run", 1, running)
    assert workers_of(cluster)
    running.send_signal(signal.SIGINT)
    _, err = running.communicate(timeout=180)
    assert running.returncode == 130 and "resume with:" in err
    wait_until_no_worker_is_left(cluster)
    assert 1 <= len(read_record(tmp_path / "run")) < ROLLOUTS


def test_each_worker_of_a_node_starts_its_server(cluster: Any, tmp_path: Path) -> None:
    served = {"policy": f"websocket:{command('--pids', tmp_path / 'pids')}"}
    there = ray_workers.RayWorkers(2, cluster.address)
    result = runs.run(tmp_path / "run", there, conditions=CONDITIONS, videos=True, **served)
    assert result.counts["fail"] == ROLLOUTS
    assert all((tmp_path / "run" / str(row.video)).stat().st_size for row in result.rows)
    pids = [int(line) for line in (tmp_path / "pids").read_text().split()]
    assert len(pids) == 2  # the one that was asked what it is, too
    wait_until_gone(pids)
    logs = [path.read_text() for path in (tmp_path / "run" / "servers").iterdir()]
    assert len({log.split()[2] for log in logs}) == 2  # a port for each


def test_a_policy_is_shared_on_a_cluster_and_started_again(cluster: Any, tmp_path: Path) -> None:
    policy = "python:support.shared_policies:Remembering"
    # Without its file the fault does nothing; options are part of what the rows say.
    options = ("fault=die",)
    runs.run(tmp_path / "own", policy=policy, policy_options=options, conditions=CONDITIONS)
    Path(os.environ[FAULT], "die").touch()
    shared = f"--policy {policy} --policy-option fault=die --workers 2 --policies 1 --no-probe"
    running = driver(tmp_path / "run", cluster.address, shared)
    answer, err = running.communicate(timeout=300)
    assert running.returncode == 0 and len(json.loads(answer)) == ROLLOUTS, err
    assert max(row["attempt"] for row in json.loads(answer)) == 2
    assert runs.finished_rows(tmp_path / "run") == runs.finished_rows(tmp_path / "own")
    assert "2" in Path(os.environ[FAULT], "batches").read_text().split()
    wait_until_no_worker_is_left(cluster)


def test_a_node_that_differs_is_one_error_that_says_how(cluster: Any) -> None:
    node = ray_cluster.add_node(cluster, cpus=2, MARK="other")
    try:
        with pytest.raises(WorkerError) as raised:
            list(
                ray_workers.RayWorkers(1, cluster.address, ray_workers.Resources(cpus=2)).run(
                    Marked(), [7]
                )
            )
    finally:
        cluster.remove_node(node, allow_graceful=False)
    assert "mark is other there, none here" in raised.value.message


def connect(address: str, **environment: str) -> str:
    """In a process of its own, for this one is a driver already; return what went wrong."""
    code = (
        "import sys\n"
        "from robomme_interference_data.runtime.ray_cluster import RayWorkers\n"
        "list(RayWorkers(1, sys.argv[1]).run(print, [1]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, address],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    return done.stderr


def test_a_cluster_that_is_not_there() -> None:
    printed = connect("127.0.0.1:1")
    assert "WorkerError: " in printed and "'127.0.0.1:1'" in printed


def test_a_token_that_is_missing(cluster: Any, tmp_path: Path) -> None:
    printed = connect(cluster.address, RAY_AUTH_MODE="token", HOME=str(tmp_path))
    assert "WorkerError" in printed and "~/.ray/auth_token" in printed


def test_a_folder_for_temporary_files_that_is_too_long(tmp_path: Path) -> None:
    folder = tmp_path / ("long" * 20)
    folder.mkdir()
    printed = connect("local", TMPDIR=str(folder))
    assert "WorkerError" in printed and "TMPDIR=/tmp" in printed


def test_a_build_has_the_bytes_of_one_process(cluster: Any, tmp_path: Path) -> None:
    source = MadeUpSource({f"MoveCube/test/{number}": (40, 20) for number in range(4)})
    tasks = tuple(PlannedEpisode(0, episode) for episode in source.episodes())
    plan = DatasetPlan("demonstrations", (source,), tasks)

    def built(name: str, executor: Executor) -> dict[str, bytes]:
        with WorkProgress(quiet=True) as progress:
            build_dataset(plan, tmp_path / name, executor, progress)
        return contents(tmp_path / name)

    assert built("cluster", ray_workers.RayWorkers(3, cluster.address)) == built("one", Serial())


def test_processors_that_no_node_has_are_waited_for(cluster: Any) -> None:
    """A worker begins when a node with room for it joins."""
    work = ray_workers.RayWorkers(1, cluster.address, ray_workers.Resources(cpus=2)).run(
        behave, [("value", 7)]
    )
    node = None
    try:
        node = ray_cluster.add_node(cluster, cpus=2)
        assert [outcome.value for outcome in work] == [7]
    finally:
        work.close()
        if node is not None:
            cluster.remove_node(node, allow_graceful=False)
