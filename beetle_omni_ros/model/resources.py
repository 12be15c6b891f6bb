"""Location of the package's data files in a checkout, a pip or a colcon installation."""

import os
from pathlib import Path
import subprocess
import sys

PACKAGE = 'beetle_omni_ros'
CHECKOUT = Path(__file__).resolve().parents[2]


def share_path(relative: str) -> Path:
    """
    Locate a shipped file such as ``params/robot.yaml``.

    The order is: source checkout, prefixes of ``AMENT_PREFIX_PATH`` (colcon, apt), prefix of the
    Python environment (pip). Edits of a parameter file in a checkout thus take effect at once.
    """
    roots = [CHECKOUT]
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        if prefix:
            roots.append(Path(prefix) / 'share' / PACKAGE)
    roots.append(Path(sys.prefix) / 'share' / PACKAGE)
    # prefix/lib/pythonX.Y/site-packages/beetle_omni_ros/model/resources.py
    roots += [prefix / 'share' / PACKAGE for prefix in Path(__file__).resolve().parents[5:6]]
    for root in roots:
        if (root / 'package.xml').is_file() and (root / relative).exists():
            return root / relative
    looked = ', '.join(str(root) for root in roots)
    raise FileNotFoundError(f'{relative}: not found in any installation of {PACKAGE} ({looked})')


def commit() -> str | None:
    """Commit of the checkout, with '+' if files are changed; None outside a checkout."""
    if not (CHECKOUT / '.git').exists():
        return None
    try:
        return subprocess.run(
            ['git', 'describe', '--always', '--abbrev=10', '--dirty=+', '--exclude=*'],
            cwd=CHECKOUT, capture_output=True, text=True, timeout=20,
            check=True).stdout.strip() or None
    except (OSError, subprocess.SubprocessError):
        return None
