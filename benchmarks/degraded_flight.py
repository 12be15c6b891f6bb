"""
Flights with a stopped rotor or a jammed tilt servo, in process, with the truth as estimate.

    python benchmarks/degraded_flight.py --what rotor --from hover --cases 12

Each case starts healthy under the NMPC and loses one actuator. The controller is informed 0.1 s
later. The chosen controller flies to the nearest attitude with a margin and holds it. Flights from
hover also descend in it to the ground. The results are deterministic for a seed.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
import json

import numpy as np

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import Command, PoseTarget, State
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.actuator_health import ActuatorHealth, ALL_HEALTHY
from beetle_omni_ros.robot.holding import Holding
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.tasks import pose_target, random_poses
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.sim.command_link import CommandLink
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.readings import Drive
from beetle_omni_ros.sim.simulator import Simulator

LEVELLING_RATE = SupervisorParameters.load().landing.level.rate     # [rad/s]
NEWS = 0.02             # [rad] change of a stuck joint's angle that updates the controller
SETTLE = 4.0            # [s] to reach the first pose
POSE_TIME = 8.0         # [s] between two poses of random100
RECOVERY = 6.0          # [s] from the loss until the pose must be held
HELD = 1.0              # [s] at the end of which the pose is measured
POSITION, ATTITUDE = 0.03, np.radians(2)    # what counts as held
MARGIN = 1.0            # [m/s^2, rad/s^2] of the pose flown to after the recovery
SINK = 0.3              # [m/s]
ABOVE = 1.0             # [m] above its first pose a flight begins, falling while rotors start
POWERED = (True,) * 4
CONTROLLERS = [name for name, entry in registry.SHIPPED.items() if entry.flies_degraded]


class Robot:
    """Simulator whose actuators can be broken; commands act after the link's delay."""

    def __init__(self, robot, conditions, seed, position, quaternion):
        parameters = SimulatorParameters.load()
        self.sim = Simulator(robot, parameters, conditions, seed)
        self.sim.reset(position, quaternion)
        self._link = CommandLink(robot, parameters.actuators, self.sim.conditions)
        self._joints = self.command = None
        self.broken = ALL_HEALTHY

    def state(self):
        """Advance one tick; return the state of a perfect estimator and of the encoders."""
        self._link.update(self.sim.time)
        tilt, thrust = self.broken.possible(self._link.tilt, self._link.thrust)
        frame = self.sim.step(Drive(tilt, POWERED, thrust))
        self._joints = frame.joints or self._joints
        truth, joints = frame.truth, self._joints
        return State(frame.time, truth.position, truth.velocity, truth.quaternion,
                     truth.angular_velocity, joints.position, joints.velocity, joints.stamp,
                     self.command)

    def send(self, command: Command):
        """Give a command."""
        self._link.push(command, self.sim.time)
        self.command = command


@dataclass
class Case:
    """Poses and lost actuator of a flight, drawn from a seed."""

    first: PoseTarget
    second: PoseTarget
    loss: float         # [s]
    broken: ActuatorHealth


def draw(what, start, number, seed, stuck_at):
    """Case ``number`` of a seed."""
    rng = np.random.default_rng([seed, number])
    if start == 'hover':
        first = second = PoseTarget(np.array([0.0, 0.0, 1.5]), np.array([0.0, 0.0, 0.0, 1.0]))
        loss = SETTLE + rng.uniform(0.0, 0.5)
    else:
        first, second = (pose_target(pose) for pose in random_poses(2, int(rng.integers(2**31))))
        loss = SETTLE + rng.uniform(0.0, POSE_TIME)
    actuator = number % 4
    if what == 'rotor':
        broken = ActuatorHealth(rotors=tuple(i != actuator for i in range(4)))
    else:
        angle = rng.uniform(-np.pi, np.pi) if stuck_at == 'random' else None
        broken = ActuatorHealth(stuck=tuple(
            (np.nan if angle is None else angle) if i == actuator else None for i in range(4)))
    return Case(first, second, loss, broken)


class Flight:
    """One case."""

    def __init__(self, robot, case, controllers, arguments, seed):
        self.robot, self.case = robot, case
        self.body = Robot(robot, arguments.conditions, seed, case.first.position + [0, 0, ABOVE],
                          case.first.quaternion)
        self.controllers, self.flying = controllers, controllers[registry.pilot()]
        self.after = controllers[arguments.controller]
        self.delay = arguments.told_after
        self.reported = ALL_HEALTHY
        self.trace = []
        for controller in controllers.values():
            controller.set_health(ALL_HEALTHY)
            controller.reset()

    def fly(self, target, until, watch=False):
        """Follow a target; return whether the floor was not touched."""
        ticks = round(self.flying.period / self.body.sim.tick)
        while self.body.sim.time < until - 1e-9:
            for _ in range(ticks):
                state = self.body.state()
            if watch and self.body.sim.truth.contact:
                return False
            reference = target.at(state.stamp)
            self.trace.append((state.stamp, *state.position, *state.velocity,
                               np.linalg.norm(reference.position - state.position),
                               rotations.geodesic_angle(reference.quaternion, state.quaternion)))
            if not self.reported.healthy:
                self.update_health(state.tilt)
            self.body.send(self.flying.step(state, target))
        return True

    def update_health(self, tilt):
        """Update the controller's actuator health; stuck joints have their measured angles."""
        broken = self.body.broken
        known = ActuatorHealth(broken.rotors, tuple(
            None if angle is None else float(own) for own, angle in zip(tilt, broken.stuck)))
        changed = self.reported.healthy or any(
            abs(new - old) > NEWS for new, old in zip(known.stuck, self.reported.stuck)
            if new is not None)
        if changed:
            self.reported = known
            self.flying.set_health(known)

    def lose(self):
        """Fly until the loss and until the controller is informed of it."""
        case = self.case
        self.fly(case.first, SETTLE)
        self.fly(case.second, case.loss)
        tilt = self.body.sim.truth.tilt
        broken = ActuatorHealth(case.broken.rotors, tuple(
            float(own) if angle is not None and np.isnan(angle) else angle
            for own, angle in zip(tilt, case.broken.stuck)))
        self.body.broken = broken
        self.start_height = self.body.sim.truth.position[2]
        self.upright = float(rotations.matrix(self.body.sim.truth.quaternion)[2, 2])
        alive = self.fly(case.second, case.loss + self.delay, watch=True)
        if self.after is not self.flying:
            self.after.reset()
        self.flying = self.after
        self.update_health(self.body.state().tilt)
        self.holding = Holding(self.robot, broken)
        return alive

    def recover(self):
        """Outcome as a row."""
        alive = self.lose()
        truth = self.body.sim.truth
        margin = self.holding.parameters.flying_margin
        attitude = self.holding.quickest(truth.quaternion, truth.angular_velocity, truth.tilt,
                                         margin, LEVELLING_RATE)
        target = PoseTarget(self.case.second.position, attitude)
        lost_at = len(self.trace)
        alive = alive and self.fly(target, self.case.loss + RECOVERY, watch=True)
        trace = np.array(self.trace)
        last = trace[trace[:, 0] > self.body.sim.time - HELD]
        return {'alive': bool(alive),
                'held': bool(alive and last[:, 7].max() < POSITION
                             and last[:, 8].max() < ATTITUDE),
                'position_m': float(last[:, 7].max()),
                'attitude_deg': float(np.degrees(last[:, 8].max())),
                'upright': self.upright, 'height_m': float(self.start_height),
                'turn_deg': float(np.degrees(rotations.geodesic_angle(attitude,
                                                                      truth.quaternion))),
                'margin_at_loss': self.holding.margin(truth.quaternion),
                'lowest_m': float(trace[lost_at - 10:, 3].min()),
                'time_s': float(self.body.sim.time - self.case.loss)}, target

    def pose(self):
        """Fly to the nearest feasible pose; return the final errors, or None."""
        target = PoseTarget(self.case.second.position, self.holding.nearest(
            self.case.second.quaternion, MARGIN))
        if not self.fly(target, self.body.sim.time + RECOVERY, watch=True):
            return None
        last = np.array(self.trace)[-round(HELD / self.flying.period):, 7:]
        return [float(last[:, 0].max()), float(np.degrees(last[:, 1].max()))]

    def land(self, target):
        """Sink in the attitude of ``target``; speed at the first touch [m/s] or None."""
        start = self.body.sim.time
        while self.body.sim.time < start + 15:
            speed = self.body.sim.truth.velocity[2]
            height = target.position[2] - SINK * (self.body.sim.time - start)
            ramp = PoseTarget(np.r_[target.position[:2], height], target.quaternion)
            if not self.fly(ramp, self.body.sim.time + self.flying.period, watch=True):
                return float(-speed)
        return None


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0].strip())
    parser.add_argument('--cases', type=int, default=12)
    parser.add_argument('--first', type=int, default=0, help='number of the first case')
    parser.add_argument('--only', type=int, nargs='*',
                        help='numbers of the cases, in place of these')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--what', choices=('rotor', 'servo'), default='rotor')
    parser.add_argument('--from', dest='start', choices=('hover', 'random'), default='hover')
    parser.add_argument('--stuck-at', choices=('random', 'here'), default='random')
    parser.add_argument('--controller', choices=CONTROLLERS, default=registry.DEFAULT)
    parser.add_argument('--told-after', type=float, default=0.1,
                        help='from the loss until the controller is informed [s]')
    parser.add_argument('--conditions', choices=('nominal', 'published'), default='nominal')
    parser.add_argument('--poses', action='store_true',
                        help='afterwards fly to the nearest feasible pose')
    parser.add_argument('--json', help='write all rows into this file')
    arguments = parser.parse_args()
    robot = RobotParameters.load()
    controllers = {name: registry.make(name, robot) for name in CONTROLLERS}
    rows = []
    print('case alive held    m    deg  upright height  turn margin lowest touchdown')
    for number in arguments.only or range(arguments.first,
                                          arguments.first + arguments.cases):
        case = draw(arguments.what, arguments.start, number, arguments.seed, arguments.stuck_at)
        flight = Flight(robot, case, controllers, arguments, number)
        row, target = flight.recover()
        row['case'] = number
        row['pose_m_deg'] = flight.pose() if row['alive'] and arguments.poses else None
        row['touchdown_m_s'] = flight.land(target) \
            if row['alive'] and arguments.start == 'hover' else None
        rows.append(row)
        print(f"{number:4d} {row['alive']!s:5} {row['held']!s:5} {row['position_m']:5.3f} "
              f"{row['attitude_deg']:5.1f} {row['upright']:7.2f} {row['height_m']:6.2f} "
              f"{row['turn_deg']:5.0f} {row['margin_at_loss']:6.2f} {row['lowest_m']:6.2f} "
              f"{row['touchdown_m_s']} {row['pose_m_deg']}", flush=True)
    alive, held = (sum(row[key] for row in rows) for key in ('alive', 'held'))
    print(f'{arguments.what}, from {arguments.start}, {arguments.controller}: '
          f'{alive} of {len(rows)} in the air, {held} hold the pose')
    if arguments.json:
        with open(arguments.json, 'w', encoding='utf-8') as file:
            json.dump({'arguments': vars(arguments), 'rows': rows}, file, indent=1)


if __name__ == '__main__':
    main()
