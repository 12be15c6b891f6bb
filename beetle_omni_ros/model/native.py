"""Compilation of CasADi functions: generated C code, compiled once and cached."""

from collections.abc import Callable, Sequence
import hashlib
import logging
import os
from pathlib import Path
import shutil
import subprocess
import tempfile

import casadi as ca
import numpy as np

from beetle_omni_ros.model.schema import RunError

log = logging.getLogger(__name__)
FLAGS = ('-O2', '-fPIC', '-shared', '-std=gnu99', '-w')
EXACT = ('-ffp-contract=off', '-lm')     # rounds each operation, as CasADi's interpreter does


def generated(functions: Sequence[ca.Function]) -> str:
    """C source of CasADi functions, each under its own name."""
    with tempfile.TemporaryDirectory() as folder:
        generator = ca.CodeGenerator('model.c', {'with_header': False})
        for function in functions:
            generator.add(function)
        generator.generate(folder + os.sep)
        return (Path(folder) / 'model.c').read_text()


def built(name: str, source: str, options: Sequence[str] = ()) -> Path:
    """
    Compile C source to a shared library, unless the cache has it.

    The cache is $XDG_CACHE_HOME (or ~/.cache) / beetle_omni_ros. Its key covers the source, the
    compiler, its flags and the casadi version. The library's file name begins with ``name``.
    ``options`` are compiler options after ``FLAGS`` and the source file.
    """
    compiler = os.environ.get('CC') or shutil.which('gcc') or shutil.which('cc')
    if not compiler or not shutil.which(compiler.split()[0]):
        raise RunError('no C compiler found (looked for $CC, gcc, cc)')
    key = '\n'.join((source, compiler, ' '.join((*FLAGS, *options)), ca.__version__))
    digest = hashlib.sha256(key.encode()).hexdigest()[:20]
    cache = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache')
    library = cache / 'beetle_omni_ros' / f'{name}_{digest}.so'
    if library.is_file():
        return library
    command = compiler.split()
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=library.parent) as build:
            path, output = Path(build) / 'source.c', Path(build) / library.name
            path.write_text(source)
            log.info('compiling %s (once for this model and these options)', library.stem)
            done = subprocess.run([*command, *FLAGS, str(path), '-o', str(output), *options],
                                  capture_output=True, text=True, timeout=300)
            if done.returncode:
                lines = done.stderr.strip().splitlines() or ['no message']
                raise RunError(f'{command[0]} failed: {lines[0]}')
            os.replace(output, library)  # atomic, because other processes may build the same
    except (OSError, subprocess.TimeoutExpired) as error:
        raise RunError(f'cannot build in {library.parent}: {error}') from None
    return library


def compiled(function: ca.Function) -> ca.Function:
    """
    Compile a function; without a usable compiler, return the function itself.

    The results are equal to the last digit. CasADi's interpreter takes about six times as long.
    """
    try:
        return ca.external(function.name(),
                           str(built(function.name(), generated([function]), EXACT)))
    except RuntimeError as error:     # also of CasADi, which cannot load it
        log.info('%s stays interpreted: %s', function.name(), str(error).splitlines()[0])
        return function


def buffered(function: ca.Function) -> Callable[..., np.ndarray]:
    """Make a fast call of a CasADi function of vectors: numpy arrays in fixed buffers."""
    buffer, evaluate = function.buffer()
    arguments = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
    result = np.zeros(function.numel_out(0))
    for i, array in enumerate(arguments):
        buffer.set_arg(i, array.data)
    buffer.set_res(0, result.data)

    def call(*values) -> np.ndarray:
        for array, value in zip(arguments, values):
            array[:] = value
        evaluate()
        return result.copy()

    call.__dict__['buffer'] = buffer    # `evaluate` has its address only
    return call
