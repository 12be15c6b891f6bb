"""When a message was published, as the middleware of its writer has stamped it."""

from __future__ import annotations

from collections.abc import Callable
import inspect
import time

# What a callback must look like for rclpy to hand over the message's information.
_TWO = inspect.Signature([inspect.Parameter(name, inspect.Parameter.POSITIONAL_ONLY)
                          for name in ('message', 'info')])
LONGEST = 1.0       # [s] an older publication, or one to come, was stamped by another clock


def with_time(handle: Callable) -> Callable:
    """
    Make a subscription's callback of ``handle(message, published)``.

    ``published`` is the source timestamp of the middleware [system s], or the arrival where
    there is none, or where it comes from another clock.
    """
    def callback(*given):
        now = time.time()
        # The events executor of Jazzy passes both as one tuple, the others as two arguments.
        message, info = given if len(given) == 2 else given[0]
        published = 1e-9 * info['source_timestamp']
        handle(message, published if 0 <= now - published < LONGEST else now)

    callback.__signature__ = _TWO
    return callback
