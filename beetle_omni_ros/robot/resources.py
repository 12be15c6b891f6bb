"""Location of the package's data files: a checkout, a pip or a colcon installation."""

import os
from pathlib import Path
import sys

PACKAGE = 'beetle_omni_ros'


def share_path(relative: str) -> Path:
    """
    Locate a shipped file such as ``params/robot.yaml``.

    The order is: source checkout, prefixes of ``AMENT_PREFIX_PATH`` (colcon, apt), prefix of the
    Python environment (pip). Edits of a parameter file in a checkout thus take effect at once.
    """
    roots = [Path(__file__).resolve().parents[2]]
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        if prefix:
            roots.append(Path(prefix) / 'share' / PACKAGE)
    roots.append(Path(sys.prefix) / 'share' / PACKAGE)
    # prefix/lib/pythonX.Y/site-packages/beetle_omni_ros/robot/resources.py
    roots += [prefix / 'share' / PACKAGE for prefix in Path(__file__).resolve().parents[5:6]]
    for root in roots:
        if (root / 'package.xml').is_file() and (root / relative).exists():
            return root / relative
    looked = ', '.join(str(root) for root in roots)
    raise FileNotFoundError(f'{relative}: not found in any installation of {PACKAGE} ({looked})')
