"""Tests. Those of a statement of the paper carry its number: S4.2-19 is `pytest -k S4_2_19`; those
of a reading carry R and its number. A frame often holds a number: it is its own ground truth."""

import contextlib
import functools
import gzip
import io
import json
import math
import multiprocessing
import os
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import time
import zlib
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict, replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from gymnasium.utils.env_checker import check_env
from torch import nn

import envs
import rbexplore
from envs import (
    InputError,
    Maze,
    Montezuma,
    PersistentEnv,
    PrinceOfPersia,
    check_contract,
    make_env,
    unit_key,
)
from rbexplore import (
    ICM,
    MAZE,
    METHODS,
    PPO,
    RND,
    Cells,
    Config,
    Graph,
    RbExplore,
    RNDBonus,
    Run,
    SimilarityModel,
    State,
    Trajectory,
    advantages_of,
    main,
    make_method,
    verify,
)

torch.set_num_threads(1)  # networks this small are faster so
HERE = pathlib.Path(__file__).parent
TINY = replace(MAZE, steps=800, pretrain_steps=400, M=4, L=3, trajectory_steps=40, merge_every=2)

# ------------------------------------------------------------------------------------------ helpers


def frame(number):
    """A picture that holds a number."""
    picture = np.zeros((32, 32), np.uint8)
    picture[0, 0], picture[0, 1] = divmod(number, 256)
    return picture


def number(picture):
    return int(picture[0, 0]) * 256 + int(picture[0, 1])


def tau(numbers, start=0, prefix=()):
    """A trajectory whose states hold these numbers; action t leads to state t."""
    frames = np.stack([frame(k) for k in numbers])
    snapshots = [b"%d" % k for k in numbers]
    actions = [b""] + [bytes([k % 256]) for k in numbers[1:]]
    t = Trajectory(frames, snapshots, actions, [(k,) for k in numbers[1:]], ended=False)
    t.start = start
    t.full_prefix = [frame(k) for k in prefix]
    return t


class Stub(nn.Module):
    """An R that is a function of the two numbers; it counts what it is asked."""

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
    """Similar are the numbers of one ten."""
    return a // 10 == b // 10


def table(values):
    """R from a table, 0 for what is not in it."""
    return lambda a, b: values.get((a, b), 0.0)


def grown(walks, R=tens, theta=0.5):
    """G from state 0, after walks: (start, numbers). Returns G and its R."""
    stub = Stub(R)
    graph = Graph(State(frame(0), b"0"))
    graph.embed_centres(stub)
    for start, numbers in walks:
        graph.add_trajectory(tau(numbers, start), stub, theta)
    return graph, stub


def centres(graph):
    return {v: number(cluster.frame) for v, cluster in graph.clusters.items()}


def visits(graph):
    return {v: cluster.visits for v, cluster in graph.clusters.items()}


def numbers_of(frames):
    return [number(picture) for picture in frames]


def numbered(pairs):
    return [(number(s_1), number(s_2), y) for s_1, s_2, y in pairs]


def weights(module):
    return [value.clone() for value in module.state_dict().values() if torch.is_tensor(value)]


def equal(one, other):
    return len(one) == len(other) and all(map(torch.equal, one, other))


def pictures(count, seed=0, size=32):
    return np.random.default_rng(seed).integers(256, size=(count, size, size)).astype(np.uint8)


class Grid(gymnasium.Env):
    """A user's own environment: 7 x 7 places, seen in the frame, 4 actions. Column 5 is a blank
    screen, the corner (6, 6) kills, the corner (0, 6) ends the episode without a death."""

    observation_space = Box(0, 255, (16, 16), np.uint8)
    action_space = Discrete(4)
    full_coverage = 49
    rewards = None

    def picture(self):
        picture = np.zeros(self.observation_space.shape, np.uint8)
        if self.place[0] != 5:
            picture[2 * self.place[0], 2 * self.place[1]] = 255
            picture[15, 15] = 77 if self.place == (6, 6) else 0
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


class CountingMaze(Maze):
    """It counts the steps that it makes, and remembers its snapshots' places."""

    steps_made = 0

    def step(self, action):
        self.steps_made += 1
        return super().step(action)


def explorer(env_fn=Grid, config=TINY, **changes):
    return RbExplore(env_fn, replace(config, **changes))


def restarted(env_fn=Grid, **changes):
    """An algorithm after its pretraining."""
    a = explorer(env_fn, pretrain_steps=0, **changes)
    a.restart()
    return a


@pytest.fixture(scope="module")
def maze_run():
    """A run on the maze, with merges, and its iterations."""
    a = explorer(CountingMaze, steps=1500, beta=1.0)
    a.env.steps_made = 0
    iterations = []
    while a.steps < a.config.steps:
        iterations.append(a.iterate())
    return a, iterations


def own(pair, trajectories):
    """Whether the first state of the pair belongs to one of the trajectories."""
    return any(np.shares_memory(pair[0], t.frames) for t in trajectories)


# -------------------------------------------------------------- 3.2: persistence; 4: the five steps


def test_S3_2_02_a_rollback_costs_no_step(maze_run):
    a, iterations = maze_run
    walked = sum(len(t.units) for i in iterations for t in i.trajectories + i.additional)
    assert a.env.steps_made == walked == a.steps == 1500


def test_S3_2_03_the_stored_actions_lead_from_s_init_to_every_centre(maze_run):
    a, iterations = maze_run
    assert len(a.graph.clusters) > 5 and sum(len(i.merged) for i in iterations) > 0
    for v, cluster in a.graph.clusters.items():
        seen = a.env.restore(a.initial_state.snapshot)
        for action in a.graph.actions_to(v):
            seen = a.env.step(action)[0]
        assert np.array_equal(seen, cluster.frame)
        assert a.env.snapshot() == cluster.snapshot
    assert verify(a)[1]


def test_S3_2_03_actions_across_blank_frames_are_kept():
    a = restarted(theta_sim=0.95, merge=False).run()
    arcs = a.graph.E_parent.values()
    assert any(len(arc.actions) > len(arc.prefix) - 1 for arc in arcs)
    table, good = verify(a)
    assert good and f"{len(a.graph.clusters)} of {len(a.graph.clusters)} clusters" in table


@pytest.mark.parametrize("pretraining", [True, False])
def test_S4_01_step_1_is_M_trajectories_from_the_sampled_centres(pretraining):
    a = explorer(Maze, steps=2500, pretrain_steps=1100)
    a.restart()
    while len(a.graph.clusters) < 4:
        a.iterate()
    clusters = dict(a.graph.clusters)
    a.pretraining = pretraining
    rng = np.random.default_rng(5)
    trajectories = a.explore(np.random.default_rng(5))
    ids, p = a.graph.sampling_distribution()
    assert [t.start for t in trajectories] == rng.choice(ids, size=4, p=p).tolist()
    assert len({t.start for t in trajectories}) > 1
    for t in trajectories:
        assert np.array_equal(t.frames[0], clusters[t.start].frame)
        assert t.snapshots[0] == clusters[t.start].snapshot
        walked = a.graph.full_prefix(t.start)
        assert len(t.full_prefix) == len(walked) and all(map(np.array_equal, t.full_prefix, walked))
    assert any(t.full_prefix for t in trajectories)


def test_an_interrupted_training_leaves_R_in_evaluation_mode():
    model = SimilarityModel(MAZE, (32, 32))

    def interrupt(*batch):
        raise KeyboardInterrupt

    model.update = interrupt
    with pytest.raises(KeyboardInterrupt):
        model.fit([(frame(k), frame(k), k % 2) for k in range(9)], np.random.default_rng(0))
    assert not model.training


def test_S4_01_a_rollback_to_another_frame_is_an_error():
    a = restarted(Maze)
    a.graph.clusters[0].frame = a.graph.clusters[0].frame + 1
    with pytest.raises(InputError, match="restore"):
        a.iterate()


def test_S4_02_pairs_are_made_of_exploration_and_of_additional_trajectories(maze_run):
    both = next(i for i in maze_run[1] if i.additional)
    assert sum(own(pair, both.trajectories) for pair in both.pairs) > 50
    for t in both.additional:
        assert sum(own(pair, [t]) for pair in both.pairs) >= len(t.frames)


def test_S4_03_S4_04_S4_05_the_steps_in_the_papers_order(monkeypatch):
    a = restarted(Maze, merge_every=1)
    calls = []

    def spy(owner, name):
        inner = getattr(owner, name)

        def told(*arguments, **named):
            calls.append(name)
            return inner(*arguments, **named)

        monkeypatch.setattr(owner, name, told)

    for name in ("explore", "make_pairs", "train_similarity", "update_graph", "train_novelty"):
        spy(a, name)
    for name in ("embed_centres", "add_trajectory", "merge"):
        spy(a.graph, name)
    spy(a.similarity, "fit")
    spy(a.novelty, "fit")
    spy(a.novelty, "reward")
    a.iterate()
    in_order = list(dict.fromkeys(calls))
    assert in_order[:3] == ["explore", "make_pairs", "reward"]
    assert in_order[3:] == [
        "train_similarity",
        "fit",
        "update_graph",
        "embed_centres",
        "add_trajectory",
        "merge",
        "train_novelty",
    ]
    assert calls[-2:] == ["train_novelty", "fit"] and calls.count("add_trajectory") == 4


def test_S4_03_states_are_assigned_by_the_R_just_trained():
    a = restarted(Maze, merge=False)
    a.iterate()
    i = a.iterate()
    for t in i.trajectories:
        embeddings = a.similarity.embed(t.frames)
        for k in range(1, len(t.frames)):
            cluster = a.graph.clusters[t.clusters[k]]
            R = a.similarity.score(a.graph.embeddings[t.clusters[k]][None], embeddings[k])[0]
            own_centre = np.array_equal(cluster.frame, t.frames[k])
            assert R > 0.5 or own_centre
    fresh = a.similarity.embed(np.stack([v.frame for v in a.graph.clusters.values()]))
    for v, embedding in zip(a.graph.clusters, fresh, strict=True):
        assert torch.allclose(a.graph.embeddings[v], embedding, atol=1e-4)


def test_S4_05_novelty_is_told_by_weights_from_before_and_learns_exploration_alone(monkeypatch):
    a = restarted(Maze, beta=0.5)
    a.iterate()
    before = a.novelty.reward(pictures(5))
    told = []
    inner = a.novelty.reward
    monkeypatch.setattr(a.novelty, "reward", lambda f: told.append(inner(pictures(5))) or inner(f))
    learned = []
    fit = a.novelty.fit
    monkeypatch.setattr(
        a.novelty, "fit", lambda frames, rng: learned.extend(frames) or fit(frames, rng)
    )
    i = a.iterate()
    assert i.additional and all(np.array_equal(reward, before) for reward in told)
    assert not np.array_equal(inner(pictures(5)), before)
    assert len(learned) == len(i.trajectories)
    assert all(x is t.frames for x, t in zip(learned, i.trajectories, strict=True))


def test_S4_06_R_and_RND_train_on_this_iterations_data_alone(monkeypatch):
    a = restarted(Maze, beta=0.5)
    trained = []
    fit = a.similarity.fit
    monkeypatch.setattr(
        a.similarity, "fit", lambda pairs, rng: trained.append(pairs) or fit(pairs, rng)
    )
    for _ in range(3):
        i = a.iterate()
        assert trained[-1] is i.pairs
        assert all(own(pair, i.trajectories + i.additional) for pair in i.pairs)


def test_S4_07_no_reward_is_used():
    class Rewarding(Grid):
        rewards = np.random.default_rng(0)

    metrics = [explorer(env).run().state_dict() for env in (Grid, Rewarding)]
    assert torch.equal(
        metrics[0]["similarity"]["head.2.weight"], metrics[1]["similarity"]["head.2.weight"]
    )
    assert metrics[0]["discovered"] == metrics[1]["discovered"]
    assert metrics[0]["graph"]["arcs"] == metrics[1]["graph"]["arcs"]


# ---------------------------------------------------------------------- 4.1: the similarity model R


def test_S4_1_01_R_is_in_0_to_1_and_depends_on_the_pair_alone():
    model = SimilarityModel(MAZE, (32, 32))
    assert not model.training
    x = pictures(40)
    model.fit([(x[k], x[-k], k % 2) for k in range(20)], np.random.default_rng(0))
    assert not model.training
    R = model.score(model.embed(x), model.embed(x[::-1].copy()))
    assert R.shape == (40,) and R.min() >= 0 and R.max() <= 1 and R.std() > 0
    alone = [
        model.score(model.embed(x[k : k + 1]), model.embed(x[39 - k : 40 - k]))[0]
        for k in range(40)
    ]
    assert np.allclose(R, alone, atol=1e-5)
    assert np.array_equal(R, model.score(model.embed(x), model.embed(x[::-1].copy())))
    with torch.no_grad():
        logits = model(x, x[::-1].copy())
    assert np.allclose(torch.sigmoid(logits), R, atol=1e-5)


def all_pairs(T, n=3, N=6, draws=300):
    """Every pair that is ever drawn of a trajectory 0 ... T-1."""
    rng = np.random.default_rng(T)
    frames = tau(range(T)).frames
    return [numbered(rbexplore.pairs_within(frames, n, N, rng)) for _ in range(draws)]


@pytest.mark.parametrize("T", [1, 4, 7, 8, 20])
def test_S4_1_02_S4_1_03_S4_1_04_S4_1_05_S4_1_06_pairs_against_an_enumeration(T):
    drawn = all_pairs(T)
    similar = {(i, j) for i in range(T) for j in range(T) if abs(i - j) < 3}
    dissimilar = {(i, j) for i in range(T) for j in range(T) if abs(i - j) > 6}
    assert {(i, j) for draw in drawn for i, j, y in draw if y == 1} == similar
    assert {(i, j) for draw in drawn for i, j, y in draw if y == 0} == dissimilar
    for draw in drawn:  # R17: one of each for each state that has one
        assert [i for i, j, y in draw if y == 1] == list(range(T))
        assert [i for i, j, y in draw if y == 0] == sorted({i for i, _ in dissimilar})


def test_R17_partners_are_uniform_among_those_allowed():
    drawn = Counter(pair for draw in all_pairs(20, draws=2000) for pair in draw)
    for i, partners in ((10, [8, 9, 10, 11, 12]), (0, [0, 1, 2])):
        counts = [drawn[i, j, 1] for j in partners]
        assert sum(counts) == 2000 and max(counts) - min(counts) < 200
    counts = [drawn[10, j, 0] for j in (0, 1, 2, 3, 17, 18, 19)]
    assert sum(counts) == 2000 and max(counts) - min(counts) < 120


def test_S4_1_07_y_is_1_for_close_states_and_R_learns_it():
    model = SimilarityModel(replace(MAZE, learning_rate=3e-3), (32, 32))
    x = pictures(30)
    pairs = [(x[k], x[k], 1) for k in range(30)] + [(x[k], x[(k + 7) % 30], 0) for k in range(30)]
    for seed in range(15):
        model.fit(pairs, np.random.default_rng(seed))
    e = model.embed(x)
    assert model.score(e, e).mean() > 0.8 and model.score(e, e.roll(7, 0)).mean() < 0.2
    assert min(model.rates(pairs, np.random.default_rng(0))) > 0.8
    told = model.rates([(x[0], x[0], 0), (x[1], x[2], 1)], np.random.default_rng(0))
    assert told == (0.0, 0.0)  # both wrong: each rate is of its own class
    told = model.rates([(x[0], x[0], 0), (x[1], x[1], 1)], np.random.default_rng(0))
    assert told == (1.0, 0.0)


def test_rates_are_shares_of_each_class_at_a_threshold_of_a_half_of_at_most_1000_pairs():
    model = SimilarityModel(MAZE, (32, 32))
    seen = []
    model.embed = lambda frames: seen.append(len(frames)) or torch.tensor(numbers_of(frames))
    model.score = lambda e_1, e_2: np.where(e_1 == 0, 0.4, 0.6)
    # Of each class one pair at 0.6 and three at 0.4.
    pairs = [(frame(k), frame(k), y) for k in (1, 0, 0, 0) for y in (1, 0)]
    assert model.rates(pairs, np.random.default_rng(0)) == (0.25, 0.75)
    model.rates(pairs * 200, np.random.default_rng(0))
    assert seen == [8, 8, 1000, 1000]


def test_the_rates_are_of_pairs_that_R_has_not_yet_seen():
    a = restarted(Maze)
    calls = []
    a.similarity = Stub(tens)
    a.similarity.rates = lambda pairs, rng: calls.append("rates") or (0.25, 0.75)
    a.similarity.fit = lambda pairs, rng: calls.append("fit") or 3.0
    assert a.train_similarity([], None) == {"r_tpr": 0.25, "r_tnr": 0.75, "r_loss": 3.0}
    assert calls == ["rates", "fit"]


def test_S4_1_08_the_loss_is_binary_cross_entropy():
    model = SimilarityModel(MAZE, (32, 32)).train()
    x = pictures(16)
    y = np.arange(8) % 2
    with torch.no_grad():
        R = torch.sigmoid(model(x[:8], x[8:])).numpy().astype(float)
    expected = np.mean(-y * np.log(R) - (1 - y) * np.log(1 - R))
    assert model.update(x[:8], x[8:], y) == pytest.approx(expected, rel=1e-4)


def test_S4_1_08_R_trains_in_training_mode_with_a_clipped_gradient():
    model = SimilarityModel(MAZE, (32, 32))
    x = pictures(16)
    modes = []
    update = model.update
    model.update = lambda *batch: modes.append(model.training) or update(*batch)
    model.fit([(x[k], x[-k], k % 2) for k in range(16)], np.random.default_rng(0))
    assert modes == [True] * 4  # R19
    model = SimilarityModel(MAZE, (32, 32)).train()
    with torch.no_grad():
        model.head[-1].weight *= 1000
    model.update(x[:8], x[8:], np.arange(8) % 2)
    gradients = [w.grad for w in model.parameters() if w.grad is not None]
    norm = math.sqrt(sum(gradient.square().sum().item() for gradient in gradients))
    assert norm == pytest.approx(1, rel=1e-3)  # R18


@pytest.mark.parametrize("start", [0, 1])
@pytest.mark.parametrize("pretraining", [True, False])
def test_S4_1_09_prefix_pairs_of_exploration_unless_it_began_at_the_initial_cluster(
    start, pretraining
):
    a = explorer(Maze)
    a.pretraining = pretraining
    a.graph, _ = grown([(0, list(range(40)))], lambda s, s_i: s_i < 39)  # cluster 1 is state 39
    t = tau(range(1000, 1012), start, prefix=numbers_of(a.graph.full_prefix(start)))
    a.novelty.reward = lambda frames: np.zeros(len(frames))
    pairs, additional = a.make_pairs([t], np.random.default_rng(0))
    with_prefix = [(i, j, y) for i, j, y in numbered(pairs) if j < 1000]
    assert additional == [] and len(with_prefix) == (12 if start else 0)
    assert all(y == 0 for _, _, y in with_prefix)


@pytest.mark.parametrize("start", [0, 1])
def test_S4_1_09_R29_the_prefix_of_an_additional_trajectory_goes_on_to_its_novel_state(start):
    a = restarted(Maze, beta=2.5, L=5)
    t = tau(range(1000, 1012), start, prefix=[0, 1, 2, 1000] if start else [])
    a.novelty.reward = lambda frames: np.where([number(f) == 1007 for f in frames], 3.0, 0.0)
    a.collect = lambda states, steps, covers, rng: [tau([number(s.frame)], 9) for s in states]
    (walked,) = a.walk_on_from_novel_states([t], np.random.default_rng(0))
    before = [0, 1, 2] if start else []
    assert numbers_of(walked.full_prefix) == [*before, *range(1000, 1008)]
    assert walked.start == start


def test_S4_1_09_R29_additional_trajectories_have_pairs_with_their_prefix():
    a = restarted(Maze, beta=2.5, L=5)
    a.novelty.reward = lambda frames: np.where([number(f) == 1020 for f in frames], 3.0, 0.0)
    a.collect = lambda states, *rest: [tau([1020, *range(2000, 2009)]) for _ in states]
    pairs, _ = a.make_pairs([tau(range(1000, 1030))], np.random.default_rng(0))
    found = [(i, y) for i, j, y in numbered(pairs) if i >= 2000 and j < 1020]
    assert found == [(i, 0) for i in range(2000, 2009)]


def test_S4_1_03_S4_1_04_S4_1_09_make_pairs_keeps_to_n_and_N_of_the_configuration():
    a = restarted(Maze, n=4, N=12)
    a.novelty.reward = lambda frames: np.zeros(len(frames))
    t = tau(range(1000, 1030), prefix=range(971, 1001))  # the joined path is 971 ... 1029
    pairs = []
    for seed in range(40):
        pairs += numbered(a.make_pairs([t], np.random.default_rng(seed))[0])
    assert {abs(i - j) for i, j, y in pairs if y == 1} == {0, 1, 2, 3}
    assert min(abs(i - j) for i, j, y in pairs if y == 0 and j >= 1000) == 13
    assert min(i - j for i, j, y in pairs if j < 1000) == 13


@pytest.mark.parametrize("P", [1, 4, 7, 8, 20])
def test_S4_2_22_S4_2_23_any_state_of_the_prefix_more_than_N_away_along_the_joined_path(P):
    rng = np.random.default_rng(P)
    frames = tau(range(1000, 1012)).frames
    prefix = [frame(k) for k in range(P)]
    drawn = Counter()
    for _ in range(800):
        pairs = numbered(rbexplore.pairs_with_prefix(frames, prefix, 6, rng))
        assert [i for i, _, _ in pairs] == [1000 + i for i in range(12) if P - 1 + i > 6]
        drawn.update(pairs)
    # Of the joined path 0 ... P-1 ... state i of the trajectory is number P - 1 + i.
    allowed = {(1000 + i, j, 0) for i in range(12) for j in range(P) if (P - 1 + i) - j > 6}
    assert set(drawn) == allowed
    last = [drawn[1011, j, 0] for j in range(P) if (P + 10) - j > 6]
    assert max(last) - min(last) < 0.5 * 800 / len(last) + 40


def test_R17_classes_are_balanced_and_neither_order_nor_position_tells_the_class():
    x = [frame(k) for k in range(100)]
    pairs = [(x[0], x[1], 1)] * 30 + [(x[2], x[3], 0)] * 12
    rng = np.random.default_rng(0)
    drawn = [rbexplore.balanced(pairs, rng) for _ in range(200)]
    assert all(sum(y for _, _, y in draw) == 12 and len(draw) == 24 for draw in drawn)
    orders = Counter(numbered([pair])[0] for draw in drawn for pair in draw)
    assert set(orders) == {(0, 1, 1), (1, 0, 1), (2, 3, 0), (3, 2, 0)}
    assert all(abs(count - 1200) < 150 for count in orders.values())
    firsts = sum(draw[0][2] for draw in drawn)
    assert 60 < firsts < 140


def test_R17_each_pair_of_the_larger_class_can_be_drawn():
    pairs = [(frame(k), frame(k), 1) for k in range(30)] + [(frame(99), frame(99), 0)] * 3
    rng = np.random.default_rng(0)
    seen = {number(s) for _ in range(150) for s, _, y in rbexplore.balanced(pairs, rng) if y == 1}
    assert seen == set(range(30))


def test_R19_R_trains_epochs_passes_each_over_all_and_returns_the_last_loss():
    model = SimilarityModel(replace(MAZE, epochs=3, r_batch=8), (32, 32))
    batches = []
    model.update = lambda s_1, s_2, y: batches.append((s_1, s_2, y)) or float(len(batches))
    pairs = [(frame(k), frame(k), k % 2) for k in range(20)]
    loss = model.fit(pairs, np.random.default_rng(0))
    assert [len(y) for _, _, y in batches] == [7, 7, 6] * 3 and loss == 8.0
    for k in range(0, 9, 3):
        s = np.concatenate([s_1 for s_1, _, _ in batches[k : k + 3]])
        y = np.concatenate([y for _, _, y in batches[k : k + 3]])
        assert sorted(numbers_of(s)) == list(range(20))
        assert all(number(a) % 2 == b for a, b in zip(s, y, strict=True))
    assert model.fit(pairs[::2], np.random.default_rng(0)) is None and len(batches) == 9
    model.fit(pairs[:1] * 3 + pairs[1::2], np.random.default_rng(0))
    odd = [{number(f) for s_1, _, _ in batches[k : k + 1] for f in s_1} for k in (9, 10, 11)]
    assert odd[0] != odd[1] != odd[2]  # each pass has a draw of its own: R17


# --------------------------------------------------- 4.2: the graph of clusters, prefixes and merge


def test_S4_2_01_the_snapshot_of_a_cluster_restores_its_centre(maze_run):
    a, _ = maze_run
    for cluster in a.graph.clusters.values():
        assert np.array_equal(a.env.restore(cluster.snapshot), cluster.frame)
    graph, _ = grown([(0, [0, 7, 15, 23])])
    assert centres(graph) == {0: 0, 1: 15, 2: 23}
    assert [v.snapshot for v in graph.clusters.values()] == [b"0", b"15", b"23"]


def test_S4_2_02_pi_explore_is_uniform_over_the_actions_in_every_state():
    env = Maze()
    env.reset()
    actions = Counter()
    repeated = 0
    for seed in range(150):
        walked = rbexplore.walk(env, State(env.reset()[0], env.snapshot()), seed, 40)
        acted = b"".join(walked.actions)
        actions.update(acted)
        repeated += sum(acted[t] == acted[t - 1] for t in range(1, len(acted)))
    total = sum(actions.values())
    assert abs(repeated / total - 1 / 7) < 0.03  # R22: no sticky actions
    chi_square = sum((actions[a] - total / 7) ** 2 / (total / 7) for a in range(7))
    assert total > 3000 and chi_square < 22.5  # 6 degrees of freedom: p = 0.001
    same = [
        rbexplore.walk(env, State(env.reset()[0], env.snapshot()), 3, 40).actions for _ in range(2)
    ]
    assert same[0] == same[1]


def test_S4_2_02_actions_begin_where_the_space_says():
    class Shifted(Grid):
        action_space = Discrete(4, start=10)

        def step(self, action):
            return super().step(action - 10)

    one, other = explorer(Grid).run(), explorer(Shifted).run()
    assert one.discovered == other.discovered and verify(other)[1]


def test_S4_2_03_a_member_is_above_theta_and_not_at_it():
    for theta, clusters in ((0.49, 1), (0.5, 2), (0.51, 2)):
        graph, _ = grown([(0, [0, 1])], table({(0, 1): 0.5}), theta)
        assert len(graph.clusters) == clusters


def test_S4_2_04_the_centre_is_the_first_argument_of_R():
    graph, _ = grown([(0, [0, 1])], table({(0, 1): 1.0}))
    assert len(graph.clusters) == 1
    graph, _ = grown([(0, [0, 1])], table({(1, 0): 1.0}))
    assert len(graph.clusters) == 2


def test_S4_2_05_a_similar_cluster_far_away_is_found():
    graph, _ = grown([(0, [0, 10, 20, 30, 2])])
    assert len(graph.clusters) == 4 and visits(graph) == {0: 3, 1: 1, 2: 1, 3: 1}


def test_S4_2_06_every_state_in_order_to_the_last():
    stub = Stub(tens)
    graph = Graph(State(frame(0), b"0"))
    graph.embed_centres(stub)
    t = tau([0, 10, 11, 20, 12, 30])
    graph.add_trajectory(t, stub, 0.5)
    assert t.clusters == [0, 1, 1, 2, 1, 3]


def test_S4_2_07_S4_2_08_S4_2_10_arcs_are_directed_count_crossings_and_join_different_clusters():
    graph, _ = grown([(0, [0, 1, 10, 11, 20, 10, 20, 21, 10])])
    assert graph.arcs == {(0, 1): 1, (1, 2): 2, (2, 1): 2}


def test_S4_2_09_visits_are_the_states_assigned():
    graph, _ = grown([(0, [0, 1, 10, 11, 12]), (1, [10, 13, 2])])
    assert visits(graph) == {0: 1 + 2 + 1, 1: 3 + 2}


def test_S4_2_11_the_graph_begins_with_the_initial_state():
    a = explorer(Maze)
    (cluster,) = a.graph.clusters.values()
    assert np.array_equal(cluster.frame, Maze().reset()[0]) and cluster.visits == 1
    assert a.graph.arcs == {} and a.graph.E_parent == {}


def test_S4_2_12_clusters_are_sampled_inversely_to_their_visits():
    graph, _ = grown([(0, [0, 10, 11, 12, 13, 20, 21])])
    assert visits(graph) == {0: 2, 1: 4, 2: 2}
    ids, p = graph.sampling_distribution()
    assert ids == [0, 1, 2] and np.allclose(p, [0.4, 0.2, 0.4])
    a = restarted(Maze, M=2000)
    a.graph = graph
    a.collect = lambda starts, steps, covers, rng: [tau([number(s.frame)]) for s in starts]
    drawn = Counter(t.start for t in a.explore(np.random.default_rng(0)))
    assert abs(drawn[1] - 400) < 80 and abs(drawn[0] - 800) < 100 and drawn.total() == 2000


def test_S4_2_13_the_previous_cluster_and_its_neighbours_come_first():
    R = {(10, 21): 0.6, (0, 21): 0.9, (20, 21): 0.7}
    graph, stub = grown([(0, [0, 10, 20])], table({}))  # 0 -> 1 -> 2
    stub.R = table(R)
    stub.asked.clear()
    assert graph.find(stub.embed([frame(21)])[0], 2, stub, 0.5) == 2
    assert stub.asked == [
        (10, 21),
        (20, 21),
    ]  # itself and its predecessor: R8; the best of both: R7
    stub.asked.clear()
    assert graph.find(stub.embed([frame(21)])[0], 0, stub, 0.5) == 0
    assert stub.asked == [(0, 21), (10, 21)]  # a successor
    stub.R = table({(0, 21): 0.6, (10, 21): 0.6})
    assert (
        graph.find(stub.embed([frame(21)])[0], 2, stub, 0.5) == 1
    )  # a neighbour, though 0 is older
    stub.R = table({(0, 21): 0.8})
    assert graph.find(stub.embed([frame(21)])[0], 2, stub, 0.5) == 0
    stub.R = table({(0, 21): 0.6, (10, 21): 0.7})
    graph.adjacent[2] = set()
    assert graph.find(stub.embed([frame(21)])[0], 2, stub, 0.5) == 1  # R7: of all the most similar


def trained_rnd(**changes):
    rnd = RND(replace(MAZE, **changes), (32, 32))
    known = pictures(60)
    known[:, :, 16:] = 0
    for seed in range(12):
        rnd.fit([known], np.random.default_rng(seed))
    return rnd, known


def test_S4_2_14_the_intrinsic_reward_falls_on_states_trained_on():
    rnd, known = trained_rnd()
    new = known[:, :, ::-1].copy()
    assert rnd.reward(new).mean() > rnd.reward(known).mean() + 1
    target = weights(rnd.target)
    rnd.fit([new], np.random.default_rng(0))
    assert equal(weights(rnd.target), target)


def test_R4_the_reward_is_in_deviations_of_the_errors_of_the_latest_five_iterations():
    rnd, known = trained_rnd()
    assert len(rnd.recent_errors) == 5
    assert np.array_equal(rnd.recent_errors[-1], rnd.errors(known))  # taken after the learning
    recent = np.concatenate(rnd.recent_errors)
    x = pictures(7, seed=2)
    expected = (rnd.errors(x) - recent.mean()) / recent.std()
    assert np.allclose(rnd.reward(x), expected, rtol=1e-4)
    z = (x - rnd.pixels.mean) / np.sqrt(rnd.pixels.var)
    z = torch.from_numpy(z.clip(-5, 5)).float()[:, None]
    error = (rnd.predictor(z) - rnd.target(z)).square().sum(1) / 64
    assert np.allclose(rnd.errors(x), error.detach(), rtol=1e-3)


def test_R4_observations_are_clipped_at_5_either_way():
    rnd = RND(MAZE, (32, 32))
    rnd.pixels.update(np.stack([np.full((32, 32), k, np.uint8) for k in (120, 122)]))
    at = {k: rnd.errors(np.full((1, 32, 32), k, np.uint8)) for k in (0, 60, 118, 123, 200, 255)}
    assert at[0] == at[60] != at[118] and at[255] == at[200] != at[123]


def test_R6_before_the_first_training_nothing_is_novel():
    rnd = RND(MAZE, (32, 32))
    assert (rnd.reward(pictures(3)) == -np.inf).all()
    a = explorer(Maze, beta=-1e9)
    assert a.iterate().additional == []
    assert len(a.iterate().additional) == 3


def test_R18_RND_learns_each_state_once_in_mixed_batches():
    rnd = RND(replace(MAZE, rnd_batch=8), (32, 32))
    batches = []
    counts = []

    def update(frames):
        batches.append(numbers_of(frames))
        counts.append(rnd.pixels.count)
        return float(len(batches))

    rnd.update = update
    frames = [tau(range(20)).frames, tau(range(20, 30)).frames]
    assert rnd.fit(frames, np.random.default_rng(0)) == 2.5  # the mean of 1, 2, 3, 4
    learned = [k for batch in batches for k in batch]
    assert [len(batch) for batch in batches] == [8, 8, 7, 7]
    assert sorted(learned) == list(range(30)) and learned != list(range(30))
    assert counts == pytest.approx([30] * 4, abs=0.01)  # the statistics come first
    assert np.array_equal(rnd.recent_errors[-1], np.concatenate([rnd.errors(x) for x in frames]))


def test_R18_a_step_of_RND_is_down_its_mean_error_unclipped_by_one_adam():
    rnd = RND(MAZE, (32, 32))
    with torch.no_grad():
        rnd.predictor[-1].weight *= 100
    x = pictures(8)
    error = rnd.errors(x).mean()
    assert rnd.update(x) == pytest.approx(error, rel=1e-5)
    gradients = [weight.grad for weight in rnd.predictor.parameters()]
    assert math.sqrt(sum(gradient.square().sum().item() for gradient in gradients)) > 10
    for seed in range(3):
        rnd.fit([x], np.random.default_rng(seed))
    assert rnd.optimiser.state_dict()["state"][0]["step"] == 4


def novel_where(a, wanted):
    """Let RND find those numbers novel by 3, and take the walks from B."""
    a.novelty.reward = lambda frames: np.array([wanted.get(number(f), 0.0) for f in frames])
    walked = []
    a.collect = lambda states, steps, covers, rng: walked.append(states) or []
    return walked


def test_S4_2_15_S4_2_16_all_states_above_beta_and_none_at_it_go_to_B_with_their_snapshots():
    a = restarted(Maze, beta=2.5, L=100)
    walked = novel_where(a, {3: 2.6, 5: 2.5, 8: 9.0, 11: 2.4, 0: 3.0})
    trajectories = [tau(range(10)), tau([8, 11, 12])]
    a.walk_on_from_novel_states(trajectories, np.random.default_rng(0))
    (states,) = walked
    assert sorted(number(s.frame) for s in states) == [0, 3, 8, 8]
    assert all(s.snapshot == b"%d" % number(s.frame) for s in states)
    assert trajectories[0].novelty[3] == 2.6


def test_S4_2_16_snapshots_of_B_restore_the_novel_states():
    a = restarted(Maze, beta=0.0, L=50)
    a.iterate()
    i = a.iterate()
    assert len(i.additional) > 10
    for t in i.additional:
        assert np.array_equal(t.frames[0], t.full_prefix[-1])


def test_S4_2_17_a_random_sample_of_B_of_at_most_L():
    a = restarted(Maze, L=5)
    walked = novel_where(a, {k: 10.0 + k for k in range(20)})
    for seed in range(300):
        a.walk_on_from_novel_states([tau(range(20))], np.random.default_rng(seed))
    drawn = Counter(number(s.frame) for states in walked for s in states)
    assert all(len({number(s.frame) for s in states}) == 5 for states in walked)
    assert len(drawn) == 20 and max(drawn.values()) - min(drawn.values()) < 70  # not the top ones
    a.walk_on_from_novel_states([tau([7, 8, 9])], np.random.default_rng(0))
    assert sorted(number(s.frame) for s in walked[-1]) == [7, 8, 9]


def test_S4_2_18_additional_trajectories_serve_R_alone():
    found = []
    for L in (0, 20):
        a = restarted(Maze, L=L, beta=0.5, steps=2500)
        a.similarity = Stub(lambda s, s_i: s == s_i)
        a.similarity.embed = lambda frames: torch.tensor([[float(f.sum())] for f in frames])
        for _ in range(3):
            i = a.iterate()
        found.append((a, i))
    (a, without), (b, with_L) = found
    assert without.additional == [] and len(with_L.additional) == 20
    assert set(a.discovered) == set(b.discovered) and b.steps > a.steps
    assert visits(a.graph) == visits(b.graph) and a.graph.arcs == b.graph.arcs
    assert equal(weights(a.novelty), weights(b.novelty))
    assert np.array_equal(a.novelty.recent_errors[-1], b.novelty.recent_errors[-1])
    assert np.array_equal(without.trajectories[0].novelty, with_L.trajectories[0].novelty)


def test_R3_R5_additional_trajectories_are_short_and_of_this_iterations_states():
    a = restarted(Maze, beta=0.0, L=30, steps=2500)
    for _ in range(3):
        i = a.iterate()
        states = {s for t in i.trajectories for s in t.snapshots}
        assert all(len(t.units) <= 20 for t in i.additional)
        assert all(t.snapshots[0] in states for t in i.additional)
    assert max(len(t.units) for t in i.additional) == 20
    walks = [b"".join(t.actions)[:10] for t in i.trajectories + i.additional]
    long = [walked for walked in walks if len(walked) == 10]
    assert len(set(long)) == len(long) > 20  # each walk has a seed of its own
    a = restarted(Maze, beta=0.0, L=5, additional_steps=13)
    a.iterate()
    assert max(len(t.units) for t in a.iterate().additional) == 13


def test_S4_2_19_every_cluster_leads_to_the_first_by_its_parents(maze_run):
    graph, _ = grown([(0, [0, 10, 20, 3, 30]), (1, [10, 40])])
    assert {v: arc.parent for v, arc in graph.E_parent.items()} == {1: 0, 2: 1, 3: 2, 4: 1}  # R13
    a, _ = maze_run
    for v in a.graph.clusters:
        steps = 0
        while v != 0:
            v = a.graph.E_parent[v].parent
            steps += 1
        assert steps < len(a.graph.E_parent) + 1


def test_S4_2_20_the_prefix_from_the_parents_centre_to_v_is_stored():
    graph, _ = grown([(0, [0, 1, 2, 10, 11, 3, 20]), (1, [10, 12, 4, 30, 31])])
    assert numbers_of(graph.E_parent[1].prefix) == [0, 1, 2, 10]
    assert numbers_of(graph.E_parent[2].prefix) == [10, 11, 3, 20]
    assert numbers_of(graph.E_parent[3].prefix) == [10, 12, 4, 30]
    assert graph.E_parent[2].actions == bytes([11, 3, 20])
    assert graph.E_parent[2].prefix.base is None  # or a whole trajectory would be kept


def test_S4_2_21_the_full_prefix_is_what_was_walked_from_s_init_in_the_order_of_time():
    graph, stub = grown([(0, [0, 1, 2, 10, 11, 3, 20]), (1, [10, 12, 4, 30, 31])])
    full = {0: [], 1: [0, 1, 2, 10], 2: [0, 1, 2, 10, 11, 3, 20], 3: [0, 1, 2, 10, 12, 4, 30]}
    assert {v: numbers_of(graph.full_prefix(v)) for v in full} == full
    assert graph.actions_to(3) == bytes([1, 2, 10, 12, 4, 30]) and graph.actions_to(0) == b""
    stub.R = table({(0, 10): 1.0})
    assert graph.merge(stub, 0.5) == {1: 0}  # the parent of 2 and 3: their prefixes stay (R15)
    assert {v: numbers_of(graph.full_prefix(v)) for v in (2, 3)} == {2: full[2], 3: full[3]}


def merged_chain(R, theta=0.5):
    """Five clusters 0 -> 1 -> 2 -> 3 -> 4, merged."""
    graph, stub = grown([(0, [0, 1, 2, 3, 4])], table({}), theta=1)
    stub.R = table(R)
    return graph, graph.merge(stub, theta)


def test_S4_2_24_merge_tests_all_pairs():
    assert merged_chain({(1, 3): 0.9})[1] == {3: 1}
    assert merged_chain({(1, 4): 0.6, (2, 4): 0.9})[1] == {4: 2}  # the most similar: R14
    assert merged_chain({(0, 1): 0.9, (1, 2): 0.9})[1] == {1: 0}  # no closure: R14
    assert merged_chain({(3, 1): 0.9})[1] == {}  # R(earlier, later)
    assert merged_chain({(a, b): 1.0 for b in range(5) for a in range(b)})[1] == {
        1: 0,
        2: 0,
        3: 0,
        4: 0,
    }


@pytest.mark.parametrize("pretraining", [True, False])
def test_S4_2_25_R28_merge_above_theta_merge_which_is_its_own_in_pretraining_too(pretraining):
    for theta_merge, merged in ((0.6, {1: 0}), (0.7, {}), (0.75, {})):
        a = explorer(Maze, theta_merge=theta_merge, theta_sim=0.1)
        a.pretraining = pretraining
        a.steps = 200
        a.graph = Graph(State(frame(0), b"0"))
        a.similarity = Stub(table({(0, 1): 0.7}))
        a.iteration = a.config.merge_every - 1
        assert a.update_graph([tau([0, 1])], theta_sim=0.8) == {}
        assert len(a.graph.clusters) == 2
        a.iteration = a.config.merge_every
        assert a.update_graph([], theta_sim=0.1) == merged
        assert len(a.graph.clusters) == 2 - len(merged)


def test_S4_2_26_S4_2_27_S4_2_28_the_earlier_cluster_keeps_its_centre_and_gets_arcs_and_visits():
    graph, stub = grown([(0, [0, 10, 20, 21, 30, 0, 10, 30, 20, 10])])
    assert graph.arcs == {
        (0, 1): 2,
        (1, 2): 1,
        (2, 3): 1,
        (3, 0): 1,
        (1, 3): 1,
        (3, 2): 1,
        (2, 1): 1,
    }
    assert visits(graph) == {0: 3, 1: 3, 2: 3, 3: 2}
    stub.R = table({(10, 30): 0.9})
    assert graph.merge(stub, 0.5) == {3: 1}
    assert graph.arcs == {(0, 1): 2, (1, 2): 2, (2, 1): 2, (1, 0): 1}
    assert graph.adjacent == {0: {1}, 1: {0, 2}, 2: {1}}
    assert visits(graph) == {0: 3, 1: 5, 2: 3}
    assert centres(graph) == {0: 0, 1: 10, 2: 20} and graph.clusters[1].snapshot == b"10"


def test_S4_2_28_S4_2_29_the_initial_cluster_stays_and_every_other_leads_to_it():
    graph, merged = merged_chain({(0, 2): 0.9, (1, 3): 0.9})
    assert merged == {2: 0, 3: 1} and centres(graph) == {0: 0, 1: 1, 4: 4}
    assert graph.lineage(4) == [1, 2, 3, 4]  # by way of ancestors that merged: R15
    assert numbers_of(graph.full_prefix(4)) == [0, 1, 2, 3, 4]


def test_R15_lineages_without_a_living_descendant_are_dropped():
    graph, _ = merged_chain({(0, 4): 0.9, (1, 3): 0.9})
    assert set(graph.clusters) == {0, 1, 2} and set(graph.E_parent) == {1, 2}


def test_R15_a_graph_that_merged_goes_on_from_its_state():
    graph, _ = merged_chain({(0, 2): 0.9, (1, 3): 0.9})  # 0, 1 and 4 live
    other = Graph(State(frame(9), b"9"))
    other.load_state_dict(graph.state_dict())
    stub = Stub(table({}))
    for g in (graph, other):
        g.embed_centres(stub)
        g.add_trajectory(tau([4, 70, 80], start=4), stub, 0.5)
    assert centres(other) == centres(graph) == {0: 0, 1: 1, 4: 4, 5: 70, 6: 80}
    assert (other.arcs, other.adjacent) == (graph.arcs, graph.adjacent)
    assert visits(other) == visits(graph)
    assert numbers_of(other.full_prefix(6)) == [0, 1, 2, 3, 4, 70, 80]


class Slow:
    """G, the slow and obvious way: numbers for states, all relations looked up in the arcs."""

    def __init__(self, scores):
        self.scores = scores
        self.made = 1
        self.arcs = Counter()
        self.centre = {0: 0}
        self.visits = {0: 1}
        self.path = {0: [0]}

    def best(self, ids, state, theta):
        score, v = max((self.scores[self.centre[v], state], -v) for v in ids)  # of equals the older
        return -v if score > theta else None

    def add(self, start, states, theta):
        at = parent = start
        self.visits[start] += 1
        since = []
        for state in states[1:]:
            since.append(state)
            near = (
                {at} | {b for a, b in self.arcs if a == at} | {a for a, b in self.arcs if b == at}
            )
            v = self.best(near, state, theta)
            if v is None:
                v = self.best(self.centre, state, theta)
            if v is None:
                v = self.made
                self.made += 1
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
            found = self.best(survivors, self.centre[v], theta) if survivors else None
            into[v] = v if found is None else found
        arcs = Counter()
        for (a, b), count in self.arcs.items():
            if into[a] != into[b]:
                arcs[into[a], into[b]] += count
        self.arcs = arcs
        kept = [v for v in into if into[v] == v]
        self.visits = {v: sum(self.visits[u] for u in into if into[u] == v) for v in kept}
        self.centre = {v: self.centre[v] for v in kept}


@pytest.mark.parametrize(("theta", "theta_merge"), [(0.8, 0.7), (0.95, 0.85), (0.98, 0.95)])
def test_S4_2_26_assignment_and_merge_against_the_slow_version(theta, theta_merge):
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
            graph.add_trajectory(tau(states, start), stub, theta)
            if turn % 4 == 3:
                slow.merge(theta_merge)
                merged += len(graph.merge(stub, theta_merge))
            assert centres(graph) == slow.centre and visits(graph) == slow.visits
            assert graph.arcs == slow.arcs
            for v in graph.clusters:
                assert numbers_of(graph.full_prefix(v)) == (slow.path[v] if v else [])
    assert merged > 20


# ---------------------------------------- 5 and 6: coverage, configuration, pretraining, the budget


def test_S5_03_S5_04_coverage_counts_units_once_of_a_fixed_set_at_exploration_steps_alone():
    a = explorer(Maze, beta=0.5, steps=1300)
    seen = {}
    steps = 0
    shares = [0.0]
    while a.steps < 1300:
        i = a.iterate()
        for k, t in enumerate(i.trajectories + i.additional):
            counts = i.metrics["phase"] == "explore" and k < len(i.trajectories)
            for unit in t.units:
                steps += 1
                if counts and unit is not None:
                    seen.setdefault(unit, steps)
        shares.append(i.metrics["coverage"])
        assert i.metrics["coverage"] == i.metrics["units"] / 187
    seen[a.initial_unit] = 400
    assert a.discovered == seen and a.initial_unit == (6, 1, 2)
    assert shares == sorted(shares) and 0 < shares[-1] <= 1


def test_S5_03_coverage_is_at_most_1_where_the_full_set_is_an_estimate():
    a = restarted()
    a.env.full_coverage = 3
    a.iterate()
    assert len(a.discovered) > 3 and rbexplore.progress_metrics(a)["coverage"] == 1.0
    assert rbexplore.coverage_curve(a.discovered, np.array([0, 99999]), 3)[-1] == 100


def test_S6_1_02_the_network_sees_pixels_in_0_to_1():
    for shape in ((2, 8, 6), (2, 8, 6, 3)):
        frames = np.random.default_rng(0).integers(256, size=shape).astype(np.uint8)
        frames.flat[:2] = (0, 255)
        x = rbexplore.to_input(frames, "cpu")
        channels = frames[:, None] if frames.ndim == 3 else np.moveaxis(frames, 3, 1)
        assert x.shape == channels.shape and x.min() == 0 and x.max() == 1
        assert np.allclose(x, channels / 255)


def test_S6_1_03_one_resnet18_embeds_a_frame_in_512():
    model = SimilarityModel(Config(), (96, 96))
    weighted = [m for m in model.encoder.modules() if isinstance(m, (nn.Conv2d, nn.Linear))]
    shortcuts = [m for m in weighted if getattr(m, "kernel_size", 0) == (1, 1)]
    assert len(weighted) - len(shortcuts) == 18 and len(shortcuts) == 3
    assert sum(w.numel() for w in model.encoder.parameters()) == 11_432_896
    assert model.embed(pictures(2, size=96)).shape == (2, 512)
    pool = model.encoder.layers[3]
    assert isinstance(pool, nn.MaxPool2d)
    assert (pool.kernel_size, pool.stride, pool.padding) == (3, 2, 1)
    x = rbexplore.to_input(pictures(2, size=96), "cpu")
    with torch.no_grad():
        mean = model.encoder.layers(x).mean((2, 3))
        assert torch.allclose(model.encoder(x), model.encoder.linear(mean), atol=1e-5)
    sizes = []
    for layer in model.encoder.layers:
        x = layer(x)
        sizes.append(tuple(x.shape[1:]))
    stem = [(64, 48, 48)] * 3 + [(64, 24, 24)]
    assert (
        sizes
        == stem + [(64, 24, 24)] * 2 + [(128, 12, 12)] * 2 + [(256, 6, 6)] * 2 + [(512, 3, 3)] * 2
    )


def test_S6_1_03_a_residual_block_adds_its_input():
    block = rbexplore.BasicBlock(8, 8).eval()
    x = torch.randn(2, 8, 5, 5, generator=torch.Generator().manual_seed(0))
    nn.init.zeros_(block.residual[-1].weight)
    with torch.no_grad():
        assert torch.equal(block(x), x.relu())
    kinds = [type(layer).__name__ for layer in block.residual]
    assert kinds == ["Conv2d", "BatchNorm2d", "ReLU", "Conv2d", "BatchNorm2d"]


def test_S6_1_04_R20_concatenated_into_four_fully_connected_layers():
    head = SimilarityModel(Config(), (96, 96)).head
    kinds = [type(layer).__name__ for layer in head]
    assert kinds == ["BatchNorm1d", "ReLU", "Linear"] * 4
    linear = [(m.in_features, m.out_features) for m in head if isinstance(m, nn.Linear)]
    assert linear == [(1024, 512), (512, 512), (512, 512), (512, 1)]
    small = SimilarityModel(replace(MAZE, head_width=48), (32, 32))
    linear = [(m.in_features, m.out_features) for m in small.head if isinstance(m, nn.Linear)]
    assert linear == [(128, 48), (48, 48), (48, 48), (48, 1)]
    e_1, e_2 = torch.randn(2, 5, 64, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = small.head(torch.cat([e_1, e_2], dim=1))[:, 0]
        assert torch.equal(small.logits(e_1, e_2), expected)


def test_S6_1_05_S6_1_08_S6_1_09_S6_1_12_the_papers_values_are_the_defaults():
    papers = {
        "seed": 0,
        "steps": 15_000_000,
        "pretrain_steps": 500_000,
        "M": 30,
        "trajectory_steps": 1500,
        "L": 1000,
        "additional_steps": 50,
        "beta": 2.5,
        "n": 5,
        "N": 25,
        "prefix": True,
        "epochs": 4,
        "theta_sim": 0.5,
        "theta_merge": 0.5,
        "merge": True,
        "merge_every": 15,
        "frame_size": 96,
        "small_networks": False,
        "embedding": 512,
        "head_width": 512,
        "learning_rate": 1e-4,
        "r_batch": 256,
        "rnd_batch": 256,
        "rollout_steps": 128 * 128,
        "episode_steps": 4500,
    }
    assert asdict(Config()) == papers
    for level in ("1", "2", "3"):
        args = rbexplore.parser().parse_args(["--env", "pop", "--level", level])
        assert rbexplore.settings_of(args)["config"] == asdict(Config())


def test_R30_the_maze_differs_in_sizes_alone():
    assert (MAZE.n, MAZE.N, MAZE.additional_steps) == (2, 10, 20)
    for name in ("beta", "theta_sim", "theta_merge", "merge_every", "epochs", "prefix", "merge"):
        assert getattr(MAZE, name) == getattr(Config(), name)


def test_S6_1_06_trajectories_are_at_most_so_many_steps_long(maze_run):
    lengths = {len(t.units) for i in maze_run[1] for t in i.trajectories}
    assert max(lengths) == TINY.trajectory_steps and min(lengths) < TINY.trajectory_steps


def walks_on_the_grid(place, count, steps):
    """Walks of so many steps from a place of the grid."""
    env = Grid()
    env.reset()
    env.place = place
    start = State(env.picture(), env.snapshot())
    return [rbexplore.walk(env, start, seed, steps) for seed in range(count)]


def test_S6_1_07_a_death_ends_the_trajectory_and_is_no_state():
    ends = Counter()
    for walked in walks_on_the_grid((6, 4), count=200, steps=12):
        dead = walked.units[-1] is None
        assert None not in walked.units[:-1]
        assert len(walked.frames) == len(walked.snapshots) == len(walked.actions)
        assert all(bytes(s) != bytes((6, 6)) for s in walked.snapshots)
        assert walked.ended == (dead or walked.units[-1] == (0, 6))
        assert walked.ended or len(walked.units) == 12
        ends[dead] += 1
    assert ends[True] > 20 and ends[False] > 20


def test_R10_the_state_at_which_an_episode_is_cut_off_is_a_state():
    walked = walks_on_the_grid((0, 4), count=60, steps=12)
    cut = [w for w in walked if w.units[-1] == (0, 6)]
    assert cut and all(w.snapshots[-1] == bytes((0, 6)) and w.ended for w in cut)


def test_R24_blank_frames_are_counted_and_replayed_but_are_no_states():
    walked = walks_on_the_grid((4, 3), count=40, steps=20)
    assert all(picture.any() for w in walked for picture in w.frames)
    assert any(len(actions) > 1 for w in walked for actions in w.actions)
    assert any(len(w.units) > len(w.frames) for w in walked)
    assert all(len(w.units) >= sum(map(len, w.actions)) for w in walked)


@pytest.mark.parametrize(("changes", "merges"), [({}, [15, 30]), ({"merge": False}, [])])
def test_S6_1_10_S6_3_01_R28_merge_runs_at_iterations_15_and_30_or_never(changes, merges):
    sizes = {"M": 1, "trajectory_steps": 20, "epochs": 1, "pretrain_steps": 200}
    a = explorer(Maze, merge_every=15, steps=100_000, **sizes, **changes)
    ran = []
    Graph_merge = Graph.merge
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Graph, "merge", lambda *x: ran.append(a.iteration) or Graph_merge(*x))
        while a.iteration < 31:
            a.iterate()
    assert ran == merges


def test_S6_1_11_M_trajectories_also_from_a_single_cluster():
    a = restarted(Maze, M=7)
    trajectories = a.iterate().trajectories
    assert len(trajectories) == 7 and {t.start for t in trajectories} == {0}
    assert len({b"".join(t.actions) for t in trajectories}) == 7


def test_S6_1_13_theta_sim_rises_from_0_linearly_in_pretraining(maze_run):
    rows = [i.metrics for i in maze_run[1]]
    before = [0] + [row["steps"] for row in rows]
    for row, steps in zip(rows, before, strict=False):
        expected = 0.5 * steps / 400 if row["phase"] == "pretrain" else 0.5
        assert row["theta_sim"] == pytest.approx(expected)
    assert [row["phase"] for row in rows].count("pretrain") >= 3
    assert [row["steps"] for row in rows if row["phase"] == "pretrain"][-1] == 400


def test_S6_1_13_states_join_by_the_threshold_that_rises(monkeypatch):
    used = []
    add = Graph.add_trajectory
    monkeypatch.setattr(Graph, "add_trajectory", lambda *x: used.append(x[3]) or add(*x))
    a = explorer(Maze)
    told = [a.iterate().metrics["theta_sim"] for _ in range(4)]
    assert list(dict.fromkeys(used)) == told and told[0] == 0 < told[1] < told[2] < told[3]


def test_S6_1_14_S6_1_15_R6_R_and_RND_train_in_pretraining_and_are_kept_when_G_is_reset():
    a = explorer(Maze, merge=False, theta_sim=0.95)
    first = [[w.detach().clone() for w in x.parameters()] for x in (a.similarity, a.novelty)]
    while a.steps < 400:
        a.iterate()
    for part, weights_before in zip((a.similarity, a.novelty), first, strict=True):
        assert not equal(list(part.parameters()), weights_before)
    assert len(a.graph.clusters) > 1 and a.discovered == {} and a.pretraining
    assert a.novelty.pixels.count > 300 and a.novelty.pixels.mean.std() > 0
    assert a.novelty.recent_errors
    before = plain([a.similarity.state_dict(), a.novelty.state_dict()])  # with their optimisers
    a.restart()
    assert plain([a.similarity.state_dict(), a.novelty.state_dict()]) == before
    assert list(a.graph.clusters) == [0] and a.graph.arcs == {} and a.discovered == {(6, 1, 2): 400}
    assert a.theta_sim_now() == 0.95 and a.iterate().metrics["phase"] == "explore"


@pytest.mark.parametrize("pool", [None, ThreadPoolExecutor])
def test_S6_2_04_the_counter_stops_at_the_budget_exactly(pool):
    executor = pool(2) if pool else None
    a = RbExplore(CountingMaze, replace(TINY, steps=834, pretrain_steps=333), executor=executor)
    a.env.steps_made = 0
    steps = []
    while a.steps < 834:
        steps.append(a.iterate().metrics["steps"])
    assert a.steps == 834 and 333 in steps
    assert pool or a.env.steps_made == 834
    with pytest.raises(InputError, match="budget"):
        a.iterate()


def test_S6_3_02_without_prefixes_the_rest_of_the_pairs_is_the_same():
    made = []
    for prefix in (True, False):
        a = restarted(Maze, prefix=prefix)
        a.graph, _ = grown([(0, list(range(40)))], lambda s, s_i: s_i < 39)
        a.novelty.reward = lambda frames: np.zeros(len(frames))
        t = tau(range(1000, 1030), 1, prefix=range(40))
        made.append(numbered(a.make_pairs([t], np.random.default_rng(0))[0]))
    assert made[0][: len(made[1])] == made[1]
    rest = made[0][len(made[1]) :]
    assert len(rest) == 30 and all(j < 40 and y == 0 for _, j, y in rest)


def test_a_seed_makes_the_run_and_global_generators_are_left_alone():
    torch.manual_seed(1)
    np.random.seed(1)  # noqa: NPY002
    before = (torch.random.get_rng_state(), np.random.get_state()[1].copy())
    runs = [explorer(Maze, seed=seed, steps=600).run() for seed in (1, 1, 2)]
    states = [weights(a.similarity) + weights(a.novelty) for a in runs]
    assert equal(states[0], states[1]) and runs[0].discovered == runs[1].discovered
    assert not equal(states[0], states[2])
    assert torch.equal(torch.random.get_rng_state(), before[0])
    assert np.array_equal(np.random.get_state()[1], before[1])


def test_each_seed_and_each_iteration_draws_anew():
    a = restarted(Maze, seed=1)
    b = restarted(Maze, seed=2)
    walks = []
    for explorer_of_a_seed in (a, a, b):
        trajectories = explorer_of_a_seed.iterate().trajectories
        walks.append(b"".join(b"".join(t.actions) for t in trajectories))
    assert len(set(walks)) == 3


def test_frames_are_embedded_in_parts_without_a_gap():
    frames = np.arange(1300)
    parts = rbexplore.in_parts(frames)
    assert np.array_equal(np.concatenate(parts), frames) and max(map(len, parts)) <= 512


def test_no_two_networks_begin_alike_be_it_of_one_seed_or_of_neighbours():
    first_layers = set()
    for seed in (0, 1):
        config = replace(MAZE, seed=seed)
        rnd = RND(config, (32, 32))
        encoders = [SimilarityModel(config, (32, 32)).encoder, rnd.target, rnd.predictor[0]]
        encoders.append(ICM(config, (32, 32), 7, "cpu").encoder)
        encoders.append(PPO(Maze, config, "rnd", "cpu").network[0])
        first_layers |= {tuple(encoder[0].weight.flatten().tolist()) for encoder in encoders}
        assert not any(isinstance(m, nn.BatchNorm2d) for e in encoders[1:] for m in e.modules())
    assert len(first_layers) == 10


def test_R18_adams_rate_is_that_of_the_configuration():
    config = replace(AGENT, learning_rate=3e-4)
    ppo = PPO(Corridor, config, "icm", "cpu")
    for part in (SimilarityModel(config, (32, 32)), RND(config, (32, 32)), ppo, ppo.curiosity):
        (group,) = part.optimiser.param_groups
        assert type(part.optimiser) is torch.optim.Adam
        assert (group["lr"], group["weight_decay"]) == (3e-4, 0)


def test_networks_begin_with_hes_weights_of_their_own():
    r, rnd = SimilarityModel(MAZE, (32, 32)), RND(MAZE, (32, 32))
    for module in (r, rnd):
        for layer in module.modules():
            if isinstance(layer, (nn.Conv2d, nn.Linear)) and layer.weight.numel() > 4000:
                he = math.sqrt(2 / layer.weight[0].numel())
                assert layer.weight.std().item() == pytest.approx(he, rel=0.1)
                assert layer.bias is None or not layer.bias.any()
    assert not equal(weights(rnd.target), weights(rnd.predictor[0]))
    assert not any(w.requires_grad for w in rnd.target.parameters())
    kinds = [type(layer).__name__ for layer in rnd.target]
    assert kinds == ["Conv2d", "ReLU"] * 3 + ["Flatten", "Linear"]
    assert [type(x).__name__ for x in rnd.predictor[1:]] == ["ReLU", "Linear"] * 2
    kinds = [type(layer).__name__ for layer in r.encoder]
    assert kinds == ["Conv2d", "BatchNorm2d", "ReLU"] * 3 + ["Flatten", "Linear"]
    convs = [m for m in RND(Config(), (96, 96)).target if isinstance(m, nn.Conv2d)]
    sizes = [(m.out_channels, m.kernel_size[0], m.stride[0], m.padding[0]) for m in convs]
    assert sizes == [(32, 8, 4, 0), (64, 4, 2, 0), (64, 3, 1, 0)]


def test_an_executor_changes_nothing_and_may_be_shared():
    with ThreadPoolExecutor(3) as executor:
        a = RbExplore(Grid, TINY, executor=executor).run()
        b = RbExplore(Maze, replace(TINY, steps=500), executor=executor).run()
    alone = explorer().run()
    assert equal(weights(a.similarity), weights(alone.similarity))
    assert a.graph.arcs == alone.graph.arcs and a.discovered == alone.discovered
    assert b.steps == 500


def test_a_worker_closes_the_environment_of_its_former_owner():
    closed = []

    class Closing(Grid):
        def close(self):
            closed.append(self)

    with ThreadPoolExecutor(1) as executor:
        RbExplore(Closing, TINY, executor=executor).iterate()
        assert closed == []
        RbExplore(Grid, TINY, executor=executor).iterate()
    assert len(closed) == 1


@pytest.mark.parametrize("channels", [(), (3,)])
def test_an_environment_of_the_users_own_in_grey_or_colour(channels):
    class Own(Grid):
        observation_space = Box(0, 255, (16, 16, *channels), np.uint8)

    a = RbExplore(Own, TINY).run()
    assert len(a.discovered) > 10 and verify(a)[1]


def test_frames_that_an_environment_uses_again_are_copied():
    class Reusing(Grid):
        shared = np.zeros((16, 16), np.uint8)

        def picture(self):
            self.shared[:] = super().picture()
            return self.shared

    assert explorer(Reusing).run().discovered == explorer(Grid).run().discovered


def test_a_time_limit_beyond_the_contracts_walk_stops_the_run_and_says_why():
    class Limited(Grid):
        taken = 0

        def step(self, action):
            self.taken += 1
            frame, reward, dead, cut, info = super().step(action)
            return frame, reward, dead, cut or self.taken > 1500, info

        def reset(self, *, seed=None, options=None):
            return super().reset()

    with pytest.raises(InputError, match="first step.*time limit"):
        RbExplore(Limited, replace(TINY, M=10, steps=20_000)).run()


def test_a_few_trajectories_may_all_end_at_once():
    at_once = tau([0, 1])
    at_once.ended = True
    rbexplore.check_lengths([at_once] * 9)
    longer = tau([0, 1, 2])
    rbexplore.check_lengths([at_once] * 9 + [longer])
    with pytest.raises(InputError, match="10 of 10 trajectories ended at their first step"):
        rbexplore.check_lengths([at_once] * 10)


def test_a_state_dict_does_not_change_with_its_algorithm():
    a = restarted(Maze)
    a.iterate()
    state = a.state_dict()
    before = plain([state["discovered"], state["graph"]])
    b = restarted(Maze)
    b.load_state_dict(state)
    for x in (a, b):
        x.iterate()
    assert plain([state["discovered"], state["graph"]]) == before


@pytest.mark.parametrize(("changes", "said"), [
    ({"n": 30}, "n is 30 and N is 10"),
    ({"additional_steps": 10}, "additional_steps is 10.*at least 11"),
    ({"trajectory_steps": 10}, "trajectory_steps is 10.*at least 11"),
    ({"pretrain_steps": 100_000}, "pretrain_steps is 100000"),
    ({"M": 0}, "M is 0: give a number from 1"),
    ({"theta_sim": 1.5}, "theta_sim is 1.5"),
    ({"beta": "2"}, "beta is '2': it must be of type float"),
    ({"M": True}, "M is True: it must be of type int"),
    ({"learning_rate": float("nan")}, "learning_rate is nan"),
])  # fmt: skip
def test_a_configuration_that_cannot_work_is_refused(changes, said):
    replace(MAZE, n=10)  # n may be N
    with pytest.raises(InputError, match=said):
        replace(MAZE, **changes)


@pytest.mark.parametrize("name", ["R", "RND"])
def test_a_loss_that_is_not_finite_is_one_clear_line(name):
    weight = nn.Parameter(torch.ones(1))
    with pytest.raises(InputError, match=f"the loss of {name} is nan.*learning rate"):
        rbexplore.gradient_step(torch.optim.Adam([weight]), (weight * math.nan).sum(), name)


# ------------------------------------------------------------------------ 6.2: the methods compared


class Corridor(gymnasium.Env):
    """17 places in a row; the left end is the start, and the far end ends the episode."""

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


AGENT = replace(TINY, pretrain_steps=0, L=0, steps=3000, rollout_steps=200, episode_steps=50)


@pytest.mark.parametrize("method", METHODS)
def test_S6_2_03_S6_2_04_every_method_stops_at_the_budget_and_covers_by_the_same_count(method):
    a = make_method(method, CountingMaze, replace(AGENT, steps=700))
    a.env.steps_made = 0
    while a.steps < 700:
        metrics = a.iterate().metrics
    assert a.env.steps_made == a.steps == metrics["steps"] == 700
    assert a.discovered[(6, 1, 2)] == 0 and max(a.discovered.values()) <= 700
    assert metrics["units"] == len(a.discovered) > 3 and metrics["phase"] == "explore"
    kinds = {"rbexplore": SimilarityModel, "cells": Cells}
    assert type(getattr(a, "similarity", None)) is kinds.get(method, type(None))
    with pytest.raises(InputError, match="budget"):
        a.iterate()


@pytest.mark.parametrize("method", ["random", "rnd"])
def test_S5_03_S6_2_04_a_compared_method_covers_at_the_step_that_arrives(method):
    units = []

    class Watched(Maze):
        def unit(self):
            return None if self.state.x == 3 else super().unit()

        def step(self, action):
            result = super().step(action)
            units.append(self.unit())
            return result

    a = make_method(method, Watched, replace(AGENT, steps=700))
    units.clear()  # of the contract's walk
    while a.steps < 700:
        a.iterate()
    first = {(6, 1, 2): 0}
    for step, unit in enumerate(units, 1):
        if unit is not None:
            first.setdefault(unit, step)
    assert None in units and a.discovered == first


@pytest.mark.parametrize("method", METHODS)
def test_S3_2_01_every_method_checks_the_contract_and_seeds_its_environment(method):
    with pytest.raises(InputError, match="gives another frame than the first time"):
        make_method(method, lambda: without("draw"), AGENT)
    seeds = set()

    class Seeded(Maze):
        def reset(self, *, seed=None, options=None):
            seeds.add(seed)
            return super().reset(seed=seed)

    make_method(method, Seeded, replace(AGENT, seed=5, steps=100)).iterate()
    assert seeds == {5}


def test_S6_2_03_random_acts_uniformly_and_starts_anew_with_each_episode():
    walks = []
    for seed in (1, 2):
        a = make_method("random", Maze, replace(AGENT, seed=seed, M=25))
        resets = []
        acted = []
        a.reset = lambda resets=resets, acted=acted: resets.append(len(acted))
        a.step = lambda action, acted=acted: acted.append(action) or (None, False)
        for _ in range(2):
            a.iterate()
        assert resets == list(range(0, 2000, 40))  # M episodes of trajectory_steps
        counts = np.bincount(acted, minlength=7)
        assert counts.min() > 220 and counts.max() < 360
        walks += [tuple(acted[:1000]), tuple(acted[1000:])]
    assert len(set(walks)) == 4  # each seed and each iteration draws anew


@pytest.mark.parametrize(("bonus", "loss"), [("rnd", "rnd_loss"), ("icm", "forward_loss")])
def test_S6_2_03_a_bonus_and_its_loss_fall_on_what_was_seen(bonus, loss):
    a = PPO(Corridor, AGENT, bonus, "cpu")
    before, after = (np.stack([frame(k + x) for k in range(40)]) for x in (0, 1))
    actions = np.arange(40) % 2
    first = a.curiosity.bonus(before, actions, after).mean()
    losses = [a.curiosity.learn(before, actions, after)[loss] for _ in range(60)]
    assert losses[-1] < 0.5 * losses[0]
    assert a.curiosity.bonus(before, actions, after).mean() < 0.5 * first


def test_S6_2_03_the_bonus_of_rnd_is_its_error_on_the_state_arrived_at():
    bonus = RNDBonus(MAZE, (32, 32))
    before, after = pictures(9), pictures(9, seed=1)
    told = bonus.bonus(before, np.zeros(9, int), after)
    assert np.allclose(told, bonus.errors(after))
    assert bonus.pixels.count == pytest.approx(9, abs=0.01)
    learned = []
    bonus.update = lambda frames: learned.append(frames) or 0.5
    assert bonus.learn(before, np.zeros(9, int), after) == {"rnd_loss": 0.5}
    assert learned[0] is after


def test_S6_2_03_the_encoder_of_icm_learns_by_the_inverse_loss_alone():
    icm = ICM(MAZE, (32, 32), 4, "cpu")
    before, after, actions = pictures(8), pictures(8, seed=1), np.arange(8) % 4
    inverse, forward = icm.losses(before, actions, after)
    assert inverse.shape == forward.shape == (8,)
    forward.mean().backward()
    assert all(w.grad is None for w in icm.encoder.parameters())
    assert all(w.grad is not None for w in icm.forward_model.parameters())
    icm.zero_grad()
    icm.losses(before, actions, after)[0].mean().backward()
    assert all(w.grad is not None for w in icm.encoder.parameters())
    with torch.no_grad():
        phi = icm.encoder(rbexplore.to_input(before, "cpu"))
        phi_next = icm.encoder(rbexplore.to_input(after, "cpu"))
        one_hot = torch.eye(4)[torch.from_numpy(actions)]
        guess = icm.forward_model(torch.cat([phi, one_hot], 1))
        logits = icm.inverse_model(torch.cat([phi, phi_next], 1)).log_softmax(1)
    assert np.allclose(
        icm.bonus(before, actions, after), ((guess - phi_next) ** 2).sum(1) / 2, rtol=1e-4
    )
    assert np.allclose(inverse.detach(), -logits[range(8), actions], rtol=1e-4)
    icm.zero_grad()
    icm.losses(before, actions, after)[1].mean().backward()
    of_forward = [0.2 * w.grad.clone() for w in icm.forward_model.parameters()]
    icm.zero_grad()
    icm.losses(before, actions, after)[0].mean().backward()
    of_inverse = [0.8 * w.grad.clone() for w in icm.inverse_model.parameters()]
    total = 0.8 * inverse.mean().item() + 0.2 * forward.mean().item()
    losses = icm.learn(before, actions, after)
    for module, expected in ((icm.forward_model, of_forward), (icm.inverse_model, of_inverse)):
        for w, gradient in zip(module.parameters(), expected, strict=True):
            assert torch.allclose(w.grad, gradient, rtol=1e-3, atol=1e-7)
    assert 0.8 * losses["inverse_loss"] + 0.2 * losses["forward_loss"] == pytest.approx(
        total, rel=1e-4
    )


def test_S6_2_03_advantages_against_the_sum_that_defines_them():
    rng = np.random.default_rng(0)
    rewards, values, last = rng.random(12), rng.random(12), 0.7
    delta = rewards + 0.9 * np.append(values[1:], last) - values
    expected = [sum(0.72 ** (k - t) * delta[k] for k in range(t, 12)) for t in range(12)]
    assert np.allclose(advantages_of(rewards, values, last, 0.9, 0.8), expected)


def test_S6_2_03_ppo_learns_to_go_where_the_bonus_is():
    a = PPO(Corridor, replace(AGENT, steps=10**6, learning_rate=1e-2), "rnd", "cpu")
    a.curiosity.bonus = lambda before, actions, after: (actions == 1).astype(float)
    a.curiosity.learn = lambda *batch: {}
    log_p, value = a.policy(frame(1003)[None])
    assert torch.allclose(log_p.exp(), torch.tensor(0.5), atol=0.05) and abs(value.item()) < 0.2
    for _ in range(22):
        a.iterate()
    assert a.policy(frame(1003)[None])[0].exp()[0, 1] > 0.85


def test_S6_2_03_a_rollout_is_what_was_done_and_an_episode_starts_anew():
    a = PPO(Corridor, AGENT, "rnd", "cpu")
    before, actions, after, log_p, values, last = a.rollout(np.random.default_rng(0))
    x = [number(f) - 1000 for f in before]
    arrived = [number(f) - 1000 for f in after]
    assert len(x) == 200 and x[0] == 0 and set(actions) == {0, 1}
    for t in range(200):
        assert arrived[t] == max(x[t] + (1 if actions[t] == 1 else -1), 0)
    ends = [t for t in range(199) if x[t + 1] != arrived[t]]
    assert all(x[t + 1] == 0 for t in ends)
    since = np.diff([-1, *ends])
    assert max(since) <= 50 and (49 in ends or any(arrived[t] == 16 for t in ends))
    expected_log_p, expected_values = a.policy(before)
    assert np.allclose(log_p, expected_log_p[range(200), actions].detach(), atol=1e-5)
    assert np.allclose(values, expected_values.detach(), atol=1e-5)
    assert last == pytest.approx(a.policy(a.frame[None])[1].item(), abs=1e-5)


def test_S6_2_03_a_bonus_is_scaled_by_the_deviation_of_its_discounted_sums():
    a = PPO(Corridor, AGENT, "rnd", "cpu")
    bonus = np.random.default_rng(0).random(40)
    scaled = [a.scaled(bonus[:25]), a.scaled(bonus[25:])]
    sums = [sum(0.99 ** (t - k) * bonus[k] for k in range(t + 1)) for t in range(40)]
    assert np.allclose(scaled[0], bonus[:25] / np.std(sums[:25]), rtol=1e-3)
    assert np.allclose(scaled[1], bonus[25:] / np.std(sums), rtol=1e-3)


@pytest.mark.parametrize("ratio", [0.7, 0.95, 1.05, 1.3])
@pytest.mark.parametrize("advantage", [2.0, -2.0])
def test_S6_2_03_ppos_step_is_its_clipped_objective(ratio, advantage):
    a = PPO(Corridor, AGENT, "rnd", "cpu")
    with torch.no_grad():
        a.network[-1].bias[0] = 1.0  # so that the entropy has a gradient
    x = pictures(16)
    log_p, values = a.policy(x)
    old = log_p[:, 0].detach() - math.log(ratio)
    gain = min(ratio * advantage, min(max(ratio, 0.9), 1.1) * advantage)
    # Beyond the clip only an advantage that pulls back counts.
    counts = gain == ratio * advantage
    entropy = -(log_p.exp() * log_p).sum(1).mean()
    surrogate = ((log_p[:, 0] - old).exp() * advantage).mean() if counts else 0
    loss = 0.5 * (values - 3).square().mean() - surrogate - 0.001 * entropy
    parameters = list(a.network.parameters())
    expected = torch.autograd.grad(loss, parameters)
    returns = np.full(16, 3.0, np.float32)
    losses = a.update(x, np.zeros(16, int), old.numpy(), np.full(16, advantage), returns)
    for parameter, gradient in zip(parameters, expected, strict=True):
        assert torch.allclose(parameter.grad, gradient, rtol=1e-3, atol=1e-6)
    assert losses["value_loss"] == pytest.approx((values - 3).square().mean().item(), rel=1e-4)
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
    assert np.abs(drawn - p).max() < 0.04
    assert all(log_p == pytest.approx(math.log(p[action]), abs=1e-4) for action, log_p, _ in acted)


def test_R27_a_rollout_is_learned_in_four_passes_of_four_minibatches_and_by_the_bonus_too():
    a, twin = (PPO(Corridor, AGENT, "rnd", "cpu") for _ in range(2))
    before, actions, after, log_p, values, last = twin.rollout(np.random.default_rng([0, 1]))
    bonus = twin.scaled(twin.curiosity.bonus(before, actions, after))
    advantages = advantages_of(bonus, values, last, 0.99, 0.95)
    seen = []
    learned = []
    a.update = lambda *batch: seen.append(batch) or {}
    a.curiosity.learn = lambda *batch: learned.append(batch) or {"rnd_loss": 0.0}
    a.iterate()
    assert [len(batch[0]) for batch in seen] == [50] * 16
    order = np.argsort(advantages)
    for k in range(0, 16, 4):
        joined = [np.concatenate(parts) for parts in zip(*seen[k : k + 4], strict=True)]
        by_advantage = np.argsort(joined[3])
        for part, expected in zip(joined, (before, actions, log_p, advantages), strict=False):
            assert np.allclose(part[by_advantage], expected[order], atol=1e-5)
        assert np.allclose(joined[4][by_advantage], (advantages + values)[order], atol=1e-5)
    for batch, of_bonus in zip(seen, learned, strict=True):
        assert np.array_equal(of_bonus[0], batch[0]) and np.array_equal(of_bonus[1], batch[1])
        steps = [number(y) - number(x) for x, y in zip(batch[0], of_bonus[2], strict=True)]
        assert set(steps) <= {-1, 0, 1}


def test_R27_ppos_values_are_burdas():
    values = (
        PPO.GAMMA,
        PPO.GAE_LAMBDA,
        PPO.PASSES,
        PPO.MINIBATCHES,
        PPO.CLIP,
        PPO.ENTROPY,
        PPO.VALUE,
    )
    assert values == (0.99, 0.95, 4, 4, 0.1, 0.001, 0.5) and ICM.BETA == 0.2
    assert (Config().rollout_steps, Config().episode_steps) == (128 * 128, 4500)


def test_cells_are_equal_where_11_by_8_pixels_of_8_greys_are():
    cells = Cells()
    light = np.full((1, 96, 96), 200, np.uint8)
    for change, same in ((3, True), (40, False)):
        other = light.copy()
        other[0, :12, :9] -= change
        assert cells.score(cells.embed(light), cells.embed(other)[0])[0] == same
    both = cells.embed(np.concatenate([light, light // 2]))
    assert cells.score(both, both[1]).tolist() == [0, 1]
    assert cells.embed(light).shape == (1, 88) and cells.embed(light).unique().tolist() == [6]
    assert cells.embed(np.full((1, 96, 96, 3), 255, np.uint8)).unique().tolist() == [7]
    bands = (np.arange(96) // 12 * 32)[:, None].repeat(96, 1).astype(np.uint8)  # 8 of them
    assert cells.embed(bands[None]).reshape(8, 11).tolist() == [[k] * 11 for k in range(8)]


@pytest.mark.parametrize("method", ["rnd", "icm", "random", "cells"])
def test_a_method_goes_on_from_its_state_as_if_never_interrupted(method):
    config = replace(AGENT, steps=1500, rollout_steps=130)
    whole, first, second = (make_method(method, Maze, config) for _ in range(3))
    whole_metrics = [whole.iterate().metrics for _ in range(4)]
    for _ in range(2):
        first.iterate()
    second.load_state_dict(first.state_dict())
    assert [second.iterate().metrics for _ in range(2)] == whole_metrics[2:]
    assert second.discovered == whole.discovered


def test_an_agent_that_goes_on_compares_the_frame_of_its_rollback():
    a = make_method("rnd", Maze, AGENT)
    a.iterate()
    state = a.state_dict()
    state["frame"] = state["frame"] + 1
    with pytest.raises(InputError, match="restore"):
        make_method("rnd", Maze, AGENT).load_state_dict(state)


# ---- the contract of a persistent environment (3.2) ----------------------------------------------


class Honest(PersistentEnv):
    """A walk on a ring of 7 cells. All of its state, four numbers, is in the snapshot."""

    observation_space = Box(0, 255, (4, 8), np.uint8)
    action_space = Discrete(2, start=1)
    limit = 25  # of time
    lives_at_start = 3
    fields = ("cell", "clock", "lives", "draw")

    def reset(self, *, seed=None, options=None):
        self.seed = seed
        self.before = self.cell = self.clock = 0
        self.lives = self.lives_at_start
        self.draw = seed  # the state of a generator
        return self.frame(), {}

    def step(self, action):
        assert action in (1, 2) and type(action) is int
        self.before = self.cell
        self.cell = (self.cell + 2 * action - 3) % 7
        self.clock += 1
        self.draw = (5 * self.draw + 3) % 64
        self.lives -= self.cell == 3
        info = {"blank": self.cell == 2}
        return self.frame(), 0.0, self.lives == 0, self.clock == self.limit, info

    def frame(self):
        frame = np.zeros(self.observation_space.shape, np.uint8)
        frame[0, self.cell] = 255
        frame[1, self.draw % 8] = 255
        return frame

    def snapshot(self):
        return bytes(getattr(self, field) for field in self.fields)

    def restore(self, snapshot):
        for field, value in zip(self.fields, snapshot, strict=True):
            setattr(self, field, value)
        return self.frame()

    def unit(self):
        return ("cave", self.cell)


def variant(**members):
    """Honest but for these members."""
    return type("Variant", (Honest,), members)()


def without(*lost, **members):
    """The snapshot lacks these fields."""
    return variant(fields=[field for field in Honest.fields if field not in lost], **members)


def late(change):
    """A step that is wrong from the seventh of an episode on."""

    def step(env, action):
        result = Honest.step(env, action)
        return change(*result) if env.clock >= 7 else result

    return step


def fails(env, *_):
    raise KeyError("over\ntwo lines")


def reused(env):
    env.buffer = getattr(env, "buffer", np.zeros((4, 8), np.uint8))
    env.buffer[:] = Honest.frame(env)
    return env.buffer


def stacked(env):
    frame = Honest.frame(env)
    frame[2, env.before] = 255
    return frame


def stale(env, snapshot):
    frame = env.frame()
    Honest.restore(env, snapshot)
    return frame


def emptied(env, snapshot):
    """Right where parts are restored in the order in which they were played."""
    Honest.restore(env, snapshot)
    if env.clock == 0:
        env.before = 0
    return env.frame()


def coloured(*shape):
    return {
        "observation_space": Box(0, 255, shape, np.uint8),
        "frame": lambda env: np.full(shape, env.cell, np.uint8),
    }


@pytest.mark.parametrize(
    "members",
    [
        {},
        {"frame": reused},
        {"unit": lambda env: None},
        {"action_space": Discrete(256, start=1), "step": lambda env, action: Honest.step(env, 1)},
        coloured(9, 9, 3),
        coloured(84, 84, 4),
        coloured(4, 84, 1),
        {
            "step": late(
                lambda frame, r, end, cut, info: (frame, r, np.bool_(end), np.bool_(cut), {})
            )
        },
    ],
)
def test_S3_2_01_the_contract_accepts_an_honest_environment_and_leaves_it_at_the_start(members):
    env = variant(**members)
    check_contract(env, seed=5)
    assert (env.cell, env.clock, env.lives, env.draw, env.seed) == (0, 0, 3, 5, 5)
    check_contract(env)
    assert env.seed == 0


def test_S3_2_01_the_contract_accepts_the_maze_and_the_emulators(prince, montezuma):
    for env in (Maze(3), prince, montezuma):
        check_contract(env)
        assert env.snapshot() == make_start(env)


def make_start(env):
    env.reset()
    return env.snapshot()


REPLAYS = "after step {}: the same action after a restore gives another {} than the first time"
BROKEN = {
    "give a function that makes the environment, so": lambda: Honest,
    "makes the environment, so that": lambda: functools.partial(Honest),
    "function that makes the environment": lambda: variant,
    "lacks reset, step, snapshot, restore, unit, close()": lambda: None,
    "lacks snapshot(), see PersistentEnv in envs.py": lambda: variant(snapshot=None),
    "lacks close()": lambda: variant(close=None),
    "PersistentEnv in envs.py; give env.unwrapped, or add them": lambda: (
        gymnasium.wrappers.TimeLimit(Honest(), 9)
    ),
    "it must be Discrete with at most 256": lambda: variant(action_space=Box(0, 1)),
    "is Discrete(257, start=1)": lambda: variant(action_space=Discrete(257, start=1)),
    "the action space is None": lambda: variant(action_space=None),
    "a Box of uint8": lambda: variant(observation_space=Box(0, 1, (4, 8), np.float32)),
    "the observation space is Discrete": lambda: variant(observation_space=Discrete(3)),
    "(H, W) or (H, W, C)": lambda: variant(observation_space=Box(0, 255, (8,), np.uint8)),
    "frames are (4, 84, 84): channels come last": lambda: variant(**coloured(4, 84, 84)),
    "frames are (3, 64, 64): channels come last": lambda: variant(**coloured(3, 64, 64)),
    "frames are (9, 9, 5): channels": lambda: variant(**coloured(9, 9, 5)),
    "after step 0: reset() fails with TypeError": lambda: variant(
        reset=lambda env: Honest.reset(env)
    ),
    "after step 0: reset() must give a frame and a dict": lambda: variant(
        reset=lambda env, seed: Honest.reset(env, seed=seed)[0]
    ),
    "reset() must give a frame and a dict": lambda: variant(
        reset=lambda env, seed: (Honest.reset(env, seed=seed)[0], None)
    ),
    "reset() must give a frame": lambda: variant(
        reset=lambda env, seed: (*Honest.reset(env, seed=seed), {})
    ),
    "reset() gives a list for the frame: give an array": lambda: variant(
        frame=lambda env: Honest.frame(env).tolist()
    ),
    "reset() gives a frame (4, 8) of float64: the observation space says (4, 8) of uint8": lambda: (
        variant(frame=lambda env: Honest.frame(env) / 255)
    ),
    "after step 0: snapshot() gives list: give bytes": lambda: variant(
        snapshot=lambda env: [env.cell]
    ),
    "after step 0: unit() fails with NotImplementedError": lambda: variant(unit=PersistentEnv.unit),
    "after step 0: unit() gives ('cave', 0.5)": lambda: variant(unit=lambda env: ("cave", 0.5)),
    "after step 1: step() fails with KeyError: 'over\\ntwo lines'": lambda: variant(step=fails),
    "after step 1: step() fails with TypeError": lambda: variant(step=lambda env: None),
    "after step 7: step() must give five values": lambda: variant(
        step=late(lambda *result: result[:4])
    ),
    "after step 7: step() gives 0.0 for terminated: give a bool": lambda: variant(
        step=late(lambda frame, *rest: (frame, 0.0, 0.0, False, {}))
    ),
    "after step 7: step() gives None for truncated: give a bool": lambda: variant(
        step=late(lambda frame, *rest: (frame, 0.0, False, None, {}))
    ),
    "after step 7: step() gives array([1, 2]) for blank: give a bool": lambda: variant(
        step=late(lambda *result: (*result[:4], {"blank": np.array([1, 2])}))
    ),
    "after step 7: step() gives None for info: give a dict": lambda: variant(
        step=late(lambda *result: (*result[:4], None))
    ),
    "after step 7: step() gives a frame (4, 8) of int64": lambda: variant(
        step=late(lambda frame, *rest: (frame.astype(int), *rest))
    ),
    "after step 7: step() gives a frame (8, 4) of uint8": lambda: variant(
        step=late(lambda frame, *rest: (frame.T, *rest))
    ),
    "restore() fails with KeyError": lambda: variant(restore=fails),
    "restore() gives a tuple for the frame": lambda: variant(
        restore=lambda env, snapshot: (Honest.restore(env, snapshot), {})
    ),
    "restore() gives another frame than the first time": lambda: variant(restore=stale),
    "reset() with the same seed gives another frame than the first time": lambda: variant(
        reset=lambda env, seed: Honest.reset(env, seed=getattr(env, "draw", 0) % 8)
    ),
    REPLAYS.format(96, "truncated"): lambda: without("clock", limit=96, lives_at_start=99),
    "gives another terminated than": lambda: without("lives"),
    "restore() gives another frame": lambda: without("draw"),
    "restore() gives another frame than": lambda: without("draw", frame=reused),
    "restore() gives another unit than": lambda: without(
        "clock", unit=lambda env: env.clock, limit=0
    ),
    "gives another blank than": lambda: without(
        "clock",
        limit=0,
        lives_at_start=99,
        step=lambda env, action: (*Honest.step(env, action)[:4], {"blank": env.clock % 10 == 0}),
    ),
    "restore() gives another frame than the first": lambda: variant(frame=stacked),
    "gives another frame than the first": lambda: variant(
        frame=stacked, restore=emptied, limit=0, lives_at_start=99
    ),
}


@pytest.mark.parametrize("said", BROKEN)
def test_S3_2_01_the_contract_refuses_in_one_line(said):
    with pytest.raises(InputError, match=re.escape(said)) as error:
        check_contract(BROKEN[said]())
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "unit, key",
    [
        (None, None),
        (5, (5,)),
        ("cave", ("cave",)),
        (("cave", 3, 4), ("cave", 3, 4)),
        ([1, "b"], (1, "b")),
        ((True, np.uint8(7)), (1, 7)),
        (np.int64(6), (6,)),
        (np.str_("c"), ("c",)),
        (np.array([1, 2]), (1, 2)),
        (np.array(3), (3,)),
        (np.array(["a"]), ("a",)),
        ((np.bool_(0),), (0,)),
    ],
)
def test_S5_04_a_unit_is_plain_ints_and_strs(unit, key):
    assert unit_key(unit) == key
    assert key is None or [type(part) for part in unit_key(unit)] == [type(part) for part in key]


@pytest.mark.parametrize(
    "unit",
    [
        0.5,
        float("nan"),
        (1, 2.0),
        np.array([1.0]),
        np.float32(1),
        {1, 2},
        {"x": 1},
        ((1, 2), 3),
        (None,),
        b"cave",
        np.zeros((2, 2), int),
        object(),
    ],
)
def test_S5_04_a_unit_of_another_kind_is_refused(unit):
    with pytest.raises(InputError, match=r"unit\(\) gives .* it must give an int, a str, a tuple"):
        unit_key(unit)


# ---- replays -------------------------------------------------------------------------------------


def memory(env):
    """All that a program can know: the RAM, or the maze's state."""
    if isinstance(env, Montezuma):
        return env._emulator.getRAM().tobytes()
    if isinstance(env, PrinceOfPersia):
        return b"".join(env._data.memory.blocks.values())
    return env.snapshot()


def watch(env, snapshot, actions):
    """What is seen of a trajectory, from the snapshot's own frame to the end of the episode."""
    seen = [(env.restore(snapshot).tobytes(), memory(env), env.unit())]
    for action in actions:
        frame, *outcome = env.step(action)
        seen.append((frame.tobytes(), memory(env), outcome, env.unit()))
        if outcome[1]:
            break
    return seen


def watch_elsewhere(make, jobs):
    env = make()
    seen = [watch(env, *job) for job in jobs]
    env.close()
    return seen


@pytest.fixture(scope="module")
def elsewhere():
    """A process that shares nothing with this one."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        yield pool


def check_replay(env, make, elsewhere, count, length):
    """Trajectories from random states met before, again in another order and another process."""
    generator = np.random.default_rng(0)
    snapshots = [make_start(env)]
    jobs = []
    seen = []
    for _ in range(count):
        snapshot = snapshots[generator.integers(len(snapshots))]
        actions = generator.integers(env.action_space.n, size=length).tolist()
        jobs.append((snapshot, actions))
        seen.append(watch(env, snapshot, actions))
        snapshots.append(env.snapshot() if not seen[-1][-1][2][1] else snapshot)
    assert len({trajectory[-1][0] for trajectory in seen}) > count / 20, "frames tell states apart"
    for k in generator.permutation(count):
        assert watch(env, *jobs[k]) == seen[k]
    there = elsewhere.submit(watch_elsewhere, make, jobs[-20:]).result()
    assert there == seen[-20:]


def test_S3_2_01_the_maze_replays_here_and_in_another_process(elsewhere):
    check_replay(Maze(3), functools.partial(Maze, 3), elsewhere, count=100, length=12)


def test_S3_2_01_the_cartridge_replays_here_and_in_another_process(prince, rom, elsewhere):
    check_replay(prince, functools.partial(PrinceOfPersia, rom), elsewhere, count=60, length=10)


def test_S3_2_01_montezuma_replays_here_and_in_another_process(montezuma, elsewhere):
    check_replay(montezuma, Montezuma, elsewhere, count=25, length=30)


# ---- the maze (5) --------------------------------------------------------------------------------

# Every rule has a place here. Letters a, b: plates; A, B: their gates.
PLAYGROUND = """
    _@_.__.__a _____^.b_#
    #_#.#_____ #A_#^#.__B
    ___.______ __________
    _______^._ _____.____
    _________# _____^___#
    ########## ##########
"""
# x, y, facing right, plates as bits: action: the same and dead afterwards
MOVES = """
    1 0 1 0: NOOP: 1 0 1 0 0      1 0 1 0: LEFT: 1 0 0 0 0      1 0 0 0: LEFT: 0 0 0 0 0
    0 0 0 0: LEFT: 0 0 0 0 0      1 0 0 0: RIGHT: 1 0 1 0 0     1 0 1 0: RIGHT: 2 0 1 0 0
    2 0 1 0: RIGHT: 3 3 1 0 1     2 0 1 0: DOWN: 3 3 1 0 1      2 0 0 0: DOWN: 2 0 0 0 0
    2 0 1 0: A: 4 0 1 0 0         2 0 1 0: B: 2 0 1 0 0         4 0 0 0: A: 2 0 0 0 0
    5 0 1 0: RIGHT: 6 1 1 0 0     5 0 1 0: DOWN: 6 1 1 0 0      4 0 1 0: A: 6 1 1 0 0
    6 1 1 0: UP: 7 0 1 0 0        6 1 0 0: UP: 5 0 0 0 0        5 1 1 0: UP: 5 1 1 0 0
    7 0 1 0: UP: 7 0 1 0 0        1 1 1 0: RIGHT: 1 1 1 0 0     1 1 1 0: A: 1 1 1 0 0
    1 1 1 0: B: 1 1 1 0 0         1 0 1 0: B: 2 0 1 0 0         1 0 0 0: B: 0 0 0 0 0
    8 0 1 0: RIGHT: 9 0 1 1 0     8 0 1 0: A: 10 0 1 0 0        7 0 1 0: A: 9 0 1 1 0
    8 0 1 0: B: 9 0 1 1 0         9 0 1 1: RIGHT: 10 0 1 1 0    14 0 1 0: RIGHT: 15 0 1 0 1
    14 0 1 0: B: 15 0 1 0 0       15 0 1 0: NOOP: 15 0 1 0 0    15 0 1 0: LEFT: 15 0 0 0 0
    13 0 1 0: A: 15 0 1 0 1       14 0 1 0: A: 16 2 1 0 1       15 0 1 0: RIGHT: 16 2 1 0 1
    15 0 1 0: DOWN: 16 2 1 0 0    15 0 1 0: A: 17 0 1 2 0       16 2 1 0: UP: 17 1 1 0 0
    16 2 0 0: UP: 16 2 0 0 0      17 0 1 2: A: 18 0 1 2 0       18 0 1 3: RIGHT: 18 0 1 3 0
    12 1 0 0: LEFT: 12 1 0 0 0    12 1 0 1: LEFT: 11 1 0 1 0    12 1 0 2: LEFT: 12 1 0 2 0
    12 1 0 1: A: 11 1 0 1 0       18 1 1 2: RIGHT: 19 1 1 2 0   18 1 1 1: RIGHT: 18 1 1 1 0
    18 1 1 0: B: 18 1 1 0 0       18 1 1 2: B: 19 1 1 2 0       19 1 1 2: RIGHT: 19 1 1 2 0
    8 4 0 0: UP: 7 3 0 0 1        8 4 1 0: UP: 9 3 1 0 0        14 3 1 0: DOWN: 15 4 1 0 1
    6 3 1 0: A: 8 4 1 0 0         9 3 0 0: DOWN: 8 4 0 0 0      16 3 0 0: B: 16 3 0 0 0
    6 3 1 0: B: 7 3 1 0 0         6 3 1 0: RIGHT: 7 3 1 0 1     17 1 0 0: A: 16 2 0 0 0
"""


@pytest.fixture
def playground(monkeypatch):
    monkeypatch.setitem(envs.LEVELS, 4, PLAYGROUND)
    return Maze(4, frame_size=96)


@pytest.mark.parametrize("move", re.split(r"\s{2,}", MOVES.strip()))
def test_the_rules_of_the_maze(playground, move):
    before, action, after = move.split(":")
    playground.restore(bytes([4, *map(int, before.split()), 0]))
    _, reward, terminated, truncated, info = playground.step(getattr(envs, action.strip()))
    x, y, facing, plates, dead = map(int, after.split())
    assert playground.snapshot() == bytes([4, x, y, facing, plates, dead])
    assert (reward, terminated, truncated, info) == (0.0, bool(dead), False, {})
    room = 2 * (y // 3) + x // 10
    assert playground.unit() == (None if dead else (room, x % 10, y % 3))


def test_S5_01_S5_02_the_maze_has_gray_square_frames_and_seven_actions():
    actions = (envs.NOOP, envs.LEFT, envs.RIGHT, envs.UP, envs.DOWN, envs.A, envs.B)
    assert actions == (0, 1, 2, 3, 4, 5, 6)
    for size in (32, 96):
        env = gymnasium.make("RbExploreMaze-v0", frame_size=size).unwrapped
        check_env(env, skip_render_check=True)
        assert env.observation_space == Box(0, 255, (size, size), np.uint8)
        assert env.action_space == Discrete(7)
        frame, info = env.reset(seed=1)
        assert (frame.shape, frame.dtype, info) == ((size, size), np.uint8, {})
    assert (Maze().level, Maze().frame_size, Maze.unit_name) == (1, 32, "tiles")


def test_S5_03_full_coverage_is_every_unit_that_steps_can_reach():
    env = Maze()
    todo = [make_start(env)]
    states = set(todo)
    units = {env.unit()}
    while todo:
        snapshot = todo.pop()
        for action in range(7):
            env.restore(snapshot)
            dead = env.step(action)[2]
            if not dead and env.snapshot() not in states:
                units.add(env.unit())
                states.add(env.snapshot())
                todo.append(env.snapshot())
    assert units == env.reachable()
    assert env.full_coverage == len(units) == 187


@pytest.mark.parametrize(
    "level, units, states, depth, deaths",
    [(1, 187, 970, 82, 16), (2, 258, 4322, 115, 102), (3, 358, 23798, 168, 1614)],
)
def test_the_size_of_each_level(level, units, states, depth, deaths):
    env = Maze(level)
    steps = env.distances(make_start(env))
    assert (env.full_coverage, len(steps), max(steps.values())) == (units, states, depth)
    assert sum(snapshot[5] for snapshot in steps) == deaths


def test_distances_begin_at_the_snapshot_and_count_steps():
    env = Maze()
    start = make_start(env)
    env.step(envs.RIGHT)
    second = env.snapshot()
    steps = env.distances(second)
    assert (steps[second], env.distances(start)[start], env.distances(start)[second]) == (0, 0, 1)
    assert start == bytes([1, 1, 8, 1, 0, 0]) and steps[start] == 3


def frames_of(env):
    for snapshot in sorted(env.distances(make_start(env))):
        yield env.restore(snapshot)


@pytest.mark.parametrize(
    "level, size, checksum",
    [
        (1, 32, 2591647558),
        (1, 40, 2897048085),
        (1, 96, 3370634031),
        (2, 32, 1574217588),
        (4, 96, 2477709669),
    ],
)
def test_S5_01_the_pixels_of_every_state(playground, level, size, checksum):
    """R learns from these: a level of other pixels has other results."""
    crc = 0
    for frame in frames_of(Maze(level, size)):
        crc = zlib.crc32(frame, crc)
    assert crc == checksum


def test_frames_tell_states_apart(playground):
    def look(x, y, facing=1, plates=0, dead=0):
        return playground.restore(bytes([4, x, y, facing, plates, dead]))

    def box(first, second):
        """Top, left, bottom and right of what differs, in pixels: a tile has 9 x 32."""
        places = np.argwhere(first != second)
        return [*places.min(axis=0), *places.max(axis=0)]

    assert box(look(1, 0), look(1, 0, facing=0)) == [9, 12, 20, 20]
    assert box(look(1, 0), look(2, 0)) == [9, 12, 27, 29]
    assert box(look(1, 0, dead=1), look(2, 0, dead=1)) == [23, 12, 27, 29], "the dead lie low"
    assert box(look(1, 0), look(1, 0, plates=1)) == [24, 84, 31, 92], "a plate"
    assert box(look(12, 1), look(12, 1, plates=1)) == [38, 12, 59, 20], "a gate"
    flat = look(12, 0)
    playground.tiles[0] = playground.tiles[0].replace("^", "_")
    playground._seen.clear()
    assert box(flat, look(12, 0)) == [19, 48, 27, 56], "spikes"


@pytest.mark.parametrize("level, checksum", [(1, 2591857595), (2, 292593030), (3, 3945248101)])
def test_the_level_map_has_a_box_for_each_reachable_unit(level, checksum):
    env = Maze(level)
    picture, boxes = env.level_map()
    assert zlib.crc32(picture) == checksum
    assert boxes.keys() == env.reachable()
    across = len(env.tiles[0]) // 10
    for (room, column, row), (x, y, w, h) in boxes.items():
        assert (x // 8, y // 24) == (room % across * 10 + column, room // across * 3 + row)
        assert (x % 8, y % 24, w, h) == (0, 0, 8, 24)


def test_frames_given_away_are_the_callers_own_and_few_are_kept():
    env = Maze()
    start = env.reset()[0]
    start[:] = 0
    assert env.reset()[0].any() and env.step(envs.NOOP)[0].any()
    big = Maze(2)
    most = 0
    for _ in frames_of(big):
        most = max(most, len(big._seen))
    assert most == 4096


def test_the_maze_refuses_what_it_cannot_do(playground):
    good = make_start(playground)
    bad = [
        b"",
        None,
        [*good],
        good[:5],
        good + b"\0",
        Maze(2).snapshot(),
        b"\3\1\0\1\0\0",  # of another level
        b"\4\3\0\1\0\0",  # in mid-air
        b"\4\0\1\1\0\0",  # in a wall
        b"\4\x0b\1\1\2\0",  # in a closed gate
        b"\4\xc8\0\1\0\0",  # outside
        b"\4\1\xc8\1\0\0",
        b"\4\1\0\2\0\0",  # facing, plates or dead out of range
        b"\4\1\0\1\4\0",
        b"\4\1\0\1\0\2",
    ]
    for snapshot in bad:
        with pytest.raises(InputError, match="no snapshot of maze level 4: "):
            playground.restore(snapshot)
    assert playground.snapshot() == good == b"\4\1\0\1\0\0"
    playground.restore(b"\4\x0b\1\1\1\0")
    playground.restore(b"\4\1\0\1\3\1")
    with pytest.raises(InputError, match="dead: reset or restore"):
        playground.step(0)
    assert playground.unit() is None and playground.reset()[0].any()
    for action in (-1, 7, 1.5, "A", None):
        with pytest.raises(InputError, match="actions 0 to 6, and not"):
            playground.step(action)


@pytest.mark.parametrize(
    "said, options",
    [
        ("unknown maze level 9: there are 1, 2, 3", {"level": 9}),
        ("maze level 1.0", {"level": 1.0}),
        (r"maze level \[1\]", {"level": [1]}),
        ("not 31", {"frame_size": 31}),
        ("not 32.0", {"frame_size": 32.0}),
        ("maze has no option 'speed': it has level", {"speed": 1}),
        ("unknown environment 'doom': there are maze, pop, montezuma", {"name": "doom"}),
    ],
)
def test_the_factory_refuses_in_one_line(said, options):
    with pytest.raises(InputError, match=said):
        make_env(**{"name": "maze", **options})


def test_the_factory_knows_three_environments():
    assert {"maze": Maze, "pop": PrinceOfPersia, "montezuma": Montezuma} == envs.ENVIRONMENTS
    env = make_env("maze", level=2, frame_size=40)
    assert (type(env), env.level, env.reset()[0].shape) == (Maze, 2, (40, 40))


# ---- the emulators, with a stand-in cartridge whose program runs in the real emulator ------------

# The suffix of an operation is its addressing: # immediate, z zero page, x indexed by X.
OPCODES = dict(
    re.findall(
        r"(\S+) (\d+)",
        """
    adc# 105  and# 41  bcc 144  bcs 176  beq 240  bit 44  bne 208  bpl 16  clc 24  cmp# 201  dec 206
    decz 198  dex 202  dey 136  inc 238  incz 230  inx 232  jmp 76  lda 173  lda# 169  ldax 189
    ldaz 165  ldx# 162  ldxz 166  ldy# 160  lsr 74  rolz 38  sbc# 233  sec 56  sei 120  sta 141
    stax 157  staz 133  txa 138""",
    )
)
# RAM 0 counts frames, 1 is the pad, 2 counts black frames; 512 + frame keeps the pad, 768 + frame
# the clock. Right of x = 332 is the next room, after 6 black frames. A below y = 160 hurts; B takes
# the sword, and above y = 64 the exit. The picture is noise, scrolled by x and y, in the room's
# colour.
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
  lit: lda 1246 | and# 7 | clc | adc# 1 | sta 8199
    lda# 48 | sta 8199 | sta 8199 | sta 8199 | lda# 10
  drawn: sta 8193 | lda# 0 | sta 8192 | lda 1243 | sta 8197 | lda 1777 | sta 8197
    lda# 1 | sta 16406 | lda# 0 | sta 16406 | ldx# 8
  pad: lda 16406 | lsr | rolz 1 | dex | bne pad
    ldxz 0 | ldaz 1 | stax 512 | lda 1222 | stax 768 | incz 0 | dec 1222
    ldaz 1 | and# 1 | beq left
    lda 1243 | clc | adc# 4 | sta 1243 | lda 1244 | adc# 0 | sta 1244 | cmp# 1 | bne left
    lda 1243 | cmp# 77 | bcc left
    lda# 0 | sta 1243 | sta 1244 | inc 1246 | lda# 6 | staz 2
  left: ldaz 1 | and# 2 | beq down
    lda 1243 | sec | sbc# 4 | sta 1243 | lda 1244 | sbc# 0 | sta 1244
  down: ldaz 1 | and# 4 | beq up | lda 1777 | clc | adc# 4 | sta 1777
  up: ldaz 1 | and# 8 | beq slow | lda 1777 | sec | sbc# 4 | sta 1777
  slow: ldaz 0 | and# 3 | bne end
    ldaz 1 | and# 128 | beq b | lda 1777 | cmp# 160 | bcc b | dec 1743
  b: ldaz 1 | and# 64 | beq end | lda# 1 | sta 1774 | lda 1777 | cmp# 64 | bcs end | incz 112
  end: jmp frame
"""
PADS = [0, 2, 1, 8, 4, 128, 64]  # no-op, left, right, up, down, A, B as the console's pad has them
RESET = 49152  # where the program begins, in the last bank


def assemble(program):
    """The program's bytes, by two passes: the first finds the labels."""
    labels = {}
    for _ in range(2):
        code = b""
        for line in re.split(r"[|\n]", program.strip()):
            label, _, operation = line.rpartition(":")
            labels[label.strip()] = RESET + len(code)
            name, *operand = operation.split()
            code += bytes([int(OPCODES[name])])
            for text in operand:
                value = int(text) if text.isdigit() else labels.get(text, RESET)
                branch = re.fullmatch("b[^i].", name)
                if branch:
                    code += bytes([value - RESET - len(code) - 1 & 255])
                else:
                    code += value.to_bytes(1 if name[-1] in "#z" else 2, "little")
    return code


def cartridge(mark=0):
    """A 128 KiB iNES image, mapper 2; `mark` fills the unused banks."""
    vectors = 3 * RESET.to_bytes(2, "little")
    last = assemble(PROGRAM).ljust(16378, b"\0") + vectors
    return HEADER + bytes([mark]) * 7 * 16384 + last


HEADER = b"NES\x1a\x08\0\x20".ljust(16, b"\0")
HALTING = HEADER + b"\2" * 8 * 16384  # every operation halts: what is in RAM stays


@pytest.fixture
def rom(tmp_path):
    pytest.importorskip("stable_retro", reason="the cartridge's emulator is not installed")
    path = tmp_path / "game.nes"
    path.write_bytes(cartridge())
    return str(path)


@pytest.fixture
def prince(rom):
    env = PrinceOfPersia(rom)
    env.reset()
    yield env
    env.close()


@pytest.fixture
def montezuma():
    pytest.importorskip("ale_py", reason="Montezuma's emulator is not installed")
    env = Montezuma()
    env.reset()
    return env


def poke(env, address, value, kind="|u1"):
    env._data.memory.assign(address, kind, value)


def place(env, room, x, y):
    poke(env, 1246, room)
    poke(env, 1243, x, "<u2")
    poke(env, 1777, y)


def test_S3_2_02_a_rollback_costs_no_frame(prince):
    before = memory(prince)
    snapshot = prince.snapshot()
    assert memory(prince) == before
    frame = prince.step(2)[0]
    later = prince.snapshot()
    assert not np.array_equal(prince.restore(snapshot), frame)
    assert memory(prince) == before
    assert prince.snapshot() == snapshot != later
    assert np.array_equal(prince.restore(later), frame)
    assert len(snapshot) < 4000


@pytest.mark.parametrize("size", [96, 40])
def test_S5_01_frames_are_gray_area_averages(prince, rom, size):
    prince.close()
    env = PrinceOfPersia(rom, frame_size=size)
    env.reset()
    frame = env.step(2)[0]
    assert frame.dtype == np.uint8 and env.observation_space == Box(0, 255, (size, size), np.uint8)
    gray = np.rint(env._emulator.get_screen() @ np.array([0.299, 0.587, 0.114]))  # (224, 240)
    rows = gray.repeat(size, axis=0).reshape(size, 224, 240).mean(axis=1)
    slow = rows.repeat(size, axis=1).reshape(size, size, 240).mean(axis=2)
    assert np.array_equal(frame, np.floor(slow + 1e-9))
    env.close()


def test_S5_02_S6_1_01_a_step_is_four_frames_of_one_of_seven_pads_and_the_clock_is_held(prince):
    assert prince.action_space == Discrete(7) and prince.reset()[0].shape == (96, 96)
    for action in [*range(7), *reversed(range(7))]:
        start = memory(prince)[0]
        prince.step(action)
        ram = memory(prince)
        frames = [(start + i) % 256 for i in range(4)]
        assert (ram[0] - start) % 256 == 4
        assert [ram[512 + i] for i in frames] == [PADS[action]] * 4  # START is 16, SELECT 32
        assert ram[1221:1223] == b"99"
        assert {ram[768 + i] for i in frames} == {ord("9")}


def test_S6_1_01_montezuma_takes_four_frames_a_step(montezuma):
    for action in (5, 0, 2):
        start = montezuma._emulator.getEpisodeFrameNumber()
        montezuma.step(action)
        assert montezuma._emulator.getEpisodeFrameNumber() == start + 4
    assert montezuma.action_space == Discrete(18)
    assert montezuma._emulator.getFloat("repeat_action_probability") == 0


def test_S5_03_full_coverage_of_every_level_of_the_cartridge(prince):
    counts = (721, 723, 756, 706, 598, 287, 755, 736, 797, 444, 575, 688, 223, 107)
    assert counts == PrinceOfPersia.FULL_COVERAGE
    assert (prince.full_coverage, prince.unit_name) == (721, "units of 32 x 32 pixels")


def test_S5_03_S5_04_units_are_32_pixels_of_a_room(prince):
    def unit(*at):
        place(prince, *at)
        return prince.unit()

    assert unit(14, 64, 128) == unit(14, 95, 159) == (14, 2, 4)
    assert unit(14, 96, 128) == (14, 3, 4)
    assert unit(14, 63, 128) == (14, 1, 4)
    assert unit(14, 64, 160) == (14, 2, 5)
    assert unit(15, 64, 128) == (15, 2, 4)
    assert unit(0, 0, 32) == (0, 0, 1)
    assert unit(0, 332, 223) == (0, 10, 6)
    assert unit(0, 333, 192) is unit(0, 0, 31) is unit(0, 0, 224) is None
    place(prince, 14, 4, 128)
    info = prince.step(1)[4]
    assert info["x"] == 65524 and prince.unit() is None, "left of the room"
    place(prince, 14, 64, 128)
    poke(prince, 1743, 0)
    assert prince.unit() is None, "the dead stand nowhere"


def test_S6_1_07_a_lost_hit_point_or_another_level_ends_the_episode(prince):
    assert not prince.step(5)[2]
    poke(prince, 1777, 200)
    before = prince.snapshot()
    _, _, terminated, truncated, info = prince.step(5)
    assert (terminated, truncated, info["hit_points"]) == (True, False, 2)
    prince.restore(before)
    assert not prince.step(0)[2]
    poke(prince, 1743, 2)  # what counts is a drop within the step, not below the start
    assert not prince.step(0)[2]
    poke(prince, 1777, 40)
    assert prince.unit() is not None
    _, _, terminated, _, info = prince.step(6)
    assert (terminated, info["level"], prince.unit()) == (True, 2, None)


def test_S6_1_07_more_hit_points_are_no_loss(prince, monkeypatch):
    tick = prince._tick
    monkeypatch.setattr(prince, "_tick", lambda action: (tick(action), poke(prince, 1743, 5)))
    assert not prince.step(0)[2]


def test_S6_1_07_a_lost_life_ends_the_episode_in_montezuma(montezuma):
    generator = np.random.default_rng(0)
    lives = 5
    ends = 0
    for action in generator.integers(18, size=600).tolist():
        _, reward, terminated, truncated, info = montezuma.step(action)
        assert terminated == (info["lives"] < lives)
        assert (reward, truncated) == (0.0, False)
        lives = info["lives"]
        ends += terminated
    assert ends


def test_every_reading_of_ram(prince):
    assert prince.reset()[1] == {
        "level": 1,
        "room": 14,
        "x": 64,
        "y": 128,
        "hit_points": 3,
        "sword": 0,
        "blank": False,
    }
    values = {112: 6, 1246: 23, 1243: 44, 1244: 1, 1777: 191, 1743: 5, 1774: 1}
    for address, value in values.items():
        poke(prince, address, value)
    assert prince.step(0)[4] == {
        "level": 7,
        "room": 23,
        "x": 300,
        "y": 160,
        "hit_points": 5,
        "sword": 1,
        "blank": False,
    }


def test_every_reading_of_ram_in_montezuma(montezuma, capfd):
    twin = Montezuma()
    assert twin.snapshot() == montezuma.snapshot()
    assert capfd.readouterr() == ("", ""), "no banner"
    assert montezuma.reset()[1] == {"room": 1, "x": 77, "y": 235, "lives": 5, "blank": False}
    assert montezuma.unit() == (1, 4, 1)
    assert (montezuma.full_coverage, montezuma.unit_name) == (None, "units of 16 x 16 pixels")
    rows = []
    for _ in range(22):  # down the ladder that the game begins on
        montezuma.step(5)
        rows.append(montezuma.unit()[2])
    assert rows == sorted(rows) and rows[-1] > rows[0] + 2
    readings = montezuma.step(0)[4]
    ram = montezuma._emulator.getRAM()
    assert list(readings.values()) == [ram[3], ram[42], ram[43], ram[58], False]


def test_R22_the_frame_is_the_last_of_its_step(prince, montezuma, monkeypatch):
    for env in (prince, montezuma):
        shown = []
        tick = env._tick

        def watched(action, env=env, tick=tick, shown=shown):
            tick(action)
            shown.append(env._observe())

        monkeypatch.setattr(env, "_tick", watched)
        frames = [env.step(action)[0] for action in (2, 4, 5, 3, 1) * 10]
        assert all(map(np.array_equal, frames, shown[3::4]))
        assert not all(map(np.array_equal, frames, shown[2::4]))


def test_R24_black_transition_frames_are_marked(prince, monkeypatch):
    poke(prince, 1243, 330, "<u2")
    black, _, _, _, info = prince.step(2)
    assert (info["blank"], black.max(), info["room"]) == (True, 0, 15)
    lit, _, _, _, info = prince.step(0)
    assert lit.any() and info["blank"] is False
    monkeypatch.setattr(prince, "_screen", lambda: np.zeros((224, 240, 3), np.uint8))
    prince._begin(b"dark", 7, 96)
    assert prince.reset()[1]["blank"] is True


STARTS = [(1, 14, 77, 192), (2, 4, 123, 128), (3, 8, 164, 192)]


def start_state(env, path, level, room, x, y, hit_points=3):
    """Write the state of an environment with this RAM, as the authors' states are written."""
    place(env, room, x, y)
    poke(env, 112, level - 1)
    poke(env, 1774, 1)
    poke(env, 1743, hit_points)
    path.write_bytes(gzip.compress(env._save()))
    return str(path)


@pytest.mark.parametrize("level, room, x, y", STARTS)
def test_S6_2_01_S6_2_02_start_states(prince, rom, tmp_path, level, room, x, y):
    start = start_state(prince, tmp_path / "start", level, room, x, y)
    frames = memory(prince)[0]
    dead = start_state(prince, tmp_path / "dead", level, room, x, y, hit_points=0)
    prince.close()
    env = PrinceOfPersia(rom, level, start)
    frame, info = env.reset()
    assert info == {
        "level": level,
        "room": room,
        "x": x,
        "y": y,
        "hit_points": 3,
        "sword": 1,
        "blank": False,
    }
    assert memory(env)[0] == frames + 1, "one frame after the state"
    assert env.full_coverage == (721, 723, 756)[level - 1]
    before = (env._save(), frame.tobytes(), env.snapshot())
    for action in (2, 2, 5, 4, 1):
        env.step(action)
    assert env.snapshot() != before[2]
    frame, _ = env.reset()
    assert (env._save(), frame.tobytes(), env.snapshot()) == before
    env.close()
    for wrong, state in ((5, start), (level, dead)):
        said = f"not in play on level {wrong}, or the state is of another cartridge"
        with pytest.raises(InputError, match=said):
            PrinceOfPersia(rom, wrong, state)


@pytest.mark.parametrize("level, room, x, y", [*STARTS, (14, 23, 300, 32)])
def test_S6_2_01_S6_2_02_a_cartridge_that_halts_keeps_the_start_state(
    prince, tmp_path, level, room, x, y
):
    """Nothing but the decoding is at work here."""
    (tmp_path / "halting.nes").write_bytes(HALTING)
    start = start_state(prince, tmp_path / "start", level, room, x, y)
    prince.close()
    env = PrinceOfPersia(str(tmp_path / "halting.nes"), level, start)
    info = env.reset()[1]
    del info["blank"]
    wanted = {"level": level, "room": room, "x": x, "y": y, "hit_points": 3, "sword": 1}
    assert info == wanted
    assert env.unit() == (room, x // 32, y // 32)
    ram = memory(env)
    env.step(2)
    assert memory(env) == ram and ram[1221:1223] == b"99"
    env.close()
    with pytest.raises(InputError, match="halting.nes is not in play on level 1: "):
        PrinceOfPersia(str(tmp_path / "halting.nes"))


@pytest.mark.parametrize(
    "said, change",
    [
        ("--rom FILE", {"rom": None}),
        ("No such file", {"rom": "nowhere.nes"}),
        ("no complete NES", {"rom": b"GAME" + cartridge()[4:]}),
        ("no complete NES", {"rom": cartridge()[:-1]}),
        ("levels 1 to 14, not 0", {"level": 0}),
        ("levels 1 to 14, not 15", {"level": 15}),
        ("levels 1 to 14, not 1.0", {"level": 1.0}),
        ("No such file", {"state": "nowhere"}),
        ("gzip", {"state": b"no gzip"}),
        ("cannot read", {"state": gzip.compress(b"cut")[:9]}),
        ("cannot read", {"state": gzip.compress(b"x" * 99)[:10] + b"\xff" * 9}),
        ("no state of this emulator", {"state": gzip.compress(b"")}),
        ("no state of this emulator", {"state": gzip.compress(b"FCS rubbish")}),
        ("no state of this emulator", {"state": gzip.compress(bytes(13339))}),
        ("game.nes is not in play on level 2: {", {"level": 2}),
    ],
)
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


def test_without_a_start_state_the_cartridge_runs_for_a_second(prince):
    assert 50 <= memory(prince)[0] <= 60  # it counts its frames, but for the first few


def test_a_snapshot_damaged_or_of_another_game_is_refused(prince, tmp_path):
    foreign = [prince.snapshot()]
    prince.close()
    (tmp_path / "other.nes").write_bytes(cartridge(mark=1))
    env = PrinceOfPersia(str(tmp_path / "other.nes"))
    own = env.snapshot()
    changed = own[:-1] + bytes([own[-1] ^ 1])
    for bad in (*foreign, b"", b"rubbish", None, own[:-1], changed, own + b"x"):
        with pytest.raises(InputError, match="damaged, or of another game, level or start state"):
            env.restore(bad)
    env.restore(own)
    env.close()


def test_a_snapshot_of_another_level_is_refused(prince, rom, tmp_path):
    start = start_state(prince, tmp_path / "start", 2, 4, 123, 128)
    snapshot = prince.snapshot()
    prince.close()
    env = PrinceOfPersia(rom, 2, start)
    with pytest.raises(InputError, match="of another game, level or start state"):
        env.restore(snapshot)
    env.close()


def test_closed_emulators_say_so(prince, montezuma):
    for env in (prince, montezuma):
        snapshot = env.snapshot()
        env.close()
        env.close()
        for use in (env.unit, env.snapshot, env.reset):
            with pytest.raises(InputError, match="the emulator is closed"):
                use()
        with pytest.raises(InputError, match="the emulator is closed"):
            env.step(0)
        with pytest.raises(InputError, match="the emulator is closed"):
            env.restore(snapshot)


def test_actions_out_of_range_are_refused(prince, montezuma):
    for env, last in ((prince, 6), (montezuma, 17)):
        before = env.snapshot()
        for action in (-1, last + 1, 1.5, None, "A"):
            with pytest.raises(InputError, match=f"actions 0 to {last}, and not"):
                env.step(action)
        assert env.snapshot() == before
        for action in (np.int64(last), True, 1.0):
            env.step(action)


@pytest.mark.parametrize("library, name", [("stable_retro", "pop"), ("ale_py", "montezuma")])
def test_a_library_that_is_not_installed(tmp_path, monkeypatch, library, name):
    (tmp_path / "game.nes").write_bytes(cartridge())
    monkeypatch.setitem(sys.modules, library, None)
    options = {"rom": str(tmp_path / "game.nes")} if name == "pop" else {}
    with pytest.raises(InputError, match="pip install " + library.replace("_", "-")):
        make_env(name, **options)


def test_gymnasium_accepts_the_emulators(prince, montezuma):
    check_env(prince, skip_render_check=True)
    check_env(montezuma, skip_render_check=True)


def test_frames_of_the_emulators_are_the_callers_own(prince):
    frame, _ = prince.reset()
    frame[:] = 0
    assert prince.restore(prince.snapshot()).any()
    frame = prince.step(0)[0]
    frame[:] = 0
    assert prince.restore(prince.snapshot()).any()


# -------------------------------------------------------------- the run folder and the command line

SMALL_RUN = ["--steps=800", "--pretrain-steps=300", "--M=4", "--L=3", "--trajectory-steps=40",
             "--merge-every=2", "--beta=1"]  # fmt: skip
SCRIPT = rbexplore.__file__
FIGURES = {"coverage.png", "coverage_map.png", "graph.png", "centres.png", "route.gif"}


def start(*argv):
    """The command line in a process of its own."""
    return subprocess.Popen([sys.executable, SCRIPT, *map(str, argv)], text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE)  # fmt: skip


def rows_of(folder):
    """Lines of metrics.csv without the seconds, which are its last column."""
    lines = (folder / "metrics.csv").read_text().splitlines()
    return [line.rsplit(",", 1)[0] for line in lines]


def outcome(folder):
    """What a run came to: rows, trace, and every tensor of its state."""
    state = rbexplore.read_checkpoint(folder)["algorithm"]
    trace = folder / "trace.jsonl"
    return rows_of(folder), trace.read_bytes() if trace.exists() else b"", plain(state)


def plain(x):
    if torch.is_tensor(x):
        return x.numpy().tobytes()
    if isinstance(x, dict):
        return {key: plain(value) for key, value in x.items()}
    return [plain(value) for value in x] if isinstance(x, list | tuple) else x


def wait_until(condition):
    deadline = time.monotonic() + 100
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def wait_for_rows(process, folder, count):
    """Until the run has written so many iterations."""

    def written():
        assert process.poll() is None, process.communicate()
        return (folder / "metrics.csv").exists() and len(rows_of(folder)) > count

    wait_until(written)


def refused(capsys, argv, said, code=2):
    """The command ends with one line that says what is wrong."""
    assert main([str(word) for word in argv]) == code
    out, err = capsys.readouterr()
    assert re.search(said, err) and err.count("\n") == 1 and "Traceback" not in err
    return out


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run that was never interrupted."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main(["--env=maze", *SMALL_RUN, "--trace", f"--out={folder}"]) == 0
    return folder, said.getvalue()


def test_a_run_folder_holds_all_that_the_readme_says(finished):
    folder, out = finished
    names = {path.name for path in folder.iterdir()} - {".lock"}
    assert names == {"config.json", "metrics.csv", "checkpoint.pt", "trace.jsonl"} | FIGURES
    for name in FIGURES:
        content = (folder / name).read_bytes()
        assert content[:4] in (b"\x89PNG", b"GIF8") and len(content) > 3000
    heading, *rows = (folder / "metrics.csv").read_text().splitlines()
    assert heading.startswith(
        "iteration,phase,steps,units,coverage,theta_sim,clusters,added,merged"
    )
    assert rows[-1].split(",")[2] == "800"
    config = json.loads((folder / "config.json").read_text())
    assert config["config"] == asdict(
        replace(
            MAZE,
            steps=800,
            pretrain_steps=300,
            M=4,
            L=3,
            trajectory_steps=40,
            merge_every=2,
            beta=1.0,
        )
    )
    assert "187 tiles to cover; seed 0; 800 steps, 300 of them pretraining" in out
    assert re.search(
        r"800 steps, \d+ s: \d+ tiles of 187, [\d.]+ %; steps to 50 %: not reached", out
    )


def test_the_trace_alone_rebuilds_visits_and_arcs(finished):
    folder, _ = finished
    state = rbexplore.read_checkpoint(folder)["algorithm"]["graph"]
    visits, arcs = Counter(), Counter()
    restarted = False
    for line in (folder / "trace.jsonl").read_text().splitlines():
        event = json.loads(line)
        pretraining = rows_of(folder)[event["iteration"]].split(",")[1] == "pretrain"
        if not pretraining and not restarted:
            visits, arcs, restarted = Counter({0: 1}), Counter(), True
        for walked in event["explored"]:
            clusters = walked["clusters"]
            assert clusters[0] == walked["start"] and len(clusters) == len(walked["novelty"])
            visits.update(clusters)
            arcs.update(
                pair for pair in zip(clusters, clusters[1:], strict=False) if pair[0] != pair[1]
            )
        into = dict(event["merged"])
        for later, earlier in into.items():
            visits[earlier] += visits.pop(later)
        ends = Counter()
        for (a, b), count in arcs.items():
            a, b = into.get(a, a), into.get(b, b)
            ends[a, b] += count if a != b else 0
        arcs = +ends
    assert {v: count for v, (_, _, count) in state["clusters"].items()} == visits
    assert state["arcs"] == arcs and len(arcs) > 3


def test_a_killed_run_leaves_no_worker_and_no_lock_and_is_resumed_to_the_same_bytes(
    finished, tmp_path, capsys
):
    folder = tmp_path / "killed"
    with start(*SMALL_RUN, "--trace", "--workers=2", f"--out={folder}") as process:
        wait_for_rows(process, folder, 2)
        refused(capsys, ["--resume", folder], "in use by another process")
        children = pathlib.Path(f"/proc/{process.pid}/task/{process.pid}/children")
        workers = [pathlib.Path("/proc", pid) for pid in children.read_text().split()]
        process.kill()
    assert len(workers) >= 2 and len(rows_of(folder)) < len(rows_of(finished[0]))
    wait_until(lambda: not any(worker.exists() for worker in workers))
    assert main(["--resume", str(folder), "--workers=1", "--no-figures"]) == 0
    assert outcome(folder) == outcome(finished[0])


def test_a_run_killed_at_any_write_can_be_resumed_or_begun(finished, tmp_path, monkeypatch):
    write = rbexplore.write_atomically
    for k in range(5):  # config, state, rows, and these two of the first iteration
        folder = tmp_path / str(k)
        left = [k]

        def write_or_die(path, content, left=left):
            left[0] -= 1
            if left[0] < 0:
                path.with_name(path.name + ".new").write_bytes(content[:10])
                raise SystemExit  # as if killed
            write(path, content)

        monkeypatch.setattr(rbexplore, "write_atomically", write_or_die)
        argv = [*SMALL_RUN, "--steps=320", "--no-figures"]
        with pytest.raises(SystemExit):
            main([*argv, f"--out={folder}"])
        monkeypatch.setattr(rbexplore, "write_atomically", write)
        if k == 0:
            assert main([*argv, f"--out={folder}"]) == 0  # it had not begun
        else:
            assert main(["--resume", str(folder), "--no-figures"]) == 0
        assert rows_of(folder)[:3] == rows_of(finished[0])[:3]


def test_a_resumed_run_writes_what_is_missing_and_keeps_its_trace(finished, tmp_path):
    folder = tmp_path / "run"
    argv = [*SMALL_RUN, "--steps=300", "--pretrain-steps=250", "--no-figures", f"--out={folder}"]
    assert main([*argv, "--trace"]) == 0
    before = outcome(folder)
    (folder / "metrics.csv").unlink()
    with open(folder / "trace.jsonl", "a") as file:
        file.write("half a li")  # of an iteration that was not complete
    assert main(["--resume", str(folder), "--no-figures"]) == 0
    assert outcome(folder) == before and before[1]
    (folder / "checkpoint.pt").unlink()
    (folder / "metrics.csv").unlink()  # killed as soon as it had begun
    assert main(["--resume", str(folder), "--no-figures"]) == 0
    assert outcome(folder) == before


def test_ctrl_c_exits_with_130_draws_and_can_be_resumed(finished, tmp_path, capsys, monkeypatch):
    folder = tmp_path / "stopped"
    train_novelty = RbExplore.train_novelty

    def interrupted(algorithm, *arguments):
        if algorithm.iteration == 4:
            signal.raise_signal(signal.SIGINT)
        return train_novelty(algorithm, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(RbExplore, "train_novelty", interrupted)
        assert main([*SMALL_RUN, "--trace", f"--out={folder}"]) == 130
    assert f"go on with: python rbexplore.py --resume {folder}" in capsys.readouterr().out
    assert {path.name for path in folder.iterdir()} >= FIGURES
    assert len(rows_of(folder)) == 1 + 3
    assert main(["--resume", str(folder), "--no-figures"]) == 0
    assert outcome(folder) == outcome(finished[0])


def test_after_ctrl_c_the_same_run_goes_on_as_if_never_stopped(tmp_path, monkeypatch):
    config = replace(TINY, steps=560)
    whole, stopped = (Run(tmp_path / name, RbExplore(Maze, config)).begin() for name in "ab")
    whole.go()
    train_novelty = RbExplore.train_novelty

    def interrupted(algorithm, *arguments):
        result = train_novelty(algorithm, *arguments)
        if algorithm.iteration == 3:
            raise KeyboardInterrupt
        return result

    with monkeypatch.context() as patch:
        patch.setattr(RbExplore, "train_novelty", interrupted)
        assert not stopped.go() and stopped.algorithm.iteration == 2
    assert stopped.go()
    assert plain(stopped.algorithm.state_dict()) == plain(whole.algorithm.state_dict())


def test_a_folder_of_something_else_is_refused_and_untouched(finished, tmp_path, capsys):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "metrics.csv").write_text("my own")
    refused(capsys, [*SMALL_RUN, f"--out={folder}"], "not empty, and no run of ours")
    assert [path.name for path in folder.iterdir()] == ["metrics.csv"]
    before = outcome(finished[0])
    refused(capsys, [*SMALL_RUN, f"--out={finished[0]}"], "holds a run already: --resume it")
    assert outcome(finished[0]) == before


def test_a_finished_run_can_be_extended_and_not_cut(finished, tmp_path, capsys):
    folder = tmp_path / "longer"
    assert main([*SMALL_RUN, "--steps=600", "--no-figures", f"--out={folder}"]) == 0
    refused(capsys, ["--resume", folder, "--steps=500"], "extended, not cut")
    assert main(["--resume", str(folder), "--no-figures", "--steps=900"]) == 0
    assert rows_of(folder)[-1].split(",")[2] == "900"
    assert json.loads((folder / "config.json").read_text())["config"]["steps"] == 900


def test_stop_at_full_ends_a_run_that_has_covered_all(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(Maze, "reachable", lambda self: set(range(12)))
    folder = tmp_path / "full"
    argv = [*SMALL_RUN, "--no-figures", f"--out={folder}"]
    assert main([*argv, "--stop-at-full"]) == 0
    assert rows_of(folder)[-1].split(",")[4] == "1.0"
    assert int(rows_of(folder)[-1].split(",")[2]) < 800
    assert main(["--resume", str(folder), "--no-figures"]) == 0
    assert rows_of(folder)[-1].split(",")[2] == "800"


@pytest.mark.parametrize("what", ["nothing", "centre", "snapshot", "actions"])
def test_S3_2_03_verify_finds_a_cluster_that_is_not_reached(finished, tmp_path, capsys, what):
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("config.json", "metrics.csv"):
        (folder / name).write_bytes((finished[0] / name).read_bytes())
    state = torch.load(finished[0] / "checkpoint.pt", weights_only=True)
    graph = state["algorithm"]["graph"]
    v = max(graph["clusters"])
    centre, snapshot, count = graph["clusters"][v]
    parent, prefix, actions = graph["E_parent"][v]
    if what == "centre":
        graph["clusters"][v] = (centre + 1, snapshot, count)
    elif what == "snapshot":
        graph["clusters"][v] = (centre, graph["clusters"][0][1], count)
    elif what == "actions":
        graph["E_parent"][v] = (parent, prefix, bytes([0]))
    torch.save(state, folder / "checkpoint.pt")
    before = (folder / "checkpoint.pt").read_bytes()
    assert main(["--verify", str(folder)]) == (0 if what == "nothing" else 1)
    table = capsys.readouterr().out
    wrong = {"nothing": 0, "centre": 2, "snapshot": 2, "actions": 1}[what]
    assert table.count("DIFFERS") == wrong
    total = len(graph["clusters"])
    assert f"{total - bool(wrong)} of {total} clusters are reached exactly, both ways" in table
    assert (folder / "checkpoint.pt").read_bytes() == before


@pytest.mark.parametrize(("name", "workers"), [("pop", 2), ("montezuma", 1)])
def test_S3_2_03_a_run_in_an_emulator_is_exact_with_workers_and_after_its_cartridge_moved(
    rom, tmp_path, capsys, name, workers
):
    folder = tmp_path / "run"
    cartridge = [f"--rom={rom}"] if name == "pop" else []
    sizes = ["--M=2", "--L=2", "--trajectory-steps=20", "--frame-size=32", "--no-figures"]
    steps = ["--steps=110", "--pretrain-steps=40", "--theta-sim=0.9", f"--workers={workers}"]
    argv = [f"--env={name}", "--config=maze", *cartridge, *sizes, *steps, f"--out={folder}"]
    assert main(argv) == 0
    if name == "pop":
        os.rename(rom, tmp_path / "moved.nes")
        refused(capsys, ["--verify", folder], "cannot read the cartridge")
        cartridge = [f"--rom={tmp_path / 'moved.nes'}"]
    resume = ["--resume", str(folder), "--steps=130", "--workers=1", "--no-figures"]
    assert main([*resume, *cartridge]) == 0
    assert main(["--verify", str(folder), *cartridge]) == 0
    clusters = len(rbexplore.read_checkpoint(folder)["algorithm"]["graph"]["clusters"])
    assert f"{clusters} of {clusters} clusters" in capsys.readouterr().out and clusters > 2


@pytest.mark.parametrize(("damage", "said"), [
    ("checkpoint.pt cut", "checkpoint.pt cannot be loaded.*another --out"),
    ("checkpoint.pt gone", "checkpoint.pt cannot be loaded"),
    ("config.json cut", "config.json cannot be used"),
    ("config.json gone", "no run in"),
    ("trace.jsonl cut", "trace.jsonl is missing or cut short"),
    ("config.json changed", "another configuration than config.json"),
    ("checkpoint.pt pickled", "checkpoint.pt cannot be loaded"),
])  # fmt: skip
def test_a_damaged_run_is_one_line_and_is_left_as_it_was(finished, tmp_path, capsys, damage, said):
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("config.json", "metrics.csv", "checkpoint.pt", "trace.jsonl"):
        (folder / name).write_bytes((finished[0] / name).read_bytes())
    name, how = damage.split()
    path = folder / name
    if how == "gone":
        path.unlink()
    elif how == "cut":
        path.write_bytes(path.read_bytes()[:60])
    elif how == "changed":
        path.write_text(path.read_text().replace('"beta": 1.0', '"beta": 2.0'))
    else:
        torch.save({"settings": pathlib.PurePosixPath("x")}, path)
    before = (folder / "metrics.csv").read_bytes()
    refused(capsys, ["--resume", folder], said)
    assert (folder / "metrics.csv").read_bytes() == before


@pytest.mark.parametrize(("argv", "said"), [
    (["--env=moon"], "unknown environment 'moon'"),
    (["--level=9"], "unknown maze level 9"),
    (["--M=0"], "M is 0: give a number from 1"),
    (["--M=x"], "argument --M: invalid int value: 'x'; --help"),
    (["--Mm=3"], "unrecognized arguments: --Mm=3"),
    (["--method=best"], "invalid choice: 'best'"),
    (["--n=11"], "n is 11 and N is 10"),
    (["--env=pop"], "needs your own cartridge image: --rom"),
    (["--env=montezuma", "--level=2"], "montezuma has no option 'level'"),
    (["--device=nowhere"], "device nowhere cannot be used"),
    (["--threads=0"], "threads is 0: give a number from 1"),
    (["--workers=0"], "workers is 0: give a number from 1"),
    (["--seeds=2"], "seeds is 2: give 1 or more, with --experiment"),
    (["--experiment=methods", "--method=rnd"], "--experiment chooses the methods"),
    (["--resume=x", "--verify=x"], "exclude each other"),
    (["--resume=nowhere"], "no run in nowhere"),
    (["--out="], "--out is empty"),
    (["--seed=-1"], "seed is -1"),
])  # fmt: skip
def test_bad_input_is_one_line_and_nothing_is_made(tmp_path, capsys, monkeypatch, argv, said):
    monkeypatch.chdir(tmp_path)
    refused(capsys, argv, said)
    assert list(tmp_path.iterdir()) == []


def test_a_run_of_another_version_goes_on_with_a_note(finished, tmp_path, capsys):
    for name in ("config.json", "metrics.csv", "checkpoint.pt", "trace.jsonl"):
        (tmp_path / name).write_bytes((finished[0] / name).read_bytes())
    config = tmp_path / "config.json"
    config.write_text(config.read_text().replace(np.__version__, "0.0"))
    assert main(["--resume", str(tmp_path), "--no-figures"]) == 0
    assert "was begun with" in capsys.readouterr().out


@pytest.mark.parametrize("option", ["--level=1", "--M=4", "--method=rnd", "--out=x", "--threads=2"])
def test_a_run_that_was_begun_keeps_its_options(finished, capsys, option):
    refused(capsys, ["--resume", finished[0], option], f"{option.split('=')[0]} does not go with")


def test_a_full_disk_is_one_line_and_leaves_the_old_file_and_no_other(
    tmp_path, monkeypatch, capsys
):
    path = tmp_path / "file"
    rbexplore.write_atomically(path, b"old")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(rbexplore.os, "fsync", full)
    with pytest.raises(OSError):
        rbexplore.write_atomically(path, b"new")
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
    refused(capsys, [*SMALL_RUN, f"--out={tmp_path / 'run'}"], "No space left on device; make room")


def test_figures_do_not_depend_on_the_users_settings(finished, tmp_path):
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nfont.family: no such font\n")
    settings = {"MPLBACKEND": "no such backend", "MATPLOTLIBRC": str(tmp_path)}
    argv = [sys.executable, SCRIPT, "--resume", finished[0]]
    done = subprocess.run(argv, env=os.environ | settings, capture_output=True, text=True)
    assert done.returncode == 0 and "could not be drawn" not in done.stdout, (
        done.stdout + done.stderr
    )
    assert "graph.png" in done.stdout


def test_a_figure_that_cannot_be_drawn_does_not_hide_the_summary(tmp_path, monkeypatch, capsys):
    def broken(graph):
        raise ZeroDivisionError("no picture")

    monkeypatch.setattr(rbexplore, "centres_figure", broken)
    assert main([*SMALL_RUN, "--steps=400", f"--out={tmp_path / 'run'}"]) == 0
    out = capsys.readouterr().out
    assert (
        "400 steps" in out and "figures could not be drawn (ZeroDivisionError: no picture)" in out
    )


@pytest.mark.parametrize("unit", [
    lambda place: place[0] * 7 + place[1],
    lambda place: ("cave", *place),
    lambda place: ("cave", place[0]) if place[0] > 2 else place[1],
    lambda place: "everywhere",
    lambda place: None,
])  # fmt: skip
def test_figures_of_a_users_own_units(tmp_path, unit):
    class Own(Grid):
        observation_space = Box(0, 255, (16, 16, 2), np.uint8)

        def unit(self):
            return unit(self.place)

    config = replace(TINY, steps=400, pretrain_steps=100)
    run = Run(tmp_path / "run", RbExplore(Own, config)).begin()
    run.go()
    assert "could not be drawn" not in rbexplore.draw(run)
    for path in (tmp_path / "run").glob("*.png"):
        assert path.stat().st_size < 300_000
    places = {u for u in run.algorithm.discovered if rbexplore.room_panels([u])}
    assert (tmp_path / "run" / "coverage_map.png").exists() == bool(places)


def test_a_run_folder_from_python_is_resumed(tmp_path):
    config = replace(TINY, steps=900)
    for steps in (500, 900):
        algorithm = RbExplore(Grid, replace(config, steps=steps))
        run = Run(tmp_path / "run", algorithm)
        run = run.begin() if steps == 500 else run.resume()
        run.go()
        run.lock.release()
    assert algorithm.steps == 900 and verify(algorithm)[1]


def test_room_panels_keep_rooms_apart_and_units_in_their_places():
    boxes = rbexplore.room_panels([(0, 1, 1), (0, 2, 1), (1, 1, 1), ("x", 3, 2)])
    assert len(set(boxes.values())) == 4
    assert boxes[0, 2, 1][0] - boxes[0, 1, 1][0] == 1 and boxes[0, 2, 1][1] == boxes[0, 1, 1][1]
    assert rbexplore.room_panels([(5,), (7,)]) == {(5,): (0, 0, 1, 1), (7,): (2, 0, 1, 1)}
    assert rbexplore.room_panels([("a", "b"), ("c",), ()]) == {}


def test_S6_2_05_the_band_is_from_the_least_to_the_most_and_the_line_the_mean():
    runs = [{(k,): 1000 * k for k in range(n)} for n in (20, 40, 90)]
    figure = rbexplore.curves_figure({"rnd": runs}, Maze(), replace(MAZE, pretrain_steps=0))
    (panel,) = figure.axes
    line = panel.lines[0].get_ydata()
    assert line[-1] == pytest.approx(100 * 50 / 187)
    band = panel.collections[0].get_paths()[0].vertices
    at_end = band[band[:, 0] == band[:, 0].max()][:, 1]
    assert at_end.min() == pytest.approx(100 * 20 / 187) and at_end.max() == pytest.approx(
        100 * 90 / 187
    )


def test_S6_2_06_the_map_is_that_of_the_best_run_by_final_coverage():
    runs = [{1: 5}, {1: 9, 2: 90, 3: 91}, {1: 1, 2: 2}]
    assert rbexplore.best(runs) == runs[1]


def test_S6_2_06_a_report_has_the_curve_of_each_run_and_the_map_of_each_methods_best(
    tmp_path, monkeypatch
):
    maps = []
    draw_maps = rbexplore.maps_figure
    monkeypatch.setattr(rbexplore, "maps_figure", lambda *x: maps.append(x[1]) or draw_maps(*x))
    units = sorted(Maze().reachable())
    few = {unit: 10 * k for k, unit in enumerate(units[:5])}
    many = {unit: 10 * k for k, unit in enumerate(units[:50])}
    found = {"rnd": {0: few, 1: many}, "icm": {0: few}}
    rbexplore.report(options("--experiment=methods", f"--out={tmp_path}"), Maze(), MAZE, found)
    assert list(maps[0].values()) == [many, few] and (tmp_path / "maps.png").exists()
    rows = (tmp_path / "curves.csv").read_text().splitlines()
    ends = [row for row in rows if ",100000," in row]
    assert ends == ["rnd,0,100000,2.6738", "rnd,1,100000,26.7380", "icm,0,100000,2.6738"]


def test_S6_2_06_a_map_colours_tiles_by_their_first_visit_and_crosses_out_the_rest():
    level = rbexplore.Level(Maze(), {})
    first, second = list(level.boxes)[:2]
    figure = rbexplore.maps_figure(level, {"run": {first: 5, second: 90}}, 100)
    (tiles,) = figure.axes[0].collections
    assert tiles.get_array().tolist() == [5, 90] and tiles.get_clim() == (0, 100)
    assert len(figure.axes[0].lines) == 187 - 2


def test_S5_03_a_curve_counts_the_units_of_its_step():
    curve = rbexplore.coverage_curve(
        {"a": 0, "b": 10, "c": 20}, np.array([0, 9, 10, 19, 20, 30]), 4
    )
    assert curve.tolist() == [25, 25, 50, 50, 75, 75]
    assert rbexplore.steps_to({k: 10 * k for k in range(9)}, 10) == {50: 40, 90: 80, 100: None}
    assert rbexplore.steps_to({k: 10 * k for k in range(9)}, 9) == {50: 40, 90: 80, 100: 80}


def options(*argv):
    return rbexplore.parser().parse_args(list(argv))


def test_the_environment_gets_its_options():
    settings = rbexplore.settings_of(options("--frame-size=48", "--level=2"))
    assert rbexplore.options_of(settings) == {"level": 2, "frame_size": 48}
    settings = rbexplore.settings_of(options("--env=pop", "--rom=/a.nes", "--state=/b"))
    assert rbexplore.options_of(settings) == {"rom": "/a.nes", "state": "/b", "frame_size": 96}


@pytest.mark.parametrize(
    ("name", "field"), [("ablation", {"merge", "prefix"}), ("theta-merge", {"theta_merge"})]
)
def test_S6_3_01_S6_3_02_S6_3_03_variants_differ_in_their_field_alone(name, field):
    runs = rbexplore.runs_of(options("--experiment", name, "--seeds=2", "--seed=5", "--M=7"))
    assert [seed for _, seed in runs] == [5, 5, 5, 6, 6, 6]
    differing, values = set(), set()
    for (_, seed), command in runs.items():
        config = rbexplore.settings_of(options(*command))["config"]
        assert config["seed"] == seed and config["M"] == 7
        changed = {k for k, v in config.items() if v != getattr(replace(MAZE, M=7, seed=seed), k)}
        assert len(changed) <= 1
        differing |= changed
        values.add((config["merge"], config["prefix"], config["theta_merge"]))
    assert differing == field
    ablations = {(True, True, 0.5), (False, True, 0.5), (True, False, 0.5)}
    thetas = {(True, True, theta) for theta in (0.25, 0.5, 0.75)}
    assert values == (ablations if name == "ablation" else thetas)


def test_S6_2_03_an_experiment_does_all_methods_three_times_unless_told():
    runs = rbexplore.runs_of(options("--experiment=methods", "--level=3"))
    assert len(runs) == 15 and {variant for variant, _ in runs} == set(METHODS)
    for (method, seed), command in runs.items():
        settings = rbexplore.settings_of(options(*command))
        assert settings["method"] == method and settings["level"] == 3
        assert settings["config"]["seed"] == seed
        without_R = settings["config"]["pretrain_steps"] == settings["config"]["L"] == 0
        assert without_R == (method != "rbexplore")


def test_an_experiment_does_the_rest_names_failures_and_goes_on(tmp_path, capsys, monkeypatch):
    variants = {"rbexplore": [], "no-merge": ["--no-merge"]}
    monkeypatch.setitem(rbexplore.EXPERIMENTS, "ablation", variants)
    argv = ["--experiment=ablation", "--seeds=1", *SMALL_RUN, "--steps=320", f"--out={tmp_path}"]
    broken = tmp_path / "no-merge-0"
    broken.mkdir()
    (broken / "mine").write_text("not a run")
    out = refused(
        capsys, argv, "failed, as their logs tell: .*no-merge-0 .exit code 2.; the same command"
    )
    assert "rbexplore         seed 0:" in out and "curves.png" in out
    assert f"{tmp_path}/rbexplore-0: done" in out and f"{tmp_path}/no-merge-0: failed" in out
    assert "not empty" in (tmp_path / "no-merge-0.log").read_text()
    (broken / "mine").unlink()
    first = outcome(tmp_path / "rbexplore-0")
    assert main(argv) == 0
    assert outcome(tmp_path / "rbexplore-0") == first
    lines = (tmp_path / "curves.csv").read_text().splitlines()
    assert lines[0] == "variant,seed,steps,coverage" and len(lines) == 1 + 2 * 201
    for change in ("--M=5", "--steps=330"):
        refused(capsys, [*argv, change], "holds a run of another configuration")


def test_an_experiments_runs_end_with_it(tmp_path):
    with start("--experiment=methods", "--seeds=1", f"--out={tmp_path}") as process:
        folder = tmp_path / "rbexplore-0"
        wait_for_rows(process, folder, 1)
        process.terminate()
    rbexplore.filelock.FileLock(folder / ".lock").acquire(timeout=20)


def test_as_many_runs_as_cores_may_be_used(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 5, 6}, raising=False)
    monkeypatch.setattr(pathlib.Path, "read_text", lambda path: "max 100000")
    assert rbexplore.cores() == 3
    monkeypatch.setattr(pathlib.Path, "read_text", lambda path: "200000 100000")
    assert rbexplore.cores() == 2
    monkeypatch.setattr(pathlib.Path, "read_text", lambda path: "50000 100000")
    assert rbexplore.cores() == 1


def test_a_warning_tells_where_R_finds_everything_new_or_known(tmp_path):
    run = Run(tmp_path, RbExplore(Grid, TINY))
    row = {"iteration": 9, "phase": "explore", "steps": 500, "seconds": 1.0, "units": 3}
    for rate, said in (("r_tpr", "new"), ("r_tnr", "known")):
        run.rows = [row | {rate: 0.0}]
        assert f"before its training R found nearly all {said}" in run.line()
        run.rows = [row | {rate: 0.1, "phase": "pretrain"}]
        assert "warning" not in run.line()


def test_the_metrics_are_what_the_iteration_did(maze_run):
    clusters = 1
    phase = "pretrain"
    for i in maze_run[1]:
        m = i.metrics
        if m["phase"] != phase:  # G is reset
            clusters = 1
        phase = m["phase"]
        clusters += m["added"] - len(i.merged)
        assert (m["clusters"], m["merged"]) == (clusters, len(i.merged))
        assert m["additional"] == len(i.additional)
        novelty = np.concatenate([t.novelty for t in i.trajectories])
        assert m["novel_share"] == np.mean(novelty > 1.0)


def test_memory_counts_frames_and_snapshots_of_the_iteration_and_of_G():
    a = restarted(Maze)
    i = a.iterate()
    taus = i.trajectories + i.additional
    states = sum(len(t.frames) for t in taus) + sum(
        len(p.prefix) for p in a.graph.E_parent.values()
    )
    snapshots = sum(len(t.snapshots) for t in taus) + len(a.graph.clusters)
    assert rbexplore.megabytes(a, i) * 2**20 == states * 1024 + snapshots * 6


# --------------------------------------------------------------------------------------- the README

README = (HERE / "README.md").read_text()


def test_every_row_of_the_ledger_has_a_function_that_exists_and_a_test():
    rows = re.findall(r"^\| (S[\d.]+-\d+) \|.*\| `([\w.]+)` \|$", README, re.M)
    assert len(rows) == 76 and len({row for row, _ in rows}) == 76
    tests = " ".join(name for name in globals() if name.startswith("test_")) + " "
    for row, function in rows:
        assert re.sub(r"[.-]", "_", row) + "_" in tests, row
        owner, _, name = function.rpartition(".")
        module = rbexplore if hasattr(rbexplore, function.split(".")[0]) else envs
        owner = getattr(module, owner) if owner else module
        known = hasattr(owner, name) or name in getattr(owner, "__dataclass_fields__", {})
        assert known, function


def test_the_examples_of_the_readme_run(tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", README, re.S)
    assert blocks
    for block in blocks:
        script = tmp_path / "example.py"
        script.write_text(block.replace("10_000", "600").replace("1_000", "300"))
        env = os.environ | {"PYTHONPATH": str(HERE)}
        done = subprocess.run(
            [sys.executable, script], cwd=tmp_path, env=env, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
