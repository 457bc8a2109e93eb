import cv2
import numpy as np
import pytest

from slam.geometry import se3
from slam.simulation.options import SimulationOptions, draw_variety
from slam.simulation.street import SimulatedStreet

SMALL = {"width": 208, "height": 64}


@pytest.fixture(scope="module")
def straight() -> SimulatedStreet:
    return SimulatedStreet(SimulationOptions("straight", 40, 700))


@pytest.fixture(scope="module")
def traffic() -> SimulatedStreet:
    return SimulatedStreet(
        SimulationOptions("straight", 60, 701, hazards=("moving-cars",), **SMALL)
    )


def path_of(street: SimulatedStreet) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions on the ground ``(N, 2)``, distance travelled and heading in radians ``(N,)``."""
    ground = street.T_world_camera[:, [0, 2], 3]
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ground, axis=0), axis=1))])
    forward = street.T_world_camera[:, [0, 2], 2]
    return ground, travelled, np.unwrap(np.arctan2(forward[:, 0], forward[:, 1]))


def revisited(street: SimulatedStreet, within_m: float = 3.0) -> tuple[float, float]:
    """Metres driven again, in the same and in the opposite direction."""
    ground, travelled, heading = path_of(street)
    same = opposite = 0.0
    for k in range(1, len(ground)):
        past = travelled[:k] < travelled[k] - 40.0
        near = past & (np.linalg.norm(ground[:k] - ground[k], axis=1) < within_m)
        aligned = np.cos(heading[:k] - heading[k])[near]
        step = travelled[k] - travelled[k - 1]
        same += step * bool((aligned > 0.7).any())
        opposite += step * bool((aligned < -0.7).any())
    return same, opposite


def warp_error(street: SimulatedStreet, target: int, source: int) -> tuple[float, float]:
    """Median photometric error of the source warped to the target by ground truth, and without a warp."""
    a, b, depth = street.render(target), street.render(source), street.depth(target)
    height, width = depth.shape
    v, u = np.mgrid[0:height, 0:width]
    pixels = np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
    points = np.linalg.inv(street.K) @ pixels * depth.ravel()
    T_source_target = se3.invert(street.T_world_camera[source]) @ street.T_world_camera[target]
    moved = street.K @ (T_source_target[:3, :3] @ points + T_source_target[:3, 3:])
    with np.errstate(divide="ignore", invalid="ignore"):
        at = (moved[:2] / moved[2]).reshape(2, height, width).astype(np.float32)
    warped = cv2.remap(b, at[0], at[1], cv2.INTER_LINEAR)
    inside = (
        (at[0] >= 0) & (at[0] <= width - 1) & (at[1] >= 0) & (at[1] <= height - 1) & (depth > 0)
    )
    error = np.abs(warped.astype(float) - a).mean(axis=2)[inside]
    unmoved = np.abs(b.astype(float) - a).mean(axis=2)[inside]
    return float(np.median(error)), float(np.median(unmoved))


@pytest.mark.parametrize("route", ["loop", "grid", "straight"])
def test_poses_start_at_the_world_and_keep_clear_of_everything_above_the_road(route: str):
    street = SimulatedStreet(SimulationOptions(route, 300, 702, 208, 64))
    assert len(street) == 300 and street.T_world_camera.shape == (300, 4, 4)
    assert np.array_equal(street.T_world_camera[0], np.eye(4))
    assert se3.is_se3(street.T_world_camera, 1e-9)
    step = np.linalg.norm(np.diff(street.T_world_camera[:, :3, 3], axis=0), axis=1)
    assert step.min() > 0.45 and step.max() < 1.5 and 0.6 < step.mean() < 1.2
    turn = se3.rotation_angle(
        se3.invert(street.T_world_camera[:-1])[:, :3, :3] @ street.T_world_camera[1:, :3, :3]
    )
    assert np.rad2deg(turn.max()) < 7.0
    assert street.T_world_camera[5, 2, 3] > 2.0  # forward is z
    assert 1.5 <= street.camera_height_m <= 1.8
    positions = street.T_world_camera[::2, :3, 3]
    assert street.distance_to_surface(positions).min() > 0.25
    below = positions + street.camera_height_m * street.T_world_camera[::2, :3, 1]
    assert np.median(street.distance_to_surface(below)) < 0.04


@pytest.mark.parametrize(("frames", "seed"), [(250, 703), (300, 704), (800, 704)])
def test_loop_revisits_its_start_and_turns_left_and_right(frames: int, seed: int):
    street = SimulatedStreet(SimulationOptions("loop", frames, seed))
    assert revisited(street)[0] >= 60.0
    ground, travelled, heading = path_of(street)
    turn = heading[20:] - heading[:-20]
    assert turn.max() > 0.8 and turn.min() < -0.8
    assert np.linalg.norm(ground - ground[0], axis=1)[travelled > 60].min() < 1.0


def test_grid_is_revisited_in_both_directions():
    again = np.array(
        [revisited(SimulatedStreet(SimulationOptions("grid", 800, s)), 5.5) for s in (705, 706)]
    )
    assert (again[:, 0] > 20.0).all() and (again[:, 1] > 20.0).all()


def test_truth_explains_the_next_image(straight: SimulatedStreet):
    for k in (3, 20):
        error, unmoved = warp_error(straight, k, k + 1)
        assert error < 5.0 and error < 0.6 * unmoved


def test_depth_is_the_distance_to_the_surface(straight: SimulatedStreet):
    depth = straight.depth(7)
    assert depth.dtype == np.float32 and depth.max() <= 200.0
    assert 0.02 < (depth == 0).mean() < 0.6  # the sky
    v, u = np.nonzero(depth)
    rays = np.linalg.inv(straight.K) @ np.stack([u, v, np.ones_like(u)])
    points = se3.apply(straight.T_world_camera[7], (rays * depth[v, u]).T)[::37]
    assert np.quantile(straight.distance_to_surface(points), 0.99) < 1e-3


def test_same_options_give_the_same_bytes_and_other_seeds_another_world(straight: SimulatedStreet):
    again = SimulatedStreet(straight.options)
    assert np.array_equal(again.T_world_camera, straight.T_world_camera)
    assert np.array_equal(again.render(9), straight.render(9))
    assert np.array_equal(again.depth(9), straight.depth(9))
    assert np.array_equal(again.scan(9), straight.scan(9))
    other = SimulatedStreet(SimulationOptions("straight", 40, 709))
    assert np.abs(other.render(9).astype(float) - straight.render(9)).mean() > 10


def test_moving_cars_are_seen_and_have_depth(traffic: SimulatedStreet):
    empty = SimulatedStreet(SimulationOptions("straight", 60, 701, **SMALL))
    for k in (5, 25):
        with_cars, without = traffic.depth(k), empty.depth(k)
        changed = (with_cars != without) & (with_cars > 0)
        assert changed.mean() > 0.002
        background = np.where(without > 0, without, np.inf)
        assert (with_cars[changed] < background[changed]).all()
    assert np.array_equal(traffic.T_world_camera, empty.T_world_camera)


def test_scans_lie_on_surfaces_and_spin_freely(straight: SimulatedStreet):
    scan, following = straight.scan(4), straight.scan(5)
    assert scan.dtype == np.float32 and scan.shape[1] == 4 and 20_000 < len(scan) < 60_000
    assert scan[:, 3].min() >= 0.0 and scan[:, 3].max() <= 1.0
    T_world_lidar = straight.T_world_camera[4] @ straight.T_camera_lidar
    points_world = se3.apply(T_world_lidar, scan[::23, :3].astype(np.float64))
    assert np.quantile(straight.distance_to_surface(points_world), 0.99) < 0.1
    assert abs(np.median(scan[scan[:, 2] < -1.0, 2]) + straight.camera_height_m + 0.08) < 0.15
    spacing = 2 * np.pi / 850
    phases = [
        np.angle(np.exp(2j * np.pi * np.arctan2(s[:, 1], s[:, 0]) / spacing).mean())
        for s in (scan, following)
    ]
    assert abs(np.exp(1j * phases[0]) - np.exp(1j * phases[1])) > 0.01


@pytest.mark.slow
def test_kiss_icp_follows_the_scans(straight: SimulatedStreet):
    config = pytest.importorskip("kiss_icp.config").load_config(None)
    odometry = pytest.importorskip("kiss_icp.kiss_icp").KissICP(config)
    for k in range(15):
        odometry.register_frame(straight.scan(k)[:, :3].astype(np.float64), np.array([]))
    truth = np.linalg.norm(straight.T_world_camera[14, :3, 3] - straight.T_world_camera[0, :3, 3])
    assert np.linalg.norm(odometry.last_pose[:3, 3]) == pytest.approx(truth, rel=0.03)


@pytest.mark.slow
def test_sunny_streets_saturate_a_little_and_have_slopes():
    shares, steepest = [], 0.0
    for seed in range(700, 706):
        street = SimulatedStreet(SimulationOptions("straight", 30, seed, 104, 32, varied=True))
        images = np.stack([street.render(index) for index in (0, 15, 29)])
        shares.append((images.max(axis=-1) >= 254).mean())
        steepest = max(steepest, np.abs(np.diff(street.T_world_camera[:, 1, 3])).max())
    assert 0.01 < np.mean(shares) < 0.15 and steepest > 0.03


def test_a_bonnet_is_a_surface_before_the_camera():
    seed = next(seed for seed in range(700, 760) if draw_variety(seed, True).bonnet > 0.1)
    street = SimulatedStreet(SimulationOptions("straight", 30, seed, 104, 32, varied=True))
    near, later = (street.depth(index)[-1, 40:64] for index in (3, 20))
    assert (near > 0.2).all() and (near < 2.1).all()
    np.testing.assert_allclose(near, later, rtol=1e-4)  # it does not move in the image
