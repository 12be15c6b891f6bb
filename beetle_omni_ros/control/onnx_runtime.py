"""
The library that runs policies, without its telemetry.

From 1.29 on it leaves a file in the temporary folder, keeps threads of its own and reports to its
maker, unless a variable says otherwise when it is loaded.
"""

import os

OFF = 'ORT_DISABLE_TELEMETRY'


def load():
    """Import onnxruntime; a value that the user gave the variable stays."""
    os.environ.setdefault(OFF, '1')
    import onnxruntime
    return onnxruntime
