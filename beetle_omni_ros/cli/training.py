"""The subcommand train."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from beetle_omni_ros.cli.options import fail, FAILED, JsonOption, RobotOption


def train(output: Annotated[Path, typer.Option(
              '--output', metavar='DIR', help='Folder for checkpoints, TensorBoard log and '
                                              'policy.onnx. Default: that of --resume.')] = None,
          config: Annotated[Optional[Path], typer.Option(
              '--config', metavar='FILE', help='Other parameters than params/train.yaml.')] = None,
          changes: Annotated[Optional[list[str]], typer.Option(
              '--set', metavar='KEY=VALUE', help='Replace a parameter, e.g. iterations=5000 or '
                                                 'ppo.robots=8192; may be repeated.')] = None,
          seed: Annotated[Optional[int], typer.Option(
              '--seed', min=0, max=2**31 - 1, help='Of everything random.')] = None,
          memory: Annotated[Optional[bool], typer.Option(
              '--memory', help='The policy also sees the estimated disturbance.')] = None,
          device: Annotated[str, typer.Option('--device', help='auto, cpu, cuda[:N].')] = 'auto',
          resume: Annotated[Optional[Path], typer.Option(
              '--resume', metavar='DIR', help="Go on from a run's last checkpoint, or from a "
                                              'model_N.pt.')] = None,
          smoke: Annotated[bool, typer.Option(
              '--smoke', help='Tiny sizes: does everything fit together?')] = False,
          stop_after: Annotated[Optional[float], typer.Option(
              '--stop-after', min=0, metavar='SECONDS', help='Stop training early.')] = None,
          robot: RobotOption = None, json_path: JsonOption = None):
    """
    Train a policy and export it to ONNX; needs the extra 'train', and a GPU to be useful.

    Several GPUs: torchrun --nproc-per-node N -m beetle_omni_ros.cli train --output DIR
    """
    from beetle_omni_ros.train.command import run_train, TrainingError
    from beetle_omni_ros.train.run_folder import parse_changes
    try:
        run_train(output=output, config=config, robot=robot, device=device, resume=resume,
                  changes=parse_changes(changes or [], seed=seed, memory=memory),
                  smoke=smoke, stop_after=stop_after, json_path=json_path)
    except TrainingError as error:
        raise typer.Exit(fail(error, FAILED)) from None
