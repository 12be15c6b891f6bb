"""Host of one component for tests: keeps what it sends and says."""

import numpy as np


class Desk:
    """
    Stand-in for a host, with a time that the test sets.

    Attributes:
        time: [s], of the stamps and steady.
        sent: (topic, value, source) of each message.
        lines: texts of log lines and warnings.

    """

    def __init__(self, component, time=0.0, simulated=True):
        self.time, self.simulated, self.sent, self.lines = time, simulated, [], []
        self.component = component
        component.attach(self)

    def now(self):
        return self.time

    def elapsed(self):
        return self.time

    def publish(self, topic, value, source=''):
        self.sent.append((topic, value, source))

    def log(self, severity, text):
        self.lines.append(f'{severity}: {text}')

    def warn(self, kind, text):
        self.lines.append(text)

    def values(self, topic):
        """Values that were sent on a topic, oldest first."""
        return [value for name, value, _ in self.sent if name == topic]

    def stamps(self, topic):
        return np.array([value.stamp for value in self.values(topic)])

    def status(self, part):
        """Newest diagnostic status of a part: (level, message, values)."""
        name = f'{self.component.name}: {part}'
        one, = (one for one in self.component.diagnostics() if one.name == name)
        return one.level, one.message, one.values

    def refused(self, topic):
        """Counts of refused messages by kind."""
        return dict(self.component.inputs[topic].rejected)
