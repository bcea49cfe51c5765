"""Make the golden cards anew: `python tests/support/make_golden_cards.py tests/golden/cards`."""

import sys
from collections.abc import Iterator
from pathlib import Path

from support.buffer_sets import GOLDEN
from support.cards import OF_BUFFER_SET, OF_DEMONSTRATIONS, OF_RESULTS, RUN, without_version

from robomme_interference_data import load_buffer_set
from robomme_interference_data.cards.dataset_facts import buffer_set_facts, demonstrations_facts
from robomme_interference_data.cards.render import CROISSANT, README, card_files
from robomme_interference_data.cards.results import results_facts


def cards() -> Iterator[tuple[str, dict[str, bytes]]]:
    """Yield the cards by name."""
    buffer_set = load_buffer_set(GOLDEN)
    lessons = demonstrations_facts(buffer_set.datasets["demonstrations"])
    yield "demonstrations", card_files(lessons, OF_DEMONSTRATIONS)
    yield "buffer_set", card_files(buffer_set_facts(buffer_set), OF_BUFFER_SET)
    yield "results", card_files(results_facts(RUN), OF_RESULTS)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(exist_ok=True)
    for name, files in cards():
        for path, content in files.items():
            if path in (README, CROISSANT):
                suffix = "md" if path == README else "json"
                text = without_version(content)
                (folder / f"{name}.{suffix}").write_text(text, encoding="utf-8", newline="\n")
