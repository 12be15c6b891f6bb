"""A thin ctypes binding of HPIPM's optimal-control QP, as shipped in the casadi wheel."""

import ctypes
from ctypes import byref, c_double, c_int, c_size_t, c_void_p
from pathlib import Path

import casadi as ca
import numpy as np

from beetle_omni_ros.robot.native import built, CompilerError, generated

SPEED_MODE = 1  # enum hpipm_mode


def casadi_folder() -> Path:
    """Folder of the casadi wheel, which ships HPIPM and BLASFEO with their headers."""
    return Path(ca.__file__).resolve().parent


def compiled_library(functions: list[ca.Function]) -> ctypes.CDLL:
    """
    Load the real-time iteration with these stage functions, compiling it if new.

    Raises:
        CompilerError: no compiler, no write access to a cache, or compilation failed.

    """
    rti = (Path(__file__).parent / 'rti.c').read_text()
    folder = casadi_folder()
    return _load(built('nmpc', generated(functions) + '\n' + rti, (
        f'-I{folder}/include', f'-L{folder}', '-l:libhpipm.so', '-l:libblasfeo.so.0', '-lm',
        f'-Wl,-rpath,{folder}')))


def _load(library: Path) -> ctypes.CDLL:
    # HPIPM names BLASFEO only by soname; having it loaded first resolves that anywhere.
    try:
        ctypes.CDLL(str(casadi_folder() / 'libblasfeo.so.0'), mode=ctypes.RTLD_GLOBAL)
        return ctypes.CDLL(str(library))
    except OSError as error:
        raise CompilerError(f'cannot load {library}: {error}') from None


def _library():
    ctypes.CDLL(str(casadi_folder() / 'libblasfeo.so.0'), mode=ctypes.RTLD_GLOBAL)
    library = ctypes.CDLL(str(casadi_folder() / 'libhpipm.so'))
    for name in ('dim', '', 'sol', 'ipm_arg', 'ipm_ws'):
        for what in ('strsize', 'memsize'):
            getattr(library, '_'.join(p for p in ('d_ocp_qp', name, what) if p)).restype = c_size_t
    return library


def _pointer(array):
    return array.ctypes.data_as(c_void_p)


class OcpQp:
    """
    One QP over stages: minimise sum of quadratic stage costs subject to linear dynamics.

    Args:
        state_sizes: N + 1 state dimensions.
        input_sizes: N + 1 input dimensions, the last one 0.
        state_bounds: N + 1 lists of bounded state indices.
        soft: linear and quadratic slack weights of the state bounds, or None for hard ones.
        tolerance: residual at which the interior-point method stops.
        max_iterations: its iteration limit.
        general: N + 1 pairs of matrices (C on the state, D on the input), or None.

    """

    def __init__(self, state_sizes, input_sizes, state_bounds, soft, tolerance, max_iterations,
                 general):
        self._lib = lib = _library()
        self._memory = []
        horizon = len(state_sizes) - 1
        self.dim = self._allocate(lib.d_ocp_qp_dim_strsize())
        lib.d_ocp_qp_dim_create(horizon, self.dim,
                                self._allocate(lib.d_ocp_qp_dim_memsize(horizon)))
        for k in range(horizon + 1):
            for field, value in (('nx', state_sizes[k]), ('nu', input_sizes[k]),
                                 ('nbx', len(state_bounds[k])), ('nbu', input_sizes[k]),
                                 ('ng', len(general[k][0]) if general[k] else 0),
                                 ('ns', len(state_bounds[k]) if soft else 0)):
                getattr(lib, f'd_ocp_qp_dim_set_{field}')(k, int(value), self.dim)
        self.qp = self._create('d_ocp_qp', self.dim)
        self.sol = self._create('d_ocp_qp_sol', self.dim)
        self.arg = self._create('d_ocp_qp_ipm_arg', self.dim)
        lib.d_ocp_qp_ipm_arg_set_default(SPEED_MODE, self.arg)
        lib.d_ocp_qp_ipm_arg_set_iter_max(byref(c_int(max_iterations)), self.arg)
        for name in ('stat', 'eq', 'ineq', 'comp'):
            getattr(lib, f'd_ocp_qp_ipm_arg_set_tol_{name}')(byref(c_double(tolerance)), self.arg)
        self.ws = self._create('d_ocp_qp_ipm_ws', self.dim, self.arg)
        self._set_structure(input_sizes, state_bounds, soft)
        for k, pair in enumerate(general):
            if pair:
                self.set('C', k, pair[0])
                self.set('D', k, pair[1])

    def _allocate(self, size):
        buffer = np.zeros(int(size) + 128, dtype=np.uint8)
        self._memory.append(buffer)
        return c_void_p((buffer.ctypes.data + 63) // 64 * 64)

    def _create(self, kind, *shape):
        struct = self._allocate(getattr(self._lib, f'{kind}_strsize')())
        memory = self._allocate(getattr(self._lib, f'{kind}_memsize')(*shape))
        getattr(self._lib, f'{kind}_create')(*shape, struct, memory)
        return struct

    def _set_structure(self, input_sizes, state_bounds, soft):
        for k, bounded in enumerate(state_bounds):
            self._set_int('idxbu', k, range(input_sizes[k]))
            self._set_int('idxbx', k, bounded)
            if soft and bounded:
                self._set_int('idxs', k, [input_sizes[k] + i for i in range(len(bounded))])
                for name, value in (('zl', soft[0]), ('zu', soft[0]), ('Zl', soft[1]),
                                    ('Zu', soft[1]), ('lls', 0.0), ('lus', 0.0)):
                    self.set(name, k, np.broadcast_to(value, len(bounded)))

    def _set_int(self, field, stage, values):
        array = np.array(list(values), dtype=np.int32)
        if array.size:
            getattr(self._lib, f'd_ocp_qp_set_{field}')(stage, _pointer(array), self.qp)

    def set(self, field: str, stage: int, value: np.ndarray) -> None:
        """Set one matrix or vector of one stage, by HPIPM's name for it."""
        array = np.asfortranarray(value, dtype=float)
        getattr(self._lib, f'd_ocp_qp_set_{field}')(stage, _pointer(array), self.qp)

    def solve(self) -> tuple[int, int]:
        """Solve; return HPIPM's status (0 solved) and its iterations."""
        status, iterations = c_int(), c_int()
        self._lib.d_ocp_qp_ipm_solve(self.qp, self.sol, self.arg, self.ws)
        self._lib.d_ocp_qp_ipm_get_status(self.ws, byref(status))
        self._lib.d_ocp_qp_ipm_get_iter(self.ws, byref(iterations))
        return status.value, iterations.value

    def get(self, field: str, stage: int, size: int) -> np.ndarray:
        """Part 'x' or 'u' of the solution at one stage."""
        out = np.zeros(size)
        getattr(self._lib, f'd_ocp_qp_sol_get_{field}')(stage, self.sol, _pointer(out))
        return out
