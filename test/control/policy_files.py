"""Small ONNX policies made by hand, for tests; needs the package `onnx`."""

import numpy as np
import onnx
from onnx import helper, numpy_helper, TensorProto

from beetle_omni_ros.control.policy_file import add_checksum, PolicyContract
from beetle_omni_ros.model.parameters import RobotParameters


def write(path, *, robot=None, memory=False, metadata=None, drop=(), weights=None, bias=None,
          inputs=None, outputs=8, names=('observation', 'action'),
          dtype=TensorProto.FLOAT):
    """
    Write one policy: affine with ``weights`` (n, 8) and ``bias`` (8,), zero by default.

    ``memory``: with the estimated disturbance as input; ``drop``: entries to leave out;
    ``inputs``: input size, if not the specified one.
    """
    contract = PolicyContract.default(robot or RobotParameters.load(), memory)
    size = inputs or contract.observation_size
    kind = helper.tensor_dtype_to_np_dtype(dtype)
    constants = [numpy_helper.from_array(np.asarray(
        np.zeros(shape) if value is None else value, dtype=kind), name)
        for name, value, shape in (('w', weights, (size, outputs)), ('b', bias, outputs))]
    nodes = [helper.make_node('Gemm', [names[0], 'w', 'b'], [names[1]])]
    graph = helper.make_graph(
        nodes, 'policy', [helper.make_tensor_value_info(names[0], dtype, [1, size])],
        [helper.make_tensor_value_info(names[1], dtype, [1, outputs])], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid('', 17)])
    model.ir_version = 8        # read by every onnxruntime that the package admits
    helper.set_model_props(model, {
        k: v for k, v in {**contract.to_metadata(), **(metadata or {})}.items() if k not in drop})
    onnx.save(model, str(path))
    add_checksum(path)
    return path
