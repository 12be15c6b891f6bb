"""
One control period of many robots: delayed commands and substeps of the robot's model.

The substep is a scalar CasADi function (SX), a list of elementary operations on numbers. With
tensors in place of the numbers it steps a whole batch: in plain torch on any device, or in one
Triton kernel, in which each GPU thread keeps its robot in registers.
"""

import atexit
from collections.abc import Callable
import importlib.util
from pathlib import Path
import shutil
import tempfile
from types import SimpleNamespace

import casadi as ca
import torch

from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.train import model

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
    """
    Translate a scalar function with dense inputs to assignments.

    Inputs and outputs are ``NAME_K``, with the function's own names and the index of the entry.
    """
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
"""Written by beetle_omni_ros.train.physics; do not edit."""
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
        function = model.substep(robot, period / substeps)
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
            body: (N, 33) quantities of each robot, slices of :mod:`train.model`.

        """
        advance = self._launch if self.has_kernel else self.advance_torch
        return advance(x, commands, delays, wrench, body)

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

    def _launch(self, x, commands, delays, wrench, body):
        x, *rest = (a.contiguous() for a in (x, *commands, delays, wrench, body))
        out = torch.empty_like(x)
        count = x.shape[0]
        blocks = (count + BLOCK - 1) // BLOCK
        self._kernel[(blocks,)](
            x, out, *rest, count, SUBSTEPS=self._substeps,
            STEP=self._period / self._substeps, PERIOD=self._period, BLOCK=BLOCK, num_warps=2)
        return out
