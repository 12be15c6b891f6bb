"""What every test shares: checked ROS message fields, and the helper modules of each folder."""

import os
from pathlib import Path
import sys

import pytest

# Jazzy writes a scalar field of a wrong type as garbage unless this is set before the import.
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')

# Appended, so that no helper can shadow an installed module.
for folder in sorted(Path(__file__).parent.iterdir()):
    if folder.is_dir() and folder.name != '__pycache__':
        sys.path.append(str(folder))

# Flights, buses and devices in real time, some with limits of milliseconds: a computer that stops
# for a moment, as shared ones do, fails them for no fault of the code. They get a second chance,
# which the summary names (R); what is broken fails twice.
REAL_TIME = ('nodes', 'drivers', 'bringup', 'sim')


def pytest_collection_modifyitems(items):
    """Give tests that run in real time a second chance."""
    for item in items:
        if Path(item.path).parent.name in REAL_TIME:
            item.add_marker(pytest.mark.flaky(reruns=1))
