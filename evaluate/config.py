"""What a run is: its settings, and which of them make it that run."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import InvalidOptionError, RunFolderError
from robomme_interference_data.evaluate.rows import PROTOCOL_VERSION
from robomme_interference_data.retrieval.select import Rule

__all__ = [
    "IDENTITY",
    "RunConfig",
    "check_same_run",
    "default_system",
    "identity",
]

IDENTITY = (
    "system",
    "simulator",
    "revision",
    "episode_split",
    "model_seed",
)
"""Settings that are part of what a run is, as they stand. Of the policy's and the retrieval step's
only a part can change a result: `policy_identity` and `Selector.identity` say which."""

_MAX, _FRONT = "max", "front"
"""The paper's rule of the retrieval step, and the camera that it looks at."""


@dataclass(frozen=True)
class RunConfig:
    """The settings of a run.

    Attributes:
        system: Name under which the rows stand.
        policy: Which policy, as `make_policy` reads it; a model on the Hub with its commit.
        memory: Memory rule of `replay`; None for other policies.
        simulator: Name of the simulator.
        split: Folder of the split of buffers.
        split_name: Label of the split in rows: `Split.name` when the run's folder was made.
        revision: `Split.revision`.
        episode_split: `train`, `val` or `test`.
        model_seed: Seed for the policy.
        retrieval: Encoder of the retrieval step, or None.
        retrieval_rule: How it chooses, `METHOD` or `METHOD/CUT`.
        retrieval_camera: Camera whose frames it compares.
        robomme_python: Interpreter of the official simulator, or None.
        check_lesson: Whether to compare the dataset's lesson with the simulator's.
        videos: Whether to write videos.
        workers: Worker processes.
        rollout_s: Seconds that a rollout may take.
        simulator_s: Seconds that a reset, or up to 16 steps, may take.
        cache: Whether to keep decoded history frames on disk, for later conditions and runs.
        history_chunk: Frames of history handed over at a time.
        max_errors: Errors in a row after which the run stops.
        policy_options: The policy's options by name, without `memory`.
    """

    system: str
    policy: str
    memory: str | None
    simulator: str
    split: str
    split_name: str
    revision: str
    episode_split: str = "test"
    model_seed: int = 0
    retrieval: str | None = None
    retrieval_rule: str = _MAX
    retrieval_camera: str = _FRONT
    robomme_python: str | None = None
    check_lesson: bool = False
    videos: bool = False
    workers: int = 1
    rollout_s: float = 3600.0
    simulator_s: float = 1800.0
    cache: bool = False
    history_chunk: int = 64
    max_errors: int = 10
    policy_options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if "memory" in self.policy_options and (self.policy == "replay" or self.memory is not None):
            raise InvalidOptionError(
                "the memory rule is no --policy-option, as it also names the system",
                f"Give --memory {self.policy_options['memory']}.",
            )
        Rule.parse(self.retrieval_rule)  # checks itself, before a name is made of it
        if self.retrieval is None:
            for name, value, usual in (
                ("rule", self.retrieval_rule, _MAX),
                ("camera", self.retrieval_camera, _FRONT),
            ):
                if value != usual:
                    raise InvalidOptionError(
                        f"--retrieval-{name} {value} says nothing without a retrieval step",
                        "Add --retrieval ENCODER, such as --retrieval siglip, or leave it out.",
                    )
        try:
            json.dumps(self.policy_options)
        except (TypeError, ValueError):
            raise InvalidOptionError(
                f"policy options {dict(self.policy_options)!r} cannot be written down",
                "Expected text, numbers, True, False, None, or lists of them.",
            ) from None

    @property
    def policy_arguments(self) -> dict[str, Any]:
        """The options that the policy is made with."""
        memory = {} if self.memory is None else {"memory": self.memory}
        return memory | dict(self.policy_options)


def default_system(
    policy: str,
    memory: str | None = None,
    retrieval: str | None = None,
    retrieval_rule: str = _MAX,
    retrieval_camera: str = _FRONT,
) -> str:
    """Return the name under which rows stand if none is given.

    That is the policy's own, `retrieval-…` with a retrieval step, and what is not usual of the
    step behind it, such as `retrieval-replay-window-oracle`. Arguments as in `RunConfig`.

    Raises:
        InvalidOptionError: The policy does not say which system it is.
    """
    kind, _, target = policy.partition(":")
    if kind == "websocket":
        raise InvalidOptionError(
            f"the rows of {policy} need the name of the system that it serves",
            "Give --system, such as perceptual-framesamp-modul, or a name of your own: see "
            "docs/systems.md.",
        )
    if kind == "lerobot":  # folders are called alike (pretrained_model), and so are revisions
        raise InvalidOptionError(
            f"the rows of {policy} need a name: that of a folder or repository does not tell one "
            "checkpoint from another",
            f"Give one of your own: --policy {policy} --system act-20000",
        )
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", target.rstrip("/").split("/")[-1]).strip("-")
    if policy == "replay":
        name = f"replay-{memory or 'full'}"
    name = name or policy
    if retrieval is None:
        return name
    rule, camera = retrieval_rule.replace("/", "-"), retrieval_camera
    unusual = [*([rule] if rule != _MAX else []), *([camera] if camera != _FRONT else [])]
    return "-".join(("retrieval", name, *unusual))


def identity(
    config: RunConfig,
    policy: Mapping[str, Any],
    simulator_version: str | None,
    retrieval_index: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return what makes the run the one that it is, as plain values.

    Args:
        config: The settings.
        policy: What can change a result of the policy; see `policies.options.policy_identity`.
        simulator_version: Version of the suite of episodes; None where it is not known.
        retrieval_index: What the choices of the retrieval step depend on; see
            `Selector.identity`. None without the step.
    """
    return {
        **{name: getattr(config, name) for name in IDENTITY},
        **policy,
        "simulator_version": simulator_version,
        "retrieval_index": None if retrieval_index is None else dict(retrieval_index),
        "protocol_version": PROTOCOL_VERSION,
    }


def check_same_run(folder: Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Check that a folder's run is the one that is wanted.

    Raises:
        RunFolderError: It is another; names every difference.
    """
    there, here = _flat(found), _flat(wanted)
    names = sorted({*there, *here}, key=lambda name: (name not in here, name))
    told = [
        f"{name} is {there.get(name, _NONE)} there, {here.get(name, _NONE)} here"
        for name in names
        if there.get(name, _NONE) != here.get(name, _NONE)
    ]
    if told:
        raise RunFolderError(
            f"{folder} holds another run: {'; '.join(told)}",
            "Give another --out, or the settings of the run that is there (see run.json).",
        )


_NONE = "not known"


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return values as text, those of inner maps under names such as `policy_metadata.sha256`."""
    flat: dict[str, str] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = repr(value)
    return flat
