"""The cable of the emulated motor board, with faults."""

import heapq
import random


class Line:
    """One direction of a cable, which loses, corrupts and delays frames by a seed."""

    def __init__(self, seed: int):
        self._random = random.Random(seed)
        self._waiting: list = []
        self._count = 0

    def put(self, data: bytes, now: float, corrupt: float, drop: float, delay: float) -> None:
        """Send a frame at ``now`` [s] with these faults."""
        if drop and self._random.random() < drop:
            return
        if corrupt and self._random.random() < corrupt:
            corrupted = bytearray(data)
            corrupted[self._random.randrange(len(data))] ^= 1 << self._random.randrange(8)
            data = bytes(corrupted)
        self._count += 1
        heapq.heappush(self._waiting, (now + delay, self._count, data))

    def take(self, now: float) -> bytes:
        """Receive everything that has arrived by ``now`` [s]."""
        pieces = []
        while self._waiting and self._waiting[0][0] <= now:
            pieces.append(heapq.heappop(self._waiting)[2])
        return b''.join(pieces)

    def next(self) -> float:
        """Arrival of the next frame [s], inf without one."""
        return self._waiting[0][0] if self._waiting else float('inf')

    def clear(self) -> None:
        """Lose all frames that have not arrived."""
        self._waiting.clear()


def frames(data: bytes) -> list[bytes]:
    """Split a sequence of valid MAVLink 2 packets; an incomplete rest is one more piece."""
    pieces = []
    while data:
        size = 12 + data[1] if len(data) > 1 and data[0] == 0xFD else len(data)
        pieces.append(data[:size])
        data = data[size:]
    return pieces
