"""ROS nodes of the control loop: state estimator, any registered controller, supervisor."""

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.registry import ControllerEntry
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.flight.stack import ControllerComponent, Estimator, SupervisorComponent
from beetle_omni_ros.model.schema import parameter, ParameterError
from beetle_omni_ros.ros.graph import NODES
from beetle_omni_ros.ros.node import FlightNode
from beetle_omni_ros.ros.parameters import file_parameter
from beetle_omni_ros.supervisor.interface import SupervisorParameters


class EkfNode(FlightNode):
    """Node of the state estimator."""

    def __init__(self):
        super().__init__('ekf_node', EkfParameters, 'params/ekf.yaml', 'ekf_file',
                         robot_file=file_parameter())
        self.run(Estimator(self.parameters, self.robot))


class ControllerNode(FlightNode):
    """Node of a controller; an exception of the controller is logged and reported."""

    def __init__(self, entry: ControllerEntry):
        more = {} if f'{entry.name}_node' in NODES else {'controller': parameter(
            entry.reference, doc='controller that this node runs')}
        super().__init__(f'{entry.name}_node', entry.parameter_class, entry.parameters_file,
                         f'{entry.name}_file', robot_file=file_parameter(), **more)
        robot = self.robot
        self.run(ControllerComponent(entry.name, entry.make(
            robot, parameters=self.parameters if entry.parameter_class else None), robot))


class SupervisorNode(FlightNode):
    """Node of the supervisor; its parameter controller selects the active one, in flight too."""

    component: SupervisorComponent

    def __init__(self):
        controllers = parameter(
            registry.STANDING_BY,
            doc='controllers that may be active: registered names, or FILE.py:Class')
        super().__init__('supervisor_node', SupervisorParameters, 'params/supervisor.yaml',
                         'supervisor_file', self._changed, changeable=('controller',),
                         controllers=controllers, robot_file=file_parameter())
        names = [registry.find(name).name if ':' in name else name
                 for name in self.parameters.controllers]
        if self.parameters.controller not in names:
            raise ParameterError(f"key 'controller': expected one of {', '.join(names)}, found "
                                 f"'{self.parameters.controller}'")
        self.run(SupervisorComponent(self.parameters, self.robot, names))

    def _changed(self, new):
        answer = self.component.select(new.controller)
        if not answer:
            raise ParameterError(f"key 'controller': {answer.text}")
