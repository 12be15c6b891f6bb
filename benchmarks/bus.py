"""
Loop rate, latency and CPU of the actuator drivers: `python benchmarks/bus.py [SECONDS]`.

The emulated servos run in a process of their own, as `sim_node` does. With --wire their answers
take the time of 1 Mbit/s.
"""

from dataclasses import replace
from pathlib import Path
import subprocess
import sys
import time

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from beetle_omni_ros.drivers.servo_bus import ServoBus  # noqa: E402
from beetle_omni_ros.drivers.servo_parameters import ServoBusParameters  # noqa: E402
from beetle_omni_ros.robot.parameters import RobotParameters  # noqa: E402

PERIOD = 0.005  # [s]
STAGES = ('write', 'read', 'health', 'tick')


def serve(wire):
    """Run the emulated servos; obey lines on standard input."""
    from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus
    with EmulatedServoBus(motion=RobotParameters.load().joints, timing=wire) as emulated:
        print(emulated.port, flush=True)
        for line in sys.stdin:
            word, *rest = line.split()
            if word == 'silent':
                emulated.faults.silent = set(map(int, rest))
            elif word == 'reboot':
                emulated.reboot(int(rest[0]))
            else:
                {'unplug': emulated.unplug, 'replug': emulated.replug}[word]()


def loop(bus, duration, script=()):
    """
    Run the bridge's loop at 200 Hz.

    Args:
        bus: enabled.
        duration: [s].
        script: (time [s], function) to call on the way, in order.

    Returns:
        stage -> times [s], missed ticks, readings lost (4,), CPU share.

    """
    times, script = {stage: [] for stage in STAGES}, list(script)
    missed, lost = 0, np.zeros(4, int)
    began, cpu = time.monotonic(), time.process_time()
    due = began
    while due - began < duration:
        if script and due - began >= script[0][0]:
            script.pop(0)[1]()
        phase = 2 * np.pi * 0.5 * (due - began)
        marks = [time.perf_counter()]
        bus.write_goals(2 * np.sin(phase + np.arange(4)))
        marks.append(time.perf_counter())
        lost += ~bus.read().valid
        marks.append(time.perf_counter())
        bus.poll_health()
        marks.append(time.perf_counter())
        for stage, spent in zip(STAGES, [*np.diff(marks), marks[-1] - marks[0]], strict=True):
            times[stage].append(spent)
        due += PERIOD
        late = time.monotonic() - due
        if late > 0:
            skipped = int(late / PERIOD) + 1
            missed += skipped
            due += skipped * PERIOD
        time.sleep(max(0.0, due - time.monotonic()))
    elapsed = time.monotonic() - began
    return times, missed, lost, (time.process_time() - cpu) / elapsed


def show(title, result, duration):
    """Print one run."""
    times, missed, lost, cpu = result
    print(f'{title}: {len(times["tick"]) / duration:.1f} Hz, {missed} ticks missed, readings lost '
          f'{lost.tolist()}, CPU {100 * cpu:.1f} % of a core')
    for stage, spent in times.items():
        median, p99, top = np.percentile(spent, [50, 99, 100]) * 1e3
        print(f'    {stage:7s} median {median:6.3f} ms   p99 {p99:6.3f} ms   max {top:6.3f} ms')


def main(duration=10.0, wire=False):
    """Measure the healthy bus, then what each fault costs."""
    device = subprocess.Popen([sys.executable, __file__, 'serve', *(['--wire'] if wire else [])],
                              stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def tell(text):
        def send():
            device.stdin.write(text + '\n')
            device.stdin.flush()
        return send

    bus = ServoBus(replace(ServoBusParameters.load(), port=device.stdout.readline().strip()),
                   RobotParameters.load().joints)
    try:
        bus.open()
        bus.configure()
        bus.enable()
        print(f'servo bus, 200 Hz for {duration:g} s' + (', answers at 1 Mbit/s' if wire else ''))
        show('healthy', loop(bus, duration), duration)
        for title, begin, end in (('servo 3 silent from 1 s to 2 s', 'silent 3', 'silent'),
                                  ('all silent from 1 s to 2 s', 'silent 1 2 3 4', 'silent'),
                                  ('servo 2 restarts at 1 s', 'reboot 1', 'silent'),
                                  ('unplugged from 1 s to 2 s', 'unplug', 'replug')):
            show(title, loop(bus, 3.0, [(1.0, tell(begin)), (2.0, tell(end))]), 3.0)
            for line in bus.take_events():
                print('    ' + line)
    finally:
        bus.close()
        device.stdin.close()
        device.wait(5)


if __name__ == '__main__':
    words = [word for word in sys.argv[1:] if word != '--wire']
    if words[:1] == ['serve']:
        serve('--wire' in sys.argv)
    else:
        main(*map(float, words[:1]), wire='--wire' in sys.argv)
