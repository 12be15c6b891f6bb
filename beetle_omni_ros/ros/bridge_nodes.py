"""ROS lifecycle nodes of the bridges; :mod:`~beetle_omni_ros.flight.bridges` has their rules."""

from functools import partialmethod

from rclpy.lifecycle import LifecycleNodeMixin, TransitionCallbackReturn

from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters, ServoBusParameters
from beetle_omni_ros.drivers.serial_port import SerialPortError
from beetle_omni_ros.drivers.servo_xc330 import ServoBusError
from beetle_omni_ros.flight import bridges
from beetle_omni_ros.model.schema import parameter
from beetle_omni_ros.ros.graph import AUTOSTART
from beetle_omni_ros.ros.node import file_parameter, FlightNode

RETRY = 1.0             # [s] between attempts to start by itself


class BridgeNode(LifecycleNodeMixin, FlightNode):
    """
    A node whose lifecycle calls the methods of a :class:`~beetle_omni_ros.flight.bridges.Bridge`.

    ServoBusError and SerialPortError refuse a transition. Their text goes to the log and to
    ``refusal`` of the bridge, and the state stays as it was.
    """

    component: bridges.Bridge

    def __init__(self, name, *args, autostart):
        FlightNode.__init__(
            self, name, *args, robot_file=file_parameter(), autostart=parameter(
                autostart, choices=tuple(AUTOSTART),
                doc='transition at the start, repeated until it succeeds'))
        LifecycleNodeMixin.__init__(self)
        self._start_timer = None
        self._starts = False    # during an automatic transition
        # In rclpy, an impossible transition ends the process.
        self._answer_change = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state

    @property
    def stage(self) -> str:
        """Name of the present state."""
        return self._state_machine.current_state[1]

    def run(self, component):
        """Connect the bridge; go to the state of ``autostart``, repeat until it succeeds."""
        super().run(component)
        if AUTOSTART[self.parameters.autostart]:
            self._start_timer = self.create_timer(RETRY, self.try_to_start,
                                                  clock=self.steady_clock)
            self.try_to_start()
        self._changed()
        return self

    def _changed(self):
        self.component.stage = self.stage
        self.component.changed()

    def try_to_start(self) -> None:
        """Make the next transitions of the automatic start."""
        self._starts, goal = True, AUTOSTART[self.parameters.autostart]
        if self.stage == bridges.UNCONFIGURED:
            self.trigger_configure()
        if self.stage == bridges.INACTIVE and goal == bridges.ACTIVE:
            self.trigger_activate()
        if self.stage not in (bridges.UNCONFIGURED, bridges.INACTIVE) or self.stage == goal:
            self._start_timer.cancel()
        self._starts = False
        self._changed()

    def _attempt(self, what, action, state):
        """Make a transition by a method; any but the first two ends the automatic start."""
        if what not in ('configure', 'activate') and self._start_timer is not None:
            self._start_timer.cancel()
        component = self.component
        before, component.refusal = component.refusal, ''
        try:
            getattr(component, action)()
        except (ServoBusError, SerialPortError) as error:
            if what == 'configure':
                component.release()
            component.refusal = ' '.join(str(error).split())
            if component.refusal != before:      # attempts are repeated, lines are not
                self.log('info' if self._starts else 'error',
                         f'cannot {what}: {component.refusal}'
                         + ('; tries again' if self._starts else ''))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:      # rclpy does not log it
            self.get_logger().fatal(f'cannot {what}: {type(error).__name__}: {error}')
            raise
        return TransitionCallbackReturn.SUCCESS

    on_configure = partialmethod(_attempt, 'configure', 'configure')
    on_activate = partialmethod(_attempt, 'activate', 'activate')
    on_deactivate = partialmethod(_attempt, 'deactivate', 'deactivate')
    on_cleanup = partialmethod(_attempt, 'clean up', 'release')
    on_shutdown = partialmethod(_attempt, 'shut down', 'release')

    def on_error(self, state):
        """Close the device after an unexpected exception; it can be configured again."""
        self.component.release()
        return TransitionCallbackReturn.SUCCESS

    def close(self):
        """Switch the device off."""
        self.component.close()

    def _on_change_state(self, request, response):
        try:
            self._answer_change(request, response)
        except Exception as error:      # rclpy does not export the class
            if 'RCLError' not in type(error).__name__:
                raise
            self.get_logger().warning(f'refused: no such transition from {self.stage}')
            response.success = False
        self._changed()
        return response


def joint_bridge_node() -> FlightNode:
    """Make the node of the bridge of the tilt servos."""
    node = BridgeNode('joint_bridge_node', ServoBusParameters, 'params/servo_bus.yaml',
                      'servo_bus_file', autostart='none')
    return node.run(bridges.JointBridge(node.parameters, node.robot))


def rotor_bridge_node() -> FlightNode:
    """Make the node of the bridge of the motor board."""
    node = BridgeNode('rotor_bridge_node', MotorBoardParameters, 'params/motor_board.yaml',
                      'motor_board_file', autostart='activate')
    return node.run(bridges.RotorBridge(node.parameters, node.robot))
