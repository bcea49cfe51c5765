"""Explain why a part of a history was chosen, as data and as text."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.viz.tables import percent

from .grade import Grade, grade
from .measure import Similarities
from .segment import FrameSpan
from .select import Choice, Rule


@dataclass(frozen=True)
class Explanation:
    """Why a part of a history was chosen.

    Attributes:
        encoder: Name of the encoder.
        camera: Camera whose frames were compared.
        grade: The grade of the choice against the true lesson.
        chosen: Runs of chosen frames: first frame, and the frame after the last.
        score: The highest score of a chosen segment; None if the rule has no scores.
        sessions: Role and source of each session with a chosen frame, in order.
        closest, cosine: The chosen frame closest to the live image, and its cosine.
        other, other_cosine, other_source: The closest frame that was not chosen, its cosine and
            episode; None if all were chosen.
        lesson: Parts of the true lesson: first frame, and the frame after the last.
    """

    encoder: str
    camera: str
    grade: Grade
    chosen: tuple[FrameSpan, ...]
    score: float | None
    sessions: tuple[str, ...]
    closest: int
    cosine: float
    other: int | None
    other_cosine: float | None
    other_source: str | None
    lesson: tuple[FrameSpan, ...]

    def text(self) -> str:
        """Return the explanation in a few lines."""
        graded, rule = self.grade, Rule.parse(self.grade.rule)
        score = "" if self.score is None else f", {self.score:.3f}"
        cut = "not cut"
        if rule.method.sides is not None:
            sides = "adjacent frames"
            if rule.method.sides > 1:
                sides = f"the means of the {rule.method.sides} frames before and after"
            parts = f"{graded.segments} segment{'s' if graded.segments > 1 else ''}"
            cut = f"cut into {parts} where the cosine of {sides} is below {graded.threshold:.3f}"
        outside = "all frames are chosen"
        if self.other is not None:
            source = f"frame {self.other} of {self.other_source}"
            outside = f"the closest other frame is {source}, {self.other_cosine:.3f}"
        lesson = frames_text(self.lesson)
        lines = (
            f"{graded.episode_id} under {graded.condition}, {self.camera} camera, rule "
            f"{graded.rule}: {graded.history_frames} history frames, {cut}",
            f"Chosen: frames {frames_text(self.chosen)}, of {', '.join(self.sessions)}",
            f"Why: {rule.name} takes {rule.method.chooses}{score}",
            f"The first live observation is closest to frame {self.closest} of these, with cosine "
            f"{self.cosine:.3f}; {outside}",
            f"The lesson is frames {lesson}: {self.graded()}" if lesson else self.graded(),
        )
        return "\n".join(lines)

    def graded(self) -> str:
        """Return purity and coverage of the choice, in words."""
        graded = self.grade
        if graded.coverage is None:
            return "the history holds no lesson"
        false = f"{graded.false_sessions} false session{'' if graded.false_sessions == 1 else 's'}"
        return f"purity {percent(graded.purity)}, coverage {percent(graded.coverage)}, {false}"


def frames_text(spans: Sequence[FrameSpan]) -> str:
    """Return the first and last frames of spans, of three at most."""
    parts = [f"{start} to {stop - 1}" for start, stop in spans[:3]]
    if len(spans) > len(parts):
        parts.append(f"{len(spans) - len(parts)} more parts")
    return " and ".join(parts)


def explain(
    buffer: Buffer, measured: Similarities, choice: Choice, encoder: str, camera: str
) -> Explanation:
    """Explain a choice."""
    alike, frames = measured.alike, choice.frames
    closest = int(frames[np.argmax(alike[frames])])
    outside = np.setdiff1d(np.arange(len(alike)), frames)
    other = int(outside[np.argmax(alike[outside])]) if len(outside) else None
    touched = [buffer.sessions[n] for n in np.unique(buffer.session_index[frames])]
    scores = [score for span, score in choice.scores.items() if span[0] in frames]
    return Explanation(
        encoder,
        camera,
        grade(measured, choice.rule),
        choice.spans,
        max(scores, default=None),
        tuple(f"{session.role} {session.source}" for session in touched),
        closest,
        float(alike[closest]),
        other,
        None if other is None else float(alike[other]),
        None if other is None else str(buffer.sessions[buffer.session_index[other]].source),
        measured.lesson,
    )
