"""
Translation of CasADi functions to torch and Triton source.

A scalar CasADi function (SX) is a list of elementary operations on numbers. With tensors in place
of the numbers it steps a whole batch: in plain torch on any device, or in one Triton kernel, in
which each GPU thread keeps its robot in registers.
"""

from collections.abc import Callable

import casadi as ca

_BINARY = {ca.OP_ADD: '{} + {}', ca.OP_SUB: '{} - {}', ca.OP_MUL: '{} * {}',
           ca.OP_DIV: '{} / {}', ca.OP_FMIN: 'minimum({}, {})', ca.OP_FMAX: 'maximum({}, {})',
           ca.OP_LT: 'number({} < {})', ca.OP_LE: 'number({} <= {})',
           ca.OP_EQ: 'number({} == {})', ca.OP_NE: 'number({} != {})',
           ca.OP_AND: '{} * {}', ca.OP_OR: 'maximum({}, {})', ca.OP_IF_ELSE_ZERO: '{} * {}'}
_UNARY = {ca.OP_ASSIGN: '{}', ca.OP_NEG: '-{}', ca.OP_SQ: '{0} * {0}', ca.OP_TWICE: '2.0 * {}',
          ca.OP_INV: '1.0 / {}', ca.OP_SQRT: 'sqrt({})', ca.OP_SIN: 'sin({})',
          ca.OP_COS: 'cos({})', ca.OP_EXP: 'exp({})', ca.OP_FABS: 'fabs({})',
          ca.OP_NOT: '(1.0 - {})'}

# Functions with a different name in each language.
TORCH = {'minimum': '_minimum', 'maximum': '_maximum', 'sqrt': 'torch.sqrt', 'sin': 'torch.sin',
         'cos': 'torch.cos', 'exp': 'torch.exp', 'fabs': 'torch.abs', 'number': '_number'}
TRITON = {'minimum': 'tl.minimum', 'maximum': 'tl.maximum', 'sqrt': 'tl.sqrt', 'sin': 'tl.sin',
          'cos': 'tl.cos', 'exp': 'tl.exp', 'fabs': 'tl.abs', 'number': '_number'}


def statements(function: ca.Function, words: dict[str, str]) -> list[str]:
    """
    Translate a scalar function to assignments.

    Inputs are read from ``NAME_K`` and outputs assigned to ``NAME_K``, with the function's own
    names of inputs and outputs and the index K of the entry.

    Args:
        function: SX function with dense inputs.
        words: names of the elementary functions.

    Raises:
        NotImplementedError: an operation that is not in the tables.

    """
    lines = []
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        inputs, outputs = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_INPUT:
            right = f'{function.name_in(inputs[0])}_{inputs[1]}'
        elif operation == ca.OP_CONST:
            right = repr(float(function.instruction_constant(k)))
        elif operation == ca.OP_OUTPUT:
            row = function.sparsity_out(outputs[0]).get_triplet()[0][outputs[1]]
            lines.append(f'{function.name_out(outputs[0])}_{row} = w{inputs[0]}')
            continue
        else:
            pattern = _BINARY.get(operation) or _UNARY.get(operation)
            if pattern is None:
                raise NotImplementedError(f'CasADi operation {operation} in {function.name()}')
            head, bracket, rest = pattern.partition('(')
            if bracket and head in words:
                pattern = words[head] + bracket + rest
            right = pattern.format(*(f'w{i}' for i in inputs))
        lines.append(f'w{outputs[0]} = {right}')
    return lines


def torch_source(function: ca.Function) -> str:
    """Source of ``FUNCTION(inputs...) -> output`` on tensors (..., number of entries)."""
    names = function.name_in()
    lines = [f'def {function.name()}({", ".join(names)}):']
    for i, name in enumerate(names):
        size = function.numel_in(i)
        parts = ', '.join(f'{name}_{k}' for k in range(size))
        lines.append(f'    {parts}, = {name}.unbind(-1)')
    lines += ['    ' + line for line in statements(function, TORCH)]
    out = function.name_out(0)
    first = f'{names[0]}_0'
    parts = ', '.join(f'_like({out}_{k}, {first})' for k in range(function.numel_out(0)))
    return '\n'.join([*lines, f'    return torch.stack([{parts}], -1)', ''])


def torch_function(function: ca.Function) -> Callable:
    """Translate a one-output SX function to torch, in the precision of its inputs."""
    import torch

    def number(condition):
        return condition.to(torch.get_default_dtype()) if torch.is_tensor(condition) \
            else float(condition)

    def pair(operation):
        def apply(a, b):
            if torch.is_tensor(a):
                return operation(a, b if torch.is_tensor(b) else a.new_tensor(b))
            return operation(b.new_tensor(a), b) if torch.is_tensor(b) \
                else float(operation(torch.tensor(a), torch.tensor(b)))
        return apply

    def like(value, other):
        return value if torch.is_tensor(value) else torch.full_like(other, value)

    def minimum(a, b):
        return torch.clamp(a, max=b) if not torch.is_tensor(b) else \
            torch.clamp(b, max=a) if not torch.is_tensor(a) else torch.minimum(a, b)

    def maximum(a, b):
        return torch.clamp(a, min=b) if not torch.is_tensor(b) else \
            torch.clamp(b, min=a) if not torch.is_tensor(a) else torch.maximum(a, b)

    space = {'torch': torch, '_minimum': minimum, '_maximum': maximum, '_number': number,
             '_like': like}
    exec(compile(torch_source(function), f'<{function.name()}>', 'exec'), space)
    return space[function.name()]
