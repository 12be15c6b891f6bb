"""Every reason for the refusal of a command, and accepted commands."""

from types import SimpleNamespace

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety import limits
from beetle_omni_ros.safety.limits import CommandStream, within_limits
from beetle_omni_ros.safety.parameters import CommandLimits, SupervisorParameters

ROBOT = RobotParameters.load()
LIMITS = CommandLimits()
NOW = 50.0


def command(stamp=NOW, tilt=(0.1, 0.2, 0.3, 0.4), thrust=(7.0, 7.5, 8.0, 8.5)):
    return Command(stamp, np.array(tilt), np.array(thrust))


def noisy(stamp, *numbers):
    """Commands with noise, like those of a controller that uses measurements."""
    given = command(stamp, *numbers)
    return Command(stamp, given.tilt + 1e-9 * np.sin(1e3 * stamp), given.thrust)


def stream():
    return CommandStream(LIMITS, ROBOT)


@pytest.mark.parametrize('bad, reason', [
    (None, limits.NOT_A_COMMAND),
    (SimpleNamespace(stamp='x', tilt=np.zeros(4), thrust=np.zeros(4)), limits.NOT_A_COMMAND),
    (command(tilt=['a', 'b', 'c', 'd']), limits.NOT_A_COMMAND),
    (command(tilt=[0, 0, 0]), limits.SHAPE),
    (command(thrust=[[7, 7, 7, 7]]), limits.SHAPE),
    (command(tilt=[0, np.nan, 0, 0]), limits.NOT_FINITE),
    (command(thrust=[7, 7, np.inf, 7]), limits.NOT_FINITE),
    (command(stamp=np.nan), limits.NOT_FINITE),
    (command(stamp=NOW - LIMITS.stale_after - 0.001), limits.STALE),
    (command(stamp=NOW + LIMITS.clock_tolerance + 0.001), limits.FUTURE),
    (command(thrust=[7, 7, 7, ROBOT.rotors.thrust_max + 0.1]), limits.THRUST),
    (command(thrust=[7, -0.1, 7, 7]), limits.THRUST),
    (command(tilt=[0, ROBOT.joints.position_limit + 0.01, 0, 0]), limits.TILT),
    (command(tilt=[0, -ROBOT.joints.position_limit - 0.01, 0, 0]), limits.TILT)])
def test_bad_command_is_refused_with_its_reason_and_counted(bad, reason):
    checked = stream()
    assert checked.offer(bad, NOW) == reason
    assert checked.refused == {reason: 1}
    assert checked.accepted is None and checked.last_refusal == reason


def test_repeated_and_older_stamps_are_refused():
    checked = stream()
    assert checked.offer(command(), NOW) == ''
    assert checked.offer(command(), NOW) == limits.REPEATED
    assert checked.offer(command(stamp=NOW - 0.01), NOW) == limits.OLDER
    assert checked.offer(command(stamp=NOW + 0.01), NOW + 0.01) == ''


def test_rounding_beyond_a_limit_is_clipped_and_not_refused():
    checked, over = stream(), LIMITS.limit_tolerance / 2
    top, travel = ROBOT.rotors.thrust_max, ROBOT.joints.position_limit
    assert checked.offer(command(tilt=[travel + over, 0, 0, 0], thrust=[-over, 7, 7, top + over]),
                         NOW) == ''
    assert checked.accepted.tilt[0] == travel
    assert checked.accepted.thrust[0] == 0.0 and checked.accepted.thrust[3] == top


def test_a_small_overstep_is_executed_at_the_limits_for_half_a_second_and_no_longer():
    checked, top = stream(), ROBOT.rotors.thrust_max
    checked.offer(command(), NOW)
    executed = []
    for k in range(1, 101):
        checked.tick(0.01)
        stamp = NOW + 0.01 * k
        over = command(stamp, (0.1, 0.2, 0.3, 4.5), (7.0, -3.0, 7.0, top + 3.0))
        assert checked.offer(over, stamp) == limits.THRUST      # refused and counted as before
        executed.append(checked.in_force)
    until = round(LIMITS.overstep_time / 0.01)
    assert all(one is not None for one in executed[:until - 1])
    assert executed[until + 1:] == [None] * (99 - until)
    for k, one in enumerate(executed[:until - 1], 1):
        assert one.stamp == NOW + 0.01 * k      # each at its arrival, not the last good one
        assert one.thrust.tolist() == [7.0, 0.0, 7.0, top]
        assert one.tilt[3] == ROBOT.joints.position_limit
    assert not checked.good


@pytest.mark.parametrize('numbers', [{'thrust': [7, 7, 7, 760.0]}, {'thrust': [-8.0, 7, 7, 7]},
                                     {'tilt': [57.3, 0, 0, 0]}])
def test_a_command_in_another_unit_is_never_executed(numbers):
    checked = stream()
    checked.offer(command(), NOW)
    good = checked.accepted
    for k in range(1, 10):
        checked.tick(0.01)
        checked.offer(command(stamp=NOW + 0.01 * k, **numbers), NOW + 0.01 * k)
        assert checked.in_force is good or k > 3
    assert checked.in_force is None


def test_a_single_spike_is_refused_and_a_real_step_loses_one_command():
    checked, far = stream(), (0.1 + LIMITS.tilt_step + 0.1, 0.2, 0.3, 0.4)
    checked.offer(command(), NOW)
    assert checked.offer(command(NOW + 0.01, far), NOW + 0.01) == limits.JUMP
    assert checked.offer(command(NOW + 0.02, far), NOW + 0.02) == ''
    assert checked.offer(command(NOW + 0.03, far, (0, 0, 0, 0)), NOW + 0.03) == ''
    assert checked.offer(command(NOW + 0.04, far, (16, 16, 16, 16)), NOW + 0.04) == limits.JUMP


def test_an_expected_jump_is_accepted_within_the_timeout():
    checked, far = stream(), (0.1 + LIMITS.tilt_step + 0.1, 0.2, 0.3, 0.4)
    checked.offer(command(), NOW)
    checked.expect_jump()
    checked.tick(0.5 * LIMITS.timeout)
    assert checked.offer(command(NOW + 0.02, far), NOW + 0.02) == ''
    checked.tick(0.6 * LIMITS.timeout)
    assert checked.offer(command(NOW + 0.06), NOW + 0.06) == limits.JUMP


def test_a_step_to_a_new_target_keeps_the_controller_selectable():
    checked, near, far = stream(), command(), (3.0, 0.2, 0.3, 0.4)
    for k in range(200):
        checked.tick(0.01)
        now = NOW + 0.01 * k
        checked.offer(noisy(now, near.tilt if k < 100 else far), now)
        assert checked.good == (k >= 50)
    assert checked.refused == {limits.JUMP: 1}


def test_a_stream_that_always_jumps_is_silent_and_not_good():
    checked, now = stream(), NOW
    for k in range(100):
        checked.tick(0.01)
        now += 0.01
        checked.offer(command(now, (3.0 * (-1) ** k, 0, 0, 0)), now)
    assert checked.silence.silent and not checked.good


def test_a_stream_of_repeated_numbers_is_refused_until_they_change():
    checked = stream()
    reasons = [checked.offer(command(NOW + 0.01 * k), NOW + 0.01 * k) for k in range(20)]
    assert reasons[:limits.SAME] == [''] * limits.SAME
    assert set(reasons[limits.SAME + 1:]) == {limits.FROZEN}
    assert checked.offer(noisy(NOW + 0.2), NOW + 0.2) == ''


def test_accepted_command_does_not_change_with_the_callers_arrays():
    checked, given = stream(), command()
    checked.offer(given, NOW)
    given.tilt[:] = np.nan
    assert np.isfinite(checked.accepted.tilt).all()


def test_good_means_half_a_second_without_gap_or_refusal():
    checked = stream()
    assert not checked.good and 'silent since the start' in checked.complaint

    def run(duration, spoil=False):
        nonlocal now
        for _ in range(round(duration / 0.01)):
            now += 0.01
            checked.tick(0.01)
            checked.offer(command(now, thrust=(np.nan,) * 4) if spoil else noisy(now), now)

    now = NOW
    run(0.4)
    assert not checked.good and 'good for only' in checked.complaint
    run(0.2)
    assert checked.good
    run(0.01, spoil=True)
    assert not checked.good
    run(0.6)
    assert checked.good
    checked.tick(0.01)
    checked.tick(LIMITS.timeout)
    assert not checked.good and 'silent for' in checked.complaint


def test_clock_set_back_does_not_block_a_stream():
    checked = stream()
    checked.offer(command(), NOW)
    checked.clock_went_back(NOW - 5)
    assert checked.offer(command(NOW - 5), NOW - 5) == ''


def test_the_final_check_clips_to_limits_and_refuses_non_finite_values():
    out = within_limits(command(tilt=[9, -9, 0, 0], thrust=[-1, 99, 1, 1]), ROBOT)
    assert np.abs(out.tilt).max() == ROBOT.joints.position_limit
    assert out.thrust.min() == 0 and out.thrust.max() == ROBOT.rotors.thrust_max
    assert within_limits(command(tilt=[np.nan, 0, 0, 0]), ROBOT) is None


def test_the_shipped_file_contains_every_parameter_at_its_default():
    from beetle_omni_ros.robot import schema
    from beetle_omni_ros.robot.resources import share_path
    leaves = {name for name, *_ in schema.flatten(SupervisorParameters())}

    def names(mapping, prefix=''):
        for key, value in mapping.items():
            yield from names(value, f'{prefix}{key}.') if isinstance(value, dict) \
                else (f'{prefix}{key}',)

    assert set(names(schema.load_yaml(share_path('params/supervisor.yaml')))) == leaves
    assert SupervisorParameters.load() == SupervisorParameters()
