"""A flight node with the lifecycle states of ROS 2."""

from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from beetle_omni_ros.nodes.node import FlightNode

UNCONFIGURED, INACTIVE, ACTIVE = 'unconfigured', 'inactive', 'active'
# autostart -> state to reach
AUTOSTART = {'none': '', 'configure': INACTIVE, 'activate': ACTIVE}
RETRY = 1.0     # [s] between attempts to start by itself


class LifecycleFlightNode(LifecycleNodeMixin, FlightNode):
    """
    Base of a node that opens a device when configured and powers it when activated.

    A subclass overrides ``configure``, ``activate``, ``deactivate`` and ``release``. The first two
    refuse a transition by an exception of ``refusals``. Its text goes to the log and to
    :attr:`refusal`, and the state stays as it was.

    Attributes:
        refusal: why the last transition was refused; '' if it was not.

    """

    refusals: tuple[type[Exception], ...] = ()

    def __init__(self, *args, **kwargs):
        FlightNode.__init__(self, *args, **kwargs)
        LifecycleNodeMixin.__init__(self)
        self.refusal = ''
        self._goal = ''
        self._start_timer = None
        self._starts = False    # during an automatic transition
        # In rclpy, an impossible transition ends the process.
        self._answer_change = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state

    def configure(self) -> None:
        """Open the device; after an exception, :meth:`release` closes it."""

    def activate(self) -> None:
        """Power the device; an exception must leave it without power."""

    def deactivate(self) -> None:
        """Switch the power off."""

    def release(self) -> None:
        """Switch the power off and close the device; callable in any state, repeatedly."""

    def changed(self) -> None:
        """React to a transition, successful or refused."""

    @property
    def stage(self) -> str:
        """Name of the present state."""
        return self._state_machine.current_state[1]

    def start_by_itself(self, autostart: str) -> None:
        """Go to the state that ``autostart`` names; repeat every second until it succeeds."""
        self._goal = AUTOSTART[autostart]
        if self._goal:
            self._start_timer = self.create_timer(RETRY, self._try_to_start,
                                                  clock=self.steady_clock)

    def _try_to_start(self):
        self._starts = True
        if self.stage == UNCONFIGURED:
            self.trigger_configure()
        if self.stage == INACTIVE and self._goal == ACTIVE:
            self.trigger_activate()
        if self.stage not in (UNCONFIGURED, INACTIVE) or self.stage == self._goal:
            self._start_timer.cancel()
        self._starts = False
        self.changed()

    # --- called by rclpy ----------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the device."""
        return self._attempt('configure', self.configure, self.release)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Power the device."""
        return self._attempt('activate', self.activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Switch the power off; ends the automatic start."""
        return self._attempt('deactivate', self._by_operator(self.deactivate))

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the device; ends the automatic start."""
        return self._attempt('clean up', self._by_operator(self.release))

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the device."""
        return self._attempt('shut down', self._by_operator(self.release))

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the device after an unexpected exception; it can be configured again."""
        self.release()
        return TransitionCallbackReturn.SUCCESS

    def _by_operator(self, action):
        def act():
            if self._start_timer is not None:
                self._start_timer.cancel()
            action()
        return act

    def _attempt(self, what, action, undo=lambda: None):
        before, self.refusal = self.refusal, ''
        try:
            action()
        except self.refusals as error:
            undo()
            self.refusal = ' '.join(str(error).split())
            if self.refusal != before:      # attempts are repeated, lines are not
                self._log_refusal(f'cannot {what}: {self.refusal}')
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.get_logger().fatal(f'cannot {what}: {type(error).__name__}: {error}')
            raise
        return TransitionCallbackReturn.SUCCESS

    def _log_refusal(self, text):
        """Log as an error; as a warning if the automatic start repeats the transition."""
        if self._starts:
            self.get_logger().warning(f'{text}; tries again')
        else:
            self.get_logger().error(text)

    def _on_change_state(self, request, response):
        try:
            self._answer_change(request, response)
        except Exception as error:      # rclpy does not export the class
            if 'RCLError' not in type(error).__name__:
                raise
            self.get_logger().warning(f'refused: no such transition from {self.stage}')
            response.success = False
        self.changed()
        return response
