"""`beetle_omni drive`: targets from the keyboard, a joystick or lines of text."""

from contextlib import closing, ExitStack
from functools import partial
import os
from pathlib import Path
import select
import sys
import termios
import tty

import numpy as np
from sensor_msgs.msg import Joy

from beetle_omni_ros.bags.topics import SENSOR
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.control.targets import TargetChecks
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.rotations import BodyState
from beetle_omni_ros.model.schema import ParameterError, RunError
from beetle_omni_ros.ros import drive, wire
from beetle_omni_ros.ros.clients import Operator
from beetle_omni_ros.ros.drive import Action, DriveParameters, Steering
from beetle_omni_ros.ros.runner import sigterm_as_interrupt

PERIOD = 0.05           # s between two targets
SUPERVISOR_TIMEOUT = 10.0   # s until the supervisor and the estimate must have appeared
SETTLE_TIME = 0.5       # s that `wait` takes at least, so that the motion has begun
NEAR, ALIGNED = 0.1, np.radians(10)     # [m], [rad] within which the robot is at its target


class Driver(Operator):
    """
    Operator that publishes target_pose while a controller flies.

    Attributes:
        odom: newest estimate, or None.
        steering: motion of the target; None while no controller flies.

    """

    def __init__(self, domain: int | None, parameters: DriveParameters, robot: RobotParameters):
        super().__init__(domain)
        self._p, self._checks = parameters, TargetChecks(robot)
        self.odom: BodyState | None = None
        self.steering: Steering | None = None
        self.axes, self.buttons, self.joy_at = (), (), -np.inf
        node = self._node
        wire.subscribe(node, 'odom', partial(setattr, self, 'odom'), qos=SENSOR)
        node.create_subscription(Joy, 'joy', self._on_joy, wire.profile(SENSOR))
        self._targets = wire.Publisher(node, 'target_pose')
        self._sent = None

    def _on_joy(self, message):
        self.axes, self.buttons, self.joy_at = message.axes, message.buttons, self.time()

    @property
    def flies(self) -> bool:
        """Whether a controller flies, and so follows targets."""
        return bool(self.state.controller)

    @property
    def at_goal(self) -> bool:
        """Whether the robot is at its goal; if no controller flies, whether it is at rest."""
        if not self.flies:
            return self.state.motors_off
        steering = self.steering
        return steering is not None and steering.arrived and self.odom is not None and bool(
            np.linalg.norm(self.odom.position - steering.position) < NEAR) and \
            rotations.geodesic_angle(self.odom.quaternion, steering.quaternion) < ALIGNED

    def is_under_way(self, begin: float, seconds: float | None) -> bool:
        """Whether a `wait` since ``begin`` continues, for ``seconds`` or until the goal [s]."""
        passed = self.time() - begin
        if seconds is None:
            return passed <= SETTLE_TIME or not self.at_goal
        return passed < seconds

    def follow(self, seconds: float) -> str:
        """Move the target for ``seconds`` and publish it if it changed; return '' or a refusal."""
        if not self.flies or self.odom is None:
            self.steering = self._sent = None
            return ''
        if self.steering is None:
            self.steering = Steering(self._p, self._checks.why_not_pose, self.odom.position,
                                     self.odom.quaternion)
        refused = self.steering.update(seconds, self.odom.position)
        pose = (*self.steering.position, *self.steering.quaternion)
        if pose != self._sent and not (self._sent is None and self.steering.arrived):
            self._sent = pose
            self._targets.publish(PoseTarget(self.steering.position, self.steering.quaternion))
        return refused

    def execute(self, action: Action) -> str:
        """Execute an action; return the text for the user."""
        name, values = action
        if name in ('arm', 'land', 'emergency_stop'):
            accepted, answer = self.call(name)
            return f"{name}: {answer or ('done' if accepted else 'refused')}"
        if name == 'controller':
            names, now = list(registry.STANDING_BY), self.state.controller
            other = names[(names.index(now) + 1) % len(names)] if now in names else names[0]
            wanted = values[0] if values else other
            accepted, answer = self.set('supervisor_node', 'controller', wanted)
            return f'controller {wanted}' + ('' if accepted else f': {answer}')
        if name == 'where':
            return self.where()
        if self.steering is None:
            return f"nothing flies (supervisor in '{self.state or 'unknown'}'); arm first"
        position, quaternion = self.steering.goal
        if name == 'shift':
            return self.steering.shift(*values)
        if name == 'goto':
            place, attitude = values
            return self.steering.go(place, quaternion if attitude is None else attitude)
        if name == 'hold':
            self.steering.hold()
            return ''
        level = rotations.from_rpy(0.0, 0.0, rotations.to_rpy(quaternion)[2])
        return self.steering.go(position, level)

    def where(self) -> str:
        """Return state, pose of the robot and of its target in one line."""
        parts = [self.state or 'no supervisor']
        for name, at in (('at', self.odom), ('target', self.steering)):
            if at is not None:
                angles = np.degrees(rotations.to_rpy(at.quaternion))
                parts.append(f"{name} {' '.join(f'{x:.2f}' for x in at.position)} m, "
                            f"{' '.join(f'{a:.0f}' for a in angles)} deg")
        return '; '.join(parts)


def run_drive(source: str, *, parameters: Path | None = None, robot: Path | None = None,
              domain_id: int | None = None) -> None:
    """
    Drive until the user quits; arguments as of `beetle_omni drive`.

    Raises:
        ParameterError: unusable input.
        RunError: no supervisor or estimate found.

    """
    p = DriveParameters.load(parameters)
    robot_parameters = RobotParameters.load(robot)
    if source == 'keyboard' and not sys.stdin.isatty():
        raise ParameterError('keyboard: standard input is no terminal; expected one, or the '
                             "source 'terminal', which reads lines")
    with ExitStack() as stack:
        stack.enter_context(sigterm_as_interrupt())
        driver = Driver(domain_id, p, robot_parameters)
        stack.callback(driver.close)

        def say(text):
            if text:
                print(text, flush=True)

        if not driver.wait(lambda: driver.answers and driver.state and driver.odom is not None,
                           SUPERVISOR_TIMEOUT):
            missing = 'odom' if driver.answers and driver.state else 'supervisor_node'
            raise RunError(f'{missing}: not seen in ROS domain {driver.domain}; expected a '
                           'running graph (bringup.launch.py, or beetle_omni fly)')
        say(driver.where())
        before = driver.time()
        try:
            for actions in stack.enter_context(closing(SOURCES[source](driver, p, say))):
                for action in actions:
                    say(driver.execute(action))
                now = driver.time()
                say(driver.follow(now - before))
                before = now
                driver.spin(PERIOD)
        finally:    # also at Ctrl-C
            say('left; the robot holds its last target')


# Each source is a generator of the actions since its last step; it ends when the user leaves.

def _typed(size=4096) -> str | None:
    """Return what was typed since the last call, '' at the end of the input, or None."""
    if not select.select([sys.stdin], [], [], 0)[0]:
        return None
    return os.read(sys.stdin.fileno(), size).decode(errors='replace')


def keyboard(driver, p, say):
    """Yield the actions of single keys of a terminal, which does not echo meanwhile."""
    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        say(drive.KEY_HELP)
        while True:
            found, typed = [], _typed(64)
            for key in 'q' if typed == '' else typed or '':
                shift, word = drive.shift_of_key(key, p), drive.KEY_WORDS.get(key)
                if word == 'quit':
                    yield found
                    return
                if shift:
                    found.append(('shift', shift))
                elif word:
                    found.append(drive.parse(word, p.poses) if word in p.poses else (word, ()))
            yield found
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def joystick(driver, p, say):
    """Yield the actions of the topic joy until Ctrl-C."""
    say('joy: sticks move and turn, buttons arm, land, hold, home; Ctrl-C leaves')
    buttons, before = (), driver.time()
    while True:
        found, now = [], driver.time()
        if now - driver.joy_at <= p.joystick_timeout:
            found += [drive.parse(name, p.poses)
                      for name in drive.pressed(buttons, driver.buttons, p)]
            buttons = tuple(driver.buttons)
            way, turn = drive.shift_of_sticks(driver.axes, now - before, p)
            if driver.steering is not None and (way.any() or turn.any()):
                found.append(('shift', (way, turn)))
        before = now
        yield found


def terminal(driver, p, say):
    """Yield the actions of lines of standard input; its end acts as `wait` and `quit`."""
    options = f'{drive.HELP}, or the name of a pose'
    say(options)
    text, wait = '', None       # `wait` in progress: its begin [s] and duration [s] or None
    while True:
        found = []
        while wait is None or not driver.is_under_way(*wait):
            wait = None
            if '\n' not in text and (typed := _typed()) is not None:
                text += typed or '\nwait\nquit\n'
            if '\n' not in text:
                break
            line, _, text = text.partition('\n')
            try:
                action = drive.parse(line, p.poses)
            except ParameterError as error:
                say(str(error))
                continue
            name, values = action or ('', ())
            if name == 'quit':
                yield found
                return
            if name == 'help':
                say(f"{options}: {', '.join(p.poses)}")
            elif name == 'wait':
                wait = driver.time(), values[0] if values else None
            elif action is not None:
                found.append(action)
        yield found


SOURCES = {'keyboard': keyboard, 'joystick': joystick, 'terminal': terminal}
