"""The real-time iteration as machine code: generated stage functions plus rti.c, on HPIPM."""

from __future__ import annotations

import ctypes
from pathlib import Path

import casadi as ca

from beetle_omni_ros.robot.native import built, CompilerError, generated


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
