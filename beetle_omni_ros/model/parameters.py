"""Parameters of the robot, and the reader of robot files."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
import hashlib
import json
from os.path import isfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from beetle_omni_ros.model import schema
from beetle_omni_ros.model.effects import CATALOGUE, delaying, settings, validated
from beetle_omni_ros.model.parts import (
    BatteryParameters,
    JointParameters,
    MultibodyParameters,
    RotorParameters,
)
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import parameter, ParameterError, quoted
from beetle_omni_ros.model.terms import SensorErrors

JOINT_NAMES = ('gimbal1', 'gimbal2', 'gimbal3', 'gimbal4')
ROTOR_NAMES = ('rotor1', 'rotor2', 'rotor3', 'rotor4')
TILT_LAG = 'tilt_lag'   # interval of a property; the logs determine it better than its parts
# What the file of one effect has beside its parameters.
EFFECT_NOTES = 'units', 'intervals', 'source'
DRAWS = 1000            # of a robot with such a lag, of which the logs allow a fifth


@dataclass(frozen=True, kw_only=True)
class RobotParameters:
    """All parameters of one robot; effects are effect -> parameter -> value."""

    mass: float = parameter(doc='total mass', unit='kg', low=0.005, high=200)
    gravity: float = parameter(9.80665, doc='gravity', unit='m/s^2', low=0, high=30)
    inertia: np.ndarray = parameter(doc='diagonal', unit='kg m^2', shape=(3,), low=1e-6, high=100)
    rotors: RotorParameters = parameter(doc='rotors')
    joints: JointParameters = parameter(doc='tilt servos')
    battery: BatteryParameters = parameter(doc='battery')
    multibody: MultibodyParameters | None = parameter(
        None, doc='parts; without them tilting parts have no mass')
    name: str = parameter('robot', doc='name of the robot')
    effects: dict = parameter({}, doc='known deviations from the model, by catalogue name')
    intervals: dict = parameter(
        {}, doc='95 % intervals of measured values, dotted key -> [lowest, highest]')
    provenance: dict = parameter({}, doc='origin of a written file, free text')

    def __post_init__(self):
        """Validate the effects and set the numbers that they replace."""
        object.__setattr__(self, 'effects', validated(self.effects))
        for key, value in settings(self.effects).items():
            part, name = key.split('.')
            object.__setattr__(self, part, replace(getattr(self, part), **{
                name: np.array(value) if np.ndim(value) else value}))
        if max(self.hover_thrust, self.rotors.thrust_min) > self.rotors.thrust_max:
            raise ParameterError(
                f'mass {self.mass:g} kg needs {self.hover_thrust:.1f} N a rotor to hover, '
                f'expected rotors.thrust_max ({self.rotors.thrust_max:g} N) above this and above '
                f'rotors.thrust_min ({self.rotors.thrust_min:g} N)')
        if not np.all(np.abs(self.rotors.spin) == 1):
            raise ParameterError(f'rotors.spin must hold +1 or -1, found {self.rotors.spin}')

    def interval(self, key: str) -> tuple:
        """95 % interval (lowest, highest) of a value by its dotted key; unmeasured: the value."""
        value = np.array(value_of(self, key), dtype=float)
        return self.intervals.get(key, (value, value))

    def drawn(self, rng: np.random.Generator) -> RobotParameters:
        """
        A robot with measured values drawn from their intervals, positive ones by ratio.

        The values of one joint have one place in their intervals: logs determine their ratios, the
        lag Kd / Kp and the angle at which friction holds, better than the values. A robot whose
        ``tilt_lag`` is outside its interval contradicts the logs and is drawn again; a
        ParameterError, if each does.
        """
        low, high = self.intervals.get(TILT_LAG, (-np.inf, np.inf))
        for _ in range(DRAWS):
            place = rng.random(4)
            drawn = {key: _between(pair, place if np.shape(pair[0]) == (4,)
                                   else rng.random(np.shape(pair[0])))
                     for key, pair in self.intervals.items() if key != TILT_LAG}
            kp, kd = (drawn.get(f'effects.joint_bandwidth.{name}', getattr(self.joints, name))
                      for name in ('kp', 'kd'))
            lag = kd / kp + drawn.get('effects.joint_command_latency.delay',
                                      self.command_delays[0])
            if np.all((low <= lag) & (lag <= high)):
                break
        else:
            raise ParameterError(f"key 'intervals.{TILT_LAG}': no values of the other intervals "
                                 f'have such a lag, {np.mean([low, high], axis=0).tolist()} s')
        nested = schema.nest({key: value if np.ndim(value) else float(value)
                              for key, value in drawn.items()})
        effects = nested.pop('effects', {})
        own = {name: replace(getattr(self, name), **value) if isinstance(value, dict) else value
               for name, value in nested.items()}
        return replace(self, **own, intervals={}, effects={
            name: values | effects.get(name, {}) for name, values in self.effects.items()})

    @classmethod
    def load(cls, path: str | Path | None = None) -> RobotParameters:
        """
        Read a robot file, see :func:`find_robot`; without a path, the shipped one.

        A file may begin with ``extends: FILE``, a file in the same folder or of the shipped
        params. It then contains the differences only. The intervals of values that differ are
        left out. A ParameterError names file, key and expected value.
        """
        path = find_robot(path) if path else share_path('params/robot.yaml')
        if not path.is_file():
            shipped = sorted(each.stem.removeprefix('robot_')
                             for each in share_path('params').glob('robot_*.yaml'))
            raise ParameterError(f'{path}: no such file; expected a robot file, or one of the '
                                 f"shipped {', '.join(shipped)}")
        robot = schema.bind(cls, _merged(path), str(path))
        try:
            mass_properties(replace(robot, effects={}))     # refuses an impossible main body
        except ParameterError as error:
            raise ParameterError(f'{path}: {error}') from None
        # not in __post_init__, because copies without some effects keep the others' intervals
        intervals = {key: pair for key, pair in robot.intervals.items()
                     if key not in settings(robot.effects)}
        for key, pair in intervals.items():
            try:
                value = np.array(value_of(robot, key), dtype=float)
                low, high = (np.broadcast_to(np.array(bound, dtype=float), value.shape)
                             for bound in pair)
                fits = bool(np.all((low <= value) & (value <= high)))
            except (TypeError, ValueError):
                fits = False
            if not fits:
                raise ParameterError(
                    f"{path}: key 'intervals': {quoted(key)}: expected [lowest, highest] around "
                    f'a number of this file, found {quoted(pair)}')
            intervals[key] = low, high
        return replace(robot, intervals=intervals)

    def effect(self, key: str, neutral):
        """Value of an effect's parameter, 'effect.parameter'; ``neutral`` without the effect."""
        name, parameter = key.split('.')
        return self.effects.get(name, {}).get(parameter, neutral)

    @property
    def torque_ratio(self) -> float:
        """Reaction torque for each newton of thrust with the effects [m]."""
        return self.effect('torque_coefficient.torque_to_thrust_ratio',
                           self.rotors.torque_to_thrust_ratio)

    @property
    def thrust_scale(self) -> np.ndarray:
        """(4,) true thrust relative to the commanded thrust, by the effects."""
        return self.effect('thrust_coefficient.scale', 1.0) * np.array(
            self.effect('rotor_thrust_coefficient.scale', (1.0,) * 4))

    @property
    def parts(self) -> MultibodyParameters:
        """The described parts, else parts from the totals."""
        return self.multibody or MultibodyParameters.from_totals(
            **self.effects.get('module_reaction', {}))

    @property
    def tilt_axes(self) -> np.ndarray:
        """(4, 3) unit tilt axes in base_link, outward along the arms."""
        yaw = self.rotors.arm_yaw
        return np.stack([np.cos(yaw), np.sin(yaw), np.zeros(4)], axis=1)

    def thrust_directions(self, tilt: np.ndarray) -> np.ndarray:
        """(..., 4, 3) unit vectors of the thrusts in base_link at tilts (..., 4) [rad]."""
        level = np.cross(self.tilt_axes, [0.0, 0.0, 1.0])
        return np.sin(tilt)[..., None] * level + np.cos(tilt)[..., None] * [0.0, 0.0, 1.0]

    @property
    def command_delays(self) -> tuple[float, float]:
        """Delays of tilt and of thrust commands [s] by the effects."""
        tilt, thrust = (sum(self.effect(f'{name}.delay', 0.0) for name in delaying(what))
                        for what in ('tilt', 'thrust'))
        return tilt, thrust

    @property
    def tilt_lag(self) -> np.ndarray:
        """(4,) lag of the joints behind a ramp [s], by damping and by the effects' delays."""
        return self.joints.kd / self.joints.kp + self.command_delays[0] + np.zeros(4)

    @property
    def sensors(self) -> SensorErrors:
        """Sensor errors by the effects."""
        return SensorErrors(**{
            spec.sensor: values[parameter] for name, values in self.effects.items()
            for parameter, spec in CATALOGUE[name].parameters.items() if spec.sensor})

    @property
    def hover_thrust(self) -> float:
        """Thrust of each rotor in level hover without effects [N]."""
        return self.mass * self.gravity / 4

    def hash(self) -> str:
        """Short digest of all physical values, for caches."""
        text = yaml.safe_dump(self.as_dict(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def as_dict(self) -> dict:
        """All physical values as plain nested data, without name, intervals and provenance."""
        values = asdict(self)
        del values['name'], values['intervals'], values['provenance']
        return json.loads(json.dumps(values, default=np.ndarray.tolist))


def find_robot(name: str | Path, seen: tuple[Path, ...] = ()) -> Path:
    """
    Path of a robot file: the given one, else a shipped file ``NAME`` or ``robot_NAME.yaml``.

    ``seen`` are files that it must not be; the last one extends it, and relative paths begin in
    the folder of that file. If there is no such file, the path is the given one.
    """
    path, shipped = (seen[-1].parent / name if seen else Path(name)), share_path('params')
    for each in (path, shipped / name, shipped / f'robot_{name}.yaml', shipped / f'{name}.yaml'):
        if isfile(each) and each.resolve() not in seen:
            return each
    return path


def _merged(path: Path, seen: tuple[Path, ...] = ()) -> dict:
    """Content of a robot file, merged with the file that it extends."""
    content = schema.load_yaml(path)
    if isinstance(effects := content.get('effects'), dict):
        content['effects'] = {name: {    # text is the path of a file of one effect
            key: own for key, own in schema.load_yaml(path.parent / value).items()
            if key not in EFFECT_NOTES} if isinstance(value, str) else value
            for name, value in effects.items()}
    if 'extends' not in content:
        return content
    name, seen = content.pop('extends'), (*seen, path.resolve())
    base = find_robot(str(name), seen)
    if not isfile(base) or base.resolve() in seen:
        raise ParameterError(f"{path}: key 'extends': expected the name of another file beside it "
                             f'or among the shipped params, found {quoted(name)}')
    below = _merged(base, seen)
    merged = _overlaid(below, content)
    if 'intervals' in below:    # those of values that the file replaces do not hold for it
        same_lag = all(merged.get(part) == below.get(part) for part in ('joints', 'effects'))
        below['intervals'] = {key: pair for key, pair in below['intervals'].items()
                              if value_of(merged, key) == value_of(below, key)
                              and (key != TILT_LAG or same_lag)}
    return _overlaid(below, content)


def value_of(content: Any, key: str) -> Any:
    """Value of a dotted key of a robot, or of the content of its file; None: it has none."""
    for name in str(key).split('.'):
        content = content.get(name) if isinstance(content, dict) else getattr(content, name, None)
    return content


def _between(interval, share):
    """Value at a share of an interval, of a positive one by ratio."""
    low, high = map(np.array, interval)
    return low * (high / low)**share if np.all(low > 0) else low + (high - low) * share


def _overlaid(base: dict, content: dict) -> dict:
    """Merge nested mappings; ``content`` overrides, and its effects replace those of ``base``."""
    merged = dict(base)
    for key, value in content.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _overlaid(merged[key], value) if both and key != 'effects' else value
    return merged


@dataclass(frozen=True)
class Variation:
    """Deviation of one robot from its file."""

    mass_scale: float = 1.0
    inertia_scale: np.ndarray = field(default_factory=lambda: np.ones(3))
    centre_of_mass: np.ndarray = field(default_factory=lambda: np.zeros(3))  # of the whole [m]


@dataclass(frozen=True)
class RigidPart:
    """Mass [kg], centre of mass (3,) [m], inertia (3, 3) there [kg m^2], in base_link's axes."""

    mass: float
    centre: np.ndarray
    inertia: np.ndarray

    def inertia_about(self, point: np.ndarray) -> np.ndarray:
        """Inertia (3, 3) about ``point`` [m], by the parallel axis theorem."""
        r = self.centre - point
        return self.inertia + self.mass * (r @ r * np.eye(3) - np.outer(r, r))


@dataclass(frozen=True)
class MassProperties:
    """All parts of the robot with its tilts at zero, in base_link."""

    main_body: RigidPart
    modules: tuple[RigidPart, ...]  # tilting, four
    end_effector: RigidPart         # the ball
    main_origin: np.ndarray         # (3,) of the main body's frame [m]
    joint_origins: np.ndarray       # (4, 3) of the tilt joints [m]
    module_rotations: np.ndarray    # (4, 3, 3), columns outward, sideways, up


def combined(parts: list[RigidPart]) -> RigidPart:
    """Combine parts into one rigid part."""
    mass = sum(part.mass for part in parts)
    centre = np.sum([part.mass * part.centre for part in parts], axis=0) / mass
    return RigidPart(mass, centre, sum((part.inertia_about(centre) for part in parts),
                                       np.zeros((3, 3))))


def mass_properties(robot: RobotParameters, variation: Variation | None = None) -> MassProperties:
    """
    Mass properties of all parts.

    The tilt axes contain the rotor centres of ``robot.rotors.positions``. Mass, centre and inertia
    of the main body follow from the totals; a ParameterError, if they are impossible.
    """
    variation = variation or Variation()
    parts, outward = robot.parts, robot.tilt_axes
    up = np.tile([0.0, 0.0, 1.0], (4, 1))
    rotations = np.stack([outward, np.cross(up, outward), up], axis=2)
    joint_origins = robot.rotors.positions - parts.module.rotor_offset * outward
    main_origin = joint_origins.mean(axis=0) - [0.0, 0.0, parts.module.joint_height]
    modules = tuple(
        RigidPart(parts.module.mass, origin + rotation @ parts.module.centre_of_mass,
                  rotation @ np.diag(parts.module.inertia) @ rotation.T)
        for origin, rotation in zip(joint_origins, rotations))
    ball = RigidPart(parts.end_effector.mass, main_origin + [0.0, 0.0, parts.end_effector.height],
                     np.zeros((3, 3)))

    mass = robot.effect('mass.mass', robot.mass) * variation.mass_scale
    total_inertia = np.array(robot.effect('inertia.inertia', robot.inertia))
    centre = variation.centre_of_mass + robot.effect('centre_of_mass.offset', (0.0,) * 3)
    known = [*modules, ball]
    rest = mass - sum(part.mass for part in known)
    if rest <= 0:
        raise ParameterError(f'multibody: modules and end-effector weigh {mass - rest:g} kg, '
                             f'the whole robot {mass:g} kg; expected a main body with mass')
    moment = mass * centre - np.sum([part.mass * part.centre for part in known], axis=0)
    main_body = RigidPart(rest, moment / rest, np.zeros((3, 3)))
    inertia = np.diag(total_inertia * variation.inertia_scale) - sum(
        part.inertia_about(centre) for part in [main_body, *known])
    moments = np.linalg.eigvalsh(inertia)
    if moments[0] <= 0 or moments[0] + moments[1] < moments[2]:
        raise ParameterError(f'inertia: {_text(total_inertia)} kg m^2 leaves the main body the '
                             f'principal moments {_text(moments)} kg m^2, which are impossible')
    return MassProperties(replace(main_body, inertia=inertia), modules, ball, main_origin,
                          joint_origins, rotations)


def _text(numbers):
    return np.array2string(np.asarray(numbers), precision=5, separator=', ', suppress_small=True)
