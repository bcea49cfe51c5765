"""Why a part of a history was chosen: as data, and in a few lines."""

from dataclasses import dataclass

import numpy as np

from robomme_interference_data.buffer import Buffer
from robomme_interference_data.retrieval.grade import Grade, grade
from robomme_interference_data.retrieval.segment import Span
from robomme_interference_data.retrieval.select import METHODS, Choice, Measured, Rule
from robomme_interference_data.tables import percent


@dataclass(frozen=True)
class Reasons:
    """Why a part of a history was chosen.

    Attributes:
        encoder: Name of the encoder.
        camera: Camera whose frames were compared.
        grade: The choice, compared with the true lesson.
        score: What the chosen segment was scored by, or None if the rule scores none.
        sessions: Role and source of each session that the chosen part touches, in order.
        closest, cosine: Chosen frame closest to what the robot sees, and its cosine.
        other, other_cosine, other_source: Frame closest to it outside the chosen part, its cosine
            and episode; None if all was chosen.
        lesson: First frame of each part of the true lesson, and the one after its last.
    """

    encoder: str
    camera: str
    grade: Grade
    score: float | None
    sessions: tuple[str, ...]
    closest: int
    cosine: float
    other: int | None
    other_cosine: float | None
    other_source: str | None
    lesson: tuple[Span, ...]

    def text(self) -> str:
        """Say it in a few lines."""
        one, method = self.grade, self.grade.rule.partition("/")[0]
        score = "" if self.score is None else f", {self.score:.3f}"
        parts = f"{one.segments} segment{'s' if one.segments > 1 else ''}"
        outside = "nothing lies outside"
        if self.other is not None:
            source = f"frame {self.other} of {self.other_source}"
            outside = f"the closest one outside is {source}, {self.other_cosine:.3f}"
        lesson = " and ".join(f"{start} to {stop - 1}" for start, stop in self.lesson)
        lines = (
            f"{one.episode_id} under {one.condition}, {self.camera} camera, rule {one.rule}: "
            f"{one.history_frames} history frames, cut into {parts} where the cosine of "
            f"adjacent frames is below {one.threshold:.3f}",
            f"Chosen: frames {one.start} to {one.stop - 1}, of {', '.join(self.sessions)}",
            f"Why: {method} takes {METHODS[method]}{score}",
            f"What the robot sees now is closest to frame {self.closest} of these, with cosine "
            f"{self.cosine:.3f}; {outside}",
            f"The lesson is frames {lesson}: {self.graded()}" if lesson else self.graded(),
        )
        return "\n".join(lines)

    def graded(self) -> str:
        """Say how the choice compares with the true lesson."""
        one = self.grade
        if one.coverage is None:
            return "the history holds no lesson"
        false = f"{one.false_sessions} false session{'' if one.false_sessions == 1 else 's'}"
        return f"purity {percent(one.purity)}, coverage {percent(one.coverage)}, {false}"


def reasons(
    buffer: Buffer, measured: Measured, choice: Choice, rule: Rule, encoder: str, camera: str
) -> Reasons:
    """Collect why a span was chosen."""
    start, stop = choice.span
    alike = measured.alike
    closest = start + int(np.argmax(alike[start:stop]))
    outside = np.concatenate([np.arange(start), np.arange(stop, len(alike))])
    other = int(outside[np.argmax(alike[outside])]) if len(outside) else None
    touched = [one for one in buffer.sessions if one.start < stop and one.stop > start]
    return Reasons(
        encoder,
        camera,
        grade(measured, rule),
        choice.scores.get(choice.span),
        tuple(f"{one.role} {one.source}" for one in touched),
        closest,
        float(alike[closest]),
        other,
        None if other is None else float(alike[other]),
        None if other is None else str(buffer.sessions[buffer.session_index[other]].source),
        measured.lesson,
    )
