"""Forward selection and backward elimination, independent of fit and criterion."""

from collections.abc import Callable
from typing import TypeVar

Entry = TypeVar('Entry')
Trial = TypeVar('Trial')
Model = TypeVar('Model')


def grow(accepted: list[Entry], model: Model,
         best: Callable[[list[Entry], Model], Trial | None],
         join: Callable[[list[Entry], Trial], tuple[list[Entry], Model]],
         most: int) -> tuple[list[Entry], Model]:
    """
    Add entries while one is accepted.

    Args:
        accepted: entries of the model.
        model: model fitted with them.
        best: the best acceptable trial of another entry, or None.
        join: entries and fitted model with that trial.
        most: largest number of entries.

    Returns:
        entries and model.

    """
    while (trial := best(accepted, model)) is not None and len(accepted) < most:
        accepted, model = join(accepted, trial)
    return accepted, model


def prune(accepted: list[Entry], model: Model,
          worst: Callable[[list[Entry], Model], Entry | None],
          without: Callable[[list[Entry], Model, Entry], Model]) -> tuple[list[Entry], Model]:
    """
    Drop entries while one is superfluous.

    Args:
        accepted: entries of the model.
        model: model fitted with them.
        worst: the entry to drop, or None.
        without: model fitted with the remaining entries; its last argument is the dropped one.

    Returns:
        entries and model.

    """
    while accepted and (dropped := worst(accepted, model)) is not None:
        accepted = [entry for entry in accepted if entry is not dropped]
        model = without(accepted, model, dropped)
    return accepted, model
