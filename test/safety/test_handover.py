"""The change of the command at a handover."""

from dataclasses import replace

import numpy as np
import pytest
from vehicle_rig import flown, PARAMETERS, TICK

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.safety.handover import Handover

LIMITS = PARAMETERS.handover


def command(stamp, tilt, thrust):
    return Command(stamp, np.full(4, float(tilt)), np.full(4, float(thrust)))


def changes(handover, asked, start):
    """Largest changes of tilt and thrust over a stream of (stamp, tilt, thrust), last command."""
    in_force, changed = start, []
    for requested in asked:
        given = handover.limit(command(*requested), in_force)
        changed.append((np.abs(given.tilt - in_force.tilt).max(),
                        np.abs(given.thrust - in_force.thrust).max()))
        in_force = given
    return np.array(changed), in_force


def test_commands_pass_unchanged_until_a_handover():
    asked = command(1.01, 3.0, 20.0)
    assert Handover(LIMITS).limit(asked, command(1.0, 0.0, 0.0)) is asked
    handover = Handover(LIMITS)
    handover.start()
    assert handover.limit(asked, None) is asked
    handover.stop()
    assert handover.limit(asked, command(1.0, 0.0, 0.0)) is asked


@pytest.mark.parametrize('period', [0.005, 0.01])
def test_the_change_is_limited_and_the_requested_command_is_reached(period):
    handover = Handover(LIMITS)
    handover.start()
    stamps = 1.0 + period * np.arange(1, 61)
    changed, last = changes(handover, [(t, 0.5, 2.0) for t in stamps], command(1.0, -0.5, 14.0))
    assert changed[:, 0].max() <= LIMITS.tilt_rate * period * (1 + 1e-9)
    assert changed[:, 1].max() <= LIMITS.thrust_rate * period * (1 + 1e-9)
    assert np.allclose(last.tilt, 0.5) and np.allclose(last.thrust, 2.0)


def test_after_convergence_commands_may_jump_again():
    handover = Handover(LIMITS)
    handover.start()
    changed, _ = changes(handover, [(1.01, 0.05, 8.0), (1.02, 2.0, 18.0)], command(1.0, 0.0, 7.0))
    assert np.allclose(changed, [[0.05, 1.0], [1.95, 10.0]])


def test_the_handover_ends_at_its_time_limit_without_convergence():
    handover = Handover(LIMITS)
    handover.start()
    stamps = 1.0 + 0.01 * np.arange(1, 60)
    changed, last = changes(handover, [(t, 50.0, 7.0) for t in stamps], command(1.0, 0.0, 7.0))
    assert last.tilt[0] == 50.0
    assert np.sum(changed[:, 0] > 0) == pytest.approx(LIMITS.time / 0.01 + 1, abs=1)


def test_a_state_gets_one_command_only():
    handover, before = Handover(LIMITS), command(1.0, 0.0, 7.0)
    handover.start()
    for stamp in (0.99, 1.0):
        assert handover.limit(command(stamp, 1.0, 9.0), before) is before


def switching(rig, far):
    """Run with different commands of rl, select it, and return the commands after that."""
    original = rig._publish

    def publish():
        rig.alive.discard('rl')
        original()
        lively = far.thrust + 1e-9 * np.sin(1e3 * rig.now)
        rig.supervisor.on_command('rl', replace(far, stamp=rig.now, thrust=lively),
                                  rig.now)

    rig._publish = publish
    rig.run(1.0)
    before = rig.command
    assert rig.supervisor.select('rl')
    return [before, *rig.run(0.5)]


def test_the_supervisor_hands_over_at_the_limited_rate():
    rig = flown()
    sent = switching(rig, command(0.0, 0.4, 3.0))
    assert rig.supervisor.source == 'rl' and rig.supervisor.state == 'flying'
    tilt = np.array([c.tilt for c in sent])
    thrust = np.array([c.thrust for c in sent])
    assert np.abs(np.diff(tilt, axis=0)).max() <= LIMITS.tilt_rate * TICK + 1e-9
    assert np.abs(np.diff(thrust, axis=0)).max() <= LIMITS.thrust_rate * TICK + 1e-9
    assert np.allclose(tilt[-1], 0.4) and np.allclose(thrust[-1], 3.0)


def test_a_clock_that_goes_back_does_not_hold_an_old_command():
    rig = flown()
    switching(rig, command(0.0, 0.4, 3.0))
    assert rig.supervisor.select('nmpc')
    rig.now -= 5.0
    sent = rig.run(1.0)
    assert rig.supervisor.state in ('flying', 'fallback')
    assert max(abs(c.stamp - rig.now) for c in sent[-10:] if c is not None) < 0.2
