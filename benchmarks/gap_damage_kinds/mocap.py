"""Damaged poses."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gap_damage_kinds.kind import damage, FIRST, HARMLESS, REPAIRABLE
from gap_damage_kinds.recording import MOCAP

OUTLIERS = 12
TURNED = r'\bturn|rotat|\bmount|misalign|ax[ei]s|frame'
UNIT = 'unit|scale|factor|instead|in place'


@damage('MoCap quaternion in the order w, x, y, z', MOCAP,
        causes=[('quaternion|orientation', r'\bw\b|wxyz|order')])
def mocap_wxyz(bag, random, other):
    """The quaternion has the order w, x, y, z."""
    pose = bag.values(MOCAP)
    pose[:, 3:] = pose[:, [6, 3, 4, 5]]
    bag.put(MOCAP, pose)


@damage('MoCap position in millimetres', MOCAP, causes=[
    'millimet', (r'\bmm\b', f'{UNIT}|in mm|1000')])
def mocap_millimetres(bag, random, other):
    """The positions are multiplied by 1000."""
    bag.put(MOCAP, bag.values(MOCAP) * [1e3, 1e3, 1e3, 1, 1, 1, 1])


@damage('MoCap position in centimetres', MOCAP, causes=[
    'centimet', (r'\bcm\b', f'{UNIT}|in cm|100')])
def mocap_centimetres(bag, random, other):
    """The positions are multiplied by 100."""
    bag.put(MOCAP, bag.values(MOCAP) * [1e2, 1e2, 1e2, 1, 1, 1, 1])


@damage('MoCap positions with 30 mm of white noise', MOCAP,
        causes=['noise|nois|scatter'])
def mocap_noisy(bag, random, other):
    """Every position has noise."""
    pose = bag.values(MOCAP).copy()
    pose[:, :3] += random.normal(0.0, 0.03, (len(pose), 3))
    bag.put(MOCAP, pose)


@damage('MoCap repeats its last pose, with new stamps, for a seventh of the flight', MOCAP,
        causes=['freez|froze|stuck|repeat|constant|stale|not change|unchang|same|stands? still'],
        scope=FIRST)
def mocap_frozen(bag, random, other):
    """The pose is constant from 45 % of the recording on."""
    begin, end = bag.moment(0.45), bag.moment(0.45 + 1 / 7)
    t, pose = bag.stamps(MOCAP), bag.values(MOCAP)
    held = (t >= begin) & (t < end)
    pose[held] = pose[np.flatnonzero(held)[0]]
    bag.put(MOCAP, pose)
    return begin


@damage('MoCap world with y up, the body as it was', MOCAP,
        causes=['y.?up', 'z.?up', ('up|vertical|gravity', 'ax[ei]s|frame|world|turned|tilt')])
def mocap_y_up(bag, random, other):
    """The axes are those of Motive by default: x stays, z becomes y, y becomes -z."""
    turn = Rotation.from_euler('x', -90, degrees=True)
    pose = bag.values(MOCAP)
    pose[:, :3] = turn.apply(pose[:, :3])
    pose[:, 3:] = (turn * Rotation.from_quat(pose[:, 3:])).as_quat()
    bag.put(MOCAP, pose)


@damage('MoCap world and body with y up', MOCAP,
        causes=['y.?up', 'z.?up', ('up|vertical|gravity', 'ax[ei]s|frame|world|turned|tilt')])
def mocap_y_up_body(bag, random, other):
    """The vectors of position and quaternion are permuted."""
    pose = bag.values(MOCAP)
    pose = pose[:, [0, 2, 1, 3, 5, 4, 6]] * [1, 1, -1, 1, 1, -1, 1]
    bag.put(MOCAP, pose)


@damage('MoCap in left-handed axes: y mirrored, the quaternion after it', MOCAP,
        causes=['left.?hand|handed|mirror', ('sign|flip|invert|negat|reflect', r'\by\b')])
def mocap_left_handed(bag, random, other):
    """The axes are those of Unity: rotations about x and z change their sign."""
    bag.put(MOCAP, bag.values(MOCAP) * [1, -1, 1, -1, 1, -1, 1])


@damage('MoCap quaternion from world to body instead of from body to world', MOCAP,
        causes=[('quaternion|orientation|attitude|rotation', 'conjugat|invers|invert|transpos')])
def mocap_conjugate(bag, random, other):
    """The vector of the quaternion has the opposite sign."""
    bag.put(MOCAP, bag.values(MOCAP) * [1, 1, 1, -1, -1, -1, 1])


@damage('markers turned by 90 deg about z against the body', MOCAP,
        causes=[('mocap|marker|pose|orientation|rigid', TURNED)])
def mocap_body_turned(bag, random, other):
    """The rigid body was defined with a rotated robot."""
    pose = bag.values(MOCAP)
    turn = Rotation.from_euler('z', 90, degrees=True)
    pose[:, 3:] = (Rotation.from_quat(pose[:, 3:]) * turn).as_quat()
    bag.put(MOCAP, pose)


@damage('MoCap quaternion of length 2', MOCAP, harm=REPAIRABLE,
        causes=[('quaternion|orientation', r'norm|unit|length|\b2\b')])
def mocap_unnormalised(bag, random, other):
    """The quaternions have another norm."""
    bag.put(MOCAP, bag.values(MOCAP) * [1, 1, 1, 2, 2, 2, 2])


@damage('a zero quaternion now and then', MOCAP, scope=FIRST, harm=REPAIRABLE,
        causes=[('quaternion|orientation', 'zero|norm|unit|length')])
def mocap_zero_quaternion(bag, random, other):
    """The body is lost for fifteen samples."""
    pose = bag.values(MOCAP)
    rows = np.sort(random.choice(np.arange(len(pose) // 5, len(pose)),
                                 min(15, len(pose) // 10), replace=False))
    pose[rows, 3:] = 0.0
    bag.put(MOCAP, pose)
    return float(bag.stamps(MOCAP)[rows[0]])


@damage('a dozen pose outliers: swapped markers turn the body by 180 deg', MOCAP, scope=FIRST,
        harm=REPAIRABLE,
        causes=['outlier|jump|flip|spike|implausibl|leap|swap|teleport|too fast|faster than'])
def mocap_outliers(bag, random, other):
    """Single samples are rotated about a body axis and moved by some centimetres."""
    pose = bag.values(MOCAP)
    rows = np.sort(random.choice(np.arange(len(pose) // 4, len(pose)),
                                 min(OUTLIERS, len(pose) // 10), replace=False))
    for row in rows:
        turn = Rotation.from_euler(random.choice(['x', 'y', 'z']), 180, degrees=True)
        pose[row, 3:] = (Rotation.from_quat(pose[row, 3:]) * turn).as_quat()
        pose[row, :3] += random.uniform(-0.08, 0.08, 3)
    bag.put(MOCAP, pose)
    return float(bag.stamps(MOCAP)[rows[0]])


@damage('control: another sign of some quaternions, which is the same orientation', MOCAP,
        harm=HARMLESS)
def mocap_quaternion_sign(bag, random, other):
    """The driver keeps w positive."""
    pose = bag.values(MOCAP)
    pose[pose[:, 6] < 0, 3:] *= -1
    some = len(pose) // 3
    pose[some:2 * some, 3:] *= -1
    bag.put(MOCAP, pose)


@damage('control: MoCap world turned by 90 deg about the vertical, and moved', MOCAP,
        harm=HARMLESS)
def mocap_world_turned(bag, random, other):
    """The heading of the world frame has no physical effect."""
    turn = Rotation.from_euler('z', 90, degrees=True)
    pose = bag.values(MOCAP)
    pose[:, :3] = turn.apply(pose[:, :3]) + [0.4, -0.7, 0.0]
    pose[:, 3:] = (turn * Rotation.from_quat(pose[:, 3:])).as_quat()
    bag.put(MOCAP, pose)


