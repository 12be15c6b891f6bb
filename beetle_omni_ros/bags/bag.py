"""Reading of rosbag2 folders (metadata.yaml and MCAP) without ROS, also of truncated files."""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from io import BytesIO
from itertools import islice
import json
from pathlib import Path
from struct import Struct
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, InvalidMagic
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream, read_magic
import numpy as np

from beetle_omni_ros.bags.conversions import from_nanoseconds
from beetle_omni_ros.bags.log import channels_of, FlightLog, LogRecorder, META_KEY
from beetle_omni_ros.bags.messages import columns, from_bytes
from beetle_omni_ros.bags.topics import ALL, controller_of, TELLING, Topic, topic_of
from beetle_omni_ros.control.base import TrajectoryTarget
from beetle_omni_ros.model.schema import ParameterError, read_yaml

BagError = ParameterError   # its name in identify
AT_ONCE = 4096      # messages that are read together
MESSAGE = int(Opcode.MESSAGE)       # a number of an enumeration takes longer to compare
HEAD, FIELDS = Struct('<BQ'), Struct('<HIQQ')   # of each record of a file, and of a message


class Recorded(NamedTuple):
    """One message of a bag, or several of one topic in the order of the file."""

    topic: str      # full name; of several messages that without the namespace of the robot
    type: str       # ROS type
    data: bytes | list[bytes]       # CDR
    received: float | np.ndarray    # time of recording [s], or (N,) times


def bag_files(path: str | Path) -> list[Path]:
    """
    Find the MCAP files of a RUN.

    Args:
        path: rosbag2 folder, its metadata.yaml or one of its ``.mcap`` files.

    Raises:
        ParameterError: no such path, or no MCAP file there.

    """
    path = Path(path)
    if not path.exists():
        raise ParameterError(f'{path}: no such bag')
    if path.name == 'metadata.yaml':
        path = path.absolute().parent
    if path.is_file():
        if path.suffix != '.mcap':
            raise ParameterError(f'{path}: expected a rosbag2 folder or a .mcap file')
        return [path]
    # of a split bag name_2.mcap before name_10.mcap
    files = sorted(path.glob('*.mcap'), key=lambda file: (
        int(number) if (number := file.stem.rpartition('_')[2]).isdigit() else -1, file.name))
    if not files:
        other = sorted(p.name for pattern in ('*.db3', '*.mcap.*', '*.bag')
                       for p in path.glob(pattern))
        hint = f' (found {other[0]}; convert it with ros2 bag convert)' if other else ''
        if (inside := runs_in([path])) != [path]:
            hint = f"; expected one of the runs in it: {', '.join(run.name for run in inside)}"
        raise ParameterError(f'{path}: no .mcap file in this folder{hint}')
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


def names_of(runs: list[Path]) -> list[str]:
    """Shortest endings of the paths that are all different, numbered if none are."""
    paths = [run.absolute().parts for run in runs]
    for depth in range(1, max((len(parts) for parts in paths), default=1) + 1):
        names = ['/'.join(parts[-depth:]) for parts in paths]
        if len(set(names)) == len(names):
            return names
    return [f'{name} ({k + 1})' for k, name in enumerate(names)] if runs else []


def read_messages(path: str | Path) -> Iterator[Recorded]:
    """
    Yield the messages of a bag in the order of recording, up to a truncation.

    Args:
        path: folder or file, see :func:`bag_files`.

    Raises:
        ParameterError: no such bag, unreadable, or not MCAP.

    """
    for topic, kind, data, received in _recorded(path, []):
        yield Recorded(topic, kind, data, from_nanoseconds(received))


def _recorded(path, warnings):
    """Topic, type, data and time [ns]; ``warnings`` gets a line for each broken file."""
    readable, broken = 0, ''
    for file in bag_files(path):
        count = 0
        try:
            stream = file.open('rb')
        except OSError as error:
            raise ParameterError(f'{file}: {error.strerror}') from None
        with stream:
            try:
                read_magic(ReadDataStream(stream))
                for message in _messages(stream, {}, {0: ''}):
                    count += 1
                    yield message
            except Exception as error:  # broken bytes raise anything in the library
                if isinstance(error, InvalidMagic) and not count:
                    raise ParameterError(f'{file}: not an MCAP file') from None
                kind = f'damaged ({type(error).__name__}: {error})' if stream.read(1) \
                    else 'cut off'
                broken = f'{file.name}: {kind} after {count} readable messages'
                warnings.append(broken)
        readable += count
    if broken and not readable:
        raise ParameterError(f"{path}: {broken}; 'mcap recover' of the mcap tool may save more")


def _messages(stream, topics, schemas, outside=True):
    """Yield topic, type, data, time [ns] of messages; the library takes four times as long."""
    while len(head := stream.read(HEAD.size)) == HEAD.size:
        kind, length = HEAD.unpack(head)
        if len(data := stream.read(length)) < length:
            break
        if kind == MESSAGE:
            channel, _, received, _ = FIELDS.unpack_from(data)
            yield *topics[channel], data[FIELDS.size:], received
            continue
        record = ReadDataStream(BytesIO(data))
        if kind == Opcode.CHUNK:
            part, size = get_chunk_data_stream(Chunk.read(record), validate_crc=True)
            yield from _messages(BytesIO(part.read(size)), topics, schemas, False)
        elif kind == Opcode.CHANNEL:
            channel = Channel.read(record)
            topics[channel.id] = channel.topic, schemas[channel.schema_id]
        elif kind == Opcode.SCHEMA:
            schema = Schema.read(record)
            schemas[schema.id] = schema.name
        elif kind == Opcode.FOOTER:
            return
    if head or outside:
        raise EndOfFile


def read_together(path: str | Path, warnings: list[str]) -> Iterator[list[Recorded]]:
    """
    Yield the messages of a bag of one robot by topic, a few seconds at a time.

    ``warnings`` gets a line for each truncated or damaged file. Errors are as in
    :func:`read_messages`, and a ParameterError reports several robots. Topics are in the order of
    their first message.
    """
    messages = _recorded(path, warnings)
    spaces: set[str] = set()    # namespaces of robots
    while part := list(islice(messages, AT_ONCE)):
        groups: dict[tuple[str, str], tuple[list, list]] = defaultdict(lambda: ([], []))
        for topic, kind, data, received in part:
            all_data, times = groups[topic, kind]
            all_data.append(data)
            times.append(received)
        found = [Recorded(f"/{topic.lstrip('/')}", kind, data, from_nanoseconds(np.array(times)))
                 for (topic, kind), (data, times) in groups.items()]
        spaces |= {topic.removesuffix(name).rstrip('/') for topic, *_ in found for name in TELLING
                   if topic.endswith(f'/{name}')}
        if len(spaces) > 1:
            robots = ' and '.join(f"'{space}'" for space in sorted(spaces))
            raise ParameterError(f'{path}: holds several robots ({robots}); expected one')
        begin = f"{next(iter(spaces), '')}/"
        yield [one._replace(topic='diagnostics' if one.topic == '/diagnostics'
                            else one.topic.removeprefix(begin)) for one in found]


def read_all(topic: Topic, messages: Sequence[bytes]) -> tuple[list[int], list, Counter]:
    """Return indices and values of the readable messages, and reason -> number of the others."""
    rows, values, refused = [], [], Counter()
    for row, data in enumerate(messages):
        try:
            values.append(topic.read(from_bytes(data, topic.type)))
            rows.append(row)
        except Exception as error:      # broken bytes raise anything
            refused[str(error) or type(error).__name__] += 1
    return rows, values, refused


def read_columns(topic: Topic, messages: Sequence[bytes], channels: dict[str, int]
                 ) -> tuple[np.ndarray, dict[str, np.ndarray], Counter]:
    """
    Read messages as :func:`read_all`, those of equal layout together, which is faster.

    Returns:
        (M,) ascending indices of the readable messages; 'stamp' and each channel -> its (M,) or
        (M, width) numbers, NaN for None; reason -> number of the other messages.

    """
    lengths = np.array([len(data) for data in messages])
    found = {name: np.empty((len(lengths), width) if width else len(lengths))
             for name, width in {'stamp': 0, **channels}.items()}
    done = np.zeros(len(lengths), dtype=bool)

    def fill(rows, value):
        for name, column in found.items():
            part = getattr(value, name)
            column[rows] = np.nan if part is None else part

    for length in np.unique(lengths):
        rows = np.flatnonzero(lengths == length)
        block = np.frombuffer(b''.join([messages[row] for row in rows]), np.uint8)
        with suppress(Exception), np.errstate(all='ignore'):    # one by one they give reasons
            together, alike = columns(block.reshape(-1, length), topic.type)
            fill(rows, topic.read(together))
            done[rows] = alike
    others = np.flatnonzero(~done)
    rows, values, refused = read_all(topic, [messages[row] for row in others])
    for row, value in zip(others[rows], values, strict=True):
        fill(row, value)
        done[row] = True
    return np.flatnonzero(done), {name: part[done] for name, part in found.items()}, refused


def read_bag(path: str | Path, needed: Collection[str] = ()) -> FlightLog:
    """
    Read a flight.

    Args:
        path: rosbag2 folder, or one of its files.
        needed: topics that are read, by default all; messages of others are only counted.

    Returns:
        The flight; its ``warnings`` list missing and unusable data.

    Raises:
        ParameterError: no such bag, unreadable, not MCAP, or several robots in it.

    """
    recorder, warnings = LogRecorder(), []
    counts: Counter = Counter()
    unused: dict[str, Counter] = {}     # topic -> reason -> number of messages
    for together in read_together(path, warnings):
        for messages in together:
            name = messages.topic
            if name not in ALL and not controller_of(name):
                continue
            if needed and name not in needed:
                counts[name] += len(messages.data)
                continue
            topic, refused = topic_of(name), unused.setdefault(name, Counter())
            if messages.type != topic.type:
                refused[f'type is {messages.type}, not {topic.type}'] += len(messages.data)
                continue
            if (channels := channels_of(name)) is not None:
                rows, found, reasons = read_columns(topic, messages.data, channels)
                received = messages.received[rows]
                found['stamp'] = np.where(found['stamp'] == 0, received, found['stamp'])
                recorder.write_rows(name, [*found.values(), received])
                counts[name] += len(rows)
                refused.update(reasons)
                continue
            rows, values, reasons = read_all(topic, messages.data)
            refused.update(reasons)
            for row, value in zip(rows, values, strict=True):
                received = float(messages.received[row])
                try:
                    recorder.write(name, _stamped(value, received), received)
                    counts[name] += 1
                except ValueError as error:     # a number in the text of a diagnostic value
                    refused[str(error)] += 1
    recorder.write_meta(_metadata(path, warnings))
    log = recorder.log()
    log.warnings, log.source = warnings + _problems(counts, unused), str(path)
    return log


def _problems(counts, unused):
    """Return a line about missing topics, and one for each topic with unusable messages."""
    missing = [name for name, topic in ALL.items() if topic.required and not counts[name]]
    if 'target_pose' in missing and counts['target_trajectory']:
        missing.remove('target_pose')
    lines = [f"no message on {', '.join(missing)}"] if missing else []
    return lines + [f'{name}: {refused.total()} messages not used ({next(iter(refused))})'
                    for name, refused in unused.items() if refused]


def read_flights(paths: Iterable[str | Path], most: int) -> dict[str, FlightLog]:
    """Read the flights of RUN arguments by name; ParameterError: also above ``most`` runs."""
    runs = runs_in(paths)
    if len(runs) > most:
        raise ParameterError(f'{len(runs)} runs; expected at most {most}')
    return {name: read_bag(path) for path, name in zip(runs, names_of(runs), strict=True)}


def _stamped(value, received):
    """The value; without a stamp (`ros2 topic pub`), it gets the time of receipt."""
    if isinstance(value, list):
        return [entry if entry.t else replace(entry, t=received) for entry in value]
    if getattr(value, 'stamp', True):   # a text has none, neither has the health of the actuators
        return value
    return value.delayed(received) if isinstance(value, TrajectoryTarget) \
        else replace(value, stamp=received)


def _metadata(path, warnings):
    """Metadata of a finished bag; empty if there is none."""
    path = Path(path)
    file = (path if path.is_dir() else path.absolute().parent) / 'metadata.yaml'
    if not file.is_file():
        warnings.append('metadata.yaml is missing: the recorder did not finish')
        return {'interrupted': True} if path.is_dir() else {}
    try:
        custom = read_yaml(file)['rosbag2_bagfile_information']['custom_data']
        meta = dict(json.loads((custom or {}).get(META_KEY, '{}')))
        if meta.get('interrupted'):
            warnings.append('interrupted; kept what was flown')
        return meta
    except (KeyError, TypeError, AttributeError, ValueError, RecursionError):
        warnings.append('metadata.yaml is not readable')
        return {}
