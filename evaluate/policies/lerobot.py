"""LeRobot policies, from a folder or the Hub, with the processors that were saved with them.

What can be seen from the configuration is checked when the policy is made; the weights are
loaded at the first rollout.
"""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION, CAMERA_PREFIX, FRONT, STATE, WRIST
from robomme_interference_data.evaluate.policies.base import Frames, RolloutInfo
from robomme_interference_data.evaluate.policies.checks import (
    ACTION_SIZE,
    check_actions,
    check_frames,
)
from robomme_interference_data.evaluate.policies.lerobot_files import (
    check_features,
    choose_device,
    digest_files,
    explained,
    feature_names,
    find_policy,
)
from robomme_interference_data.simulators.base import Observation

__all__ = ["LeRobotPolicy"]

_MOST_ACTIONS = 16  # more are never executed


class LeRobotPolicy:
    """A policy trained with LeRobot, such as one of its ACT, diffusion or VLA models.

    A policy that acts on one observation takes no history and runs `no-history` only. One that
    acts on the last few (`n_obs_steps` above 1, as diffusion policies do) gets them in its own
    queue: at first the end of the history, then live ones.

    Args:
        path: Folder that `save_pretrained` wrote, or a model on the Hub, `namespace/name` or
            `namespace/name@revision`.
        device: `cpu`, `cuda` or `cuda:1`; by default the first GPU, if there is one.

    Raises:
        InvalidOptionError: The device is not there.
        MissingFileError: There is no such folder, or a file is missing in it.
        HubError: The Hub does not know the model, or cannot be reached.
        MissingExtraError: Its kind of policy needs more libraries.
        PolicyError: It wants what the simulators do not give, or gives other actions.
    """

    privileged = False

    def __init__(self, path: str, *, device: str | None = None):
        self._device = choose_device(device)
        self._folder, self._source = find_policy(path)
        with explained(path):
            self._config = PreTrainedConfig.from_pretrained(self._folder)
            self._config.device = self._device
            self._config.pretrained_path = self._folder
            self._before, self._after = make_pre_post_processors(
                self._config,
                pretrained_path=str(self._folder),
                preprocessor_overrides={"device_processor": {"device": self._device}},
            )
        names = feature_names(self._before)
        check_features(path, self._config, names)
        wanted = [name for name in (FRONT, WRIST) if names[name] in self._config.input_features]
        self.cameras = tuple(name.removeprefix(CAMERA_PREFIX) for name in wanted)
        self._steps = int(self._config.n_obs_steps or 1)
        self.wants_history = self.every_frame = self._steps > 1
        self.history_cameras = self.cameras if self.wants_history else ()
        self._model: Any = None
        self._recent: deque[dict[str, Any]] = deque(maxlen=self._steps)
        self._seed = self._asked = 0

    def reset(self, info: RolloutInfo) -> None:
        """Empty the policy's queues, loading its weights first if need be.

        Raises:
            MissingExtraError: Its kind of policy needs more libraries.
            PolicyError: The weights cannot be loaded.
        """
        if self._model is None:
            with explained(str(self._folder)):
                kind = get_policy_class(self._config.type)
                self._model = kind.from_pretrained(self._folder, config=self._config, strict=True)
        self._model.reset()
        self._before.reset()
        self._after.reset()
        self._recent.clear()
        self._seed, self._asked = info.seed, 0

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        """Keep the last few frames; a policy that acts on one observation keeps none."""
        if self.wants_history:
            self._keep(frames, states)

    def observe(self, frames: Frames, states: NDArray[np.float32]) -> None:
        """Keep the last few frames."""
        self._keep(frames, states)

    def _keep(self, frames: Frames, states: NDArray[np.float32]) -> None:
        images = {camera: check_frames(frames, states, camera) for camera in self.cameras}
        for index in range(max(0, len(states) - self._steps), len(states)):
            shown = {camera: part[index].copy() for camera, part in images.items()}
            self._recent.append(self._prepared(shown, states[index]))

    def _prepared(
        self, images: dict[str, NDArray[np.uint8]], state: NDArray[np.float32]
    ) -> dict[str, Any]:
        """Return an observation as LeRobot's processors take it: batches of one, images 0 to 1."""
        prepared: dict[str, Any] = {}
        for camera, image in images.items():
            pixels = torch.from_numpy(image).permute(2, 0, 1).to(torch.float32) / 255
            prepared[CAMERA_PREFIX + camera] = pixels.contiguous()[None]
        prepared[STATE] = torch.from_numpy(np.array(state, np.float32))[None]
        return prepared

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return a chunk of actions, `(n, 8) float32`, n at most 16.

        Raises:
            PolicyError: The policy gives none that can be executed.
        """
        if not self._recent:  # asked again without a new observation
            shown = {camera: observation.images[camera] for camera in self.cameras}
            self._recent.append(self._prepared(shown, observation.state))
        *earlier, last = [self._before(one | {"task": [goal]}) for one in self._recent]
        self._recent.clear()
        with torch.inference_mode(), self._seeded():
            if self._has_queue:
                for one in earlier:
                    self._enqueue(one)
                chunk = self._ask(last)
            else:
                chunk = self._predict(last)
            # One at a time: a step may refer to the one observation that was processed.
            actions = [self._after(action) for action in chunk[:_MOST_ACTIONS]]
        return check_actions(torch.cat(actions).to("cpu", torch.float32).numpy())

    @property
    def _has_queue(self) -> bool:
        """Whether the policy keeps observations in a queue, beside its queue of actions."""
        queues = getattr(self._model, "_queues", None) or {}
        return ACTION in queues and len(queues) > 1

    def _enqueue(self, one: dict[str, Any]) -> None:
        """Put an observation into the policy's queue without having it predict anything."""
        actions = self._model._queues[ACTION]
        actions.clear()
        # It predicts only when no action is left: this one it hands back.
        actions.append(torch.zeros(1, ACTION_SIZE))
        self._model.select_action(one)

    def _ask(self, one: dict[str, Any]) -> list[torch.Tensor]:
        """Return all actions, `(1, 8)` each, that the policy queues for an observation."""
        self._model._queues[ACTION].clear()
        first = self._model.select_action(one)
        rest = list(self._model._queues[ACTION])
        self._model._queues[ACTION].clear()
        return [first, *rest]

    def _predict(self, one: dict[str, Any]) -> list[torch.Tensor]:
        if getattr(self._config, "temporal_ensemble_coeff", None) is not None:
            return [self._model.select_action(one)]  # it averages over the chunks of every step
        chunk = self._model.predict_action_chunk(one)
        steps = int(getattr(self._config, "n_action_steps", None) or chunk.shape[1])
        return list(chunk[:, :steps].unbind(1))

    @contextmanager
    def _seeded(self) -> Iterator[None]:
        """Draw from the rollout's seed, and leave PyTorch's generators as they were."""
        devices = [torch.device(self._device)] if self._device.startswith("cuda") else []
        with torch.random.fork_rng(devices):
            torch.manual_seed((self._seed << 16) + self._asked)
            self._asked += 1
            yield

    def metadata(self) -> dict[str, Any]:
        """Return what is loaded, with the SHA-256 of its files, and the device.

        All files are read for it, which takes seconds for a large model.
        """
        return {
            "policy": "lerobot",
            "source": self._source,
            "sha256": digest_files(self._folder),
            "type": self._config.type,
            "n_obs_steps": self._steps,
            "device": self._device,
        }

    def close(self) -> None:
        """Let go of the weights."""
        self._model = None
