"""Scale and place of a drive without a known camera height: by a known distance, and by GPS with noise and outliers."""

from __future__ import annotations

import numpy as np
import pytest
from oracle import OracleNoise, OraclePredictor

from slam.config.sections import load_config
from slam.frames import GpsTrack, Image, Intrinsics
from slam.frontend.gps import LocalFrame, Location
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.pipeline.estimate import Estimate
from slam.pipeline.run import SlamPipeline
from slam.runtime.errors import ConfigError, Failed, SlamError
from slam.sequences.recording import RecordedSequence

FRAMES = 200
CAMERA = Intrinsics(width=104, height=32, fx=60.0, fy=60.0, cx=51.5, cy=12.0)
PLACE = np.array([49.0110, 8.4160, 115.0])
SETTINGS = [
    "visual_odometry.enabled=false",
    "mapping.enabled=false",
    "gaps.enabled=false",
    "loops.enabled=false",
]
SETTINGS += ["keyframes.use=never"]
# the first camera looks east: its x axis points south, its y axis down
T_ENU_WORLD = se3.make(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([5.0, -3.0, 1.0])
)


class Grey:
    width, height = 104, 32

    def __len__(self) -> int:
        return FRAMES

    def read(self, index: int) -> Image:
        return np.full((32, 104, 3), 90, np.uint8)


def path() -> FloatArray:
    k = np.arange(FRAMES - 1)
    yaw = 0.03 * np.sin(k / 19.0)
    return se3.chain(
        se3.from_rotation_vector(
            np.stack([0 * yaw, yaw, 0 * yaw], 1), np.tile([0.0, 0.0, 1.0], (len(k), 1))
        )
    )


def drive() -> RecordedSequence:
    return RecordedSequence("drive", Grey(), CAMERA, 0.1 * np.arange(FRAMES), (), path())


def depth(index: int) -> FloatArray:
    rows = np.minimum(1.5 * CAMERA.fy / np.maximum(np.arange(32) - CAMERA.cy, 1e-3), 30.0)
    return np.repeat(rows[:, None], 104, axis=1)


def track(rng: np.random.Generator, sigma_m: float, outliers: int = 0) -> GpsTrack:
    """Fixes four times a second between the frames."""
    stamps = np.arange(0.03, 19.9, 0.25)
    positions = se3.apply(T_ENU_WORLD, path()[:, :3, 3])
    points = np.column_stack(
        [np.interp(stamps, 0.1 * np.arange(FRAMES), positions[:, axis]) for axis in range(3)]
    )
    points += rng.normal(scale=sigma_m, size=points.shape)
    points[rng.choice(len(points), outliers, replace=False)] += [60.0, 40.0, 0.0]
    return GpsTrack(stamps, LocalFrame(PLACE).places(points), np.ones(len(stamps)))


def run(gps: GpsTrack | None, *overrides: str, noise: OracleNoise | None = None) -> Estimate:
    oracle = OraclePredictor(path(), depth, noise or OracleNoise(), 0.2)
    return SlamPipeline(
        drive(), oracle, load_config(None, [*SETTINGS, *overrides]), gps_track=gps
    ).run()


def worst(result: Estimate) -> float:
    """Largest distance from the truth, without any alignment, metres."""
    return float(np.linalg.norm(result.optimised.positions - path()[:, :3, 3], axis=1).max())


def test_exact_fixes_give_scale_and_place() -> None:
    result = run(
        track(np.random.default_rng(0), 0.0), "gps.sigma_m=0.1", "gps.vertical_sigma_m=0.1"
    )
    assert result.scale.mode == "gps" and worst(result) < 0.1
    location = result.location
    assert isinstance(location, Location)
    places = location.fixes.frame.places(
        (location.T_enu_world @ result.optimised.T_world_camera)[:, :3, 3]
    )
    true = LocalFrame(PLACE).places(se3.apply(T_ENU_WORLD, path()[:, :3, 3]))
    assert (
        np.linalg.norm(
            LocalFrame(PLACE).points(places) - LocalFrame(PLACE).points(true), axis=1
        ).max()
        < 0.1
    )


@pytest.mark.parametrize("correlation_s", [0, pytest.param(10, marks=pytest.mark.slow)])
def test_gps_holds_a_drifting_odometry_despite_outliers(correlation_s: int) -> None:
    noise = OracleNoise(np.deg2rad(0.3), 0.05, seed=1)
    gps = track(np.random.default_rng(1), 0.5, outliers=8)
    settings = ("gps.sigma_m=0.5", "gps.vertical_sigma_m=0.5", f"gps.correlation_s={correlation_s}")
    beside, within = (
        run(gps, *settings, f"gps.factors={use}", noise=noise) for use in ("false", "true")
    )
    assert beside.scale.estimate == within.scale.estimate
    positions = [r.location.T_enu_world @ r.optimised.T_world_camera for r in (beside, within)]
    frame = within.location.fixes.frame.points(
        LocalFrame(PLACE).places(se3.apply(T_ENU_WORLD, path()[:, :3, 3]))
    )
    errors = [float(np.linalg.norm(T[:, :3, 3] - frame, axis=1).mean()) for T in positions]
    assert errors[1] < 0.45 and 2 * errors[1] < errors[0]


def test_a_track_that_does_not_fit_is_refused() -> None:
    gps = track(np.random.default_rng(0), 0.0)
    with pytest.raises(SlamError, match=r"0 GPS fixes .* set gps\.offset_s"):
        run(gps, "gps.offset_s=100")
    with pytest.raises(SlamError, match=r"choose scale\.mode=gps"):
        run(gps, "scale.mode=none")
    with pytest.raises(SlamError, match="give --gps FILE"):
        run(None, "scale.mode=gps")


@pytest.mark.parametrize("change", ["backwards", pytest.param("late", marks=pytest.mark.slow)])
def test_fixes_of_another_drive_are_left_out_or_refused(
    change: str, caplog: pytest.LogCaptureFixture
) -> None:
    gps = track(np.random.default_rng(0), 0.0)
    places = gps.places[::-1] if change == "backwards" else np.roll(gps.places, 30, axis=0)
    other = GpsTrack(gps.stamps, places, gps.dilution)
    settings = ("gps.sigma_m=0.2", "gps.vertical_sigma_m=0.2")
    result = run(other, *settings, "scale.mode=reference")
    found = next(each for each in result.agreements if each.source == "GPS")
    assert found.is_wrong and isinstance(result.location, Failed)
    assert caplog.text.count("GPS contradicts the images by") == 1
    with pytest.raises(SlamError, match="contradicts the images by"):
        run(other, *settings, "scale.mode=gps")


def test_a_camera_that_stands_is_not_located() -> None:
    gps = track(np.random.default_rng(0), 0.0)
    result = run(GpsTrack(gps.stamps, np.tile(PLACE, (len(gps.stamps), 1)), gps.dilution))
    assert isinstance(result.location, Failed) and "moves too little" in result.location.reason
    assert isinstance(result.scale.estimate, Failed)


def test_fixes_in_metres_are_no_factors_of_lengths_that_are_not(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Long enough for the heading, too short for the scale."""
    gps = track(np.random.default_rng(0), 0.0)
    result = run(gps, "gps.sigma_m=5", "gps.correlation_s=0")
    assert isinstance(result.location, Failed)
    assert "0 stretches of a tenth of the fixes span over 25.0 m" in result.location.reason
    assert caplog.text.count("the camera moves too little") == 1
    assert result.optimised.length_m == pytest.approx(result.odometry.length_m, rel=1e-6)


@pytest.mark.parametrize("ends", ["[20,80]", "[8.04s,20]"])
def test_a_known_distance_gives_metres(ends: str) -> None:
    apart = float(np.linalg.norm(path()[80, :3, 3] - path()[20, :3, 3]))
    result = run(None, "scale.mode=known", f"scale.known_m={apart}", f"scale.known_between={ends}")
    assert result.scale.mode == "known" and worst(result) < 0.05


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("[20,200]", "names 200, but the drive has frames 0 to 199"),
        ("[5,5]", "twice"),
        ("[30s,5]", "names 30s"),
    ],
)
def test_a_distance_between_frames_that_are_not_there(setting: str, said: str) -> None:
    with pytest.raises(SlamError, match=said):
        run(None, "scale.mode=known", "scale.known_m=3", f"scale.known_between={setting}")


def test_a_known_distance_needs_both_settings() -> None:
    for overrides in (
        ["scale.known_m=3"],
        ["scale.known_between=[1,2]"],
        ["scale.known_m=3", "scale.known_between=[a,2]"],
    ):
        with pytest.raises(ConfigError, match=r"known_m and known_between|stamps in seconds"):
            load_config(None, ["scale.mode=known", *overrides])
