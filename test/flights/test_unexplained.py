"""Tests of what repeats and no entry explains: found where it is, with a known rate where not."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.flights import discrepancy, quality
from beetle_omni_ros.identify.flights.discrepancy import of_thrusts
from beetle_omni_ros.identify.flights.quality import line, repeatable, Unexplained
from beetle_omni_ros.identify.flights.results import outweighs, verdict_of
from beetle_omni_ros.identify.flights.spectrum import spectrum
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()
CHANNELS = 'force_x', 'force_y', 'force_z', 'torque_x', 'torque_y', 'torque_z'
COUNTS, PERIOD = (3200, 2580), 0.02      # blocks of 8 and of 8.6 s


def flight(seed, count, extra=lambda motion, noise: 0.0):
    """A flight of smooth random motion, and its residual: white noise of one, and ``extra``."""
    rng = np.random.default_rng(seed)

    def smooth(width, size):
        x = gaussian_filter1d(rng.normal(size=(count, width)), 50, axis=0)
        return size * x / x.std(axis=0)

    motion = {'velocity': smooth(3, 0.3), 'position': smooth(3, 0.5), 'tilt': smooth(4, 0.6),
              'rate': smooth(3, 0.3), 'thrust': ROBOT.hover_thrust + smooth(4, 1.0),
              'quaternion': Rotation.from_rotvec(smooth(3, 0.3)).as_quat()}
    time = PERIOD * np.arange(count)
    made = SimpleNamespace(robot=ROBOT, motion=motion, time=time, period=PERIOD, highest=8.0,
                           mask=np.ones((count, 6), dtype=bool))
    residual = rng.normal(size=(count, 6))
    residual += extra(motion, residual)
    found = spectrum(residual, np.zeros((count, 6, 1)), made.mask, PERIOD, np.full(6, 1e-6), 8.0,
                     [np.arange(6)], np.eye(1, 2).repeat(6, axis=0))
    found.noise[:] = np.eye(6)
    return made, found


def both_tests(seeds, **more):
    flights, spectra = zip(*(flight(seed, count, **more)
                             for seed, count in zip(seeds, COUNTS, strict=True)), strict=True)
    left = [found.residual for found in spectra]
    filters = [np.eye(1, 2).repeat(6, axis=0)] * len(flights)
    return repeatable(flights, spectra, left, filters, CHANNELS), \
        line(spectra, left, CHANNELS, list(range(len(CHANNELS))))


def test_noise_alone_is_neither_repeatable_nor_a_line():
    found = [both_tests((seed, seed + 100)) for seed in range(5)]
    assert min(test.probability for pair in found for test in pair) > 0.005
    assert sum(pair[0].probability < 0.025 for pair in found) <= 1


def test_a_force_that_depends_on_the_tilts_is_repeatable():
    def downwash(motion, noise):
        lost = np.sin(motion['tilt'][:, 0])
        return np.outer(lost, [0.0, 0.0, -1.0, 0.5, 0.0, 0.0])

    assert both_tests((1, 2), extra=downwash)[0].probability < 0.01


def test_a_thrust_that_depends_on_the_own_inflow_of_each_rotor_is_repeatable():
    def inflow(motion, noise):
        axes, slopes = of_thrusts(ROBOT, motion['tilt'])
        turn = Rotation.from_quat(motion['quaternion']).as_matrix()
        along = np.einsum('nix,nyx,ny->ni', axes, turn.transpose(0, 2, 1), motion['velocity'])
        return np.einsum('nci,ni->nc', slopes, -0.5 * along)

    assert both_tests((5, 6), extra=inflow)[0].probability < 0.01


def test_forces_that_move_the_robot_are_no_law_of_its_velocity(monkeypatch):
    def gusts(motion, noise):
        turn = Rotation.from_quat(motion['quaternion']).as_matrix()
        force = np.einsum('nij,nj->ni', turn, noise[:, :3])
        # brakes within a second; the measured velocity is smoothed, and knows what comes
        motion['velocity'] = gaussian_filter1d(lfilter([PERIOD], [1, PERIOD - 1], force, axis=0),
                                               0.1 / PERIOD, axis=0)
        return 0.0

    assert both_tests((7, 8), extra=gusts)[0].probability > 0.025
    monkeypatch.setattr(discrepancy, 'LATE', 0.0)
    assert both_tests((7, 8), extra=gusts)[0].probability < 0.01


def test_a_vibration_is_a_line_of_its_frequency_in_flights_of_any_length():
    def shaking(motion, noise):
        phase = 2 * np.pi * 5.3 * PERIOD * np.arange(len(noise))
        return np.outer(np.sin(phase), [0.0, 0.25, 0.0, 0.0, 0.0, 0.0])

    found = both_tests((3, 4), extra=shaking)[1]
    assert found.probability < 1e-6
    assert found.what.startswith('a vibration of 5.3 Hz in force y and ')


@pytest.mark.parametrize(('evidence', 'verdict'), [(9.0, 'unknown'), (11.0, 'named')])
def test_a_name_with_a_tenth_of_what_repeats_unexplained_is_only_a_part(evidence, verdict):
    rest = [Unexplained('a force', 0.002, 100.0)]
    assert verdict_of(1e-4, [['wind']], rest, [], 0.05, evidence)[0] == verdict


def test_tests_share_the_accepted_probability_of_a_false_alarm(monkeypatch):
    for name, chance in (('repeatable', 0.016), ('line', 0.017), ('beyond', 0.001)):
        monkeypatch.setattr(quality, name, lambda *_, chance=chance: Unexplained('', chance, 1.0))
    monkeypatch.setattr(quality, 'fitted', lambda *_: 0.0)
    engine = SimpleNamespace(flights=[], filters=[], channels=['force_x'], balanced=[], alpha=0.05,
                             without_motion=lambda balanced: [])
    solution = SimpleNamespace(banned={}, spectra=[SimpleNamespace(
        parts=[([0], None, None)], at=float)])
    found = quality.unexplained(engine, solution)
    assert [test.probability for test in found] == [0.001, 0.016]


@pytest.mark.parametrize(('excluded', 'left', 'one_value', 'more'), [
    (0, 1.0, -1.0, True), (1, 51.0, -1.0, True), (1, 49.0, 9.0, False), (3, 60.0, 1.2, True),
    (3, 60.0, 1.1, False)])
def test_a_name_has_more_evidence_than_feedback(excluded, left, one_value, more):
    solution = SimpleNamespace(banned=dict.fromkeys(range(excluded)), unsteady={7: -one_value},
                               sought=100.0, posterior=SimpleNamespace(gain=left))
    assert outweighs(solution, 7) is more
    assert outweighs(solution, 8) is (left > 50 or not excluded)    # not in the loop


def test_feedback_that_hides_the_others_is_the_reason():
    verdict, reason = verdict_of(1.0, [], [], ['wind', 'rotor_drag'], 0.05, 0.0)
    assert verdict == 'not_decidable' and 'values of rotor drag, wind differ' in reason
