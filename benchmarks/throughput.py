"""How many observations a policy answers a second: one policy for all rollouts, or one for each.

    python benchmarks/throughput.py                 # some minutes
    python benchmarks/throughput.py --models fake --workers 8

Rollouts are processes that give a policy front and wrist images, wait for its actions, and sleep
while a simulator with processors of its own would execute them: 16 steps of 1 ms, or of 4 ms as on
tabletop, from half to one and a half times as long, drawn for each chunk. Four ways:

- each rollout has its own policy, in its process, as without --policies;
- all share one policy in a process, as with --policies 1, whose batches wait for 10 or 30 ms;
- all share a server of vla-eval, with --policy vla-eval:ws://…, whose batches wait for 10 ms;
- one process acts for all at once and waits until all have executed their actions, as lerobot-eval
  with asynchronous environments: the vector's steps are in lockstep, and sleep for the slowest.

The fake model takes 50 ms, and 5 ms more for each further observation of a batch, during which it
holds a lock across processes: models in several processes share one GPU in turns, too. The other
model is a small ACT with random weights on this CPU, whose cores all processes share; vla-eval's
server of LeRobot policies gives one action at a time, and makes no batches.
"""

import argparse
import dataclasses
import fcntl
import itertools
import logging
import os
import socket
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from common import positive, print_machine, print_table

from robomme_interference_data.evaluate import BatchPolicy, Observation, RolloutInfo, RunConfig
from robomme_interference_data.evaluate.policies.policy import Policy
from robomme_interference_data.evaluate.policies.process import policy_processes
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.policies.shared import Address, SharedPolicy
from robomme_interference_data.runtime.executor import Worker
from robomme_interference_data.runtime.process import Processes

FIRST_S, FURTHER_S = 0.050, 0.005
TIMEOUTS_S = (0.01, 0.03)
DEVICE = "BENCHMARK_DEVICE"
"""Environment variable: the file that the fake model locks."""

GOAL = "push the button"

FAKE = "python:throughput:Fake"


class Fake(BatchPolicy):
    """Holds the device while it sleeps."""

    cameras = ("front", "wrist")

    def session(self) -> Policy:
        """Return another one: it has no memory."""
        return Fake()

    def act(self, observation: Observation, goal: str) -> Any:
        """Sleep for one observation."""
        return self.act_batch([self], [observation], [goal])[0]

    def act_batch(
        self, sessions: Sequence[Policy], observations: Sequence[Observation], goals: Sequence[str]
    ) -> list[Any]:
        """Sleep for all observations."""
        with Path(os.environ[DEVICE]).open("rb") as device:
            fcntl.flock(device, fcntl.LOCK_EX)
            time.sleep(FIRST_S + FURTHER_S * (len(sessions) - 1))
        return [np.zeros((16, 8), np.float32)] * len(sessions)

    def metadata(self) -> dict[str, Any]:
        """Return its name."""
        return {"policy": "fake"}


def serve(port: int) -> None:
    """Serve the fake model with vla-eval."""
    from vla_eval.model_servers import serve as serving

    logging.getLogger("vla_eval").setLevel(logging.ERROR)  # it reports its load
    from vla_eval.model_servers.predict import PredictModelServer

    class FakeServer(PredictModelServer):  # type: ignore[misc]
        def get_observation_params(self) -> dict[str, bool]:
            return {"send_state": True, "send_wrist_image": True}

        def get_action_spec(self) -> dict[str, Any]:
            return {}

        get_observation_spec = get_action_spec

        def predict(self, obs: Any, ctx: Any) -> Any:
            return self.predict_batch([obs], [ctx])[0]

        def predict_batch(self, obs_batch: Any, ctx_batch: Any) -> Any:
            every = [Fake()] * len(obs_batch)
            return [{"actions": one} for one in Fake().act_batch(every, (), ())]

    fake = FakeServer(chunk_size=None, max_batch_size=8, max_wait_time=0.01)
    serving.serve(fake, "127.0.0.1", port)


@contextmanager
def served() -> Iterator[str]:
    """Serve the fake model with vla-eval in the block; gives the policy that asks it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = get_context("spawn").Process(target=serve, args=(port,), daemon=True)
    process.start()
    try:
        yield f"vla-eval:ws://127.0.0.1:{port}"
    finally:
        process.kill()


class Rollouts:
    """A worker: acts until a time; returns when each of its answers came."""

    def __init__(
        self, config: RunConfig, addresses: Sequence[Address], chunk_s: float, folder: Path
    ):
        self._config, self._addresses, self._folder = config, addresses, folder
        self._chunk_s = chunk_s

    def __call__(self, task: tuple[int, int, float], worker: Worker) -> list[float]:
        """Wait until all workers are ready, and act for some seconds."""
        number, count, seconds = task
        policy = (
            SharedPolicy.open(self._addresses[0], number)
            if self._addresses
            else make_policy(self._config.policy, self._config.policy_options)
        )
        frames, observation = view()
        draw, times = np.random.default_rng(number), []
        with closing(policy):
            policy.reset(RolloutInfo(GOAL, 0, 0))
            ask(policy, frames, observation)  # the first call is slow
            (self._folder / str(number)).touch()
            while len([*self._folder.iterdir()]) < count:
                time.sleep(0.01)
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                ask(policy, frames, observation)
                times.append(time.monotonic())
                time.sleep(self._chunk_s * draw.uniform(0.5, 1.5))
        return times


def view() -> tuple[dict[str, Any], Observation]:
    """Return frames as `observe` gets them, and the observation."""
    images = np.random.default_rng(0).integers(0, 256, (2, 1, 256, 256, 3), dtype=np.uint8)
    frames = dict(zip(("front", "wrist"), images, strict=True))
    state = np.zeros(8, np.float32)
    return frames, Observation({name: part[0] for name, part in frames.items()}, state)


def ask(policy: Policy, frames: dict[str, Any], observation: Observation) -> None:
    """Let a policy act once."""
    policy.observe(frames, observation.state[None])
    assert policy.act(observation, GOAL).shape == (16, 8)


def processes(
    config: RunConfig, addresses: Sequence[Address], chunk_s: float, seconds: float
) -> float:
    """Return the observations a second of workers with their own policies, or a shared one."""
    with tempfile.TemporaryDirectory() as folder:
        task = Rollouts(config, addresses, chunk_s, Path(folder))
        tasks = [(number, config.workers, seconds) for number in range(config.workers)]
        outcomes = [*Processes(config.workers).run(task, tasks)]
    for one in outcomes:
        if one.error is not None:
            raise one.error
    return sum(len(one.value) for one in outcomes) / seconds


def lockstep(config: RunConfig, chunk_s: float, seconds: float) -> float:
    """Return the observations a second of one process that acts for a vector of environments."""
    policy: Any = make_policy(config.policy, config.policy_options)
    frames, observation = view()
    count, draw, answers = config.workers, np.random.default_rng(0), -config.workers
    with closing(policy):
        sessions = [policy.session() for _ in range(count)]
        for one in sessions:
            one.reset(RolloutInfo(GOAL, 0, 0))
        end = float("inf")
        while time.monotonic() < end:
            for one in sessions:
                one.observe(frames, observation.state[None])
            if count == 1:
                sessions[0].act(observation, GOAL)
            else:
                policy.act_batch(sessions, [observation] * count, [GOAL] * count)
            if answers < 0:  # the first call is slow
                end = time.monotonic() + seconds
            answers += count
            time.sleep(chunk_s * draw.uniform(0.5, 1.5, count).max())
    return answers / seconds


def measure(
    policy: tuple[str, tuple[str, ...]], workers: int, chunk_s: float, seconds: float
) -> list[float]:
    """Return the rate of each way."""
    text, options = policy
    config = RunConfig(
        policy=text,
        buffer_set="nowhere",
        out=Path("nowhere"),
        policy_options=options,
        policies=1,
        workers=workers,
    )
    own = processes(config, (), chunk_s, seconds)
    shared = []
    for timeout_s in TIMEOUTS_S:
        waiting = dataclasses.replace(config, batch_wait_timeout_s=timeout_s)
        with policy_processes(waiting) as addresses:
            shared.append(processes(waiting, addresses, chunk_s, seconds))
    vla_eval = float("nan")  # its server of LeRobot policies gives one action at a time
    if text == FAKE:
        named = ("checkpoint=benchmark",)
        with served() as asked:
            given = dataclasses.replace(config, policy=asked, policy_options=named, policies=None)
            vla_eval = processes(given, (), chunk_s, seconds)
    return [own, *shared, vla_eval, lockstep(config, chunk_s, seconds)]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--models", nargs="+", default=["fake", "act"], choices=["fake", "act"])
    parser.add_argument("--workers", nargs="+", type=positive, default=[1, 4, 8])
    parser.add_argument("--chunk-ms", nargs="+", type=positive, default=[16, 64])
    parser.add_argument("--seconds", type=positive, default=10)
    parser.add_argument("--rounds", type=positive, default=3)
    options = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"  # of each process: workers share the cores
    print_machine("torch", "lerobot")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ[DEVICE] = str(Path(folder, "device"))
        Path(folder, "device").touch()
        policies: dict[str, tuple[str, tuple[str, ...]]] = {"fake": (FAKE, ())}
        if "act" in options.models:
            from support.lerobot_policies import save_policy

            saved = save_policy(Path(folder, "act"), "act")
            policies["act"] = f"lerobot:{saved}", ("device=cpu",)
        cases = itertools.product(options.models, options.chunk_ms, options.workers)
        for model, chunk_ms, workers in cases:
            rounds = [
                measure(policies[model], workers, chunk_ms / 1000, options.seconds)
                for _ in range(options.rounds)
            ]
            rates = [f"{median(column):.1f}" for column in zip(*rounds, strict=True)]
            rates = ["–" if rate == "nan" else rate for rate in rates]
            ratio = median(one[2] / one[0] for one in rounds)
            aim = "≥ 3" if (model, chunk_ms, workers) == ("fake", 16, 8) else ""
            rows.append([model, str(chunk_ms), str(workers), *rates, f"{ratio:.2f}", aim])
    print_table(
        f"Observations/s; medians of {options.rounds} rounds of {options.seconds} s; the ratio is "
        "that of one policy for all, with waits of 30 ms, to one for each.",
        (
            *("<model", ">simulator ms", ">rollouts", ">one each"),
            *(">one for all, 10 ms", ">30 ms", ">vla-eval", ">lockstep", ">ratio", ">aim"),
        ),
        rows,
    )


if __name__ == "__main__":
    main()
