"""This package: its name, and where it is installed from."""

from importlib import metadata

DISTRIBUTION = "robomme-interference-data"


def install_source() -> str:
    """Return what pip installs this package from: its repository, as no index has it."""
    urls = metadata.metadata(DISTRIBUTION).get_all("Project-URL", [])
    pairs = (url.split(", ") for url in urls)
    return f"git+{dict(pairs)['Repository']}"
