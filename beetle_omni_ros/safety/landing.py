"""Landing: level out, sink at a set rate, detect the ground, with any remaining estimate."""

from dataclasses import replace
from math import floor, inf, isfinite

import numpy as np

from beetle_omni_ros.control.base import Command, Fallback, Reference, TrajectoryTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import ActuatorHealth, ALL_HEALTHY, Allocator
from beetle_omni_ros.robot.degraded import Holding
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.events import ERROR, EventLog
from beetle_omni_ros.safety.levelling import plan, Way
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.ramp import inclination, Ramp
from beetle_omni_ros.safety.support import SupportGauge
from beetle_omni_ros.safety.turnover import find_turnover, Turnover
from beetle_omni_ros.safety.vehicle import Vehicle

FADING_STEPS = 10       # in which a rotor comes to rest
AT_ONCE = 1e-3          # [s]
AT_REST = 0.5           # [m/s]
FELT = 0.1      # [s] time constant of the force that the ground carries
STILL = 1.0     # [s] without IMU: time without sinking until the ground is detected
AHEAD, BETWEEN = 20.0, 0.1      # [s] length and spacing of the published way


class Landing:
    """
    One descent, stepped by the supervisor.

    Args:
        parameters: rates and thresholds.
        robot: the model.
        hover: the controller.
        allocator: of the robot.
        gauge: share of the weight that the rotors carry.
        vehicle: estimate, joints and raw sensors.
        events: for messages.
        floor: height of base_link on the ground before the flight [m].

    Attributes:
        grounded: whether the robot is on the ground.
        given_up: '' or the reason why a controlled descent is no longer possible.

    """

    def __init__(self, parameters: SupervisorParameters, robot: RobotParameters,
                 hover: Fallback, allocator: Allocator, gauge: SupportGauge, vehicle: Vehicle,
                 events: EventLog, floor: float = 0.0):
        self._parameters, self._blind_limit = parameters.landing, parameters.state.blind_limit
        self._allocator, self._floor = allocator, floor
        self._hover, self._gauge, self._vehicle, self._events = hover, gauge, vehicle, events
        self.grounded, self.given_up = False, ''
        self._standing_for, self._still_for, self._blind_for = 0.0, 0.0, 0.0
        self._support = 0.0     # share of the weight that the rotors do not carry, filtered
        self._blind = False
        self._robot, self._health = robot, ALL_HEALTHY
        self._turnover: Turnover | None = None

    @property
    def way(self) -> TrajectoryTarget:
        """The planned way, for a controller that can fly a trajectory."""
        ramp = self._ramp
        times = ramp.stamp + np.arange(0.0, ramp.wait + AHEAD, BETWEEN)
        samples = [ramp.at(time) for time in times]
        return TrajectoryTarget(times, np.array([one.position for one in samples]),
                                np.array([one.quaternion for one in samples]),
                                np.array([one.velocity for one in samples]),
                                np.array([one.angular_velocity for one in samples]), ramp.stamp)

    def degrade(self, health: ActuatorHealth, now: float, in_force: Command | None) -> None:
        """Continue with the working actuators."""
        self._health = health
        self.set_out(now, in_force)

    def start(self, now: float, in_force: Command | None, distrusted: bool = False) -> None:
        """
        Begin at the present pose, with the estimator or the backup.

        Args:
            now: [s].
            in_force: the executed command.
            distrusted: whether the estimator runs, but is wrong.

        """
        if distrusted:
            self._vehicle.backup.start_from_poses(self._vehicle.known)
        elif self._vehicle.estimate.silent:
            self._vehicle.backup.start(self._vehicle.known)
        self._blind = self._without_mocap
        self.set_out(now, in_force)

    def step(self, now: float, dt: float, in_force: Command | None) -> Command:
        """The command for the present time."""
        vehicle, backup = self._vehicle, self._vehicle.backup
        if not backup.running and vehicle.estimate.silent:
            self._events.say(now, ERROR, f'ekf_node {vehicle.estimate.text}: descent goes on with '
                                         'raw sensors')
            backup.start(vehicle.known)
            self.set_out(now, in_force)
        if self._without_mocap and not self._blind:
            self._blind = True      # the velocity error grows with time: land faster
            self.set_out(now, in_force)
        if not backup.running:
            return self._follow(vehicle.seen(in_force), dt, vehicle.specific_force_up
                                if vehicle.mocap_lost else None)
        dead_reckoning = self._lean_on_what_is_left(now, dt, in_force)
        state = vehicle.seen(in_force, vehicle.backup_state(now))
        return self._follow(state, dt, backup.specific_force_up if dead_reckoning else None)

    def _lean_on_what_is_left(self, now, dt, in_force):
        """Advance the backup; whether it is without MoCap."""
        vehicle = self._vehicle
        no_mocap, no_imu = vehicle.mocap.silent, vehicle.imu.silent
        for gone, name in ((no_mocap, 'MoCap'), (no_imu, 'IMU')):
            if gone:
                self._events.say(now, ERROR, f'{name} is gone too: descent without it',
                                 f'no {name}')
        self._blind_for = self._blind_for + dt if no_mocap and no_imu else 0.0
        if self._blind_for > self._blind_limit:
            self.given_up = 'no estimator, no MoCap, no IMU'
        tilt = vehicle.seen(in_force).tilt
        vehicle.backup.predict(
            now, self._ramp.at(now).velocity if no_mocap else None,
            self._gauge.motion(tilt, self._robot.inertia) if no_imu else None)
        return no_mocap

    def set_out(self, now: float, in_force: Command | None) -> None:
        """Level out and sink from the present pose."""
        vehicle = self._vehicle
        state = vehicle.backup_state(now) if vehicle.backup.running else vehicle.seen(in_force)
        p, blind = self._parameters, self._without_mocap
        level = replace(p.level, rate=p.blind_level_rate) if blind else p.level
        self._end_turnover()
        leap = 0.0, 0.0
        if self._health.healthy:
            way = plan(state.quaternion, state.tilt, self._allocator, level)
        else:
            way, leap = self._way_with_what_is_left(state, level.rate)
        if way.lost > p.turnover.lost_lift and self._begin_turnover(state, level):
            return
        slanted = inclination(state.quaternion) > p.level_first or not self._health.healthy
        wait = way.duration if slanted else 0.0
        height = max(0.0, state.position[2] - self._floor)
        fast = max(0.0, height - p.flare_height) if blind else 0.0
        if fast and self._health.healthy:   # level for the flare: velocity errors grow with time
            wait = max(0.0, wait - fast / p.blind_speed)
        self._ramp = Ramp(state.stamp, state.position, way, wait, *(
            (-fast, p.blind_speed, p.blind_acceleration) if fast
            else (-inf, p.speed, p.acceleration)), leap=leap)
        self._due = now + wait + (height - fast) / p.speed + (
            self._ramp.duration - wait if fast else 0.0)

    def _begin_turnover(self, state, level):
        """Fly to an attitude at which a joint turns over with its rotor off; False if none."""
        found = find_turnover(state.quaternion, state.tilt, self._robot, self._allocator, level,
                              self._parameters.turnover)
        if found is None:
            return False
        way = Way.straight(state.quaternion, found.quaternion, level.rate)
        p = self._parameters
        wait = way.duration + p.turnover.time_limit
        self._turnover, self._arrived, self._share, self._full = found, None, 1.0, 0.0
        self._ramp = Ramp(state.stamp, state.position, way, wait, -inf, p.speed, p.acceleration)
        self._due = inf     # not before the joint has turned
        return True

    def _turn_over(self, found: Turnover, state, command) -> Command:
        """The command with the target of the turning joint; ends when four rotors work again."""
        elapsed = state.stamp - self._ramp.stamp
        p = self._parameters.turnover
        since = elapsed - self._ramp.way.duration - p.settling_time
        if since < 0:
            self._full = float(command.thrust[found.joint])
        elif self._arrived is None:
            # The other rotors take over the load in steps, so that their joints can follow.
            share = self._rest(found, 1 - since / p.fading_time)
            if share <= 0:
                command = replace(command, tilt=np.where(
                    np.arange(4) == found.joint, found.tilt, command.tilt))
                if abs(state.tilt[found.joint] - found.tilt) < p.arrived \
                        or elapsed > self._ramp.wait:
                    self._arrived = state.stamp
        elif self._rest(found, (state.stamp - self._arrived) / p.fading_time) >= 1:
            self.set_out(state.stamp, command)
        return command

    def _rest(self, found: Turnover, share) -> float:
        """Limit the rotor to a share of its thrust, in steps; return the share of the step."""
        share = float(np.clip(np.round(share * FADING_STEPS) / FADING_STEPS, 0.0, 1.0))
        if share != self._share:
            self._share = share
            self._hover.set_health(found.health(share * self._full))
        return share

    def _end_turnover(self):
        if self._turnover is not None:
            self._turnover = None
            self._hover.set_health(self._health)

    def _way_with_what_is_left(self, state, rate):
        """
        First to the attitude where control is regained soonest, then towards level.

        If only the pack is weak, an attitude at rest may be held, but not all attitudes on the
        way. The robot then leaps first, to have speed and height for the fall in the turn.

        Returns:
            the way, and the acceleration [m/s^2] and duration [s] of the leap.

        """
        holding = Holding(self._robot, self._health)
        p = holding.parameters
        escape = holding.quickest(state.quaternion, state.angular_velocity, state.tilt,
                                  p.flying_margin, rate)
        level = rotations.from_rpy(0.0, 0.0, rotations.to_rpy(state.quaternion)[2])
        goal = holding.nearest(level, p.flying_margin)
        turn = max(rotations.geodesic_angle(goal, escape) / rate, 1e-3)
        leap = 0.0, 0.0
        speed = np.linalg.norm(state.velocity)
        if replace(self._health, thrust_limit=None).healthy and speed < AT_REST:
            margin = holding.margin(state.quaternion)
            if margin > 0 and holding.unheld_angle(state.quaternion) > 0:
                # The turn begins between two samples of the published way, which has no rate then.
                leap = self._parameters.leap_share * margin, BETWEEN * (
                    floor(self._parameters.leap_time / BETWEEN) + 0.5)
        # The escape attitude is the reference at once: a sampled path to it costs height.
        times, attitudes = ([leap[1], AT_ONCE], [state.quaternion, escape]) if leap[1] else \
            ([0.0], [escape])
        return Way(np.cumsum([*times, p.escape_time, turn]),
                   np.array([*attitudes, escape, goal])), leap

    @property
    def _without_mocap(self):
        vehicle = self._vehicle
        return vehicle.mocap.silent if vehicle.backup.running else vehicle.mocap_lost

    def _follow(self, state, dt, specific_force_up):
        """
        Follow the ramp, whose target waits for the robot.

        ``specific_force_up`` [m/s^2] is given only if motion is not measured: otherwise an upward
        wind would be interpreted as the ground.
        """
        reference = self._ramp.at(state.stamp)
        if isfinite(self._ramp.climb) and self._slow_enough(state.stamp, reference):
            self._flare(state.stamp, reference)
        sink, velocity = 0.0, reference.velocity
        if specific_force_up is not None:
            # Dead reckoning may estimate a descent that does not happen: then sink faster.
            growth = self._parameters.overdue_acceleration
            late = max(0.0, state.stamp - self._due)
            sink = 0.5 * growth * late ** 2
            velocity = velocity - [0.0, 0.0, growth * late]
            if late > self._parameters.overdue_limit:
                self.given_up = f'no MoCap, and no ground felt {late:.0f} s after it was due'
        lowest = state.position[2] - self._parameters.target_lead
        height = max(reference.position[2] - sink, lowest)
        reference = replace(reference, velocity=velocity, position=np.array(
            [*reference.position[:2], height]))
        self._feel_ground(state, dt, specific_force_up, reference)
        # Rates from MoCap only are late and noisy: no update of the disturbance.
        self._hover.observe(state, free=self._vehicle.backup.imu_alive)
        command = self._hover.step(state, _Now(reference))
        return command if self._turnover is None else \
            self._turn_over(self._turnover, state, command)

    def _slow_enough(self, stamp, reference):
        """Whether the fast descent ends, to brake to the touchdown speed."""
        ramp = self._ramp
        half = ramp.stamp + ramp.wait + 0.5 * (ramp.duration - ramp.wait)
        return stamp > half and -reference.velocity[2] <= self._parameters.speed

    def _flare(self, stamp, reference):
        """Continue with the low speed."""
        p = self._parameters
        self._ramp = Ramp(stamp, reference.position, self._ramp.way.ended(), 0.0, -inf, p.speed,
                          p.acceleration, moving=True)

    def _feel_ground(self, state, dt, specific_force_up, reference):
        """The rotors carry clearly less than the weight, but the robot does not fall."""
        p = self._parameters
        # Without IMU the velocity comes from the rotor model, which does not include the floor.
        blind = self._vehicle.backup.running and not self._vehicle.backup.imu_alive
        by_poses = self._vehicle.backup.velocity_by_poses if blind else None
        sinks = state.velocity[2] if by_poses is None else by_poses[2]
        still = abs(sinks) < p.ground_speed
        # The accelerometer jitters on the floor, by more than the weight with idle rotors.
        self._support += min(1.0, dt / FELT) * (
            self._gauge.support(specific_force_up) - self._support)
        carried = self._support > p.ground_support
        sinking = reference.velocity[2] < -0.5 * p.speed
        stands = sinking and carried and (still or specific_force_up is not None)
        self._standing_for = self._standing_for + dt if stands else 0.0
        self._still_for = self._still_for + dt if blind and sinking and still else 0.0
        # Above the floor of the takeoff there may be a platform, or a wrong velocity estimate.
        aloft = specific_force_up is None and \
            state.position[2] - self._floor > p.platform_height
        needed = p.platform_time if aloft else p.ground_time
        self.grounded = self._standing_for >= needed - 1e-9 or self._still_for >= STILL


class _Now:
    """A target that is one reference."""

    def __init__(self, reference: Reference):
        self._reference = reference

    def at(self, time):
        return self._reference
