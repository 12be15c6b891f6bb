"""Transactions with servos by dynamixel_sdk: each call exchanges packets and checks them."""

import math
import select
import time
from types import SimpleNamespace

from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, PacketHandler

from beetle_omni_ros.drivers.serial_port import SerialPort, SerialPortError
from beetle_omni_ros.drivers.servo_xc330 import ALERT, Register, ServoBusError

RELAXED_REPLY_TIME = 0.02   # [s] time limit of an answer to a request with several attempts
STATUS_SIZE = 11            # [B] of an answer without data


class ServoLink:
    """
    The bus at one baud rate.

    It is also the port of the SDK's packet handler (methods in camelCase), because the SDK's own
    port waits in a busy loop, uses the wall clock and may block in a write. Each call raises
    SerialPortError if the port is lost.

    Attributes:
        reply_time: time limit of an answer, without its time on the wire [s]. It is longer for
            requests with several attempts, which are made outside the loop.
        late: whether an answer of the last transaction was missing or corrupt.
        last_sent: monotonic time of the last packet [s], which restarts the servos' watchdogs.
        counts: transactions, connections and errors since the creation of the link.

    """

    def __init__(self, path: str, baud_rate: int, reply_time: float):
        self.path, self.baud_rate, self.reply_time = path, baud_rate, reply_time
        self.late = self.is_using = False
        self.last_sent = -math.inf
        self.counts = dict.fromkeys(
            ('transactions', 'unanswered', 'corrupt', 'refused', 'connections'), 0)
        self._handler = PacketHandler(2.0)
        self._port: SerialPort | None = None
        self._unsent, self._deadline, self._limit = 0, 0.0, reply_time

    @property
    def is_open(self) -> bool:
        """Whether the port is open; True until a call notices its loss."""
        return self._port is not None

    def open(self):
        """Open the port."""
        self.close()
        self._port = SerialPort(self.path, self.baud_rate)
        self.is_using = False
        self.counts['connections'] += 1

    def close(self):
        """Close the port, if it is open."""
        if self._port is not None:
            self._port.close()
            self._port = None

    # --- the port of the SDK ------------------------------------------------------------------

    def clearPort(self):
        """Drop received bytes; the SDK calls this before each packet."""
        if self._port is None:
            raise SerialPortError(f'{self.path}: not open')
        self._port.clear()

    def writePort(self, packet):
        """Write without waiting, also if the buffer is full."""
        self._unsent, self.last_sent = len(packet), time.monotonic()
        return len(packet) if self._port.write(bytes(packet)) else 0

    def readPort(self, length):
        """Wait for bytes, at most until the packet's time limit."""
        if length <= 0:     # the SDK asks for this if a corrupt length is too small
            return b''
        select.select([self._port.fd], [], [], max(0.0, self._deadline - time.monotonic()))
        return self._port.read(length)

    def setPacketTimeout(self, packet_length):
        """Set the time limit: both packets' time on the wire and one reply time."""
        on_wire = 10 / self.baud_rate * (self._unsent + packet_length)
        self._deadline = time.monotonic() + on_wire + self._limit

    def isPacketTimeout(self):
        """Whether the time limit has passed."""
        return time.monotonic() > self._deadline

    def ping(self, identifier: int, attempts: int = 1) -> int:
        """Model number of a servo."""
        return self._ask(identifier, 'ping', attempts,
                         lambda: self._handler.ping(self, identifier))

    def read(self, identifier: int, register: Register, attempts: int = 1) -> int:
        """Value of a register."""
        return register.decoded(self._ask(identifier, f'read {register}', attempts, lambda: (
            self._reply(identifier, register.size, self._handler.readTx(
                self, identifier, register.address, register.size)))))

    def write(self, identifier: int, register: Register, value: int, attempts: int = 3):
        """Write a register, and repeat it if there is no answer."""
        self._ask(identifier, f'write {value} to {register}', attempts, lambda: (
            self._reply(identifier, 0, self._handler.writeTxOnly(
                self, identifier, register.address, register.size, register.encoded(value)))))

    def reboot(self, identifier: int):
        """Restart a servo, which does not answer for about 0.3 s."""
        self._ask(identifier, 'reboot', 1,
                  lambda: (None, *self._handler.reboot(self, identifier)))

    def _ask(self, identifier, what, attempts, exchange):
        """Data of an exchange, which returns (data, the SDK's result, error byte)."""
        self._limit = max(self.reply_time, RELAXED_REPLY_TIME * (attempts > 1))
        for left in reversed(range(attempts)):
            data, result, error = exchange()
            self.counts['transactions'] += 1
            self.late = False
            self._count_errors(result)
            if result == COMM_SUCCESS:
                break
            if not left:
                text = self._handler.getTxRxResult(result).removeprefix('[TxRxResult] ')
                raise ServoBusError(f'{self.path}, id {identifier}: {what}: {text}')
        if number := error & ~ALERT:
            self.counts['refused'] += 1
            text = self._handler.getRxPacketError(number).removeprefix('[RxPacketError] ')
            raise ServoBusError(f'{self.path}, id {identifier}: {what}: refused, {text}')
        return data

    def _reply(self, identifier, length, sent):
        """Receive the answer of one servo: data, the SDK's result, error byte."""
        if sent != COMM_SUCCESS:
            return b'', sent, 0
        self.setPacketTimeout(STATUS_SIZE + length)
        while True:
            found, error, data, result = self._receive()
            if result != COMM_SUCCESS or found == identifier and _fits(length, error, data):
                return data, result, error

    def _receive(self):
        """Next packet: ID, error byte, data, and the SDK's result."""
        packet, result = self._handler.rxPacket(self, False)
        if result != COMM_SUCCESS:
            return 0, 0, b'', result
        return packet[4], packet[8], bytes(packet[9:5 + (packet[5] | packet[6] << 8)]), result

    def sync_write(self, register: Register, values: dict[int, int], port=None) -> bool:
        """Write one register of several servos by one packet; return whether it was sent."""
        self.counts['transactions'] += 1
        parameters = []
        for identifier, value in values.items():
            parameters += [identifier, *register.encoded(value)]
        return self._handler.syncWriteTxOnly(
            port or self, register.address, register.size, parameters,
            len(parameters)) == COMM_SUCCESS

    def packet_of_sync_write(self, register: Register, values: dict[int, int]) -> bytes:
        """Packet that :meth:`sync_write` would send."""
        packet: list[int] = []
        self.sync_write(register, values, SimpleNamespace(
            is_using=False, clearPort=lambda: None, writePort=packet.extend))
        return bytes(packet)

    def sync_read(self, address: int, length: int,
                  identifiers: list[int]) -> dict[int, tuple[int, bytes]]:
        """
        Read the same registers of several servos; return ID -> (error byte, data) of the valid.

        Each servo answers after the previous one in the list, so servos behind a silent one may
        not answer. The SDK's GroupSyncRead does not serve here: it drops the error bytes, and all
        answers if one is missing or corrupt. A fast sync read would save 0.2 ms at 1 Mbit/s, but
        has one packet for all servos.
        """
        self.counts['transactions'] += 1
        self.late, self._limit = False, self.reply_time
        if self._handler.syncReadTx(self, address, length, identifiers, len(identifiers),
                                    False) != COMM_SUCCESS:
            self.counts['unanswered'] += 1
            return {}
        answers: dict[int, tuple[int, bytes]] = {}
        while len(answers) < len(identifiers):
            identifier, error, data, result = self._receive()
            self._count_errors(result)
            if result == COMM_RX_TIMEOUT:
                break
            if result == COMM_SUCCESS and identifier in identifiers and _fits(length, error, data):
                answers[identifier] = error, data
        return answers

    def _count_errors(self, result):
        if result != COMM_SUCCESS:
            self.counts['unanswered' if result == COMM_RX_TIMEOUT else 'corrupt'] += 1
            self.late = True


def _fits(length, error, data):
    """Whether an answer may be that to a request of ``length`` bytes."""
    # It does not contain its address. One of another length is a late one of another transaction,
    # whose CRC the SDK's readRx would return as data.
    return len(data) == length or (not data and error & ~ALERT)
