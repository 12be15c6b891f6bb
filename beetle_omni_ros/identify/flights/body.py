"""Body equations with every effect's parameters as symbols, for many samples at once."""

import casadi as ca
import numpy as np

from beetle_omni_ros.identify.flights.keys import Key, MODULES
from beetle_omni_ros.model import dynamics, native
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.parameters import RobotParameters

WIDTHS = {'velocity': 3, 'quaternion': 4, 'rate': 3, 'tilt': 4, 'thrust': 4, 'tilt_rate': 4,
          'tilt_acceleration': 4, 'thrust_rate': 4, 'position': 3, 'voltage': 1,
          'modules': 1}


class BodyModel:
    """
    Expected specific force and angular acceleration for measured states.

    Args:
        robot: parameters of the robot file with its effects.
        keys: keys of the catalogue and the extra ones.
        modules: module inertia [kg m^2] and mass moment [kg m] of the robot file.

    Attributes:
        names: keys of the parameter vector, in order.
        slow: effects whose states (N, 4) are inputs.

    """

    def __init__(self, robot: RobotParameters, keys: dict[str, Key],
                 modules: tuple[float, float]):
        self.names = [name for name, key in keys.items() if key.body]
        self._index = {name: k for k, name in enumerate(self.names)}
        self._p = p = ca.SX.sym('p', len(self.names))
        self.slow = [name for name, effect in CATALOGUE.items() if effect.rate]
        widths = WIDTHS | {f'state of {name}': 4 for name in self.slow}
        self._x = x = {name: ca.SX.sym(name, width) for name, width in widths.items()}
        effects: dict[str, dict] = {}
        searched = {key.effect for key in keys.values()}
        for name, effect in CATALOGUE.items():
            if effect.apply is None:
                continue
            if name not in searched:    # without a treatment, it acts as the robot file has it
                effects |= {name: robot.effects[name]} if name in robot.effects else {}
                continue
            effects[name] = {parameter: robot.effects[name][parameter] if spec.text
                             else self._symbol(keys, name, parameter)
                             for parameter, spec in effect.parameters.items()}
        if MODULES not in robot.effects:
            share = x['modules']
            own = effects[MODULES]
            effects[MODULES] = {
                'module_inertia': own['module_inertia'] + share * modules[0],
                'mass_moment': own['mass_moment'] + share * modules[1]}
        places = ca.SX(robot.rotors.positions)
        for k in range(12):
            places[k // 3, k % 3] += p[self._index[f'position.offset[{k}]']]
        acceleration, turning = dynamics.rigid_body(
            robot, x['velocity'], x['quaternion'], x['rate'], x['tilt'], x['thrust'],
            tilt_acceleration=x['tilt_acceleration'], effects=effects, tilt_rate=x['tilt_rate'],
            thrust_rate=x['thrust_rate'], position=x['position'], voltage_ratio=x['voltage'],
            states={name: x[f'state of {name}'] for name in self.slow}, rotor_positions=places)
        rotation = dynamics.rotation_matrix(x['quaternion'])
        force = rotation.T @ (acceleration + ca.DM([0, 0, robot.gravity]))
        self._out = ca.cse(ca.densify(ca.vertcat(force, turning)))
        self._function = native.compiled(ca.Function('body', [*x.values(), p], [self._out]))
        self._maps: dict = {}

    def _symbol(self, keys, name, parameter):
        found = [key for key in keys.values() if key.effect == name
                 and key.parameter == parameter]
        result = []
        for key in found:
            symbol = self._p[self._index[key.name]]
            result.append(key.base * ca.exp(symbol) if key.relative else key.base + symbol)
        return result[0] if found[0].index is None else tuple(result)

    def _over(self, what, count, make):
        """The function mapped over ``count`` samples, as buffer and evaluation."""
        if (what, count) not in self._maps:
            function = make()
            self._maps[what, count] = function.map(
                f'{function.name()}_{count}', 'serial', count, [len(self._x)], []).buffer()
        return self._maps[what, count]

    def __call__(self, inputs: dict[str, np.ndarray], theta: dict[str, float]) -> np.ndarray:
        """(N, 6) specific force [m/s^2] and angular acceleration [rad/s^2] of the samples."""
        count = len(inputs['voltage'])
        return self._called(self._over('', count, lambda: self._function), inputs,
                            theta, np.empty((count, 6)))

    def derivatives(self, inputs: dict[str, np.ndarray], theta: dict[str, float],
                    names: tuple[str, ...]) -> np.ndarray:
        """(N, 6, len(names)) exact derivatives by the named keys."""
        count = len(inputs['voltage'])
        chosen = [self._index[name] for name in names]

        def make():
            jacobian = ca.densify(ca.jacobian(self._out, self._p[chosen]))
            return ca.Function('slopes', [*self._x.values(), self._p], [ca.cse(ca.vec(jacobian))])

        flat = self._called(self._over(names, count, make), inputs, theta,
                            np.empty((count, len(names), 6)))
        return flat.transpose(0, 2, 1)

    def _called(self, function, inputs, theta, result):
        """
        Evaluate in place; CasADi's conversion of arrays would take longer than the equations.

        ``function`` is a pair of buffer and evaluation. The memory order of inputs (N, width)
        equals CasADi's (width, N).
        """
        buffer, evaluate = function
        vector = np.array([theta.get(name, 0.0) for name in self.names])
        arrays = [np.ascontiguousarray(one, dtype=float) for one in (
            *(inputs[name] for name in self._x), vector)]
        for index, array in enumerate(arrays):
            buffer.set_arg(index, memoryview(array))        # type: ignore[arg-type]
        buffer.set_res(0, memoryview(result))
        evaluate()
        return result


def tilting_modules(robot: RobotParameters) -> tuple[float, float]:
    """Inertia about the joint [kg m^2] and mass moment [kg m] of a module of the file."""
    if robot.multibody is None:
        return 0.0, 0.0
    module = robot.multibody.module
    depth = -float(module.centre_of_mass[2])
    return float(module.inertia[0] + module.mass * depth**2), float(module.mass * depth)
