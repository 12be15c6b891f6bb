"""How noisy the MoCap really is, seen from its poses alone."""

import numpy as np

from beetle_omni_ros.estimation.parameters import MocapParameters
from beetle_omni_ros.robot import rotations

POSES = 4        # a third difference needs four
GAIN = 20.0      # variance of the third difference of white noise: 1 + 9 + 9 + 1
CLIP = 9.0       # one difference counts at most as three standard deviations
WINDOW = 100     # poses that are averaged
TRUSTED = 1.5    # excess of variance that chance does not give over the window
EVEN = 0.1       # relative difference of intervals still taken as even


class NoiseMonitor:
    """
    Compares the noise of position and orientation with what the parameters claim.

    The third difference of evenly spaced poses removes smooth motion and keeps noise. It needs
    no filter state, so it works before the first fix, cannot argue with the gate, and a jump or
    a single outlier, being clipped, hardly moves it.
    """

    def __init__(self, mocap: MocapParameters):
        """Begin with the parameters' claim."""
        self._claim = np.array([mocap.position_noise, mocap.orientation_noise]) ** 2 * (3 * GAIN)
        self._limit = mocap.noise_scale_limit ** 2
        self._poses: list = []
        self._count = 0
        self._ratio = np.ones(2)

    @property
    def scale(self) -> tuple[float, float]:
        """Factors >= 1 on the claimed variances of position and orientation."""
        position, orientation = self._ratio.tolist()
        return (min(position, self._limit) if position > TRUSTED else 1.0,
                min(orientation, self._limit) if orientation > TRUSTED else 1.0)

    def add(self, stamp: float, position: np.ndarray, quaternion: np.ndarray) -> None:
        """Take one pose: stamp [s], (3,) [m], (4,) unit."""
        poses = self._poses
        if poses:
            last = poses[-1]
            turn = rotations.log(rotations.multiply(
                rotations.conjugate(last[2]).tolist(), quaternion.tolist()))
            poses.append((stamp, position, quaternion, position - last[1], turn, stamp - last[0]))
        else:
            poses.append((stamp, position, quaternion, None, None, None))
        if len(poses) < POSES:
            return
        (_, _, _, move1, turn1, dt1), (_, _, _, move2, turn2, dt2), (*_, move3, turn3, dt3) = \
            poses[1:]
        del poses[0]
        if max(dt1, dt2, dt3) - min(dt1, dt2, dt3) > EVEN * dt2:
            return
        position_excess = move3 - 2 * move2 + move1
        orientation_excess = turn3 - 2 * turn2 + turn1
        seen = np.array([position_excess @ position_excess,
                         orientation_excess @ orientation_excess]) / self._claim
        self._count = min(self._count + 1, WINDOW)
        self._ratio += (np.minimum(seen, CLIP * self._ratio) - self._ratio) / self._count
