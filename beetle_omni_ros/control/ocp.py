"""
The NMPC's optimal control problem as stage functions, generated from the robot's model.

The rigid body is integrated by Runge-Kutta 4, the first-order lags of servos and rotors in closed
form at the start, middle and end of an interval, which may therefore be much longer than a servo's
time constant. docs/explanation/nmpc.md has the cost. HPIPM, which the casadi wheel contains with
BLASFEO and the headers of both, solves the QP.
"""

import ctypes
from ctypes import c_double, c_int, c_void_p, POINTER
from pathlib import Path

import casadi as ca
import numpy as np

from beetle_omni_ros.model import dynamics
from beetle_omni_ros.model.native import built, generated
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

FOLDER = Path(ca.__file__).resolve().parent
OPTIONS = (f'-I{FOLDER}/include', f'-L{FOLDER}', '-l:libhpipm.so', '-l:libblasfeo.so.0', '-lm',
           f'-Wl,-rpath,{FOLDER}')
_DOUBLES = POINTER(c_double)

# Order of the weight vector; see NmpcWeights for meanings and units.
WEIGHTS = ('position_xy', 'position_z', 'velocity', 'attitude_xy', 'attitude_z', 'rate', 'tilt',
           'thrust', 'tilt_change', 'thrust_change', 'thrust_command')
INPUT_SIZE = 8
# position, velocity, quaternion, rate, tilt, thrust, lead of tilt and of thrust commands
REFERENCE_SIZE = 29
# Smallest duration of an interval in the cost of command leads [s]; otherwise aggressive commands
# in short first intervals would be cheap.
CHANGE_TIME = 0.1


def stage_functions(robot: RobotParameters, servo_lag: float, rotor_lag: bool
                    ) -> tuple[ca.Function, ca.Function]:
    """
    Write the stage functions for a robot.

    Args:
        robot: with the effects that apply.
        servo_lag: time constant of the servos' first-order reduction [s].
        rotor_lag: whether thrust is a state with the robot's rotor time constant
            (21 states) or follows its command at once (17 states).

    Returns:
        stage: (x, u, d, reference, weights, h) -> x_next, A, B, Q, R, S, q, r, and
        terminal: (x, reference, weights) -> Q, q.

    """
    size = 21 if rotor_lag else 17
    x, u = ca.SX.sym('x', size), ca.SX.sym('u', INPUT_SIZE)
    d = ca.SX.sym('d', dynamics.DISTURBANCE_SIZE)
    reference, weights = ca.SX.sym('reference', REFERENCE_SIZE), ca.SX.sym('w', len(WEIGHTS))
    h = ca.SX.sym('h')

    x_next = _interval(robot, servo_lag, rotor_lag, x, u, d, h)
    part = ca.fmax(h, CHANGE_TIME) / h
    residual, weight = _residual(rotor_lag, x, u, d, reference, weights, part)
    z = ca.vertcat(x, u)
    jacobian = ca.jacobian(residual, z)
    hessian = h * (jacobian.T @ ca.diag(weight) @ jacobian)
    gradient = h * (jacobian.T @ (weight * residual))
    stage = ca.Function('stage', [x, u, d, reference, weights, h], [ca.densify(e) for e in (
        x_next, ca.jacobian(x_next, x), ca.jacobian(x_next, u),
        hessian[:size, :size], hessian[size:, size:], hessian[size:, :size],
        gradient[:size], gradient[size:])])

    residual, weight = _residual(rotor_lag, x, None, None, reference, weights, 1)
    jacobian = ca.jacobian(residual, x)
    return stage, ca.Function('terminal', [x, reference, weights], [ca.densify(e) for e in (
        jacobian.T @ ca.diag(weight) @ jacobian, jacobian.T @ (weight * residual))])


def _interval(robot, servo_lag, rotor_lag, x, u, d, h):
    """State after one interval of length ``h`` under a constant command."""
    tilt_target = u[:4] + d[dynamics.TILT_OFFSET]
    tilt = x[13:17]

    def actuators(time):
        angle = tilt_target + (tilt - tilt_target) * ca.exp(-time / servo_lag)
        if not rotor_lag:
            return angle, u[4:]
        decay = ca.exp(-time / robot.rotors.time_constant)
        return angle, u[4:] + (x[17:21] - u[4:]) * decay

    def body_derivative(body, time):
        angle, thrust = actuators(time)
        rates = {'tilt_rate': (tilt_target - angle) / servo_lag, 'position': body[:3]}
        if rotor_lag:
            rates['thrust_rate'] = (u[4:] - thrust) / robot.rotors.time_constant
        acceleration, angular_acceleration = dynamics.rigid_body(
            robot, body[3:6], body[6:10], body[10:13], angle, thrust,
            d[dynamics.FORCE], d[dynamics.TORQUE], **rates)
        return ca.vertcat(body[3:6], acceleration,
                          dynamics.quaternion_rate(body[6:10], body[10:13]),
                          angular_acceleration)

    body = x[:13]
    k1 = body_derivative(body, 0)
    k2 = body_derivative(body + h / 2 * k1, h / 2)
    k3 = body_derivative(body + h / 2 * k2, h / 2)
    k4 = body_derivative(body + h * k3, h)
    angle, thrust = actuators(h)
    parts = [body + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), angle]
    return ca.vertcat(*parts, thrust) if rotor_lag else ca.vertcat(*parts)


def _residual(rotor_lag, x, u, d, reference, weights, change):
    """Residual and weights, those of leads times ``change``; without ``u``, the terminal ones."""
    w = dict(zip(WEIGHTS, ca.vertsplit(weights)))
    xr, yr, zr, wr = ca.vertsplit(reference[6:10])
    qx, qy, qz, qw = ca.vertsplit(x[6:10])
    attitude = ca.vertcat(wr * qx - xr * qw - yr * qz + zr * qy,
                          wr * qy - yr * qw - zr * qx + xr * qz,
                          wr * qz - zr * qw - xr * qy + yr * qx)
    residual = [x[0:3] - reference[0:3], x[3:6] - reference[3:6], attitude,
                x[10:13] - reference[10:13], x[13:17] - reference[13:17]]
    weight = [w['position_xy'], w['position_xy'], w['position_z'], *[w['velocity']] * 3,
              w['attitude_xy'], w['attitude_xy'], w['attitude_z'], *[w['rate']] * 3,
              *[w['tilt']] * 4]
    if rotor_lag:
        residual.append(x[17:21] - reference[17:21])
        weight += [w['thrust']] * 4
    if u is not None:
        residual.append(u[:4] + d[dynamics.TILT_OFFSET] - x[13:17] - reference[21:25])
        weight += [change * w['tilt_change']] * 4
        if rotor_lag:
            residual.append(u[4:] - x[17:21] - reference[25:29])
            weight += [change * w['thrust_change']] * 4
        residual.append(u[4:] - reference[17:21] - reference[25:29])
        weight += [w['thrust_command']] * 4
    return ca.vertcat(*residual), ca.vertcat(*weight)


class Rti:
    """
    One Gauss-Newton QP a cycle around a stored, shifted trajectory, compiled with rti.c.

    Args:
        robot, servo_lag, rotor_lag: of :func:`stage_functions`.
        intervals: (N,) interval lengths [s].
        soft: linear weight of the slacks, quadratic weight on velocity and rate, quadratic weight
            on the height; or None.
        tolerance: residual at which the QP counts as solved.
        max_iterations: of the QP.
        reaches: number of intervals after the first in which the lead of tilt targets is bounded.

    """

    def __init__(self, robot, servo_lag, rotor_lag, intervals, soft, tolerance, max_iterations,
                 reaches=0):
        # HPIPM names BLASFEO only by soname; having it loaded first resolves that anywhere.
        ctypes.CDLL(str(FOLDER / 'libblasfeo.so.0'), mode=ctypes.RTLD_GLOBAL)
        stage, terminal = stage_functions(robot, servo_lag, rotor_lag)
        source = generated([stage, terminal]) + '\n' \
            + Path(__file__).with_name('rti.c').read_text()
        self._library = lib = ctypes.CDLL(str(built('nmpc', source, OPTIONS)))
        lib.rti_create.restype = c_void_p
        lib.rti_create.argtypes = [c_int, _DOUBLES, c_int, c_int, _DOUBLES, c_double, c_int,
                                   c_int]
        for name in ('rti_states', 'rti_inputs'):
            getattr(lib, name).restype = _DOUBLES
            getattr(lib, name).argtypes = [c_void_p]
        lib.rti_step.argtypes = [c_void_p] * 6
        lib.rti_shift.argtypes = [c_void_p, c_double]
        lib.rti_iterations.argtypes = lib.rti_free.argtypes = [c_void_p]
        n, size = len(intervals), stage.size1_in(0)
        weights = np.array(soft if soft else (0.0,) * 3, dtype=float)
        self._handle = lib.rti_create(n, intervals.ctypes.data_as(_DOUBLES), size, int(bool(soft)),
                                      weights.ctypes.data_as(_DOUBLES), tolerance, max_iterations,
                                      reaches)
        if not self._handle:
            raise ParameterError(f'horizon: expected at most 64 intervals, found {n}')
        self.states = np.ctypeslib.as_array(lib.rti_states(self._handle), (n + 1, size))
        self.inputs = np.ctypeslib.as_array(lib.rti_inputs(self._handle), (n, INPUT_SIZE))

    def __del__(self):
        if getattr(self, '_handle', None):
            self._library.rti_free(self._handle)
            self._handle = None

    def fill(self, x, u):
        """Store one state and one input over the whole horizon."""
        self.states[:], self.inputs[:] = x, u

    def shift(self, time: float):
        """Move the stored trajectory forward by ``time`` [s], at most the shortest interval."""
        self._library.rti_shift(self._handle, time)

    def step(self, x0, references, disturbance, weights, bounds) -> tuple[bool, int]:
        """
        One iteration, with the result in ``states`` and ``inputs``; if solved, and iterations.

        Args:
            x0: (nx,) present state.
            references: (N + 1, 29).
            disturbance: (10,) force in world, torque in body, tilt offsets.
            weights: (11,) in the order of ``WEIGHTS``.
            bounds: (18 + 2 N,) lower and upper input bounds, limits of |v| and |w|, for each
                interval the largest lead of a tilt target, and for each of the nodes 1 to N the
                smallest height.

        """
        status = self._library.rti_step(
            self._handle, x0.ctypes.data, references.ctypes.data, disturbance.ctypes.data,
            weights.ctypes.data, bounds.ctypes.data)
        return status == 0, self._library.rti_iterations(self._handle)
