"""
A hand-written policy: PD control of the pose, then allocation.

It consists of ONNX operators on the observation, so that tests need neither training nor the
shipped file. It is slow, and has a steady error without the estimated disturbance. All vectors are
in base_link axes; rows of matrices are the x, y and z axes.
"""

import numpy as np
from onnx import helper, numpy_helper, TensorProto
from policy_files import save

from beetle_omni_ros.control.policy_file import PolicyContract
from beetle_omni_ros.robot.allocation import Allocator
from beetle_omni_ros.robot.parameters import RobotParameters

POSITION_GAINS, ATTITUDE_GAINS = (4.0, 3.5), (6.0, 4.0)     # 1/s^2, 1/s
LONGEST_ERROR = 1.0     # m or rad
TILT_REACH = 0.08       # rad a step
TINY = 1e-9


class Graph:
    """Operators and constants by the names of their results."""

    def __init__(self):
        self.nodes, self.constants = [], []

    def __call__(self, operator, *inputs, **attributes):
        """Add a node; arrays among the inputs become constants."""
        names = [value if isinstance(value, str) else self.constant(value) for value in inputs]
        result = attributes.pop('result', f't{len(self.nodes)}')
        self.nodes.append(helper.make_node(operator, names, [result], **attributes))
        return result

    def constant(self, value):
        """Name of a new constant: indices stay integers, all else becomes float32."""
        value = np.asarray(value)
        value = value if value.dtype == np.int64 else value.astype(np.float32)
        name = f'c{len(self.constants)}'
        self.constants.append(numpy_helper.from_array(value, name))
        return name

    def columns(self, value, begin, end):
        """Columns of a row."""
        return self('Gather', value, np.arange(begin, end), axis=1)

    def length(self, value):
        """Euclidean length of a row, (1, 1)."""
        return self('Sqrt', self('ReduceSum', self('Mul', value, value), np.array([1])))

    def shortened(self, value):
        """A row, at most LONGEST_ERROR long."""
        share = self('Div', LONGEST_ERROR, self('Add', self.length(value), TINY))
        return self('Mul', value, self('Min', share, 1.0))

    def cross(self, a, b):
        """Cross product of two rows."""
        def turned(value, order):
            return self('Gather', value, np.array(order), axis=1)
        return self('Sub', self('Mul', turned(a, [1, 2, 0]), turned(b, [2, 0, 1])),
                    self('Mul', turned(a, [2, 0, 1]), turned(b, [1, 2, 0])))

    def axes(self, columns):
        """Three rows x, y, z of a matrix, from the columns x and z in one row."""
        x, z = self.columns(columns, 0, 3), self.columns(columns, 3, 6)
        return self('Concat', x, self.cross(z, x), z, axis=0)

    def angle(self, sine, cosine):
        """Four-quadrant arc tangent, from half angles."""
        length = self('Sqrt', self('Add', self('Mul', sine, sine), self('Mul', cosine, cosine)))
        half = self('Atan', self('Div', sine, self('Add', self('Add', length, cosine), TINY)))
        return self('Mul', half, 2.0)


def write_hover_policy(path, memory=False, blind_above=None):
    """
    Write the policy for the shipped robot.

    Args:
        path: file to write.
        memory: whether it cancels the estimated disturbance.
        blind_above: height of the target above the robot [m] at which the actions become NaN.

    """
    robot = RobotParameters.load()
    contract, g = PolicyContract.default(robot, memory), Graph()
    seen = 'observation'
    velocity, rate, way = (g.columns(seen, k, k + 3) for k in (0, 3, 6))
    body = g.axes(g.columns(seen, 9, 15))
    goal = g.axes(g.columns(seen, 15, 21))
    up = g('Transpose', g('Gather', body, np.array([2]), axis=1))

    kp, kd = POSITION_GAINS
    force = g('Mul', robot.mass, g('Add', g('Mul', up, robot.gravity), g(
        'Sub', g('Mul', g.shortened(way), kp), g('Mul', velocity, kd))))
    kp, kd = ATTITUDE_GAINS
    torque = g('Mul', robot.inertia[None], g(
        'Sub', g('Mul', g.shortened(turn(g, body, goal)), kp), g('Mul', rate, kd)))
    wrench = g('Concat', force, torque, axis=1)
    if memory:      # the estimated disturbance is cancelled
        wrench = g('Sub', wrench, g.columns(seen, 33, 39))
    components = g('MatMul', wrench, Allocator(robot).inverse.T)
    tilt, thrust = targets(g, components, g.columns(seen, 21, 25), g.columns(seen, 25, 29),
                           contract, robot.joints.position_limit)
    requested = g('Sub', g('Concat', tilt, thrust, axis=1), np.array([contract.action_offset]))
    action = g('Div', requested, np.array([contract.action_scale]),
               result='t' if blind_above else 'action')
    if blind_above:
        height = g('Sub', g('MatMul', way, g('Transpose', up)), float(blind_above))
        g('Where', g('Greater', height, 0.0), np.nan, action, result='action')
    save(path, g.nodes, g.constants, contract.observation_size, 8, (seen, 'action'),
         TensorProto.FLOAT, contract.to_metadata())
    return path


def turn(g, body, goal):
    """Rotation vector (1, 3) from body to goal, in the body's axes."""
    relative = g('Reshape', g('MatMul', body, g('Transpose', goal)), np.array([1, 9]))
    take = {k: g.columns(relative, k, k + 1) for k in range(9)}
    sine = g('Mul', 0.5, g('Concat', g('Sub', take[7], take[5]), g('Sub', take[2], take[6]),
                           g('Sub', take[3], take[1]), axis=1))
    trace = g('Add', take[0], g('Add', take[4], take[8]))
    cosine = g('Mul', 0.5, g('Sub', trace, 1.0))
    length = g('Add', g.length(sine), 1e-6)
    return g('Mul', g('Div', sine, length), g.angle(length, cosine))


def targets(g, components, measured, previous, contract, limit):
    """Tilts by the shortest permitted turn at limited rate, and thrusts along the wanted force."""
    along = g('Gather', components, np.arange(0, 8, 2), axis=1)
    across = g('Gather', components, np.arange(1, 8, 2), axis=1)

    def seen_from(tilt):
        cosine, sine = g('Cos', tilt), g('Sin', tilt)
        return (g('Add', g('Mul', along, cosine), g('Mul', across, sine)),
                g('Sub', g('Mul', across, cosine), g('Mul', along, sine)))

    before = g('Mul', previous, np.array([contract.action_scale[:4]]))
    ahead, beside = seen_from(before)
    way = g.angle(beside, ahead)
    goal = g('Add', before, way)
    beyond = g('Greater', g('Abs', goal), float(limit))
    way = g('Where', beyond, g('Sub', way, g('Mul', g('Sign', goal), 2 * np.pi)), way)
    tilt = g('Add', before, g('Clip', way, -TILT_REACH, TILT_REACH))
    helpful, _ = seen_from(measured)
    return tilt, g('Max', helpful, 0.0)
