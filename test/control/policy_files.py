"""Small ONNX policies made by hand, for tests; needs the package `onnx`."""

import numpy as np
import onnx
from onnx import helper, numpy_helper, TensorProto

from beetle_omni_ros.control.policy_file import add_checksum, PolicyContract
from beetle_omni_ros.model.parameters import RobotParameters


def write(path, *, robot=None, memory=False, metadata=None, drop=(), weights=None, bias=None,
          inputs=None, outputs=8, names=('observation', 'action'), history=0,
          dtype=TensorProto.FLOAT):
    """
    Write one policy: affine with ``weights`` (n, 8) and ``bias`` (8,), zero by default.

    ``memory``: with the estimated disturbance as input; ``drop``: entries to leave out;
    ``inputs``: input size, if not the specified one. ``history``: size of a history, which counts
    calls, and whose weights follow those of the observation.
    """
    contract = PolicyContract.default(robot or RobotParameters.load(), memory)
    size = inputs or contract.observation_size
    kind = helper.tensor_dtype_to_np_dtype(dtype)
    constants = [numpy_helper.from_array(np.asarray(
        np.zeros(shape) if value is None else value, dtype=kind), name)
        for name, value, shape in (('w', weights, (size + history, outputs)),
                                   ('b', bias, outputs), ('one', [1.0], 1))]
    kept = 2 if history else 1
    nodes = [helper.make_node('Concat', [names[0], 'history'][:kept], ['all'], axis=1),
             helper.make_node('Gemm', ['all', 'w', 'b'], [names[1]]),
             helper.make_node('Add', ['history', 'one'], ['next_history'])][:kept + 1]
    graph = helper.make_graph(
        nodes, 'policy', [helper.make_tensor_value_info(name, dtype, [1, width]) for name, width
                          in ((names[0], size), ('history', history))][:kept],
        [helper.make_tensor_value_info(name, dtype, [1, width]) for name, width
         in ((names[1], outputs), ('next_history', history))][:kept], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid('', 17)])
    model.ir_version = 8        # read by every onnxruntime that the package admits
    helper.set_model_props(model, {
        k: v for k, v in {**contract.to_metadata(), **(metadata or {})}.items() if k not in drop})
    onnx.save(model, str(path))
    add_checksum(path)
    return path
