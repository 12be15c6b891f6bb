"""Fast calls of one CasADi function with numpy arrays, compiled or interpreted."""

import ctypes

import casadi as ca
import numpy as np

_POINTERS = ctypes.POINTER(ctypes.c_double)


class FunctionCall:
    """
    A CasADi function of vectors with fixed buffers.

    Args:
        function: with vector inputs and one vector output.
        library: with the function's generated code, or None to interpret it.

    """

    def __init__(self, function: ca.Function, library: ctypes.CDLL | None):
        self._arguments = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
        self._result = np.zeros(function.numel_out(0))
        if library is None:
            self._buffer, self._evaluate = function.buffer()
            for i, array in enumerate(self._arguments):
                self._buffer.set_arg(i, array.data)
            self._buffer.set_res(0, self._result.data)
            return
        count = len(self._arguments)
        self._pointers = (_POINTERS * count)(*[a.ctypes.data_as(_POINTERS)
                                              for a in self._arguments])
        self._results = (_POINTERS * 1)(self._result.ctypes.data_as(_POINTERS))
        symbol = getattr(library, function.name())
        self._evaluate = lambda: symbol(self._pointers, self._results, None, None, 0)

    def __call__(self, *values) -> np.ndarray:
        """The result for these arguments, a fresh array."""
        for array, value in zip(self._arguments, values):
            array[:] = value
        self._evaluate()
        return self._result.copy()
