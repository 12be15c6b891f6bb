"""Every reason for the refusal of a command, and accepted commands."""

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.supervisor import commands
from beetle_omni_ros.supervisor.commands import CommandStream

ROBOT = RobotParameters.load()
NOW = 50.0


def command(stamp=NOW, tilt=(0.1, 0.2, 0.3, 0.4), thrust=(7.0, 7.5, 8.0, 8.5)):
    return Command(stamp, np.array(tilt), np.array(thrust))


def noisy(stamp, *numbers):
    """Commands with noise, like those of a controller that uses measurements."""
    given = command(stamp, *numbers)
    return Command(stamp, given.tilt + 1e-9 * np.sin(1e3 * stamp), given.thrust)


def stream():
    return CommandStream(ROBOT, 0.02)


@pytest.mark.parametrize('bad, reason', [
    (command(tilt=[0, np.nan, 0, 0]), 'not finite'),
    (command(thrust=[7, 7, np.inf, 7]), 'not finite'),
    (command(stamp=np.nan), 'not finite'),
    (command(stamp=NOW - commands.STALE_AFTER - 0.001), 'stale stamp'),
    (command(stamp=NOW + commands.AHEAD + 0.001), 'stamp in the future'),
    (command(thrust=[7, 7, 7, 760.0]), 'thrust out of range'),
    (command(thrust=[7, -8.0, 7, 7]), 'thrust out of range'),
    (command(tilt=[0, 57.3, 0, 0]), 'tilt out of range')])
def test_bad_command_is_refused_with_its_reason_and_counted(bad, reason):
    checked = stream()
    assert checked.offer(bad, NOW) == reason
    assert checked.refused == {reason: 1}
    assert checked.accepted is None and checked.complaint.endswith(f'last refused: {reason}')


def test_a_small_excess_is_clipped():
    checked, top = stream(), ROBOT.rotors.thrust_max
    given = command(tilt=[0.1, 0.2, 0.3, 4.5], thrust=[7.0, -3.0, 7.0, top + 3.0])
    assert checked.offer(given, NOW) == ''
    assert checked.accepted.thrust.tolist() == [7.0, 0.0, 7.0, top]
    assert checked.accepted.tilt[3] == ROBOT.joints.position_limit
    assert given.tilt[3] == 4.5     # a copy


def test_a_single_spike_is_refused_and_a_real_step_loses_one_command():
    checked, far = stream(), (0.1 + commands.STEP[0] + 0.1, 0.2, 0.3, 0.4)
    assert checked.offer(command(), NOW) == ''
    for stamp in (NOW, NOW - 0.01):
        assert checked.offer(command(stamp), NOW) == 'repeated or older stamp'
    assert checked.offer(command(NOW + 0.01, far, (16, 16, 16, 16)), NOW + 0.01) == commands.JUMP
    assert checked.offer(command(NOW + 0.02, far, (16, 16, 16, 15)), NOW + 0.02) == ''
    assert checked.offer(command(NOW + 0.03, far, (1, 1, 1, 1)), NOW + 0.03) == ''


def test_far_tilts_on_both_sides_with_calm_thrusts_keep_control_and_random_commands_lose_it():
    random = np.random.default_rng(3)
    for wild in (False, True):
        checked, silent = stream(), False
        for k in range(1, 200):
            now = NOW + 0.01 * k
            checked.tick(0.01)
            silent = silent or k > 1 and checked.silence.silent
            given = (random.uniform(-3, 3, 4), random.uniform(0, 20, 4)) if wild else \
                (np.full(4, 3.9 * (-1) ** k), 7.0 + random.uniform(-3, 3, 4))
            checked.offer(command(now, *given), now)
        assert silent is wild and checked.good is not wild


def test_a_stream_of_repeated_numbers_is_refused_until_they_change():
    checked = stream()
    reasons = [checked.offer(command(NOW + 0.01 * k), NOW + 0.01 * k) for k in range(20)]
    assert reasons[:commands.SAME] == [''] * commands.SAME
    assert set(reasons[commands.SAME + 1:]) == {commands.FROZEN}
    assert checked.offer(noisy(NOW + 0.2), NOW + 0.2) == ''


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
    checked.tick(commands.TIMEOUT)
    assert not checked.good and 'silent for' in checked.complaint
