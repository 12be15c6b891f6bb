"""Real-time iteration: one Gauss-Newton QP a cycle around a stored, shifted trajectory."""

from ctypes import c_double, c_int, c_void_p, POINTER

import numpy as np

from beetle_omni_ros.control.hpipm import compiled_library, OcpQp
from beetle_omni_ros.control.ocp import INPUT_SIZE, Ocp, REFERENCE_SIZE
from beetle_omni_ros.robot.dynamics import TILT_OFFSET

BOUNDED_STATES = [2, 3, 4, 5, 10, 11, 12]  # height, velocity and body rates
UPPER = [0.0, *[1.0] * 6]               # the height has no upper bound
QUATERNION, TILT = slice(6, 10), slice(13, 17)
_DOUBLES = POINTER(c_double)


class CompiledRti:
    """
    The iteration in C; a call costs a fraction of a millisecond.

    Args:
        ocp: stage functions.
        intervals: (N,) interval lengths [s].
        soft: linear weight of the slacks, quadratic weight on velocity and rate, quadratic weight
            on the height; or None.
        tolerance: residual at which the QP counts as solved.
        max_iterations: of the QP.
        reaches: number of intervals after the first in which the lead of tilt targets is bounded.
        extra: further CasADi functions to compile into the same library.

    Raises:
        CompilerError: there is no usable compiler.

    """

    def __init__(self, ocp: Ocp, intervals, soft, tolerance, max_iterations, reaches=0, extra=()):
        self.library = lib = compiled_library([ocp.stage, ocp.terminal, *extra])
        lib.rti_create.restype = c_void_p
        lib.rti_create.argtypes = [c_int, _DOUBLES, c_int, c_int, _DOUBLES, c_double, c_int,
                                   c_int]
        for name in ('rti_states', 'rti_inputs'):
            getattr(lib, name).restype = _DOUBLES
            getattr(lib, name).argtypes = [c_void_p]
        lib.rti_step.argtypes = [c_void_p] * 6
        lib.rti_fill.argtypes = [c_void_p] * 3
        lib.rti_shift.argtypes = [c_void_p, c_double]
        lib.rti_iterations.argtypes = lib.rti_free.argtypes = [c_void_p]
        n, size = len(intervals), ocp.state_size
        interval = np.array(intervals, dtype=float)
        weights = np.array(soft if soft else (0.0,) * 3, dtype=float)
        self._handle = lib.rti_create(n, interval.ctypes.data_as(_DOUBLES), size, int(bool(soft)),
                                      weights.ctypes.data_as(_DOUBLES), tolerance, max_iterations,
                                      reaches)
        if not self._handle:
            raise MemoryError(f'the NMPC could not be allocated for {n} intervals')
        self.states = np.ctypeslib.as_array(lib.rti_states(self._handle), (n + 1, size))
        self.inputs = np.ctypeslib.as_array(lib.rti_inputs(self._handle), (n, INPUT_SIZE))

    def __del__(self):
        if getattr(self, '_handle', None):
            self.library.rti_free(self._handle)
            self._handle = None

    def fill(self, x, u):
        """Store one state and one input over the whole horizon."""
        self.states[:], self.inputs[:] = x, u

    def shift(self, time: float):
        """Move the stored trajectory forward by ``time`` [s], at most the shortest interval."""
        self.library.rti_shift(self._handle, time)

    def step(self, x0, references, disturbance, weights, bounds) -> tuple[int, int]:
        """
        One iteration; the result is in ``states`` and ``inputs``.

        Args:
            x0: (nx,) present state.
            references: (N + 1, 29).
            disturbance: (10,) force in world, torque in body, tilt offsets.
            weights: (11,) in the order of ``ocp.WEIGHTS``.
            bounds: (18 + 2 N,) lower and upper input bounds, limits of |v| and |w|, for each
                interval the largest lead of a tilt target, and for each of the nodes 1 to N the
                smallest height.

        Returns:
            QP status (0 solved) and iterations; above 1 nothing has changed.

        """
        status = self.library.rti_step(
            self._handle, x0.ctypes.data, references.ctypes.data, disturbance.ctypes.data,
            weights.ctypes.data, bounds.ctypes.data)
        return status, self.library.rti_iterations(self._handle)


class InterpretedRti:
    """The same iteration without a compiler: CasADi's interpreter and HPIPM through ctypes."""

    def __init__(self, ocp: Ocp, intervals, soft, tolerance, max_iterations, reaches=0):
        """Allocate; arguments as for :class:`CompiledRti`."""
        n, size = len(intervals), ocp.state_size
        self._ocp, self._intervals = ocp, np.array(intervals, dtype=float)
        self.states, self.inputs = np.zeros((n + 1, size)), np.zeros((n, INPUT_SIZE))
        slack = [np.full(7, soft[0]), np.r_[soft[2], np.full(6, soft[1])]] if soft else None
        self._qp = OcpQp([0] + [size] * n, [INPUT_SIZE] * n + [0], [[]] + [BOUNDED_STATES] * n,
                         slack, tolerance, max_iterations,
                         self._lead_constraints(n, size, reaches))
        for k in range(1, n + 1):
            self._qp.set('ubx_mask', k, np.array(UPPER))
        self._reaches = reaches
        self._buffer, self._evaluate = ocp.stage.buffer()
        shapes = [ocp.stage.size_out(i) for i in range(ocp.stage.n_out())]
        flat = [np.zeros(rows * columns) for rows, columns in shapes]
        self._outputs = [array.reshape(shape, order='F') for array, shape in zip(flat, shapes)]
        self._inputs = [np.zeros(ocp.stage.numel_in(i)) for i in range(6)]
        for i, array in enumerate(self._inputs):
            self._buffer.set_arg(i, array.data)
        for i, array in enumerate(flat):
            self._buffer.set_res(i, array.data)

    def fill(self, x, u):
        """Store one state and one input over the whole horizon."""
        self.states[:], self.inputs[:] = x, u

    def shift(self, time: float):
        """As :meth:`CompiledRti.shift`."""
        part = time / self._intervals[:, None]
        self.states[:-1] += part * np.diff(self.states, axis=0)
        self.inputs[:-1] += part[:-1] * np.diff(self.inputs, axis=0)

    def step(self, x0, references, disturbance, weights, bounds) -> tuple[int, int]:
        """As :meth:`CompiledRti.step`."""
        qp, n = self._qp, len(self._intervals)
        x, u = self.states.copy(), self.inputs.copy()
        if x0[QUATERNION] @ x[0, QUATERNION] < 0:
            x[:, QUATERNION] *= -1
        x[0] = x0
        for k in range(n):
            f = self._linearise(x[k], u[k], disturbance, references[k], weights, k)
            qp.set('b', k, f.ravel() - x[k + 1])
            self._bound_inputs(k, x[k], u[k], disturbance, bounds)
        hessian, gradient = self._ocp.terminal(x[n], references[n], weights)
        qp.set('Q', n, np.array(hessian))
        qp.set('q', n, np.array(gradient).ravel())
        limit = np.r_[0.0, np.repeat(bounds[2 * INPUT_SIZE:2 * INPUT_SIZE + 2], 3)]
        for k in range(1, n + 1):
            low = -limit
            low[0] = bounds[2 * INPUT_SIZE + 1 + n + k]
            qp.set('lbx', k, low - x[k, BOUNDED_STATES])
            qp.set('ubx', k, limit - x[k, BOUNDED_STATES])
        status, iterations = qp.solve()
        for k in range(n):
            u[k] += qp.get('u', k, INPUT_SIZE)
            x[k + 1] += qp.get('x', k + 1, x.shape[1])
        if not (np.isfinite(x).all() and np.isfinite(u).all()):
            status = 3
        if status <= 1:
            self.states[:], self.inputs[:] = x, u
        return status, iterations

    @staticmethod
    def _lead_constraints(n, size, reaches):
        tilt_lead = np.zeros((4, size)), np.eye(4, INPUT_SIZE)
        tilt_lead[0][:, TILT] = -np.eye(4)
        return [tilt_lead if 0 < k <= reaches else None for k in range(n + 1)]

    def _bound_inputs(self, k, x, u, disturbance, bounds):
        lower, upper = bounds[:INPUT_SIZE] - u, bounds[INPUT_SIZE:2 * INPUT_SIZE] - u
        if k <= self._reaches:
            reach = bounds[2 * INPUT_SIZE + 2 + k]
            lead = u[:4] + disturbance[TILT_OFFSET] - x[TILT]
            if k > 0:
                self._qp.set('lg', k, -reach - lead)
                self._qp.set('ug', k, reach - lead)
            else:  # the first state is given: a bound on the input
                bottom, top = lower[:4].copy(), upper[:4].copy()
                lower[:4] = np.clip(-reach - lead, bottom, top)
                upper[:4] = np.clip(reach - lead, bottom, top)
        self._qp.set('lbu', k, lower)
        self._qp.set('ubu', k, upper)

    def _linearise(self, x, u, disturbance, reference, weights, k):
        values = (x, u, disturbance, reference, weights, self._intervals[k])
        for array, value in zip(self._inputs, values):
            array[:] = value
        self._evaluate()
        f, a, b, q_xx, r_uu, s_ux, q, r = self._outputs
        self._qp.set('B', k, b)
        self._qp.set('R', k, r_uu)
        self._qp.set('r', k, r.ravel())
        if k > 0:
            self._qp.set('A', k, a)
            self._qp.set('Q', k, q_xx)
            self._qp.set('S', k, s_ux)
            self._qp.set('q', k, q.ravel())
        return f


__all__ = ['BOUNDED_STATES', 'CompiledRti', 'InterpretedRti', 'REFERENCE_SIZE']
