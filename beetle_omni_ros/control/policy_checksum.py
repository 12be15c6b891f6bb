"""
The checksum of a policy file: ``python -m beetle_omni_ros.control.policy_checksum FILE`` adds it.

A flipped bit in a weight changes the policy, but the file still loads. The checksum covers every
byte of the ONNX file except its own entry in the metadata.
"""

import hashlib
from pathlib import Path
import sys

from beetle_omni_ros.robot.schema import ParameterError

KEY = 'checksum'
# The entry as ONNX's protobuf stores it; DIGITS hexadecimal digits follow.
ENTRY, DIGITS = b'rS\n\x08checksum\x12Gsha256:', 64
ADD = 'python -m beetle_omni_ros.control.policy_checksum FILE adds it to a file that you trust'


def verify(data: bytes) -> bool:
    """
    Compare an ONNX file's content with the checksum in it.

    Returns:
        Whether there is one.

    Raises:
        ParameterError: they differ.

    """
    before, entry, after = data.rpartition(ENTRY)
    if entry and after[:DIGITS] != _digest(before + after[DIGITS:]):
        raise ParameterError('weights, graph or metadata are not those that were exported: their '
                             f"checksum differs from the metadata's '{KEY}'; take an undamaged "
                             'copy')
    return bool(entry)


def add(path: str | Path) -> None:
    """
    Write the checksum into a file, in place of an older one; the rest is unchanged.

    Raises:
        ParameterError: not readable or not writable.

    """
    path = Path(path)
    try:
        data = path.read_bytes()
        before, entry, after = data.rpartition(ENTRY)
        if entry:
            data = before + after[DIGITS:]
        part = path.with_name(f'{path.name}.part')
        part.write_bytes(data + ENTRY + _digest(data))
        part.replace(path)
    except OSError as error:
        raise ParameterError(f'policy {path}: {error.strerror}') from None


def _digest(data):
    return hashlib.sha256(data).hexdigest().encode()


if __name__ == '__main__':
    try:
        for name in sys.argv[1:]:
            add(name)
    except ParameterError as failure:
        sys.exit(f'error: {failure}')
