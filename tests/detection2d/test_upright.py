import cv2
import numpy as np
import pytest

from shapepose_fg.core.camera import Camera
from shapepose_fg.core.rendering import look_at
from shapepose_fg.detection2d.upright import UprightView, roll_of

UP = np.array([0.0, 0.0, 1.0])


def rolled(degrees: float, eye=(4.0, 0.5, 1.8)) -> Camera:
    wTc = look_at(np.array(eye), np.array([0.0, 0.0, 1.0]), UP)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    wTc[:3, :3] = wTc[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return Camera("c", np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]]), wTc, (640, 480))


@pytest.mark.parametrize("degrees", [-170, -90, -26, 0, 13, 45, 90, 150])
def test_what_is_up_in_the_world_is_up_in_the_turned_picture(degrees):
    camera = rolled(degrees)
    view = UprightView.of((-0.5, -0.5, 639.5, 479.5), roll_of(camera, UP), 656, 16)
    xy, _ = camera.project(np.array([[0, 0, 1.0], [0, 0, 1.1]]))
    low, high = xy @ view.input_from_picture[:, :2].T + view.input_from_picture[:, 2]
    across, up = high[0] - low[0], low[1] - high[1]
    assert up > 0
    # Both sides are rounded to multiples of 16: the axes' scales differ by up to 3 %, a degree at
    # 45.
    assert abs(np.degrees(np.arctan2(across, up))) < 1.5
    assert view.size[0] % 16 == 0 and view.size[1] % 16 == 0 and max(view.size) == 656


def test_a_little_roll_is_left_and_a_camera_that_looks_down_is_not_turned():
    region = (-0.5, -0.5, 639.5, 479.5)
    assert UprightView.of(region, 3.0, 656, 16).turn_deg == 0
    assert UprightView.of(region, 88.0, 656, 16).turn_deg == 90
    assert UprightView.of(region, 12.0, 656, 16).turn_deg == 12
    assert roll_of(rolled(40, eye=(0.01, 0.0, 5.0)), UP) == 0.0


@pytest.mark.parametrize("only_size", [None, (656, 368)])
@pytest.mark.parametrize("degrees", [0.0, 26.0, -90.0, 180.0])
def test_a_dot_of_the_input_is_where_it_is_in_the_picture(degrees, only_size):
    """Through a region of the picture, as letterboxed pictures have it; in both directions."""
    region = (29.5, 19.5, 1229.5, 819.5)
    view = UprightView.of(region, degrees, 656, 16, only_size)
    assert only_size is None or view.size == only_size
    for x, y in ((60, 40), (700, 444), (1200, 800)):
        picture = np.zeros((860, 1280, 3), dtype=np.uint8)
        cv2.circle(picture, (x, y), 12, (255, 255, 255), -1)
        shown = view.input_of(picture)
        assert shown.shape == (view.size[1], view.size[0], 3)
        weight = shown[..., 0].astype(float) * (
            shown[..., 0] > 60
        )  # the mean colour outside is dark
        rows, columns = np.indices(weight.shape)
        middle = np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()
        # Half a pixel of the input is a pixel of the picture.
        np.testing.assert_allclose(view.picture_from_input(middle), [x, y], atol=1.0)


def test_inside_is_the_region():
    view = UprightView.of((9.5, -0.5, 99.5, 49.5), 0.0, 128, 16)
    xy = np.array([[9.0, 10], [10, 10], [99, 49], [100, 10], [50, 50]])
    assert view.inside(xy).tolist() == [False, True, True, False, False]
