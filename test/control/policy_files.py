"""Small ONNX policies made by hand, for tests; needs the package `onnx`."""

import numpy as np
import onnx
from onnx import helper, numpy_helper, TensorProto

from beetle_omni_ros.control.policy_file import add_checksum, PolicyContract
from beetle_omni_ros.robot.parameters import RobotParameters


def write(path, *, robot=None, memory=False, metadata=None, drop=(), weights=None, bias=None,
          hidden=None, seed=0, inputs=None, outputs=8, names=('observation', 'action'),
          dtype=TensorProto.FLOAT):
    """
    Write one policy: affine, or a random network with ``hidden`` layers.

    Args:
        path: file to write.
        robot: robot in the metadata; default the shipped one.
        memory: whether the estimated disturbance is an input.
        metadata: entries that replace the correct ones.
        drop: entries to leave out.
        weights: (n, 8) of an affine policy; default zero.
        bias: (8,); default zero.
        hidden: sizes of hidden layers of a random ELU network.
        seed: seed of the random network.
        inputs: input size, if not the specified one.
        outputs: output size.
        names: names of input and output.
        dtype: type of input and output.

    """
    contract = PolicyContract.default(robot or RobotParameters.load(), memory)
    size = inputs or contract.observation_size
    nodes, constants, last = [], [], names[0]
    if hidden is None:
        hidden, weights = (), np.zeros((size, outputs)) if weights is None else weights
    rng = np.random.default_rng(seed)
    widths = (size, *hidden, outputs)
    for k, (fan_in, fan_out) in enumerate(zip(widths[:-1], widths[1:])):
        final = k == len(widths) - 2
        matrix = weights if final and weights is not None else \
            rng.normal(size=(fan_in, fan_out)) / np.sqrt(fan_in)
        offset = bias if final and bias is not None else np.zeros(fan_out)
        kind = helper.tensor_dtype_to_np_dtype(dtype)
        constants += [numpy_helper.from_array(np.asarray(matrix, dtype=kind), f'w{k}'),
                      numpy_helper.from_array(np.asarray(offset, dtype=kind), f'b{k}')]
        result = names[1] if final else f'y{k}'
        nodes.append(helper.make_node('Gemm', [last, f'w{k}', f'b{k}'], [result]))
        last = result
        if not final:
            nodes.append(helper.make_node('Elu', [last], [f'h{k}']))
            last = f'h{k}'
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
