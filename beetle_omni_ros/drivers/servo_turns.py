"""
Ambiguity of the joint angle after the loss of a servo's turn count.

A servo counts turns only while it has power. After power-up or reboot its position is within one
turn. An angle beyond +-(2 pi - travel) then has a second solution, one turn away, within the
travel. With a travel of +-3.96 rad, readings beyond +-2.32 rad (0.74 pi) are ambiguous.
"""

from collections.abc import Sequence
from math import ceil, floor, pi

TURN = 2 * pi


def candidates(angle: float, travel: float) -> list[float]:
    """Angles within +-``travel`` [rad] that differ from ``angle`` by whole turns, ascending."""
    first, last = ceil((-travel - angle) / TURN), floor((travel - angle) / TURN)
    return [angle + TURN * turn for turn in range(first, last + 1)]


def nearest_turns(angle: float, reference: float) -> int:
    """Number of whole turns that brings ``angle`` [rad] nearest to ``reference``."""
    return round((reference - angle) / TURN)


def unambiguous_limit(travel: float) -> float:
    """Angle up to which a reading within one turn is unambiguous [rad]."""
    return TURN - travel if travel > pi else travel


def settle(servos: Sequence, travel: float, confirmed: Sequence[float] | None) -> str:
    """
    Determine the unknown turn counts of servos.

    Args:
        servos: servos whose ``position`` [rad], ``turns`` and ``turns_known`` are updated.
        travel: travel of the joints to each side [rad].
        confirmed: angles measured by the operator, correct to half a turn [rad], or None.

    Returns:
        '' or a message about the ambiguous servos.

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
