"""Damaged stamps: clocks that jump, drift, or count something else."""

from __future__ import annotations

from gap_damage_kinds.kind import damage, FIRST
from gap_damage_kinds.recording import COMMAND, IMU, JOINTS, MOCAP

CLOCK = 'clock|stamp|time'
STEP = 'jump|step|back|decreas|monoton|order|forward|ahead|late|earl|shift|offset|leap|behind'
EPOCH = 1_780_000_000.0     # [s], some day in 2026


def stepped(bag, name, part, by):
    """Let the clock of a topic jump ``by`` [s] when ``part`` of the recording is over."""
    begin = bag.moment(part)
    t = bag.stamps(name)
    bag.put_stamps(name, t + by * (t >= begin))
    return begin


@damage('MoCap clock 0.3 s back from half way', MOCAP, scope=FIRST, causes=[(CLOCK, STEP)])
def mocap_clock_back(bag, random, other):
    """A time server corrects the MoCap computer."""
    return stepped(bag, MOCAP, 0.5, -0.3)


@damage('encoder clock 0.15 s late from half way', JOINTS, scope=FIRST, causes=[(CLOCK, STEP)])
def encoder_clock_late(bag, random, other):
    """Stamps 0.15 s later than the positions."""
    return stepped(bag, JOINTS, 0.5, 0.15)


@damage('MoCap clock 0.3 s forward at a third', MOCAP, scope=FIRST, causes=[(CLOCK, STEP)])
def mocap_clock_forward(bag, random, other):
    """Looks like a short silence."""
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
    """Stamps that run away by ``rate`` seconds a second."""
    t = bag.stamps(name)
    return t + rate * (t - t[0])
