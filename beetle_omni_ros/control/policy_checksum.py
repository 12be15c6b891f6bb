"""
The checksum of a policy file: ``python -m beetle_omni_ros.control.policy_checksum FILE`` adds it.

A flipped bit in a weight changes the policy, but the file still loads. The checksum covers the
ONNX file without its metadata: graph, weights, versions of the operators. It is stored in the
metadata. The module parses only the outermost layer of the file, so that no other package is
needed.
"""

from collections.abc import Iterator
import hashlib
from pathlib import Path
import sys

from beetle_omni_ros.robot.schema import ParameterError

KEY = 'checksum'
METADATA = 14           # field of ONNX's ModelProto; its entries have key (1) and value (2)
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5    # wire types of protobuf
LARGEST = 1 << 28       # bytes of a file; the shipped ones have 0.8 MB
MODULE = 'beetle_omni_ros.control.policy_checksum'
ADD = f'python -m {MODULE} FILE adds it to a file that you trust'


def checksum(data: bytes) -> str:
    """
    Checksum of an ONNX file's content without its metadata, as text.

    Raises:
        ParameterError: it is no ONNX file.

    """
    digest = hashlib.sha256()
    for field, whole, _ in fields(data):
        if field != METADATA:
            digest.update(whole)
    return f'sha256:{digest.hexdigest()}'


def stored(data: bytes) -> str | None:
    """Checksum in the metadata of an ONNX file; None: there is none."""
    found = None
    for field, _, value in fields(data):
        if field == METADATA:
            entry = {number: bytes(part) for number, _, part in fields(value)}
            if entry.get(1) == KEY.encode():
                found = entry.get(2, b'').decode(errors='replace')
    return found


def verify(data: bytes) -> bool:
    """
    Compare an ONNX file's content with the checksum in it.

    Returns:
        Whether there is one.

    Raises:
        ParameterError: they differ, or it is no ONNX file.

    """
    written = stored(data)
    if written is not None and written != checksum(data):
        raise ParameterError('weights or graph are not those that were exported: their checksum '
                             f"differs from the metadata's '{KEY}'; take an undamaged copy")
    return written is not None


def add(path: str | Path) -> str:
    """
    Write the checksum into a file without one; the rest of the file is unchanged.

    Returns:
        the checksum.

    Raises:
        ParameterError: no ONNX file, not writable, or another checksum is in it.

    """
    path = Path(path)
    try:
        data = path.read_bytes()
        text = checksum(data)
        if not verify(data):
            part = path.with_name(f'{path.name}.part')
            part.write_bytes(data + _field(METADATA, _field(1, KEY.encode())
                                           + _field(2, text.encode())))
            part.replace(path)
    except OSError as error:
        raise ParameterError(f'policy {path}: {error.strerror}') from None
    except ParameterError as error:
        raise ParameterError(f'policy {path}: {error}') from None
    return text


def fields(data: bytes | memoryview) -> Iterator[tuple[int, memoryview, memoryview]]:
    """
    Walk the fields of one protobuf message.

    Yields:
        (number, bytes of the whole field, bytes of its value).

    Raises:
        ParameterError: the bytes are no message.

    """
    view, at = memoryview(data), 0
    while at < len(view):
        begin = at
        tag, at = _varint(view, at)
        kind = tag & 7
        if kind == BYTES:
            length, at = _varint(view, at)
        elif kind in (FIXED32, FIXED64):
            length = 8 if kind == FIXED64 else 4
        elif kind == VARINT:
            length = _varint(view, at)[1] - at
        else:
            raise _unreadable()
        if at + length > len(view) or not tag >> 3:
            raise _unreadable()
        yield tag >> 3, view[begin:at + length], view[at:at + length]
        at += length


def _varint(view, at):
    """(value, position behind it) of a number of seven bits a byte."""
    value = 0
    for k in range(10):
        if at + k >= len(view):
            break
        value |= (view[at + k] & 127) << 7 * k
        if view[at + k] < 128:
            return value, at + k + 1
    raise _unreadable()


def _field(number, value):
    """One field with bytes as its value."""
    return _number(number << 3 | BYTES) + _number(len(value)) + value


def _number(value):
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def _unreadable():
    return ParameterError('not a readable ONNX file, possibly truncated')


def main(paths: list[str]) -> int:
    """Add checksums; exit status 0, or 2 with one line about an unusable file."""
    if not paths or paths[0].startswith('-'):
        print(f'usage: python -m {MODULE} FILE...', file=sys.stderr)
        return 2
    try:
        for path in paths:
            print(f'{path}: {add(path)}')
    except ParameterError as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
