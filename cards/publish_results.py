"""Publish the results of a run: its record and tables, the scores, the report and a card."""

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

from robomme_interference_data.constants import RUN_HEADER, RUN_RECORD, RUN_TABLES
from robomme_interference_data.errors import PublishError
from robomme_interference_data.evaluate.run.log import read_record
from robomme_interference_data.evaluate.score.config import Grid, Settings
from robomme_interference_data.evaluate.score.scoring import Score, score
from robomme_interference_data.evaluate.score.writing import write_score
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.rollouts import TIMING_COLUMNS
from robomme_interference_data.storage.files import canonical_json
from robomme_interference_data.storage.hub import HubFiles

from . import render
from .publication import Publication
from .publish_config import VersionConfig
from .publishing import Goods
from .tree import Content, Tree
from .versions import Version

_SCORE = "score"
"""Folder of tables, figures and report."""


def score_run(run: Path, grid: Grid = Grid.BENCHMARK) -> Score:
    """Score the run that is to be published.

    Raises:
        PublishError: The folder holds no run that has ended.
        FormatError: Its rows cannot be scored.
    """
    needed = (RUN_HEADER, RUN_RECORD, *RUN_TABLES)
    if lacking := [name for name in needed if not (run / name).is_file()]:
        raise PublishError(
            f"{run} holds no run that has ended: {lacking[0]} is missing",
            "Run it to its end with the same evaluate command, or give the folder of a run.",
        )
    return score(Settings(rows=(run,), grid=grid))


def results_of(found: Score, run: Path, config: VersionConfig) -> Goods:
    """Return what the repository of a run's results holds.

    The videos of rollouts are left out.

    Raises:
        MissingExtraError: matplotlib or jinja2 is not installed.
    """
    command = f"robomme-interference publish-results RUN --repo-id {config.repo_id}"
    files: Tree = {name: Content(run / name) for name in (RUN_HEADER, RUN_RECORD, *RUN_TABLES)}
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_score(found, folder, command=command)
        for path in sorted(one for one in folder.rglob("*") if one.is_file()):
            where = f"{_SCORE}/{path.relative_to(folder).as_posix()}"
            files[where] = Content(path.read_bytes())

    def card(version: Version) -> dict[str, bytes]:
        about = Publication(config.repo_id, str(version), config.license, None, command)
        return render.results_files(found, about)

    def parts(earlier: HubFiles | None) -> dict[str, str]:
        return parts_of_run(earlier.snapshot(RUN_HEADER, RUN_RECORD) if earlier else run)

    return Goods(config.repo_id, Version(1, 0, 0), files, card, parts, RUN_HEADER)


def parts_of_run(run: Path) -> dict[str, str]:
    """Return what each rollout of a run came to, its times aside."""
    parts = {}
    for item, row in read_record(run).items():
        told = to_dict(row)
        parts[str(item)] = canonical_json({k: told[k] for k in _kept(told)})
    return parts


def _kept(columns: Iterable[str]) -> list[str]:
    return [name for name in columns if name not in (*TIMING_COLUMNS, "attempt", "video")]
