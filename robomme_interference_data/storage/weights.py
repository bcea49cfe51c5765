"""Digests of model files, cached so that large files are read once on a machine."""

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from robomme_interference_data.storage.cache import cache_folder
from robomme_interference_data.storage.files import digest_folder, write_text
from robomme_interference_data.storage.text import canonical_json


def digest_weights(folder: Path, patterns: Sequence[str]) -> str:
    """Return `digest_folder`, from the cache if sizes and times of the files did not change."""
    paths = sorted(
        {path for pattern in patterns for path in folder.rglob(pattern) if path.is_file()}
    )
    stats = [(str(path.relative_to(folder)), path.stat()) for path in paths]
    # A copy can keep the time of writing, but not that of the last change of the inode.
    state = [[name, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns] for name, stat in stats]
    key = canonical_json([str(folder.resolve()), state])
    name = hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest()
    kept = cache_folder("weights") / name
    with suppress(OSError, UnicodeDecodeError):
        digest = kept.read_text("utf-8")
        if len(digest) == 64 and set(digest) <= set("0123456789abcdef"):
            return digest
    digest = digest_folder(folder, patterns)
    with suppress(OSError):
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_text(kept, digest)
    return digest
