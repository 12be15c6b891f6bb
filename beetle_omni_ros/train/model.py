"""
Model of the robot in the training environment, as one CasADi function, and its batch.

To :mod:`robot.dynamics` it adds the integration over a short substep, the limits of the servos and
the quantities that differ between robots. With a multibody section in the robot file it includes
the reaction of the tilting modules and their shift of the centre of mass, without which a policy
does not hold level attitudes on the multibody plant. The function is a list of scalar operations.
With tensors in place of the numbers it steps a batch: in plain torch on any device, or in one
Triton kernel, in which each GPU thread keeps its robot in registers.
"""

import atexit
from collections.abc import Callable
from dataclasses import replace
import importlib.util
from pathlib import Path
import shutil
import tempfile
from types import SimpleNamespace

import casadi as ca
import numpy as np
import torch

from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.servo import CASADI, SLIDING_RATE, Step

# Quantities of each robot: mass [kg], inertia (3) [kg m^2], centre of mass (3) [m]; for the four
# joints stiffness [N m/rad], damping [N m s/rad], Coulomb friction and stiction [N m] and play
# [rad]; lag of the rotors [s]; for the rotors their distance from the centre of gravity as a
# fraction of the robot file's, and thrust for a command (4).
MASS, INERTIA, CENTRE = slice(0, 1), slice(1, 4), slice(4, 7)
STIFFNESS, DAMPING, COULOMB, STICTION, PLAY = (slice(k, k + 4) for k in range(7, 27, 4))
LAG, ACTUATORS = slice(27, 28), slice(7, 28)
ARM, GAIN = slice(28, 29), slice(29, 33)
BODY_SIZE = 33
SERVO_STEPS = 2    # servo steps in a substep; a servo reaches its rate limit within 1 ms
WRENCH_SIZE = 6    # external force in world [N], torque in body [N m]


def module_reaction(robot: RobotParameters) -> dict[str, float]:
    """Parameters of the effect ``module_reaction`` from the multibody section [kg m^2], [kg m]."""
    module = robot.multibody.module
    depth = -float(module.centre_of_mass[2])
    return {'module_inertia': float(module.inertia[0] + module.mass * depth ** 2),
            'mass_moment': float(module.mass * depth)}


def nominal_body(robot: RobotParameters) -> list[float]:
    """(33,) quantities of the robot file, with its effects."""
    return [robot.effect('mass.mass', robot.mass), *robot.effect('inertia.inertia', robot.inertia),
            *robot.effect('centre_of_mass.offset', (0.0, 0.0, 0.0)), *actuators(robot), 1.0,
            *robot.effect('rotor_thrust_coefficient.scale', (1.0,) * 4)]


def actuators(robot: RobotParameters) -> np.ndarray:
    """(21,) quantities ``ACTUATORS`` of a robot."""
    joints = [robot.effect(key, neutral) for key, neutral in (
        ('joint_bandwidth.kp', robot.joints.kp), ('joint_bandwidth.kd', robot.joints.kd),
        ('joint_friction.coulomb', 0.0), ('joint_friction.stiction', 0.0),
        ('joint_backlash.gap', 0.0))]
    lag = robot.effect('rotor_lag.time_constant', robot.rotors.time_constant)
    return np.hstack([*(np.broadcast_to(value, 4) for value in joints), lag])


def _servos(robot, x, target, h, body):
    """Tilts (4,) and rates (4,) after ``h`` seconds, within rate limit and stops."""
    tilts, rates = [], []
    for i in range(4):
        tilt, rate, thrust = x[model.TILT][i], x[model.TILT_RATE][i], x[model.THRUST][i]
        servo, terms = model.tilt_servo(robot, i, target[i], thrust)
        coulomb = body[COULOMB][i]
        step = Step(CASADI, replace(
            servo, kp=body[STIFFNESS][i], kd=body[DAMPING][i], coulomb=coulomb,
            stiction=ca.fmax(coulomb, body[STICTION][i]),
            position_limit=robot.joints.position_limit), h / SERVO_STEPS)
        for _ in range(SERVO_STEPS):
            tilt, rate = step(terms.target, tilt, rate, terms.load)
        tilts.append(tilt)
        rates.append(rate)
    return ca.vertcat(*tilts), ca.vertcat(*rates)


def substep(robot: RobotParameters, duration: float) -> ca.Function:
    """
    One integration step of ``duration`` [s]: x (25), u (8), wrench (6), body (33) -> x_next (25).

    The servos take shorter steps within rate limit and stops. The rotor lag is exact. The body
    uses the acceleration at the mean thrust and the new tilt. The slices are those of
    :mod:`robot.dynamics` and of this module.
    """
    x, u = ca.SX.sym('x', model.STATE_SIZE), ca.SX.sym('u', model.INPUT_SIZE)
    wrench, body = ca.SX.sym('wrench', WRENCH_SIZE), ca.SX.sym('body', BODY_SIZE)
    h, joints, rotors = duration, robot.joints, robot.rotors

    def clip(value, low, high):
        return ca.fmin(ca.fmax(value, low), high)

    rate = x[model.TILT_RATE]
    target = clip(u[model.TILT_COMMAND], -joints.position_limit, joints.position_limit)
    new_tilt, new_rate = _servos(robot, x, target, h, body)
    # A turning motor leads the rotor by half the play. The state has no side of contact at rest,
    # so the rotor is then in the middle.
    speed = new_rate / SLIDING_RATE
    rotor_tilt = new_tilt - 0.5 * body[PLAY] * speed / ca.sqrt(1 + speed * speed)

    thrust_target = clip(u[model.THRUST_COMMAND], rotors.thrust_min, rotors.thrust_max)
    thrust = x[model.THRUST]
    new_thrust = thrust + (1 - ca.exp(-h / body[LAG])) * (thrust_target - thrust)

    effects = dict(robot.effects)
    if robot.multibody is not None:
        effects.setdefault('module_reaction', module_reaction(robot))
    effects.update(mass={'mass': body[MASS]}, inertia={'inertia': body[INERTIA]},
                   centre_of_mass={'offset': body[CENTRE]},
                   rotor_thrust_coefficient={'scale': body[GAIN]})
    order = ['mass', *(name for name in effects if name != 'mass')]
    acceleration, angular_acceleration = model.rigid_body(
        robot, x[model.VELOCITY], x[model.QUATERNION], x[model.RATE], rotor_tilt,
        (thrust + new_thrust) / 2, wrench[:3], wrench[3:], (new_rate - rate) / h,
        {name: effects[name] for name in order}, tilt_rate=new_rate,
        thrust_rate=(new_thrust - thrust) / h, position=x[model.POSITION],
        rotor_positions=body[ARM] * ca.DM(rotors.positions))
    velocity = x[model.VELOCITY] + h * acceleration
    angular_velocity = x[model.RATE] + h * angular_acceleration
    position = x[model.POSITION] + h * (x[model.VELOCITY] + velocity) / 2
    quaternion = x[model.QUATERNION] + h * model.quaternion_rate(
        x[model.QUATERNION], (x[model.RATE] + angular_velocity) / 2)
    quaternion = quaternion / ca.norm_2(quaternion)
    after = ca.vertcat(position, velocity, quaternion, angular_velocity, new_tilt, new_rate,
                       new_thrust)
    return ca.Function('substep', [x, u, wrench, body], [ca.cse(after)],
                       ['x', 'u', 'wrench', 'body'], ['x_next'])


BLOCK = 64    # robots in one program; small blocks use the GPU well with a few thousand robots

# Text in the language of Triton; ``tl`` and ``number`` are torch's elsewhere.
_OPERATIONS = {
    ca.OP_ADD: '{} + {}', ca.OP_SUB: '{} - {}', ca.OP_MUL: '{} * {}', ca.OP_DIV: '{} / {}',
    ca.OP_FMIN: 'tl.minimum({}, {})', ca.OP_FMAX: 'tl.maximum({}, {})',
    ca.OP_LT: 'number({} < {})', ca.OP_LE: 'number({} <= {})', ca.OP_EQ: 'number({} == {})',
    ca.OP_NE: 'number({} != {})', ca.OP_AND: '{} * {}', ca.OP_OR: 'tl.maximum({}, {})',
    ca.OP_IF_ELSE_ZERO: '{} * {}', ca.OP_NOT: '(1.0 - {})', ca.OP_ASSIGN: '{}', ca.OP_NEG: '-{}',
    ca.OP_SQ: '{0} * {0}', ca.OP_TWICE: '2.0 * {}', ca.OP_INV: '1.0 / {}',
    ca.OP_SQRT: 'tl.sqrt({})', ca.OP_SIN: 'tl.sin({})', ca.OP_COS: 'tl.cos({})',
    ca.OP_EXP: 'tl.exp({})', ca.OP_FABS: 'tl.abs({})'}


def _statements(function: ca.Function) -> list[str]:
    """Translate a scalar function with dense inputs to assignments."""
    # Inputs and outputs are ``NAME_K``, with the function's own names and the index of the entry.
    lines = []
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        inputs, outputs = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_OUTPUT:
            row = function.sparsity_out(outputs[0]).get_triplet()[0][outputs[1]]
            lines.append(f'{function.name_out(outputs[0])}_{row} = w{inputs[0]}')
            continue
        if operation == ca.OP_INPUT:
            right = f'{function.name_in(inputs[0])}_{inputs[1]}'
        elif operation == ca.OP_CONST:
            right = repr(float(function.instruction_constant(k)))
        elif operation in _OPERATIONS:
            right = _OPERATIONS[operation].format(*(f'w{i}' for i in inputs))
        else:
            raise NotImplementedError(f'CasADi operation {operation} in {function.name()}')
        lines.append(f'w{outputs[0]} = {right}')
    return lines


def torch_function(function: ca.Function) -> Callable:
    """Translate a one-output function to torch, on tensors (..., number of entries)."""
    def minimum(a, b):
        return torch.clamp(a, max=b) if not torch.is_tensor(b) else \
            torch.clamp(b, max=a) if not torch.is_tensor(a) else torch.minimum(a, b)

    def maximum(a, b):
        return torch.clamp(a, min=b) if not torch.is_tensor(b) else \
            torch.clamp(b, min=a) if not torch.is_tensor(a) else torch.maximum(a, b)

    def number(condition):
        return condition.to(torch.get_default_dtype()) if torch.is_tensor(condition) \
            else float(condition)

    def like(value, other):
        return value if torch.is_tensor(value) else torch.full_like(other, value)

    names, out = function.name_in(), function.name_out(0)
    lines = [f'def {function.name()}({", ".join(names)}):']
    for i, name in enumerate(names):
        parts = ', '.join(f'{name}_{k}' for k in range(function.numel_in(i)))
        lines.append(f'    {parts}, = {name}.unbind(-1)')
    lines += ['    ' + line for line in _statements(function)]
    parts = ', '.join(f'like({out}_{k}, {names[0]}_0)' for k in range(function.numel_out(0)))
    lines.append(f'    return stack([{parts}], -1)')
    words = SimpleNamespace(minimum=minimum, maximum=maximum, sqrt=torch.sqrt, sin=torch.sin,
                            cos=torch.cos, exp=torch.exp, abs=torch.abs)
    space = {'tl': words, 'number': number, 'like': like, 'stack': torch.stack}
    exec(compile('\n'.join(lines), f'<{function.name()}>', 'exec'), space)
    return space[function.name()]


_KERNEL = '''\
"""Written by beetle_omni_ros.train.model; do not edit."""
import triton
import triton.language as tl


@triton.jit
def number(condition):
    return condition.to(tl.float32)


@triton.jit
def advance(x_in, x_out, newest, previous, oldest, delays, wrench, body, count,
            SUBSTEPS: tl.constexpr, STEP: tl.constexpr, PERIOD: tl.constexpr,
            BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = i < count
{loads}
    tilt_delay = tl.load(delays + 2 * i, mask=mask, other=0.0)
    thrust_delay = tl.load(delays + 2 * i + 1, mask=mask, other=0.0)
    for s in range(SUBSTEPS):
        age = s * STEP + 1e-6
{commands}
{step}
{update}
{stores}
'''


def _kernel_source(function) -> str:
    """Triton module of a substep function."""
    def lines(depth, items):
        return '\n'.join(' ' * depth + item for item in items)

    def load(name, array, k, size):
        return f'{name}_{k} = tl.load({array} + {size} * i + {k}, mask=mask, other=0.0)'

    states, inputs = function.numel_in(0), function.numel_in(1)
    loads = [load('x', 'x_in', k, states) for k in range(states)]
    loads += [load(name, name, k, size) for name, size in (
        ('wrench', function.numel_in(2)), ('body', function.numel_in(3))) for k in range(size)]
    loads += [load(name, name, k, inputs) for name in ('newest', 'previous', 'oldest')
              for k in range(inputs)]
    commands = []
    for k in range(inputs):
        delay = 'tilt_delay' if k < 4 else 'thrust_delay'
        commands.append(f'u_{k} = tl.where(age >= {delay}, newest_{k}, tl.where('
                        f'age + PERIOD >= {delay}, previous_{k}, oldest_{k}))')
    out = function.name_out(0)
    return _KERNEL.format(
        loads=lines(4, loads), commands=lines(8, commands),
        step=lines(8, _statements(function)),
        update=lines(8, [f'x_{k} = {out}_{k}' for k in range(states)]),
        stores=lines(4, [f'tl.store(x_out + {states} * i + {k}, x_{k}, mask=mask)'
                         for k in range(states)]))


def _load_kernel(source: str):
    """Import a Triton module from a file, because its compiler reads the source there."""
    folder = Path(tempfile.mkdtemp(prefix='beetle_omni_'))    # other users cannot write there
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    path = folder / 'kernel.py'
    path.write_text(source)
    spec = importlib.util.spec_from_file_location('beetle_omni_kernel', path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.advance


class Physics:
    """Control periods [s] of a batch of robots, with the Triton kernel on a GPU."""

    def __init__(self, robot: RobotParameters, period: float, substeps: int,
                 device: torch.device | str):
        self._period, self._substeps = period, substeps
        function = substep(robot, period / substeps)
        self.has_kernel = torch.device(device).type == 'cuda'
        if self.has_kernel:
            self._kernel = _load_kernel(_kernel_source(function))
        self._substep = torch_function(function)

    def advance(self, x, commands, delays, wrench, body) -> torch.Tensor:
        """
        States one control period later.

        Args:
            x: (N, 25) states, slices of :mod:`robot.dynamics`.
            commands: newest, previous and the one before, each (N, 8).
            delays: (N, 2) of tilt and thrust commands [s], at most two periods.
            wrench: (N, 6) external force in world [N], torque in body [N m].
            body: (N, 33) quantities of each robot, slices of this module.

        """
        if not self.has_kernel:
            return self.advance_torch(x, commands, delays, wrench, body)
        x, *rest = (a.contiguous() for a in (x, *commands, delays, wrench, body))
        out, count = torch.empty_like(x), x.shape[0]
        self._kernel[((count + BLOCK - 1) // BLOCK,)](
            x, out, *rest, count, SUBSTEPS=self._substeps,
            STEP=self._period / self._substeps, PERIOD=self._period, BLOCK=BLOCK, num_warps=2)
        return out

    def advance_torch(self, x, commands, delays, wrench, body):
        """:meth:`advance` in plain torch."""
        step = self._period / self._substeps
        delay = delays.repeat_interleave(4, dim=1)
        for s in range(self._substeps):
            age = s * step + 1e-6
            command = torch.where(age >= delay, commands[0], torch.where(
                age + self._period >= delay, commands[1], commands[2]))
            x = self._substep(x, command, wrench, body)
        return x
