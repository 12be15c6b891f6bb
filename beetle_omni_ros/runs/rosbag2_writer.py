"""The writer of the library rosbags, made to write what ``ros2 bag record`` of Jazzy writes."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import ClassVar

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.rosbag2.storage_mcap import McapWriter, write_channel, write_string

from beetle_omni_ros.runs.chunk_index import ChunkIndex

VERSION = 9     # of metadata.yaml
DISTRIBUTION = 'jazzy'
# Chunks inside the MCAP file, which every reader opens; as the preset `zstd_fast` of rosbag2.
COMPRESSIONS = ('none', 'zstd')


def _from_jazzy(metadata):
    return metadata.replace('ros_distro: rosbags', f'ros_distro: {DISTRIBUTION}')


class JazzyStorage(McapWriter):
    """MCAP with the hash of each type, and an index that takes no memory."""

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
    """rosbags' writer with this storage."""

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
