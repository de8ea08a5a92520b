# SPDX-License-Identifier: Apache-2.0
"""Retirements of keyframes as the nodes behind the selector receive them."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from pipeprog_msgs.msg import KeyframesRetired
from pipeprog_node import qos
from pipeprog_node.intake import Intake, InvalidMessageError
from pipeprog_node.received import keyframes as received_keyframes
from pipeprog_node.received.keyframes import ReceivedRetirement

RETIRED = "keyframes/retired"
MAX_WAITING = 50  # retirements; as deep as the keyframes' topic


class RetirementInput:
    """Subscribes to retirements: each is handed on once the keyframes that were published before it have come.

    Args:
        intake: the door of the node.
        use: gets each retirement.
        known: where a journal is kept: stamps of the retirements in it, which may come again and are passed over.
    """

    def __init__(
        self, intake: Intake, use: Callable[[ReceivedRetirement], None], known: Iterable[tuple[int, ...]] | None = None
    ) -> None:
        self._intake, self._use = intake, use
        self._known = None if known is None else set(known)
        self._waiting: list[ReceivedRetirement] = []
        self._keyframes = 0
        depth = qos.reliable(MAX_WAITING) if known is None else qos.kept(MAX_WAITING)
        intake.subscribe(KeyframesRetired, RETIRED, received_keyframes.retirement, self._on_retired, depth)

    def keyframes_came(self, count: int) -> None:
        """Notes how many keyframes have come in all."""
        self._keyframes = count
        for retirement in [each for each in self._waiting if count >= each.keyframes_published]:
            self._waiting.remove(retirement)
            self._use(retirement)

    def _on_retired(self, retirement: ReceivedRetirement) -> None:
        if self._known is not None:
            if retirement.stamps in self._known:
                return
            self._known.add(retirement.stamps)
        self._waiting.append(retirement)
        self.keyframes_came(self._keyframes)
        if len(self._waiting) > MAX_WAITING:
            last = max(self._waiting, key=lambda each: each.keyframes_published)
            self._waiting.remove(last)
            text = f"{MAX_WAITING} retirements wait already, that after {last.keyframes_published} keyframes is dropped"
            self._intake.reject(RETIRED, InvalidMessageError("waiting", text))
