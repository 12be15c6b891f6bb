"""Run nodes in one process: start, spin, stop; errors in one line, exit status with meaning."""

from __future__ import annotations

from collections.abc import Sequence
import gc
import signal
import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from beetle_omni_ros.nodes.instance import StartError
from beetle_omni_ros.robot.schema import ParameterError

OK, FAILED, UNUSABLE = 0, 1, 2
# The events executor of Jazzy dispatches nothing in the calls that take no timeout.
FOREVER = 1e8


def main(node_class: type, args: Sequence[str] | None = None) -> None:
    """Entry point of a node's executable."""
    argv = list(sys.argv if args is None else args)
    rest = remove_ros_args(argv)[1:]
    name = node_class.__module__.rsplit('.', 1)[-1]
    if rest:
        usage = f'usage: {name} [--ros-args -p KEY:=VALUE --params-file FILE ...]'
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
    try:
        rclpy.init(args=list(argv))
        executor = make_executor()
        for node_class in node_classes:
            name = node_class.__module__.rsplit('.', 1)[-1]
            node = node_class()
            nodes.append(node)
            executor.add_node(node)
        # What start-up made lives as long as the process: keep the collector off it, so
        # that no pause of some 10 ms lands in a control cycle.
        gc.collect()
        gc.freeze()
        executor.spin_until_future_complete(Future(), FOREVER)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ParameterError as error:
        status = _fail(name, error, UNUSABLE)
    except (StartError, OSError) as error:
        status = _fail(name, error, FAILED)
    except rclpy.exceptions.ROSInterruptException:
        pass
    except Exception as error:
        if rclpy.ok() and not _of_ros_arguments(error):
            raise
        status = _fail(name, error, UNUSABLE)
    finally:
        # A second signal, forwarded by a launch system, must not cut the clean-up short.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        for node in reversed(nodes):
            close = getattr(node, 'close', None)
            if close:
                close()
            node.destroy_node()
        rclpy.try_shutdown()
    return status


def make_executor():
    """Make the events executor, or the plain one on a distribution without it."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor
        return SingleThreadedExecutor()
    return EventsExecutor()


def _of_ros_arguments(error):
    return type(error).__name__ in ('RCLInvalidROSArgsError', 'UnknownROSArgsError')


def _fail(name, error, status):
    text = ' '.join(str(error).split())
    print(f'{name}: error: {text}', file=sys.stderr, flush=True)
    return status
