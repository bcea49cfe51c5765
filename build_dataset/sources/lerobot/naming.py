"""How the episodes of a LeRobot dataset that does not name them get their families."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from .families import families_by_task, recorded_splits
from .families_file import DATASET, TASK, one_line, read_families
from .family_names import families_of


def origin_of_families(families_from: str) -> str:
    """Return what a dataset records of `families_from`: `task`, `dataset` or `file`.

    The path of a file is not recorded: equal recordings give equal datasets on all machines.
    """
    return families_from if families_from in (TASK, DATASET) else "file"


@dataclass(frozen=True)
class EpisodeNaming:
    """Where the families of a dataset's episodes come from, if not from the dataset itself.

    Attributes:
        tasks: The tasks of each episode.
        splits: `splits` of its `info.json`.
        dataset: The name of the dataset.
        families_from: `task`, `dataset` or the path of a families file; None if it is not given.
        dataset_where: Where the dataset is, for errors.
    """

    tasks: Sequence[Sequence[str]]
    splits: Any
    dataset: str
    families_from: str | None
    dataset_where: str

    @property
    def file(self) -> Path | None:
        """The families file that is used."""
        if self.families_from in (None, TASK, DATASET):
            return None
        return Path(self.families_from)

    @property
    def where(self) -> str:
        """What names the episodes, for errors: the families file or the dataset."""
        return self.dataset_where if self.file is None else f"families file {self.file}"

    @cached_property
    def families(self) -> dict[str, str]:
        """The families that are made, by task or by name of the dataset."""
        if self.families_from == DATASET:
            return families_of([self.dataset])
        return families_by_task(self.tasks, self.dataset_where)

    @cached_property
    def recorded_splits(self) -> list[str]:
        """The split of each episode by `info.json`."""
        return recorded_splits(self.splits, len(self.tasks), self.dataset_where)

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """Columns `family`, `split` and others of each episode; empty if the dataset names them."""
        if self.file is None and self.families_from is None:
            return []
        if self.file is not None:
            rows = read_families(self.file, self.tasks, self.dataset)
        elif self.families_from == DATASET:
            rows = [{"family": self.families[self.dataset]} for _ in self.tasks]
        else:
            families = self.families
            rows = [{"family": families[one_line(texts[0])]} for texts in self.tasks]
        return [
            row | {"split": row.get("split") or split}
            for row, split in zip(rows, self.recorded_splits, strict=True)
        ]

    def row(self, index: int) -> dict[str, Any]:
        """Return these columns of an episode."""
        return self.rows[index] if self.rows else {}
