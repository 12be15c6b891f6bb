"""The active controller, and the command streams of all controllers."""

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.limits import CommandStream, UNKNOWN
from beetle_omni_ros.safety.parameters import CommandLimits


class Selection:
    """
    The controllers that may fly.

    Args:
        names: their names.
        active: the one selected at first.
        limits: thresholds of their commands.
        robot: thrust and tilt ranges.

    Attributes:
        active: name of the selected controller.

    """

    def __init__(self, names: tuple[str, ...], active: str, limits: CommandLimits,
                 robot: RobotParameters):
        self._streams = {name: CommandStream(limits, robot) for name in names}
        self._unknown = 0
        self.active = active if active in self._streams else names[0]

    @property
    def stream(self) -> CommandStream:
        """The active controller's commands."""
        return self._streams[self.active]

    def good(self, controller: str) -> Command | None:
        """The latest command of a controller that may get control, else None."""
        stream = self._streams.get(controller)
        return stream.accepted if stream is not None and stream.good else None

    def offer(self, controller: str, command: Command, now: float) -> str:
        """Check one command; '' when it is valid, else the reason (counted)."""
        if controller not in self._streams:
            self._unknown += 1
            return UNKNOWN
        return self._streams[controller].offer(command, now)

    def why_not(self, controller: str, in_flight: bool) -> str:
        """'' when ``controller`` may be selected, else the reason."""
        if controller not in self._streams:
            return f"unknown controller '{controller}'; known: {', '.join(self._streams)}"
        stream = self._streams[controller]
        if in_flight and not stream.good:
            return f'{controller}_node {stream.complaint}; {self.active} stays selected'
        return ''

    def tick(self, dt: float) -> None:
        """``dt`` seconds passed."""
        for stream in self._streams.values():
            stream.tick(dt)

    def clock_went_back(self, now: float) -> None:
        """Accept new stamps after a step of the clock."""
        for stream in self._streams.values():
            stream.clock_went_back(now)

    def expect_jump(self) -> None:
        """Accept jumps for a moment, because the actuators are no longer the same."""
        for stream in self._streams.values():
            stream.expect_jump()

    def diagnostics(self) -> dict[str, float | int]:
        """For each controller: validity, silence [ms], refusals by reason."""
        values: dict[str, float | int] = {}
        for name, stream in self._streams.items():
            values[f'{name}.good'] = int(stream.good)
            values[f'{name}.silent_ms'] = 1000 * stream.silence.elapsed
            values.update({f'{name}.refused.{reason}': count
                         for reason, count in stream.refused.items()})
        if self._unknown:
            values[f'refused.{UNKNOWN}'] = self._unknown
        return values
