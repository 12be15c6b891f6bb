"""The operator of a graph: calls the supervisor, and waits for states."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
import math
import time
from typing import Any

from rcl_interfaces.srv import SetParameters
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from beetle_omni_ros.bags.conversions import seconds as seconds_of
from beetle_omni_ros.bags.messages import Diagnostic
from beetle_omni_ros.bags.topics import SENSOR
from beetle_omni_ros.control import registry
from beetle_omni_ros.model.mode import DISARMED, Mode
from beetle_omni_ros.model.schema import RunError
from beetle_omni_ros.ros import wire
from beetle_omni_ros.ros.graph import BRIDGES, READY
from beetle_omni_ros.ros.listeners import Client

# Simulated time may be slow, or stop if the simulator dies: waiting ends after this much steady
# time for each second of the timeout.
SLOWEST = 20.0
ARM_TIMEOUT = 10.0      # s
PAUSE_TIMEOUT = 10.0    # s
PAUSE_SETTLE = 0.05     # s until the nodes have answered the last sample before a pause
TAKEOFF_TIMEOUT = 30.0  # s
TAKEOFF_ATTEMPTS = 3
SETTLE_TIME = 1.0       # s before arming, in which start-up work ends
NEVER = 1e9             # s, time at which simulated time does not stand still
SERVICES = ('arm', 'disarm', 'land', 'emergency_stop')
SUPERVISOR = 'supervisor_node'


class Operator(Client):
    """
    Calls services and watches states; with simulated time, seconds are those of /clock.

    Attributes:
        state, states: newest state of the supervisor, '' before the first message; all of them.
        progress: state of reference_node, '' before the first message.
        bridges: bridge node -> its newest state.
        controller: name of the watched controller.
        diagnostics: status name -> newest :class:`Diagnostic`.
        required: bridges whose states belong to the text of an error.
        show: called with what the operator waits for.

    """

    required: Sequence[str] = ()
    show: Callable[[str], None] = staticmethod(lambda text: None)

    def __init__(self, domain: int | None, controller: str = registry.DEFAULT):
        super().__init__('operator', domain)
        self.controller = controller
        self.state, self.progress = Mode(), ''
        self.states: list[Mode] = []
        self.bridges: dict[str, str] = {}
        self.diagnostics: dict[str, Diagnostic] = {}
        self._offset: float | None = None   # s from /clock to time(), which goes on steadily
        self._clock = self._epoch = 0.0
        node = self._node
        node.create_subscription(Clock, '/clock', self._on_clock, wire.profile(SENSOR))
        wire.subscribe(node, 'supervisor/state', self._on_state)
        wire.subscribe(node, 'reference/state', partial(setattr, self, 'progress'))
        for bridge in BRIDGES:
            wire.subscribe(node, f"{bridge.removesuffix('_node')}/state",
                           partial(self.bridges.__setitem__, bridge))
        wire.subscribe(node, 'diagnostics', lambda statuses: self.diagnostics.update(
            (status.name, status) for status in statuses))
        self._clients = {name: node.create_client(Trigger, f'{SUPERVISOR}/{name}')
                         for name in SERVICES}

    def _on_clock(self, message):
        self._clock = seconds_of(message.clock)
        if self._offset is None:
            self._offset = time.monotonic() - self._clock
            self._epoch = math.floor(self._clock)

    def _on_state(self, mode):
        self.state = Mode(mode if mode.controller else mode.state)
        self.states.append(mode)

    def time(self) -> float:
        """Return a time that passes like that of the flight, simulated or steady [s]."""
        return time.monotonic() if self._offset is None else self._clock + self._offset

    @property
    def answers(self) -> bool:
        """Whether the supervisor can be called."""
        return self._clients['arm'].service_is_ready()

    @property
    def ready(self) -> bool:
        """Whether the supervisor can be called and the controller runs."""
        return f'{self.controller}_node: controller' in self.diagnostics and self.answers

    def waits_for(self, bridges: Sequence[str]) -> str:
        """Return the states of the bridges that are not ready, '' if all are."""
        states = {name: self.bridges.get(name, 'silent') for name in bridges}
        return '; '.join(f'{name} {text}' for name, text in states.items()
                         if not text.startswith(READY))

    def spin(self, seconds: float) -> None:
        """Process messages for ``seconds`` of steady time."""
        self.spin_steadily(seconds)

    def countdown(self, seconds: float) -> Iterator[float]:
        """Yield the remaining time [s], steady or simulated, until it is over."""
        start, steady = self.time(), time.monotonic()
        while (left := start + seconds - self.time()) > 0 \
                and time.monotonic() - steady < SLOWEST * seconds + 1.0:
            yield left

    def wait(self, condition, timeout: float) -> bool:
        """Process messages until ``condition()`` holds; False after ``timeout`` [s]."""
        for _ in self.countdown(timeout):
            if condition():
                return True
            self.spin(0.05)
        return bool(condition())

    def expect(self, text: str, condition, timeout: float, why=lambda: '') -> None:
        """Wait as :meth:`wait`; a timeout raises RunError with ``text`` and ``why()``."""
        self.show(text)
        if not self.wait(condition, timeout):
            waits = self.waits_for(self.required)
            raise RunError(f'{text}: nothing after {timeout:g} s, supervisor in '
                           f"'{self.state}'{why()}" + (waits and f'; {waits}'))

    def take_off(self) -> None:
        """Arm and take off, or raise RunError; repeat if the supervisor disarms on the ground."""
        answers = []
        for _ in range(TAKEOFF_ATTEMPTS):
            self.spin(SETTLE_TIME)
            self.expect('arming', lambda: answers.append(self.arm()) or answers[-1][0],
                        ARM_TIMEOUT, lambda: f'; supervisor_node: {answers[-1][1]}')
            self.states.clear()
            # The state may name a fault: disarmed:joint1_astray.
            self.expect('taking off', lambda: self.state.controller or any(
                mode.state == DISARMED for mode in self.states), TAKEOFF_TIMEOUT)
            if self.state.controller:
                return
        raise RunError(f'no take-off in {TAKEOFF_ATTEMPTS} attempts; see the warnings below')

    def arm(self) -> tuple[bool, str]:
        """Ask the supervisor to arm; return (accepted, answer)."""
        return self.call('arm')

    def pause_at(self, moment: float) -> None:
        """
        Let simulated time run to ``moment`` since its start [s], and stand still there.

        NEVER ends the pause. What is done meanwhile has its effect at that moment.
        """
        accepted, answer = self.set('sim_node', 'pause_at', float(moment))
        if not accepted:
            raise RunError(f'sim_node: {answer}')
        if moment < NEVER:
            self.expect(f'simulated time {moment:g} s',
                        lambda: self._clock - self._epoch > moment - 1e-3, moment + PAUSE_TIMEOUT)
            self.spin(PAUSE_SETTLE)

    def call(self, name: str, timeout: float = 2.0) -> tuple[bool, str]:
        """Call a service of the supervisor; return (accepted, answer)."""
        future = self._clients[name].call_async(Trigger.Request())
        if not self.wait(future.done, timeout):
            return False, f'{SUPERVISOR} does not answer to {name}'
        return future.result().success, future.result().message

    def request(self, service: str, kind: type, request: Any, timeout: float) -> Any:
        """Call any service; return its response, None without an answer."""
        client = self._node.create_client(kind, service)
        if not self.wait(client.service_is_ready, timeout):
            return None
        future = client.call_async(request)
        return future.result() if self.wait(future.done, timeout) else None

    def set(self, node: str, name: str, value, timeout: float = 5.0) -> tuple[bool, str]:
        """Set a parameter of a node; return (accepted, answer)."""
        answer = self.request(f'{node}/set_parameters', SetParameters,
                              wire.parameter_request(name, value), timeout)
        if answer is None:
            return False, f'{node} does not answer'
        return answer.results[0].successful, answer.results[0].reason

    def values(self, status: str) -> dict[str, str]:
        """Return the values of a diagnostic status, empty before the first message."""
        found = self.diagnostics.get(status)
        return found.values if found else {}
