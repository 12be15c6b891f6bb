"""The index of a bag while it is written: on disk, so that a long flight takes no memory."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
import tempfile


class ChunkIndex:
    """
    Takes the place of the list of index records that the MCAP writer keeps until the end.

    A flight of an hour has 9000 chunks, and their records took 4 MB. The file has no name and
    goes with the process.
    """

    def __init__(self, folder: Path):
        """Open the file in ``folder``."""
        self._file = tempfile.TemporaryFile(dir=folder)
        self._sizes = array('L')

    def append(self, record: BytesIO) -> None:
        """Take a record, up to its position."""
        self._file.write(record.getbuffer())
        self._sizes.append(record.tell())

    def __iter__(self) -> Iterator[BytesIO]:
        """Give all records back, each positioned at its end."""
        self._file.seek(0)
        for size in self._sizes:
            record = BytesIO()
            record.write(self._file.read(size))
            yield record

    def __len__(self) -> int:
        """How many there are."""
        return len(self._sizes)

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()
