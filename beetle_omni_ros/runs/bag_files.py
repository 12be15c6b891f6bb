"""Reading of the MCAP files of a rosbag2 folder without ROS, also of truncated files."""

from collections.abc import Iterable, Iterator
from io import BytesIO
from pathlib import Path
import struct
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import get_chunk_data_stream, MAGIC_SIZE, StreamReader
from mcap.writer import MCAP0_MAGIC
import numpy as np

from beetle_omni_ros.messages.conversions import from_nanoseconds

AT_ONCE = 4096      # messages outside chunks that are passed on together
LENGTH = struct.Struct('<Q')
DECLARED = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel}
PREFIX = 9          # bytes of a record before its content: kind and length
HEAD = np.dtype([('channel', '<u2'), ('sequence', '<u4'), ('log_time', '<u8'),
                 ('publish_time', '<u8')])      # of the content of a message, before its data


class BagError(ValueError):
    """A bag cannot be written or read; the text names the folder or file."""


class RawMessage(NamedTuple):
    """One message: full topic, ROS type, CDR, time of recording [s]."""

    topic: str
    type: str
    data: bytes
    received: float


class Messages(NamedTuple):
    """Messages of one topic in the order of the file: CDR, (N,) times of recording [s]."""

    topic: str
    type: str
    data: list[bytes]
    received: np.ndarray


class _WholeReads:
    """A stream whose reads are complete or raise EOFError, to detect the end of a cut file."""

    def __init__(self, stream):
        self._stream = stream

    def read(self, size):
        data = self._stream.read(size)
        if len(data) < size:
            raise EOFError
        return data


class _Records(StreamReader):
    """Records of a file, without the content of message indices, which is not needed."""

    def _read_record(self, opcode, length):
        return None if opcode == Opcode.MESSAGE_INDEX else super()._read_record(opcode, length)


def bag_files(path: str | Path) -> list[Path]:
    """
    Find the MCAP files of a RUN.

    Args:
        path: rosbag2 folder, its metadata.yaml or one of its ``.mcap`` files.

    Raises:
        BagError: no such path, or no MCAP file there.

    """
    path = Path(path)
    if not path.exists():
        raise BagError(f'{path}: no such bag')
    if path.name == 'metadata.yaml':
        path = path.absolute().parent
    if path.is_file():
        if path.suffix != '.mcap':
            raise BagError(f'{path}: expected a rosbag2 folder or a .mcap file')
        return [path]
    files = sorted(path.glob('*.mcap'), key=_split_number)
    if not files:
        other = sorted(p.name for pattern in ('*.db3', '*.mcap.*', '*.bag')
                       for p in path.glob(pattern))
        hint = f' (found {other[0]}; convert it with ros2 bag convert)' if other else ''
        raise BagError(f'{path}: no .mcap file in this folder{hint}')
    return files


def runs_in(paths: Iterable[str | Path]) -> list[Path]:
    """Paths of RUN arguments, with the bags in a folder of bags in its place."""
    runs: list[Path] = []
    for path in map(Path, paths):
        inside = []
        if path.is_dir() and not any(path.glob('*.mcap')):
            inside = sorted({file.parent for file in path.glob('*/*.mcap')})
        runs += inside or [path]
    return runs


def no_pose(path: str | Path, warnings: list[str]) -> BagError:
    """Error for a bag without a pose; ``warnings`` of its reading may give the reason."""
    return BagError('; '.join([f'{path}: no pose of the robot; expected ground_truth/odom or '
                               'odom', *warnings]))


def _split_number(file):
    """Sort key of a split bag: name_2.mcap comes before name_10.mcap."""
    number = file.stem.rpartition('_')[2]
    return (int(number) if number.isdigit() else -1, file.name)


def names_of(runs: list[Path]) -> list[str]:
    """Shortest endings of the paths that are all different."""
    paths = [run.absolute().parts for run in runs]
    for depth in range(1, max((len(parts) for parts in paths), default=1) + 1):
        names = ['/'.join(parts[-depth:]) for parts in paths]
        if len(set(names)) == len(names):
            break
    return names


def read_messages(path: str | Path, warnings: list[str] | None = None) -> Iterator[RawMessage]:
    """
    Yield the messages of a bag in the order of recording, up to a truncation.

    Args:
        path: folder or file, see :func:`bag_files`.
        warnings: list to which a line is added for each truncated or damaged file.

    Raises:
        BagError: no such bag, unreadable, or not MCAP.

    """
    for part in _parts(path, warnings):
        for channel, data, received in zip(part.channels.tolist(), part.data,
                                           part.received.tolist(), strict=True):
            yield RawMessage(*part.known[channel], data, received)


def read_together(path: str | Path, warnings: list[str] | None = None
                  ) -> Iterator[list[Messages]]:
    """
    Yield the messages of a bag by topic, a few seconds at a time; much faster than one by one.

    Arguments and errors are as in :func:`read_messages`. Topics are in the order of their first
    message.
    """
    for part in _parts(path, warnings):
        found, first = np.unique(part.channels, return_index=True)
        together = []
        for channel in found[np.argsort(first)].tolist():
            rows = np.flatnonzero(part.channels == channel)
            together.append(Messages(*part.known[channel], [part.data[row] for row in rows],
                                     part.received[rows]))
        yield together


class _Part(NamedTuple):
    """Messages in order: (N,) channel, data, (N,) time [s]; channel -> topic and type."""

    channels: np.ndarray
    data: list[bytes]
    received: np.ndarray
    known: dict[int, tuple[str, str]]


def _parts(path, warnings) -> Iterator[_Part]:
    found, broken = 0, ''
    for file in bag_files(path):
        count = 0
        try:
            with file.open('rb') as stream:
                _check_magic(file, stream)
                for part in _Reader().parts(stream):
                    count += len(part.data)
                    yield part
        except OSError as error:
            raise BagError(f'{file}: {error.strerror}') from None
        except (BagError, GeneratorExit):
            raise
        except Exception as error:  # broken bytes raise anything in the library
            kind = 'cut off' if isinstance(error, EOFError) else f'damaged ({error})'
            broken = f'{file.name}: {kind} after {count} readable messages'
            if warnings is not None:
                warnings.append(broken)
        found += count
    if broken and not found:
        raise BagError(f"{path}: {broken}; 'mcap recover' of the mcap tool may save more")


def _check_magic(file, stream):
    """Refuse another kind of file; a shorter one may be an MCAP file that was cut off."""
    if not MCAP0_MAGIC.startswith(stream.read(MAGIC_SIZE)):
        raise BagError(f'{file}: not an MCAP file')
    stream.seek(0)


class _Reader:
    """Reader of one file."""

    def __init__(self):
        self._schemas: dict[int, str] = {}
        self._known: dict[int, tuple[str, str]] = {}

    def parts(self, stream) -> Iterator[_Part]:
        """Yield the parts, also the messages before an error."""
        loose: list[Message] = []
        try:
            for record in _Records(_WholeReads(stream), emit_chunks=True,
                                   validate_crcs=True).records:
                if isinstance(record, Message):
                    self._check(record.channel_id)
                    loose.append(record)
                if loose and (len(loose) == AT_ONCE or not isinstance(record, Message)):
                    yield self._of_loose(loose)
                    loose = []
                if isinstance(record, Chunk):
                    yield self._of_chunk(record)
                elif isinstance(record, (Schema, Channel)):
                    self._declare(record)
        except GeneratorExit:
            raise
        except Exception:
            if loose:
                yield self._of_loose(loose)
            raise

    def _of_loose(self, messages):
        return _Part(np.array([one.channel_id for one in messages]),
                     [one.data for one in messages],
                     np.array([from_nanoseconds(one.log_time) for one in messages]), self._known)

    def _of_chunk(self, chunk):
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        data, at, begins, ends = stream.read(size), 0, [], []
        while at < size:
            kind, begin = data[at], at + PREFIX
            at = begin + LENGTH.unpack_from(data, at + 1)[0]
            if at > size:
                raise McapError('a record is longer than its chunk')
            if kind == Opcode.MESSAGE:
                begins.append(begin)
                ends.append(at)
            elif kind in DECLARED:
                self._declare(DECLARED[kind].read(ReadDataStream(BytesIO(data[begin:at]))))
        rows = np.array(begins, dtype=int)[:, None] + np.arange(HEAD.itemsize)
        heads = np.frombuffer(data, np.uint8)[rows].view(HEAD)[:, 0]
        for channel in np.unique(heads['channel']).tolist():
            self._check(channel)
        return _Part(heads['channel'], [data[begin + HEAD.itemsize:end]
                                        for begin, end in zip(begins, ends, strict=True)],
                     from_nanoseconds(heads['log_time']), self._known)

    def _declare(self, record):
        if isinstance(record, Schema):
            self._schemas[record.id] = record.name
        elif record.schema_id and record.schema_id not in self._schemas:
            raise McapError(f'no schema record found with id {record.schema_id}')
        else:
            self._known[record.id] = record.topic, self._schemas.get(record.schema_id, '')

    def _check(self, channel):
        if channel not in self._known:
            raise McapError(f'no channel record found with id {channel}')
