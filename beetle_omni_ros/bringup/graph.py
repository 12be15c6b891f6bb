"""Messages and publishers observed in the ROS graph for some seconds; does not need ROS."""

from collections import Counter
from dataclasses import dataclass, field
from statistics import median

# Bridge -> device whose port it opens.
BRIDGES = {'joint_bridge': 'the servo bus', 'rotor_bridge': 'the motor board'}


@dataclass
class Stream:
    """
    Messages of one topic.

    Attributes:
        arrivals: arrival times on a monotonic clock [s].
        ages: clock of this computer minus stamp, at arrival [s].
        norms: norm of the measured vector of each message, equal only if a sensor is frozen.
        refused: reason -> number of unusable messages.
        publishers: names of the publishing nodes.
        other_types: other message types under which the topic is published.

    """

    arrivals: list[float] = field(default_factory=list)
    ages: list[float] = field(default_factory=list)
    norms: list[float] = field(default_factory=list)
    refused: Counter = field(default_factory=Counter)
    publishers: list[str] = field(default_factory=list)
    other_types: list[str] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Mean rate between first and last arrival [Hz]; 0 with fewer than two messages."""
        if len(self.arrivals) < 2 or self.arrivals[-1] <= self.arrivals[0]:
            return 0.0
        return (len(self.arrivals) - 1) / (self.arrivals[-1] - self.arrivals[0])

    @property
    def gap(self) -> float:
        """Longest pause between two messages [s]."""
        return max((b - a for a, b in zip(self.arrivals, self.arrivals[1:])), default=0.0)

    @property
    def freshest(self) -> float:
        """Smallest age [s]: the latency plus the offset between the clocks."""
        return min(self.ages)

    @property
    def median_age(self) -> float:
        """Median age [s]."""
        return median(self.ages)

    @property
    def frozen(self) -> bool:
        """Whether more than two messages arrived and all have the same norm."""
        return len(self.norms) > 2 and len(set(self.norms)) == 1


@dataclass(frozen=True)
class Status:
    """A diagnostic status; ``level`` is 0 (ok), 1 (warning), 2 (error) or 3 (stale)."""

    level: int
    message: str
    values: dict[str, str]


@dataclass
class ObservedGraph:
    """
    Everything observed during one check.

    Attributes:
        domain: ROS domain.
        seconds: duration of the observation [s].
        streams: topic -> its messages.
        states: bridge ('joint_bridge', 'rotor_bridge') -> its latched state.
        diagnostics: name of a status -> the newest one.

    """

    domain: int = 0
    seconds: float = 0.0
    streams: dict[str, Stream] = field(default_factory=dict)
    states: dict[str, str] = field(default_factory=dict)
    diagnostics: dict[str, Status] = field(default_factory=dict)

    def of_bridge(self, bridge: str) -> dict[str, Status]:
        """Diagnostics of a bridge's node: name without the prefix 'NODE: ' -> status."""
        start = f'{bridge}_node: '
        return {name.removeprefix(start): status for name, status in self.diagnostics.items()
                if name.startswith(start)}

    def runs(self, bridge: str) -> bool:
        """Whether a state or a diagnostic of the bridge arrived."""
        return bridge in self.states or bool(self.of_bridge(bridge))
