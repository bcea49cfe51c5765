"""Read the JSON files that head a folder: datasets, manifests, indexes, staged episodes."""

from pathlib import Path

from robomme_interference_data.constants import FORMAT_VERSION
from robomme_interference_data.errors import FormatError
from robomme_interference_data.schema.codec import descriptions, from_dict

from .files import read_json


def read_header[T](path: Path, record: type[T]) -> T:
    """Read a JSON file as a record, if it has the `format_version` of this package."""
    value = read_json(path)
    if "format_version" in descriptions(record):
        version = value.get("format_version")
        if version != FORMAT_VERSION:
            raise FormatError(
                f"{path} has format version {version!r}; this package reads {FORMAT_VERSION}",
                "Install the version of robomme-interference-data that wrote it, or make it again.",
            )
    return from_dict(record, value, path, strict=True)
