"""The state of the supervisor, a text on the wire, and the age limit of its commands."""

DISARMED, TAKEOFF, FLYING = 'disarmed', 'takeoff', 'flying'
FALLBACK, LANDING, STOPPED = 'fallback', 'landing', 'emergency_stop'
IN_FLIGHT = (TAKEOFF, FLYING, FALLBACK, LANDING)
MOTORS_OFF = (DISARMED, STOPPED)
COMMAND_AGE = 0.1       # [s] from the stamp: no older command is sent or executed by any actuator


class Mode(str):
    """
    A state, with the active controller ('flying:nmpc') or the last fault ('landing:crash').

    Attributes:
        state: one of the constants of this module, '' before the first one.
        controller: the controller that flies, or ''.
        fault: the last fault, or ''.
        motors_off, in_flight: whether the state is one of MOTORS_OFF, or of IN_FLIGHT.

    """

    state: str
    controller: str
    fault: str
    motors_off: bool
    in_flight: bool

    def __new__(cls, text: str = '') -> 'Mode':
        """Read a text of the topic supervisor/state."""
        made = super().__new__(cls, text)
        made.state, _, detail = text.partition(':')
        flies = made.state == FLYING
        made.controller, made.fault = (detail, '') if flies else ('', detail)
        made.motors_off, made.in_flight = made.state in MOTORS_OFF, made.state in IN_FLIGHT
        return made

    @classmethod
    def of(cls, state: str, detail: str = '') -> 'Mode':
        """Make a mode of a state and its controller or fault."""
        return cls(f'{state}:{detail}' if detail else state)
