"""The policy in the whole loop: switched in flight, and with faults in flight."""


import numpy as np
import pytest

pytest.importorskip('onnx')

from hover_policy import write_hover_policy
from policy_files import write

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.evaluation import command, loop
from beetle_omni_ros.evaluation.loop import FlightLoop
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import RunError
from beetle_omni_ros.runs.log import LogRecorder
from beetle_omni_ros.runs.metrics import metrics
from beetle_omni_ros.runs.tasks import make_task
from beetle_omni_ros.safety.commands import HANDOVER_TIME, THRUST_RATE, TILT_RATE

ROBOT = RobotParameters.load()
POSES, SWITCHES = 2, 20
PERIOD = 0.01       # s between commands
HEADER = 'x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n'


@pytest.fixture(scope='module')
def flight():
    """One flight with switches."""
    return fly_switching(share_path('policies/rl.onnx'), seed=1)


class Switching(LogRecorder):
    """Stand-in for the recorder that selects the other controller at given times."""

    def __init__(self, times):
        super().__init__()
        self.supervisor, self.times, self.switched = None, list(times), []

    def write(self, topic, value, received=None):
        super().write(topic, value, received)
        t = value.stamp if topic == 'odom' else -np.inf
        if self.times and t >= self.times[0] and self.supervisor.state == 'flying':
            self.times.pop(0)
            other = 'rl' if self.supervisor.active == 'nmpc' else 'nmpc'
            assert self.supervisor.select(other, t)
            self.switched.append((t, other))


def fly_switching(policy, seed):
    """Both controllers in one loop over random poses, switched at times drawn from ``seed``."""
    times = np.sort(np.random.default_rng(seed).uniform(4.0, 3.8 + 8 * POSES, SWITCHES))
    recorder = Switching(times)
    controllers = {name: registry.make(name, ROBOT, ControllerOptions(policy=policy)
                                       if name == 'rl' else ControllerOptions())
                   for name in ('nmpc', 'rl')}
    flight = FlightLoop(ROBOT, ROBOT, controllers, recorder)
    recorder.supervisor = flight.supervisor
    task = make_task(f'random{POSES}', seed)
    return flight.fly(task), recorder, task


def test_twenty_switches_at_random_times_of_random_poses(flight):
    stayed, recorder, task = flight
    log = recorder.log()
    assert stayed and len(recorder.switched) == SWITCHES
    # every switch takes effect at its time, and nothing else changes the state
    flown = [(t, name) for t, name in zip(log.state_t, log.states) if name.startswith('flying')]
    assert [name for _, name in flown] == ['flying:nmpc'] + [
        f'flying:{name}' for _, name in recorder.switched]
    assert np.allclose([t for t, _ in flown[1:]], [t for t, _ in recorder.switched], atol=0.011)
    assert not {'fallback', 'landing', 'emergency_stop'} & {
        state.partition(':')[0] for state in log.states}
    assert all(pose['reached'] for pose in metrics(log, task)['poses'])
    # After the handover the executed command is that of the selected controller. The time of a
    # handover is measured in stamps and ends with the first command beyond it.
    settled = HANDOVER_TIME + 2 * PERIOD
    for (start, name), (end, _) in zip(flown, [*flown[1:], (log.end, '')]):
        asked = log.requests[name.partition(':')[2]]
        inside = (log.command_received > start + settled) & (log.command_received < end)
        k = np.searchsorted(asked.t, log.command_t[inside])
        assert np.allclose(asked.t[k], log.command_t[inside])
        assert np.allclose(asked.tilt[k], log.command_tilt[inside], atol=1e-9)


def test_no_switch_makes_the_command_jump(flight):
    stayed, recorder, _ = flight
    log = recorder.log()
    assert stayed and len(recorder.switched) == SWITCHES
    step = np.diff(log.command_t)
    tilt = np.abs(np.diff(log.command_tilt, axis=0)).max(axis=1)
    thrust = np.abs(np.diff(log.command_thrust, axis=0)).max(axis=1)
    for moment, name in recorder.switched:
        asked = log.requests[name]
        first = np.searchsorted(log.command_t[1:], moment - 1e-9)
        for k in range(first, min(first + round(HANDOVER_TIME / PERIOD), len(step))):
            assert tilt[k] <= TILT_RATE * step[k] + 1e-6
            assert thrust[k] <= THRUST_RATE * step[k] + 1e-6
            own = np.searchsorted(asked.t, log.command_t[k + 1])
            if own == len(asked.t) or np.allclose(asked.tilt[own], log.command_tilt[k + 1]) \
                    and np.allclose(asked.thrust[own], log.command_thrust[k + 1]):
                break       # the handover is over, and its commands are executed


def fly_poses(tmp_path, policy, *heights):
    """Fly level poses at these heights with the policy."""
    path = tmp_path / 'poses.csv'
    path.write_text(HEADER + ''.join(f'0,0,{z},0,0,0\n' for z in heights))
    return command.fly('rl', make_task(path), robot=ROBOT, plant=ROBOT,
                       options={'rl': ControllerOptions(policy=policy)})


def test_nan_commands_lead_to_hover_and_good_ones_regain_control(tmp_path):
    broken = write_hover_policy(tmp_path / 'broken.onnx', memory=True, blind_above=0.3)
    log = fly_poses(tmp_path, broken, 1.0, 1.6, 1.1)
    assert not log.meta['crashed']
    assert [name for name in log.states if name not in ('disarmed', 'takeoff')] == [
        'flying:rl', 'fallback:controller_silent', 'flying:rl']
    begin, fell = log.state_t[log.states.index('flying:rl')], \
        log.state_t[log.states.index('fallback:controller_silent')]
    up = log.truth_t > begin
    assert log.truth_position[up, 2].min() > 0.8
    # within the timeout after the first refusal, and on the second target
    assert begin + 8.0 < fell < begin + 8.2
    assert np.isfinite(log.command_tilt).all() and np.isfinite(log.command_thrust).all()
    assert np.isnan(log.requests['rl'].thrust).any()


def test_implausible_commands_never_get_control(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, 'TAKEOFF_TIMEOUT', 10.0)      # s; others fly after 4
    absurd = write(tmp_path / 'absurd.onnx', bias=np.r_[np.zeros(4), np.full(4, 1e6)])
    with pytest.raises(RunError, match="'fallback'.*rl_node.*thrust out of range"):
        fly_poses(tmp_path, absurd, 1.0)
