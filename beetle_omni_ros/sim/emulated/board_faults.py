"""Faults of the motor board and of its cable that can be switched on."""

from __future__ import annotations

from dataclasses import dataclass
import heapq
import random


@dataclass
class BoardFaults:
    """
    What is wrong at present; may be changed at any time.

    Attributes:
        corrupt_out: probability that a packet of the board has a wrong bit.
        corrupt_in: the same for a packet to the board.
        drop_out: probability that a packet of the board is lost.
        drop_in: the same for a packet to the board.
        delay_out: packets of the board arrive this much later [s].
        delay_in: packets to the board arrive this much later [s].
        mute: the board works but nothing of it arrives.
        voltage_sag: the pack gives this much less than the world says [V].
        failed_escs: rotors (1 to 4) that do not turn.

    """

    corrupt_out: float = 0.0
    corrupt_in: float = 0.0
    drop_out: float = 0.0
    drop_in: float = 0.0
    delay_out: float = 0.0
    delay_in: float = 0.0
    mute: bool = False
    voltage_sag: float = 0.0
    failed_escs: tuple[int, ...] = ()


class Line:
    """One direction of a cable: loses, spoils and delays pieces, seeded, in order."""

    def __init__(self, seed: int):
        self._random = random.Random(seed)
        self._waiting: list = []
        self._count = 0

    def put(self, data: bytes, now: float, corrupt: float, drop: float, delay: float) -> None:
        """Take a piece at ``now`` [s] under these faults."""
        if drop and self._random.random() < drop:
            return
        if corrupt and self._random.random() < corrupt:
            spoilt = bytearray(data)
            spoilt[self._random.randrange(len(data))] ^= 1 << self._random.randrange(8)
            data = bytes(spoilt)
        self._count += 1
        heapq.heappush(self._waiting, (now + delay, self._count, data))

    def take(self, now: float) -> bytes:
        """All that has arrived by ``now``."""
        pieces = []
        while self._waiting and self._waiting[0][0] <= now:
            pieces.append(heapq.heappop(self._waiting)[2])
        return b''.join(pieces)

    def next(self) -> float:
        """When the next piece arrives [s], inf for none."""
        return self._waiting[0][0] if self._waiting else float('inf')

    def clear(self) -> None:
        """Lose what is on its way."""
        self._waiting.clear()


def frames(data: bytes) -> list[bytes]:
    """Split bytes of well-formed MAVLink 2 packets at their ends; a rest is a piece of its own."""
    pieces = []
    while data:
        size = 12 + data[1] if len(data) > 1 and data[0] == 0xFD else len(data)
        pieces.append(data[:size])
        data = data[size:]
    return pieces
