# SPDX-License-Identifier: Apache-2.0
"""The queue of images: bounded in number and, live, in bytes."""

from __future__ import annotations

from pipeprog_frames.incoming.arrival import MAX_QUEUE, MAX_QUEUE_BYTES, Arrival, ArrivalQueue


def test_the_oldest_of_many_small_images_gives_way() -> None:
    for lossless in (False, True):
        queue = ArrivalQueue(lossless)
        dropped = [each.stamp for stamp in range(20_000) for each in queue.push(Arrival(stamp, "", nbytes=1))]
        assert len(queue) == MAX_QUEUE
        assert dropped == list(range(20_000 - MAX_QUEUE))
        assert queue.head.stamp == queue.pop().stamp == 20_000 - MAX_QUEUE


def test_large_images_wait_in_bounded_memory() -> None:
    queue = ArrivalQueue(lossless=False)
    assert not queue.push(Arrival(0, "", nbytes=2 * MAX_QUEUE_BYTES)), "one larger than all is held alone"
    assert [each.stamp for each in queue.push(Arrival(1, "", nbytes=MAX_QUEUE_BYTES // 2))] == [0]
    assert not queue.push(Arrival(2, "", nbytes=MAX_QUEUE_BYTES // 2))
    assert [each.stamp for each in queue.push(Arrival(3, "", nbytes=1))] == [1]


def test_a_replay_loses_no_large_image() -> None:
    queue = ArrivalQueue(lossless=True)
    assert not any(queue.push(Arrival(stamp, "", nbytes=MAX_QUEUE_BYTES)) for stamp in range(MAX_QUEUE))
