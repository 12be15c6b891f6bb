"""
Real-time iteration: one Gauss-Newton QP a cycle around a stored, shifted trajectory.

The iteration is in rti.c and compiled together with the stage functions. The QP is solved by
HPIPM, which the casadi wheel contains with BLASFEO and the headers of both.
"""

import ctypes
from ctypes import c_double, c_int, c_void_p, POINTER
from pathlib import Path

import casadi as ca
import numpy as np

from beetle_omni_ros.control.ocp import INPUT_SIZE, Ocp
from beetle_omni_ros.robot.native import built, generated

FOLDER = Path(ca.__file__).resolve().parent
OPTIONS = (f'-I{FOLDER}/include', f'-L{FOLDER}', '-l:libhpipm.so', '-l:libblasfeo.so.0', '-lm',
           f'-Wl,-rpath,{FOLDER}')
_DOUBLES = POINTER(c_double)


class Rti:
    """
    The compiled iteration; a call costs a fraction of a millisecond.

    Args:
        ocp: stage functions.
        intervals: (N,) interval lengths [s].
        soft: linear weight of the slacks, quadratic weight on velocity and rate, quadratic weight
            on the height; or None.
        tolerance: residual at which the QP counts as solved.
        max_iterations: of the QP.
        reaches: number of intervals after the first in which the lead of tilt targets is bounded.

    Raises:
        RunError: there is no usable compiler.

    """

    def __init__(self, ocp: Ocp, intervals, soft, tolerance, max_iterations, reaches=0):
        # HPIPM names BLASFEO only by soname; having it loaded first resolves that anywhere.
        ctypes.CDLL(str(FOLDER / 'libblasfeo.so.0'), mode=ctypes.RTLD_GLOBAL)
        source = generated([ocp.stage, ocp.terminal])
        source += '\n' + Path(__file__).with_name('rti.c').read_text()
        self._library = lib = ctypes.CDLL(str(built('nmpc', source, OPTIONS)))
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
            self._library.rti_free(self._handle)
            self._handle = None

    def fill(self, x, u):
        """Store one state and one input over the whole horizon."""
        self.states[:], self.inputs[:] = x, u

    def shift(self, time: float):
        """Move the stored trajectory forward by ``time`` [s], at most the shortest interval."""
        self._library.rti_shift(self._handle, time)

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
        status = self._library.rti_step(
            self._handle, x0.ctypes.data, references.ctypes.data, disturbance.ctypes.data,
            weights.ctypes.data, bounds.ctypes.data)
        return status, self._library.rti_iterations(self._handle)
