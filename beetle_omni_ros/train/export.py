"""Export of a trained actor to an ONNX file with its policy contract."""

from collections.abc import Callable
import copy
from dataclasses import replace
from datetime import datetime, timezone
import logging
from pathlib import Path
import subprocess
import warnings

import numpy as np
import torch

from beetle_omni_ros import __version__
from beetle_omni_ros.control.policy_file import (
    add_checksum,
    INPUT,
    OUTPUT,
    PolicyContract,
    session,
)
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import RunError
from beetle_omni_ros.train.network import ActorModel, ExportedPolicy
from beetle_omni_ros.train.parameters import TrainParameters

OPSET = 18
AGREEMENT = 1e-5     # largest difference of torch and onnxruntime, relative to the largest action
PROBES = 256         # compared observations


def export_policy(actor: ActorModel, path: Path, robot: RobotParameters,
                  parameters: TrainParameters, training: dict | None = None,
                  metrics: dict | None = None) -> float:
    """
    Write an actor as ONNX and compare the file with it.

    Args:
        actor: trained network.
        path: path of the file.
        robot: robot of the training.
        parameters: parameters of the training.
        training: further facts of the training for the file, e.g. its duration.
        metrics: results of the policy for the file.

    Returns:
        largest difference of torch and onnxruntime, relative to the largest action.

    Raises:
        RunError: the difference exceeds ``AGREEMENT``.

    """
    import onnx

    actor = copy.deepcopy(actor).cpu().eval()
    network, size = ExportedPolicy(actor).eval(), actor.obs_dim
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        logging.getLogger('torch.onnx').setLevel(logging.ERROR)
        program = torch.onnx.export(
            network, (torch.zeros(1, size),), input_names=[INPUT], output_names=[OUTPUT],
            opset_version=OPSET, dynamo=True, verbose=False)
    written = program.model_proto
    contract = PolicyContract.default(robot, parameters.memory)
    contract = replace(
        contract, training={**parameters.plain(), **(training or {})}, metrics=metrics or {},
        commit=commit(), version=__version__,
        created=datetime.now(timezone.utc).isoformat(timespec='seconds'))
    del written.metadata_props[:]
    for key, value in contract.to_metadata().items():
        written.metadata_props.add(key=key, value=value)
    strip_paths(written)
    path = Path(path)
    part = path.with_suffix('.part')
    onnx.save(written, str(part))
    add_checksum(part)
    difference = compare(actor.mean, part, size)
    if not difference <= AGREEMENT:
        part.unlink()
        raise RunError(f'{path}: torch and onnxruntime differ by {difference:.2g}, more than '
                       f'{AGREEMENT:g}')
    part.replace(path)
    return difference


def compare(mean: Callable[[torch.Tensor], torch.Tensor], path: Path, size: int) -> float:
    """Largest relative difference of torch and onnxruntime on random observations."""
    network = session(path.read_bytes())
    generator = torch.Generator().manual_seed(0)
    probes = torch.randn(PROBES, size, generator=generator)
    with torch.no_grad():
        expected = mean(probes).numpy()
    found = np.concatenate([network.run([OUTPUT], {INPUT: row[None].numpy()})[0]
                            for row in probes])
    return float(np.abs(found - expected).max() / max(np.abs(expected).max(), 1.0))


def strip_paths(proto) -> None:
    """Remove the exporter's notes on the origin of nodes, because they contain local paths."""
    for node in proto.graph.node:
        del node.metadata_props[:]
        node.doc_string = ''
    for value in (*proto.graph.input, *proto.graph.output, *proto.graph.value_info):
        del value.metadata_props[:]
    del proto.graph.metadata_props[:]
    for function in proto.functions:
        del function.metadata_props[:]


def commit() -> str:
    """Commit of the working tree of this package, '' outside of one."""
    try:
        done = subprocess.run(['git', 'describe', '--always', '--dirty', '--abbrev=12'],
                              cwd=Path(__file__).parent, capture_output=True, text=True,
                              timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return ''
    return done.stdout.strip()
