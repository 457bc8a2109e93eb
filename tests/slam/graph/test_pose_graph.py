from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from slam.frames import RelativePose
from slam.geometry import se3
from slam.graph.pose_graph import LOOP_SOURCE, PoseGraph, whitened_squared
from slam.runtime.errors import SlamError

ROTATION, TRANSLATION = 0.003, 0.03


def circle(count: int, rounds: float = 2.0, radius: float = 30.0) -> np.ndarray:
    angle = np.linspace(0.0, 2 * np.pi * rounds, count)
    turn = se3.from_rotation_vector(
        np.stack([0 * angle, angle, 0 * angle], axis=1), np.zeros((count, 3))
    )
    turn[:, :3, 3] = radius * np.stack([-np.cos(angle), 0.02 * angle, np.sin(angle)], axis=1)
    return se3.invert(turn[0]) @ turn


def edge(T, i, j, rng=None, source="network", loosen=1.0) -> RelativePose:
    T_i_j = se3.invert(T[i]) @ T[j]
    sigmas = loosen * np.repeat([ROTATION, TRANSLATION], 3)
    if rng is not None:
        noise = sigmas * rng.normal(size=6)
        T_i_j = T_i_j @ se3.from_rotation_vector(noise[:3], noise[3:])
    return RelativePose(i, j, T_i_j, sigmas, source)


def noisy_problem(seed: int = 0, count: int = 200):
    rng = np.random.default_rng(seed)
    truth = circle(count)
    odometry = [edge(truth, k, k + 1, rng) for k in range(count - 1)]
    skips = [edge(truth, k, k + 2, rng, loosen=1.5) for k in range(count - 2)]
    half = count // 2
    loops = [edge(truth, k, k + half, rng, LOOP_SOURCE, 2.0) for k in range(0, half, 5)]
    initial = se3.chain(np.stack([e.T_from_to for e in odometry]))
    return truth, odometry, skips, loops, initial


def ate(estimate, truth) -> float:
    return float(np.sqrt(((estimate[:, :3, 3] - truth[:, :3, 3]) ** 2).sum(axis=1).mean()))


def solve(edges, initial):
    graph = PoseGraph()
    graph.add_relative(*edges)
    return graph, graph.optimise(initial)


def test_exact_factors_recover_the_chain_from_a_bent_start():
    truth = circle(40, rounds=0.8)
    exact = [edge(truth, k, k + 1) for k in range(39)] + [edge(truth, k + 2, k) for k in range(38)]
    bent = truth.copy()
    bent[1:, :3, 3] += np.random.default_rng(0).normal(scale=0.5, size=(39, 3))
    graph, solved = solve(exact, bent)
    np.testing.assert_allclose(solved, truth, atol=1e-5)
    assert whitened_squared(graph.relative_poses, solved).max() < 1e-6
    assert se3.is_se3(solved)


def test_loops_cut_the_drift():
    truth, odometry, skips, loops, initial = noisy_problem()
    _, without = solve(odometry + skips, initial)
    _, solved = solve(odometry + skips + loops, initial)
    assert ate(without, truth) < ate(initial, truth) * 1.05
    assert ate(solved, truth) < 0.5 * ate(initial, truth)
    np.testing.assert_array_equal(solved[0], initial[0])


def test_the_robust_kernel_survives_gross_outliers(monkeypatch):
    truth, odometry, skips, loops, initial = noisy_problem()
    rng = np.random.default_rng(1)
    false = []
    for k in range(6):
        wrong = se3.from_rotation_vector(rng.normal(size=3), 10 * rng.normal(size=3))
        false.append(RelativePose(10 * k, 190 - 10 * k, wrong, loops[0].sigmas, LOOP_SOURCE))
    edges = odometry + skips + loops + false
    graph, robust = solve(edges, initial)
    monkeypatch.setattr("slam.graph.pose_graph.HUBER_K", 1e9)
    _, plain = solve(edges, initial)
    assert ate(robust, truth) < ate(initial, truth)
    assert ate(robust, truth) < 0.2 * ate(plain, truth)
    errors = whitened_squared(graph.relative_poses, robust)
    assert errors[-len(false) :].min() > 1000 > np.quantile(errors[: -len(false)], 0.95)


def test_world_stays_at_the_first_pose():
    truth = circle(20)
    moved = se3.from_rotation_vector(np.array([0.3, -0.2, 0.1]), np.array([5.0, 6.0, 7.0])) @ truth
    _, solved = solve([edge(truth, k, k + 1) for k in range(19)], moved)
    np.testing.assert_allclose(solved, moved, atol=1e-5)


def test_correlated_sigmas_weigh_a_chain_against_a_loop_and_leave_sigmas_as_they_are():
    """The graph weighs by ``correlated_sigmas``; single residuals are whitened by ``sigmas``."""
    truth, odometry, _, loops, initial = noisy_problem()
    chained = [replace(each, correlated_sigmas=4.0 * each.sigmas) for each in odometry]
    looser = [replace(each, sigmas=4.0 * each.sigmas) for each in odometry]
    _, solved = solve(chained + loops, initial)
    _, solved_looser = solve(looser + loops, initial)
    _, stiff = solve(odometry + loops, initial)
    np.testing.assert_array_equal(solved, solved_looser)
    assert np.abs(solved - stiff).max() > 1e-3
    of_chained = whitened_squared(chained, truth)
    np.testing.assert_array_equal(of_chained, whitened_squared(odometry, truth))


def test_wrong_input_is_refused_with_its_name(tmp_path: Path):
    truth = circle(5)
    good = edge(truth, 0, 1)
    graph = PoseGraph()
    with pytest.raises(SlamError, match="not been optimised"):
        graph.write_g2o(tmp_path / "graph.g2o")
    with pytest.raises(SlamError, match="not been optimised"):
        graph.marginal(0)
    undefined = good.T_from_to.copy()
    undefined[0, 0] = np.nan
    rigid, sigmas = "is not a finite rigid transform", "needs six positive sigmas; got"
    wrong = [
        ("must link two different frames", replace(good, to_index=0)),
        (rigid, replace(good, T_from_to=undefined)),
        (rigid, replace(good, T_from_to=2.0 * np.eye(4))),
        (sigmas, replace(good, sigmas=np.zeros(6))),
        (sigmas, replace(good, sigmas=np.ones(3))),
        (sigmas, replace(good, correlated_sigmas=np.full(6, np.inf))),
    ]
    for said, factor in wrong:
        name = rf"^factor 0 -> {factor.to_index} \(network\) {said}"
        with pytest.raises(SlamError, match=name):
            graph.add_relative(good, factor)
    with pytest.raises(SlamError, match="factor -1 -> 1"):
        graph.add_relative(replace(good, from_index=-1))
    assert graph.relative_poses == []
    graph.add_relative(good, edge(truth, 1, 2), edge(truth, 3, 4))
    with pytest.raises(SlamError, match=r"^2 of 5 frames are not connected.*frame 3"):
        graph.optimise(truth)
    with pytest.raises(SlamError, match=r"frame 4.*3 frames"):
        graph.optimise(truth[:3])
    graph.add_relative(edge(truth, 2, 3))
    with pytest.raises(SlamError, match="initial trajectory"):
        graph.optimise(2.0 * truth)
    graph.optimise(truth)
    with pytest.raises(SlamError, match=r"no frame 5 .* 0 to 4"):
        graph.marginal(5)


def test_drift_of_a_straight_chain_by_hand():
    """The variance of the k-th of eight positions is 3 k 0.1^2, over a path of 8."""
    sigmas = np.repeat([1e-6, 0.1], 3)
    step = se3.from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    graph = PoseGraph()
    graph.add_relative(*(RelativePose(k, k + 1, step, sigmas, "network") for k in range(8)))
    graph.optimise(se3.chain(np.tile(step, (8, 1, 1))))
    assert graph.drift() == pytest.approx(np.sqrt(0.03 * 4.5) / 8, rel=1e-3)


def test_whitened_residual_by_hand():
    sigmas = np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
    measured = RelativePose(0, 1, np.eye(4), sigmas, "network")
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, :3, 3] = [1.0, 2.0, 6.0]
    assert whitened_squared([measured], T)[0] == pytest.approx(1 + 1 + 4)
    T[1] = se3.from_rotation_vector(np.array([0.0, 0.2, 0.0]), np.zeros(3))
    assert whitened_squared([measured], T)[0] == pytest.approx(1)


def test_g2o_round_trip_through_gtsam(tmp_path):
    _, odometry, _, loops, initial = noisy_problem(count=50)
    sigmas = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    edges = [
        RelativePose(e.from_index, e.to_index, e.T_from_to, sigmas, e.source)
        for e in odometry + loops
    ]
    graph, solved = solve(edges, initial)
    path = tmp_path / "graph.g2o"
    graph.write_g2o(path)
    read, values = gtsam.readG2o(str(path), True)
    assert values.size() == 50
    for k in range(50):
        np.testing.assert_allclose(values.atPose3(k).matrix(), solved[k], atol=1e-12)
    between = [
        read.at(k) for k in range(read.size()) if isinstance(read.at(k), gtsam.BetweenFactorPose3)
    ]
    assert len(between) == len(edges)
    for factor, e in zip(between, edges, strict=True):
        assert factor.keys() == [e.from_index, e.to_index]
        np.testing.assert_allclose(factor.measured().matrix(), e.T_from_to, atol=1e-12)
        np.testing.assert_allclose(factor.noiseModel().sigmas(), sigmas, rtol=1e-9)
    assert list(tmp_path.iterdir()) == [path]


def test_a_system_that_cannot_be_solved_is_one_line(monkeypatch: pytest.MonkeyPatch):
    _, odometry, _, loops, initial = noisy_problem(count=40)

    def singular(*parts: Any) -> None:
        raise RuntimeError("\nIndeterminant linear system detected\nlong explanation")

    monkeypatch.setattr(gtsam, "LevenbergMarquardtOptimizer", singular)
    with pytest.raises(SlamError, match=r"^the pose graph cannot be solved: Ind.* detected$"):
        solve(odometry + loops, initial)


def test_a_loop_contradicted_by_the_rest_is_dropped():
    truth, odometry, skips, loops, initial = noisy_problem()
    wrong = (
        truth[0] @ truth[100] @ se3.from_rotation_vector(np.zeros(3), np.array([30.0, 0.0, 0.0]))
    )
    false = RelativePose(20, 120, wrong, loops[0].sigmas, LOOP_SOURCE)
    graph = PoseGraph()
    graph.add_relative(*odometry, *skips, *loops, false)
    graph.optimise(initial)
    assert graph.drop_contradicted() and graph.dropped == [false]
    graph.optimise(initial)
    assert not graph.drop_contradicted() and len(graph.relative_poses) == len(
        odometry + skips + loops
    )


def test_positions_far_from_all_others_are_dropped():
    truth, odometry, skips, _, initial = noisy_problem()
    rng = np.random.default_rng(3)
    frames = np.arange(0, len(truth), 4)
    places = truth[frames, :3, 3] + rng.normal(scale=0.05, size=(len(frames), 3))
    places[10:14] += [0.0, 0.0, 20.0]
    graph = PoseGraph()
    graph.add_relative(*odometry, *skips)
    graph.add_positions(frames, places, np.full((len(frames), 3), 0.05), np.eye(4))
    before = ate(graph.T_fixed_world @ graph.optimise(initial), truth)
    assert graph.drop_contradicted()
    after = ate(graph.T_fixed_world @ graph.optimise(initial), truth)
    assert after < 0.08 and 2 * after < before and not graph.drop_contradicted()
