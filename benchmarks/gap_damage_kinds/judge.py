"""Whether a damage was detected, and its stated cause, topic and time."""

from __future__ import annotations

from dataclasses import asdict, dataclass
import re

from gap_damage_kinds.ask import TIMEOUT
from gap_damage_kinds.kind import HARMLESS, Kind, REPAIRABLE

SENSORS = ('mocap_time_offset', 'imu_filter_lag', 'joint_feedback_delay', 'mocap_misalignment',
           'imu_accelerometer_bias', 'imu_gyroscope_bias', 'imu_misalignment', 'imu_lever_arm')
NEAR = 2.0          # [s] from the onset
BAD_DATA = 3        # exit status


@dataclass(frozen=True)
class Judged:
    """
    Result for one kind of damage on one set of flights.

    Attributes:
        verdict: verdict of the JSON, or the event in its place.
        status: exit status.
        names: all named effects.
        false_names: named effects of body, rotors, joints and commands that are not named on the
            same flights without damage.
        cause: whether the cause is stated; None if there is none.
        topic: whether the right topic is stated with it; None without a cause.
        onset: whether the time is stated with it; None if the damage has none.
        right: see :func:`judge`.
        said: statement with the cause, or the reason.
        seconds: time of the analysis.

    """

    verdict: str
    status: int
    names: tuple[str, ...]
    false_names: tuple[str, ...]
    cause: bool | None
    topic: bool | None
    onset: bool | None
    right: bool
    said: str
    seconds: float

    def plain(self) -> dict:
        """As plain data."""
        return asdict(self)


def judge(kind: Kind, asked: dict, known: tuple[str, ...] = ()) -> Judged:
    """
    Judge one answer.

    Right is: ``bad_data`` with exit status 3 and the cause in words; for repairable damage also
    another verdict with status 0, the cause in words and no false name; for a control every
    verdict but ``bad_data``, with status 0 and no false name.

    Args:
        kind: kind of damage.
        asked: see :func:`~gap_damage_kinds.ask.ask`, with ``onset`` of the damage [s] by the
            undamaged stamps, or None, and ``begin``, the first of these stamps [s].
        known: effects that are named in the undamaged flights.

    """
    answer = asked['answer'] or {}
    verdict = verdict_of(asked)
    names = tuple(dict.fromkeys(
        name for effect in answer.get('effects') or () for name in effect['names'][:1]))
    false = tuple(n for n in names if n not in SENSORS and n not in known)
    stated = [s for s in statements(answer, asked['folder']) if kind.is_stated_in(s['text'])]
    cause = topic = None
    if kind.causes:
        cause = bool(stated)
        topic = any(on_topic(kind, s) for s in stated)
    refused = verdict == 'bad_data' and asked['status'] == BAD_DATA
    used = verdict not in ('bad_data', 'timeout', 'no answer') and asked['status'] == 0
    right = not false and not asked['crash'] and (
        used if kind.harm == HARMLESS else
        bool(cause) and (refused or (kind.harm == REPAIRABLE and used)))
    return Judged(verdict, asked['status'], names, false, cause, topic,
                  states_onset(asked, stated), right,
                  (stated[0]['text'] if stated else answer.get('reason')) or asked['message'],
                  asked['seconds'])


def verdict_of(asked: dict) -> str:
    """The verdict, or the event in its place."""
    answer = asked['answer'] or {}
    return answer.get('verdict') or ('timeout' if asked['status'] == TIMEOUT else 'no answer')


def statements(answer: dict, folder: str) -> list[dict]:
    """
    All statements: ``text``, and ``topic`` and ``at_s`` if present.

    Args:
        answer: the JSON.
        folder: folder of the bags, which is removed from the texts.

    """
    def words(text):
        return str(text).replace(folder, '')

    entries = [e for e in answer.get('bad_data') or () if isinstance(e, dict)]
    said = [{'text': words(f"{e.get('topic') or ''}: {e.get('cause')}"), 'topic': e.get('topic'),
             'at_s': e.get('at_s')} for e in entries]
    return said + [{'text': words(text), 'topic': None, 'at_s': None}
                   for text in (answer.get('reason'), *(answer.get('findings') or ())) if text]


def on_topic(kind: Kind, statement: dict) -> bool:
    """Whether a statement names one of the right topics."""
    if not kind.topics:
        return True
    if statement['topic']:
        return any(str(statement['topic']).lstrip('/').endswith(t) for t in kind.topics)
    return any(topic in statement['text'] for topic in kind.topics)


def states_onset(asked: dict, stated: list[dict]) -> bool | None:
    """Whether a statement of the cause has its onset; None without one."""
    if asked['onset'] is None:
        return None
    return any(near(s, asked['onset'], asked['begin']) for s in stated)


def near(statement: dict, onset: float, begin: float) -> bool:
    """Whether a statement has the time, by the stamps or since the first of them."""
    if isinstance(statement['at_s'], (int, float)):
        times = [statement['at_s']]
    else:
        times = [float(t) for t in re.findall(r'(\d+(?:\.\d+)?) s\b', statement['text'])]
    return any(abs(t - moment) <= NEAR for t in times for moment in (onset, onset - begin))
