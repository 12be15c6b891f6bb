"""The flown part of a recording: what happens on the ground is neither checked nor used."""

from dataclasses import replace

import numpy as np

from beetle_omni_ros.identify.gap.bags import Recording
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.recording.limits import RecordingLimits, shipped
from beetle_omni_ros.identify.recording.relations import THRUSTS
from beetle_omni_ros.robot.parameters import RobotParameters


def flown(recording: Recording, robot: RobotParameters, p: GapParameters,
          limits: RecordingLimits | None = None) -> tuple[Recording, float] | None:
    """
    The longest flight of a recording; None if the robot does not fly.

    Times of recording are used if they are known, because stamps and units may be damaged.

    Returns:
        the flight, with up to one second before it, and that time [s].

    """
    limits = limits or shipped()
    clock = {topic: received if len(received := recording.received.get(topic, ())) == len(t)
             else t for topic, t in recording.times.items()}
    t, thrust = clock['command'], recording.values['command'][:, 4:].sum(axis=1)
    weight = robot.mass * robot.gravity
    level = max((thrust**2).sum() / max(thrust.sum(), 1e-9) / weight, 1e-9)
    unit = min((1.0, *THRUSTS), key=lambda u: abs(np.log(level / u)))
    lifted = np.flatnonzero(thrust > p.lifted * weight * min(unit, level))
    if not len(lifted):
        return None
    # A short dip of the thrust is a descent.
    landed = (np.diff(lifted) > 1) & (np.diff(t[lifted]) > p.settle)
    pieces = [(t[piece[0]], t[piece[-1]])
              for piece in np.split(lifted, np.flatnonzero(landed) + 1)]
    begin, end = max(pieces, key=lambda piece: piece[1] - piece[0])
    begin, end = _aloft(recording, clock['mocap/pose'], begin, end, p, limits)
    first = max(begin - p.memory, t[0])
    result = replace(recording, times={}, values={}, received={}, warnings=[
        *recording.warnings, *([f'{recording.name}: {len(pieces)} flights; the longest is used']
                               if len(pieces) > 1 else [])])
    for topic, at in clock.items():
        keep = (at >= first) & (at <= end)
        for new, old in ((result.times, recording.times), (result.values, recording.values),
                         (result.received, recording.received)):
            if topic in old:
                new[topic] = old[topic][keep] if len(old[topic]) == len(at) else old[topic]
    return result, begin - first


def _aloft(recording, when, begin, end, p, limits):
    """Times after take-off and before touchdown, as far as these were recorded."""
    height, inside = recording.values['mocap/pose'][:, 2], (when > begin) & (when < end)
    before, after = height[when < begin - limits.bin], height[when > end + limits.bin]
    if len(after):
        high = when[inside & (height > after[0] + limits.risen)]
        end = high[-1] if len(high) else end
    if not len(before):
        return begin + 0.1, end
    high = when[inside & (height > before[-1] + limits.risen)]
    begin = (high[0] if len(high) else begin) + p.settle
    flying = [at for at, state in recording.states if state.startswith('flying') and at < end]
    return max([begin, *flying[:1]]), end
