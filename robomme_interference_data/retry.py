"""Repeat what may succeed later: a connection, a download, a question to a model."""

import time
from collections.abc import Callable, Iterable, Iterator


def retry[Result](
    call: Callable[[], Result], is_temporary: Callable[[Exception], bool], pauses: Iterable[float]
) -> Result:
    """Return the result of a call, which is repeated after temporary faults.

    Args:
        call: What may fail.
        is_temporary: Whether to call again after an error; others are raised at once.
        pauses: Seconds to wait before each further call; when they end, the last error is raised.
    """
    waits = iter(pauses)
    while True:
        try:
            return call()
        except Exception as error:
            if not is_temporary(error) or (pause := next(waits, None)) is None:
                raise
        time.sleep(pause)


def growing(first: float, longest: float) -> Iterator[float]:
    """Yield pauses in seconds that double from `first` to `longest`, without end."""
    pause = first
    while True:
        yield pause
        pause = min(2 * pause, longest)
