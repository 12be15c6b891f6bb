"""Damaged stamps: clocks that jump, drift, or count something else."""

from __future__ import annotations

import numpy as np

from gap_damage_kinds.kind import damage, FIRST, HARMLESS, REPAIRABLE
from gap_damage_kinds.recording import COMMAND, IMU, JOINTS, MOCAP

CLOCK = r'clock|stamp|\btime'
STEP = (r'jump|\bstep|\bback|decreas|monoton|order|forward|ahead|\blat|\bearl|shift|offset|leap|'
        r'behind')
ANOTHER_DAY = 40 * 86400.0      # [s] later
BOOTED = 5.0                    # [s] from the start of a board to its first message


def stepped(bag, name, part, by):
    """Let the clock of a topic jump ``by`` [s] when ``part`` of the recording is over."""
    begin = bag.moment(part)
    t = bag.stamps(name)
    bag.put_stamps(name, t + by * (t >= begin))
    return begin


@damage('MoCap clock 0.3 s back from half way', MOCAP, scope=FIRST, causes=[(CLOCK, STEP)])
def mocap_clock_back(bag, random, other):
    """The clock of the MoCap computer is set back by a time server."""
    return stepped(bag, MOCAP, 0.5, -0.3)


@damage('encoder clock 0.15 s late from half way', JOINTS, scope=FIRST, causes=[(CLOCK, STEP)])
def encoder_clock_late(bag, random, other):
    """The stamps are 0.15 s later than the positions."""
    return stepped(bag, JOINTS, 0.5, 0.15)


@damage('MoCap clock 0.3 s forward at a third', MOCAP, scope=FIRST, causes=[(CLOCK, STEP)])
def mocap_clock_forward(bag, random, other):
    """The stamps look like those of a short gap."""
    return stepped(bag, MOCAP, 1 / 3, 0.3)


@damage('IMU clock 1.5 s forward at 60 %', IMU, scope=FIRST, causes=[(CLOCK, STEP)])
def imu_clock_forward(bag, random, other):
    """Looks like a silence."""
    return stepped(bag, IMU, 0.6, 1.5)


@damage('command clock 0.8 s forward at 40 %', COMMAND, scope=FIRST, causes=[(CLOCK, STEP)])
def command_clock_forward(bag, random, other):
    """Looks like a silence."""
    return stepped(bag, COMMAND, 0.4, 0.8)


def ramp(bag, name, rate):
    """Shift stamps by ``rate`` seconds a second."""
    t = bag.stamps(name)
    return t + rate * (t - t[0])


@damage('MoCap clock 1 % too fast', MOCAP, causes=[
    (CLOCK, r'drift|fast|slow|\brate|diverg|percent|%')])
def mocap_drift(bag, random, other):
    """Times of recording are unchanged."""
    bag.put_stamps(MOCAP, ramp(bag, MOCAP, 0.01))


@damage('MoCap later and later: stamped on arrival, by 0.5 s in the end', MOCAP, causes=[
    (f'{CLOCK}|mocap', r'drift|grow|increas|\blate|delay|progress|diverg|slow|fast|\brate')])
def mocap_delay_growing(bag, random, other):
    """A queue fills: times of recording grow later than the stamps."""
    t = bag.stamps(MOCAP)
    later = 0.5 * (t - t[0]) / (t[-1] - t[0])
    bag.put_stamps(MOCAP, t + later)
    for m, by in zip(bag.on(MOCAP), later, strict=True):
        m.received += float(by)
    bag.in_order()


@damage('all IMU stamps zero', IMU, causes=[
    (CLOCK, r'zero|\b0(\.0*)? s|\b0\b|1970|epoch|not set|unset|same|equal|empty|constant')])
def imu_stamps_zero(bag, random, other):
    """The driver does not set the stamps."""
    bag.put_stamps(IMU, np.zeros(len(bag.on(IMU))))


def moved(bag, by):
    """Shift all stamps and times of recording."""
    for m in bag.messages:
        m.received += by
        if hasattr(m.content, 'header'):
            m.stamp += by


@damage('joint stamps of 1970, since the board was switched on; all others of today', JOINTS,
        causes=[(CLOCK, '1970|zero|epoch|apart|overlap|years?|days?|boot|another clock|differ')])
def joint_stamps_1970(bag, random, other):
    """The board has no clock."""
    t = bag.stamps(JOINTS)
    bag.put_stamps(JOINTS, t - t[0] + BOOTED)


@damage('MoCap stamps an hour ahead', MOCAP, causes=[
    (CLOCK, r'hour|3600|apart|overlap|ahead|another clock|differ|offset|future|3[56]\d\d')])
def mocap_hour_ahead(bag, random, other):
    """The MoCap computer uses summer time."""
    bag.put_stamps(MOCAP, bag.stamps(MOCAP) + 3600.0)


@damage('times of recording an hour after all stamps', harm=REPAIRABLE, causes=[
    ('clock|stamp|time|record|receiv', r'hour|3600|3[56]\d\d|apart|\blate|after|ahead|differ')])
def received_hour_late(bag, random, other):
    """The clock of the recorder is late; the stamps agree with each other."""
    for m in bag.messages:
        m.received += 3600.0


def _count_in_seconds(bag, topic, unit):
    """Put stamps, counted in 1/unit s, into the 32 bits of their seconds."""
    for m, t in zip(bag.on(topic), bag.stamps(topic), strict=True):
        m.content.header.stamp.sec = (round(t * unit) + 2**31) % 2**32 - 2**31
        m.content.header.stamp.nanosec = 0


@damage('MoCap nanoseconds in the seconds of the stamp', MOCAP, causes=[
    (CLOCK, r'nanosec|unit|overflow|order|jump|\bback|monoton|\brange|implausib|factor|apart')])
def mocap_stamps_nanoseconds(bag, random, other):
    """The counts exceed 32 bits and wrap."""
    _count_in_seconds(bag, MOCAP, 1e9)


@damage('joint milliseconds in the seconds of the stamp', JOINTS, causes=[
    (CLOCK, r'millisec|unit|factor|1000|scale|\brate|fast|slow|drift|apart|jump|overlap')])
def joint_stamps_milliseconds(bag, random, other):
    """The stamps run a thousand times too fast, and today's date wraps."""
    _count_in_seconds(bag, JOINTS, 1e3)


@damage('control: the same flight on another day', harm=HARMLESS)
def another_day(bag, random, other):
    """Stamps and times of recording of another date."""
    moved(bag, ANOTHER_DAY)
