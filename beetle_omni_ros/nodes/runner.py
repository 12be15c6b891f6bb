"""Run nodes in one process: start, spin, stop; errors in one line, exit status with meaning."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import contextmanager
import ctypes
import gc
import os
import re
import signal
import socket
import sys
import threading

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from beetle_omni_ros.nodes import discovery
from beetle_omni_ros.nodes.node import StartError
from beetle_omni_ros.robot.schema import load_yaml, ParameterError

OK, FAILED, UNUSABLE = 0, 1, 2
# The events executor of Jazzy dispatches nothing in the calls that take no timeout.
FOREVER = 1e8
# A driver gives a servo 3 ms for its answer, so that no thread may keep the interpreter to itself
# for the usual 5 ms.
THREAD_SWITCH = 0.0005  # s
REAL_TIME_PRIORITY = 1  # lowest of the real-time ones: above every ordinary process
PR_SET_PDEATHSIG = 1    # of linux/prctl.h
ENDING = (signal.SIGINT, signal.SIGTERM)


def main(node_class: type, args: Sequence[str] | None = None) -> None:
    """Entry point of a node's executable."""
    argv = list(sys.argv if args is None else args)
    name = executable(node_class)
    rest = own_arguments(argv, name)
    if rest:
        usage = (f'usage: {name} [{discovery.ARGUMENT} RANGE] '
                 '[--ros-args -p KEY:=VALUE --params-file FILE ...]')
        if rest[0] in ('-h', '--help'):
            print(f'{usage}\n\n{(node_class.__doc__ or "").strip()}')
            sys.exit(OK)
        print(f"{name}: unknown argument '{rest[0]}'; {usage}", file=sys.stderr)
        sys.exit(UNUSABLE)
    sys.exit(run([node_class], argv, name))


def run(node_classes: Sequence[type], argv: Sequence[str], name: str) -> int:
    """
    Run the nodes on one events executor until a signal or a fatal error.

    Args:
        node_classes: each called without arguments.
        argv: program name and ROS arguments.
        name: of the process, for messages.

    Returns:
        Exit status: 0 stopped by a signal, 1 failed, 2 unusable parameters.

    """
    nodes, status = [], OK
    signal.signal(signal.SIGTERM, signal.default_int_handler)   # while starting, as Ctrl-C
    end_with_parent()
    try:
        discovery.confine()
        # Not rclpy's handlers: they end the context under a callback that still publishes.
        rclpy.init(args=list(argv), signal_handler_options=SignalHandlerOptions.NO)
        executor = make_executor()
        for node_class in node_classes:
            name = executable(node_class)
            node = node_class()
            nodes.append(node)
            node.introduce()
            executor.add_node(node)
        # What start-up made lives as long as the process: keep the collector off it, so
        # that no pause of some 10 ms lands in a control cycle.
        gc.collect()
        gc.freeze()
        if any(getattr(node, 'real_time', False) for node in nodes):
            sys.setswitchinterval(THREAD_SWITCH)
        # Alone in its process a node shares the processor as any other: real-time processes
        # that wait for one another have held up the simulator for a third of a second.
        if len(nodes) > 1 and any(getattr(node, 'real_time', False) for node in nodes):
            run_before_others()
        executor.spin_until_future_complete(_stop_on_signal(), FOREVER)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ParameterError as error:
        status = _fail(name, error, UNUSABLE)
    except (StartError, OSError) as error:
        status = _fail(name, error, FAILED)
    finally:
        # A second signal, forwarded by a launch system, must not cut the clean-up short.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        for node in reversed(nodes):
            node.destroy_node()
        rclpy.try_shutdown()
    return status


def own_arguments(argv: Sequence[str], name: str) -> list[str]:
    """
    Arguments that are neither for ROS nor for discovery, which is confined here.

    Ends the process when those are unusable.
    """
    try:
        _check_parameter_files(argv)
        return discovery.take(remove_ros_args(list(argv))[1:])
    except Exception as error:
        # rclpy does not export the class of what it raises on bad arguments.
        if not isinstance(error, ParameterError) and 'ROSArgs' not in type(error).__name__:
            raise
        sys.exit(_fail(name, error, UNUSABLE))


def executable(node_class: type) -> str:
    """Name of a node's executable, its own or of its class: EkfNode -> ekf_node."""
    return getattr(node_class, 'executable', '') \
        or re.sub(r'(?<=[a-z])(?=[A-Z])', '_', node_class.__name__).lower()


def make_executor(context=None):
    """Make the events executor, or the plain one on a distribution without it."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def _stop_on_signal() -> Future:
    """
    Make a future that SIGINT or SIGTERM completes, between two callbacks.

    Python runs a signal handler only when the main thread is in Python, which in an idle
    node may take a second; the wake-up descriptor is written at once.
    """
    stop = Future()
    waiting, written = socket.socketpair()
    written.setblocking(False)

    def wait():
        waiting.recv(1)
        stop.set_result((waiting, written))     # keeps both ends open for further signals

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    signal.set_wakeup_fd(written.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=wait, daemon=True).start()
    return stop


def run_before_others():
    """
    Give every thread so far real-time priority, where the system allows it.

    On a busy computer this is what keeps commands in time. Only after the start, which
    may compile for seconds; Linux itself leaves 5 % to the rest, whatever happens here.
    """
    try:
        for thread in os.listdir('/proc/self/task'):
            os.sched_setscheduler(int(thread), os.SCHED_RR, os.sched_param(REAL_TIME_PRIORITY))
    except (OSError, AttributeError):
        pass        # not permitted, or not Linux: as any other process


def end_with_parent():
    """Let Linux stop this process when the one that started the graph dies, even by SIGKILL."""
    parent = os.environ.get('BEETLE_OMNI_PARENT')
    if parent and sys.platform == 'linux':
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != int(parent):     # it was gone already
            os.kill(os.getpid(), signal.SIGTERM)


def _check_parameter_files(argv):
    """Refuse unusable files by file and line; ROS would answer with a traceback."""
    for flag, path in zip(argv, argv[1:]):
        if flag == '--params-file':
            load_yaml(path)


def _fail(name, error, status):
    text = ' '.join(str(error).split())
    print(f'{name}: error: {text}', file=sys.stderr, flush=True)
    return status


@contextmanager
def terminable():
    """
    Let SIGTERM end what is inside as Ctrl-C does, so that nothing is left behind.

    The first signal counts; those that follow do not cut the cleaning up short.

    Raises:
        KeyboardInterrupt: one of the signals came, whatever a library made of it.

    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came = []

    def interrupt(number, _):
        came.append(number)
        for each in ENDING:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in ENDING}
    try:
        yield
    except Exception:
        if came:
            raise KeyboardInterrupt from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def undisturbed():
    """Let signals wait: who cleans up has been told already, and a launch system tells twice."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, signal.SIG_IGN) for number in ENDING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
