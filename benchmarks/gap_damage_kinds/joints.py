"""Damaged joint feedback."""

from __future__ import annotations

import numpy as np

from gap_damage_kinds.kind import damage, FIRST, HARMLESS
from gap_damage_kinds.recording import JOINTS

COUNTS = 4096           # of an encoder, for one turn; its middle is 0 rad
JOINT = 'joint|encoder|gimbal|tilt'
DEGREES = r'\bin deg|deg\w* (instead|in place|rather|not)|deg.*unit|unit.*deg|not (in )?rad'


def scaled(bag, factors):
    """Multiply positions and velocities of joints 1 to 4 by (4,) factors."""
    values = bag.values(JOINTS)
    bag.put(JOINTS, values * np.tile(factors, values.shape[1] // 4))


@damage('joints 1 and 2 swapped', JOINTS,
        causes=[(JOINT, 'swap|exchang|interchang|mixed|permut|order'),
                (JOINT, 'follows? (the )?(command|target)s? of')])
def joints_swapped(bag, random, other):
    """Two plugs are exchanged."""
    values = bag.values(JOINTS)
    columns = np.arange(values.shape[1]).reshape(-1, 4)[:, [1, 0, 2, 3]].ravel()
    bag.put(JOINTS, values[:, columns])


@damage('joint 3 with the opposite sign', JOINTS,
        causes=[(JOINT, 'sign|negat|revers|invert|opposite|mirror|flip')])
def joint_sign(bag, random, other):
    """The servo has the opposite direction."""
    scaled(bag, [1, 1, -1, 1])


@damage('joints in degrees', JOINTS, causes=[(JOINT, DEGREES)])
def joints_degrees(bag, random, other):
    """Positions and velocities are in degrees."""
    scaled(bag, np.full(4, np.degrees(1)))


@damage('joints in encoder counts', JOINTS, causes=[
    r'\bcounts?\b|\bticks?\b|\braw\b|encoder steps'])
def joints_counts(bag, random, other):
    """A turn has 4096 counts, and 0 rad is 2048."""
    values = bag.values(JOINTS)
    values[:, :4] = np.round(values[:, :4] * COUNTS / (2 * np.pi)) + COUNTS / 2
    values[:, 4:] = np.round(values[:, 4:] * COUNTS / (2 * np.pi))
    bag.put(JOINTS, values)


@damage('joint 2 repeats its last position from a third on', JOINTS, scope=FIRST,
        causes=['freez|froze|stuck|repeat|constant|stale|not change|unchang|same|stands? still|'
                'not move|never mov|does not follow'])
def joint_frozen(bag, random, other):
    """The encoder is no longer read."""
    begin = bag.moment(1 / 3)
    values, late = bag.values(JOINTS), bag.stamps(JOINTS) >= begin
    values[late, 1] = values[np.flatnonzero(late)[0], 1]
    values[late, 5:6] = 0.0
    bag.put(JOINTS, values)
    return begin


@damage('control: joints in another order, with their names', JOINTS, harm=HARMLESS)
def joints_reordered(bag, random, other):
    """The names of the JointState have the same order, so that no data change."""
    for m in bag.on(JOINTS):
        m.content.name = m.content.name[::-1]
        m.content.position = m.content.position[::-1].copy()
        m.content.velocity = m.content.velocity[::-1].copy()
        m.content.effort = m.content.effort[::-1].copy()
