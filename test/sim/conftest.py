"""Make the robots of this folder importable by its tests, whatever pytest's import mode."""

from pathlib import Path
import sys

sys.path.insert(0, str(Path(__file__).parent))
