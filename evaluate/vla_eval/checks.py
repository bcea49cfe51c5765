"""What servers of vla-eval must declare and answer, to this project's client and to vla-eval's."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from vla_eval.protocol.messages import PROTOCOL_VERSION, Message, MessageType
from vla_eval.specs import GRIPPER_CLOSE_NEG, IMAGE_RGB, LANGUAGE, DimSpec

from robomme_interference_data.errors import PolicyServerError
from robomme_interference_data.simulators.episode import ACTION_SIZE

from .observations import ACTIONS, CAMERAS, HISTORIES, STATE, STATE_HISTORY

WRISTS = ("wrist", "wrist_image")
"""Names of the wrist camera in an observation spec."""

_IMAGES = ("image", "images", *CAMERAS.values(), *WRISTS, *HISTORIES.values())

_PARTS: Mapping[str, Mapping[str, DimSpec]] = {
    "action": {
        **dict.fromkeys(("actions", "action"), ACTIONS),
        "joints": replace(ACTIONS, dims=ACTION_SIZE - 1),
        "gripper": GRIPPER_CLOSE_NEG,
    },
    "observation": {
        **dict.fromkeys(_IMAGES, IMAGE_RGB),
        **dict.fromkeys(
            ("state", STATE_HISTORY),
            replace(STATE, accepts=frozenset({STATE.format, "joint_positions"})),
        ),
        "language": LANGUAGE,
    },
}
"""What a server may declare of actions and observations."""

_ASKED = ("send_wrist_image", "send_state", "send_video_history")
"""What a server may ask for."""


def check_hello(server: str, hello: Mapping[str, Any]) -> None:
    """Check that a server speaks this protocol, reads what is sent and returns what is executed."""
    version = hello.get("protocol_version")
    if version != PROTOCOL_VERSION:
        raise PolicyServerError(
            f"policy server {server} speaks version {version} of vla-eval's protocol (it has "
            f"vla-eval {hello.get('harness_version')}); expected version {PROTOCOL_VERSION}",
            "Install the same vla-eval on both sides.",
        )
    faults = [
        f"asks for {name}, which is not sent"
        for name, value in hello.get("observation_params", {}).items()
        if name.startswith("send_") and value and name not in _ASKED
    ]
    for what, known in _PARTS.items():
        for name, part in hello.get(f"{what}_spec", {}).items():
            declaration = f"declares the {what} {name} ({part['dims']} values, {part['format']})"
            if name not in known:
                faults.append(f"{declaration}; expected {', '.join(known)}")
                continue
            size, formats = known[name].dims, known[name].accepts or {known[name].format}
            if part["dims"] not in (0, size) or part["format"] not in formats:
                expected = f"{size} values, {' or '.join(sorted(formats))}"
                faults.append(f"{declaration}; expected {expected}")
    sizes = [part["dims"] for part in hello.get("action_spec", {}).values()]
    if sizes and all(sizes) and sum(sizes) != ACTION_SIZE:
        faults.append(f"declares {sum(sizes)} action values; expected {ACTION_SIZE}")
    if faults:
        raise PolicyServerError(
            f"policy server {server} ({hello.get('model_server')}) does not fit: it "
            f"{'; it '.join(faults)}",
            "docs/how-to/connect-a-policy.md lists what is sent and what is executed.",
        )


def fault_of(answer: Message, expected: MessageType, seq: int) -> tuple[str, str] | None:
    """Return what is wrong with the answer to message `seq`, and what to do; None if nothing."""
    if answer.type is MessageType.ERROR:
        what = answer.payload.get("error", answer.payload)
        return f"reports: {what}", "See the server's log for the traceback."
    if (answer.type, answer.seq) != (expected, seq):
        return (
            f"sends {answer.type.value} {answer.seq}; expected {expected.value} {seq}",
            "A server must answer every observation, and each once.",
        )
    if expected is MessageType.ACTION and actions_of(answer.payload) is None:
        keys = ", ".join(map(str, answer.payload))
        return f"answers without actions: {keys}", "Return them under the key `actions`."
    return None


def actions_of(content: Mapping[str, Any]) -> Any:
    """Return the actions of an answer; None if it has none."""
    return content.get("actions", content.get("action"))
