"""Writers of subgoals by their text: `oracle`, or a model."""

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from robomme_interference_data.evaluate.models.registry import make_model, model_identity, pin_model
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.systems import System
from robomme_interference_data.runtime.specs import bind_options

from .model_writer import ModelWriter
from .writer import ORACLE, OracleWriter, SubgoalWriter


def pin_subgoals(text: str | None) -> str | None:
    """Return the one text of a writer: a model on the Hub has its commit; None stays None."""
    return text if text in (None, ORACLE) else pin_model(str(text))


def make_writer(config: RunConfig) -> SubgoalWriter | None:
    """Make what writes the subgoals of a run, in this process; None if nothing does."""
    if config.subgoals in (None, ORACLE):
        return None if config.subgoals is None else OracleWriter()
    own, others = _parted(config.subgoal_options)
    model = make_model(str(config.subgoals), others, _own_names())
    return ModelWriter(model, str(config.subgoal_prompt), **_bound(config.subgoals, own))


def describe_subgoals(config: RunConfig, system: System) -> tuple[RunConfig, dict[str, Any]]:
    """Make what writes subgoals once, ask what it is, and release it."""
    if config.subgoals not in (None, ORACLE):
        config = replace(config, subgoal_prompt=config.subgoal_prompt or system.prompt)
    writer = make_writer(config)
    if writer is None:
        return config, {}
    try:
        return config, {"subgoals": writer.metadata()}
    finally:
        writer.close()


def subgoals_identity(config: RunConfig, metadata: Mapping[str, Any]) -> Any:
    """Return what of the subgoals can change a result, as plain values; None without any."""
    if config.subgoals in (None, ORACLE):
        return config.subgoals
    own, others = _parted(config.subgoal_options)
    writer = metadata["subgoals"]
    model = model_identity(str(config.subgoals), others, writer["model"])
    prompt = {"prompt_sha256": writer["prompt_sha256"]}
    return model | prompt | _bound(config.subgoals, own)


def _parted(options: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the options of `ModelWriter`, and those of the model."""
    names = _own_names()
    own = [one for one in options if one.partition("=")[0] in names]
    return own, [one for one in options if one not in own]


def _own_names() -> list[str]:
    kinds = inspect.signature(ModelWriter).parameters.values()
    return [one.name for one in kinds if one.kind is inspect.Parameter.KEYWORD_ONLY]


def _bound(text: Any, options: Sequence[str]) -> dict[str, Any]:
    return bind_options(f"model {text!r}", ModelWriter, {"model": None, "prompt": ""}, options)
