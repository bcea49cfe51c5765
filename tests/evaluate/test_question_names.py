"""Under which names answers stand: those of who answers without a model are nobody else's."""

from pathlib import Path

import pytest
from support.splits import GOLDEN

from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    UnknownNameError,
)
from robomme_interference_data.evaluate.questions import ask
from robomme_interference_data.evaluate.run.config import AskConfig


@pytest.mark.parametrize(
    ("given", "error", "reason"),
    [
        ({"system": "oracle"}, InvalidOptionError, "oracle is a system that acts"),
        ({"system": "questions-guess"}, InvalidOptionError, "otherwise than recall"),
        ({"system": "questions-recall-full"}, InvalidOptionError, "otherwise than recall"),
        ({"system": "questions-mine"}, UnknownNameError, "a control that is asked questions"),
        ({"model": "openai:http://h/v1#m"}, InvalidOptionError, "need a name"),
        # Sound names: what is refused is what comes after them.
        ({"system": "questions-recall-framesamp"}, UnknownNameError, "'Nothing'"),
        ({"system": "mine"}, UnknownNameError, "'Nothing'"),
        ({"model": "guess", "system": "questions-guess"}, UnknownNameError, "'Nothing'"),
        ({}, UnknownNameError, "'Nothing'"),
    ],
)
def test_names_are_of_who_answers(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    given: dict[str, str],
    error: type[InterferenceError],
    reason: str,
) -> None:
    monkeypatch.setattr(ask, "read_questions", lambda split: {})
    asked = {"model": "recall", "families": ("Nothing",), **given}
    with pytest.raises(error, match=reason):
        ask.run_examination(AskConfig(split=GOLDEN, out=tmp_path / "run", **asked))
    assert not (tmp_path / "run").exists()
