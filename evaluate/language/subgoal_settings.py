"""What the settings of a run say of its subgoals: `oracle`, or a vision-language model.

It is imported for runs with subgoals only.
"""

import inspect
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

from robomme_interference_data.constants import ORACLE
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.policies.registry import policy_options
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.identity import short_digest
from robomme_interference_data.runtime.specs import bind_options

from .models import MODELS
from .prompt_files import prompted_identity
from .published_prompts import PUBLISHED, load_published
from .subgoal_prompt import DEFAULT_PROMPT
from .subgoal_writers import ModelWriter, OracleWriter, SubgoalWriter

_WRITER_OPTIONS = [
    parameter.name
    for parameter in inspect.signature(ModelWriter).parameters.values()
    if parameter.kind is inspect.Parameter.KEYWORD_ONLY
]


def pin_subgoals(text: str) -> str:
    """Return the full text of a writer, with the commit of a model on the Hub."""
    return text if text == ORACLE else MODELS.pin(text)


def make_writer(config: RunConfig) -> SubgoalWriter:
    """Make the subgoal writer of a run that has one."""
    if config.subgoals == ORACLE:
        return OracleWriter()
    writer_options, model_options = _split(config)
    model = MODELS.make(str(config.subgoals), model_options, _WRITER_OPTIONS)
    prompt = load_published(config.subgoal_prompt or DEFAULT_PROMPT, config.system)
    return ModelWriter(model, prompt, **writer_options)


def with_published(config: RunConfig) -> RunConfig:
    """Return the settings with the options of a published system, and check its prompt.

    Raises:
        InvalidOptionError: The prompt, or an option that is set, is another one.
    """
    published = PUBLISHED.get(config.system or "")
    if published is None or config.subgoals == ORACLE:
        return config
    text = str(config.subgoals)
    if MODELS.parse(text).kind != "openai":
        raise InvalidOptionError(
            f"{config.system} sends its history as a video, and {text} takes images",
            "Serve the model behind an endpoint: see docs/how-to/official-simulator.md.",
        )
    names = {option.partition("=")[0] for option in config.subgoal_options}
    added = [f"{name}={value}" for name, value in published.options.items() if name not in names]
    config = replace(config, subgoal_options=(*config.subgoal_options, *added))
    writer_options, model_options = _split(config)
    options = writer_options | MODELS.options(text, model_options, _WRITER_OPTIONS)
    prompt = load_published(config.subgoal_prompt or DEFAULT_PROMPT, config.system)
    published.check(str(config.system), prompt, options)
    return config


def describe_subgoals(config: RunConfig) -> dict[str, Any]:
    """Return the metadata of the writer."""
    with closing(make_writer(config)) as writer:
        return {"subgoals": writer.metadata()}


def subgoals_identity(config: RunConfig, metadata: Mapping[str, Any]) -> Any:
    """Return what of the subgoals can change a result, given `describe_subgoals`' metadata."""
    if config.subgoals == ORACLE:
        return ORACLE
    writer_options, model_options = _split(config)
    text = str(config.subgoals)
    return prompted_identity(text, model_options, metadata["subgoals"]) | writer_options


def subgoals_text(config: RunConfig, metadata: Mapping[str, Any]) -> str:
    """Return what writes subgoals as `SystemFacts` have it; see `subgoals_identity`."""
    if config.subgoals == ORACLE:
        points = policy_options(config.policy, config.policy_options).get("points", True)
        return ORACLE if points else f"{ORACLE} in words"
    kind = MODELS.parse(str(config.subgoals)).kind
    return f"{kind} {short_digest(subgoals_identity(config, metadata))}"


def _split(config: RunConfig) -> tuple[dict[str, Any], Sequence[str]]:
    """Return the options of `ModelWriter`, defaults included, and those of the model."""
    own = [
        option for option in config.subgoal_options if option.partition("=")[0] in _WRITER_OPTIONS
    ]
    what = f"model {config.subgoals!r}"
    bound = bind_options(what, ModelWriter, {"model": None, "prompt": ""}, own)
    return bound, [option for option in config.subgoal_options if option not in own]
