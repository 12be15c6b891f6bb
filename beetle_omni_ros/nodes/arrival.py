"""When a message was published, for what is to be answered in time."""

from __future__ import annotations

from collections.abc import Callable
from inspect import Parameter, Signature
import math

TWO_ARGUMENTS = Signature([Parameter(name, Parameter.POSITIONAL_ONLY)
                           for name in ('message', 'info')])


def with_publication(callback: Callable) -> Callable:
    """
    Make a subscription's callback of one that also takes the time of publication.

    rclpy looks at a callback's signature to see whether it wants the message's info. The plain
    executor then gives two arguments, the events executor of Jazzy one tuple of both.

    Args:
        callback: called with (message, publication [s, system time, set by the middleware of the
            publisher]; nan where the middleware tells none).

    """
    def take(*given):
        message, info = given if len(given) == 2 else given[0]
        stamp = info.get('source_timestamp')
        callback(message, stamp * 1e-9 if stamp and stamp > 0 else math.nan)

    take.__signature__ = TWO_ARGUMENTS
    return take
