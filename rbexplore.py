"""RbExplore, as its paper says it: Ugadiarov, Skrynnik, Panov, "Long-Term Exploration in Persistent
MDPs".

The agent explores without rewards. It rolls back to stored snapshots of the environment, clusters
the states that it meets by a learned similarity R, and starts again from rarely visited clusters.
An iteration has five steps (section 4). They are the five calls of `RbExplore.iterate`:

    1  explore            sample M clusters of G, roll back to each, walk with pi_explore
    2  make_pairs         walk on from L novel states; label pairs of states, full prefixes included
    3  train_similarity   train R on the pairs of this iteration
    4  update_graph       add the states of step 1 to G; every 15th iteration merge similar clusters
    5  train_novelty      train the novelty module (RND) on the states of step 1

    symbol              here                         meaning
    s, snap             State.frame, .snapshot       a state: its observation, the simulator's bytes
    tau                 Trajectory                   states s_1 ... s_T that follow one another
    pi_explore          walk                         uniform over the actions
    R(s_1, s_2)         SimilarityModel              in [0, 1]: are the two states close in time?
    n, N                Config.n, Config.N           closer than n: similar; further than N: not
    G = (V, E)          Graph.clusters, Graph.arcs   clusters and the arcs between them
    v = (s, snap)       Cluster                      a cluster is its centre; v is its number
    E_parent            Graph.E_parent               the arc from v to the cluster it came from
    theta_sim           Config.theta_sim             threshold of R to join a cluster
    theta_merge         Config.theta_merge           threshold of R to merge two clusters
    B, beta, L          B, Config.beta, Config.L     novel states; what is novel; how many are drawn
    M                   Config.M                     exploration trajectories an iteration

"S4.2-03" is a statement of the paper, and `pytest -k S4_2_03` its test; "R13" is our reading where
the paper is silent or unclear. The README lists both. A step is an agent step: one action, after
the frameskip (R1).
"""

import argparse
import contextlib
import functools
import io
import json
import math
import multiprocessing
import os
import pathlib
import platform
import signal
import sys
import threading
import time
import uuid
from collections import Counter, deque
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field, fields, replace

import filelock
import gymnasium
import numpy as np
import torch
from gymnasium.wrappers.utils import RunningMeanStd
from torch import nn
from torch.nn import functional as F
from tqdm import tqdm

from envs import InputError, check_contract, make_env, unit_key

# ---------------------------------- configuration (6.1; S6.1-05, S6.1-08, S6.1-09, S6.1-12)


def option(default, meaning, low=-math.inf, high=math.inf):
    """A field of the configuration: what --help says of it, and its range."""
    return field(default=default, metadata={"meaning": meaning, "low": low, "high": high})


@dataclass(frozen=True)
class Config:
    """The paper's configuration: the defaults are its values, where it gives them, else those of
    our readings; the same for every level.

    Raises InputError for a value that cannot work."""

    seed: int = option(0, "every generator is made from it", 0, 2**63)
    steps: int = option(15_000_000, "agent steps in all, pretraining included (6.2, R2)", 1, 10**12)
    pretrain_steps: int = option(500_000, "steps of pretraining; then G is reset (6.1)", 0)
    M: int = option(30, "exploration trajectories an iteration (6.1)", 1, 10**6)
    trajectory_steps: int = option(1500, "longest exploration trajectory, steps (6.1, R1)", 1)
    L: int = option(1000, "novel states to walk on from, at most, an iteration (6.1)", 0)
    additional_steps: int = option(50, "longest additional trajectory, steps: 2N (R3)", 1)
    beta: float = option(2.5, "a state is novel above this reward, in deviations (6.1, R4)")
    n: int = option(5, "pairs closer than this are similar, steps (6.1)", 1)
    N: int = option(25, "pairs further apart than this are dissimilar, steps (6.1)", 1)
    prefix: bool = option(True, "negative pairs with the full prefix (4.2; off: ablation of 6.3)")
    epochs: int = option(4, "passes of R over the pairs of an iteration (R19)", 1)
    theta_sim: float = option(0.5, "a state joins a cluster above this R (6.1)", 0, 1)
    theta_merge: float = option(0.5, "two clusters merge above this R (6.1)", 0, 1)
    merge: bool = option(True, "merge clusters (4.2; off: ablation of 6.3)")
    merge_every: int = option(15, "iterations from one merge to the next (6.1, R28)", 1)
    frame_size: int = option(96, "height and width of an observation, pixels (5)", 32, 1024)
    small_networks: bool = option(
        False, "small encoders: not ResNet-18 for R (6.1), not Burda's for the others"
    )
    embedding: int = option(512, "size of an embedding (6.1), and of RND's output", 1)
    head_width: int = option(512, "width of fully connected layers; the paper gives none", 1)
    learning_rate: float = option(1e-4, "Adam's (R18)", 0)
    r_batch: int = option(256, "pairs in a batch of R (R18)", 2)
    rnd_batch: int = option(256, "states in a batch of RND (R18)", 1)
    rollout_steps: int = option(16_384, "RND and ICM: steps of an iteration (6.2, R27)", 1)
    episode_steps: int = option(4_500, "RND and ICM: longest episode, steps (6.2, R27)", 1)

    def __post_init__(self):
        self.check_fields()
        if self.n > self.N:
            raise InputError(
                f"n is {self.n} and N is {self.N}: similar states are closer than "
                "dissimilar ones; give n <= N"
            )
        for name in ("trajectory_steps", "additional_steps"):
            if getattr(self, name) <= self.N:
                raise InputError(
                    f"{name} is {getattr(self, name)}: no two states would be more "
                    f"than N = {self.N} steps apart; give at least {self.N + 1}"
                )
        if self.pretrain_steps >= self.steps:
            raise InputError(
                f"pretrain_steps is {self.pretrain_steps} of {self.steps} steps: "
                "nothing is left to explore; give more steps, or less pretraining"
            )

    def check_fields(self):
        for f in fields(self):
            value = getattr(self, f.name)
            low = f.metadata["low"]
            high = f.metadata["high"]
            whole_number_for_float = f.type is float and type(value) is int
            if type(value) is not f.type and not whole_number_for_float:
                raise InputError(f"{f.name} is {value!r}: it must be of type {f.type.__name__}")
            if not low <= value <= high:
                raise InputError(f"{f.name} is {value}: give a number from {low:,} to {high:,}")


# What a small image, a small budget and a CPU need; all else is the paper's. n and N: R30.
MAZE = Config(
    steps=100_000,
    pretrain_steps=4_000,
    M=10,
    trajectory_steps=150,
    L=10,
    additional_steps=20,
    n=2,
    N=10,
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
CONFIGS = {"paper": Config(), "maze": MAZE}

# --------------------------------------------------------------- the algorithm (4; S4-01 ... S4-07)


@dataclass
class Iteration:
    """What one iteration did, for whoever prints, traces, saves or tests it."""

    metrics: dict
    trajectories: list = field(default_factory=list)  # of step 1
    additional: list = field(default_factory=list)  # of step 2
    pairs: list = field(default_factory=list)  # of step 2: triples (s_1, s_2, y)
    merged: dict = field(default_factory=dict)  # of step 4: cluster -> what it merged into


class RbExplore:
    """The algorithm of section 4.

    env_fn makes the persistent environment (envs.PersistentEnv says what that is). device is where
    the networks are. executor, one of concurrent.futures, walks the trajectories, with the same
    result. Processes need an env_fn that pickles; with threads several environments live in one
    process, which the cartridge's emulator does not allow. Raises InputError for an environment
    that breaks the contract, or a loss that is not finite."""

    def __init__(self, env_fn, config=None, device="cpu", executor=None):
        self.config = config or Config()
        self.env_fn = env_fn
        self.executor = executor
        self.env = env_fn()
        check_contract(self.env, self.config.seed)
        frame, _ = self.env.reset(seed=self.config.seed)
        self.initial_state = State(np.array(frame), self.env.snapshot())
        self.initial_unit = unit_key(self.env.unit())
        # Layers draw first weights from torch's global generator, which is left as it was.
        with torch.random.fork_rng(devices=[]):
            self.similarity = SimilarityModel(self.config, frame.shape, device)
            self.novelty = RND(self.config, frame.shape, device)
        self.graph = Graph(self.initial_state)
        self.pretraining = True
        self.iteration = 0
        self.steps = 0
        self.discovered: dict[tuple, int] = {}  # coverage unit -> step of its first visit
        self.worker_key = uuid.uuid4().hex  # by which a worker knows whose environment it has

    def iterate(self) -> Iteration:
        """One iteration: the paper's five steps, in the paper's order."""
        check_budget(self)
        if self.pretraining and self.steps >= self.config.pretrain_steps:
            self.restart()
        self.iteration += 1
        # Made anew each iteration, so that a checkpoint needs no generator; one for each step that
        # draws, so that what one step draws does not shift the next step.
        rng = np.random.default_rng([self.config.seed, self.iteration])
        rng_1, rng_2, rng_3, rng_5 = rng.spawn(4)
        theta_sim = self.theta_sim_now()  # before any step is taken: it begins at 0 (S6.1-13)
        first_new = self.graph.next_number

        trajectories = self.explore(rng_1)
        pairs, additional = self.make_pairs(trajectories, rng_2)
        r_metrics = self.train_similarity(pairs, rng_3)
        merged = self.update_graph(trajectories, theta_sim)
        rnd_loss = self.train_novelty(trajectories, rng_5)

        novelty = np.concatenate([tau.novelty for tau in trajectories])
        metrics = {  # a new entry becomes a column of metrics.csv
            **progress_metrics(self),
            "theta_sim": theta_sim,
            "clusters": len(self.graph.clusters),
            "added": self.graph.next_number - first_new,
            "merged": len(merged),
            "novel_share": float(np.mean(novelty > self.config.beta)),
            "additional": len(additional),
            **r_metrics,
            "rnd_loss": rnd_loss,
        }
        return Iteration(metrics, trajectories, additional, pairs, merged)

    def run(self):
        """Iterate until the budget of steps is spent."""
        while self.steps < self.config.steps:
            self.iterate()
        return self

    def restart(self):
        """The end of pretraining (6.1; S6.1-15): G is reset to the initial state, R and RND are
        kept (R6), and coverage starts (R2)."""
        self.pretraining = False
        self.graph = Graph(self.initial_state)
        if self.initial_unit is not None:
            self.discovered[self.initial_unit] = self.steps

    def theta_sim_now(self):
        """The threshold; in pretraining it rises linearly from 0 (6.1, R21; S6.1-13)."""
        if not self.pretraining:
            return self.config.theta_sim
        return self.config.theta_sim * self.steps / self.config.pretrain_steps

    def explore(self, rng):
        """Step 1: sample M clusters, roll back to each, explore (S4-01, S6.1-06, S6.1-11).

        Clusters are drawn with replacement, as G begins with a single one (R12)."""
        clusters, probabilities = self.graph.sampling_distribution()
        sampled = rng.choice(clusters, size=self.config.M, p=probabilities).tolist()
        centres = [self.graph.clusters[v] for v in sampled]
        covers = not self.pretraining
        trajectories = self.collect(centres, self.config.trajectory_steps, covers, rng)
        for tau, v in zip(trajectories, sampled, strict=False):  # fewer, where the steps ended
            tau.start = v
            tau.full_prefix = self.graph.full_prefix(v)
        check_lengths(trajectories)
        return trajectories

    def collect(self, starts, max_steps, covers, rng):
        """Roll back to each state and walk at most `max_steps` steps.

        Each step counts, whatever it serves (R2), and none is taken beyond the end of pretraining
        or of the budget (S6.2-04), so there may be fewer trajectories then. covers: whether its
        steps count for coverage (R25)."""
        end = self.config.pretrain_steps if self.pretraining else self.config.steps
        seeds = rng.integers(2**63, size=len(starts)).tolist()
        trajectories = []
        while len(trajectories) < len(starts) and self.steps < end:
            left = end - self.steps
            limit = min(max_steps, left)
            # Workers walk side by side, so only those are begun that fit at full length; what the
            # shorter ones leave is for the next round.
            fitting = max(1, left // max_steps)
            first = len(trajectories)
            jobs = [(starts[k], seeds[k], limit) for k in range(first, len(starts))][:fitting]
            for tau in progress(walk_all(self, jobs), "walk", len(jobs)):
                for unit in tau.units:
                    self.steps += 1
                    if covers and unit is not None:
                        self.discovered.setdefault(unit, self.steps)
                trajectories.append(tau)
        return trajectories

    def make_pairs(self, trajectories, rng):
        """Step 2: pairs of exploration and of additional trajectories (S4-02), and pairs with their
        full prefixes (S4.1-09, R29). Returns the pairs and the additional trajectories."""
        additional = self.walk_on_from_novel_states(trajectories, rng)
        pairs = []
        for tau in trajectories + additional:
            pairs += pairs_within(tau.frames, self.config.n, self.config.N, rng)
        # In a loop of its own: without it the other pairs are the same (S6.3-02).
        if self.config.prefix:
            for tau in trajectories + additional:
                pairs += pairs_with_prefix(tau.frames, tau.full_prefix, self.config.N, rng)
        return pairs, additional

    def walk_on_from_novel_states(self, trajectories, rng):
        """Put the novel states into B, sample L of them, walk on from these (S4.2-15 ... S4.2-18).

        The RND of the iteration before decides what is novel. B holds the novel states of this
        iteration only (R5). The walks serve R alone."""
        B = []  # a novel state: its trajectory, and its index there
        for tau in trajectories:
            tau.novelty = self.novelty.reward(tau.frames)
            B += [(tau, i) for i in np.flatnonzero(tau.novelty > self.config.beta)]  # S4.2-16
        sample = [B[k] for k in rng.permutation(len(B))[: self.config.L]]  # S4.2-17
        novel_states = [State(tau.frames[i], tau.snapshots[i]) for tau, i in sample]
        additional = self.collect(novel_states, self.config.additional_steps, False, rng)
        for walked, (tau, i) in zip(additional, sample, strict=False):
            walked.start = tau.start
            # The full prefix goes on from tau's, which ends with its s_1, to the novel state (R29).
            walked.full_prefix = tau.full_prefix[:-1] + list(tau.frames[: i + 1])
        return additional

    def train_similarity(self, pairs, rng):
        """Step 3: train R on this iteration's pairs and no others (S4-03, S4-06). Returns metrics:
        how often it was right on them before, while they were unseen, and its loss."""
        true_positive, true_negative = self.similarity.rates(pairs, rng)
        loss = self.similarity.fit(pairs, rng)
        return {"r_tpr": true_positive, "r_tnr": true_negative, "r_loss": loss}

    def update_graph(self, trajectories, theta_sim):
        """Step 4: add the states of the exploration trajectories to G; every 15th iteration merge
        (S4-04, S6.1-10, S6.3-01). Returns which cluster merged into which."""
        self.graph.embed_centres(self.similarity)  # R has changed: the old embeddings are stale
        for tau in progress(trajectories, "update G"):
            self.graph.add_trajectory(tau, self.similarity, theta_sim)
        if self.config.merge and self.iteration % self.config.merge_every == 0:
            return self.graph.merge(self.similarity, self.config.theta_merge)
        return {}

    def train_novelty(self, trajectories, rng):
        """Step 5: train RND, last, on the states of the exploration trajectories and no others
        (S4-05). Returns its loss."""
        return self.novelty.fit([tau.frames for tau in trajectories], rng)

    def state_dict(self):
        """All that a run needs to go on, as plain data and tensors."""
        return {
            "pretraining": self.pretraining,
            "iteration": self.iteration,
            "steps": self.steps,
            "discovered": dict(self.discovered),
            "similarity": self.similarity.state_dict(),
            "novelty": self.novelty.state_dict(),
            "graph": self.graph.state_dict(),
        }

    def load_state_dict(self, state):
        """Take over the state of a run of the same configuration and environment."""
        self.pretraining = state["pretraining"]
        self.iteration = state["iteration"]
        self.steps = state["steps"]
        self.discovered = dict(state["discovered"])
        self.similarity.load_state_dict(state["similarity"])
        self.novelty.load_state_dict(state["novelty"])
        self.graph.load_state_dict(state["graph"])


# ------------------------- step 1: trajectories of a persistent MDP (3.2, 4.2; S3.2-01, S3.2-02)


@dataclass
class State:
    """s and snap: an observation, (H, W) or (H, W, C) uint8, and the bytes that restore it."""

    frame: np.ndarray
    snapshot: bytes


@dataclass
class Trajectory:
    """tau = (s_1, snap_1), ..., (s_T, snap_T). A terminal state, which cannot be returned to, is
    not stored (R10)."""

    frames: np.ndarray  # (T, H, W) uint8
    snapshots: list[bytes]  # T
    actions: list[bytes]  # T; actions[t] lead from state t - 1 to t: several across blanks (R24)
    units: list[tuple | None]  # the coverage unit after each step: as many as steps were taken
    ended: bool  # by the environment, and not by the number of steps
    start: int = 0  # the cluster it began from; of an additional one: that its exploration did
    # Frames of the full prefix s_init ... s_1; empty of an exploration from the initial cluster.
    full_prefix: list[np.ndarray] = field(default_factory=list)
    novelty: np.ndarray | None = None  # (T,) intrinsic reward of each state, from step 2
    clusters: list[int] = field(default_factory=list)  # T; of each state in step 4, before merges


def walk(env, start, seed, max_steps):
    """Roll back to `start` and follow pi_explore, uniform over the actions (6.1; S4.2-02), for
    `max_steps` steps or to the end of the episode (S6.1-07). The result depends on these arguments
    alone."""
    rng = np.random.default_rng(seed)
    roll_back(env, start)
    frames = [start.frame]
    snapshots = [start.snapshot]
    actions = [b""]
    units = []
    since_state = b""  # the actions since the last state
    ended = False
    while len(units) < max_steps and not ended:
        action = int(rng.integers(env.action_space.n))
        frame, _, terminated, truncated, info = env.step(int(env.action_space.start) + action)
        units.append(unit_key(env.unit()))
        since_state += bytes([action])
        ended = bool(terminated or truncated)
        blank = info.get("blank", False)  # a transition screen is stepped and counted (R24)
        if not terminated and not blank:
            frames.append(np.array(frame))
            snapshots.append(env.snapshot())
            actions.append(since_state)
            since_state = b""
    return Trajectory(np.stack(frames), snapshots, actions, units, ended)


def roll_back(env, state):
    """Return to a state, at no step (S3.2-02). Raises InputError if the frame is another one
    (S4-01)."""
    if not np.array_equal(env.restore(state.snapshot), state.frame):
        raise InputError(
            "restore() did not give the frame of its snapshot again: part of the "
            "state is not in the snapshot; see PersistentEnv in envs.py"
        )


def walk_all(algorithm, jobs):
    """`walk` for each (start, seed, max_steps), in order: here, or in the executor's workers."""
    if algorithm.executor is None:
        return (walk(algorithm.env, *job) for job in jobs)
    remote = functools.partial(walk_in_worker, algorithm.worker_key, algorithm.env_fn)
    return algorithm.executor.map(remote, jobs)


_worker = threading.local()  # the environment of this process or thread, and whose it is


def walk_in_worker(owner, env_fn, job):
    """`walk` in an environment that is made at the first job of its owner, and kept."""
    if getattr(_worker, "owner", None) != owner:
        if hasattr(_worker, "env"):
            _worker.env.close()
        _worker.env = env_fn()
        _worker.env.reset()
        _worker.owner = owner
    return walk(_worker.env, *job)


def check_lengths(trajectories):
    """Raise InputError where more than 90 % end at their first step, as they do behind a time
    limit. Fewer than ten trajectories, as the end of the budget leaves, are not judged."""
    at_once = sum(tau.ended and len(tau.units) == 1 for tau in trajectories)
    if len(trajectories) >= 10 and at_once > 0.9 * len(trajectories):
        raise InputError(
            f"{at_once} of {len(trajectories)} trajectories ended at their first "
            "step: is there a time limit, which a rollback does not set back? take "
            "it out"
        )


# ------------------------------------------ step 2: training pairs (4.1, 4.2; S4.1-02 ... S4.1-09)

# A pair is a triple (s_1, s_2, y): two frames, and y = 1 where they are similar (S4.1-07).


def pairs_within(frames, n, N, rng):
    """Figure 2 (a), (b): for each state of a trajectory (T, H, W) a similar one, and a dissimilar
    one if there is any, each uniform among those of the same trajectory (R17)."""
    pairs = []
    position = np.arange(len(frames))
    for i in range(len(frames)):
        distance = np.abs(position - i)
        similar = np.flatnonzero(distance < n)  # S4.1-03; i itself included, as 0 < n (R30)
        pairs.append((frames[i], frames[rng.choice(similar)], 1))
        dissimilar = np.flatnonzero(distance > N)  # S4.1-04; between the two none (S4.1-05)
        if len(dissimilar) > 0:
            pairs.append((frames[i], frames[rng.choice(dissimilar)], 0))
    return pairs


def pairs_with_prefix(frames, full_prefix, N, rng):
    """Figure 2 (c): for each state of a trajectory (T, H, W) a state of its full prefix, if there
    is any, uniform among those more than N steps away along the joined path (S4.2-22, S4.2-23,
    R16)."""
    pairs = []
    position = np.arange(len(full_prefix))
    for i in range(len(frames)):
        # The prefix ends with s_1, with which the trajectory begins. An empty one gives no pairs.
        distance = (len(full_prefix) - 1 + i) - position
        distant = np.flatnonzero(distance > N)
        if len(distant) > 0:
            pairs.append((frames[i], full_prefix[rng.choice(distant)], 0))
    return pairs


def balanced(pairs, rng):
    """As many similar as dissimilar pairs, drawn anew at each call, in random order (R17)."""
    similar = [pair for pair in pairs if pair[2] == 1]
    dissimilar = [pair for pair in pairs if pair[2] == 0]
    size = min(len(similar), len(dissimilar))
    chosen = [similar[k] for k in rng.permutation(len(similar))[:size]]
    chosen += [dissimilar[k] for k in rng.permutation(len(dissimilar))[:size]]
    return [in_either_order(chosen[k], rng) for k in rng.permutation(2 * size)]


def in_either_order(pair, rng):
    """The pair, or its states swapped: a prefix state that always came second would give its class
    away (R17)."""
    s_1, s_2, y = pair
    return (s_2, s_1, y) if rng.random() < 0.5 else pair


def stack_pairs(pairs):
    """Frames s_1 (B, H, W), frames s_2 (B, H, W), labels (B,)."""
    s_1, s_2, y = zip(*pairs, strict=True)
    return np.stack(s_1), np.stack(s_2), np.array(y)


# --------- step 3: the similarity model R (4.1, 6.1; S4.1-01, S4.1-08, S6.1-02, S6.1-03, S6.1-04)


class SimilarityModel(nn.Module):
    """R_w(s_1, s_2): one encoder embeds both frames, four fully connected layers classify the two
    embeddings (6.1). It is in evaluation mode except during `fit`, so that R of a pair depends on
    that pair alone (S4.1-01). shape: of a frame, (H, W) or (H, W, C)."""

    def __init__(self, config, shape, device="cpu"):
        super().__init__()
        self.epochs = config.epochs
        self.batch_size = config.r_batch
        self.device = device
        if config.small_networks:
            self.encoder = conv_encoder(SMALL, shape, config.embedding, batch_norm=True)
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
        self.to(device, memory_format=torch.channels_last)  # which is faster
        self.eval()
        self.optimiser = torch.optim.Adam(self.parameters(), lr=config.learning_rate, fused=True)

    def forward(self, s_1, s_2):
        """Frames (B, H, W) twice -> logits of R (B,)."""
        frames = to_input(np.concatenate([s_1, s_2]), self.device)  # (2B, C, H, W)
        e_1, e_2 = self.encoder(frames).chunk(2)  # (B, d) each
        return self.logits(e_1, e_2)

    def logits(self, e_1, e_2):
        """Embeddings (B, d) twice -> (B,)."""
        return self.head(torch.cat([e_1, e_2], dim=1)).squeeze(1)

    @torch.no_grad()
    def embed(self, frames):
        """Frames (T, H, W) uint8 -> embeddings (T, d)."""
        parts = [self.encoder(to_input(part, self.device)) for part in in_parts(frames)]
        return torch.cat(parts)

    @torch.no_grad()
    def score(self, e_1, e_2):
        """R of embeddings (K, d) with as many others, or with one (d,) -> (K,) in [0, 1]."""
        return torch.sigmoid(self.logits(e_1, e_2.expand_as(e_1))).cpu().numpy()

    def fit(self, pairs, rng):
        """Minimise the binary cross-entropy in `epochs` passes (R19), each over a balanced draw of
        its own. Returns the mean loss of the last; None where there are no pairs of both
        classes."""
        losses = []
        self.train()
        try:
            for _ in range(self.epochs):
                losses = []
                for batch in progress(batches(balanced(pairs, rng), self.batch_size), "train R"):
                    losses.append(self.update(*stack_pairs(batch)))
        finally:
            self.eval()  # also after Ctrl-C
        return float(np.mean(losses)) if losses else None

    def update(self, s_1, s_2, y):
        """One step on frames (B, H, W) twice and labels (B,). Returns the loss before it, the mean
        of -y log R - (1 - y) log(1 - R) (S4.1-08)."""
        labels = torch.from_numpy(y).float().to(self.device)
        loss = F.binary_cross_entropy_with_logits(self(s_1, s_2), labels)
        gradient_step(self.optimiser, loss, "R", max_norm=1.0)  # R18
        return loss.item()

    def rates(self, pairs, rng):
        """How often R > 0.5 is right, of at most 1,000 pairs: true positive rate and true negative
        rate; None and None where there are no pairs of both classes."""
        chosen = balanced(pairs, rng)[:1000]
        if not chosen:
            return None, None
        s_1, s_2, y = stack_pairs(chosen)
        R = self.score(self.embed(s_1), self.embed(s_2))
        return float(np.mean(R[y == 1] > 0.5)), float(np.mean(R[y == 0] <= 0.5))

    def get_extra_state(self):
        """What PyTorch's state_dict() keeps beside the weights."""
        return self.optimiser.state_dict()

    def set_extra_state(self, state):
        self.optimiser.load_state_dict(state)


# ------------------- step 4: the graph of clusters, prefixes, merge (4.2; S4.2-01 ... S4.2-29)


@dataclass
class Cluster(State):
    """v = (s, snap): the centre of a cluster, and its visits."""

    visits: int = 0  # states assigned to it, its own centre included (R11)


@dataclass(frozen=True)
class ParentArc:
    """An arc of E_parent, from a cluster to its parent, with the prefix as it was walked."""

    parent: int
    prefix: np.ndarray  # (k, H, W) from the parent's centre to the cluster's, both included
    actions: bytes  # they lead from the one to the other; numbered from 0


class Graph:
    """G. Clusters are numbered in the order of creation; number 0 is the initial one (S4.2-11).
    In what follows v, u, later and earlier are such numbers."""

    def __init__(self, initial_state):
        initial = Cluster(initial_state.frame, initial_state.snapshot, visits=1)
        self.clusters: dict[int, Cluster] = {0: initial}  # V
        self.arcs: dict[tuple[int, int], int] = {}  # E: (from, to) -> visits
        self.adjacent: dict[int, set[int]] = {0: set()}  # predecessors and successors (R8)
        # For each cluster but 0, and its ancestors, merged or not. No merge changes an entry, so
        # that distances along a prefix stay true, and its actions are pi^p of section 3.2 (R15).
        self.E_parent: dict[int, ParentArc] = {}
        self.next_number = 1  # of the cluster made next
        self.embeddings: dict[int, torch.Tensor] = {}  # (d,) of each centre, by the R of now

    def sampling_distribution(self):
        """sigma: the clusters, each with a probability inverse to its visits (6.1; S4.2-12)."""
        weights = np.array([1 / cluster.visits for cluster in self.clusters.values()])
        return list(self.clusters), weights / weights.sum()

    def embed_centres(self, similarity):
        """Embed all centres by the R of now (S4-03)."""
        frames = np.stack([cluster.frame for cluster in self.clusters.values()])
        self.embeddings = dict(zip(self.clusters, similarity.embed(frames), strict=True))

    def most_similar(self, ids, e_i, similarity, theta):
        """Of these clusters the one whose centre s has the greatest R(s, s_i), if that is above
        theta, else None (S4.2-03, S4.2-04). e_i: the embedding (d,) of s_i."""
        centres = torch.stack([self.embeddings[v] for v in ids])  # (K, d)
        scores = similarity.score(centres, e_i)  # (K,)
        best = int(scores.argmax())
        return ids[best] if scores[best] > theta else None

    def add_trajectory(self, tau, similarity, theta_sim):
        """Each state in order joins a cluster or makes one (S4.2-06); successive states of
        different clusters make an arc (S4.2-07, S4.2-08). tau.clusters then tells where each state
        went."""
        embeddings = similarity.embed(tau.frames)  # (T, d)
        tau.clusters = [tau.start]  # s_1 is its centre (R9)
        self.clusters[tau.start].visits += 1
        parent_at = 0  # index in tau of the parent's centre: the cluster last made, else s_1 (R13)
        for i in range(1, len(tau.frames)):
            previous = tau.clusters[i - 1]
            v = self.find(embeddings[i], previous, similarity, theta_sim)
            if v is None:
                v = self.create(tau, i, parent_at, embeddings[i])
                parent_at = i
            self.clusters[v].visits += 1  # S4.2-09; a new one had none
            if v != previous:
                self.add_arc(previous, v, visits=1)
            tau.clusters.append(v)

    def find(self, e_i, previous, similarity, theta_sim):
        """The cluster to which s_i belongs: the most similar of the previous one and those adjacent
        to it (S4.2-13, R8), else of all (R7), else None (S4.2-05). e_i: its embedding (d,)."""
        nearby = sorted({previous} | self.adjacent[previous])
        found = self.most_similar(nearby, e_i, similarity, theta_sim)
        if found is None:
            found = self.most_similar(list(self.clusters), e_i, similarity, theta_sim)
        return found

    def create(self, tau, i, parent_at, e_i):
        """Make a cluster of state i of tau, embedded as e_i (d,), and its arc to the parent, whose
        centre is state parent_at of tau (S4.2-01, S4.2-19, S4.2-20). Returns its number."""
        v = self.next_number
        self.next_number += 1
        prefix = tau.frames[parent_at : i + 1].copy()  # a view would keep the whole of tau
        actions = b"".join(tau.actions[parent_at + 1 : i + 1])
        self.clusters[v] = Cluster(prefix[-1], tau.snapshots[i])
        self.embeddings[v] = e_i
        self.adjacent[v] = set()
        self.E_parent[v] = ParentArc(tau.clusters[parent_at], prefix, actions)
        return v

    def add_arc(self, start, end, visits):
        """Add so many visits to the arc (start, end) (S4.2-10)."""
        self.arcs[start, end] = self.arcs.get((start, end), 0) + visits
        self.adjacent[start].add(end)
        self.adjacent[end].add(start)

    def lineage(self, v):
        """v and its ancestors but for the initial cluster, oldest first (S4.2-19)."""
        line = []
        while v != 0:
            line.append(v)
            v = self.E_parent[v].parent
        return line[::-1]

    def full_prefix(self, v):
        """The frames of s_init ... s on the way to the centre s of v, in the order of time; empty
        for the initial cluster (S4.2-21)."""
        if v == 0:
            return []
        frames = [self.clusters[0].frame]
        for u in self.lineage(v):
            frames += list(self.E_parent[u].prefix[1:])  # without the parent's centre
        return frames

    def actions_to(self, v):
        """The actions that lead from s_init to the centre of v: pi^p of section 3.2 (S3.2-03)."""
        return b"".join(self.E_parent[u].actions for u in self.lineage(v))

    def merge(self, similarity, theta_merge):
        """In the order of creation, each cluster merges into the most similar surviving earlier one
        with R(earlier, later) > theta_merge (S4.2-24, S4.2-25; our reading of all pairs, R14). The
        earlier one keeps its centre (S4.2-28) and inherits visits (S4.2-27) and arcs. Returns
        {later: earlier}."""
        merged = {}
        survivors = [0]
        for later in list(self.clusters)[1:]:
            e_later = self.embeddings[later]
            earlier = self.most_similar(survivors, e_later, similarity, theta_merge)
            if earlier is None:
                survivors.append(later)
            else:
                merged[later] = earlier
        for later, earlier in merged.items():
            absorbed = self.clusters.pop(later)
            self.clusters[earlier].visits += absorbed.visits
        self.redirect_arcs(self.arcs, merged)
        # Of E_parent only the lineages of living clusters are kept (R15; S4.2-29).
        needed = {u for v in self.clusters for u in self.lineage(v)}
        self.E_parent = {v: arc for v, arc in self.E_parent.items() if v in needed}
        return merged

    def redirect_arcs(self, arcs, merged):
        """Whatever arc was incident to a cluster is incident to the one it merged into; between the
        two there is none (S4.2-26)."""
        self.arcs = {}
        self.adjacent = {v: set() for v in self.clusters}
        for (start, end), visits in arcs.items():
            start = merged.get(start, start)
            end = merged.get(end, end)
            if start != end:
                self.add_arc(start, end, visits)

    def state_dict(self):
        """G without its embeddings, which each iteration makes anew. Frames are tensors: PyTorch
        loads no arrays with weights_only."""
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
        self.redirect_arcs(state["arcs"], merged={})


# ------------------------------------------------------- step 5: novelty (4.2; S4.2-14, S6.1-14)


class RND(nn.Module):
    """Random network distillation (Burda et al. 2019): a predictor learns the output of a fixed
    random target network; its error is large on states unlike those it was trained on."""

    def __init__(self, config, shape, device="cpu"):
        super().__init__()
        d = config.embedding
        layers = SMALL if config.small_networks else NATURE
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
        self.optimiser = torch.optim.Adam(self.predictor.parameters(), lr=config.learning_rate)
        self.pixels = RunningMeanStd(shape=shape)  # over all states trained on
        self.recent_errors = deque(maxlen=5)  # one entry an iteration (R4); empty: untrained

    def forward(self, frames):
        """Frames (B, H, W) -> the predictor's mean squared errors (B,), on observations
        standardised and clipped to +-5 (R4)."""
        z = (frames - self.pixels.mean) / np.sqrt(self.pixels.var + 1e-8)
        z = z.clip(-5, 5).astype(np.float32)
        x = channels_first(torch.from_numpy(z).to(self.device))  # (B, C, H, W)
        return (self.predictor(x) - self.target(x)).square().mean(1)

    @torch.no_grad()
    def errors(self, frames):
        """Frames (T, H, W) -> errors (T,)."""
        return np.concatenate([self(part).cpu().numpy() for part in in_parts(frames)])

    def reward(self, frames):
        """The intrinsic reward, frames (T, H, W) -> (T,): by how many standard deviations of the
        latest iterations' errors an error exceeds their mean (R4). It changes nothing. Before the
        first training nothing is novel (R6)."""
        if not self.recent_errors:
            return np.full(len(frames), -np.inf)
        recent = np.concatenate(self.recent_errors)
        return (self.errors(frames) - recent.mean()) / (recent.std() + 1e-8)

    def fit(self, trajectories, rng):
        """One pass over the frames of trajectories, (T, H, W) each; before it the pixels' mean and
        variance are updated. The errors after it scale the next iterations' rewards (R4). Returns
        the mean loss."""
        for frames in trajectories:
            self.pixels.update(frames)
        states = [frame for frames in trajectories for frame in frames]
        losses = []
        order = rng.permutation(len(states))
        for batch in progress(batches(order, self.batch_size), "train RND"):
            losses.append(self.update(np.stack([states[k] for k in batch])))
        # Taken after the learning: before it, the large errors of one new room would widen the
        # scale and hide the next new room.
        self.recent_errors.append(np.concatenate([self.errors(frames) for frames in trajectories]))
        return float(np.mean(losses))

    def update(self, frames):
        """One step of the predictor on frames (B, H, W). Returns the mean error before it."""
        loss = self(frames).mean()
        gradient_step(self.optimiser, loss, "RND")
        return loss.item()

    def get_extra_state(self):
        """What PyTorch's state_dict() keeps beside the weights."""
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
    """17 convolutions, shortcuts not counted, and a linear layer (He et al. 2016): (B, C, H, W) ->
    (B, out)."""

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
        x = self.layers(x)  # (B, 512, h, w)
        # As AdaptiveAvgPool2d(1), whose gradient is not deterministic on CUDA.
        return self.linear(x.mean((2, 3)))


def conv_norm(inputs, width, kernel, stride, padding):
    """A convolution and its batch normalisation, which has the bias."""
    conv = nn.Conv2d(inputs, width, kernel, stride, padding, bias=False)
    return [conv, nn.BatchNorm2d(width)]


# Width, kernel, stride, padding: of Burda et al., and the maze's.
NATURE = ((32, 8, 4, 0), (64, 4, 2, 0), (64, 3, 1, 0))
SMALL = ((16, 4, 4, 0), (32, 3, 2, 1), (32, 3, 2, 1))


def conv_encoder(layers, shape, out, batch_norm):
    """A stack of convolutions and a linear layer, for frames of a shape: (B, C, H, W) -> (B,
    out)."""
    modules = []
    channels = channels_of(shape)
    for width, kernel, stride, padding in layers:
        modules.append(nn.Conv2d(channels, width, kernel, stride, padding))
        if batch_norm:
            modules.append(nn.BatchNorm2d(width))
        modules.append(nn.ReLU(inplace=True))
        channels = width
    modules.append(nn.Flatten())
    example = torch.zeros(1, channels_of(shape), *shape[:2])
    try:
        features = nn.Sequential(*modules).eval()(example)  # batch normalisation learns nothing
    except RuntimeError:
        raise InputError(
            f"frames of {shape[0]} x {shape[1]} pixels are too small for the network: "
            "make them larger, or set small_networks"
        ) from None
    return nn.Sequential(*modules, nn.Linear(features.shape[1], out))


def dense(inputs, outputs):
    """A layer of R's head (R20)."""
    return [nn.BatchNorm1d(inputs), nn.ReLU(), nn.Linear(inputs, outputs)]


def channels_of(shape):
    return shape[2] if len(shape) == 3 else 1


def initialise(network, seed, number):
    """He's initialisation, and biases of 0. The number tells the networks of one seed apart."""
    generator = torch.Generator()
    generator.manual_seed(np.random.SeedSequence([seed, number]).generate_state(1).item())
    for layer in network.modules():
        if isinstance(layer, (nn.Conv2d, nn.Linear)):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu", generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def to_input(frames, device):
    """(B, H, W) or (B, H, W, C) uint8 -> (B, C, H, W) float in 0..1 (S6.1-02)."""
    return channels_first(torch.from_numpy(frames).to(device)).float() / 255


def channels_first(x):
    """(B, H, W) or (B, H, W, C) -> (B, C, H, W)."""
    return x.unsqueeze(1) if x.ndim == 3 else x.permute(0, 3, 1, 2)


# -------------------------------------------------------------------- what several parts use


def in_parts(frames, size=512):
    """Frames in parts that fit into memory at once."""
    return [frames[k : k + size] for k in range(0, len(frames), size)]


def batches(items, size):
    """Items, already shuffled, in batches of nearly equal sizes, at most `size`."""
    count = math.ceil(len(items) / size)
    return [items[k::count] for k in range(count)]


def gradient_step(optimiser, loss, name, max_norm=math.inf):
    """One step down the loss, its gradient at most max_norm long. Raises InputError if the loss is
    infinite or no number."""
    if not math.isfinite(loss.item()):
        raise InputError(f"the loss of {name} is {loss.item()}: give a lower learning rate")
    optimiser.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(optimiser.param_groups[0]["params"], max_norm)
    optimiser.step()


def check_budget(algorithm):
    budget = algorithm.config.steps
    if algorithm.steps >= budget:
        raise InputError(f"the budget of {budget:,} steps is spent: give more steps")


def full_coverage(env):
    """The number of units of full coverage; None where it is unknown."""
    return getattr(env, "full_coverage", None)


def progress_metrics(algorithm):
    """Where a run stands, and %Cov: visited units of all, where these are known (5; S5-03)."""
    full = full_coverage(algorithm.env)
    units = len(algorithm.discovered)
    return {
        "iteration": algorithm.iteration,
        "phase": "pretrain" if algorithm.pretraining else "explore",
        "steps": algorithm.steps,
        "units": units,
        "coverage": min(1.0, units / full) if full else None,  # a full count may be an estimate
    }


def statistics_state(statistics):
    """A RunningMeanStd, for a checkpoint."""
    return {
        "mean": torch.as_tensor(statistics.mean),
        "var": torch.as_tensor(statistics.var),
        "count": float(statistics.count),
    }


def load_statistics(statistics, state):
    statistics.mean = state["mean"].numpy()
    statistics.var = state["var"].numpy()
    statistics.count = state["count"]


def progress(items, what, total=None):
    """A bar over a long loop; silent where the output is no terminal."""
    return tqdm(items, desc=what, total=total, leave=False, disable=None)


# ##################################################################################################
# Nothing below this line belongs to the algorithm.
# ##################################################################################################

# ------------------------------------- the methods compared (6.2; S6.2-03, S6.2-04; R2, R25, R27)


class Baseline:
    """What the compared methods share with RbExplore: one count of steps, one coverage, and the
    interface that a run folder uses. A subclass has advance(rng): act and learn for one iteration,
    and return metrics."""

    pretraining = False

    def __init__(self, env_fn, config):
        self.config = config
        self.env = env_fn()
        check_contract(self.env, config.seed)
        self.s_init = self.reset()
        unit = unit_key(self.env.unit())
        self.iteration = 0
        self.steps = 0
        self.discovered = {} if unit is None else {unit: 0}

    def iterate(self) -> Iteration:
        """One iteration."""
        check_budget(self)
        self.iteration += 1
        metrics = self.advance(np.random.default_rng([self.config.seed, self.iteration]))
        return Iteration({**progress_metrics(self), **metrics})

    def reset(self):
        """Back to the start; gives its frame."""
        return np.array(self.env.reset(seed=self.config.seed)[0])

    def step(self, action):
        """One step, counted and covered as RbExplore's. Returns the frame, and whether the episode
        has ended."""
        action += int(self.env.action_space.start)
        frame, _, terminated, truncated, _ = self.env.step(action)
        self.steps += 1
        unit = unit_key(self.env.unit())
        if unit is not None:
            self.discovered.setdefault(unit, self.steps)
        return np.array(frame), bool(terminated or truncated)

    def state_dict(self):
        return {
            "iteration": self.iteration,
            "steps": self.steps,
            "discovered": dict(self.discovered),
        }

    def load_state_dict(self, state):
        self.iteration = state["iteration"]
        self.steps = state["steps"]
        self.discovered = dict(state["discovered"])


class Random(Baseline):
    """Uniform over the actions, always from the start, M episodes an iteration: nothing is
    stored."""

    def advance(self, rng):
        for _ in range(self.config.M):
            self.reset()
            length = min(self.config.trajectory_steps, self.config.steps - self.steps)
            for _ in range(length):
                _, ended = self.step(int(rng.integers(self.env.action_space.n)))
                if ended:
                    break
        return {}


class RNDBonus(RND):
    """The bonus of Burda et al. 2019: the error of RND on the state arrived at. R4's scale is not
    used."""

    def bonus(self, before, actions, after):
        """Frames (T, H, W), actions (T,), frames (T, H, W) -> (T,). The statistics of the pixels
        come first, as there is no error without them."""
        self.pixels.update(after)
        return self.errors(after)

    def learn(self, before, actions, after):
        """One step on a batch. Returns the losses by name."""
        return {"rnd_loss": self.update(after)}


class ICM(nn.Module):
    """The bonus of Pathak et al. 2017: the error of a forward model, in the features of an encoder
    that learns by the inverse model alone. Its layers are RND's."""

    BETA = 0.2  # the weight of the forward loss (Pathak)

    def __init__(self, config, shape, actions, device):
        super().__init__()
        d = config.embedding
        layers = SMALL if config.small_networks else NATURE
        self.actions = actions
        self.device = device
        self.encoder = conv_encoder(layers, shape, d, batch_norm=False)
        self.inverse_model = perceptron(2 * d, config.head_width, actions)
        self.forward_model = perceptron(d + actions, config.head_width, d)
        initialise(self, config.seed, 2)
        self.to(device)
        self.optimiser = torch.optim.Adam(self.parameters(), lr=config.learning_rate)

    def losses(self, before, actions, after):
        """Frames (B, H, W), actions (B,), frames (B, H, W) -> inverse and forward losses, (B,)
        each: their equations 3 and 5."""
        frames = to_input(np.concatenate([before, after]), self.device)
        phi, phi_next = self.encoder(frames).chunk(2)  # (B, d) each
        a = torch.from_numpy(actions).to(self.device)
        a_guess = self.inverse_model(torch.cat([phi, phi_next], dim=1))
        inverse = F.cross_entropy(a_guess, a, reduction="none")
        one_hot = F.one_hot(a, self.actions)
        phi_guess = self.forward_model(torch.cat([phi.detach(), one_hot], dim=1))
        forward = (phi_guess - phi_next.detach()).square().sum(1) / 2
        return inverse, forward

    @torch.no_grad()
    def bonus(self, before, actions, after):
        """Their equation 6, (T,), without its factor eta: PPO divides by the bonus's own scale."""
        parts = zip(in_parts(before), in_parts(actions), in_parts(after), strict=True)
        return np.concatenate([self.losses(*part)[1].cpu().numpy() for part in parts])

    def learn(self, before, actions, after):
        """One step on their equation 7, whose policy term is PPO's own. Returns the losses by
        name."""
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
    """Generalised advantage estimation (Schulman et al. 2016, equation 16): (T,) from rewards (T,),
    values (T,) of the states acted in, and the value of the state after. Returns go on beyond the
    end of an episode, as intrinsic ones do (Burda)."""
    following = np.append(values[1:], last_value)
    delta = rewards + gamma * following - values
    advantages = np.zeros(len(rewards))
    advantage = 0.0
    for t in reversed(range(len(rewards))):
        advantage = delta[t] + gamma * gae_lambda * advantage
        advantages[t] = advantage
    return advantages


class PPO(Baseline):
    """Proximal policy optimisation (Schulman et al. 2017) of a bonus alone, RND's or ICM's, by the
    settings of Burda et al. 2019, table 5 (R27), but for one actor, whose rollout is by default as
    long as that of their 128, and a policy that sees what RbExplore sees: one frame (5)."""

    GAMMA = 0.99  # discount of the intrinsic reward
    GAE_LAMBDA = 0.95
    PASSES = 4  # over a rollout
    MINIBATCHES = 4  # a pass
    CLIP = 0.1  # bound on the change of a probability
    ENTROPY = 0.001  # weight of the entropy
    VALUE = 0.5  # weight of the value's squared error (Burda's code)

    def __init__(self, env_fn, config, method, device):
        super().__init__(env_fn, config)
        self.device = device
        self.actions = int(self.env.action_space.n)
        shape = self.s_init.shape
        width = config.head_width
        layers = SMALL if config.small_networks else NATURE
        with torch.random.fork_rng(devices=[]):
            encoder = conv_encoder(layers, shape, width, batch_norm=False)
            head = nn.Linear(width, self.actions + 1)  # the logits of the policy, and the value
            self.network = nn.Sequential(encoder, nn.ReLU(), head)
            if method == "rnd":
                self.curiosity = RNDBonus(config, shape, device)
            else:
                self.curiosity = ICM(config, shape, self.actions, device)
        initialise(self.network, config.seed, 3)
        head.weight.data *= 0.01  # so that the first policy is uniform and the first values are 0
        self.network.to(device)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate)
        self.discounted_sum = 0.0  # of the bonus so far
        self.discounted_sums = RunningMeanStd()
        self.frame = self.s_init
        self.age = 0  # steps of this episode

    def policy(self, frames):
        """Frames (B, H, W) -> log-probabilities (B, actions), values (B,)."""
        out = self.network(to_input(frames, self.device))
        return F.log_softmax(out[:, :-1], dim=1), out[:, -1]

    @torch.no_grad()
    def act(self, frame, rng):
        """A sample of the policy: the action, its log-probability, and the value of the state."""
        log_p, value = self.policy(frame[None])
        log_p = log_p[0].cpu().numpy()
        action = int(np.argmax(log_p + rng.gumbel(size=self.actions)))
        return action, log_p[action], value.item()

    def advance(self, rng):
        """A rollout, and several passes over it, of PPO and of the bonus."""
        before, actions, after, log_p, values, last_value = self.rollout(rng)
        bonus = self.curiosity.bonus(before, actions, after)
        rewards = self.scaled(bonus)
        advantages = advantages_of(rewards, values, last_value, self.GAMMA, self.GAE_LAMBDA)
        returns = advantages + values
        size = math.ceil(len(actions) / self.MINIBATCHES)
        losses = []
        for _ in range(self.PASSES):
            for k in batches(rng.permutation(len(actions)), size):
                ppo = self.update(before[k], actions[k], log_p[k], advantages[k], returns[k])
                losses.append(ppo | self.curiosity.learn(before[k], actions[k], after[k]))
        means = {name: float(np.mean([row[name] for row in losses])) for name in losses[0]}
        return {"bonus": float(bonus.mean()), **means}

    def rollout(self, rng):
        """Frames (T, H, W), actions (T,), frames arrived at (T, H, W), log-probabilities (T,),
        values (T,), and the value of the state after. T ends with the budget (S6.2-04)."""
        T = min(self.config.rollout_steps, self.config.steps - self.steps)
        before = np.empty((T, *self.frame.shape), np.uint8)
        after = np.empty_like(before)
        actions = np.empty(T, np.int64)
        log_p = np.empty(T, np.float32)
        values = np.empty(T, np.float32)
        for t in progress(range(T), "rollout"):
            before[t] = self.frame
            actions[t], log_p[t], values[t] = self.act(self.frame, rng)
            self.frame, ended = self.step(int(actions[t]))
            after[t] = self.frame
            self.age += 1
            if ended or self.age >= self.config.episode_steps:
                self.frame = self.reset()
                self.age = 0
        _, _, last_value = self.act(self.frame, rng)
        return before, actions, after, log_p, values, last_value

    def scaled(self, bonus):
        """The bonus (T,) over the standard deviation of its discounted sums so far (Burda, 2.4)."""
        sums = np.empty(len(bonus))
        for t in range(len(bonus)):
            self.discounted_sum = self.GAMMA * self.discounted_sum + float(bonus[t])
            sums[t] = self.discounted_sum
        self.discounted_sums.update(sums)
        return bonus / np.sqrt(self.discounted_sums.var + 1e-8)

    def update(self, frames, actions, old_log_p, advantages, returns):
        """One step on B states: the clipped objective, the value's squared error and the entropy
        (Schulman et al. 2017, equations 7 and 9). Returns the losses by name."""
        log_p, values = self.policy(frames)
        old_log_p = torch.from_numpy(old_log_p).to(values)  # (B,)
        advantages = torch.from_numpy(advantages).to(values)
        returns = torch.from_numpy(returns).to(values)
        ratio = (log_p[range(len(actions)), actions] - old_log_p).exp()
        clipped = ratio.clamp(1 - self.CLIP, 1 + self.CLIP)
        gain = torch.min(ratio * advantages, clipped * advantages).mean()
        value_loss = (values - returns).square().mean()
        entropy = -(log_p.exp() * log_p).sum(1).mean()
        loss = self.VALUE * value_loss - gain - self.ENTROPY * entropy
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
            "frame": torch.from_numpy(self.frame),
            "snapshot": self.env.snapshot(),
            "age": self.age,
        }

    def load_state_dict(self, state):
        super().load_state_dict(state)
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.curiosity.load_state_dict(state["curiosity"])
        self.discounted_sum = state["discounted_sum"]
        load_statistics(self.discounted_sums, state["discounted_sums"])
        self.frame = state["frame"].numpy()
        roll_back(self.env, State(self.frame, state["snapshot"]))
        self.age = state["age"]


class Cells(nn.Module):
    """Go-Explore's cells without domain knowledge (Ecoffet et al. 2019) in the place of R: two
    frames are similar if they are equal in 11 x 8 pixels of 8 grey levels. Nothing is learned."""

    def embed(self, frames):
        """Frames (T, H, W) uint8 -> cells (T, 88)."""
        cells = []
        for part in in_parts(frames):
            gray = to_input(part, "cpu").mean(1, keepdim=True)  # (B, 1, H, W)
            small = F.interpolate(gray, (8, 11), mode="area").flatten(1)
            cells.append((small * 8).clamp(max=7).byte())
        return torch.cat(cells)

    def score(self, e_1, e_2):
        """Cells (K, 88), and (K, 88) or (88,) -> (K,)."""
        return (e_1 == e_2).all(1).double().numpy()

    def rates(self, pairs, rng):
        return None, None

    def fit(self, pairs, rng):
        return None


METHODS = ("rbexplore", "rnd", "icm", "random", "cells")


def make_method(method, env_fn, config, device="cpu", executor=None):
    """RbExplore, or a method with its interface."""
    if method == "random":
        return Random(env_fn, config)
    if method in ("rnd", "icm"):
        return PPO(env_fn, config, method, device)
    algorithm = RbExplore(env_fn, config, device, executor)
    if method == "cells":
        algorithm.similarity = Cells()
    return algorithm


# ----------------------------------------------------------------------------- the run folder


class Run:
    """A run folder: config.json, metrics.csv, checkpoint.pt, trace.jsonl and the figures; and what
    one sees meanwhile. It has one owner: InputError where another process works in it.

    settings: what makes the run, for config.json; by default the configuration alone."""

    def __init__(self, folder, algorithm, settings=None, trace=False):
        self.folder = pathlib.Path(folder)
        self.algorithm = algorithm
        self.settings = settings or {"config": asdict(algorithm.config)}
        self.trace = trace
        self.rows = []
        self.trace_bytes = 0
        self.lock = filelock.FileLock(self.folder / ".lock", timeout=0)

    def begin(self):
        """Begin in a folder that is new or empty. Returns the run."""
        check_unused(self.folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.own()
        check_unused(self.folder)  # again, now that nobody else can begin in it
        self.write_settings()
        if self.trace:
            (self.folder / "trace.jsonl").touch()
        self.save()
        return self

    def resume(self):
        """Go on from the last complete iteration; what came after it is forgotten. Returns the
        run."""
        self.own()
        saved = [self.folder / "checkpoint.pt", self.folder / "metrics.csv"]
        if any(path.exists() for path in saved):  # else it was stopped as soon as it had begun
            self.load()
        trace = self.folder / "trace.jsonl"
        size = trace.stat().st_size if trace.exists() else 0
        if size < self.trace_bytes:
            raise InputError(
                f"{trace} is missing or cut short: put the whole file back, or begin "
                "anew with another --out"
            )
        if trace.exists():
            self.trace = True
            os.truncate(trace, self.trace_bytes)
        self.write_settings()
        self.save()
        return self

    def own(self):
        try:
            self.lock.acquire()
        except filelock.Timeout:
            raise InputError(
                f"{self.folder} is in use by another process: wait for its end, or "
                "choose another --out"
            ) from None

    def load(self):
        """Take the state of the last complete iteration from the checkpoint; writes nothing."""
        state = read_checkpoint(self.folder)
        if state["settings"] != fixed(self.settings):
            raise InputError(
                f"{self.folder / 'checkpoint.pt'} is of another configuration than "
                "config.json beside it: put the right one back"
            )
        try:
            self.algorithm.load_state_dict(state["algorithm"])
        except (KeyError, RuntimeError, TypeError, ValueError, AttributeError) as error:
            raise damaged(self.folder, error) from None
        self.rows = state["rows"]
        self.trace_bytes = state["trace_bytes"]

    def go(self, stop_at_full=False):
        """Iterate until the budget is spent, or all is covered if that is to be the end. Returns
        False after Ctrl-C, which goes back to the last complete iteration."""
        print(self.header())
        try:
            while not self.is_done(stop_at_full):
                began = time.monotonic()
                iteration = self.algorithm.iterate()
                self.keep(iteration, time.monotonic() - began)
                print(self.line(), flush=True)
        except KeyboardInterrupt:
            print("\nstopped: going back to the last complete iteration", flush=True)
            self.load()
            return False
        return True

    def is_done(self, stop_at_full):
        a = self.algorithm
        is_full = len(a.discovered) >= (full_coverage(a.env) or math.inf)
        return a.steps >= a.config.steps or (stop_at_full and is_full)

    def keep(self, iteration, seconds):
        """Keep what an iteration did: its row, its trace, the state after it."""
        row = dict(iteration.metrics)
        row["memory_mb"] = round(megabytes(self.algorithm, iteration), 3)
        row["seconds"] = round(seconds, 2)
        self.rows.append(row)
        if self.trace:
            with open(self.folder / "trace.jsonl", "ab") as file:
                file.write(json.dumps(trace_of(iteration)).encode() + b"\n")
                self.trace_bytes = file.tell()
        self.save()

    def save(self):
        state = {
            "settings": fixed(self.settings),
            "rows": self.rows,
            "trace_bytes": self.trace_bytes,
            "algorithm": self.algorithm.state_dict(),
        }
        content = io.BytesIO()  # not to the file: torch has an error of its own for a full disk
        torch.save(state, content)
        write_atomically(self.folder / "checkpoint.pt", content.getvalue())
        names = list(dict.fromkeys(name for row in self.rows for name in row))
        lines = [names] + [[as_cell(row.get(name)) for name in names] for row in self.rows]
        text = "".join(",".join(line) + "\n" for line in lines)
        write_atomically(self.folder / "metrics.csv", text.encode())

    def write_settings(self):
        write_atomically(self.folder / "config.json", json.dumps(self.settings, indent=1).encode())

    def header(self):
        a = self.algorithm
        full = full_coverage(a.env)
        target = f"{full} {unit_name(a.env)} to cover" if full else "full coverage is not known"
        headings = " ".join(f"{heading:>{width}}" for heading, width, _, _ in COLUMNS)
        return (
            f"{self.settings.get('method', 'rbexplore')}: {target}; seed {a.config.seed}; "
            f"{a.config.steps:,} steps, {a.config.pretrain_steps:,} of them pretraining; "
            f"run folder {self.folder}\n{headings}    left"
        )

    def line(self):
        """What is shown of the latest iteration, with a warning where R tells little."""
        row = self.rows[-1]
        cells = []
        for _, width, name, form in COLUMNS:
            value = row.get(name)
            cell = "-" if value is None else format(value, form)
            cells.append(f"{cell:>{width}}")
        recent = self.rows[-5:]
        steps_before = self.rows[-6]["steps"] if len(self.rows) > 5 else 0
        pace = sum(r["seconds"] for r in recent) / max(1, row["steps"] - steps_before)
        left = round(pace * (self.algorithm.config.steps - row["steps"]))
        cells.append(f"{left // 60:4}:{left % 60:02}")
        for name, finds in (("r_tpr", "new"), ("r_tnr", "known")):
            rate = row.get(name)
            if row["phase"] == "explore" and rate is not None and rate < 0.2:
                found = f"before its training R found nearly all {finds}"
                cells.append(f"\n       warning: {name} is {rate:.2f}: {found}")
        return " ".join(cells)

    def summary(self):
        a = self.algorithm
        full = full_coverage(a.env)
        seconds = sum(row["seconds"] for row in self.rows)
        text = f"{a.steps:,} steps, {seconds:.0f} s: {len(a.discovered)} {unit_name(a.env)}"
        if full:
            text += f" of {full}, {100 * progress_metrics(a)['coverage']:.1f} %; steps to "
            marks = steps_to(a.discovered, full)
            text += ", ".join(f"{mark} %: {step or 'not reached'}" for mark, step in marks.items())
        return text


COLUMNS = (  # heading, width, name in the row, format
    ("iter", 5, "iteration", "d"),
    ("phase", 8, "phase", "s"),
    ("steps", 9, "steps", ",d"),
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
BEGINNINGS = {".lock", "config.json.new"}  # what a run leaves that was killed before it began


def check_unused(folder):
    """Raise InputError for a folder that holds a run, or anything else; it is not touched."""
    if (folder / "config.json").exists():
        raise InputError(f"{folder} holds a run already: --resume it, or choose another --out")
    if folder.exists() and {path.name for path in folder.iterdir()} - BEGINNINGS:
        raise InputError(f"{folder} is not empty, and no run of ours: choose another --out")


def fixed(settings):
    """What makes the run, of its settings: the rest may change when it goes on."""
    free = ("workers", "rom", "state", "device", "versions")
    kept = {name: value for name, value in settings.items() if name not in free}
    kept["config"] = settings["config"] | {"steps": None}
    return kept


def write_atomically(path, content):
    """A reader finds the old file or the new one and never half of one, also after a kill, or where
    the disk is full."""
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


def read_checkpoint(folder):
    """The checkpoint in the folder. InputError: it is missing or damaged."""
    try:
        state = torch.load(folder / "checkpoint.pt", map_location="cpu", weights_only=True)
        return {name: state[name] for name in ("settings", "rows", "trace_bytes", "algorithm")}
    except Exception as error:  # torch raises many kinds for a file that is cut short
        raise damaged(folder, error) from None


def damaged(folder, error):
    path = folder / "checkpoint.pt"
    return InputError(
        f"{path} cannot be loaded ({type(error).__name__}): it is missing, "
        "damaged, or of another version; begin anew with another --out"
    )


def as_cell(value):
    return "" if value is None else str(value)


def trace_of(iteration):
    """What an iteration did, as plain data: where each trajectory began, how novel its states were
    and to which clusters they went, and what merged."""
    explored = []
    for tau in iteration.trajectories:
        novelty = [float(x) if np.isfinite(x) else None for x in tau.novelty]
        explored.append({"start": tau.start, "novelty": novelty, "clusters": tau.clusters})
    return {
        "iteration": iteration.metrics["iteration"],
        "explored": explored,
        "additional": [tau.start for tau in iteration.additional],
        "pairs": len(iteration.pairs),
        "merged": list(iteration.merged.items()),
    }


def megabytes(algorithm, iteration):
    """Frames and snapshots that the iteration and G held."""
    size = 0
    for tau in iteration.trajectories + iteration.additional:
        size += tau.frames.nbytes + sum(map(len, tau.snapshots))
    if isinstance(algorithm, RbExplore):
        graph = algorithm.graph
        size += sum(arc.prefix.nbytes for arc in graph.E_parent.values())
        size += sum(len(v.snapshot) for v in graph.clusters.values())
    return size / 2**20


def unit_name(env):
    return getattr(env, "unit_name", "units")


def steps_to(discovered, full):
    """Per cent of full coverage -> the step that reached it; None where none did."""
    times = sorted(discovered.values())
    marks = {}
    for mark in (50, 90, 100):
        needed = math.ceil(full * mark / 100)
        marks[mark] = times[needed - 1] if len(times) >= needed else None
    return marks


def verify(algorithm):
    """For each cluster replay its actions from s_init and restore its snapshot, and compare both
    with its centre, exactly (S3.2-01, S3.2-03). Returns a table, and whether all agree."""
    env = algorithm.env
    graph = algorithm.graph
    lines = [f"{'cluster':>9}{'visits':>9}{'steps from s_init':>19}   replayed   restored"]
    wrong = 0
    for v, cluster in graph.clusters.items():
        actions = graph.actions_to(v)
        frame, unit = play(env, cluster.snapshot, b"")
        restored = np.array_equal(frame, cluster.frame)
        frame, replayed_unit = play(env, algorithm.initial_state.snapshot, actions)
        replayed = np.array_equal(frame, cluster.frame) and replayed_unit == unit
        wrong += not (replayed and restored)
        answers = ["exact" if right else "DIFFERS" for right in (replayed, restored)]
        lines.append(f"{v:9}{cluster.visits:9,}{len(actions):19,}   {answers[0]:8}   {answers[1]}")
    total = len(graph.clusters)
    lines.append(f"{total - wrong} of {total} clusters are reached exactly, both ways")
    return "\n".join(lines), wrong == 0


def play(env, snapshot, actions):
    """Roll back and do the actions: the frame and the coverage unit then; no frame after an end."""
    frame = env.restore(snapshot)
    for action in actions:
        frame, _, terminated, _, _ = env.step(action + int(env.action_space.start))
        if terminated:
            return None, None
    return frame, unit_key(env.unit())


# -------------------------------------------------------------------------------- the figures


def draw(run):
    """Draw the figures of a run into its folder. Returns a line that names them, or why there are
    none: a figure that cannot be drawn never hides a finished run."""
    try:
        names = save_figures(run.folder, run_figures(run.algorithm))
    except Exception as error:
        return f"{run.folder}: figures could not be drawn ({type(error).__name__}: {error})"
    return f"{run.folder}: config.json, metrics.csv, checkpoint.pt, {', '.join(names)}"


def run_figures(a):
    """File name -> figure, of an algorithm as it stands."""
    figures = {"coverage.png": curves_figure({"coverage": [a.discovered]}, a.env, a.config)}
    level = Level(a.env, a.discovered)
    if level.boxes:
        title = f"{len(a.discovered)} {unit_name(a.env)} after {a.steps:,} steps (red: not visited)"
        figures["coverage_map.png"] = maps_figure(level, {title: a.discovered}, a.steps)
    if isinstance(a, RbExplore):
        figures["centres.png"] = centres_figure(a.graph)
        figures["route.gif"] = route_animation(a.graph)
        # G itself does not know units.
        units = {v: play(a.env, c.snapshot, b"")[1] for v, c in a.graph.clusters.items()}
        places = {v: level.boxes[unit] for v, unit in units.items() if unit in level.boxes}
        if places:
            figures["graph.png"] = graph_figure(a.graph, level, places)
    return figures


def save_figures(folder, figures):
    """Write them; returns their names."""
    for name, figure in figures.items():
        content = io.BytesIO()
        if name.endswith(".gif"):
            figure[0].save(content, "gif", save_all=True, append_images=figure[1:], duration=80)
        else:
            figure.savefig(content, format="png", dpi=120)
        write_atomically(folder / name, content.getvalue())
    return list(figures)


def new_figure(width, height):
    """A matplotlib figure by matplotlib's own defaults, not by the user's backend or settings."""
    os.environ["MPLBACKEND"] = "agg"  # a notebook sets one that matplotlib may refuse
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError(
            "figures need matplotlib: pip install matplotlib, or give --no-figures"
        ) from None
    matplotlib.rcdefaults()
    return Figure(figsize=(width, height), layout="constrained")


class Level:
    """Where units lie in a picture. boxes: unit -> (left, top, width, height): by the environment's
    level_map(), else squares at (x, y), those of a room, (..., x, y), in a panel of its own."""

    def __init__(self, env, units):
        self.picture = None
        if hasattr(env, "level_map"):
            self.picture, self.boxes = env.level_map()
        else:
            self.boxes = room_panels(units)
        corners = [(left + w, top + h) for left, top, w, h in self.boxes.values()]
        self.width, self.height = np.max(corners, axis=0) if corners else (1, 1)
        self.aspect = float(np.clip(self.height / self.width, 0.2, 1.5))  # to be legible

    def show(self, panel, title):
        panel.set(title=title, xticks=[], yticks=[], facecolor="0.15")
        panel.set(xlim=(0, self.width), ylim=(self.height, 0))
        if self.picture is not None:
            panel.imshow(self.picture, extent=(0, self.width, self.height, 0), aspect="auto")


def room_panels(units):
    """A box for each unit that ends with two whole numbers, or is one; the others have no place."""
    places = {}
    for unit in units:
        if len(unit) == 1:
            places[unit] = ((), unit[0], 0)
        elif len(unit) > 1:
            places[unit] = (unit[:-2], unit[-2], unit[-1])
    places = {u: place for u, place in places.items() if all(isinstance(z, int) for z in place[1:])}
    if not places:
        return {}
    rooms, xs, ys = zip(*places.values(), strict=True)
    order = sorted(set(rooms), key=str)
    across = math.ceil(math.sqrt(len(order)))
    boxes = {}
    for unit, (room, x, y) in places.items():
        k = order.index(room)
        left = k % across * (max(xs) - min(xs) + 2) + x - min(xs)
        top = k // across * (max(ys) - min(ys) + 2) + y - min(ys)
        boxes[unit] = (left, top, 1, 1)
    return boxes


def coverage_curve(discovered, grid, full):
    """Coverage after each number of steps of the grid: in %, or in units."""
    visited = np.searchsorted(sorted(discovered.values()), grid, "right")
    return np.minimum(100.0, visited * 100 / full) if full else visited


def curves_figure(runs, env, config):
    """Coverage against steps: for each variant the mean of its runs, and a band from their least to
    their most (S6.2-05). runs: variant -> first visits, unit -> step, of each run."""
    figure = new_figure(7, 4)
    panel = figure.subplots()
    full = full_coverage(env)
    grid = np.linspace(0, config.steps, 501).astype(int)
    if config.pretrain_steps:
        panel.axvspan(0, config.pretrain_steps, color="0.9", label="pretraining")
    for k, (variant, discovered) in enumerate(runs.items()):
        curves = np.stack([coverage_curve(d, grid, full) for d in discovered])  # (runs, grid)
        style = ("-", "--", "-.", ":")[k % 4]  # so that curves which coincide are both seen
        (drawn,) = panel.plot(grid, curves.mean(0), style, label=variant)
        least = curves.min(0)
        most = curves.max(0)
        panel.fill_between(grid, least, most, color=drawn.get_color(), alpha=0.2, linewidth=0)
    panel.set_xlabel("agent steps (exploration, additional, pretraining)")
    panel.set_ylabel(f"coverage, % of {full} {unit_name(env)}" if full else unit_name(env))
    panel.set(xlim=(0, config.steps), ylim=(0, 102 if full else None))
    panel.legend(loc="lower right")
    return figure


def maps_figure(level, found, steps):
    """Coverage maps: visited units in the colour of the step of the first visit, others crossed
    out. found: title -> first visits, unit -> step."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    across = min(3, len(found))
    down = math.ceil(len(found) / across)
    width = 10 if across == 1 else 5
    figure = new_figure(width * across + 1, (width * level.aspect + 0.5) * down)
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for panel in panels[len(found) :]:
        panel.axis("off")
    for panel, (title, discovered) in zip(panels, found.items(), strict=False):
        level.show(panel, title)
        tiles = []
        firsts = []
        for unit, (x, y, w, h) in level.boxes.items():
            if unit in discovered:
                tiles.append(Rectangle((x, y), w, h))
                firsts.append(discovered[unit])
            else:
                panel.plot([x, x + w], [y, y + h], color="tab:red", linewidth=1)
        colours = PatchCollection(tiles, cmap="viridis_r", alpha=0.7)
        colours.set_array(firsts)
        colours.set_clim(0, steps)
        panel.add_collection(colours)
    bar = figure.colorbar(colours, ax=panels.tolist(), label="step of the first visit", shrink=0.8)
    bar.solids.set_alpha(1)
    return figure


def graph_figure(graph, level, places):
    """G over the level: a disc for each cluster, its area by its visits; arcs fainter the rarer
    they are. places: cluster -> the box of its unit."""
    figure = new_figure(10, 10 * level.aspect + 0.5)
    panel = figure.subplots()
    level.show(panel, f"graph: {len(graph.clusters)} clusters, {len(graph.arcs)} arcs")
    at = {}
    crowd = Counter()
    for v, box in places.items():
        x, y, w, h = box
        radius = 0.3 if crowd[box] else 0.0  # clusters of one unit stand around its middle
        angle = 2.4 * crowd[box]
        at[v] = (x + w * (0.5 + radius * math.cos(angle)), y + h * (0.5 + radius * math.sin(angle)))
        crowd[box] += 1
    busiest = max(graph.arcs.values(), default=1)
    for (start, end), visits in graph.arcs.items():
        if start in at and end in at:
            share = math.sqrt(visits / busiest)  # most arcs are rare: they must not hide the others
            xs, ys = zip(at[start], at[end], strict=True)
            panel.plot(xs, ys, color="white", alpha=0.04 + 0.8 * share, linewidth=0.3 + 2 * share)
    most = max(v.visits for v in graph.clusters.values())
    sizes = [12 + 300 * graph.clusters[v].visits / most for v in at]
    xs, ys = zip(*at.values(), strict=True)
    discs = panel.scatter(xs, ys, sizes, list(at), cmap="plasma", edgecolors="black", zorder=3)
    figure.colorbar(discs, label="cluster, in the order of creation", shrink=0.8)
    return figure


def centres_figure(graph, most=80):
    """The centres of the clusters, at most so many, evenly from all, with number and visits."""
    ids = list(graph.clusters)
    shown = ids[:: math.ceil(len(ids) / most)]
    across = min(10, len(shown))
    down = math.ceil(len(shown) / across)
    figure = new_figure(across * 1.1 + 0.2, down * 1.3 + 0.4)
    figure.suptitle(f"{len(shown)} of {len(ids)} centres: number, visits", fontsize=9)
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
    """The way from s_init to the cluster that is furthest from it: frames of an animation."""
    from PIL import Image

    furthest = max(graph.clusters, key=lambda v: len(graph.actions_to(v)))
    states = graph.full_prefix(furthest) or [graph.clusters[0].frame]
    scale = max(1, 256 // max(states[0].shape[:2]))
    frames = [viewable(s).repeat(scale, axis=0).repeat(scale, axis=1) for s in states]
    return [Image.fromarray(frame) for frame in frames]


# ---------------------- the experiments (6.2, 6.3; S6.2-05, S6.2-06, S6.3-01, S6.3-02, S6.3-03)

EXPERIMENTS = {  # variant -> what its runs alone have on the command line
    "methods": {method: [f"--method={method}"] for method in METHODS},
    "ablation": {"rbexplore": [], "no-merge": ["--no-merge"], "no-prefix": ["--no-prefix"]},
    "theta-merge": {f"theta-merge-{x}": [f"--theta-merge={x}"] for x in ("0.25", "0.5", "0.75")},
}


def runs_of(args):
    """(variant, seed) -> the command line of that run: what `args` says, then the variant's own."""
    shared = ["--no-figures"]
    for name, value in vars(args).items():
        flag = name.replace("_", "-")
        if value is None or name in ("experiment", "seeds", "seed", "out", "no_figures"):
            continue
        if isinstance(value, bool):
            shared.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            shared.append(f"--{flag}={value}")
    first = args.seed or 0
    runs = {}
    for seed in range(first, first + (args.seeds or 3)):
        for variant, options in EXPERIMENTS[args.experiment].items():
            out = f"--out={experiment_folder(args)}/{variant}-{seed}"
            runs[variant, seed] = [*shared, *options, f"--seed={seed}", out]
    return runs


def experiment_folder(args):
    return pathlib.Path(args.out or f"runs/{args.experiment}-{args.env or 'maze'}")


def experiment(args):
    """All runs, side by side where there are cores; then what they found. A run that fails is named
    when all others are done."""
    runs = {key: parser().parse_args(command) for key, command in runs_of(args).items()}
    for run in runs.values():
        check_same(run)
    settings = settings_of(next(iter(runs.values())))
    env = make_env(settings["env"], **options_of(settings))  # its errors show before any run
    side_by_side = max(1, cores() // (settings["workers"] * settings["threads"]))
    where = f"in {experiment_folder(args)}, the log of each beside its folder"
    print(f"{len(runs)} runs, {side_by_side} at a time, {where}", flush=True)
    with ThreadPoolExecutor(side_by_side) as pool:
        jobs = [pool.submit(run_apart, command) for command in runs_of(args).values()]
        try:
            codes = [job.result() for job in jobs]
        except BaseException:  # Ctrl-C: no run is begun any more, and those that run are ended
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise
    found = {}
    failed = []
    for ((variant, seed), run), code in zip(runs.items(), codes, strict=True):
        if code == 0:
            discovered = read_checkpoint(pathlib.Path(run.out))["algorithm"]["discovered"]
            found.setdefault(variant, {})[seed] = discovered
        else:
            failed.append(f"{run.out} (exit code {code})")
    if found:
        report(args, env, Config(**settings["config"]), found)
    env.close()
    if failed:
        raise InputError(
            f"failed, as their logs tell: {', '.join(failed)}; the same command tries these again"
        )
    return 0


def check_same(run):
    """Raise InputError where the folder of a run holds one of another configuration."""
    if not (pathlib.Path(run.out) / "config.json").exists():
        return
    found = recorded_settings(run.out, parser().parse_args([]))
    wanted = settings_of(run)
    same_steps = found["config"]["steps"] == wanted["config"]["steps"]
    if fixed(found) != fixed(wanted) or not same_steps:
        raise InputError(f"{run.out} holds a run of another configuration: choose another --out")


def run_apart(command):
    """Do a run in a process of its own, or what is left of it. Returns its exit code."""
    process = multiprocessing.get_context("spawn").Process(target=run_into_log, args=(command,))
    process.start()
    process.join()
    word = "done" if process.exitcode == 0 else "failed"
    print(f"{parser().parse_args(command).out}: {word}", flush=True)
    return process.exitcode


def run_into_log(command):
    """In a process of its own: the run, its output in a file beside its folder."""
    end_with_parent()
    folder = pathlib.Path(parser().parse_args(command).out)
    if (folder / "config.json").exists():
        command = ["--resume", str(folder), "--no-figures"]
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (
        open(f"{folder}.log", "a", buffering=1) as log,
        contextlib.redirect_stdout(log),
        contextlib.redirect_stderr(log),
    ):
        sys.exit(main(command))


def end_with_parent():
    """End this process when the one that started it ends, also where that was killed."""

    def watch():
        multiprocessing.parent_process().join()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    threading.Thread(target=watch, daemon=True).start()


def report(args, env, config, found):
    """Curves, figures, and a line for each run. found: variant -> seed -> first visits."""
    folder = experiment_folder(args)
    full = full_coverage(env)
    grid = np.linspace(0, config.steps, 201).astype(int)
    rows = ["variant,seed,steps,coverage"]
    for variant, of_seed in found.items():
        for seed, discovered in of_seed.items():
            curve = coverage_curve(discovered, grid, full)
            rows += [f"{variant},{seed},{x},{y:.4f}" for x, y in zip(grid, curve, strict=True)]
            marks = f"% at the end; steps to {steps_to(discovered, full)}" if full else "units"
            print(f"{variant:17} seed {seed}: {curve[-1]:6.1f} {marks}")
    write_atomically(folder / "curves.csv", ("\n".join(rows) + "\n").encode())
    if args.no_figures:
        return
    runs = {variant: list(of_seed.values()) for variant, of_seed in found.items()}
    figures = {"curves.png": curves_figure(runs, env, config)}
    if args.experiment == "methods":
        maps = {f"{v}: {len(best(of))} {unit_name(env)}": best(of) for v, of in runs.items()}
        level = Level(env, {unit for discovered in maps.values() for unit in discovered})
        if level.boxes:
            figures["maps.png"] = maps_figure(level, maps, config.steps)
    print(f"{folder}: curves.csv, {', '.join(save_figures(folder, figures))}")


def best(runs):
    """Of a variant's runs the one that covers most at the end (S6.2-06)."""
    return max(runs, key=len)


def cores():
    """How many cores this process may use."""
    try:
        allowed = len(os.sched_getaffinity(0))
    except AttributeError:  # not every system has it
        allowed = os.cpu_count() or 1
    try:
        quota, period = pathlib.Path("/sys/fs/cgroup/cpu.max").read_text().split()
        return max(1, min(allowed, int(quota) // int(period)))  # of a container
    except (OSError, ValueError):
        return allowed


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
    add("--rom", "pop: the NES cartridge's file, which you bring")
    add("--state", "pop: a start state, gzip of the emulator's")
    add(
        "--method",
        "what explores (6.2): RbExplore; PPO of RND's or of ICM's bonus; random "
        "actions; RbExplore with Go-Explore's cells for R (default: rbexplore)",
        choices=METHODS,
    )
    add(
        "--config",
        "values of the fields below (default: maze for the maze, else paper)",
        choices=list(CONFIGS),
    )
    add("--out", "run folder (default: runs/<env>-<seed>)", metavar="RUN")
    add("--resume", "go on with the run in this folder; with --steps beyond its end", metavar="RUN")
    add(
        "--verify",
        "check that each cluster of this run is reached exactly, by its actions and by "
        "its snapshot; exit code 1 if one is not",
        metavar="RUN",
    )
    add(
        "--experiment",
        "do all runs of figures 4 and 5 (6.2) or 6 (6.3), or go on with them",
        choices=list(EXPERIMENTS),
    )
    add("--seeds", "with --experiment: runs of each variant, from --seed on (default: 3)", type=int)
    add("--stop-at-full", "end as soon as all is covered", **flag)
    add("--trace", "write what each iteration did to trace.jsonl", **flag)
    add("--no-figures", "draw none", **flag)
    add("--workers", "processes that walk; any number, same result (default: 1)", type=int)
    add("--threads", "of the arithmetic; another number, other roundings (default: 1)", type=int)
    add("--device", "where the networks are: cpu, cuda, cuda:1, ... (default: cpu)")
    group = p.add_argument_group("configuration", "In brackets the paper's value | the maze's.")
    for f in fields(Config):
        values = dict.fromkeys(str(getattr(config, f.name)) for config in CONFIGS.values())
        form = {"type": f.type, "metavar": f.type.__name__}
        if f.type is bool:
            form = {"action": argparse.BooleanOptionalAction}
        meaning = f"[{' | '.join(values)}] {f.metadata['meaning']}"
        group.add_argument("--" + f.name.replace("_", "-"), default=None, help=meaning, **form)
    return p


def settings_of(args):
    """What makes a run, and what is good to know of it: for config.json."""
    env = args.env or "maze"
    given = {f.name: getattr(args, f.name) for f in fields(Config)}
    given = {name: value for name, value in given.items() if value is not None}
    base = CONFIGS[args.config or ("maze" if env == "maze" else "paper")]
    method = args.method or "rbexplore"
    if method != "rbexplore":  # no R is learned, so nothing is spent on what serves it alone
        given |= {"pretrain_steps": 0, "L": 0}
    settings = {
        "method": method,
        "env": env,
        "level": args.level,
        "rom": absolute(args.rom),
        "state": absolute(args.state),
        "config": asdict(replace(base, **given)),
        "device": args.device or "cpu",
        "threads": 1 if args.threads is None else args.threads,
        "workers": 1 if args.workers is None else args.workers,
        "versions": versions(),
    }
    check_counts(settings)
    return settings


def check_counts(settings):
    for name in ("threads", "workers"):
        value = settings[name]
        if not isinstance(value, int) or not 1 <= value <= 1000:
            raise InputError(f"{name} is {value}: give a number from 1 to 1,000")


def absolute(path):
    return path and os.path.abspath(path)


def options_of(settings):
    """The options with which the environment is made."""
    options = {name: settings[name] for name in ("level", "rom", "state")}
    options["frame_size"] = settings["config"]["frame_size"]
    return {name: value for name, value in options.items() if value is not None}


def versions():
    return {
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "numpy": np.__version__,
        "gymnasium": gymnasium.__version__,
    }


def recorded_settings(folder, args):
    """The settings of the run in the folder; of the command line what cannot change its result."""
    may_change = ["resume", "verify", "workers", "rom", "state", "no_figures"]
    may_change += ["device"] if args.verify else ["steps", "stop_at_full"]
    for name, value in vars(args).items():
        if value is not None and name not in may_change:
            raise InputError(
                f"--{name.replace('_', '-')} does not go with a run that was begun: "
                "leave it out, or begin anew with another --out"
            )
    path = pathlib.Path(folder) / "config.json"
    try:
        settings = json.loads(path.read_text())
        steps = Config(**settings["config"]).steps
        if settings.keys() != settings_of(parser().parse_args([])).keys():
            raise KeyError("settings")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{path} cannot be used ({type(error).__name__}): there is no run in "
            f"{folder}, or it is damaged, or of another version"
        ) from None
    if settings["versions"] != versions():
        print(
            f"note: {folder} was begun with {settings['versions']}, and this is {versions()}: "
            "the result may differ in the last digits"
        )
    if args.steps is not None and args.steps < steps:
        raise InputError(f"steps is {args.steps}: a run is extended, not cut; give {steps} or more")
    settings["config"]["steps"] = args.steps or steps
    settings["rom"] = absolute(args.rom) or settings["rom"]
    settings["state"] = absolute(args.state) or settings["state"]
    settings["device"] = args.device or settings["device"]
    if args.workers is not None:
        settings["workers"] = args.workers
    check_counts(settings)
    return settings


def prepare(settings):
    """Fix threads and determinism. Returns the algorithm, and the executor of its workers, if
    any."""
    torch.set_num_threads(settings["threads"])
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # nothing here reads any
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS wants it for that
    try:
        torch.zeros(1, device=settings["device"]).cpu()
    except (RuntimeError, AssertionError, ImportError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise InputError(
            f"device {settings['device']} cannot be used ({reason}): give another "
            "--device, such as cpu"
        ) from None
    executor = None
    if settings["workers"] > 1:
        context = multiprocessing.get_context("spawn")
        executor = ProcessPoolExecutor(settings["workers"], context, initializer=end_with_parent)
    env_fn = functools.partial(make_env, settings["env"], **options_of(settings))
    config = Config(**settings["config"])
    algorithm = make_method(settings["method"], env_fn, config, settings["device"], executor)
    return algorithm, executor


def main(argv=None):
    """The command line. Returns the exit code: 0; 1 where --verify finds a difference; 2 for what
    the user can put right; 130 after Ctrl-C."""
    try:
        return command(parser().parse_args(argv))
    except InputError as error:
        problem = str(error)
    except OSError as error:
        place = error.filename or "a file"  # a full disk names none
        problem = f"{place} cannot be written: {error.strerror}; make room, or choose another place"
    except BrokenProcessPool:
        problem = "a worker process died, of memory perhaps: --resume with fewer --workers"
    except MemoryError:
        problem = "out of memory: give smaller values, of M, L or trajectory_steps for example"
    except KeyboardInterrupt:
        return 130
    print(f"rbexplore: {problem}", file=sys.stderr)
    return 2


def command(args):
    """Do what the options say. Returns the exit code."""
    check_options(args)
    if args.experiment:
        return experiment(args)
    if args.verify:
        return verified(args)
    settings = recorded_settings(args.resume, args) if args.resume else settings_of(args)
    folder = args.resume or args.out or f"runs/{settings['env']}-{settings['config']['seed']}"
    algorithm, executor = prepare(settings)
    try:
        run = Run(folder, algorithm, settings, bool(args.trace))
        if args.resume:
            run.resume()
        else:
            run.begin()
        complete = run.go(args.stop_at_full)
        print(run.summary())
        if not args.no_figures:
            print(draw(run))
        run.lock.release()
    finally:
        algorithm.env.close()
        if executor:
            executor.shutdown(cancel_futures=True)
    if complete:
        return 0
    print(f"go on with: python rbexplore.py --resume {folder}")
    return 130


def check_options(args):
    """Raise InputError for options that are empty or do not go together."""
    for name, value in vars(args).items():
        if value == "":
            raise InputError(f"--{name.replace('_', '-')} is empty: give a value, or leave it out")
    if sum(map(bool, (args.experiment, args.resume, args.verify))) > 1:
        raise InputError("--experiment, --resume and --verify exclude each other: give one of them")
    if args.seeds is not None and not (args.experiment and args.seeds > 0):
        raise InputError(f"seeds is {args.seeds}: give 1 or more, with --experiment")
    if args.experiment and (args.method or args.trace or args.stop_at_full):
        raise InputError(
            "--experiment chooses the methods and does whole runs: leave --method, "
            "--trace and --stop-at-full out"
        )
    if not args.no_figures and not args.verify:
        new_figure(1, 1)  # so that a missing matplotlib shows now, and not at the end


def verified(args):
    """Check the run in a folder. Returns the exit code."""
    settings = recorded_settings(args.verify, args)
    if settings["method"] not in ("rbexplore", "cells"):
        raise InputError(f"{args.verify} is a run of {settings['method']}, which has no clusters")
    algorithm, _ = prepare(settings | {"workers": 1})
    Run(args.verify, algorithm, settings).load()
    table, good = verify(algorithm)
    algorithm.env.close()
    print(table)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
