"""Fingerprint of everything that determines the numbers of a flight."""

import ast
from functools import cache
import hashlib
from importlib import metadata
import inspect
from pathlib import Path
import platform
import re
import subprocess

from beetle_omni_ros.comparison.plan import Flight
from beetle_omni_ros.control import registry
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import PACKAGE, share_path

LIBRARIES = ('casadi', 'filterpy', 'mujoco', 'numpy', 'onnxruntime', 'scipy')
SOURCE = Path(__file__).resolve().parents[1]
COMPARED = (SOURCE / 'comparison' / 'flight.py',)
LENGTH = 16  # hexadecimal digits kept
# How a module names the shipped parameter file that it reads.
READ = re.compile(r"\bfile='([\w.]+\.yaml)'|share_path\('params/([\w.]+)'\)")


@cache
def code_fingerprint(controller: str | None = None,
                     flown_by: tuple[Path, ...] = COMPARED) -> str:
    """
    Digest of code, parameters and libraries of flights and their metrics.

    Args:
        controller: the shipped controller that flies; None: any of them.
        flown_by: modules that fly and judge.

    """
    digest = hashlib.sha256()
    for path in flown_files(controller, flown_by):
        digest.update(f'{path.parent.name}/{path.name}'.encode())
        digest.update(path.read_bytes())
    for library in LIBRARIES:
        digest.update(f'{library} {_version(library)}'.encode())
    digest.update(f'{platform.machine()} {platform.python_version()}'.encode())
    return digest.hexdigest()[:LENGTH]


def flown_files(controller: str | None = None,
                flown_by: tuple[Path, ...] = COMPARED) -> list[Path]:
    """Modules that flights import, directly or not, and the parameter files that these name."""
    entries = [registry.SHIPPED[controller]] if controller else list(registry.SHIPPED.values())
    modules = {str(reference).partition(':')[0]
               for entry in entries for reference in (entry.controller, entry.parameters)}
    left, code = [*flown_by, *filter(None, map(_module, modules))], {Path(__file__).resolve()}
    while left:
        path = left.pop()
        if path not in code:
            code.add(path)
            left += filter(None, map(_module, _imports(path)))
    code.remove(Path(__file__).resolve())
    parameters = {name for path in code for names in READ.findall(path.read_text('utf-8'))
                  for name in names if name}
    parameters |= {Path(entry.parameters_file).name for entry in entries}
    compiled = [file for path in code for file in path.parent.glob(f'{path.stem}.[ch]')]
    return sorted([*code, *compiled, *(share_path('params') / name for name in parameters)],
                  key=lambda path: (path.parent.name, path.name))


def _module(name: str) -> Path | None:
    """File of a module of the package; None for other modules, and for names in a module."""
    if name.partition('.')[0] != PACKAGE:
        return None
    place = SOURCE.joinpath(*name.split('.')[1:])
    return next((path for path in (place.with_suffix('.py'), place / '__init__.py')
                 if place != SOURCE and path.is_file()), None)


@cache
def _imports(path: Path) -> list[str]:
    """Names that a file imports, also inside functions."""
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [f'{node.module}', *(f'{node.module}.{alias.name}' for alias in node.names)]
    return names


def _version(library):
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return 'absent'


def file_digest(path: str | Path) -> str:
    """Digest of a file's content; 'absent' without the file."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:LENGTH]
    except OSError:
        return 'absent'


def policy_file(controller: str, other: str | Path | None = None) -> Path | None:
    """
    Locate a controller's policy.

    Args:
        controller: name or class, as in the registry.
        other: file that replaces the shipped policy, for the controller of `--policy`.

    Returns:
        None if the controller needs no policy or its file is absent.

    """
    if controller == registry.owner('--policy') and other:
        return Path(other)
    shipped = registry.find(controller).policy_file
    try:
        return share_path(shipped) if shipped else None
    except FileNotFoundError:
        return None


def own_files(controller: str) -> tuple[Path, ...]:
    """Code of a controller outside the package; nothing for a shipped one."""
    if controller in registry.SHIPPED:
        return ()
    file = Path(inspect.getfile(registry.find(controller).builder()))
    top = file.parent
    while (top / '__init__.py').is_file():
        top = top.parent
    return (file,) if top == file.parent else tuple(sorted(
        (top / file.relative_to(top).parts[0]).rglob('*.py')))


def flight_key(flight: Flight) -> str:
    """Digest of everything that determines a flight's numbers."""
    own = own_files(flight.reference)
    parts = [code_fingerprint(None if own else flight.reference, (*COMPARED, *own)),
             flight.reference, flight.conditions, str(flight.seed),
             *(file_digest(path) for path in own)]      # anew, because it may change meanwhile
    is_file = Path(flight.task).is_file()
    parts.append(file_digest(flight.task) if is_file else flight.task)
    if policy := policy_file(flight.reference, flight.policy):
        parts.append(file_digest(policy))
    if flight.plant:
        parts.append(RobotParameters.load(flight.plant).hash())
    return hashlib.sha256('\n'.join(parts).encode()).hexdigest()[:LENGTH]


def commit() -> str | None:
    """Commit of the checkout, with '+' if files are changed; None outside a checkout."""
    folder = Path(__file__).resolve().parents[2]
    if not (folder / '.git').exists():
        return None
    try:
        text = subprocess.run(
            ['git', 'describe', '--always', '--abbrev=10', '--dirty=+', '--exclude=*'],
            cwd=folder, capture_output=True, text=True, timeout=20, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        return None
    return text.strip() or None


def versions() -> dict[str, str]:
    """Versions of the package, Python and the libraries."""
    return {PACKAGE: _version(PACKAGE), 'python': platform.python_version(),
            **{library: _version(library) for library in LIBRARIES}}
