"""
The lost turn count: which angle a reading stands for.

A servo counts turns only while it has power. After power-up or reboot its position is within
one turn, so that each angle beyond +-(2 pi - travel) has a twin one turn away that the joint can
reach as well: with +-3.96 rad of travel, readings beyond +-2.32 rad (0.74 pi) are ambiguous.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, floor, pi

TURN = 2 * pi


def candidates(angle: float, travel: float) -> list[float]:
    """All angles within +-``travel`` [rad] that differ from ``angle`` by whole turns, rising."""
    first, last = ceil((-travel - angle) / TURN), floor((travel - angle) / TURN)
    return [angle + TURN * turn for turn in range(first, last + 1)]


def nearest_turns(angle: float, reference: float) -> int:
    """How many whole turns to add to ``angle`` [rad] to come nearest to ``reference``."""
    return round((reference - angle) / TURN)


def certain_limit(travel: float) -> float:
    """Angle up to which a reading within one turn has one meaning [rad]."""
    return TURN - travel if travel > pi else travel


def settle(servos: Sequence, travel: float, confirmed: Sequence[float] | None) -> str:
    """
    Make sure of the turn count of each servo that has none.

    Args:
        servos: with ``position`` [rad] and ``turns``, which are set with ``turns_known``.
        travel: of the joints to each side [rad].
        confirmed: true angles to half a turn as the operator sees them [rad], or None.

    Returns:
        '' or, for the operator, which servos are in doubt.

    """
    doubts = []
    for k, servo in enumerate(servos):
        if servo.turns_known:
            continue
        options = candidates(servo.position, travel)
        if len(options) == 1:
            chosen = options[0]
        elif options and confirmed is not None:
            chosen = min(options, key=lambda angle: abs(angle - confirmed[k]))
        else:
            places = ' or '.join(f'{angle:+.2f}' for angle in options or [servo.position])
            doubts.append(f'{servo.name} (id {servo.identifier}) stands at {places} rad')
            continue
        servo.turns += nearest_turns(servo.position, chosen)
        servo.position, servo.turns_known = chosen, True
    return '; '.join(doubts)
