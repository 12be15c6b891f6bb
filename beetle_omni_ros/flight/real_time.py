"""The loop in real time, with the drivers and emulated devices on serial ports."""

from __future__ import annotations

from dataclasses import replace
import sys
import time

from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters, ServoBusParameters
from beetle_omni_ros.flight.bridges import ACTIVE, Bridge, JointBridge, RotorBridge
from beetle_omni_ros.flight.loop import FlightLoop
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.sim.emulated.device import EmulatedActuators
from beetle_omni_ros.sim.faults import DEVICES

WAIT = 0.0005           # [s] between looks for messages of the drivers' threads
THREAD_SWITCH = 0.0005  # [s] a servo has 3 ms to answer
READY_TIMEOUT = 20.0    # [s] until the bridges are ready


class EmulatedLoop(FlightLoop):
    """
    A flight whose commands go through bridges, drivers, serial ports and emulated devices.

    The devices keep real time, and so does this loop; its digits depend on the computer. Close it
    after the flight. Arguments are those of FlightLoop.
    """

    simulated = False

    def __init__(self, robot, plant, *arguments, **options):
        for fault in options.get('faults', ()):
            if fault.changes(*DEVICES):
                raise ParameterError(f"--faults: '{fault.kind}' affects a device; expected "
                                     '--actuators direct')
        servos, board = ServoBusParameters.load(), MotorBoardParameters.load()
        self._began = time.monotonic()
        self._switch_interval = sys.getswitchinterval()
        super().__init__(robot, plant, *arguments, **options)
        devices = EmulatedActuators.of(self.simulator, plant, servos, seed=options.get('seed', 0))
        self.robot.use(devices)
        self._bridges: list[Bridge] = [
            JointBridge(replace(servos, port=devices.bus.port), robot),
            RotorBridge(replace(board, port=devices.board.port), robot)]
        sys.setswitchinterval(THREAD_SWITCH)
        for bridge in self._bridges:
            self.add(bridge)
            bridge.configure()
            bridge.activate()
            bridge.stage = ACTIVE
            bridge.changed()
        self._began = time.monotonic() - self.simulator.time

    def now(self) -> float:
        """Time on the clock of the stamps [s]."""
        return self.simulator.epoch + self.elapsed()

    def elapsed(self) -> float:
        """Real time since the start [s]."""
        return time.monotonic() - self._began

    def step(self) -> None:
        """Wait for the next tick, deliver the messages of the drivers meanwhile, and run it."""
        due = self._began + self.simulator.time + self.simulator.tick
        while (left := due - time.monotonic()) > 0:
            time.sleep(min(left, WAIT))
            self._now = self.now()
            self.deliver()
        super().step()

    def take_off(self) -> None:
        """Wait for the bridges; arm and climb until a controller flies."""
        end = self.simulator.time + READY_TIMEOUT
        while self.supervisor.why_not_arm() and self.simulator.time < end:
            self.step()
        super().take_off()

    def close(self) -> None:
        """Switch the devices off and end the recording."""
        for bridge in self._bridges:
            bridge.close()
        self.robot.close()
        sys.setswitchinterval(self._switch_interval)
        super().close()
