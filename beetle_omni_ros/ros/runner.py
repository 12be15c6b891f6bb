"""Runs nodes in one process: start, spin, stop; errors are one line and an exit status."""

from collections.abc import Callable
from contextlib import contextmanager
import ctypes
from functools import partial
import gc
from importlib import import_module
import os
import signal
import socket
import sys
import threading

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from beetle_omni_ros.control import registry
from beetle_omni_ros.flight.component import Component
from beetle_omni_ros.model.schema import load_yaml, ParameterError, RunError
from beetle_omni_ros.ros.graph import COMPOSED, confine, CONTROLLER, NODES
from beetle_omni_ros.ros.node import component_node

OK, FAILED, UNUSABLE = 0, 1, 2
# s; without a timeout, the events executor of Jazzy dispatches no callbacks.
FOREVER = 1e8
# A servo has 3 ms to answer, so no thread may keep the interpreter for the default 5 ms.
THREAD_SWITCH = 0.0005  # s
REAL_TIME_PRIORITY = 1  # lowest real-time priority, above every ordinary process
PR_SET_PDEATHSIG = 1    # of linux/prctl.h
ENDING = (signal.SIGINT, signal.SIGTERM)


def maker(name: str) -> Callable:
    """Import what makes the node of an executable, or of a controller by name or reference."""
    if ':' in name and isinstance(kind := registry.loaded(name), type) \
            and issubclass(kind, Component):
        return partial(component_node, kind, name)
    place = NODES.get(name, CONTROLLER)
    module, _, kind = place.partition(':')
    made = getattr(import_module(f'{__package__}.{module}'), kind)
    if place == CONTROLLER:
        return partial(made, registry.find(name.removesuffix('_node')))
    return made


def main(name: str) -> int:
    """
    Run an executable, one node or `composed`, until a signal or a fatal error.

    Returns:
        Exit status: 0 stopped by a signal, 1 failed, 2 unusable parameters.

    """
    nodes, status = [], OK
    signal.signal(signal.SIGTERM, signal.default_int_handler)   # KeyboardInterrupt during start-up
    end_with_parent()
    try:
        confine()
        names = _names(name)
        # rclpy's handlers would end the context while a callback still publishes.
        rclpy.init(args=[each for each in sys.argv if each not in names],
                   signal_handler_options=SignalHandlerOptions.NO)
        executor = EventsExecutor()
        for name in names:
            node = maker(name)()
            nodes.append(node)
            node.introduce()
            executor.add_node(node)
        name = name if len(names) == 1 else COMPOSED
        # Objects of the start-up live as long as the process. Freezing them avoids pauses of the
        # garbage collector of some 10 ms in a control cycle.
        gc.collect()
        gc.freeze()
        sys.setswitchinterval(THREAD_SWITCH)
        # Not for a single node: real-time processes that wait for one another delayed the
        # simulator by a third of a second.
        if len(nodes) > 1:
            use_real_time_priority()
        stop = _stop_on_signal()
        for node in nodes:
            node.stop = stop
        executor.spin_until_future_complete(stop, FOREVER)
        stop.result()       # raises the failure of a node
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ParameterError as error:
        status = _fail(name, error, UNUSABLE)
    except ModuleNotFoundError as error:
        status = _fail(name, f"needs the Python package '{error.name}': "
                       'docs/how-to/install.md', UNUSABLE)
    except (OSError, RunError) as error:
        status = _fail(name, error, FAILED)
    finally:
        # A second signal, forwarded by a launch system, must not interrupt the clean-up.
        for number in ENDING:
            signal.signal(number, signal.SIG_IGN)
        for node in reversed(nodes):
            node.destroy_node()
        rclpy.try_shutdown()
    return status


def _names(name):
    """Return the names of the nodes to run; the option --help ends the process."""
    usage = f'usage: {name} [--ros-args -p KEY:=VALUE --params-file FILE ...]'
    if name == COMPOSED:
        usage = (f"usage: {name} NODE... [--ros-args -p NODE:KEY:=VALUE ...]; NODE: "
                 f"{', '.join(NODES)}, a controller's name, {registry.CLASS}")
    for flag, path in zip(sys.argv, sys.argv[1:]):
        if flag == '--params-file':     # by file and line; ROS would print a traceback
            load_yaml(path)
    try:
        given = remove_ros_args(list(sys.argv))[1:]
    except Exception as error:      # rclpy does not export the class
        if 'ROSArgs' not in type(error).__name__:
            raise
        raise ParameterError(str(error)) from None
    if given[:1] in (['-h'], ['--help']):
        print(usage)
        sys.exit(OK)
    unknown = [each for each in given if name != COMPOSED
               or ':' not in each and each not in (*NODES, *registry.names())]
    if unknown or name == COMPOSED and not given:
        raise ParameterError(f"unknown '{unknown[0]}'; {usage}" if unknown else usage)
    return given or [name]


def _stop_on_signal() -> Future:
    """Make a future that SIGINT or SIGTERM completes between two callbacks."""
    # Python runs a signal handler only when the main thread executes Python, in an idle node up to
    # a second later. The wake-up descriptor is written at once.
    stop = Future()
    waiting, written = socket.socketpair()
    written.setblocking(False)

    def wait():
        waiting.recv(1)
        stop.set_result((waiting, written))     # keeps both ends open for further signals

    for number in ENDING:
        signal.signal(number, lambda *_: None)
    signal.set_wakeup_fd(written.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=wait, daemon=True).start()
    return stop


def use_real_time_priority():
    """Give all present threads real-time priority, if the system permits it."""
    try:
        for thread in os.listdir('/proc/self/task'):
            os.sched_setscheduler(int(thread), os.SCHED_RR, os.sched_param(REAL_TIME_PRIORITY))
    except (OSError, AttributeError):
        pass        # not permitted, or not Linux


def end_with_parent():
    """Let Linux send SIGTERM when the process that started the graph ends, even by SIGKILL."""
    parent = os.environ.get('BEETLE_OMNI_PARENT')
    if parent and sys.platform == 'linux':
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != int(parent):     # it ended before prctl
            os.kill(os.getpid(), signal.SIGTERM)


def _fail(name, error, status):
    text = ' '.join(str(error).split())
    print(f'{name}: error: {text}', file=sys.stderr, flush=True)
    return status


@contextmanager
def sigterm_as_interrupt():
    """Raise KeyboardInterrupt on SIGTERM too, and ignore further signals during the clean-up."""
    received = []       # a library may turn the interrupt into another exception

    def interrupt(number, _):
        received.append(number)
        for each in ENDING:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in ENDING}
    try:
        yield
    except Exception:
        if received:
            raise KeyboardInterrupt from None
        raise
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)
