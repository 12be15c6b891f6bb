"""Lists in options of the command line."""

from __future__ import annotations

from beetle_omni_ros.robot.schema import ParameterError

MOST = 2**31  # seeds are below


def names(option: str, text: str | None) -> list[str] | None:
    """Split a list of names; None stays None; an entry twice or none is a ParameterError."""
    if text is None:
        return None
    found = [part.strip() for part in text.split(',') if part.strip()]
    if not found or len(set(found)) != len(found):
        raise ParameterError(f"{option} '{text}': expected different entries, separated by "
                             'commas')
    return found


def numbers(option: str, text: str | None) -> list[int] | None:
    """Split a list of whole numbers from 0; None stays None; others are a ParameterError."""
    found = names(option, text)
    if found is None:
        return None
    for part in found:
        if not part.isdecimal() or int(part) >= MOST:
            raise ParameterError(f"{option} '{text}': expected whole numbers from 0, separated "
                                 f"by commas, found '{part}'")
    return [int(part) for part in found]
