"""What was heard of the ROS graph while listening for some seconds; needs no ROS itself."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from statistics import median

# Bridge -> device whose port it has.
BRIDGES = {'joint_bridge': 'the servo bus', 'rotor_bridge': 'the motor board'}


@dataclass
class Stream:
    """
    Messages of one topic.

    Attributes:
        arrivals: steady times [s].
        ages: clock of this computer minus stamp, at arrival [s].
        sizes: a number for each message that a living sensor never repeats for long: the norm
            of what was measured.
        refused: reason -> messages that cannot be used.
        publishers: names of the nodes that publish it.
        other_types: types under which others publish it, which nobody here understands.

    """

    arrivals: list[float] = field(default_factory=list)
    ages: list[float] = field(default_factory=list)
    sizes: list[float] = field(default_factory=list)
    refused: Counter = field(default_factory=Counter)
    publishers: list[str] = field(default_factory=list)
    other_types: list[str] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Messages a second from the first to the last arrival; 0 with fewer than two."""
        if len(self.arrivals) < 2 or self.arrivals[-1] <= self.arrivals[0]:
            return 0.0
        return (len(self.arrivals) - 1) / (self.arrivals[-1] - self.arrivals[0])

    @property
    def gap(self) -> float:
        """Longest pause between two messages [s]."""
        return max((b - a for a, b in zip(self.arrivals, self.arrivals[1:])), default=0.0)

    @property
    def freshest(self) -> float:
        """Smallest age [s]: what is left of it is latency, or clocks that do not agree."""
        return min(self.ages)

    @property
    def median_age(self) -> float:
        """Median age [s]."""
        return median(self.ages)

    @property
    def frozen(self) -> bool:
        """Whether several messages came and all said the same."""
        return len(self.sizes) > 2 and len(set(self.sizes)) == 1


@dataclass(frozen=True)
class Status:
    """A diagnostic status: level 0 well, 1 warning, 2 error, 3 stale."""

    level: int
    message: str
    values: dict[str, str]


@dataclass
class Heard:
    """
    All that was heard.

    Attributes:
        domain: ROS domain.
        seconds: for how long.
        streams: topic -> its messages.
        states: bridge ('joint_bridge', 'rotor_bridge') -> what its latched state says.
        diagnostics: name of a status -> the newest.

    """

    domain: int = 0
    seconds: float = 0.0
    streams: dict[str, Stream] = field(default_factory=dict)
    states: dict[str, str] = field(default_factory=dict)
    diagnostics: dict[str, Status] = field(default_factory=dict)

    def of_bridge(self, bridge: str) -> dict[str, Status]:
        """Diagnostics of a bridge's node: what comes after 'NODE: ' -> status."""
        start = f'{bridge}_node: '
        return {name.removeprefix(start): status for name, status in self.diagnostics.items()
                if name.startswith(start)}

    def runs(self, bridge: str) -> bool:
        """Whether a bridge was heard."""
        return bridge in self.states or bool(self.of_bridge(bridge))
