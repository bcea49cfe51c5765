"""Names of families from texts, such as the tasks of a dataset. Pure rules."""

import hashlib
import re
import unicodedata
from collections.abc import Iterable

from robomme_interference_data.errors import SourceError, named

_LONGEST = 40
"""Most characters of a name before its digest."""

_NUMBER = r"(?:(?<!\S)-)?\d+(?:\.\d+)*"
_WORD = re.compile(rf"{_NUMBER}|[^\s\d.-]+")


def family_of(text: str) -> str:
    """Return the name of the family of a task: its words in one, such as `PickUpTheRedCup`.

    Case, spaces and punctuation do not count, nor the Unicode form of a letter; accents are left
    out. A name that is too long is cut, and one that loses letters which ASCII has not is
    incomplete: both end with 8 digits of the SHA-256 of the words, as in `Task-0a1b2c3d`.
    """
    words = words_of(text)
    plain = [_without_accents(word) for word in words]
    letters = ["".join(char for char in word if char.isascii()) for word in plain]
    name = "".join(word[:1].upper() + word[1:] for word in letters)
    complete = letters == plain and len(name) <= _LONGEST
    name = name[:_LONGEST]
    if not name[:1].isalpha():
        name = f"Task{name}"
    if complete:
        return name
    return f"{name}-{hashlib.sha256(' '.join(words).encode()).hexdigest()[:8]}"


def families_of(texts: Iterable[str]) -> dict[str, str]:
    """Return the family of each text.

    Raises:
        SourceError: A text has no words, or two with different words would have one family.
    """
    families = {text: family_of(text) for text in texts}
    hint = f"Name the families in a CSV file: {named('families_from', 'FILE.csv')}."
    first: dict[str, str] = {}
    for text, family in families.items():
        if not words_of(text):
            raise SourceError(f"the task {text!r} has no words to make a family of", hint)
        other = first.setdefault(family, text)
        if words_of(other) != words_of(text):
            raise SourceError(f"{other!r} and {text!r} would both be of the family {family}", hint)
    return families


def words_of(text: str) -> list[str]:
    """Return the words and numbers of a text, in lower case."""
    folded = unicodedata.normalize("NFKC", unicodedata.normalize("NFKD", text).casefold())
    kept = "".join(char if _is_kept(char) else " " for char in folded.replace("−", "-"))
    return _WORD.findall(kept)


def _is_kept(char: str) -> bool:
    # Letters, marks and numbers; a minus and a point are kept for numbers.
    return unicodedata.category(char)[0] in "LMN" or char in "-."


def _without_accents(word: str) -> str:
    decomposed = unicodedata.normalize("NFKD", word)
    return "".join(char for char in decomposed if unicodedata.category(char) != "Mn")
