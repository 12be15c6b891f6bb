"""CPU time of the estimator: `python benchmarks/ekf.py [SECONDS_OF_FLIGHT]`."""

from pathlib import Path
import sys
from time import process_time, process_time_ns

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test' / 'estimation')]

from ekf_flights import fly, GRAVITY  # noqa: E402

from beetle_omni_ros.estimation.ekf import EkfParameters, ErrorStateEkf, ImuReading  # noqa: E402

FLIGHT = 800.0  # [s] a run of 100 poses


def main(duration=20.0):
    """Fly for ``duration`` seconds at 200 Hz IMU and 100 Hz MoCap, 10 ms old; print times."""
    ekf = ErrorStateEkf(EkfParameters.load(), GRAVITY)
    arrivals = list(fly(0, duration).arrivals())
    times = {'imu': [], 'pose with replay': [], 'estimate': []}
    for _, sample in arrivals:
        is_imu = isinstance(sample, ImuReading)
        start = process_time_ns()
        (ekf.imu if is_imu else ekf.pose)(sample)
        middle = process_time_ns()
        ekf.estimate
        end = process_time_ns()
        times['imu' if is_imu else 'pose with replay'].append(middle - start)
        times['estimate'].append(end - middle)
    for name, spent in times.items():
        median, p99 = np.percentile(spent, [50, 99]) / 1e3
        print(f'{name:18s} median {median:6.1f} us   p99 {p99:6.1f} us   {len(spent)} calls')

    ekf.reset()
    start = process_time()
    for _, sample in arrivals:
        (ekf.imu if isinstance(sample, ImuReading) else ekf.pose)(sample)
    whole = (process_time() - start) * FLIGHT / duration
    print(f'{FLIGHT:.0f} s of flight: {whole:.1f} s CPU')


if __name__ == '__main__':
    main(*map(float, sys.argv[1:2]))
