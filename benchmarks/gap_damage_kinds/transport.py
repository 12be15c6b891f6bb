"""Damage of whole bags by recorders, networks and operators."""

from __future__ import annotations

from copy import copy

from gap_damage_kinds.kind import damage, FIRST, HARMLESS, REPAIRABLE
from gap_damage_kinds.recording import BATTERY, IMU, JOINTS, MEASURED, MOCAP


@damage('messages of two flights, one between the other', *MEASURED, scope=FIRST, causes=[
    r'\btwo\b|interleav|several|mixed|more than one|another flight|second (flight|publisher)'])
def two_flights(bag, random, other):
    """Two recordings are merged, the second one half a millisecond later."""
    begin = bag.messages[0].received - other.messages[0].received + 5e-4
    for m in other.copy().messages:
        m.received += begin
        if m.name in MEASURED:
            m.stamp += begin
            bag.messages.append(m)
    bag.in_order()


@damage('every message twice', *MEASURED, harm=REPAIRABLE,
        causes=['duplicat|twice|repeat|same (stamp|time)|double|two messages'])
def duplicates(bag, random, other):
    """Messages are recorded twice, by two recorders or two network paths."""
    bag.messages = [made for m in bag.messages for made in (m, copy(m))]


@damage('IMU messages in the wrong order', IMU, harm=REPAIRABLE,
        causes=['order|sort|earlier|backward|jumps? back|not rising|monoton'])
def out_of_order(bag, random, other):
    """Neighbouring messages are shuffled with their stamps."""
    places = [k for k, m in enumerate(bag.messages) if m.name == IMU]
    for begin in range(0, len(places) - 8, 8):
        block = places[begin:begin + 8]
        mixed = [bag.messages[k] for k in random.permutation(block)]
        times = [bag.messages[k].received for k in block]
        for k, m, t in zip(block, mixed, times, strict=True):
            bag.messages[k], m.received = m, t


@damage('the bag is cut off at 60 %', scope=FIRST, harm=REPAIRABLE,
        causes=[r'\bcut|truncat|ends early|incomplete|metadata|not finish|unfinished'])
def cut_off(bag, random, other):
    """The recorder is killed."""
    bag.keep = 0.6


@damage('no MoCap', MOCAP, causes=[
    (r'mocap', r'\bno\b|missing|without|absent|lacks|empty|never|not recorded|0 messages')])
def mocap_missing(bag, random, other):
    """The driver does not run."""
    bag.drop(MOCAP)


@damage('no MoCap for 3 s', MOCAP, scope=FIRST, harm=REPAIRABLE,
        causes=['gap|hole|missing|drop|silen|without|lost|absent|no message'])
def mocap_silent(bag, random, other):
    """The robot is out of sight of the cameras."""
    begin = bag.moment(0.5)
    bag.messages = [m for m in bag.messages
                    if m.name != MOCAP or not begin <= m.stamp < begin + 3.0]
    return begin


@damage('control: nothing is changed', harm=HARMLESS)
def nothing(bag, random, other):
    """The recording is unchanged."""


@damage('control: battery current with the opposite sign', BATTERY, harm=HARMLESS)
def battery_current(bag, random, other):
    """Only the voltage is used."""
    for m in bag.on(BATTERY):
        m.content.current = -m.content.current


@damage('control: no battery', BATTERY, harm=HARMLESS)
def battery_missing(bag, random, other):
    """The topic is optional."""
    bag.drop(BATTERY)


@damage('control: all topics in a namespace', harm=HARMLESS)
def in_namespace(bag, random, other):
    """The topics are in the namespace /robot1."""
    for m in bag.messages:
        m.topic = '/robot1' + m.topic


@damage('control: a tenth of the joint feedback is lost', JOINTS, harm=HARMLESS)
def joints_lossy(bag, random, other):
    """Single messages are lost, as with best effort."""
    lost = random.random(len(bag.messages)) < 0.1
    bag.messages = [m for m, gone in zip(bag.messages, lost, strict=True)
                    if not (gone and m.name == JOINTS)]


