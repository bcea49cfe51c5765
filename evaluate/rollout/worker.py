"""What a worker of a run does: one rollout after the other."""

import logging
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from robomme_interference_data.constants import DEMONSTRATIONS, MAX_STEPS
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import (
    NoRendererError,
    PolicyError,
    PolicyServerError,
    ServerKeepaliveError,
    SimulatorError,
    WorkerRetiredError,
    first_line,
)
from robomme_interference_data.evaluate.policies.policy import Policy
from robomme_interference_data.evaluate.policies.registry import make_policy, starts_server
from robomme_interference_data.evaluate.probe.clients import Calls, Interleaved, Recorder
from robomme_interference_data.evaluate.probe.plays import SHORT_STEPS, PlannedPlay, ProbeTask
from robomme_interference_data.evaluate.probe.trace import Play, Trace
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.run.worker import (
    WORTH_REPEATING,
    Job,
    RunContext,
    RunFunction,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Worker
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import check_drawn
from robomme_interference_data.simulators.registry import (
    make_simulator,
    simulator_renderer,
    simulator_versions,
)

from .agreement import check_episode
from .rollout import run_rollout
from .settings import simulator_options, used_cameras

if TYPE_CHECKING:
    from robomme_interference_data.evaluate.language.subgoal_writers import SubgoalWriter
    from robomme_interference_data.evaluate.policies.answers import Answers
    from robomme_interference_data.evaluate.policies.shared import Address

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class StartServer:
    """Start the policy's server, before the first job.

    Attributes:
        asks: Whether to find out if it keeps frames.
    """

    asks: bool


@dataclass(frozen=True)
class StartSimulator:
    """Start the simulator, before the first job; a simulator of the user begins an `episode`.

    So a mistake in it shows once, instead of in every row.
    """

    episode: EpisodeId | None


class RolloutFunction(RunFunction[RunConfig]):
    """Runs rollouts; makes policy and simulator at the first one, and again after an error.

    `answers` are those that the policy `answers` carries out; None for all other policies.
    `addresses` are those of shared policies; empty if each worker has its own policy. `policy` is
    one that is made already.
    """

    def __init__(
        self,
        config: RunConfig,
        answers: "Answers | None" = None,
        addresses: "Sequence[Address]" = (),
        policy: Policy | None = None,
    ):
        super().__init__(config)
        self._answers, self._addresses, self._made_policy = answers, addresses, policy
        self._simulator: Simulator | None = None
        self._policy: Policy | None = None
        self._past: list[str] = []  # labels of what the policy has played
        self._checked = False  # whether the policy's server is the one that the run began with
        self._writer: SubgoalWriter | None = None
        self._logs: dict[str, bytes] = {}

    def work(
        self, task: Job[RunConfig] | ProbeTask | StartServer | StartSimulator, worker: Worker
    ) -> Any:
        """Run a rollout; return its row, and a problem of its clip. Or probe, or start a part."""
        if isinstance(task, StartServer):
            return self._start_server(task.asks, worker)
        if isinstance(task, StartSimulator):
            return self._start_simulator(task.episode, worker)
        if isinstance(task, ProbeTask):
            return self._probe(task, worker)
        return self._run(task, worker)

    def describe(self) -> dict[str, str]:
        """Return the buffer set's revision, all versions, and the simulator's renderer."""
        simulator, python = self.config.simulator, self.config.simulator_python
        described = super().describe() | simulator_versions(simulator, python)
        return described | {"renderer": str(simulator_renderer(simulator, python))}

    def close(self) -> None:
        """Release simulator, policy and subgoal writer."""
        for resource in (self._policy, self._simulator, self._writer):
            # It may be broken already, and the first error is the one to report.
            with suppress(Exception):
                if resource is not None:
                    resource.close()
        self._policy = self._simulator = self._writer = None
        self._past.clear()

    def _start_server(
        self, asks: bool, worker: Worker
    ) -> tuple[dict[str, Any], str | None, bool | None]:
        """Return the server's metadata and memory, and whether it keeps frames, if asked."""
        from robomme_interference_data.evaluate.policies.identity import (
            declared_memory,
            policy_metadata,
        )

        policy: Any = self._open_policy(worker)
        metadata = policy_metadata(self.config.policy, policy)
        keeps = policy.keeps_frames() if asks else None
        return metadata, declared_memory(policy, metadata), keeps

    def _start_simulator(self, episode: EpisodeId | None, worker: Worker) -> None:
        policy = self._open_policy(worker)
        simulator = self._open_simulator(policy, worker)
        if episode is not None:
            cameras = used_cameras(self.config, policy.cameras, self._demonstrations)
            self._try_out(simulator, episode, cameras, worker)

    def _try_out(
        self, simulator: Simulator, episode: EpisodeId, cameras: set[str], worker: Worker
    ) -> None:
        """Begin an episode; raise only for what no episode can work with."""
        limit = worker.limit(self.config.simulator_timeout_s, "the simulator's reset")
        try:
            with limit:
                lesson, first, info = simulator.reset(str(episode), demonstration=False)
            check_drawn(lesson, first, sorted(cameras))
            check_episode(self.buffer_set.query(episode), lesson, first, info)
        except (NoRendererError, SimulatorError):
            raise
        except Exception:
            self.close()  # the rollout of this episode becomes an error row

    def _run(self, job: Job[RunConfig], worker: Worker) -> tuple[Rollout, str | None]:
        item, config, clip = job.item, self.config, None
        if config.videos:
            from .clips import Clip

            clip = Clip(item, job.run.system, worker.folder)
        try:
            row = self._roll(job, worker, clip=clip)
        except Exception as error:
            what = f"{type(error).__name__}: {first_line(error)}"
            self._send_files(item, worker, clip, Status.ERROR, what)
            if isinstance(error, ServerKeepaliveError):
                logger.warning("%s: %s. It is started again, once.", item, error.message)
            self._check_reachable(error, worker)
            raise
        self._send_files(item, worker, clip, Status(row.status))
        return row, clip.problem if clip else None

    def _probe(self, task: ProbeTask, worker: Worker) -> list[Play]:
        """Play rollouts one after the other, and return their values.

        One that breaks is played once more, with everything new: if it does not break then, a state
        may have broken it.
        """
        if task.fresh and self._past:
            self.close()
        plays = list[Play]()
        calls: dict[WorkItem, Calls] = {
            planned.beside: [] for planned in task.planned if planned.beside is not None
        }
        for planned in task.planned:
            after = plays[-1].planned.label if plays else None
            plays.append(self._play(task.run, planned, calls, after, worker))
            if plays[-1].error is not None:
                self.close()
                plays.append(self._play(task.run, planned, calls, planned.label, worker))
        self._logs.clear()
        return plays

    def _play(
        self,
        run: RunContext[RunConfig],
        planned: PlannedPlay,
        calls: dict[WorkItem, Calls],
        after: str | None,
        worker: Worker,
    ) -> Play:
        """Play a rollout for the probe; `calls` holds those of rollouts that act beside others."""
        trace = Trace(MAX_STEPS if planned.whole else SHORT_STEPS)
        policy, past, status = self._open_policy(worker), tuple(self._past), None
        with ExitStack() as stack:
            if planned.beside is not None:
                other = stack.enter_context(closing(self._make_policy(worker, client=1)))
                policy = Interleaved(policy, other, calls[planned.beside])
            elif planned.item in calls:
                policy = Recorder(policy, calls[planned.item])
            try:
                job = Job(planned.item, run)
                row = self._roll(job, worker, policy=policy, trace=trace, label=planned.label)
                if planned.whole or row.steps < SHORT_STEPS:
                    status = row.status
            except Exception as error:
                self._check_reachable(error, worker)
                # What breaks with everything new breaks without any state.
                if trace.error is None or not past or isinstance(error, WORTH_REPEATING):
                    raise
        return Play(
            planned, past, after, tuple(trace.events), trace.first_action, status, trace.error
        )

    def _roll(
        self,
        job: Job[RunConfig],
        worker: Worker,
        *,
        clip: Any = None,
        policy: Policy | None = None,
        trace: Trace | None = None,
        label: str | None = None,
    ) -> Rollout:
        """Run a rollout; `policy` is the worker's own, or one around it."""
        if self._answers is not None and job.item not in self._answers:
            raise PolicyError(
                f"the question of {job.item} broke: it has no answer",
                "Resume the run of questions, then this one.",
            )
        own = self._open_policy(worker)
        policy = policy or own
        if not self._checked:
            self._check_served(own, job.run.metadata)
            self._send_logs(worker)
            self._checked = True
        predecessor = self._past[-1] if self._past else None
        self._past.append(label or job.item.key)
        return run_rollout(
            job.run,
            job.item,
            simulator=self._open_simulator(policy, worker),
            policy=policy,
            buffer_set=self.buffer_set,
            history=self.history,
            selector=self.selector,
            writer=self._open_writer(),
            clip=clip,
            worker=worker,
            answer=(self._answers or {}).get(job.item),
            predecessor=predecessor,
            trace=trace,
        )

    def _check_served(self, policy: Policy, metadata: Mapping[str, Any]) -> None:
        """Retire the worker if its server reports other metadata than at the start of the run."""
        if "server_metadata" not in metadata:  # the policy has no server
            return
        from robomme_interference_data.evaluate.run.identity import plain

        reported = plain(policy.metadata())["server_metadata"]
        first = metadata["server_metadata"]
        if reported != first:
            raise WorkerRetiredError(
                f"a worker's policy server reports {reported}; the run began with {first}",
                "Serve the same checkpoint everywhere; on a cluster localhost is each node's own.",
            )

    def _check_reachable(self, error: Exception, worker: Worker) -> None:
        """Retire the worker if, after an error, the policy's server cannot be reached.

        It must not break one rollout after the other: workers with other servers do the rest. A
        server that workers start is started again instead.
        """
        if not isinstance(error, PolicyServerError) or starts_server(self.config.policy):
            return
        self.close()
        try:
            with closing(self._make_policy(worker)) as policy:
                policy.metadata()  # connects
        except PolicyServerError as gone:
            raise WorkerRetiredError(gone.message, gone.hint) from gone

    def _send_files(
        self, item: WorkItem, worker: Worker, clip: Any, status: Status, error: str | None = None
    ) -> None:
        """Send the subgoals of a rollout, its clip, and logs of servers that it started."""
        self._send_logs(worker)
        if status is not Status.ERROR:
            self._logs.clear()
        if self._writer is not None:
            worker.send_file(*item.transcript("subgoals", map(to_dict, self._writer.turns)))
        if clip is not None:
            clip.close(status, error)
            if clip.data is not None:
                worker.send_file(item.clip, clip.data)
                if clip.page is not None:
                    worker.send_file(item.page, clip.page)

    def _send_logs(self, worker: Worker) -> None:
        """Send the output of servers that the worker started.

        Logs of earlier attempts are sent again, because the files of an attempt may be lost.
        """
        server: Any = self._policy
        if server is not None and starts_server(self.config.policy):
            self._logs[f"servers/{server.started}-{worker.number}.log"] = server.log()
        for log in self._logs.items():
            worker.send_file(*log)

    def _open_policy(self, worker: Worker) -> Policy:
        if self._policy is None:
            self._policy = self._make_policy(worker)
            self._checked = False
        return self._policy

    def _make_policy(self, worker: Worker, client: int = 0) -> Policy:
        """Make the worker's policy, or another client of what that shares with other workers."""
        config = self.config
        if self._made_policy is not None:
            return self._made_policy
        if not self._addresses:
            return make_policy(config.policy, config.policy_options, worker=worker.number)
        from robomme_interference_data.evaluate.policies.shared import SharedPolicy

        address = self._addresses[worker.number % len(self._addresses)]
        # Workers have numbers from 0, and whoever loads the policy has -1.
        return SharedPolicy.open(address, -2 - worker.number if client else worker.number)

    def _open_simulator(self, policy: Policy, worker: Worker) -> Simulator:
        config = self.config
        if self._simulator is None:
            options = simulator_options(config, policy.cameras, self._demonstrations)
            with worker.limit(config.simulator_timeout_s, "the simulator's start"):
                self._simulator = make_simulator(config.simulator, **options)
        return self._simulator

    def _open_writer(self) -> "SubgoalWriter | None":
        if self._writer is None and self.config.subgoals is not None:
            from robomme_interference_data.evaluate.language.subgoal_settings import make_writer

            self._writer = make_writer(self.config)
        return self._writer

    @property
    def _demonstrations(self) -> Dataset:
        return self.buffer_set.datasets[DEMONSTRATIONS]
