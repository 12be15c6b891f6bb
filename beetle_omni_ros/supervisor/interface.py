"""What the callers of the supervisor use: its parameters, its events and its answers."""

from dataclasses import dataclass
from typing import NamedTuple

from beetle_omni_ros.control import registry
from beetle_omni_ros.model.schema import parameter, ParameterFile

INFO, WARNING, ERROR = 'info', 'warning', 'error'


class Event(NamedTuple):
    """An event for the log: time [s], severity, and one line with node and outcome."""

    stamp: float
    severity: str
    text: str


class Answer(NamedTuple):
    """The answer to a request: granted or not, with the reason."""

    ok: bool
    text: str

    def __bool__(self):
        """Whether the request was granted."""
        return self.ok


@dataclass(frozen=True, kw_only=True)
class SupervisorParameters(ParameterFile, file='supervisor.yaml'):
    """All parameters of the supervisor."""

    controller: str = parameter(registry.DEFAULT, doc='the active controller, also in flight')
    takeoff_height: float = parameter(
        1.0, doc='height of base_link in world where the controller takes over', unit='m',
        low=0.1, high=20)
    age_limit: float = parameter(
        0.015, doc='largest median age of commands and estimates, usually 0.004; the tilts of a '
        'hovering policy swing by 2 rad at 0.02', unit='s', low=0.01, high=0.05)
    fence_half_width: float = parameter(
        20.0, doc='largest |x| and |y| in world; beyond it the robot lands', unit='m', low=0.5,
        high=1000)
    fence_height: float = parameter(
        20.0, doc='largest z in world; beyond it the robot lands', unit='m', low=0.5, high=1000)
    battery_arm: float = parameter(
        3.5, doc='smallest voltage of a cell for arming', unit='V', low=2.5, high=4.4)
    battery_warn: float = parameter(
        3.4, doc='a lower voltage of a cell gives a warning', unit='V', low=2.5, high=4.4)
    battery_land: float = parameter(
        3.2, doc='a lower voltage of a cell starts a landing', unit='V', low=2.0, high=4.4)
