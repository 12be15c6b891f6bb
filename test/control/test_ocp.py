"""Stage functions against fine steps; the iteration against an independent QP solver."""

import casadi as ca
import numpy as np

from beetle_omni_ros.control.nmpc import NmpcWeights
from beetle_omni_ros.control.ocp import REFERENCE_SIZE, Rti, stage_functions
from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()
LAG = 0.03      # [s] of the servos
STAGE, TERMINAL = stage_functions(ROBOT, LAG, True)
WEIGHTS = NmpcWeights(thrust_command=0.7).vector()
INTERVALS = np.full(4, 0.1)
SOFT = (10.0, 100.0, 2000.0)
HEIGHT = 1.01  # [m] above the present height, so that the limit is active
REACH = 0.15   # [rad]
REACHES = 2


def random_point(seed):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=21)
    x[6:10] = rotations.normalized(rng.normal(size=4))
    u = np.r_[rng.uniform(-3, 3, 4), rng.uniform(2, 18, 4)]
    reference = rng.normal(size=29)
    reference[6:10] = rotations.normalized(rng.normal(size=4))
    return x, u, 0.1 * rng.normal(size=10), reference


def test_the_cost_is_zero_at_the_reference_for_both_quaternion_signs():
    _, _, d, reference = random_point(1)
    reference[21:] = 0
    u = np.r_[reference[13:17] - d[6:], reference[17:21]]
    for sign in (1, -1):
        x = reference[:21].copy()
        x[6:10] *= sign
        *_, q, r = STAGE(x, u, d, reference, WEIGHTS, 0.1)
        assert np.allclose(np.array(q), 0, atol=1e-9)
        assert np.allclose(np.array(r), 0, atol=1e-9)


def test_one_interval_agrees_with_fine_integration_of_the_lagged_model():
    x, u, d, reference = random_point(4)
    x[10:13] *= 0.5
    coarse = np.array(STAGE(x, u, d, reference, WEIGHTS, 0.05)[0]).ravel()
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
                np.array(w_dot).ravel(), (u[:4] + d[6:] - y[13:17]) / LAG,
                (u[4:] - y[17:21]) / ROBOT.rotors.time_constant])
        fine = fine + fine_step * rate(fine + fine_step / 2 * rate(fine))
    # lags are exact; the body sees them at three points of the interval only
    assert np.allclose(coarse[13:], fine[13:], atol=1e-4)
    assert np.allclose(coarse[:13], fine[:13], atol=0.02)


def setting():
    x = np.zeros(21)
    x[2], x[9], x[17:] = 1.0, 1.0, ROBOT.hover_thrust
    references = np.zeros((len(INTERVALS) + 1, REFERENCE_SIZE))
    references[:, :21] = x
    references[:, 0] = 1.5
    references[:, 6:10] = [np.sin(0.5), 0, 0, np.cos(0.5)]
    bounds = np.r_[np.full(4, -3.96), np.zeros(4), np.full(4, 3.96), np.full(4, 20.0), 0.2, 1.0,
                   np.full(len(INTERVALS), REACH), np.full(len(INTERVALS), HEIGHT)]
    return x, references, 0.05 * np.ones(10), bounds


def qp_by_casadi(x, u, x0, references, disturbance, bounds):
    """The same QP, written as one dense program and solved by qpOASES-like active sets (qrqp)."""
    n, size, nu = len(INTERVALS), 21, 8
    opti_x = [ca.MX.sym(f'x{k}', size) for k in range(n + 1)]
    opti_u = [ca.MX.sym(f'u{k}', nu) for k in range(n)]
    slack = [ca.MX.sym(f's{k}', 13) for k in range(1, n + 1)]
    cost, equal, low, high, inequality = 0, [opti_x[0] - (x0 - x[0])], [], [], []
    for k in range(n):
        f, a, b, q_xx, r_uu, s_ux, q, r = STAGE(
            x[k] if k else x0, u[k], disturbance, references[k], WEIGHTS, INTERVALS[k])
        dx = opti_x[k] if k else ca.MX.zeros(size)
        du = opti_u[k]
        cost += 0.5 * dx.T @ q_xx @ dx + 0.5 * du.T @ r_uu @ du + du.T @ s_ux @ dx \
            + q.T @ dx + r.T @ du
        equal.append(a @ dx + b @ du + f - x[k + 1] - opti_x[k + 1])
        inequality.append(du)
        low.append(bounds[:nu] - u[k])
        high.append(bounds[nu:2 * nu] - u[k])
    hessian, gradient = TERMINAL(x[n], references[n], WEIGHTS)
    cost += 0.5 * opti_x[n].T @ hessian @ opti_x[n] + gradient.T @ opti_x[n]
    for k in range(REACHES + 1):
        tilt = (x[k] if k else x0)[13:17] + (opti_x[k][13:17] if k else 0)
        inequality.append(u[k, :4] + opti_u[k][:4] + disturbance[6:] - tilt)
        low.append(np.full(4, -REACH))
        high.append(np.full(4, REACH))
    limit = np.repeat(bounds[2 * nu:2 * nu + 2], 3)
    for k in range(1, n + 1):
        s, sunk = slack[k - 1][:12], slack[k - 1][12]
        cost += SOFT[0] * ca.sum1(s) + 0.5 * SOFT[1] * ca.sumsqr(s)
        cost += SOFT[0] * sunk + 0.5 * SOFT[2] * sunk ** 2
        moving = [3, 4, 5, 10, 11, 12]      # velocity and body rates
        value = opti_x[k][moving] + x[k, moving]
        inequality += [value + s[:6], value - s[6:], opti_x[k][2] + x[k, 2] + sunk, slack[k - 1]]
        low += [-limit, np.full(6, -np.inf), np.array([HEIGHT]), np.zeros(13)]
        high += [np.full(6, np.inf), limit, np.full(14, np.inf)]
    variables = ca.vertcat(*opti_x, *opti_u, *slack)
    solver = ca.qpsol('qp', 'qrqp', {'x': variables, 'f': cost,
                                     'g': ca.vertcat(*equal, *inequality)},
                      {'print_iter': False, 'print_header': False, 'error_on_fail': True})
    zeros = np.zeros(sum(e.numel() for e in equal))
    solution = solver(lbg=np.r_[zeros, np.concatenate(low)],
                      ubg=np.r_[zeros, np.concatenate(high)])
    values = np.array(solution['x']).ravel()
    return values[size * (n + 1):size * (n + 1) + nu].reshape(nu) + u[0]


def test_the_first_command_is_that_of_an_independent_qp_solver():
    x0, references, disturbance, bounds = setting()
    rti = Rti(ROBOT, LAG, True, INTERVALS, SOFT, 1e-9, 60, REACHES)
    rti.fill(x0, np.r_[np.zeros(4), x0[17:]])
    x, u = rti.states.copy(), rti.inputs.copy()
    assert rti.step(x0, references, disturbance, WEIGHTS, bounds)[0]
    reference = qp_by_casadi(x, u, x0, references, disturbance, bounds)
    assert np.allclose(rti.inputs[0], reference, atol=1e-5)


def test_a_plan_sinks_below_the_smallest_height_only_while_it_cannot_help_it():
    x0, references, disturbance, bounds = setting()
    x0[5] = -0.6                                      # [m/s] sinking
    references[:, 2] = 0.8
    heights = []
    for height in (-1000.0, 0.92):
        bounds[-len(INTERVALS):] = height
        rti = Rti(ROBOT, LAG, True, INTERVALS, (10.0, 100.0, 1e5), 1e-8, 80, REACHES)
        rti.fill(x0, np.r_[np.zeros(4), x0[17:]])
        for _ in range(8):
            rti.step(x0, references, 0 * disturbance, WEIGHTS, bounds)
        heights.append(rti.states[:, 2].copy())
    assert heights[0].min() < 0.89
    assert heights[1].min() > 0.91


def test_an_unsolved_qp_leaves_the_plan_unchanged():
    x0, references, disturbance, bounds = setting()
    rti = Rti(ROBOT, LAG, True, INTERVALS, SOFT, 1e-6, 50, REACHES)
    rti.fill(x0, np.r_[np.zeros(4), x0[17:]])
    rti.step(x0, references, disturbance, WEIGHTS, bounds)
    before = rti.states.copy(), rti.inputs.copy()
    broken = references.copy()
    broken[2, 0] = np.nan
    assert not rti.step(x0, broken, disturbance, WEIGHTS, bounds)[0]
    assert np.array_equal(before[0], rti.states)
    assert np.array_equal(before[1], rti.inputs)
