"""Servers of vla-eval for tests: `python -m support.vla_eval_servers NAME PORT`."""

import sys
from typing import Any, ClassVar

import numpy as np
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import serve
from vla_eval.specs import IMAGE_RGB, RAW


class Blind(PredictModelServer):
    """Holds the pose that it sees: it did not ask for histories."""

    params: ClassVar[dict[str, Any]] = {"send_state": True}

    def __init__(self) -> None:
        super().__init__(chunk_size=None)

    def get_observation_params(self) -> dict[str, Any]:
        return self.params

    def get_action_spec(self) -> dict[str, Any]:
        return {"actions": RAW}

    def get_observation_spec(self) -> dict[str, Any]:
        return {"agentview": IMAGE_RGB, "state": RAW}

    def predict(self, obs: Any, ctx: Any) -> Any:
        return {"actions": pose(obs["states"])}


class Remembering(Blind):
    """Repeats the lesson's pose that the simulator of `worlds` asks for, out of its memory."""

    params: ClassVar = {"send_state": True, "send_wrist_image": True, "send_video_history": True}

    def __init__(self) -> None:
        super().__init__()
        self.memory = dict[str, Any]()

    def predict(self, obs: Any, ctx: Any) -> Any:
        if obs.get("episode_restart"):
            self.memory[ctx.session_id] = obs.get("state_history")
            history = obs.get("video_history", []), obs.get("wrist_video_history", [])
            assert {len(one) for one in history} == {len(obs.get("state_history", []))}
        states = self.memory[ctx.session_id]
        return {"actions": pose(obs["states"] if states is None else states[3])}


class Refusing(Remembering):
    """Raises at the goals of one family."""

    def predict(self, obs: Any, ctx: Any) -> Any:
        if "VideoRepick" in obs["task_description"]:
            raise RuntimeError("this goal is odd")
        return super().predict(obs, ctx)


def pose(state: Any) -> Any:
    return np.append(np.asarray(state)[:7], 1.0).astype(np.float32)


if __name__ == "__main__":
    serve(globals()[sys.argv[1]](), "127.0.0.1", int(sys.argv[2]))
