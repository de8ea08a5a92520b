# SPDX-License-Identifier: Apache-2.0
"""Which keyframes and retirements were published, and which of them the SfM has answered to."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from pipeprog_camera.errors import InputError
from pipeprog_frames.overlap_feedback import OverlapReport

MAX_AHEAD = 2  # in lockstep: keyframes that the SfM may still be working on when the next is published


@dataclass(frozen=True)
class Answer:
    """One answer of the SfM; fields as in pipeprog_msgs/ImageOverlapArray.

    Attributes:
        stamp: of the newest keyframe that it has considered [ns].
        keyframes: number of keyframes that it has considered.
        retirements: number of retirements that it has considered.
        reports: overlaps that changed.
        readout: of the rolling shutter in use, s; 0: none, or none known yet.
    """

    stamp: int
    keyframes: int
    retirements: int
    reports: tuple[OverlapReport, ...]
    readout: float = 0.0


class Ledger:
    """Counts of what was published and answered, and the answers that were not used yet."""

    def __init__(self, exact: bool = False) -> None:
        """`exact`: the SfM has begun with this selector and works for it alone, so that it answers to each once."""
        self._exact = exact
        self.published: list[int] = []  # stamps in the order of publication
        self.lag = 0  # keyframes that the SfM is behind
        self._retirements = self._answered = self._answered_retirements = 0
        self._answers: deque[Answer] = deque()

    def publish(self, stamp: int) -> None:
        """Notes a published keyframe."""
        self.published.append(stamp)

    def retire(self) -> None:
        """Notes a published retirement."""
        self._retirements += 1

    def receive(self, answer: Answer) -> None:
        """Notes an answer, which waits until it is asked for.

        Raises InputError for an answer that cannot be the SfM's: to more than was published, or a second time.
        """
        if self._exact:
            self._check(answer)
        self._answered = max(self._answered, answer.keyframes)
        self._answered_retirements = max(self._answered_retirements, answer.retirements)
        self._answers.append(answer)
        if answer.stamp in self.published:  # by stamp, since a count would never recover from a lost keyframe
            self.lag = len(self.published) - 1 - self.published.index(answer.stamp)

    def _check(self, answer: Answer) -> None:
        published, answered = (len(self.published), self._retirements), (self._answered, self._answered_retirements)
        counts = answer.keyframes, answer.retirements
        if counts[0] > published[0] or counts[1] > published[1]:
            raise InputError(
                f"an answer to {counts[0]} keyframes and {counts[1]} retirements, of which {published[0]} and "
                f"{published[1]} were published: does another graph run in this ROS domain?"
            )
        if sum(counts) <= sum(answered):
            raise InputError(
                f"a second answer to {counts[0]} keyframes and {counts[1]} retirements: does another graph run in this "
                "ROS domain?"
            )

    def answers(self, keyframes: int) -> Iterator[Answer]:
        """Takes out the answers to no more than the first `keyframes` keyframes."""
        while self._answers and self._answers[0].keyframes <= keyframes:
            yield self._answers.popleft()

    @property
    def is_answered(self) -> bool:
        """Whether the SfM has answered to everything."""
        return self._answered >= len(self.published) and self._answered_retirements >= self._retirements

    @property
    def may_publish(self) -> bool:
        """Whether the SfM has followed closely enough for the next keyframe, in lockstep."""
        return self._answered_retirements >= self._retirements and len(self.published) - self._answered < MAX_AHEAD
