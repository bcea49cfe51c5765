"""A shard: an equal part of a run or of a build, for machines that do not know of each other."""

import hashlib
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Self

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.ids import EpisodeId

_FORM = re.compile(r"(\d{1,6})/(\d{1,6})")


@dataclass(frozen=True, order=True)
class Shard:
    """Part `number`, from 1, of `of` parts; `1/1` is the whole."""

    number: int
    of: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse a shard such as `2/8`, the second of eight.

        Raises:
            InvalidOptionError: The text is none.
        """
        found = _FORM.fullmatch(text)
        if found is None or not 1 <= int(found[1]) <= int(found[2]):
            raise InvalidOptionError.expected(
                "shard", text, "NUMBER/OF, such as 2/8 for the second of eight"
            )
        return cls(int(found[1]), int(found[2]))

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    @property
    def is_whole(self) -> bool:
        """Whether there is no other shard."""
        return self.of == 1

    def share[T](self, items: Iterable[T], episode: Callable[[T], EpisodeId]) -> list[T]:
        """Return the items of this shard, in the shuffled order of their episodes.

        Shards take items in turn: they are disjoint, together they are all items, and their sizes
        differ by at most one.

        Args:
            items: One for each episode.
            episode: Returns the episode of an item.
        """
        shuffled = sorted(items, key=lambda item: shuffle_key(episode(item)))
        return shuffled[self.number - 1 :: self.of]


def shuffle_key(episode: EpisodeId) -> bytes:
    """Return the key of an order of episodes that is shuffled, and always the same."""
    return hashlib.sha256(str(episode).encode()).digest()
