"""Serves the port of the motor board in a thread: reading, timing, reconnecting."""

from collections.abc import Callable
import os
import select
import threading
import time

from beetle_omni_ros.drivers.mavlink_dialect import common
from beetle_omni_ros.drivers.mavlink_receiver import MavlinkReceiver
from beetle_omni_ros.drivers.motor_board_parameters import MotorBoardParameters
from beetle_omni_ros.drivers.serial_port import SerialPort, SerialPortError

TICK = 0.01             # [s] longest sleep of the thread, a tenth of its shortest period


class BoardLink:
    """
    MAVLink on one serial port. The callbacks run one at a time in the thread of the link.

    Args:
        on_message: called with (message, arrival [s, monotonic]).
        on_tick: called with the monotonic time [s], at least each :data:`TICK`.
        on_connection: called with (True, '') or (False, reason) when the port opens or fails.
        restarts: whether a message is the first one after a restart of the board.

    Attributes:
        receiver: parser with the counts of received messages.
        sent: number of frames written to the port.
        dropped: number of frames dropped because the output buffer was full.
        connections: number of times the port was opened.

    """

    def __init__(self, parameters: MotorBoardParameters, on_message: Callable,
                 on_tick: Callable, on_connection: Callable, restarts: Callable):
        self._parameters = parameters
        self._on_message, self._on_tick = on_message, on_tick
        self._on_connection = on_connection
        self._packer = common.MAVLink(None, parameters.host_system, parameters.host_component)
        self.receiver = MavlinkReceiver(parameters.board_system, parameters.board_component,
                                        restarts)
        self._port: SerialPort | None = None
        self._write_lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self.sent = self.dropped = self.connections = 0

    def open(self) -> None:
        """
        Open the port and start the thread.

        Raises:
            SerialPortError: the port cannot be opened.

        """
        self._connect()
        self._stop.clear()
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, name='motor_board', daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread and close the port."""
        if self._thread is None:
            return
        self._stop.set()
        os.write(self._wake_write, b'x')
        if self._thread is not threading.current_thread():
            self._thread.join(2.0)
        self._thread = None
        self._disconnect()
        os.close(self._wake_read)
        os.close(self._wake_write)

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    @property
    def opened(self) -> bool:
        """Whether the thread runs, also while the port is lost."""
        return self._thread is not None

    def send(self, message) -> bool:
        """
        Pack and write a message without waiting.

        Returns:
            whether it was written, at least in part; False if the port is lost or its buffer full.

        """
        with self._write_lock:
            if self._port is None:
                return False
            frame = message.pack(self._packer)
            try:
                taken = self._port.write(frame)
            except SerialPortError:
                return False            # the thread detects the error itself and reconnects
            if taken:
                # A dropped frame must not leave a gap, which the board would count as lost.
                self._packer.seq = (self._packer.seq + 1) % 256
                self.sent += 1
            else:
                self.dropped += 1
            return taken

    def _connect(self):
        port = SerialPort(self._parameters.port, self._parameters.baud)
        self.receiver.restart()
        with self._write_lock:
            self._port = port
        self.connections += 1

    def _disconnect(self):
        with self._write_lock:
            port, self._port = self._port, None
        if port:
            port.close()

    def _run(self):
        retry = 0.0
        while not self._stop.is_set():
            try:
                if self._port is None:
                    retry = self._reconnect(retry)
                else:
                    self._serve()
            except SerialPortError as error:
                self._disconnect()
                self._on_connection(False, str(error))
            self._on_tick(time.monotonic())

    def _reconnect(self, retry):
        """Try to open the port if it is time; return the time of the next attempt."""
        now = time.monotonic()
        if now < retry:
            select.select([self._wake_read], [], [], min(TICK, retry - now))
            return retry
        try:
            self._connect()
        except SerialPortError:
            return now + self._parameters.reconnect_period
        self._on_connection(True, '')
        return 0.0

    def _serve(self):
        """Wait at most one tick for bytes and handle them."""
        port = self._port
        writers = [port] if port.waiting else []
        readable, writable, _ = select.select([port, self._wake_read], writers, [], TICK)
        if writable:
            with self._write_lock:
                port.flush()
        if port in readable:
            data = port.read()
            now = time.monotonic()
            for message in self.receiver.feed(data):
                self._on_message(message, now)
