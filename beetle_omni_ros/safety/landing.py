"""Takeoff and landing, stepped by the supervisor: the way up, and the one way down."""

from dataclasses import replace
from math import exp, inf

import numpy as np

from beetle_omni_ros.control.base import Command, Fallback, Reference, State, TrajectoryTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import ALL_HEALTHY, Allocator, ROTORS
from beetle_omni_ros.robot.degraded import Holding
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.events import ERROR
from beetle_omni_ros.safety.inputs import Inputs
from beetle_omni_ros.safety.way import (
    climb,
    find_turnover,
    inclination,
    LOST_LIFT,
    plan,
    Ramp,
    Turnover,
    Way,
)

ACCELERATION = 0.5      # [m/s^2] of climb and descent
# Takeoff
CLIMB_SPEED = 0.5       # [m/s]
GROUND_RATE = 0.5       # [rad/s] at which an inclination of the ground is levelled
AIRBORNE = 0.05         # [m] of rise; below it the reaction to a fault is motors off
CLEARANCE = 0.3         # [m] smallest climb, for a start from a platform
ALIGN_RATE = 2.0        # [rad/s] of the joints, which turn to their hover angles first
ALIGNED = 0.1           # [rad] larger than the servos' sag of 0.02 rad
ALIGN_PATIENCE = 4.0    # [s] the farthest joint needs 2 s
NEAR, SLOW = 0.15, 0.2  # [m] error of the hover controller with a 10 % wrong mass; [m/s]
PATIENCE = 4.0          # [s] after the climb
# Levelling
LEVEL_RATE = 0.8        # [rad/s] from upside down to level in 4 s
LEVEL_FIRST = 0.3       # [rad] a larger inclination is levelled before the descent
UNSETTLED = 1.0         # [rad] of a joint from its hover angle: it may still wind to either side
SETTLING_TIME = 0.6     # [s] until joints and body have settled in an attitude
TURN_TIME = 4.0         # [s] for a joint that turns over; it takes 1 s
ARRIVED = 0.2           # [rad] the thrust direction is within 12 deg of its target
FADING_TIME, FADING_STEPS = 0.5, 10     # [s] in which the other joints move by 1.2 rad, so that
                        # three rotors carry the robot
LEAP_SHARE = 0.7        # [-] of the margin of the attitude; the rest is for control
LEAP_TIME = 0.85        # [s] upwards before a turn with a weak pack; between two samples of the
                        # published way, which then has no rate
BRAKE = 3.0             # [-] in the turn after the leap the robot falls anyway
AT_REST = 0.5           # [m/s]
AT_ONCE = 1e-3          # [s]
# Without MoCap the velocity error grows with time
BLIND_RATE = 1.6        # [rad/s]
BLIND_SPEED, BLIND_ACCELERATION = 1.0, 2.0      # [m/s], [m/s^2] until the flare
FLARE_HEIGHT = 0.5      # [m] above the floor; the error of the height is 0.2 m by then
OVERDUE = 0.3           # [m/s^2] a bias can prevent the descent: then sink faster. With 0.6 the
                        # touchdown reached 1.0 m/s, with 0.3 0.85
OVERDUE_LIMIT = 6.0     # [s] after this the robot slides on the ground or is far away: motors off
BLIND_LIMIT = 0.3       # [s] without any sensor the attitude is then unknown: motors off
# The ground
SPEED = 0.3             # [m/s] of the descent, harmless for the legs
TARGET_LEAD = 0.5       # [m] depth of the target below the robot
STILL_SPEED = 0.12      # [m/s] a slower robot may stand on the ground
CARRIED = 0.2           # [-] share of the weight that the ground carries
FELT = 0.1              # [s] time constant of this share
GROUND_TIME = 0.3       # [s] of both; the rotors need 0.1 s to settle
PLATFORM_HEIGHT = 0.3   # [m] above the floor of the takeoff; the estimate is within 0.1 m
PLATFORM_TIME = 1.0     # [s] there: without a fifth of its lift a robot in the air falls by 1 m in
                        # it, so a wrong velocity estimate does not stop the motors
STILL_TIME = 1.0        # [s] without sinking until the ground is detected without IMU
BASELINE_TIME = 2.0     # [s] time constant of the ratio of specific force and thrust
BASELINE_RANGE = (0.7, 1.4)     # largest ratio to the model; a larger one is a disturbance
LEAST_LIFT = 0.3        # [weights] the ratio is not used with less thrust
AHEAD, BETWEEN = 20.0, 0.1      # [s] length and spacing of the published way


class SupportGauge:
    """
    Share of the weight that the rotors do not carry, from commands and accelerometer.

    The true thrust differs from the model by several percent. The ratio of specific force to
    commanded thrust is therefore learnt in free flight and kept constant while landing.
    """

    def __init__(self, allocator: Allocator, robot: RobotParameters):
        self._allocator, self._robot = allocator, robot
        self._baseline, self._lift = 1.0, 0.0   # modelled thrust along world up, in weights
        self._thrusts = np.zeros(ROTORS)    # modelled thrust of each rotor [N]
        # The last command and its force: a controller is slower than the supervisor.
        self._command: Command | None = None
        self._force = np.zeros(3)

    def update(self, command: Command | None, quaternion: np.ndarray, dt: float,
               specific_force_up: float | None, learn: bool) -> None:
        """Update in one tick."""
        share, gravity = 1.0 - exp(-dt / self._robot.rotors.time_constant), self._robot.gravity
        self._thrusts += share * ((0.0 if command is None else command.thrust) - self._thrusts)
        if command is not self._command:
            self._command = command
            self._force = np.zeros(3) if command is None else \
                self._allocator.wrench(command.tilt, command.thrust)[0]
        up = float(rotations.up(quaternion).dot(self._force)) / self._allocator.mass / gravity
        self._lift += share * (up - self._lift)
        if learn and specific_force_up is not None and self._lift > LEAST_LIFT:
            low, high = BASELINE_RANGE
            ratio = min(max(specific_force_up / gravity / self._lift, low), high)
            self._baseline += min(1.0, dt / BASELINE_TIME) * (ratio - self._baseline)

    def motion(self, tilt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Specific force (3,) and angular acceleration (3,) by the rotors at true tilts (4,)."""
        force, torque = self._allocator.wrench(tilt, self._thrusts)
        return self._baseline * force / self._allocator.mass, torque / self._robot.inertia

    def support(self, specific_force_up: float | None) -> float:
        """Share of the weight that the rotors do not carry."""
        felt = 1.0 if specific_force_up is None else specific_force_up / self._robot.gravity
        return felt - self._baseline * self._lift


class Takeoff:
    """
    Joints to their hover angles, then a climb by the hover controller.

    Attributes:
        failure: '' or the reason of an abort.
        done: whether the height is reached.
        airborne: whether it has left the ground.
        target: (3,) position at its end [m].

    """

    def __init__(self, height: float, allocator: Allocator, hover: Fallback, state: State):
        self._hover, self._start = hover, state
        self._tilt = np.clip(state.tilt, -allocator.tilt_limit, allocator.tilt_limit)
        self._goal_tilt = allocator.hover(state.quaternion, self._tilt).tilt
        self._rise = max(height - state.position[2], CLEARANCE)
        self.target = state.position + np.array([0.0, 0.0, self._rise])
        self._ramp: Ramp | None = None
        self._aligned_for = self._climbed_for = 0.0
        self.failure, self.done, self.airborne = '', False, False
        hover.reset()

    def step(self, state: State, dt: float) -> Command:
        """The command for the present time."""
        self.airborne |= bool(state.position[2] > self._start.position[2] + AIRBORNE)
        if self._ramp is None:
            return self._align(state, dt)
        self._climbed_for += dt
        self._judge(state, self._climbed_for - self._ramp.duration)
        self._hover.observe(state, free=self.airborne)
        # The ramp runs by counted time, which a step of the clock does not change.
        return self._hover.step(state, _Now(self._ramp.at(self._climbed_for)))

    def _align(self, state, dt):
        reach = ALIGN_RATE * dt
        self._tilt = self._tilt + np.clip(self._goal_tilt - self._tilt, -reach, reach)
        self._aligned_for += dt
        error = np.abs(state.tilt - self._goal_tilt)
        if error.max() < ALIGNED and np.array_equal(self._tilt, self._goal_tilt):
            level = rotations.from_rpy(0.0, 0.0, rotations.to_rpy(state.quaternion)[2])
            self._ramp = Ramp(0.0, self._start.position,
                              Way.straight(state.quaternion, level, GROUND_RATE),
                              climb(self._rise, CLIMB_SPEED, ACCELERATION))
        elif self._aligned_for > ALIGN_PATIENCE:
            k = int(error.argmax())
            self.failure = f'gimbal{k + 1} is {error[k]:.2f} rad from its place after ' \
                           f'{ALIGN_PATIENCE:g} s (joint_bridge_node)'
        return Command(state.stamp, self._tilt, np.zeros(4))

    def _judge(self, state, over):
        if over < 0:
            return
        if np.linalg.norm(state.position - self.target) < NEAR \
                and np.linalg.norm(state.velocity) < SLOW:
            self.done = True
        elif over > PATIENCE:
            # In the air, off target: the hand-over follows. On the ground: abort.
            self.done = self.airborne
            if not self.airborne:
                self.failure = f'still on the ground {PATIENCE:g} s after the climb'


class Landing:
    """
    One way down from any attitude, with any remaining estimate and actuators.

    Attributes:
        grounded: whether the robot is on the ground.
        given_up: '' or the reason why a controlled descent is no longer possible.

    """

    def __init__(self, inputs: Inputs, hover: Fallback, gauge: SupportGauge, now: float,
                 in_force: Command | None):
        self._inputs, self._hover, self._gauge = inputs, hover, gauge
        self.grounded, self.given_up = False, ''
        self._standing_for = self._still_for = self._blind_for = 0.0
        self._support = 0.0     # share of the weight that the rotors do not carry, filtered
        self._health = ALL_HEALTHY
        self._settled = False   # whether joints far from their hover angles had time to wind
        self._turnover: Turnover | None = None
        if 'estimator_wrong' in inputs.faults:
            inputs.backup.start_from_poses(inputs.known)
        elif inputs.ekf.silent:
            inputs.backup.start(inputs.known)
        self.set_out(now, in_force)

    @property
    def way(self) -> TrajectoryTarget:
        """The planned way, for a controller that can fly a trajectory."""
        ramp = self._ramp
        times = ramp.stamp + np.arange(0.0, ramp.duration + AHEAD, BETWEEN)
        samples = [ramp.at(time) for time in times]
        return TrajectoryTarget(times, np.array([one.position for one in samples]),
                                np.array([one.quaternion for one in samples]),
                                np.array([one.velocity for one in samples]),
                                np.array([one.angular_velocity for one in samples]), ramp.stamp)

    def step(self, now: float, dt: float, in_force: Command | None) -> Command:
        """The command for the present time."""
        inputs, backup = self._inputs, self._inputs.backup
        if not backup.running and inputs.ekf.silent:
            inputs.say(ERROR, f'ekf_node {inputs.ekf.text}: descent goes on with raw sensors')
            backup.start(inputs.known)
            self.set_out(now, in_force)
        elif inputs.blind and not self._blind or now >= self._again_at:
            self.set_out(now, in_force)
        if not backup.running:
            return self._follow(inputs.seen(in_force), dt, inputs.specific_force_up
                                if inputs.mocap.lost else None)
        for source, name in ((inputs.mocap, 'MoCap'), (inputs.imu, 'IMU')):
            if source.silent:
                inputs.say(ERROR, f'{name} is gone too: descent without it', f'no {name}')
        no_mocap, no_imu = inputs.mocap.silent, inputs.imu.silent
        self._blind_for = self._blind_for + dt if no_mocap and no_imu else 0.0
        if self._blind_for > BLIND_LIMIT:
            self.given_up = 'no estimator, no MoCap, no IMU'
        backup.predict(now, self._ramp.at(now).velocity if no_mocap else None,
                       self._gauge.motion(inputs.seen(in_force).tilt) if no_imu else None)
        return self._follow(inputs.seen(in_force, inputs.best), dt,
                            backup.specific_force_up if no_mocap else None)

    # The plan ---------------------------------------------------------------------------------

    def set_out(self, now: float, in_force: Command | None) -> None:
        """Plan the way down from the present pose, with the actuators that work."""
        inputs = self._inputs
        state, self._blind = inputs.seen(in_force, inputs.best), inputs.blind
        self._again_at = self._due = inf
        self._health = inputs.health
        if self._turnover is not None:
            self._turnover = None
            self._hover.set_health(self._health)
        rate, leap = BLIND_RATE if self._blind else LEVEL_RATE, [(0.0, 0.0)]
        if not self._health.healthy:
            way, leap = self._escape(state, rate)
        elif not self._settled and self._unsettled(state):
            # Both joints of a pair may wind to the same side, so that the way is another one.
            self._settled, self._again_at = True, now + SETTLING_TIME
            self._ramp = Ramp(state.stamp, state.position, Way.straight(
                state.quaternion, state.quaternion, rate), leap)
            return
        else:
            way = plan(state.quaternion, state.tilt, inputs.allocator, rate)
            if way.lost > LOST_LIFT and self._begin_turnover(state, rate):
                return
        slanted = inclination(state.quaternion) > LEVEL_FIRST or not self._health.healthy
        wait, height = way.duration if slanted else 0.0, state.position[2] - inputs.floor
        fast = max(0.0, height - FLARE_HEIGHT) if self._blind else 0.0
        if self._health.healthy:    # level for the flare: velocity errors grow with time
            wait = max(0.0, wait - fast / BLIND_SPEED)
        self._ramp = Ramp(state.stamp, state.position, way, self._descent(leap, wait, fast))
        self._due = now + self._ramp.end + max(0.0, height + self._ramp.rise) / SPEED

    def _descent(self, leap, wait, fast):
        """Knots: a leap, a wait, ``fast`` metres faster than the touchdown, then its speed."""
        slow, a = SPEED, BLIND_ACCELERATION
        begin = max(leap[-1][0], wait)
        top = min(BLIND_SPEED, (fast * a + 0.5 * slow**2) ** 0.5)
        if top <= slow:
            return [*leap, (begin + 1e-9, 0.0), (begin + slow / ACCELERATION, -slow)]
        cruise = (fast - (top**2 - 0.5 * slow**2) / a) / top
        reached = begin + top / a
        return [*leap, (begin + 1e-9, 0.0), (reached, -top), (reached + cruise, -top),
                (reached + cruise + (top - slow) / a, -slow)]

    def _unsettled(self, state):
        hover = self._inputs.allocator.hover(state.quaternion, state.tilt).tilt
        return np.abs(hover - state.tilt).max() > UNSETTLED

    def _escape(self, state, rate):
        """
        First to the attitude where control is regained soonest, then towards level.

        If only the pack is weak, an attitude at rest may be held, but not all attitudes on the
        way. The robot then leaps first (knots), to have speed and height for the fall in the turn.
        """
        holding = Holding(self._inputs.robot, self._health)
        p = holding.parameters
        escape = holding.quickest(state.quaternion, state.angular_velocity, state.tilt,
                                  p.flying_margin, rate)
        level = rotations.from_rpy(0.0, 0.0, rotations.to_rpy(state.quaternion)[2])
        goal = holding.nearest(level, p.flying_margin)
        turn = max(rotations.geodesic_angle(goal, escape) / rate, 1e-3)
        # The escape attitude is the reference at once: a sampled path to it costs height.
        times, attitudes, leap = [0.0], [escape], [(0.0, 0.0)]
        if replace(self._health, thrust_limit=None).healthy \
                and np.linalg.norm(state.velocity) < AT_REST:
            margin = holding.margin(state.quaternion)
            if margin > 0 and holding.unheld_angle(state.quaternion) > 0:
                leap += [(LEAP_TIME, LEAP_SHARE * margin * LEAP_TIME),
                         ((1 + 1 / BRAKE) * LEAP_TIME, 0.0)]
                times, attitudes = [LEAP_TIME, AT_ONCE], [state.quaternion, escape]
        return Way(np.cumsum([*times, p.escape_time, turn]),
                   np.array([*attitudes, escape, goal])), leap

    # A joint that turns over ------------------------------------------------------------------

    def _begin_turnover(self, state, rate):
        """Fly to an attitude at which a joint turns over with its rotor off; False if none."""
        found = find_turnover(state.quaternion, state.tilt, self._inputs.robot,
                              self._inputs.allocator, rate)
        if found is None:
            return False
        way = Way.straight(state.quaternion, found.quaternion, rate)
        self._turnover, self._arrived, self._share, self._full = found, None, 1.0, 0.0
        self._ramp = Ramp(state.stamp, state.position, way, [(0.0, 0.0)])
        self._again_at = state.stamp + way.duration + SETTLING_TIME + TURN_TIME
        return True

    def _turn_over(self, found: Turnover, state, command) -> Command:
        """The command with the target of the turning joint; ends when four rotors work again."""
        since = state.stamp - self._ramp.stamp - self._ramp.way.duration - SETTLING_TIME
        if since < 0:
            self._full = float(command.thrust[found.joint])
        elif self._arrived is None:
            # The other rotors take over the load in steps, so that their joints can follow.
            if self._rest(found, 1 - since / FADING_TIME) <= 0:
                command = replace(command, tilt=np.where(
                    np.arange(ROTORS) == found.joint, found.tilt, command.tilt))
                if abs(state.tilt[found.joint] - found.tilt) < ARRIVED:
                    self._arrived = state.stamp
        elif self._rest(found, (state.stamp - self._arrived) / FADING_TIME) >= 1:
            self.set_out(state.stamp, command)
        return command

    def _rest(self, found: Turnover, share) -> float:
        """Limit the rotor to a share of its thrust, in steps; return the share of the step."""
        share = float(np.clip(np.round(share * FADING_STEPS) / FADING_STEPS, 0.0, 1.0))
        if share != self._share:
            self._share = share
            self._hover.set_health(found.health if share == 0 else replace(
                ALL_HEALTHY, held=tuple(share * self._full if k == found.joint else None
                                        for k in range(ROTORS))))
        return share

    # The descent ------------------------------------------------------------------------------

    def _follow(self, state, dt, specific_force_up):
        """
        Follow the ramp, whose target waits for the robot.

        ``specific_force_up`` [m/s^2] is given only if motion is not measured: otherwise an upward
        wind would be interpreted as the ground.
        """
        reference = self._ramp.at(state.stamp)
        sink, velocity = 0.0, reference.velocity
        if specific_force_up is not None:
            # Dead reckoning may estimate a descent that does not happen: then sink faster.
            late = max(0.0, state.stamp - self._due)
            sink, velocity = 0.5 * OVERDUE * late ** 2, velocity - [0.0, 0.0, OVERDUE * late]
            if late > OVERDUE_LIMIT:
                self.given_up = f'no MoCap, and no ground felt {late:.0f} s after it was due'
        height = max(reference.position[2] - sink, state.position[2] - TARGET_LEAD)
        reference = replace(reference, velocity=velocity, position=np.array(
            [*reference.position[:2], height]))
        self._feel_ground(state, dt, specific_force_up, reference.velocity[2])
        # Rates from MoCap only are late and noisy: no update of the disturbance.
        self._hover.observe(state, free=self._inputs.backup.imu_alive)
        command = self._hover.step(state, _Now(reference))
        return command if self._turnover is None else \
            self._turn_over(self._turnover, state, command)

    def _feel_ground(self, state, dt, specific_force_up, speed):
        """The rotors carry clearly less than the weight, but the robot does not fall."""
        # Without IMU the velocity comes from the rotor model, which does not include the floor.
        backup = self._inputs.backup
        blind = backup.running and not backup.imu_alive
        by_poses = backup.velocity_by_poses if blind else None
        still = abs(state.velocity[2] if by_poses is None else by_poses[2]) < STILL_SPEED
        # The accelerometer jitters on the floor, by more than the weight with idle rotors.
        self._support += min(1.0, dt / FELT) * (
            self._gauge.support(specific_force_up) - self._support)
        sinking = speed < -0.5 * SPEED
        stands = sinking and self._support > CARRIED and (still or specific_force_up is not None)
        self._standing_for = self._standing_for + dt if stands else 0.0
        self._still_for = self._still_for + dt if blind and sinking and still else 0.0
        # Above the floor of the takeoff there may be a platform, or a wrong velocity estimate.
        aloft = specific_force_up is None and \
            state.position[2] - self._inputs.floor > PLATFORM_HEIGHT
        needed = PLATFORM_TIME if aloft else GROUND_TIME
        self.grounded = self._standing_for >= needed - 1e-9 or self._still_for >= STILL_TIME


class _Now:
    """A target that is one reference."""

    def __init__(self, reference: Reference):
        self._reference = reference

    def at(self, time):
        return self._reference
