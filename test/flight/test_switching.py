"""The policy and the NMPC in the whole loop, switched in flight."""

import numpy as np

from beetle_omni_ros.bags.log import LogRecorder
from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.flight.loop import FlightLoop
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.supervisor.commands import HANDOVER_TIME, THRUST_RATE, TILT_RATE

ROBOT = RobotParameters.load()
POSES, SWITCHES = 2, 20
PERIOD = 0.01       # s between commands


class Switching(LogRecorder):
    """Stand-in for the recorder that selects the other controller at given times."""

    def __init__(self, times):
        super().__init__()
        self.flight, self.times, self.switched = None, list(times), []

    def write(self, topic, value, received=None):
        super().write(topic, value, received)
        t = value.stamp if topic == 'odom' else -np.inf
        if self.times and t >= self.times[0] and self.flight.supervisor.state == 'flying':
            self.times.pop(0)
            other = 'rl' if self.flight.supervisor.active == 'nmpc' else 'nmpc'
            assert self.flight.select(other)
            self.switched.append((t, other))


def test_twenty_switches_at_random_times_of_random_poses():
    times = np.sort(np.random.default_rng(1).uniform(4.0, 3.8 + 8 * POSES, SWITCHES))
    recorder, task = Switching(times), make_task(f'random{POSES}', 1)
    controllers = {name: registry.find(name).make(ROBOT) for name in ('nmpc', 'rl')}
    flight = FlightLoop(ROBOT, ROBOT, controllers, recorder)
    recorder.flight = flight
    assert flight.fly(task) and len(recorder.switched) == SWITCHES
    log = recorder.log()
    # every switch takes effect at its time, and nothing else changes the state
    flown = [(t, name) for t, name in zip(log.state_t, log.states) if name.startswith('flying')]
    assert [name for _, name in flown] == ['flying:nmpc'] + [
        f'flying:{name}' for _, name in recorder.switched]
    assert np.allclose([t for t, _ in flown[1:]], [t for t, _ in recorder.switched], atol=0.011)
    assert not {'fallback', 'landing', 'emergency_stop'} & {
        state.partition(':')[0] for state in log.states}
    assert all(pose['reached'] for pose in metrics(log, task)['poses'])
    for moment, _ in recorder.switched:     # without a jump of the command
        k = np.searchsorted(log.command.t[1:], moment - 1e-9)
        step = log.command.t[k + 1] - log.command.t[k]
        for values, rate in ((log.command.tilt, TILT_RATE), (log.command.thrust, THRUST_RATE)):
            assert np.abs(values[k + 1] - values[k]).max() <= rate * step + 1e-6
    # After the handover the executed command is that of the selected controller. The time of a
    # handover is measured in stamps and ends with the first command beyond it.
    settled = HANDOVER_TIME + 2 * PERIOD
    for (start, name), (end, _) in zip(flown, [*flown[1:], (log.end, '')]):
        asked = log.requests[name.partition(':')[2]]
        inside = (log.command.received > start + settled) & (log.command.received < end)
        k = np.searchsorted(asked.t, log.command.t[inside])
        assert np.allclose(asked.t[k], log.command.t[inside])
        assert np.allclose(asked.tilt[k], log.command.tilt[inside], atol=1e-9)
