"""Evidence that the code does what the paper says.

How to read this. The tests follow the ledger (README). `pytest -k S4_2_03` runs the tests of
statement S4.2-03, and fails for a build that gets it wrong; the first test of an id is the one to
read beside the paper. R and a number is a reading. Below the second line stands what the paper says
nothing about.

A frame holds a number, 1000 * trajectory + step, so that a test reads from a frame which state it
shows. R is mostly a stub, a function of two such numbers: no test depends on which states the float
arithmetic of a processor happens to call similar.
"""

import csv
import functools
import gzip
import io
import json
import math
import multiprocessing
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict, replace

import gymnasium
import matplotlib
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from gymnasium.utils.env_checker import check_env
from PIL import Image
from torch import nn

import envs
import rbexplore
from envs import (
    InputError,
    Maze,
    Montezuma,
    PrinceOfPersia,
    check_contract,
    make_env,
    unit_key,
)
from rbexplore import (
    ICM,
    MAZE,
    PPO,
    RND,
    Cells,
    Config,
    Coverage,
    Graph,
    RbExplore,
    RNDBonus,
    Run,
    SimilarityModel,
    State,
    Trajectory,
    advantages_of,
    draw,
    main,
    make_method,
    verify,
    walk,
)

torch.set_num_threads(1)  # networks this small are faster so
HERE = pathlib.Path(__file__).parent
TINY = replace(
    MAZE, steps=800, pretrain_steps=400, M=4, L=3, trajectory_steps=40, merge_every=2, epochs=1
)

# --------------------------------------------------------------------------------------- helpers


def frame(number):
    """A picture that holds a number."""
    picture = np.zeros((32, 32), np.uint8)
    picture[0, 0], picture[0, 1] = divmod(number, 256)
    return picture


def number(picture):
    return int(picture[0, 0]) * 256 + int(picture[0, 1])


def numbers(frames):
    return [number(picture) for picture in frames]


def numbered(pairs):
    """Pairs as (i, j, y)."""
    return [(number(s_1), number(s_2), y) for s_1, s_2, y in pairs]


def tau(states):
    """A trajectory of states that hold these numbers; its actions are the numbers' last bytes."""
    actions = [b""] + [bytes([k % 256]) for k in states[1:]]
    snapshots = [b"%d" % k for k in states]
    units = [(k,) for k in states[1:]]
    return Trajectory(np.stack([frame(k) for k in states]), snapshots, actions, units, False, False)


class Stub(nn.Module):
    """An R that is a function of two numbers; it records which pairs were asked for."""

    def __init__(self, R):
        super().__init__()
        self.R = R
        self.asked = []

    def embed(self, frames):
        return torch.tensor([[float(number(picture))] for picture in frames])

    def score(self, e_1, e_2):
        pairs = [(int(a), int(b)) for a, b in zip(e_1[:, 0], e_2.expand_as(e_1)[:, 0], strict=True)]
        self.asked += pairs
        return np.array([float(self.R(a, b)) for a, b in pairs])

    def rates(self, pairs, rng):
        return None, None

    def fit(self, pairs, rng):
        return None


def tens(a, b):
    """R: numbers of the same ten are similar."""
    return a // 10 == b // 10


def table(values):
    """R from a table; 0 for pairs that are not in it."""
    return lambda a, b: values.get((a, b), 0.0)


def grown(walks, R=tens, theta=0.5):
    """G from state 0 after walks (start cluster, numbers). Returns G and its R."""
    stub = Stub(R)
    graph = Graph(State(frame(0), b"0"))
    graph.embed_centres(stub)
    for start, states in walks:
        graph.add_trajectory(start, tau(states), stub, theta)
    return graph, stub


def centres(graph):
    return {v: number(cluster.frame) for v, cluster in graph.clusters.items()}


def visits(graph):
    return {v: cluster.visits for v, cluster in graph.clusters.items()}


def pictures(count, seed=0, size=32):
    """Frames of noise."""
    return np.random.default_rng(seed).integers(256, size=(count, size, size)).astype(np.uint8)


class Grid(gymnasium.Env):
    """7 x 7 places, seen in the frame; 4 actions. Column 5 is a blank screen, the corner (6, 6)
    kills, the corner (0, 6) truncates the episode."""

    observation_space = Box(0, 255, (32, 32), np.uint8)
    action_space = Discrete(4)
    full_coverage = 49
    rewards = None  # a generator of rewards

    def picture(self):
        picture = np.zeros(self.observation_space.shape, np.uint8)
        if self.place[0] != 5:
            picture[4 * self.place[0] : 4 * self.place[0] + 4, 4 * self.place[1] + 1] = 255
            picture[31, 31] = 77
        return picture

    def reset(self, *, seed=None, options=None):
        self.place = (0, 0)
        return self.picture(), {}

    def step(self, action):
        dx, dy = [(-1, 0), (1, 0), (0, -1), (0, 1)][action]
        self.place = (min(max(self.place[0] + dx, 0), 6), min(max(self.place[1] + dy, 0), 6))
        reward = 0.0 if self.rewards is None else float(self.rewards.normal())
        dead = self.place == (6, 6)
        return self.picture(), reward, dead, self.place == (0, 6), {"blank": self.place[0] == 5}

    def snapshot(self):
        return bytes(self.place)

    def restore(self, snapshot):
        self.place = tuple(snapshot)
        return self.picture()

    def unit(self):
        return None if self.place == (6, 6) else self.place


def explorer(env_fn=Maze, config=TINY, **changes):
    return RbExplore(env_fn, replace(config, **changes))


def restarted(env_fn=Maze, **changes):
    """An algorithm after its pretraining."""
    a = explorer(env_fn, pretrain_steps=0, **changes)
    a.restart()
    return a


def plain(x):
    """A state dict as plain data, to compare."""
    if torch.is_tensor(x):
        return x.numpy().tobytes()
    if isinstance(x, dict):
        return {key: plain(value) for key, value in x.items()}
    return [plain(value) for value in x] if isinstance(x, list | tuple) else x


def walking(a, states):
    """Let every walk of an algorithm visit states with these numbers."""
    a.walks = lambda starts, seeds, limit: [tau(states)] * len(starts)


def pairs_made(a, starts, trajectories, seed=0):
    """The pairs of step 2, as (i, j, y)."""
    return numbered(a.make_pairs(starts, trajectories, np.random.default_rng(seed))[0])


# ------------------------------------------------------------ 3.2: persistence; 4: the five steps


def grown_on_the_maze(iterations=4):
    """G of a few iterations on the maze. R is a function of the place where the agent is seen:
    equal places are similar, and neighbouring ones are merged. Returns the algorithm, and what
    merged."""

    def place(picture):
        row, column = divmod(int(picture.argmax()), 32)
        return column // 3 + 20 * (row // 10) + 100 * int(picture[2, 16])

    a = restarted(steps=10**6, M=6, L=0, theta_merge=0.4)
    a.similarity = Stub(lambda s, s_i: 1 / (1 + abs(s - s_i)))
    a.similarity.embed = lambda frames: torch.tensor([[float(place(f))] for f in frames])
    merged = [a.iterate().merged for _ in range(iterations)]
    return a, merged


def test_S3_2_01_any_stored_state_can_be_accessed_again():
    """the environment allows one to save and load states"""
    a, _ = grown_on_the_maze()
    wrong = []
    for v, cluster in a.graph.clusters.items():
        shown = a.env.restore(cluster.snapshot)
        if not np.array_equal(shown, cluster.frame):
            wrong.append(v)
    assert wrong == []


def test_S3_2_02_a_rollback_costs_no_step():
    """instead of a policy, an environment property that allows one to save and load states"""

    class Counting(Maze):
        steps_made = 0

        def step(self, action):
            self.steps_made += 1
            return super().step(action)

    a = explorer(Counting)
    a.env.steps_made = 0
    found = [a.iterate() for _ in range(3)]
    walked = sum(len(t.units) for i in found for t in i.trajectories + i.additional)
    assert a.env.steps_made == walked
    assert a.coverage.steps == walked


def test_S3_2_03_the_stored_actions_lead_from_s_init_to_every_centre():
    """some policy transits the agent from s_init to s_v in a finite number of steps"""
    a, merged = grown_on_the_maze()
    assert sum(map(len, merged)) > 0
    assert len(a.graph.clusters) > 5
    for v, cluster in a.graph.clusters.items():
        shown = a.env.restore(a.initial_state.snapshot)
        for action in a.graph.actions_to(v):
            shown = a.env.step(action)[0]
        assert shown.tobytes() == cluster.frame.tobytes()
        assert a.env.snapshot() == cluster.snapshot


def test_S3_2_03_R24_actions_across_blank_screens_are_stored():
    a = restarted(Grid, steps=3000, merge=False)
    a.similarity = Stub(lambda s, s_i: s == s_i)
    a.similarity.embed = lambda frames: torch.tensor([[float(np.argmax(f))] for f in frames])
    a.run()
    longer = [v for v, arc in a.graph.E_parent.items() if len(arc.actions) >= len(arc.prefix)]
    assert len(longer) > 0
    assert set(verify(a).values()) == {"exact"}


def test_S4_01_step_1_samples_M_clusters_rolls_back_and_explores():
    """sample M clusters from G, roll back to corresponding states, and run exploration"""
    a, _ = grown_on_the_maze()
    starts, trajectories = a.explore(np.random.default_rng(0))
    assert len(starts) == len(trajectories) == a.config.M
    for v, t in zip(starts, trajectories, strict=True):
        assert t.frames[0].tobytes() == a.graph.clusters[v].frame.tobytes()
        assert t.snapshots[0] == a.graph.clusters[v].snapshot
    assert len(set(starts)) > 1


def test_S4_01_a_rollback_to_another_frame_is_an_error():
    a = restarted()
    a.graph.clusters[0].frame = a.graph.clusters[0].frame + 1
    with pytest.raises(InputError, match="restore.. returned a different frame"):
        a.iterate()


def with_novel_states(a, novel, additional=(2000, 2001)):
    """Let RND find these numbers novel, and additional walks visit those."""
    a.rnd.reward = lambda frames: np.array([3.0 * (number(f) in novel) for f in frames])
    a.walks = lambda states, seeds, limit: [
        tau([number(state.frame), *additional]) for state in states
    ]


def test_S4_02_pairs_come_from_exploration_and_from_additional_trajectories():
    """Generate training data from the exploration trajectories and additional trajectories"""
    a = restarted()
    with_novel_states(a, novel=[1003])
    pairs = pairs_made(a, [0], [tau(range(1000, 1006))])
    assert {i for i, _, _ in pairs} == {*range(1000, 1006), 2000, 2001}


def test_S4_03_S4_04_S4_05_the_five_steps_in_order(monkeypatch):
    """1 explore, 2 training data, 3 train R, 4 update G and merge, 5 train the novelty module"""
    a = restarted(M=1)
    calls = []
    steps = ["explore", "make_pairs", "train_similarity", "update_graph", "train_novelty"]

    def recorded(name, step, *arguments):
        calls.append(name)
        return step(*arguments)

    for name in steps:
        monkeypatch.setattr(a, name, functools.partial(recorded, name, getattr(a, name)))
    a.iterate()
    assert calls == steps


def test_S4_03_states_and_centres_are_embedded_by_the_R_just_trained():
    """3. Train the similarity model R. 4. Update the graph G"""
    a = restarted(M=1, L=0)
    a.similarity = Stub(tens)

    def fit(pairs, rng):  # from now on, R sees state k as 100 * k + 50
        a.similarity.embed = lambda f: torch.tensor([[100.0 * k + 50] for k in numbers(f)])

    walking(a, [0, 1, 0])
    assert a.iterate().clusters == [[0, 0, 0]]
    a.similarity.fit = fit
    assert a.iterate().clusters == [[0, 1, 0]]


def test_S4_04_states_are_added_and_then_clusters_are_merged():
    """Update the graph G with states from the exploration trajectories and merge its clusters"""
    a = restarted(theta_merge=0.6)
    a.graph = Graph(State(frame(0), b"0"))
    a.similarity = Stub(lambda s, s_i: 0.5 if s != s_i else 1)
    a.similarity.R = table({(0, 1): 0.0, (1, 2): 0.0, (0, 2): 0.0})
    a.iteration = a.config.merge_every
    assert a.update_graph([0], [tau([0, 1, 2])], 0.5) == ([[0, 1, 2]], {})
    a.similarity.R = table({(0, 3): 0.7})  # above theta_merge: made by add, undone by merge
    assert a.update_graph([0], [tau([0, 3])], 0.8) == ([[0, 3]], {3: 0})


def test_S4_05_RND_trains_on_the_states_of_the_exploration_trajectories():
    """Train the novelty detection module on the states from the exploration trajectories"""
    a = restarted(beta=-1e9)
    a.iterate()
    trained = []
    a.rnd.fit = lambda trajectories, rng: trained.extend(f.tobytes() for f in trajectories)
    i = a.iterate()
    assert len(i.additional) == 3
    assert trained == [t.frames.tobytes() for t in i.trajectories]


def test_S4_05_novelty_is_measured_by_RND_as_trained_before_the_iteration():
    a = restarted(beta=-1e9)
    a.iterate()
    x = pictures(5)
    reward = a.rnd.reward
    before = reward(x)
    during = []
    a.rnd.reward = lambda frames: during.append(reward(x)) or reward(frames)
    a.iterate()
    assert [r.tobytes() for r in during] == [before.tobytes()] * 4
    assert reward(x).tobytes() != before.tobytes()


def test_S4_06_R_and_RND_train_on_the_data_of_this_iteration_only():
    """trained on the data collected during the current iteration"""
    a = restarted(M=1, L=1, beta=1e9, prefix=False)
    seen_by = {"R": [], "RND": []}
    a.similarity.update = lambda s_1, s_2, y: seen_by["R"].extend(numbers([*s_1, *s_2])) or 0.0
    a.rnd.update = lambda frames: seen_by["RND"].extend(numbers(frames)) or 0.0
    for k in (1000, 2000, 3000):
        walking(a, [0, *range(k, k + 14)])
        a.iterate()
        for seen in seen_by.values():
            assert {state // 1000 for state in seen} == {0, k // 1000}
            seen.clear()


@pytest.mark.parametrize("method", ["rbexplore", "rnd"])
def test_S4_07_no_reward_is_used(method):
    """without rewards and domain knowledge"""

    class Rewarding(Grid):
        rewards = np.random.default_rng(0)

    states = []
    for env_fn in (Grid, Rewarding):
        a = make_method(method, env_fn, replace(TINY, rollout_steps=100))
        for _ in range(3):
            a.iterate()
        states.append(plain(a.state_dict()))
    assert states[0] == states[1]


# ---------------------------------------------------------------------- 4.1: the similarity model


def test_S4_1_01_R_maps_a_pair_to_0_to_1():
    """R: S x S -> [0, 1]"""
    model = SimilarityModel(MAZE, (32, 32))
    with torch.no_grad():
        model.head[-1].weight *= 1000
    R = model.score(model.embed(pictures(40)), model.embed(pictures(40, seed=1)))
    assert R.shape == (40,)
    assert R.min() >= 0
    assert R.max() <= 1
    assert R.max() - R.min() > 0.5


def test_S4_1_01_R_of_a_pair_depends_on_that_pair_alone():
    model = SimilarityModel(MAZE, (32, 32))
    x = pictures(40)
    for pairs in ([], [(x[k], x[-k], k % 2) for k in range(20)]):  # untrained, and trained
        if pairs:
            model.fit(pairs, np.random.default_rng(0))
        R = model.score(model.embed(x), model.embed(x[::-1].copy()))
        for k in (0, 7, 39):
            alone = model.score(model.embed(x[k : k + 1]), model.embed(x[39 - k : 40 - k]))
            assert alone[0] == pytest.approx(R[k], abs=1e-5)


def drawn_pairs(T, n=3, N=6, draws=300):
    """All pairs (i, j, y) that are drawn from a trajectory of states 0 ... T - 1."""
    rng = np.random.default_rng(T)
    frames = tau(range(T)).frames
    return [numbered(rbexplore.pairs_within(frames, n, N, rng)) for _ in range(draws)]


def test_S4_1_02_both_states_of_a_pair_belong_to_one_trajectory():
    """triples (s_i^k, s_j^k, y_ij^k) are constructed for the same trajectory tau^k"""
    a = restarted(prefix=False)
    with_novel_states(a, novel=[2003], additional=range(3000, 3030))
    pairs = pairs_made(a, [0, 0], [tau(range(1000, 1030)), tau(range(2000, 2030))])
    crossing = [(i, j) for i, j, _ in pairs if i // 1000 != j // 1000]
    # 2003 is in two trajectories: it is also the first state of the additional one.
    assert [pair for pair in crossing if 2003 not in pair or max(pair) < 3000] == []
    assert {i // 1000 for i, _, _ in pairs} == {1, 2, 3}


def test_S4_1_03_S4_1_07_similar_states_are_fewer_than_n_steps_apart_and_have_y_1():
    """similar (y = 1) if the distance is less than n steps: |i - j| < n"""
    drawn = {(i, j) for draw_ in drawn_pairs(20, n=3) for i, j, y in draw_ if y == 1}
    assert drawn == {(i, j) for i in range(20) for j in range(20) if abs(i - j) < 3}


def test_S4_1_04_S4_1_07_dissimilar_states_are_more_than_N_steps_apart_and_have_y_0():
    """negative examples (y = 0): more than N steps apart, |i - j| > N"""
    drawn = {(i, j) for draw_ in drawn_pairs(20, N=6) for i, j, y in draw_ if y == 0}
    assert drawn == {(i, j) for i in range(20) for j in range(20) if abs(i - j) > 6}
    assert [y for draw_ in drawn_pairs(7, N=6) for _, _, y in draw_ if y == 0] == []


def test_S4_1_05_distances_from_n_to_N_have_no_label():
    """between n and N: neither similar nor dissimilar"""
    distances = {abs(i - j) for draw_ in drawn_pairs(20, n=3, N=6) for i, j, _ in draw_}
    assert sorted(distances)[:5] == [0, 1, 2, 7, 8]


@pytest.mark.parametrize("T", [1, 4, 8])
def test_S4_1_06_indices_are_positions_in_the_trajectory(T):
    """tau^k = s_1^k, ..., s_T^k"""
    drawn = {(i, j) for draw_ in drawn_pairs(T, n=2, N=6) for i, j, y in draw_ if y == 1}
    assert drawn == {(i, j) for i in range(T) for j in range(T) if abs(i - j) < 2}
    far = {(i, j) for draw_ in drawn_pairs(T, n=2, N=6) for i, j, y in draw_ if y == 0}
    assert far == {(i, j) for i in range(T) for j in range(T) if abs(i - j) > 6}


def test_S4_1_03_S4_1_04_n_and_N_are_those_of_the_configuration():
    a = restarted(n=4, N=12, L=0)
    pairs = []
    for seed in range(40):
        pairs += pairs_made(a, [0], [tau(range(1000, 1030))], seed)
    assert max(abs(i - j) for i, j, y in pairs if y == 1) == 3
    assert min(abs(i - j) for i, j, y in pairs if y == 0) == 13


def test_S4_1_07_y_is_1_for_close_states():
    """predicting whether two states are close in the trajectory (class 1) or not (class 0)"""
    model = SimilarityModel(replace(MAZE, learning_rate=3e-3, epochs=1), (32, 32))
    x = pictures(30)
    close = [(x[k], x[k], 1) for k in range(30)]
    far = [(x[k], x[(k + 7) % 30], 0) for k in range(30)]
    for seed in range(60):
        model.fit(close + far, np.random.default_rng(seed))
    e = model.embed(x)
    assert model.score(e, e).mean() > 0.8
    assert model.score(e, e.roll(7, 0)).mean() < 0.2


def test_S4_1_08_the_loss_is_binary_cross_entropy():
    """E[-y log R(s_1, s_2) - (1 - y) log(1 - R(s_1, s_2))]"""
    model = SimilarityModel(MAZE, (32, 32)).train()
    x = pictures(16)
    y = np.arange(8) % 2
    with torch.no_grad():
        R = torch.sigmoid(model(x[:8], x[8:])).numpy().astype(float)
    expected = np.mean(-y * np.log(R) - (1 - y) * np.log(1 - R))
    assert model.update(x[:8], x[8:], y) == pytest.approx(expected, rel=1e-4)


def test_R18_the_gradient_of_R_is_clipped_at_norm_1_before_the_step():
    model = SimilarityModel(MAZE, (32, 32)).train()
    with torch.no_grad():
        model.head[-1].weight *= 1000
    x = pictures(16)
    model.update(x[:8], x[8:], np.arange(8) % 2)
    # After one step Adam's first moment is 0.1 of the gradient that it was given.
    moments = [s["exp_avg"] for s in model.optimiser.state_dict()["state"].values()]
    norm = math.sqrt(sum(m.square().sum().item() for m in moments)) / 0.1
    assert norm == pytest.approx(1, rel=1e-3)


def full_prefix_of(graph):
    """A graph whose cluster 1 is 40 steps from s_init: its full prefix is 0 ... 39."""
    graph.load_state_dict(grown([(0, range(40))], lambda s, s_i: s_i < 39)[0].state_dict())


def prefix_pairs(start, length=12, novel=(), **changes):
    """The pairs with states of the full prefix, from a trajectory 1000, 1001, ... ."""
    a = restarted(**changes)
    full_prefix_of(a.graph)
    with_novel_states(a, novel)
    pairs = pairs_made(a, [start], [tau(range(1000, 1000 + length))])
    return [(i, j, y) for i, j, y in pairs if j < 1000]


def test_S4_1_09_negative_pairs_with_the_full_prefix_of_the_start_cluster():
    """c) negative examples using the full prefix of the starting cluster of the trajectory"""
    found = prefix_pairs(start=1, length=5)  # which has no dissimilar pair of its own
    assert [i for i, _, _ in found] == [1000, 1001, 1002, 1003, 1004]
    assert {y for _, _, y in found} == {0}
    assert prefix_pairs(start=0) == []


def test_S4_1_09_R29_additional_trajectories_have_no_pairs_with_a_prefix():
    """If the exploration trajectory started from a cluster"""
    found = prefix_pairs(start=1, novel=[1003, 1007])
    assert [i for i, _, _ in found] == list(range(1000, 1012))


@pytest.mark.parametrize("pretraining", [True, False])
def test_S4_1_09_each_trajectory_has_the_prefix_of_its_own_start(pretraining):
    a = explorer(L=0)
    a.pretraining = pretraining
    full_prefix_of(a.graph)
    explored = [tau(range(k, k + 12)) for k in (1000, 2000, 3000)]
    pairs = pairs_made(a, [0, 1, 0], explored)
    assert [i for i, j, _ in pairs if j < 1000] == list(range(2000, 2012))


# ------------------------------------------------------- readings of 4.1: which pairs, how R learns


def test_R17_one_similar_and_one_dissimilar_state_for_each_state():
    for T in (1, 7, 8, 20):
        for draw_ in drawn_pairs(T, n=3, N=6, draws=20):
            assert [i for i, _, y in draw_ if y == 1] == list(range(T))
            partners = [i for i in range(T) if i > 6 or T - 1 - i > 6]
            assert [i for i, _, y in draw_ if y == 0] == partners


def test_R17_partners_are_uniform_among_those_allowed():
    drawn = Counter(pair for draw_ in drawn_pairs(20, draws=2000) for pair in draw_)
    expected = {(10, 1): [8, 9, 10, 11, 12], (0, 1): [0, 1, 2], (10, 0): [0, 1, 2, 3, 17, 18, 19]}
    for (i, y), partners in expected.items():
        counts = [drawn[i, j, y] for j in partners]
        assert sum(counts) == 2000
        assert max(counts) - min(counts) < 200


def test_R17_classes_are_balanced():
    pairs = [(frame(k), frame(k), 1) for k in range(30)] + [(frame(99), frame(99), 0)] * 12
    rng = np.random.default_rng(0)
    draws = [numbered(rbexplore.balanced(pairs, rng)) for _ in range(150)]
    assert {Counter(y for _, _, y in draw_)[0] for draw_ in draws} == {12}
    assert {Counter(y for _, _, y in draw_)[1] for draw_ in draws} == {12}
    assert {i for draw_ in draws for i, _, y in draw_ if y == 1} == set(range(30))


def test_R17_neither_order_nor_position_reveals_the_label():
    pairs = [(frame(0), frame(1), 1), (frame(2), frame(3), 0)] * 12
    rng = np.random.default_rng(0)
    draws = [numbered(rbexplore.balanced(pairs, rng)) for _ in range(200)]
    orders = Counter(pair for draw_ in draws for pair in draw_)
    assert sorted(orders) == [(0, 1, 1), (1, 0, 1), (2, 3, 0), (3, 2, 0)]
    assert max(orders.values()) - min(orders.values()) < 200
    assert 60 < sum(y for (_, _, y), *_ in draws) < 140


def trained_batches(fits, **changes):
    """The batches of `fits` fits of 20 pairs of state k with itself, and the losses returned."""
    model = SimilarityModel(replace(MAZE, **changes), (32, 32))
    batches = []
    model.update = lambda s_1, s_2, y: batches.append((numbers(s_1), y)) or float(len(batches))
    losses = []
    for pairs in fits:
        losses.append(model.fit(pairs, np.random.default_rng(0)))
    return batches, losses


TWENTY = [(frame(k), frame(k), k % 2) for k in range(20)]


def test_R19_R_trains_in_epochs_passes_over_all_pairs_and_returns_the_last_loss():
    batches, losses = trained_batches([TWENTY], epochs=3, r_batch=8)
    assert [len(states) for states, _ in batches] == [7, 7, 6] * 3
    for k in (0, 3, 6):
        assert sorted(sum((states for states, _ in batches[k : k + 3]), [])) == list(range(20))
    assert losses == [(7 + 8 + 9) / 3]
    wrong = [(s, y) for states, ys in batches for s, y in zip(states, ys, strict=True) if s % 2 - y]
    assert wrong == []


def test_R17_each_pass_has_a_balanced_draw_of_its_own():
    twice_as_many_similar = TWENTY + [(frame(k), frame(k), 1) for k in range(21, 61, 2)]
    batches, _ = trained_batches([twice_as_many_similar], epochs=4, r_batch=100)
    similar = [{s for s in states if s % 2} for states, _ in batches]
    assert {len(states) for states in similar} == {10}
    assert len({frozenset(states) for states in similar}) == 4


def test_R19_where_a_class_is_missing_R_keeps_its_weights():
    """an iteration with hardly any pairs"""
    model = SimilarityModel(MAZE, (32, 32))
    before = plain(model.state_dict())
    x = pictures(3)
    for pairs in ([], [(x[0], x[0], 1)], [(x[0], x[1], 0)]):
        assert model.fit(pairs, np.random.default_rng(0)) is None
        assert model.rates(pairs, np.random.default_rng(0)) == (None, None)
    assert plain(model.state_dict()) == before
    assert model.fit([(x[0], x[0], 1), (x[0], x[1], 0)], np.random.default_rng(0)) > 0


def test_R20_R_is_in_training_mode_only_while_it_trains():
    model = SimilarityModel(MAZE, (32, 32))
    modes = [model.training]

    def update(*batch):
        modes.append(model.training)
        if len(modes) == 4:
            raise KeyboardInterrupt
        return 0.0

    model.update = update
    with pytest.raises(KeyboardInterrupt):
        model.fit(TWENTY, np.random.default_rng(0))
    assert [*modes, model.training] == [False, True, True, True, False]


def test_rates_are_shares_of_the_pairs_whose_frames_differ_at_a_threshold_of_a_half():
    R = {(0, 1): 0.6, (0, 2): 0.5, (0, 3): 0.4, (0, 4): 0.4}
    stub = Stub(lambda a, b: R.get((min(a, b), max(a, b)), 1.0))
    model = SimilarityModel(MAZE, (32, 32))
    model.embed = stub.embed
    model.score = stub.score
    identical = [(frame(k), frame(k), y) for k in range(9) for y in (1, 0)]
    pairs = [(frame(0), frame(k), y) for k in (1, 2, 3, 4) for y in (1, 0)]
    assert model.rates(identical + pairs, np.random.default_rng(0)) == (0.25, 0.75)
    assert model.rates(identical, np.random.default_rng(0)) == (None, None)


def test_rates_are_taken_before_training_and_do_not_shift_what_R_draws():
    a = restarted()
    calls = []
    a.similarity.rates = lambda pairs, rng: calls.append(len(rng.random(5))) or (0.25, 0.75)
    a.similarity.fit = lambda pairs, rng: calls.append(rng.random()) or 3.0
    metrics = a.train_similarity([], np.random.default_rng(0))
    assert calls == [5, np.random.default_rng(0).random()]
    assert metrics == {"r_tpr": 0.25, "r_tnr": 0.75, "r_loss": 3.0}


# --------------------------------------------------- 4.2: the graph of clusters, prefixes and merge


def test_S4_2_01_a_cluster_is_a_state_and_its_snapshot():
    """a cluster v = (s, snap): state s, the center, and the corresponding snapshot"""
    graph, _ = grown([(0, [0, 7, 15, 16, 23])])
    assert centres(graph) == {0: 0, 1: 15, 2: 23}
    assert [v.snapshot for v in graph.clusters.values()] == [b"0", b"15", b"23"]


def test_S4_2_01_each_state_has_a_snapshot_of_its_own_also_where_nothing_is_seen_to_change():
    class Dark(Grid):
        steps = 0

        def picture(self):
            return frame(1)

        def step(self, action):
            self.steps += 1
            return super().step(action)

        def snapshot(self):
            return bytes([*self.place, self.steps])

        def restore(self, snapshot):
            self.steps = snapshot[2]
            return super().restore(snapshot[:2])

    env = Dark()
    env.reset()
    found = walk(env, State(frame(1), bytes([0, 0, 0])), seed=0, max_steps=9)
    assert [snapshot[2] for snapshot in found.snapshots] == list(range(len(found.frames)))


def actions_of_walks(env, count, steps, **place):
    env.reset()
    for name, value in place.items():
        setattr(env, name, value)
    start = State(env.picture(), env.snapshot())
    return [b"".join(walk(env, start, seed, steps).actions) for seed in range(count)]


def test_S4_2_02_pi_explore_is_uniform_over_the_actions():
    """a stochastic policy, e.g. uniform distribution over actions"""
    acted = Counter(b"".join(actions_of_walks(Grid(), count=300, steps=12)))
    total = sum(acted.values())
    chi_square = sum((acted[a] - total / 4) ** 2 / (total / 4) for a in range(4))
    assert total > 2000
    assert chi_square < 16.3  # 3 degrees of freedom: p = 0.001


def test_S4_2_02_R22_an_action_depends_neither_on_the_state_nor_on_the_last_action():
    walks = actions_of_walks(Grid(), count=300, steps=12)
    repeated = [x == y for w in walks for x, y in zip(w, w[1:], strict=False)]
    assert np.mean(repeated) == pytest.approx(1 / 4, abs=0.04)
    there = Counter(b"".join(actions_of_walks(Grid(), count=300, steps=2, place=(3, 3))))
    assert min(there.values()) > 100
    assert max(there.values()) < 200


def test_S4_2_02_actions_begin_where_the_action_space_does():
    class Shifted(Grid):
        action_space = Discrete(4, start=10)

        def step(self, action):
            return super().step(action - 10)

    found = [explorer(env_fn, steps=600).run() for env_fn in (Grid, Shifted)]
    assert found[0].coverage.first_visits == found[1].coverage.first_visits
    assert set(verify(found[1]).values()) == {"exact"}


@pytest.mark.parametrize(("theta", "clusters"), [(0.49, [0]), (0.5, [0, 1]), (0.51, [0, 1])])
def test_S4_2_03_a_state_belongs_to_a_cluster_if_R_is_greater_than_theta_sim(theta, clusters):
    """if R(s, s_i) > theta_sim"""
    graph, _ = grown([(0, [0, 1])], table({(0, 1): 0.5}), theta)
    assert list(graph.clusters) == clusters


def test_S4_2_04_the_centre_is_the_first_argument_of_R():
    """R(s, s_i)"""
    assert len(grown([(0, [0, 1])], table({(0, 1): 1.0}))[0].clusters) == 1
    assert len(grown([(0, [0, 1])], table({(1, 0): 1.0}))[0].clusters) == 2


def test_S4_2_05_otherwise_a_new_cluster_is_created():
    """Otherwise, a new cluster is created"""
    graph, _ = grown([(0, [0, 10, 20, 30, 2])])
    assert centres(graph) == {0: 0, 1: 10, 2: 20, 3: 30}  # 2 is like 0, which is not adjacent
    assert visits(graph) == {0: 3, 1: 1, 2: 1, 3: 1}


def test_S4_2_06_every_state_in_order_to_the_last():
    """for each state s_i of the obtained trajectory"""
    stub = Stub(tens)
    graph = Graph(State(frame(0), b"0"))
    graph.embed_centres(stub)
    assert graph.add_trajectory(0, tau([0, 10, 11, 20, 12, 30]), stub, 0.5) == [0, 1, 1, 2, 1, 3]
    assert graph.add_trajectory(2, tau([20, 31, 40]), stub, 0.5) == [2, 3, 4]


def test_R9_the_first_state_belongs_to_the_cluster_it_starts_from():
    graph, stub = grown([(0, [0, 10])], table({}))
    stub.R = table({(0, 10): 1.0})  # of state 10 with another centre, and not with its own
    assert graph.add_trajectory(1, tau([10, 12]), stub, 0.5) == [1, 2]
    assert visits(graph) == {0: 2, 1: 2, 2: 1}


def test_S4_2_07_successive_states_of_different_clusters_make_an_arc():
    """an arc between those clusters (v_i, v_j) is added"""
    graph, _ = grown([(0, [0, 1, 10, 20])])
    assert set(graph.arcs) == {(0, 1), (1, 2)}


def test_S4_2_08_an_arc_joins_different_clusters():
    """belong to different clusters"""
    graph, _ = grown([(0, [0, 1, 2, 10, 11])])
    assert set(graph.arcs) == {(0, 1)}


def test_S4_2_09_R11_visits_of_a_cluster_are_the_states_assigned_to_it():
    """cluster visit statistics"""
    graph, _ = grown([(0, [0, 1, 10, 11, 12]), (1, [10, 13, 2])])
    assert visits(graph) == {0: 1 + 2 + 1, 1: 3 + 2}


def test_S4_2_10_visits_of_an_arc_are_its_crossings():
    """arc visit statistics"""
    graph, _ = grown([(0, [0, 1, 10, 11, 20, 10, 20, 21, 10])])
    assert graph.arcs == {(0, 1): 1, (1, 2): 2, (2, 1): 2}


def test_S4_2_11_the_graph_is_initialised_with_the_initial_state():
    """initialized with the initial state of the environment (s_init, snap_init)"""
    a = explorer()
    s_init = Maze().reset()[0]
    assert [cluster.frame.tobytes() for cluster in a.graph.clusters.values()] == [s_init.tobytes()]
    assert (visits(a.graph), a.graph.arcs, a.graph.E_parent) == ({0: 1}, {}, {})


def test_S4_2_12_clusters_are_sampled_inversely_to_their_visits():
    """the probability of sampling a cluster is inversely proportional to the number of visits"""
    graph, _ = grown([(0, [0, 10, 11, 12, 13, 20, 21])])
    assert visits(graph) == {0: 2, 1: 4, 2: 2}
    clusters, p = graph.sampling_distribution()
    assert clusters == [0, 1, 2]
    assert p == pytest.approx([0.4, 0.2, 0.4])


def starts_of(graph, M, seed=0, pretraining=False):
    """The clusters that step 1 samples from a graph."""
    a = explorer(M=M)
    a.pretraining = pretraining
    a.graph = graph
    walking(a, [0])
    return a.explore(np.random.default_rng(seed))[0]


@pytest.mark.parametrize("pretraining", [True, False])
def test_S4_2_12_the_samples_follow_these_probabilities(pretraining):
    graph, _ = grown([(0, [0, 10, 11, 12, 13, 20, 21])])
    drawn = Counter(starts_of(graph, M=2000, pretraining=pretraining))
    assert [drawn[v] for v in range(3)] == pytest.approx([800, 400, 800], abs=100)


def test_S4_2_12_R12_with_replacement_also_where_G_has_M_clusters():
    graph, _ = grown([(0, range(0, 100, 10))])
    draws = [starts_of(graph, M=5, seed=seed) for seed in range(20)]
    assert {len(draw_) for draw_ in draws} == {5}
    assert sum(len(set(draw_)) < 5 for draw_ in draws) > 5


def path_graph(R):
    """G = 0 -> 1 -> 2 with centres 0, 10, 20, and R from a table."""
    graph, stub = grown([(0, [0, 10, 20])], table({}))
    stub.R = table(R)
    stub.asked.clear()
    return graph, stub


def found(graph, stub, previous):
    """The cluster of state 21 after a state of cluster `previous`."""
    return graph.find(stub.embed([frame(21)])[0], previous, stub, 0.5)


def test_S4_2_13_R8_clusters_adjacent_to_the_previous_states_cluster_come_first():
    """considering first those vertices which are adjacent to the cluster of s_{i-1}"""
    graph, stub = path_graph({(0, 21): 0.9, (10, 21): 0.6})
    assert found(graph, stub, previous=2) == 1  # a neighbour above theta, though 0 is better
    assert stub.asked == [(10, 21), (20, 21)]


def test_S4_2_13_R8_adjacent_are_the_cluster_itself_predecessors_and_successors():
    graph, stub = path_graph({(20, 21): 0.9})
    assert found(graph, stub, previous=1) == 2
    assert stub.asked == [(0, 21), (10, 21), (20, 21)]


def test_S4_2_13_adjacent_to_the_cluster_of_the_previous_state_not_of_the_start():
    graph, stub = grown([(0, [0, 10, 20, 30])], table({}))
    stub.R = table({(10, 11): 0.9, (20, 22): 0.9, (30, 33): 0.6, (0, 33): 0.9})
    assert graph.add_trajectory(0, tau([0, 11, 22, 33]), stub, 0.5) == [0, 1, 2, 3]


def test_S4_2_13_R7_the_most_similar_of_the_adjacent_clusters_else_of_all():
    graph, stub = path_graph({(20, 21): 0.6, (10, 21): 0.7})
    assert found(graph, stub, previous=2) == 1
    graph, stub = path_graph({(0, 21): 0.8})
    assert found(graph, stub, previous=2) == 0
    graph, stub = grown([(0, [0, 10, 20, 30])], table({}))
    stub.R = table({(0, 21): 0.6, (10, 21): 0.7})
    assert found(graph, stub, previous=3) == 1


# ---------------------------------------------------------------------------------- 4.2: novelty


def test_S4_2_14_the_intrinsic_reward_measures_novelty():
    """an intrinsic reward, which is used as a measure of the state's novelty"""
    rnd = RND(MAZE, (32, 32))
    known = pictures(60)
    known[:, :, 16:] = 0
    new = known[:, :, ::-1].copy()
    for seed in range(12):
        rnd.fit([known], np.random.default_rng(seed))
    errors = rnd.errors(new).mean()
    assert rnd.reward(new).mean() > rnd.reward(known).mean() + 1
    for seed in range(20):
        rnd.fit([new], np.random.default_rng(seed))
    assert rnd.errors(new).mean() < errors / 2


def test_S4_2_14_the_predictor_learns_and_the_target_does_not():
    rnd = RND(MAZE, (32, 32))
    before = [plain(network.state_dict()) for network in (rnd.target, rnd.predictor)]
    rnd.fit([pictures(20)], np.random.default_rng(0))
    assert plain(rnd.target.state_dict()) == before[0]
    assert plain(rnd.predictor.state_dict()) != before[1]


def B_of(rewards, L=100, trajectories=None, seeds=(0,), **changes):
    """The states from which additional walks start, where RND gives these rewards, else 0: one
    list for each seed."""
    a = restarted(L=L, **changes)
    a.rnd.reward = lambda frames: np.array([rewards.get(number(f), 0.0) for f in frames])
    started = []
    a.walks = lambda states, seeds, limit: started.append(states) or iter([])
    trajectories = trajectories or [tau(range(20))]
    for seed in seeds:
        pairs_made(a, [0] * len(trajectories), trajectories, seed)
    return started


def test_S4_2_15_novel_is_what_has_a_reward_greater_than_beta():
    """novel if the intrinsic reward is greater than beta_intrinsic"""
    (started,) = B_of({3: 2.6, 5: 2.5, 8: 9.0, 11: 2.4, 13: -9.0}, beta=2.5)
    assert sorted(numbers(s.frame for s in started)) == [3, 8]


def test_R5_B_holds_the_novel_states_of_this_iteration_only():
    started = B_of({3: 9.0}, seeds=(0, 1))
    assert [numbers(s.frame for s in states) for states in started] == [[3], [3]]


def test_S4_2_16_all_novel_states_are_placed_into_B_with_their_snapshots():
    """all states from the trajectory, detected as novel, are placed into the buffer B"""
    rewards = {0: 3.0, 3: 3.0, 19: 3.0, 31: 3.0}
    (started,) = B_of(rewards, trajectories=[tau(range(20)), tau([0, 30, 31])])
    expected = [(0, b"0"), (0, b"0"), (3, b"3"), (19, b"19"), (31, b"31")]
    assert sorted((number(s.frame), s.snapshot) for s in started) == expected


def test_S4_2_17_a_set_of_states_is_randomly_sampled_from_B():
    """(s_i*, snap_i*) ~ B is randomly sampled from the buffer"""
    rewards = {k: 10.0 + k for k in range(20)}
    draws = [numbers(s.frame for s in draw_) for draw_ in B_of(rewards, L=5, seeds=range(60))]
    drawn = Counter(k for draw_ in draws for k in draw_)
    assert {len(set(draw_)) for draw_ in draws} == {5}
    assert len(drawn) == 20
    assert max(drawn.values()) < 30  # 15 on average: not always the same ones
    (few,) = B_of(rewards, L=5, trajectories=[tau([7, 8])])
    assert sorted(numbers(s.frame for s in few)) == [7, 8]


def test_S4_2_18_additional_trajectories_serve_R_solely():
    """The resulting trajectories are used solely to generate additional training data for R"""
    results = []
    for L, walked in ((2, []), (2, [2000, 2001]), (1, [2000])):
        a = restarted(M=1, beta=0.5, L=L)
        a.similarity = Stub(tens)
        a.rnd.reward = lambda frames: np.arange(len(frames)) * 1.0
        walks = [tau([0, 1000, 1010]), tau([1000, *walked]), tau([1010, *walked])]
        a.walks = lambda states, seeds, limit, walks=walks: [walks.pop(0) for _ in states]
        draws = []
        a.similarity.fit = lambda pairs, rng, draws=draws: draws.append(rng.random())
        trained = []
        a.rnd.fit = lambda trajectories, rng, trained=trained: trained.append(
            (list(map(numbers, trajectories)), rng.random())
        )
        assert len(a.iterate().additional) == L
        results.append((visits(a.graph), list(a.coverage.first_visits.values()), trained, draws))
    assert results[0][:2] == ({0: 2, 1: 1, 2: 1}, [0, 1, 2])
    assert results[0][2][0][0] == [[0, 1000, 1010]]
    assert results == [results[0]] * 3


def test_S4_2_18_R2_their_steps_count_and_their_units_do_not():
    a = restarted()
    a.coverage.first_visits.clear()
    a.walks = lambda states, seeds, limit: [tau([0, 7, 8])]
    a.collect([State(frame(0), b"0")], 20, np.random.default_rng(0), covers=False)
    assert (a.coverage.steps, a.coverage.first_visits) == (2, {})
    a.collect([State(frame(0), b"0")], 20, np.random.default_rng(0), covers=True)
    assert (a.coverage.steps, a.coverage.first_visits) == (4, {(7,): 3, (8,): 4})


# ------------------------------------------------------------------ 4.2: parents, prefixes, merge


def parents(graph):
    return {v: arc.parent for v, arc in graph.E_parent.items()}


def test_S4_2_19_a_new_cluster_gets_an_arc_to_its_parent():
    """a new arc from v to the parent cluster from which v was created is added to E_parent"""
    graph, _ = grown([(0, [0, 10, 20]), (1, [10, 40])])
    assert parents(graph) == {1: 0, 2: 1, 3: 1}


def test_S4_2_19_R13_the_parent_is_the_cluster_last_created_on_the_trajectory_else_its_start():
    graph, _ = grown([(0, [0, 10, 20, 3, 30]), (1, [10, 4, 40, 11, 50])])
    assert parents(graph) == {1: 0, 2: 1, 3: 2, 4: 1, 5: 4}


def test_S4_2_20_R13_the_prefix_from_the_parent_to_v_is_stored_along_with_the_arc():
    """a sequence of states from the parent cluster to v is stored along with the arc"""
    graph, _ = grown([(0, [0, 1, 2, 10, 11, 3, 20]), (1, [10, 12, 4, 30, 31])])
    stored = {v: numbers(arc.prefix) for v, arc in graph.E_parent.items()}
    assert stored == {1: [0, 1, 2, 10], 2: [10, 11, 3, 20], 3: [10, 12, 4, 30]}


def test_S4_2_20_with_its_actions_and_without_the_rest_of_the_trajectory():
    graph, _ = grown([(0, [0, 1, 2, 10, 11, 3, 20])])
    actions = [arc.actions for arc in graph.E_parent.values()]
    assert actions == [bytes([1, 2, 10]), bytes([11, 3, 20])]
    assert [arc.prefix.base for arc in graph.E_parent.values()] == [None, None]


def test_S4_2_21_a_full_prefix_leads_from_s_init_to_s_in_the_order_of_time():
    """a full prefix tau^prefix = s_init, ..., s"""
    graph, _ = grown([(0, [0, 1, 2, 10, 11, 3, 20]), (1, [10, 12, 4, 30, 31])])
    full = {v: numbers(graph.full_prefix(v)) for v in graph.clusters}
    expected = {0: [], 1: [0, 1, 2, 10], 2: [0, 1, 2, 10, 11, 3, 20], 3: [0, 1, 2, 10, 12, 4, 30]}
    assert full == expected
    assert graph.actions_to(3) == bytes([1, 2, 10, 12, 4, 30])
    assert graph.actions_to(0) == b""


def drawn_with_prefix(P, N=6, T=12, draws=400):
    """The pairs drawn from a trajectory 1000, ... with a full prefix 0 ... P - 1."""
    rng = np.random.default_rng(P)
    frames = tau(range(1000, 1000 + T)).frames
    prefix = [frame(k) for k in range(P)]
    return [numbered(rbexplore.pairs_with_prefix(frames, prefix, N, rng)) for _ in range(draws)]


@pytest.mark.parametrize("P", [1, 4, 7, 8, 20])
def test_S4_2_22_R16_s_2_is_sufficiently_distant_from_s_1_along_the_joined_path(P):
    """a sufficiently distant state s_2 in tau^prefix"""
    # On the joined path 0 ... P - 1 ... state i of the trajectory is number P - 1 + i.
    allowed = {(1000 + i, j, 0) for i in range(12) for j in range(P) if (P - 1 + i) - j > 6}
    assert {pair for draw_ in drawn_with_prefix(P) for pair in draw_} == allowed


def test_S4_2_22_the_distance_is_N_of_the_configuration():
    a = restarted(N=30, n=2, additional_steps=31, L=0)
    full_prefix_of(a.graph)
    pairs = []
    for seed in range(60):
        pairs += pairs_made(a, [1], [tau([1000, 1001])], seed)
    assert min(i - 1000 + 39 - j for i, j, _ in pairs if j < 1000) == 31


def test_S4_2_23_s_2_is_randomly_selected():
    """randomly selected"""
    drawn = Counter(pair for draw_ in drawn_with_prefix(20, draws=2000) for pair in draw_)
    counts = [drawn[1000, j, 0] for j in range(13)]  # 19 - j > 6
    assert sum(counts) == 2000
    assert max(counts) - min(counts) < 100


def merged_chain(R, theta=0.5):
    """Clusters 0 -> 1 -> 2 -> 3 -> 4, after merging. Returns G and what merged."""
    graph, stub = grown([(0, [0, 1, 2, 3, 4])], table({}), theta=1)
    stub.R = table(R)
    return graph, graph.merge(stub, theta)


def test_S4_2_24_merge_tests_all_pairs_of_clusters():
    """It tests all pairs of clusters in the graph G"""
    merged = {(i, j): merged_chain({(i, j): 0.9})[1] for j in range(5) for i in range(j)}
    assert merged == {(i, j): {j: i} for j in range(5) for i in range(j)}


def test_S4_2_24_R14_into_the_most_similar_surviving_earlier_cluster():
    assert merged_chain({(1, 4): 0.6, (2, 4): 0.9})[1] == {4: 2}
    assert merged_chain({(0, 1): 0.9, (1, 2): 0.9})[1] == {1: 0}  # 1 is not compared again
    assert merged_chain({(3, 1): 0.9})[1] == {}  # R(earlier, later)
    everything = {(i, j): 1.0 for j in range(5) for i in range(j)}
    assert merged_chain(everything)[1] == {1: 0, 2: 0, 3: 0, 4: 0}


@pytest.mark.parametrize(("theta", "merged"), [(0.69, {1: 0}), (0.7, {}), (0.71, {})])
def test_S4_2_25_merges_if_R_is_greater_than_theta_merge(theta, merged):
    """greater than the selected threshold theta_merge: R(s_1, s_2) > theta_merge"""
    assert merged_chain({(0, 1): 0.7}, theta)[1] == merged


@pytest.mark.parametrize(("pretraining", "theta_sim"), [(True, 0.025), (False, 0.1)])
def test_S4_2_25_S6_1_13_S6_3_03_theta_merge_is_a_parameter_of_its_own(pretraining, theta_sim):
    for theta_merge, merged in ((0.6, {1: 0}), (0.75, {})):
        a = explorer(theta_merge=theta_merge, theta_sim=0.1)
        a.pretraining = pretraining
        a.coverage.steps = 100  # of 400 of pretraining
        assert a.theta_sim_now() == pytest.approx(theta_sim)
        a.graph = Graph(State(frame(0), b"0"))
        a.similarity = Stub(table({(0, 1): 0.7}))
        a.iteration = a.config.merge_every
        assert a.update_graph([0], [tau([0, 1])], theta_sim=0.8) == ([[0, 1]], merged)


def test_S4_2_26_S4_2_08_the_new_cluster_has_all_arcs_of_both_but_those_between_them():
    """The new cluster is incident to any arc that was incident to the two original clusters"""
    graph, stub = grown([(0, [0, 10, 20, 30, 0, 10, 30, 20, 10])])
    before = {(0, 1): 2, (1, 2): 1, (2, 3): 1, (3, 0): 1, (1, 3): 1, (3, 2): 1, (2, 1): 1}
    assert graph.arcs == before
    stub.R = table({(10, 30): 0.9})
    assert graph.merge(stub, 0.5) == {3: 1}
    assert graph.arcs == {(0, 1): 2, (1, 2): 2, (2, 1): 2, (1, 0): 1}
    assert graph.adjacent == {0: {1}, 1: {0, 2}, 2: {1}}


def test_S4_2_27_visits_are_summed():
    """Cluster visits statistics are summarized during merging"""
    graph, stub = grown([(0, [0, 10, 20, 21, 30, 31, 32])])
    stub.R = table({(10, 20): 0.9, (10, 30): 0.9})
    graph.merge(stub, 0.5)
    assert visits(graph) == {0: 2, 1: 1 + 2 + 3}


def test_S4_2_28_R14_state_and_snapshot_are_those_of_the_earlier_cluster():
    """the cluster that was added to the graph G earlier"""
    graph, stub = grown([(0, [0, 10, 20, 21, 22, 30])])
    stub.R = table({(10, 20): 0.9, (0, 30): 0.9})
    assert graph.merge(stub, 0.5) == {2: 1, 3: 0}
    assert centres(graph) == {0: 0, 1: 10}  # also where the later one has more visits
    assert [v.snapshot for v in graph.clusters.values()] == [b"0", b"10"]


def test_S4_2_29_S4_2_19_R15_every_cluster_still_leads_to_the_initial_one():
    """for any cluster in the graph G, it is possible to construct a sequence of states"""
    graph, stub = grown([(0, [0, 1, 2, 3, 4])], table({}))
    assert parents(graph) == {1: 0, 2: 1, 3: 2, 4: 3}
    stub.R = table({(0, 2): 0.9, (1, 3): 0.9})
    assert graph.merge(stub, 0.5) == {2: 0, 3: 1}
    assert parents(graph) == {1: 0, 2: 1, 3: 2, 4: 3}  # by way of clusters that merged
    assert numbers(graph.full_prefix(4)) == [0, 1, 2, 3, 4]


def test_R15_lineages_without_a_living_descendant_are_dropped():
    graph, _ = merged_chain({(0, 4): 0.9, (1, 3): 0.9})
    assert list(graph.clusters) == [0, 1, 2]
    assert sorted(graph.E_parent) == [1, 2]


def test_R15_a_graph_continues_from_its_state_with_new_numbers():
    graph, _ = merged_chain({(0, 2): 0.9, (1, 4): 0.9})  # 0, 1 and 3 live
    other = Graph(State(frame(9), b"9"))
    other.load_state_dict(graph.state_dict())
    stub = Stub(table({}))
    for g in (graph, other):
        g.embed_centres(stub)
        g.add_trajectory(3, tau([3, 70, 80]), stub, 0.5)
    assert centres(other) == {0: 0, 1: 1, 3: 3, 5: 70, 6: 80}  # 4 is not used again
    assert plain(other.state_dict()) == plain(graph.state_dict())
    assert other.adjacent == graph.adjacent
    assert numbers(other.full_prefix(6)) == [0, 1, 2, 3, 70, 80]


class Slow:
    """G, the slow and obvious way: all relations are looked up in the arcs."""

    def __init__(self, scores):
        self.scores = scores
        self.created = 1
        self.arcs = Counter()
        self.centre = {0: 0}
        self.visits = {0: 1}
        self.path = {0: [0]}

    def best(self, candidates, state, theta):
        score, v = max((self.scores[self.centre[v], state], -v) for v in candidates)
        return -v if score > theta else None

    def add(self, start, states, theta):
        at = parent = start
        self.visits[start] += 1
        since = []
        for state in states[1:]:
            since.append(state)
            near = {at}
            near |= {b for a, b in self.arcs if a == at}
            near |= {a for a, b in self.arcs if b == at}
            v = self.best(near, state, theta)
            if v is None:
                v = self.best(self.centre, state, theta)
            if v is None:
                v = self.created
                self.created += 1
                self.centre[v] = state
                self.path[v] = self.path[parent] + since
                self.visits[v] = 0
                parent = v
                since = []
            self.visits[v] += 1
            if v != at:
                self.arcs[at, v] += 1
            at = v

    def merge(self, theta):
        into = {}
        for v in self.centre:
            survivors = [u for u in into if into[u] == u]
            found_ = self.best(survivors, self.centre[v], theta) if survivors else None
            into[v] = v if found_ is None else found_
        arcs = Counter()
        for (a, b), count in self.arcs.items():
            if into[a] != into[b]:
                arcs[into[a], into[b]] += count
        self.arcs = arcs
        kept = [v for v in into if into[v] == v]
        self.visits = {v: sum(self.visits[u] for u in into if into[u] == v) for v in kept}
        self.centre = {v: self.centre[v] for v in kept}


@pytest.mark.parametrize(("theta", "theta_merge"), [(0.8, 0.7), (0.95, 0.85), (0.98, 0.95)])
def test_S4_2_26_S4_2_06_assignment_and_merging_against_the_slow_version(theta, theta_merge):
    rng = np.random.default_rng(0)
    merged = 0
    for _ in range(20):
        scores = rng.random((30, 30))
        slow = Slow(scores)
        graph, stub = grown([], lambda a, b, scores=scores: scores[a, b])
        for turn in range(8):
            start = int(rng.choice(list(slow.centre)))
            states = [slow.centre[start], *rng.integers(30, size=10).tolist()]
            slow.add(start, states, theta)
            graph.add_trajectory(start, tau(states), stub, theta)
            if turn % 4 == 3:
                slow.merge(theta_merge)
                merged += len(graph.merge(stub, theta_merge))
            assert centres(graph) == slow.centre
            assert visits(graph) == slow.visits
            assert graph.arcs == slow.arcs
            paths = {v: numbers(graph.full_prefix(v)) for v in graph.clusters if v}
            assert paths == {v: slow.path[v] for v in graph.clusters if v}
    assert merged > 20


# ----------------------------------------------------------- readings of 4.2: novelty, additional


def test_R3_additional_trajectories_are_short_and_start_from_this_iterations_states():
    a = restarted(beta=-1e9, L=30, additional_steps=13, merge=False)
    a.iterate()
    i = a.iterate()
    states = {s for t in i.trajectories for s in t.snapshots}
    assert [t for t in i.additional if t.snapshots[0] not in states] == []
    assert max(len(t.units) for t in i.additional) == 13
    assert max(len(t.units) for t in i.trajectories) == 40


def test_S4_2_02_S6_1_11_each_walk_of_an_iteration_and_each_iteration_draws_its_own_actions():
    a = restarted(beta=-1e9, L=30, merge=False)
    a.iterate()
    walks = []
    for _ in range(2):
        i = a.iterate()
        walks += [b"".join(t.actions)[:10] for t in i.trajectories + i.additional]
    long = [w for w in walks if len(w) == 10]
    assert len(long) > 30
    assert len(set(long)) == len(long)


def test_R4_the_reward_is_error_minus_mean_over_standard_deviation_of_the_last_five_iterations():
    rnd = RND(MAZE, (32, 32))
    after_training = []
    for k in range(7):
        x = pictures(10 + k, seed=k)
        rnd.fit([x[:5], x[5:]], np.random.default_rng(k))
        after_training.append(rnd.errors(x))
    recent = np.concatenate(after_training[-5:])
    x = pictures(7, seed=9)
    expected = (rnd.errors(x) - recent.mean()) / recent.std()
    assert rnd.reward(x) == pytest.approx(expected, rel=1e-4)


def test_R4_errors_are_mean_squares_on_standardised_observations():
    rnd = RND(MAZE, (32, 32))
    known = pictures(60)
    rnd.fit([known[:25], known[25:]], np.random.default_rng(0))
    x = pictures(7, seed=2)
    z = (x - known.mean(0, dtype=float)) / known.std(0, dtype=float)
    z = torch.from_numpy(z.clip(-5, 5)).float()[:, None]
    with torch.no_grad():
        expected = (rnd.predictor(z) - rnd.target(z)).square().mean(1)
    assert rnd.errors(x) == pytest.approx(expected.numpy(), rel=1e-2)


def test_R4_observations_are_clipped_at_5_standard_deviations():
    rnd = RND(MAZE, (32, 32))
    rnd.pixels.update(np.stack([np.full((32, 32), k, np.uint8) for k in (120, 122)]))
    at = {k: rnd.errors(np.full((1, 32, 32), k, np.uint8))[0] for k in (0, 112, 118, 124, 130, 255)}
    assert at[0] == at[112] != at[118]
    assert at[255] == at[130] != at[124]


def test_R6_before_the_first_training_nothing_is_novel():
    rnd = RND(MAZE, (32, 32))
    assert rnd.reward(pictures(3)).tolist() == [-np.inf] * 3
    a = explorer(beta=-1e9)
    assert [len(a.iterate().additional) for _ in range(2)] == [0, 3]


def test_R18_RND_learns_each_state_once_in_mixed_batches_after_its_statistics():
    rnd = RND(replace(MAZE, rnd_batch=8), (32, 32))
    batches = []
    seen_before = []

    def update(frames):
        batches.append(numbers(frames))
        seen_before.append(rnd.pixels.count)
        return float(len(batches))

    rnd.update = update
    loss = rnd.fit([tau(range(20)).frames, tau(range(20, 30)).frames], np.random.default_rng(0))
    assert loss == 2.5  # the mean of 1, 2, 3, 4
    assert [len(batch) for batch in batches] == [8, 8, 7, 7]
    learned = sum(batches, [])
    assert sorted(learned) == list(range(30))
    assert learned != list(range(30))
    assert seen_before == pytest.approx([30] * 4, abs=0.01)


def test_R18_a_step_of_RND_is_down_its_mean_error_unclipped_by_one_Adam():
    rnd = RND(MAZE, (32, 32))
    with torch.no_grad():
        rnd.predictor[-1].weight *= 100
    x = pictures(8)
    assert rnd.update(x) == pytest.approx(rnd.errors(x).mean(), rel=0.9)
    moments = [s["exp_avg"] for s in rnd.optimiser.state_dict()["state"].values()]
    assert math.sqrt(sum(m.square().sum().item() for m in moments)) / 0.1 > 10
    for seed in range(3):
        rnd.fit([x], np.random.default_rng(seed))
    assert rnd.optimiser.state_dict()["state"][0]["step"] == 4


def test_where_L_is_0_nothing_of_RND_runs():
    a = restarted(L=0)
    a.rnd = None
    i = a.iterate()
    assert (i.novelty, i.additional) == ([], [])
    assert (i.metrics["novel_share"], i.metrics["rnd_loss"]) == (None, None)


# ---------------------------------------- 5 and 6.1: coverage, configuration, pretraining, budget


def test_S5_03_coverage_is_visited_units_over_all_units_of_the_level():
    """% Cov = |U_visited| / |U_full|"""
    coverage = Coverage(full=4, budget=100)
    shares = []
    for unit in ("a", "b", "a", None, "c", "d", "e"):
        coverage.count(unit)
        shares.append(coverage.metrics()["coverage"])
    assert shares == [0.25, 0.5, 0.5, 0.5, 0.75, 1, 1]  # at most 1
    assert coverage.first_visits == {"a": 1, "b": 2, "c": 5, "d": 6, "e": 7}
    coverage.full = None
    assert coverage.metrics() == {"steps": 7, "units": 5, "coverage": None}


def test_S5_03_R25_coverage_is_counted_at_each_step_of_exploration_and_never_falls():
    a = restarted(beta=-1e9)
    seen = {}
    steps = 0
    shares = []
    for _ in range(3):
        i = a.iterate()
        shares.append(i.metrics["coverage"])
        for t in i.trajectories:
            for unit in t.units:
                steps += 1
                if unit is not None:
                    seen.setdefault(unit, steps)
        steps += sum(len(t.units) for t in i.additional)
    assert a.coverage.first_visits == seen | {(6, 1, 2): 0}
    assert shares == sorted(shares)
    assert shares[-1] == len(a.coverage.first_visits) / 187


def test_S6_1_02_the_network_sees_pixels_in_0_to_1():
    """Frame pixels are rescaled to the 0-1 range"""
    model = SimilarityModel(MAZE, (32, 32))
    seen = []
    model.encoder.register_forward_pre_hook(lambda encoder, inputs: seen.append(inputs[0]))
    x = pictures(4)
    x[0, 0, :2] = (0, 255)
    model.embed(x)
    model(x, x)
    assert torch.allclose(seen[0], torch.from_numpy(x[:, None] / 255).float())
    assert torch.allclose(seen[1], torch.cat([seen[0], seen[0]]))


def test_S6_1_02_channels_come_first_at_the_networks_input():
    frames = np.random.default_rng(0).integers(256, size=(2, 8, 6, 3)).astype(np.uint8)
    x = rbexplore.to_input(frames, "cpu")
    assert np.allclose(x, np.moveaxis(frames, 3, 1) / 255)
    assert torch.equal(rbexplore.to_input(frames[..., 0], "cpu"), x[:, :1])


def test_S6_1_03_resnet_18_embeds_a_frame_in_512_numbers():
    """ResNet-18 accepts a frame as input and produces its embedding of dimension 512"""
    model = SimilarityModel(Config(), (96, 96))
    assert model.embed(pictures(2, size=96)).shape == (2, 512)
    weighted = [m for m in model.encoder.modules() if isinstance(m, (nn.Conv2d, nn.Linear))]
    shortcuts = [m for m in weighted if isinstance(m, nn.Conv2d) and m.kernel_size == (1, 1)]
    assert (len(weighted) - len(shortcuts), len(shortcuts)) == (18, 3)
    assert sum(w.numel() for w in model.encoder.parameters()) == 11_432_896


def test_S6_1_03_one_encoder_embeds_both_frames():
    model = SimilarityModel(MAZE, (32, 32))
    encoders = [m for m in model.children() if isinstance(m, nn.Sequential)]
    assert encoders == [model.encoder, model.head]
    x = pictures(8)
    with torch.no_grad():
        logits = model(x[:4], x[4:])
    R = model.score(model.embed(x[:4]), model.embed(x[4:]))
    assert torch.sigmoid(logits).numpy() == pytest.approx(R, abs=1e-5)


def test_S6_1_03_the_layers_of_resnet_18():
    x = rbexplore.to_input(pictures(1, size=96), "cpu")
    sizes = []
    encoder = SimilarityModel(Config(), (96, 96)).encoder
    for layer in encoder.layers:
        x = layer(x)
        sizes.append(tuple(x.shape[1:]))
    stem = [(64, 48, 48)] * 3 + [(64, 24, 24)]
    blocks = [(64, 24, 24), (128, 12, 12), (256, 6, 6), (512, 3, 3)]
    assert sizes == stem + [size for size in blocks for _ in range(2)]
    pool = encoder.layers[3]
    assert isinstance(pool, nn.MaxPool2d)
    assert (pool.kernel_size, pool.stride, pool.padding) == (3, 2, 1)
    x = torch.randn(2, 1, 96, 96, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        mean = encoder.layers(x).mean((2, 3))
        assert torch.allclose(encoder(x), encoder.linear(mean), atol=1e-4)


def test_S6_1_03_a_residual_block_adds_its_input_and_strides_in_its_first_convolution():
    block = rbexplore.BasicBlock(8, 16, stride=2).eval()
    layers = [type(layer).__name__ for layer in block.residual]
    assert layers == ["Conv2d", "BatchNorm2d", "ReLU", "Conv2d", "BatchNorm2d"]
    assert [block.residual[k].stride for k in (0, 3)] == [(2, 2), (1, 1)]
    block = rbexplore.BasicBlock(8, 8).eval()
    nn.init.zeros_(block.residual[-1].weight)
    x = torch.randn(2, 8, 5, 5, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        assert torch.equal(block(x), x.relu())


def test_S6_1_04_R20_concatenated_embeddings_into_four_fully_connected_layers():
    """concatenated and fed into the fully connected network; a four-layer network"""
    head = SimilarityModel(replace(Config(), head_width=48), (96, 96)).head
    linear = [(m.in_features, m.out_features) for m in head if isinstance(m, nn.Linear)]
    assert linear == [(1024, 48), (48, 48), (48, 48), (48, 1)]
    assert [type(layer).__name__ for layer in head] == ["BatchNorm1d", "ReLU", "Linear"] * 4
    small = SimilarityModel(MAZE, (32, 32))
    e_1, e_2 = torch.randn(2, 5, 64, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = torch.sigmoid(small.head(torch.cat([e_1, e_2], dim=1))[:, 0]).numpy()
    assert small.score(e_1, e_2) == pytest.approx(expected)


VALUES = [
    ("S5_01", "frame_size", 96),
    ("S6_1_01", "frameskip", 4),
    ("S6_1_03", "embedding", 512),
    ("S6_1_03", "small_networks", False),
    ("S6_1_06", "trajectory_steps", 1500),
    ("S6_1_08", "n", 5),
    ("S6_1_08", "N", 25),
    ("S6_1_09", "theta_sim", 0.5),
    ("S6_1_09", "theta_merge", 0.5),
    ("S6_1_10", "merge_every", 15),
    ("S6_1_11", "M", 30),
    ("S6_1_12", "beta", 2.5),
    ("S6_1_12", "L", 1000),
    ("S6_1_13", "pretrain_steps", 500_000),
    ("S6_2_04", "steps", 15_000_000),
    ("S6_3_01", "merge", True),
    ("S6_3_02", "prefix", True),
    ("R3", "additional_steps", 50),
    ("R18", "learning_rate", 1e-4),
    ("R18", "r_batch", 256),
    ("R18", "rnd_batch", 256),
    ("R19", "epochs", 4),
    ("R27", "rollout_steps", 128 * 128),
    ("R27", "episode_steps", 4500),
]


@pytest.mark.parametrize(
    ("name", "value"),
    [row[1:] for row in VALUES],
    ids=[f"{row}_{name}" for row, name, _ in VALUES],
)
def test_S6_1_08_S6_1_09_S6_1_12_the_papers_values_are_the_defaults(name, value):
    assert getattr(Config(), name) == value


def test_S6_1_05_the_parameters_are_the_same_on_all_levels():
    """The same algorithm parameters are used for all levels"""
    for words in ("--env=pop --level=1", "--env=pop --level=3", "--env=montezuma"):
        args = rbexplore.parser().parse_args(words.split())
        assert rbexplore.settings_of(args)["config"] == asdict(Config())


def test_R30_the_maze_and_the_small_configuration_differ_in_sizes_only():
    assert (MAZE.n, MAZE.N, MAZE.additional_steps, MAZE.frameskip) == (2, 10, 20, 1)
    small = rbexplore.CONFIGS["small"]
    assert (small.n, small.N, small.additional_steps, small.frameskip) == (5, 25, 50, 4)
    for name in ("beta", "theta_sim", "theta_merge", "merge_every", "epochs", "prefix", "merge"):
        values = {getattr(config, name) for config in (MAZE, small, Config())}
        assert (name, values) == (name, {getattr(Config(), name)})


@pytest.mark.parametrize("pretraining", [True, False])
def test_S6_1_06_R1_a_trajectory_has_at_most_trajectory_steps_agent_steps(pretraining):
    """The maximum number of frames per exploration trajectory is 1,500"""
    a = explorer(Grid, trajectory_steps=23, frameskip=4)
    a.env.step = lambda action: (a.env.picture(), 0.0, False, False, {})
    a.pretraining = pretraining
    _, trajectories = a.explore(np.random.default_rng(0))
    assert {len(t.units) for t in trajectories} == {23}


def walks_on_the_grid(place, count=200, steps=12):
    env = Grid()
    env.reset()
    env.place = place
    start = State(env.picture(), env.snapshot())
    return [walk(env, start, seed, steps) for seed in range(count)]


def test_S6_1_07_a_death_ends_the_trajectory():
    """Episodes are terminated on the loss of life"""
    walks = walks_on_the_grid((6, 4))
    dead = [t for t in walks if t.terminated]
    assert len(dead) > 20
    assert [t for t in dead if t.units[-1] is not None] == []
    assert [t for t in walks if None in t.units[:-1]] == []
    short = [t for t in walks if len(t.units) < 12]
    assert [t for t in short if not t.terminated and t.units[-1] != (0, 6)] == []


def test_S6_1_07_R10_a_terminal_state_is_not_stored():
    for t in walks_on_the_grid((6, 4)):
        assert bytes((6, 6)) not in t.snapshots
        assert len(t.frames) == len(t.snapshots) == len(t.actions)


def test_R10_the_last_state_of_a_truncated_episode_is_stored():
    cut = [t for t in walks_on_the_grid((0, 4)) if t.truncated]
    assert len(cut) > 20
    assert {t.snapshots[-1] for t in cut} == {bytes((0, 6))}
    assert {t.units[-1] for t in cut} == {(0, 6)}


def test_R24_blank_screens_are_stepped_and_counted_but_are_no_states():
    walks = walks_on_the_grid((4, 3), count=40, steps=20)
    assert [f for t in walks for f in t.frames if not f.any()] == []
    assert max(len(actions) for t in walks for actions in t.actions) > 1
    more_steps_than_states = [t for t in walks if len(t.units) > len(t.frames) - 1]
    assert len(more_steps_than_states) > 10
    ended = [t for t in walks if t.units[-1] not in ((5, y) for y in range(7)) and not t.terminated]
    assert [t for t in ended if sum(map(len, t.actions)) != len(t.units)] == []


def merges_of(iterations, restart_at=None, **changes):
    """At which iterations clusters are merged."""
    a = explorer(Grid, L=0, steps=10**6, merge_every=15, **changes)
    walking(a, [0, 1])
    a.similarity = Stub(tens)
    ran = []
    for _ in range(iterations):
        if a.iteration == restart_at:
            a.restart()
        a.graph.merge = lambda *arguments: ran.append(a.iteration) or {}
        a.iterate()
    return ran


def test_S6_1_10_merging_runs_every_15_iterations():
    """Merge is run every 15 iteration"""
    assert merges_of(31) == [15, 30]


def test_S6_1_10_R28_iterations_of_pretraining_are_counted():
    assert merges_of(31, restart_at=17, pretrain_steps=10**5) == [15, 30]


def test_S6_1_11_S4_01_M_clusters_are_sampled_every_iteration_also_of_one_cluster():
    """Every iteration M = 30 clusters are sampled from the graph"""
    i = restarted(M=7).iterate()
    assert i.starts == [0] * 7
    assert len({b"".join(t.actions) for t in i.trajectories}) == 7


def test_S6_1_13_R21_during_pretraining_theta_sim_rises_linearly_from_0():
    """a gradual increase of the value of the similarity threshold from 0 to theta_similarity"""
    a = explorer(M=1, L=0, pretrain_steps=700, steps=1000, trajectory_steps=100, theta_sim=0.7)
    a.similarity = Stub(tens)
    walking(a, [0] * 101)
    thresholds = [a.iterate().metrics["theta_sim"] for _ in range(9)]
    assert thresholds == pytest.approx([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.7])


def test_S6_1_13_R21_states_join_by_the_threshold_at_the_start_of_their_iteration():
    a = explorer(M=1, L=0, merge=False, pretrain_steps=400, theta_sim=0.5)
    a.similarity = Stub(lambda s, s_i: 0.3)
    walking(a, [0, *range(100, 200)])
    clusters = [a.iterate().metrics["clusters"] for _ in range(4)]  # theta 0, 1/8, 1/4, 3/8
    assert clusters == [1, 1, 1, 101]


def test_S6_1_14_R6_RND_is_initialised_during_pretraining_and_kept():
    """At the same time, the necessary normalization parameters of the RND module are initialized"""
    a = explorer()
    while a.coverage.steps < a.config.pretrain_steps:
        a.iterate()
    a.restart()
    assert a.rnd.pixels.count > 300
    assert a.rnd.pixels.mean.std() > 0
    assert len(a.rnd.recent_errors) == a.iteration > 1


def pretrained():
    """An algorithm at the end of pretraining, with some clusters and a trained R."""
    a = explorer(merge=False, theta_sim=0.95)
    walking(a, range(1000, 1041))
    while a.coverage.steps < a.config.pretrain_steps:
        a.iterate()
    return a


def test_S6_1_15_R31_G_is_reset_to_the_initial_state_and_R_is_kept():
    """After pretraining the graph G is reset to the initial state, and RbExplore is restarted"""
    a = pretrained()
    assert len(a.graph.arcs) + a.graph.clusters[0].visits > 1
    before = plain([a.similarity.state_dict(), a.rnd.state_dict(), a.iteration])
    a.restart()
    assert plain([a.similarity.state_dict(), a.rnd.state_dict(), a.iteration]) == before  # R31
    assert (visits(a.graph), a.graph.arcs, a.graph.E_parent) == ({0: 1}, {}, {})
    assert a.theta_sim_now() == 0.95


def test_S6_1_15_the_restart_comes_with_the_first_iteration_after_pretraining():
    a = pretrained()
    count = a.iteration
    metrics = a.iterate().metrics
    assert (metrics["phase"], metrics["theta_sim"]) == ("explore", 0.95)
    assert metrics["iteration"] == count + 1
    assert a.coverage.steps > 400


def test_S6_1_15_R2_coverage_starts_at_the_restart():
    a = pretrained()
    assert a.coverage.first_visits == {}
    steps = a.coverage.steps
    a.restart()
    assert a.coverage.first_visits == {(6, 1, 2): steps}


def test_S6_2_04_R2_iterations_are_whole_and_the_run_ends_with_the_one_that_spends_its_steps():
    """15 million steps"""
    a = explorer(M=4, L=0, pretrain_steps=130, steps=250)
    a.similarity = Stub(tens)
    walking(a, range(31))
    a.run()
    assert (a.iteration, a.coverage.steps) == (3, 3 * 4 * 30)  # pretraining included


def test_S6_2_04_what_is_covered_after_the_last_step_does_not_count():
    coverage = Coverage(full=10, budget=2)
    for unit in ("a", "b", "c"):
        coverage.count(unit)
    assert coverage.visited() == {"a": 1, "b": 2}
    assert coverage.metrics() == {"steps": 3, "units": 2, "coverage": 0.2}
    coverage.budget = 3  # a run that is extended
    assert coverage.visited() == {"a": 1, "b": 2, "c": 3}


def test_S6_3_01_without_merging_merge_is_never_called():
    """The first version does not merge clusters in the graph G"""
    assert merges_of(31, merge=False) == []


def test_S6_3_02_without_prefixes_the_other_pairs_are_identical():
    """does not build the full trajectory prefix when generating negative examples"""
    made = {}
    for prefix in (True, False):
        a = restarted(prefix=prefix, L=0)
        full_prefix_of(a.graph)
        explored = [tau(range(1000, 1030)), tau(range(2000, 2030))]
        made[prefix] = pairs_made(a, [1, 1], explored)
    assert len([j for _, j, _ in made[True] if j < 1000]) == 60
    assert [pair for pair in made[True] if pair[1] >= 1000] == made[False]


def test_the_metrics_are_what_the_iteration_did():
    a = explorer(theta_merge=0.4, beta=0.2, pretrain_steps=50)
    a.similarity = Stub(lambda s, s_i: 1 / (1 + abs(s - s_i)))
    a.rnd.reward = lambda frames: np.arange(len(frames)) / 10
    walking(a, [0, 3, 10, 11, 30])  # 11 is near enough to 10 to merge, and not to join
    found = [a.iterate() for _ in range(4)]
    names = ("steps", "clusters", "added", "merged", "novel_share", "additional")
    # 4 trajectories and 3 additional ones, of 4 steps each. Pretraining has two iterations.
    assert [[i.metrics[name] for name in names] for i in found] == [
        [28, 1, 0, 0, 0.4, 3],
        [56, 4, 3, 0, 0.4, 3],
        [84, 5, 4, 0, 0.4, 3],
        [112, 4, 0, 1, 0.4, 3],
    ]
    assert [len(states) for states in found[0].clusters] == [5] * 4
    assert [i.merged for i in found] == [{}, {}, {}, {3: 2}]


def test_the_seed_makes_the_run_and_global_generators_are_left_alone():
    torch.manual_seed(1)
    before = (torch.random.get_rng_state(), np.random.get_state()[1].copy())
    states = [plain(explorer(seed=seed, steps=600).run().state_dict()) for seed in (1, 1, 2)]
    assert states[0] == states[1]
    assert states[0] != states[2]
    assert torch.equal(torch.random.get_rng_state(), before[0])
    assert np.array_equal(np.random.get_state()[1], before[1])


def test_no_two_iterations_draw_alike_be_they_of_one_seed_or_of_neighbouring_seeds():
    drawn = []

    def walks(states, seeds, limit):
        drawn.append(tuple(seeds))
        return [tau([0, 1])] * len(states)

    for seed in (0, 1):
        a = restarted(seed=seed, L=0)
        a.similarity = Stub(tens)
        a.walks = walks
        a.iterate()
        a.iterate()
    assert len(set(drawn)) == 4


def test_no_two_networks_start_alike_be_they_of_one_seed_or_of_neighbouring_seeds():
    first_layers = set()
    for seed in (0, 1):
        config = replace(MAZE, seed=seed)
        rnd = RND(config, (32, 32))
        encoders = [SimilarityModel(config, (32, 32)).encoder, rnd.target, rnd.predictor[0]]
        encoders.append(ICM(config, (32, 32), 7, "cpu").encoder)
        encoders.append(PPO(Maze, config, "rnd", "cpu").network[0])
        first_layers |= {tuple(encoder[0].weight.flatten().tolist()) for encoder in encoders}
    assert len(first_layers) == 10


def test_R18_networks_start_with_hes_weights_and_learn_at_the_configured_rate():
    config = replace(MAZE, learning_rate=3e-4)
    agent = PPO(Maze, config, "icm")
    modules = [SimilarityModel(config, (32, 32)), RND(config, (32, 32)), agent.curiosity]
    for module in modules:
        for layer in module.modules():
            if isinstance(layer, (nn.Conv2d, nn.Linear)) and layer.weight.numel() > 4000:
                he = math.sqrt(2 / layer.weight[0].numel())
                assert layer.weight.std().item() == pytest.approx(he, rel=0.1)
    for optimiser in [*(module.optimiser for module in modules), agent.optimiser]:
        (group,) = optimiser.param_groups
        assert type(optimiser) is torch.optim.Adam
        assert (group["lr"], group["weight_decay"]) == (3e-4, 0)


def test_R18_the_layers_of_the_small_encoders_and_of_RND():
    kinds = [type(layer).__name__ for layer in SimilarityModel(MAZE, (32, 32)).encoder]
    assert kinds == ["Conv2d", "BatchNorm2d", "ReLU"] * 3 + ["Flatten", "Linear"]
    rnd = RND(Config(), (96, 96))
    kinds = [type(layer).__name__ for layer in rnd.target]
    assert kinds == ["Conv2d", "ReLU"] * 3 + ["Flatten", "Linear"]
    convs = [m for m in rnd.target if isinstance(m, nn.Conv2d)]
    sizes = [(m.out_channels, m.kernel_size[0], m.stride[0], m.padding[0]) for m in convs]
    assert sizes == [(32, 8, 4, 0), (64, 4, 2, 0), (64, 3, 1, 0)]
    assert [type(x).__name__ for x in rnd.predictor[1:]] == ["ReLU", "Linear"] * 2
    assert [w for w in rnd.target.parameters() if w.requires_grad] == []


def test_frames_are_embedded_in_parts_without_a_gap():
    model = SimilarityModel(MAZE, (32, 32))
    x = pictures(1100)
    e = model.embed(x)
    assert e.shape == (1100, 64)
    for k in (0, 511, 512, 1023, 1024, 1099):
        assert torch.allclose(e[k], model.embed(x[k : k + 1])[0], atol=1e-4)


@pytest.mark.parametrize("shape", [(32, 32, 3), (40, 33)])
def test_an_environment_in_colour_or_of_another_size(shape):
    class Own(Grid):
        observation_space = Box(0, 255, shape, np.uint8)

    a = explorer(Own, pretrain_steps=100, steps=500).run()
    assert len(a.coverage.visited()) > 5
    assert set(verify(a).values()) == {"exact"}


def test_frames_that_an_environment_reuses_are_copied():
    class Reusing(Grid):
        shared = np.zeros((32, 32), np.uint8)

        def picture(self):
            self.shared[:] = super().picture()
            return self.shared

    states = [plain(explorer(env_fn, steps=500).run().state_dict()) for env_fn in (Reusing, Grid)]
    assert states[0] == states[1]


@pytest.mark.parametrize(("changes", "said"), [
    ({"n": 30}, "n is 30 and N is 10"),
    ({"additional_steps": 10}, "additional_steps is 10.*at least 11"),
    ({"trajectory_steps": 10}, "trajectory_steps is 10.*at least 11"),
    ({"pretrain_steps": 100_000}, "pretrain_steps is 100000 of 100000"),
    ({"M": 0}, "M is 0: choose a number from 1"),
    ({"theta_sim": 1.5}, "theta_sim is 1.5"),
    ({"beta": "2"}, "beta is '2': it must be of type float"),
    ({"M": True}, "M is True: it must be of type int"),
    ({"learning_rate": float("nan")}, "learning_rate is nan"),
])  # fmt: skip
def test_a_configuration_that_cannot_work_is_refused(changes, said):
    replace(MAZE, n=10)  # n may equal N
    with pytest.raises(InputError, match=said):
        replace(MAZE, **changes)


def test_a_loss_that_is_not_finite_is_one_clear_line():
    model = SimilarityModel(MAZE, (32, 32))
    with torch.no_grad():
        model.head[-1].bias.fill_(math.nan)
    with pytest.raises(InputError, match="the loss of R is nan: choose a lower learning_rate"):
        model.fit(TWENTY, np.random.default_rng(0))


# ------------------------------------------------------------- 6.2: the methods that are compared


class Corridor(gymnasium.Env):
    """17 places in a row; the left end is the start, the right end ends the episode."""

    observation_space = Box(0, 255, (32, 32), np.uint8)
    action_space = Discrete(2, start=3)

    def reset(self, *, seed=None, options=None):
        self.x = 0
        return frame(1000 + self.x), {}

    def step(self, action):
        self.x = max(self.x + (1 if action == 4 else -1), 0)
        return frame(1000 + self.x), 5.0, self.x == 16, False, {}

    def snapshot(self):
        return bytes([self.x])

    def restore(self, snapshot):
        (self.x,) = snapshot
        return frame(1000 + self.x)

    def unit(self):
        return (self.x,)


def test_R25_the_unit_of_a_terminal_state_is_covered():
    a = restarted(Corridor)
    a.collect([State(frame(1015), bytes([15]))] * 20, 5, np.random.default_rng(0), covers=True)
    assert (16,) in a.coverage.first_visits


AGENT = replace(TINY, steps=700, rollout_steps=200, episode_steps=50)
METHODS = ["rbexplore", "rnd", "icm", "random", "cells"]


@pytest.mark.parametrize("method", METHODS)
def test_S6_2_03_every_method_counts_all_its_steps_and_covers_at_each(method):
    """exploration performance of RbExplore alongside ICM and RND"""
    units = []

    class Watched(Maze):
        def step(self, action):
            result = super().step(action)
            units.append(self.unit())
            return result

    a = make_method(method, Watched, replace(AGENT, pretrain_steps=0, L=0))
    units.clear()  # of the contract's walk
    while a.coverage.steps < 700:
        metrics = a.iterate().metrics
    assert a.coverage.steps == metrics["steps"] == len(units)
    first = {}
    for step, unit in enumerate(units, 1):
        if unit is not None:
            first.setdefault(unit, step)
    assert a.coverage.first_visits == first | {(6, 1, 2): 0}
    assert (a.method, metrics["phase"]) == (method, "explore")


def test_S6_2_03_only_rbexplore_pretrains_and_has_additional_trajectories():
    configs = {method: make_method(method, Maze, TINY).config for method in METHODS}
    sizes = {method: (config.pretrain_steps, config.L) for method, config in configs.items()}
    assert sizes == {method: (400, 3) if method == "rbexplore" else (0, 0) for method in METHODS}


def test_S6_2_03_cells_replace_R_and_nothing_else():
    cells = make_method("cells", Maze, TINY)
    assert isinstance(cells.similarity, Cells)
    assert isinstance(make_method("rbexplore", Maze, TINY).similarity, SimilarityModel)
    i = cells.iterate()
    assert len(i.trajectories) == 4
    assert i.metrics["r_loss"] is None
    assert len(cells.graph.clusters) > 3


@pytest.mark.parametrize("method", METHODS)
def test_S6_2_03_every_method_checks_the_contract_and_seeds_its_environment(method):
    seeds = set()

    class Seeded(Maze):
        def reset(self, *, seed=None, options=None):
            seeds.add(seed)
            return super().reset(seed=seed)

    make_method(method, Seeded, replace(AGENT, seed=5)).iterate()
    assert seeds == {5}

    class Stale(Maze):
        def restore(self, snapshot):
            shown = self.step(0)[0]
            super().restore(snapshot)
            return shown

    with pytest.raises(InputError, match="leads to a different"):
        make_method(method, Stale, AGENT)


def test_S6_2_03_random_acts_uniformly_in_M_episodes_from_s_init():
    walks = []
    for seed in (1, 2):
        a = make_method("random", Maze, replace(AGENT, seed=seed, M=25))
        resets = []
        acted = []
        a.reset = lambda resets=resets, acted=acted: resets.append(len(acted))
        # The step number 990 ends its episode.
        a.step = lambda action, acted=acted: acted.append(action) or (None, len(acted) == 990)
        for _ in range(2):
            a.iterate()
        # 25 episodes of trajectory_steps each time
        assert resets == [*range(0, 990, 40), *range(990, 1990, 40)]
        counts = np.bincount(acted, minlength=7)
        assert min(counts) > 220
        assert max(counts) < 360
        walks += [tuple(acted[:990]), tuple(acted[990:1980])]
    assert len(set(walks)) == 4  # each seed and each iteration draws anew


def test_S6_2_03_an_episode_ends_with_a_death_or_a_truncation():
    a = make_method("random", Grid, AGENT)
    ended = []
    for place, action in (((5, 6), 1), ((0, 5), 3), ((3, 3), 1)):
        a.env.place = place
        ended.append(a.step(action)[1])
    assert ended == [True, True, False]


@pytest.mark.parametrize(("method", "loss"), [("rnd", "rnd_loss"), ("icm", "forward_loss")])
def test_S6_2_03_a_bonus_and_its_loss_fall_on_what_was_seen(method, loss):
    a = PPO(Corridor, AGENT, method, "cpu")
    before, after = (np.stack([frame(k + x) for k in range(40)]) for x in (0, 1))
    actions = np.arange(40) % 2
    first = a.curiosity.bonus(before, actions, after).mean()
    losses = [a.curiosity.learn(before, actions, after)[loss] for _ in range(60)]
    assert losses[-1] < 0.5 * losses[0]
    assert a.curiosity.bonus(before, actions, after).mean() < 0.5 * first


def test_S6_2_03_the_bonus_of_RND_is_its_error_on_the_successor():
    bonus = RNDBonus(MAZE, (32, 32))
    before, after = pictures(9), pictures(9, seed=1)
    found = bonus.bonus(before, np.zeros(9, int), after)
    assert found == pytest.approx(bonus.errors(after))
    assert bonus.pixels.count == pytest.approx(9, abs=0.01)  # its statistics come first
    learned = []
    bonus.update = lambda frames: learned.append(frames) or 0.5
    assert bonus.learn(before, np.zeros(9, int), after) == {"rnd_loss": 0.5}
    assert learned[0] is after


def icm_batch():
    """ICM with 4 actions, and a batch: frames, actions, successors."""
    return ICM(MAZE, (32, 32), 4, "cpu"), (pictures(8), np.arange(8) % 4, pictures(8, seed=1))


def test_S6_2_03_ICMs_encoder_learns_by_the_inverse_loss_only():
    icm, batch = icm_batch()
    icm.losses(*batch)[1].mean().backward()
    assert [w for w in icm.encoder.parameters() if w.grad is not None] == []
    assert [w for w in icm.forward_model.parameters() if w.grad is None] == []
    icm.zero_grad()
    icm.losses(*batch)[0].mean().backward()
    assert [w for w in icm.encoder.parameters() if w.grad is None] == []


def test_S6_2_03_ICMs_losses_are_equations_3_and_5():
    icm, (before, actions, after) = icm_batch()
    with torch.no_grad():
        phi, phi_next = (icm.encoder(rbexplore.to_input(x, "cpu")) for x in (before, after))
        one_hot = torch.eye(4)[torch.from_numpy(actions)]
        predicted = icm.forward_model(torch.cat([phi, one_hot], 1))
        log_p = icm.inverse_model(torch.cat([phi, phi_next], 1)).log_softmax(1)
    inverse, forward = icm.losses(before, actions, after)
    assert inverse.tolist() == pytest.approx((-log_p[range(8), actions]).tolist(), rel=1e-4)
    expected = (((predicted - phi_next) ** 2).sum(1) / 2).numpy()
    assert forward.tolist() == pytest.approx(expected.tolist(), rel=1e-4)
    assert icm.bonus(before, actions, after) == pytest.approx(expected, rel=1e-4)


def test_S6_2_03_ICM_learns_by_four_parts_inverse_and_one_part_forward_loss():
    icm, batch = icm_batch()
    inverse, forward = (loss.mean() for loss in icm.losses(*batch))
    expected = torch.autograd.grad(0.8 * inverse + 0.2 * forward, list(icm.parameters()))
    losses = icm.learn(*batch)
    for w, gradient in zip(icm.parameters(), expected, strict=True):
        assert torch.allclose(w.grad, gradient, rtol=1e-3, atol=1e-6)
    assert losses["inverse_loss"] == pytest.approx(inverse.item(), rel=1e-4)
    assert losses["forward_loss"] == pytest.approx(forward.item(), rel=1e-4)


def test_S6_2_03_advantages_are_discounted_sums_of_temporal_differences():
    rng = np.random.default_rng(0)
    rewards, values, last = rng.random(12), rng.random(12), 0.7
    delta = rewards + 0.9 * np.append(values[1:], last) - values
    expected = [sum(0.72 ** (k - t) * delta[k] for k in range(t, 12)) for t in range(12)]
    assert advantages_of(rewards, values, last, 0.9, 0.8) == pytest.approx(expected)


def corridor_rollout():
    a = PPO(Corridor, AGENT, "rnd", "cpu")
    r = a.rollout(np.random.default_rng(0))
    return a, r, [k - 1000 for k in numbers(r.before)], [k - 1000 for k in numbers(r.after)]


def test_S6_2_03_a_rollout_holds_what_was_done():
    a, r, before, after = corridor_rollout()
    moves = np.where(r.actions == 1, 1, -1)
    assert after == [max(x + move, 0) for x, move in zip(before, moves, strict=True)]
    log_p, values = (x.detach().numpy() for x in a.policy(r.before))
    assert r.log_p == pytest.approx(log_p[range(200), r.actions], abs=1e-5)
    assert r.values == pytest.approx(values, abs=1e-5)
    assert r.last_value == pytest.approx(a.policy(a.state.frame[None])[1].item(), abs=1e-5)


def test_S6_2_03_R27_an_episode_ends_with_the_environment_or_after_episode_steps():
    _, r, before, after = corridor_rollout()
    assert (len(before), before[0]) == (200, 0)
    restarts = [t for t in range(199) if before[t + 1] != after[t]]
    assert {before[t + 1] for t in restarts} == {0}
    lengths = np.diff([-1, *restarts])
    wrong = [n for n, t in zip(lengths, restarts, strict=True) if n != 50 and after[t] != 16]
    assert wrong == []
    assert max(lengths) <= 50


def test_S6_2_03_a_rollout_continues_where_the_last_one_ended():
    a = PPO(Corridor, replace(AGENT, rollout_steps=17), "rnd", "cpu")
    first = a.rollout(np.random.default_rng(0))
    a.env.reset()
    second = a.rollout(np.random.default_rng(1))
    assert number(second.before[0]) == number(first.after[-1])
    assert (a.age, number(a.state.frame) - 1000) == (34, a.state.snapshot[0])


def test_S6_2_03_R27_a_bonus_is_divided_by_the_standard_deviation_of_its_discounted_sums():
    a = PPO(Corridor, AGENT, "rnd", "cpu")
    bonus = np.random.default_rng(0).random(40)
    sums = [sum(0.99 ** (t - k) * bonus[k] for k in range(t + 1)) for t in range(40)]
    assert a.scaled(bonus[:25]) == pytest.approx(bonus[:25] / np.std(sums[:25]), rel=1e-3)
    assert a.scaled(bonus[25:]) == pytest.approx(bonus[25:] / np.std(sums), rel=1e-3)


@pytest.mark.parametrize("ratio", [0.7, 0.95, 1.05, 1.3])
@pytest.mark.parametrize("advantage", [2.0, -2.0])
def test_S6_2_03_a_step_of_PPO_is_down_its_clipped_objective(ratio, advantage):
    a = PPO(Corridor, AGENT, "rnd", "cpu")
    with torch.no_grad():
        a.network[-1].bias[0] = 1.0  # so that the entropy has a gradient
    x = pictures(16)
    log_p, values = a.policy(x)
    old = log_p[:, 0].detach() - math.log(ratio)
    # Beyond the clip, only an advantage that pulls back counts.
    clipped = (ratio > 1.1 and advantage > 0) or (ratio < 0.9 and advantage < 0)
    surrogate = 0 if clipped else ((log_p[:, 0] - old).exp() * advantage).mean()
    entropy = -(log_p.exp() * log_p).sum(1).mean()
    loss = 0.5 * (values - 3).square().mean() - surrogate - 0.001 * entropy
    expected = torch.autograd.grad(loss, list(a.network.parameters()))
    returns = np.full(16, 3.0, np.float32)
    losses = a.update(x, np.zeros(16, int), old.numpy(), np.full(16, advantage), returns)
    for parameter, gradient in zip(a.network.parameters(), expected, strict=True):
        assert torch.allclose(parameter.grad, gradient, rtol=1e-3, atol=1e-6)
    assert losses["entropy"] == pytest.approx(entropy.item(), rel=1e-4)


def test_S6_2_03_actions_are_samples_of_the_policy():
    a = PPO(Maze, AGENT, "rnd", "cpu")
    p = np.array([0.4, 0.3, 0.1, 0.1, 0.05, 0.03, 0.02])
    with torch.no_grad():
        a.network[-1].weight.zero_()
        a.network[-1].bias[:7] = torch.from_numpy(np.log(p))
    rng = np.random.default_rng(0)
    acted = [a.act(pictures(1)[0], rng) for _ in range(2000)]
    drawn = np.bincount([action for action, _, _ in acted], minlength=7) / 2000
    assert drawn == pytest.approx(p, abs=0.04)
    log_p = [x for _, x, _ in acted]
    assert log_p == pytest.approx([math.log(p[action]) for action, _, _ in acted], abs=1e-4)


def test_R27_a_rollout_is_learned_in_four_epochs_of_four_minibatches():
    a = PPO(Corridor, AGENT, "rnd", "cpu")
    r = a.rollout(np.random.default_rng(0))
    a.rollout = lambda rng: r
    a.scaled = lambda bonus: np.arange(200.0)  # by which the samples are recognised
    seen = []
    learned = []
    a.update = lambda *batch: seen.append(batch) or {}
    a.curiosity.learn = lambda *batch: learned.append(batch) or {"rnd_loss": 0.0}
    a.iterate()
    assert [len(batch[0]) for batch in seen] == [50] * 16
    advantages = advantages_of(np.arange(200.0), r.values, r.last_value, 0.99, 0.95)
    expected = (r.before, r.actions, r.log_p, advantages, advantages + r.values)
    for epoch in range(0, 16, 4):
        joined = [np.concatenate(parts) for parts in zip(*seen[epoch : epoch + 4], strict=True)]
        order = np.argsort(-joined[3])
        for part, column in zip(joined, expected, strict=True):
            assert np.array_equal(part[order], column[np.argsort(-advantages)])
    for batch, of_bonus in zip(seen, learned, strict=True):
        assert np.array_equal(of_bonus[0], batch[0])
        assert np.array_equal(of_bonus[1], batch[1])
        moves = np.where(batch[1] == 1, 1, -1)
        steps = np.array(numbers(batch[0])) - 1000
        arrived = np.array(numbers(of_bonus[2])) - 1000
        assert np.array_equal(arrived, np.maximum(steps + moves, 0))


def test_R27_the_settings_of_PPO_are_those_of_Burda_et_al():
    names = ("GAMMA", "GAE_LAMBDA", "EPOCHS", "MINIBATCHES", "CLIP", "ENTROPY", "VALUE")
    assert [getattr(PPO, name) for name in names] == [0.99, 0.95, 4, 4, 0.1, 0.001, 0.5]
    assert ICM.BETA == 0.2
    log_p, _ = PPO(Corridor, AGENT, "rnd").policy(pictures(1))
    assert log_p.exp().tolist()[0] == pytest.approx([0.5, 0.5], abs=0.05)  # at first


def test_cells_are_equal_where_11_by_8_pixels_of_8_greys_are():
    cells = Cells()
    light = np.full((1, 96, 96), 200, np.uint8)
    for change, same in ((3, 1), (40, 0)):
        other = light.copy()
        other[0, :12, :9] -= change
        assert cells.score(cells.embed(light), cells.embed(other)[0]).tolist() == [same]
    both = cells.embed(np.concatenate([light, light // 2]))
    assert cells.score(both, both[1]).tolist() == [0, 1]
    assert cells.embed(light).shape == (1, 88)
    assert cells.embed(np.full((1, 96, 96, 3), 255, np.uint8)).unique().tolist() == [7]
    stripes = (np.arange(96) % 2 * 255)[:, None].repeat(96, 1).astype(np.uint8)
    assert cells.embed(stripes[None]).unique().tolist() == [4]  # the mean of a cell
    bands = (np.arange(96) // 12 * 32)[:, None].repeat(96, 1).astype(np.uint8)  # 8 of them
    assert cells.embed(bands[None]).reshape(8, 11).tolist() == [[k] * 11 for k in range(8)]


@pytest.mark.parametrize("method", METHODS)
def test_a_method_continues_from_its_state_as_if_never_interrupted(method):
    config = replace(AGENT, steps=1500, pretrain_steps=100, rollout_steps=130)
    whole, first, second = (make_method(method, Maze, config) for _ in range(3))
    for _ in range(4):
        whole.iterate()
    for _ in range(2):
        first.iterate()
    state = first.state_dict()
    kept = plain(state)
    second.load_state_dict(state)
    for _ in range(2):
        second.iterate()
    assert plain(second.state_dict()) == plain(whole.state_dict())
    if method in ("rbexplore", "cells"):
        assert plain(state["graph"]) == kept["graph"]


# ---------------------------- 3.2: verification of a run; 6.2, 6.3: the comparison of several runs


class Track(Grid):
    """Places 0, 1, 2, ... in a row; the frame shows the number. Action 0 leads back, any other one
    leads on; place 9 is an abyss. The sixth step after a restore() shows a fault: hidden state."""

    action_space = Discrete(5)
    full_coverage = None
    fault = None
    taken = 0

    def reset(self, *, seed=None, options=None):
        return self.restore(b"0"), {}

    def step(self, action):
        assert self.place < 9, "a step after the end"
        self.counter += 1
        self.taken += 1
        self.place = max(0, self.place + (1 if action else -1))
        fault = self.fault if self.counter == 6 else None
        picture = frame(999 if fault == "frame" else self.place)
        return picture, 0.0, self.place == 9 or fault == "end", False, {}

    def snapshot(self):
        return b"%d" % self.place

    def restore(self, snapshot):
        self.place = int(snapshot)
        self.counter = 0
        return frame(self.place)

    def unit(self):
        return (999 if self.fault == "unit" and self.counter == 6 else self.place,)


def tracked():
    """An explorer whose clusters 0 to 4 are places 0 to 4, each the parent of the next."""
    a = explorer(Track)
    a.graph, a.similarity = grown([(0, range(5))], lambda s, s_i: s == s_i)
    return a


@pytest.mark.parametrize("actions", [b"\0", b"\1" * 9], ids=["another place", "the abyss"])
def test_S3_2_03_verify_finds_centres_that_their_actions_do_not_reach(actions):
    """a policy transits the agent from s_init to s_v in a finite number of timesteps"""
    a = tracked()
    assert list(verify(a).values()) == ["exact"] * 5
    a.graph.E_parent[2] = replace(a.graph.E_parent[2], actions=actions)
    missed = "the actions do not lead to the centre"
    assert list(verify(a, steps=0).values()) == ["exact"] * 2 + [missed] * 3


def test_S3_2_03_verify_compares_the_unit_that_is_reached(monkeypatch):
    a = tracked()
    monkeypatch.setattr(Track, "unit", lambda env: (env.place, env.counter > 0))
    assert list(verify(a).values()) == ["exact"] + ["the actions do not lead to the centre"] * 4


def test_S3_2_03_verify_replays_a_shared_prefix_once_through_merged_clusters_too():
    a = tracked()
    a.graph.merge(Stub(table({(1, 2): 1.0})), 0.5)
    a.env.taken = 0
    assert verify(a, steps=0) == dict.fromkeys([0, 1, 3, 4], "exact")
    assert a.env.taken == 4  # not 0 + 1 + 3 + 4


@pytest.mark.parametrize("part", ["frame", "snapshot"])
def test_S3_2_01_verify_finds_a_snapshot_that_does_not_restore_the_centre(part):
    """the environment can load any state that was visited"""
    a = tracked()
    setattr(a.graph.clusters[4], part, getattr(a.graph.clusters[2], part))
    assert list(verify(a).values()) == ["exact"] * 4 + ["the snapshot does not restore the centre"]


@pytest.mark.parametrize("fault", ["frame", "unit", "end"])
def test_S3_2_01_verify_finds_hidden_state_that_shows_in_later_steps_only(fault):
    a = tracked()
    a.env.fault = fault
    verdict = "the next steps after replay and after restore differ"
    assert list(verify(a).values()) == ["exact"] + [verdict] * 4  # no action leads to cluster 0


def coverage_of(times, steps=800):
    """A coverage of which 10 units are full, 800 steps the budget, and `times` the first visits."""
    coverage = Coverage(10, 800)
    coverage.steps = steps
    coverage.first_visits = {(k, 0): step for k, step in enumerate(times)}
    return coverage


def compared(folder, *runs, figures=False):
    """Compare runs, each made of changes of TINY and perhaps its `method` and the `times` of its
    first visits. Returns label -> row of the table."""
    folders = []
    for run in runs:
        changes = {"method": "rbexplore", "times": []} | run
        coverage = coverage_of(changes.pop("times"))
        a = make_method(changes.pop("method"), Grid, replace(TINY, **changes))
        a.coverage = coverage
        folders.append(Run(folder / str(len(folders)), a).begin().folder)
    rbexplore.compare(folders, folder / "out", figures)
    with open(folder / "out" / "table.csv", encoding="utf-8") as file:
        return {row[""]: row for row in csv.DictReader(file)}


def test_S6_2_03_a_comparison_names_the_methods(tmp_path):
    methods = ["rnd", "icm", "rbexplore", "random", "cells"]
    assert list(compared(tmp_path, *[{"method": method} for method in methods])) == methods


def test_S6_2_04_a_comparison_leaves_out_what_is_visited_after_the_last_step(tmp_path):
    times = [0, 799, 800, 801, 802]
    row = compared(tmp_path, {"times": times})["rbexplore"]
    assert (row["mean"], row["to 50 %"]) == ("30.0", "-")
    (panel,) = rbexplore.curves_figure({"RND": [coverage_of(times, 820)]}, "tiles", 0).axes
    assert panel.lines[0].get_xydata()[-1].tolist() == [800, 30]


def test_S6_2_05_the_line_is_the_mean_and_the_band_from_least_to_most():
    """curves are averaged over three runs; the shading indicates the min-max range"""
    runs = [coverage_of([0] * units) for units in (2, 3, 12)]  # of 10, so at most 100 %
    (panel,) = rbexplore.curves_figure({"RND": runs}, "tiles", pretrain_steps=0).axes
    (line,) = panel.lines
    (band,) = panel.collections
    assert set(line.get_ydata()) == {50.0}
    assert band.get_datalim(panel.transData).intervaly.tolist() == [20.0, 100.0]


def test_S6_2_05_a_curve_counts_units_by_their_step_and_ends_with_the_shortest_run():
    runs = [coverage_of([0, 500], steps) for steps in (820, 600)]
    (panel,) = rbexplore.curves_figure({"RND": runs}, "tiles", pretrain_steps=0).axes
    x, y = panel.lines[0].get_data()
    assert x[-1] == 600
    assert y.tolist() == [10.0 if step < 500 else 20.0 for step in x]


def test_S6_2_05_a_table_has_the_mean_the_range_and_the_median_steps(tmp_path):
    runs = [{"times": range(0, 100 * units, 100), "seed": units} for units in (9, 5, 2)]
    (row,) = compared(tmp_path, *runs).values()
    values = ["rbexplore", "3", "53.3", "20.0 - 90.0", "0 of 3", "400", "-", "-"]
    assert list(row.values()) == values
    of_three = coverage_of([5, 7, 9])
    of_three.full = 3
    assert rbexplore.steps_to(of_three) == {50: 7, 90: 9, 100: 9}


def test_S6_2_06_every_group_has_a_map_of_its_best_run_by_final_coverage(tmp_path, monkeypatch):
    """the first level coverage for the best RND, ICM, and RbExplore runs"""
    drawn = {}
    monkeypatch.setattr(rbexplore, "save_figures", lambda folder, figures: drawn.update(figures))
    fast = {"times": [0, 1]}
    best = {"times": [5, 500, 700, 900], "seed": 1}
    too_late = {"times": [0, 801, 802, 803, 804], "seed": 2}
    other = {"times": [3] * 4, "method": "random"}
    compared(tmp_path, fast, best, too_late, other, figures=True)
    maps = {panel.get_title(): panel for panel in drawn["maps.png"].axes if panel.get_title()}
    assert list(maps) == ["rbexplore: 3 units", "random: 4 units"]
    (tiles,) = maps["rbexplore: 3 units"].collections
    assert tiles.get_array().tolist() == [5, 500, 700]  # coloured by their first visits


def test_S6_3_01_S6_3_02_S6_3_03_runs_are_grouped_by_all_settings_but_the_seed(tmp_path):
    """No merge; No prefix; theta_merge in {0.25, 0.5, 0.75}"""
    thetas = [{"theta_merge": theta} for theta in (0.25, 0.5, 0.75)]
    others = [{"prefix": False}, {"merge": False, "beta": 9.0}, {"merge": False}]
    rows = compared(tmp_path, *thetas, *others, {"merge": False, "seed": 8})
    labels = ["theta_merge 0.25", "rbexplore", "theta_merge 0.75", "no prefix"]
    assert list(rows) == [*labels, "beta 9.0, no merge", "no merge"]
    assert [row["runs"] for row in rows.values()] == ["1", "1", "1", "1", "1", "2"]


# ------------------------------------------ the game (3.2, 5, 6.1, 6.2): a cartridge, and Montezuma

# The Prince of Persia cartridge cannot be shipped. These tests run a cartridge of our own in the
# same emulator: its program, at the end of this section, keeps its readings at the same addresses.
RAM = {"level": 112, "room": 1246, "x": 1243, "y": 1777, "hit_points": 1743, "sword": 1774}


@pytest.fixture
def console(tmp_path):
    """Inserts a cartridge into the one emulator of this process, and makes the environment."""
    pytest.importorskip("stable_retro", reason="the cartridge needs stable-retro")
    inserted = []

    def insert(image=None, **options):
        for env in inserted:
            env.close()
        path = tmp_path / "game.nes"
        path.write_bytes(image or cartridge())
        inserted.append(PrinceOfPersia(str(path), **options))
        inserted[-1].reset()
        return inserted[-1]

    yield insert
    for env in inserted:
        env.close()


@pytest.fixture
def prince(console):
    return console()


@pytest.fixture
def montezuma():
    pytest.importorskip("ale_py", reason="Montezuma's Revenge needs ale-py")
    return Montezuma


@pytest.fixture(params=["console", "montezuma"])
def emulator(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(params=["maze", "console", "montezuma"])
def env(request):
    return Maze(3) if request.param == "maze" else request.getfixturevalue(request.param)()


def memory(env):
    """All that the program of a game knows: the RAM, or the state of the maze."""
    if isinstance(env, Montezuma):
        return env._emulator.getRAM().tobytes()
    if isinstance(env, PrinceOfPersia):
        return b"".join(env._data.memory.blocks.values())
    return env.snapshot()


def put(env, **readings):
    """Write into the RAM of the cartridge, where level 1 is 0."""
    for name, value in readings.items():
        env._data.memory.assign(RAM[name], "<u2" if name == "x" else "|u1", value)


def start_state(env, path, level=1, room=14, x=77, y=192, hit_points=3):
    """Write a start state, with the sword, in the format in which the authors publish theirs."""
    put(env, level=level - 1, room=room, x=x, y=y, hit_points=hit_points, sword=1)
    path.write_bytes(gzip.compress(env._emulator.get_state()))
    return str(path)


def play(env, frame, k):
    """The last frame of the k-th walk of 8 random steps, and all that is seen on it."""
    seen = [(frame.tobytes(), env.snapshot())]
    for action in np.random.default_rng(k).integers(env.action_space.n, size=8).tolist():
        frame, *outcome = env.step(action)
        seen.append((frame.tobytes(), memory(env), env.unit(), outcome))
        if outcome[1]:
            frame, _ = env.reset()
    return frame, seen


def replay(env_fn, snapshots):
    """What is seen on the walks when their starts are loaded, the last one first."""
    env = env_fn()
    return {k: play(env, env.restore(snapshots[k]), k)[1] for k in reversed(range(len(snapshots)))}


@pytest.fixture(scope="module")
def elsewhere():
    """A process that shares nothing with this one."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        yield pool


def test_S3_2_01_any_visited_state_can_be_loaded_anywhere(env, elsewhere, tmp_path):
    """3.2: "an environment property, that allows one to save and load states"; here in another
    process, and in the reverse order."""
    snapshots = []
    walks = []
    frame = env.reset()[0]
    for k in range(40):
        snapshots.append(env.snapshot())
        frame, seen = play(env, frame, k)
        walks.append(seen)
    options = {Maze: {"level": 3}, PrinceOfPersia: {"rom": str(tmp_path / "game.nes")}}
    env_fn = functools.partial(type(env), **options.get(type(env), {}))
    again = elsewhere.submit(replay, env_fn, snapshots).result()
    assert [k for k in range(40) if again[k] != walks[k]] == []
    assert len({step[0] for seen in walks for step in seen}) > 9  # pictures tell states apart


def test_S3_2_01_all_of_a_state_is_loaded_and_the_dead_take_no_step(playground):
    for state in ([4, 1, 0, 1, 3, 0], [4, 1, 0, 0, 0, 1]):  # both plates pressed; dead
        playground.restore(bytes(state))
        assert list(playground.snapshot()) == state
    for action in range(7):
        with pytest.raises(InputError, match="dead: reset or restore"):
            playground.step(action)


def test_S3_2_02_loading_a_state_costs_no_frame_of_the_emulator(emulator, monkeypatch):
    """3.2: states are loaded "instead of policy" pi^p, so no environment step is taken."""
    env = emulator()
    snapshot = env.snapshot()
    before = memory(env)
    env.step(envs.RIGHT)
    monkeypatch.setattr(env, "_tick", None)  # from here on a frame raises TypeError
    env.restore(snapshot)
    assert memory(env).hex() == before.hex()


def test_S3_2_03_every_cluster_of_a_game_is_reached_exactly(emulator):
    a = make_method("cells", emulator, replace(TINY, steps=150, pretrain_steps=0)).run()
    assert len(a.graph.clusters) > 3
    assert set(verify(a).values()) == {"exact"}


@pytest.mark.parametrize("options, size", [({}, 96), ({"frame_size": 40}, 40)])
def test_S5_01_an_observation_is_the_screen_as_a_gray_picture(emulator, options, size):
    """5: "The input of the agent is a 96x96 grayscale image"."""
    env = emulator(**options)
    frame = env.step(envs.RIGHT)[0]
    prince = isinstance(env, PrinceOfPersia)
    screen = env._emulator.get_screen() if prince else env._emulator.getScreenRGB()
    picture = Image.fromarray(screen).convert("L").resize((size, size), Image.Resampling.BILINEAR)
    assert env.observation_space == Box(0, 255, (size, size), np.uint8)
    assert np.argwhere(frame != np.array(picture)).tolist() == []


def test_S5_02_seven_actions_are_seven_states_of_the_joystick(prince):
    """5: "seven possible joystick actions {no-op, left, right, up, down, A, B}"."""
    buttons = {0: "", 1: "right", 2: "left", 4: "down", 8: "up", 64: "B", 128: "A"}
    pressed = []
    for action in range(prince.action_space.n):
        prince.step(action)
        pressed.append(buttons.get(memory(prince)[1]))  # RAM 1: the pad as the game reads it
    assert pressed == ["", "left", "right", "up", "down", "A", "B"]
    names = [envs.NOOP, envs.LEFT, envs.RIGHT, envs.UP, envs.DOWN, envs.A, envs.B]
    assert names == [0, 1, 2, 3, 4, 5, 6]
    assert Maze().action_space == prince.action_space


def test_S5_03_the_full_coverage_of_each_level(console, tmp_path):
    """5: "%Cov = |U_visited| / |U_full|", with U_full as the authors' reference data count it."""
    counts = []
    for level in (1, 2, 3, 14):
        state = start_state(console(), tmp_path / "state", level)
        counts.append(console(level=level, state=state).full_coverage)
    assert counts == [721, 723, 756, 107]


def test_S5_03_the_full_coverage_of_the_maze_is_every_tile_that_is_reached_alive(playground):
    snapshots = [playground.snapshot()]
    units = {playground.unit()}
    for snapshot in snapshots:  # grows during the loop
        for action in range(7):
            playground.restore(snapshot)
            dead = playground.step(action)[2]
            if not dead and playground.snapshot() not in snapshots:
                units.add(playground.unit())
                snapshots.append(playground.snapshot())
    assert units ^ playground.reachable() == set()
    assert playground.full_coverage == len(units)


def test_S5_04_R26_a_unit_is_the_space_above_a_plate(prince):
    """5: "the area that roughly corresponds to space above the plate"; R26: 32 x 32 pixels."""
    expected = {
        (64, 128): (14, 2, 4), (95, 159): (14, 2, 4), (63, 128): (14, 1, 4), (64, 160): (14, 2, 5),
        (0, 32): (14, 0, 1), (332, 32): (14, 10, 1), (0, 223): (14, 0, 6),  # the room's corners
        (333, 32): None, (65535, 32): None, (0, 31): None, (0, 224): None,  # outside
    }  # fmt: skip
    units = {}
    for x, y in expected:
        put(prince, x=x, y=y, hit_points=1)
        units[x, y] = prince.unit()
    assert units == expected
    put(prince, room=15, x=64, y=128)
    assert prince.unit() == (15, 2, 4)
    put(prince, hit_points=0)
    assert prince.unit() is None
    assert prince.unit_name == "units of 32 x 32 pixels"


def test_S6_1_01_a_step_is_four_frames_of_one_action(prince):
    """6.1: "applying a frameskip of 4 frames". The cartridge runs 4 pixels a frame."""
    positions = [prince.reset()[1]["x"], prince.step(envs.RIGHT)[4]["x"]]
    assert positions == [64, 80]


@pytest.mark.parametrize("options, count", [({}, 4), ({"frameskip": 7}, 7)])
def test_S6_1_01_a_step_leads_as_far_as_steps_of_one_frame(emulator, options, count):
    actions = 4 * [envs.RIGHT, envs.DOWN, envs.A, envs.UP, envs.LEFT]
    env = emulator(frameskip=1)
    frames = [[env.step(action)[0].tobytes() for _ in range(count)] for action in actions]
    env = emulator(**options)
    seen = [env.step(action)[0].tobytes() for action in actions]
    assert [k for k in range(20) if seen[k] != frames[k][-1]] == []
    assert [k for k in range(20) if seen[k] != frames[k][-2]] != []


def test_S6_1_07_the_loss_of_a_hit_point_ends_the_episode(prince):
    """6.1: "Episodes are terminated on the loss of life". On the lowest floor, A hurts."""
    assert prince.step(envs.A)[2] is False
    put(prince, y=200)
    _, _, terminated, truncated, info = prince.step(envs.A)
    assert info["hit_points"] == 2
    assert terminated is True
    assert truncated is False


def test_S6_1_07_the_loss_of_a_life_ends_the_episode_in_montezuma(montezuma):
    env = montezuma()
    lives = [5]
    ended = []
    for action in np.random.default_rng(0).integers(18, size=300).tolist():
        _, _, terminated, _, info = env.step(action)
        lives.append(info["lives"])
        ended.append(terminated)
    assert ended == (np.diff(lives) < 0).tolist()
    assert sum(ended) > 0


@pytest.mark.parametrize("level, room, x", [(1, 14, 77), (2, 4, 123), (3, 8, 300)])
def test_S6_2_01_S6_2_02_a_level_starts_as_its_start_state(console, tmp_path, level, room, x):
    """6.2: "starts the first level with the sword [...] where the sword is located. For the other
    levels, we did not make any changes to the initial state"."""
    env = console()
    state = start_state(env, tmp_path / "state", level, room, x, y=200)
    before = memory(env)
    env = console(level=level, state=state)
    env.step(envs.RIGHT)
    expected = {"level": level, "room": room, "x": x, "y": 192, "hit_points": 3, "sword": 1}
    assert env.reset()[1] == {**expected, "blank": False}
    after = memory(env)
    assert after[0] == before[0] + 1  # the one frame that makes a picture
    assert after[1:].hex() == before[1:].hex()


def test_R22_the_observation_is_the_last_frame_of_its_step(prince):
    """R22: no maximum over frames. Six frames are black: the 4th to the 9th."""
    put(prince, x=244)
    black = [not prince.step(action)[0].any() for action in (envs.RIGHT, envs.NOOP, envs.NOOP)]
    assert black == [True, True, False]


def test_R22_actions_are_not_sticky(montezuma):
    assert montezuma()._emulator.getFloat("repeat_action_probability") == 0


def test_R23_any_loss_of_hit_points_or_another_level_ends_the_trajectory(prince):
    """R23: the loss is counted within the step, whatever was lost before it. B heals."""
    put(prince, hit_points=2)
    seen = []
    for level, y, action in ((0, 128, envs.A), (0, 200, envs.A), (0, 200, envs.B), (1, 128, 0)):
        put(prince, level=level, y=y)
        _, _, terminated, _, info = prince.step(action)
        seen.append((info["level"], info["hit_points"], terminated))
    assert seen == [(1, 2, False), (1, 1, True), (1, 2, False), (2, 2, True)]
    assert prince.unit() is None


@pytest.mark.parametrize("colour, blank", [(15, True), (45, False)])  # black, dark gray
def test_R24_a_black_screen_is_marked_as_blank(console, colour, blank):
    """R24: between two rooms the screen is black for six frames. Other screens are so in part."""
    prince = console(cartridge(PROGRAM.replace("lda# 15", f"lda# {colour}")))
    put(prince, x=252)
    frame, _, _, _, info = prince.step(envs.RIGHT)
    assert np.ptp(frame) == 0
    assert info["blank"] is blank
    frame, _, _, _, info = prince.step(envs.NOOP)
    assert frame.min() == 0
    assert info["blank"] is False


# The program of the cartridge. RAM 0 counts frames, RAM 1 is the pad. RIGHT moves x; behind x = 255
# is the next room, after 6 black frames. Below y = 160, A takes a hit point every fourth frame and
# B adds one. The picture is noise, scrolled by x and y, before the room's colour.
PROGRAM = """
    lda# 0 | ldx# 0
  clear: stax 0 | stax 1024 | stax 1536 | inx | bne clear
    lda# 14 | sta room | lda# 64 | sta x | lda# 128 | sta y | lda# 3 | sta hit_points
    lda# 53 | sta clock | lda# 0 | sta address | sta address | ldx# 16
  empty: sta data | dex | bne empty
    lda# 32 | sta address | lda# 0 | sta address | ldx# 0 | ldy# 4
  noise: ldax 49152 | and# 1 | sta data | inx | bne noise | dey | bne noise
  frame: lda status | bpl frame
    lda# 63 | sta address | lda# 0 | sta address | lda black | beq lit
    dec black | lda# 15 | sta data | lda# 0 | jmp drawn
  lit: lda room | and# 7 | ora# 32 | sta data | lda# 29 | sta data | sta data | sta data | lda# 10
  drawn: sta mask | lda# 0 | sta control | lda x | sta scroll | lda y | sta scroll
    lda# 1 | sta port | lda# 0 | sta port | ldx# 8
  buttons: lda port | lsr | rol pad | dex | bne buttons
    inc frames | dec clock | lda pad | and# 1 | beq floor
    lda x | clc | adc# 4 | sta x | bcc floor | inc room | lda# 6 | sta black
  floor: lda frames | and# 3 | bne end | lda y | cmp# 160 | bcc end
    lda pad | and# 128 | beq heal | dec hit_points
  heal: lda pad | and# 64 | beq end | inc hit_points
  end: jmp frame
"""
# The suffix of an operation is its addressing: # immediate, x indexed by X.
OPCODES = {
    "adc#": 105, "and#": 41, "bcc": 144, "beq": 240, "bne": 208, "bpl": 16, "clc": 24, "cmp#": 201,
    "dec": 206, "dex": 202, "dey": 136, "inc": 238, "inx": 232, "jmp": 76, "lda": 173, "lda#": 169,
    "ldax": 189, "ldx#": 162, "ldy#": 160, "lsr": 74, "ora#": 9, "rol": 46, "sta": 141, "stax": 157,
}  # fmt: skip
ADDRESSES = RAM | {
    "frames": 0, "pad": 1, "black": 2, "clock": 1222, "control": 8192, "mask": 8193,
    "status": 8194, "scroll": 8197, "address": 8198, "data": 8199, "port": 16406,
}  # fmt: skip
ORIGIN = 49152  # the address of the program


def cartridge(program=PROGRAM):
    """A cartridge image (iNES, mapper 2): one bank of 16 KiB."""
    labels = dict(ADDRESSES)
    for _ in range(2):  # the first pass finds the labels
        code = b""
        for line in re.split(r"[|\n]", program.strip()):
            label, _, operation = line.rpartition(":")
            labels[label.strip()] = ORIGIN + len(code)
            name, *operand = operation.split()
            code += bytes([OPCODES[name]])
            for text in operand:
                value = int(text) if text.isdigit() else labels.get(text, ORIGIN)
                branch = name.startswith("b")
                if branch:
                    value = (value - ORIGIN - len(code) - 1) % 256
                code += value.to_bytes(1 if branch or name.endswith("#") else 2, "little")
    vectors = 3 * ORIGIN.to_bytes(2, "little")
    return b"NES\x1a\1\0\x20".ljust(16, b"\0") + code.ljust(16378, b"\0") + vectors


# ##################################################################################################
# Nothing below this line is a statement of the paper.
# ##################################################################################################

# ------------------------------------------------------- the contract of a persistent environment


class Clocked(Grid):
    """The left edge of the grid, where no episode ends; and hidden numbers, which no snapshot
    holds. They are a fault as soon as something shows them."""

    clock = 0
    seeds = ()

    def reset(self, *, seed=None, options=None):
        self.clock = 0
        self.seeds = (*self.seeds, seed)
        return super().reset()

    def step(self, action):
        self.clock += 1
        return super().step(action % 2)


def variant(**members):
    return type("Variant", (Clocked,), members)()


def stepping(change):
    """step() returns something else."""
    return variant(step=lambda env, action: change(env, *Clocked.step(env, action)))


def restore_in_order(env, snapshot):
    """Exact if the snapshots are restored in the order in which they were taken."""
    if not env.restored:
        env.clock = 0
    env.restored = True
    return Grid.restore(env, snapshot)


@pytest.mark.parametrize("env", [
    variant(unit=lambda env: None),
    variant(action_space=Discrete(2, start=5),
            step=lambda env, action: Clocked.step(env, [5, 6].index(action))),
    variant(action_space=Discrete(256), observation_space=Box(0, 255, (32, 32, 4), np.uint8)),
    stepping(lambda env, frame, *_: (frame, 0.0, np.bool_(env.place == (4, 0)), False, {})),
])  # fmt: skip
def test_the_contract_accepts_an_honest_environment_and_leaves_it_at_s_init(env):
    check_contract(env, seed=5)
    assert env.place == (0, 0)
    assert set(env.seeds) == {5}


@pytest.mark.parametrize("env, said", [
    (Grid, "is not an environment: give a function that makes"),
    (functools.partial(Grid), "so that calling it once returns an instance"),
    (None, "lacks reset, step, snapshot, restore, unit, close(), see PersistentEnv in envs.py"),
    (variant(snapshot=None), "lacks snapshot(), see"),
    (gymnasium.wrappers.TimeLimit(Grid(), 9), "use env.unwrapped, or add them to the wrapper"),
    (variant(action_space=Box(0, 1)), "the action space is Box"),
    (variant(action_space=Discrete(257)), "at most 256 actions"),
    (variant(observation_space=Box(0, 255, (32, 32), np.float32)), "must be a Box of uint8"),
    (variant(observation_space=Box(0, 255, (8,), np.uint8)), "(H, W) or (H, W, C)"),
    (variant(observation_space=Box(0, 255, (9, 9, 5), np.uint8)), "channels come last, (H, W, C)"),
    (variant(observation_space=Box(0, 255, (3, 64, 64), np.uint8)), "channels come last"),
    (variant(reset=lambda env, seed: Grid.reset(env)[0]), "reset() must return a frame and a dict"),
    (variant(reset=lambda env, seed: (Grid.reset(env)[0], 0)), "reset() must return a frame"),
    (variant(picture=lambda env: [[0] * 32] * 32), "reset() returns a list as the frame, not"),
    (variant(picture=lambda env: np.zeros((32, 32))), "frame (32, 32) of float64"),
    (variant(snapshot=lambda env: [1]), "after step 0: snapshot() returns [1]"),
    (variant(snapshot=lambda env: b""), "after step 0: snapshot() returns b''"),
    (variant(unit=lambda env: 0.5), "after step 0: unit() returns 0.5"),
    (variant(step=lambda env, action: 1 / 0), "after step 1: step() fails with ZeroDivisionError"),
    (stepping(lambda env, *result: result[:4]), "after step 1: step() must return frame, reward"),
    (stepping(lambda env, *result: (*result[:4], None)), "terminated, truncated, and a dict"),
    (stepping(lambda env, frame, *rest: (frame[1:], *rest)), "step() returns a frame (31, 32)"),
    (stepping(lambda env, *result: (*result[:2], 0, False, {})), "returns 0 for terminated"),
    (variant(restore=lambda env, _: env.picture()), "restore() leads to a different frame than"),
    (variant(unit=lambda env: env.clock), "restore() leads to a different unit"),
    (variant(picture=lambda env: frame(len(env.seeds))), "reset() with the same seed leads to a "),
    (variant(picture=lambda env: frame(env.clock), restore=restore_in_order, restored=False),
     "leads to a different frame"),
    (variant(picture=lambda env: np.add(env.array, 1, out=env.array),  # the same array every time
             array=np.zeros((32, 32), np.uint8)), "leads to a different frame"),
    (stepping(lambda env, *result: (*result[:3], env.clock == 96, {})), "different truncated"),
    (stepping(lambda env, *result: (*result[:4], {"blank": env.clock % 10 == 0})),
     "the same action after a restore leads to a different blank"),
])  # fmt: skip
def test_the_contract_refuses(env, said):
    with pytest.raises(InputError, match=re.escape(said)):
        check_contract(env)


def test_the_environment_is_given_as_a_function_and_checked():
    with pytest.raises(InputError, match="is not a function: give a class or function"):
        envs.make_checked(Grid(), seed=5)
    with pytest.raises(InputError, match="lacks reset"):
        envs.make_checked(dict, seed=5)
    assert envs.make_checked(Clocked, seed=5).seeds[-1] == 5
    assert str(InputError("over\ntwo  lines")) == "over two lines"


def test_the_contract_finds_a_fault_that_shows_late_and_says_how_many_values_differ():
    draws = iter(range(99))  # which no snapshot holds

    def restore(env, snapshot):
        env.clock = snapshot[2]
        return Grid.restore(env, snapshot[:2])

    env = variant(
        picture=lambda env: frame(257 * next(draws) if env.clock == 100 else 0),
        snapshot=lambda env: bytes([*env.place, env.clock]),
        restore=restore,
    )
    said = "leads to a different frame than the first time: 2 values differ, the first at (0, 0)"
    with pytest.raises(InputError, match=re.escape(said)):
        check_contract(env)


def test_a_unit_becomes_a_tuple_of_plain_ints_and_strs():
    units = [None, 5, ("c", 3), [1, "b"], np.int64(6), np.str_("c"), np.array([1]), (True,)]
    keys = [unit_key(unit) for unit in units]
    assert keys == [None, (5,), ("c", 3), (1, "b"), (6,), ("c",), (1,), (1,)]
    assert {type(part) for key in keys[1:] for part in key} == {int, str}
    for unit in (0.5, (1, 2.0), {1}, ((1, 2), 3), (None,), b"c"):
        with pytest.raises(InputError, match="must be an int, a str, a tuple of them, or None"):
            unit_key(unit)


# ------------------------------------------------------------------------------------ the maze

# Every rule has a place here. Letters a, b: plates; A, B: their gates.
PLAYGROUND = """
    _@_.__.__a _____^.b_#
    #_#.#_____ #A_#^#.__B
    ___.______ __________
    _______^._ _____.____
    _________# _____^___#
    ########## ##########
"""


# x, y, facing, plates that are pressed: action: the same afterwards
RULES = {
    "LEFT and RIGHT turn, then run": ["1 0 > LEFT 1 0 <", "1 0 > RIGHT 2 0 >"],
    "walls stop": ["1 1 > RIGHT 1 1 >", "1 1 > A 1 1 >", "1 1 > B 1 1 >", "17 1 < A 16 2 <"],
    "beyond the level is a wall": ["0 0 < LEFT 0 0 <", "19 1 > b RIGHT 19 1 > b"],
    "a fall of two rows kills": ["5 0 > RIGHT 6 1 >", "15 0 > RIGHT 16 2 > dead"],
    "DOWN shortens it by one": ["15 0 > DOWN 16 2 >", "2 0 > DOWN 3 3 > dead"],
    "DOWN needs an edge": ["2 0 < DOWN 2 0 <"],
    "UP climbs on the side that is faced": ["6 1 > UP 7 0 >", "6 1 < UP 5 0 <"],
    "UP needs an opening and a floor": ["4 4 > UP 4 4 >", "5 1 > UP 5 1 >", "16 2 < UP 16 2 <"],
    "A jumps over a gap and spikes": ["2 0 > A 4 0 >", "6 3 > A 8 4 >"],
    "A may land in a gap": ["4 0 > A 6 1 >", "14 0 > A 16 2 > dead"],
    "B steps, but not over an edge": ["1 0 > B 2 0 >", "2 0 > B 2 0 >"],
    "spikes kill who runs or jumps": ["6 3 > RIGHT 7 3 > dead", "13 0 > A 15 0 > dead"],
    "spikes kill who falls or climbs": ["14 3 > DOWN 15 4 > dead", "8 4 < UP 7 3 < dead"],
    "spikes spare who steps or stands": ["6 3 > B 7 3 >", "15 0 > LEFT 15 0 <"],
    "plates are pressed and latched": ["8 0 > B 9 0 > a", "15 0 > A 17 0 > b"],
    "plates stay pressed": ["9 0 > a b LEFT 9 0 < a b", "8 0 > b RIGHT 9 0 > a b"],
    "a plate opens its gate": ["12 1 < b LEFT 12 1 < b", "12 1 < a LEFT 11 1 < a"],
}


@pytest.fixture
def playground(monkeypatch):
    monkeypatch.setitem(envs.LEVELS, 4, PLAYGROUND)
    return Maze(4, frame_size=96)


@pytest.mark.parametrize("rule", RULES)
def test_the_rules_of_the_maze(playground, rule):
    for move in RULES[rule]:
        before, action, after = re.fullmatch("(.*) ([A-Z]+) (.*)", move).groups()
        snapshots = []
        for state in (before, after):
            x, y, facing, *rest = state.split()
            plates = ("a" in rest) + 2 * ("b" in rest)
            snapshots.append(bytes([4, int(x), int(y), facing == ">", plates, "dead" in rest]))
        playground.restore(snapshots[0])
        outcome = playground.step(getattr(envs, action))[1:]
        assert list(playground.snapshot()) == list(snapshots[1])
        assert outcome == (0.0, "dead" in after, False, {})
        unit = (2 * (int(y) // 3) + int(x) // 10, int(x) % 10, int(y) % 3)
        assert playground.unit() == (None if "dead" in after else unit)
        playground.reset()
        assert list(playground.snapshot()) == [4, 1, 0, 1, 0, 0]


def test_a_frame_shows_place_facing_plates_gates_and_death(playground):
    # x, y, facing, plates, dead. The first plate is in the first room, its gate in the second.
    states = [[1, 0, 1, 0, 0], [2, 0, 1, 0, 0], [1, 0, 0, 0, 0], [1, 0, 1, 1, 0], [1, 0, 1, 0, 1]]
    states += [[12, 1, 1, 0, 0], [12, 1, 1, 1, 0]]
    frames = {playground.restore(bytes([4, *state])).tobytes() for state in states}
    assert len(frames) == 7


def test_S5_03_S5_04_the_number_of_units_of_each_level():
    assert [Maze(level).full_coverage for level in (1, 2, 3)] == [187, 258, 358]


def test_the_level_map_has_a_box_for_each_reachable_unit():
    env = Maze()
    picture, boxes = env.level_map()
    assert picture.shape == (9 * 24, 30 * 8, 3)  # 9 lines of 30 tiles
    assert boxes.keys() == env.reachable()
    assert boxes[6, 1, 2] == (8 * 1, 24 * 8, 8, 24)  # where the agent starts
    assert boxes[8, 4, 1] == (8 * 24, 24 * 7, 8, 24)
    for y, line in enumerate(envs.LEVELS[1].replace(" ", "").split()):
        floors = {tuple(picture[24 * y + 23, 8 * x]) for x in range(30) if line[x] == "_"}
        assert floors == {envs.FLOOR}


@pytest.mark.parametrize("snapshot", [
    [3, 1, 0, 1, 0, 0],  # another level
    [4, 3, 0, 1, 0, 0], [4, 0, 1, 1, 0, 0], [4, 11, 1, 1, 2, 0],  # in mid-air, a wall, a gate
    [4, 200, 0, 1, 0, 0], [4, 1, 0, 2, 0, 0], [4, 1, 0, 1, 4, 0], [4, 1, 0, 1, 0, 2],  # too large
    [4, 1, 0, 1, 0], [4, 1, 0, 1, 0, 0, 0],  # too short, too long
])  # fmt: skip
def test_a_snapshot_of_no_state_of_the_maze_is_refused(playground, snapshot):
    with pytest.raises(InputError, match="no snapshot of maze level 4: "):
        playground.restore(bytes(snapshot))
    assert list(playground.snapshot()) == [4, 1, 0, 1, 0, 0]


# ------------------------------------------------------------- the factory, Gymnasium, bad input


def test_the_factory_makes_environments_by_name():
    env = make_env("maze", level=2, frame_size=40, frameskip=1)
    assert env.level == 2
    assert env.reset()[0].shape == (40, 40)


@pytest.mark.parametrize("name, options, said", [
    ("doom", {}, "unknown environment 'doom': there are maze, pop, montezuma"),
    ("maze", {"speed": 1}, "maze has no option 'speed': it has level, frame_size, frameskip"),
    ("maze", {"level": 9}, "unknown maze level 9: there are 1, 2, 3"),
    ("maze", {"level": "1"}, "unknown maze level '1'"),
    ("maze", {"frame_size": 31}, "32 pixels or more, not 31"),
    ("maze", {"frame_size": 32.0}, "must be an int, 32 pixels or more, not 32.0"),
    ("maze", {"frameskip": 4}, "a step of the maze is a whole move: frameskip is 1, not 4"),
])  # fmt: skip
def test_the_factory_refuses_in_one_line(name, options, said):
    with pytest.raises(InputError, match=re.escape(said)):
        make_env(name, **options)


def test_every_environment_keeps_the_contract_and_refuses_other_actions(env):
    env.reset()
    before = memory(env)
    check_contract(env)
    last = int(env.action_space.n) - 1
    for action in (-1, last + 1, 1.5, None):
        with pytest.raises(InputError, match=f"there are actions 0 to {last}, and not {action}"):
            env.step(action)
    assert memory(env).hex() == before.hex()
    env.step(np.int64(last))
    check_env(env, skip_render_check=True)


def test_s_init_is_one_second_after_power_on_and_the_clock_is_held(prince):
    assert 50 <= memory(prince)[0] <= 60  # frames
    assert memory(prince)[1221:1223] == b"99"


def test_the_readings_of_montezuma(montezuma, capfd):
    env = montezuma()
    assert capfd.readouterr() == ("", "")  # no banner
    assert env.reset()[1] == {"room": 1, "x": 77, "y": 235, "lives": 5, "blank": False}
    units = [env.unit()]
    for _ in range(14):  # down the ladder
        env.step(5)
        units.append(env.unit())
    assert [units[0], units[-1]] == [(1, 4, 1), (1, 4, 3)]
    assert env.unit_name == "units of 16 x 16 pixels"


@pytest.mark.parametrize("change, said", [
    ({"rom": None}, "--rom FILE"),
    ({"rom": "nowhere.nes"}, "cannot read .* No such file"),
    ({"rom": b"GAME" + bytes(150_000)}, "no complete NES"),
    ({"rom": b"NES\x1a\x08" + bytes(99)}, "no complete NES"),
    ({"level": 0}, "levels 1 to 14, not 0"),
    ({"level": 15}, "levels 1 to 14, not 15"),
    ({"level": 1.0}, "levels 1 to 14, not 1.0"),
    ({"level": 2}, "game.nes is not in play on level 2: {"),
    ({"state": gzip.compress(b"cut")[:9]}, "cannot read"),
    ({"state": gzip.compress(b"x" * 99)[:10] + b"\xff" * 9}, "cannot read"),
    ({"state": gzip.compress(b"FCS rubbish")}, "no state of this emulator"),
    ({"state": gzip.compress(bytes(13339))}, "no state of this emulator"),
    ({"state": {"level": 5}}, "not in play on level 1, or the state is of another cartridge"),
    ({"state": {"hit_points": 0}}, "file is not in play on level 1, or the state is of another"),
])  # fmt: skip
def test_bad_input_is_one_line_and_leaves_no_emulator(console, tmp_path, change, said):
    env = console()
    file = tmp_path / "file"
    [(name, value)] = change.items()
    if isinstance(value, dict):
        value = start_state(env, file, **value)
    if isinstance(value, bytes):
        file.write_bytes(value)
        value = str(file)
    env.close()
    options = {"rom": str(tmp_path / "game.nes"), name: value}
    with pytest.raises(InputError, match=said) as error:
        PrinceOfPersia(**options)
    assert len(str(error.value).splitlines()) == 1
    console()
    with pytest.raises(InputError, match=r"the emulator refuses .*: close\(\) the first"):
        PrinceOfPersia(str(tmp_path / "game.nes"))


def test_a_snapshot_of_another_cartridge_or_level_is_refused(console, tmp_path):
    env = console()
    snapshot = env.snapshot()
    state = start_state(env, tmp_path / "state", level=2)
    for options in ({"image": cartridge() + b"x"}, {"level": 2, "state": state}):
        with pytest.raises(InputError, match="or of another game, level or start state"):
            console(**options).restore(snapshot)


def test_a_damaged_snapshot_and_a_closed_emulator_are_refused(emulator):
    env = emulator()
    snapshot = env.snapshot()
    for bad in (b"", b"rubbish", None, snapshot[:-1], snapshot + b"x"):
        with pytest.raises(InputError, match="the snapshot is damaged, or of another game"):
            env.restore(bad)
    env.restore(snapshot)
    env.close()
    env.close()
    for name, *arguments in (["unit"], ["snapshot"], ["reset"], ["step", 0], ["restore", snapshot]):
        with pytest.raises(InputError, match="the emulator is closed"):
            getattr(env, name)(*arguments)


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_retro", None)
    monkeypatch.setitem(sys.modules, "ale_py", None)
    rom = tmp_path / "game.nes"
    rom.write_bytes(cartridge())
    with pytest.raises(InputError, match="pip install stable-retro"):
        make_env("pop", rom=str(rom))
    with pytest.raises(InputError, match="pip install ale-py"):
        make_env("montezuma")


# ------------------------------------------------------------- the run folder and the command line

SIZES = ["--steps=800", "--M=4", "--L=3", "--trajectory-steps=40", "--epochs=1"]  # as in TINY
CELLS = [*SIZES, "--method=cells", "--no-figures"]  # a run of an eighth of a second
RANDOM = [*SIZES, "--method=random"]
FIGURES = ["coverage.png", "coverage_map.png", "centres.png", "route.gif", "graph.png"]
MEMORY = "out of memory: choose smaller values of M, trajectory_steps, L, r_batch or"


def rows_of(folder):
    with open(folder / "metrics.csv", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def differences(one, other):
    """The parts of the algorithm's state in which two runs differ."""
    assert len(rows_of(one)) == len(rows_of(other))
    parts = [plain(rbexplore.read_checkpoint(folder)["algorithm"]) for folder in (one, other)]
    return [name for name in parts[0] if parts[0][name] != parts[1][name]]


def command(*words, code=0):
    """Run the command, which returns this exit code."""
    assert main([str(word) for word in words]) == code


def refused(capsys, *words):
    """The one line by which the command refuses."""
    capsys.readouterr()
    command(*words, code=2)
    (line,) = capsys.readouterr().err.splitlines()
    return line


def random_run(folder, env_fn=Grid, **changes):
    """A run without networks, made in Python."""
    return Run(folder, make_method("random", env_fn, replace(TINY, **changes)))


def at_call(k, function, fault):
    """The function, but its call number k first raises the fault, or calls it."""
    calls = iter(range(10**6))

    def faulty(*arguments):
        if next(calls) == k:
            if isinstance(fault, BaseException):
                raise fault
            fault()
        return function(*arguments)

    return faulty


class Moved(Grid):
    """Starts at another place."""

    def reset(self, *, seed=None, options=None):
        return self.restore(bytes([1, 0])), {}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A folder of runs that are not to be changed. `whole` is one of RbExplore on the grid."""
    folder = tmp_path_factory.mktemp("runs")
    list(Run(folder / "whole", explorer(Grid)).begin())
    command(*CELLS, f"--out={folder / 'cells'}")
    command(*CELLS, "--level=2", f"--out={folder / 'level'}")
    command(*CELLS, "--steps=801", f"--out={folder / 'steps'}")
    command(*RANDOM, "--no-figures", f"--out={folder / 'random'}")
    random_run(folder / "python").begin()
    random_run(folder / "start", Moved).begin()
    (folder / "mine").mkdir()
    (folder / "mine" / "metrics.csv").touch()
    return folder


def test_a_run_folder_holds_what_the_readme_says(tmp_path, capsys):
    for name in ("checkpoint.pt.new", ".lock"):  # left by a kill
        (tmp_path / name).touch()
    command(*SIZES, "--pretrain-steps=400", f"--out={tmp_path}")
    printed = capsys.readouterr().out
    names = {path.name for path in tmp_path.iterdir()} - {".lock"}
    assert names == {"checkpoint.pt", "config.json", "metrics.csv", *FIGURES}
    assert [name for name in names if name not in printed] == []
    settings = json.loads((tmp_path / "config.json").read_text(encoding="utf-8"))
    assert settings["config"] == asdict(replace(TINY, merge_every=15))
    rows = [[row["iteration"], row["phase"]] for row in rows_of(tmp_path)]
    assert [line.split()[:2] for line in printed.splitlines()[2:-2]] == rows
    assert "187 tiles to cover; seed 0; 800 steps, 400 of them pretraining" in printed
    assert re.search(r"\d+ s: \d+ tiles of 187, [\d.]+%; steps to 50 %: not reached", printed)


def test_a_run_with_workers_that_is_killed_is_resumed_and_extended_to_the_same_bytes(tmp_path):
    killed = tmp_path / "killed"
    argv = [sys.executable, rbexplore.__file__, *CELLS, "--steps=1500", f"--out={killed}"]
    with subprocess.Popen([*argv, "--workers=2"], stdout=subprocess.PIPE, text=True) as process:
        next(line for line in process.stdout if line.split()[:1] == ["3"])
        process.kill()
        process.communicate(timeout=60)  # until the workers, which hold the output, have ended
    command("--resume", killed, "--steps=2000", "--workers=1", "--no-figures")
    command(*CELLS, "--steps=2000", f"--out={tmp_path / 'whole'}")
    assert differences(killed, tmp_path / "whole") == []
    assert json.loads((killed / "config.json").read_text())["config"]["steps"] == 2000


def sigterm():
    assert callable(signal.getsignal(signal.SIGTERM)), "else it ends the tests"
    signal.raise_signal(signal.SIGTERM)


# KeyboardInterrupt: as Ctrl-C, unless the process ignores SIGINT.
@pytest.mark.parametrize(("stop", "code"), [(KeyboardInterrupt(), 130), (sigterm, 143)])
def test_a_stopped_run_says_how_to_resume_and_draws(
    runs, tmp_path, capsys, monkeypatch, stop, code
):
    handler = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(Maze, "step", at_call(500, Maze.step, stop))
    command(*RANDOM, f"--out={tmp_path}", code=code)
    printed = capsys.readouterr().out
    assert signal.getsignal(signal.SIGTERM) == handler
    assert f"to resume: python rbexplore.py --resume {tmp_path}" in printed
    assert f"\n{rows_of(tmp_path)[-1]['steps']} steps, " in printed  # complete iterations
    assert "coverage_map.png" in [path.name for path in tmp_path.iterdir()]
    command("--resume", tmp_path, "--no-figures")
    assert differences(tmp_path, runs / "random") == []


@pytest.mark.parametrize(("owner", "name", "call", "error"), [
    (Grid, "step", 300, OSError()),  # in the middle of a walk
    (RbExplore, "train_novelty", 2, KeyboardInterrupt()),  # after R was trained and G updated
    (os, "fsync", 6, OSError()),  # in saving the second iteration
])  # fmt: skip
def test_a_run_that_raised_continues_after_the_last_complete_iteration(
    runs, tmp_path, monkeypatch, owner, name, call, error
):
    run = Run(tmp_path, explorer(Grid)).begin()
    monkeypatch.setattr(owner, name, at_call(call, getattr(owner, name), error))
    with pytest.raises(type(error)):
        list(run)
    assert run.algorithm.iteration == len(run.rows) == len(rows_of(tmp_path))
    assert list(tmp_path.glob("*.new")) == []
    list(run)
    assert differences(tmp_path, runs / "whole") == []


def test_a_run_whose_worker_died_continues_after_the_last_complete_iteration(runs, tmp_path):
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as executor:
        run = Run(tmp_path, RbExplore(Grid, TINY, executor=executor)).begin()
        with pytest.raises(InputError, match="a worker process died .*use fewer workers"):
            for _ in run:
                executor.submit(os._exit, 1)
    assert run.algorithm.iteration == 1
    list(Run(tmp_path, explorer(Grid)).resume())
    assert differences(tmp_path, runs / "whole") == []


def test_executors_give_the_same_metrics():
    def metrics(executor):
        a = RbExplore(Grid, replace(TINY, beta=0.0), executor=executor)
        a.similarity = Cells()
        return [a.iterate().metrics for _ in range(4)]

    expected = metrics(None)
    assert sum(row["additional"] for row in expected) > 0
    fork = multiprocessing.get_context("fork")
    executors = [ProcessPoolExecutor(k, fork) for k in (1, 2, 3)]
    for executor in (*executors, ThreadPoolExecutor(3)):
        with executor:
            RbExplore(Maze, TINY, executor=executor)  # the workers first make another one
            assert metrics(executor) == expected


def test_a_worker_that_gets_sigterm_ends_its_walk_first():
    with ProcessPoolExecutor(1, initializer=rbexplore.end_with_parent) as executor:
        assert executor.submit(signal.raise_signal, signal.SIGTERM).result() is None


def test_an_environment_that_workers_cannot_make_is_refused_at_once():
    said = "define the class or function that makes it in a module"
    with ProcessPoolExecutor(1) as executor, pytest.raises(InputError, match=said):
        RbExplore(lambda: Grid(), TINY, executor=executor)


def test_a_lock_is_named_and_released_however_a_run_ends(tmp_path, monkeypatch):
    for _ in random_run(tmp_path).begin():
        assert len(rows_of(tmp_path)) == 1  # an iteration is saved before it is yielded
        break
    run = random_run(tmp_path).resume()  # which is refused where the lock is held
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(Grid, "step", at_call(10, Grid.step, ZeroDivisionError()))
        list(run)
    said = f"in use by another process.* If no process uses it, delete {tmp_path / '.lock'}"
    with random_run(tmp_path).resume() as holder, pytest.raises(InputError, match=said):
        list(holder)
        list(run)
    list(run)
    assert random_run(tmp_path).resume().rows == run.rows


class Trojan:
    """Makes a folder when it is unpickled."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


def test_a_damaged_checkpoint_is_refused(runs, tmp_path, capsys):
    path = tmp_path / "checkpoint.pt"
    torch.save(Trojan(tmp_path / "trojan"), path)
    trojan = path.read_bytes()
    state = rbexplore.read_checkpoint(runs / "cells")
    torch.save(state | {"algorithm": {}}, path)
    of_another_version = path.read_bytes()
    del state["rows"]
    torch.save(state, path)
    without_rows = path.read_bytes()
    content = (runs / "cells" / "checkpoint.pt").read_bytes()
    k = content.index(Maze().reset()[0].tobytes()) + 500
    flipped = content[:k] + bytes([content[k] ^ 1]) + content[k + 1 :]  # one bit, in a frame
    for damaged in (flipped, of_another_version, without_rows, content[:3000], b"text", trojan):
        path.write_bytes(damaged)
        said = f"{path} cannot be loaded .*: it is damaged or of another version; start over in"
        assert re.search(said, refused(capsys, "--resume", tmp_path))
    assert not (tmp_path / "trojan").exists()


@pytest.mark.parametrize(("fault", "said"), [
    (lambda: torch.empty(2**50), MEMORY),
    (lambda: np.empty(2**50), MEMORY),
    (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"), MEMORY),
    (RuntimeError("DefaultCPUAllocator: not enough memory: you tried"), MEMORY),
    (OSError(28, "No space left on device"), "a file: No space left on device; make room"),
    (OSError(13, "Permission denied", "x"), "x: Permission denied; choose an --out that can be"),
    (OSError(37, "No locks available"), "; choose an --out on a file system that has locks"),
])  # fmt: skip
def test_an_error_that_the_user_can_fix_is_one_line_with_a_hint(
    tmp_path, capsys, monkeypatch, fault, said
):
    monkeypatch.setattr(Maze, "step", at_call(300, Maze.step, fault))
    assert said in refused(capsys, *CELLS, f"--out={tmp_path}")


@pytest.mark.parametrize("streams", [["stderr"], ["stderr", "stdout"]])
def test_a_run_without_standard_streams(tmp_path, monkeypatch, streams):
    for stream in streams:  # as after 2>&-, and with pythonw
        monkeypatch.setattr(sys, stream, None)
    command(*CELLS, f"--out={tmp_path}")


def test_names_that_the_output_cannot_encode_are_escaped(tmp_path, monkeypatch):
    stdout = io.TextIOWrapper(io.BytesIO(), "cp1252", write_through=True)
    monkeypatch.setattr(sys, "stdout", stdout)
    command(*CELLS, f"--out={tmp_path / '日本'}")
    assert rb"\u65e5\u672c" in stdout.buffer.getvalue()


def test_metrics_that_cannot_be_replaced_are_a_warning_and_tried_again(
    runs, tmp_path, capsys, monkeypatch
):
    metrics = tmp_path / "metrics.csv"
    metrics.mkdir()
    shutil.copy(runs / "cells" / "checkpoint.pt", tmp_path)
    monkeypatch.setattr(Maze, "step", at_call(300, Maze.step, metrics.rmdir))
    command("--resume", tmp_path, "--steps=1200", "--no-figures")
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"warning: {metrics} cannot be written: Is a directory"
    assert int(rows_of(tmp_path)[-1]["steps"]) >= 1200


def test_ten_deaths_in_a_row_at_the_first_step_are_reported_and_stop_no_run(tmp_path):
    dead = replace(tau([0]), units=[(0,)], terminated=True)
    cut = replace(tau([0]), units=[(0,)], truncated=True)
    later = replace(tau([0]), units=[(0,)] * 2, terminated=True)
    walks = [[*[dead] * 9, later]] * 2 + [[dead] * 10] * 50 + [[later, *[cut] * 9], [cut] * 10]
    a = explorer(Grid, M=10, L=0, steps=543, pretrain_steps=0)
    a.walks = lambda *arguments: walks[a.iteration - 1]
    before = plain(a.similarity.state_dict())
    with warnings.catch_warnings(record=True) as reports:
        warnings.simplefilter("always")
        counts = [len(reports) for _ in Run(tmp_path, a).begin()]
    assert counts == [0] * 2 + [1] * 51 + [2]
    said = "ten trajectories in a row ended at their first step, the last"
    why = "truncated: is there a time limit that restore() does not reset?"
    assert [str(report.message) for report in reports] == [f"{said} terminated", f"{said} {why}"]
    assert plain(a.similarity.state_dict()) == before  # R has nothing to learn


class Cliff(Grid):
    """Places 0 to 3 on a cliff. Action 2 jumps, and the step after a jump is death: half of the
    states cannot be survived."""

    action_space = Discrete(3)
    full_coverage = None

    def picture(self):
        return frame(2 * self.place[0] + self.place[1])

    def step(self, action):
        x, falling = self.place
        jumps = action == 2
        self.place = (x if jumps else min(3, max(0, x + 2 * action - 1)), int(jumps))
        return self.picture(), 0.0, bool(falling), False, {}

    def unit(self):
        return self.place


def test_deaths_at_the_first_step_never_stop_a_run(tmp_path):
    sizes = {"M": 1000, "n": 1, "N": 1, "trajectory_steps": 2, "additional_steps": 2, "L": 0}
    a = explorer(Cliff, steps=30_000, pretrain_steps=0, **sizes)
    a.similarity = Stub(lambda s, s_i: s == s_i)
    deaths = 0
    with warnings.catch_warnings(record=True):
        for iteration in Run(tmp_path, a).begin():
            deaths += sum(len(t.units) == 1 for t in iteration.trajectories)
    assert len(a.graph.clusters) == 8
    assert deaths > 5000


def test_a_tilde_is_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    command(*CELLS, "--out=~/run")
    command("--resume=~/run", "--steps=800", "--no-figures")
    command("--verify=~/run")
    command("--compare", "~/run", "--out=~/comparison", "--no-figures")
    with ThreadPoolExecutor(1) as executor:  # as Dask's workers do
        executor.submit(command, *CELLS, "--seed=5").result()
    assert sorted(map(str, pathlib.Path().glob("*/"))) == ["comparison", "run", "runs"]
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["maze-5"]
    command(*CELLS, "--out=~nobody-of-this-name/run")


def test_a_setting_of_tqdm_that_cannot_be_read_is_one_line(tmp_path, capsys, monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "tqdm"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setenv("TQDM_MININTERVAL", "junk")
    line = refused(capsys, *CELLS, f"--out={tmp_path}")
    assert "an environment variable TQDM_... is invalid" in line


def test_a_run_of_something_else_is_named(tmp_path):
    random_run(tmp_path).begin()
    for other, said in (
        (Run(tmp_path, make_method("cells", Grid, TINY)), "method is random there and cells here"),
        (random_run(tmp_path, M=5), "M is 4 there and 5 here"),
        (random_run(tmp_path, seed=5), "seed is 0 there and 5 here"),
        (random_run(tmp_path, Track), "another environment: its initial state differs"),
        (random_run(tmp_path / "nowhere"), "there is no run in"),
    ):
        with pytest.raises(InputError, match=said):
            other.resume()
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize(("words", "said"), [
    ("--env=moon", "unknown environment 'moon'"),
    ("--env=montezuma --level=2", "montezuma has no option 'level'"),
    ("--M=x", "invalid int value: 'x'; --help lists the options"),
    ("--M=0", "M is 0: choose a number from 1"),
    ("--step=9", "unrecognized arguments: --step=9"),  # options are not abbreviated
    ("--method=best", "invalid choice: 'best'"),
    ("--device=nowhere", "device nowhere cannot be used"),
    ("--workers=0", "'0' is not a number from 1 to 1,000"),
    ("--out=", "--out is empty"),
    ("--out=mine", "mine is not empty and holds no run: choose another folder"),
    ("--out=cells", "cells holds a run already: resume it, or choose another folder"),
    ("--resume=nowhere", "there is no run in nowhere"),
    ("--resume=python", "python was made in Python, and its environment is not known here"),
    ("--resume=cells --steps=799", "a run can be extended, not shortened; give 800 or more"),
    ("--resume=cells --level=1", "--level cannot be given with --resume"),
    ("--resume=cells --M=4", "--M cannot be given with --resume"),
    ("--resume=cells --threads=1", "--threads cannot be given with --resume"),
    ("--resume=cells --method=cells", "--method cannot be given with --resume"),
    ("--resume=cells --config=maze", "--config cannot be given with --resume"),
    ("--verify=random", "random is a run of random, which has no clusters"),
    ("--verify=x --resume=x", "--resume cannot be given with --verify"),
    ("--compare x --steps=9", "--steps cannot be given with --compare"),
    ("--compare cells level", "cells and level cannot be compared: level is 1 in the one and 2"),
    ("--compare cells steps", "cells and steps cannot be compared: steps is 800 in the one and"),
    ("--compare cells python", "cells and python cannot be compared: env is maze in the one"),
    ("--compare python start", "python and start cannot be compared: their initial states differ"),
])  # fmt: skip
def test_what_is_refused_is_one_line_and_nothing_is_created(runs, capsys, monkeypatch, words, said):
    monkeypatch.chdir(runs)
    before = sorted(runs.rglob("*"))
    assert said in refused(capsys, *words.split())
    assert sorted(runs.rglob("*")) == before


@pytest.mark.parametrize(("full", "iterations"), [(1, 0), (2, 1)])  # one covers more than 2 tiles
def test_stop_at_full_coverage(tmp_path, monkeypatch, full, iterations):
    monkeypatch.setattr(Maze, "reachable", lambda maze: range(full))
    command(*RANDOM, f"--out={tmp_path}", "--stop-at-full", "--no-figures")
    command("--resume", tmp_path, "--stop-at-full", "--no-figures")
    assert len(rows_of(tmp_path)) == iterations
    command("--resume", tmp_path, "--no-figures")
    assert int(rows_of(tmp_path)[-1]["steps"]) >= 800


def test_the_command_verify(runs, tmp_path, capsys):
    before = (runs / "cells" / "checkpoint.pt").read_bytes()
    command("--verify", runs / "cells")
    assert (runs / "cells" / "checkpoint.pt").read_bytes() == before
    state = rbexplore.read_checkpoint(runs / "cells")
    graph = state["algorithm"]["graph"]
    total = len(graph["clusters"])
    said = f"{total} of {total} clusters are reached exactly"
    assert capsys.readouterr().out.splitlines()[-1] == said
    v = max(graph["clusters"])
    graph["E_parent"][v] = (0, graph["E_parent"][v][1], b"\0")
    torch.save(state, tmp_path / "checkpoint.pt")
    command("--verify", tmp_path, code=1)
    assert capsys.readouterr().out.splitlines()[-2:] == [
        f"cluster {v}, 1 steps from s_init: the actions do not lead to the centre",
        f"{total - 1} of {total} clusters are reached exactly",
    ]


def test_the_command_compare(runs, tmp_path, capsys):
    checkpoint = rbexplore.read_checkpoint(runs / "random")
    checkpoint["algorithm"]["coverage"]["steps"] = 700  # unfinished
    torch.save(checkpoint, tmp_path / "checkpoint.pt")
    out = tmp_path / "out"
    command("--compare", runs / "cells", tmp_path, f"--out={out}")
    names = ["curves.csv", "curves.png", "maps.png", "table.csv"]
    assert sorted(path.name for path in out.iterdir()) == names
    _, _, *printed = capsys.readouterr().out.splitlines()
    _, *table = csv.reader((out / "table.csv").read_text().splitlines())
    assert printed == [f"| {' | '.join(row)} |" for row in table]
    assert [row[:2] for row in table] == [["cells", "1"], ["random", "1 (1 unfinished)"]]
    curves = csv.DictReader((out / "curves.csv").read_text().splitlines())
    rows = [(name, row["units"]) for name in ("cells", "random") for row in rows_of(runs / name)]
    assert [(row["group"], row["units"]) for row in curves] == rows


def test_figures_neither_use_nor_change_the_users_settings(tmp_path, monkeypatch):
    run = random_run(tmp_path).begin()
    list(run)
    names = draw(run)
    assert names == ["coverage.png", "coverage_map.png"]
    figures = [(tmp_path / name).read_bytes() for name in names]
    monkeypatch.setitem(matplotlib.rcParams, "lines.linewidth", 9.0)
    monkeypatch.setitem(matplotlib.rcParams, "figure.facecolor", "red")
    settings = matplotlib.rcParams.copy()
    draw(run)
    assert [(tmp_path / name).read_bytes() for name in names] == figures
    assert matplotlib.rcParams.copy() == settings


def test_figures_that_cannot_be_drawn_hide_no_run(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(rbexplore, "curves_figure", lambda *arguments: 1 / 0)
    command(*RANDOM, f"--out={tmp_path / 'drawn'}")
    assert "but no figures (ZeroDivisionError: division by zero)" in capsys.readouterr().out
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "matplotlib cannot be imported" in refused(capsys, f"--out={tmp_path / 'other'}")
    assert not (tmp_path / "other").exists()
    command(*CELLS, f"--out={tmp_path / 'other'}")


def test_units_without_a_place_have_no_map(tmp_path, monkeypatch):
    monkeypatch.setattr(Grid, "unit", lambda env: "everywhere")
    a = make_method("cells", Grid, TINY)
    a.iterate()
    assert draw(Run(tmp_path, a).begin()) == ["coverage.png", "centres.png", "route.gif"]


def test_help_shows_every_field_of_the_configuration(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    shown = " ".join(capsys.readouterr().out.split())
    meanings = [f.metadata["meaning"] for f in Config.__dataclass_fields__.values()]
    assert [meaning for meaning in meanings if meaning not in shown] == []
    assert "--n int [5 | 2 | 5] similar" in shown


# --------------------------------------------------------------------------------------- the README

README = (HERE / "README.md").read_text(encoding="utf-8")


def test_every_row_of_the_ledger_has_a_function_that_exists_and_a_test():
    rows = re.findall(r"^\| (S[\d.]+-\d+) \|.*\| `([\w.]+)` \|$", README, re.M)
    assert len({row for row, _ in rows}) == 76
    tests = " ".join(name for name in globals() if name.startswith("test_"))
    assert [row for row, _ in rows if re.sub(r"[.-]", "_", row) + "_" not in tests] == []
    for _, function in rows:
        names = function.split(".")
        module = rbexplore if hasattr(rbexplore, names[0]) else envs
        functools.reduce(getattr, names, module)  # raises AttributeError for what does not exist


def test_the_example_of_the_readme_runs(tmp_path, capsys, monkeypatch):
    (example,) = re.findall(r"```python\n(.*?)```", README, re.S)
    monkeypatch.chdir(tmp_path)
    exec(example.replace("10_000", "600").replace("1_000", "300"), {})
    assert capsys.readouterr().err == ""
    assert (tmp_path / "runs" / "line" / "graph.png").exists()
