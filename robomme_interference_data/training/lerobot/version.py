"""The version of LeRobot whose training loop `loop` runs."""

from importlib import metadata, util

from robomme_interference_data.errors import MissingExtraError

TESTED = "0.6.1"


def check_lerobot() -> None:
    """Check that the version of LeRobot that was tested is installed, with its training.

    Raises:
        MissingExtraError: It is not.
    """
    try:
        installed = f"lerobot {metadata.version('lerobot')}"
    except metadata.PackageNotFoundError:
        installed = "no lerobot"
    if installed == f"lerobot {TESTED}" and util.find_spec("accelerate") is None:
        installed += " without accelerate"
    if installed != f"lerobot {TESTED}":
        raise MissingExtraError(
            f"training was tested with lerobot {TESTED}, whose training loop it changes in two "
            f"places; installed is {installed}",
            f'Install it: pip install "lerobot[training]=={TESTED}"',
        )
