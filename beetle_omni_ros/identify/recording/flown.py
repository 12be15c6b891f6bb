"""The flown part of a recording: what happens on the ground is neither checked nor used."""

from dataclasses import replace

import numpy as np

from beetle_omni_ros.identify.gap.bags import Recording
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.recording.damage import changed, COMMAND, POSE
from beetle_omni_ros.identify.recording.limits import shipped
from beetle_omni_ros.identify.recording.relations import THRUSTS
from beetle_omni_ros.model.parameters import RobotParameters


def flown(recording: Recording, robot: RobotParameters,
          p: GapParameters) -> tuple[Recording, float] | None:
    """
    The longest flight of a recording; None if the robot does not fly.

    Times of recording are used if they are known, because stamps and units may be damaged.

    Returns:
        the flight, with up to ``p.memory`` before it, and that time [s].

    """
    clock = {topic: recording.received.get(topic, t) for topic, t in recording.times.items()}
    t, thrust = clock[COMMAND], recording.values[COMMAND][:, 4:].sum(axis=1)
    weight = robot.mass * robot.gravity
    level = max((thrust**2).sum() / max(thrust.sum(), 1e-9) / weight, 1e-9)
    unit = min((1.0, *THRUSTS), key=lambda u: abs(np.log(level / u)))
    lifted = np.flatnonzero(thrust > p.lifted * weight * min(unit, level))
    if not len(lifted):
        return None
    # A short dip of the thrust is a descent.
    landed = (np.diff(lifted) > 1) & (np.diff(t[lifted]) > p.settle)
    pieces = np.split(lifted, np.flatnonzero(landed) + 1)
    begin, end = t[max(pieces, key=lambda rows: t[rows[-1]] - t[rows[0]])][[0, -1]]
    begin, end = _aloft(recording, clock[POSE], begin, end, p)
    first = max(begin - p.memory, t[0])
    if len(pieces) > 1:
        recording = replace(recording, warnings=[
            *recording.warnings, f'{recording.name}: {len(pieces)} flights, the longest is used'])
    for topic, at in clock.items():
        recording = changed(recording, topic, keep=(at >= first) & (at <= end))
    return recording, float(begin - first)


def _aloft(recording, when, begin, end, p):
    """Times after take-off and before touchdown, as far as these were recorded."""
    height, inside = recording.values[POSE][:, 2], (when > begin) & (when < end)
    before, after = (height[rows] for rows in (when < begin - shipped().bin,
                                               when > end + shipped().bin))
    if len(after):
        high = when[inside & (height > after[0] + shipped().risen)]
        end = high[-1] if len(high) else end
    if not len(before):
        return begin, end
    high = when[inside & (height > before[-1] + shipped().risen)]
    begin = (high[0] if len(high) else begin) + p.settle
    flying = [at for at, state in recording.states if state.startswith('flying') and at < end]
    return max([begin, *flying[:1]]), end
