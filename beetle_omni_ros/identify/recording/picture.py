"""Figure of a damaged topic and the topic that it is compared with."""

import numpy as np

from beetle_omni_ros.identify.gap.bags import Recording
from beetle_omni_ros.identify.recording.clocks import begin_of
from beetle_omni_ros.identify.recording.damage import Damage
from beetle_omni_ros.pages.figures import COLOURS, FAINT, legend, line, panels

APART = 5       # MoCap readings between two orientations of a finite difference


def damage_figure(recording: Recording, damage: Damage):
    """Figure of the damaged, uncorrected readings; a dashed line marks the onset."""
    begin = begin_of(recording)
    joints = damage.topic in ('joint_states', 'command')
    figure, axes = panels(4 if joints else 3, 1, height=1.1, sharex=True)
    draw = _joints if joints else _motion
    draw(recording, axes[:, 0], begin)
    for axis in axes[:, 0]:
        if damage.at_s is not None:
            axis.axvline(damage.at_s, color=COLOURS[1], ls='--', lw=1.0)
    axes[-1, 0].set_xlabel('stamp [s], from the first IMU message on')
    legend(figure, axes[0, 0])
    return figure


def _joints(recording, axes, begin):
    for k, axis in enumerate(axes):
        for topic, colour in (('command', FAINT), ('joint_states', COLOURS[0])):
            values = recording.values[topic]
            if len(values):
                line(axis, recording.times[topic] - begin, values[:, k], color=colour, lw=0.9,
                     label=topic)
        axis.set_ylabel(f'gimbal{k + 1} [rad]')


def _motion(recording, axes, begin):
    rate, force, place = axes
    t, values = recording.times['imu/data_raw'] - begin, recording.values['imu/data_raw']
    if len(t):
        line(rate, t, np.linalg.norm(values[:, 3:], axis=1), color=COLOURS[0], lw=0.8,
             label='imu/data_raw')
        line(force, t, np.linalg.norm(values[:, :3], axis=1), color=COLOURS[0], lw=0.8)
    t, pose = recording.times['mocap/pose'] - begin, recording.values['mocap/pose']
    if len(t) > APART:
        line(rate, *_turning(t, pose[:, 3:]), color=COLOURS[1], lw=0.8, label='mocap/pose')
        for k, axis in enumerate('xyz'):
            place.plot(t, pose[:, k], lw=0.8, color=COLOURS[k], label=axis)
        place.legend(loc='upper right', ncols=3)
    rate.set_ylabel('rate [rad/s]')
    force.set_ylabel('force [m/s^2]')
    place.set_ylabel('position [m]')


def _turning(t, quaternion):
    """Times (n,) and magnitude of the rate (n,) [rad/s] of orientations (N, 4)."""
    with np.errstate(all='ignore'):
        unit = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
        cosine = np.clip(np.abs((unit[APART:] * unit[:-APART]).sum(axis=1)), 0, 1)
        steps = t[APART:] - t[:-APART]
        rate = 2 * np.arccos(cosine) / np.where(steps > 0, steps, np.nan)
    return 0.5 * (t[APART:] + t[:-APART]), rate
