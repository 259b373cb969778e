"""SDO transfers and frames that were held back: how they may end, and which answer a client takes for its own."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from drive_env import cia402
from drive_env.cia402 import State
from rigs.safety_model.drive import latch, write_consumer, write_controlword
from rigs.safety_model.rules import Assumptions
from rigs.safety_model.situation import ACKNOWLEDGED, GONE, LIBRARY, Hand, Held, Situation, has_sdo, moved


def deliver(s: Situation, frame: Held) -> Situation:
    """Return the situation after a frame to the drive that was held back; an answer is then on its way."""
    held = list(s.held)
    held.remove(frame)
    assert isinstance(frame.content, int), "requests and RPDOs carry controlwords"
    if frame.kind == "rpdo":
        return s._replace(drive=latch(s.drive, frame.content), held=tuple(held))
    if not has_sdo(s):
        return s._replace(held=tuple(held))
    after = moved(s, write_controlword(s.drive, frame.content), Hand.OURS)
    if s.at not in GONE and not s.silent:
        held.append(Held("answer", ACKNOWLEDGED))
    return after._replace(held=tuple(held))


class ModelTransfer(NamedTuple):
    """How an SDO transfer may end: its fate, and the answer that its client takes for its own."""

    kind: str
    text: str
    after: Situation
    answer: object  # None: none came


def transfers(s: Situation, index: int, value: int | None, assumptions: Assumptions) -> Iterator[ModelTransfer]:
    """Return how a transfer may end: a write of `value` to 6040h or 1016h, or a read of 6041h."""
    if assumptions.keeps_order:
        while (earlier := next((frame for frame in s.held if frame.kind == "request"), None)) is not None:
            s = deliver(s, earlier)
    if not has_sdo(s):
        for answer, after in _answered(s, index, None, assumptions):
            yield ModelTransfer(LIBRARY, "the node answers no SDO in its NMT state", after, answer)
        return
    done, content = s, object()
    if index == cia402.CONTROLWORD:
        assert value is not None
        done, content = moved(s, write_controlword(s.drive, value), Hand.OURS), ACKNOWLEDGED
    elif index == 0x1016:
        assert value is not None
        done, content = s._replace(drive=write_consumer(s.drive, value)), "written"
    else:
        content = s.drive.fsa
    outcomes: list[tuple[str, str, Situation, object, tuple[Held, ...]]] = [(LIBRARY, "", done, content, ())]
    if s.silent:
        outcomes = [(LIBRARY, "it acts, and the node, which is silent, does not answer", done, None, ())]
    elif s.troubles:
        outcomes += [
            ("request lost", "the request is lost", s, None, ()),
            ("answer lost", "it acts, and its answer is lost", done, None, ()),
        ]
        if index == cia402.CONTROLWORD:
            late = (Held("request", value),)
            outcomes += [
                ("request held", "the request is held back", s, None, late),
                ("request doubled", "it acts, and a second copy is held back", done, content, late),
            ]
        if index != 0x1016:
            late = (Held("answer", content),)
            outcomes += [
                ("answer held", "it acts, and its answer is held back", done, None, late),
                ("answer doubled", "a second copy of its answer is held back", done, content, late),
            ]
    for kind, text, after, own, more in outcomes:
        troubles = s.troubles - (kind != LIBRARY)
        for answer, then in _answered(after._replace(troubles=troubles), index, own, assumptions):
            is_stale = answer is not None and answer is not own
            stale = f"an earlier answer is taken for its own: {named(answer)}" if is_stale else ""
            yield ModelTransfer(
                kind, ", ".join(filter(None, (text, stale))), then._replace(held=then.held + more), answer
            )


def _answered(s: Situation, index: int, own: object, assumptions: Assumptions) -> Iterator[tuple[object, Situation]]:
    """Return the answers that the client may take for its own: one that came late fits if it names the same object."""
    answers = [frame for frame in s.held if frame.kind == "answer"]
    others = tuple(frame for frame in s.held if frame.kind != "answer")
    # Answers of before that are not taken are passed over, or were there when the request was sent, and are dropped.
    left = s.held if own is None or not assumptions.keeps_order else others
    yield own, s._replace(held=left)
    for k, frame in enumerate(answers):
        if index != 0x1016 and (frame.content is ACKNOWLEDGED) == (index == cia402.CONTROLWORD):
            rest = (*others, *answers[k + 1 :]) + (() if own is None else (Held("answer", own),))
            yield frame.content, s._replace(held=rest)
            return


def named(content: object) -> str:
    """Return an answer's content in words."""
    return content.name.lower().replace("_", " ") if isinstance(content, State) else str(content)
