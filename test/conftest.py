"""What every test shares: checked ROS message fields, and the helper modules of each folder."""

import os
from pathlib import Path
import sys

# Jazzy writes a scalar field of a wrong type as garbage unless this is set before the import.
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')

# Appended, so that no helper can shadow an installed module.
for folder in sorted(Path(__file__).parent.iterdir()):
    if folder.is_dir() and folder.name != '__pycache__':
        sys.path.append(str(folder))
