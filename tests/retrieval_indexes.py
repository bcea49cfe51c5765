"""Indexes in a copy of the sample split."""

from pathlib import Path
from typing import Any

import factories
import pytest

from robomme_interference_data.progress import BuildProgress
from robomme_interference_data.retrieval.commands import datasets_in
from robomme_interference_data.retrieval.encoders import make_encoder
from robomme_interference_data.retrieval.index import build_index

QUIET = BuildProgress(quiet=True)
EPISODE = "VideoRepick/test/0"


def make_index(split: Path, encoder: str = "thumbnail", **options: Any) -> list[int]:
    reports = build_index(datasets_in(split), make_encoder(encoder), QUIET, **options)
    return [report.embedded for report in reports]


def files_of(split: Path) -> dict[str, bytes]:
    return {
        path.relative_to(split).as_posix(): path.read_bytes()
        for path in split.glob("*/index/**/*")
        if path.is_file()
    }


@pytest.fixture
def split(tmp_path: Path) -> Path:
    return factories.copy_of_split(tmp_path / "split")
