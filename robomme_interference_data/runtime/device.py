"""The one choice of the device on which a model computes."""

from typing import TYPE_CHECKING

from robomme_interference_data.errors import InvalidOptionError, first_line, named

if TYPE_CHECKING:
    import torch


def choose_device(name: str | None) -> "torch.device":
    """Return a device that computes.

    Args:
        name: `cpu`, `cuda` or `cuda:1`; None for the first GPU, or `cpu` without one.

    Raises:
        InvalidOptionError: PyTorch knows no such device, or it cannot be used.
    """
    import torch

    try:
        # None means the best of this machine; a device that is named must work.
        device = torch.device(name or ("cuda" if torch.cuda.is_available() else "cpu"))
        torch.empty(0, device=device)  # a device that is only named may be missing
    except (RuntimeError, AssertionError) as error:
        raise InvalidOptionError(
            f"device {name!r} cannot be used: {first_line(error)}", f"Set {named('device', 'cpu')}."
        ) from None
    return device
