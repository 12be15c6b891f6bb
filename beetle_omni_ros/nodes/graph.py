"""The nodes of one flight as processes of this computer: start, CPU time, stop."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import yaml

import beetle_omni_ros
from beetle_omni_ros.nodes import plan
from beetle_omni_ros.nodes.discovery import confine
from beetle_omni_ros.nodes.plan import BRIDGES, BRIDGES_COMPOSED, COMPOSED

PORT_TIMEOUT = 30.0     # s for the simulator to make its serial ports
STOP_TIMEOUT = 8.0      # s from SIGINT to SIGKILL


class Graph:
    """
    Processes that run nodes.

    Args:
        parameters: node name -> parameters that differ from the shipped ones.
        folder: existing folder for the parameter file and the output of the processes.
        domain: ROS domain.
        composed: one process for the bridges, which block on serial ports, and one for all other
            nodes; otherwise one process for each node.
        simulated: simulated time, which waits for nodes that are late.

    """

    def __init__(self, parameters: dict[str, dict], folder: Path, domain: int,
                 composed: bool = True, simulated: bool = False):
        if simulated:
            parameters = plan.in_simulated_time(parameters)
        self.folder, self.domain = Path(folder), domain
        self.composed, self.simulated = composed, simulated
        self.nodes = list(parameters)
        simulator = parameters.get('sim_node', {})
        self._ports = [port for port in map(simulator.get, ('servo_port', 'board_port')) if port]
        self._file = self.folder / 'parameters.yaml'
        self._file.write_text(yaml.safe_dump(
            {f'/**/{node}': {'ros__parameters': values}
             for node, values in parameters.items() if values}) if any(parameters.values())
            else '/**: {ros__parameters: {}}\n')
        if composed:
            self._commands = {name: [COMPOSED, *plan.arguments(parameters, nodes), '--ros-args']
                              for name, nodes in plan.processes(parameters).items()}
        else:
            self._commands = {node: [plan.executable(node), '--ros-args', *(
                () if node in plan.NODES else ('-r', f'__node:={node}'))] for node in self.nodes}
        self.processes: dict[str, subprocess.Popen] = {}

    def start(self) -> None:
        """
        Start every process; the bridges after the simulator has made its serial ports.

        Each process ends with this one, even if this one is killed.
        """
        for name in self._commands:
            if name not in (BRIDGES_COMPOSED, *BRIDGES):
                self.start_process(name)
        # Bridges also wait for their ports, but log a warning.
        deadline = time.monotonic() + PORT_TIMEOUT
        while not all(map(os.path.exists, self._ports)) and time.monotonic() < deadline \
                and not self.dead():
            time.sleep(0.05)
        for name in self._commands:
            if name in (BRIDGES_COMPOSED, *BRIDGES):
                self.start_process(name)

    def start_process(self, name: str) -> subprocess.Popen:
        """Start one process, or start it again."""
        with open(self.log(name), 'a') as log:
            self.processes[name] = subprocess.Popen(
                [sys.executable, '-m', 'beetle_omni_ros.start', *self._commands[name],
                 '--params-file', str(self._file)],
                env=child_environment(self.domain), stdin=subprocess.DEVNULL, stdout=log,
                stderr=log, start_new_session=True)     # Ctrl-C reaches this process only
        return self.processes[name]

    def log(self, name: str) -> Path:
        """Return the file with the output of a process."""
        return self.folder / f'{name}.log'

    def dead(self) -> dict[str, str]:
        """Return name -> exit status or signal of each process that has ended."""
        return {name: _ending(process.returncode, self.log(name))
                for name, process in self.processes.items() if process.poll() is not None}

    def cpu_seconds(self, bridges: bool = False) -> float:
        """Return the CPU time of the running processes, or of the bridges only [s]."""
        return sum(_cpu_seconds(p.pid) for name, p in self.processes.items() if p.poll() is None
                   and (not bridges or name in (BRIDGES_COMPOSED, *BRIDGES)))

    def kill(self, name: str) -> None:
        """Kill one process."""
        self.processes[name].send_signal(signal.SIGKILL)
        self.processes[name].wait()

    def stop(self) -> list[str]:
        """
        Stop all processes.

        Bridges stop first, because they switch off the actuators, which the simulator emulates.
        The recorder stops last, so that the bag contains the end.

        Returns:
            Names of the processes that had to be killed.

        """
        first = [name for name in self.processes if name in (BRIDGES_COMPOSED, *BRIDGES)]
        last = [name for name in self.processes if name == 'recorder_node']
        others = [name for name in self.processes if name not in (*first, *last)]
        return self._end(first) + self._end(others) + self._end(last)

    def _end(self, names):
        """Send SIGINT every second: a process that still imports may lose the first one."""
        deadline = time.monotonic() + STOP_TIMEOUT
        left = list(names)
        while left and time.monotonic() < deadline:
            for name in left:
                if self.processes[name].poll() is None:
                    self.processes[name].send_signal(signal.SIGINT)
            again = time.monotonic() + 1.0
            while left and time.monotonic() < again:
                time.sleep(0.02)
                left = [name for name in left if self.processes[name].poll() is None]
        for name in left:
            self.kill(name)
        return left

    def warnings(self) -> list[str]:
        """Return the lines that the processes logged as warning or error, without duplicates."""
        lines = {}
        for name in self.processes:
            for line in self.log(name).read_text(errors='replace').splitlines():
                if '[WARN]' in line or '[ERROR]' in line or ': error: ' in line:
                    lines[line.split(']: ', 1)[-1]] = line
        return list(lines.values())


def child_environment(domain: int) -> dict[str, str]:
    """Return the environment of a process in ROS domain ``domain`` that ends with this one."""
    root = str(Path(beetle_omni_ros.__file__).resolve().parents[1])
    environment = dict(
        os.environ, ROS_DOMAIN_ID=str(domain), BEETLE_OMNI_PARENT=str(os.getpid()),
        PYTHONPATH=os.pathsep.join(filter(None, [root, os.environ.get('PYTHONPATH')])))
    confine(environment)
    return environment


def _ending(code: int, log: Path) -> str:
    if code < 0:
        return f'ended by {signal.Signals(-code).name}'
    lines = log.read_text(errors='replace').strip().splitlines()
    return f"exit status {code}{': ' + lines[-1] if lines else ''}"


def _cpu_seconds(pid: int) -> float:
    """User and system time from /proc; 0 if that does not exist."""
    try:
        fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')
