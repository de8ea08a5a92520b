# SPDX-License-Identifier: Apache-2.0
import tracemalloc
from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.frame_decision import Decision, Load
from pipeprog_frames.incoming.decoding import decode_reduced, is_cut_off, reduction
from pipeprog_frames.incoming.frame_buffer import EncodedFrame, FrameFile, FrameRing
from pipeprog_frames.overlap_feedback import OverlapReport
from pipeprog_frames.policy.keyframe_budget import KeyframeBudget
from pipeprog_frames.policy.selector import FrameSelector
from pipeprog_frames.policy.stream import MAX_GAP, KeyframeStream
from pipeprog_frames.tracker import Tracker

WIDTH, HEIGHT = 320, 180
CAMERA = Camera(WIDTH * 4, HEIGHT * 4, 900.0, 900.0, WIDTH * 2.0, HEIGHT * 2.0)


@pytest.fixture(scope="module")
def wall() -> NDArray[np.uint8]:
    """A wide textured wall that a window of the image size pans over."""
    noise = np.random.default_rng(0).standard_normal((HEIGHT + 40, WIDTH * 6)).astype(np.float32)
    smooth = sum(sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (2.0, 6.0, 18.0))
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def pan(wall: NDArray[np.uint8], x: float) -> NDArray[np.uint8]:
    shift = np.array([[1, 0, -x], [0, 1, -20.0]])
    return cv2.warpAffine(wall, shift, (WIDTH, HEIGHT))


def load(image: NDArray[np.uint8] | None) -> Load | None:
    return None if image is None else lambda: image


def run(selector: FrameSelector, images: Sequence[NDArray[np.uint8] | None], fps: float = 5.0) -> list[Decision]:
    """Decisions in order of time; the first stamp is 1."""
    period = round(1e9 / fps)
    decisions = [d for index, image in enumerate(images) for d in selector.consider(index * period + 1, load(image))]
    return sorted(decisions + selector.flush(), key=lambda decision: decision.stamp)


@pytest.mark.parametrize("shift", [3.0, 15.0, 40.0])
def test_overlap_of_a_pan(wall: NDArray[np.uint8], shift: float) -> None:
    tracker = Tracker(CAMERA)
    tracker.start(pan(wall, 0))
    assert tracker.track(pan(wall, shift)).overlap == pytest.approx(1 - shift / WIDTH, abs=0.01)


def test_a_jump_without_common_view_is_no_overlap(wall: NDArray[np.uint8]) -> None:
    tracker = Tracker(CAMERA)
    tracker.start(pan(wall, 0))
    assert tracker.track(pan(wall, 3 * WIDTH)).overlap == 0.0


def test_pan_takes_the_fewest_frames_that_keep_the_overlap(wall: NDArray[np.uint8]) -> None:
    step = 8  # px, 2.5 % of the width: five steps keep 0.875, six fall to 0.85
    images: list[NDArray[np.uint8] | None] = [pan(wall, step * index) for index in range(100)]
    decisions = run(FrameSelector(FramesConfig(overlap_min=0.86), CAMERA), images)
    gaps = np.diff([index for index, decision in enumerate(decisions) if decision.chosen])
    assert len(decisions) == 100
    assert gaps.max() <= 5
    assert np.median(gaps) == 5


def test_standing_still_adds_nothing(wall: NDArray[np.uint8]) -> None:
    decisions = run(FrameSelector(FramesConfig(), CAMERA), [pan(wall, 0)] * 40)
    assert [decision.stamp for decision in decisions if decision.chosen] == [1]
    assert len(decisions) == 40


def test_blurred_frame_is_passed_over(wall: NDArray[np.uint8]) -> None:
    images: list[NDArray[np.uint8] | None] = [pan(wall, 12 * index) for index in range(30)]
    for index in (3, 7, 11, 15, 19, 23):
        images[index] = cv2.GaussianBlur(images[index], (0, 0), 2.5)
    decisions = run(FrameSelector(FramesConfig(overlap_min=0.8), CAMERA), images)
    assert not any(decisions[index].chosen for index in (3, 7, 11, 15, 19, 23))
    assert sum(decision.chosen for decision in decisions) >= 6


def test_covered_lens_and_damaged_frames_cost_themselves_alone(wall: NDArray[np.uint8]) -> None:
    images: list[NDArray[np.uint8] | None] = [pan(wall, 4 * index) for index in range(60)]
    plain = {d.stamp for d in run(FrameSelector(FramesConfig(), CAMERA), list(images)) if d.chosen}
    for index in (20, 21, 22, 23):
        images[index] = np.full((HEIGHT, WIDTH), 3, np.uint8)
    images[40] = None
    decisions = run(FrameSelector(FramesConfig(), CAMERA), images)
    assert decisions[40].reason == "damaged image"
    assert decisions[21].reason == "too few features"
    assert not any(decisions[index].chosen for index in (20, 21, 22, 23, 40))
    assert abs(sum(decision.chosen for decision in decisions) - len(plain)) <= 1


@pytest.mark.parametrize("step", [0.8, 2.5, 6.0])
def test_what_is_not_looked_at_changes_no_choice_by_more_than_a_frame(wall: NDArray[np.uint8], step: float) -> None:
    """Of a 30 Hz stream most frames are not even decoded; a 5 Hz one, where each counts, is looked at in full."""
    images = [pan(wall, step * index) for index in range(min(200, int(1500 / step)))]
    chosen, looks = {}, {}
    for fps in (5.0, 30.0):
        seen: set[int] = set()

        def look(index: int, seen: set[int] = seen) -> NDArray[np.uint8]:
            seen.add(index)
            return images[index]

        selector = FrameSelector(FramesConfig(), CAMERA)
        decisions = []
        for index in range(len(images)):
            decisions += selector.consider(round(index * 1e9 / fps), partial(look, index))
        decisions += selector.flush()
        assert len(decisions) == len(images)
        chosen[fps], looks[fps] = sum(decision.chosen for decision in decisions), len(seen)
    assert looks[5.0] == len(images)
    assert chosen[5.0] > 3
    assert chosen[30.0] == pytest.approx(chosen[5.0], rel=0.1)
    if step < 2.0:
        assert looks[30.0] < 0.5 * len(images)


def test_a_sudden_turn_after_a_rest_loses_nothing(wall: NDArray[np.uint8]) -> None:
    """While nothing moves few frames are looked at; a turn of 90 degrees a second is followed from its first frame."""
    step = WIDTH / 70 * 3  # 3 degrees a frame at 30 Hz
    images = [pan(wall, 0)] * 30 + [pan(wall, step * index) for index in range(1, 31)]
    decisions = run(FrameSelector(FramesConfig(), CAMERA), images, fps=30.0)
    chosen = [index for index, decision in enumerate(decisions) if decision.chosen]
    assert chosen[0] == 0
    assert min(chosen[1:]) >= 30
    assert np.diff([29, *chosen[1:]]).max() * step <= (1 - FramesConfig().overlap_min) * WIDTH
    assert chosen[-1] * step > (59 - 4) * step


def test_load_asks_for_fewer_keyframes(wall: NDArray[np.uint8]) -> None:
    images = [pan(wall, 6.0 * index) for index in range(120)]
    counts = []
    for load_of_sfm in (0.0, 0.5, 1.0):
        selector = FrameSelector(FramesConfig(), CAMERA)
        selector.limits.relax(load_of_sfm)
        counts.append(sum(decision.chosen for decision in run(selector, images)))
    assert counts[0] > counts[1] > counts[2] > 3


@pytest.mark.parametrize("burst", [4, 15, 40])
def test_a_burst_of_damaged_frames_costs_those_alone(wall: NDArray[np.uint8], burst: int) -> None:
    images: list[NDArray[np.uint8] | None] = [pan(wall, 3 * index) for index in range(90)]
    plain = sum(d.chosen for d in run(FrameSelector(FramesConfig(), CAMERA), images, fps=30.0))
    rng = np.random.default_rng(5)
    damaged = [*range(30, 30 + burst), 80]
    for index in damaged:
        images[index] = cv2.resize(rng.integers(0, 255, (23, 40), dtype=np.uint8), (WIDTH, HEIGHT), interpolation=0)
    decisions = run(FrameSelector(FramesConfig(), CAMERA), images, fps=30.0)
    assert len(decisions) == 90
    assert not any(decisions[index].chosen for index in damaged)
    lost = round(burst / (0.15 * WIDTH / 3))  # keyframes that the burst has covered
    assert abs(sum(decision.chosen for decision in decisions) - (plain - lost)) <= 1


@pytest.mark.parametrize("step", [120, 400])
def test_jumps_beyond_the_trackers_reach_are_keyframes(wall: NDArray[np.uint8], step: int) -> None:
    """A turning robot at 2 Hz: what the tracker cannot follow the features of the SfM may."""
    if step == 120:
        images = [pan(wall, step * index) for index in range(13)]
        decisions = run(FrameSelector(FramesConfig(), CAMERA), images, fps=2.0)
        assert sum(decision.chosen for decision in decisions) >= 7
    images = [pan(wall, 0)] * 10 + [pan(wall, step)] * 10 + [pan(wall, 3 * step)] * 10
    decisions = run(FrameSelector(FramesConfig(), CAMERA), images)
    assert [index for index, decision in enumerate(decisions) if decision.chosen] == [0, 10, 20]


def test_a_lens_covered_while_walking_leaves_one_gap(wall: NDArray[np.uint8]) -> None:
    rng = np.random.default_rng(6)
    images: list[NDArray[np.uint8] | None] = [pan(wall, 2 * index) for index in range(240)]
    for index in range(90, 150):
        images[index] = np.clip(rng.normal(4, 0.5, (HEIGHT, WIDTH)), 0, 255).astype(np.uint8)
    decisions = run(FrameSelector(FramesConfig(), CAMERA), images, fps=30.0)
    chosen = [index for index, decision in enumerate(decisions) if decision.chosen]
    assert not set(chosen) & set(range(90, 150))
    assert 150 in chosen
    assert any(66 < index < 90 for index in chosen), "and the gap is as short as can be"


def test_a_stop_of_twenty_seconds_in_an_unsteady_hand_adds_two_frames_at_most(wall: NDArray[np.uint8]) -> None:
    rng = np.random.default_rng(7)
    sway = 4 * np.sin(np.arange(600) / 9) + rng.normal(0, 0.5, 600)
    images = []
    for index in range(600):
        noise = rng.normal(0, 2, (HEIGHT, WIDTH))
        images.append(np.clip(pan(wall, 200 + sway[index]) + noise, 0, 255).astype(np.uint8))
    decisions = run(FrameSelector(FramesConfig(), CAMERA), images, fps=30.0)
    assert sum(decision.chosen for decision in decisions) <= 1 + 2


def test_stamps_that_run_backwards_or_repeat(wall: NDArray[np.uint8]) -> None:
    selector = FrameSelector(FramesConfig(), CAMERA)
    selector.consider(10, load(pan(wall, 0)))
    assert selector.consider(10, load(pan(wall, 1)))[0].reason == "stamp repeats"
    assert selector.consider(5, load(pan(wall, 2)))[0].reason == "stamp runs backwards"


@pytest.mark.parametrize(
    ("width", "factor"), [(320, 1), (640, 2), (1280, 4), (1920, 4), (3840, 8), (7680, 8), (200, 1)]
)
def test_reduction(width: int, factor: int) -> None:
    assert reduction(width) == factor


def test_a_jpeg_without_its_end_is_damaged(wall: NDArray[np.uint8]) -> None:
    whole = cv2.imencode(".jpg", pan(wall, 0))[1].tobytes()
    assert not is_cut_off(whole)
    assert not is_cut_off(cv2.imencode(".png", pan(wall, 0))[1].tobytes())
    assert is_cut_off(whole[: len(whole) // 2])
    assert is_cut_off(b"")


def test_a_long_4k_stream_stays_in_flat_memory(wall: NDArray[np.uint8]) -> None:
    """Ten minutes at 30 Hz, shortened to what fills the ring three times over: 1 MiB a frame."""
    camera = Camera(3840, 2160, 2700.0, 2700.0, 1919.5, 1079.5)
    ring = FrameRing(64 << 20)
    stream = KeyframeStream(FramesConfig(), camera, ring.sharpest_between, KeyframeBudget(0))
    views = [cv2.resize(pan(wall, 2.5 * index), (480, 270)) for index in range(60)]
    peaks = []
    tracemalloc.start()
    for index in range(240):
        stamp = 1 + index * 33_333_333
        ring.add(EncodedFrame(stamp, "camera", bytes(1 << 20), camera))
        # There and back: a stream that would walk on would need a wall of ten minutes.
        stream.consider(stamp, partial(views.__getitem__, min(index % 120, 119 - index % 120)))
        if index % 60 == 59:
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.reset_peak()
    tracemalloc.stop()
    assert max(peaks) < 16 << 20, "beside the ring, which is one piece: the window and the images being looked at"
    assert max(peaks[2:]) - min(peaks[2:]) < 1 << 20


@pytest.mark.parametrize(("readout", "lag", "denser"), [(0.0, 0, False), (0.015, 0, True), (0.015, 25, False)])
def test_keyframes_are_dense_in_time_for_a_rolling_shutter_that_the_sfm_keeps_up_with(
    wall: NDArray[np.uint8], readout: float, lag: int, denser: bool
) -> None:
    camera = Camera(WIDTH, HEIGHT, 225.0, 225.0, 159.5, 89.5)
    file = FrameFile()
    stream = KeyframeStream(FramesConfig(), camera, file.sharpest_between, KeyframeBudget(0))
    chosen = []
    for index in range(60):
        image, stamp = pan(wall, index), 1 + index * 33_333_333
        file.add(EncodedFrame(stamp, "camera", cv2.imencode(".jpg", image)[1].tobytes(), camera))
        chosen += [decision.stamp for decision in stream.consider(stamp, load(image)) if decision.chosen]
    assert max(np.diff(chosen)) > MAX_GAP
    stream.lag(lag)
    reports = [OverlapReport(stamp, True, 0.86, 0.86, 500, 500) for stamp in chosen]
    assert any(decision.chosen for decision in stream.answer(reports, readout)) == denser


def test_the_ring_gives_up_its_oldest_and_the_file_none(wall: NDArray[np.uint8]) -> None:
    encoded = [cv2.imencode(".jpg", pan(wall, 3 * index))[1].tobytes() for index in range(20)]
    camera = Camera(WIDTH, HEIGHT, 225.0, 225.0, 159.5, 89.5)
    ring, file = FrameRing(sum(map(len, encoded[10:]))), FrameFile()
    for store in (ring, file):
        for index, data in enumerate(encoded):
            store.add(EncodedFrame(index + 1, "camera", data, camera))
        store.add(EncodedFrame(1, "camera", b"again", camera))  # a stamp that runs backwards
        kept = store.get(20)
        assert kept is not None
        assert kept.encoded == encoded[19]
        assert store.sharpest_between(12, 20) in (15, 16, 17)
        assert store.sharpest_between(15, 17, {16}) is None
    assert ring.get(5) is None
    first = file.get(1)
    assert first is not None
    assert first.encoded == encoded[0]
    assert file.sharpest_between(1, 9) in (4, 5, 6)
    assert ring.sharpest_between(1, 9) is None


@given(sizes=st.lists(st.integers(1, 60), min_size=1, max_size=60), capacity=st.integers(1, 100))
def test_the_ring_holds_the_last_frames_unchanged(sizes: list[int], capacity: int) -> None:
    ring = FrameRing(capacity)
    camera = Camera(WIDTH, HEIGHT, 225.0, 225.0, 159.5, 89.5)
    encoded = {stamp: bytes([stamp]) * size for stamp, size in enumerate(sizes)}
    for stamp, data in encoded.items():
        ring.add(EncodedFrame(stamp, "camera", data, camera))
    held = {stamp: frame.encoded for stamp in encoded if (frame := ring.get(stamp)) is not None}
    assert held == {stamp: encoded[stamp] for stamp in held}
    assert list(held) == list(encoded)[-len(held) :]
    # Frames that do not fit behind the last one begin anew at the start: less than one frame is lost to that.
    before = len(sizes) - len(held) - 1
    room = max(capacity, *sizes)
    assert before < 0 or sum(sizes[before:]) > room - max(sizes)


def test_the_sharpest_about_the_middle_is_taken_and_a_useless_frame_never(wall: NDArray[np.uint8]) -> None:
    ring = FrameRing(1 << 30)
    camera = Camera(WIDTH, HEIGHT, 225.0, 225.0, 159.5, 89.5)
    images = [pan(wall, 3 * index) for index in range(9)]
    images[3], images[4] = cv2.GaussianBlur(images[3], (0, 0), 3), np.full((HEIGHT, WIDTH), 3, np.uint8)
    for index, image in enumerate(images):
        ring.add(EncodedFrame(index, "camera", cv2.imencode(".jpg", image)[1].tobytes(), camera))
    assert ring.sharpest_between(0, 8) in (2, 5)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_a_camera_that_is_mounted_turned_chooses_the_same(wall: NDArray[np.uint8], turns: int) -> None:
    """Spot's front cameras lie on their sides; grey PNG at irregular 2 to 15 Hz."""
    stamps = 1 + np.cumsum(np.random.default_rng(3).uniform(1 / 15, 1 / 2, 40) * 1e9).astype(int)
    width, height = (WIDTH, HEIGHT) if turns % 2 == 0 else (HEIGHT, WIDTH)
    camera = Camera(2 * width, 2 * height, 450.0, 450.0, width - 0.5, height - 0.5)
    chosen = []
    selector = FrameSelector(FramesConfig(), camera)
    decisions = []
    for index, stamp in enumerate(stamps):
        image = np.rot90(cv2.resize(pan(wall, 12 * index), (2 * WIDTH, 2 * HEIGHT)), turns)
        encoded = cv2.imencode(".png", np.ascontiguousarray(image))[1].tobytes()
        decisions += selector.consider(int(stamp), partial(decode_reduced, encoded, camera.width))
    decisions = sorted(decisions + selector.flush(), key=lambda decision: decision.stamp)
    chosen = [index for index, decision in enumerate(decisions) if decision.chosen]
    assert len(decisions) == 40
    assert np.diff(chosen).max() <= 4  # 12 px a frame: 0.15 of the width are four
    assert 10 <= len(chosen) <= 16
