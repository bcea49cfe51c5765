"""Questions as a kind of run: the checks before it starts, and what identifies it."""

import dataclasses
from collections.abc import Sequence
from contextlib import closing
from typing import Any

from robomme_interference_data.data.questions import digest_questions, read_questions
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    UnknownNameError,
    named,
    nearest,
)
from robomme_interference_data.evaluate.run.config import (
    AskConfig,
    check_unused,
    nothing_to_retrieve,
    with_retrieval,
)
from robomme_interference_data.evaluate.run.kind import Run, RunKind, retrieval_text, short_digest
from robomme_interference_data.evaluate.run.plan import Plan, WorkItem
from robomme_interference_data.evaluate.systems import SYSTEMS, SystemFacts, name_system
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.simulators.registry import recorded_scene

from .models import MODELS, model_identity
from .question_task import AskTask
from .responders import CONTROLS, OWN, ModelResponder


class Questions(RunKind[AskConfig]):
    """Multiple-choice questions about what history buffers show."""

    def prepare(self) -> None:
        """Check the settings, and identify the model."""
        config = self.config
        _check_settings(config)
        self.memory = Memory.parse(config.memory)
        self.config = config = dataclasses.replace(config, memory=str(self.memory))
        self._questions = read_questions(self.buffer_set)
        self.metadata, self._images = {"model": config.model}, None
        if config.model not in OWN:
            self.config = config = dataclasses.replace(config, model=MODELS.pin(config.model))
        self.system = _name(config)
        if config.model not in OWN:
            with closing(ModelResponder(config)) as responder:
                self.metadata, self._images = responder.metadata(), responder.images

    def facts(self) -> SystemFacts:
        """Return what the system is: the model, and what it sees of the past."""
        config, own = self.config, self.config.model in OWN
        return SystemFacts(
            policy=config.model if own else MODELS.parse(config.model).kind,
            policy_id=short_digest({"model": self._model_identity(), "control": config.control}),
            memory=None if config.model == "guess" else config.memory,
            retrieval=retrieval_text(config, self.buffer_set),
            reference=own,
        )

    def refusal(self, condition: str) -> InterferenceError | None:
        """Return why a condition does not apply, or None."""
        if self.config.retrieval is None or condition != NO_HISTORY:
            return None
        return nothing_to_retrieve(f"Leave {NO_HISTORY} out of {named('conditions')}.")

    def check(self, plan: Plan, items: Sequence[WorkItem]) -> None:
        """Check that the images fit, and that the ideal observer knows the possible answers."""
        config = self.config
        if config.model == "recall":
            for episode in {item.episode for item in items}:
                if recorded_scene(self.buffer_set.query(episode)) is None:
                    raise InvalidOptionError(
                        f"recall does not know the possible answers in {episode}",
                        "Ask a model, or guess.",
                    )
        # How many frames a retrieval step selects is unknown before.
        if self._images is None or (config.retrieval is not None and self.memory.rule == "full"):
            return
        for item in items:
            history = self.buffer_set.manifest(item.episode, item.condition).history_frames
            kept = len(self.memory.earlier(history))
            if kept + 1 > self._images:
                raise InvalidOptionError(
                    f"{item.episode}, {item.condition}: {kept} history frames and the picture; "
                    f"the model takes {self._images} images at most",
                    f"Set {named('model_options', f'images={kept + 1}')}, or a smaller "
                    f"{named('memory')}.",
                )

    def task(self, run: Run[AskConfig]) -> AskTask:
        """Return the function that asks questions."""
        return AskTask(run)

    def identity(self, plan: Plan) -> dict[str, Any]:
        """Return what of questions and model can change an answer."""
        config = self.config
        return {
            "memory": str(self.memory),
            "control": config.control,
            "model": self._model_identity(),
            "questions": digest_questions(self._questions.values()),
        }

    def _model_identity(self) -> dict[str, Any]:
        config = self.config
        if config.model in OWN:
            return self.metadata
        model = model_identity(config.model, config.model_options, self.metadata["model"])
        return model | {"prompt_sha256": self.metadata["prompt_sha256"]}


def _check_settings(config: AskConfig) -> None:
    """Check the settings by themselves and against each other."""
    if config.control not in CONTROLS:
        raise InvalidOptionError.one_of("control", config.control, CONTROLS)
    if config.model in OWN:
        unused = ["model_options", "control", "prompt"]
        if config.model == "guess":
            unused += ["memory", "retrieval"]
        check_unused(config, unused, config.model, "Leave it out, or ask a model.")
    elif ":" not in config.model:
        raise UnknownNameError(
            f"there is no model {config.model!r}; expected recall, guess, openai:URL#MODEL, "
            "transformers:ID or transformers:FOLDER",
            nearest(config.model, OWN, more=""),
        )
    else:
        MODELS.parse(config.model)


def _name(config: AskConfig) -> str:
    """Return the label of the rows: a name of the table only for the responder that it names."""
    default = None
    if config.model in OWN:
        default = f"questions-{config.model}"
        if config.model == "recall":
            default += f"-{Memory.parse(config.memory).label}"
        default = with_retrieval(default, config)
    name = config.system or default
    if name is None:
        raise InvalidOptionError(
            f"the rows of {config.model} need a name",
            f"Set {named('system')}, such as qwen3-vl-4b, or qwen3-vl-4b-blank for a control.",
        )
    name_system(name)
    if name != default and name in SYSTEMS:
        raise InvalidOptionError(
            f"{name} is the name of another system than {config.model}",
            f"Set {named('system')} to a name of your own.",
        )
    return name
