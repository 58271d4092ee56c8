"""RbExplore, as its paper says it: Ugadiarov, Skrynnik, Panov, "Long-Term Exploration in Persistent MDPs".

The agent explores without rewards. It rolls back to stored snapshots of the environment, clusters the states
that it meets by a learned similarity R, and starts again from rarely visited clusters. An iteration has five
steps (section 4), the five calls of `RbExplore.iterate`:

    1  explore            sample M clusters of G, roll back to each, walk with pi_explore
    2  make_pairs         label pairs of states; walk on from L novel states for more pairs; prefixes
    3  train_similarity   train R on the pairs of this iteration
    4  update_graph       add the states of step 1 to G; every 15th iteration, merge similar clusters
    5  train_novelty      train the novelty module (RND) on the states of step 1

    symbol              here                        meaning
    s, snap             frame, snapshot             a state: its observation, and the simulator's saved bytes
    tau                 Trajectory                  states s_1 ... s_T that follow one another
    pi_explore          walk                        uniform over the actions
    R(s_1, s_2)         SimilarityModel             in [0, 1]: are the two states close in time?
    n, N                Config.n, .N                closer than n steps: similar; more than N apart: dissimilar
    G = (V, E)          Graph.clusters, .arcs       clusters, and the arcs between them
    v = (s, snap)       Cluster                     a cluster is its centre
    E_parent, prefix    Cluster.parent, .path       the cluster that v came from; the states in between
    theta_sim, _merge   Config.theta_sim, ...       thresholds on R: to join a cluster; to merge two
    B, beta, L          novel, Config.beta, .L      novel states; what is novel; how many of them are sampled
    M                   Config.M                    exploration trajectories an iteration

"S4.2-03" is a statement of the paper and names its test; "R13" is our reading where the paper is silent or
unclear. The README lists both.
"""

import argparse
import copy
import functools
import io
import itertools
import json
import math
import multiprocessing
import os
import pathlib
import platform
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field, fields, replace

import gymnasium
import numpy as np
import torch
from torch import nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint_sequential

from envs import InputError, Maze, check_contract, make_env

try:
    import resource
except ImportError:  # Windows has none
    resource = None

# ---------------------------------------------------------------------------- configuration (6.1; S6.1-05, 08, 09, 12)


def option(default, meaning, low=-10**9, high=10**9, choices=None):
    """A field of the configuration: its meaning is the text of --help, its range is checked."""
    return field(default=default, metadata={"meaning": meaning, "low": low, "high": high, "choices": choices})


def check_fields(config) -> None:
    """Raise InputError for a value of the wrong type or out of its range."""
    for f in fields(config):
        value, (low, high, choices) = getattr(config, f.name), (f.metadata[key] for key in ("low", "high", "choices"))
        types = (int, float) if f.type is float else f.type
        if not isinstance(value, types) or isinstance(value, bool) and f.type is not bool:
            raise InputError(f"{f.name} is {value!r}: it must be of type {f.type.__name__}")
        if f.type in (int, float) and not low <= value <= high:
            raise InputError(f"{f.name} is {value}: give a number from {low:,} to {high:,}")
        if choices and value not in choices:
            raise InputError(f"{f.name} is {value!r}: choose {' or '.join(choices)}")


@dataclass(frozen=True)
class Config:
    """The paper's configuration: the defaults are its values, the same for every level. A step is an agent step:
    one action, after the frameskip (R1). Raises InputError for a value that cannot work."""

    seed: int = option(0, "every generator is made from it", 0, 2**63)
    steps: int = option(15_000_000, "agent steps in all: exploration, additional, pretraining (6.2, R2)", 1)
    pretrain_steps: int = option(500_000, "steps of pretraining; then G is reset (6.1)", 0)
    M: int = option(30, "exploration trajectories an iteration (6.1)", 1)
    trajectory_steps: int = option(1500, "longest exploration trajectory, steps (6.1, R1)", 1)
    trim: int = option(0, "last states of a trajectory that G ignores (R10)", 0)
    L: int = option(1000, "novel states to walk on from, at most, an iteration (6.1)", 0)
    additional_steps: int = option(50, "longest additional trajectory, steps (R3)", 1)
    beta: float = option(2.5, "a state is novel above this intrinsic reward, standard deviations (6.1, R4)")
    novelty_window: int = option(5, "latest iterations whose errors standardise the reward (R4)", 1)
    keep_buffer: bool = option(False, "keep the novel states of earlier iterations in B (R5)")
    n: int = option(5, "pairs closer than this are similar, steps (6.1)", 1)
    N: int = option(25, "pairs further apart than this are dissimilar, steps (6.1)", 1)
    prefix: bool = option(True, "negative pairs with the full prefix (4.2; off: the ablation of 6.3)")
    epochs: int = option(4, "passes of R over the pairs of an iteration (R19)", 1)
    replay_iterations: int = option(0, "earlier iterations whose pairs R trains on again (R19)", 0)
    theta_sim: float = option(0.5, "a state joins a cluster above this R (6.1)", 0, 1)
    theta_merge: float = option(0.5, "two clusters merge above this R (6.1)", 0, 1)
    merge: bool = option(True, "merge clusters (4.2; off: the ablation of 6.3)")
    merge_every: int = option(15, "iterations from one merge to the next, those of pretraining counted (6.1, R28)", 1)
    max_clusters: int = option(0, "make no cluster beyond so many; 0: no bound, as in the paper", 0)
    frame_size: int = option(96, "height and width of an observation, pixels (5)", 32)
    encoder: str = option("resnet18", "network that embeds a frame for R (6.1)", choices=("resnet18", "small"))
    embedding: int = option(512, "size of a frame's embedding (6.1)", 1)
    head_width: int = option(512, "width of R's fully connected layers (R20)", 1)
    r_learning_rate: float = option(1e-4, "Adam's, for R (R18)", 0)
    r_anneal: bool = option(False, "R's learning rate falls to 0 within each iteration, linearly (R18)")
    r_batch: int = option(256, "pairs in a batch (R18)", 2)
    r_clip: float = option(1.0, "bound on the norm of R's gradient (R18)", 0)
    rnd_encoder: str = option("nature", "network of RND (R18)", choices=("nature", "small"))
    rnd_features: int = option(512, "size of RND's output (R18)", 1)
    rnd_learning_rate: float = option(1e-4, "Adam's, for RND (R18)", 0)
    rnd_batch: int = option(256, "states in a batch (R18)", 1)

    def __post_init__(self):
        check_fields(self)
        if self.n > self.N:
            raise InputError(f"n is {self.n} and N is {self.N}: a distance cannot be both similar and dissimilar; give n <= N")
        for name in ("trajectory_steps", "additional_steps"):
            if getattr(self, name) <= self.N:
                raise InputError(f"{name} is {getattr(self, name)}: a negative pair is more than N = {self.N} steps apart, "
                                 f"so there would be none; give at least {self.N + 1}")
        if self.pretrain_steps >= self.steps:
            raise InputError(f"pretrain_steps is {self.pretrain_steps} of {self.steps} steps: nothing is left to explore; "
                             "give more steps, or less pretraining")


# The maze's: what a small image, a small budget and a CPU need; the rest is the paper's.
MAZE = Config(steps=100_000, pretrain_steps=8_000, M=20, trajectory_steps=150, L=20, frame_size=32,
              encoder="small", embedding=64, head_width=128, r_learning_rate=1e-3, r_anneal=True, r_batch=128,
              rnd_encoder="small", rnd_features=64, rnd_learning_rate=1e-3, rnd_batch=64)
CONFIGS = {"paper": Config(), "maze": MAZE}

# ------------------------------------------------------------------------------------ the algorithm (4; S4-01 ... S4-07)

PURPOSES = ("init", "sample", "explore", "buffer", "additional", "pairs", "prefix", "rates", "similarity", "novelty")
_owners = itertools.count()


class RbExplore:
    """The algorithm of section 4.

    env_fn: makes the persistent environment (envs.PersistentEnv says what that is); where the executor has processes, it
    must pickle. executor: any concurrent.futures.Executor, to run trajectories in; the result is the same for each.
    tell: hears of progress (step, done, total), of every decision, and of each complete iteration (row).
    Raises InputError for an environment that breaks the contract, FloatingPointError for a loss that is not finite."""

    def __init__(self, env_fn: Callable, config: Config | None = None, device: str = "cpu", executor=None,
                 tell: Callable = lambda event, **data: None):
        self.config, self.env_fn, self.executor, self.tell = config or Config(), env_fn, executor, tell
        self.env, self.owner = env_fn(), f"{os.getpid()}.{next(_owners)}"
        check_contract(self.env)
        self.s_init = self.env.reset(seed=self.config.seed)[0].copy()
        self.snap_init, self.unit_init = self.env.snapshot(), unit_key(self.env.unit())
        self.similarity = SimilarityModel(self.config, self.s_init.shape, device)
        self.novelty = RND(self.config, self.s_init.shape, device)
        self.graph = Graph(self.s_init, self.snap_init, self.config)
        self.phase, self.iteration, self.steps, self.exploration_steps = "pretrain", 0, 0, 0
        self.discovered: dict[tuple, int] = {}  # coverage unit -> the step at which it was first visited
        self.novel: list[bytes] = []  # B: snapshots of novel states
        self.replay: deque[Pairs] = deque(maxlen=self.config.replay_iterations)

    def run(self) -> "RbExplore":
        """Iterate until the budget of steps is spent."""
        while self.steps < self.config.steps:
            self.iterate()
        return self

    def iterate(self) -> dict:
        """One iteration: the paper's five steps in the paper's order. Returns its metrics."""
        check_budget(self)
        if self.phase == "pretrain" and self.steps >= self.config.pretrain_steps:
            self.restart()
        self.iteration += 1
        self.row = {"iteration": self.iteration, "phase": self.phase, "theta_sim": self.theta_sim()}
        self.tell("iteration", **self.row)

        trajectories = self.explore()
        pairs = self.make_pairs(trajectories)
        self.train_similarity(pairs)
        self.update_graph(trajectories)
        self.train_novelty(trajectories)

        self.row |= counts(self) | {"clusters": len(self.graph.clusters)}
        self.tell("row", row=self.row)
        return self.row

    def restart(self) -> None:
        """The end of pretraining: G is reset to s_init, R and RND are kept, coverage starts (6.1, R2, R6; S6.1-15)."""
        self.phase, self.novel, self.graph = "explore", [], Graph(self.s_init, self.snap_init, self.config)
        self.discovered |= {} if self.unit_init is None else {self.unit_init: self.steps}
        self.tell("restart")

    def theta_sim(self) -> float:
        """The threshold; in pretraining it rises linearly from 0 (6.1, R21; S6.1-13)."""
        share = self.steps / self.config.pretrain_steps if self.phase == "pretrain" else 1
        return self.config.theta_sim * share

    def seed(self, purpose: str, index: int = -1) -> list[int]:
        """A seed for each purpose of each iteration, so that nothing random is carried from one to the next."""
        return [self.config.seed, self.iteration, PURPOSES.index(purpose), index + 1]

    def rng(self, purpose: str) -> np.random.Generator:
        return np.random.default_rng(self.seed(purpose))

    def explore(self) -> list["Trajectory"]:
        """Step 1: sample M clusters, with replacement (R12), roll back to each, walk (S4-01, S4.2-12, S6.1-06, S6.1-11)."""
        ids, probabilities = self.graph.sampling_distribution()
        chosen = self.rng("sample").choice(ids, size=self.config.M, p=probabilities).tolist()
        self.tell("sample", clusters=ids, probabilities=probabilities.tolist(), chosen=chosen)
        trajectories = self.collect("explore", [self.graph.clusters[v].snapshot for v in chosen], self.config.trajectory_steps)
        for tau, v in zip(trajectories, chosen, strict=False):  # fewer, where the budget of steps ended
            tau.start = v
            check_rollback(tau, self.graph.clusters[v])
        return trajectories

    def collect(self, purpose: str, snapshots: list[bytes], steps: int) -> list["Trajectory"]:
        """Walk at most `steps` steps from each snapshot. Every step costs one, whatever it serves (R2), and none is taken
        beyond the budget (S6.2-04). Only exploration covers units (R25)."""
        end = self.config.pretrain_steps if self.phase == "pretrain" else self.config.steps
        trajectories: list[Trajectory] = []
        while len(trajectories) < len(snapshots) and self.steps < end:
            todo = list(range(len(trajectories), len(snapshots)))
            if len(todo) * steps > end - self.steps:  # they might not all fit: one at a time
                todo = todo[:1]
            jobs = [(snapshots[k], self.seed(purpose, k), min(steps, end - self.steps), purpose == "explore") for k in todo]
            for tau in walks(self, jobs):
                for unit in tau.units:
                    self.steps += 1
                    self.exploration_steps += purpose == "explore"
                    if purpose == "explore" and self.phase == "explore" and unit is not None:
                        self.discovered.setdefault(unit_key(unit), self.steps)
                trajectories.append(tau)
                self.tell("progress", step=purpose, done=len(trajectories), total=len(snapshots))
        return trajectories

    def make_pairs(self, trajectories: list["Trajectory"]) -> "Pairs":
        """Step 2: label pairs of exploration and of additional trajectories, and pairs with their prefixes (S4-02, S4.1-09)."""
        additional = self.additional_trajectories(trajectories)
        pairs, rng, prefix_rng = Pairs(), self.rng("pairs"), self.rng("prefix")  # so --no-prefix leaves the rest alone
        for source, taus in (("exploration", trajectories), ("additional", additional)):
            for tau in taus:
                pairs.add_trajectory(source, tau.frames, self.config, rng)
                if self.config.prefix and tau.start:  # from cluster 0, the initial one, there is none (S4.1-09, S4.2-21; R30)
                    prefix = self.graph.clusters[tau.start].path.states() + list(tau.since)
                    pairs.add_prefix(source, tau.frames, prefix, self.config, prefix_rng)
        self.tell("pairs", **pairs.counts)
        return pairs

    def additional_trajectories(self, trajectories: list["Trajectory"]) -> list["Trajectory"]:
        """Put novel states into B, sample L of it, walk on from them (S4.2-15 ... S4.2-18). They serve R alone."""
        self.novel = self.novel if self.config.keep_buffer else []
        before = len(self.novel)
        origin: dict[bytes, tuple[Trajectory, int]] = {}  # a novel state: the (latest) trajectory that met it, and where
        for k, tau in enumerate(trajectories):
            reward = self.novelty.reward(tau.frames)  # (T,)
            found = np.flatnonzero(reward > self.config.beta)
            self.novel += [tau.snapshots[i] for i in found]
            origin |= {tau.snapshots[i]: (tau, i) for i in found}
            if len(found):
                self.tell("novel", trajectory=k, states=found.tolist(), reward=reward[found].tolist())
        novel_share = (len(self.novel) - before) / sum(len(tau.frames) for tau in trajectories)
        sample = [self.novel[i] for i in self.rng("buffer").permutation(len(self.novel))[: self.config.L]]
        additional = self.collect("additional", sample, self.config.additional_steps)
        for tau, snapshot in zip(additional, sample, strict=False):  # fewer, where the budget of steps ended
            if snapshot in origin:  # else it is of an earlier iteration (keep_buffer), whose trajectories are gone
                met, i = origin[snapshot]
                tau.start, tau.since = met.start, met.frames[1 : i + 1]
        self.row |= {"novel_share": novel_share, "additional": len(additional)}
        return additional

    def train_similarity(self, pairs: "Pairs") -> None:
        """Step 3: train R on this iteration's pairs (S4-03, S4-06); first measure it on them, while they are unseen."""
        self.row |= rates(self.similarity, pairs, self.rng("rates"))
        training = Pairs.joined([*self.replay, pairs])  # `replay` keeps none by default (R19)
        self.row["r_loss"] = self.similarity.fit(training, self.config, self.rng("similarity"), self.tell)
        self.replay.append(pairs)

    def update_graph(self, trajectories: list["Trajectory"]) -> None:
        """Step 4: add the exploration trajectories to G; every 15th iteration then merge (S4-04, S6.1-10, S6.3-01)."""
        before = len(self.graph.clusters)
        self.graph.embed_centres(self.similarity)  # R has changed since: old embeddings are stale
        for k, tau in enumerate(trajectories):
            decisions = self.graph.add_trajectory(tau, self.similarity, self.row["theta_sim"])
            self.tell("assign", trajectory=k, start=tau.start, **decisions)
            self.tell("progress", step="update", done=k + 1, total=len(trajectories))
        self.row |= {"added": len(self.graph.clusters) - before, "merged": 0}
        if self.config.merge and self.iteration % self.config.merge_every == 0:
            merged = self.graph.merge(self.similarity, self.config.theta_merge)
            self.tell("merge", merged=merged)
            self.row["merged"] = len(merged)

    def train_novelty(self, trajectories: list["Trajectory"]) -> None:
        """Step 5: train RND, last, on the states of the exploration trajectories and no others (S4-05)."""
        self.row["rnd_loss"] = self.novelty.fit([tau.frames for tau in trajectories], self.rng("novelty"), self.tell)


# ----------------------------------------------------- step 1: trajectories of a persistent MDP (3.2, 4.2; S3.2-01, 02)


@dataclass
class Trajectory:
    """tau = (s_1, snap_1) ... (s_T, snap_T); the terminal state of a death is not one of them (R10)."""

    frames: np.ndarray  # (T, H, W) uint8
    snapshots: list[bytes]  # T; none for an additional trajectory
    actions: list[bytes]  # T; actions[t] lead from state t-1 to state t: one, or more across blank frames (R24)
    units: list[tuple | None]  # the coverage unit after each step: as many as steps were taken
    start: int | None = None  # the cluster it started from; for an additional one, that of the trajectory that met its s_1
    since: np.ndarray | tuple = ()  # (k, H, W) the states from that cluster's centre (exclusive) to s_1: additional ones only


def walk(env, snapshot: bytes, seed: list[int], steps: int, keep_snapshots: bool) -> Trajectory:
    """Roll back to `snapshot`, which costs no step, and follow pi_explore, uniform over the actions (6.1; S4.2-02), for
    `steps` steps or to the end of the episode (S6.1-07). The result depends on these arguments alone."""
    frames, snapshots, actions, units, since = [env.restore(snapshot).copy()], [snapshot], [b""], [], b""
    for action in np.random.default_rng(seed).integers(env.action_space.n, size=steps).tolist():
        frame, _, terminated, truncated, info = env.step(action + int(env.action_space.start))
        units.append(env.unit())
        since += bytes([action])
        if terminated:
            break
        if not info.get("blank"):  # a black transition frame is stepped and counted, but it is no state (R24)
            frames.append(frame.copy())
            actions.append(since)
            since = b""
            if keep_snapshots:
                snapshots.append(env.snapshot())
        if truncated:
            break
    return Trajectory(np.stack(frames), snapshots if keep_snapshots else [], actions, units)


# -------------------------------------------------------------------- step 2: training pairs (4.1; S4.1-02 ... S4.1-09)


@dataclass
class Pairs:
    """The training data D: pairs (s_1, s_2, y)."""

    states: list[np.ndarray] = field(default_factory=list)  # frames, (H, W) uint8
    index: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int64))  # (D, 2) s_1 and s_2 among `states`
    y: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))  # (D,) 1 similar, 0 dissimilar
    counts: Counter = field(default_factory=Counter)  # pairs of each kind

    def add_trajectory(self, source: str, frames: np.ndarray, config: Config, rng: np.random.Generator) -> None:
        """(a), (b) of figure 2: each state with a state less than n away, and one more than N away if there is one; both
        are drawn uniformly from those of the same trajectory (R17). frames: (T, H, W)."""
        T, i, base = len(frames), np.arange(len(frames)), len(self.states)
        near = rng.integers(np.maximum(i - (config.n - 1), 0), np.minimum(i + config.n, T))
        before = np.maximum(i - config.N, 0)  # so many states lie more than N before i: 0 ... i-N-1
        after = np.maximum(T - 1 - config.N - i, 0)  # and after it: i+N+1 ... T-1
        i_far = np.flatnonzero(before + after)
        k = rng.integers((before + after)[i_far])
        far = np.where(k < before[i_far], k, k - before[i_far] + i_far + config.N + 1)
        self.states += list(frames)
        self._add(f"{source} positive", base + i, base + near, 1, rng)
        self._add(f"{source} negative", base + i_far, base + far, 0, rng)

    def add_prefix(self, source: str, frames: np.ndarray, prefix: list[np.ndarray], config: Config,
                   rng: np.random.Generator) -> None:
        """(c) of figure 2: each state i of the trajectory added last with a state j of its full prefix, drawn from all that
        are more than N away along the joined path (S4.2-22, S4.2-23, R16)."""
        i, base = np.arange(len(frames)), len(self.states)
        # The prefix ends with the state that the trajectory begins with, so (P - 1 - j) + i steps lie in between.
        eligible = np.clip(len(prefix) - 1 - config.N + i, 0, len(prefix))
        i = np.flatnonzero(eligible)
        self.states += [prefix[j] for j in rng.integers(eligible[i])]
        self._add(f"{source} prefix", base - len(frames) + i, base + np.arange(len(i)), 0, rng)

    def _add(self, kind: str, s_1: np.ndarray, s_2: np.ndarray, y: int, rng: np.random.Generator) -> None:
        index = np.stack([s_1, s_2], axis=1)  # (k, 2)
        swap = rng.random(len(index)) < 0.5  # a prefix state always comes first: the order must not give it away (R17)
        index[swap] = index[swap, ::-1]
        self.index, self.y = np.concatenate([self.index, index]), np.append(self.y, np.full(len(index), y))
        self.counts[kind] += len(index)

    @staticmethod
    def joined(parts: list["Pairs"]) -> "Pairs":
        starts = np.cumsum([0] + [len(part.states) for part in parts])
        return Pairs([s for part in parts for s in part.states],
                     np.concatenate([part.index + start for part, start in zip(parts, starts, strict=False)]),
                     np.concatenate([part.y for part in parts]), sum((part.counts for part in parts), Counter()))

    def balanced(self, rng: np.random.Generator, most: int | None = None) -> np.ndarray:
        """As many positive as negative pairs, at most `most` of each, in random order: indices of pairs (R17)."""
        classes = [rng.permutation(np.flatnonzero(self.y == y)) for y in (0, 1)]
        size = min(*map(len, classes), most or len(self.y))
        return rng.permutation(np.concatenate([c[:size] for c in classes]))

    def frames(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The states s_1 and the states s_2 of the chosen pairs, (B, H, W) each."""
        return tuple(np.array([self.states[s] for s in self.index[chosen, side].tolist()]) for side in (0, 1))


# --------------------------------------------------- step 3: the similarity model R (4.1, 6.1; S4.1-08, S6.1-02 ... 04)


class SimilarityModel(nn.Module):
    """R_w(s_1, s_2): a shared encoder embeds both frames, four fully connected layers classify the two embeddings (6.1).
    In evaluation mode, save within `fit`: R of a pair then depends on nothing else (S4.1-01)."""

    def __init__(self, config: Config, shape: tuple, device: str = "cpu"):
        super().__init__()
        d, w, head = config.embedding, config.head_width, []
        with torch.random.fork_rng(devices=[]):  # torch initialises too, from its global generator, which stays as it is
            small = config.encoder == "small"
            self.encoder = convolutions(shape, d, SMALL, norm=True) if small else resnet18(channels_of(shape), d)
            for inputs, outputs in ((2 * d, w), (w, w), (w, w), (w, 1)):
                head += [nn.BatchNorm1d(inputs), nn.ReLU(inplace=True), nn.Linear(inputs, outputs)]  # R20
            self.head = nn.Sequential(*head)
        initialise(self, config.seed).to(device, memory_format=torch.channels_last).eval()  # which is faster
        self.device, self.optimiser = device, torch.optim.Adam(self.parameters(), lr=config.r_learning_rate)

    def forward(self, first: np.ndarray, second: np.ndarray) -> torch.Tensor:
        """Frames (B, H, W) and (B, H, W) -> logits (B,)."""
        embeddings = self.encoder(to_input(np.concatenate([first, second]), self.device))  # (2B, d)
        return self.head(torch.cat(embeddings.chunk(2), dim=1)).squeeze(1)

    @torch.no_grad()
    def embed(self, frames: np.ndarray) -> torch.Tensor:
        """Frames (T, H, W) uint8 -> embeddings (T, d)."""
        return torch.cat([self.encoder(to_input(part, self.device)) for part in chunks(frames)])

    @torch.no_grad()
    def probability(self, first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        """What the network says of embeddings (K, d) and (K, d) or (d,): (K,) in [0, 1]."""
        return torch.sigmoid(self.head(torch.cat([first, second.expand_as(first)], dim=1))).squeeze(1)

    @torch.no_grad()
    def score(self, first: torch.Tensor, second: torch.Tensor) -> np.ndarray:
        """R of embeddings (K, d) and (K, d) or (d,) -> (K,). R(s, s) is 1, as s is no step away from itself: else a state that
        the network finds unlike itself would make one more cluster at each visit (R29)."""
        rounding = 1e-5 * first.abs().amax(1)  # of embeddings of equal frames, which may come from batches of different sizes
        same = (first - second).abs().amax(1) <= rounding
        return torch.where(same, 1.0, self.probability(first, second)).cpu().numpy()

    def fit(self, pairs: Pairs, config: Config, rng: np.random.Generator, tell: Callable) -> float | None:
        """Minimise the binary cross-entropy, `epochs` passes. Returns the mean loss of the last; None without pairs.
        r_anneal lets the learning rate fall, so that the R that decides in step 4 hangs less on its last batches (R18)."""
        self.train()
        try:
            for epoch in range(config.epochs):
                order, losses = pairs.balanced(rng), []
                batches = np.array_split(order, math.ceil(len(order) / config.r_batch) or 1)
                for k, batch in enumerate(batches if len(order) else []):
                    done, total = epoch * len(batches) + k, config.epochs * len(batches)
                    self.optimiser.param_groups[0]["lr"] = config.r_learning_rate * (1 - config.r_anneal * done / total)
                    losses.append(self.update(*pairs.frames(batch), pairs.y[batch], config.r_clip))
                    tell("progress", step="train R", done=done + 1, total=total)
        finally:
            self.eval()
        return float(np.mean(losses)) if losses else None

    def update(self, first: np.ndarray, second: np.ndarray, y: np.ndarray, clip: float) -> float:
        """One step on a batch: frames (B, H, W) twice, labels (B,). Returns the loss: -y log R - (1 - y) log(1 - R)."""
        loss = F.binary_cross_entropy_with_logits(self(first, second), torch.from_numpy(y).float().to(self.device))
        return descend(self.optimiser, loss, "R", clip)


# ----------------------------------------- step 4: the graph of clusters, prefixes, merge (4.2; S4.2-01 ... S4.2-29)


@dataclass(frozen=True, eq=False)
class Path:
    """A prefix: the states from a parent's centre (exclusive) to a cluster's centre, just as they were walked.

    Linked to the parent's own it is the full prefix s_init ... s. It never changes, merge or not, so distances along it
    stay true, and its actions lead from s_init to s: they are the policy pi^p of section 3.2 (R15; S3.2-03)."""

    parent: "Path | None"
    frames: np.ndarray  # (k, H, W) uint8; the last one is the centre
    actions: tuple[bytes, ...]  # k; actions[t] lead to frames[t]

    def chain(self) -> list["Path"]:
        """The links from s_init to this one."""
        links = [self]
        while links[-1].parent:
            links.append(links[-1].parent)
        return links[::-1]

    def states(self) -> list[np.ndarray]:
        """The full prefix s_init ... s, in the order of time."""
        return [frame for link in self.chain() for frame in link.frames]

    def replay(self) -> bytes:
        """The actions that lead from s_init to s."""
        return b"".join(action for link in self.chain() for action in link.actions)


@dataclass(eq=False)
class Cluster:
    """v = (s, snap), and what G knows of it."""

    frame: np.ndarray  # s, the centre, (H, W) uint8
    snapshot: bytes
    path: Path
    parent: int | None  # its arc in E_parent; none for the initial cluster
    visits: int = 0  # states assigned to it, its own centre included (R11)


class Graph:
    """G. Clusters are numbered in the order of their creation; number 0 is (s_init, snap_init) (S4.2-11)."""

    def __init__(self, s_init: np.ndarray, snap_init: bytes, config: Config):
        self.trim, self.max_clusters = config.trim, config.max_clusters
        self.clusters = {0: Cluster(s_init, snap_init, Path(None, s_init[None], (b"",)), None, visits=1)}
        self.arcs: dict[tuple[int, int], int] = {}  # E: (from, to) -> visits
        self.adjacent: dict[int, set[int]] = {0: set()}  # clusters at the other end of an arc, either way (R8)
        self.created = self.assigned = 1  # clusters ever made; states ever assigned
        self.refused = 0  # clusters that max_clusters prevented

    def sampling_distribution(self) -> tuple[list[int], np.ndarray]:
        """sigma: the clusters, each with a probability inverse to its visits (6.1)."""
        weights = 1 / np.array([v.visits for v in self.clusters.values()])
        return list(self.clusters), weights / weights.sum()

    def embed_centres(self, similarity: SimilarityModel) -> None:
        self.centres = similarity.embed(np.stack([v.frame for v in self.clusters.values()]))  # (V, d)
        self.row = {v: row for row, v in enumerate(self.clusters)}

    def add_trajectory(self, tau: Trajectory, similarity: SimilarityModel, theta: float) -> dict[str, list]:
        """Assign every state in order: it joins a cluster, or makes one (S4.2-06). Returns the cluster of each state, the R
        that decided it, and each new cluster with its parent."""
        previous = parent = tau.start  # the first state is this cluster's centre (R9)
        self.visit(previous)
        clusters, scores, made, parent_at = [previous], [None], [], 0
        embeddings = similarity.embed(tau.frames)  # (T, d)
        for i in range(1, len(tau.frames) - self.trim):
            cluster, score = self.find(embeddings[i], previous, similarity, theta)
            if cluster is None:
                cluster = self.create(tau, i, parent, parent_at, embeddings[i])
                made.append((cluster, parent))
                parent, parent_at = cluster, i  # the parent is the cluster made last, else the start (R13)
            self.visit(cluster)
            if cluster != previous:
                self.add_arc(previous, cluster, 1)
            previous = cluster
            clusters.append(cluster)
            scores.append(score)
        return {"clusters": clusters, "R": scores, "made": made}

    def find(self, s_i: torch.Tensor, previous: int, similarity: SimilarityModel, theta: float) -> tuple[int | None, float]:
        """The cluster with R(centre, s_i) > theta and that R: the best adjacent to the previous one, or else the best of
        all, or else none (S4.2-03, 04, 05, 13; R7). s_i: (d,)."""
        for ids in (sorted(self.adjacent[previous] | {previous}), list(self.clusters)):
            scores = similarity.score(self.centres[[self.row[v] for v in ids]], s_i)
            best = int(scores.argmax())
            if scores[best] > theta:
                return ids[best], float(scores[best])
        if self.max_clusters and len(ids) >= self.max_clusters:
            self.refused += 1
            return ids[best], float(scores[best])
        return None, float(scores[best])

    def create(self, tau: Trajectory, i: int, parent: int, parent_at: int, s_i: torch.Tensor) -> int:
        """A cluster with state i of tau as its centre, and its prefix from its parent's centre (S4.2-01, 19, 20)."""
        since = slice(parent_at + 1, i + 1)
        path = Path(self.clusters[parent].path, tau.frames[since].copy(), tuple(tau.actions[since]))
        new, self.created = self.created, self.created + 1
        self.clusters[new] = Cluster(path.frames[-1], tau.snapshots[i], path, parent)
        self.adjacent[new], self.row[new] = set(), len(self.centres)
        self.centres = torch.cat([self.centres, s_i[None]])
        return new

    def visit(self, v: int) -> None:
        self.clusters[v].visits += 1
        self.assigned += 1

    def add_arc(self, a: int, b: int, visits: int) -> None:
        self.arcs[a, b] = self.arcs.get((a, b), 0) + visits
        self.adjacent[a].add(b)
        self.adjacent[b].add(a)

    def merge(self, similarity: SimilarityModel, theta: float) -> list[tuple[int, int, float]]:
        """Test all pairs: in the order of creation, each cluster joins the most similar earlier survivor with
        R(earlier, later) > theta (S4.2-24, 25; R14). Returns (survivor, merged, R) for each."""
        merged, kept = [], [0]
        for later in list(self.clusters)[1:]:
            scores = similarity.score(self.centres[[self.row[v] for v in kept]], self.centres[self.row[later]])
            best = int(scores.argmax())
            if scores[best] > theta:
                self.absorb(kept[best], later)
                merged.append((kept[best], later, float(scores[best])))
            else:
                kept.append(later)
        self.centres = self.centres[[self.row[v] for v in kept]]
        self.row = {v: row for row, v in enumerate(kept)}
        return merged

    def absorb(self, earlier: int, later: int) -> None:
        """The earlier cluster keeps its centre and inherits visits, arcs and children (S4.2-26 ... S4.2-29; R15)."""
        self.clusters[earlier].visits += self.clusters.pop(later).visits
        for a, b in [arc for arc in self.arcs if later in arc]:
            visits, ends = self.arcs.pop((a, b)), (earlier if a == later else a, earlier if b == later else b)
            if ends[0] != ends[1]:
                self.add_arc(*ends, visits)
        for other in self.adjacent.pop(later):
            self.adjacent[other].discard(later)
        for v in self.clusters.values():
            if v.parent == later:  # a parent stays older than its child, so no cycle can arise
                v.parent = earlier

    def check(self) -> None:
        """Assert the invariants of G."""
        ids, ends = list(self.clusters), {v: set() for v in self.clusters}
        assert ids[0] == 0 and ids == sorted(ids), "the initial cluster stays, and comes first"
        assert sum(v.visits for v in self.clusters.values()) == self.assigned, "visits are conserved"
        for (a, b), visits in self.arcs.items():
            assert a != b and visits > 0, "an arc was walked between two clusters"
            ends[a].add(b)
            ends[b].add(a)
        assert ends == self.adjacent, "adjacent clusters are the ends of arcs"
        for v, cluster in self.clusters.items():
            assert (cluster.parent is None) == (v == 0), "every cluster but the first has a parent"
            assert v == 0 or cluster.parent in self.clusters and cluster.parent < v, "which exists and is older"
            assert cluster.path.chain()[0] is self.clusters[0].path, "every full prefix begins with s_init"
            assert np.array_equal(cluster.path.frames[-1], cluster.frame), "and ends with the centre"


# -------------------------------------------------------------------------- step 5: novelty (4.2; S4.2-14, S6.1-14)


class RND:
    """Random network distillation (Burda et al. 2019): a predictor learns the output of a fixed random target network; its
    error is large on states unlike those it was trained on."""

    def __init__(self, config: Config, shape: tuple, device: str = "cpu"):
        layers, out = SMALL if config.rnd_encoder == "small" else NATURE, config.rnd_features
        with torch.random.fork_rng(devices=[]):
            self.target = convolutions(shape, out, layers, norm=False)
            self.predictor = nn.Sequential(copy.deepcopy(self.target), nn.ReLU(), nn.Linear(out, out), nn.ReLU(),
                                           nn.Linear(out, out))
        initialise(self.target, config.seed + 1).to(device)
        initialise(self.predictor, config.seed + 2).to(device)
        self.optimiser = torch.optim.Adam(self.predictor.parameters(), lr=config.rnd_learning_rate)
        self.device, self.batch = device, config.rnd_batch
        self.pixels = Moments()  # of each pixel, over all states trained on
        self.errors: deque[Moments] = deque(maxlen=config.novelty_window)  # of the error on the states just learned

    def distance(self, frames: np.ndarray) -> torch.Tensor:
        """Frames (B, H, W) -> the predictor's mean squared error (B,), on pixels standardised and clipped to +-5 (R4)."""
        x = channels_first(torch.from_numpy(self.pixels.standardise(frames).clip(-5, 5).astype(np.float32)).to(self.device))
        with torch.no_grad():
            goal = self.target(x)
        return (self.predictor(x) - goal).square().mean(1)

    @torch.no_grad()
    def reward(self, frames: np.ndarray) -> np.ndarray:
        """The intrinsic reward: frames (T, H, W) -> (T,), errors in standard deviations from the mean of the latest
        iterations' (R4). Changes nothing. Before the first training nothing is novel (R6)."""
        recent = Moments()
        for moments in self.errors:
            recent.join(moments)
        if not recent.count:
            return np.full(len(frames), -np.inf)
        return recent.standardise(np.concatenate([self.distance(part).cpu().numpy() for part in chunks(frames)]))

    def fit(self, trajectories: list[np.ndarray], rng: np.random.Generator, tell: Callable) -> float:
        """Update the normalisers and train the predictor, one pass; (T, H, W) each. Returns the mean loss.

        The errors that make a reward comparable are those of the states just learned, after learning (R4): measured before,
        the large errors of one new room would hide the next for as long as the window remembers them."""
        parts = [part for frames in trajectories for part in chunks(frames)]
        for part in parts:
            self.pixels.join(Moments(part))
        states, errors = [frame for frames in trajectories for frame in frames], []
        batches = np.array_split(rng.permutation(len(states)), math.ceil(len(states) / self.batch))
        for k, batch in enumerate(batches):
            errors.append(self.update(np.stack([states[s] for s in batch])))
            tell("progress", step="train RND", done=k + 1, total=len(batches))
        with torch.no_grad():
            self.errors.append(Moments(np.concatenate([self.distance(part).cpu().numpy() for part in parts])))
        return float(np.mean(np.concatenate(errors)))

    def update(self, frames: np.ndarray) -> np.ndarray:
        """One step of the predictor on a batch (B, H, W). Returns the errors before it (B,)."""
        error = self.distance(frames)
        descend(self.optimiser, error.mean(), "RND")
        return error.detach().cpu().numpy()


# ######################################################################################################################
# What the five steps stand on: counts and rates, worker processes, running moments, the layers of the networks (6.1, R18).
# ######################################################################################################################


def check_budget(a) -> None:
    if a.steps >= a.config.steps:
        raise InputError(f"the budget of {a.config.steps} steps is spent: give more steps to go on")


def counts(a) -> dict:
    """Steps so far, and %Cov: units visited, of those of full coverage where these are known (5; S5-03)."""
    full, units = getattr(a.env, "full_coverage", None), len(a.discovered)
    return {"steps": a.steps, "exploration_steps": a.exploration_steps, "units": units,
            "coverage": units / full if full else None}


def rates(similarity: SimilarityModel, pairs: Pairs, rng: np.random.Generator, most: int = 500) -> dict[str, float]:
    """How often the network's R > 0.5 is right, for at most `most` pairs of each class; empty without pairs."""
    chosen = pairs.balanced(rng, most)
    if not len(chosen):
        return {}
    first, second = map(similarity.embed, pairs.frames(chosen))
    right = (similarity.probability(first, second).cpu().numpy() > 0.5) == pairs.y[chosen]
    similar = pairs.y[chosen] == 1
    return {"r_accuracy": float(right.mean()), "r_true_positive": float(right[similar].mean()),
            "r_true_negative": float(right[~similar].mean())}


def unit_key(unit) -> tuple | None:
    """A coverage unit as a tuple of plain numbers or strings, or None."""
    try:
        key = None if unit is None else tuple(np.ravel(unit).tolist())
        hash(key)
    except (TypeError, ValueError):
        raise InputError(f"unit() gives {unit!r}: it must give a number, a string, a tuple of them, or None") from None
    return key


def walks(a: RbExplore, jobs: list[tuple]):
    """`walk` for each job, in their order: here, or in the executor's workers."""
    if a.executor:
        return a.executor.map(walk_remotely, [(a.owner, a.env_fn)] * len(jobs), jobs)
    return (walk(a.env, *job) for job in jobs)


def check_rollback(tau: Trajectory, start: Cluster) -> None:
    """Raise InputError for an environment that did not come back to the centre, or whose frames are of another kind."""
    if tau.frames.dtype != np.uint8 or not np.array_equal(tau.frames[0], start.frame):
        raise InputError("restore() did not give the frame of its snapshot again, or step() gives frames that are not uint8: see "
                         "PersistentEnv in envs.py")


_worker = threading.local()  # an environment for each process, or thread, of an executor


def walk_remotely(owner: tuple[str, Callable], job: tuple) -> Trajectory:
    """`walk` in a worker, which makes an environment at its first job for this owner, and keeps it."""
    if getattr(_worker, "owner", None) != owner[0]:
        if getattr(_worker, "env", None):
            _worker.env.close()
        _worker.owner, _worker.env = owner[0], owner[1]()
        _worker.env.reset()
    return walk(_worker.env, *job)


class Moments:
    """Count, mean and variance of all batches so far, joined exactly (Chan et al. 1979), in float64."""

    def __init__(self, batch: np.ndarray | None = None):
        self.count, self.mean, self.m2 = 0, np.zeros(()), np.zeros(())
        if batch is not None:  # (B, ...): moments of each entry
            self.count, self.mean = len(batch), batch.mean(0, dtype=np.float64)
            self.m2 = np.square(batch - self.mean).sum(0)

    def join(self, other: "Moments") -> "Moments":
        total, delta = self.count + other.count, other.mean - self.mean
        self.m2 = self.m2 + other.m2 + delta**2 * (self.count * other.count / total)
        self.mean, self.count = self.mean + delta * (other.count / total), total
        return self

    def standardise(self, x: np.ndarray) -> np.ndarray:
        return (x - self.mean) / np.maximum(np.sqrt(self.m2 / max(self.count, 1)), 1e-8)


def chunks(frames: np.ndarray, size: int = 512) -> list[np.ndarray]:
    return [frames[k : k + size] for k in range(0, len(frames), size)]


def to_input(frames: np.ndarray, device: str) -> torch.Tensor:
    """(B, H, W) or (B, H, W, C) uint8 -> (B, C, H, W) float in 0..1."""
    return channels_first(torch.from_numpy(frames).to(device)).float() / 255


def channels_first(x: torch.Tensor) -> torch.Tensor:
    return x.unsqueeze(1) if x.ndim == 3 else x.permute(0, 3, 1, 2)


class BasicBlock(nn.Module):
    """The residual block of ResNet-18 (He et al. 2016)."""

    def __init__(self, inputs: int, width: int, stride: int):
        super().__init__()
        self.residual = nn.Sequential(
            nn.Conv2d(inputs, width, 3, stride, 1, bias=False), nn.BatchNorm2d(width), nn.ReLU(inplace=True),
            nn.Conv2d(width, width, 3, 1, 1, bias=False), nn.BatchNorm2d(width))
        self.shortcut = nn.Sequential()
        if stride > 1:
            self.shortcut = nn.Sequential(nn.Conv2d(inputs, width, 1, stride, bias=False), nn.BatchNorm2d(width))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return F.relu(self.residual(x) + self.shortcut(x), inplace=True)


class SpatialMean(nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.mean((2, 3))  # as AdaptiveAvgPool2d(1), whose gradient is not deterministic on CUDA


class Frugal(nn.Sequential):
    """A Sequential that trains in less memory: it takes a batch in halves, the states s_1 and the states s_2, and has the
    backward pass compute most activations anew, not kept (which moves BatchNorm's running statistics twice a batch)."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if not self.training:
            return super().forward(x)
        return torch.cat([checkpoint_sequential(self, 3, half, use_reentrant=False) for half in x.chunk(2)])


def resnet18(channels: int, out: int) -> nn.Module:
    """17 convolutions and a linear layer: (B, C, H, W) -> (B, out)."""
    layers = [nn.Conv2d(channels, 64, 7, 2, 3, bias=False), nn.BatchNorm2d(64), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2, 1)]
    for inputs, width in ((64, 64), (64, 128), (128, 256), (256, 512)):
        layers += [BasicBlock(inputs, width, width // inputs), BasicBlock(width, width, 1)]
    return Frugal(*layers, SpatialMean(), nn.Linear(512, out))


SMALL = ((16, 4, 4, 0), (32, 3, 2, 1), (32, 3, 2, 1))  # width, kernel, stride, padding
NATURE = ((32, 8, 4, 0), (64, 4, 2, 0), (64, 3, 1, 0))  # Mnih et al. 2015, which Burda et al. 2019 use


def convolutions(shape: tuple, out: int, layers: tuple, norm: bool) -> nn.Module:
    """A stack of convolutions and a linear layer, for frames of this shape: (B, C, H, W) -> (B, out)."""
    modules, (height, width), channels = [], shape[:2], channels_of(shape)
    for planes, kernel, stride, pad in layers:
        modules += [nn.Conv2d(channels, planes, kernel, stride, pad)] + [nn.BatchNorm2d(planes)] * norm + [nn.ReLU(inplace=True)]
        height, width = ((side + 2 * pad - kernel) // stride + 1 for side in (height, width))
        channels = planes
    if min(height, width) < 1:
        raise InputError(f"frames of {shape[0]} x {shape[1]} are too small for the network: make them larger, or set encoder and "
                         "rnd_encoder to small")
    return nn.Sequential(*modules, nn.Flatten(), nn.Linear(channels * height * width, out))


def channels_of(shape: tuple) -> int:
    return shape[2] if len(shape) == 3 else 1


def initialise(module: nn.Module, seed: int) -> nn.Module:
    """He's initialisation, and biases of 0, from a generator of our own."""
    generator = torch.Generator().manual_seed(seed)
    for layer in module.modules():
        if isinstance(layer, (nn.Conv2d, nn.Linear)):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu", generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    return module


def descend(optimiser: torch.optim.Optimizer, loss: torch.Tensor, what: str, clip: float | None = None) -> float:
    """One step of the optimiser down the loss, its gradient clipped at the norm `clip`. Returns the loss before it."""
    if not math.isfinite(loss.item()):
        raise FloatingPointError(f"the loss of {what} is {loss.item()}: start again with a lower learning rate")
    optimiser.zero_grad()
    loss.backward()
    if clip is not None:
        nn.utils.clip_grad_norm_([w for group in optimiser.param_groups for w in group["params"]], clip)
    optimiser.step()
    return loss.item()


# ######################################################################################################################
# Nothing below this line belongs to the algorithm: the methods compared, the run folder, its figures, the command line.
# ######################################################################################################################

# ------------------------------------------------------------------- the methods compared (6.2; S6.2-03, S6.2-04, R2, R27)


class Baseline:
    """What the compared methods share with RbExplore: one step counter, one coverage (R2, R25), seeds by purpose, and the
    interface that the run folder uses. A subclass has advance(): spend the steps of one iteration, and learn from them."""

    run, seed, rng, phase = RbExplore.run, RbExplore.seed, RbExplore.rng, "explore"
    parts, moments = (), ()  # networks and optimisers, and statistics, which a checkpoint keeps

    def __init__(self, env_fn: Callable, config: Config):
        self.config, self.env, self.tell = config, env_fn(), lambda event, **data: None
        check_contract(self.env)
        self.s_init = self.env.reset(seed=config.seed)[0].copy()
        self.snap_init, unit = self.env.snapshot(), unit_key(self.env.unit())
        self.iteration = self.steps = self.exploration_steps = 0
        self.discovered: dict[tuple, int] = {} if unit is None else {unit: 0}

    def iterate(self) -> dict:
        """One iteration. Returns its metrics."""
        check_budget(self)
        self.iteration += 1
        self.row = {"iteration": self.iteration, "phase": self.phase}
        self.tell("iteration", **self.row)
        self.advance()
        self.row |= counts(self)
        self.tell("row", row=self.row)
        return self.row

    def step(self, action: int) -> tuple[np.ndarray, bool, bool]:
        """One step of the environment, counted and covered as RbExplore's: the frame, terminated, truncated."""
        frame, _, terminated, truncated, _ = self.env.step(action + int(self.env.action_space.start))
        self.steps, self.exploration_steps, unit = self.steps + 1, self.exploration_steps + 1, self.env.unit()
        if unit is not None:
            self.discovered.setdefault(unit_key(unit), self.steps)
        return frame, terminated, truncated


class Random(Baseline):
    """Uniform over the actions, always from the start, M episodes an iteration: nothing is stored or rolled back to."""

    def advance(self) -> None:
        rng = self.rng("explore")
        for _ in range(self.config.M):
            self.env.reset(seed=self.config.seed)
            for _ in range(min(self.config.trajectory_steps, self.config.steps - self.steps)):
                if any(self.step(int(rng.integers(self.env.action_space.n)))[1:]):
                    break


@dataclass(frozen=True)
class PPOConfig:
    """PPO's settings, the same for RND and ICM: Burda et al. 2019 (table 5, or their code), and Pathak et al. 2017 (R27)."""

    actors: int = option(128, "environments: snapshots that one environment takes turns at (Burda)", 1)
    rollout_steps: int = option(128, "steps of an actor an iteration (Burda)", 1)
    episode_steps: int = option(4500, "longest episode, steps: 18,000 frames (Burda)", 1)
    stack: int = option(4, "latest frames that policy and value see (Burda)", 1)
    gamma: float = option(0.99, "discount of the intrinsic reward (Burda)", 0, 1)
    gae_lambda: float = option(0.95, "lambda of GAE (Burda)", 0, 1)
    episodic: bool = option(False, "returns end with their episode; intrinsic ones do not (Burda)")
    learning_rate: float = option(1e-4, "Adam's, for PPO and ICM; RND has rnd_learning_rate (Burda)", 0)
    passes: int = option(4, "passes over a rollout (Burda: epochs)", 1)
    minibatches: int = option(4, "minibatches a pass (Burda)", 1)
    clip: float = option(0.1, "PPO's bound on the change of a probability (Burda)", 0)
    entropy: float = option(0.001, "weight of the entropy (Burda)", 0)
    value_weight: float = option(0.5, "weight of the value's squared error (Burda's code)", 0)
    standardise: bool = option(False, "advantages have mean 0 and deviation 1 in a minibatch; not so in Burda's code")
    bonus_share: float = option(0.25, "share of the experience that trains the bonus: 32 actors' of 128 (Burda)", 0, 1)
    hidden: int = option(448, "width of the layer before policy and value, and of ICM's models (Burda's code)", 1)
    icm_beta: float = option(0.2, "weight of ICM's forward loss; 1 - it of the inverse loss (Pathak)", 0, 1)
    __post_init__ = check_fields


# The maze's: 8 actors, so that 100,000 steps make 97 updates and not 6, each of which then has to count; one frame shows all
# that four would; no state of level 1 is more than 86 steps from the start.
PPO_CONFIGS = {"paper": PPOConfig(), "maze": PPOConfig(actors=8, episode_steps=150, stack=1, learning_rate=1e-3, standardise=True,
                                                       bonus_share=1.0, hidden=128)}


class RNDBonus:
    """Burda et al. 2019, 2.2 and 2.4: the error of RND, the one of RbExplore's novelty, on the state arrived at."""

    def __init__(self, config: Config, ppo: PPOConfig, shape: tuple, actions: int, device: str):
        self.rnd = RND(config, shape, device)
        self.parts, self.moments = (self.rnd.target, self.rnd.predictor, self.rnd.optimiser), (self.rnd.pixels,)

    @torch.no_grad()
    def reward(self, before: np.ndarray, actions: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Frames (B, H, W), actions (B,), frames (B, H, W) -> (B,). The pixels' statistics come first, as there is no error
        without them: the first rollout, of a policy still uniform, is Burda et al.'s random agent."""
        for part in chunks(after):
            self.rnd.pixels.join(Moments(part))
        return np.concatenate([self.rnd.distance(part).cpu().numpy() for part in chunks(after)])

    def update(self, before: np.ndarray, actions: np.ndarray, after: np.ndarray) -> dict[str, float]:
        return {"rnd_loss": float(self.rnd.update(after).mean())}


class ICM(nn.Module):
    """Pathak et al. 2017: the error of a forward model, in the features of an encoder that learns by the inverse model
    alone. Their frames, layers and width are RND's and PPO's here, so that nothing differs but the bonus."""

    def __init__(self, config: Config, ppo: PPOConfig, shape: tuple, actions: int, device: str):
        super().__init__()
        d, w, self.actions, self.beta, self.device = config.rnd_features, ppo.hidden, actions, ppo.icm_beta, device
        with torch.random.fork_rng(devices=[]):
            self.encoder = convolutions(shape, d, SMALL if config.rnd_encoder == "small" else NATURE, norm=False)
            self.inverse_model = nn.Sequential(nn.Linear(2 * d, w), nn.ReLU(), nn.Linear(w, actions))
            self.forward_model = nn.Sequential(nn.Linear(d + actions, w), nn.ReLU(), nn.Linear(w, d))
        self.optimiser = torch.optim.Adam(initialise(self, config.seed + 3).to(device).parameters(), lr=ppo.learning_rate)
        self.parts, self.moments = (self, self.optimiser), ()

    def losses(self, before: np.ndarray, actions: np.ndarray, after: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """Frames (B, H, W), actions (B,), frames (B, H, W) -> inverse and forward losses (B,), (B,): equations 3 and 5."""
        phi, phi_next = self.encoder(to_input(np.concatenate([before, after]), self.device)).chunk(2)  # (B, d) each
        a = torch.from_numpy(actions).to(self.device)
        inverse = F.cross_entropy(self.inverse_model(torch.cat([phi, phi_next], 1)), a, reduction="none")
        guess = self.forward_model(torch.cat([phi.detach(), F.one_hot(a, self.actions)], 1))  # (B, d)
        return inverse, (guess - phi_next.detach()).square().sum(1) / 2

    @torch.no_grad()
    def reward(self, before: np.ndarray, actions: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Equation 6, (B,), without its factor eta: PPO divides the reward by its own scale in any case."""
        parts = zip(chunks(before), chunks(actions), chunks(after), strict=True)
        return np.concatenate([self.losses(*part)[1].cpu().numpy() for part in parts])

    def update(self, before: np.ndarray, actions: np.ndarray, after: np.ndarray) -> dict[str, float]:
        """A step on equation 7, whose policy term is PPO's own."""
        inverse, forward = (loss.mean() for loss in self.losses(before, actions, after))
        descend(self.optimiser, (1 - self.beta) * inverse + self.beta * forward, "ICM")
        return {"inverse_loss": inverse.item(), "forward_loss": forward.item()}


def gae(rewards, values, last, ended, at_end, gamma: float, lam: float, episodic: bool) -> np.ndarray:
    """Generalised advantage estimation (Schulman et al. 2016, equation 16). All (T, K) but `last`, (K,): values of the states
    acted in, and of those after the rollout. An episodic return ends with its episode, with `at_end`: 0 after a death, the
    value of the last state where only time ran out. Others go on, with the value of the next episode's first state."""
    following, cut = np.concatenate([values[1:], last[None]]), ended & episodic
    advantages, tail = rewards + gamma * np.where(cut, at_end, following) - values, 0.0
    for t in reversed(range(len(rewards))):
        advantages[t] = tail = advantages[t] + gamma * lam * ~cut[t] * tail
    return advantages


class PPO(Baseline):
    """Proximal policy optimisation (Schulman et al. 2017) of a bonus, RNDBonus or ICM, alone: the environment's rewards are
    ignored. The actors are snapshots of one environment, which plays them in turn: emulators allow no second one."""

    def __init__(self, env_fn: Callable, config: Config, device: str, ppo: PPOConfig, bonus: Callable):
        super().__init__(env_fn, config)
        shape, self.n, self.ppo, self.device = self.s_init.shape, int(self.env.action_space.n), ppo, device
        self.channels, layers = channels_of(shape), SMALL if config.rnd_encoder == "small" else NATURE
        with torch.random.fork_rng(devices=[]):
            self.net = nn.Sequential(convolutions((*shape[:2], self.channels * ppo.stack), ppo.hidden, layers, norm=False),
                                     nn.ReLU(), nn.Linear(ppo.hidden, self.n + 1))
        initialise(self.net, config.seed + 4).to(device)
        self.net[-1].weight.data *= 0.01  # the first policy is uniform, the first values are 0
        self.optimiser = torch.optim.Adam(self.net.parameters(), lr=ppo.learning_rate)
        self.bonus = bonus(config, ppo, shape, self.n, device)
        self.sums, self.returns = np.zeros(ppo.actors), Moments()  # discounted sums of the bonus; their moments
        self.parts, self.moments = (self.net, self.optimiser, *self.bonus.parts), (self.returns, *self.bonus.moments)
        self.snapshots, self.ages = [self.snap_init] * ppo.actors, np.zeros(ppo.actors, np.int64)
        self.seen = np.stack([self.first(self.s_init)] * ppo.actors)  # (K, H, W, C * stack)

    def first(self, frame: np.ndarray) -> np.ndarray:
        """What is seen at the start of an episode: its frame, (H, W) or (H, W, C), `stack` times, (H, W, C * stack)."""
        return np.tile(frame.reshape(*frame.shape[:2], -1), self.ppo.stack)

    def act(self, seen: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, H, W, C * stack) -> log-probabilities (B, A), values (B,)."""
        out = self.net(to_input(seen, self.device))
        return F.log_softmax(out[:, :-1], 1), out[:, -1]

    @torch.no_grad()
    def one(self, k: int) -> tuple[np.ndarray, float]:
        """Log-probabilities (A,) and value of what actor k sees."""
        logp, value = self.act(self.seen[k : k + 1])
        return logp[0].cpu().numpy(), value.item()

    def advance(self) -> None:
        """A rollout, and several passes over it, of PPO and of the bonus."""
        p, rng, (seen, actions, logp, after, values, *ends) = self.ppo, self.rng("novelty"), self.rollout()
        size, before = actions.size, seen[..., -self.channels :].reshape(after.shape)
        transitions = [x.reshape(size, *x.shape[2:]) for x in (before, actions, after)]
        bonus = self.bonus.reward(*transitions)
        advantages = gae(self.scaled(bonus.reshape(actions.shape)), values, *ends, p.gamma, p.gae_lambda, p.episodic)
        experience = [x.reshape(size, *x.shape[2:]) for x in (seen, actions, logp, advantages, advantages + values)]
        losses: dict[str, list] = {"bonus": [bonus.mean()]}
        for _ in range(p.passes):
            for batch in np.array_split(rng.permutation(size), min(p.minibatches, size)):
                new = self.update(*(x[batch] for x in experience))
                kept = batch[rng.random(len(batch)) < p.bonus_share]
                if len(kept):
                    new |= self.bonus.update(*(x[kept] for x in transitions))
                for name, loss in new.items():
                    losses.setdefault(name, []).append(loss)
        self.row |= {name: float(np.mean(values)) for name, values in losses.items()}

    def rollout(self) -> tuple:
        """T steps of each of K actors, and none beyond the budget (S6.2-04)."""
        p, rng, left = self.ppo, self.rng("explore"), self.config.steps - self.steps
        T, K = max(1, min(p.rollout_steps, left // p.actors)), min(p.actors, left)
        seen, after = np.empty((T, K, *self.seen.shape[1:]), np.uint8), np.empty((T, K, *self.s_init.shape), np.uint8)
        actions, ended, last = np.empty((T, K), np.int64), np.zeros((T, K), bool), np.empty(K)
        logp, values, at_end = np.zeros((3, T, K))
        for k in range(K):
            self.env.restore(self.snapshots[k])
            for t in range(T):
                policy, values[t, k] = self.one(k)
                action = int((policy + rng.gumbel(size=self.n)).argmax())  # a sample of the policy
                seen[t, k], actions[t, k], logp[t, k] = self.seen[k], action, policy[action]
                after[t, k], terminated, truncated = self.step(action)
                self.ages[k] += 1
                self.seen[k] = np.roll(self.seen[k], -self.channels, -1)
                self.seen[k, ..., -self.channels :] = after[t, k].reshape(*self.seen.shape[1:3], -1)
                ended[t, k] = terminated or truncated or self.ages[k] >= p.episode_steps
                if ended[t, k]:
                    at_end[t, k] = 0 if terminated else self.one(k)[1]
                    self.seen[k], self.ages[k] = self.first(self.env.reset(seed=self.config.seed)[0]), 0
            self.snapshots[k], last[k] = self.env.snapshot(), self.one(k)[1]
            self.tell("progress", step="explore", done=k + 1, total=K)
        return seen, actions, logp, after, values, last, ended, at_end

    def scaled(self, bonus: np.ndarray) -> np.ndarray:
        """The bonus (T, K) over the standard deviation of its discounted sums so far, along the time of each actor (Burda et al.
        2019, 2.4, and their code)."""
        sums, K = np.empty(bonus.shape), bonus.shape[1]
        for t, now in enumerate(bonus):
            sums[t] = self.sums[:K] = self.ppo.gamma * self.sums[:K] + now
        self.returns.join(Moments(sums.ravel()))
        return bonus / max(math.sqrt(self.returns.m2 / self.returns.count), 1e-8)

    def update(self, seen, actions, logp, advantages, targets) -> dict[str, float]:
        """A step on B states: the clipped objective, the value's squared error and the entropy (equations 7 and 9)."""
        p, (new, values) = self.ppo, self.act(seen)
        logp, advantages, targets = (torch.from_numpy(x).to(values) for x in (logp, advantages, targets))  # (B,)
        if p.standardise:
            advantages = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-8)
        ratio = (new[range(len(actions)), actions] - logp).exp()
        gain = torch.min(ratio * advantages, ratio.clamp(1 - p.clip, 1 + p.clip) * advantages).mean()
        value_loss, entropy = (values - targets).square().mean(), -(new.exp() * new).sum(1).mean()
        descend(self.optimiser, p.value_weight * value_loss - gain - p.entropy * entropy, "PPO")
        return {"value_loss": value_loss.item(), "entropy": entropy.item()}


class Cells(nn.Module):
    """Cells in R's place: 1 for states of one cell, else 0. embed: frames (T, H, W) uint8 -> cells (T, d)."""

    def __init__(self, embed: Callable):
        super().__init__()
        self.embed, self.optimiser = embed, nn.Identity()  # nothing is trained: both have an empty state_dict
        self.fit = lambda *unused: None

    def probability(self, first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        """Cells (K, d) and (K, d) or (d,) -> (K,)."""
        return (first == second).all(1).double()

    def score(self, first: torch.Tensor, second: torch.Tensor) -> np.ndarray:
        return self.probability(first, second).numpy()


def coarse(frames: np.ndarray) -> torch.Tensor:
    """Cells without domain knowledge (Ecoffet et al. 2019): gray, 11 x 8 areas, 8 levels: (T, H, W) -> (T, 88) uint8."""
    areas = [F.interpolate(to_input(part, "cpu").mean(1, keepdim=True), (8, 11), mode="area") for part in chunks(frames)]
    return (torch.cat(areas).flatten(1) * 8).clamp(max=7).byte()


class ExactMaze(Maze):
    """The maze with its whole state, the snapshot, over the first pixels of each frame."""

    def _frame(self) -> np.ndarray:
        frame, state = super()._frame().copy(), np.frombuffer(self.snapshot(), np.uint8)
        frame[0, : len(state)] = state
        return frame


def exact(frames: np.ndarray) -> torch.Tensor:
    """Exact states as cells: (T, H, W) -> (T, W) uint8, the first row of ExactMaze's frames."""
    return torch.from_numpy(frames[:, 0].copy())


METHODS = ("rbexplore", "rnd", "icm", "random", "cells", "oracle")


def config_of(method: str, config: Config, **given) -> Config:
    """The configuration with the given values, less the steps that serve a learned R alone: pretraining, additional ones."""
    return replace(config, **given | ({} if method == "rbexplore" else {"pretrain_steps": 0, "L": 0}))


def make_method(method: str, env_fn: Callable, config: Config, device: str = "cpu", executor=None, ppo: PPOConfig | None = None):
    """RbExplore, or a method with its interface. Raises InputError for the oracle of anything but the maze."""
    config = config_of(method, config)
    if method in ("rnd", "icm"):
        return PPO(env_fn, config, device, ppo or PPOConfig(), RNDBonus if method == "rnd" else ICM)
    if method == "random":
        return Random(env_fn, config)
    if method == "oracle":
        maze = env_fn()
        if not isinstance(maze, Maze):
            raise InputError("--method oracle knows the exact states of the maze alone: give --env maze, or another method")
        env_fn = functools.partial(ExactMaze, maze.level, maze.frame_size)
    a = RbExplore(env_fn, config, device, executor)
    if method in ("cells", "oracle"):
        a.similarity = Cells(exact if method == "oracle" else coarse)
    return a


METRICS = ("iteration", "phase", "steps", "exploration_steps", "coverage", "units", "clusters", "added", "merged",
           "theta_sim", "r_loss", "r_accuracy", "r_true_positive", "r_true_negative", "novel_share", "additional",
           "rnd_loss", "bonus", "inverse_loss", "forward_loss", "value_loss", "entropy", "memory_mb", "seconds")

# --------------------------------------------------------------------------------------- the state of a run, as plain data


def kept(a: RbExplore | Baseline) -> tuple[tuple, tuple]:
    """The networks and optimisers of a method, and its statistics."""
    if isinstance(a, Baseline):
        return a.parts, a.moments
    r, rnd = a.similarity, a.novelty
    return (r, r.optimiser, rnd.target, rnd.predictor, rnd.optimiser), (rnd.pixels, *rnd.errors)


def pack(a: RbExplore | Baseline) -> dict:
    """All that a run needs to go on, as tensors, numbers and strings (bytes as hex), which load without unpickling objects.
    There is no generator in it: each is made from the seed, the iteration and a purpose."""
    tensor, (parts, moments) = torch.as_tensor, kept(a)
    state = {
        "counters": [a.phase, a.iteration, a.steps, a.exploration_steps],
        "discovered": [(list(unit), step) for unit, step in a.discovered.items()],
        "networks": [part.state_dict() for part in parts],
        "moments": [(m.count, tensor(m.mean), tensor(m.m2)) for m in moments],
    }
    if isinstance(a, PPO):
        state["actors"] = [[x.hex() for x in a.snapshots], tensor(a.seen), tensor(a.ages), tensor(a.sums)]
    if isinstance(a, Baseline):
        return state
    number: dict[Path, int] = {}  # each path once, parents first
    for v in a.graph.clusters.values():
        for link in v.path.chain():
            number.setdefault(link, len(number))
    return state | {
        "buffer": [snapshot.hex() for snapshot in a.novel],
        "replay": [(tensor(np.stack(p.states)), tensor(p.index), tensor(p.y), dict(p.counts)) for p in a.replay],
        "paths": [(number.get(p.parent, -1), tensor(p.frames), [x.hex() for x in p.actions]) for p in number],
        "clusters": [(id, v.snapshot.hex(), number[v.path], v.parent, v.visits) for id, v in a.graph.clusters.items()],
        "arcs": [(*arc, visits) for arc, visits in a.graph.arcs.items()],
        "graph": [a.graph.created, a.graph.assigned, a.graph.refused],
    }


def unpack(a: RbExplore | Baseline, state: dict) -> None:
    """Put a packed state into an algorithm of the same configuration."""
    a.phase, a.iteration, a.steps, a.exploration_steps = state["counters"]
    a.discovered = {tuple(unit): step for unit, step in state["discovered"]}
    if isinstance(a, RbExplore):
        a.novelty.errors = deque((Moments() for _ in state["moments"][1:]), a.config.novelty_window)
    parts, moments = kept(a)
    for part, saved in zip(parts, state["networks"], strict=True):
        part.load_state_dict(saved)
    for m, (count, mean, m2) in zip(moments, state["moments"], strict=True):
        m.count, m.mean, m.m2 = count, mean.numpy(), m2.numpy()
    if isinstance(a, PPO):
        snapshots, *rest = state["actors"]
        a.snapshots, (a.seen, a.ages, a.sums) = list(map(bytes.fromhex, snapshots)), (x.numpy() for x in rest)
    if isinstance(a, Baseline):
        return
    a.novel = [bytes.fromhex(x) for x in state["buffer"]]
    replay = [Pairs(list(s.numpy()), index.numpy(), y.numpy(), Counter(c)) for s, index, y, c in state["replay"]]
    a.replay = deque(replay, a.config.replay_iterations)
    paths: list[Path] = []
    for parent, frames, actions in state["paths"]:
        paths.append(Path(paths[parent] if parent >= 0 else None, frames.numpy(), tuple(map(bytes.fromhex, actions))))
    g = a.graph
    g.clusters = {id: Cluster(paths[p].frames[-1], bytes.fromhex(snapshot), paths[p], parent, visits)
                  for id, snapshot, p, parent, visits in state["clusters"]}
    g.arcs, g.adjacent = {}, {v: set() for v in g.clusters}
    for start, end, visits in state["arcs"]:
        g.add_arc(start, end, visits)
    g.created, g.assigned, g.refused = state["graph"]
    g.check()


def memory(a: RbExplore) -> float:
    """Megabytes of frames and snapshots that G and B hold."""
    if isinstance(a, Baseline):
        return 0.0
    links = {link for v in a.graph.clusters.values() for link in v.path.chain()}
    held = [*(v.snapshot for v in a.graph.clusters.values()), *a.novel]
    return round((sum(link.frames.nbytes for link in links) + sum(map(len, held))) / 2**20, 3)


# ---------------------------------------------------------------------------------------------------- the run folder


def write_atomically(path: pathlib.Path, write: Callable) -> None:
    """A reader finds the old file or the new one and never half of one, also after a kill, or where the disk is full."""
    temporary, content = path.with_name(path.name + ".new"), io.BytesIO()
    write(content)  # not to the file: torch has an error of its own for a full disk
    try:
        with open(temporary, "wb") as file:
            file.write(content.getbuffer())
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def load_checkpoint(folder: pathlib.Path, use: Callable):
    """What `use` makes of the checkpoint in the folder; InputError where it cannot."""
    path = folder / "checkpoint.pt"
    try:
        return use(torch.load(path, map_location="cpu", weights_only=True))  # load_state_dict moves what must move
    except Exception as error:  # torch raises many kinds for a file that is cut short
        raise InputError(f"{path} cannot be loaded ({type(error).__name__}): it is missing or damaged; begin anew with "
                         "another --out") from None


class Run:
    """A folder with config.json, metrics.csv, checkpoint.pt, trace.jsonl and the figures; and what one sees meanwhile."""

    def __init__(self, folder: pathlib.Path, settings: dict, algorithm: RbExplore, trace: bool = False):
        self.folder, self.settings, self.algorithm, self.tracing = folder, settings, algorithm, trace
        self.rows, self.events, self.trace_bytes, self.live = [], [], 0, sys.stdout.isatty()
        self.began = self.shown = time.monotonic()
        algorithm.tell = self.tell

    def create(self) -> None:
        """Begin in a folder that holds no run yet."""
        trace = self.folder / "trace.jsonl"  # ours is empty until there is a config.json
        if (self.folder / "config.json").exists() or trace.exists() and trace.stat().st_size:
            raise InputError(f"{self.folder} holds a run already: --resume it, or choose another folder with --out")
        self.folder.mkdir(parents=True, exist_ok=True)
        self.save()  # before config.json, whose presence makes a run of the folder: a kill in between leaves none
        write_atomically(self.folder / "config.json", lambda f: f.write(json.dumps(self.settings, indent=1).encode()))

    def load(self) -> None:
        """Take the state of the last complete iteration from the checkpoint; writes nothing."""
        def take(state: dict) -> bool:
            rows, trace_bytes, settings = list(state["rows"]), state["trace_bytes"], state["settings"]
            same = all(settings[key] == self.settings[key] for key in ("method", "ppo", "env", "options", "config", "threads"))
            if same:
                unpack(self.algorithm, state["algorithm"])
                self.rows, self.trace_bytes = rows, trace_bytes
            return same

        if not load_checkpoint(self.folder, take):
            raise InputError(f"{self.folder / 'checkpoint.pt'} is of another configuration than config.json beside it: put the "
                             "right one back, or begin anew with another --out")

    def resume(self) -> None:
        """Go on from the last complete iteration; what came after it is forgotten."""
        self.load()
        trace, self.events = self.folder / "trace.jsonl", []
        if self.tracing and self.trace_bytes > (trace.stat().st_size if trace.exists() else 0):
            raise InputError(f"{trace} is missing or cut short: put the whole file back, or begin anew with another --out")
        self.write_metrics()
        if self.tracing:
            with open(trace, "ab") as file:
                file.truncate(self.trace_bytes)

    def save(self) -> None:
        if self.tracing:
            with open(self.folder / "trace.jsonl", "ab") as file:
                file.writelines(json.dumps(event).encode() + b"\n" for event in self.events)
                self.trace_bytes, self.events = file.tell(), []
        state = {"settings": self.settings, "rows": self.rows, "trace_bytes": self.trace_bytes,
                 "algorithm": pack(self.algorithm)}
        write_atomically(self.folder / "checkpoint.pt", lambda f: torch.save(state, f))
        self.write_metrics()  # last: resuming writes it anew from the checkpoint

    def write_metrics(self) -> None:
        lines = [",".join("" if row.get(name) is None else str(row[name]) for name in METRICS) for row in self.rows]
        text = "\n".join([",".join(METRICS), *lines, ""])
        write_atomically(self.folder / "metrics.csv", lambda f: f.write(text.encode()))

    def tell(self, event: str, **data) -> None:
        """Hear of the algorithm: show progress, keep the trace, and save at the end of an iteration."""
        if event == "progress":
            now = time.monotonic()
            if now - self.shown > (0.2 if self.live else 30):
                self.shown = now
                line = f"   {data['step']}: {data['done']} of {data['total']}"
                print(f"\r{line:<50}" if self.live else line, end="" if self.live else "\n", flush=True)
        elif event == "row":
            row, now = data["row"], time.monotonic()
            row |= {"seconds": round(now - self.began, 2), "memory_mb": memory(self.algorithm)}
            self.began = self.shown = now
            self.rows.append(row)
            self.save()
            self.show(row)
        elif self.tracing:
            self.events.append({"event": event, **data})

    COLUMNS = (  # heading, width, name in the row, format
        ("iter", 6, "iteration", "d"), ("phase", 8, "phase", "s"), ("steps", 9, "steps", ",d"), ("clusters", 8, "clusters", "d"),
        ("new", 5, "added", "d"), ("merged", 6, "merged", "d"), ("%Cov", 6, "coverage", ".1%"), ("R's loss", 8, "r_loss", ".3f"),
        ("acc", 5, "r_accuracy", ".3f"), ("TPR", 5, "r_true_positive", ".3f"), ("TNR", 5, "r_true_negative", ".3f"),
        ("novel", 6, "novel_share", ".1%"), ("s", 6, "seconds", ".1f"))

    def show(self, row: dict) -> None:
        """A line for an iteration."""
        before = self.rows[-6]["steps"] if len(self.rows) > 5 else 0
        pace = sum(r["seconds"] for r in self.rows[-5:]) / max(1, row["steps"] - before)
        left = round(pace * (self.settings["config"]["steps"] - row["steps"]))
        cells = [f"{'-' if row.get(name) is None else format(row[name], form):>{width}}" for _, width, name, form in self.COLUMNS]
        if row["coverage"] is None:
            cells[6] = f"{row['units']:>5}u"
        print(("\r" if self.live else "") + " ".join(cells) + f" {left // 60:4}:{left % 60:02}", flush=True)
        if row["phase"] == "explore":
            for name, what in (("r_true_positive", "every state new"), ("r_true_negative", "every state known")):
                if row.get(name) is not None and row[name] < 0.2:
                    print(f"       warning: {name} is {row[name]:.2f}: R finds {what}, so G tells little")
        if row.get("clusters") and self.algorithm.graph.refused and row["clusters"] >= self.algorithm.config.max_clusters:
            print(f"       max_clusters has kept {self.algorithm.graph.refused} states from making a cluster so far")


# --------------------------------------------------------------------------------------------------------- the figures


def new_figure(width: float, height: float):
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError("figures need matplotlib: pip install matplotlib, or give --no-figures") from None
    return Figure(figsize=(width, height), layout="constrained")


def draw_figures(run: Run) -> list[str]:
    """Draw what the run has found so far; returns the names of the files."""
    a = run.algorithm
    unit_of = {}  # cluster -> coverage unit, by rolling back: G itself does not know units
    graph = None if isinstance(a, Baseline) else a.graph
    for v, cluster in graph.clusters.items() if graph else ():
        a.env.restore(cluster.snapshot)
        if a.env.unit() is not None:
            unit_of[v] = unit_key(a.env.unit())
    a.env.restore(a.snap_init)
    drawing, grid = level_drawing(a.env, {*a.discovered, *unit_of.values()}), np.linspace(0, a.steps, 1001).astype(int)
    full, unit = getattr(a.env, "full_coverage", None), unit_name(a.env)
    curves = {run.settings["method"]: {a.config.seed: coverage_curve(a.discovered, grid, full)}}
    figures = {"coverage.png": curves_figure(grid, curves, full, unit, a.config.pretrain_steps)}
    if graph:
        figures["centres.png"] = centres_figure(a)
    if drawing[1]:
        share = f"{100 * len(a.discovered) / full:.1f} % of {full}" if full else f"{len(a.discovered)}"
        figures["coverage_map.png"] = maps_figure(drawing, {f"after {a.steps:,} steps: {share} {unit}": a.discovered}, a.steps)
        figures |= {"graph.png": graph_figure(a, drawing, unit_of)} if graph else {}
    save_figures(run.folder, figures)
    return list(figures)


def save_figures(folder: pathlib.Path, figures: dict) -> None:
    for name, figure in figures.items():
        write_atomically(folder / name, lambda f, figure=figure: figure.savefig(f, format="png", dpi=120))


def level_drawing(env, units: set[tuple]) -> tuple[np.ndarray, dict, list]:
    """A picture of the level (H, W, 3), the box of each unit in it (left, top, width, height), and names (x, y, name)."""
    drawn = env.level_map() if hasattr(env, "level_map") else None
    return (*drawn, []) if drawn else rooms_map(units)


def rooms_map(units: set[tuple]) -> tuple[np.ndarray, dict, list]:
    """Where the environment draws no level: a panel for each room, in it a square for each unit (room, x, y) known."""
    places = {u: (u[:-2], *((0, 0, *u)[-2:])) for u in units}  # (5,) is x = 0, y = 5 of the only room
    rooms, xs, ys = (sorted({place[k] for place in places.values()}) for k in range(3))
    if not units or not all(isinstance(x, int) for x in (*xs, *ys)):
        return np.zeros((1, 1, 3), np.uint8), {}, []
    width, height, across, side = xs[-1] - xs[0] + 2, ys[-1] - ys[0] + 3, math.ceil(math.sqrt(len(rooms))), 12
    corner = {room: (k % across * width, k // across * height + 1) for k, room in enumerate(rooms)}
    boxes = {u: ((corner[room][0] + x - xs[0]) * side, (corner[room][1] + y - ys[0]) * side, side, side)
             for u, (room, x, y) in places.items()}
    labels = [(x * side, y * side, "room " + " ".join(map(str, room))) for room, (x, y) in corner.items() if room]
    rows = math.ceil(len(rooms) / across)
    return np.full((rows * height * side, across * width * side, 3), 40, np.uint8), boxes, labels


def steps_to(times: list[int], full: int) -> dict[int, str | None]:
    """Per cent of full coverage -> the step that reached it, if one did; times: of the first visits, sorted."""
    needed = {share: math.ceil(full * share / 100) for share in (50, 90, 100)}
    return {share: f"{times[k - 1]:,}" if len(times) >= k else None for share, k in needed.items()}


def coverage_curve(discovered: dict[tuple, int], grid: np.ndarray, full: int | None) -> np.ndarray:
    """Coverage after each number of steps of the grid: %, or units where full coverage is not known."""
    return np.searchsorted(sorted(discovered.values()), grid, "right") * (100 / full if full else 1)


def curves_figure(grid: np.ndarray, curves: dict[str, dict[int, np.ndarray]], full: int | None, unit: str, pretraining: int = 0):
    """Coverage against agent steps: for each variant the mean of its runs, and a band from their least to their most."""
    figure = new_figure(7, 4)
    axes = figure.subplots()
    for variant, of in curves.items():
        runs = np.stack(list(of.values()))  # (runs, points of the grid)
        (line,) = axes.plot(grid, runs.mean(0), label=variant)
        axes.fill_between(grid, runs.min(0), runs.max(0), color=line.get_color(), alpha=0.2, linewidth=0)  # S6.2-05
    if pretraining:
        axes.axvspan(0, pretraining, color="0.9", label="pretraining")
    axes.set(xlabel="agent steps (exploration, additional, pretraining)", xlim=(0, max(1, grid[-1])),
             ylabel=f"coverage, % of {full} {unit}" if full else f"{unit} covered", ylim=(0, 102 if full else None))
    axes.legend(loc="lower right" if len(curves) == 1 else "best")
    return figure


def unit_name(env) -> str:
    return getattr(env, "unit_name", "units")


def show_level(axes, level: np.ndarray, labels: list, title: str) -> None:
    axes.imshow(level)
    axes.set(title=title, xticks=[], yticks=[])
    for x, y, name in labels:
        axes.text(x, y, name, color="white", fontsize=8, verticalalignment="bottom")


def maps_figure(drawing: tuple, found: dict[str, dict[tuple, int]], steps: int):
    """Coverage maps, one for each title: visited units coloured by the step of the first visit, the others crossed out."""
    level, boxes, labels = drawing
    across, width = min(3, len(found)), 10 if len(found) == 1 else 5
    down = math.ceil(len(found) / across)
    figure = new_figure(width * across + 1.5, (width * level.shape[0] / level.shape[1] + 0.7) * down)
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes, (title, discovered) in zip(panels, found.items(), strict=False):
        show_level(axes, level, labels, title)
        heat = np.full(level.shape[:2], np.nan)
        for unit, (x, y, w, h) in boxes.items():
            if unit in discovered:
                heat[y : y + h, x : x + w] = discovered[unit]
            else:
                axes.plot([x, x + w], [y, y + h], color="tab:red", linewidth=1)
        image = axes.imshow(heat, cmap="viridis_r", alpha=0.6, vmin=0, vmax=steps)
    figure.colorbar(image, ax=panels.tolist(), label="step of the first visit", shrink=0.8)
    return figure


def graph_figure(a: RbExplore, drawing: tuple, unit_of: dict):
    """G over the level: a disc for each cluster, its area by the visits; a line for each arc, its width by the visits."""
    level, boxes, labels = drawing
    figure = new_figure(10, 10 * level.shape[0] / level.shape[1] + 0.9)
    axes = figure.subplots()
    show_level(axes, level, labels, f"graph: {len(a.graph.clusters)} clusters, {len(a.graph.arcs)} arcs")
    place, crowd = {}, Counter()
    for v, unit in unit_of.items():
        if unit in boxes:
            x, y, w, h = boxes[unit]
            turn, crowd[unit] = 2.4 * crowd[unit], crowd[unit] + 1  # clusters of one unit stand around its middle
            radius = 0 if crowd[unit] == 1 else 0.3
            place[v] = x + w * (0.5 + radius * math.cos(turn)), y + h * (0.5 + radius * math.sin(turn))
    most = max(v.visits for v in a.graph.clusters.values())
    for (start, end), visits in a.graph.arcs.items():
        if start in place and end in place:
            axes.plot(*zip(place[start], place[end], strict=True), color="white", alpha=0.5,
                      linewidth=0.3 + min(2.0, 0.2 * math.log1p(visits)))
    ids = list(place)
    points = axes.scatter(*zip(*(place[v] for v in ids), strict=True), c=ids, cmap="plasma", edgecolors="black", zorder=3,
                          s=[12 + 300 * a.graph.clusters[v].visits / most for v in ids])
    figure.colorbar(points, label="cluster, in the order of creation", shrink=0.8)
    return figure


def centres_figure(a: RbExplore, most: int = 80):
    """A contact sheet: the centres of the clusters, at most so many, evenly from all, with number and visits."""
    ids = list(a.graph.clusters)
    shown = [ids[k] for k in np.unique(np.linspace(0, len(ids) - 1, min(most, len(ids))).astype(int))]
    across = min(10, len(shown))
    figure = new_figure(across * 1.1 + 0.2, math.ceil(len(shown) / across) * 1.3 + 0.4)
    figure.suptitle(f"centres of {len(shown)} of {len(ids)} clusters: number, visits", fontsize=9)
    panels = np.ravel(figure.subplots(math.ceil(len(shown) / across), across, squeeze=False))
    for axes in panels:
        axes.axis("off")
    for axes, v in zip(panels, shown, strict=False):
        axes.imshow(a.graph.clusters[v].frame.squeeze(), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
        axes.set_title(f"{v}: {a.graph.clusters[v].visits:,}", fontsize=7)
    return figure


# ------------------------------------------------------------------- the policy pi^p of section 3.2, checked and exported


def verify(a: RbExplore) -> tuple[str, bool]:
    """For every cluster: replay its actions from s_init, restore its snapshot, and compare both with its centre, exactly.
    Returns a table, and whether all agree."""
    lines, wrong = [f"{'cluster':>9}{'visits':>9}{'steps from s_init':>19}   replayed   restored"], 0
    for v, cluster in a.graph.clusters.items():
        actions = cluster.path.replay()
        frame, ended = a.env.restore(a.snap_init), False
        for action in actions:
            ended = ended or a.env.step(action + int(a.env.action_space.start))[2]
        if actions and not ended:
            frame = a.env.restore(a.env.snapshot())
        replayed, unit = np.array_equal(frame, cluster.frame) and not ended, a.env.unit()
        restored = np.array_equal(a.env.restore(cluster.snapshot), cluster.frame)
        replayed = replayed and unit == a.env.unit()
        wrong += not (replayed and restored)
        answers = ["exact" if good else "DIFFERS" for good in (replayed, restored)]
        lines.append(f"{v:9}{cluster.visits:9,}{len(actions):19,}   {answers[0]:8}   {answers[1]}")
    lines.append(f"{len(a.graph.clusters) - wrong} of {len(a.graph.clusters)} clusters are reached exactly, both ways")
    return "\n".join(lines), not wrong


def export_demos(a: RbExplore, path: pathlib.Path) -> None:
    """The actions that lead from s_init to each centre, as demonstrations: actions[offsets[k]:offsets[k + 1]] lead to the
    centre of cluster clusters[k], whose frame is centres[k]."""
    demos = [np.frombuffer(v.path.replay(), np.uint8) for v in a.graph.clusters.values()]
    arrays = {"clusters": np.array(list(a.graph.clusters)), "offsets": np.cumsum([0, *map(len, demos)]),
              "actions": np.concatenate(demos), "centres": np.stack([v.frame for v in a.graph.clusters.values()])}
    write_atomically(path, lambda f: np.savez_compressed(f, **arrays))


# ---------------------------------------------------------------------------------------------------------- the profile


class Profile:
    """Seconds per step of the iteration: environment, network mathematics, the rest. It wraps functions from outside."""

    STEPS = {"explore": "1 explore", "make_pairs": "2 pairs", "train_similarity": "3 train R", "update_graph": "4 update G",
             "train_novelty": "5 train RND"}

    def __init__(self, algorithm: RbExplore, run: Run):
        self.seconds, self.step, self.depth = Counter(), "run folder, start", 0
        a = algorithm
        if isinstance(a, Baseline) or isinstance(a.similarity, Cells) or a.executor:
            raise InputError("--profile is for --method rbexplore with one worker")
        for name in self.STEPS:
            self.wrap(a, name, None)
        for name in ("step", "snapshot", "restore", "unit"):
            self.wrap(a.env, name, "environment")
        for owner, names in ((a.similarity, ("embed", "probability", "score", "update")), (a.novelty, ("distance", "update"))):
            for name in names:
                self.wrap(owner, name, "network")

    def wrap(self, owner, name: str, kind: str | None) -> None:
        inner = getattr(owner, name)

        def timed(*arguments, **named):
            before, self.depth, start = self.step, self.depth + (kind is not None), time.perf_counter()
            self.step = self.step if kind else self.STEPS[name]
            try:
                return inner(*arguments, **named)
            finally:
                self.depth -= kind is not None
                if kind is None or self.depth == 0:
                    self.seconds[self.step, kind or "all"] += time.perf_counter() - start
                self.step = before

        object.__setattr__(owner, name, timed)

    def table(self, total: float) -> str:
        """Rows: the steps; columns: where the seconds went."""
        lines = [f"{'':20}{'environment':>13}{'network':>10}{'rest':>8}{'all':>8}{'share':>8}"]
        inside = sum(self.seconds[name, "all"] for name in self.STEPS.values())
        sums = Counter()
        for name in (*self.STEPS.values(), "run folder, start"):
            env, net = self.seconds[name, "environment"], self.seconds[name, "network"]
            whole = self.seconds[name, "all"] if name in self.STEPS.values() else total - inside
            lines.append(f"{name:20}{env:13.2f}{net:10.2f}{whole - env - net:8.2f}{whole:8.2f}{whole / total:8.1%}")
            sums.update(env=env, net=net)
        rest = total - sums["env"] - sums["net"]
        lines.append(f"{'all':20}{sums['env']:13.2f}{sums['net']:10.2f}{rest:8.2f}{total:8.2f}")
        return "\n".join([*lines, f"outside environment steps and network mathematics: {rest / total:.1%} of the wall time"])


# ----------------------------------------------------------------------- the experiments (6.2, 6.3; S6.2-05, 06, S6.3-01 ... 03)

EXPERIMENTS = {  # variant -> what its runs alone have on the command line
    "methods": {method: ["--method", method] for method in METHODS},
    "ablation": {"rbexplore": [], "no-merge": ["--no-merge"], "no-prefix": ["--no-prefix"]},
    "theta-merge": {f"theta-merge-{theta}": ["--theta-merge", theta] for theta in ("0.25", "0.5", "0.75")}}


def runs_of(args: argparse.Namespace) -> dict[tuple[str, int], list[str]]:
    """(variant, seed) -> the command line of that run: what `args` says, the variant's own, the seed; its folder is last."""
    shared, env, first = ["--no-figures"], args.env or "maze", args.seed or 0
    for name, value in vars(args).items():
        if value is not None and name not in ("experiment", "seeds", "seed", "out", "trace", "profile", "no_figures"):
            flag = name.replace("_", "-")
            shared += [(f"--{flag}" if value else f"--no-{flag}") if isinstance(value, bool) else f"--{flag}={value}"]
    out = args.out or f"runs/{args.experiment}-{env}"
    return {(variant, seed): [*shared, *own, "--seed", str(seed), "--out", f"{out}/{variant}-{seed}"]
            for seed in range(first, first + (args.seeds or 3)) for variant, own in EXPERIMENTS[args.experiment].items()
            if variant != "oracle" or env == "maze"}


def execute(command: list[str]) -> str:
    """Run it in a process of its own, or go on where it was interrupted, or find it finished. Returns what was done."""
    folder, settings = pathlib.Path(command[-1]), settings_of(parser().parse_args(command))
    if (folder / "config.json").exists():
        free = {"versions": 0, "workers": 0}  # may differ
        if recorded_settings(str(folder), parser().parse_args([])) | free != settings | free:
            raise InputError(f"{folder} holds a run of another configuration: choose another --out")
        steps = load_checkpoint(folder, lambda state: max((row["steps"] for row in state["rows"]), default=0))
        if steps >= settings["config"]["steps"]:
            return f"{folder} was finished"
        command = ["--resume", str(folder), "--no-figures", "--workers", str(settings["workers"])]
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "log.txt", "a") as log:
        code = subprocess.run([sys.executable, __file__, *command], stdout=log, stderr=log).returncode
    if code:
        raise InputError(f"{folder} ended with code {code}: log.txt there says why; the same command goes on with the rest")
    return f"{folder} done"


def experiment(args: argparse.Namespace) -> int:
    """All runs, side by side where there are cores; then curves.csv with all curves, the figures, and a line for each run."""
    runs = runs_of(args)
    settings = [settings_of(parser().parse_args(command)) for command in runs.values()][0]  # all: an error shows before any run
    env, grid = make_env(settings["env"], **settings["options"]), np.linspace(0, settings["config"]["steps"], 201).astype(int)
    with ThreadPoolExecutor(max(1, (os.cpu_count() or 1) // (args.workers or 1))) as pool:
        try:
            for line in pool.map(execute, runs.values()):
                print(line, flush=True)
        except BaseException:  # Ctrl-C too, which the running processes hear by themselves
            pool.shutdown(cancel_futures=True)
            raise
    out = pathlib.Path(next(iter(runs.values()))[-1]).parent
    full, found, curves = env.full_coverage, {}, {}
    for (variant, seed), command in runs.items():
        discovered = load_checkpoint(pathlib.Path(command[-1]), lambda state: state["algorithm"]["discovered"])
        found[variant, seed] = {tuple(unit): step for unit, step in discovered}
        times = sorted(found[variant, seed].values())
        curves.setdefault(variant, {})[seed] = coverage_curve(found[variant, seed], grid, full)
        unit = f"%; steps to 50, 90, 100 %: {', '.join(s or '-' for s in steps_to(times, full).values())}" if full else "units"
        print(f"{variant:18} seed {seed}: {curves[variant][seed][-1]:6.1f} {unit}")
    rows = [f"{v},{n},{x},{y:.4f}" for v, of in curves.items() for n, ys in of.items() for x, y in zip(grid, ys, strict=True)]
    write_atomically(out / "curves.csv", lambda f: f.write("\n".join(["variant,seed,steps,coverage", *rows, ""]).encode()))
    if not args.no_figures:
        figures = {"curves.png": curves_figure(grid, curves, full, unit_name(env))}
        if args.experiment == "methods":
            shown = {variant: found[variant, best(of)] for variant, of in curves.items()}
            figures["maps.png"] = maps_figure(level_drawing(env, set().union(*shown.values())),
                                              {f"{v}: {len(d)} {unit_name(env)}": d for v, d in shown.items()}, int(grid[-1]))
        save_figures(out, figures)
    print(f"{out}: curves.csv{'' if args.no_figures else ', ' + ', '.join(figures)}")
    return 0


def best(curves: dict[int, np.ndarray]) -> int:
    """The seed whose coverage is highest at the end (S6.2-06)."""
    return max(curves, key=lambda seed: curves[seed][-1])


# ----------------------------------------------------------------------------------------------------- the command line


class Parser(argparse.ArgumentParser):
    def error(self, message: str):
        raise InputError(f"{message}; --help lists the options")


def parser() -> Parser:
    p = Parser(prog="rbexplore.py", usage="rbexplore.py --env maze [options]", allow_abbrev=False,
               description="Explore an environment by rolling back to stored states, clustered by a learned similarity: "
                           "RbExplore (Ugadiarov, Skrynnik, Panov).")
    p.add_argument("--env", help="environment: maze, pop or montezuma (default: maze)")
    p.add_argument("--method", choices=METHODS, help="what explores (6.2): RbExplore; PPO of RND's or of ICM's bonus; random "
                   "actions; RbExplore with Go-Explore's cells in R's place, or exact states (default: rbexplore)")
    p.add_argument("--experiment", choices=list(EXPERIMENTS), help="do all runs of figures 4 and 5 (6.2) or of figure 6 (6.3), "
                   "and draw; --out is then the folder of their folders; the same command goes on where it was interrupted")
    p.add_argument("--seeds", type=int, help="with --experiment: runs of each variant, from --seed on (default: 3)")
    p.add_argument("--level", type=int, help="level: 1 to 3 of the maze, 1 to 14 of pop (default: 1)")
    p.add_argument("--rom", help="pop: the NES cartridge's file, which you bring")
    p.add_argument("--state", help="pop: a start state, gzip of the emulator's; without it the cartridge boots")
    p.add_argument("--config", choices=list(CONFIGS), help="values of all fields below (default: maze for maze, else paper)")
    p.add_argument("--out", help="run folder (default: runs/<env>-<seed>)")
    p.add_argument("--resume", metavar="RUN", help="go on with the run in this folder; its options come from there")
    p.add_argument("--verify", metavar="RUN", help="check that every cluster of this run is reached exactly, both by replaying "
                   "its actions and by its snapshot; exit code 1 if one is not")
    p.add_argument("--export-demos", metavar="FILE", help="with --verify: write the actions to each cluster to FILE (npz)")
    p.add_argument("--device", help="where the networks are: cpu, cuda, cuda:1, ... (default: cpu)")
    p.add_argument("--threads", type=int, help="of the networks' arithmetic; another number, other roundings (default: 1)")
    p.add_argument("--workers", type=int, help="processes that run trajectories; any number, same result (default: 1)")
    p.add_argument("--trace", action="store_true", help="write every decision to trace.jsonl")
    p.add_argument("--no-figures", action="store_true", help="draw none")
    p.add_argument("--profile", action="store_true", help="print where the time went")
    for kind, configs, title in ((Config, CONFIGS, "fields of the configuration"), (PPOConfig, PPO_CONFIGS, "of PPO")):
        group = p.add_argument_group(title, "In brackets: paper | maze; then the section, the reading or the source.")
        for f in fields(kind):
            flag, values = "--" + f.name.replace("_", "-"), [getattr(c, f.name) for c in configs.values()]
            text = f"[{' | '.join(map(str, dict.fromkeys(values)))}] {f.metadata['meaning']}"
            form = {"action": argparse.BooleanOptionalAction} if f.type is bool else {"type": f.type, "metavar": f.type.__name__}
            group.add_argument(flag, default=None, help=text.replace("%", "%%"), **form)
    return p


def settings_of(args: argparse.Namespace) -> dict:
    """What makes the run, from the command line: all of it goes to config.json."""
    env, method = args.env or "maze", args.method or "rbexplore"
    base = args.config or ("maze" if env == "maze" else "paper")
    given, ppo = ({f.name: getattr(args, f.name) for f in fields(kind) if getattr(args, f.name) is not None}
                  for kind in (Config, PPOConfig))
    config = config_of(method, CONFIGS[base], **given)
    paths = {name: getattr(args, name) and os.path.abspath(getattr(args, name)) for name in ("rom", "state")}
    options = {name: value for name, value in ({"level": args.level} | paths).items() if value is not None}
    for name in ("threads", "workers"):
        if getattr(args, name) is not None and not 1 <= getattr(args, name) <= 1000:
            raise InputError(f"{name} is {getattr(args, name)}: give a number from 1 to 1,000")
    return {"method": method, "ppo": asdict(replace(PPO_CONFIGS[base], **ppo)), "env": env,
            "options": options | {"frame_size": config.frame_size}, "config": asdict(config), "device": args.device or "cpu",
            "threads": args.threads or 1, "workers": args.workers or 1, "versions": versions()}


def versions() -> dict[str, str]:
    return {"python": platform.python_version(), "torch": str(torch.__version__), "numpy": np.__version__,
            "gymnasium": gymnasium.__version__}


def recorded_settings(folder: str, args: argparse.Namespace) -> dict:
    """The settings of the run in the folder; what else is on the command line must agree with them."""
    path = pathlib.Path(folder) / "config.json"
    try:
        settings = json.loads(path.read_text())
        fixed = {"level": 1, "rom": None, "state": None, "out": folder} | settings["options"] | settings["config"]
        fixed |= settings["ppo"] | {name: settings[name] for name in ("method", "env", "device", "threads")}
        recorded = settings["workers"], settings["versions"]
        if not all(isinstance(settings[name], int) and settings[name] > 0 for name in ("threads", "workers")):
            raise ValueError
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        raise InputError(f"{path} cannot be read: there is no run in {folder}; see what --out was") from None
    if args.config:
        raise InputError("--config goes with a new run: a resumed run keeps its options; leave it out")
    settings["workers"] = args.workers or recorded[0]  # any number gives the same result
    if args.verify and args.device:
        settings["device"] = fixed["device"] = args.device
    if recorded[1] != versions():
        print(f"note: {folder} was begun with {recorded[1]}, this is {versions()}: the result may differ in the last digits")
    for name, value in vars(args).items():
        value = os.path.abspath(value) if name in ("rom", "state") and value else value
        if name in fixed and value is not None and value != fixed[name]:
            raise InputError(f"--{name.replace('_', '-')} {value} differs from {fixed[name]} in {path}: a resumed run keeps "
                             "its options; leave it out, or begin anew with another --out")
    return settings


def prepare(settings: dict):
    """Check the device, fix threads and determinism; return the algorithm and its executor."""
    torch.set_num_threads(settings["threads"])
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # nothing here reads such memory, and filling it takes time
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # which cuBLAS wants for that
    torch.backends.cudnn.allow_tf32 = False  # whose rounding would hide that two embeddings are of equal frames (R29)
    try:
        torch.zeros(1, device=settings["device"]).cpu()
    except (RuntimeError, AssertionError, ImportError) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise InputError(f"device {settings['device']} cannot be used ({reason}): give another --device, such as cpu") from None
    try:
        config, ppo = Config(**settings["config"]), PPOConfig(**settings["ppo"])
    except TypeError as error:
        raise InputError(f"the configuration in config.json does not fit this version: {error}") from None
    executor = None
    if settings["workers"] > 1:
        executor = ProcessPoolExecutor(settings["workers"], multiprocessing.get_context("spawn"), signal.signal,
                                       (signal.SIGINT, signal.SIG_IGN))
    env_fn = functools.partial(make_env, settings["env"], **settings["options"])
    return make_method(settings["method"], env_fn, config, settings["device"], executor, ppo), executor


def main(argv: list[str] | None = None) -> int:
    """The command line. Returns the exit code: 0; 2 for an error that the user can put right; 130 after Ctrl-C."""
    try:
        return command(parser().parse_args(argv))
    except (InputError, FloatingPointError) as error:
        print(f"rbexplore: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        place = error.filename or "a file"  # a full disk names none
        print(f"rbexplore: {place} cannot be written: {error.strerror}; make room, or choose another place", file=sys.stderr)
        return 2
    except BrokenProcessPool:
        print("rbexplore: a worker process died, of memory perhaps: go on with --resume and fewer --workers", file=sys.stderr)
        return 2
    except MemoryError:
        print("rbexplore: out of memory: give smaller values, of M, frame_size or actors for example", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


def command(args: argparse.Namespace) -> int:
    for name, value in vars(args).items():
        if value == "":
            raise InputError(f"--{name.replace('_', '-')} is empty: give a value, or leave it out")
    if sum(map(bool, (args.experiment, args.resume, args.verify))) > 1:
        raise InputError("--experiment, --resume and --verify exclude each other: give one of them")
    if args.export_demos and not (args.verify and args.export_demos.endswith(".npz")):
        raise InputError("--export-demos goes with --verify RUN, and FILE ends in .npz")
    if args.seeds is not None and not (args.experiment and args.seeds > 0):
        raise InputError(f"seeds is {args.seeds}: give 1 or more, with --experiment")
    if args.experiment and args.method:
        raise InputError("--experiment chooses the methods: leave --method out")
    if args.experiment and (args.trace or args.profile):
        raise InputError("--trace and --profile go with a single run, not with --experiment: leave them out")
    if not args.no_figures and not args.verify:
        new_figure(1, 1)  # so that a missing matplotlib shows now and not at the end
    if args.experiment:
        return experiment(args)
    old = args.resume or args.verify
    settings = recorded_settings(old, args) if old else settings_of(args)
    started = time.monotonic()
    algorithm, executor = prepare(settings)
    folder = pathlib.Path(old or args.out or f"runs/{settings['env']}-{settings['config']['seed']}")
    run = Run(folder, settings, algorithm, args.trace or bool(old) and (folder / "trace.jsonl").exists())
    if args.verify:
        return verified(run, args.export_demos)
    profile = Profile(algorithm, run) if args.profile else None  # which may refuse, before there is a folder
    run.resume() if args.resume else run.create()
    print(header(run))
    stopped = False
    try:
        algorithm.run()
    except KeyboardInterrupt:
        stopped = True
        print("\nstopped: going back to the last complete iteration", flush=True)
        run.resume()
    finally:
        if executor:
            executor.shutdown(cancel_futures=True)
    figures = [] if args.no_figures else draw_figures(run)
    print(summary(run, figures, time.monotonic() - started, stopped))
    if profile:
        print(profile.table(time.monotonic() - started))
    return 130 if stopped else 0


def verified(run: Run, demos: str | None) -> int:
    if isinstance(run.algorithm, Baseline):
        raise InputError(f"{run.folder} is a run of {run.settings['method']}, which has no clusters to verify")
    run.load()
    table, good = verify(run.algorithm)
    print(table)
    if demos:
        export_demos(run.algorithm, pathlib.Path(demos))
        print(f"demonstrations: {demos}")
    return 0 if good else 1


def header(run: Run) -> str:
    s, c, a = run.settings, run.settings["config"], run.algorithm
    full = getattr(a.env, "full_coverage", None)
    level = f", level {s['options'].get('level', 1)}" if s["env"] != "montezuma" else ""
    units = f"{full} {unit_name(a.env)} to cover" if full else f"full coverage in {unit_name(a.env)} is not known"
    begin = f", from step {a.steps:,} on" if a.steps else ""
    return (f"{s['method']} on {s['env']}{level}: {units}; seed {c['seed']}; {c['steps']:,} steps, {c['pretrain_steps']:,} "
            f"of them pretraining{begin}\n{s['device']}, {s['threads']} thread(s), {s['workers']} worker(s), "
            f"torch {torch.__version__}; run folder {run.folder}\n"
            + " ".join(f"{heading:>{width}}" for heading, width, *_ in Run.COLUMNS) + "    left")


def summary(run: Run, figures: list[str], seconds: float, stopped: bool) -> str:
    a, full = run.algorithm, getattr(run.algorithm.env, "full_coverage", None)
    times = sorted(a.discovered.values())
    lines = [f"{'stopped' if stopped else 'done'} after {a.steps:,} steps and {seconds:.0f} s: {len(times)} "
             f"{f'of {full} ' if full else ''}{unit_name(a.env)}{f' ({100 * len(times) / full:.1f} %)' if full else ''}"]
    if not isinstance(a, Baseline):
        lines[0] += f", {len(a.graph.clusters)} clusters"
    if full:
        marks = steps_to(times, full).items()
        lines.append("steps to " + ", ".join(f"{share} %: {step or 'not reached'}" for share, step in marks))
    if resource:
        unit = 2**30 if sys.platform == "darwin" else 2**20  # it counts bytes there, elsewhere kilobytes
        lines[0] += f", peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit:.2f} GiB"
    lines.append(f"{run.folder}: config.json, metrics.csv, checkpoint.pt{', ' if figures else ''}{', '.join(figures)}")
    if stopped:
        lines.append(f"go on with: python rbexplore.py --resume {run.folder}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
