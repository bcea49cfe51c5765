"""What a worker process of a run does: one rollout after the other."""

import dataclasses
import traceback
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import (
    InterferenceError,
    PolicyServerError,
    WorkerRetiredError,
)
from robomme_interference_data.evaluate.config import RunConfig
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.evaluate.policies.base import Policy
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.retrieval import make_selector
from robomme_interference_data.evaluate.rollout import base_row, run_rollout
from robomme_interference_data.evaluate.rows import Rollout
from robomme_interference_data.evaluate.videos import ClipWatcher, video_name
from robomme_interference_data.evaluate.watchdog import Watchdog
from robomme_interference_data.loader import Split, load_split
from robomme_interference_data.retrieval.selector import Selector
from robomme_interference_data.simulators.base import Simulator, Status
from robomme_interference_data.simulators.registry import make_simulator
from robomme_interference_data.workers import worker_number

__all__ = ["RolloutWorker", "error_row", "simulator_options"]


class RolloutWorker:
    """Runs rollouts in its process; simulator, policy and split are made at the first one.

    A rollout that raises becomes an error row, and simulator and policy are made anew for the
    next: nothing that broke is used again.

    Args:
        config: The run.
        out: The run's folder, for videos.
    """

    def __init__(self, config: RunConfig, out: Path):
        self.config = config
        self._out = out
        self._watchdog: Watchdog | None = None
        self._simulator: Simulator | None = None
        self._policy: Policy | None = None
        self._split: Split | None = None
        self._selector: Selector | None = None

    def __call__(self, item: WorkItem) -> tuple[Rollout, str | None]:
        """Run a rollout; return its row, and the traceback of what broke: it, its clip, or None."""
        if self._watchdog is None:
            self._watchdog = Watchdog(self.config.simulator_s, self._out, worker_number())
        self._watchdog.clear()
        with self._recorder(item) as clip:
            row, trace = self._run(item, clip)
            if clip is None:
                return row, trace
            if clip.close(Status(row.status), row.error):
                row = dataclasses.replace(row, video=video_name(item))
            # Whatever became of the clip, the rollout ended as it did.
            return row, "\n".join(filter(None, (trace, clip.problem))) or None

    def _recorder(self, item: WorkItem) -> AbstractContextManager[ClipWatcher | None]:
        if not self.config.videos:
            return nullcontext()
        return ClipWatcher(self._out / video_name(item), item, self.config.system)

    def _run(self, item: WorkItem, clip: ClipWatcher | None) -> tuple[Rollout, str | None]:
        try:
            self._prepare()
            assert self._simulator is not None and self._policy is not None
            assert self._split is not None
            row = run_rollout(
                self.config,
                item,
                simulator=self._simulator,
                policy=self._policy,
                split=self._split,
                selector=self._selector,
                watcher=clip,
                watchdog=self._watchdog,
            )
        except Exception as error:
            trace = traceback.format_exc()
            self._discard()
            if isinstance(error, PolicyServerError):
                self._check_server()
            return self._broken(item, error), trace
        return row, None

    def _prepare(self) -> None:
        config = self.config
        if self._split is None:
            self._split = load_split(config.split, cache=config.cache, threads=1)
        if self._policy is None:
            self._policy = self._make_policy()
        if self._selector is None:
            self._selector = make_selector(config)
        if self._simulator is None:
            self._simulator = make_simulator(
                config.simulator, **simulator_options(config, self._policy.cameras, self._selector)
            )

    def _make_policy(self) -> Policy:
        config = self.config
        return make_policy(config.policy, worker=worker_number(), **config.policy_arguments)

    def close(self) -> None:
        """Release everything; no rollout follows."""
        self._discard()
        if self._watchdog is not None:
            self._watchdog.close()

    def _discard(self) -> None:
        for thing in (self._policy, self._simulator):
            try:
                if thing is not None:
                    thing.close()
            except Exception:  # it is broken already, and the first error is the one to tell
                continue
        self._policy = self._simulator = None

    def _check_server(self) -> None:
        """See whether the policy's server is still there: without it nothing can be done here.

        Raises:
            WorkerRetiredError: It is not.
        """
        try:
            self._policy = self._make_policy()
            self._policy.metadata()  # connects
        except PolicyServerError as error:
            raise WorkerRetiredError(error.message, error.hint) from error
        finally:
            self._discard()

    def _broken(self, item: WorkItem, error: Exception) -> Rollout:
        seed = difficulty = None
        if self._split is not None:
            manifest = self._split.manifest(item.episode, self._split.k_values[0])
            seed, difficulty = manifest.seed, manifest.difficulty
        text = str(error)
        if isinstance(error, InterferenceError):
            text = error.message if error.hint is None else f"{error.message} ({error.hint})"
        return error_row(
            self.config, item, f"{type(error).__name__}: {text}", seed=seed, difficulty=difficulty
        )


def error_row(
    config: RunConfig,
    item: WorkItem,
    error: str,
    *,
    seed: int | None = None,
    difficulty: str | None = None,
) -> Rollout:
    """Return the row of a rollout that broke."""
    return Rollout(
        **base_row(config, item),
        seed=seed,
        difficulty=difficulty,
        goal=None,
        status=str(Status.ERROR),
        success=None,
        steps=0,
        history_frames=0,
        lesson_frames=0,
        lesson_share=None,
        error=" ".join(error.split())[:2000],
    )


def simulator_options(
    config: RunConfig, watched: Iterable[str], selector: Selector | None
) -> dict[str, Any]:
    """Return the options of a run's simulator: it draws only what somebody looks at.

    Args:
        config: The run.
        watched: Cameras that the policy wants.
        selector: The retrieval step, or None.
    """
    wanted = {*watched, *([selector.camera] if selector else [])}
    if config.videos:
        wanted |= {"front", "wrist"}
    if config.check_lesson:
        wanted |= {"front"}
    cameras = tuple(name for name in ("front", "wrist") if name in wanted)
    if config.simulator == "robomme":
        # Its own limits end a little before the watchdog's: its error shows what RoboMME printed.
        limit = 0.9 * config.simulator_s
        options = {"cameras": cameras, "reset_s": limit, "step_s": limit}
        return {"python": config.robomme_python, **options}
    if config.simulator != "tabletop" or config.check_lesson:
        return {}
    return {"cameras": cameras}
