"""
The supervisor: selects the command of the actuators and reacts to faults.

A pure state machine that reads no clock and no topic. All times are arguments, so that the node
and the in-process evaluation run the same code with the same results. See docs/safety.md.
"""

from collections.abc import Sequence

import numpy as np

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import Command, Fallback, PoseTarget, Target
from beetle_omni_ros.model import mode
from beetle_omni_ros.model.allocation import ALL_HEALTHY
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.supervisor.commands import HANDOVER_TIME, Output
from beetle_omni_ros.supervisor.inputs import ARM_TILT, Inputs
from beetle_omni_ros.supervisor.interface import Answer, ERROR, INFO, SupervisorParameters, WARNING
from beetle_omni_ros.supervisor.landing import Landing, Takeoff, why_land
from beetle_omni_ros.supervisor.way import coasted, halting, inclination
from beetle_omni_ros.supervisor.wrench import NEAR_GROUND

STOP_TIME = 0.3         # [s] zero thrust is sent for this time, then nothing
LOOK = 0.02             # [s] after a pause without a command: two periods of MoCap, because the
                        # robot may lie on the floor
LATE_TIME = 0.3         # [s] three lags of a rotor after late commands: no actuator is suspected
RESUMING = 0.1          # [s] after a pause until every source has sent a message again
FALLBACK_TIME = 30.0    # [s] of fallback until landing; enough to restart a controller
RECOVERY_TIME = 1.0     # [s] in which a landing stops a tumble of 15 rad/s
FENCE_MARGIN = 2.0      # [m] farther outside the fence a landing is a flyaway: motors off
LANDING_LIMIT = 90.0    # [s] from the margin above the fence it takes 74 s, and levelling 4 s


class Supervisor:
    """
    Arms, selects, checks, falls back, lands.

    ``fallback`` flies takeoff, fallback and landing. ``controllers`` may be active; None: those on
    standby.

    Attributes:
        inputs: messages received, and what they show; its ``on_...`` methods receive them.
        output: the executed command.
        active: name of the selected controller.
        faults: of this flight: name -> time of detection [s].
        state: 'disarmed', 'takeoff', 'flying', 'fallback', 'landing' or 'emergency_stop'.
        source: of the executed command: a controller's name, 'hover' or 'none'.
        target_override: target of the controllers that replaces the operator's target, or None.

    """

    def __init__(self, parameters: SupervisorParameters, robot: RobotParameters,
                 fallback: Fallback, controllers: Sequence[str] | None = None):
        controllers = tuple(registry.STANDING_BY if controllers is None else controllers)
        self.inputs, self.output = Inputs(parameters, robot, controllers), Output(robot)
        self._watch, self._say = self.inputs.watch, self.inputs.say
        self.faults = self._watch.faults
        self.active = parameters.controller if parameters.controller in controllers \
            else controllers[0]
        self._takeoff_height = parameters.takeoff_height
        self._pilot = registry.pilot(controllers)
        self._hover = fallback
        self.state, self.source = mode.DISARMED, 'none'
        self.target_override: Target | None = None
        self._cycle = {mode.TAKEOFF: self._take_off, mode.FLYING: self._fly,
                       mode.FALLBACK: self._hold, mode.LANDING: self._descend}
        # Objects of the present state, created when it is entered.
        self._takeoff: Takeoff
        self._landing: Landing
        self._target: PoseTarget | None     # of the fallback; None until the turn has ended
        self._height: float
        self._in_state = 0.0    # time since the last change of the state [s]
        self._acted_on = ALL_HEALTHY    # health to which landing and hover are adapted
        self._before = -np.inf      # time of the update before [s]
        self._resumed = -np.inf     # time of the last pause [s]

    # Requests ---------------------------------------------------------------------------------

    def why_not_arm(self) -> str:
        """'' when the motors may start, else the missing condition."""
        return self.inputs.why_not_arm(self.active)

    def arm(self, now: float) -> Answer:
        """Start the motors and take off, or return the reason of the refusal."""
        reason = self.why_not_arm() if self.state == mode.DISARMED \
            else f'{self.state}, not disarmed'
        if reason:
            return self._refuse(f'arm refused: {reason}')
        self.output.in_force = self.output.given = None
        self._takeoff = Takeoff(self._takeoff_height, self.inputs.allocator, self._hover,
                                self._seen)
        self.inputs.floor = float(self.inputs.estimate.position[2])
        self._watch.reset()
        self._acted_on = ALL_HEALTHY
        self._hover.set_health(ALL_HEALTHY)
        return self._enter(mode.TAKEOFF, INFO, 'armed: takeoff')

    def disarm(self, now: float) -> Answer:
        """Motors off, on the ground or after an emergency stop; refused in the air."""
        if self.inputs.airborne:
            return self._refuse(f'disarm refused: {self.state}; land or emergency_stop')
        if self.state == mode.DISARMED:
            return Answer(True, 'already disarmed')
        return self._enter(mode.DISARMED, INFO, 'disarmed')

    def emergency_stop(self, now: float, reason: str = 'requested') -> Answer:
        """Motors off at once, latched until disarmed."""
        if self.state == mode.STOPPED:
            return Answer(True, 'already stopped')
        return self._enter(mode.STOPPED, ERROR, f'emergency stop: {reason}')

    def land(self, now: float) -> Answer:
        """Descend at the present position, motors off at the ground."""
        if self.state not in mode.IN_FLIGHT:
            return self._refuse(f'land refused: {self.state}, not in flight')
        if self.state == mode.LANDING:
            return Answer(True, 'already landing')
        return self._land(now, INFO, 'landing on request')

    def select(self, controller: str) -> Answer:
        """Select another controller; in flight only one with valid commands."""
        if controller == self.active:
            return Answer(True, f'{controller} is active')
        stream = self.inputs.streams.get(controller)
        if stream is None:
            return self._refuse(f"select refused: unknown controller '{controller}'; known: "
                                f"{', '.join(self.inputs.streams)}")
        if self.state in mode.IN_FLIGHT and not stream.good:
            return self._refuse(f'select refused: {controller}_node {stream.complaint}; '
                                f'{self.active} stays selected')
        self.active = controller
        self.output.hand_over_left = HANDOVER_TIME
        self._say(INFO, f'{controller} selected')
        return Answer(True, f'{controller} selected')

    def _refuse(self, text):
        self._say(WARNING, text)
        return Answer(False, text)

    # The cycle --------------------------------------------------------------------------------

    def update(self, now: float) -> Command | None:
        """
        A finite command within limits, or None: nothing is sent.

        Call it at least every 10 ms.
        """
        dt, before, self._before = self.inputs.tick(now), self._before, now
        if now < before:    # the clock was set back
            self._hover.reset()
            self.output.hand_over_left = 0.0
            if self.state == mode.LANDING:
                self._landing.set_out()
        self._in_state += dt
        self._look_for_faults(now, now - before)
        if self.state in mode.IN_FLIGHT:
            self._react(now)
        command = self._guarded(self._cycle.get(self.state, self._stand)(now, dt), now)
        if self.state in mode.IN_FLIGHT:
            self.inputs.airborne = self.state != mode.TAKEOFF or self._takeoff.airborne
            self.output.turn_rotors(dt, command)
        return command

    def _guarded(self, command, now):
        """Final check of a new output: finite, inside limits."""
        if command is None or now - self._resumed < LOOK:
            return None
        is_new = command is not self.output.given
        sent = self.output.checked(command, self.inputs.health)
        if sent is None:
            self.emergency_stop(now, f'{self.source} gave a command that is not finite')
        elif is_new:
            self._watch.on_command(sent)
        return sent

    # Faults -----------------------------------------------------------------------------------

    def _look_for_faults(self, now, paused):
        """Results of the detectors, in the air."""
        inputs = self.inputs
        if inputs.airborne and inputs.imu.lost and 'imu_frozen' not in self.faults:
            self._watch.name('imu_lost', now, f'the raw IMU is {inputs.imu.text}')
        if inputs.airborne and inputs.rotors.lost and 'rotor' in inputs.bridges:
            text = f'rotor_bridge_node {inputs.rotors.text}'
            self._watch.name('rotor_bridge_silent', now, text)
        while self._watch.news:
            self._say(ERROR, self._watch.news.pop(0))
        if not inputs.airborne:
            return
        contact, poses = self._watch.contact.reason, inputs.backup.poses
        flies = self.state == mode.FLYING or self._in_state < LATE_TIME
        self._watch.paused = inputs.ages.partly \
            or flies and inputs.streams[self.active].ages.partly
        if paused > mode.COMMAND_AGE:
            self._watch.name('supervisor_paused', now)
            self._watch.restart()
            self._resumed = now
            self._say(WARNING, f'supervisor_node was not scheduled for {1000 * paused:.0f} ms: '
                      'the actuators had stopped')
            if self.state == mode.FLYING:
                self._fall_back(WARNING, 'fallback to hover after the pause')
        # Messages queued during the pause are older. The estimate may be wrong after a fall.
        elif now - self._resumed < RESUMING and not inputs.mocap.silent \
                and poses[-1][1][2] - inputs.floor < NEAR_GROUND:
            contact = 'on the floor after the pause'
        if not contact:
            if inputs.health is not self._acted_on:
                self._degrade(now)
        elif self.state == mode.LANDING and inclination(inputs.best.quaternion) < ARM_TILT:
            self._enter(mode.DISARMED, INFO, f'on the ground, {contact}: motors off, disarmed')
        else:
            self._watch.name('crash', now)
            self.emergency_stop(now, f'crash: {contact}')

    def _degrade(self, now):
        """Land with the working actuators, in the attitude nearest level with a margin."""
        before, self._acted_on, self.output.given = self._acted_on, self.inputs.health, None
        if self.inputs.health.healthy:
            return      # a zero has moved, which is corrected in commands and readings
        self._hover.set_health(self.inputs.health)
        if self.state != mode.LANDING:
            self._land(now, ERROR, f"{', '.join(self.faults)}: landing with what is left")
        elif before.same_actuators(self.inputs.health):
            return
        else:
            self._landing.set_out()
        if self.state == mode.LANDING:
            self.target_override = self._landing.way

    def _react(self, now):
        """Faults that end or change a flight with any controller, the most urgent first."""
        inputs = self.inputs
        if inputs.battery_low:
            self._say(WARNING, f'battery low: {inputs.voltage:.1f} V', 'battery')
        no_rotors = inputs.unready('rotor')
        if no_rotors and not inputs.bridges['rotor'].startswith('silent:'):
            if not inputs.airborne:
                self._enter(mode.DISARMED, ERROR, f'{no_rotors}; still on the ground: motors off')
            else:
                self._watch.name('rotor_bridge_lost', now)
                self.emergency_stop(now, no_rotors)
        elif self.state == mode.LANDING:
            if self._in_state < RECOVERY_TIME:
                return
            if inputs.outside(FENCE_MARGIN):
                self.emergency_stop(now, 'left the fence while landing')
            elif inputs.lost:
                self.emergency_stop(now, 'tumbling or falling while landing')
            elif self._in_state > LANDING_LIMIT:
                self.emergency_stop(now, f'no ground within {LANDING_LIMIT:g} s of landing')
        elif self.state == mode.FALLBACK and self._in_state > FALLBACK_TIME:
            text = f'{self.active}_node not good for {self._in_state:.0f} s: landing'
            self._land(now, ERROR, text, 'controller_lost')
        elif reason := why_land(inputs):
            self._land(now, ERROR, *reason)
        elif inputs.lost and self.state == mode.FLYING:
            self._watch.name('control_lost', now)
            self._fall_back(ERROR, f'tumbling or falling under {self.active}_node: fallback '
                                   'to hover')

    # One function for each state --------------------------------------------------------------

    def _stand(self, now, dt):
        """Motors off: zero thrust for a short time, then no command."""
        # A rotor that ignores its thrust command is turned so that it presses on the floor.
        self.source = 'none'
        last = self.output.in_force
        if self._in_state > STOP_TIME + 1e-9 or last is None:
            return None
        tilt = np.array([own if held is None else np.copysign(np.pi, own)
                         for own, held in zip(last.tilt, self.inputs.health.held)])
        return Command(now, tilt, np.zeros(4))

    def _take_off(self, now, dt):
        self.source = 'hover'
        command = self._takeoff.step(self._seen, dt)
        if self._takeoff.failure:
            self._enter(mode.DISARMED, ERROR, f'takeoff failed: {self._takeoff.failure}')
            return self._stand(now, dt)
        if self._takeoff.done:
            stream = self.inputs.streams[self.active]
            if stream.good:
                self._enter(mode.FLYING, INFO, f'takeoff done: {self.active} flies')
            else:
                self._fall_back(WARNING, f'takeoff done, but {self.active}_node '
                                f'{stream.complaint}: hover waits for it')
        return command

    def _fly(self, now, dt):
        inputs, stream = self.inputs, self.inputs.streams[self.active]
        if (late := inputs.late(self.active)) or stream.silence.silent or stream.accepted is None:
            name, text = late or ('controller_silent', f'{self.active}_node {stream.complaint}')
            if late or inputs.ekf.elapsed <= 0.5 * inputs.ekf.limit:    # it answers estimates
                self._watch.name(name, now)
            self._fall_back(ERROR, f'{text}: fallback to hover')
            return self._hold(now, dt)
        self.source = self.active
        self._hover.observe(self._seen)
        return self.output.hand_over(stream.accepted)

    def _hold(self, now, dt):
        is_good = self.inputs.streams[self.active].good and not self.inputs.lost
        if is_good and self._in_state >= RESUMING:
            self._enter(mode.FLYING, INFO, f'{self.active}_node good again: it flies')
            return self._fly(now, dt)
        self.source, state = 'hover', self._seen
        if self._target is None:
            reference = halting(state, self._height)
            if reference is not None:
                return self._hover.step(state, reference)
            self._target = PoseTarget(coasted(state), state.quaternion, now)
        return self._hover.step(state, self._target)

    def _descend(self, now, dt):
        self.source, plan = 'hover', self._landing.ramp
        command = self._landing.step(now, dt)
        if self.target_override is not None and self._landing.ramp is not plan:
            self.target_override = self._landing.way
        if self._landing.given_up:
            self.emergency_stop(now, self._landing.given_up)
            return self._stand(now, dt)
        if self._landing.grounded:
            self._enter(mode.DISARMED, INFO, 'on the ground: motors off, disarmed')
            return self._stand(now, dt)
        pilot = self.inputs.streams.get(self._pilot)
        if self.target_override is not None and pilot is not None and pilot.good \
                and pilot.accepted is not None and not self.inputs.backup.running:
            self.source = self._pilot
            command = self.output.hand_over(pilot.accepted)
        return command

    # Changes of state -------------------------------------------------------------------------

    def _fall_back(self, severity, text):
        """Hover at the present height, in the attitude in which the present turn ends."""
        self._target, self._height = None, float(self.inputs.estimate.position[2])
        self._enter(mode.FALLBACK, severity, text)

    def _land(self, now, severity, text, name=''):
        if name:
            self._watch.name(name, now)
        if not self.inputs.airborne:
            return self._enter(mode.DISARMED, severity, f'{text}; still on the ground: motors off')
        self._landing = Landing(self.inputs, self.output, self._hover)
        return self._enter(mode.LANDING, severity, text)

    def _enter(self, state, severity, text):
        self.state, self._in_state, self.target_override = state, 0.0, None
        if state in mode.MOTORS_OFF:
            self.inputs.backup.running = self.inputs.airborne = False
        if state == mode.FLYING:
            self.output.hand_over_left = HANDOVER_TIME
        if state in (mode.FALLBACK, mode.LANDING):
            self.output.pull_back(self._seen.tilt)
        self._say(severity, text)
        return Answer(True, text)

    @property
    def _seen(self):
        return self.inputs.seen(self.output.in_force)

    # Reports ----------------------------------------------------------------------------------

    @property
    def mode(self) -> mode.Mode:
        """The state with its controller or its last fault."""
        if self.state == mode.FLYING:
            return mode.Mode.of(mode.FLYING, self.active)
        return mode.Mode.of(self.state, next(reversed(self.faults), '')
                            if self.state != mode.TAKEOFF else '')

    def diagnostics(self) -> dict[str, float | int | str]:
        """State, sources and refusals, flat, for operators and logs."""
        return {'state': self.state, 'controller': self.active, 'source': self.source,
                **self.inputs.diagnostics()}
