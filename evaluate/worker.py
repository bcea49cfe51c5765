"""What a worker process of a run does: one rollout after the other."""

import dataclasses
import traceback
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.evaluate.config import RunConfig
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.evaluate.policies.base import Policy
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.rollout import base_row, run_rollout
from robomme_interference_data.evaluate.rows import Rollout
from robomme_interference_data.evaluate.watchdog import Watchdog
from robomme_interference_data.loader import Split, load_split
from robomme_interference_data.retrieval.selector import Selector
from robomme_interference_data.simulators.base import Simulator, Status
from robomme_interference_data.simulators.registry import make_simulator
from robomme_interference_data.workers import worker_number

__all__ = ["RolloutWorker", "error_row", "make_selector", "simulator_options"]


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
        """Run a rollout; return its row, and the traceback of its error if there is one."""
        try:
            self._prepare()
            assert self._simulator is not None and self._policy is not None
            assert self._split is not None
            row = self._run(item)
        except Exception as error:
            self._discard()
            return self._broken(item, error), traceback.format_exc()
        return row, None

    def _run(self, item: WorkItem) -> Rollout:
        assert self._simulator is not None and self._policy is not None
        assert self._split is not None
        parts: dict[str, Any] = {
            "simulator": self._simulator,
            "policy": self._policy,
            "split": self._split,
            "selector": self._selector,
            "watchdog": self._watchdog,
        }
        if not self.config.videos:
            return run_rollout(self.config, item, **parts)
        from robomme_interference_data.evaluate.videos import record_rollout, video_name

        row = record_rollout(self.config, item, self._out, **parts)
        return dataclasses.replace(row, video=video_name(item))

    def _prepare(self) -> None:
        config = self.config
        if self._watchdog is None:
            self._watchdog = Watchdog(config.simulator_s, self._out)
        if self._split is None:
            self._split = load_split(config.split, cache=config.cache, threads=1)
        if self._policy is None:
            self._policy = make_policy(
                config.policy, worker=worker_number(), **config.policy_arguments
            )
        if self._selector is None and config.retrieval is not None:
            self._selector = make_selector(config)
        if self._simulator is None:
            self._simulator = make_simulator(
                config.simulator, **simulator_options(config, self._policy, self._selector)
            )

    def _discard(self) -> None:
        for thing in (self._policy, self._simulator):
            try:
                if thing is not None:
                    thing.close()
            except Exception:  # it is broken already, and the first error is the one to tell
                continue
        self._policy = self._simulator = None

    def _broken(self, item: WorkItem, error: Exception) -> Rollout:
        seed = difficulty = None
        if self._split is not None:
            manifest = self._split.manifest(item.episode, self._split.k_values[0])
            seed, difficulty = manifest.seed, manifest.difficulty
        text = error.message if isinstance(error, InterferenceError) else str(error)
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


def make_selector(config: RunConfig) -> Selector:
    """Make the retrieval step of a run."""
    assert config.retrieval is not None
    return Selector(config.retrieval, threshold=config.retrieval_threshold)


def simulator_options(
    config: RunConfig, policy: Policy, selector: Selector | None
) -> dict[str, Any]:
    """Return the options of a run's simulator: it draws only what somebody looks at."""
    wanted = {*policy.cameras, *([selector.camera] if selector else [])}
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
