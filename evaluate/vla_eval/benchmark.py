"""RoboMME-Interference as a benchmark of vla-eval: `vla-eval run` plays it against its servers."""

from dataclasses import fields, replace
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.specs import DimSpec
from vla_eval.types import Action, EpisodeResult, Task
from vla_eval.types import Observation as ServerObservation

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.errors import InvalidOptionError, RunError, UnknownNameError, counted
from robomme_interference_data.evaluate.rollout.runner import plan_rollouts
from robomme_interference_data.evaluate.rollout.worker import RolloutFunction
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.row import row_line, row_of
from robomme_interference_data.evaluate.run.worker import Job
from robomme_interference_data.ids import EpisodeId, count_numbers, nth_number
from robomme_interference_data.runtime.tasks import Worker
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.simulators.episode import Observation

from .checks import actions_of
from .configuration import check_label, check_robot
from .harness_connection import CheckedConnections
from .observations import ACTION_SPEC, CAMERAS, OBSERVATION_SPEC, ObservingPolicy

SETTINGS = (
    # Which rollouts:
    "conditions",
    "families",
    "episodes",
    "split",
    "training_seed",
    "model_seed",
    # The simulator:
    "simulator",
    "simulator_python",
    "simulator_options",
    "shift",
    "check_lesson",
    # The retrieval step:
    "retrieval",
    "retrieval_rule",
    "retrieval_camera",
)
"""Settings of `evaluate` that the benchmark takes too."""


class HarnessPolicy(ObservingPolicy):
    """Passes requests of a rollout to another thread, and waits for the answers.

    Attributes:
        requests: Observations as servers get them, then the row of the rollout, or what it raised.
        answers: Actions, `(n, 8) float32`, or None to end the rollout.
    """

    def __init__(self, wrist: bool = False, history: bool = False, state: bool = True):
        self.cameras = tuple(CAMERAS)[: 1 + wrist]
        self.history_cameras = self.cameras if history else ()
        self.wants_history, self.sends_state = history, state
        self.other_states = "refuse" if state else "omit"
        self.requests, self.answers = SimpleQueue[Any](), SimpleQueue[Any]()

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the answer to a request."""
        self.requests.put(self.message(observation, goal))
        if (actions := self.answers.get()) is None:
            raise RunError("vla-eval ended the rollout")
        return cast("NDArray[np.float32]", actions)

    def metadata(self) -> dict[str, Any]:
        """Return nothing: vla-eval records what its server reports."""
        return {}


class RoboMMEInterference(StepBenchmark):  # type: ignore[misc]
    """Rollouts under the conditions of a buffer set, with a server of vla-eval as the policy.

    A task is a family under a condition, such as `MoveCube/k7`; its episode n is the n-th query
    episode of the family. A rollout runs as in `evaluate`, and its row is in the `metrics`.

    Args:
        buffer_set: Folder of the buffer set, or `NAMESPACE/NAME` on the Hub.
        system: Label of the rows; not one of the paper's, whose servers speak another protocol.
        send_wrist_image: Whether the server gets the wrist camera, live and of the history.
        send_state: Whether it gets the states, live and of the history.
        send_video_history: Whether it gets the history. vla-eval sets this and the two above as
            the server asks, unless its configuration names them.
        settings: `SETTINGS`, as the options of `evaluate`. By default the conditions are all that
            apply.

    Raises:
        InvalidOptionError: Settings have other types, or do not fit each other, the buffer set or
            the simulator; or a condition has a history, and the server did not ask for it.
        UnknownNameError: A setting is unknown; or a family, condition or episode.
    """

    render_backends: ClassVar[frozenset[str]] = frozenset({"gpu", "cpu"})

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """Set nothing: the simulators draw with the machine's Vulkan driver."""
        return {}

    def __init__(
        self,
        buffer_set: str,
        system: str,
        *,
        send_wrist_image: bool = False,
        send_state: bool = True,
        send_video_history: bool = False,
        **settings: Any,
    ):
        super().__init__()
        if unknown := sorted({*settings} - {*SETTINGS}):
            raise UnknownNameError.among("setting", unknown[0], "the benchmark", SETTINGS)
        defaults = {field.name: field.default for field in fields(RunConfig)}
        chosen = {name: _typed(name, value, defaults[name]) for name, value in settings.items()}
        _typed("buffer_set", buffer_set, "")
        _typed("send_wrist_image", send_wrist_image, False)
        _typed("send_state", send_state, False)
        _typed("send_video_history", send_video_history, False)
        check_label(_typed("system", system, ""))
        opened = load_buffer_set(buffer_set)
        options = {"wrist": send_wrist_image, "history": send_video_history, "state": send_state}
        config = RunConfig(
            policy=f"python:{__name__}:{HarnessPolicy.__name__}",
            policy_options=tuple(f"{name}={value}".lower() for name, value in options.items()),
            buffer_set=opened.location,
            out=Path(),  # vla-eval writes the results
            system=system,
            **chosen,
        )
        check_robot(opened, config.simulator)
        with_history = [name for name in config.conditions if name != NO_HISTORY]
        if with_history and not send_video_history:
            raise InvalidOptionError(
                "the server did not ask for histories: its observation_params have no "
                f"send_video_history, and {', '.join(with_history)} would be {NO_HISTORY}",
                f"Set `conditions` to [{NO_HISTORY}], or serve a model with a memory.",
            )
        planned = plan_rollouts(config, opened)
        self._plan = planned.plan
        # Which server plays is not known here: without an identity, its rows are paired with none.
        facts = replace(planned.run.facts, policy="vla-eval", policy_id=None)
        self._run = replace(planned.run, facts=facts)
        self._policy = HarnessPolicy(**options)
        self._rollouts = RolloutFunction(self._run.config, policy=self._policy)
        # A rollout asks its policy for actions, and vla-eval asks its benchmark for observations:
        # each has its own thread. A simulator that hangs does not keep the process from its end.
        self._jobs = SimpleQueue[Job[RunConfig] | None]()
        self._thread = Thread(target=self._work, name="rollouts", daemon=True)
        self._thread.start()
        self._running = False
        self._connections = CheckedConnections(self._policy.cameras)
        self._connections.begin()

    def get_tasks(self) -> list[Task]:
        """Return the tasks, with what identifies the rows of each."""
        tasks = []
        for group, numbers in self._plan.episodes.items():
            for condition in self._plan.conditions:
                episode = EpisodeId.parse(f"{group}/{nth_number(numbers, 0)}")
                key = self._run.key(WorkItem(condition, episode)) | {"episode": numbers}
                key |= to_dict(self._run.facts)
                name = f"{episode.family}/{condition}"
                tasks.append({"name": name, "suite": episode.family, **key})
        return tasks

    def get_metadata(self) -> dict[str, Any]:
        """Return the benchmark's limit of steps."""
        return {"max_steps": MAX_STEPS}

    def get_action_spec(self) -> dict[str, DimSpec]:
        """Return what an action is."""
        return ACTION_SPEC

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """Return what an observation holds."""
        names = ["language", *(CAMERAS[camera] for camera in self._policy.cameras)]
        if self._policy.sends_state:
            names.append("state")
        return {name: OBSERVATION_SPEC[name] for name in names}

    def reset(self, task: Task) -> ServerObservation:
        """Begin the rollout of an episode; return what the server gets first."""
        self._stop()
        numbers, index = task["episode"], task["episode_idx"]
        if (number := nth_number(numbers, index)) is None:
            count = count_numbers(numbers)
            raise InvalidOptionError(
                f"{task['name']} has {counted(count, 'episode')}, and vla-eval asks for number "
                f"{index}, from 0",
                f"Set `episodes_per_task` to {count}.",
            )
        episode = EpisodeId(task["family"], task["split"], number)
        self._jobs.put(Job(WorkItem(task["condition"], episode), self._run))
        self._running = True
        return self._next().obs

    def step(self, action: Action) -> StepResult:
        """Execute a server's action, or a chunk of them."""
        self._policy.answers.put(np.atleast_2d(np.asarray(actions_of(action), np.float32)))
        return self._next()

    def make_obs(self, raw_obs: ServerObservation, task: Task) -> ServerObservation:
        """Return what the server gets: the rollout's policy made it."""
        return raw_obs

    def get_step_result(self, step_result: StepResult) -> EpisodeResult:
        """Return the row of the rollout."""
        if not step_result.done:
            raise RunError(
                "`max_steps` of vla-eval's configuration ended the rollout; expected at least the "
                f"{MAX_STEPS} of the benchmark",
                "Leave it out.",
            )
        return step_result.info

    def cleanup(self) -> None:
        """End the simulator."""
        self._connections.end()
        self._stop()
        self._jobs.put(None)
        self._thread.join()

    def _work(self) -> None:
        """Run one rollout after the other, in the second thread."""
        while (job := self._jobs.get()) is not None:
            try:
                row, _ = self._rollouts(job, Worker())
                self._policy.requests.put(row_of(row_line(row)))  # raises what no file can hold
            except Exception as error:
                self._policy.requests.put(error)
            except BaseException as error:  # such as SystemExit: the other thread must not wait
                self._policy.requests.put(RunError(f"the rollout raised {error!r}"))
        self._rollouts.close()

    def _next(self) -> StepResult:
        """Wait for the rollout to ask for an action, or to end."""
        request = self._policy.requests.get()
        if isinstance(request, dict):
            return StepResult(request, 0.0, False, {})
        self._running = False
        if isinstance(request, Exception):
            raise request
        return StepResult(None, float(request.success), True, to_dict(request))

    def _stop(self) -> None:
        """Stop a rollout whose server failed."""
        if self._running:
            self._policy.answers.put(None)
            while isinstance(self._policy.requests.get(), dict):
                pass
        self._running = False


_TYPES: dict[type, tuple[type, str]] = {
    tuple: (list, "a list, such as [k0] or [MoveCube]"),
    bool: (bool, "true or false"),
    int: (int, "a whole number"),
}
"""Type of a setting's default to its type in YAML; that of all others is text."""


def _typed(name: str, value: Any, default: Any) -> Any:
    """Return a setting out of YAML if it has the type of its default; a list as a tuple."""
    kind, expected = _TYPES.get(type(default), (str, "text, in quotes if it is a number"))
    if type(value) is not kind:
        raise InvalidOptionError.expected(name, value, expected, "Correct it in `params`.")
    return tuple(value) if isinstance(value, list) else value
