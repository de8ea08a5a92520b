import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeprog_camera.camera import Camera
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.selector import Decision, FrameSelector
from pipeprog_frames.tracker import Tracker, is_cut_off, reduction

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


def run(selector: FrameSelector, images: list[NDArray[np.uint8] | None]) -> list[Decision]:
    decisions = [d for index, image in enumerate(images) for d in selector.consider(index + 1, image)]
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
    chosen = [decision.stamp for decision in decisions if decision.chosen]
    gaps = np.diff(chosen)
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


def test_stamps_that_run_backwards_or_repeat(wall: NDArray[np.uint8]) -> None:
    selector = FrameSelector(FramesConfig(), CAMERA)
    selector.consider(10, pan(wall, 0))
    assert selector.consider(10, pan(wall, 1))[0].reason == "stamp repeats"
    assert selector.consider(5, pan(wall, 2))[0].reason == "stamp runs backwards"


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
