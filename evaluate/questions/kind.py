"""Questions as the work of a run: what is checked of them, and what identifies their run."""

import dataclasses
from collections.abc import Sequence
from contextlib import closing
from typing import Any

from robomme_interference_data.data.questions import digest_questions, read_questions
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    UnknownNameError,
    nearest,
)
from robomme_interference_data.evaluate.models.registry import (
    model_identity,
    parse_model,
    pin_model,
)
from robomme_interference_data.evaluate.run.config import (
    AskConfig,
    check_shared,
    non_default_retrieval,
)
from robomme_interference_data.evaluate.run.kind import Run, RunKind
from robomme_interference_data.evaluate.run.plan import Plan, WorkItem
from robomme_interference_data.evaluate.systems import known_system, name_system
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.schema.sampling import MEMORIES
from robomme_interference_data.simulators.registry import recorded_scene

from .responders import CONTROLS, OWN, ModelResponder
from .task import AskTask


class Questions(RunKind[AskConfig]):
    """Multiple-choice questions about what history buffers show."""

    def prepare(self) -> None:
        """Check the settings, and ask what answers."""
        config = self.config
        _check_settings(config)
        self._questions = read_questions(self.buffer_set)
        self.metadata, self._images = {"model": config.model}, None
        if config.model not in OWN:
            self.config = config = dataclasses.replace(config, model=pin_model(config.model))
        self.system = _name(config)
        if config.model not in OWN:
            with closing(ModelResponder(config)) as responder:
                self.metadata, self._images = responder.metadata(), responder.images

    def refusal(self, condition: str) -> InterferenceError | None:
        """Return why a condition does not apply, or None."""
        if self.config.retrieval is None or condition != NO_HISTORY:
            return None
        return InvalidOptionError(
            f"a retrieval step has nothing to retrieve from under {NO_HISTORY}",
            f"Leave {NO_HISTORY} out of `conditions`.",
        )

    def check(self, plan: Plan, items: Sequence[WorkItem]) -> None:
        """Check that what is shown fits, and that the ideal observer knows what is possible."""
        config = self.config
        if config.model == "recall":
            for episode in {item.episode for item in items}:
                if recorded_scene(self.buffer_set.query(episode)) is None:
                    raise InvalidOptionError(
                        f"recall does not know what may have been the answer in {episode}",
                        "Ask a model, or guess.",
                    )
        # How much of a history a retrieval step chooses is not known before.
        if self._images is None or (config.retrieval is not None and config.sampling == "full"):
            return
        for item in items:
            history = self.buffer_set.manifest(item.episode, item.condition).history_frames
            kept = len(MEMORIES[config.sampling](history, config.frames))
            if kept + 1 > self._images:
                raise InvalidOptionError(
                    f"{item.episode}, {item.condition}: {kept} frames are kept, and shown with "
                    f"the picture; the model takes {self._images} images at most",
                    f'Set model_options=("images={kept + 1}",), or fewer `frames`.',
                )

    def task(self, run: Run[AskConfig]) -> AskTask:
        """Return what asks."""
        return AskTask(run)

    def identity(self, plan: Plan) -> dict[str, Any]:
        """Return what of questions and model can change an answer."""
        config, model = self.config, self.metadata
        if config.model not in OWN:
            model = model_identity(config.model, config.model_options, model["model"])
            model["prompt_sha256"] = self.metadata["prompt_sha256"]
        return {
            "frames": config.frames,
            "sampling": config.sampling,
            "control": config.control,
            "model": model,
            "questions": digest_questions(self._questions.values()),
        }


def _check_settings(config: AskConfig) -> None:
    """Check the settings by themselves and against each other."""
    if config.sampling not in MEMORIES:
        raise InvalidOptionError.one_of("sampling", config.sampling, MEMORIES)
    if config.frames < 2:
        raise InvalidOptionError.expected("frames", config.frames, "2 or more")
    check_shared(config)
    if config.control not in CONTROLS:
        raise InvalidOptionError.one_of("control", config.control, CONTROLS)
    if config.model in OWN:
        unused = ["model_options", "control", "prompt"]
        if config.model == "guess":
            unused += ["frames", "sampling", "retrieval"]
        for name in unused:
            if getattr(config, name) != type(config).__dataclass_fields__[name].default:
                raise InvalidOptionError(
                    f"`{name}` has no effect on {config.model}", "Leave it out, or ask a model."
                )
    elif ":" not in config.model:
        raise UnknownNameError(
            f"there is no model {config.model!r}; expected recall, guess, openai:URL#MODEL, "
            "transformers:ID or transformers:FOLDER",
            nearest(config.model, OWN, more=""),
        )
    else:
        parse_model(config.model)


def _default_system(config: AskConfig) -> str:
    """Return the name of who answers without a model, that of a bound (see `is_bound`)."""
    parts = ["questions", config.model]
    parts += [config.sampling] if config.model == "recall" else []
    if config.retrieval is None:
        return "-".join(parts)
    return "-".join(["retrieval", *parts, *non_default_retrieval(config).values()]).replace(
        "/", "-"
    )


def _name(config: AskConfig) -> str:
    """Return the name under which rows stand: of the table only that of who answers."""
    own = _default_system(config) if config.model in OWN else None
    name = config.system or own
    if name is None:
        raise InvalidOptionError(
            f"the rows of {config.model} need a name",
            "Set `system`, such as qwen3-vl-4b, or qwen3-vl-4b-blank for a control.",
        )
    name_system(name)
    if name != own and known_system(name) is not None:
        raise InvalidOptionError(
            f"{name} is a system that acts, or answers, otherwise than {config.model}",
            "Set `system` to a name of your own.",
        )
    return name
