"""Fingerprint of everything that determines the numbers of a flight."""

from functools import cache
import hashlib
from importlib import metadata
import inspect
from pathlib import Path
import platform
import subprocess

from beetle_omni_ros.comparison.plan import Flight
from beetle_omni_ros.control import registry
from beetle_omni_ros.robot.resources import PACKAGE, share_path

ROOMS = ('control', 'estimation', 'evaluation', 'robot', 'runs', 'safety', 'sim')
LIBRARIES = ('casadi', 'filterpy', 'mujoco', 'numpy', 'onnxruntime', 'scipy')
# Files and folders that only policies read.
OF_POLICIES = ('control/guidance', 'control/observation.py', 'control/policy.py',
               'control/policy_file.py', 'control/policy_network.py', 'params/rl.yaml')
NOT_FLOWN = ('gap.yaml', 'train.yaml')  # parameters that no flight reads
LENGTH = 16  # hexadecimal digits kept


@cache
def code_fingerprint(policy: bool = True, beside: tuple[str, ...] = ()) -> str:
    """
    Digest of code, parameters and libraries of flights and their metrics.

    Args:
        policy: whether to include the code and parameters that only policies use.
        beside: further folders of the package.

    """
    package = Path(__file__).resolve().parents[1]
    files = [path for room in (*ROOMS, *beside) for path in (package / room).rglob('*.*')
             if path.suffix in ('.py', '.c', '.h')]
    files += [package / 'comparison' / 'flight.py']
    files += [path for path in share_path('params').glob('*.yaml') if path.name not in NOT_FLOWN]
    if not policy:
        files = [path for path in files if not is_of_policies(path)]
    digest = hashlib.sha256()
    for path in sorted(files, key=lambda path: (path.parent.name, path.name)):
        digest.update(f'{path.parent.name}/{path.name}'.encode())
        digest.update(path.read_bytes())
    for library in LIBRARIES:
        digest.update(f'{library} {_version(library)}'.encode())
    digest.update(f'{platform.machine()} {platform.python_version()}'.encode())
    return digest.hexdigest()[:LENGTH]


def is_of_policies(path: Path) -> bool:
    """Whether only policies use a file."""
    there = f"/{'/'.join(path.parts[-3:])}"
    return any(there.endswith(f'/{part}') or f'/{part}/' in there for part in OF_POLICIES)


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


def own_code(controller: str) -> str:
    """Digest of the code of a controller outside the package; '' for a shipped one."""
    if controller in registry.SHIPPED:
        return ''
    file = Path(inspect.getfile(registry.find(controller).builder()))
    top = file.parent
    while (top / '__init__.py').is_file():
        top = top.parent
    files = [file] if top == file.parent else sorted(
        (top / file.relative_to(top).parts[0]).rglob('*.py'))
    return ' '.join(file_digest(path) for path in files)


def flight_key(flight: Flight) -> str:
    """Digest of everything that determines a flight's numbers."""
    entry, own = registry.find(flight.reference), own_code(flight.reference)
    parts = [code_fingerprint(bool(entry.policy_file or own)), flight.reference,
             flight.conditions, str(flight.seed)]
    parts += [own] if own else []
    is_file = Path(flight.task).is_file()
    parts.append(file_digest(flight.task) if is_file else flight.task)
    if policy := policy_file(flight.reference, flight.policy):
        parts.append(file_digest(policy))
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
