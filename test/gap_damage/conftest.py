"""The kinds of damage lie beside the benchmarks."""

from pathlib import Path
import sys

sys.path.append(str(Path(__file__).resolve().parents[2] / 'benchmarks'))
