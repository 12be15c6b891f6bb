"""
Import of onnxruntime without its telemetry.

From version 1.29 on it writes a file into the temporary folder, starts threads and sends reports
to its vendor, unless an environment variable is set when it is loaded.
"""

import os

OFF = 'ORT_DISABLE_TELEMETRY'


def load():
    """Import onnxruntime; a value of the variable set by the user is kept."""
    os.environ.setdefault(OFF, '1')
    import onnxruntime
    return onnxruntime
