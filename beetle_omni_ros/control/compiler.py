"""Stage functions to machine code: generated C plus rti.c, compiled once and cached."""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
from pathlib import Path
import shutil
import subprocess
import tempfile

import casadi as ca

log = logging.getLogger(__name__)
FLAGS = ('-O2', '-fPIC', '-shared', '-std=gnu99', '-w')


class CompilerError(RuntimeError):
    """No usable C compiler, or it failed; the text says which and its first complaint."""


def casadi_folder() -> Path:
    """Folder of the casadi wheel, which ships HPIPM and BLASFEO with their headers."""
    return Path(ca.__file__).resolve().parent


def cache_folder() -> Path:
    """Where compiled solvers are kept: $XDG_CACHE_HOME (or ~/.cache) / beetle_omni_ros."""
    base = os.environ.get('XDG_CACHE_HOME') or os.path.join(os.path.expanduser('~'), '.cache')
    return Path(base) / 'beetle_omni_ros'


def generate(functions: list[ca.Function]) -> str:
    """C source of CasADi functions, each under its own name."""
    with tempfile.TemporaryDirectory() as folder:
        generator = ca.CodeGenerator('model.c', {'with_header': False})
        for function in functions:
            generator.add(function)
        generator.generate(folder + os.sep)
        return (Path(folder) / 'model.c').read_text()


def compiled_library(functions: list[ca.Function]) -> ctypes.CDLL:
    """
    Load the real-time iteration with these stage functions, compiling it if new.

    The cache key covers the generated code (and with it model and options), rti.c,
    the compiler, its flags and the casadi version.

    Raises:
        CompilerError: no compiler, no write access to a cache, or compilation failed.

    """
    compiler = os.environ.get('CC') or shutil.which('gcc') or shutil.which('cc')
    if not compiler or not shutil.which(compiler.split()[0]):
        raise CompilerError('no C compiler found (looked for $CC, gcc, cc)')
    rti = (Path(__file__).parent / 'rti.c').read_text()
    source = generate(functions) + '\n' + rti
    key = '\n'.join((source, compiler, ' '.join(FLAGS), ca.__version__, str(casadi_folder())))
    name = f'nmpc_{hashlib.sha256(key.encode()).hexdigest()[:20]}.so'
    library = cache_folder() / name
    if not library.is_file():
        _compile(compiler.split(), source, library)
    return _load(library)


def _compile(compiler, source, library):
    folder = casadi_folder()
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=library.parent) as build:
            path = Path(build) / 'nmpc.c'
            path.write_text(source)
            output = Path(build) / library.name
            command = [*compiler, *FLAGS, str(path), '-o', str(output), f'-I{folder}/include',
                       f'-L{folder}', '-l:libhpipm.so', '-l:libblasfeo.so.0', '-lm',
                       f'-Wl,-rpath,{folder}']
            log.info('compiling the NMPC (once for this model and these options)')
            done = subprocess.run(command, capture_output=True, text=True, timeout=300)
            if done.returncode:
                lines = done.stderr.strip().splitlines() or ['no message']
                raise CompilerError(f'{compiler[0]} failed: {lines[0]}')
            os.replace(output, library)  # atomic: another process may build the same
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CompilerError(f'cannot build in {library.parent}: {error}') from None


def _load(library: Path) -> ctypes.CDLL:
    # HPIPM names BLASFEO only by soname; having it loaded first resolves that anywhere.
    try:
        ctypes.CDLL(str(casadi_folder() / 'libblasfeo.so.0'), mode=ctypes.RTLD_GLOBAL)
        return ctypes.CDLL(str(library))
    except OSError as error:
        raise CompilerError(f'cannot load {library}: {error}') from None
