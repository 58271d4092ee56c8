"""RbExplore, the algorithm of "Long-Term Exploration in Persistent MDPs" (Ugadiarov, Skrynnik,
Panov, 2021).

The agent explores without rewards. It groups the states it has visited into clusters, using a
learned similarity R, stores a snapshot with each cluster, and rolls the environment back to rarely
visited clusters to explore from there. One iteration has five steps (section 4), which are the five
calls in `RbExplore.iterate`:

    1  explore            sample M clusters of G, roll back to each, explore with pi_explore
    2  make_pairs         explore from at most L novel states; label pairs of states
    3  train_similarity   train R on the pairs of this iteration
    4  update_graph       add the states of step 1 to G; every 15th iteration, merge clusters
    5  train_novelty      train the novelty module (RND) on the states of step 1

    symbol              here                         meaning
    s, snap             State.frame, .snapshot       a state: its observation, and the bytes that
                                                     restore it in the simulator
    tau                 Trajectory                   successive states s_1 ... s_T
    pi_explore          in walk                      uniform over the actions
    R(s_1, s_2)         SimilarityModel              in [0, 1]: are the two states close in time?
    n, N                Config.n, Config.N           similar: fewer than n steps apart; dissimilar:
                                                     more than N
    G = (V, E)          Graph.clusters, Graph.arcs   clusters, and directed arcs between them
    v = (s, snap)       Cluster                      its centre s, the snapshot, and the number of
                                                     its visits; v, u in the code: cluster numbers
    E_parent            Graph.E_parent               from a cluster to its parent, with the states
                                                     on the way (the prefix)
    theta_sim           Config.theta_sim             a state joins a cluster if R > theta_sim
    theta_merge         Config.theta_merge           two clusters merge if R > theta_merge
    B, beta, L          B, Config.beta, Config.L     the novel states, whose intrinsic reward is
                                                     above beta; at most L of them are sampled
    M                   Config.M                     exploration trajectories per iteration
    pi^p                Graph.actions_to             the actions that lead from s_init to a cluster
    %Cov                Coverage                     the share of the level's units (for example
                                                     tiles) visited; the class also counts steps

A step of the environment is one action, which an emulator repeats for `frameskip` frames (R1).
"S4.2-03" is a statement of the paper; `pytest -k S4_2_03` runs its tests. "R13" is our reading of
a passage where the paper is silent or unclear. The README lists both.
"""

import argparse
import contextlib
import csv
import errno
import functools
import io
import json
import math
import multiprocessing
import os
import pathlib
import shlex
import signal
import sys
import threading
import time
import warnings
import zipfile
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, fields, replace
from typing import NamedTuple

import filelock
import numpy as np
import torch
from gymnasium.wrappers.utils import RunningMeanStd
from torch import nn
from torch.nn import functional as F

from envs import (
    InputError,
    PersistentEnv,
    Workers,
    make_checked,
    make_env,
    unit_key,
)

# ---------------------------------- configuration (6.1; S6.1-05, S6.1-08, S6.1-09, S6.1-12)


def option(default, meaning, low=-math.inf, high=math.inf):
    """A field of Config: its default, its line in --help, and its range."""
    return field(default=default, metadata={"meaning": meaning, "low": low, "high": high})


@dataclass(frozen=True)
class Config:
    """A configuration. The defaults are the paper's, the same for every level; where it states no
    value, they are ours.

    Raises InputError for values that cannot work."""

    seed: int = option(0, "seed of every random generator", 0, 2**63)
    steps: int = option(15_000_000, "agent steps in total, pretraining included (6.2, R2)", 1)
    pretrain_steps: int = option(500_000, "steps of pretraining, after which G is reset (6.1)", 0)
    M: int = option(30, "exploration trajectories per iteration (6.1)", 1)
    trajectory_steps: int = option(1500, "longest exploration trajectory, steps (6.1, R1)", 1)
    L: int = option(1000, "maximum number of novel states to explore from (6.1); 0: no RND", 0)
    additional_steps: int = option(50, "longest additional trajectory, steps; choose 2N (R3)", 1)
    beta: float = option(2.5, "a state is novel above this intrinsic reward (6.1, R4)")
    n: int = option(5, "similar: states fewer than n steps apart (6.1)", 1)
    N: int = option(25, "dissimilar: states more than N steps apart (6.1)", 1)
    prefix: bool = option(True, "negative pairs with the full prefix (4.2; off: ablation of 6.3)")
    epochs: int = option(4, "training passes over the pairs of an iteration (R19)", 1)
    theta_sim: float = option(0.5, "a state joins a cluster if R is above this (6.1)", 0, 1)
    theta_merge: float = option(0.5, "two clusters merge if R is above this (6.1)", 0, 1)
    merge: bool = option(True, "merge clusters (4.2; off: ablation of 6.3)")
    merge_every: int = option(15, "iterations between merges (6.1, R28)", 1)
    frameskip: int = option(4, "frames of the emulator per step (6.1)", 1, 1000)
    frame_size: int = option(96, "height and width of an observation, pixels (5)", 32, 1024)
    small_networks: bool = option(
        False, "small encoders, instead of ResNet-18 in R (6.1) and Burda et al.'s in RND"
    )
    embedding: int = option(512, "size of an embedding (6.1), and of RND's output", 1)
    head_width: int = option(512, "width of R's fully connected layers (not in the paper)", 1)
    learning_rate: float = option(1e-4, "learning rate of Adam (R18)", 0)
    r_batch: int = option(256, "pairs per batch of R (R18)", 2)
    rnd_batch: int = option(256, "states per batch of RND (R18)", 1)
    rollout_steps: int = option(16_384, "RND and ICM agents: steps per iteration (6.2, R27)", 1)
    episode_steps: int = option(4_500, "RND and ICM agents: longest episode, steps (R27)", 1)

    def __post_init__(self):
        for f in fields(self):
            check_field(f, getattr(self, f.name))
        if self.n > self.N:
            raise InputError(
                f"n is {self.n} and N is {self.N}: similar states must be closer than dissimilar "
                "ones; choose n <= N"
            )
        for name in ("trajectory_steps", "additional_steps"):
            if getattr(self, name) <= self.N:
                raise InputError(
                    f"{name} is {getattr(self, name)}: no two states would be more than "
                    f"N = {self.N} steps apart; choose at least {self.N + 1}"
                )
        if self.pretrain_steps >= self.steps:
            raise InputError(
                f"pretrain_steps is {self.pretrain_steps} of {self.steps} steps: nothing is left "
                "for exploration; choose more steps or less pretraining"
            )


def check_field(f, value):
    """Raise InputError unless the value has the type and range of the field."""
    low = f.metadata["low"]
    high = f.metadata["high"]
    whole_number_for_float = f.type is float and type(value) is int  # but not a bool
    if type(value) is not f.type and not whole_number_for_float:
        raise InputError(f"{f.name} is {value!r}: it must be of type {f.type.__name__}")
    if not low <= value <= high:
        raise InputError(f"{f.name} is {value}: choose a number from {low:,} to {high:,}")


# For small images, a small budget and a CPU. Fields not listed keep their defaults. n and N are
# smaller, because a step of the maze crosses a whole tile (R30).
MAZE = Config(
    steps=100_000,
    pretrain_steps=4_000,
    M=10,
    trajectory_steps=150,
    L=10,
    additional_steps=20,
    n=2,
    N=10,
    frameskip=1,
    frame_size=32,
    small_networks=True,
    embedding=64,
    head_width=128,
    learning_rate=1e-3,
    r_batch=128,
    rnd_batch=64,
    rollout_steps=1_024,
    episode_steps=150,
)
# For a game on a CPU.
SMALL = replace(
    MAZE,
    steps=1_000_000,
    pretrain_steps=10_000,
    trajectory_steps=300,
    L=20,
    additional_steps=50,
    n=5,
    N=25,
    frameskip=4,
    frame_size=64,
    episode_steps=4_500,
)
CONFIGS = {"paper": Config(), "maze": MAZE, "small": SMALL}

# --------------------------------------------------------------- the algorithm (4; S4-01 ... S4-07)


@dataclass
class Iteration:
    """The result of one iteration. starts, trajectories, clusters and, unless L is 0, novelty have
    one entry per exploration trajectory, in the same order. The compared methods fill in metrics
    only."""

    metrics: dict
    starts: list[int] = field(default_factory=list)  # step 1: the sampled clusters
    trajectories: list["Trajectory"] = field(default_factory=list)  # step 1
    novelty: list[np.ndarray] = field(default_factory=list)  # step 2: intrinsic rewards, (T,)
    additional: list["Trajectory"] = field(default_factory=list)  # step 2
    pairs: list[tuple] = field(default_factory=list)  # step 2: labelled pairs (s_1, s_2, y)
    clusters: list[list[int]] = field(default_factory=list)  # step 4: of each state, before merging
    merged: dict[int, int] = field(default_factory=dict)  # step 4: {absorbed: survivor}


class RbExplore:
    """The algorithm of section 4.

    env_fn: makes the persistent environment (see envs.PersistentEnv).
    device: where the networks are.
    executor: a pool of processes that walks the trajectories (see envs.Workers). The result is the
    same as without it; env_fn must be picklable.

    Raises InputError for an environment that breaks the contract of PersistentEnv, and for a loss
    that is not finite."""

    method = "rbexplore"

    def __init__(
        self,
        env_fn: Callable[[], PersistentEnv],
        config: Config | None = None,
        device: str = "cpu",
        executor: Executor | None = None,
    ):
        self.config = config or Config()
        self.env = make_checked(env_fn, self.config.seed)
        frame, _ = self.env.reset(seed=self.config.seed)
        self.initial_state = State(np.array(frame), self.env.snapshot())
        self.initial_unit = unit_key(self.env.unit())
        # The layers' default weights come from PyTorch's global generator; fork_rng restores that
        # generator for the caller, and `initialise` replaces the weights.
        with torch.random.fork_rng(devices=[]):
            self.similarity = SimilarityModel(self.config, frame.shape, device)
            self.rnd = RND(self.config, frame.shape, device)
        self.graph = Graph(self.initial_state)
        full_coverage = getattr(self.env, "full_coverage", None)
        self.coverage = Coverage(full_coverage, self.config.steps)
        self.pretraining = True
        self.iteration = 0
        self.workers = None
        if executor is not None:
            self.workers = Workers(executor, env_fn, self.config.seed)
            self.workers.check(walk, self.initial_state, 0, 0)  # a walk of no steps

    def iterate(self) -> Iteration:
        """Run one iteration: the five steps, in the paper's order."""
        if self.pretraining and self.coverage.steps >= self.config.pretrain_steps:
            self.restart()
        self.iteration += 1
        theta_sim = self.theta_sim_now()  # from the steps before this iteration (R21)
        clusters_before = len(self.graph.clusters)
        # Each iteration has its own generators, so that a checkpoint need not store any. Each step
        # that draws (all but step 4) has one of its own, so that its draws do not shift those of
        # another step.
        rng = np.random.default_rng([self.config.seed, self.iteration])
        rng_1, rng_2, rng_3, rng_5 = rng.spawn(4)

        starts, trajectories = self.explore(rng_1)
        pairs, additional, novelty = self.make_pairs(starts, trajectories, rng_2)
        r_metrics = self.train_similarity(pairs, rng_3)
        clusters, merged = self.update_graph(starts, trajectories, theta_sim)
        rnd_loss = self.train_novelty(trajectories, rng_5)

        metrics = {  # the columns of metrics.csv
            "iteration": self.iteration,
            "phase": "pretrain" if self.pretraining else "explore",
            **self.coverage.metrics(),
            "theta_sim": theta_sim,
            "clusters": len(self.graph.clusters),
            "added": len(self.graph.clusters) + len(merged) - clusters_before,
            "merged": len(merged),
            "novel_share": share_above(self.config.beta, novelty),
            "additional": len(additional),
            **r_metrics,
            "rnd_loss": rnd_loss,
        }
        return Iteration(
            metrics=metrics,
            starts=starts,
            trajectories=trajectories,
            novelty=novelty,
            additional=additional,
            pairs=pairs,
            clusters=clusters,
            merged=merged,
        )

    def run(self) -> "RbExplore":
        """Iterate until the steps of the budget are spent. Returns the algorithm itself."""
        while self.coverage.steps < self.config.steps:
            self.iterate()
        return self

    def restart(self):
        """End pretraining (6.1; S6.1-15): reset G to the initial state and start counting coverage
        (R31). R, RND with its statistics, the optimisers and the counts of steps and iterations are
        kept (R2, R6, R31)."""
        self.pretraining = False
        self.graph = Graph(self.initial_state)
        self.coverage.visit(self.initial_unit)

    def theta_sim_now(self):
        """theta_sim. During pretraining it rises linearly from 0 with the steps taken (6.1, R21;
        S6.1-13)."""
        if not self.pretraining:
            return self.config.theta_sim
        return self.config.theta_sim * self.coverage.steps / self.config.pretrain_steps

    def explore(self, rng):
        """Step 1: sample M clusters, roll back to each, explore (S4-01, S6.1-06, S6.1-11). Returns
        the numbers of the sampled clusters, and a trajectory from each."""
        numbers, probabilities = self.graph.sampling_distribution()
        # With replacement, because G starts with a single cluster (R12).
        starts = rng.choice(numbers, size=self.config.M, p=probabilities).tolist()
        centres = [self.graph.clusters[v] for v in starts]
        max_steps = self.config.trajectory_steps
        trajectories = self.collect(centres, max_steps, rng, covers=not self.pretraining)
        return starts, trajectories

    def collect(self, states, max_steps, rng, covers):
        """Roll back to each state and walk at most `max_steps` steps. Every step counts (R2);
        `covers` says whether the units visited count as coverage (R25). Returns the
        trajectories."""
        seeds = rng.integers(2**63, size=len(states)).tolist()
        trajectories = list(self.walks(states, seeds, max_steps))
        for tau in trajectories:
            for unit in tau.units:
                self.coverage.count(unit, covers)
        return trajectories

    def walks(self, states, seeds, max_steps):
        """A walk from each state, in this process or by the workers. Yields trajectories."""
        limits = [max_steps] * len(states)
        if self.workers is None:
            return map(functools.partial(walk, self.env), states, seeds, limits)
        return self.workers.map(walk, states, seeds, limits)

    def make_pairs(self, starts, trajectories, rng):
        """Step 2: label pairs of states within each exploration and each additional trajectory
        (S4-02). Also pair the states of each exploration trajectory with states of its full prefix,
        which leads from s_init to the start cluster (S4.1-09, R29). Returns the pairs, the
        additional trajectories, and the intrinsic rewards of the exploration trajectories."""
        additional, novelty = self.explore_from_novel_states(trajectories, rng)
        pairs = []
        for tau in trajectories + additional:
            pairs += pairs_within(tau.frames, self.config.n, self.config.N, rng)
        # A separate loop, so that disabling prefixes leaves the random draws of the other pairs
        # unchanged (S6.3-02).
        if self.config.prefix:
            for start, tau in zip(starts, trajectories, strict=True):
                full_prefix = self.graph.full_prefix(start)
                pairs += pairs_with_prefix(tau.frames, full_prefix, self.config.N, rng)
        return pairs, additional, novelty

    def explore_from_novel_states(self, trajectories, rng):
        """Put all novel states into B, sample at most L of them, and explore from those (S4.2-15
        ... S4.2-18). B holds the novel states of this iteration only (R5). Returns the additional
        trajectories, and the intrinsic rewards of the exploration trajectories."""
        if self.config.L == 0:
            return [], []
        novelty = [self.rnd.reward(tau.frames) for tau in trajectories]
        B = []
        for tau, reward in zip(trajectories, novelty, strict=True):
            for i in np.flatnonzero(reward > self.config.beta):
                B.append(State(tau.frames[i], tau.snapshots[i]))
        sample = [B[k] for k in rng.permutation(len(B))[: self.config.L]]
        additional = self.collect(sample, self.config.additional_steps, rng, covers=False)
        return additional, novelty

    def train_similarity(self, pairs, rng):
        """Step 3: train R on the pairs of this iteration only (S4-03, S4-06). Returns metrics: R's
        true positive and true negative rates before the training, and its loss."""
        # The rates have their own generator, so that they do not shift the draws of R's training.
        true_positive_rate, true_negative_rate = self.similarity.rates(pairs, rng.spawn(1)[0])
        loss = self.similarity.fit(pairs, rng)
        return {"r_tpr": true_positive_rate, "r_tnr": true_negative_rate, "r_loss": loss}

    def update_graph(self, starts, trajectories, theta_sim):
        """Step 4: add the states of the exploration trajectories to G; every merge_every-th (15th)
        iteration, merge (S4-04, S6.1-10, S6.3-01). Returns the cluster of each state of each
        trajectory, and {absorbed: survivor}."""
        self.graph.embed_centres(self.similarity)  # by the R just trained (S4-03)
        clusters = []
        for start, tau in zip(starts, trajectories, strict=True):
            clusters.append(self.graph.add_trajectory(start, tau, self.similarity, theta_sim))
        merged = {}
        if self.config.merge and self.iteration % self.config.merge_every == 0:
            merged = self.graph.merge(self.similarity, self.config.theta_merge)
        return clusters, merged

    def train_novelty(self, trajectories, rng):
        """Step 5: train RND on the states of the exploration trajectories only (S4-05). Returns its
        loss; None if L is 0, because then nothing uses novelty."""
        if self.config.L == 0:
            return None
        return self.rnd.fit([tau.frames for tau in trajectories], rng)

    def state_dict(self) -> dict:
        """What load_state_dict needs to continue, as plain data and tensors."""
        return {
            "pretraining": self.pretraining,
            "iteration": self.iteration,
            "coverage": self.coverage.state_dict(),
            "similarity": self.similarity.state_dict(),
            "rnd": self.rnd.state_dict(),
            "graph": self.graph.state_dict(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Continue from the state of an algorithm with the same configuration and environment."""
        self.pretraining = state["pretraining"]
        self.iteration = state["iteration"]
        self.coverage.load_state_dict(state["coverage"])
        self.similarity.load_state_dict(state["similarity"])
        self.rnd.load_state_dict(state["rnd"])
        self.graph.load_state_dict(state["graph"])


# ------------------------- step 1: trajectories of a persistent MDP (3.2, 4.2; S3.2-01, S3.2-02)


@dataclass
class State:
    """s and snap: an observation, (H, W) or (H, W, C) uint8, and the bytes that restore it."""

    frame: np.ndarray
    snapshot: bytes


@dataclass
class Trajectory:
    """tau = (s_1, snap_1), ..., (s_T, snap_T). A terminal state is not stored, because no step can
    be taken from it (R10); the last state of a truncated episode is stored."""

    frames: np.ndarray  # (T, H, W) uint8
    snapshots: list[bytes]  # T
    actions: list[bytes]  # T; actions[t] lead from state t - 1 to state t, one byte per action
    units: list[tuple | None]  # the coverage unit after each step: one entry per step taken
    terminated: bool
    truncated: bool


def walk(env: PersistentEnv, start: State, seed: int, max_steps: int) -> Trajectory:
    """Roll back to `start` and follow pi_explore, uniform over the actions (6.1; S4.2-02), for
    `max_steps` steps or until the episode ends (S6.1-07)."""
    rng = np.random.default_rng(seed)
    roll_back(env, start)
    frames = [start.frame]
    snapshots = [start.snapshot]
    actions = [b""]
    units = []
    since_state = b""  # the actions since the last state
    terminated = False
    truncated = False
    while len(units) < max_steps and not terminated and not truncated:
        action = int(rng.integers(env.action_space.n))
        frame, _, terminated, truncated, info = env.step(int(env.action_space.start) + action)
        units.append(unit_key(env.unit()))
        since_state += bytes([action])
        blank = info.get("blank", False)  # a blank screen counts as a step, not as a state (R24)
        if not terminated and not blank:
            frames.append(np.array(frame))
            snapshots.append(env.snapshot())
            actions.append(since_state)
            since_state = b""
    return Trajectory(np.stack(frames), snapshots, actions, units, terminated, truncated)


def roll_back(env, state):
    """Return to a state without an environment step (S3.2-02). Raises InputError if the frame
    differs from the stored one (S4-01)."""
    if not np.array_equal(env.restore(state.snapshot), state.frame):
        raise InputError(
            "restore() returned a different frame from the one stored with the snapshot: probably, "
            "part of the state is not in the snapshot; see PersistentEnv in envs.py"
        )


# ------------------------------------------ step 2: training pairs (4.1, 4.2; S4.1-02 ... S4.1-09)

# A pair is stored with its label as (s_1, s_2, y): s_1 and s_2 are frames, and y = 1 if they are
# similar, else 0 (S4.1-07).
# Distances count the states of a trajectory, which are one step apart except across blank screens.


def pairs_within(frames, n, N, rng):
    """Figure 2 (a, b): for each state of a trajectory (T, H, W), one similar state and, if one
    exists, one dissimilar state, each drawn uniformly from this trajectory (R17)."""
    pairs = []
    position = np.arange(len(frames))
    for i in range(len(frames)):
        distance = np.abs(position - i)
        similar = np.flatnonzero(distance < n)  # S4.1-03; i itself included, because 0 < n
        pairs.append((frames[i], frames[rng.choice(similar)], 1))
        dissimilar = np.flatnonzero(distance > N)  # S4.1-04; distances n ... N: no label (S4.1-05)
        if len(dissimilar) > 0:
            pairs.append((frames[i], frames[rng.choice(dissimilar)], 0))
    return pairs


def pairs_with_prefix(frames, full_prefix, N, rng):
    """Figure 2 (c): for each state of a trajectory (T, H, W), one state of its full prefix, drawn
    uniformly from those more than N before it, if one exists. Distances are measured along the
    joined path, which is the prefix followed by the trajectory (S4.2-22, S4.2-23, R16)."""
    pairs = []
    position = np.arange(len(full_prefix))
    for i in range(len(frames)):
        # full_prefix[-1] and frames[0] are the same state.
        distance = (len(full_prefix) - 1 + i) - position
        distant = np.flatnonzero(distance > N)
        if len(distant) > 0:
            pairs.append((frames[i], full_prefix[rng.choice(distant)], 0))
    return pairs


def balanced(pairs, rng):
    """Equally many similar and dissimilar pairs, in random order (R17)."""
    similar = [pair for pair in pairs if pair[2] == 1]
    dissimilar = [pair for pair in pairs if pair[2] == 0]
    size = min(len(similar), len(dissimilar))
    chosen = [similar[k] for k in rng.permutation(len(similar))[:size]]
    chosen += [dissimilar[k] for k in rng.permutation(len(dissimilar))[:size]]
    return [in_either_order(chosen[k], rng) for k in rng.permutation(2 * size)]


def in_either_order(pair, rng):
    """The pair, or with probability 1/2 its states swapped: otherwise a prefix state would always
    come second, and its position would reveal the label (R17)."""
    s_1, s_2, y = pair
    return (s_2, s_1, y) if rng.random() < 0.5 else pair


def stack_pairs(pairs):
    """Three arrays: the frames s_1, the frames s_2, (batch, H, W) each, and the labels (batch,)."""
    s_1, s_2, y = zip(*pairs, strict=True)
    return np.stack(s_1), np.stack(s_2), np.array(y)


# --------- step 3: the similarity model R (4.1, 6.1; S4.1-01, S4.1-08, S6.1-02, S6.1-03, S6.1-04)


class SimilarityModel(nn.Module):
    """R(s_1, s_2): one encoder embeds both frames; four fully connected layers classify the two
    embeddings (6.1). Except during `fit`, the model is in evaluation mode: batch normalisation then
    uses fixed statistics, so that R of a pair depends on that pair alone (S4.1-01).

    shape: of a frame, (H, W) or (H, W, C)."""

    def __init__(self, config: Config, shape: tuple[int, ...], device: str = "cpu"):
        super().__init__()
        self.epochs = config.epochs
        self.batch_size = config.r_batch
        self.device = device
        if config.small_networks:
            self.encoder = conv_encoder(SMALL_LAYERS, shape, config.embedding, batch_norm=True)
        else:
            self.encoder = ResNet18(channels_of(shape), config.embedding)
        width = config.head_width
        self.head = nn.Sequential(
            *dense(2 * config.embedding, width),
            *dense(width, width),
            *dense(width, width),
            *dense(width, 1),
        )
        initialise(self, config.seed, 0)
        self.to(device, memory_format=torch.channels_last)  # for speed only, as is `fused`
        self.eval()
        self.optimiser = torch.optim.Adam(self.parameters(), lr=config.learning_rate, fused=True)

    def forward(self, s_1, s_2):
        """Two batches of frames (batch, H, W) -> logits of R (batch,)."""
        frames = to_input(np.concatenate([s_1, s_2]), self.device)  # (2 * batch, C, H, W)
        e_1, e_2 = self.encoder(frames).chunk(2)  # (batch, d) each
        return self.logits(e_1, e_2)

    def logits(self, e_1, e_2):
        """Two batches of embeddings (batch, d) -> logits of R (batch,)."""
        return self.head(torch.cat([e_1, e_2], dim=1)).squeeze(1)

    @torch.no_grad()
    def embed(self, frames):
        """Frames (T, H, W) uint8 -> embeddings (T, d)."""
        parts = [self.encoder(to_input(part, self.device)) for part in in_parts(frames)]
        return torch.cat(parts)

    @torch.no_grad()
    def score(self, e_1, e_2):
        """R of each embedding in e_1 (K, d) with the corresponding one in e_2 (K, d), or with the
        single e_2 (d,) -> (K,) in [0, 1]."""
        return torch.sigmoid(self.logits(e_1, e_2.expand_as(e_1))).cpu().numpy()

    def fit(self, pairs, rng):
        """Minimise the binary cross-entropy in `epochs` passes (R19), each over a new balanced draw
        of the pairs. Returns the mean loss of the last pass; if one class has no pairs, returns
        None and leaves R unchanged."""
        self.train()
        try:
            for _ in range(self.epochs):
                losses = []
                for batch in batches(balanced(pairs, rng), self.batch_size):
                    losses.append(self.update(*stack_pairs(batch)))
        finally:
            self.eval()  # also after Ctrl-C
        return float(np.mean(losses)) if losses else None

    def update(self, s_1, s_2, y):
        """One optimiser step on a batch (see stack_pairs). Returns the loss before it, the mean of
        -y log R - (1 - y) log(1 - R) (S4.1-08)."""
        labels = torch.from_numpy(y).float().to(self.device)
        loss = F.binary_cross_entropy_with_logits(self(s_1, s_2), labels)
        gradient_step(self.optimiser, loss, "R", max_norm=1.0)  # R18
        return loss.item()

    def rates(self, pairs, rng):
        """The true positive and true negative rates of R > 0.5, over a balanced sample of at most
        1,000 pairs whose frames differ: pairs of identical frames do not show whether R
        generalises. Returns (None, None) if either class has no such pair."""
        differing = [pair for pair in pairs if not np.array_equal(pair[0], pair[1])]
        chosen = balanced(differing, rng)[:1000]
        if not chosen:
            return None, None
        s_1, s_2, y = stack_pairs(chosen)
        R = self.score(self.embed(s_1), self.embed(s_2))
        return float(np.mean(R[y == 1] > 0.5)), float(np.mean(R[y == 0] <= 0.5))

    def get_extra_state(self):
        """What PyTorch's state_dict() stores in addition to the weights."""
        return self.optimiser.state_dict()

    def set_extra_state(self, state):
        self.optimiser.load_state_dict(state)


# ------------------- step 4: the graph of clusters, prefixes, merge (4.2; S4.2-01 ... S4.2-29)


@dataclass
class Cluster(State):
    """v = (s, snap): a cluster, which is its centre and the number of its visits."""

    visits: int = 1  # states assigned to it, its centre and every start included (R11)


@dataclass(frozen=True)
class ParentArc:
    """An arc of E_parent, from a cluster v to its parent: the cluster created most recently before
    v on the same trajectory, or the start cluster if there is none (R13)."""

    parent: int
    prefix: np.ndarray  # (k, H, W), from the parent's centre to the cluster's, both included
    actions: bytes  # those that lead from the parent's centre to the cluster's


class Graph:
    """G. Clusters are numbered in the order of their creation; number 0 is the initial cluster
    (S4.2-11). Below, v, u, start, parent, later and earlier are such numbers."""

    def __init__(self, initial_state: State):
        initial = Cluster(initial_state.frame, initial_state.snapshot)
        self.clusters: dict[int, Cluster] = {0: initial}  # V
        self.arcs: dict[tuple[int, int], int] = {}  # E: (from, to) -> visits
        self.adjacent: dict[int, set[int]] = {0: set()}  # predecessors and successors (R8)
        # The arcs of every cluster but 0 and of all its ancestors, even absorbed ones. A merge
        # changes none of them, so every full prefix remains a path that was walked; it only deletes
        # the arcs that no cluster of G needs any more (R15).
        self.E_parent: dict[int, ParentArc] = {}
        self.next_number = 1  # of the next cluster; numbers are not reused
        self.embeddings: dict[int, torch.Tensor] = {}  # (d,) of each centre, by the current R

    def sampling_distribution(self):
        """sigma: the numbers of the clusters, and their probabilities, inversely proportional to
        their visits (6.1; S4.2-12)."""
        weights = np.array([1 / cluster.visits for cluster in self.clusters.values()])
        return list(self.clusters), weights / weights.sum()

    def embed_centres(self, similarity):
        """Embed all centres by the current R (S4-03)."""
        frames = np.stack([cluster.frame for cluster in self.clusters.values()])
        self.embeddings = dict(zip(self.clusters, similarity.embed(frames), strict=True))

    def most_similar(self, candidates, e_i, similarity, theta):
        """Of these clusters, the one whose centre s has the greatest R(s, s_i), if that is greater
        than theta; else None (S4.2-03, S4.2-04). e_i: the embedding (d,) of s_i."""
        centres = torch.stack([self.embeddings[v] for v in candidates])  # (K, d)
        scores = similarity.score(centres, e_i)  # (K,)
        best = int(scores.argmax())
        return candidates[best] if scores[best] > theta else None

    def add_trajectory(self, start, tau, similarity, theta_sim):
        """Assign each state, in order, to a cluster or to a new one (S4.2-06), and add an arc where
        successive states belong to different clusters (S4.2-07, S4.2-08). start: the cluster from
        which tau began. Returns the cluster of each state (T)."""
        embeddings = similarity.embed(tau.frames)  # (T, d)
        clusters = [start]  # the first state is the centre of its start cluster (R9)
        self.clusters[start].visits += 1
        parent = start  # the parent of the next new cluster (R13)
        parent_index = 0  # the position of the parent's centre in tau
        for i in range(1, len(tau.frames)):
            previous = clusters[-1]
            v = self.find(embeddings[i], previous, similarity, theta_sim)
            if v is None:
                # Copied, because a view would keep the whole trajectory in memory.
                prefix = tau.frames[parent_index : i + 1].copy()
                actions = b"".join(tau.actions[parent_index + 1 : i + 1])
                arc = ParentArc(parent, prefix, actions)
                v = self.create(tau.snapshots[i], arc, embeddings[i])
                parent = v
                parent_index = i
            else:
                self.clusters[v].visits += 1  # S4.2-09
            if v != previous:
                self.add_arc(previous, v, visits=1)
            clusters.append(v)
        return clusters

    def find(self, e_i, previous, similarity, theta_sim):
        """The cluster to which s_i belongs: the most similar among the previous state's cluster and
        those adjacent to it (S4.2-13, R8), else among all (R7), else None (S4.2-05). e_i: the
        embedding (d,) of s_i."""
        nearby = sorted({previous} | self.adjacent[previous])
        found = self.most_similar(nearby, e_i, similarity, theta_sim)
        if found is None:
            found = self.most_similar(list(self.clusters), e_i, similarity, theta_sim)
        return found

    def create(self, snapshot, arc, embedding):
        """Create a cluster whose centre is the last state of the arc's prefix, and add the arc to
        E_parent (S4.2-01, S4.2-19, S4.2-20). Returns the number of the cluster."""
        v = self.next_number
        self.next_number += 1
        self.clusters[v] = Cluster(arc.prefix[-1], snapshot)
        self.embeddings[v] = embedding
        self.adjacent[v] = set()
        self.E_parent[v] = arc
        return v

    def add_arc(self, source, target, visits):
        """Add visits to the arc (source, target), and the arc if it is new (S4.2-10)."""
        self.arcs[source, target] = self.arcs.get((source, target), 0) + visits
        self.adjacent[source].add(target)
        self.adjacent[target].add(source)

    def lineage(self, v):
        """v and its ancestors except the initial cluster, oldest first (S4.2-19)."""
        line = []
        while v != 0:
            line.append(v)
            v = self.E_parent[v].parent
        return line[::-1]

    def full_prefix(self, v: int) -> list[np.ndarray]:
        """The frames from s_init to the centre of v in chronological order; empty for the initial
        cluster (S4.2-21)."""
        if v == 0:
            return []
        frames = [self.clusters[0].frame]
        for u in self.lineage(v):
            frames += list(self.E_parent[u].prefix[1:])  # the parent's centre is there already
        return frames

    def actions_to(self, v: int) -> bytes:
        """pi^p of section 3.2: the actions that lead from s_init to the centre of v (S3.2-03). They
        are numbers from 0, whatever the first action of the action space is."""
        return b"".join(self.E_parent[u].actions for u in self.lineage(v))

    def merge(self, similarity, theta_merge):
        """In the order of creation, compare each cluster with the surviving earlier ones, and merge
        it into the one with the greatest R(earlier, later) if that is above theta_merge (S4.2-24,
        S4.2-25). A cluster that was absorbed is not compared again (R14). The earlier cluster keeps
        its centre (S4.2-28) and inherits visits (S4.2-27) and arcs. Returns {later: earlier}."""
        merged = {}
        survivors = [0]  # the initial cluster is the earliest
        for later in list(self.clusters)[1:]:
            earlier = self.most_similar(survivors, self.embeddings[later], similarity, theta_merge)
            if earlier is None:
                survivors.append(later)
            else:
                merged[later] = earlier
        for later, earlier in merged.items():
            absorbed = self.clusters.pop(later)
            self.clusters[earlier].visits += absorbed.visits
        self.set_arcs(self.arcs, merged)
        # Keep the arcs of E_parent that lead from clusters of G to s_init (R15; S4.2-29).
        needed = {u for v in self.clusters for u in self.lineage(v)}
        self.E_parent = {v: arc for v, arc in self.E_parent.items() if v in needed}
        return merged

    def set_arcs(self, arcs, merged):
        """Replace E by these arcs: move the arcs of merged clusters to their survivors and drop
        self-loops (S4.2-26)."""
        self.arcs = {}
        self.adjacent = {v: set() for v in self.clusters}
        for (source, target), visits in arcs.items():
            source = merged.get(source, source)
            target = merged.get(target, target)
            if source != target:
                self.add_arc(source, target, visits)

    def state_dict(self):
        """G without its embeddings, which every iteration computes anew. Frames are stored as
        tensors, because torch.load with weights_only refuses arrays."""
        clusters = {}
        for v, cluster in self.clusters.items():
            clusters[v] = (torch.from_numpy(cluster.frame), cluster.snapshot, cluster.visits)
        E_parent = {}
        for v, arc in self.E_parent.items():
            E_parent[v] = (arc.parent, torch.from_numpy(arc.prefix), arc.actions)
        return {
            "clusters": clusters,
            "arcs": dict(self.arcs),
            "E_parent": E_parent,
            "next_number": self.next_number,
        }

    def load_state_dict(self, state):
        self.clusters = {}
        for v, (frame, snapshot, visits) in state["clusters"].items():
            self.clusters[v] = Cluster(frame.numpy(), snapshot, visits)
        self.E_parent = {}
        for v, (parent, prefix, actions) in state["E_parent"].items():
            self.E_parent[v] = ParentArc(parent, prefix.numpy(), actions)
        self.next_number = state["next_number"]
        self.set_arcs(state["arcs"], merged={})


# ------------------------------------------- steps 2 and 5: novelty (4.2; S4.2-14, S6.1-14)


class RND(nn.Module):
    """Random network distillation (Burda et al. 2019): a predictor learns the output of a fixed
    random target network; its error is large on states unlike those it was trained on.

    shape: of a frame, (H, W) or (H, W, C)."""

    def __init__(self, config: Config, shape: tuple[int, ...], device: str = "cpu"):
        super().__init__()
        d = config.embedding
        layers = SMALL_LAYERS if config.small_networks else BURDA_LAYERS
        self.batch_size = config.rnd_batch
        self.device = device
        self.target = conv_encoder(layers, shape, d, batch_norm=False)
        self.predictor = nn.Sequential(
            conv_encoder(layers, shape, d, batch_norm=False),
            nn.ReLU(),
            nn.Linear(d, d),
            nn.ReLU(),
            nn.Linear(d, d),
        )
        initialise(self, config.seed, 1)
        self.target.requires_grad_(False)
        self.to(device)
        self.optimiser = torch.optim.Adam(
            self.predictor.parameters(), lr=config.learning_rate, fused=True
        )
        self.pixels = RunningMeanStd(shape=shape)  # of each pixel, over all states trained on
        self.recent_errors = deque(maxlen=5)  # one array per iteration (R4); empty: untrained

    def forward(self, frames):
        """Frames (batch, H, W) -> mean squared errors of the predictor (batch,), on observations
        standardised and clipped to +-5 (R4)."""
        z = (frames - self.pixels.mean) / np.sqrt(self.pixels.var + 1e-8)
        z = z.clip(-5, 5).astype(np.float32)
        x = channels_first(torch.from_numpy(z).to(self.device))  # (batch, C, H, W)
        return (self.predictor(x) - self.target(x)).square().mean(1)

    @torch.no_grad()
    def errors(self, frames):
        """Frames (T, H, W) -> errors (T,)."""
        return np.concatenate([self(part).cpu().numpy() for part in in_parts(frames)])

    def reward(self, frames):
        """The intrinsic reward, frames (T, H, W) -> (T,): (error - mean) / standard deviation. Mean
        and standard deviation are those of the errors of the last five iterations' states, measured
        after RND was trained on them (R4). Before the first training, nothing is novel (R6)."""
        if not self.recent_errors:
            return np.full(len(frames), -np.inf)
        recent = np.concatenate(self.recent_errors)
        return (self.errors(frames) - recent.mean()) / (recent.std() + 1e-8)

    def fit(self, trajectories, rng):
        """Update the statistics of the pixels, then train the predictor in one pass over the frames
        of the trajectories, (T, H, W) each. Returns the mean loss."""
        for frames in trajectories:
            self.pixels.update(frames)
        states = [frame for frames in trajectories for frame in frames]
        losses = []
        order = rng.permutation(len(states))
        for batch in batches(order, self.batch_size):
            losses.append(self.update(np.stack([states[k] for k in batch])))
        # Errors are measured after training: before it, those of new states are so large that they
        # would inflate the standard deviation and hide the novel states of later iterations (R4).
        self.recent_errors.append(np.concatenate([self.errors(frames) for frames in trajectories]))
        return float(np.mean(losses))

    def update(self, frames):
        """One optimiser step on frames (batch, H, W). Returns the mean error before it."""
        loss = self(frames).mean()
        gradient_step(self.optimiser, loss, "RND")
        return loss.item()

    def get_extra_state(self):
        """What PyTorch's state_dict() stores in addition to the weights."""
        return {
            "optimiser": self.optimiser.state_dict(),
            "pixels": statistics_state(self.pixels),
            "recent_errors": [torch.from_numpy(errors) for errors in self.recent_errors],
        }

    def set_extra_state(self, state):
        self.optimiser.load_state_dict(state["optimiser"])
        load_statistics(self.pixels, state["pixels"])
        self.recent_errors.clear()
        self.recent_errors.extend(errors.numpy() for errors in state["recent_errors"])


# ------------------------------------------ steps and coverage (5; S5-03, S5-04, S6.2-04; R2, R25)


class Coverage:
    """The number of steps taken, and the units of coverage visited: pieces of the level, such as
    tiles, that the environment names (unit()). The compared methods count in the same way.

    full: number of units of full coverage, None if unknown. budget: the steps of the run."""

    def __init__(self, full: int | None, budget: int):
        self.full = full
        self.budget = budget
        self.steps = 0
        self.first_visits: dict[tuple, int] = {}  # unit -> step of its first visit

    def count(self, unit, covers=True):
        """Count one step that ended in `unit`. covers: whether the unit counts as visited."""
        self.steps += 1
        if covers:
            self.visit(unit)

    def visit(self, unit):
        """Mark a unit as visited. None: the agent is in no unit."""
        if unit is not None:
            self.first_visits.setdefault(unit, self.steps)

    def visited(self) -> dict[tuple, int]:
        """unit -> step of its first visit. Iterations are always complete, so the last may exceed
        the budget; units that it visits after the last step of the budget do not count
        (S6.2-04)."""
        return {unit: step for unit, step in self.first_visits.items() if step <= self.budget}

    def metrics(self):
        """Steps, visited units, and %Cov as a share; None where full coverage is unknown."""
        units = len(self.visited())
        # At most 1: where `full` is an estimate, more units may be visited (S5-03).
        share = min(1.0, units / self.full) if self.full else None
        return {"steps": self.steps, "units": units, "coverage": share}

    def state_dict(self):
        return {"steps": self.steps, "first_visits": dict(self.first_visits)}

    def load_state_dict(self, state):
        self.steps = state["steps"]
        self.first_visits = dict(state["first_visits"])


# -------------------------------------------------------- the networks' layers (6.1, R18; S6.1-03)


class BasicBlock(nn.Module):
    """The residual block of ResNet-18 (He et al. 2016)."""

    def __init__(self, inputs, width, stride=1):
        super().__init__()
        self.residual = nn.Sequential(
            *conv_norm(inputs, width, 3, stride, 1),
            nn.ReLU(inplace=True),
            *conv_norm(width, width, 3, 1, 1),
        )
        self.shortcut = nn.Sequential()  # the identity
        if stride > 1:
            self.shortcut = nn.Sequential(*conv_norm(inputs, width, 1, stride, 0))

    def forward(self, x):
        return F.relu(self.residual(x) + self.shortcut(x), inplace=True)


class ResNet18(nn.Module):
    """17 convolutions, not counting the shortcuts, and a linear layer (He et al. 2016):
    (batch, C, H, W) -> (batch, out)."""

    def __init__(self, channels, out):
        super().__init__()
        self.layers = nn.Sequential(
            *conv_norm(channels, 64, 7, 2, 3),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(3, 2, padding=1),
            BasicBlock(64, 64),
            BasicBlock(64, 64),
            BasicBlock(64, 128, stride=2),
            BasicBlock(128, 128),
            BasicBlock(128, 256, stride=2),
            BasicBlock(256, 256),
            BasicBlock(256, 512, stride=2),
            BasicBlock(512, 512),
        )
        self.linear = nn.Linear(512, out)

    def forward(self, x):
        x = self.layers(x)  # (batch, 512, h, w)
        # Equal to AdaptiveAvgPool2d(1), whose gradient is not deterministic on CUDA.
        return self.linear(x.mean((2, 3)))


def conv_norm(inputs, width, kernel, stride, padding):
    """A convolution, and batch normalisation, which supplies the bias."""
    conv = nn.Conv2d(inputs, width, kernel, stride, padding, bias=False)
    return [conv, nn.BatchNorm2d(width)]


# Width, kernel, stride and padding of each convolution.
BURDA_LAYERS = ((32, 8, 4, 0), (64, 4, 2, 0), (64, 3, 1, 0))
SMALL_LAYERS = ((16, 4, 4, 0), (32, 3, 2, 1), (32, 3, 2, 1))


def conv_encoder(layers, shape, out, batch_norm):
    """Convolutions and a linear layer for frames of this shape:
    (batch, C, H, W) -> (batch, out)."""
    modules = []
    channels = channels_of(shape)
    for width, kernel, stride, padding in layers:
        if batch_norm:
            modules += conv_norm(channels, width, kernel, stride, padding)
        else:
            modules.append(nn.Conv2d(channels, width, kernel, stride, padding))
        modules.append(nn.ReLU(inplace=True))
        channels = width
    modules.append(nn.Flatten())
    example = torch.zeros(1, channels_of(shape), *shape[:2])
    try:
        features = nn.Sequential(*modules).eval()(example)  # keeps the statistics of BatchNorm
    except RuntimeError:
        raise InputError(
            f"frames of {shape[0]} x {shape[1]} pixels are too small for the network: make them "
            "larger"
        ) from None
    return nn.Sequential(*modules, nn.Linear(features.shape[1], out))


def dense(inputs, outputs):
    """A layer of R's head: batch normalisation and ReLU before the linear layer (R20)."""
    return [nn.BatchNorm1d(inputs), nn.ReLU(), nn.Linear(inputs, outputs)]


def channels_of(shape):
    return shape[2] if len(shape) == 3 else 1


def initialise(network, seed, number):
    """He initialisation, and zero biases. `number` distinguishes the networks of one seed."""
    generator = torch.Generator()
    generator.manual_seed(np.random.SeedSequence([seed, number]).generate_state(1).item())
    for layer in network.modules():
        if isinstance(layer, (nn.Conv2d, nn.Linear)):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu", generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def to_input(frames, device):
    """(batch, H, W) or (batch, H, W, C) uint8 -> (batch, C, H, W) float in 0..1 (S6.1-02)."""
    return channels_first(torch.from_numpy(frames).to(device)).float() / 255


def channels_first(x):
    """(batch, H, W) or (batch, H, W, C) -> (batch, C, H, W)."""
    return x.unsqueeze(1) if x.ndim == 3 else x.permute(0, 3, 1, 2)


# --------------------------------------------------------------------------- shared helpers


def in_parts(frames, size=512):
    """Frames in parts of at most `size`, to bound the memory that the networks need."""
    return [frames[k : k + size] for k in range(0, len(frames), size)]


def batches(items, size):
    """Items, already shuffled, in batches of at most `size`. Their sizes are nearly equal: batch
    normalisation fails on a last batch of one."""
    count = math.ceil(len(items) / size)
    return [items[k::count] for k in range(count)]


def gradient_step(optimiser, loss, name, max_norm=math.inf):
    """One optimiser step, with the norm of the gradient clipped to max_norm. Raises InputError if
    the loss is infinite or not a number."""
    if not math.isfinite(loss.item()):
        raise InputError(f"the loss of {name} is {loss.item()}: choose a lower learning_rate")
    optimiser.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(optimiser.param_groups[0]["params"], max_norm)
    optimiser.step()


def share_above(threshold, parts):
    """The share of all values in these arrays above a threshold; None without arrays."""
    return float(np.mean(np.concatenate(parts) > threshold)) if parts else None


def statistics_state(statistics):
    """A RunningMeanStd as plain data."""
    return {
        "mean": torch.as_tensor(statistics.mean),
        "var": torch.as_tensor(statistics.var),
        "count": float(statistics.count),
    }


def load_statistics(statistics, state):
    statistics.mean = state["mean"].numpy()
    statistics.var = state["var"].numpy()
    statistics.count = state["count"]


# ##################################################################################################
# Nothing below this line belongs to the algorithm.
# ##################################################################################################

# ------------------------------------- the methods compared (6.2; S6.2-03, S6.2-04; R2, R25, R27)


class Baseline:
    """Base class of the agents that RbExplore is compared with: the part of its interface that Run
    uses. A subclass implements advance(rng), which acts and learns for one iteration and returns
    metrics."""

    def __init__(self, env_fn: Callable[[], PersistentEnv], config: Config):
        self.config = config
        self.env = make_checked(env_fn, config.seed)
        frame = self.reset()
        self.initial_state = State(frame, self.env.snapshot())
        self.coverage = Coverage(getattr(self.env, "full_coverage", None), config.steps)
        self.coverage.visit(unit_key(self.env.unit()))
        self.iteration = 0

    def iterate(self) -> Iteration:
        """Run one iteration."""
        self.iteration += 1
        agent_metrics = self.advance(np.random.default_rng([self.config.seed, self.iteration]))
        metrics = {
            "iteration": self.iteration,
            "phase": "explore",
            **self.coverage.metrics(),
            **agent_metrics,
        }
        return Iteration(metrics)

    def reset(self):
        """Return to s_init. Returns its frame."""
        return np.array(self.env.reset(seed=self.config.seed)[0])

    def step(self, action):
        """One step of an action, counted from 0. Returns the frame, and whether the episode has
        ended."""
        first = int(self.env.action_space.start)
        frame, _, terminated, truncated, _ = self.env.step(first + action)
        self.coverage.count(unit_key(self.env.unit()))
        return np.array(frame), bool(terminated or truncated)

    def state_dict(self):
        return {"iteration": self.iteration, "coverage": self.coverage.state_dict()}

    def load_state_dict(self, state):
        self.iteration = state["iteration"]
        self.coverage.load_state_dict(state["coverage"])


class Random(Baseline):
    """Uniform actions, in M episodes of at most trajectory_steps per iteration, each from
    s_init."""

    method = "random"

    def advance(self, rng):
        for _ in range(self.config.M):
            self.reset()
            for _ in range(self.config.trajectory_steps):
                _, ended = self.step(int(rng.integers(self.env.action_space.n)))
                if ended:
                    break
        return {}


class RNDBonus(RND):
    """The bonus of Burda et al. 2019: the error of RND on the successor, without the normalisation
    of RND.reward. It has the interface of ICM, and ignores the state and the action."""

    def bonus(self, before, actions, after):
        """Frames (T, H, W), actions (T,), successors (T, H, W) -> bonus (T,). Updates the
        statistics of the pixels first."""
        self.pixels.update(after)
        return self.errors(after)

    def learn(self, before, actions, after):
        """One optimiser step on a batch. Returns the losses by name."""
        return {"rnd_loss": self.update(after)}


class ICM(nn.Module):
    """The intrinsic curiosity module (Pathak et al. 2017): the bonus is the error of a forward
    model, in the features of an encoder that only the inverse model trains. The encoder has the
    layers of RND's target network.

    actions: the number of actions."""

    BETA = 0.2  # weight of the forward loss (Pathak et al.)

    def __init__(self, config: Config, shape: tuple[int, ...], actions: int, device: str = "cpu"):
        super().__init__()
        d = config.embedding
        layers = SMALL_LAYERS if config.small_networks else BURDA_LAYERS
        self.actions = actions
        self.device = device
        self.encoder = conv_encoder(layers, shape, d, batch_norm=False)
        self.inverse_model = perceptron(2 * d, config.head_width, actions)
        self.forward_model = perceptron(d + actions, config.head_width, d)
        initialise(self, config.seed, 2)
        self.to(device)
        self.optimiser = torch.optim.Adam(self.parameters(), lr=config.learning_rate)

    def losses(self, before, actions, after):
        """Frames (batch, H, W), actions (batch,), successors (batch, H, W) -> inverse and forward
        losses, (batch,) each: equations 3 and 5 of Pathak et al."""
        frames = to_input(np.concatenate([before, after]), self.device)
        phi, phi_next = self.encoder(frames).chunk(2)  # (batch, d) each
        a = torch.from_numpy(actions).to(self.device)
        logits = self.inverse_model(torch.cat([phi, phi_next], dim=1))  # (batch, actions)
        inverse = F.cross_entropy(logits, a, reduction="none")
        one_hot = F.one_hot(a, self.actions)
        predicted = self.forward_model(torch.cat([phi.detach(), one_hot], dim=1))  # (batch, d)
        forward = (predicted - phi_next.detach()).square().sum(1) / 2
        return inverse, forward

    @torch.no_grad()
    def bonus(self, before, actions, after):
        """Equation 6 of Pathak et al., (T,), without the factor eta, because PPO divides by the
        scale of the bonus."""
        parts = zip(in_parts(before), in_parts(actions), in_parts(after), strict=True)
        return np.concatenate([self.losses(*part)[1].cpu().numpy() for part in parts])

    def learn(self, before, actions, after):
        """One optimiser step on equation 7 of Pathak et al., without the policy's term. Returns the
        losses by name."""
        inverse, forward = self.losses(before, actions, after)
        loss = (1 - self.BETA) * inverse.mean() + self.BETA * forward.mean()
        gradient_step(self.optimiser, loss, "ICM")
        return {"inverse_loss": inverse.mean().item(), "forward_loss": forward.mean().item()}

    def get_extra_state(self):
        return self.optimiser.state_dict()

    def set_extra_state(self, state):
        self.optimiser.load_state_dict(state)


def perceptron(inputs, width, outputs):
    return nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, outputs))


def advantages_of(rewards, values, last_value, gamma, gae_lambda):
    """Generalised advantage estimation (Schulman et al. 2016, equation 16): rewards (T,), values
    (T,) of the states acted in, and the value of the last successor -> advantages (T,). Returns
    continue beyond the end of an episode, because the intrinsic reward does (Burda et al.)."""
    next_values = np.append(values[1:], last_value)
    delta = rewards + gamma * next_values - values
    advantages = np.zeros(len(rewards))
    advantage = 0.0
    for t in reversed(range(len(rewards))):
        advantage = delta[t] + gamma * gae_lambda * advantage
        advantages[t] = advantage
    return advantages


@dataclass
class Rollout:
    """T steps of an agent."""

    before: np.ndarray  # frames (T, H, W)
    actions: np.ndarray  # (T,)
    after: np.ndarray  # successors (T, H, W)
    log_p: np.ndarray  # log-probabilities of the actions (T,)
    values: np.ndarray  # of the states before (T,)
    last_value: float  # of the state from which the next rollout starts


class PPO(Baseline):
    """Proximal policy optimisation (Schulman et al. 2017) of a bonus only, RND's or ICM's. The
    settings are those of Burda et al. 2019, table 5 (R27), with three differences: one actor makes
    a rollout that is by default as long as those of their 128 together; the policy sees one frame,
    as RbExplore does (5); the predictor learns from every state.

    method: rnd or icm."""

    GAMMA = 0.99  # discount of the intrinsic reward
    GAE_LAMBDA = 0.95
    EPOCHS = 4  # over a rollout
    MINIBATCHES = 4  # per epoch
    CLIP = 0.1  # of the probability ratio
    ENTROPY = 0.001  # weight of the entropy
    VALUE = 0.5  # weight of the value loss (Burda et al.'s code)

    def __init__(
        self,
        env_fn: Callable[[], PersistentEnv],
        config: Config,
        method: str,
        device: str = "cpu",
    ):
        super().__init__(env_fn, config)
        self.method = method
        self.device = device
        self.actions = int(self.env.action_space.n)
        shape = self.initial_state.frame.shape
        width = config.head_width
        layers = SMALL_LAYERS if config.small_networks else BURDA_LAYERS
        with torch.random.fork_rng(devices=[]):
            encoder = conv_encoder(layers, shape, width, batch_norm=False)
            head = nn.Linear(width, self.actions + 1)  # the logits of the policy, and the value
            self.network = nn.Sequential(encoder, nn.ReLU(), head)
            if method == "rnd":
                self.curiosity = RNDBonus(config, shape, device)
            else:
                self.curiosity = ICM(config, shape, self.actions, device)
        initialise(self.network, config.seed, 3)
        head.weight.data *= 0.01  # so that the first policy is nearly uniform, and values near 0
        self.network.to(device)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate)
        self.discounted_sum = 0.0  # of the bonus so far
        self.discounted_sums = RunningMeanStd()
        self.state = self.initial_state  # where the next rollout starts
        self.age = 0  # steps of the current episode

    def policy(self, frames):
        """Frames (batch, H, W) -> log-probabilities (batch, actions), values (batch,)."""
        out = self.network(to_input(frames, self.device))
        return F.log_softmax(out[:, :-1], dim=1), out[:, -1]

    @torch.no_grad()
    def act(self, frame, rng):
        """Sample the policy. Returns the action, its log-probability, and the value of the
        state."""
        log_p, value = self.policy(frame[None])
        log_p = log_p[0].cpu().numpy()
        action = int(np.argmax(log_p + rng.gumbel(size=self.actions)))
        return action, log_p[action], value.item()

    def advance(self, rng):
        """Make a rollout, and train the policy and the curiosity module on it."""
        r = self.rollout(rng)
        bonus = self.curiosity.bonus(r.before, r.actions, r.after)
        rewards = self.scaled(bonus)
        advantages = advantages_of(rewards, r.values, r.last_value, self.GAMMA, self.GAE_LAMBDA)
        returns = advantages + r.values
        size = math.ceil(len(bonus) / self.MINIBATCHES)
        losses = []
        for _ in range(self.EPOCHS):
            for k in batches(rng.permutation(len(bonus)), size):
                ppo_losses = self.update(
                    r.before[k], r.actions[k], r.log_p[k], advantages[k], returns[k]
                )
                bonus_losses = self.curiosity.learn(r.before[k], r.actions[k], r.after[k])
                losses.append(ppo_losses | bonus_losses)
        means = {name: float(np.mean([row[name] for row in losses])) for name in losses[0]}
        return {"bonus": float(bonus.mean()), **means}

    def rollout(self, rng):
        """Act for `rollout_steps` steps from where the last rollout ended."""
        roll_back(self.env, self.state)
        frame = self.state.frame
        T = self.config.rollout_steps
        before = np.empty((T, *frame.shape), np.uint8)
        after = np.empty_like(before)
        actions = np.empty(T, np.int64)
        log_p = np.empty(T, np.float32)
        values = np.empty(T, np.float32)
        for t in range(T):
            before[t] = frame
            actions[t], log_p[t], values[t] = self.act(frame, rng)
            frame, ended = self.step(int(actions[t]))
            after[t] = frame
            self.age += 1
            if ended or self.age >= self.config.episode_steps:
                frame = self.reset()
                self.age = 0
        self.state = State(frame, self.env.snapshot())
        _, _, last_value = self.act(frame, rng)
        return Rollout(before, actions, after, log_p, values, last_value)

    def scaled(self, bonus):
        """The bonus (T,) divided by the standard deviation of its discounted sums so far (Burda et
        al., 2.4)."""
        sums = np.empty(len(bonus))
        for t in range(len(bonus)):
            self.discounted_sum = self.GAMMA * self.discounted_sum + float(bonus[t])
            sums[t] = self.discounted_sum
        self.discounted_sums.update(sums)
        return bonus / np.sqrt(self.discounted_sums.var + 1e-8)

    def update(self, frames, actions, old_log_p, advantages, returns):
        """One optimiser step on a minibatch: the clipped objective, the value loss and the entropy
        (Schulman et al. 2017, equations 7 and 9). Returns the losses by name."""
        log_p, values = self.policy(frames)
        old_log_p = torch.from_numpy(old_log_p).to(values)  # (batch,)
        advantages = torch.from_numpy(advantages).to(values)
        returns = torch.from_numpy(returns).to(values)
        ratio = (log_p[range(len(actions)), actions] - old_log_p).exp()
        clipped = ratio.clamp(1 - self.CLIP, 1 + self.CLIP)
        objective = torch.min(ratio * advantages, clipped * advantages).mean()
        value_loss = (values - returns).square().mean()
        entropy = -(log_p.exp() * log_p).sum(1).mean()
        loss = self.VALUE * value_loss - objective - self.ENTROPY * entropy
        gradient_step(self.optimiser, loss, "PPO")
        return {"value_loss": value_loss.item(), "entropy": entropy.item()}

    def state_dict(self):
        return {
            **super().state_dict(),
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "curiosity": self.curiosity.state_dict(),
            "discounted_sum": self.discounted_sum,
            "discounted_sums": statistics_state(self.discounted_sums),
            "frame": torch.from_numpy(self.state.frame),
            "snapshot": self.state.snapshot,
            "age": self.age,
        }

    def load_state_dict(self, state):
        super().load_state_dict(state)
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.curiosity.load_state_dict(state["curiosity"])
        self.discounted_sum = state["discounted_sum"]
        load_statistics(self.discounted_sums, state["discounted_sums"])
        self.state = State(state["frame"].numpy(), state["snapshot"])
        self.age = state["age"]


class Cells(nn.Module):
    """Go-Explore's cells without domain knowledge (Ecoffet et al. 2019) in place of R: two frames
    are similar if they are equal when reduced to 11 x 8 pixels of 8 grey levels. Nothing is
    learned."""

    def embed(self, frames):
        """Frames (T, H, W) uint8 -> cells (T, 88)."""
        cells = []
        for part in in_parts(frames):
            gray = to_input(part, "cpu").mean(1, keepdim=True)  # (batch, 1, H, W)
            small = F.interpolate(gray, (8, 11), mode="area").flatten(1)
            cells.append((small * 8).clamp(max=7).byte())
        return torch.cat(cells)

    def score(self, e_1, e_2):
        """Cells (K, 88) and others, (K, 88) or a single one (88,) -> (K,)."""
        return (e_1 == e_2).all(1).double().numpy()

    def rates(self, pairs, rng):
        return None, None

    def fit(self, pairs, rng):
        return None


METHODS = ("rbexplore", "rnd", "icm", "random", "cells")


def make_method(
    method: str,
    env_fn: Callable[[], PersistentEnv],
    config: Config,
    device: str = "cpu",
    executor: Executor | None = None,
):
    """RbExplore, or another method with its interface. Pretraining and additional trajectories
    serve to train R, so the others have none. Raises InputError for an unknown method."""
    if method not in METHODS:
        raise InputError(f"unknown method {method!r}: there are {', '.join(METHODS)}")
    if method == "rbexplore":
        return RbExplore(env_fn, config, device, executor)
    config = replace(config, pretrain_steps=0, L=0)
    if method == "random":
        return Random(env_fn, config)
    if method in ("rnd", "icm"):
        return PPO(env_fn, config, method, device)
    algorithm = RbExplore(env_fn, config, device, executor)
    algorithm.method = "cells"
    algorithm.similarity = Cells()
    return algorithm


# ----------------------------------------------------------------------------- the run folder


class Run:
    """A run in a folder. Iterating over it runs the algorithm until its steps are spent, and yields
    each Iteration once it has been saved:

        with Run("runs/mine", explorer).begin() as run:  # or resume()
            for iteration in run:
                print(iteration.metrics)

    A run is resumed from checkpoint.pt alone; config.json and metrics.csv are for people. The run
    holds the folder's lock while it iterates, and inside `with`. If an iteration is interrupted,
    the algorithm returns to the last complete one before the exception is raised.

    settings: plain data to record in addition to the method and its configuration.
    stop_at_full: stop at full coverage.

    Its methods raise InputError if another process holds the lock."""

    def __init__(
        self,
        folder: str | os.PathLike,
        algorithm,
        settings: dict | None = None,
        stop_at_full: bool = False,
    ):
        self.folder = pathlib.Path(os.path.expanduser(folder))
        self.algorithm = algorithm
        self.settings = {
            **(settings or {}),
            "method": algorithm.method,
            "config": asdict(algorithm.config),
            "frame_shape": list(algorithm.initial_state.frame.shape),
            "full_coverage": algorithm.coverage.full,
            "unit_name": getattr(algorithm.env, "unit_name", "units"),
        }
        self.stop_at_full = stop_at_full
        self.rows: list[dict] = []  # the metrics of each iteration
        self.ended_at_once = 0  # trajectories in a row that ended at their first step
        self.started = False  # whether begin() or resume() was called
        self.lock = filelock.FileLock(self.folder / ".lock", timeout=0)

    def __enter__(self) -> "Run":
        """Acquire the lock; nested uses are counted."""
        try:
            self.lock.acquire()
        except filelock.Timeout:
            raise InputError(
                f"{self.folder} is in use by another process: wait for its end, or choose another "
                f"folder. If no process uses it, delete {self.folder / '.lock'}"
            ) from None
        return self

    def __exit__(self, *exception) -> None:
        self.lock.release()

    def begin(self) -> "Run":
        """Begin in a folder that is new or empty. Returns the run."""
        check_unused(self.folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        with self:
            check_unused(self.folder)  # again, now that no other process can begin in it
            self.save()
        self.started = True
        return self

    def resume(self) -> "Run":
        """Continue after the last complete iteration. Returns the run."""
        read_checkpoint(self.folder)  # before the lock, which would create a file
        with self:
            self.load()
            self.save()  # records settings that changed, such as more steps
        self.started = True
        return self

    def __iter__(self) -> Iterator[Iteration]:
        if not self.started:
            raise InputError(f"call begin() or resume() of the run in {self.folder} first")
        with self:
            while not self.is_done():
                began = time.monotonic()
                try:
                    iteration = self.algorithm.iterate()
                    seconds = round(time.monotonic() - began, 2)
                    self.rows.append({**iteration.metrics, "seconds": seconds})
                    self.save()
                except BaseException:
                    self.load()
                    raise
                self.report_ends(iteration.trajectories)
                yield iteration

    def is_done(self) -> bool:
        """Whether the steps are spent or, with stop_at_full, the level is covered."""
        coverage = self.algorithm.coverage
        if self.stop_at_full and coverage.full and len(coverage.visited()) >= coverage.full:
            return True
        return coverage.steps >= coverage.budget

    def report_ends(self, trajectories):
        """Warn if ten trajectories in a row end at their first step. This happens at new clusters
        that nobody survives, and in an environment whose time limit restore() does not reset."""
        for tau in trajectories:
            at_once = len(tau.units) == 1 and (tau.terminated or tau.truncated)
            self.ended_at_once = self.ended_at_once + 1 if at_once else 0
            if self.ended_at_once == 10:
                cause = "terminated"
                if tau.truncated:
                    cause = "truncated: is there a time limit that restore() does not reset?"
                warnings.warn(
                    f"ten trajectories in a row ended at their first step, the last {cause}",
                    stacklevel=3,
                )

    def save(self):
        state = {
            "settings": self.settings,
            "rows": self.rows,
            "s_init": torch.from_numpy(self.algorithm.initial_state.frame),
            "algorithm": self.algorithm.state_dict(),
        }
        content = io.BytesIO()  # not the file: on a full disk, torch raises no OSError
        torch.save(state, content)
        write_atomically(self.folder / "checkpoint.pt", content.getvalue())
        for_people = {
            "config.json": json.dumps(self.settings, indent=1),
            "metrics.csv": csv_text(self.rows),
        }
        for name, text in for_people.items():
            try:
                write_atomically(self.folder / name, text.encode())
            except OSError as error:  # the run does not need the file; try again next time
                problem = error.strerror or error
                warnings.warn(f"{self.folder / name} cannot be written: {problem}", stacklevel=3)

    def load(self):
        """Restore the state of the last complete iteration. Raises InputError for a run of another
        method, configuration or environment."""
        state = read_checkpoint(self.folder)
        saved = {"method": state["settings"]["method"], **state["settings"]["config"]}
        mine = {"method": self.settings["method"], **self.settings["config"]}
        for name, value in mine.items():
            if name != "steps" and saved.get(name) != value:
                raise InputError(
                    f"{self.folder} holds another run: {name} is {saved.get(name)} there and "
                    f"{value} here"
                )
        if not np.array_equal(state["s_init"].numpy(), self.algorithm.initial_state.frame):
            raise InputError(
                f"{self.folder} holds a run of another environment: its initial state differs"
            )
        try:
            self.algorithm.load_state_dict(state["algorithm"])
        except (KeyError, RuntimeError, TypeError, ValueError, AttributeError) as error:
            raise damaged(self.folder, error) from None
        self.rows = state["rows"]
        self.settings = state["settings"] | self.settings


def check_unused(folder):
    """Raise InputError unless the folder is missing or empty. Nothing is changed."""
    if (folder / "checkpoint.pt").exists():
        raise InputError(f"{folder} holds a run already: resume it, or choose another folder")
    leftovers = {".lock", "checkpoint.pt.new"}  # of a run that was killed before its first save
    if folder.exists() and {path.name for path in folder.iterdir()} - leftovers:
        raise InputError(f"{folder} is not empty and holds no run: choose another folder")


def write_atomically(path, content):
    """Replace a file atomically: whatever happens, it has its old content or the new one."""
    temporary = path.with_name(path.name + ".new")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def read_checkpoint(folder: str | os.PathLike) -> dict:
    """The checkpoint in a folder: settings, rows, s_init and algorithm. Raises InputError if it is
    missing or damaged."""
    folder = pathlib.Path(os.path.expanduser(folder))
    try:
        content = (folder / "checkpoint.pt").read_bytes()
        # torch.load verifies no checksums, and would load a file with a flipped bit.
        broken = zipfile.ZipFile(io.BytesIO(content)).testzip()
        if broken:
            raise zipfile.BadZipFile(broken)
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        Config(**state["settings"]["config"])  # fails for a checkpoint of another version
        return {name: state[name] for name in ("settings", "rows", "s_init", "algorithm")}
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"there is no run in {folder}: it has no checkpoint.pt") from None
    except (OSError, MemoryError):
        raise
    except Exception as error:  # a damaged file makes zipfile and torch raise many kinds
        raise damaged(folder, error) from None


def damaged(folder, error):
    return InputError(
        f"{folder / 'checkpoint.pt'} cannot be loaded ({type(error).__name__}): it is damaged or "
        "of another version; start over in another folder"
    )


def csv_text(rows):
    """Dicts with the same keys as the text of a CSV file. None is an empty cell."""
    text = io.StringIO()
    names = list(rows[0]) if rows else []
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


# ------------------------------------------------------- verification (3.2; S3.2-01, S3.2-03)


class Seen(NamedTuple):
    """What an environment shows after a step."""

    frame: bytes
    unit: tuple | None
    terminated: bool = False
    truncated: bool = False


def verify(explorer: RbExplore, steps: int = 10) -> dict[int, str]:
    """Replay the actions that lead from s_init to each cluster, and compare frame and unit with the
    centre. Then take the same random steps from the replayed state and from the restored snapshot,
    and compare every frame, unit and end: this also reveals hidden state that no frame shows.

    A prefix that clusters share is replayed once: each arc of E_parent is replayed from a snapshot
    of the state in which the replay of its parent ended.

    Returns a verdict for each cluster: "exact", or what differs."""
    env = explorer.env
    graph = explorer.graph
    rng = np.random.default_rng(explorer.config.seed)
    arcs = {0: ParentArc(0, explorer.initial_state.frame[None], b"")}  # no actions lead to s_init
    arcs.update(sorted(graph.E_parent.items()))  # parents first
    replays = {0: explorer.initial_state.snapshot}  # None: the episode ended on the way
    verdicts = {}
    for v, arc in arcs.items():
        random_actions = rng.integers(env.action_space.n, size=steps).tolist()
        arrived = None
        after_replay = []
        if replays[arc.parent] is not None:
            arrived = play(env, replays[arc.parent], arc.actions)[-1]
        replays[v] = None
        if arrived is not None and not arrived.terminated:
            replays[v] = env.snapshot()
            after_replay = play(env, None, random_actions)
        if v not in graph.clusters:  # it was merged
            continue
        cluster = graph.clusters[v]
        restored, *after_restore = play(env, cluster.snapshot, random_actions)
        if restored.frame != cluster.frame.tobytes():
            verdicts[v] = "the snapshot does not restore the centre"
        elif replays[v] is None or (arrived.frame, arrived.unit) != (restored.frame, restored.unit):
            verdicts[v] = "the actions do not lead to the centre"
        elif after_replay != after_restore:
            verdicts[v] = "the next steps after replay and after restore differ"
        else:
            verdicts[v] = "exact"
    return verdicts


def play(env, snapshot, actions):
    """Restore a snapshot, unless it is None, and take actions, counted from 0, until the episode
    ends. Returns what is seen after the restore and after each action."""
    seen = []
    if snapshot is not None:
        frame = env.restore(snapshot)
        seen.append(Seen(np.array(frame).tobytes(), unit_key(env.unit())))
    for action in actions:
        frame, _, terminated, truncated, _ = env.step(action + int(env.action_space.start))
        unit = unit_key(env.unit())
        seen.append(Seen(np.array(frame).tobytes(), unit, bool(terminated), bool(truncated)))
        if terminated or truncated:
            break
    return seen


# -------------------------------------------------------------------------------- the figures


@contextlib.contextmanager
def default_matplotlib():
    """matplotlib with its default settings; afterwards the user's settings are back."""
    try:
        import matplotlib
    except Exception as error:  # an ImportError, or a ValueError for an invalid MPLBACKEND
        reason = str(error).splitlines()[0]
        raise InputError(
            f"matplotlib cannot be imported ({reason}): install it, or draw no figures"
        ) from None
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        yield


def draw(run: Run) -> list[str]:
    """Draw the figures of a run into its folder. Returns their file names."""
    a = run.algorithm
    name = run.settings["unit_name"]
    figures = {}
    with default_matplotlib():
        pretrain_steps = a.config.pretrain_steps
        figures["coverage.png"] = curves_figure({"this run": [a.coverage]}, name, pretrain_steps)
        level = level_of(a.env, a.coverage.visited())
        if level.boxes:
            steps = min(a.coverage.steps, a.coverage.budget)
            title = f"{len(a.coverage.visited())} {name} after {steps:,} steps"
            figures["coverage_map.png"] = maps_figure(level, {title: a.coverage})
        if isinstance(a, RbExplore):
            figures["centres.png"] = centres_figure(a.graph)
            figures["route.gif"] = route_animation(a.graph)
            places = places_of(a, level)
            if places:
                figures["graph.png"] = graph_figure(a.graph, level, places)
        save_figures(run.folder, figures)
    return list(figures)


def save_figures(folder, figures):
    """Write figures, or lists of images as animations."""
    for name, figure in figures.items():
        content = io.BytesIO()
        if name.endswith(".gif"):
            figure[0].save(content, "gif", save_all=True, append_images=figure[1:], duration=80)
        else:
            figure.savefig(content, format="png", dpi=120, bbox_inches="tight")
        write_atomically(folder / name, content.getvalue())


def new_figure(width, height):
    from matplotlib.figure import Figure  # without pyplot, which would choose a backend

    return Figure(figsize=(width, height), layout="constrained")


class Level(NamedTuple):
    """Where units lie in a picture. Boxes are (left, top, width, height)."""

    boxes: dict[tuple, tuple]  # unit -> box
    rooms: dict[str, tuple]  # name -> box
    picture: np.ndarray | None  # (H, W, 3); None: the environment has no level_map()
    width: int
    height: int

    def show(self, panel, title):
        """Draw the level, without units, into a panel."""
        from matplotlib.patches import Rectangle

        panel.set_title(title, fontsize=10)
        panel.set(xticks=[], yticks=[], facecolor="0.15", aspect="equal")
        if self.picture is not None:
            panel.imshow(self.picture, extent=(0, self.width, self.height, 0))
        for name, (left, top, w, h) in self.rooms.items():
            panel.add_patch(Rectangle((left, top), w, h, fill=False, color="0.6", linewidth=0.8))
            panel.text(left, top, name[:30], color="white", fontsize=6, va="bottom")
        panel.set(xlim=(0, self.width), ylim=(self.height, 0))


def level_of(env, units):
    """The level by the environment's level_map(), else by rooms of these units: each unit that ends
    with two whole numbers (..., x, y), or is one, is a square in the room that the rest of it
    names. Other units have no place."""
    if hasattr(env, "level_map"):
        picture, boxes = env.level_map()
        return Level(boxes, {}, picture, picture.shape[1], picture.shape[0])
    places = {}
    for unit in units:
        *name, x, y = unit if len(unit) > 1 else (*unit, 0, 0)[:2]
        if isinstance(x, int) and isinstance(y, int):
            places[unit] = (" ".join(map(str, name)), x, y)
    if not places:
        return Level({}, {}, None, 1, 1)
    names, xs, ys = zip(*places.values(), strict=True)
    names = sorted(set(names), key=lambda name: (len(name), name))  # 2 before 10
    across = math.ceil(math.sqrt(len(names)))
    width = max(xs) - min(xs) + 1
    height = max(ys) - min(ys) + 1
    rooms = {}
    for k, name in enumerate(names):
        rooms[name] = (k % across * (width + 1) + 1, k // across * (height + 1) + 1, width, height)
    boxes = {}
    for unit, (name, x, y) in places.items():
        left, top, _, _ = rooms[name]
        boxes[unit] = (left + x - min(xs), top + y - min(ys), 1, 1)
    down = math.ceil(len(names) / across)
    return Level(boxes, rooms, None, across * (width + 1) + 1, down * (height + 1) + 1)


def curve_of(coverage, grid):
    """Coverage after each number of steps in the grid: in %, or in units where the full coverage is
    unknown."""
    visited = np.searchsorted(sorted(coverage.visited().values()), grid, "right")
    if not coverage.full:
        return visited.astype(float)
    return np.minimum(100.0, visited * 100 / coverage.full)


def curves_figure(groups, unit_name, pretrain_steps):
    """Coverage against steps: for each group of runs their mean, and a band from their minimum to
    their maximum (S6.2-05), up to the step that all of them have reached.

    groups: label -> the coverage of each run."""
    figure = new_figure(7, 4.5)
    panel = figure.subplots()
    if pretrain_steps:
        panel.axvspan(0, pretrain_steps, color="0.9", label="pretraining")
    for k, (label, runs) in enumerate(groups.items()):
        budget = runs[0].budget
        full = runs[0].full
        last_step = min(budget, *(coverage.steps for coverage in runs))
        grid = np.linspace(0, last_step, 501).astype(int)
        curves = np.stack([curve_of(coverage, grid) for coverage in runs])  # (runs, grid)
        style = ("-", "--", "-.", ":")[k % 4]  # so that curves which coincide both show
        (line,) = panel.plot(grid, curves.mean(0), style, label=label)
        low = curves.min(0)
        high = curves.max(0)
        panel.fill_between(grid, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
    panel.set_xlabel("agent steps")
    panel.set_ylabel(f"coverage, % of {full} {unit_name}" if full else f"coverage, {unit_name}")
    panel.set(xlim=(0, budget), ylim=(0, 102 if full else None))
    figure.legend(loc="outside upper center", ncols=4, fontsize=8)
    return figure


def maps_figure(level, found):
    """Coverage maps: visited units in the colour of their first visit. Where the environment has a
    level_map(), the others are crossed out. found: title -> coverage."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    across = min(3, len(found))
    figure = new_figure(12, 8)
    panels = figure.subplots(math.ceil(len(found) / across), across, squeeze=False).ravel()
    for panel in panels[len(found) :]:
        panel.axis("off")
    for panel, (title, coverage) in zip(panels, found.items(), strict=False):
        level.show(panel, title)
        visited = {u: step for u, step in coverage.visited().items() if u in level.boxes}
        tiles = [Rectangle(level.boxes[unit][:2], *level.boxes[unit][2:]) for unit in visited]
        opacity = 1 if level.picture is None else 0.7
        colours = PatchCollection(
            tiles, cmap="viridis_r", alpha=opacity, edgecolor="0.15", linewidth=0.3
        )
        colours.set_array(list(visited.values()))
        colours.set_clim(0, coverage.budget)
        panel.add_collection(colours)
        if level.picture is not None:
            for unit in level.boxes.keys() - visited.keys():
                left, top, w, h = level.boxes[unit]
                panel.plot([left, left + w], [top, top + h], color="tab:red", linewidth=1)
    label = "step of the first visit"
    if level.picture is not None:
        label += " (red: not visited)"
    bar = figure.colorbar(colours, ax=panels.tolist(), label=label, shrink=0.8)
    bar.solids.set_alpha(1)
    return figure


def places_of(explorer, level):
    """cluster -> its point in the level, for clusters whose unit has a box. Those of one unit are
    spread over its box. The environment is left in one of the clusters."""
    crowds = {}
    for v, cluster in explorer.graph.clusters.items():
        explorer.env.restore(cluster.snapshot)
        unit = unit_key(explorer.env.unit())
        if unit in level.boxes:
            crowds.setdefault(level.boxes[unit], []).append(v)
    places = {}
    for (left, top, w, h), crowd in crowds.items():
        columns = max(1, round(math.sqrt(len(crowd) * w / h)))
        rows = math.ceil(len(crowd) / columns)
        for k, v in enumerate(crowd):
            x = left + w * (k % columns + 0.5) / columns
            y = top + h * (k // columns + 0.5) / rows
            places[v] = np.array([x, y])
    return places


def graph_figure(graph, level, places):
    """G over the level. A disc is a cluster, larger the more visits it has; the star is the initial
    one. An arc tapers from its start to its end; only the busiest arcs are drawn, which together
    have 90 % of all crossings.

    places: cluster -> its point."""
    from matplotlib.collections import PolyCollection
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(12, 8)
    panel = figure.subplots()
    busiest = sorted(graph.arcs.items(), key=lambda arc: -arc[1])
    crossings = np.cumsum([visits for _, visits in busiest])
    shown = busiest[: 1 + int(np.searchsorted(crossings, 0.9 * sum(graph.arcs.values())))]
    tapers = []
    colours = []
    for (source, target), visits in reversed(shown):
        if source in places and target in places:
            strength = math.sqrt(visits / busiest[0][1])
            along = places[target] - places[source]
            sideways = np.array([-along[1], along[0]]) / max(np.hypot(*along), 1e-9)
            sideways *= level.width * (0.0005 + 0.0025 * strength)
            # On one side of the line, so that the arcs of both directions show.
            tapers.append([places[source], places[source] + 2 * sideways, places[target]])
            colours.append((1, 1, 1, 0.15 + 0.75 * strength))
    title = f"{len(places)} clusters; {len(tapers)} of {len(graph.arcs)} arcs"
    level.show(panel, f"{title} (90 % of the crossings), thick at their start")
    panel.add_collection(PolyCollection(tapers, facecolors=colours))
    most = max(cluster.visits for cluster in graph.clusters.values())
    sizes = [15 + 100 * graph.clusters[v].visits / most for v in places]
    xs, ys = np.array(list(places.values())).T
    discs = panel.scatter(
        xs, ys, sizes, list(places), cmap="plasma", edgecolors="black", linewidths=0.5, zorder=3
    )
    if 0 in places:
        panel.plot(*places[0], "*", color="white", markeredgecolor="black", ms=12, zorder=4)
    bar = figure.colorbar(discs, label="cluster, in the order of creation", shrink=0.8)
    bar.ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def evenly(items, most):
    """At most `most` of the items, evenly spaced, the first and the last included."""
    return [items[k] for k in np.linspace(0, len(items) - 1, min(most, len(items))).astype(int)]


def centres_figure(graph):
    """The centres of at most 80 clusters, each with its number and visits."""
    shown = evenly(list(graph.clusters), 80)
    across = min(10, len(shown))
    down = math.ceil(len(shown) / across)
    figure = new_figure(across * 1.1 + 0.2, down * 1.3 + 0.4)
    figure.suptitle(f"{len(shown)} of {len(graph.clusters)} centres: number, visits", fontsize=9)
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for panel in panels:
        panel.axis("off")
    for panel, v in zip(panels, shown, strict=False):
        cluster = graph.clusters[v]
        picture = viewable(cluster.frame)
        panel.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
        panel.set_title(f"{v}: {cluster.visits:,}", fontsize=7)
    return figure


def viewable(frame):
    """A frame as a picture: grey (H, W), or red, green and blue (H, W, 3)."""
    if frame.ndim == 2 or frame.shape[2] == 3:
        return frame
    return frame.mean(2).astype(np.uint8)


def route_animation(graph):
    """The full prefix of the cluster farthest from s_init, in at most 300 images."""
    from PIL import Image

    farthest = max(graph.clusters, key=lambda v: len(graph.actions_to(v)))
    states = graph.full_prefix(farthest) or [graph.clusters[0].frame]
    scale = max(1, 256 // max(states[0].shape[:2]))
    frames = [viewable(s).repeat(scale, axis=0).repeat(scale, axis=1) for s in evenly(states, 300)]
    return [Image.fromarray(frame) for frame in frames]


# ------- the comparison of runs (6.2, 6.3; S6.2-05, S6.2-06, S6.3-01, S6.3-02, S6.3-03)


class SavedRun(NamedTuple):
    """What compare() needs of a run."""

    folder: str
    settings: dict
    config: Config
    coverage: Coverage
    rows: list[dict]  # the metrics of each iteration
    s_init: np.ndarray


def read_run(folder):
    """The run saved in a folder."""
    state = read_checkpoint(folder)
    settings = state["settings"]
    config = Config(**settings["config"])
    coverage = Coverage(settings["full_coverage"], config.steps)
    coverage.load_state_dict(state["algorithm"]["coverage"])
    return SavedRun(folder, settings, config, coverage, state["rows"], state["s_init"].numpy())


def compare(folders: list[str], out: str | os.PathLike, figures: bool = True) -> str:
    """Compare the runs in these folders, finished or not, of one environment and budget. Write
    table.csv, curves.csv, curves.png (figures 5 and 6) and maps.png (figure 4) to the folder `out`.
    Returns the table, in Markdown.

    Raises InputError for runs that cannot be compared."""
    different = {os.path.realpath(os.path.expanduser(folder)): folder for folder in folders}
    groups = group([read_run(folder) for folder in different.values()])
    out = pathlib.Path(os.path.expanduser(out))
    out.mkdir(parents=True, exist_ok=True)
    table = []
    curves = []
    for label, runs in groups.items():
        table.append(table_row(label, runs))
        for run in runs:
            for row in run.rows:
                point = {name: row[name] for name in ("iteration", "steps", "units", "coverage")}
                curves.append({"group": label, "seed": run.config.seed, **point})
    write_atomically(out / "table.csv", csv_text(table).encode())
    write_atomically(out / "curves.csv", csv_text(curves).encode())
    if figures:
        with default_matplotlib():
            save_figures(out, comparison_figures(groups))
    lines = [list(table[0]), ["---"] * len(table[0])]
    lines += [list(row.values()) for row in table]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def group(runs):
    """label -> the runs whose settings are equal except for the seed. A label names the method,
    unless it is rbexplore, and the fields that differ between runs and from the default."""
    values = {}  # of each field: those that occur
    for run in runs:
        check_comparable(runs[0], run)
        for name, value in settings_compared(run).items():
            values.setdefault(name, set()).add(value)
    default = asdict(default_config(runs[0].settings.get("env")))
    groups = {}
    for run in runs:
        method = run.settings["method"]
        words = [] if method == "rbexplore" else [method]
        for name, value in settings_compared(run).items():
            if len(values[name]) == 1 or value == default[name]:
                continue
            if isinstance(value, bool):
                words.append(name if value else f"no {name}")
            else:
                words.append(f"{name} {value}")
        groups.setdefault(", ".join(words) or "rbexplore", []).append(run)
    return groups


def settings_compared(run):
    """The configuration by which a run is grouped."""
    config = asdict(run.config)
    del config["seed"]
    if run.settings["method"] != "rbexplore":  # see make_method
        del config["pretrain_steps"], config["L"]
    return config


def check_comparable(one, other):
    """Raise InputError unless two runs have the same environment and budget."""
    for name in ("env", "level", "full_coverage", "unit_name", "steps"):
        values = [(run.settings | asdict(run.config)).get(name) for run in (one, other)]
        if values[0] != values[1]:
            raise InputError(
                f"{one.folder} and {other.folder} cannot be compared: {name} is {values[0]} in the "
                f"one and {values[1]} in the other"
            )
    same_size = one.s_init.shape == other.s_init.shape
    if same_size and not np.array_equal(one.s_init, other.s_init):
        raise InputError(
            f"{one.folder} and {other.folder} cannot be compared: their initial states differ"
        )


def table_row(label, runs):
    """The row of a group: coverage at the end, in % or, where full coverage is unknown, in units;
    median steps to 50, 90 and 100 %, where a run that has not reached it counts as infinite."""
    ends = [curve_of(run.coverage, run.config.steps) for run in runs]
    unfinished = sum(run.coverage.steps < run.config.steps for run in runs)
    row = {
        "": label,
        "runs": f"{len(runs)} ({unfinished} unfinished)" if unfinished else f"{len(runs)}",
        "mean": f"{np.mean(ends):.1f}",
        "min - max": f"{min(ends):.1f} - {max(ends):.1f}",
    }
    if runs[0].coverage.full:
        marks = [steps_to(run.coverage) for run in runs]
        row["at 100 %"] = f"{sum(mark[100] is not None for mark in marks)} of {len(runs)}"
        for percent in (50, 90, 100):
            median = np.median([math.inf if m[percent] is None else m[percent] for m in marks])
            row[f"to {percent} %"] = f"{median:,.0f}" if median < math.inf else "-"
    return row


def steps_to(coverage):
    """Percentage of full coverage -> the step that reached it; None if none did."""
    times = sorted(coverage.visited().values())
    marks = {}
    for mark in (50, 90, 100):
        needed = math.ceil(coverage.full * mark / 100)
        marks[mark] = times[needed - 1] if len(times) >= needed else None
    return marks


def comparison_figures(groups):
    curves = {}
    maps = {}
    units = set()  # visited in these maps
    for label, runs in groups.items():
        unit_name = runs[0].settings["unit_name"]
        curves[label] = [run.coverage for run in runs]
        most = best(curves[label])
        maps[f"{label}: {len(most.visited())} {unit_name}"] = most
        units.update(most.visited())
        settings = runs[0].settings
    figures = {"curves.png": curves_figure(curves, unit_name, pretrain_steps=0)}
    env = make_env("maze", level=settings["level"]) if settings.get("env") == "maze" else None
    level = level_of(env, units)
    if level.boxes:
        figures["maps.png"] = maps_figure(level, maps)
    return figures


def best(coverages):
    """The coverage of the run in a group that covers most at the end (S6.2-06)."""
    return max(coverages, key=lambda coverage: len(coverage.visited()))


# --------------------------------------------------------------------------- the command line


class Parser(argparse.ArgumentParser):
    def error(self, message):
        raise InputError(f"{message}; --help lists the options")


def parser():
    p = Parser(
        prog="rbexplore.py",
        allow_abbrev=False,
        description="RbExplore (Ugadiarov, Skrynnik, Panov): explore an environment by rolling "
        "back to stored states, clustered by a learned similarity.",
        epilog="example: python rbexplore.py --env maze --level 2 --seed 1 --out runs/second",
    )

    def add(name, meaning, **form):
        p.add_argument(name, help=meaning, **form)

    flag = {"action": "store_true", "default": None}
    add("--env", "maze, pop (Prince of Persia) or montezuma (default: maze)")
    add("--level", "1 to 3 of the maze, 1 to 14 of pop (default: 1)", type=int)
    add("--rom", "pop: your image of the NES cartridge", metavar="FILE")
    add("--state", "pop: a start state, gzip of an emulator state")
    add(
        "--method",
        "what explores (6.2): RbExplore, PPO with the bonus of RND or of ICM, random actions, or "
        "RbExplore with Go-Explore's cells instead of R (default: rbexplore)",
        choices=METHODS,
    )
    add(
        "--config",
        "preset of the configuration below (default: maze for the maze, else paper)",
        choices=list(CONFIGS),
    )
    add("--out", "run folder (default: runs/<env>-<seed>)", metavar="FOLDER")
    add("--resume", "continue the run in this folder; --steps extends it", metavar="RUN")
    add(
        "--verify",
        "check that the clusters of this run are reached exactly; exit code 1 if one is not",
        metavar="RUN",
    )
    add(
        "--compare",
        "compare runs of one environment and budget: print a table, and write it, the curves and "
        "two figures to --out (default: runs/comparison)",
        nargs="+",
        metavar="RUN",
    )
    add("--stop-at-full", "stop at full coverage", **flag)
    add("--no-figures", "draw no figures", **flag)
    add(
        "--workers",
        "processes that collect trajectories; the result is the same (default: 1)",
        type=count,
    )
    add("--threads", "CPU threads of PyTorch; changes the rounding (default: 1)", type=count)
    add("--device", "device of the networks: cpu, cuda, cuda:1, ... (default: cpu)")
    add_fields(p)
    return p


def add_fields(p):
    """An option for each field of Config."""
    heading = f"In brackets the values of --config {' | '.join(CONFIGS)}, where they differ."
    configuration = p.add_argument_group("configuration", heading)
    for f in fields(Config):
        values = [str(getattr(config, f.name)) for config in CONFIGS.values()]
        shown = " | ".join(values) if len(set(values)) > 1 else values[0]
        form = {"type": f.type, "metavar": f.type.__name__}
        if f.type is bool:
            form = {"action": argparse.BooleanOptionalAction}
        meaning = f"[{shown}] {f.metadata['meaning']}"
        configuration.add_argument(flag_of(f.name), default=None, help=meaning, **form)


def count(text):
    """A number of workers or threads."""
    if not text.isdecimal() or not 1 <= int(text) <= 1000:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from 1 to 1,000")
    return int(text)


def flag_of(name):
    return "--" + name.replace("_", "-")


def default_config(env):
    """The configuration of an environment unless --config names another."""
    return MAZE if env == "maze" else Config()


def settings_of(args):
    """The settings of a new run."""
    env = args.env or "maze"
    method = args.method or "rbexplore"
    base = CONFIGS[args.config] if args.config else default_config(env)
    if method != "rbexplore":
        base = replace(base, pretrain_steps=0)  # as in make_method, but before steps are checked
    given = {f.name: getattr(args, f.name) for f in fields(Config)}
    given = {name: value for name, value in given.items() if value is not None}
    level = args.level
    if level is None and env in ("maze", "pop"):
        level = 1
    return {
        "method": method,
        "env": env,
        "level": level,
        "rom": absolute(args.rom),
        "state": absolute(args.state),
        "config": asdict(replace(base, **given)),
        "device": args.device or "cpu",
        "threads": args.threads or 1,
        "workers": args.workers or 1,
    }


def recorded_settings(args, folder):
    """The settings of the run in a folder, with the changes that the command line makes."""
    settings = read_checkpoint(folder)["settings"]
    if "env" not in settings:
        raise InputError(
            f"{folder} was made in Python, and its environment is not known here: use "
            "Run(folder, algorithm).resume() or verify(algorithm) there"
        )
    steps = settings["config"]["steps"]
    if args.steps is not None and args.steps < steps:
        raise InputError(
            f"steps is {args.steps}: a run can be extended, not shortened; give {steps} or more"
        )
    settings["config"]["steps"] = args.steps or steps
    for name in ("device", "workers", "rom", "state"):
        value = getattr(args, name)
        if value is not None:
            settings[name] = absolute(value) if name in ("rom", "state") else value
    return settings


def absolute(path):
    return path and os.path.abspath(os.path.expanduser(path))


def check_options(args, action, allowed):
    """Raise InputError for options that are empty or do not go together with an action."""
    for name, value in vars(args).items():
        if value == "" or value == [""]:
            raise InputError(f"{flag_of(name)} is empty: give a value, or leave it out")
        if action and value is not None and name not in (action, *allowed):
            raise InputError(
                f"{flag_of(name)} cannot be given with {flag_of(action)}: leave it out"
            )


def make_algorithm(settings, stack):
    """Make the algorithm that the settings describe. The exit stack closes its environment and
    workers."""
    torch.set_num_threads(settings["threads"])
    device = settings["device"]
    if device != "cpu":  # on the CPU, every operation used here is deterministic
        torch.use_deterministic_algorithms(True)
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # which cuBLAS needs for that
    try:
        torch.zeros(1, device=device).cpu()
    except (RuntimeError, AssertionError, ImportError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise InputError(
            f"device {device} cannot be used ({reason}): choose another --device, such as cpu"
        ) from None
    executor = None
    if settings["workers"] > 1:
        context = multiprocessing.get_context("spawn")
        executor = ProcessPoolExecutor(settings["workers"], context, initializer=end_with_parent)
        stack.callback(executor.shutdown, cancel_futures=True)
    options = {name: settings[name] for name in ("level", "rom", "state")}
    options = {name: value for name, value in options.items() if value is not None}
    for name in ("frame_size", "frameskip"):
        options[name] = settings["config"][name]
    env_fn = functools.partial(make_env, settings["env"], **options)
    config = Config(**settings["config"])
    algorithm = make_method(settings["method"], env_fn, config, device, executor)
    stack.callback(algorithm.env.close)
    return algorithm


def end_with_parent():
    """In a worker: end with the process that started it, even if that is killed."""

    def watch():
        multiprocessing.parent_process().join()
        os._exit(1)

    def end_soon(number, frame):
        timer = threading.Timer(5, os._exit, [1])
        timer.daemon = True
        timer.start()

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    # Slurm sends SIGTERM to the workers too. If one ended while it sends a trajectory, the parent
    # would wait for the rest forever. Nor is the signal ignored: it is how a pool ends its workers.
    signal.signal(signal.SIGTERM, end_soon)
    threading.Thread(target=watch, daemon=True).start()


# What is printed of an iteration: heading, width, metric, format.
COLUMNS = (
    ("iter", 5, "iteration", "d"),
    ("phase", 8, "phase", "s"),
    ("steps", 10, "steps", ",d"),
    ("units", 6, "units", "d"),
    ("%Cov", 6, "coverage", ".1%"),
    ("clusters", 8, "clusters", "d"),
    ("new", 4, "added", "d"),
    ("merged", 6, "merged", "d"),
    ("R's loss", 8, "r_loss", ".3f"),
    ("TPR", 4, "r_tpr", ".2f"),
    ("TNR", 4, "r_tnr", ".2f"),
    ("novel", 6, "novel_share", ".1%"),
    ("s", 5, "seconds", ".1f"),
)


def table_line(metrics):
    """The printed line of an iteration; "-" for a metric that it does not have."""
    cells = []
    for _, width, name, form in COLUMNS:
        value = metrics.get(name)
        cell = "-" if value is None else format(value, form)
        cells.append(cell.rjust(width))
    return " ".join(cells)


def show(run):
    """Iterate over a run, and print a heading, a line for each iteration and a summary, with a
    progress bar over the steps below."""
    coverage = run.algorithm.coverage
    config = run.algorithm.config
    name = run.settings["unit_name"]
    target = f"{coverage.full} {name} to cover" if coverage.full else "full coverage is unknown"
    say(
        f"{run.settings['method']}: {target}; seed {config.seed}; {config.steps:,} steps, "
        f"{config.pretrain_steps:,} of them pretraining; run folder {run.folder}"
    )
    say(" ".join(heading.rjust(width) for heading, width, _, _ in COLUMNS))
    try:
        # disable=None: no bar where stderr is not a terminal
        disable = True if sys.stderr is None else None
        with tqdm()(total=config.steps, desc="steps", leave=False, disable=disable) as bar:
            bar.update(coverage.steps)
            for _ in run:
                say(table_line(run.rows[-1]))
                bar.update(coverage.steps - bar.n)
    finally:
        seconds = sum(row["seconds"] for row in run.rows)
        text = f"{coverage.steps:,} steps, {seconds:.0f} s: {len(coverage.visited())} {name}"
        if coverage.full:
            share = coverage.metrics()["coverage"]
            marks = []
            for percent, step in steps_to(coverage).items():
                marks.append(f"{percent} %: " + ("not reached" if step is None else f"{step:,}"))
            text += f" of {coverage.full}, {share:.1%}; steps to {', '.join(marks)}"
        say(text)


def tqdm():
    """The class tqdm. Raises InputError where an invalid TQDM_ variable makes its import fail."""
    try:
        import tqdm
    except ValueError as error:
        raise InputError(
            f"an environment variable TQDM_... is invalid ({error}): correct it, or unset it"
        ) from None
    return tqdm.tqdm


def say(text, file=None):
    """Print a line above the progress bar."""
    file = file or sys.stdout
    if file is not None:  # None: the process was started without it
        tqdm().write(text, file=file)
        file.flush()


MAKE_ROOM = "; make room, or choose another --out"
CHOOSE_ANOTHER = "; choose an --out that can be written"
HINTS = {  # what the user can do about an OSError
    errno.ENOSPC: MAKE_ROOM,
    errno.EDQUOT: MAKE_ROOM,
    errno.EACCES: CHOOSE_ANOTHER,
    errno.EPERM: CHOOSE_ANOTHER,
    errno.EROFS: CHOOSE_ANOTHER,
    errno.ENOTDIR: CHOOSE_ANOTHER,
    errno.EEXIST: CHOOSE_ANOTHER,
    errno.ENOLCK: "; choose an --out on a file system that has locks",
    errno.EPIPE: "; the reader of the output has ended; the run can be resumed",
}


def main(argv: list[str] | None = None) -> int:
    """The command line. Returns the exit code: 0; 1 if --verify finds a difference; 2 for what the
    user can fix; 130 after Ctrl-C; 143 after SIGTERM."""
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")  # for characters that its encoding lacks
    try:
        with sigterm_as_interrupt(), warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: say(f"warning: {message}", sys.stderr)
            return command(parser().parse_args(argv))
    except InputError as error:
        problem = str(error)
    except KeyboardInterrupt as interrupt:
        return interrupt.args[0] if interrupt.args else 130
    except OSError as error:
        problem = f"{error.filename or 'a file'}: {error.strerror}{HINTS.get(error.errno, '')}"
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        problem = (
            "out of memory: choose smaller values of M, trajectory_steps, L, r_batch or, for rnd "
            "and icm, rollout_steps"
        )
    print(f"rbexplore: {problem}", file=sys.stderr)
    return 2


def is_out_of_memory(error):
    """Whether an exception of NumPy or torch, on any device, means that memory is exhausted."""
    if isinstance(error, (MemoryError, torch.OutOfMemoryError)):
        return True
    return "can't allocate memory" in str(error) or "not enough memory" in str(error)


@contextlib.contextmanager
def sigterm_as_interrupt():
    """Treat SIGTERM, by which Slurm and Docker stop a job, as Ctrl-C."""

    def interrupt(number, frame):
        raise KeyboardInterrupt(143)  # the exit code

    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread can handle signals
        return
    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def command(args):
    """Do what the options say. Returns the exit code."""
    if args.compare:
        check_options(args, "compare", ["out", "no_figures"])
        say(compare(args.compare, args.out or "runs/comparison", not args.no_figures))
        return 0
    if args.verify:
        check_options(args, "verify", ["device", "rom", "state"])
        return verify_command(args)
    if args.resume:
        unchanged = ["device", "workers", "rom", "state", "no_figures", "stop_at_full"]
        check_options(args, "resume", ["steps", *unchanged])
    else:
        check_options(args, None, [])
    return run_command(args)


def run_command(args):
    """Begin or resume a run, and show it. Returns the exit code."""
    settings = recorded_settings(args, args.resume) if args.resume else settings_of(args)
    default_folder = f"runs/{settings['env']}-{settings['config']['seed']}"
    folder = args.resume or args.out or default_folder
    if not args.no_figures:
        with default_matplotlib():
            pass  # so that a missing matplotlib is reported now, and not at the end
    code = 0
    with contextlib.ExitStack() as stack:
        algorithm = make_algorithm(settings, stack)
        run = Run(folder, algorithm, settings, bool(args.stop_at_full))
        stack.enter_context(run.resume() if args.resume else run.begin())
        try:
            show(run)
        except KeyboardInterrupt as interrupt:
            code = interrupt.args[0] if interrupt.args else 130
        if not args.no_figures:
            try:
                figures = ", ".join(draw(run))
            except Exception as error:  # which must not hide that the run is finished
                figures = f"but no figures ({type(error).__name__}: {error})"
            say(f"{folder}: checkpoint.pt, config.json, metrics.csv, {figures}")
    if code:
        say(
            "stopped after the last complete iteration; to resume: "
            f"python rbexplore.py --resume {shlex.quote(str(folder))}"
        )
    return code


def verify_command(args):
    """Verify the run in a folder, and print a verdict for each cluster. Returns the exit code."""
    settings = recorded_settings(args, args.verify)
    if settings["method"] not in ("rbexplore", "cells"):
        raise InputError(f"{args.verify} is a run of {settings['method']}, which has no clusters")
    with contextlib.ExitStack() as stack:
        explorer = make_algorithm(settings | {"workers": 1}, stack)
        Run(args.verify, explorer, settings).load()
        verdicts = verify(explorer)
    for v, verdict in verdicts.items():
        say(f"cluster {v}, {len(explorer.graph.actions_to(v)):,} steps from s_init: {verdict}")
    exact = list(verdicts.values()).count("exact")
    say(f"{exact} of {len(verdicts)} clusters are reached exactly")
    return 0 if exact == len(verdicts) else 1


if __name__ == "__main__":
    sys.exit(main())
