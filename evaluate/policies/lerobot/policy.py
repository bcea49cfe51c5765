"""LeRobot policies, from a folder or the Hub, with the processors that were saved with them.

The configuration is checked when the policy is made; weights are loaded at the first rollout.
"""

import copy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from lerobot.policies.factory import get_policy_class
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION, ACTION_CHUNK, CAMERA_PREFIX, FRONT, WRIST
from robomme_interference_data.evaluate.policies.policy import BatchPolicy, Frames, RolloutInfo
from robomme_interference_data.runtime.device import choose_device
from robomme_interference_data.schema.other_states import check_rule
from robomme_interference_data.simulators.episode import ACTION_SIZE, Observation
from robomme_interference_data.storage.weights import digest_weights

from .checks import check_features, check_statistics, declared_memory, feature_names
from .files import POLICY_FILES, explained, find_policy, make_processors, read_config, read_training
from .observations import LastObservations, Observations, ObservationWithMemory


class LeRobotPolicy(BatchPolicy):
    """A policy trained with LeRobot, such as one of its ACT, diffusion or VLA models.

    A policy whose configuration declares a memory (`memory` and `image_size`) gets, with each
    observation, what that rule keeps of the history and of live frames, as `observation.memory.*`.
    Of the others, one that acts on one observation uses no history and runs under `no-history`
    only. One that acts on the last few (`n_obs_steps` above 1, such as diffusion policies) gets
    them in its own queue: first the end of the history, then live observations.

    Sessions of a policy act in one forward pass, unless it keeps such a queue, averages over chunks
    (temporal ensembling) or draws random numbers: then they act one after the other.

    Args:
        path: Folder that `save_pretrained` wrote, or a model on the Hub, `namespace/name` or
            `namespace/name@revision`.
        device: `cpu`, `cuda` or `cuda:1`; by default the first GPU, or else the CPU.
        other_states: What it gets of the states of units of another robot, see
            `Policy.other_states`.
    """

    def __init__(self, path: str, *, device: str | None = None, other_states: str = "refuse"):
        self.other_states = check_rule(other_states)
        self._device = str(choose_device(device))
        self._folder, self._source = find_policy(path)
        self._config = read_config(path, self._folder, self._device)
        self._memory = declared_memory(path, self._config)
        with explained(path):
            self._before, self._after = self._make_processors()
        check_features(path, self._config, self._before, self._memory)
        check_statistics(path, (*self._before.steps, *self._after.steps))
        names = feature_names(self._before, (FRONT, WRIST))
        wanted = [name for name in names if names[name] in self._config.input_features]
        self.cameras = tuple(name.removeprefix(CAMERA_PREFIX) for name in wanted)
        self._steps = int(self._config.n_obs_steps or 1)
        self.memory = None if self._memory is None else str(self._memory)
        self.wants_history = self.every_frame = self._memory is not None or self._steps > 1
        self.history_cameras = self.cameras if self.wants_history else ()
        self._observations = self._make_observations()
        self._model: Any = None
        self._seed = self._asked = 0
        self._draws = False  # whether it is known to draw random numbers

    def _make_processors(self) -> tuple[Any, Any]:
        return make_processors(self._config, self._folder, self._device)

    def _make_observations(self) -> Observations:
        if self._memory is None:
            return LastObservations(self.cameras, self._steps)
        return ObservationWithMemory(self.cameras, self._memory, self._config.image_size)

    def _load(self) -> None:
        if self._model is None:
            with explained(str(self._folder)):
                kind = get_policy_class(self._config.type)
                self._model = kind.from_pretrained(self._folder, config=self._config, strict=True)

    def session(self) -> "LeRobotPolicy":
        """Return a policy with its own memory and processors, loading the weights if necessary."""
        self._load()
        session = copy.copy(self)
        session._before, session._after = self._make_processors()
        session._observations = self._make_observations()
        # A copy of all that the model keeps between calls, whatever its type, but not of tensors.
        weights = (*self._model.parameters(), *self._model.buffers())
        session._model = copy.deepcopy(self._model, {id(tensor): tensor for tensor in weights})
        return session

    def reset(self, info: RolloutInfo) -> None:
        """Empty memory and queues, loading its weights first if necessary."""
        self._load()
        self._model.reset()
        self._before.reset()
        self._after.reset()
        self._observations.clear()
        self._seed, self._asked = info.seed, 0

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        """Keep frames of the history."""
        self._observations.add(frames, states)

    def observe(self, frames: Frames, states: NDArray[np.float32]) -> None:
        """Keep live frames."""
        self._observations.add(frames, states)

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return a chunk of actions, `(n, 8) float32`, n at most 16."""
        *earlier, last = self._processed(goal)
        with torch.inference_mode(), self._seeded():
            chunk = self._ask(earlier, last) if self._has_queue else self._predict(last)
            actions = self._finished(chunk)
        self._observations.acted()
        return actions

    def act_batch(
        self, sessions: Sequence[Any], observations: Sequence[Observation], goals: Sequence[str]
    ) -> list[NDArray[np.float32]]:
        """Return the chunks of several sessions, `(n, 8) float32` each; see the class."""
        batch = None
        if not (self._draws or self._ensembles or any(session._has_queue for session in sessions)):
            pairs = zip(sessions, goals, strict=True)
            batch = _stacked([session._processed(goal)[-1] for session, goal in pairs])
        if batch is not None:
            with torch.inference_mode(), self._seeded():
                before = self._generators()
                chunks = self._chunk(batch)
                self._draws = not all(map(torch.equal, before, self._generators()))
                if not self._draws:
                    parts = zip(sessions, chunks.unbind(), strict=True)
                    actions = [session._finished([*chunk[:, None]]) for session, chunk in parts]
                    for session in sessions:
                        session._observations.acted()
                    return actions
        # Each session has its own seed, which a batch could not follow.
        return [
            session.act(observation, goal)
            for session, observation, goal in zip(sessions, observations, goals, strict=True)
        ]

    def _processed(self, goal: str) -> list[dict[str, Any]]:
        """Return the last observations as the model takes them."""
        return [self._before(seen | {"task": [goal]}) for seen in self._observations.current()]

    def _finished(self, chunk: list[torch.Tensor]) -> NDArray[np.float32]:
        """Return the executed part of a chunk, `(n, 8)`, in the units of actions."""
        # One at a time: a processor step may refer to a single processed observation.
        actions = [self._after(action) for action in chunk[:ACTION_CHUNK]]
        result: NDArray[np.float32] = torch.cat(actions).to("cpu", torch.float32).numpy()
        return result

    @property
    def _has_queue(self) -> bool:
        """Whether the policy has a queue of observations besides its queue of actions."""
        queues = getattr(self._model, "_queues", None) or {}
        return ACTION in queues and len(queues) > 1

    def _ask(self, earlier: list[dict[str, Any]], last: dict[str, Any]) -> list[torch.Tensor]:
        """Return all actions, `(1, 8)` each, that the policy queues for its last observations."""
        queue = self._model._queues[ACTION]
        for processed in earlier:
            queue.clear()
            # The policy predicts only when no action is left: it returns this one.
            queue.append(torch.zeros(1, ACTION_SIZE))
            self._model.select_action(processed)
        queue.clear()
        first = self._model.select_action(last)
        rest = list(self._model._queues[ACTION])
        self._model._queues[ACTION].clear()
        return [first, *rest]

    @property
    def _ensembles(self) -> bool:
        """Whether it averages over the chunks of every step."""
        return getattr(self._config, "temporal_ensemble_coeff", None) is not None

    def _predict(self, processed: dict[str, Any]) -> list[torch.Tensor]:
        if self._ensembles:
            return [self._model.select_action(processed)]
        return list(self._chunk(processed).unbind(1))

    def _chunk(self, batch: dict[str, Any]) -> torch.Tensor:
        """Return the actions of B observations, `(B, n, 8)`."""
        chunk: torch.Tensor = self._model.predict_action_chunk(batch)
        steps = int(getattr(self._config, "n_action_steps", None) or chunk.shape[1])
        return chunk[:, :steps]

    def _generators(self) -> list[torch.Tensor]:
        """Return the states of PyTorch's random generators."""
        states = [torch.get_rng_state()]
        if self._device.startswith("cuda"):
            states.append(torch.cuda.get_rng_state(self._device))
        return states

    @contextmanager
    def _seeded(self) -> Iterator[None]:
        """Seed PyTorch for one call, and restore its generators afterwards."""
        devices = [torch.device(self._device)] if self._device.startswith("cuda") else []
        with torch.random.fork_rng(devices):
            # A seed for each call: a rollout has fewer than 1 << 16 of them.
            torch.manual_seed((self._seed << 16) + self._asked)
            self._asked += 1
            yield

    def metadata(self) -> dict[str, Any]:
        """Return the source, the SHA-256 of its files, its training, and the device."""
        return {
            "policy": "lerobot",
            "source": self._source,
            "sha256": digest_weights(self._folder, POLICY_FILES),
            "type": self._config.type,
            "n_obs_steps": self._steps,
            **read_training(self._folder),
            "device": self._device,
        }

    def close(self) -> None:
        """Release the weights."""
        self._model = None


def _stacked(items: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Return one batch of processed observations; None if they do not fit into one.

    Tensors, whose first dimension is 1, and lists are joined; anything else must be equal.
    """
    batch: dict[str, Any] = {}
    for name, first in items[0].items():
        values = [item[name] for item in items]
        if isinstance(first, torch.Tensor):
            if {value.shape for value in values} != {first.shape}:
                return None
            batch[name] = torch.cat(values)
        elif isinstance(first, list):
            batch[name] = [entry for value in values for entry in value]
        elif any(value != first for value in values):
            return None
        else:
            batch[name] = first
    return batch
