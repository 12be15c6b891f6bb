"""rosbags' writer, adapted to the format of ``ros2 bag record`` of Jazzy."""

from array import array
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
import tempfile
from typing import ClassVar

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.rosbag2.storage_mcap import McapWriter, write_channel, write_string

VERSION = 9     # of metadata.yaml
DISTRIBUTION = 'jazzy'
# Compression of the chunks in the MCAP file, which every reader supports; 'zstd' is like the
# preset `zstd_fast` of rosbag2.
COMPRESSIONS = ('none', 'zstd')


def _from_jazzy(metadata):
    return metadata.replace('ros_distro: rosbags', f'ros_distro: {DISTRIBUTION}')


class ChunkIndex:
    """
    Replaces the MCAP writer's list of index records by a temporary file.

    A flight of an hour has 9000 chunks, whose records need 4 MB of memory. The file has no name
    and is deleted with the process.
    """

    def __init__(self, folder: Path):
        self._file = tempfile.TemporaryFile(dir=folder)
        self._sizes = array('L')

    def append(self, record: BytesIO) -> None:
        """Store a record."""
        self._file.write(record.getbuffer())
        self._sizes.append(record.tell())

    def __iter__(self) -> Iterator[BytesIO]:
        """Yield all records, each positioned at its end."""
        self._file.seek(0)
        for size in self._sizes:
            record = BytesIO()
            record.write(self._file.read(size))
            yield record

    def __len__(self) -> int:
        return len(self._sizes)

    def close(self) -> None:
        """Delete the file."""
        self._file.close()


class JazzyStorage(McapWriter):
    """MCAP with the hash of each type, and an index outside memory."""

    def __init__(self, path: Path, compression: CompressionMode):
        """Create the file in the folder ``path``."""
        super().__init__(path, compression)
        self.chunks = ChunkIndex(path)

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        """Declare a topic."""
        buffer = self.chunk.bio
        start = buffer.tell()
        super().add_connection(connection, offered_qos_profiles)
        entry = BytesIO()
        write_string(entry, 'topic_type_hash')
        write_string(entry, connection.digest)
        channel = self.channels[-1]
        self.channels[-1] = channel._replace(metadata=channel.metadata + entry.getvalue())
        buffer.seek(start)
        write_channel(buffer, self.channels[-1], self.schemas)

    def close(self, version: int, metadata: str) -> None:
        """Write index and metadata."""
        super().close(version, _from_jazzy(metadata))


class JazzyWriter(Writer):
    """rosbags' writer with :class:`JazzyStorage`."""

    STORAGE_PLUGINS: ClassVar = {StoragePlugin.MCAP: JazzyStorage}

    def __init__(self, path: Path, compression: str = 'none'):
        """Prepare a bag at ``path``; ``compression`` is one of ``COMPRESSIONS``."""
        super().__init__(path, version=VERSION, storage_plugin=StoragePlugin.MCAP)
        if compression == 'zstd':
            self.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)

    def close(self) -> None:
        """Finish the bag."""
        index = self.storage.chunks
        try:
            super().close()
        finally:
            index.close()
        self.metapath.write_text(_from_jazzy(self.metapath.read_text('utf8')), 'utf8')
