"""Damaged commands."""

from __future__ import annotations

import numpy as np

from gap_damage_kinds.joints import DEGREES
from gap_damage_kinds.kind import damage
from gap_damage_kinds.recording import COMMAND

MOST = 20.0         # [N] of a rotor
LATE = 0.3          # [s]
THRUST = 'thrust|effort|rotor|command'
TIMES = r'clock|stamp|\blat|\bearl|delay|ahead|behind|older|newer|shift'


def scaled(bag, tilt=1.0, thrust=1.0):
    """Scale tilts and thrusts of the commands."""
    bag.put(COMMAND, bag.values(COMMAND) * np.repeat([tilt, thrust], 4))


@damage('tilt commands in degrees', COMMAND, causes=[
    ('tilt|joint|command|gimbal', DEGREES)])
def tilt_degrees(bag, random, other):
    """The thrusts are unchanged."""
    scaled(bag, tilt=np.degrees(1))


@damage('thrust commands in percent', COMMAND, causes=[
    ('thrust|effort|rotor', 'percent|%|unit|scale|factor')])
def thrust_percent(bag, random, other):
    """20 N is written as 100."""
    scaled(bag, thrust=100 / MOST)


@damage('thrust commands in millinewton', COMMAND, causes=[
    ('thrust|effort|rotor', r'milli|\bmN\b|unit|scale|factor|1000')])
def thrust_thousandfold(bag, random, other):
    """The thrusts are multiplied by 1000."""
    scaled(bag, thrust=1000.0)


@damage('commands stamped 0.3 s late', COMMAND, causes=[('command', TIMES)])
def commands_late(bag, random, other):
    """The stamps are later than those of the answered states."""
    bag.put_stamps(COMMAND, bag.stamps(COMMAND) + LATE)


@damage('commands stamped 0.3 s early', COMMAND, causes=[('command', TIMES)])
def commands_early(bag, random, other):
    """The stamps are earlier than those of the answered states."""
    bag.put_stamps(COMMAND, bag.stamps(COMMAND) - LATE)


@damage('thrusts from the last rotor to the first', COMMAND, causes=[
    (THRUST, 'order|swap|exchang|interchang|mixed|permut|revers')])
def thrusts_reversed(bag, random, other):
    """The names are unchanged."""
    bag.put(COMMAND, bag.values(COMMAND)[:, [0, 1, 2, 3, 7, 6, 5, 4]])


@damage('tilt commands with the opposite sign', COMMAND, causes=[
    ('tilt|joint|command|gimbal', 'sign|negat|revers|invert|opposite|mirror|flip')])
def tilt_sign(bag, random, other):
    """All four tilts change their sign."""
    scaled(bag, tilt=-1.0)
