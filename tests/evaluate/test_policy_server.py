"""The policy server of the tests: its own account of the memory."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support import policy_server
from support.policy_calls import observation, rollout
from support.policy_server import Memory

from robomme_interference_data.evaluate.policies.websocket import WebsocketPolicy


@pytest.mark.parametrize(
    ("calls", "text"),
    [
        (["add 1 0"], "reset first"),
        (["reset", "infer"], "history feats is empty, add buffer first"),
        (["reset", "add 3 2", "add 1 3"], "another length of the history"),
        (["reset", "add 1 0", "add 1 3"], "history after other frames"),
        (["reset", "add 2 1", "infer", "add 1 1"], "history after the first answer"),
        (["reset", "add 2 2", "infer"], "0 live frames before the first answer"),
        (["reset", "add 1 0", "infer", "infer"], "0 frames since the last answer"),
        (["reset", "add 1 0", "infer", "add 17 0", "infer"], "17 frames since the last answer"),
        (["reset", "add 4097 0"], "index 4096 is out of bounds"),
    ],
)
def test_the_servers_account_refuses_a_wrong_order(calls: list[str], text: str) -> None:
    memory = Memory(keep=False)
    seen = observation(0)
    message = {
        "observation/image": seen.images["front"],
        "observation/wrist_image": seen.images["wrist"],
        "observation/state": seen.state,
        "prompt": "pick",
    }

    def play(call: str) -> None:
        name, *numbers = call.split()
        if name == "reset":
            memory.reset()
        elif name == "infer":
            memory.infer(message)
        else:
            frames, start = map(int, numbers)
            images = np.zeros((frames, 1, 2, 2, 3), np.uint8)
            states = np.zeros((frames, 8), np.float32)
            memory.add_buffer({"images": images, "state": states, "exec_start_idx": start})

    for call in calls[:-1]:
        play(call)
    with pytest.raises(AssertionError, match=text):
        play(calls[-1])


def test_the_server_in_a_process_of_its_own(tmp_path: Path) -> None:
    log = tmp_path / "calls.jsonl"
    command = [sys.executable, policy_server.__file__, "--log", str(log)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            policy = WebsocketPolicy("127.0.0.1", int(address.rsplit(":", 1)[1]))
            rollout(policy, 20, [20], [16])
            policy.close()
        finally:
            process.kill()
    lines = [line for line in log.read_text(encoding="utf-8").splitlines() if line]
    assert [line.split('"')[3] for line in lines] == [
        "reset",
        "add_buffer",
        "add_buffer",
        "infer",
        "add_buffer",
        "infer",
    ]
