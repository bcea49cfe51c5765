"""`robomme-interference card`."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.buffer_sets import GOLDEN
from support.hub import BASE, BUFFER_SET, push_buffer_set, running_hub

from robomme_interference_data import load_buffer_set
from robomme_interference_data.cards.commands import facts_of
from robomme_interference_data.cards.dataset_facts import buffer_set_facts
from robomme_interference_data.cards.publication import Publication
from robomme_interference_data.cards.render import card_text

Run = Callable[..., tuple[int, str, str]]


def test_a_card_is_printed(run: Run) -> None:
    code, out, err = run(
        *("card", GOLDEN / "demonstrations", "--repo-id", "people/tiny"),
        *("--version", "2.0.1", "--license", "cc0-1.0"),
    )
    assert (code, err) == (0, "")
    assert out.startswith("---\npretty_name: ")
    assert "license: cc0-1.0\n" in out
    assert "data-2.0.1" in out
    assert "people/tiny" in out


def test_a_card_of_what_is_on_the_hub(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running_hub(tmp_path / "cache", monkeypatch) as hub:
        _, base = push_buffer_set(hub, GOLDEN, tmp_path / "work")
        code, out, _ = run("card", BUFFER_SET, "--repo-id", BUFFER_SET)
        assert code == 0
        place = f"{BASE}@{base}"
        assert out == card_text(
            buffer_set_facts(load_buffer_set(GOLDEN)), Publication(BUFFER_SET, "1.0.0", base=place)
        )
        assert not [path for path in hub.downloads() if path.endswith(".mp4")]
        code, out, _ = run("card", place, "--repo-id", BASE)
        assert code == 0
        assert out == card_text(
            facts_of(str(GOLDEN / "demonstrations")), Publication(BASE, "1.0.0")
        )


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((GOLDEN, "--license", "MIT License"), "--license 'MIT License'"),
        ((GOLDEN / "distractors",), "dataset of distractors"),
        (("nobody/nothing",), "HF_HUB_OFFLINE"),
    ],
)
def test_invalid_arguments(run: Run, given: tuple[str | Path, ...], message: str) -> None:
    code, out, err = run("card", *given)
    assert (code, out) == (1, "")
    assert message in err


def test_a_card_needs_jinja2(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    code, _, err = run("card", GOLDEN)
    assert code == 1
    assert "robomme-interference-data[score]" in err
