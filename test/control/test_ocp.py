"""Stage functions: the cost at the reference, the interval against fine steps."""

import casadi as ca
import numpy as np

from beetle_omni_ros.control.nmpc import NmpcWeights
from beetle_omni_ros.control.ocp import stage_functions
from beetle_omni_ros.robot import dynamics as model
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters

ROBOT = RobotParameters.load()
WEIGHTS = NmpcWeights(thrust_command=0.7).vector()
SERVO_LAG = 0.03


def random_point(seed, size):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=size)
    x[6:10] = rotations.normalized(rng.normal(size=4))
    u = np.r_[rng.uniform(-3, 3, 4), rng.uniform(2, 18, 4)]
    reference = rng.normal(size=29)
    reference[6:10] = rotations.normalized(rng.normal(size=4))
    return x, u, 0.1 * rng.normal(size=10), reference


def test_the_cost_is_zero_at_the_reference_for_both_quaternion_signs():
    stage, _ = stage_functions(ROBOT, SERVO_LAG, True)
    _, _, d, reference = random_point(1, 21)
    reference[21:] = 0
    u = np.r_[reference[13:17] - d[6:], reference[17:21]]
    for sign in (1, -1):
        x = reference[:21].copy()
        x[6:10] *= sign
        *_, q, r = stage(x, u, d, reference, WEIGHTS, 0.1)
        assert np.allclose(np.array(q), 0, atol=1e-9)
        assert np.allclose(np.array(r), 0, atol=1e-9)


def test_one_interval_agrees_with_fine_integration_of_the_lagged_model():
    stage, _ = stage_functions(ROBOT, SERVO_LAG, True)
    x, u, d, reference = random_point(4, 21)
    x[10:13] *= 0.5
    coarse = np.array(stage(x, u, d, reference, WEIGHTS, 0.05)[0]).ravel()
    fine = x.copy()
    fine_step = 0.05 / 200
    for _ in range(200):  # midpoint rule on all states, lags included
        def rate(y):
            a, w_dot = model.rigid_body(ROBOT, ca.DM(y[3:6]), ca.DM(y[6:10]), ca.DM(y[10:13]),
                                        ca.DM(y[13:17]), ca.DM(y[17:21]), ca.DM(d[:3]),
                                        ca.DM(d[3:6]))
            return np.concatenate([
                y[3:6], np.array(a).ravel(),
                np.array(model.quaternion_rate(ca.DM(y[6:10]), ca.DM(y[10:13]))).ravel(),
                np.array(w_dot).ravel(), (u[:4] + d[6:] - y[13:17]) / SERVO_LAG,
                (u[4:] - y[17:21]) / ROBOT.rotors.time_constant])
        fine = fine + fine_step * rate(fine + fine_step / 2 * rate(fine))
    # lags are exact; the body sees them at three points of the interval only
    assert np.allclose(coarse[13:], fine[13:], atol=1e-4)
    assert np.allclose(coarse[:13], fine[:13], atol=0.02)
