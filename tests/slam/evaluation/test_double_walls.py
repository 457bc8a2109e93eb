import numpy as np
import pytest

from slam.evaluation.map import double_wall_share

SQUARE = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], float)
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])  # looks along z


@pytest.mark.parametrize(("distance", "share"), [(0.1, 0.0), (1.0, 0.5), (1.9, 0.5), (2.5, 0.0)])
def test_the_surface_behind_another_counts(distance: float, share: float):
    vertices = np.concatenate([SQUARE, SQUARE + np.array([0, 0, distance])])
    assert double_wall_share([(vertices, np.concatenate([TRIANGLES, TRIANGLES + 4]))]) == pytest.approx(share)


def test_the_two_sides_of_a_body_are_not_a_double_wall():
    vertices = np.concatenate([SQUARE, SQUARE - np.array([0, 0, 1.0])])
    back = TRIANGLES[:, ::-1] + 4
    assert double_wall_share([(vertices, np.concatenate([TRIANGLES, back]))]) == 0
    assert np.isnan(double_wall_share([]))
