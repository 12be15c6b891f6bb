"""One hypothesis of the motion, with a short history for delayed poses."""

from bisect import bisect_right

import numpy as np

from beetle_omni_ros.estimation.alignment import MarkerAlignment
from beetle_omni_ros.estimation.model import ErrorStateModel
from beetle_omni_ros.estimation.propagation import Node, SAME_INSTANT

VELOCITY_KNOWN = 5  # poses after which the velocity is known, so that the time can be uncertain


def interpolate(stamp, before, after) -> tuple[np.ndarray, np.ndarray]:
    """Force and rate at ``stamp``, linear between two readings (stamp, force, rate)."""
    share = (stamp - before[0]) / (after[0] - before[0])
    return (before[1] + share * (after[1] - before[1]),
            before[2] + share * (after[2] - before[2]))


class Track:
    """
    States from the last correction, or from the largest age of a pose, to the newest reading.

    A pose is applied to the state at its capture time. The later readings are then replayed, so
    that the result is the same as without the delay.
    """

    def __init__(self, model: ErrorStateModel, first: Node, history: float,
                 time_deviation: float = 0.0):
        """
        Start with one state.

        Args:
            model: prediction and correction.
            first: state with its covariance.
            history: largest age of a pose [s].
            time_deviation: standard deviation of the first state's time offset [s].

        """
        self._time_deviation = time_deviation
        self._model = model
        self._history = history
        self.nodes = [first]
        self.last_fix = first.stamp
        self._waits_since: float | None = None     # first reading after a pose was used
        self._aligned: tuple[float, np.ndarray] | None = None   # stamp and turn of expect_poses
        self.fixes = 1

    @property
    def newest(self) -> Node:
        """State at the newest reading."""
        return self.nodes[-1]

    def at(self, stamp: float) -> Node:
        """Last state not after ``stamp`` [s], or the oldest one."""
        return self.nodes[max(0, bisect_right(self.nodes, stamp + SAME_INSTANT, key=_stamp) - 1)]

    def predict(self, stamp: float, force: np.ndarray, rate: np.ndarray,
                after_impact: bool) -> None:
        """Append the state at the next reading."""
        nodes = self.nodes
        nodes.append(self._model.predict(nodes[-1], stamp, force, rate, after_impact))
        while nodes[1].stamp < stamp - self._history:
            del nodes[0]
            self._model.covariance(nodes[0])    # otherwise it would keep its predecessors

    def expect_poses(self, period: float, alignment: MarkerAlignment) -> None:
        """Prepare the newest state for dead reckoning if no pose was used for ``period`` [s]."""
        if self._waits_since is None:
            self._waits_since = self.newest.stamp
        if self.newest.stamp - self._waits_since > period:
            self._waits_since = np.inf      # once after each pose
            known = alignment.corrected(self.newest, self._model.covariance(self.newest))
            if known is not self.newest:
                self.nodes[-1], self._aligned = known, (known.stamp, alignment.turn.copy())

    def correct(self, stamp: float, position: np.ndarray, quaternion: np.ndarray,
                doubt_span: float = 0.0) -> tuple[Node, Node] | None:
        """
        Apply a pose at its capture time and replay the later readings.

        Args:
            stamp: capture time [s], not after the newest node; at least the oldest node's is used.
            position: (3,) of the marker body in world [m].
            quaternion: (4,) marker body to world.
            doubt_span: duration for which the IMU may have been wrong [s], 0: not at all.

        Returns:
            the oldest state, which is that after the previous pose unless the time since then was
            too long, and the one predicted to this pose; None if the pose fails the gate, and the
            track is then unchanged.

        """
        nodes = self.nodes
        stamp = max(stamp, nodes[0].stamp)
        index = bisect_right(nodes, stamp + SAME_INSTANT, key=_stamp) - 1
        prior = nodes[index]
        since, turn = self._aligned or (np.inf, None)
        aligned = prior.stamp >= since
        if stamp - prior.stamp > SAME_INSTANT:
            after = nodes[index + 1]
            prior = self._model.predict(prior, stamp, *interpolate(
                stamp, (prior.stamp, prior.force, prior.rate),
                (after.stamp, after.force, after.rate)), after.after_impact)
        if turn is not None and aligned:    # poses refer to the markers
            prior = self._model.turned(prior, turn)
        if doubt_span:
            prior = self._model.doubt(prior, doubt_span)
        posterior = self._model.correct(prior, position, quaternion)
        if posterior is None:
            return None
        first = prior if aligned else nodes[0]
        self.fixes += 1
        if self.fixes == VELOCITY_KNOWN:
            self._model.add_time_uncertainty(posterior, self._time_deviation)
        replayed = [posterior]
        for node in nodes[index + 1:]:
            replayed.append(self._model.predict(replayed[-1], node.stamp, node.force, node.rate,
                                                node.after_impact))
        self.nodes = replayed
        self.last_fix = stamp
        self._waits_since = self._aligned = None
        return first, prior


def _stamp(node):
    return node.stamp
