"""Folder of a training run: its parameter file and its checkpoints."""

from pathlib import Path
import re

import yaml

from beetle_omni_ros.robot.schema import bind, nest, ParameterError, parse_yaml, quoted, YamlError
from beetle_omni_ros.train.parameters import TrainParameters

PARAMETER_FILE = 'train.yaml'


def read_parameters(file: Path | None, changes: dict) -> TrainParameters:
    """
    Read a parameter file and replace single values.

    Args:
        file: YAML; None: the shipped one.
        changes: dotted name -> value.

    Raises:
        ParameterError: unusable file or value.

    """
    parameters = TrainParameters.load(file)
    flat = parameters.plain()
    for key, value in changes.items():
        if key not in flat:
            raise ParameterError(f'--set {key}: unknown; keys are those of params/train.yaml, '
                                 'e.g. ppo.robots')
        flat[key] = value
    return bind(TrainParameters, nest(flat), '--set' if changes else str(file or ''))


def write_parameters(parameters: TrainParameters, path: Path) -> None:
    """Write parameters as YAML, for ``--config``."""
    path.write_text(yaml.safe_dump(nest(parameters.plain()), sort_keys=False))


def last_checkpoint(folder: Path) -> Path:
    """
    Latest checkpoint of a run.

    Raises:
        ParameterError: no checkpoint.

    """
    if folder.is_file():
        return folder
    numbered = checkpoints(folder)
    if not numbered:
        raise ParameterError(f'--resume {folder}: no model_N.pt there; expected the folder of a '
                             'training')
    return numbered[max(numbered)]


def checkpoints(folder: Path) -> dict[int, Path]:
    """Iteration -> its checkpoint."""
    return {int(match[1]): path for path in folder.glob('model_*.pt')
            if (match := re.fullmatch(r'model_(\d+)\.pt', path.name))}


def make_folder(output: Path, checkpoint: Path | None) -> bool:
    """
    Create the folder of a run; return whether it is new.

    Raises:
        ParameterError: it cannot be created, or contains another run.

    """
    new = not output.exists()
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f'--output {output}: cannot be made ({error.strerror})') from None
    resumed = checkpoint is not None and output.resolve() == checkpoint.parent.resolve()
    if checkpoints(output) and not resumed:
        raise ParameterError(f'--output {output}: holds the checkpoints of another run; '
                             f'--resume {output} continues it')
    return new


def parse_changes(texts: list[str], **others) -> dict:
    """
    Parse ``key=value`` texts of the command line; add other keys whose value is not None.

    Raises:
        ParameterError: no '=', or an invalid YAML value.

    """
    changes = {}
    for text in texts:
        key, sign, value = text.partition('=')
        if not sign:
            raise ParameterError(f"--set '{text}': expected key=value")
        try:
            changes[key.strip()] = _number(parse_yaml(value))
        except YamlError as error:
            raise ParameterError(f'--set {quoted(text)}: the value is {error}') from None
    return changes | {key: value for key, value in others.items() if value is not None}


def _number(value):
    """Number of a text such as 1e-3, which is not a number in YAML 1.1."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value
