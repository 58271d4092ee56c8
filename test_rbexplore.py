"""A test for every statement of the paper: the name carries the ledger's number (README), and says what must hold.

Observations are their own ground truth where that is possible, R is a stub where a statement is about logic, and slow
obvious versions stand beside the fast ones. `pytest -m mutants` breaks the code in many small ways; the tests must notice."""

import copy
import csv
import functools
import gc
import gzip
import io
import itertools
import json
import math
import multiprocessing
import os
import pathlib
import pickle
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict, fields, replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from torch import nn

import envs
import rbexplore
from envs import FRAMESKIP, LEVELS, InputError, Maze, Montezuma, PersistentEnv, PrinceOfPersia, make_env
from rbexplore import (
    CONFIGS,
    ICM,
    MAZE,
    METHODS,
    PPO,
    PPO_CONFIGS,
    RND,
    Config,
    ExactMaze,
    Graph,
    Moments,
    Pairs,
    RbExplore,
    RNDBonus,
    SimilarityModel,
    Trajectory,
    best,
    coarse,
    exact,
    gae,
    main,
    make_method,
    parser,
    runs_of,
    settings_of,
    walk,
)

HERE = pathlib.Path(__file__).parent
torch.set_num_threads(1)  # several threads on small networks wait for one another


# ------------------------------------------------------------ sections 4.1 and 4.2, the network of 6.1

NEAR = replace(MAZE, n=3, N=6)

# -- observations that are their own ground truth: a frame holds the number of its state


def frame(number: int) -> np.ndarray:
    return np.array([divmod(number, 256)], np.uint8)  # (1, 2)


def frames_of(numbers) -> np.ndarray:
    return np.stack([frame(n) for n in numbers])


def numbers(frames) -> list[int]:
    return [int(f[0, 0]) * 256 + int(f[0, 1]) for f in frames]


def tau(states: list[int], start: int | None = 0) -> Trajectory:
    """A trajectory through these states; the action that leads to state 7 is b"7 "."""
    return Trajectory(frames_of(states), [b"%d" % n for n in states], [b"", *(b"%d " % n for n in states[1:])],
                      [None] * (len(states) - 1), start)


class Stub:
    """R as a function of (numbers of the first states, number of the second); its embedding of a state is the number."""

    def __init__(self, R, read=lambda frames: np.array(numbers(frames))[:, None]):
        self.R, self.read, self.scored = R, read, 0

    def embed(self, frames):
        return torch.from_numpy(self.read(frames))  # (T, d)

    def score(self, first, second):
        self.scored += len(first)
        return self.R(first.squeeze(-1).numpy(), second.squeeze(-1).numpy())  # (K,)

    def probability(self, first, second):
        return torch.from_numpy(self.R(first.squeeze(-1).numpy(), second.squeeze(-1).numpy()))

    def fit(self, pairs, config, rng, tell):
        return None


def table(values: dict, default: float = 0.0):
    """R(a, b) = values[a, b]: asymmetric, unless both orders are given."""
    scores = np.full((100, 100), default)
    for pair, value in values.items():
        scores[pair] = value
    return lambda a, b: scores[a, b]


def tens(a, b):
    """R: states of the same ten are similar."""
    return (a // 10 == b // 10).astype(float)


def grow(walks: list[tuple[int, list[int]]], R=tens, theta: float = 0.5) -> tuple[Graph, Stub]:
    """G after these (start, states), from state 0."""
    graph, stub = Graph(frame(0), b"0", MAZE), Stub(R)
    graph.embed_centres(stub)
    for start, states in walks:
        graph.add_trajectory(tau(states, start), stub, theta)
        graph.check()
    return graph, stub


def centres(graph: Graph) -> dict[int, int]:
    return {v: numbers([cluster.frame])[0] for v, cluster in graph.clusters.items()}


def visits(graph: Graph) -> dict[int, int]:
    return {v: cluster.visits for v, cluster in graph.clusters.items()}


def algorithm(R=None, read=None, **changes) -> RbExplore:
    a = RbExplore(Maze, replace(MAZE, pretrain_steps=0, **changes))
    a.restart()
    a.row = {}
    if R:
        a.similarity = Stub(R, *[read] if read else [])
    return a


def tile_by_tile(first, second):
    """R for the maze: falls with the share of pixels that differ, below 0.5 where the agent stands on another tile."""
    return np.exp(-200 * (first != second).mean(1))


def explored(L: int) -> RbExplore:
    """Three iterations in the maze, a merge after the second, and an R that does not learn."""
    a = algorithm(tile_by_tile, lambda frames: frames.reshape(len(frames), -1), M=6, trajectory_steps=40, L=L, beta=-0.5,
                  additional_steps=100, merge_every=2, theta_merge=0.3)
    for _ in range(3):
        a.iterate()
        a.graph.check()
    return a


@pytest.fixture(scope="module")
def maze_run() -> RbExplore:
    return explored(L=20)


def labelled(pairs: Pairs) -> list[tuple[int, int, int]]:
    """(number of s_1, number of s_2, y) of each pair."""
    first, second = pairs.frames(np.arange(len(pairs.y)))
    return list(zip(numbers(first), numbers(second), pairs.y.tolist(), strict=True))


def pairs_of(T: int, config: Config = MAZE, draws: int = 300) -> list[tuple[int, int, int]]:
    """All pairs of many draws from a trajectory 0 ... T-1."""
    found, rng = [], np.random.default_rng(T)
    for _ in range(draws):
        pairs = Pairs()
        pairs.add_trajectory("exploration", frames_of(range(T)), config, rng)
        found += labelled(pairs) if len(pairs.y) else []
    return found


def agree(observed: Counter, anchors: dict[int, list[int]]) -> None:
    """Each anchor as often as any other, its partner uniform among those allowed, either one first: no other pair, none
    missing, frequencies within five standard deviations."""
    anchors, expected = {i: partners for i, partners in anchors.items() if partners}, Counter()
    for i, partners in anchors.items():
        for j in partners:
            expected[i, j] += 0.5 / len(anchors) / len(partners)
            expected[j, i] += 0.5 / len(anchors) / len(partners)
    total = observed.total()
    assert set(observed) == set(expected)
    for pair, p in expected.items():
        assert abs(observed[pair] - total * p) < 5 * math.sqrt(total * p * (1 - p)) + 1e-6, pair


def pictures(count: int, seed: int = 0, size: int = 32) -> np.ndarray:
    return np.random.default_rng(seed).integers(256, size=(count, size, size), dtype=np.uint8)


# -- 3.2 and 4.2 in the maze: states, snapshots, actions


def test_S3_2_03_the_stored_actions_lead_from_s_init_to_every_centre(maze_run):
    env = Maze()
    assert len(maze_run.graph.clusters) > 10
    for v, cluster in maze_run.graph.clusters.items():
        walked = [env.restore(maze_run.snap_init)] + [env.step(action)[0] for action in cluster.path.replay()]
        assert env.snapshot() == cluster.snapshot and np.array_equal(walked[-1], cluster.frame)
        assert np.array_equal(walked, cluster.path.states()), f"the full prefix of {v} is not what was walked"


def test_S3_2_03_actions_of_a_path_in_the_order_of_time():
    graph, _ = grow([(0, [0, 1, 10, 11, 20]), (2, [20, 12, 30])])
    assert graph.clusters[3].path.replay() == b"1 10 11 20 12 30 "


def test_S4_2_01_a_snapshot_restores_the_centre(maze_run):
    env = Maze()
    for cluster in maze_run.graph.clusters.values():
        assert np.array_equal(env.restore(cluster.snapshot), cluster.frame)


class Line(PersistentEnv):
    """State k is followed by state k + 1, whatever the action; actions are remembered."""

    observation_space, action_space = gymnasium.spaces.Box(0, 255, (1, 2), np.uint8), gymnasium.spaces.Discrete(7)

    def restore(self, snapshot):
        self.k, self.actions = int(snapshot), []
        return frame(self.k)

    def step(self, action):
        self.k += 1
        self.actions.append(action)
        return frame(self.k), 0.0, False, False, {}

    def snapshot(self):
        return b"%d" % self.k

    def unit(self):
        return (self.k,)


def test_S4_2_02_pi_explore_is_uniform_and_blind():
    env = Line()
    t = walk(env, b"5", [1, 2], 14_000, True)
    a = env.actions
    assert b"".join(t.actions) == bytes(a) and numbers(t.frames[:3]) == [5, 6, 7] and t.snapshots[:2] == [b"5", b"6"]
    for observed, cells, limit in ((Counter(a), 7, 22.5), (Counter(zip(a, a[1:], strict=False)), 49, 85)):
        expected = observed.total() / cells  # limits: chi-square of 6 and 48 degrees of freedom at 0.001
        assert sum((count - expected) ** 2 / expected for count in observed.values()) < limit and len(observed) == cells
    assert walk(env, b"900", [1, 2], 14_000, True).actions == t.actions, "they must not depend on the state"
    assert walk(env, b"5", [1, 3], 14_000, True).actions != t.actions


# -- 4.1: pairs


def test_S4_1_02_pairs_of_a_trajectory_stay_within_it():
    rng, parts = np.random.default_rng(0), [Pairs(), Pairs()]
    for k in range(12):
        states = range(1000 * k, 1000 * k + 40)
        parts[k % 2].add_trajectory(("exploration", "additional")[k % 3 == 0], frames_of(states), MAZE, rng)
    for pairs in (*parts, Pairs.joined(parts)):
        found = labelled(pairs)
        assert all(a // 1000 == b // 1000 and (y == 1) == (abs(a - b) < 5) for a, b, y in found)
    assert {a // 1000 for a, *_ in found} == set(range(12)) and len(found) == sum(map(len, (p.y for p in parts)))
    assert parts[0].counts["exploration positive"] == 160 and parts[0].counts["additional positive"] == 80


def test_S4_1_03_04_and_05_similar_below_n_dissimilar_above_N_and_no_label_between():
    assert (MAZE.n, MAZE.N) == (5, 25)
    distances = [{abs(a - b) for a, b, label in pairs_of(60) if label == y} for y in (0, 1)]
    assert distances == [set(range(26, 60)), set(range(5))]
    assert all(y == 1 for *_, y in pairs_of(26))
    assert {(min(a, b), max(a, b)) for a, b, y in pairs_of(27) if y == 0} == {(0, 26)}


def test_S4_1_06_indices_are_positions_in_the_trajectory():
    for T in (1, 2, 4, 5, 6, 30):
        found = pairs_of(T, draws=100)
        assert {a for a, *_ in found} == set(range(T)) and all(abs(a - b) < 5 for a, b, y in found if y == 1)
    pairs = Pairs()
    pairs.add_trajectory("exploration", frames_of(range(30)), MAZE, np.random.default_rng(0))
    assert pairs.index.min() >= 0 and pairs.index.max() == 29


@pytest.mark.parametrize("T", [4, 12])
def test_S4_1_06_pairs_against_an_enumeration(T):
    found = pairs_of(T, NEAR, draws=2000)
    for y, allowed in ((1, lambda i, j: abs(i - j) < 3), (0, lambda i, j: abs(i - j) > 6)):
        agree(Counter((a, b) for a, b, label in found if label == y),
              {i: [j for j in range(T) if allowed(i, j)] for i in range(T)})


def test_S4_1_07_classes_are_balanced():
    pairs = Pairs(y=np.array([1] * 30 + [0] * 12))
    for most, each in ((None, 12), (5, 5), (99, 12)):
        chosen = pairs.balanced(np.random.default_rng(0), most)
        assert len(set(chosen.tolist())) == 2 * each and pairs.y[chosen].sum() == each
        assert 0 < pairs.y[chosen][:each].sum() < each, "in random order"


def test_rates_are_of_balanced_classes_and_each_of_its_own(monkeypatch):
    model, y = SimilarityModel(MAZE, (32, 32)), np.array([1] * 30 + [0] * 12)
    pairs = Pairs(list(pictures(42)), np.stack([np.arange(42)] * 2, 1), y)
    rates = functools.partial(rbexplore.rates, model, pairs)
    monkeypatch.setattr(model, "probability", lambda first, second: torch.ones(len(first)))
    assert rates(np.random.default_rng(0)) == {"r_accuracy": 0.5, "r_true_positive": 1, "r_true_negative": 0}
    monkeypatch.setattr(model, "probability", lambda first, second: torch.zeros(len(first)))  # of equal frames: no R29 in rates
    assert rates(np.random.default_rng(0)) == {"r_accuracy": 0.5, "r_true_positive": 0, "r_true_negative": 1}


def test_R19_R_trains_epochs_passes_each_in_an_order_of_its_own(monkeypatch):
    model, batches = SimilarityModel(MAZE, (32, 32)), []
    pairs = Pairs(list(pictures(42)), np.stack([np.arange(42)] * 2, 1), np.array([1] * 30 + [0] * 12))
    monkeypatch.setattr(model, "update", lambda first, second, y, clip: batches.append(first.tobytes()) or float(len(batches)))
    loss = model.fit(pairs, replace(MAZE, epochs=3, r_batch=10), np.random.default_rng(0), lambda *_, **__: None)
    assert len(batches) == 3 * 3 and max(map(len, batches)) <= 10 * 1024 and loss == 8  # the mean of 7, 8 and 9
    assert len({b"".join(batches[k : k + 3]) for k in (0, 3, 6)}) == 3


@pytest.mark.parametrize("anneal", [True, False])
def test_R18_annealed_the_rate_of_R_falls_linearly_from_one_iteration_to_the_next(monkeypatch, anneal):
    model, rates = SimilarityModel(MAZE, (32, 32)), []
    pairs = Pairs(list(pictures(40)), np.stack([np.arange(40)] * 2, 1), np.arange(40) % 2)
    monkeypatch.setattr(model, "update", lambda *_: rates.append(model.optimiser.param_groups[0]["lr"]) or 0.0)
    for _ in range(2):  # iterations, of 2 passes over 4 batches
        model.fit(pairs, replace(MAZE, r_anneal=anneal, r_learning_rate=0.8, epochs=2, r_batch=10), np.random.default_rng(0),
                  lambda *_, **__: None)
    assert rates == pytest.approx([0.8 - 0.1 * k * anneal for k in range(8)] * 2)
    assert rbexplore.MAZE.r_anneal and not Config().r_anneal  # the authors' rate is constant


def test_R18_the_norm_of_Rs_gradient_is_clipped_and_each_network_has_its_rate():
    config = replace(MAZE, r_learning_rate=0.5, rnd_learning_rate=0.25)
    model, rnd, x = SimilarityModel(config, (32, 32)), RND(config, (32, 32)), pictures(16)
    model.train().update(x[:8], x[8:], np.arange(8) % 2, 1e-3)
    assert 0 < math.sqrt(sum(w.grad.square().sum().item() for w in model.parameters())) < 1.001e-3
    assert model.optimiser.param_groups[0]["lr"] == 0.5 and rnd.optimiser.param_groups[0]["lr"] == 0.25


def test_R20_batch_normalisation_and_relu_before_each_layer_of_the_head():
    head = SimilarityModel(MAZE, (32, 32)).head
    assert [type(layer) for layer in head] == [nn.BatchNorm1d, nn.ReLU, nn.Linear] * 4


def test_a_residual_block_and_the_sizes_within_resnet18():
    block, x = rbexplore.BasicBlock(4, 8, 2).eval(), torch.randn(2, 4, 6, 6, generator=torch.Generator().manual_seed(0))
    y = block(x)
    assert torch.allclose(y, (block.residual(x) + block.shortcut(x)).clamp(min=0)) and 0 < (y == 0).float().mean() < 1
    features = rbexplore.resnet18(1, 512).eval()[:-2](torch.zeros(1, 1, 96, 96))
    assert features.shape == (1, 512, 3, 3)


def test_R4_pixels_are_clipped_and_the_errors_of_all_states_counted_as_they_are_after_training(monkeypatch):
    rnd, sizes = RND(replace(MAZE, rnd_batch=4), (32, 32)), []
    rnd.pixels.join(Moments(100 + pictures(50) % 10))
    far = np.stack([np.full((32, 32), shade, np.uint8) for shade in (200, 255)])
    one, other = rnd.distance(far).tolist()
    assert one == other  # both are more than five standard deviations away
    update = rnd.update
    monkeypatch.setattr(rnd, "update", lambda frames: sizes.append(len(frames)) or update(frames))
    states = pictures(7), pictures(3, 1)
    loss = rnd.fit(list(states), np.random.default_rng(0), lambda *_, **__: None)
    assert rnd.errors[-1].count == sum(sizes) == 10 and max(sizes) <= 4
    after = Moments(rnd.distance(np.concatenate(states)).detach().numpy())
    assert np.allclose([rnd.errors[-1].mean, rnd.errors[-1].m2], [after.mean, after.m2], rtol=1e-4)
    assert loss != pytest.approx(after.mean), "the loss is that of training"


def test_R29_embeddings_of_equal_frames_are_not_rounded_to_tf32(monkeypatch):
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", True)
    rbexplore.prepare(settings())
    assert not torch.backends.cudnn.allow_tf32


@pytest.mark.parametrize("scale", [0.01, 1, 100])
def test_R29_a_state_is_similar_to_itself_whatever_the_network_says(scale):
    model, frames = SimilarityModel(MAZE, (32, 32)), pictures(40)
    model.encoder[-1].weight.data *= scale
    model.head[-1].weight.data /= scale
    nn_says = torch.sigmoid(model(frames, frames)).detach().numpy()
    assert (nn_says < 0.99).all()
    for size in (1, 3, 40):  # the rounding of an embedding depends on the batch that it is in
        e = torch.cat([model.embed(frames[k : k + size]) for k in range(0, 40, size)])
        assert (model.score(e, model.embed(frames)) == 1).all()
        assert (model.score(e, model.embed(frames[7:8])[0]) == 1).tolist() == [k == 7 for k in range(40)]
    close = e[:2].clone()
    close[0, 3] += 1e-3 * scale
    close[1, :3] += 1e-3 * scale
    assert (model.score(close, e[:2]) < 1).all(), "one number that differs is enough"


def test_S4_1_07_R_learns_that_1_means_close():
    """A bar moves to the right, a pixel a step."""
    bars = np.zeros((32, 32, 32), np.uint8)
    for t, picture in enumerate(bars):
        picture[:, t : t + 3] = 255
    config, rng = replace(MAZE, n=3, N=12, epochs=10), np.random.default_rng(0)
    model, pairs = SimilarityModel(config, (32, 32)), Pairs()
    for _ in range(20):
        pairs.add_trajectory("exploration", bars, config, rng)
    model.fit(pairs, config, rng, lambda *_, **__: None)
    e = model.embed(bars)
    near, far = model.score(e[:-2], e[2:]), model.score(e[:-13], e[13:])
    assert near.mean() > 0.8 and far.mean() < 0.2
    rates = rbexplore.rates(model, pairs, rng)
    assert min(rates.values()) > 0.8 and rates["r_accuracy"] == (rates["r_true_positive"] + rates["r_true_negative"]) / 2


def test_S4_1_08_the_loss_is_binary_cross_entropy():
    model, first, second = SimilarityModel(MAZE, (32, 32)), pictures(16), pictures(16, seed=1)
    y = np.array([1, 0, 0, 1] * 4)
    R = model.score(model.embed(first), model.embed(second)).astype(float)
    by_hand = np.mean(-y * np.log(R) - (1 - y) * np.log(1 - R))
    assert model.update(first, second, y, clip=1.0) == pytest.approx(by_hand, rel=1e-5)
    for _ in range(10):
        last = model.update(first, second, y, clip=1.0)
    assert last < by_hand


def prefix_pairs(start: int, **changes) -> tuple[Pairs, Counter]:
    """Step 2 for a trajectory of states 1000, ... from cluster 0 (state 0) or 1 (state 30, which 0 ... 30 lead to)."""
    a = algorithm(**changes)
    a.graph, _ = grow([(0, list(range(31)))], lambda first, second: 1.0 * (first // 30 == second // 30))
    assert centres(a.graph) == {0: 0, 1: 30}
    pairs = a.make_pairs([tau([*range(1000, 1040)], start)])
    return pairs, Counter((min(a, b) < 1000, y) for a, b, y in labelled(pairs))


def test_S4_1_09_the_prefix_of_an_additional_trajectory_ends_with_the_novel_state_it_starts_from(monkeypatch):
    """0 ... 30 lead to cluster 1. From it one trajectory meets the novel state 1003, another 1502; one from cluster 0, 1701."""
    a, given = algorithm(), []
    a.graph, _ = grow([(0, list(range(31)))], lambda first, second: 1.0 * (first // 30 == second // 30))
    a.novelty.reward = lambda frames: np.array([9.0 * (n in (1003, 1502, 1701)) for n in numbers(frames)])
    a.collect = lambda purpose, snapshots, steps: [tau([int(s), *range(2000, 2040)], None) for s in snapshots]
    monkeypatch.setattr(Pairs, "add_prefix", lambda self, source, frames, prefix, *_:
                        given.append((source, numbers(frames)[0], numbers(prefix))))
    a.make_pairs([tau([30, *range(1001, 1011)], 1), tau([30, *range(1501, 1511)], 1), tau([0, *range(1701, 1711)], 0)])
    assert a.row["additional"] == 3 and given[:2] == [("exploration", 30, [*range(31)])] * 2
    assert sorted(given[2:]) == [("additional", 1003, [*range(31), 1001, 1002, 1003]),
                                 ("additional", 1502, [*range(31), 1501, 1502])]


def test_S4_1_09_prefix_negatives_unless_the_start_is_the_initial_cluster():
    counts, found = prefix_pairs(start=1)[0].counts, prefix_pairs(start=1)[1]
    assert found[True, 0] == 40 == counts["exploration prefix"] and not found[True, 1]
    counts, found = prefix_pairs(start=0)
    assert not found[True, 0] and not found[True, 1] and not counts.counts["exploration prefix"]
    assert found[False, 1] == 40 and not prefix_pairs(start=1, prefix=False)[1][True, 0]


# -- 4.1 and 6.1: the network


def test_S4_1_01_R_is_a_probability_of_the_pair_alone():
    model, first, second = SimilarityModel(MAZE, (32, 32)), pictures(40), pictures(40, seed=1)
    pairs, rng = Pairs(list(first), np.arange(40).reshape(20, 2), np.arange(20) % 2), np.random.default_rng(0)
    for fitted in (False, True):
        if fitted:
            model.fit(pairs, MAZE, rng, lambda *_, **__: None)
        R = model.score(model.embed(first), model.embed(second))
        assert R.shape == (40,) and R.min() >= 0 and R.max() <= 1 and np.ptp(R) > 0.01
        assert np.array_equal(R, model.score(model.embed(first), model.embed(second)))
        for some in (slice(3, 10), slice(0, 1)):
            assert np.allclose(R[some], model.score(model.embed(first[some]), model.embed(second[some])), atol=1e-5)
        one = model.embed(second[:1])[0]  # (d,): one second state for all first ones
        assert np.allclose(model.score(model.embed(first), one)[0], R[0], atol=1e-5)


@pytest.mark.parametrize("shape", [(32, 32), (32, 32, 3)])
def test_S6_1_02_the_network_sees_pixels_in_0_to_1(shape):
    model, seen = SimilarityModel(MAZE, shape), []
    model.encoder[0].register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    frames = np.zeros((2, *shape), np.uint8)
    frames[1], frames[0, 1, 2] = 255, 51
    model.embed(frames)
    model(frames[:1], frames[1:])
    for x in seen:
        assert x.shape == (2, *(shape[2:] or (1,)), 32, 32) and x.min() == 0 and x.max() == 1
        assert x[0, 0, 1, 2].item() == pytest.approx(0.2) and (x[1] == 1).all()
    assert len(seen) == 2


def test_S6_1_03_and_04_resnet18_and_four_fully_connected_layers():
    model = SimilarityModel(Config(), (96, 96))
    a, b = pictures(2, size=96), pictures(2, seed=1, size=96)
    convs = [m for m in model.modules() if isinstance(m, nn.Conv2d)]
    weighted = sum(m.kernel_size != (1, 1) for m in convs) + sum(isinstance(m, nn.Linear) for m in model.encoder.modules())
    assert weighted == 18 and convs[0].in_channels == 1, "18 weighted layers, a single frame"
    # The published size: 11,689,512 with 3 channels and 1,000 classes.
    published = 11_689_512 - 513_000 - 2 * 64 * 7 * 7 + 512 * 512 + 512
    assert sum(p.numel() for p in model.encoder.parameters()) == published
    assert model.embed(a).shape == (2, 512)
    linear = [m for m in model.head.modules() if isinstance(m, nn.Linear)]
    assert [m.in_features for m in linear] == [1024, 512, 512, 512] and linear[-1].out_features == 1
    assert set(convs) <= set(model.encoder.modules()), "one encoder, for both frames"
    R = model.score(model.embed(a), model.embed(b))
    assert np.allclose(R, torch.sigmoid(model(a, b)).detach().numpy(), atol=1e-5)
    assert not np.allclose(R, model.score(model.embed(b), model.embed(a)), atol=1e-5), "concatenated: the order matters"


def test_S6_1_03_resnet18_trains_in_less_memory_with_the_same_gradients():
    def run(network):
        kept = []  # bytes of activations: what has as many rows as the batch
        with torch.autograd.graph.saved_tensors_hooks(lambda x: (kept.append(x.nbytes * (len(x) == 2)), x)[1], lambda x: x):
            out = torch.cat([network(half) for half in halves]) if network is plain else network(torch.cat(halves))
        out.square().sum().backward()
        return sum(kept), [p.grad for p in network.parameters()]

    frugal = SimilarityModel(Config(), (96, 96)).encoder.train()
    plain = nn.Sequential(*copy.deepcopy(frugal)).train()
    halves = rbexplore.to_input(pictures(4, size=96), "cpu").chunk(2)
    (most, expected), (least, gradients) = run(plain), run(frugal)
    assert all(torch.allclose(a, b, rtol=1e-3, atol=1e-4) for a, b in zip(gradients, expected, strict=True))
    assert least < most / 2
    x = halves[0]
    assert torch.equal(frugal.eval()(x), nn.Sequential(*frugal)(x)), "nothing differs in evaluation"


# -- 4.2: assignment


def test_S4_2_03_a_member_is_above_theta_not_at_it():
    assert list(centres(grow([(0, [0, 1])], table({(0, 1): 0.5}))[0]).values()) == [0, 1]
    assert list(centres(grow([(0, [0, 1])], table({(0, 1): 0.5 + 1e-6}))[0]).values()) == [0]


def test_S4_2_03_membership_by_the_R_of_now():
    """Centres are embedded anew: an embedding of an R before says nothing."""
    a = algorithm()
    for now in (1000, 2000):
        a.similarity = Stub(tens, lambda frames, now=now: np.array(numbers(frames))[:, None] + now)
        if now == 1000:
            a.graph = Graph(frame(0), b"0", MAZE)
        a.row = {"theta_sim": 0.5}
        a.update_graph([tau([0, 10, 20])])
        assert list(centres(a.graph).values()) == [0, 10, 20]


def test_S4_2_04_the_centre_is_the_first_argument():
    assert len(grow([(0, [0, 1])], table({(0, 1): 0.9}))[0].clusters) == 1
    assert len(grow([(0, [0, 1])], table({(1, 0): 0.9}))[0].clusters) == 2
    for first, left in ((0, 1), (1, 2)):  # and merging gives R the earlier centre first
        graph, _ = grow([(0, [0, 1])], theta=1, R=table({}))
        graph.merge(Stub(table({(first, 1 - first): 0.9})), 0.5)
        assert len(graph.clusters) == left


def test_S4_2_05_a_similar_cluster_far_away_is_found():
    graph, stub = grow([(0, [0, 1, 2])], table({(2, 7): 0.9}))
    decisions = graph.add_trajectory(tau([0, 7]), stub, 0.5)
    assert decisions == {"clusters": [0, 2], "R": [None, 0.9], "made": []} and graph.arcs[0, 2] == 1


def test_S4_2_06_every_state_in_order_to_the_last():
    graph, stub = grow([])
    stub.R = table({(n, n + 1): 1 for n in range(99)})
    decisions = graph.add_trajectory(tau([0, 50, 51, 52]), stub, 0.5)
    assert decisions["clusters"] == [0, 1, 1, 2] and list(centres(graph).values()) == [0, 50, 52]
    assert decisions["made"] == [(1, 0), (2, 1)] and graph.clusters[2].snapshot == b"52"


def test_S4_2_07_and_08_arcs_are_directed_and_join_different_clusters():
    graph, _ = grow([(0, [0, 1, 10, 11, 20, 21, 10])])
    assert graph.arcs == {(0, 1): 1, (1, 2): 1, (2, 1): 1}


def test_S4_2_09_visits_are_the_states_assigned():
    graph, _ = grow([(0, [0, 1, 10, 11, 12, 3]), (1, [10, 20, 11]), (1, [10])])
    assert visits(graph) == {0: 1 + 3, 1: 3 + 2 + 1, 2: 1}


def test_S4_2_10_arc_visits_are_crossings():
    graph, _ = grow([(0, [0, 10, 1, 11, 2]), (0, [0, 10, 12]), (1, [10, 13, 3])])
    assert graph.arcs == {(0, 1): 3, (1, 0): 3}


def test_S4_2_11_the_graph_begins_with_s_init():
    a = algorithm()
    for graph in (Graph(frame(7), b"7", MAZE), a.graph):
        graph.check()
        assert list(graph.clusters) == [0] and not graph.arcs and graph.clusters[0].visits > 0
    assert np.array_equal(a.graph.clusters[0].frame, a.s_init) and a.graph.clusters[0].snapshot == a.snap_init


def test_S4_2_12_sampled_inversely_to_visits():
    a, asked = algorithm(M=20_000), []
    a.graph, _ = grow([(0, [0, 10, 20, 30])])
    a.collect = lambda purpose, snapshots, steps: asked.extend(snapshots) or []
    for v, count in enumerate((1, 9, 4, 2)):
        a.graph.clusters[v].visits = count
    p = np.array([1, 1 / 9, 1 / 4, 1 / 2]) / (1 + 1 / 9 + 1 / 4 + 1 / 2)
    ids, probabilities = a.graph.sampling_distribution()
    assert ids == [0, 1, 2, 3] and np.allclose(probabilities, p)
    a.explore()
    frequencies = [asked.count(snapshot) / 20_000 for snapshot in (b"0", b"10", b"20", b"30")]
    assert np.abs(frequencies - p).max() < 0.015


def test_S4_2_13_neighbours_first():
    graph, stub = grow([(0, [0, 1, 2, 3])], table({(1, 5): 0.6, (2, 5): 0.9, (1, 6): 0.6, (0, 6): 0.9, (3, 7): 0.6, (0, 7): 0.9}))
    for start, state, cluster, scored in ((0, 5, 1, 2), (2, 6, 1, 3), (3, 7, 3, 2)):  # a successor, a predecessor, itself
        before = stub.scored
        assert graph.add_trajectory(tau([start, state], start), stub, 0.5)["clusters"] == [start, cluster]
        assert stub.scored - before == scored, "a search among the neighbours alone"


def test_S4_2_13_the_most_similar_of_those_above_theta():
    graph, stub = grow([(0, [0, 1, 2, 3])], table({(0, 5): 0.6, (1, 5): 0.9, (2, 6): 0.6, (3, 6): 0.9}))
    assert graph.add_trajectory(tau([0, 5]), stub, 0.5)["clusters"] == [0, 1]  # of the adjacent ones
    assert graph.add_trajectory(tau([0, 6]), stub, 0.5)["clusters"] == [0, 3]  # of all


# -- 4.2: novelty


def test_S4_2_14_the_reward_falls_on_states_trained_on():
    rnd, noise = RND(MAZE, (32, 32)), np.random.default_rng(0)
    known, new = (pictures(1, seed=s) // 2 + noise.integers(32, size=(64, 32, 32), dtype=np.uint8) for s in (0, 1))
    assert not (rnd.reward(known) > -np.inf).any(), "nothing is novel to begin with"
    target = [p.clone() for p in rnd.target.parameters()]
    rnd.fit([known], noise, lambda *_, **__: None)
    first = rnd.distance(known).mean().item(), rnd.distance(new).mean().item()
    for _ in range(30):
        rnd.fit([known[:40], known[40:]], noise, lambda *_, **__: None)
    assert rnd.distance(known).mean().item() < 0.5 * first[0] and rnd.reward(new).min() > rnd.reward(known).max()
    assert all(torch.equal(*both) for both in zip(target, rnd.target.parameters(), strict=True)), "the target is fixed"
    before = [p.clone() for p in rnd.predictor.parameters()], rnd.pixels.count, len(rnd.errors), rnd.reward(new)
    assert np.array_equal(rnd.reward(new), before[3]) and (rnd.pixels.count, len(rnd.errors)) == before[1:3]
    assert all(torch.equal(*both) for both in zip(before[0], rnd.predictor.parameters(), strict=True))


def test_S4_2_14_the_reward_counts_standard_deviations_of_recent_errors():
    rnd, data = RND(replace(MAZE, novelty_window=2), (32, 32)), pictures(60)
    recent = []
    for k in range(3):
        rnd.distance = lambda frames, k=k: torch.tensor(frames[:, 0, 0] * (k + 1.0))
        rnd.update = lambda frames: rnd.distance(frames).numpy()
        rnd.fit([data[20 * k : 20 * k + 20]], np.random.default_rng(0), lambda *_, **__: None)
        recent.append(data[20 * k : 20 * k + 20, 0, 0] * (k + 1.0))
    errors = np.concatenate(recent[-2:])
    assert np.allclose(rnd.reward(data), (data[:, 0, 0] * 3.0 - errors.mean()) / errors.std())


def test_S4_2_14_moments_equal_numpy_over_all_data():
    rng, all_of_it, moments = np.random.default_rng(0), [], Moments()
    for size in (1, 7, 64, 1, 300):
        all_of_it.append(rng.integers(256, size=(size, 3, 4), dtype=np.uint8))
        moments.join(Moments(all_of_it[-1]))
        data = np.concatenate(all_of_it).astype(float)
        assert moments.count == len(data) and np.allclose(moments.mean, data.mean(0))
        assert np.allclose(moments.m2 / len(data), data.var(0))
    assert np.allclose(moments.standardise(data), (data - data.mean(0)) / data.std(0))


def with_rewards(rewards: dict[int, float], **changes) -> tuple[RbExplore, list[list[bytes]]]:
    """An algorithm whose RND rewards state k with rewards[k], and a record of the snapshots it walks on from."""
    a, walks = algorithm(**changes), []
    a.novelty.reward = lambda frames: np.array([rewards[n] for n in numbers(frames)])
    a.collect = lambda purpose, snapshots, steps: walks.append(snapshots) or []
    return a, walks


def test_R10_trim_leaves_the_last_states_of_a_trajectory_out_of_G():
    graph, stub = Graph(frame(0), b"0", replace(MAZE, trim=2)), Stub(tens)
    graph.embed_centres(stub)
    assert graph.add_trajectory(tau([0, 1, 10, 20, 30]), stub, 0.5)["clusters"] == [0, 0, 1]
    assert centres(graph) == {0: 0, 1: 10}


def test_max_clusters_bounds_G_and_a_refused_state_joins_the_most_similar_cluster():
    graph, stub = Graph(frame(0), b"0", replace(MAZE, max_clusters=3)), Stub(table({(10, 50): 0.4, (10, 51): 0.4}, 0.1))
    graph.embed_centres(stub)
    assert graph.add_trajectory(tau([0, 10, 20, 50, 51, 52]), stub, 0.5)["clusters"] == [0, 1, 2, 1, 1, 0]
    assert centres(graph) == {0: 0, 1: 10, 2: 20} and graph.refused == 3


def test_S4_2_15_and_16_all_states_above_beta_and_none_at_it_go_to_B():
    rewards = {0: 2.5, 1: 2.5 + 1e-9, 2: 2.4, 3: 9.0, 4: -9.0, 5: 3.0, 6: 2.5}
    a, walks = with_rewards(rewards, beta=2.5)
    a.additional_trajectories([tau([0, 1, 2]), tau([3, 4, 5, 6])])
    assert a.novel == [b"1", b"3", b"5"] and sorted(walks[0]) == a.novel
    assert a.row == {"novel_share": 3 / 7, "additional": 0}
    a.additional_trajectories([tau([3])])
    assert a.novel == [b"3"], "B holds the novel states of this iteration (R5)"


def test_S4_2_16_snapshots_of_B_restore_the_novel_states():
    a = algorithm(M=4, trajectory_steps=40, L=0)
    a.novelty.reward = lambda frames: np.arange(len(frames)) % 4.0  # every fourth state has 3
    taus = a.explore()
    a.additional_trajectories(taus)
    novel = np.concatenate([t.frames[3::4] for t in taus])
    assert np.array_equal([a.env.restore(snapshot) for snapshot in a.novel], novel)


def test_S4_2_17_a_random_sample_of_B():
    a, walks = with_rewards({n: 10 + n for n in range(20)}, L=5)
    for a.iteration in range(400):
        a.additional_trajectories([tau(list(range(20)))])
    assert all(len(set(sample)) == len(sample) == 5 for sample in walks), "without replacement"
    drawn = Counter(snapshot for sample in walks for snapshot in sample)
    assert len(drawn) == 20 and all(abs(count - 100) < 5 * math.sqrt(75) for count in drawn.values()), "not the top ones"
    a.additional_trajectories([tau([7, 8, 9])])
    assert sorted(walks[-1]) == [b"7", b"8", b"9"], "min(L, size of B)"


def test_S4_2_18_additional_trajectories_serve_R_alone(maze_run):
    a, b = maze_run, explored(L=0)
    assert a.row["additional"] == 20 and a.steps > a.exploration_steps and b.steps == b.exploration_steps
    assert a.exploration_steps == b.exploration_steps and set(a.discovered) == set(b.discovered) and a.novel == b.novel != []
    assert visits(a.graph) == visits(b.graph) and a.graph.arcs == b.graph.arcs
    for v, w in zip(a.graph.clusters.values(), b.graph.clusters.values(), strict=True):
        assert (v.snapshot, v.parent, v.path.replay()) == (w.snapshot, w.parent, w.path.replay())
    for p, q in zip(a.novelty.predictor.parameters(), b.novelty.predictor.parameters(), strict=True):
        assert torch.equal(p, q)
    for x, y in zip((a.novelty.pixels, *a.novelty.errors), (b.novelty.pixels, *b.novelty.errors), strict=True):
        assert x.count == y.count and np.array_equal(x.mean, y.mean) and np.array_equal(x.m2, y.m2)


# -- 4.2: prefixes


def test_S4_2_19_every_cluster_leads_to_the_first_by_its_parents(maze_run):
    graph, _ = grow([(0, [0, 10, 20, 3, 30]), (1, [10, 40])])
    assert [v.parent for v in graph.clusters.values()] == [None, 0, 1, 2, 1]  # R13: the one made last, else the start
    for v in maze_run.graph.clusters:
        for _ in maze_run.graph.clusters:
            v = maze_run.graph.clusters[v].parent or 0
        assert v == 0


def test_S4_2_20_and_21_a_prefix_is_what_was_walked_from_the_parent_and_in_full_from_s_init():
    graph, stub = grow([(0, [0, 1, 2, 10, 11, 3, 20]), (1, [10, 12, 4, 30, 31])])
    assert [numbers(v.path.frames) for v in graph.clusters.values()] == [[0], [1, 2, 10], [11, 3, 20], [12, 4, 30]]
    full = [[0], [0, 1, 2, 10], [0, 1, 2, 10, 11, 3, 20], [0, 1, 2, 10, 12, 4, 30]]
    assert [numbers(v.path.states()) for v in graph.clusters.values()] == full
    stub.R = table({(0, 10): 1.0})  # the parent of two merges into another
    graph.merge(stub, 0.5)
    assert [numbers(v.path.states()) for v in graph.clusters.values()] == [full[0], *full[2:]]


@pytest.mark.parametrize("P", [1, 4, 7, 8, 20])
def test_S4_2_22_and_23_the_state_of_the_prefix_is_any_more_than_N_away(P):
    T, rng, found = 12, np.random.default_rng(P), Counter()
    for _ in range(1500):
        pairs = Pairs()
        pairs.add_trajectory("exploration", frames_of(range(1000, 1000 + T)), NEAR, rng)
        before = len(pairs.y)
        pairs.add_prefix("additional", frames_of(range(1000, 1000 + T)), list(frames_of(range(P))), NEAR, rng)
        new = labelled(pairs)[before:]
        assert all(y == 0 for *_, y in new) and len(new) == pairs.counts["additional prefix"]
        found.update((a, b) for a, b, _ in new)
    # Along the joined path state j of the prefix is the j-th, and state i of the trajectory is number P - 1 + i.
    agree(found, {1000 + i: [j for j in range(P) if (P - 1 + i) - j > 6] for i in range(T)})


# -- 4.2: merge


def chain(R: dict, theta: float = 0.5) -> tuple[Graph, list]:
    """Merge of the five clusters 0 -> 1 -> 2 -> 3 -> 4."""
    graph, stub = grow([(0, [0, 1, 2, 3, 4])], theta=1, R=table(R))
    merged = graph.merge(stub, theta)
    graph.check()
    return graph, merged


def test_S4_2_24_merge_tests_all_pairs():
    assert chain({(1, 3): 0.9})[1] == [(1, 3, 0.9)], "of clusters far apart"
    assert chain({(1, 4): 0.6, (2, 4): 0.9})[1] == [(2, 4, 0.9)], "the most similar one (R14)"
    assert chain({(0, 1): 0.9, (1, 2): 0.9})[1] == [(0, 1, 0.9)], "no transitive closure (R14)"
    assert chain({(a, b): 1 for b in range(5) for a in range(b)})[0].clusters.keys() == {0}


def test_S4_2_25_merge_above_theta_merge_which_is_its_own():
    for theta_merge, left in ((0.6, 1), (0.7, 2), (0.75, 2)):
        a = algorithm(table({(0, 1): 0.7}), theta_sim=0.8, theta_merge=theta_merge)
        a.graph, a.iteration, a.row = Graph(frame(0), b"0", MAZE), a.config.merge_every, {"theta_sim": 0.8}
        a.update_graph([tau([0, 1])])
        assert len(a.graph.clusters) == left and a.row["added"] == 1 and a.row["merged"] == 2 - left


def test_S4_2_26_27_and_28_the_earlier_cluster_inherits_arcs_and_visits_and_keeps_its_centre():
    graph, stub = grow([(0, [0, 10, 20, 21, 30, 0, 10, 30, 20, 10])])
    assert graph.arcs == {(0, 1): 2, (1, 2): 1, (2, 3): 1, (3, 0): 1, (1, 3): 1, (3, 2): 1, (2, 1): 1}
    assert visits(graph) == {0: 3, 1: 3, 2: 3, 3: 2}
    stub.R = table({(10, 30): 0.9})
    graph.merge(stub, 0.5)
    graph.check()
    assert graph.arcs == {(0, 1): 2, (1, 2): 1 + 1, (2, 1): 1 + 1, (1, 0): 1}, "the arc between the two is gone"
    assert visits(graph) == {0: 3, 1: 5, 2: 3} and sum(visits(graph).values()) == graph.assigned == 11
    assert centres(graph) == {0: 0, 1: 10, 2: 20} and graph.clusters[1].snapshot == b"10"


def test_S4_2_28_and_29_the_initial_cluster_stays_and_is_still_the_root():
    graph, merged = chain({(0, 2): 0.9, (1, 3): 0.9})
    assert merged == [(0, 2, 0.9), (1, 3, 0.9)] and centres(graph) == {0: 0, 1: 1, 4: 4}
    assert [v.parent for v in graph.clusters.values()] == [None, 0, 1]
    assert numbers(graph.clusters[4].path.states()) == [0, 1, 2, 3, 4] and graph.clusters[0].snapshot == b"0"


class Slow:
    """G, the slow and obvious way: numbers for states, and all relations looked up in the arcs."""

    def __init__(self, scores: np.ndarray):
        self.R, self.made, self.arcs = scores, 1, Counter()
        self.centre, self.prefix, self.parent, self.visits = {0: 0}, {0: [0]}, {0: None}, {0: 1}

    def best(self, ids, state: int, theta: float) -> int | None:
        score, v = max((self.R[self.centre[v], state], -v) for v in ids)  # of equals, the older one
        return -v if score > theta else None

    def add(self, start: int, states: list[int], theta: float) -> None:
        at, parent, since = start, start, []
        self.visits[start] += 1
        for state in states[1:]:
            since.append(state)
            v = self.best({at} | {b for a, b in self.arcs if a == at} | {a for a, b in self.arcs if b == at}, state, theta)
            if v is None:
                v = self.best(self.centre, state, theta)
            if v is None:
                v, self.made = self.made, self.made + 1
                self.centre[v], self.prefix[v], self.parent[v] = state, self.prefix[parent] + since, parent
                self.visits[v], parent, since = 0, v, []
            self.visits[v] += 1
            self.arcs[at, v] += at != v
            self.arcs, at = +self.arcs, v

    def merge(self, theta: float) -> None:
        into = {}
        for v in self.centre:  # in the order of creation; those that map to themselves have survived
            survivor = self.best([u for u in into if into[u] == u], self.centre[v], theta) if v else None
            into[v] = v if survivor is None else survivor
        arcs, old = Counter(), self.visits
        for (a, b), count in self.arcs.items():
            arcs[into[a], into[b]] += count * (into[a] != into[b])
        self.arcs, kept = +arcs, [v for v in into if into[v] == v]
        self.visits = {v: sum(old[u] for u in into if into[u] == v) for v in kept}
        self.centre, self.prefix = {v: self.centre[v] for v in kept}, {v: self.prefix[v] for v in kept}
        self.parent = {v: into[self.parent[v]] if v else None for v in kept}


@pytest.mark.parametrize(("theta", "theta_merge"), [(0.8, 0.7), (0.95, 0.85), (0.98, 0.95)])
def test_S4_2_24_to_29_assignment_and_merge_against_the_slow_version(theta, theta_merge):
    rng, merged = np.random.default_rng(0), 0
    for _ in range(40):
        scores = rng.random((30, 30))
        slow, stub, graph = Slow(scores), Stub(lambda a, b, scores=scores: scores[a, b]), Graph(frame(0), b"0", MAZE)
        graph.embed_centres(stub)
        for turn in range(8):
            start = int(rng.choice(list(slow.centre)))
            states = [slow.centre[start], *rng.integers(30, size=10).tolist()]
            slow.add(start, states, theta)
            graph.add_trajectory(tau(states, start), stub, theta)
            if turn % 4 == 3:
                slow.merge(theta_merge)
                merged += len(graph.merge(stub, theta_merge))
            graph.check()
            assert centres(graph) == slow.centre and visits(graph) == slow.visits and graph.arcs == slow.arcs
            assert {v: c.parent for v, c in graph.clusters.items()} == slow.parent
            assert {v: numbers(c.path.states()) for v, c in graph.clusters.items()} == slow.prefix
    assert merged > 40


def test_R17_every_pair_of_the_larger_class_can_be_drawn():
    pairs, rng = Pairs(y=np.array([1] * 30 + [0] * 12)), np.random.default_rng(0)
    assert {int(k) for _ in range(50) for k in pairs.balanced(rng)} == set(range(42))


def test_rates_are_of_as_many_pairs_as_the_smaller_class_has(monkeypatch):
    model, y, scored = SimilarityModel(MAZE, (32, 32)), np.array([1] * 30 + [0] * 12), []
    monkeypatch.setattr(model, "probability", lambda first, second: scored.append(len(first)) or torch.ones(len(first)))
    rbexplore.rates(model, Pairs(list(pictures(42)), np.stack([np.arange(42)] * 2, 1), y), np.random.default_rng(0))
    assert scored == [24]


def test_R18_the_gradient_is_clipped_before_the_step():
    model, x = SimilarityModel(MAZE, (32, 32)), pictures(16)
    model.train().update(x[:8], x[8:], np.arange(8) % 2, 1e-3)
    assert math.sqrt(sum(s["exp_avg"].square().sum().item() for s in model.optimiser.state.values())) < 1.001e-4


def test_R18_a_relu_follows_each_convolution_and_R_alone_has_batch_normalisation():
    nets = SimilarityModel(MAZE, (32, 32)).encoder, RND(MAZE, (32, 32)).target
    kinds = [[type(layer).__name__ for layer in net] for net in nets]
    assert kinds[0] == ["Conv2d", "BatchNorm2d", "ReLU"] * 3 + ["Flatten", "Linear"]
    assert kinds[1] == ["Conv2d", "ReLU"] * 3 + ["Flatten", "Linear"]


def test_R18_R20_widths_are_those_of_the_configuration():
    head = SimilarityModel(replace(MAZE, embedding=8, head_width=24), (32, 32)).head
    assert [m.in_features for m in head if isinstance(m, nn.Linear)] == [16, 24, 24, 24]
    rnd, x = RND(replace(MAZE, rnd_features=24), (32, 32)), torch.zeros(1, 1, 32, 32)
    assert rnd.target(x).shape == rnd.predictor(x).shape == (1, 24)


def test_each_seed_makes_other_networks_and_the_predictor_is_not_the_target():
    one, other = ((SimilarityModel(c, (32, 32)), RND(c, (32, 32))) for c in (replace(MAZE, seed=seed) for seed in (0, 1)))
    assert weights(one[0]) != weights(other[0]) and weights(one[1].target) != weights(other[1].target)
    assert weights(one[1].target) != weights(one[1].predictor[0])


def test_a_prefix_does_not_keep_its_whole_trajectory_in_memory():
    t, (graph, stub) = tau(list(range(0, 400, 10))), grow([])
    graph.add_trajectory(t, stub, 0.5)
    assert all(v.path.frames.base is None for v in list(graph.clusters.values())[1:])
    assert all(np.shares_memory(v.frame, v.path.frames) for v in graph.clusters.values())


def test_networks_do_not_depend_on_torchs_generator():
    made = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        made.append((weights(SimilarityModel(MAZE, (32, 32))), weights(RND(MAZE, (32, 32)).predictor)))
    assert made[0] == made[1]


def test_prefix_pairs_of_a_short_trajectory_too():
    a = algorithm()
    a.graph, _ = grow([(0, list(range(31)))], lambda first, second: 1.0 * (first // 30 == second // 30))
    assert a.make_pairs([tau([*range(1000, 1010)], 1)]).counts["exploration prefix"] == 10


def test_the_novel_share_is_of_this_iteration():
    a, _ = with_rewards({0: 9.0, 1: 0.0}, beta=2.5, keep_buffer=True)
    for _ in range(2):
        a.additional_trajectories([tau([0, 1])])
        assert a.row["novel_share"] == 0.5


def test_R18_rnds_error_is_a_mean_over_features_and_that_before_the_step():
    rnd, x = RND(MAZE, (32, 32)), pictures(8)
    rnd.pixels.join(Moments(x))
    z = torch.from_numpy(rnd.pixels.standardise(x).clip(-5, 5).astype(np.float32))[:, None]
    before = rnd.distance(x).detach()
    assert torch.allclose(before, ((rnd.predictor(z) - rnd.target(z)) ** 2).sum(1) / MAZE.rnd_features, rtol=1e-4)
    assert np.allclose(rnd.update(x), before.numpy(), rtol=1e-6)


def test_R18_rnds_batches_mix_the_states_of_trajectories(monkeypatch):
    rnd, x, seen = RND(replace(MAZE, rnd_batch=8), (32, 32)), pictures(32), []
    monkeypatch.setattr(rnd, "update", lambda frames: seen.extend(f.tobytes() for f in frames) or np.zeros(len(frames)))
    rnd.fit([x], np.random.default_rng(0), lambda *_, **__: None)
    ordered = [f.tobytes() for f in x]
    assert seen != ordered and sorted(seen) == sorted(ordered)


@pytest.mark.parametrize("bad", [float("inf"), float("nan")])
def test_a_loss_that_is_not_finite_stops(bad):
    with pytest.raises(FloatingPointError):
        rbexplore.descend(None, torch.tensor(bad), "R")


def test_the_R_of_a_new_cluster_is_the_best_there_was():
    graph, stub = Graph(frame(0), b"0", MAZE), Stub(table({(0, 20): 0.1, (10, 20): 0.4}))
    graph.embed_centres(stub)
    assert graph.add_trajectory(tau([0, 10, 20]), stub, 0.5)["R"] == [None, 0.0, 0.4]


def test_check_finds_a_loop():
    graph, _ = grow([(0, [0, 10])])
    graph.add_arc(1, 1, 1)
    with pytest.raises(AssertionError, match="two clusters"):
        graph.check()


def test_rates_of_at_most_500_of_each_class(monkeypatch):
    model, scored = SimilarityModel(MAZE, (32, 32)), []
    monkeypatch.setattr(model, "probability", lambda first, second: scored.append(len(first)) or torch.ones(len(first)))
    pairs = Pairs(list(pictures(2)), np.zeros((1200, 2), np.int64), np.arange(1200) % 2)
    rbexplore.rates(model, pairs, np.random.default_rng(0))
    assert scored == [1000]


def test_he_initialisation():
    for net in (SimilarityModel(Config(), (96, 96)), RND(Config(), (96, 96)).predictor):
        for layer in net.modules():
            if isinstance(layer, (nn.Conv2d, nn.Linear)):
                fan_in, count = layer.weight[0].numel(), layer.weight.numel()
                if count > 5000:
                    assert layer.weight.std().item() == pytest.approx(math.sqrt(2 / fan_in), rel=0.05)
                assert layer.bias is None or not layer.bias.any()


def test_R29_rounding_is_of_each_embedding_itself():
    model = SimilarityModel(MAZE, (32, 32))
    first = torch.zeros(2, MAZE.embedding)
    first[0], first[1] = 1e4, 1.0
    assert (model.score(first, first[1] + 1e-3) < 1).all()


def test_each_pass_draws_from_the_larger_class_anew(monkeypatch):
    model, seen = SimilarityModel(MAZE, (32, 32)), set()
    pairs = Pairs(list(pictures(42)), np.stack([np.arange(42)] * 2, 1), np.array([1] * 30 + [0] * 12))
    monkeypatch.setattr(model, "update", lambda first, second, y, clip: seen.update(f.tobytes() for f in first) or 0.0)
    model.fit(pairs, replace(MAZE, epochs=30), np.random.default_rng(0), lambda *_, **__: None)
    assert len(seen) == 42


def test_the_layers_of_resnet18_and_of_a_block():
    def kinds(net):
        return [type(layer).__name__ for layer in net]
    net = rbexplore.resnet18(1, 512)
    assert kinds(net) == ["Conv2d", "BatchNorm2d", "ReLU", "MaxPool2d"] + ["BasicBlock"] * 8 + ["SpatialMean", "Linear"]
    assert kinds(net[4].residual) == ["Conv2d", "BatchNorm2d", "ReLU", "Conv2d", "BatchNorm2d"]
    x = torch.randn(2, 3, 4, 5, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(rbexplore.SpatialMean()(x), x.flatten(2).mean(2))


def test_the_layers_of_rnd_are_burdas():
    rnd = RND(Config(), (96, 96))
    convs = [(m.out_channels, m.kernel_size[0], m.stride[0], m.padding[0]) for m in rnd.target if isinstance(m, nn.Conv2d)]
    assert convs == [(32, 8, 4, 0), (64, 4, 2, 0), (64, 3, 1, 0)]
    assert [type(m).__name__ for m in rnd.predictor[1:]] == ["ReLU", "Linear", "ReLU", "Linear"]


def test_R3_R18_R19_values_of_the_readings():
    paper = {"additional_steps": 50, "r_learning_rate": 1e-4, "r_batch": 256, "r_clip": 1.0, "rnd_learning_rate": 1e-4,
             "epochs": 4, "novelty_window": 5, "head_width": 512, "rnd_encoder": "nature", "rnd_features": 512, "rnd_batch": 256}
    assert paper.items() <= asdict(Config()).items()


def test_the_pixels_statistics_come_before_the_training(monkeypatch):
    rnd, counts = RND(MAZE, (32, 32)), []
    monkeypatch.setattr(rnd, "update", lambda frames: counts.append(rnd.pixels.count) or np.zeros(len(frames)))
    rnd.fit([pictures(8)], np.random.default_rng(0), lambda *_, **__: None)
    assert counts == [8]


def test_R_trains_in_training_mode_and_its_gradients_are_those_of_the_batch(monkeypatch):
    model, x, modes, grads = SimilarityModel(replace(MAZE, r_learning_rate=0.0), (32, 32)), pictures(16), [], []
    model.train()
    for _ in range(2):
        model.update(x[:8], x[8:], np.arange(8) % 2, 1e9)
        grads.append([p.grad.clone() for p in model.parameters()])
    model.eval()
    monkeypatch.setattr(model, "update", lambda *_: modes.append(model.training) or 0.0)
    model.fit(Pairs(list(x), np.zeros((8, 2), np.int64), np.arange(8) % 2), MAZE, np.random.default_rng(0), lambda *_, **__: None)
    assert all(modes)
    assert all(torch.allclose(p, q, rtol=1e-3, atol=1e-6) for p, q in zip(*grads, strict=True))


# ------------------------------------------------------------ the loop, the run folder, the environments

TINY = replace(MAZE, steps=4000, pretrain_steps=600, M=4, L=3, trajectory_steps=60, additional_steps=40, merge_every=3)
SHORT = replace(TINY, steps=1500, beta=0.5)  # beta: so that few iterations find novel states
GATE = replace(MAZE, steps=12_000, pretrain_steps=1000, M=10, L=5, trajectory_steps=100, additional_steps=60)
QUICK = replace(SHORT, trajectory_steps=30, additional_steps=26, epochs=4, embedding=8, head_width=16, rnd_features=8)
MAZE_FN = functools.partial(make_env, "maze")


class Grid(PersistentEnv):
    """A user's own environment: a walk on 7 x 7 places, 4 actions. A frame shows the place, so it is its own ground truth.
    Column 5 is a transition screen, the corner (6, 6) kills, and the corner (0, 6) ends the episode without a death."""

    def __init__(self, channels: tuple = (), rewards: int | None = None):
        self.observation_space = gymnasium.spaces.Box(0, 255, (8, 8, *channels), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(4)
        self.rewards, self.calls, self.place = rewards is not None and np.random.default_rng(rewards), [], (0, 0)

    def frame(self):
        frame = np.zeros(self.observation_space.shape, np.uint8)
        if self.place[0] != 5:
            frame[self.place] = 255
            frame[7, 7] = 77 * (self.place == (6, 6))
        return frame

    def reset(self, *, seed=None, options=None):
        self.place = (0, 0)
        return self.frame(), {}

    def step(self, action):
        self.calls.append(action)
        x, y = np.add(self.place, [(-1, 0), (1, 0), (0, -1), (0, 1)][action]).clip(0, 6).tolist()
        self.place = x, y
        reward = self.rewards.normal() * 1e6 if self.rewards else 0.0
        return self.frame(), reward, self.place == (6, 6), self.place == (0, 6), {"blank": x == 5}

    def snapshot(self):
        return bytes(self.place)

    def restore(self, snapshot):
        self.place = tuple(snapshot)
        return self.frame()

    def unit(self):
        return self.place


class Recorder:
    """Hears of an algorithm: every event and, at each call of a wrapped function, what `note` says of its arguments."""

    def __init__(self):
        self.events, self.calls = [], []

    def __call__(self, event, **data):
        self.events.append((event, data))

    def of(self, event):
        return [data for name, data in self.events if name == event]

    def rows(self):
        """Metrics rows, but for what time and memory it took."""
        return [{k: v for k, v in e["row"].items() if k not in ("seconds", "memory_mb")} for e in self.of("row")]

    def wrap(self, patch, owner, name, label=None, note=lambda *arguments: None):
        inner = getattr(owner, name)

        def wrapped(*arguments, **named):
            self.calls.append((label or name, note(*arguments)))
            return inner(*arguments, **named)
        patch.setattr(owner, name, wrapped)

    def noted(self, label):
        return [note for name, note in self.calls if name == label]


def explorer(config=QUICK, env_fn=Grid, executor=None, seed=0):
    tape = Recorder()
    return RbExplore(env_fn, replace(config, seed=seed), executor=executor, tell=tape), tape


def through_a_file(state):
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def weights(module):
    return b"".join(x.cpu().numpy().tobytes() for x in module.state_dict().values())


def graph_of(a):
    """G as plain values: clusters with all that they know, and arcs."""
    clusters = [(v, c.frame.tobytes(), c.snapshot, c.parent, c.visits, c.path.replay()) for v, c in a.graph.clusters.items()]
    return clusters, a.graph.arcs


def play(env, snapshot, actions, look=lambda env: env.snapshot()):
    """All that can be seen of a trajectory, from the snapshot's own frame on; it ends with a death."""
    seen = [(env.restore(snapshot).tobytes(), look(env), env.unit())]
    for action in actions:
        frame, *outcome = env.step(action)
        seen.append((frame.tobytes(), look(env), outcome, env.unit()))
        if outcome[1]:
            break
    return seen


def play_elsewhere(make, jobs, look=lambda env: env.snapshot()):
    env = make()
    return [play(env, *job, look) for job in jobs]


def elsewhere(function, *arguments):
    """Call in a process that shares nothing with this one."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


# ------------------------------------------------------------------------------------------- persistent MDPs (3.2)


def test_S3_2_01_any_visited_state_can_be_accessed_again_later_and_in_another_process():
    (a, _), rng = explorer(SHORT, MAZE_FN), np.random.default_rng(0)
    met = [snapshot for _ in range(2) for tau in a.explore() for snapshot in tau.snapshots]
    jobs = [(met[rng.integers(len(met))], rng.integers(7, size=12).tolist()) for _ in range(200)]
    seen = [play(a.env, *job) for job in jobs]
    assert len({trace[-1][0] for trace in seen}) > 10  # the frames tell states apart
    a.run()  # G changes, is reset and merged
    order = rng.permutation(len(jobs))
    assert [play(a.env, *jobs[k]) for k in order] == [seen[k] for k in order]
    assert elsewhere(play_elsewhere, MAZE_FN, jobs[:40]) == seen[:40]


def test_S3_2_02_a_rollback_costs_no_step():
    a, tape = explorer()
    a.run()
    assert len(a.graph.clusters) > 3
    assert a.steps == len(a.env.calls) == a.config.steps  # each step of the environment costs one, and nothing else does
    assert tape.rows()[-1]["steps"] == a.steps > tape.rows()[-1]["exploration_steps"] == a.exploration_steps


@pytest.mark.parametrize("env_fn", [MAZE_FN, Grid])
def test_S3_2_03_in_a_whole_run_the_stored_actions_lead_to_every_centre(env_fn):
    a, _ = explorer(replace(TINY, steps=2500), env_fn)
    env, through_blank = env_fn(), 0
    while a.steps < a.config.steps:
        a.iterate()
        a.graph.check()
        for cluster in a.graph.clusters.values():
            frame = env.reset()[0]
            for action in cluster.path.replay():
                frame, _, terminated, _, info = env.step(action)
                through_blank += info.get("blank", False)
                assert not terminated
            assert np.array_equal(frame, cluster.frame) and env.snapshot() == cluster.snapshot
            assert np.array_equal(env.restore(cluster.snapshot), cluster.frame)
    assert len(a.graph.clusters) > 3 and (through_blank > 0) == (env_fn is Grid)


# ------------------------------------------------------------------------------- the five steps of an iteration (4)


def test_S4_01_S6_1_06_S6_1_11_M_trajectories_from_the_sampled_centres_within_the_cap(monkeypatch):
    a, tape = explorer(replace(QUICK, merge_every=2))
    explore, seen = a.explore, []

    def noted():
        clusters, room = dict(a.graph.clusters), a.config.pretrain_steps if a.phase == "pretrain" else a.config.steps
        seen.append((clusters, room - a.steps, explore()))
        return seen[-1][2]
    monkeypatch.setattr(a, "explore", noted)
    a.run()
    assert len(seen[0][0]) == 1 and len(seen[0][2]) == a.config.M == 4  # also where G has one cluster
    full = 0
    for (clusters, room, taus), sample in zip(seen, tape.of("sample"), strict=True):
        assert len(sample["chosen"]) == a.config.M and [tau.start for tau in taus] == sample["chosen"][: len(taus)]
        assert len(taus) == a.config.M or sum(len(tau.units) for tau in taus) == room
        for tau in taus:
            v = clusters[tau.start]
            assert np.array_equal(tau.frames[0], v.frame) and tau.snapshots[0] == v.snapshot
            assert 1 <= len(tau.units) <= a.config.trajectory_steps
            full += len(tau.units) == a.config.trajectory_steps
    assert full > 5 and max(len(set(sample["chosen"])) for sample in tape.of("sample")) > 2
    assert a.exploration_steps == sum(len(tau.units) for *_, taus in seen for tau in taus) < a.steps
    assert any(row["merged"] for row in tape.rows()[:-1])
    made = 0
    for event, data in tape.events:
        made += len(data.get("made", ()))
        if event == "row":
            assert data["row"]["added"] == made
            made = 0


def test_S4_02_pairs_are_made_of_exploration_and_of_additional_trajectories(monkeypatch):
    (a, tape), kept = explorer(replace(QUICK, prefix=False), MAZE_FN), []
    tape.wrap(monkeypatch, a, "train_similarity", note=kept.append)
    collect = a.collect
    monkeypatch.setattr(a, "collect", lambda purpose, *rest: kept.append(collect(purpose, *rest)) or kept[-1])
    while not kept or not kept[-1].counts["additional negative"]:
        kept.clear()
        a.iterate()
    explored, additional, pairs = kept
    assert [f.tobytes() for tau in (*explored, *additional) for f in tau.frames] == [f.tobytes() for f in pairs.states]
    used, first = np.unique(pairs.index), sum(len(tau.frames) for tau in explored)
    assert used[0] == 0 and (used < first).any() and (used >= first).any() and used[-1] == len(pairs.states) - 1
    assert {"exploration positive", "exploration negative", "additional positive", "additional negative"} <= set(+pairs.counts)


def test_S4_03_S4_04_S4_05_the_five_steps_are_called_in_the_papers_order(monkeypatch):
    a, tape = explorer(replace(QUICK, merge_every=1, pretrain_steps=0))
    a.iterate()
    parts = [("RND", a.novelty, "reward update"), ("R", rbexplore, "rates"), ("R", a.similarity, "update"),
             ("G", Graph, "embed_centres add_trajectory merge")]
    tape.wrap(monkeypatch, a, "collect", note=lambda purpose, *_: purpose)
    for part, owner, names in parts:
        for name in names.split():
            tape.wrap(monkeypatch, owner, name, f"{part} {name}")
    a.iterate()
    order = [call for call, _ in itertools.groupby(tape.calls)]
    assert order == [("collect", "explore"), ("RND reward", None), ("collect", "additional"),
                     ("R rates", None), ("R update", None),
                     ("G embed_centres", None), ("G add_trajectory", None), ("G merge", None), ("RND update", None)]


def test_S4_03_states_are_assigned_by_the_trained_R_to_centres_embedded_anew(monkeypatch):
    a, tape = explorer(replace(SHORT, pretrain_steps=0), MAZE_FN)
    fit, trained = a.similarity.fit, []
    monkeypatch.setattr(a.similarity, "fit", lambda *arguments: (fit(*arguments), trained.append(weights(a.similarity)))[0])

    def fresh(g, *_):
        centres = a.similarity.embed(np.stack([v.frame for v in g.clusters.values()]))
        trained_now = not a.similarity.training and weights(a.similarity) == trained[-1]
        return trained_now and torch.allclose(g.centres, centres, atol=1e-5)
    tape.wrap(monkeypatch, Graph, "add_trajectory", note=fresh)
    tape.wrap(monkeypatch, Graph, "merge", note=fresh)
    a.run()
    assert len(set(trained)) == a.iteration and all(tape.noted("add_trajectory")) and all(tape.noted("merge"))


def test_S4_05_the_filter_uses_rnd_from_before_and_rnd_learns_exploration_states_only(monkeypatch):
    a, tape = explorer(replace(QUICK, pretrain_steps=0))

    def state(*_):
        return weights(a.novelty.predictor), a.novelty.pixels.count, len(a.novelty.errors)
    tape.wrap(monkeypatch, a.novelty, "reward", note=state)
    tape.wrap(monkeypatch, a.novelty, "update", note=lambda frames: [f.tobytes() for f in frames])
    tape.wrap(monkeypatch, a, "make_pairs", note=lambda taus: [f.tobytes() for tau in taus for f in tau.frames])
    additional = 0
    for _ in range(4):
        before = state()
        tape.calls.clear()
        additional += a.iterate()["additional"]
        assert set(tape.noted("reward")) == {before} and state() != before
        (explored,) = tape.noted("make_pairs")
        assert Counter(sum(tape.noted("update"), [])) == Counter(explored)  # each once: one pass
        assert a.novelty.pixels.count == before[1] + len(explored)
    assert additional > 3


@pytest.mark.parametrize("iterations", [0, 1])
def test_S4_06_no_pair_and_no_novel_state_outlives_its_iteration(monkeypatch, iterations):
    config = replace(QUICK, replay_iterations=iterations, keep_buffer=iterations > 0)
    (a, tape), given, novel = explorer(config, MAZE_FN), [], 0
    tape.wrap(monkeypatch, a, "train_similarity", note=lambda pairs: given.append(pairs))
    tape.wrap(monkeypatch, a.similarity, "fit", note=lambda pairs, *_: pairs)
    while a.phase == "pretrain":
        before = len(tape.of("novel"))
        a.iterate()
        found = sum(len(e["states"]) for e in tape.of("novel")[before:])
        novel = found + (novel if config.keep_buffer else 0)
        assert len(a.novel) == novel or a.phase == "explore"
        trained, recent = tape.noted("fit")[-1], given[-1 - iterations :]
        assert [s.tobytes() for s in trained.states] == [s.tobytes() for p in recent for s in p.states]
        assert len(trained.y) == sum(len(p.y) for p in recent) and sum(trained.y) == sum(sum(p.y) for p in recent)
    assert len(given) > 4


def test_S4_07_rewards_change_nothing():
    runs = [explorer(QUICK, functools.partial(Grid, rewards=seed)) for seed in (None, 1, 2)]
    for a, _ in runs:
        a.run()
    assert all(tape.rows() == runs[0][1].rows() and graph_of(a) == graph_of(runs[0][0]) for a, tape in runs[1:])
    assert len(runs[0][0].graph.clusters) > 3


def test_each_purpose_of_each_iteration_has_seeds_of_its_own():
    a, seeds = explorer()[0], set()
    for a.iteration in range(3):
        seeds |= {tuple(a.seed(purpose, k)) for purpose in rbexplore.PURPOSES for k in (-1, 0, 1)}
    assert len(seeds) == 3 * 3 * len(rbexplore.PURPOSES)


def test_a_seeded_environment_begins_where_the_seed_says():
    class Seeded(Grid):
        home = (0, 0)

        def reset(self, *, seed=None, options=None):
            self.place = self.home = self.home if seed is None else (seed, 0)
            return self.frame(), {}
    assert explorer(env_fn=Seeded, seed=3)[0].snap_init == bytes((3, 0))
    assert make_method("random", Seeded, replace(QUICK, seed=3)).snap_init == bytes((3, 0))


def test_R19_rates_are_of_pairs_that_R_has_not_trained_on(monkeypatch):
    (a, tape), given = explorer(replace(QUICK, replay_iterations=1), MAZE_FN), []
    tape.wrap(monkeypatch, a, "train_similarity", note=given.append)
    tape.wrap(monkeypatch, rbexplore, "rates", note=lambda model, pairs, *_: pairs)
    for _ in range(3):
        a.iterate()
    assert all(x is y for x, y in zip(tape.noted("rates"), given, strict=True))


def test_units_become_plain_keys():
    assert [rbexplore.unit_key(u) for u in (5, "hall", [1, 2], (3,))] == [(5,), ("hall",), (1, 2), (3,)]
    assert {type(x) for x in rbexplore.unit_key(np.array([1, 2]))} == {int}


def test_a_worker_resets_its_environment_before_the_first_job(monkeypatch):
    tapes = []

    def recorded():
        env, tape = Grid(), Recorder()
        tapes.append(tape)
        for name in ("reset", "restore"):
            tape.wrap(monkeypatch, env, name)
        return env
    with ThreadPoolExecutor(1) as pool:
        explorer(env_fn=recorded, executor=pool)[0].iterate()
    assert [tape.calls[0][0] for tape in tapes] == ["reset", "reset"]


def test_each_trajectory_has_a_seed_of_its_own_also_near_the_end_of_the_budget(monkeypatch):
    (a, _), seeds, inner = explorer(replace(QUICK, pretrain_steps=0, steps=100)), [], rbexplore.walk
    a.restart()
    monkeypatch.setattr(rbexplore, "walk", lambda env, at, seed, *rest: seeds.append(tuple(seed)) or inner(env, at, seed, *rest))
    a.collect("explore", [a.snap_init] * 4, 30)  # 120 steps do not fit
    assert len(seeds) == len(set(seeds)) > 2


def test_a_death_on_a_blank_frame_ends_the_trajectory():
    class Dark(Grid):
        def step(self, action):
            frame, reward, _, truncated, info = super().step(action)
            return frame, reward, info["blank"], truncated, info
    t = walk(Dark(), bytes((4, 3)), [0], 200, True)
    assert t.units[-1][0] == 5 and all(u[0] != 5 for u in t.units[:-1])


def test_additional_trajectories_keep_no_snapshots():
    a = explorer()[0]
    assert all(not t.snapshots for t in a.collect("additional", [a.snap_init] * 2, 30))


def test_sample_differs_between_iterations():
    a, asked = algorithm(M=40), []
    a.graph, _ = grow([(0, [0, 10, 20, 30])])
    a.collect = lambda purpose, snapshots, steps: asked.append(tuple(snapshots)) or []
    for a.iteration in range(3):
        a.explore()
    assert len(set(asked)) == 3


def test_R28_iterations_of_pretraining_count_for_the_merge(monkeypatch):
    a, tape = explorer(replace(QUICK, merge_every=4, L=0, steps=3000))
    tape.wrap(monkeypatch, Graph, "merge", note=lambda *_: (a.phase, a.iteration))
    a.run()
    rows = tape.rows()
    assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))
    assert tape.noted("merge") == [(row["phase"], row["iteration"]) for row in rows if row["iteration"] % 4 == 0]
    assert {phase for phase, _ in tape.noted("merge")} == {"pretrain", "explore"}
    last = max(row["iteration"] for row in rows if row["phase"] == "pretrain")
    assert last % 4, "else the merges after the restart are the same, counted from it"


# ------------------------------------------------------------------------------ the domain and the experiments (5, 6)


def test_S5_03_S5_04_coverage_counts_units_once_of_a_fixed_set_at_exploration_steps_only(monkeypatch):
    a, tape = explorer(replace(SHORT, steps=3000), MAZE_FN)
    collect, first, step = a.collect, {}, 0

    def noted(purpose, *arguments):
        nonlocal step
        step = a.steps
        taus = collect(purpose, *arguments)
        for unit in (unit for tau in taus for unit in tau.units):
            step += 1
            if (purpose, a.phase) == ("explore", "explore") and unit is not None:
                first.setdefault(unit, step)
        return taus
    monkeypatch.setattr(a, "collect", noted)
    a.run()
    assert a.discovered == first | {a.unit_init: a.config.pretrain_steps}
    covered = [row["coverage"] for row in tape.rows()]
    assert covered == sorted(covered) and covered[-1] == len(a.discovered) / len(a.env.reachable()) <= 1
    assert all(not row["units"] for row in tape.rows() if row["phase"] == "pretrain") and len(a.discovered) > 10
    env, units = MAZE_FN(), []
    env.reset()
    for action in (0, 1, 2, 2):  # turn on the spot, then walk
        env.step(action)
        units.append(env.unit())
    assert units == [(6, 1, 2)] * 3 + [(6, 2, 2)]  # (room, column, row): two states of one unit count once


def test_S6_1_05_S6_1_08_S6_1_09_S6_1_12_the_papers_values_are_the_defaults_on_every_level():
    paper = {"M": 30, "trajectory_steps": 1500, "n": 5, "N": 25, "theta_sim": 0.5, "theta_merge": 0.5, "merge_every": 15,
             "beta": 2.5, "L": 1000, "pretrain_steps": 500_000, "steps": 15_000_000, "frame_size": 96, "encoder": "resnet18",
             "embedding": 512, "prefix": True, "merge": True, "trim": 0, "replay_iterations": 0, "keep_buffer": False}
    assert paper.items() <= asdict(Config()).items() and CONFIGS["paper"] == Config()
    of = [settings("--env", "pop", "--rom", "x", "--level", str(level))["config"] for level in (1, 2, 3)]
    assert of == [asdict(Config())] * 3 and settings("--config", "paper")["config"] == asdict(Config())
    assert all(f.metadata["meaning"] for f in fields(Config))


def settings(*argv):
    return rbexplore.settings_of(rbexplore.parser().parse_args(argv))


def test_S6_1_07_a_death_ends_the_trajectory_and_is_no_state(monkeypatch):
    a, tape = explorer(replace(QUICK, steps=3000, trajectory_steps=120))
    taus = []
    collect = a.collect
    monkeypatch.setattr(a, "collect", lambda *arguments: taus.append(collect(*arguments)) or taus[-1])
    a.run()
    ends = Counter()
    for tau in itertools.chain(*taus):
        assert not (tau.frames[:, 7, 7] == 77).any() and (6, 6) not in tau.units[:-1] and (0, 6) not in tau.units[:-1]
        lit = [bytes(u) for u in tau.units if u[0] != 5 and u != (6, 6)]
        frames = [bytes(np.argwhere(f == 255)[0].tolist()) for f in tau.frames]
        assert frames[1:] == lit == (tau.snapshots[1:] or lit)  # every other state is one, also that of a truncation
        ends[tau.units[-1]] += 1
    assert ends[6, 6] and ends[0, 6] and all(bytes((6, 6)) != v.snapshot for v in a.graph.clusters.values())


def test_R24_blank_frames_are_counted_and_replayed_but_are_no_states():
    a, _ = explorer()
    tau = rbexplore.walk(a.env, bytes((4, 3)), [0], 200, True)
    assert len(tau.units) == len(a.env.calls) and any(u[0] == 5 for u in tau.units)
    assert len(tau.frames) == len(tau.snapshots) == len(tau.actions) < len(tau.units) and tau.frames.any((1, 2)).all()
    assert {len(x) for x in tau.actions[1:]} > {1}
    a.env.restore(tau.snapshots[0])
    for actions, snapshot in zip(tau.actions[1:], tau.snapshots[1:], strict=True):
        for action in actions:
            a.env.step(action)
        assert a.env.snapshot() == snapshot
    a.run()
    assert all(v.frame.any() for v in a.graph.clusters.values())


@pytest.mark.parametrize("merge", [True, False])
def test_S6_1_10_S6_3_01_merge_runs_at_15_and_30_or_never(monkeypatch, merge):
    every = {"merge_every": MAZE.merge_every, "M": 1, "L": 0, "pretrain_steps": 0, "steps": 10_000}
    a, tape = explorer(replace(QUICK, merge=merge, **every))
    tape.wrap(monkeypatch, Graph, "merge", note=lambda *_: a.iteration)
    while a.iteration < 31:
        a.iterate()
    assert tape.noted("merge") == ([15, 30] if merge else [])
    assert all(row["merged"] == 0 for row in tape.rows() if row["iteration"] % 15 or not merge)


def test_S6_1_13_theta_rises_linearly_from_0_in_pretraining_and_is_fixed_after(monkeypatch):
    a, tape = explorer(replace(QUICK, pretrain_steps=1000, steps=2000))
    tape.wrap(monkeypatch, Graph, "add_trajectory", note=lambda g, tau, R, theta: theta)
    used, at = [], []
    while a.steps < a.config.steps:
        at.append(a.steps)
        tape.calls.clear()
        a.iterate()
        used.append(set(tape.noted("add_trajectory")))
    wanted = [0.5 * min(1, steps / 1000) for steps in at]
    assert used == [{theta} for theta in wanted] and [row["theta_sim"] for row in tape.rows()] == wanted
    assert wanted[0] == 0 and 1000 in at and len([steps for steps in at if steps < 1000]) > 3


def test_S6_1_14_S6_1_15_at_the_restart_G_is_reset_and_R_and_rnd_are_kept(monkeypatch):
    a, tape = explorer(replace(SHORT, keep_buffer=True, beta=-9.0, r_anneal=False), MAZE_FN)  # beta: every state is novel

    def kept():
        parts = a.similarity, a.novelty.predictor, a.novelty.target
        moments = [a.novelty.pixels, *a.novelty.errors]
        optimisers = [s["exp_avg"].numpy().tobytes() for o in (a.similarity, a.novelty) for s in o.optimiser.state.values()]
        return [weights(part) for part in parts], optimisers, [(m.count, m.mean.tobytes(), m.m2.tobytes()) for m in moments]
    fresh = kept()
    while a.steps < a.config.pretrain_steps:
        a.iterate()
    before = kept()
    assert len(a.graph.clusters) > 1 and a.novel and not a.discovered and a.phase == "pretrain"
    assert a.novelty.pixels.count > 300 and a.novelty.pixels.m2.any() and a.novelty.errors and before[0][0] != fresh[0][0]
    a.restart()
    assert kept() == before and a.steps == a.config.pretrain_steps
    assert len(a.graph.clusters) == 1 and not a.graph.arcs and a.graph.clusters[0].snapshot == a.snap_init and not a.novel
    assert np.array_equal(a.graph.clusters[0].frame, a.s_init) and a.theta_sim() == 0.5 and len(a.discovered) == 1
    a.run()
    assert len(tape.of("restart")) == 1


@pytest.mark.parametrize("pool", [None, ThreadPoolExecutor])
def test_S6_2_04_the_counter_stops_exactly_at_the_budget(pool):
    counted = []

    class Counting(Grid):
        def step(self, action):
            counted.append(action)
            return super().step(action)
    for steps, pretrain in ((977, 331), (61, 60), (1, 0)):
        counted.clear()
        with pool(2) if pool else open(os.devnull) as executor:
            a, tape = explorer(replace(QUICK, steps=steps, pretrain_steps=pretrain), Counting, executor if pool else None)
            a.run()
        assert a.steps == len(counted) == steps and max(a.discovered.values()) <= steps
        assert [row["steps"] for row in tape.rows() if row["phase"] == "pretrain"][-1:] == [pretrain] * (pretrain > 0)


def test_S6_3_02_without_prefixes_the_rest_of_the_pairs_is_identical():
    (a, _), twin = explorer(SHORT, MAZE_FN), explorer(replace(SHORT, prefix=False), MAZE_FN)[0]
    a.run()
    rbexplore.unpack(twin, rbexplore.pack(a))
    for run in (a, twin):
        run.row, run.config = {}, replace(run.config, steps=10_000)
    taus = a.explore()
    twin.steps = a.steps
    assert any(tau.start for tau in taus)
    pairs = [run.make_pairs(taus) for run in (a, twin)]
    of = [pairs[0].counts.pop(f"{source} prefix") for source in ("exploration", "additional")]
    assert min(of) > 50 and pairs[0].counts == pairs[1].counts  # no pair of another kind comes or goes

    def plain(p):
        return Counter((p.states[i].tobytes(), p.states[j].tobytes(), y) for (i, j), y in zip(p.index, p.y.tolist(), strict=True))
    left = plain(pairs[0]) - plain(pairs[1])
    assert not plain(pairs[1]) - plain(pairs[0]) and left.total() == sum(of) and all(y == 0 for *_, y in left)


def test_S6_3_03_only_theta_merge_differs(monkeypatch):
    plain = asdict(MAZE)
    for theta in (0.25, 0.5, 0.75):
        given = settings("--theta-merge", str(theta))["config"]
        assert given == plain | {"theta_merge": theta}
        a, tape = explorer(replace(QUICK, pretrain_steps=0, theta_merge=theta, steps=900, merge_every=1))
        tape.wrap(monkeypatch, a.graph, "merge", note=lambda R, threshold: threshold)
        a.phase = "explore"
        tape.wrap(monkeypatch, a.graph, "add_trajectory", note=lambda tau, R, threshold: threshold)
        a.run()
        assert set(tape.noted("merge")) == {theta} and set(tape.noted("add_trajectory")) == {0.5}
        assert sum(row["added"] for row in tape.rows()) > 3  # there is something to merge


# ------------------------------------------------------------------------------------- the same run, however it is run


def test_a_seed_makes_the_run_and_global_generators_are_left_alone():
    before = torch.get_rng_state(), str(np.random.get_state()), random.getstate()  # noqa: NPY002
    (a, one), (b, two), (_, other) = runs = [explorer(SHORT, MAZE_FN, seed=seed) for seed in (5, 5, 6)]
    for run, _ in runs:
        run.run()
        torch.rand(1) if run is not b else None  # nor does the run depend on them
        before = (torch.get_rng_state(), *before[1:])
    assert torch.equal(before[0], torch.get_rng_state()) and before[1:] == (str(np.random.get_state()), random.getstate())
    assert one.rows() == two.rows() != other.rows() and graph_of(a) == graph_of(b)
    assert weights(a.similarity) == weights(b.similarity)


def test_an_executor_changes_nothing():
    alone, tape = explorer(SHORT, MAZE_FN)
    alone.run()
    with ThreadPoolExecutor(2) as pool:
        shared, other = explorer(SHORT, MAZE_FN, pool)
        shared.run()
    assert tape.rows() == other.rows() and graph_of(alone) == graph_of(shared)


class Shifted(Grid):
    """Its actions are 3 to 6."""

    def __init__(self):
        super().__init__()
        self.action_space = gymnasium.spaces.Discrete(4, start=3)

    def step(self, action):
        assert self.action_space.contains(action)
        return super().step(action - 3)


class Reusing(Grid):
    """Gives the same array again and again."""

    def frame(self):
        self.buffer = getattr(self, "buffer", super().frame())
        self.buffer[:] = super().frame()
        return self.buffer


class Strict(Grid):
    """Its transition screen ends the episode too; no step may follow an end."""

    over = False

    def reset(self, **named):
        self.over = False
        return super().reset(**named)

    def restore(self, snapshot):
        self.over = False
        return super().restore(snapshot)

    def step(self, action):
        assert not self.over
        frame, reward, terminated, truncated, info = super().step(action)
        self.over = terminated or truncated or info["blank"]
        return frame, reward, terminated, truncated or info["blank"], info


@pytest.mark.parametrize("env_fn", [Shifted, Reusing])
def test_where_actions_start_and_whose_the_frames_are_changes_nothing(env_fn):
    (a, _), (plain, _) = explorer(env_fn=env_fn), explorer()
    assert graph_of(a.run()) == graph_of(plain.run()) and len(a.graph.clusters) > 3
    assert not plain.s_init[1:].any() and np.array_equal(a.s_init, plain.s_init) and rbexplore.verify(a)[1]
    units = [make_method("random", fn, QUICK).run().discovered for fn in (env_fn, Grid)]
    assert units[0] == units[1]


def test_nothing_steps_on_after_an_end():
    tau = walk(Strict(), bytes((4, 3)), [0], 200, True)
    assert tau.units[-1][0] == 5 and all(u[0] != 5 for u in tau.units[:-1])
    for method in ("rbexplore", "random", "rnd"):
        a = make_method(method, Strict, QUICK, ppo=TINY_PPO).run()
        assert any(unit[0] == 5 for unit in a.discovered)


def test_two_algorithms_share_an_executor():
    closed = []

    class Closing(Grid):
        def close(self):
            closed.append(self)
    makers = Closing, functools.partial(Grid, (3,))
    with ThreadPoolExecutor(1) as pool:
        for shared, alone in [[(explorer(env_fn=fn, executor=x)[0]) for x in (pool, None)] for fn in makers] * 2:
            for a in (shared, alone):
                a.iterate()
            assert graph_of(shared) == graph_of(alone) and shared.discovered == alone.discovered
    assert closed


def test_R3_additional_trajectories_have_a_length_of_their_own_and_the_trace_tells_their_rewards(monkeypatch):
    a, tape = explorer(replace(QUICK, beta=0.0))
    collect, longest = a.collect, Counter()

    def noted(purpose, *arguments):
        taus = collect(purpose, *arguments)
        longest[purpose] = max([longest[purpose], *(len(tau.units) for tau in taus)])
        return taus
    monkeypatch.setattr(a, "collect", noted)
    a.run()
    assert longest == {"explore": 30, "additional": 26}
    assert tape.of("novel") and all(min(e["reward"]) > 0 and len(e["reward"]) == len(e["states"]) for e in tape.of("novel"))


def test_a_packed_state_holds_the_buffer_the_replayed_pairs_and_the_refusals():
    config = replace(QUICK, keep_buffer=True, replay_iterations=1, max_clusters=3, beta=0.0)
    (a, _), (b, _) = explorer(config), explorer(config)
    while a.phase == "pretrain" or not a.graph.refused or not a.novel:
        a.iterate()
    rbexplore.unpack(b, through_a_file(rbexplore.pack(a)))
    assert b.novel == a.novel and b.graph.refused == a.graph.refused and len(b.replay) == 1
    assert graph_of(a.run()) == graph_of(b.run()) and weights(a.similarity) == weights(b.similarity)


def test_values_at_the_edge_of_what_can_work():
    assert replace(MAZE, n=25, N=25).n == 25
    for wrong in ({"n": 26}, {"pretrain_steps": MAZE.steps}, {"trajectory_steps": 25}):
        with pytest.raises(InputError):
            replace(MAZE, **wrong)


def test_memory_counts_each_link_of_the_lineage_once():
    a, picture = explorer()[0], np.zeros((512, 1024), np.uint8)  # half a megabyte
    a.graph = Graph(picture, bytes(2**20), MAZE)
    link = rbexplore.Path(a.graph.clusters[0].path, np.stack([picture] * 2), (b"0", b"0"))  # its cluster was merged away
    for v in (2, 3):
        a.graph.clusters[v] = rbexplore.Cluster(picture, b"", rbexplore.Path(link, picture[None], (b"0",)), 0)
    a.novel = [bytes(2**20)]
    assert rbexplore.memory(a) == 0.5 + 1 + 0.5 + 0.5 + 1 + 1


def test_verify_tells_places_apart_that_look_alike():
    class Alike(Grid):
        def frame(self):
            frame = np.zeros((8, 8), np.uint8)
            frame[self.place[0], 0] = 255
            return frame
    for place, good in (((1, 0), True), ((1, 1), False)):
        a, _ = explorer(env_fn=Alike)
        picture, root = a.env.restore(bytes(place)), a.graph.clusters[0].path
        a.graph.clusters[1] = rbexplore.Cluster(picture, bytes(place), rbexplore.Path(root, picture[None], (b"\1",)), 0)
        assert rbexplore.verify(a)[1] == good


@pytest.mark.parametrize("channels", [(), (3,)])
def test_an_environment_of_the_users_own(channels):
    a, tape = explorer(replace(QUICK, trim=2, max_clusters=2), functools.partial(Grid, channels))
    a.run()
    a.graph.check()
    assert tape.rows()[-1]["coverage"] is None and 5 < tape.rows()[-1]["units"] <= 49 and len(a.graph.clusters) <= 2
    assert a.graph.refused > 0
    assert a.similarity.encoder[0].in_channels == (channels or (1,))[0] and a.s_init.shape == (8, 8, *channels)


@pytest.mark.parametrize("change, said", [
    ({"snapshot": None}, r"lacks snapshot\(\)"), ({"restore": None, "unit": None}, r"lacks restore, unit\(\)"),
    ({"action_space": gymnasium.spaces.Box(0, 1)}, "must be Discrete"),
    ({"action_space": gymnasium.spaces.Discrete(257)}, "at most 256"),
    ({"observation_space": gymnasium.spaces.Box(0, 1, (8, 8))}, "Box of uint8"),
    ({"frame": lambda: np.zeros((9, 9), np.uint8)}, "gives a frame"),
    ({"frame": lambda: np.zeros((8, 8))}, "gives a frame"), ({"restore": lambda s: np.ones((8, 8), np.uint8)}, "same frame"),
    ({"snapshot": lambda: "00"}, "must give bytes")])
def test_an_environment_that_breaks_the_contract(change, said):
    def broken():
        env = Grid()
        for name, value in change.items():
            setattr(env, name, value)
        return env
    with pytest.raises(InputError, match=said):
        RbExplore(broken, QUICK)
    change = {"action_space": gymnasium.spaces.Discrete(256)}  # as many as a byte tells apart
    RbExplore(broken, QUICK)


def test_learning_gate():
    """A broken R or graph explores no further than a walk; what is asked here is far from what a good seed reaches."""
    a, tape = explorer(GATE, MAZE_FN, seed=0)
    a.run()
    env, rng, units = MAZE_FN(), np.random.default_rng(0), set()
    while a.steps > 0:  # the same steps, all from the start
        units |= set(rbexplore.walk(env, a.snap_init, [int(rng.integers(2**31))], GATE.trajectory_steps, False).units) - {None}
        a.steps -= GATE.trajectory_steps
    assert len(a.discovered) > 1.3 * len(units)
    assert np.mean([row["r_accuracy"] for row in tape.rows()[-5:]]) > 0.7


def test_a_packed_state_holds_the_next_number():
    (a, _), (b, _) = explorer(), explorer()
    a.graph.created = 9  # the clusters made last were merged away
    rbexplore.unpack(b, through_a_file(rbexplore.pack(a)))
    assert b.graph.created == 9


# ------------------------------------------------------------------------------------ the run folder, the command line

SCRIPT = rbexplore.__file__
TINY_OPTIONS = {"steps": 4000, "pretrain-steps": 600, "M": 4, "L": 3, "trajectory-steps": 60, "additional-steps": 40,
                "merge-every": 3, "beta": 1}
TINY_RUN = ["--trace", *(f"--{name}={value}" for name, value in TINY_OPTIONS.items())]
FIGURES = {"coverage.png", "coverage_map.png", "graph.png", "centres.png"}


def metrics(folder, leave=("seconds",)):
    with open(folder / "metrics.csv", newline="") as file:
        return [[v for k, v in row.items() if k not in leave] for row in csv.DictReader(file)]


def outcome(folder):
    """What must not depend on how a run was run: metrics but for the seconds, the trace, and G, R and RND."""
    state = torch.load(folder / "checkpoint.pt", weights_only=True)["algorithm"]
    return metrics(folder), (folder / "trace.jsonl").read_bytes(), tensors_as_bytes(state)


def tensors_as_bytes(x):
    if isinstance(x, torch.Tensor):
        return x.numpy().tobytes()
    if isinstance(x, dict):
        return {k: tensors_as_bytes(v) for k, v in x.items()}
    return [tensors_as_bytes(v) for v in x] if isinstance(x, (list, tuple)) else x


def start(*argv):
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    return subprocess.Popen([sys.executable, SCRIPT, *argv], env=os.environ | {"OMP_NUM_THREADS": "1"}, **quiet)


def wait_for_rows(process, folder, count, deadline=60):
    """Until metrics.csv has so many rows, or the process or its time is over."""
    end = time.monotonic() + deadline
    while process.poll() is None and time.monotonic() < end:
        if (folder / "metrics.csv").exists() and len(metrics(folder)) >= count:
            return
        time.sleep(0.002)  # between two looks
    raise AssertionError(f"no {count} rows: {process.stderr.read() if process.poll() is not None else 'too slow'}")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The uninterrupted run, by the command line in this process."""
    folder = tmp_path_factory.mktemp("run") / "whole"
    assert main([*TINY_RUN, "--out", str(folder)]) == 0
    return folder


def check_figures(folder):
    from matplotlib.image import imread
    for name in FIGURES:
        assert (folder / name).read_bytes().startswith(b"\x89PNG") and imread(folder / name)[..., :3].std() > 0.02


def test_a_run_folder_holds_figures_metrics_and_a_checkpoint_of_plain_data(finished):
    check_figures(finished)
    assert {p.name for p in finished.iterdir()} == FIGURES | {"config.json", "metrics.csv", "checkpoint.pt", "trace.jsonl"}
    state, rows = torch.load(finished / "checkpoint.pt", weights_only=True), metrics(finished, leave=())
    assert len(state["rows"]) == len(rows) > 10 and int(rows[-1][rbexplore.METRICS.index("steps")]) == 4000
    assert len({row[1] for row in rows}) == 2 and sum(int(row[rbexplore.METRICS.index("additional")]) for row in rows) > 5


def test_killed_twice_and_resumed_equals_uninterrupted(finished, tmp_path):
    folder = tmp_path / "killed"
    for rows, argv in ((2, [*TINY_RUN, "--out", str(folder)]), (6, ["--resume", str(folder), "--trace"])):
        process = start("--no-figures", *argv)
        wait_for_rows(process, folder, rows)
        process.kill()
        assert process.wait() == -signal.SIGKILL and rows <= len(metrics(folder)) < len(metrics(finished))
        process.stderr.close()
    assert main(["--resume", str(folder), "--trace", "--no-figures"]) == 0
    assert outcome(folder) == outcome(finished) and not FIGURES & {p.name for p in folder.iterdir()}


def killed_at(write: int, argv: list[str]) -> None:
    """Run until this file is to be replaced by its new version, and no further."""
    replaced = itertools.count(1)

    def crash(old, new, inner=os.replace):
        if next(replaced) == write:
            raise SystemExit("killed")
        inner(old, new)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(rbexplore.os, "replace", crash)
        main(argv)


@pytest.mark.parametrize("write", range(9, 11))
def test_killed_between_two_writes_and_resumed_equals_uninterrupted(finished, tmp_path, write):
    folder = str(tmp_path / "run")
    killed_at(write, [*TINY_RUN, "--no-figures", "--out", folder])
    assert main(["--resume", folder, "--trace", "--no-figures"]) == 0
    assert outcome(tmp_path / "run") == outcome(finished)


@pytest.mark.parametrize("write", [1, 2, 3])
def test_a_run_killed_while_it_is_made_leaves_a_folder_that_can_be_used(tmp_path, write):
    line = ["--method", "random", "--steps", "2000", "--no-figures", "--out", str(tmp_path / "run")]
    killed_at(write, line)
    assert main(line) == 0


def test_ctrl_c_exits_with_130_leaves_figures_and_can_be_resumed(finished, tmp_path):
    code = """if True:
        import os, signal, sys, rbexplore
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job inherits that it is ignored
        train = rbexplore.RbExplore.train_novelty
        def interrupted(self, trajectories):  # so that the signal comes in iteration 6 however busy the machine is
            if self.iteration == 6:
                os.kill(os.getpid(), signal.SIGINT)
            train(self, trajectories)
        rbexplore.RbExplore.train_novelty = interrupted
        sys.exit(rbexplore.main(sys.argv[1:]))"""
    done = subprocess.run([sys.executable, "-c", code, *TINY_RUN, "--out", str(tmp_path / "run")], cwd=HERE, capture_output=True)
    assert done.returncode == 130 and done.stderr == b""
    check_figures(tmp_path / "run")
    assert len(metrics(tmp_path / "run")) == 5 < len(metrics(finished))
    assert main(["--resume", str(tmp_path / "run"), "--trace", "--no-figures"]) == 0
    assert outcome(tmp_path / "run") == outcome(finished)


def test_ctrl_c_before_the_first_iteration_ends(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt
    monkeypatch.setattr(RbExplore, "train_novelty", interrupt)
    assert main([*TINY_RUN, "--out", str(tmp_path)]) == 130 and not metrics(tmp_path)
    check_figures(tmp_path)


def test_workers_change_nothing(finished, tmp_path, capsys):
    assert main([*TINY_RUN, "--out", str(tmp_path / "two"), "--workers", "2", "--no-figures"]) == 0
    assert outcome(tmp_path / "two") == outcome(finished)
    out = capsys.readouterr().out
    assert "2 worker(s)" in out and "\r" not in out


def test_the_profile_adds_up_and_changes_nothing(finished, tmp_path, capsys):
    assert main([*TINY_RUN, "--out", str(tmp_path / "run"), "--no-figures", "--profile"]) == 0
    assert outcome(tmp_path / "run") == outcome(finished)
    table = [line.split() for line in capsys.readouterr().out.splitlines()]
    steps = [list(map(float, row[-5:-1])) for row in table if row and row[-1].endswith("%")][-6:]
    (whole,) = [list(map(float, row[1:])) for row in table if row and row[0] == "all"]
    assert np.allclose(np.sum(steps, 0), whole, atol=0.1) and np.allclose([sum(row[:3]) for row in [*steps, whole]],
                                                                          [row[3] for row in [*steps, whole]], atol=0.05)
    assert steps[0][0] > 0 and steps[2][1] > steps[2][0] == 0  # step 1 is the environment's time, step 3 the networks'


def check_refused(capsys, tmp_path, argv, said):
    """Exit code 2, one line on stderr that says what is wrong, and no file made or changed."""
    before = {p: p.is_file() and p.read_bytes() for p in tmp_path.rglob("*")}
    capsys.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        patch.delattr(RbExplore, "run")  # an accepted input fails at once
        assert main(argv) == 2
    err = capsys.readouterr().err
    assert re.search(said, err) and err.count("\n") == 1 and err.startswith("rbexplore: ")
    assert before == {p: p.is_file() and p.read_bytes() for p in tmp_path.rglob("*")}


@pytest.mark.parametrize("argv, said", [
    ("--env mars", "unknown environment 'mars'"), ("--level 4", "unknown maze level 4"), ("--mars 1", "unrecognized.*--mars"),
    ("--n 30", "n is 30 and N is 25"), ("--theta-sim 1.5", "theta_sim is 1.5.*from 0 to 1"), ("--theta-merge -1", "theta_merge"),
    ("--M 0", "M is 0.*1 to 1,000,000"), ("--additional-steps 25", "additional_steps is 25.*least 26"), ("--L x", "--L: invalid"),
    ("--trajectory-steps 25", "at least 26"), ("--beta nan", "beta is nan"), ("--r-batch 1", "r_batch"), ("--M 2.5", "--M: inv"),
    ("--steps 5", "pretrain_steps is 8000"), ("--encoder big", "choose resnet18 or small"), ("--config big", "invalid choice"),
    ("--device cuda:99", "device cuda:99 cannot be used"), ("--device mars", "device mars"),
    ("--threads 0", "threads is 0"), ("--threads 100000000000", "threads is"), ("--workers 0", "workers is 0"),
    ("--device hpu", "device hpu"), (f"--M {10**30}", "M is"), ("--r-learning-rate 1e99", "r_learning_rate is"),
    ("--resume=", "--resume is empty"), ("--verify=", "--verify is empty"), ("--env=", "--env is empty"),
    ("--seeds 3", "with --experiment"), ("--experiment methods --seeds 0", "seeds is 0"),
    ("--experiment methods --method random", "leave --method out"), ("--experiment ablation --rom x", "no option 'rom'"),
    ("--verify run --export-demos run/config.json", "ends in .npz"),
    ("--frame-size 8", "frame_size is 8"), ("--rom x", "maze has no option 'rom'"),
    ("--env pop", "--rom"), ("--env pop --rom {tmp}/none.nes", "cannot read"), ("--env pop --rom {tmp}/bad.nes", "iNES"),
    ("--threads -1", "threads is -1"), ("--env montezuma --level 2", "no option"), ("--resume {tmp}/none", "cannot be read"),
    ("--resume {tmp}/broken", "cannot be read"), ("--resume", "expected one argument"),
    ("--config maze --rnd-encoder nature", "too small for the network"),
])
def test_bad_input_is_one_line_and_nothing_is_made(argv, said, tmp_path, capsys):
    (tmp_path / "bad.nes").write_bytes(b"no cartridge")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "config.json").write_text('{"config": ')
    argv = argv.format(tmp=tmp_path).split()
    check_refused(capsys, tmp_path, argv + ([] if "--resume" in argv else ["--out", str(tmp_path / "out")]), said)


@pytest.mark.parametrize("old, new", [
    ('"workers": 1', '"workers": "2"'), ('"workers": 1', '"workers": null'), ('"threads": 1', '"threads": 0'),
    ("{", "[" * 10**5)])
def test_a_config_that_was_damaged_is_one_line(finished, tmp_path, capsys, old, new):
    folder = shutil.copytree(finished, tmp_path / "run")
    text = (folder / "config.json").read_text()
    assert old in text
    (folder / "config.json").write_text(text.replace(old, new, 1))
    check_refused(capsys, tmp_path, ["--resume", str(folder)], "cannot be read")


@pytest.mark.parametrize("cut", [lambda whole: whole[:50], lambda whole: None])
def test_a_trace_that_was_cut_is_not_filled_up(finished, tmp_path, capsys, cut):
    folder = shutil.copytree(finished, tmp_path / "run")
    left = cut((folder / "trace.jsonl").read_bytes())
    (folder / "trace.jsonl").write_bytes(left) if left else (folder / "trace.jsonl").unlink()
    check_refused(capsys, tmp_path, ["--resume", str(folder), "--trace"], "missing or cut short")


def test_a_graph_that_breaks_its_invariants_is_a_damaged_checkpoint(finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "run")
    state = torch.load(folder / "checkpoint.pt", weights_only=True)
    state["algorithm"]["graph"][1] += 1  # one state more than the clusters were visited by
    torch.save(state, folder / "checkpoint.pt")
    check_refused(capsys, tmp_path, ["--resume", str(folder)], "missing or damaged")


@pytest.mark.parametrize("argv", [[], ["--trace"]])
def test_a_trace_of_something_else_is_kept(tmp_path, capsys, argv):
    line = ["--method", "random", "--steps", "200", "--no-figures", "--out", str(tmp_path), *argv]
    (tmp_path / "trace.jsonl").write_text("somebody's own\n")
    check_refused(capsys, tmp_path, line, "holds a run already")
    (tmp_path / "trace.jsonl").write_text("")  # of a run killed before its config.json
    assert main(line) == 0
    lines = (tmp_path / "trace.jsonl").read_text().splitlines()
    assert [json.loads(line)["event"] for line in lines] == ["iteration"] * len(argv)


def test_a_full_disk_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    def full(number):
        raise OSError(28, "No space left on device")
    rbexplore.write_atomically(tmp_path / "file", lambda f: f.write(b"old"))
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        rbexplore.write_atomically(tmp_path / "file", lambda f: torch.save(torch.zeros(9), f))
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]


def test_a_run_is_not_overwritten_nor_resumed_as_another(finished, tmp_path, capsys):
    for name in ("config.json", "metrics.csv", "checkpoint.pt", "trace.jsonl"):
        (tmp_path / name).write_bytes((finished / name).read_bytes())
    whole, here = (tmp_path / "checkpoint.pt").read_bytes(), str(tmp_path)
    check_refused(capsys, tmp_path, [*TINY_RUN, "--out", here], "holds a run already")
    for other in ("--seed 1", "--env pop", "--threads 2", "--M 5", "--no-merge", "--device cuda"):
        check_refused(capsys, tmp_path, ["--resume", here, *other.split()], "keeps its options")
    for damaged in (whole[: len(whole) // 2], b"", None):
        (tmp_path / "checkpoint.pt").write_bytes(damaged) if damaged is not None else (tmp_path / "checkpoint.pt").unlink()
        check_refused(capsys, tmp_path, ["--resume", here], "missing or damaged")
    (tmp_path / "checkpoint.pt").write_bytes(whole)
    text = (tmp_path / "config.json").read_text()
    changes = ('"beta": 1.0', '"beta": 2.0'), ('"options": {', '"options": {"level": 2,'), ('"gamma": 0.99', '"gamma": 0.9')
    for old, new in changes:
        assert old in text
        (tmp_path / "config.json").write_text(text.replace(old, new))
        check_refused(capsys, tmp_path, ["--resume", here], "another configuration")
    (tmp_path / "config.json").write_text(text.replace('"beta"', '"alpha"'))
    check_refused(capsys, tmp_path, ["--resume", here], "does not fit this version")
    (tmp_path / "file").write_text("")
    check_refused(capsys, tmp_path, [*TINY_RUN, "--out", str(tmp_path / "file" / "run")], "cannot be written")


@pytest.mark.parametrize("other", ["--level 2", "--config paper", "--out elsewhere"])
def test_resume_refuses_what_it_would_not_follow(finished, tmp_path, capsys, other):
    check_refused(capsys, tmp_path, ["--resume", str(finished), "--no-figures", *other.split()], "keeps its options")


@pytest.mark.parametrize("what", ["R", "RND"])
def test_a_loss_that_is_not_finite_stops_the_run_and_keeps_the_checkpoint(what, tmp_path, monkeypatch, capsys):
    calls, inner = itertools.count(), rbexplore.descend
    stop = 60 if what == "R" else 12

    def spoil(optimiser, loss, name, *clip):
        return inner(optimiser, loss * float("nan") if name == what and next(calls) == stop else loss, name, *clip)
    monkeypatch.setattr(rbexplore, "descend", spoil)
    assert main([*TINY_RUN, "--out", str(tmp_path), "--no-figures"]) == 2
    err, rows = capsys.readouterr().err, metrics(tmp_path)
    assert err == f"rbexplore: the loss of {what} is nan: start again with a lower learning rate\n" and rows
    assert len(torch.load(tmp_path / "checkpoint.pt", weights_only=True)["rows"]) == len(rows)


def test_a_learning_rate_without_bounds_stops_the_run(tmp_path, capsys):
    assert main([*TINY_RUN, "--out", str(tmp_path), "--no-figures", "--r-learning-rate", "1e9"]) == 2
    assert re.fullmatch("rbexplore: the loss of R is (nan|inf): .*\n", capsys.readouterr().err)
    assert torch.load(tmp_path / "checkpoint.pt", weights_only=True)["rows"] == []


def test_a_configuration_refuses_wrong_types_and_choices():
    for wrong, said in (({"M": True}, "type int"), ({"rnd_encoder": "big"}, "choose nature or small")):
        with pytest.raises(InputError, match=said):
            replace(MAZE, **wrong)


def test_what_the_command_line_makes_of_ppo_and_of_paths():
    for base in ("maze", "paper"):
        assert settings("--method", "rnd", "--config", base)["ppo"] == asdict(PPO_CONFIGS[base])
    assert settings("--gamma", "0.9", "--episodic")["ppo"] == asdict(replace(PPO_CONFIGS["maze"], gamma=0.9, episodic=True))
    assert settings("--env", "pop", "--rom", "x", "--state", "y")["options"] == {
        "rom": os.path.abspath("x"), "state": os.path.abspath("y"), "frame_size": 96}


@pytest.mark.parametrize("argv, said", [
    ("--resume {0} --no-figures --gamma 0.9", "keeps its options"), ("--resume {0} --verify {0}", "exclude each other"),
    ("--export-demos x.npz", "goes with"), ("--verify {0} --export-demos {1}/none/x.npz", "cannot be written"),
    ("--method cells --profile --no-figures --out {1}/run", "--profile is for"),
    ("--workers 2 --profile --no-figures --out {1}/run", "--profile is for"),
    ("--experiment ablation --trace --out {1}/run", "single run"),
    ("--experiment ablation --profile --out {1}/run", "single run")])
def test_options_that_do_not_go_together(finished, tmp_path, capsys, argv, said):
    check_refused(capsys, tmp_path, argv.format(finished, tmp_path).split(), said)


def test_a_resumed_run_may_have_other_workers_and_a_verified_one_another_device(finished, tmp_path):
    line = parser().parse_args(["--resume", str(finished), "--workers", "2"])
    assert rbexplore.recorded_settings(str(finished), line)["workers"] == 2
    folder = shutil.copytree(finished, tmp_path / "run")
    text = (folder / "config.json").read_text().replace('"device": "cpu"', '"device": "cuda:7"')
    (folder / "config.json").write_text(text)
    assert main(["--verify", str(folder), "--device", "cpu"]) == 0


def test_a_trace_goes_on_at_a_resume_that_does_not_ask_for_it(tmp_path):
    inner = RbExplore.train_novelty

    def interrupted(self, trajectories):
        if self.iteration == 2:
            raise KeyboardInterrupt
        inner(self, trajectories)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RbExplore, "train_novelty", interrupted)
        assert main(["--method", "cells", "--trace", "--no-figures", "--steps", "9000", "--out", str(tmp_path / "c")]) == 130
    assert main(["--resume", str(tmp_path / "c"), "--no-figures"]) == 0
    events = [json.loads(line) for line in (tmp_path / "c" / "trace.jsonl").read_text().splitlines()]
    assert [e["iteration"] for e in events if e["event"] == "iteration"] == list(range(1, len(metrics(tmp_path / "c")) + 1))


def test_seconds_are_those_of_an_iteration(tmp_path):
    began = time.monotonic()
    assert main([*TINY_RUN, "--no-figures", "--steps", "2000", "--out", str(tmp_path)]) == 0
    seconds = [float(row[-1]) for row in metrics(tmp_path, leave=())]
    assert len(seconds) > 4 and 0 < sum(seconds) < time.monotonic() - began + 0.1


def test_a_warning_names_its_cause(tmp_path, capsys):
    run = rbexplore.Run(tmp_path, settings(), explorer(env_fn=MAZE_FN)[0])
    for low, what in (("r_true_positive", "new"), ("r_true_negative", "known")):
        row = {"iteration": 1, "phase": "explore", "steps": 9, "coverage": 0.1, "units": 3, "seconds": 1.0,
               "r_true_positive": 0.9, "r_true_negative": 0.9} | {low: 0.1}
        run.rows = [row]
        run.show(row)
        out = capsys.readouterr().out
        assert out.count("warning") == 1 and f"every state {what}" in out


def test_ranges_of_the_configuration():
    assert replace(MAZE, beta=2).beta == 2
    for wrong in ({"seed": -1}, {"n": 0}, {"novelty_window": 0}, {"seed": 2**63 + 1}, {"replay_iterations": -1}):
        with pytest.raises(InputError):
            replace(MAZE, **wrong)


def test_what_serves_a_learned_R_alone_is_not_asked_of_cells():
    assert settings("--method", "cells", "--pretrain-steps", "500", "--L", "3")["config"]["pretrain_steps"] == 0


@pytest.mark.parametrize("error, said", [
    (rbexplore.BrokenProcessPool(), "a worker process died"),
    (OSError(28, "No space left on device"), "a file cannot be written: No space"), (MemoryError(), "out of memory")])
def test_a_dead_worker_and_a_full_disk_are_one_line(tmp_path, monkeypatch, capsys, error, said):
    def fail(self):
        raise error
    monkeypatch.setattr(RbExplore, "run", fail)
    assert main(["--no-figures", "--out", str(tmp_path / "run")]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1


def test_a_resumed_run_keeps_its_method_and_threads(finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "run")
    check_refused(capsys, tmp_path, ["--resume", str(folder), "--no-figures", "--method", "rnd"], "keeps its options")
    text = (folder / "config.json").read_text()
    assert '"threads": 1' in text
    (folder / "config.json").write_text(text.replace('"threads": 1', '"threads": 2'))
    check_refused(capsys, tmp_path, ["--resume", str(folder), "--no-figures"], "another configuration")


def test_the_time_left_is_that_of_the_last_five_iterations(tmp_path, capsys):
    run = rbexplore.Run(tmp_path, {"config": {"steps": 2000}}, explorer()[0])
    row = {"phase": "explore", "coverage": None, "units": 1}
    run.rows = [row | {"iteration": k, "steps": 100 * k, "seconds": 10.0} for k in range(1, 11)]
    run.show(run.rows[-1])
    assert capsys.readouterr().out.split()[-1] == "1:40"  # 1,000 steps at 10 a second


def test_no_warning_in_pretraining(tmp_path, capsys):
    run = rbexplore.Run(tmp_path, {"config": {"steps": 2000}}, explorer()[0])
    for phase in ("pretrain", "explore"):
        run.rows = [{"iteration": 1, "steps": 9, "seconds": 1.0, "phase": phase, "coverage": 0.1, "r_true_positive": 0.1}]
        run.show(run.rows[0])
        assert ("warning" in capsys.readouterr().out) == (phase == "explore")


def test_a_resume_writes_the_metrics_of_its_checkpoint(tmp_path):
    line = ["--method", "random", "--steps", "6000", "--no-figures", "--out", str(tmp_path / "run")]
    killed_at(9, line)  # between checkpoint.pt and metrics.csv of the last iteration
    assert len(metrics(tmp_path / "run")) == 2
    assert main(["--resume", str(tmp_path / "run"), "--no-figures"]) == 0
    assert len(metrics(tmp_path / "run")) == 3


def test_a_map_colours_the_units_visited():
    drawing = (np.zeros((20, 40, 3), np.uint8), {(0,): (0, 0, 10, 10), (1,): (30, 10, 10, 10)}, [])
    axes = rbexplore.maps_figure(drawing, {"title": {(1,): 7}}, 9).axes[0]
    heat = np.ma.filled(axes.images[1].get_array(), np.nan)
    assert (heat[10:20, 30:40] == 7).all() and np.isnan(heat).sum() == 20 * 40 - 100
    assert [list(line.get_xdata()) for line in axes.lines] == [[0, 10]]


@pytest.mark.parametrize("after, centre", [(b"", (6, 6)), (b"\2", (6, 5))])
def test_verify_knows_that_an_episode_ended(after, centre):
    a, _ = explorer()
    picture, root = a.env.restore(bytes(centre)), a.graph.clusters[0].path
    actions = b"\1" * 6 + b"\3" * 6 + after  # into the corner that kills, and on
    a.graph.clusters[1] = rbexplore.Cluster(picture, bytes(centre), rbexplore.Path(root, picture[None], (actions,)), 0)
    assert not rbexplore.verify(a)[1]


def test_threads_are_those_asked_for():
    before = torch.get_num_threads()
    try:
        rbexplore.prepare(settings("--threads", "2"))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_algorithms_are_deterministic():
    torch.use_deterministic_algorithms(False)
    rbexplore.prepare(settings())
    assert torch.are_deterministic_algorithms_enabled()


def test_the_summary_tells_per_cent(tmp_path):
    run = rbexplore.Run(tmp_path, settings(), make_method("random", MAZE_FN, BRIEF).run())
    share = 100 * len(run.algorithm.discovered) / 187
    assert f"{len(run.algorithm.discovered)} of 187 tiles ({share:.1f} %)" in rbexplore.summary(run, [], 1.0, False)


def test_rooms_without_a_drawing():
    picture, boxes, labels = rbexplore.rooms_map({(3, 4, 7), (3, 6, 7), (5, 4, 8)})
    assert len({box[:2] for box in boxes.values()}) == 3 and len(labels) == 2
    (a, b), side = (boxes[3, 4, 7], boxes[3, 6, 7]), 12
    assert (b[0] - a[0], b[1] - a[1]) == (2 * side, 0)
    assert all(x >= 0 and x + w <= picture.shape[1] and y >= 0 and y + h <= picture.shape[0] for x, y, w, h in boxes.values())


# ----------------------------------------------------------------------------------------------------------- the maze


@pytest.mark.parametrize("size", [32, 96])
def test_S5_01_S5_02_the_maze_is_a_gymnasium_environment_of_seven_actions(size):
    env = gymnasium.make("RbExploreMaze-v0", frame_size=size, render_mode="rgb_array").unwrapped
    check_env(env)
    frame = env.reset()[0]
    assert frame.shape == (size, size) and frame.dtype == np.uint8 and env.action_space == gymnasium.spaces.Discrete(7)
    assert env.render().shape == (360, 360, 3) and len(env.snapshot()) == 6
    assert rbexplore.SimilarityModel(MAZE, frame.shape).encoder[0].in_channels == 1  # grayscale: one channel


def test_S5_03_reachable_is_every_unit_that_steps_can_reach():
    env = MAZE_FN()
    env.reset()
    states, todo, units = set(), [env.snapshot()], {env.unit()}
    while todo:
        snapshot = todo.pop()
        for action in range(7):
            env.restore(snapshot)
            dead = env.step(action)[2]
            if not dead and env.snapshot() not in states:
                units.add(env.unit())
                states.add(env.snapshot())
                todo.append(env.snapshot())
    assert units == env.reachable() and env.full_coverage == len(units) == len(env.level_map()[1])


@pytest.mark.parametrize("level", LEVELS)
def test_on_each_level_a_walk_from_the_start_covers_less_than_a_quarter(level):
    env = Maze(level)
    snapshot, rng, units = env.snapshot(), np.random.default_rng(0), set()
    for _ in range(MAZE.steps // MAZE.trajectory_steps):
        units |= set(rbexplore.walk(env, snapshot, [int(rng.integers(2**31))], MAZE.trajectory_steps, False).units)
    assert len(units - {None}) < 0.25 * env.full_coverage and units - {None} <= env.reachable()


@pytest.mark.parametrize("level", LEVELS)
def test_the_levels_keep_the_rules_of_levels(level):
    lines = Maze(level).tiles
    tiles = {(x, y): tile for y, line in enumerate(lines) for x, tile in enumerate(line)}
    assert {len(line) % 10 for line in lines} == {len(lines) % 3} == {0} and len({len(line) for line in lines}) == 1
    assert Counter(tiles.values())["@"] == 1 and {t for t in tiles.values() if not t.isalpha()} == set("#_@.^")
    rooms = {t: {(x // 10, y // 3) for (x, y), other in tiles.items() if other == t} for t in tiles.values() if t.isalpha()}
    assert set(rooms) == {t.swapcase() for t in rooms}, "a plate for each gate, a gate for each plate"
    for plate in filter(str.islower, rooms):
        for (i, j), (k, m) in itertools.product(rooms[plate], rooms[plate.upper()]):
            assert max(abs(i - k), abs(j - m)) == 1, "a gate is in a room beside its plate's"
    for (x, y), tile in tiles.items():
        assert tile != "." or tiles[x, y + 1] in "_@.^" or tiles[x, y + 1].islower(), "there is ground under each opening"


@pytest.mark.parametrize("level, size", [(1, (187, 1344, 86)), (2, (258, 7172, 127)), (3, (358, 42580, 175))])
def test_the_size_of_each_level(level, size):
    """Units, states and the longest way from the start: a rule changed anywhere changes one of them."""
    env = Maze(level)
    steps = env.distances(env.snapshot())
    assert (env.full_coverage, len(steps), max(steps.values())) == size


def test_a_deep_fall_kills_unless_the_agent_lets_itself_down(monkeypatch):
    monkeypatch.setitem(LEVELS, 4, "    @.________\n    #.########\n    #_########")
    env = Maze(4)
    env.reset()
    assert env.step(2)[2] and env.unit() is None
    env.reset()
    assert not env.step(4)[2] and env.unit() == (0, 1, 2)
    deaths = {tuple(snapshot[1:3]) for snapshot in Maze(3).distances(Maze(3).snapshot()) if snapshot[-1]}
    assert {(x, y) for x, y in deaths if Maze(3).tiles[y][x] != "^"} == {(6, 11)}, "level 3 has such a fall"


def test_a_maze_can_be_copied_to_another_process():
    env = Maze()
    env.restore(bytes((1, 15, 5, 1, 1, 0)))
    assert pickle.loads(pickle.dumps(env)).step(5)[0].tobytes() == env.step(5)[0].tobytes()


def test_dead_agents_stand_nowhere_and_gates_show_their_state():
    env = Maze()
    for snapshot in env.distances(env.snapshot()):
        env.restore(snapshot)
        assert (env.unit() is None) == bool(snapshot[-1])
    for k, (x, y) in enumerate(((15, 5), (7, 2), (25, 4))):  # in the rooms of the gates A, B and C
        closed, opened = (env.restore(bytes((1, x, y, 1, plates, 0))) for plates in (0, 1 << k))
        assert not np.array_equal(closed, opened)


def test_the_maze_refuses_what_it_cannot_do():
    env = Maze()
    level, x, y, *_ = env.snapshot()
    wrong = (0, 0, 1, 0, 0), (x, y, 2, 0, 0), (x, y, 1, 8, 0), (x, y, 1, 0, 2)  # in a wall; facing, plates, dead out of range
    for bad in (b"", b"\1", None, bytes(6), Maze(2).snapshot(), *(bytes((level, *state)) for state in wrong)):
        with pytest.raises(InputError, match="snapshot"):
            env.restore(bad)
    for options in ({"level": 9}, {"frame_size": 31}, {"frame_size": 32.0}, {"render_mode": "human"}, {"speed": 1}):
        with pytest.raises(InputError):
            MAZE_FN(**options)
    with pytest.raises(InputError, match="actions 0 to 6"):
        env.step(7)
    env.restore(next(s for s in env.distances(env.snapshot()) if s[-1]))  # a state of death
    with pytest.raises(InputError, match="dead"):
        env.step(0)


def test_nothing_moves_where_there_is_no_edge_and_nothing_to_climb_to(monkeypatch):
    monkeypatch.setitem(LEVELS, 4, "    #..#######\n    #@_#######\n    ##########")
    for env, action in ((Maze(), envs.DOWN), (Maze(4), envs.UP)):
        before = env.snapshot()
        env.step(action)
        assert env.snapshot() == before


@pytest.mark.parametrize("level", LEVELS)
def test_the_level_map_has_rooms_and_boxes_in_their_places(level):
    env = Maze(level)
    (picture, boxes), across = env.level_map(), len(env.tiles[0]) // 10
    for (room, column, row), (x, y, w, h) in boxes.items():
        assert (x // 8, y // 24, w, h) == (room % across * 10 + column, room // across * 3 + row, 8, 24)
    for y, line in enumerate(env.tiles):
        for x, tile in enumerate(line):
            assert (tuple(picture[24 * y + 23, 8 * x]) == envs.STONE) == (tile == "#"), (x, y)


def test_frames_show_plates_spikes_and_the_dead_and_rooms_look_different():
    env, bare = Maze(), Maze()
    for k, plate in enumerate(env.letters):
        ((x, y),) = [(x, y) for y, line in enumerate(env.tiles) for x, tile in enumerate(line) if tile == plate]
        beside = next(x + d for d in (1, -1) if env.tiles[y][x + d] in "_@" and (x + d) // 10 == x // 10)
        up, sunk = (env.restore(bytes((1, beside, y, 1, plates, 0))) for plates in (0, 1 << k))
        assert not np.array_equal(up, sunk), plate
    dead = next(s for s in env.distances(env.snapshot()) if s[-1])
    assert not np.array_equal(env.restore(dead), env.restore(dead[:-1] + b"\0"))
    y, x = next((y, line.index("^")) for y, line in enumerate(env.tiles) if "^" in line)
    bare.tiles, room = [line.replace("^", "_") for line in env.tiles], y // 3 * env.across + x // 10
    assert not np.array_equal(env._paint_room(room, 0, 8, 24), bare._paint_room(room, 0, 8, 24))
    bare.tiles = ["".join("#" if k % 10 in (0, 9) else "_" for k in range(30))] * 9
    assert len({bare._paint_room(k, 0, 8, 24).tobytes() for k in range(9)}) == 9


def test_the_contract_asks_for_close_for_pictures_and_for_the_frame_restored():
    shut, flat, same = Grid(), Grid(), Reusing()
    shut.close = None
    flat.observation_space, flat.frame = spaces.Box(0, 255, (8,), np.uint8), lambda: np.zeros(8, np.uint8)
    same.restore = lambda snapshot: Reusing.restore(same, bytes((3, 3)))
    for env, said in ((shut, r"lacks close\(\)"), (flat, r"\(H, W\)"), (same, "same frame")):
        with pytest.raises(InputError, match=said):
            envs.check_contract(env)


@pytest.mark.parametrize("restore", [
    lambda env, snapshot: env.frame(),  # goes nowhere
    lambda env, snapshot: Grid.restore(env, bytes(max(x - 1, 0) for x in snapshot))])  # wrong but for the start
def test_a_restore_that_does_not_restore_ends_the_run(restore):
    a, _ = explorer()
    a.env.restore = functools.partial(restore, a.env)
    with pytest.raises(InputError, match=r"restore\(\) did not give"):
        a.run()


def test_frames_of_steps_are_uint8_too():
    a, _ = explorer()
    step = a.env.step
    a.env.step = lambda action: (lambda frame, *rest: (frame / 255, *rest))(*step(action))
    with pytest.raises(InputError, match="not uint8"):
        a.iterate()


@pytest.mark.parametrize("unit", [{1, 2}, {"x": 1}, ((1, 2), 3)])
@pytest.mark.parametrize("method", ["rbexplore", "random"])
def test_a_unit_that_cannot_be_counted_is_refused_at_the_start(unit, method):
    class Odd(Grid):
        def unit(self):
            return unit
    with pytest.raises(InputError, match=r"unit\(\) gives"):
        make_method(method, Odd, QUICK)


def test_distances_begin_at_the_snapshot():
    env = Maze()
    env.step(2), env.step(2)
    snapshot = env.snapshot()
    assert snapshot != bytes((env.level, *env.start)) and env.distances(snapshot)[snapshot] == 0


def test_a_maze_takes_whole_levels_and_whole_snapshots_and_renders_where_asked():
    for level in (1.0, [1]):
        with pytest.raises(InputError, match="unknown maze level"):
            Maze(level)
    env = Maze()
    with pytest.raises(InputError, match="no snapshot"):
        env.restore(env.snapshot() + b"\0")
    assert env.render() is None and Maze(render_mode="rgb_array").render().shape == (360, 360, 3)


def test_a_maze_keeps_few_frames():
    env = Maze()
    env._seen |= dict.fromkeys(range(4095))
    for snapshot in env.distances(env.snapshot()):
        env.restore(snapshot)
    assert len(env._seen) <= 4096


def test_luminance_of_the_maze():
    env = Maze(frame_size=96)
    frame, slow = env.reset()[0], np.floor(env._picture(9, 32).astype(int) @ np.array([77, 150, 29]) / 256)
    assert np.array_equal(frame[:, 3:93], slow) and not frame[:, :3].any() and not frame[:, 93:].any()


def test_frames_given_away_are_the_users_own():
    env = Maze()
    frame = env.reset()[0]
    frame[:] = 0
    assert env.reset()[0].any() and env.restore(env.snapshot()).any()


def test_frames_show_which_way_the_agent_faces():
    env = Maze()
    right = env.reset()[0]
    left = env.step(envs.LEFT)[0]
    assert not np.array_equal(left, right)


def test_no_snapshot_in_mid_air():
    env = Maze()
    x, y = next((line.index("."), y) for y, line in enumerate(env.tiles) if "." in line)
    with pytest.raises(InputError, match="snapshot"):
        env.restore(bytes((1, x, y, 1, 0, 0)))


def test_an_open_gate_shows_less_than_a_closed_one():
    shut, opened = (Maze(frame_size=96)._paint_room(4, plates, 9, 32) for plates in (0, 1))
    assert (shut == envs.STEEL).all(2).sum() - (opened == envs.STEEL).all(2).sum() > 50


# ------------------------------------------- the emulators, on a stand-in cartridge whose program runs in the real emulator

# The suffix of an operation is its addressing: # immediate, z zero page, x indexed by X.
OPCODES = dict(re.findall(r"(\S+) (\d+)", """
    adc# 105  and# 41  bcc 144  bcs 176  beq 240  bit 44  bne 208  bpl 16  clc 24  cmp# 201  dec 206
    decz 198  dex 202  dey 136  inc 238  incz 230  inx 232  jmp 76  lda 173  lda# 169  ldax 189  ldaz 165
    ldx# 162  ldxz 166  ldy# 160  lsr 74  rolz 38  sbc# 233  sec 56  sei 120  sta 141  stax 157  staz 133
    txa 138"""))
# RAM 0 counts frames, 1 is the pad, 2 counts black frames; 512 + frame keeps the pad, 768 + frame the clock.
# Right of x = 332 is the next room, after 6 black frames. A below y = 160 hurts; B takes the sword, and above
# y = 64 the exit. The picture is noise, scrolled by x and y, in the room's colour.
PROGRAM = """
    sei | ldx# 0 | txa
  clear: stax 0 | stax 1024 | stax 1536 | inx | bne clear
  warm1: bit 8194 | bpl warm1
  warm2: bit 8194 | bpl warm2
    sta 8198 | sta 8198 | ldx# 16
  empty: sta 8199 | dex | bne empty
    lda# 32 | sta 8198 | lda# 0 | sta 8198 | ldx# 0 | ldy# 4
  noise: ldax 49152 | and# 1 | sta 8199 | inx | bne noise | dey | bne noise
    lda# 3 | sta 1743 | lda# 64 | sta 1243 | lda# 128 | sta 1777 | lda# 14 | sta 1246
    lda# 53 | sta 1221 | lda# 57 | sta 1222
  frame: bit 8194 | bpl frame
    lda# 63 | sta 8198 | lda# 0 | sta 8198 | ldaz 2 | beq lit
    decz 2 | lda# 15 | sta 8199 | lda# 0 | jmp drawn
  lit: lda 1246 | and# 7 | clc | adc# 1 | sta 8199 | lda# 48 | sta 8199 | sta 8199 | sta 8199 | lda# 10
  drawn: sta 8193 | lda# 0 | sta 8192 | lda 1243 | sta 8197 | lda 1777 | sta 8197
    lda# 1 | sta 16406 | lda# 0 | sta 16406 | ldx# 8
  pad: lda 16406 | lsr | rolz 1 | dex | bne pad
    ldxz 0 | ldaz 1 | stax 512 | lda 1222 | stax 768 | incz 0 | dec 1222 | ldaz 1 | and# 1 | beq left
    lda 1243 | clc | adc# 4 | sta 1243 | lda 1244 | adc# 0 | sta 1244 | cmp# 1 | bne left
    lda 1243 | cmp# 77 | bcc left | lda# 0 | sta 1243 | sta 1244 | inc 1246 | lda# 6 | staz 2
  left: ldaz 1 | and# 2 | beq down | lda 1243 | sec | sbc# 4 | sta 1243 | lda 1244 | sbc# 0 | sta 1244
  down: ldaz 1 | and# 4 | beq up | lda 1777 | clc | adc# 4 | sta 1777
  up: ldaz 1 | and# 8 | beq slow | lda 1777 | sec | sbc# 4 | sta 1777
  slow: ldaz 0 | and# 3 | bne end | ldaz 1 | and# 128 | beq b | lda 1777 | cmp# 160 | bcc b | dec 1743
  b: ldaz 1 | and# 64 | beq end | lda# 1 | sta 1774 | lda 1777 | cmp# 64 | bcs end | incz 112
  end: jmp frame
"""
PADS = [0, 2, 1, 8, 4, 128, 64]  # no-op, left, right, up, down, A, B as the console's pad reports them


def assemble(program: str, origin: int = 49152) -> bytes:
    """Two passes: the first finds the labels."""
    labels = {}
    for _ in range(2):
        code = b""
        for line in re.split(r"[|\n]", program.strip()):
            label, _, operation = line.rpartition(":")
            labels[label.strip()] = origin + len(code)
            name, *operand = operation.split()
            code += bytes([int(OPCODES[name])])
            for text in operand:
                value = int(text) if text.isdigit() else labels.get(text, origin)
                if re.fullmatch("b[^i].", name):  # branches are relative
                    code += bytes([value - origin - len(code) - 1 & 255])
                else:
                    code += value.to_bytes(1 if name[-1] in "#z" else 2, "little")
    return code


def cartridge(mark: int = 0) -> bytes:
    """128 KiB iNES image, mapper 2; `mark` fills the unused banks."""
    last = assemble(PROGRAM).ljust(16378, b"\0") + 3 * (49152).to_bytes(2, "little")
    return b"NES\x1a\x08\0\x20".ljust(16, b"\0") + bytes([mark]) * 7 * 16384 + last


@pytest.fixture
def rom(tmp_path):
    pytest.importorskip("stable_retro", reason="the cartridge's emulator, stable-retro, is not installed")
    (tmp_path / "game.nes").write_bytes(cartridge())
    return str(tmp_path / "game.nes")


@pytest.fixture
def prince(rom):
    env = PrinceOfPersia(rom)
    env.reset()
    yield env
    env.close()


@pytest.fixture
def montezuma():
    pytest.importorskip("ale_py", reason="Montezuma's emulator, ale-py, is not installed")
    return Montezuma()


def poke(env, address, value, kind="|u1"):
    env._data.memory.assign(address, kind, value)


def memory(env):
    return env._emulator.getRAM().tobytes() if isinstance(env, Montezuma) else b"".join(env._data.memory.blocks.values())


def tapes(env, count, length):
    """`count` random trajectories from random ends of earlier ones: [((snapshot, actions), what was seen)]."""
    rng, snapshots, made = np.random.default_rng(0), [env.snapshot()], []
    for _ in range(count):
        job = snapshots[rng.integers(len(snapshots))], rng.integers(env.action_space.n, size=length).tolist()
        made.append((job, play(env, *job, memory)))
        snapshots.append(env.snapshot())
    assert len({seen[-1][0] for _, seen in made}) > count / 4  # the frames tell states apart
    return made


def check_replay(env, make, count, length):
    jobs, seen = zip(*tapes(env, count, length), strict=True)
    assert all(play(env, *jobs[k], memory) == seen[k] for k in np.random.default_rng(1).permutation(count))
    assert elsewhere(play_elsewhere, make, jobs[-20:], memory) == list(seen[-20:])


def test_S3_2_01_the_cartridge_replays_bit_identically_here_and_in_another_process(prince, rom):
    check_replay(prince, functools.partial(PrinceOfPersia, rom), count=200, length=10)


def test_S3_2_01_montezuma_replays_bit_identically_here_and_in_another_process(montezuma, capfd):
    montezuma.reset()
    check_replay(montezuma, Montezuma, count=60, length=30)
    assert capfd.readouterr() == ("", "")  # no banner


def test_S3_2_02_a_rollback_costs_no_frame(prince):
    before, snapshot = memory(prince), prince.snapshot()
    assert memory(prince) == before
    prince.step(2)
    prince.restore(snapshot)
    assert memory(prince) == before and len(snapshot) < 4000


def test_S5_01_frames_are_96x96_gray_area_averages(prince):
    frame = prince.step(2)[0]
    assert frame.shape == (96, 96) and frame.dtype == np.uint8 and prince.observation_space.contains(frame)
    gray = np.rint(prince._emulator.get_screen() @ np.array([0.299, 0.587, 0.114]))  # (224, 240)
    rows = gray.repeat(96, axis=0).reshape(96, 224, 240).mean(axis=1)
    slow = rows.repeat(96, axis=1).reshape(96, 96, 240).mean(axis=2)
    assert np.abs(frame - np.floor(slow + 1e-9)).max() == 0


def test_S5_02_S6_1_01_one_step_is_four_frames_of_one_of_seven_pads_and_the_clock_is_held(prince):
    assert prince.action_space.n == len(PADS) and FRAMESKIP == 4
    for action in [*range(7), *reversed(range(7))]:
        start = memory(prince)[0]
        prince.step(action)
        ram, frames = memory(prince), [(start + i) % 256 for i in range(4)]
        assert (ram[0] - start) % 256 == 4
        assert [ram[512 + i] for i in frames] == [PADS[action]] * 4  # START is 16, SELECT 32
        assert ram[1221:1223] == b"99" and {ram[768 + i] for i in frames} == {ord("9")}


def test_S5_03_S5_04_units_are_32_pixels_of_a_room_within_the_full_coverage_set(prince):
    def unit(room, x, y):
        poke(prince, 1246, room), poke(prince, 1243, x, "<u2"), poke(prince, 1777, y)
        return prince.unit()
    assert unit(14, 64, 128) == unit(14, 95, 159) == (14, 2, 4)
    neighbours = (14, 64, 128), (14, 96, 128), (14, 63, 128), (14, 64, 160), (15, 64, 128)
    assert len({unit(*at) for at in neighbours}) == 5
    assert unit(0, 332, 192) == (0, 10, 6) and unit(0, 333, 192) is unit(0, 0, 31) is unit(0, 0, 224) is None
    unit(14, 4, 128)
    prince.step(1)
    assert prince._ram()["x"] == 65524 and prince.unit() is None  # left of the room
    units = {seen[-1] for _, trace in tapes(prince, 30, 10) for seen in trace} - {None}
    assert 1 < len(units) <= prince.full_coverage == 721 and sum(prince.FULL_COVERAGE) == 8116


def test_every_reading_of_ram(prince):
    for address, value in {112: 6, 1246: 23, 1243: 44, 1244: 1, 1777: 191, 1743: 5, 1774: 1}.items():
        poke(prince, address, value)
    assert prince._ram() == {"level": 7, "room": 23, "x": 300, "y": 160, "hit_points": 5, "sword": 1}
    info = prince.reset()[1]
    assert info == {"level": 1, "room": 14, "x": 64, "y": 128, "hit_points": 3, "sword": 0, "blank": False}


def test_S6_1_07_a_lost_hit_point_or_another_level_ends_the_episode(prince):
    assert not prince.step(5)[2]
    poke(prince, 1777, 200)
    before = prince.snapshot()
    assert prince.step(5)[2] and prince._ram()["hit_points"] == 2
    prince.restore(before)
    assert prince._ram()["hit_points"] == 3 and not prince.step(0)[2]
    poke(prince, 1743, 2)  # what counts is a drop within the step, not below the start
    assert not prince.step(0)[2]
    poke(prince, 1777, 40)
    assert prince.unit() is not None and prince.step(6)[2]
    assert prince._ram()["level"] == 2 and prince.unit() is None


def test_R24_black_transition_frames_are_marked(prince):
    poke(prince, 1243, 330, "<u2")
    (black, *_, first), (lit, *_, second) = prince.step(2), prince.step(0)
    assert (first["blank"], black.max(), first["room"]) == (True, 0, 15) and not second["blank"] and lit.any()


@pytest.mark.parametrize("level, room, x, y", [(1, 14, 77, 192), (2, 4, 123, 128), (3, 8, 164, 192)])
def test_S6_2_01_S6_2_02_start_states(prince, rom, tmp_path, level, room, x, y):
    for address, value in {112: level - 1, 1246: room, 1243: x, 1777: y, 1774: 1}.items():
        poke(prince, address, value)
    (tmp_path / "start").write_bytes(gzip.compress(prince._save()))
    frames = memory(prince)[0]
    poke(prince, 1743, 0)
    (tmp_path / "dead").write_bytes(gzip.compress(prince._save()))
    prince.close()
    env = PrinceOfPersia(rom, level, str(tmp_path / "start"))
    frame, info = env.reset()
    wanted = {"level": level, "room": room, "x": x, "y": y, "hit_points": 3, "sword": 1, "blank": False}
    assert info == wanted and memory(env)[0] == frames + 1 and env.full_coverage == (721, 723, 756)[level - 1]
    start = env._save(), frame.tobytes()
    tapes(env, 5, 10)
    assert (env.reset()[0].tobytes(), env._save()) == start[::-1]
    env.close()
    for wrong, name in (5, "start"), (level, "dead"):
        with pytest.raises(InputError, match=f"not in play on level {wrong}"):
            PrinceOfPersia(rom, wrong, str(tmp_path / name))


def test_the_whole_of_rbexplore_runs_on_the_cartridge(rom):
    config = replace(QUICK, steps=900, pretrain_steps=200)
    a, tape = explorer(config, functools.partial(make_env, "pop", rom=rom, frame_size=32))
    a.run()
    a.graph.check()
    for cluster in a.graph.clusters.values():
        a.env.reset()
        for action in cluster.path.replay():
            a.env.step(action)
        assert a.env.snapshot() == cluster.snapshot and np.array_equal(a.env.restore(cluster.snapshot), cluster.frame)
    assert 0 < tape.rows()[-1]["coverage"] == len(a.discovered) / 721 and a.steps == 900
    a.env.close()


@pytest.mark.parametrize("said, change", [
    ("--rom", {"rom": None}), ("No such file", {"rom": "nowhere.nes"}),
    ("iNES", {"rom": b"GAME" + cartridge()[4:]}), ("iNES", {"rom": cartridge()[:-1]}),
    ("1 to 14", {"level": 0}), ("1 to 14", {"level": 15}),
    ("No such file", {"state": "nowhere"}), ("gzip", {"state": b"no gzip"}),
    ("cannot read", {"state": gzip.compress(b"cut")[:9]}), ("no state", {"state": gzip.compress(b"rubbish")}),
    ("no state", {"state": gzip.compress(bytes(13339))}), ("not in play on level 2", {"level": 2})])
def test_bad_input_is_one_clear_line_and_leaves_no_emulator(rom, tmp_path, said, change):
    for name, content in change.items():
        if isinstance(content, bytes):
            (tmp_path / "bad").write_bytes(content)
            change = {name: str(tmp_path / "bad")}
    with pytest.raises(InputError, match=said) as error:
        PrinceOfPersia(**{"rom": rom, **change})
    assert "\n" not in str(error.value)
    PrinceOfPersia(rom).close()


def test_one_emulator_a_process_and_nothing_left_behind(prince, rom, tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"close\(\) the first"):
        PrinceOfPersia(rom)
    prince.close()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    PrinceOfPersia(rom).close()
    assert [path.name for path in tmp_path.iterdir()] == ["game.nes"]


def test_a_snapshot_damaged_or_of_another_cartridge_or_level_is_refused(prince, tmp_path):
    good = prince.snapshot()
    (tmp_path / "other.nes").write_bytes(cartridge(mark=1))
    prince.close()
    env = PrinceOfPersia(str(tmp_path / "other.nes"))
    own = env.snapshot()
    for bad in (good, b"", b"rubbish", None, own[:-1], own[:-1] + bytes([own[-1] ^ 1])):
        with pytest.raises(InputError, match="snapshot"):
            env.restore(bad)
    env.close()


@pytest.mark.parametrize("library, make", [("stable_retro", PrinceOfPersia), ("ale_py", Montezuma)])
def test_a_library_that_is_not_installed(tmp_path, monkeypatch, library, make):
    (tmp_path / "game.nes").write_bytes(cartridge())
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(InputError, match="pip install"):
        make(*[str(tmp_path / "game.nes")] * (make is PrinceOfPersia))


def test_montezuma_ends_with_a_life_starts_alike_and_counts_rooms(montezuma):
    env, twin, rng = montezuma, Montezuma(), np.random.default_rng(0)
    assert env.reset()[1] == {"room": 1, "x": 77, "y": 235, "lives": 5, "blank": False}
    assert env.snapshot() == twin.snapshot() and env.unit() == (1, 4, 1) and env.full_coverage is None
    assert env._emulator.getFloat("repeat_action_probability") == 0  # twins share a seed
    lives, ended = 5, 0
    for action in rng.integers(18, size=600).tolist():
        frame, _, terminated, _, info = env.step(action)
        assert terminated == (info["lives"] < lives) and frame.tobytes() == twin.step(action)[0].tobytes()
        lives, ended = info["lives"], ended + terminated
    assert ended


def test_gymnasium_accepts_the_cartridge(prince):
    check_env(prince, skip_render_check=True)


def test_what_the_emulators_tell_of_a_state(prince, monkeypatch):
    assert prince.reset()[0].flags.writeable and prince.restore(prince.snapshot()).flags.writeable
    tick = prince._tick
    monkeypatch.setattr(prince, "_tick", lambda action: (tick(action), poke(prince, 1743, 5)))
    assert not prince.step(0)[2]  # more hit points are no loss of life
    assert prince.unit() is not None
    poke(prince, 1743, 0)
    assert prince.unit() is None  # the dead stand nowhere
    poke(prince, 1743, 3)
    monkeypatch.setattr(prince, "_screen", lambda: np.zeros((224, 240, 3), np.uint8))
    prince._begin(b"dark", 7, 96)
    assert prince.reset()[1]["blank"]


def test_a_way_down_in_montezuma_is_a_way_down_on_its_map(montezuma):
    montezuma.reset()
    units = [montezuma.unit()]
    for _ in range(22):  # down the ladder that the game begins on
        montezuma.step(5)
        units.append(montezuma.unit())
    rows = [row for _, _, row in units]
    assert rows == sorted(rows) and rows[-1] > rows[0] + 2


def test_gymnasium_accepts_montezuma(montezuma):
    check_env(montezuma, skip_render_check=True)


def test_the_trace_alone_rebuilds_the_graph(finished):
    """Visits, arcs and parents, from nothing but the decisions that trace.jsonl tells."""
    visits, arcs, parents = Counter({0: 1}), Counter(), {0: None}
    for event in map(json.loads, (finished / "trace.jsonl").read_text().splitlines()):
        if event["event"] == "restart":
            visits, arcs, parents = Counter({0: 1}), Counter(), {0: None}
        elif event["event"] == "assign":
            assert event["clusters"][0] == event["start"] and len(event["R"]) == len(event["clusters"])
            visits.update(event["clusters"])
            arcs.update((a, b) for a, b in itertools.pairwise(event["clusters"]) if a != b)
            parents |= dict(event["made"])
        elif event["event"] == "merge":
            for survivor, gone, score in event["merged"]:
                assert survivor < gone and score > 0.5
                visits[survivor] += visits.pop(gone)
                moved = Counter()
                for arc, crossings in arcs.items():
                    moved[tuple(survivor if v == gone else v for v in arc)] += crossings
                arcs = Counter({arc: crossings for arc, crossings in moved.items() if arc[0] != arc[1]})
                del parents[gone]
                parents = {v: survivor if parent == gone else parent for v, parent in parents.items()}
    state = torch.load(finished / "checkpoint.pt", weights_only=True)["algorithm"]
    assert {v: (parent, n) for v, _, _, parent, n in state["clusters"]} == {v: (parents[v], visits[v]) for v in parents}
    assert {(a, b): n for a, b, n in state["arcs"]} == dict(arcs)


def test_verify_replays_and_restores_every_centre_and_exports_the_actions(finished, tmp_path, capsys):
    clusters = len(torch.load(finished / "checkpoint.pt", weights_only=True)["algorithm"]["clusters"])
    before = {path: path.read_bytes() for path in finished.iterdir()}
    assert main(["--verify", str(finished), "--export-demos", str(tmp_path / "demos.npz")]) == 0
    assert f"{clusters} of {clusters} clusters are reached exactly" in capsys.readouterr().out
    assert before == {path: path.read_bytes() for path in finished.iterdir()}
    demos = np.load(tmp_path / "demos.npz")
    ids = [c[0] for c in torch.load(finished / "checkpoint.pt", weights_only=True)["algorithm"]["clusters"]]
    assert demos["clusters"].tolist() == ids != list(range(clusters))  # some were merged
    assert len(demos["clusters"]) == clusters > 3
    for k, centre in enumerate(demos["centres"]):
        env = Maze()
        frame, _ = env.reset()
        for action in demos["actions"][demos["offsets"][k] : demos["offsets"][k + 1]]:
            frame = env.step(int(action))[0]
        assert np.array_equal(frame, centre)


@pytest.mark.parametrize("what", ["centre", "snapshot", "actions"])
def test_verify_finds_a_cluster_that_is_not_reached(finished, tmp_path, capsys, what):
    wrong = shutil.copytree(finished, tmp_path / "wrong")
    state = torch.load(wrong / "checkpoint.pt", weights_only=True)
    clusters, paths = state["algorithm"]["clusters"], state["algorithm"]["paths"]
    last = clusters[-1]
    if what == "centre":
        paths[last[2]][1][-1, 0, 0] += 1
    elif what == "snapshot":
        clusters[-1] = (last[0], clusters[0][1], *last[2:])
    else:
        paths[last[2]][2].append("01" * 5)  # five times to the left
    torch.save(state, wrong / "checkpoint.pt")
    assert main(["--verify", str(wrong)]) == 1
    assert f"{len(clusters) - 1} of {len(clusters)} clusters" in capsys.readouterr().out


def test_verify_and_workers_in_the_emulators(rom, tmp_path, capsys):
    pytest.importorskip("ale_py", reason="Montezuma's emulator, ale-py, is not installed")
    small = ["--config", "maze", "--frame-size", "48", "--steps", "900", "--pretrain-steps", "200", "--M", "4", "--L", "4",
             "--epochs", "1", "--no-figures"]
    for env, options in (("pop", ["--rom", rom]), ("montezuma", [])):
        folder = str(tmp_path / env)
        assert main(["--env", env, *options, *small, "--out", folder]) == 0
        gc.collect()  # stable-retro allows one emulator in a process: the run's must be gone
        assert main(["--verify", folder]) == 0 and "DIFFERS" not in capsys.readouterr().out
        gc.collect()
        assert main(["--env", env, *options, *small, "--out", folder + "2", "--workers", "2"]) == 0  # an emulator in each
        gc.collect()
        one, two = (torch.load(pathlib.Path(f, "checkpoint.pt"), weights_only=True)["algorithm"] for f in (folder, folder + "2"))
        assert tensors_as_bytes(one) == tensors_as_bytes(two) and len(one["clusters"]) > 1


def test_the_cartridge_has_frames_of_the_size_asked_for(rom):
    env = PrinceOfPersia(rom, frame_size=40)
    assert env.reset()[0].shape == (40, 40)
    env.close()


def test_the_cartridge_boots_for_a_second(prince):
    assert memory(prince)[0] >= 50  # it counts its frames


def test_the_cartridge_refuses_what_it_cannot_use(rom, prince, tmp_path):
    packed = bytearray(gzip.compress(bytes(range(256)) * 9))
    packed[10:14] = b"\xff" * 4
    (tmp_path / "bad").write_bytes(bytes(packed))
    with pytest.raises(InputError, match="cannot read"):
        PrinceOfPersia(rom, state=str(tmp_path / "bad"))
    with pytest.raises(InputError, match="levels 1 to 14"):
        PrinceOfPersia(rom, level=1.0)
    with pytest.raises(InputError, match="damaged"):
        prince.restore(prince.snapshot() + b"x")


def test_full_coverage_of_every_level_of_the_cartridge():
    assert PrinceOfPersia.FULL_COVERAGE == (721, 723, 756, 706, 598, 287, 755, 736, 797, 444, 575, 688, 223, 107)


def test_a_snapshot_taken_after_a_restore_is_the_same(prince):
    first = prince.snapshot()
    for _ in range(5):
        frame = prince.step(2)[0]
    second = prince.snapshot()
    assert not np.array_equal(prince.restore(first), frame)
    assert prince.snapshot() == first != second


def test_R22_the_last_frame_of_a_step(montezuma):
    montezuma.reset()
    for action in np.random.default_rng(0).integers(18, size=100).tolist():
        frame = montezuma.step(action)[0]
        assert np.array_equal(frame, montezuma._observe())


# ------------------------------------------------------------------------------------------ the methods compared (6.2, 6.3)

BRIEF = replace(MAZE, steps=700, pretrain_steps=200, M=3, trajectory_steps=60, L=3, additional_steps=30)
TINY_PPO = replace(PPO_CONFIGS["maze"], actors=3, rollout_steps=50, hidden=32)


class Corridor(PersistentEnv):
    """Cells 0 to 5, actions left and right, start in 1; both ends are terminal. The frame shows the cell."""

    observation_space, action_space = spaces.Box(0, 255, (32, 32), np.uint8), spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return self.restore(b"\1"), {}

    def restore(self, snapshot):
        self.x = snapshot[0]
        frame = np.zeros((32, 32), np.uint8)
        frame[:, 5 * self.x : 5 * self.x + 5] = 255
        return frame

    def step(self, action):
        return self.restore(bytes([self.x + (1 if action else -1)])), 0.0, self.x in (0, 5), False, {}

    def snapshot(self):
        return bytes([self.x])

    def unit(self):
        return (self.x,)


class ColourCorridor(Corridor):
    """In three colours, of different brightness."""

    observation_space = spaces.Box(0, 255, (32, 32, 3), np.uint8)

    def restore(self, snapshot):
        return super().restore(snapshot)[..., None] // np.array([1, 2, 4], np.uint8)


class Goal:
    """A bonus for a rewarded task: 1 at the right end of the corridor, 0.2 at the left one, which is nearer."""

    parts = moments = ()

    def __init__(self, *unused):
        pass

    def reward(self, before, actions, after):
        return 1.0 * (after[:, 0, 25] > 0) + 0.2 * (after[:, 0, 0] > 0)

    def update(self, before, actions, after):
        return {}


def transitions(steps=60):
    env, rng = MAZE_FN(), np.random.default_rng(0)
    before, actions, after, frame = [], [], [], env.reset()[0]
    for action in rng.integers(7, size=steps):
        before.append(frame)
        frame, _, dead, _, _ = env.step(int(action))
        actions.append(action)
        after.append(frame)
        frame = env.reset()[0] if dead else frame
    return np.stack(before), np.array(actions), np.stack(after)


def test_S6_2_03_rnd_loss_and_bonus_fall_on_visited_states_only():
    seen, b = transitions(), RNDBonus(BRIEF, TINY_PPO, (32, 32), 7, "cpu")
    new = tuple(x[:, ::-1].copy() if x.ndim == 3 else x for x in seen)  # upside down: never visited
    first, unseen = b.reward(*seen).mean(), b.rnd.distance(new[2]).mean()
    losses = [b.update(*seen)["rnd_loss"] for _ in range(100)]
    assert losses[-1] < 0.2 * losses[0] and b.rnd.distance(seen[2]).mean() < 0.2 * first
    assert b.rnd.distance(new[2]).mean() > 0.4 * unseen


def test_S6_2_03_icm_losses_and_bonus_fall_on_visited_states():
    seen, b = transitions(), ICM(BRIEF, TINY_PPO, (32, 32), 7, "cpu")
    inverse = [b.update(*seen)["inverse_loss"] for _ in range(120)]
    b.encoder.requires_grad_(False)  # while the features grow, so does the error in them
    bonus, forward = b.reward(*seen).mean(), [b.update(*seen)["forward_loss"] for _ in range(300)]
    assert inverse[-1] < 0.75 * inverse[0] and forward[-1] < 0.5 * forward[0] and b.reward(*seen).mean() < 0.5 * bonus


def test_S6_2_03_icm_encoder_learns_by_the_inverse_loss_only():
    icm, seen = ICM(BRIEF, TINY_PPO, (32, 32), 7, "cpu"), transitions(50)
    icm.losses(*seen)[1].mean().backward()
    assert all(p.grad is None for p in icm.encoder.parameters())
    assert all(p.grad.abs().sum() > 0 for p in icm.forward_model.parameters())
    icm.losses(*seen)[0].mean().backward()
    assert all(p.grad.abs().sum() > 0 for p in icm.encoder.parameters())


def test_S6_2_03_ppo_solves_a_rewarded_task():
    a = PPO(Corridor, replace(BRIEF, steps=4000), "cpu", replace(TINY_PPO, actors=2, rollout_steps=64, episodic=True), Goal)
    a.run()
    frames = np.stack([a.first(a.env.restore(bytes([x]))) for x in range(1, 5)])
    assert (a.act(frames)[0].exp()[:, 1] > 0.9).all()


@pytest.mark.parametrize("episodic", [True, False])
def test_S6_2_03_gae_against_a_slow_version(episodic):
    rng, T, K, gamma, lam = np.random.default_rng(0), 9, 3, 0.9, 0.8
    r, v, at_end, last, ended = *rng.normal(size=(3, T, K)), rng.normal(size=K), rng.random((T, K)) < 0.3
    for k in range(K):
        for t in range(T):
            total, weight = 0, 1
            for j in range(t, T):
                after = at_end[j, k] if episodic and ended[j, k] else v[j + 1, k] if j + 1 < T else last[k]
                total, weight = total + weight * (r[j, k] + gamma * after - v[j, k]), weight * gamma * lam
                if episodic and ended[j, k]:
                    break
            assert np.isclose(gae(r, v, last, ended, at_end, gamma, lam, episodic)[t, k], total)


def test_S6_2_03_discounted_bonus_runs_over_time_of_each_actor():
    r = np.array([[1.0, 10], [2, 20], [3, 30]])  # 3 steps of 2 actors
    a = PPO(Corridor, BRIEF, "cpu", replace(TINY_PPO, actors=2, gamma=0.5), Goal)
    assert np.allclose(a.scaled(r), r / np.std([1, 10, 2.5, 25, 4.25, 42.5]))
    a.scaled(r)
    assert np.allclose(a.sums, [3 + 0.5 * 2 + 0.25 * 1 + 4.25 / 8, 42.5 * 1.125])  # carried from rollout to rollout


def test_S6_2_03_truncation_keeps_the_bootstrap_and_death_cuts_it():
    a = PPO(Corridor, BRIEF, "cpu", replace(TINY_PPO, episode_steps=4), Goal)
    a.net[-1].bias.data[-1] = 2.0
    seen, actions, _, after, values, last, ended, at_end = a.rollout()
    died = (after[:, :, 0, 0] > 0) | (after[:, :, 0, 25] > 0)
    timed_out = ended & ~died
    for k in range(ended.shape[1]):
        ends = [-1, *np.flatnonzero(ended[:, k]).tolist()]
        assert all((t - before == 4) == bool(timed_out[t, k]) or died[t, k] for before, t in itertools.pairwise(ends))
        assert max(np.diff([*ends, len(ended)])) <= 4
    assert died.any() and timed_out.any() and (ended | ~died).all() and (at_end[died] == 0).all()
    assert np.allclose(at_end[timed_out], a.act(after[timed_out][..., None])[1].detach(), atol=1e-5)
    episodic, endless = (gae(0 * values, values, last, ended, at_end, 1.0, 0.0, flag) + values for flag in (True, False))
    assert (episodic[died] == 0).all() and np.allclose(episodic[timed_out], at_end[timed_out])
    assert np.allclose(endless[:-1], values[1:]) and np.allclose(endless[-1], last)  # on with the next episode's first state


@pytest.mark.parametrize("env_fn, c", [(Corridor, 1), (ColourCorridor, 3)])
def test_S6_2_03_policy_sees_the_latest_frames_newest_last(env_fn, c):
    a, given = PPO(env_fn, BRIEF, "cpu", replace(TINY_PPO, stack=3), Goal), []
    seen, _, _, after, _, _, ended, _ = rollout = a.rollout()
    after = after.reshape(*after.shape[:4], c)
    assert (seen[0, :, 0, 5, 0] == 255).all() and np.array_equal(seen[1:, ..., -c:][~ended[:-1]], after[:-1][~ended[:-1]])
    assert np.array_equal(seen[1:, ..., : 2 * c][~ended[:-1]], seen[:-1, ..., c:][~ended[:-1]])
    assert (seen[1:][ended[:-1]][:, 0, 5, ::c] == 255).all()  # a new episode: three times its first frame
    a.row, a.rollout = {}, lambda: rollout
    a.bonus.reward = lambda before, actions, after: given.append(before) or np.zeros(len(actions))
    a.advance()
    assert np.array_equal(given[0].reshape(*seen.shape[:4], c), seen[..., -c:])  # the bonus sees the latest frame alone


def test_ppo_update_clips_the_ratio_and_raises_the_entropy():
    def made(**changes):
        plain = {"value_weight": 0.0, "entropy": 0.0, "standardise": False, "clip": 0.1, "learning_rate": 0.01}
        a = PPO(Corridor, BRIEF, "cpu", replace(TINY_PPO, **plain | changes), Goal)
        a.net[-1].bias.data[0] = 1.0
        return a, a.seen[:1], np.array([0]), a.act(a.seen[:1])[0].detach().numpy()[:, 0].astype(float)
    for ratio, advantage, moves in ((1.5, 1.0, False), (1.5, -1.0, True), (0.5, 1.0, True), (0.5, -1.0, False)):
        a, seen, actions, logp = made()
        a.update(seen, actions, logp - math.log(ratio), np.array([advantage]), np.zeros(1))
        assert any(w.grad.abs().sum() > 0 for w in a.net.parameters()) == moves, (ratio, advantage)
    a, seen, actions, logp = made(entropy=1.0)
    first, second = (a.update(seen, actions, logp, np.zeros(1), np.zeros(1))["entropy"] for _ in range(2))
    assert second > first + 0.001


def test_ppo_standardises_advantages_and_its_targets_are_returns():
    twins = [PPO(Corridor, BRIEF, "cpu", TINY_PPO, Goal) for _ in range(2)]
    seen, advantages = np.repeat(twins[0].seen, 2, 0), np.array([1.0, -2, 3, 0, 1, 5])
    for a, shift in zip(twins, (0.0, 5.0), strict=True):
        a.update(seen, np.arange(6) % 2, np.full(6, -0.7), advantages + shift, np.zeros(6))
    assert all(torch.allclose(x, y, atol=1e-6) for x, y in zip(*(a.net.parameters() for a in twins), strict=True))
    a, given = PPO(Corridor, BRIEF, "cpu", replace(TINY_PPO, passes=1, minibatches=1), Goal), []
    a.net[-1].bias.data[-1] = 2.0  # values are about 2
    a.row, a.update = {}, lambda *batch: given.append(batch) or {}
    a.advance()
    *_, advantages, targets = given[0]
    assert np.allclose(targets - advantages, 2, atol=0.1)


@pytest.mark.parametrize("share", [1.0, 0.25])
def test_R27_a_share_of_the_experience_trains_the_bonus(share):
    a, sizes = PPO(Corridor, BRIEF, "cpu", replace(TINY_PPO, bonus_share=share), Goal), []
    a.bonus.update = lambda before, actions, after: sizes.append(len(actions)) or {}
    a.iterate()
    assert abs(sum(sizes) - share * 600) <= (0 if share == 1 else 60)  # 150 steps, 4 passes


def test_the_bonuses_see_what_they_should():
    (before, actions, after), rnd = transitions(20), RNDBonus(BRIEF, TINY_PPO, (32, 32), 7, "cpu")
    assert np.array_equal(rnd.reward(before, actions, after), rnd.rnd.distance(after).detach().numpy())
    rnd.rnd.update = lambda frames: given.append(frames) or np.zeros(1)
    given: list = []
    rnd.update(before, actions, after)
    assert given[0] is after
    rnd.reward(before, actions, after)
    assert rnd.rnd.pixels.count == 40  # the statistics grow with each rollout
    icm = ICM(BRIEF, TINY_PPO, (32, 32), 7, "cpu")
    phi, following = (icm.encoder(rbexplore.to_input(x, "cpu")) for x in (before, after))
    guess = icm.forward_model(torch.cat([phi, torch.eye(7)[actions]], 1))
    assert np.allclose(icm.reward(before, actions, after), ((guess - following) ** 2).sum(1).detach() / 2, rtol=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_S6_2_04_every_method_stops_exactly_at_the_budget(method):
    a, calls = make_method(method, MAZE_FN, BRIEF, ppo=TINY_PPO), []
    inner, unit = a.env.step, a.env.unit
    a.env.step = lambda action: calls.append(inner(action)) or calls[-1]
    stood = set()
    a.env.unit = lambda: stood.add(unit()) or unit()
    a.run()
    assert a.steps == len(calls) == 700 and max(a.discovered.values()) <= 700
    assert set(a.discovered) <= stood | {(6, 1, 2)} and a.row["coverage"] == len(a.discovered) / a.env.full_coverage
    assert a.exploration_steps == 700 or method == "rbexplore"  # nothing but a learned R needs other steps
    if method in ("rnd", "icm", "random"):
        assert make_method(method, MAZE_FN, BRIEF, ppo=TINY_PPO).discovered == {(6, 1, 2): 0}
        with pytest.raises(InputError, match="spent"):
            a.iterate()
        assert set(a.discovered) == stood - {None} | {(6, 1, 2)}


def test_random_never_rolls_back():
    a, starts = make_method("random", MAZE_FN, BRIEF), []
    a.env.restore = a.env.snapshot = None  # calling either would raise
    reset, a.env.reset = a.env.reset, lambda **named: starts.append(a.steps) or reset(**named)
    a.run()
    assert len(starts) >= 700 / 60 and max(np.diff([*starts, 700])) <= 60


def test_cells_and_exact_states():
    env, same = ExactMaze(1), rbexplore.Cells(exact)
    plain, marked = zip(*((Maze.restore(Maze(1), s), env.restore(s)) for s in (b"\1\1\7\1\0\0", b"\1\1\7\1\2\0")), strict=True)
    frames = np.stack([plain[0], plain[0] ^ 1, 255 - plain[0]])
    cells = coarse(frames)
    left = np.zeros((1, 16, 22), np.uint8)
    left[..., :2] = 255  # an eleventh of the width
    assert coarse(left).reshape(8, 11).tolist() == [[7] + [0] * 10] * 8
    assert cells.shape == (3, 88) and cells.max() < 8 and not torch.equal(cells[0], cells[2])
    assert rbexplore.Cells(coarse).score(cells, coarse(plain[0][None])[0]).tolist()[::2] == [1.0, 0.0]
    assert np.array_equal(*plain) and same.score(exact(np.stack(marked)), exact(marked[0][None])[0]).tolist() == [1.0, 0.0]
    assert [make_method(m, MAZE_FN, BRIEF).similarity.embed for m in ("cells", "oracle")] == [coarse, exact]
    with pytest.raises(InputError, match="maze alone"):
        make_method("oracle", Corridor, BRIEF)


def test_oracle_and_cells_explore_further_than_random():
    units = {m: len(make_method(m, MAZE_FN, replace(MAZE, steps=9000)).run().discovered) for m in ("random", "cells", "oracle")}
    assert units["random"] * 1.5 < min(units["cells"], units["oracle"])


@pytest.mark.parametrize("method", ["random", "rnd", "icm", "cells"])
def test_methods_resume_as_if_never_interrupted(method):
    def make():
        return make_method(method, MAZE_FN, BRIEF, ppo=TINY_PPO)

    whole, a, b = make().run(), make(), make()
    a.iterate()
    state = through_a_file(rbexplore.pack(a))
    np.random.seed(1)
    torch.manual_seed(1)  # neither is used
    rbexplore.unpack(b, state)
    b.run()
    assert b.row == whole.row and b.discovered == whole.discovered


def test_steps_to_a_share_of_full_coverage():
    assert rbexplore.steps_to([10, 20, 1300, 1400], 4) == {50: "20", 90: "1,400", 100: "1,400"}
    assert rbexplore.steps_to([10, 20], 3) == {50: "20", 90: None, 100: None}


def test_S6_2_05_band_is_min_to_max_and_S6_2_06_best_is_by_final_coverage():
    grid, curves = np.array([0, 5, 10]), {0: np.array([0.0, 9, 10]), 1: np.array([0.0, 1, 12]), 2: np.array([0.0, 2, 5])}
    (axes,) = rbexplore.curves_figure(grid, {"rnd": curves}, 100, "tiles").axes
    assert axes.lines[0].get_ydata().tolist() == [0, 4, 9]
    edge = {tuple(map(float, point)) for point in axes.collections[0].get_paths()[0].vertices}
    assert edge == {(0, 0), (5, 1), (5, 9), (10, 5), (10, 12)} and best(curves) == 1


@pytest.mark.parametrize("name, field", [("ablation", {"merge", "prefix"}), ("theta-merge", {"theta_merge"})])
def test_S6_3_01_02_03_variants_differ_in_their_field_only(name, field):
    runs = {run: settings_of(parser().parse_args(line)) for run, line in
            runs_of(parser().parse_args(["--experiment", name, "--seeds", "2", "--steps", "9000"])).items()}
    assert {seed for _, seed in runs} == {0, 1} and len(runs) == 6
    for (variant, seed), settings in runs.items():
        base = settings_of(parser().parse_args(["--steps", "9000", "--seed", str(seed)]))
        changed = {key for key, value in settings["config"].items() if value != base["config"][key]}
        assert changed <= field and len(changed) <= 1 and settings | {"config": 0} == base | {"config": 0}
        expected = {"no-merge": ("merge", False), "no-prefix": ("prefix", False), "rbexplore": ("merge", True)}
        key, value = expected.get(variant) or ("theta_merge", float(variant.rsplit("-")[-1]))
        assert settings["config"][key] == value


def test_experiment_runs_resumes_and_gathers(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(rbexplore, "EXPERIMENTS", {"methods": {"random": ["--method", "random"]}})
    line = ["--experiment", "methods", "--seeds", "2", "--steps", "2000", "--out", str(tmp_path)]
    assert rbexplore.main(line) == 0 and "done" in capsys.readouterr().out
    assert (tmp_path / "maps.png").exists() and (tmp_path / "curves.png").exists()
    rows = list(csv.DictReader((tmp_path / "curves.csv").open()))
    for seed in "01":
        mine = [row for row in rows if row["variant"] == "random" and row["seed"] == seed]
        assert [int(row["steps"]) for row in mine] == list(range(0, 2001, 10))
        last = metrics(tmp_path / f"random-{seed}")[-1][rbexplore.METRICS.index("coverage")]
        assert float(mine[-1]["coverage"]) == pytest.approx(100 * float(last), abs=1e-4)
    assert rbexplore.main([*line, "--workers", "2"]) == 0 and capsys.readouterr().out.count("was finished") == 2
    assert rbexplore.main([*line, "--M", "7"]) == 2 and "another configuration" in capsys.readouterr().err


@pytest.mark.parametrize("method", METHODS)
def test_no_method_iterates_on_a_spent_budget_or_has_a_metric_without_a_column(method):
    a = make_method(method, MAZE_FN, BRIEF, ppo=TINY_PPO).run()
    assert a.row.keys() <= set(rbexplore.METRICS)
    with pytest.raises(InputError, match="spent"):
        a.iterate()


def test_baselines_record_first_visits_and_check_the_contract():
    a = make_method("random", MAZE_FN, BRIEF)
    step, first = a.env.step, {a.env.unit(): 0}

    def noted(action):
        result = step(action)
        if a.env.unit():
            first.setdefault(a.env.unit(), a.steps + 1)
        return result
    a.env.step = noted
    assert a.run().discovered == first

    def broken():
        env = Grid()
        env.snapshot = None
        return env
    for method in ("random", "rnd"):
        with pytest.raises(InputError, match="lacks snapshot"):
            make_method(method, broken, QUICK)


def test_ppo_discounts_as_its_configuration_says(monkeypatch):
    given, inner = [], rbexplore.gae
    monkeypatch.setattr(rbexplore, "gae", lambda *arguments: given.append(arguments[5:]) or inner(*arguments))
    PPO(Corridor, BRIEF, "cpu", replace(TINY_PPO, gamma=0.9, gae_lambda=0.8, episodic=True), Goal).iterate()
    assert given == [(0.9, 0.8, True)]


def test_icm_beta_weighs_the_forward_loss():
    icm = ICM(BRIEF, replace(TINY_PPO, icm_beta=1.0), (32, 32), 7, "cpu")
    icm.update(*transitions(20))
    assert not any(p.grad.any() for p in icm.inverse_model.parameters())
    assert all(p.grad.any() for p in icm.forward_model.parameters())


def test_the_oracle_plays_the_level_asked_for():
    env = make_method("oracle", functools.partial(make_env, "maze", level=2, frame_size=48), BRIEF).env
    assert (env.level, env.frame_size) == (2, 48)


def test_a_curve_counts_the_units_of_its_step():
    assert rbexplore.coverage_curve({(0,): 5, (1,): 6}, np.array([4, 5, 6]), 4).tolist() == [0, 25, 50]


def test_a_run_without_clusters_has_nothing_to_verify(tmp_path, capsys):
    assert main(["--method", "random", "--steps", "600", "--no-figures", "--out", str(tmp_path)]) == 0
    check_refused(capsys, tmp_path, ["--verify", str(tmp_path)], "no clusters to verify")


def test_an_experiments_runs_have_its_seeds_options_and_environment():
    def lines_of(*argv):
        return rbexplore.runs_of(parser().parse_args(["--experiment", "methods", *argv]))
    assert {seed for _, seed in lines_of("--seed", "5", "--seeds", "2")} == {5, 6}
    for line in lines_of("--no-prefix", "--keep-buffer").values():
        config = settings_of(parser().parse_args(line))["config"]
        assert not config["prefix"] and config["keep_buffer"]
    assert {variant for variant, _ in lines_of("--env", "montezuma")} == set(METHODS) - {"oracle"}


def test_an_experiment_refuses_before_it_begins(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(rbexplore, "EXPERIMENTS", {"methods": {"random": ["--method", "random"]}})
    (tmp_path / "file").write_text("no folder")
    (tmp_path / "damaged" / "random-0").mkdir(parents=True)
    (tmp_path / "damaged" / "random-0" / "config.json").write_text("{")
    for folder, said in (("file/run", "cannot be written"), ("damaged", "cannot be read")):
        line = ["--experiment", "methods", "--seeds", "1", "--no-figures", "--out", str(tmp_path / folder)]
        check_refused(capsys, tmp_path, line, said)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    check_refused(capsys, tmp_path, ["--experiment", "methods", "--out", str(tmp_path / "run")], "figures need matplotlib")


def test_the_bonus_is_scaled_by_all_sums_so_far():
    r = np.array([[1.0, 10], [2, 20], [3, 30]])
    a = PPO(Corridor, BRIEF, "cpu", replace(TINY_PPO, actors=2, gamma=0.0), Goal)
    a.scaled(r)
    assert np.allclose(a.scaled(0 * r), 0) and np.allclose(a.scaled(r), r / np.std([*r.ravel(), *(0 * r).ravel(), *r.ravel()]))


def test_losses_of_ppo_and_of_icm_must_be_finite():
    nan, a = np.full(3, np.nan), PPO(Corridor, BRIEF, "cpu", TINY_PPO, Goal)
    with pytest.raises(FloatingPointError, match="PPO"):
        a.update(a.seen, np.zeros(3, int), nan, nan, nan)
    icm = ICM(BRIEF, TINY_PPO, (32, 32), 7, "cpu")
    icm.encoder[0].weight.data[:] = float("nan")
    with pytest.raises(FloatingPointError, match="ICM"):
        icm.update(*transitions(9))


def test_an_experiment_tells_of_damaged_runs_and_needs_no_metrics(tmp_path, capsys):
    options = TINY_OPTIONS | {"steps": 900, "pretrain-steps": 200, "beta": -0.00001}
    line = ["--experiment", "ablation", "--seeds", "1", "--no-figures", "--out", str(tmp_path),
            *(f"--{name}={value}" for name, value in options.items())]
    assert main(line) == 0
    (tmp_path / "no-merge-0" / "metrics.csv").unlink()
    assert main(line) == 0
    capsys.readouterr()
    whole = (tmp_path / "rbexplore-0" / "checkpoint.pt").read_bytes()
    (tmp_path / "rbexplore-0" / "checkpoint.pt").write_bytes(whole[:-9000])
    assert main(line) == 2
    assert re.fullmatch("rbexplore: .*rbexplore-0/checkpoint.pt cannot be loaded .*\n", capsys.readouterr().err)


def test_an_interrupted_experiment_goes_on_also_with_other_versions(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(rbexplore, "EXPERIMENTS", {"methods": {"random": ["--method", "random"]}})
    line = ["--experiment", "methods", "--seeds", "1", "--steps", "9000", "--no-figures", "--out", str(tmp_path)]
    (command,) = rbexplore.runs_of(parser().parse_args(line)).values()
    tell = rbexplore.Run.tell

    def stop(self, event, **data):
        tell(self, event, **data)
        if event == "row":
            raise KeyboardInterrupt
    with monkeypatch.context() as patch:
        patch.setattr(rbexplore.Run, "tell", stop)
        assert main(command) == 130
    assert main([*line, "--workers", "2"]) == 0 and "random-0 done" in capsys.readouterr().out
    assert "2 worker(s)" in (tmp_path / "random-0" / "log.txt").read_text()
    assert int(metrics(tmp_path / "random-0")[-1][rbexplore.METRICS.index("steps")]) == 9000
    monkeypatch.setattr(rbexplore, "versions", lambda: {"python": "9"})
    assert main(line) == 0 and "was finished" in capsys.readouterr().out


def test_an_experiments_map_is_that_of_the_best_run(tmp_path, monkeypatch):
    monkeypatch.setattr(rbexplore, "EXPERIMENTS", {"methods": {"random": ["--method", "random"]}})
    given, inner = [], rbexplore.maps_figure
    monkeypatch.setattr(rbexplore, "maps_figure", lambda *of: given.append(of[1]) or inner(*of))
    monkeypatch.setattr(rbexplore, "best", lambda of: 1)
    assert main(["--experiment", "methods", "--seeds", "2", "--steps", "600", "--out", str(tmp_path)]) == 0
    state = torch.load(tmp_path / "random-1" / "checkpoint.pt", weights_only=True)["algorithm"]
    assert list(given[0].values()) == [{tuple(unit): step for unit, step in state["discovered"]}]


def test_R27_the_values_are_burdas_and_pathaks():
    paper = {"actors": 128, "rollout_steps": 128, "episode_steps": 4500, "stack": 4, "gamma": 0.99, "gae_lambda": 0.95,
             "episodic": False, "learning_rate": 1e-4, "passes": 4, "minibatches": 4, "clip": 0.1, "entropy": 0.001,
             "value_weight": 0.5, "standardise": False, "bonus_share": 0.25, "hidden": 448, "icm_beta": 0.2}
    assert asdict(PPO_CONFIGS["paper"]) == paper


def test_value_weight_weighs_the_values_error():
    a = PPO(Corridor, BRIEF, "cpu", replace(TINY_PPO, value_weight=0.0, entropy=0.0), Goal)
    a.update(a.seen[:2], np.array([0, 1]), np.full(2, -0.7), np.zeros(2), np.full(2, 9.0))
    assert not any(w.grad.any() for w in a.net.parameters())


def test_the_first_policy_is_uniform_and_the_first_values_are_0():
    a = PPO(Corridor, BRIEF, "cpu", TINY_PPO, Goal)
    logp, values = a.act(np.random.default_rng(0).integers(256, size=(20, 32, 32, 1), dtype=np.uint8))
    assert (logp.exp() - 0.5).abs().max() < 0.02 and values.abs().max() < 0.05


def test_actions_are_a_sample_of_the_policy():
    class Endless(Corridor):
        def step(self, action):
            return self.restore(b"\2"), 0.0, False, False, {}
    a = PPO(Endless, replace(BRIEF, steps=10_000), "cpu", replace(TINY_PPO, actors=1, rollout_steps=4000), Goal)
    a.net[-1].weight.data *= 0
    a.net[-1].bias.data[:2] = torch.tensor([0.9, 0.1]).log()
    actions = a.rollout()[1]
    assert abs((actions == 0).mean() - 0.9) < 0.025


def test_the_value_after_the_rollout_is_that_of_the_state_it_ends_in():
    a = PPO(Corridor, BRIEF, "cpu", TINY_PPO, Goal)
    a.net[-1].bias.data[-1] = 2.0
    last = a.rollout()[5]
    assert np.allclose(last, a.act(a.seen)[1].detach(), atol=1e-5) and (last > 1).all()


def test_three_runs_unless_told():
    assert {seed for _, seed in runs_of(parser().parse_args(["--experiment", "ablation"]))} == {0, 1, 2}


# ------------------------------------------------------------------------------------------------- the README tells the truth

README = (HERE / "README.md").read_text()


def ledger_rows() -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in README.splitlines() if re.match(r"\| S\d", line)]


def rows_of(name: str) -> set[str]:
    """The statements that a test's name carries: test_S4_1_03_04_and_05_..., test_S4_2_24_to_29_..., test_S4_01_S6_1_11_..."""
    rows = set()
    for section, sub, numbers in re.findall(r"S(\d)(?:_(\d)(?!\d))?((?:_(?:and_|to_)?\d\d(?!\d))+)", name):
        last = 0
        for to, number in re.findall(r"(to_)?(\d\d)", numbers):
            first, last = last + 1 if to else int(number), int(number)
            rows |= {f"S{section}{'.' + sub if sub else ''}-{n:02}" for n in range(first, last + 1)}
    return rows


def resolve(name: str) -> object:
    """What the README calls by this dotted name, in rbexplore.py or else in envs.py."""
    found = rbexplore if hasattr(rbexplore, name.split(".")[0]) else envs
    for part in name.split("."):
        found = getattr(found, part)
    return found


def test_every_row_of_the_ledger_names_a_function_and_tests_that_exist():
    assert len(ledger_rows()) == 76
    for row, _, function, tests in ledger_rows():
        assert callable(resolve(function.strip("`"))) and tests, row
        for name in tests.split():
            assert callable(globals().get(name.strip("`"))), name
            assert row in rows_of(name), (row, name)


def test_every_test_of_a_statement_is_in_the_ledger():
    named = {(row, name.strip("`")) for row, _, _, tests in ledger_rows() for name in tests.split()}
    assert {(row, name) for name in globals() if name.startswith("test_S") for row in rows_of(name)} == named


def test_every_field_that_the_readings_name_exists():
    names = {f.name for f in fields(Config)}
    for line in README.splitlines():
        if re.match(r"\| R\d", line):
            for name in re.findall(r"`(\w+)`", line.split("|")[-2]):
                assert any(field.startswith(name.rstrip(".")) for field in names), (line, name)


def test_the_examples_of_the_readme_run(tmp_path):
    example, executors = re.findall(r"```python\n(.*?)```", README, re.S)
    small = "replace(MAZE, steps=600, pretrain_steps=200, M=2, L=2, trajectory_steps=40)"
    (tmp_path / "example.py").write_text(re.sub(r"replace\(MAZE, .*?\)", small, example + executors))
    done = subprocess.run([sys.executable, "example.py"], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(HERE)},
                          capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    alone, spread = re.findall(r"^(\d+ units, \d+ clusters)$", done.stdout, re.M)
    assert alone == spread


# ------------------------------------------------------------------------------------------------------------- the mutants

MUTANTS = [  # statement, what is wrong, the source, its wrong version, the test that fails
    ('S3.2-03', 'the actions of a path from its end to its start',
     'return b"".join(action for link in self.chain()',
     'return b"".join(action for link in self.chain()[::-1]',
     'test_S3_2_03'),
    ('S3.2-03', 'actions of a prefix shifted by one',
     'tuple(tau.actions[since])',
     'tuple(tau.actions[parent_at:i])',
     'test_S3_2_03'),
    ('S4.1-01', 'batch normalisation stays in training mode after fit',
     '        finally:\n            self.eval()',
     '        finally:\n            pass',
     'test_S4_1_01_R_is_a_probability_of_the_pair_alone'),
    ('S4.1-01', 'batch normalisation in training mode before the first fit',
     'memory_format=torch.channels_last).eval()',
     'memory_format=torch.channels_last)',
     'test_S4_1_01_R_is_a_probability_of_the_pair_alone'),
    ('S4.1-01', 'R is a logit',
     'return torch.sigmoid(self.head(torch.cat([first, second.expand_as(first)], dim=1))).squeeze(1)',
     'return self.head(torch.cat([first, second.expand_as(first)], dim=1)).squeeze(1)',
     'test_S4_1_01_R_is_a_probability_of_the_pair_alone'),
    ('S4.1-02', 'partners from the first trajectory',
     'self._add(f"{source} positive", base + i, base + near, 1, rng)',
     'self._add(f"{source} positive", base + i, near, 1, rng)',
     'test_S4_1_02_pairs_of_a_trajectory_stay_within_it'),
    ('S4.1-02', 'joined without an offset',
     '[part.index + start for part, start',
     '[part.index + 0 * start for part, start',
     'test_S4_1_02_pairs_of_a_trajectory_stay_within_it'),
    ('S4.1-03', 'distance n counts as similar',
     'np.minimum(i + config.n, T))',
     'np.minimum(i + config.n + 1, T))',
     'test_S4_1_03_04_and_05'),
    ('S4.1-03', 'positives look ahead only',
     'np.maximum(i - (config.n - 1), 0)',
     'i',
     'test_S4_1_06_pairs_against_an_enumeration'),
    ('S4.1-04', 'distance N counts as dissimilar',
     'before = np.maximum(i - config.N, 0)',
     'before = np.maximum(i - config.N + 1, 0)',
     'test_S4_1_03_04_and_05'),
    ('S4.1-04', 'the last state is no partner ahead',
     'after = np.maximum(T - 1 - config.N - i, 0)',
     'after = np.maximum(T - 2 - config.N - i, 0)',
     'test_S4_1_06_pairs_against_an_enumeration'),
    ('S4.1-05', 'negatives are all beyond n',
     'k - before[i_far] + i_far + config.N + 1)',
     'k - before[i_far] + i_far + config.n)',
     'test_S4_1_03_04_and_05'),
    ('S4.1-06', 'indices wrap around',
     'near = rng.integers(np.maximum(i - (config.n - 1), 0), np.minimum(i + config.n, T))',
     'near = rng.integers(i - (config.n - 1), i + config.n) % T',
     'test_S4_1_06_indices_are_positions_in_the_trajectory'),
    ('S4.1-06', 'the order of a pair is fixed',
     'swap = rng.random(len(index)) < 0.5',
     'swap = rng.random(len(index)) < 0',
     'test_S4_1_06_pairs_against_an_enumeration'),
    ('S4.1-07', 'labels swapped in training',
     'torch.from_numpy(y).float()',
     'torch.from_numpy(1 - y).float()',
     'test_S4_1_07_R_learns_that_1_means_close'),
    ('S4.1-07', 'classes are not balanced',
     'np.concatenate([c[:size] for c in classes])',
     'np.concatenate([c[: most or len(c)] for c in classes])',
     'test_S4_1_07_classes_are_balanced'),
    ('S4.1-08', 'squared error',
     'loss = F.binary_cross_entropy_with_logits(self(first, second), ',
     'loss = F.mse_loss(torch.sigmoid(self(first, second)), ',
     'test_S4_1_08_the_loss_is_binary_cross_entropy'),
    ('S4.1-08', 'summed over the batch',
     'torch.from_numpy(y).float().to(self.device))',
     "torch.from_numpy(y).float().to(self.device), reduction='sum')",
     'test_S4_1_08_the_loss_is_binary_cross_entropy'),
    ('S4.1-09', 'prefix pairs for the initial cluster too',
     'self.config.prefix and tau.start:',
     'self.config.prefix and tau.start is not None:',
     'test_S4_1_09_prefix_negatives'),
    ('S4.1-09', 'prefix pairs are positive',
     'base + np.arange(len(i)), 0, rng)',
     'base + np.arange(len(i)), 1, rng)',
     'test_S4_1_09_prefix_negatives'),
    ('S4.1-09', 'additional trajectories have no prefix',
     'tau.start, tau.since = met.start, met.frames[1 : i + 1]',
     'pass',
     'test_S4_1_09_the_prefix_of_an_additional'),
    ('S4.1-09', 'the prefix of an additional trajectory is that of the first',
     'met, i = origin[snapshot]',
     'met, i = trajectories[0], origin[snapshot][1]',
     'test_S4_1_09_the_prefix_of_an_additional'),
    ('S4.1-09', 'the prefix of an additional trajectory ends with the centre',
     'path.states() + list(tau.since)',
     'path.states()',
     'test_S4_1_09_the_prefix_of_an_additional'),
    ('S4.1-09', 'the prefix of an additional trajectory ends before its first state',
     'met.frames[1 : i + 1]',
     'met.frames[1:i]',
     'test_S4_1_09_the_prefix_of_an_additional'),
    ('S4.1-09', 'only the last link of the prefix',
     'self.graph.clusters[tau.start].path.states()',
     'list(self.graph.clusters[tau.start].path.frames[-1:])',
     'test_S4_1_09_prefix_negatives'),
    ('S4.2-01', 'the snapshot of the state before',
     'tau.snapshots[i], path, parent)',
     'tau.snapshots[i - 1], path, parent)',
     'test_S4_2_01_a_snapshot_restores_the_centre'),
    ('S4.2-02', 'one action is never taken',
     'integers(env.action_space.n, size=steps)',
     'integers(env.action_space.n - 1, size=steps)',
     'test_S4_2_02_pi_explore_is_uniform_and_blind'),
    ('S4.2-02', 'the walk depends on the state',
     'np.random.default_rng(seed).integers(env',
     'np.random.default_rng([*seed, *snapshot]).integers(env',
     'test_S4_2_02_pi_explore_is_uniform_and_blind'),
    ('S4.2-03', 'a member at theta',
     'if scores[best] > theta:\n                return',
     'if scores[best] >= theta:\n                return',
     'test_S4_2_03_a_member_is_above_theta_not_at_it'),
    ('S4.2-03', 'stale embeddings: centres are embedded once',
     'self.graph.embed_centres(self.similarity)  #',
     "hasattr(self.graph, 'row') or self.graph.embed_centres(self.similarity)  #",
     'test_S4_2_03_membership_by_the_R_of_now'),
    ('S4.2-04', "the state is R's first argument",
     'similarity.score(self.centres[[self.row[v] for v in ids]], s_i)',
     'similarity.score(s_i.expand(len(ids), -1), self.centres[[self.row[v] for v in ids]])',
     'test_S4_2_04_the_centre_is_the_first_argument'),
    ('S4.2-04', 'merge gives R the later cluster first',
     'similarity.score(self.centres[[self.row[v] for v in kept]], self.centres[self.row[later]])',
     'similarity.score(self.centres[self.row[later]].expand(len(kept), -1), self.centres[[self.row[v] for v in kept]])',
     'test_S4_2_04_the_centre_is_the_first_argument'),
    ('S4.2-05', 'only neighbours are searched',
     'for ids in (sorted(self.adjacent[previous] | {previous}), list(self.clusters)):',
     'for ids in (sorted(self.adjacent[previous] | {previous}),):',
     'test_S4_2_05_a_similar_cluster_far_away_is_found'),
    ('S4.2-06', 'the last state is dropped',
     'range(1, len(tau.frames) - self.trim)',
     'range(1, len(tau.frames) - 1 - self.trim)',
     'test_S4_2_06_every_state_in_order_to_the_last'),
    ('S4.2-06', 'a new cluster takes no members before the next iteration',
     'torch.cat([self.centres, s_i[None]])',
     'torch.cat([self.centres, s_i[None] * 0])',
     'test_S4_2_06_every_state_in_order_to_the_last'),
    ('S4.2-07', 'arcs both ways',
     '            if cluster != previous:\n                self.add_arc(previous, cluster, 1)',
     '            if cluster != previous:\n                self.add_arc(previous, cluster, 1)\n                self.add_arc(cluster, previous, 1)',  # noqa: E501
     'test_S4_2_07_and_08'),
    ('S4.2-08', 'self-loops',
     '            if cluster != previous:\n                self.add_arc',
     '            if True:\n                self.add_arc',
     'test_S4_2_07_and_08'),
    ('S4.2-09', 'visits count entries, not states',
     '            self.visit(cluster)\n',
     '            if cluster != previous:\n                self.visit(cluster)\n',
     'test_S4_2_09_visits_are_the_states_assigned'),
    ('S4.2-09', 'a start does not count',
     '        self.visit(previous)\n',
     '',
     'test_S4_2_09_visits_are_the_states_assigned'),
    ('S4.2-09', 'two visits at birth',
     'tau.snapshots[i], path, parent)',
     'tau.snapshots[i], path, parent, 1)\n        self.assigned += 1',
     'test_S4_2_09_visits_are_the_states_assigned'),
    ('S4.2-10', 'arcs are not counted',
     'self.arcs.get((a, b), 0) + visits',
     'visits',
     'test_S4_2_10_arc_visits_are_crossings'),
    ('S4.2-11', 'no visit to begin with',
     'Path(None, s_init[None], (b"",)), None, visits=1)}',
     'Path(None, s_init[None], (b"",)), None, visits=0)}',
     'test_S4_2_11_the_graph_begins_with_s_init'),
    ('S4.2-12', '1 / sqrt(visits)',
     'weights = 1 / np.array([v.visits for v in self.clusters.values()])',
     'weights = 1 / np.sqrt([v.visits for v in self.clusters.values()])',
     'test_S4_2_12_sampled_inversely_to_visits'),
    ('S4.2-12', 'proportional to visits',
     'weights = 1 / np.array([v.visits',
     'weights = np.array([v.visits',
     'test_S4_2_12_sampled_inversely_to_visits'),
    ('S4.2-12', 'sampled uniformly in spite of the distribution',
     'size=self.config.M, p=probabilities)',
     'size=self.config.M)',
     'test_S4_2_12_sampled_inversely_to_visits'),
    ('S4.2-13', 'the best of all, neighbour or not',
     'for ids in (sorted(self.adjacent[previous] | {previous}), list(self.clusters)):',
     'for ids in (list(self.clusters),):',
     'test_S4_2_13_neighbours_first'),
    ('S4.2-13', 'predecessors are no neighbours',
     '        self.adjacent[b].add(a)\n\n',
     '\n',
     'test_S4_2_13_neighbours_first'),
    ('S4.2-13', 'the first match, not the best',
     '            best = int(scores.argmax())\n            if scores[best] > theta:\n                return',
     '            best = int((scores > theta).argmax())\n            if scores[best] > theta:\n                return',
     'test_S4_2_13_the_most_similar_of_those_above_theta'),
    ('S4.2-14', 'the reward is negative',
     'return (x - self.mean) / np.maximum',
     'return (self.mean - x) / np.maximum',
     'test_S4_2_14_the_reward_falls_on_states_trained_on'),
    ('S4.2-14', 'the target is trained',
     '        with torch.no_grad():\n            goal = self.target(x)\n',
     "        goal = self.target(x)\n        self.optimiser.param_groups[0]['params'] = [*self.predictor.parameters(), *self.target.parameters()]\n",  # noqa: E501
     'test_S4_2_14_the_reward_falls_on_states_trained_on'),
    ('S4.2-14', 'the predictor is not trained',
     '        descend(self.optimiser, error.mean(), "RND")\n',
     '',
     'test_S4_2_14_the_reward_falls_on_states_trained_on'),
    ('S4.2-14', 'statistics over all history',
     'deque(maxlen=config.novelty_window)  #',
     'deque()  #',
     'test_S4_2_14_the_reward_counts_standard_deviations'),
    ('S4.2-14', 'moments joined without the shift of the mean',
     ' + delta**2 * (self.count * other.count / total)',
     '',
     'test_S4_2_14_moments_equal_numpy_over_all_data'),
    ('S4.2-15', 'novel at beta',
     'np.flatnonzero(reward > self.config.beta)',
     'np.flatnonzero(reward >= self.config.beta)',
     'test_S4_2_15_and_16'),
    ('S4.2-16', 'one novel state of each trajectory',
     'self.novel += [tau.snapshots[i] for i in found]',
     'self.novel += [tau.snapshots[i] for i in found[:1]]',
     'test_S4_2_15_and_16'),
    ('S4.2-16', 'the snapshot after the novel state',
     'self.novel += [tau.snapshots[i] for i in found]',
     'self.novel += [tau.snapshots[min(i + 1, len(tau.snapshots) - 1)] for i in found]',
     'test_S4_2_16_snapshots_of_B'),
    ('S4.2-17', 'the first ones of B',
     'self.rng("buffer").permutation(len(self.novel))[: self.config.L]',
     'np.arange(len(self.novel))[: self.config.L]',
     'test_S4_2_17_a_random_sample_of_B'),
    ('S4.2-17', 'with replacement',
     'self.rng("buffer").permutation(len(self.novel))[: self.config.L]',
     'self.rng("buffer").integers(len(self.novel), size=min(self.config.L, len(self.novel)))',
     'test_S4_2_17_a_random_sample_of_B'),
    ('S4.2-18', 'additional trajectories cover units',
     'if purpose == "explore" and self.phase == "explore"',
     'if self.phase == "explore"',
     'test_S4_2_18_additional_trajectories_serve_R_alone'),
    ('S4.2-18', 'RND trains on additional states',
     '        self.row |= {"novel_share": novel_share, "additional"',
     '        self.novelty.fit([t.frames for t in additional] or [self.s_init[None]], self.rng("novelty"), self.tell)\n        self.row |= {"novel_share": novel_share, "additional"',  # noqa: E501
     'test_S4_2_18_additional_trajectories_serve_R_alone'),
    ('S4.2-18', 'additional trajectories join G',
     '        self.row |= {"novel_share": novel_share, "additional"',
     '        for t in additional:\n            t.start, t.snapshots = 0, [self.snap_init] * len(t.frames)\n        trajectories += additional\n        self.row |= {"novel_share": novel_share, "additional"',  # noqa: E501
     'test_S4_2_18_additional_trajectories_serve_R_alone'),
    ('S4.2-19', 'the parent is always the start cluster',
     '                parent, parent_at = cluster, i  #',
     '                pass  #',
     'test_S4_2_19_every_cluster_leads_to_the_first_by_its_parents'),
    ('S4.2-20', 'a prefix begins one state late',
     'since = slice(parent_at + 1, i + 1)',
     'since = slice(parent_at + 2, i + 1) if i > parent_at + 1 else slice(i, i + 1)',
     'test_S4_2_20_and_21'),
    ('S4.2-20', "a prefix repeats its parent's centre",
     'since = slice(parent_at + 1, i + 1)',
     'since = slice(parent_at, i + 1)',
     'test_S4_2_20_and_21'),
    ('S4.2-21', 'the full prefix from s back to s_init',
     'return links[::-1]',
     'return links',
     'test_S4_2_20_and_21'),
    ('S4.2-21', 'the joins are walked in the wrong order',
     'for link in self.chain() for frame in link.frames]',
     'for link in self.chain()[::-1] for frame in link.frames]',
     'test_S4_2_20_and_21'),
    ('S4.2-22', 'no test of the distance',
     'eligible = np.clip(len(prefix) - 1 - config.N + i, 0, len(prefix))',
     'eligible = np.full(len(frames), len(prefix))',
     'test_S4_2_22_and_23'),
    ('S4.2-22', 'distance N is enough',
     'np.clip(len(prefix) - 1 - config.N + i,',
     'np.clip(len(prefix) - config.N + i,',
     'test_S4_2_22_and_23'),
    ('S4.2-22', 'the way along the trajectory does not count',
     'np.clip(len(prefix) - 1 - config.N + i,',
     'np.clip(len(prefix) - 1 - config.N + 0 * i,',
     'test_S4_2_22_and_23'),
    ('S4.2-23', 'always s_init',
     '[prefix[j] for j in rng.integers(eligible[i])]',
     '[prefix[0] for j in rng.integers(eligible[i])]',
     'test_S4_2_22_and_23'),
    ('S4.2-24', 'only clusters that an arc joins are tested',
     '            if scores[best] > theta:\n                self.absorb',
     '            if scores[best] > theta and later in self.adjacent[kept[best]]:\n                self.absorb',
     'test_S4_2_24_merge_tests_all_pairs'),
    ('S4.2-24', 'the first similar one, not the most similar',
     '            best = int(scores.argmax())\n            if scores[best] > theta:\n                self.absorb',
     '            best = int((scores > theta).argmax())\n            if scores[best] > theta:\n                self.absorb',
     'test_S4_2_24_merge_tests_all_pairs'),
    ('S4.2-25', 'merge at theta_merge',
     '            if scores[best] > theta:\n                self.absorb',
     '            if scores[best] >= theta:\n                self.absorb',
     'test_S4_2_25_merge_above_theta_merge'),
    ('S4.2-25', 'merge by theta_sim',
     'self.graph.merge(self.similarity, self.config.theta_merge)',
     'self.graph.merge(self.similarity, self.config.theta_sim)',
     'test_S4_2_25_merge_above_theta_merge'),
    ('S4.2-26', 'incoming arcs are lost',
     'earlier if b == later else b)\n            if ends[0] != ends[1]:',
     'earlier if b == later else b)\n            if ends[0] != ends[1] and b != later:',
     'test_S4_2_26_27_and_28'),
    ('S4.2-26', 'arc visits are not summed',
     '                self.add_arc(*ends, visits)',
     '                self.add_arc(*ends, visits - self.arcs.get(ends, 0))',
     'test_S4_2_26_27_and_28'),
    ('S4.2-26', 'merging leaves self-loops',
     '            if ends[0] != ends[1]:\n',
     '            if True:\n',
     'test_S4_2_26_27_and_28'),
    ('S4.2-26', 'adjacency keeps the merged cluster',
     '            self.adjacent[other].discard(later)\n',
     '            pass\n',
     'test_S4_2_26_27_and_28'),
    ('S4.2-27', 'visits of the merged cluster are lost',
     'self.clusters[earlier].visits += self.clusters.pop(later).visits',
     'self.assigned -= self.clusters.pop(later).visits',
     'test_S4_2_26_27_and_28'),
    ('S4.2-28', 'the later centre is kept',
     '        self.clusters[earlier].visits += self.clusters.pop(later).visits\n',
     '        c, d = self.clusters[earlier], self.clusters.pop(later)\n        c.visits, c.frame, c.snapshot = c.visits + d.visits, d.frame, d.snapshot\n',  # noqa: E501
     'test_S4_2_26_27_and_28'),
    ('S4.2-29', 'children of the merged cluster hang on nothing',
     '                v.parent = earlier\n',
     '                pass\n',
     'test_S4_2_28_and_29'),
    ('S4.2-29', 'children of the merged cluster all go to the first',
     '                v.parent = earlier\n',
     '                v.parent = 0\n',
     'test_S4_2_28_and_29'),
    ('S4.2-24', 'rows of the embeddings not renumbered after a merge',
     '        self.centres = self.centres[[self.row[v] for v in kept]]\n',
     '        self.centres = self.centres[: len(kept)]\n',
     'test_S4_2_24_to_29_assignment_and_merge'),
    ('S6.1-02', 'pixels in 0..255',
     '.float() / 255',
     '.float()',
     'test_S6_1_02_the_network_sees_pixels_in_0_to_1'),
    ('S6.1-02', 'pixels in -1..1',
     '.float() / 255',
     '.float() / 127.5 - 1',
     'test_S6_1_02_the_network_sees_pixels_in_0_to_1'),
    ('S6.1-03', 'a block too few',
     'BasicBlock(inputs, width, width // inputs), BasicBlock(width, width, 1)]',
     'BasicBlock(inputs, width, width // inputs)]',
     'test_S6_1_03_and_04'),
    ('S6.1-03', "no residual connection's own projection",
     '        if stride > 1:\n',
     '        if False:\n',
     'test_S6_1_03_and_04'),
    ('S6.1-03', 'the batch is not halved in training',
     'for half in x.chunk(2)])',
     'for half in x.chunk(1)])',
     'test_S6_1_03_resnet18_trains'),
    ('S6.1-03', 'every activation is kept',
     'checkpoint_sequential(self, 3, half, use_reentrant=False)',
     'super(Frugal, self).forward(half)',
     'test_S6_1_03_resnet18_trains'),
    ('S6.1-04', 'five layers',
     '((2 * d, w), (w, w), (w, w), (w, 1))',
     '((2 * d, w), (w, w), (w, w), (w, w), (w, 1))',
     'test_S6_1_03_and_04'),
    ('S6.1-04', "the pair's embeddings interleaved in training, not halved",
     'torch.cat(embeddings.chunk(2), dim=1)',
     'embeddings.view(len(first), -1)',
     'test_S6_1_03_and_04'),
    ('S4-05', 'RND is trained before the filter',
     '        trajectories = self.explore()\n        pairs = self.make_pairs(trajectories)',
     '        trajectories = self.explore()\n        self.train_novelty(trajectories)\n        pairs = self.make_pairs(trajectories)',  # noqa: E501
     'test_S4_05_the_filter_uses_rnd_from_before_and_rnd_learns_exploration_states_only'),
    ('S4-03', 'G is updated before R is trained',
     '        self.train_similarity(pairs)\n        self.update_graph(trajectories)',
     '        self.update_graph(trajectories)\n        self.train_similarity(pairs)',
     'test_S4_03_S4_04_S4_05_the_five_steps_are_called_in_the_papers_order'),
    ('S4-03', 'centres keep the embeddings of an older R',
     '        self.graph.embed_centres(self.similarity)  # R has changed',
     "        hasattr(self.graph, 'centres') or self.graph.embed_centres(self.similarity)  # R has changed",
     'test_S4_03_states_are_assigned_by_the_trained_R_to_centres_embedded_anew'),
    ('S4-01', 'one trajectory too few',
     'size=self.config.M, p=probabilities',
     'size=max(1, self.config.M - 1), p=probabilities',
     'test_S4_01_'),
    ('S6.1-11', 'clusters sampled without replacement',
     'size=self.config.M, p=probabilities)',
     'size=min(len(ids), self.config.M), p=probabilities, replace=False)',
     'test_S4_01_'),
    ('S4-02', 'pairs of exploration trajectories only',
     '(("exploration", trajectories), ("additional", additional))',
     '(("exploration", trajectories),)',
     'test_S4_02_'),
    ('S4-06', 'pairs of earlier iterations are kept',
     'maxlen=self.config.replay_iterations)',
     'maxlen=self.config.replay_iterations + 1)',
     'test_S4_06_'),
    ('S4-06', 'B persists',
     'self.novel = self.novel if self.config.keep_buffer else []',
     'self.novel = self.novel',
     'test_S4_06_'),
    ('S5-03', 'additional trajectories count as coverage',
     'if purpose == "explore" and self.phase == "explore" and unit is not None:',
     'if self.phase == "explore" and unit is not None:',
     'test_S5_03_S5_04_coverage'),
    ('S5-03', 'coverage counts in pretraining',
     'if purpose == "explore" and self.phase == "explore" and unit is not None:',
     'if purpose == "explore" and unit is not None:',
     'test_S5_03_S5_04_coverage'),
    ('R2', 'steps of pretraining are free',
     '                    self.steps += 1\n',
     '                    self.steps += 1 if self.phase == "explore" or self.steps < end - 1 or purpose == "explore" else 0\n',
     'test_S3_2_02_a_rollback_costs_no_step'),
    ('R2', 'additional steps are free',
     '                    self.steps += 1\n',
     '                    self.steps += purpose == "explore"\n',
     'test_S3_2_02_a_rollback_costs_no_step'),
    ('S6.2-04', 'budget overrun by the last trajectory',
     'min(steps, end - self.steps), purpose',
     'steps, purpose',
     'test_S6_2_04_'),
    ('S6.1-06', 'one step beyond the cap',
     'self.seed(purpose, k), min(steps, end',
     'self.seed(purpose, k), min(steps + 1, end',
     'test_S4_01_'),
    ('S6.1-07', 'the terminal state of a death is stored',
     '        if terminated:\n            break\n',
     '        truncated = truncated or terminated\n',
     'test_S6_1_07_a_death'),
    ('R24', 'blank frames become states',
     'if not info.get("blank"):',
     'if True:',
     'test_R24_blank'),
    ('R24', 'actions across blank frames are lost',
     '        since += bytes([action])\n',
     '        since = bytes([action])\n',
     'test_R24_blank'),
    ('S6.1-15', 'the restart does not reset G',
     '[], Graph(self.s_init, self.snap_init, self.config)\n        self.discovered',
     '[], self.graph\n        self.discovered',
     'test_S6_1_14_'),
    ('S6.1-15', 'the restart makes R anew',
     '        self.tell("restart")\n',
     '        initialise(self.similarity, 99)\n        self.tell("restart")\n',
     'test_S6_1_14_'),
    ('S6.1-14', "the restart forgets RND's normalisers",
     '        self.tell("restart")\n',
     '        self.novelty.pixels = Moments()\n        self.tell("restart")\n',
     'test_S6_1_14_'),
    ('S6.1-13', 'theta does not rise',
     'return self.config.theta_sim * share',
     'return self.config.theta_sim',
     'test_S6_1_13_'),
    ('S6.1-13', 'theta rises by the square root',
     'return self.config.theta_sim * share',
     'return self.config.theta_sim * share**0.5',
     'test_S6_1_13_'),
    ('S6.1-10', 'merge at iterations 1, 16, 31',
     'self.iteration % self.config.merge_every == 0',
     'self.iteration % self.config.merge_every == 1',
     'test_S6_1_10_'),
    ('S6.3-01', 'no-merge merges',
     'if self.config.merge and self.iteration',
     'if self.iteration',
     'test_S6_1_10_'),
    ('S6.3-03', 'merge uses theta_sim',
     'self.graph.merge(self.similarity, self.config.theta_merge)',
     'self.graph.merge(self.similarity, self.config.theta_sim)',
     'test_S6_3_03_'),
    ('S6.3-02', 'no-prefix changes the other pairs',
     'Pairs(), self.rng("pairs"), self.rng("prefix")',
     'Pairs(), *[self.rng("pairs")] * 2',
     'test_S6_3_02_'),
    ('S3.2-03', 'a prefix misses its first action',
     'path = Path(self.clusters[parent].path, tau.frames[since].copy(), tuple(tau.actions[since]))',
     'path = Path(self.clusters[parent].path, tau.frames[since].copy(), tuple(tau.actions[slice(parent_at, i)]))',
     'test_S3_2_03_'),
    ('S4-05', 'additional states reach RND',
     '        self.train_novelty(trajectories)\n\n',
     "        self.train_novelty(trajectories + self.collect('additional', [trajectories[0].snapshots[0]], 9))\n\n",
     'test_S4_05_'),
    ('R10', 'trim does nothing',
     'range(1, len(tau.frames) - self.trim)',
     'range(1, len(tau.frames))',
     'test_R10_trim'),
    ('option', 'one cluster more than max_clusters',
     'len(ids) >= self.max_clusters',
     'len(ids) > self.max_clusters',
     'test_max_clusters'),
    ('option', 'a refused state stays with the previous cluster',
     'self.refused += 1\n            return ids[best]',
     'self.refused += 1\n            return previous',
     'test_max_clusters'),
    ('resume', 'B is forgotten',
     'a.novel = [bytes.fromhex(x) for x in state["buffer"]]',
     'a.novel = []',
     'test_a_packed_state'),
    ('resume', 'refusals are forgotten',
     'g.created, g.assigned, g.refused = state["graph"]',
     'g.created, g.assigned, _ = state["graph"]',
     'test_a_packed_state'),
    ('contract', 'actions begin at 0',
     'info = env.step(action + int(env.action_space.start))',
     'info = env.step(action)',
     'test_where_actions'),
    ('contract', "the environment's own array is kept",
     'frames.append(frame.copy())',
     'frames.append(frame)',
     'test_where_actions'),
    ('R3', 'additional trajectories as long as others',
     'sample, self.config.additional_steps)',
     'sample, self.config.trajectory_steps)',
     'test_R3_'),
    ('trace', 'rewards of other states',
     'reward=reward[found].tolist()',
     'reward=reward[: len(found)].tolist()',
     'test_R3_'),
    ('option', 'pretraining may take all steps',
     'if self.pretrain_steps >= self.steps',
     'if self.pretrain_steps > self.steps',
     'test_values_at'),
    ('R24', 'no end on a blank frame',
     '        if truncated:\n            break\n    return',
     '        if truncated and not info.get("blank"):\n            break\n    return',
     'test_nothing_steps'),
    ('R2', 'exploration in pretraining is not counted',
     'self.exploration_steps += purpose == "explore"\n',
     'self.exploration_steps += purpose == self.phase\n',
     'test_S4_01_'),
    ('S4.1-07', 'true positives and negatives exchanged',
     'pairs.y[chosen] == 1\n',
     'pairs.y[chosen] == 0\n',
     'test_rates'),
    ('R18', "R's gradient is not clipped",
     '        nn.utils.clip_grad_norm_([w for group in optimiser.param_groups for w in group["params"]], clip)\n',
     '        pass\n',
     'test_R18_'),
    ('R20', 'no batch normalisation in the head',
     'head += [nn.BatchNorm1d(inputs), nn.ReLU(inplace=True),',
     'head += [nn.ReLU(inplace=True),',
     'test_R20_'),
    ('R4', 'errors from before the training of their states',
     'self.distance(part).cpu().numpy() for part in parts])))',
     'part for part in errors])))',
     'test_R4_pixels_are_clipped'),
    ('R29', 'a state may be unlike itself',
     'return torch.where(same, 1.0, self.probability(first, second)).cpu()',
     'return self.probability(first, second).cpu()',
     'test_R29_'),
    ('R29', 'only to the last bit',
     'rounding = 1e-5 *',
     'rounding = 0 *',
     'test_R29_'),
    ('R29', 'one equal number of the embedding suffices',
     '(first - second).abs().amax(1)',
     '(first - second).abs().amin(1)',
     'test_R29_'),
    ('R4', 'pixels are not clipped',
     '.clip(-5, 5)',
     '',
     'test_R4_'),
    ('S6.2-03', 'PPO lowers the entropy',
     '- p.entropy * entropy',
     '+ p.entropy * entropy',
     'test_ppo_update'),
    ('S6.2-03', 'PPO takes the better of the two ratios',
     'gain = torch.min(ratio',
     'gain = torch.max(ratio',
     'test_ppo_update'),
    ('S6.2-03', 'PPO clips from the wrong side',
     'ratio.clamp(1 - p.clip,',
     'ratio.clamp(p.clip,',
     'test_ppo_update'),
    ('S6.2-03', 'advantages are not centred',
     '(advantages - advantages.mean()) /',
     'advantages /',
     'test_ppo_standardises'),
    ('S6.2-03', 'the bonus sees the oldest frame',
     'seen[..., -self.channels :].reshape(after.shape)',
     'seen[..., : self.channels].reshape(after.shape)',
     'policy_sees'),
    ('S6.2-03', "ICM's forward model sees its goal",
     'torch.cat([phi.detach(), F.one_hot',
     'torch.cat([phi_next.detach(), F.one_hot',
     'test_the_bonuses'),
    ('S6.2-03', 'the error of the state left',
     'self.rnd.distance(part).cpu().numpy() for part in chunks(after)',
     'self.rnd.distance(part).cpu().numpy() for part in chunks(before)',
     'test_the_bonuses'),
    ('S3.2-03', 'verify compares frames alone',
     '        replayed = replayed and unit == a.env.unit()\n',
     '',
     'test_verify_tells'),
    ('R17', 'the surplus of the larger class is never drawn',
     '[rng.permutation(np.flatnonzero(self.y == y)) for y in (0, 1)]',
     '[np.flatnonzero(self.y == y) for y in (0, 1)]',
     'test_R17_'),
    ('seeds', 'all purposes share one stream',
     '[self.config.seed, self.iteration, PURPOSES.index(purpose), index + 1]',
     '[self.config.seed, self.iteration, index + 1]',
     'test_each_purpose'),
    ('seeds', 'every seed has the same networks',
     'generator = torch.Generator().manual_seed(seed)',
     'generator = torch.Generator().manual_seed(0)',
     'test_each_seed'),
    ('seeds', 'the environment is not seeded',
     'self.s_init = self.env.reset(seed=self.config.seed)[0].copy()\n        self.snap_init, self.unit_init',
     'self.s_init = self.env.reset()[0].copy()\n        self.snap_init, self.unit_init',
     'test_a_seeded'),
    ('R18', "R's learning rate falls anew in each pass",
     'config.r_anneal * done / total)',
     'config.r_anneal * k / len(batches))',
     'test_R18_annealed_the_rate_of_R_falls_linearly_from_one_iteration_to_the_next'),
    ('R18', "R's learning rate does not fall",
     'config.r_anneal * done / total)',
     'config.r_anneal * 0)',
     'test_R18_annealed_the_rate_of_R_falls_linearly_from_one_iteration_to_the_next'),
    ('R18', 'the gradient is clipped after the step',
     '    if clip is not None:\n        nn.utils.clip_grad_norm_([w for group in optimiser.param_groups for w in group["params"]], clip)\n    optimiser.step()\n',  # noqa: E501
     '    optimiser.step()\n    if clip is not None:\n        nn.utils.clip_grad_norm_([w for group in optimiser.param_groups for w in group["params"]], clip)\n',  # noqa: E501
     'test_R18_the_gradient'),
    ('R18', "RND's size is fixed",
     'if config.rnd_encoder == "small" else NATURE, config.rnd_features\n        with',
     'if config.rnd_encoder == "small" else NATURE, 512\n        with',
     'test_R18_R20'),
    ('R19', 'rates of pairs that R knows',
     'rates(self.similarity, pairs, self.rng("rates"))',
     'rates(self.similarity, Pairs.joined([*self.replay, pairs]), self.rng("rates"))',
     'test_R19_rates'),
    ('S4.2-20', 'a prefix keeps its whole trajectory in memory',
     'tau.frames[since].copy()',
     'tau.frames[since]',
     'test_a_prefix_does'),
    ('S6.2-04', 'a spent budget is not noticed',
     "paper's order. Returns its metrics.\"\"\"\n        check_budget(self)\n",
     "paper's order. Returns its metrics.\"\"\"\n",
     'test_no_method_iterates'),
    ('S5-03', 'coverage keeps last visits',
     '            self.discovered.setdefault(unit_key(unit), self.steps)\n        return frame',
     '            self.discovered[unit_key(unit)] = self.steps\n        return frame',
     'test_baselines_record'),
    ('S6.2-03', "ICM's losses exchange their weights",
     '(1 - self.beta) * inverse + self.beta * forward,',
     'self.beta * inverse + (1 - self.beta) * forward,',
     'test_icm_beta'),
    ('S6.2-03', 'the oracle always plays level 1',
     'functools.partial(ExactMaze, maze.level, maze.frame_size)',
     'functools.partial(ExactMaze, frame_size=maze.frame_size)',
     'test_the_oracle'),
    ('S4-01', 'the same draws in every iteration',
     'self.rng("sample").choice',
     'np.random.default_rng(self.config.seed).choice',
     'test_sample_differs'),
    ('R28', 'iterations of pretraining do not count for the merge',
     'if self.config.merge and self.iteration %',
     'if self.config.merge and self.phase == "explore" and self.iteration %',
     'test_R28_'),
    ('S6.1-15', 'the restart counts iterations, and so seeds, anew',
     'self.phase, self.novel, self.graph = "explore", [], Graph',
     'self.phase, self.iteration, self.novel, self.graph = "explore", 0, [], Graph',
     'test_R28_'),
    ('S4.1-08', 'gradients of all batches are summed',
     '    optimiser.zero_grad()\n',
     '',
     'test_R_trains_in'),
    ('R20', 'batch normalisation is frozen in training',
     '        self.train()\n        try:',
     '        self.eval()\n        try:',
     'test_R_trains_in'),
    ('R6', 'the statistics of pixels come after the training',
     '        for part in parts:\n            self.pixels.join(Moments(part))\n        states,',
     '        states,',
     'test_the_pixels'),
    ('S6.2-03', 'actions are no sample of the policy',
     'rng.gumbel(size=self.n)',
     'rng.normal(size=self.n)',
     'test_actions_are_a_sample'),
    ('S6.2-03', 'no value after the rollout',
     'self.env.snapshot(), self.one(k)[1]\n',
     'self.env.snapshot(), 0.0\n',
     'test_the_value_after'),
    ('S6.2-03', 'discount and lambda exchanged',
     'values, *ends, p.gamma, p.gae_lambda, p.episodic)',
     'values, *ends, p.gae_lambda, p.gamma, p.episodic)',
     'test_ppo_discounts'),
]

warnings.filterwarnings("ignore", category=pytest.PytestUnknownMarkWarning)  # no configuration file registers the mark


def pytest_generate_tests(metafunc):
    if "mutant" in metafunc.fixturenames:
        asked = "mutants" in metafunc.config.option.markexpr
        metafunc.parametrize("mutant", MUTANTS if asked else [None], ids=lambda m: f"{m[0]} {m[1]}" if m else "all")


@pytest.mark.mutants
def test_mutant_is_killed(mutant, tmp_path):
    if mutant is None:
        pytest.skip(f"{len(MUTANTS)} wrong versions take a quarter of an hour: pytest -m mutants runs them")
    _, _, right, wrong, test = mutant
    source = (HERE / "rbexplore.py").read_text()
    assert source.count(right) == 1, "the mutant does not apply"
    (tmp_path / "rbexplore.py").write_text(source.replace(right, wrong))
    for name in ("envs.py", "test_rbexplore.py", "README.md"):
        (tmp_path / name).write_text((HERE / name).read_text())
    done = subprocess.run([sys.executable, "-m", "pytest", "-qx", "-p", "no:cacheprovider", "-k", test, "test_rbexplore.py"],
                          cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert done.returncode == 1, done.stdout  # a test or its set-up failed; 2 would be: no test could be collected
