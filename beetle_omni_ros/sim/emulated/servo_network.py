"""Answers of the servos on one line to packets; without input and output."""

from collections import deque
from dataclasses import dataclass

from beetle_omni_ros.sim.emulated import servo_table as table
from beetle_omni_ros.sim.emulated.dynamixel import (
    BROADCAST,
    Error,
    fast_status,
    Instruction,
    LENGTH_LIMIT,
    Packet,
    status,
)
from beetle_omni_ros.sim.emulated.servo import EmulatedServo


@dataclass(frozen=True, slots=True)
class Refusal:
    """A refused instruction; a servo does not answer a refused broadcast."""

    identifier: int
    instruction: int
    error: int
    address: int | None = None


@dataclass(frozen=True, slots=True)
class Reply:
    """Bytes of an answer, sent ``delay`` [s] after the previous one."""

    data: bytes
    delay: float = 0.0


class ServoNetwork:
    """
    The servos of one line.

    Attributes:
        servos: servos in the order of the robot's joints.
        silent: IDs that receive and answer nothing.
        refused: the last refusals, for tests and diagnosis.
        refusals: number of refusals.

    """

    def __init__(self, servos: list[EmulatedServo]):
        self.servos = servos
        self.silent: set[int] = set()
        self.refused: deque[Refusal] = deque(maxlen=1000)
        self.refusals = 0

    def handle(self, packet: Packet, baud_rate: int, now: float) -> list[Reply]:
        """
        Execute a packet in every servo that receives it.

        Args:
            packet: received packet.
            baud_rate: baud rate of the line; servos at another one receive nothing.
            now: time on a monotonic clock [s].

        Returns:
            answers in the order in which they are sent.

        """
        listening = {}
        for servo in self.servos:
            if servo['ID'] not in self.silent and servo.booted(now) \
                    and servo.baud_rate == baud_rate:
                listening[servo['ID']] = servo
        if not packet.valid:
            servo = listening.get(packet.identifier)
            return [self._answer(servo, Error.CRC, packet)] if servo else []
        for servo in listening.values():
            servo.feed_watchdog(now)
        group = {
            Instruction.SYNC_READ: self._sync_read, Instruction.SYNC_WRITE: self._sync_write,
            Instruction.FAST_SYNC_READ: self._sync_read}.get(packet.instruction)
        if group:
            return group(packet, listening, now) if packet.identifier == BROADCAST else []
        if packet.identifier == BROADCAST:
            replies = [self._single(servo, packet, now) for _, servo in sorted(listening.items())]
            return replies if packet.instruction == Instruction.PING else []
        servo = listening.get(packet.identifier)
        if servo is None or packet.instruction == Instruction.STATUS:
            return []
        level = servo['Status Return Level']
        reply = self._single(servo, packet, now)
        needed = {Instruction.PING: 0, Instruction.READ: 1}.get(packet.instruction, 2)
        return [reply] if level >= needed else []

    # --- one servo ----------------------------------------------------------------------------

    def _single(self, servo, packet, now):
        """Execute an instruction in one servo; return its answer, even if it is not sent."""
        code, given = packet.instruction, packet.parameters
        address = int.from_bytes(given[:2], 'little') if len(given) >= 2 else None
        data = b''
        if code == Instruction.PING:
            error, data = servo.read(0, 2, now)
            data += bytes((servo['Firmware Version'],))
        elif code == Instruction.READ:
            error = Error.DATA_LENGTH
            if len(given) == 4:
                error, data = servo.read(address, int.from_bytes(given[2:], 'little'), now)
        elif code == Instruction.WRITE:
            delay = servo['Return Delay Time']
            error = Error.DATA_LENGTH if address is None else servo.write(address, given[2:])
            return self._answer(servo, error, packet, address=address, delay=delay)
        elif code == Instruction.REBOOT:
            reply = self._answer(servo, Error.NONE, packet)
            servo.reboot(now)
            return reply
        else:
            error = Error.INSTRUCTION
        return self._answer(servo, error, packet, data, address)

    def _answer(self, servo, error, packet, data=b'', address=None, delay=None):
        self._record_refusal(servo, error, packet, address)
        # A servo whose ID has just changed answers with the old one.
        name = servo['ID'] if packet.identifier == BROADCAST else packet.identifier
        wait = servo['Return Delay Time'] if delay is None else delay
        return Reply(status(name, error | servo.alert, data), wait * table.DELAY_UNIT)

    def _record_refusal(self, servo, error, packet, address=None):
        if error:
            self.refusals += 1
            self.refused.append(Refusal(servo['ID'], int(packet.instruction), int(error),
                                        address))

    # --- several servos -----------------------------------------------------------------------

    def _sync_read(self, packet, listening, now):
        """Answers in sequence; each servo waits for the previous one, so a silent one ends it."""
        given = packet.parameters
        address, length = (int.from_bytes(given[k:k + 2], 'little') for k in (0, 2))
        names = given[4:]
        total = len(names) * (4 + length)
        if not names or len(set(names)) != len(names) or total > LENGTH_LIMIT:
            return []
        fast = packet.instruction == Instruction.FAST_SYNC_READ
        blocks, delays = [], []
        for name in names:
            servo = listening.get(name)
            if servo is None or servo['Status Return Level'] < 1 \
                    or (fast and servo['Firmware Version'] < table.FIRST_FAST_FIRMWARE):
                break
            error, data = servo.read(address, length, now)
            self._record_refusal(servo, error, packet, address)
            if fast:
                data = data.ljust(length, b'\0')
            blocks.append((name, error | servo.alert, data))
            delays.append(servo['Return Delay Time'] * table.DELAY_UNIT)
        if not fast:
            return [Reply(status(*block), delay)
                    for block, delay in zip(blocks, delays, strict=True)]
        if not blocks:
            return []
        # The parts form one packet without pauses; only the first one has a delay.
        return [Reply(fast_status(blocks, total), delays[0])]

    def _sync_write(self, packet, listening, now):
        given = packet.parameters
        address, length = (int.from_bytes(given[k:k + 2], 'little') for k in (0, 2))
        rest = given[4:]
        if not length or len(rest) % (length + 1):
            return []
        for k in range(0, len(rest), length + 1):
            servo = listening.get(rest[k])
            if servo is not None:
                error = servo.write(address, rest[k + 1:k + 1 + length])
                self._record_refusal(servo, error, packet, address)
        return []
