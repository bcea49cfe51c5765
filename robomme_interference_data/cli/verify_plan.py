"""The options of `verify` that are about reference plans."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from robomme_interference_data.errors import counted

from .console import echo, print_status

if TYPE_CHECKING:
    from robomme_interference_data.data.buffer_set import BufferSet
    from robomme_interference_data.schema.reference_plan import ReferencePlan


@dataclass(frozen=True)
class PlanOptions:
    """A reference plan to compare a buffer set with, and a file for its own; None for neither.

    Attributes:
        name: What the user calls the plan.
        plan: The plan.
        file: Where the plan of the buffer set is written.
    """

    name: str | None
    plan: "ReferencePlan | None"
    file: Path | None

    @classmethod
    def read(cls, against: str | None, file: Path | None) -> Self:
        """Read the plan: what is wrong with it shows before hours of decoding."""
        from robomme_interference_data.build_dataset.verify.reference import read_plan

        return cls(against, None if against is None else read_plan(against), file)

    @property
    def used(self) -> bool:
        """Whether there is anything to compare or to write."""
        return self.plan is not None or self.file is not None

    def carry_out(self, opened: "BufferSet", report: dict[str, Any], *, as_json: bool) -> bool:
        """Compare and write; add the comparison to the report, or print it.

        Returns:
            Whether the buffer set differs from the plan.
        """
        from robomme_interference_data.build_dataset.verify.reference import (
            reference_plan,
            write_plan,
        )

        found = reference_plan(opened)
        if self.file is not None:
            write_plan(found, self.file)
            print_status(
                f"{self.file}: the plan of {counted(len(found.queries), 'query', 'queries')}"
            )
        if self.plan is None:
            return False
        return self._compare(found, self.plan, report, as_json=as_json)

    def _compare(
        self,
        found: "ReferencePlan",
        plan: "ReferencePlan",
        report: dict[str, Any],
        *,
        as_json: bool,
    ) -> bool:
        from robomme_interference_data.build_dataset.verify.against import compare

        comparison = compare(found, plan)
        report["against"] = {
            "plan": self.name,
            "differences": [vars(difference) for difference in comparison.differences],
            "notes": [*comparison.notes],
            "digests_compared": comparison.digests,
        }
        if not as_json:
            for difference in comparison.differences:
                echo(f"{difference.where}: {difference.what}")
        for note in comparison.notes:
            print_status(note)
        queries = counted(len(plan.queries), "query", "queries")
        if comparison.differences:
            count = counted(len(comparison.differences), "difference")
            print_status(f"{count} from the plan {self.name}")
        else:
            print_status(
                f"Equal to the plan {self.name}: sessions and lengths of {queries}; digests of "
                f"{comparison.digests} of {counted(len(plan.episodes), 'episode')} were compared."
            )
        return bool(comparison.differences)
