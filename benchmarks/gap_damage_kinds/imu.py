"""Damaged IMU samples."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from gap_damage_kinds.kind import damage, FIRST, REPAIRABLE
from gap_damage_kinds.recording import IMU, MOCAP

GRAVITY = 9.80665       # [m/s^2]
SATURATED = 1.0         # [rad/s]
SPIKE = 1e6             # [m/s^2]
TURNED = r'\bturn|rotat|\bmount|misalign|ax[ei]s|orient'
SENSOR = r'imu|accelero|gyro|specific force'


def turned(bag, axis, degrees, begin=-np.inf):
    """Rotate both sensors by [deg] about a body axis, from a stamp on."""
    turn = Rotation.from_euler(axis, degrees, degrees=True)
    values, late = bag.values(IMU), bag.stamps(IMU) >= begin
    for columns in (slice(0, 3), slice(3, 6)):
        values[late, columns] = turn.apply(values[late, columns])
    bag.put(IMU, values)


@damage('gyroscope in deg/s', IMU, causes=[
    r'deg(rees?)?\s?(/|per )\s?s', ('gyro|rate', 'in deg|unit.*deg|deg.*unit')])
def gyroscope_degrees(bag, random, other):
    """The rates are multiplied by 57.3."""
    bag.put(IMU, bag.values(IMU) * [1, 1, 1, *np.full(3, np.degrees(1))])


@damage('accelerometer in g', IMU, causes=[
    r'\bin g\b', r"units? of g\b|\bg units?\b|'g'|\(g\)|m/s.{0,3} in place of g",
    ('gravit|9\\.8', 'unit|factor|scale')])
def accelerometer_g(bag, random, other):
    """The specific force is divided by 9.80665."""
    bag.put(IMU, bag.values(IMU) / [GRAVITY, GRAVITY, GRAVITY, 1, 1, 1])


@damage('accelerometer with the opposite sign', IMU, causes=[
    ('accelero|specific force|imu|force', 'sign|negat|revers|invert|opposite|convention')])
def accelerometer_sign(bag, random, other):
    """The specific force has the opposite sign."""
    bag.put(IMU, bag.values(IMU) * [-1, -1, -1, 1, 1, 1])


@damage('accelerometer without gravity', IMU, causes=[
    ('gravity', r'without|missing|remov|\bno\b|lacks|taken|subtract|compensat|zero|free|absent'),
    ('accelero|specific force', 'linear acceleration|free of|compensat')])
def accelerometer_without_gravity(bag, random, other):
    """The driver subtracts gravity, like the "linear acceleration" of some IMUs."""
    values, pose = bag.values(IMU), bag.values(MOCAP)
    t = bag.stamps(MOCAP)
    rising = np.flatnonzero(np.diff(t, prepend=-np.inf) > 0)
    attitude = Slerp(t[rising], Rotation.from_quat(pose[rising, 3:]))
    at = np.clip(bag.stamps(IMU), t[rising[0]], t[rising[-1]])
    values[:, :3] -= attitude(at).inv().apply([0, 0, GRAVITY])
    bag.put(IMU, values)


@damage('IMU with y and z axes swapped, both sensors', IMU, causes=[
    (SENSOR, 'swap|exchang|interchang|permut|left.?hand|mirror'), (SENSOR, TURNED)])
def imu_yz_swapped(bag, random, other):
    """The axes are left-handed, so that no rotation can explain them."""
    bag.put(IMU, bag.values(IMU)[:, [0, 2, 1, 3, 5, 4]])


@damage('IMU turned by 90 deg about z', IMU, causes=[(SENSOR, TURNED)])
def imu_turned_z(bag, random, other):
    """The mounting is not in the robot file."""
    turned(bag, 'z', 90)


@damage('IMU upside down: 180 deg about x', IMU,
        causes=[(SENSOR, f'upside|180|{TURNED}'), 'upside down'])
def imu_upside_down(bag, random, other):
    """Forward-right-down axes look the same."""
    turned(bag, 'x', 180)


@damage('IMU turned by 90 deg about z from half way', IMU, scope=FIRST,
        causes=[(SENSOR, f'{TURNED}|loose|slip')])
def imu_turned_halfway(bag, random, other):
    """The mounting slips in flight."""
    begin = bag.moment(0.5)
    turned(bag, 'z', 90, begin)
    return begin


@damage('gyroscope with the opposite sign about y', IMU, causes=[
    ('gyro|rate|angular', 'sign|left.?hand|mirror|invert|revers|flip|negat|opposite')])
def gyroscope_sign(bag, random, other):
    """One axis has the opposite sign, as in a left-handed sensor."""
    bag.put(IMU, bag.values(IMU) * [1, 1, 1, 1, -1, 1])


@damage('gyroscope saturated at 1 rad/s', IMU,
        causes=[r'satur|clip|limit|\brange|never (above|exceeds)|full.?scale'])
def gyroscope_saturated(bag, random, other):
    """The range is set too small."""
    values = bag.values(IMU)
    values[:, 3:] = np.clip(values[:, 3:], -SATURATED, SATURATED)
    bag.put(IMU, values)


@damage('gyroscope without signal: all zero', IMU,
        causes=[('gyro|rate|angular|imu', r'zero|\b0\b|dead|constant|no signal|frozen|unchang')])
def gyroscope_dead(bag, random, other):
    """The driver does not read the gyroscope."""
    bag.put(IMU, bag.values(IMU) * [1, 1, 1, 0, 0, 0])


@damage('one accelerometer value of 1e6', IMU, scope=FIRST, harm=REPAIRABLE,
        causes=[r'spike|outlier|impossibl|implausibl|\brange|exceed|beyond|physical|1e\+?0?6|10{6}'])
def imu_spike(bag, random, other):
    """A bit error passes the checksum."""
    values = bag.values(IMU)
    row = int(random.uniform(0.3, 0.7) * len(values))
    values[row, 0] = SPIKE
    bag.put(IMU, values)
    return float(bag.stamps(IMU)[row])


@damage('every other IMU sample repeats the one before', IMU,
        causes=[(SENSOR, 'repeat|stale|duplicat|same|half|held|twice|fr[eo]z')])
def imu_stale(bag, random, other):
    """The driver reads at twice the rate of the sensor."""
    values = bag.values(IMU)
    values[1::2] = values[:-1:2] if len(values) % 2 else values[::2]
    bag.put(IMU, values)


@damage('IMU values that are no numbers, twenty times', IMU, scope=FIRST, harm=REPAIRABLE,
        causes=[r'\bnan\b|finite|not a number|no numbers?'])
def imu_nan(bag, random, other):
    """The driver writes nan for lost samples."""
    values = bag.values(IMU)
    rows = np.sort(random.choice(np.arange(len(values) // 4, len(values)),
                                 min(20, len(values) // 10), replace=False))
    values[rows] = np.nan
    bag.put(IMU, values)
    return float(bag.stamps(IMU)[rows[0]])
