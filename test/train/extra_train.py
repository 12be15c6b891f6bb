"""Import this first: without the extra 'train' the test module is skipped."""

import pytest

for module in ('torch', 'tensordict', 'rsl_rl', 'onnx', 'onnxscript', 'tensorboard'):
    pytest.importorskip(module, reason=f"the extra 'train' is not installed (no {module})")
