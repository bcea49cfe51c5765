"""Which frames of a recording are used: a families file may leave out its beginning and end."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

from robomme_interference_data.errors import SourceError
from robomme_interference_data.schema.records import EvidenceSpan


@dataclass(frozen=True)
class Trim:
    """The frames `start` to `stop` (excluded) of a recording."""

    start: int
    stop: int

    @classmethod
    def of(cls, row: Mapping[str, Any], length: int) -> Self:
        """Return the frames that a line of a families file leaves of a recording.

        Args:
            row: `start`, `stop` and `exec_start_idx`, each of which may be missing. All are
                numbers of frames of the recording; `exec_start_idx` 0 means no demonstration.
            length: Frames of the recording.

        Raises:
            SourceError: They do not lie in the recording in this order, or it has no frames.
        """
        if length == 0:
            raise SourceError("the recording has no frames", "Leave the episode out.")
        given_start, given_stop = row.get("start"), row.get("stop")
        start = 0 if given_start is None else given_start
        stop = length if given_stop is None else given_stop
        if not 0 <= start < stop <= length:
            raise SourceError(
                f"start {start} and stop {stop} of a recording of {length} frames",
                f"Give numbers of its frames, start less than stop, stop at most {length}.",
            )
        live = row.get("exec_start_idx") or 0
        if live and not start <= live <= stop:
            raise SourceError(
                f"exec_start_idx {live} is not between start {start} and stop {stop}",
                "It is the number of the first frame after the demonstration, counted from the "
                "beginning of the recording; 0 if there is no demonstration.",
            )
        return cls(start, stop)

    def lesson(self, recorded: int | None) -> int | None:
        """Return how many of the used frames are of a demonstration of `recorded` frames."""
        if recorded is None:
            return None
        return min(max(recorded, self.start), self.stop) - self.start

    def evidence(self, spans: Iterable[EvidenceSpan]) -> tuple[EvidenceSpan, ...]:
        """Return evidence spans of the recording as those of the used frames.

        Raises:
            SourceError: One is not among them.
        """
        moved = []
        for span in spans:
            if not self.start <= span.start < span.stop <= self.stop:
                raise SourceError(
                    f"the frames {self.start} to {self.stop} leave out evidence: {span.text!r} in "
                    f"{span.start} to {span.stop}",
                    "Choose start and stop around all evidence.",
                )
            moved.append(replace(span, start=span.start - self.start, stop=span.stop - self.start))
        return tuple(moved)
