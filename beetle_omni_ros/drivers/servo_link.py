"""Transactions with servos by dynamixel_sdk: each call exchanges packets and checks them."""

from contextlib import contextmanager
from dataclasses import dataclass

from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, PacketHandler

from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.servo_port import PortLost, ServoPort
from beetle_omni_ros.drivers.servo_registers import Register

BROADCAST = 0xFE
RELAXED_REPLY_TIME = 0.02   # [s] time limit of an answer outside the loop
STATUS_SIZE = 11            # [B] of an answer without data
FIRST_BLOCK = 8             # [B] before the first error byte in the answer to a fast sync read


class ServoBusError(RuntimeError):
    """The bus or a servo failed; one line with port and ID."""


class NoAnswer(ServoBusError):
    """A servo did not answer, or its answer was corrupt."""


class Refused(ServoBusError):
    """A servo answered with an error."""


class _Recorder:
    """A port that stores the packet written by the SDK."""

    is_using = False
    sent = b''

    def clearPort(self):
        """Do nothing."""

    def writePort(self, packet):
        """Store the packet."""
        self.sent = packet
        return len(packet)


@dataclass
class LinkStatistics:
    """Counts since the creation of the link."""

    transactions: int = 0
    unanswered: int = 0
    corrupt: int = 0
    refused: int = 0
    connections: int = 0


class ServoLink:
    """
    The bus at one baud rate.

    Args:
        reply_time: time limit of an answer, without its time on the wire [s].

    Attributes:
        fast: whether to use fast sync read, which needs firmware 46 or later in every servo.
        alerts: IDs whose last answer had the alert bit of a hardware error.
        late: whether an answer of the last transaction was missing or corrupt.

    Raises:
        PortLost: by any call, if the port is lost; open it again.

    """

    def __init__(self, path: str, baud_rate: int, reply_time: float):
        self.path, self.baud_rate, self.reply_time = path, baud_rate, reply_time
        self.fast = False
        self.late = False
        self.alerts: set[int] = set()
        self.statistics = LinkStatistics()
        self._handler = PacketHandler(2.0)
        self._port: ServoPort | None = None

    @property
    def is_open(self) -> bool:
        """Whether the port is open; True until a call notices its loss."""
        return self._port is not None

    def open(self):
        """Open the port; raises PortLost if it cannot be opened."""
        self.close()
        port = ServoPort(self.path, self.baud_rate, self.reply_time)
        port.openPort()
        self._port = port
        self.statistics.connections += 1

    @contextmanager
    def patient(self):
        """Context with a longer time limit for answers, for use outside the loop."""
        self.reply_time, usual = max(self.reply_time, RELAXED_REPLY_TIME), self.reply_time
        self._set_reply_time()
        try:
            yield
        finally:
            self.reply_time = usual
            self._set_reply_time()

    def _set_reply_time(self):
        if self._port is not None:
            self._port.reply_time = self.reply_time

    def close(self):
        """Close the port, if it is open."""
        if self._port is not None:
            self._port.closePort()
            self._port = None

    def where(self, identifier: int | None = None) -> str:
        """Port and ID, for messages."""
        return self.path if identifier is None else f'{self.path}, id {identifier}'

    # --- one servo ----------------------------------------------------------------------------

    def ping(self, identifier: int) -> int:
        """Model number of a servo."""
        model, result, error = self._handler.ping(self._open_port(), identifier)
        self._check(identifier, result, error, 'ping')
        return model

    def read(self, identifier: int, register: Register) -> int:
        """Value of a register."""
        port = self._open_port()
        result = self._handler.readTx(port, identifier, register.address, register.size)
        error, data = 0, b''
        if result == COMM_SUCCESS:
            error, data, result = self._status(port, identifier, register.size)
        self._check(identifier, result, error, f'read {register.name}({register.address})')
        return register.decoded(data)

    def write(self, identifier: int, register: Register, value: int, attempts: int = 3):
        """Write a register, and repeat it if there is no answer."""
        what = f'write {value} to {register.name}({register.address})'
        for attempt in range(attempts):
            port = self._open_port()
            result = self._handler.writeTxOnly(port, identifier, register.address,
                                               register.size, register.encoded(value))
            error = 0
            if result == COMM_SUCCESS:
                port.setPacketTimeout(STATUS_SIZE)
                error, _, result = self._status(port, identifier, 0)
            try:
                return self._check(identifier, result, error, what)
            except NoAnswer:
                if attempt == attempts - 1:
                    raise

    def reboot(self, identifier: int):
        """Restart a servo, which does not answer for about 0.3 s."""
        result, error = self._handler.reboot(self._open_port(), identifier)
        self._check(identifier, result, error, 'reboot')

    # --- several servos -----------------------------------------------------------------------

    def sync_write(self, register: Register, values: dict[int, int]) -> bool:
        """Write one register of several servos by one packet; return whether it was sent."""
        parameters = []
        for identifier, value in values.items():
            parameters.append(identifier)
            parameters += register.encoded(value)
        result = self._handler.syncWriteTxOnly(
            self._open_port(), register.address, register.size, parameters, len(parameters))
        self.statistics.transactions += 1
        return result == COMM_SUCCESS

    def packet_of_sync_write(self, register: Register, values: dict[int, int]) -> bytes:
        """Packet that :meth:`sync_write` would send."""
        recorder = _Recorder()
        held, self._port = self._port, recorder
        try:
            self.sync_write(register, values)
        finally:
            self._port = held
        return bytes(recorder.sent)

    def sync_read(self, address: int, length: int,
                  identifiers: list[int]) -> dict[int, tuple[int, bytes]]:
        """
        Read the same registers of several servos.

        Each servo answers after the previous one in the list, so servos behind a silent one may
        not answer.

        Returns:
            ID -> (error number, data) of each valid answer.

        """
        port = self._open_port()
        self.statistics.transactions += 1
        self.late = False
        result = self._handler.syncReadTx(port, address, length, identifiers, len(identifiers),
                                          self.fast)
        if result != COMM_SUCCESS:
            self.statistics.unanswered += 1
            return {}
        answers = (self._fast_answers if self.fast else self._answers)(port, length, identifiers)
        for identifier, (error, data) in answers.items():
            self._note_alert(identifier, error)
            answers[identifier] = (error & 0x7F, data)
        return answers

    def _answers(self, port, length, identifiers):
        answers = {}
        for identifier in identifiers:
            error, data, result = self._status(port, identifier, length)
            self._count_errors(result)
            if result == COMM_SUCCESS:
                answers[identifier] = (error, data)
        return answers

    def _status(self, port, identifier, length):
        """
        Receive the answer of one servo: error byte, data, the SDK's result.

        An answer does not contain its address. An answer of another length is a late one of
        another transaction, whose CRC the SDK's readRx would return as data.
        """
        while True:
            packet, result = self._handler.rxPacket(port, False)
            if result != COMM_SUCCESS:
                return 0, b'', result
            size = (packet[5] | packet[6] << 8) - 4
            if packet[4] == identifier and (size == length or (size == 0 and packet[8] & 0x7F)):
                return packet[8], bytes(packet[9:9 + size]), result

    def _fast_answers(self, port, length, identifiers):
        step = length + 4
        expected = 1 + step * len(identifiers)
        while True:
            packet, result = self._handler.rxPacket(port, True)
            ours = len(packet) >= FIRST_BLOCK and packet[4] == BROADCAST \
                and packet[5] | packet[6] << 8 == expected
            # A late answer of another transaction may come first.
            if ours or result != COMM_SUCCESS:
                break
        self._count_errors(result)
        if not ours:
            return {}
        answers, checked, crc = {}, 0, 0
        for count, identifier in enumerate(identifiers, 1):
            end = FIRST_BLOCK + step * count
            if end > len(packet) or packet[end - step + 1] != identifier:
                break
            if result != COMM_SUCCESS:
                # Each block ends with the CRC of everything before, so the valid part is usable.
                crc = self._handler.updateCRC(crc, packet[checked:end - 2], end - 2 - checked)
                if crc != packet[end - 2] | packet[end - 1] << 8:
                    break
                checked = end - 2
            answers[identifier] = (packet[end - step], bytes(packet[end - step + 2:end - 2]))
        return answers

    # --- results ------------------------------------------------------------------------------

    def _open_port(self):
        if self._port is None:
            raise PortLost('not open')
        return self._port

    def _count_errors(self, result):
        if result == COMM_RX_TIMEOUT:
            self.statistics.unanswered += 1
            self.late = True
        elif result != COMM_SUCCESS:
            self.statistics.corrupt += 1
            self.late = True

    def _note_alert(self, identifier, error):
        if error & registers.ALERT:
            self.alerts.add(identifier)
        else:
            self.alerts.discard(identifier)

    def _check(self, identifier, result, error, what):
        self.statistics.transactions += 1
        self.late = False
        self._count_errors(result)
        if result != COMM_SUCCESS:
            text = self._handler.getTxRxResult(result).removeprefix('[TxRxResult] ')
            raise NoAnswer(f'{self.where(identifier)}: {what}: {text}')
        self._note_alert(identifier, error)
        number = error & 0x7F
        if number:
            self.statistics.refused += 1
            text = registers.PACKET_ERRORS.get(number, f'error {number}')
            raise Refused(f'{self.where(identifier)}: {what}: refused, {text}')
