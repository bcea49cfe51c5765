"""Read rows of rollouts from any files; `checks` decides which of them are valid."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robomme_interference_data.errors import FormatError, InvalidOptionError, counted, named
from robomme_interference_data.schema.renderers import renderers_note

from .checks import Checks
from .files import find_sources, read_file, with_stated
from .row_format import ReadFiles
from .values import Row

if TYPE_CHECKING:
    from robomme_interference_data.evaluate.run.record import RunHeader

    from .scenes import ScenesOf

_SHOWN = 10  # bad rows that are listed; the others are counted


@dataclass(frozen=True)
class CheckedRows:
    """Rows that passed every check, in the order of their files.

    Attributes:
        rows: The rows.
        sources: The files that were read (see `files.find_sources`).
        revisions: Simulator to the revision of its buffer set, where rows name one.
        without_revision: Simulator and system of rows that name no revision, such as released ones,
            and of evaluations by other programs whose scenes are not known to be the same.
        scenes: What decides the scenes of evaluations by other programs.
        notes: What readers must know of them.
        bad_reasons: The first bad rows that were left out: location and reason.
        bad_count: The number of bad rows.
    """

    rows: tuple[Row, ...]
    sources: "Mapping[Path, RunHeader | None]"
    revisions: Mapping[str, str] = field(default_factory=dict)
    without_revision: frozenset[tuple[str, str]] = frozenset()
    scenes: "ScenesOf" = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    bad_reasons: tuple[str, ...] = ()
    bad_count: int = 0

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Row]:
        return iter(self.rows)

    def names(self, column: str) -> list[Any]:
        """Return the distinct values of a column, sorted."""
        return sorted({getattr(row, column) for row in self.rows})


def read_rows(
    paths: Sequence[Path],
    systems: Sequence[str] = (),
    lenient: bool = False,
    model_seeds: Sequence[int] = (),
    system_option: str = "system",
) -> CheckedRows:
    """Read rows from folders of runs and files, and check each of them.

    Args:
        paths: Folders of runs, and files of one of `files.FORMATS`.
        systems: System of files that name none, for all or for each in their order; by default the
            one in the name of a released or exported file.
        model_seeds: Seeds of files that name none, likewise.
        lenient: Leave bad rows out, and count them. Of identical rows of one rollout the first is
            kept, of rows that contradict each other none.
        system_option: The setting that errors name for `systems`.

    Raises:
        FormatError: A file has no known format or is damaged, a row is bad, or none is valid.
        InvalidOptionError: Stated systems or seeds do not fit the files.
        MissingFileError: There is no such file.
    """
    sources = find_sources(paths)
    files = {path: read_file(path, Row._fields) for path in sources}
    files = with_stated(files, systems, model_seeds, system_option)
    scenes, same_scenes, notes = _scenes(files)
    checks = Checks()
    for path, run in sources.items():
        checks.add(path, files[path], None if run is None else path.parent)
    checks.check_together()
    bad_reasons = checks.bad_reasons()
    if bad_reasons and not lenient:
        lines = [f"{counted(len(bad_reasons), 'bad row')}:", *bad_reasons[:_SHOWN]]
        if len(bad_reasons) > _SHOWN:
            lines.append(f"… and {len(bad_reasons) - _SHOWN:,} more")
        raise FormatError(
            "\n".join(lines), f"Correct them; score leaves them out with {named('lenient')}."
        )
    rows = tuple(checks.sound.values())
    if not rows:
        given = ", ".join(map(str, paths))
        message = f"there are no rows in {given}"
        if bad_reasons:
            message = f"all {len(bad_reasons):,} rows in {given} are bad; the first is "
            message += bad_reasons[0]
        raise FormatError(message, "Give at least one valid row.")
    revisions, without_revision = _revisions(rows)
    return CheckedRows(
        rows,
        sources,
        revisions,
        without_revision - same_scenes,
        scenes,
        notes,
        tuple(bad_reasons[:_SHOWN]),
        len(bad_reasons),
    )


def renderer_notes(runs: "Iterable[RunHeader | None]") -> list[str]:
    """Return a note for each simulator whose images are known to come from different renderers."""
    drawn = defaultdict[str, list[tuple[str, str | None]]](list)
    for run in runs:
        renderers = {} if run is None else run.identity.get("renderers")
        if run is not None and isinstance(renderers, dict):
            drawn[str(run.identity.get("simulator"))] += [
                (images, None if renderer is None else str(renderer))
                for images, renderer in renderers.items()
            ]
    return [note for pairs in drawn.values() if (note := renderers_note(pairs)) is not None]


def _scenes(files: ReadFiles) -> "tuple[ScenesOf, frozenset[tuple[str, str]], tuple[str, ...]]":
    """Check evaluations by other programs against one another.

    Returns what decides their scenes, simulator and system of those whose scenes are known to be
    the same, and what readers must know of them.
    """
    if all(contents.scenes is None for contents in files.values()):
        return {}, frozenset(), ()
    from .scenes import check_apart, notes_on, of_other_scenes, scenes_of  # only for these files

    check_apart(files)
    scenes = scenes_of(files)
    same_scenes = scenes.keys() - of_other_scenes(scenes)
    return scenes, frozenset(same_scenes), tuple(notes_on(files, scenes))


def _revisions(rows: Iterable[Row]) -> tuple[dict[str, str], frozenset[tuple[str, str]]]:
    """Return the revision of each simulator, and simulator and system of rows that name none."""
    cells = {(row.simulator, row.system, row.revision) for row in rows}
    without = frozenset((simulator, name) for simulator, name, revision in cells if not revision)
    for simulator, name, revision in sorted(cells - {(*cell, None) for cell in without}):
        if (simulator, name) in without:  # protocol, rule 5
            raise InvalidOptionError(
                f"some rows of {name} in {simulator} have the revision {revision} of a buffer "
                "set, others name no revision, like released rows",
                "Their histories may differ: score the files separately, or compare them.",
            )
    return {simulator: revision for simulator, _, revision in cells if revision}, without
