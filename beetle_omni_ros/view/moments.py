"""What a picture of a flight shows at one moment."""

from bisect import bisect_right
from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.control.base import Target
from beetle_omni_ros.runs.log import FlightLog, geodesic_angles, hold, motion

LARGEST = 1e6           # [m, rad, N] of what is drawn; a damaged bag may have any number
Placed = tuple[np.ndarray, np.ndarray]      # position (3,) in world [m], quaternion (4,)


@dataclass
class Moment:
    """
    One robot at one time.

    Attributes:
        position, quaternion: (3,) in world [m] and (4,) body to world; the truth if it is known,
            else the estimate.
        tilt, thrust: (4,) measured tilt [rad] and commanded thrust [N].
        force: (3,) external force in world [N].
        target: position and quaternion, or None.
        state: state of the supervisor.

    """

    position: np.ndarray
    quaternion: np.ndarray
    tilt: np.ndarray = field(default_factory=lambda: np.zeros(4))
    thrust: np.ndarray = field(default_factory=lambda: np.zeros(4))
    force: np.ndarray = field(default_factory=lambda: np.zeros(3))
    target: Placed | None = None
    state: str = ''

    def text(self) -> str:
        """Return state and errors as one line."""
        parts = [self.state] if self.state else []
        if self.target is not None:
            away = np.linalg.norm(self.position - self.target[0])
            angle, = geodesic_angles(self.quaternion[None], self.target[1])
            parts.append(f'{1e3 * away:.0f} mm, {np.degrees(angle):.1f}° off target')
        return ', '.join(parts)


def drawable(values: np.ndarray) -> np.ndarray:
    """Return values without NaN, within LARGEST."""
    return np.clip(np.nan_to_num(values), -LARGEST, LARGEST)


def target_at(targets: list[Target], t: float) -> Placed | None:
    """Return the pose of the latest target at ``t`` [s], or None before the first one."""
    k = bisect_right(targets, t + 1e-6, key=lambda target: target.stamp) - 1
    if k < 0:
        return None
    reference = targets[k].at(t)
    return reference.position, reference.quaternion


def moments(log: FlightLog, times: np.ndarray) -> list[Moment | None]:
    """
    Return what is shown at ``times`` (N,) [s] on the clock of the flight.

    None before the first pose and after the last one.
    """
    body = motion(log)

    def held(t, values, width):
        return drawable(hold(t, values, times)) if len(t) else np.zeros((len(times), width))

    rows = zip(times, held(body.t, body.position, 3), held(body.t, body.quaternion, 4),
               held(*(log.joint_t, log.joint_position) if len(log.joint_t) else
                    (log.command_t, log.command_tilt), 4),
               held(log.command_t, log.command_thrust, 4), held(log.wrench_t, log.wrench_force, 3))
    made: list[Moment | None] = []
    for t, position, quaternion, tilt, thrust, force in rows:
        state = bisect_right(log.state_t, t) - 1
        known = body.t[0] - 1e-6 <= t <= body.t[-1] + 0.1
        made.append(Moment(position, quaternion, tilt, thrust, force, target_at(log.targets, t),
                           log.states[state] if state >= 0 else '') if known else None)
    return made
