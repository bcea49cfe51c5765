"""What a worker of a run does: one rollout after the other."""

import logging
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from robomme_interference_data.constants import CAMERA_PREFIX
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.errors import (
    PolicyServerError,
    ServerKeepaliveError,
    WorkerRetiredError,
    first_line,
)
from robomme_interference_data.evaluate.policies.identity import plain, policy_metadata
from robomme_interference_data.evaluate.policies.policy import Policy
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.identity import make_selector, package_versions
from robomme_interference_data.evaluate.run.kind import Job, Run
from robomme_interference_data.evaluate.run.log import clip_name, transcript_file
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.subgoals.registry import make_writer
from robomme_interference_data.evaluate.subgoals.writer import CAMERA, ORACLE, SubgoalWriter
from robomme_interference_data.evaluate.systems import name_system
from robomme_interference_data.runtime.executor import Worker
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.rollouts import Rollout, Status
from robomme_interference_data.simulators.base import CAMERAS, Simulator
from robomme_interference_data.simulators.registry import (
    make_simulator,
    simulator_class,
    simulator_versions,
)

from .clips import Clip
from .rollout import run_rollout

if TYPE_CHECKING:
    from robomme_interference_data.retrieval.selector import Selector

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Opening:
    """What a worker opens before the first job: the `simulator`, or the policy's `server`."""

    what: str


class RolloutTask:
    """Runs rollouts, as an executor's task; simulator, policy and buffer set are made at the first one.

    What breaks is raised, and simulator and policy are made anew for the next rollout: nothing
    that broke is used again. Clips, subgoals and the log of a server that it started are sent.
    """

    def __init__(self, run: Run[RunConfig]):
        self._run = run
        self._simulator: Simulator | None = None
        self._policy: Policy | None = None
        self._checked = False  # whether the policy is what the run began with
        self._writer: SubgoalWriter | None = None
        self._buffer_set: BufferSet | None = None
        self._logs: dict[str, bytes] = {}
        self._selector: Selector | None = None

    def __call__(self, task: Job | Opening, worker: Worker) -> Any:
        """Run a rollout; return its row, and what befell its clip, or None. Or open something."""
        try:
            if isinstance(task, Opening):
                return self._open(task, worker)
            return self._run_job(task, worker)
        except Exception:
            self.close()
            raise

    def _open(self, opening: Opening, worker: Worker) -> Any:
        """Open the simulator; or the policy, and return what it reports, and if it keeps frames.

        Whether it does is asked only where that is known of the system.
        """
        policy = self._open_policy(worker)
        if opening.what == "simulator":
            self._open_simulator(policy, worker)
            return None
        known = name_system(self._run.system).keeps_frames is not None
        return (
            policy_metadata(self._run.config.policy, policy),
            cast("Any", policy).keeps_frames() if known else None,
        )

    def _run_job(self, job: Job, worker: Worker) -> tuple[Rollout, str | None]:
        item, config = job.item, self._run.config
        clip = Clip(item, self._run.system, worker.folder) if config.videos else None
        try:
            row = self._roll(job, worker, clip)
        except Exception as error:
            what = f"{type(error).__name__}: {first_line(error)}"
            self._send_files(item, worker, clip, Status.ERROR, what)
            if isinstance(error, ServerKeepaliveError):
                logger.warning("%s: %s. It is started again, once.", item, error.message)
            if isinstance(error, PolicyServerError) and config.serve is None:
                self.close()
                self._check_server(worker)
            raise
        # Whatever became of what is to be looked at, the rollout ended as it did.
        self._send_files(item, worker, clip, Status(row.status))
        return row, clip.problem if clip else None

    def _open_policy(self, worker: Worker) -> Policy:
        config = self._run.config
        if self._policy is None:
            self._policy = make_policy(config.policy, config.policy_options, worker=worker.number)
            self._checked = False
        return self._policy

    def _open_simulator(self, policy: Policy, worker: Worker) -> Simulator:
        config = self._run.config
        if self._simulator is None:
            options = simulator_options(config, policy.cameras)
            with worker.limit(config.simulator_timeout, "the simulator's start"):
                self._simulator = make_simulator(config.simulator, **options)
        return self._simulator

    def _roll(self, job: Job, worker: Worker, clip: Clip | None) -> Rollout:
        config = self._run.config
        if self._buffer_set is None:
            self._buffer_set = load_buffer_set(config.buffer_set, cache=config.cache, threads=1)
            self._selector = make_selector(config)
        policy = self._open_policy(worker)
        if not self._checked:
            self._check_served(policy, job.metadata)
            self._send_logs(worker)
            self._checked = True
        if self._writer is None:
            self._writer = make_writer(config)
        return run_rollout(
            self._run,
            job.item,
            simulator=self._open_simulator(policy, worker),
            policy=policy,
            buffer_set=self._buffer_set,
            selector=self._selector,
            writer=self._writer,
            clip=clip,
            worker=worker,
        )

    def describe(self) -> dict[str, str]:
        """Return the buffer set's revision and all versions, where it would run."""
        config = self._run.config
        versions = simulator_versions(config.simulator, config.robomme_python)
        revision = load_buffer_set(config.buffer_set).revision
        return package_versions(config) | versions | {"the buffer set's revision": revision}

    def close(self) -> None:
        """Release simulator, policy and what writes subgoals."""
        for thing in (self._policy, self._simulator, self._writer):
            # It may be broken already, and the first error is the one to tell.
            with suppress(Exception):
                if thing is not None:
                    thing.close()
        self._policy = self._simulator = self._writer = None

    def _send_files(
        self,
        item: WorkItem,
        worker: Worker,
        clip: Clip | None,
        status: Status,
        error: str | None = None,
    ) -> None:
        """Send the subgoals of a rollout, its clip, and logs of servers that it started."""
        self._send_logs(worker)
        if status is not Status.ERROR:
            self._logs.clear()
        if self._writer is not None:
            worker.send_file(*transcript_file("subgoals", item, map(to_dict, self._writer.turns)))
        if clip is not None:
            clip.close(status, error)
            if clip.data is not None:
                worker.send_file(clip_name(item), clip.data)

    def _send_logs(self, worker: Worker) -> None:
        """Send what servers that the worker started have printed.

        Of one that broke again with the next rollout: the files of an attempt may be lost.
        """
        server: Any = self._policy
        if self._run.config.serve is not None and server is not None:
            self._logs[f"servers/{server.started}-{worker.number}.log"] = server.log()
        for log in self._logs.items():
            worker.send_file(*log)

    def _check_served(self, policy: Policy, began: Mapping[str, Any]) -> None:
        """Retire the worker if the server that it reaches is not what the run began with."""
        if "server_metadata" not in began:
            return
        found, first = (one["server_metadata"] for one in (plain(policy.metadata()), began))
        if found != first:
            raise WorkerRetiredError(
                f"a worker's policy server reports {found}; the run began with {first}",
                "Serve the same checkpoint everywhere; on a cluster localhost is each node's own.",
            )

    def _check_server(self, worker: Worker) -> None:
        """Retire the worker unless the policy's server is still there."""
        config = self._run.config
        policy = make_policy(config.policy, config.policy_options, worker=worker.number)
        try:
            policy.metadata()  # connects
        except PolicyServerError as error:
            raise WorkerRetiredError(error.message, error.hint) from error
        finally:
            policy.close()


def simulator_options(config: RunConfig, watched: Iterable[str]) -> dict[str, Any]:
    """Return the options of a run's simulator: it draws only what somebody looks at.

    `watched` has the cameras that the policy wants.
    """
    wanted = {*watched}
    if config.subgoals not in (None, ORACLE):
        wanted.add(CAMERA)
    if config.retrieval is not None:
        wanted.add(config.retrieval_camera.removeprefix(CAMERA_PREFIX))
    if config.videos or config.check_lesson:
        wanted |= {*CAMERAS}
    cameras = tuple(name for name in CAMERAS if name in wanted)
    settings = {
        "cameras": cameras,
        "shift": config.shift,
        "python": config.robomme_python,
        "subgoals": config.subgoals == ORACLE,
        # Its own limit ends a little before the worker's: its error shows what it printed.
        "answer_s": 0.9 * config.simulator_timeout,
    }
    return {name: settings[name] for name in simulator_class(config.simulator).settings}
