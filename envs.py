"""Environments that can be rolled back (paper 3.2 and 5).

The contract of a persistent environment · the maze · the emulators · coverage units · workers ·
the factory by name. Coverage units are for metrics and figures; the algorithm never sees them.
"""

import functools
import gzip
import inspect
import tempfile
import threading
import uuid
import zlib
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np


class InputError(ValueError):
    """Something that the user can fix. Its message is the one line that is shown."""

    def __init__(self, message: str):
        super().__init__(" ".join(message.split()))  # a quoted text may have several lines


# ---- The contract of a persistent environment (paper 3.2; S3.2-01, S3.2-02) ----------------------


class PersistentEnv(gymnasium.Env):
    """A Gymnasium environment whose states can be saved and restored: a persistent MDP (section
    3.2 of the paper).

    observation_space: a Box of uint8, (H, W) or (H, W, C) with C <= 4, channels last.
    action_space: Discrete, at most 256 actions. Rewards are ignored.
    reset(seed=...) returns (frame, info); the same seed leads to the same state every time.

    info["blank"] = True marks the frame of a step as a transition screen (R24): the step counts,
    but the frame is not a state.

    level_map(), which is optional, is for figures: it returns a picture of the level, (H, W, 3)
    uint8, and the box (left, top, width, height) of each unit of full coverage, in pixels.

    Do not put a time limit in the environment. If its counter is in the snapshot, restoring a
    snapshot restores the counter, and the walks from late states are cut off. If it is not, the
    replay is not exact. Config.trajectory_steps limits the length of a trajectory.

    Keep snapshots small. An iteration holds one for each of its states: M x trajectory_steps + L x
    additional_steps, which in the paper's configuration and at 1 MB each needs 95 GB.
    """

    full_coverage: int | None = None  # number of units of full coverage; None if unknown
    unit_name = "units"  # what a unit is, printed beside every coverage (R26)

    def snapshot(self) -> bytes:
        """The complete state: position, clocks, generators, everything hidden."""
        raise NotImplementedError

    def restore(self, snapshot: bytes) -> np.ndarray:
        """Return to the state of `snapshot` without an environment step. Returns its observation.
        The same actions then lead to the same frames and outcomes as before, in any process.

        Emulators do not restore the screen, and some renderers draw random numbers. In such a case,
        store the frame in the snapshot.

        Raises InputError if the snapshot is malformed or of another environment.
        """
        raise NotImplementedError

    def unit(self) -> tuple | int | str | None:
        """The coverage unit in which the agent is (section 5; see unit_key), or None."""
        raise NotImplementedError


CONTRACT = ("reset", "step", "snapshot", "restore", "unit", "close")


def make_checked(env_fn: Callable[[], PersistentEnv], seed: int) -> PersistentEnv:
    """Make an environment and check its contract. Raises InputError, one line."""
    if not callable(env_fn):
        raise InputError(
            f"{env_fn!r:.80} is not a function: give a class or function that makes the "
            "environment, not the environment itself"
        )
    env = env_fn()
    check_contract(env, seed)
    return env


def check_contract(env: PersistentEnv, seed: int = 0, steps: int = 100) -> None:
    """Raise InputError, one line, unless `env` behaves as a persistent environment.

    A random walk of `steps` steps is recorded, with snapshots on the way. Then the snapshots are
    restored in the reverse order, and the actions after each are repeated: frames, units and ends
    must be the same. Afterwards `env` is at s_init. Faults that show later, or only in another
    process, are not found.
    """
    check_methods(env)
    check_spaces(env)
    rng = np.random.default_rng(0)
    witness = Witness(env)
    start = witness.reset(seed)
    seen = start
    parts = []  # of the walk: (steps before it, snapshot, what is seen, [(action, what is seen)])
    while witness.steps < steps:
        part = (witness.steps, witness.snapshot(), seen, [])
        parts.append(part)
        # Uneven lengths, so that a hidden clock is not right again by chance.
        for _ in range(rng.integers(5, 15)):
            action = int(env.action_space.start + rng.integers(env.action_space.n))
            seen = witness.step(action)
            part[3].append((action, seen))
            if seen["terminated"] or seen["truncated"]:
                seen = witness.reset(seed)
                break
    for steps_before, snapshot, first, moves in reversed(parts):
        witness.steps = steps_before
        witness.compare("restore()", first, witness.restore(snapshot))
        for action, before in moves:
            witness.compare("the same action after a restore", before, witness.step(action))
    witness.compare("reset() with the same seed", start, witness.reset(seed))


class Witness:
    """Calls an environment for check_contract, and checks what it returns. Every fault is an
    InputError that names the step of the walk."""

    def __init__(self, env):
        self.env = env
        self.steps = 0

    def call(self, name, *arguments, **named):
        try:
            return getattr(self.env, name)(*arguments, **named)
        except Exception as error:
            self.refuse(f"{name}() fails with {type(error).__name__}: {error}")

    def refuse(self, problem):
        raise InputError(f"the environment, after step {self.steps}: {problem}")

    def reset(self, seed):
        result = self.call("reset", seed=seed)
        pair = isinstance(result, tuple) and len(result) == 2
        if not pair or not isinstance(result[1], dict):
            self.refuse("reset() must return a frame and a dict")
        return self.look("reset", result[0])

    def step(self, action):
        self.steps += 1
        result = self.call("step", action)
        if not isinstance(result, tuple) or len(result) != 5 or not isinstance(result[4], dict):
            self.refuse("step() must return frame, reward, terminated, truncated, and a dict")
        frame, _, terminated, truncated, info = result
        seen = self.look("step", frame)
        flags = {
            "terminated": terminated,
            "truncated": truncated,
            "blank": info.get("blank", False),
        }
        for name, flag in flags.items():
            if not isinstance(flag, bool | np.bool_):
                self.refuse(f"step() returns {flag!r:.60} for {name}: it must be a bool")
            seen[name] = bool(flag)
        return seen

    def restore(self, snapshot):
        return self.look("restore", self.call("restore", snapshot))

    def snapshot(self):
        snapshot = self.call("snapshot")
        if not isinstance(snapshot, bytes) or not snapshot:
            self.refuse(f"snapshot() returns {snapshot!r:.60}: it must be bytes, at least one")
        return snapshot

    def look(self, name, frame):
        """A copy of the frame that a method returned, and the unit."""
        shape = self.env.observation_space.shape
        if not isinstance(frame, np.ndarray):
            self.refuse(f"{name}() returns a {type(frame).__name__} as the frame, not an array")
        if frame.shape != shape or frame.dtype != np.uint8:
            self.refuse(
                f"{name}() returns a frame {frame.shape} of {frame.dtype}: the observation space "
                f"says {shape} of uint8"
            )
        unit = self.call("unit")
        try:
            return {"frame": frame.copy(), "unit": unit_key(unit)}
        except InputError as error:
            self.refuse(str(error))

    def compare(self, what, first, second):
        for name in first:
            # restore() and reset() show frame and unit only.
            if name not in second or np.array_equal(first[name], second[name]):
                continue
            detail = ""
            if name == "frame":
                places = np.argwhere(first[name] != second[name])
                detail = f": {len(places)} values differ, the first at {tuple(places[0].tolist())}"
            self.refuse(f"{what} leads to a different {name} than the first time{detail}")


def check_methods(env):
    """Raise InputError unless `env` is an instance with the methods of the contract."""
    maker = callable(env) and not hasattr(env, "step")
    if maker or isinstance(env, type):
        raise InputError(
            f"{env!r:.80} is not an environment: give a function that makes the environment, "
            "so that calling it once returns an instance"
        )
    missing = [name for name in CONTRACT if not callable(getattr(env, name, None))]
    if missing:
        wrapped = isinstance(env, gymnasium.Wrapper)
        hint = "; use env.unwrapped, or add them to the wrapper" if wrapped else ""
        raise InputError(
            f"the environment lacks {', '.join(missing)}(), see PersistentEnv in envs.py{hint}"
        )


def check_spaces(env):
    """Raise InputError unless the spaces are as PersistentEnv requires."""
    actions = getattr(env, "action_space", None)
    if not isinstance(actions, gymnasium.spaces.Discrete) or actions.n > 256:
        raise InputError(
            f"the action space is {actions}: it must be Discrete with at most 256 actions"
        )
    frames = getattr(env, "observation_space", None)
    images = isinstance(frames, gymnasium.spaces.Box) and frames.dtype == np.uint8
    if not images or len(frames.shape) not in (2, 3):
        raise InputError(
            f"the observation space is {frames}: it must be a Box of uint8, (H, W) or (H, W, C)"
        )
    if len(frames.shape) == 3 and frames.shape[2] > 4:
        raise InputError(f"frames are {frames.shape}: channels come last, (H, W, C), at most 4")


# ---- The maze: a side-view level in the spirit of the Prince of Persia (paper 5) -----------------

# The seven actions of the Prince of Persia environment, in its order (S5-02).
NOOP = 0
LEFT = 1
RIGHT = 2
UP = 3
DOWN = 4
A = 5
B = 6

COLUMNS = 10  # tiles of a room, which is one screen
ROWS = 3

# A level is drawn in rooms of 10 x 3 tiles, separated by spaces.
#   #  wall      _  floor       @  floor where the agent starts
#   ^  spikes    .  open: no floor, the agent falls through
#   a  pressure plate, latched, opens every gate A
#   A  gate, closed until its plate is pressed
LEVELS = {
    2: """
    ##.____^__ _______.__ _____.____ ___.____##
    ##__.____# ___.______ ___.______ ______.___
    ####b_._B_ _____^____ _c____._## #__.^____#
    ##__.____# ##_.____## #____.____ ##____.__#
    ##_.______ ________._ #.____C___ ____D__.__
    ##_______# ####__.A__ #_____._## #._d^__e_#
    ##_.__^___ ____.___## ##___.____ ____._____
    #____.#### ##_.____a# ##____.___ __.___^___
    #@_____### ##___##### #________# #___E___^#
    """,
    3: """
    ##.____^__ ____^__.__ ___^_.____ ___.__^_##
    ##__.____# ___.____^_ ___.___^__ ______.___
    ####b_._B_ __^__^____ _c____._## #__.^____#
    ##__.____# ##_.____## #__^_.____ ##____.__#
    ##_.___^__ ________._ #.____C___ ____D__.__
    ##_______# ####__.A__ #_____._## #._d^__e_#
    ##_.__^___ ____.___## ##___.__^_ ____._____
    #____.#### ##_.____a# ##____.___ __.___^___
    #@_____### ##___##### #_.______# #___E___^#
    ##_^__.___ ___^_.____ _____.__^_ __________
    #_.__^.___ _.__^_____ ___.___^__ ____._____
    #___G____# #____^__g# #_^_____h# #_^__H__^#
    """,
}
# Level 1 is the first three columns of rooms of level 2.
LEVELS[1] = "\n".join(line[:36] for line in LEVELS[2].splitlines())

# The agent, facing right; h head, b body. Drawn at 6 x 12, sampled to the tile's real size.
ALIVE = """
......
......
......
......
..hhhh
..hhhh
..bb..
.bbbbb
.bbb.b
..bb..
.bbbb.
bb..bb
"""
DEAD = """
......
......
......
......
......
......
......
......
......
......
bbbbbh
bbbbhh
"""
COLOURS = {"h": (255, 214, 170), "b": (255, 255, 255)}
FLOOR = (186, 160, 120)
STONE = (112, 98, 86)
STEEL = (196, 206, 214)
PLATE = (240, 196, 60)
SUNK = (84, 60, 40)
TINTS = ((0.8, 0.9, 1.3), (1.2, 0.9, 0.8), (0.8, 1.1, 0.8))  # of the rooms' walls
LUMINANCE = np.array([77, 150, 29], np.uint32)  # of red, green and blue, in 1/256

FRAMES_KEPT = 4096


class MazeState(NamedTuple):
    """The full state of a maze."""

    x: int  # tiles from the left of the level
    y: int  # tiles from its top
    facing: int  # 1 right, 0 left
    plates: int  # the plates pressed, as bits
    dead: int


class Maze(PersistentEnv):
    """A deterministic level of several rooms, of which the agent sees one; the reward is always 0.

    LEFT and RIGHT turn the agent or, if it already faces that way, run one tile.
    A jumps two tiles ahead, over whatever is on the tile between; a wall stops it.
    B steps one tile ahead, onto spikes without harm, and never over an edge.
    UP climbs, if an opening is above the agent, to the floor beside the opening that it faces.
    DOWN hangs from the edge ahead and lets go, which shortens the fall by one row.
    A fall of two rows or more kills, and so do spikes unless the agent steps on them with B.

    unit() is (room, column, row). A snapshot is canonical: equal states have equal bytes.
    frameskip must be 1: a step is a whole move.
    Raises InputError for an unknown level, and a frame_size that is not an int of 32 or more.
    """

    unit_name = "tiles"

    def __init__(self, level: int = 1, frame_size: int = 32, frameskip: int = 1):
        if not isinstance(level, int) or level not in LEVELS:
            known = ", ".join(str(number) for number in sorted(LEVELS))
            raise InputError(f"unknown maze level {level!r}: there are {known}")
        if not isinstance(frame_size, int) or frame_size < 32:
            raise InputError(f"frame_size must be an int, 32 pixels or more, not {frame_size!r}")
        if frameskip != 1:
            raise InputError(f"a step of the maze is a whole move: frameskip is 1, not {frameskip}")
        self.level = level
        self.frame_size = frame_size
        drawing = LEVELS[level].replace(" ", "")
        self.tiles = drawing.split()
        self.across = len(self.tiles[0]) // COLUMNS  # rooms
        self.down = len(self.tiles) // ROWS
        self.letters = sorted({tile for tile in drawing if tile.islower()})
        y = next(y for y, line in enumerate(self.tiles) if "@" in line)
        x = self.tiles[y].index("@")
        self.start = MazeState(x, y, facing=1, plates=0, dead=0)
        self.state = self.start
        self.observation_space = gymnasium.spaces.Box(0, 255, (frame_size, frame_size), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(7)
        self._seen: dict[MazeState, np.ndarray] = {}  # frames of recent states
        self.full_coverage = len(self.reachable())

    def reset(self, *, seed=None, options=None):
        """Return to the start. Returns the frame, (frame_size, frame_size) uint8, and {}."""
        super().reset(seed=seed)
        self.state = self.start
        return self._frame(), {}

    def step(self, action: int):
        """One action. Raises InputError unless it is one of 0 to 6 and the agent is alive."""
        check_action(action, 7)
        if self.state.dead:
            raise InputError("the agent is dead: reset or restore the maze before the next step")
        self.state = self._next(self.state, action)
        return self._frame(), 0.0, bool(self.state.dead), False, {}

    def snapshot(self) -> bytes:
        """Six bytes: level, x, y, facing, plates, dead."""
        return bytes((self.level, *self.state))

    def restore(self, snapshot: bytes) -> np.ndarray:
        """Return to the state of `snapshot` (see PersistentEnv.restore)."""
        self.state = self._read(snapshot)
        return self._frame()

    def unit(self) -> tuple[int, int, int] | None:
        """(room, column, row) of the agent; None if it is dead."""
        if self.state.dead:
            return None
        return self._place(self.state.x, self.state.y)

    def reachable(self) -> set[tuple[int, int, int]]:
        """Every unit that the agent can reach alive, by a search over all states (S5-03)."""
        units = set()
        found = {self.start}
        queue = [self.start]
        for state in queue:  # grows during the loop
            if state.dead:
                continue
            units.add(self._place(state.x, state.y))
            for action in range(7):
                after = self._next(state, action)
                if after not in found:
                    found.add(after)
                    queue.append(after)
        return units

    def level_map(self) -> tuple[np.ndarray, dict[tuple, tuple[int, int, int, int]]]:
        """The level in tiles of 8 x 24 pixels with no plate pressed, and the box of each unit."""
        w = 8
        h = 24
        lines = []
        for k in range(self.down):
            rooms = range(k * self.across, (k + 1) * self.across)
            lines.append(np.hstack([self._paint_room(room, 0, w, h) for room in rooms]))
        boxes = {}
        for room, column, row in self.reachable():
            x = room % self.across * COLUMNS + column
            y = room // self.across * ROWS + row
            boxes[room, column, row] = (x * w, y * h, w, h)
        return np.vstack(lines), boxes

    def _place(self, x, y):
        """(room, column, row) of a tile; rooms are counted along the lines of the level."""
        room = y // ROWS * self.across + x // COLUMNS
        return room, x % COLUMNS, y % ROWS

    def _pressed(self, letter, plates):
        """Whether the plate of this letter, or the plate of this gate, is pressed."""
        return bool(plates >> self.letters.index(letter.lower()) & 1)

    def _tile(self, x, y, plates):
        """The tile as it acts now: a closed gate is a wall, an open one is floor."""
        if not (0 <= y < len(self.tiles) and 0 <= x < len(self.tiles[0])):
            return "#"  # beyond the level
        tile = self.tiles[y][x]
        if tile.isupper():
            return "_" if self._pressed(tile, plates) else "#"
        return tile

    def _next(self, state: MazeState, action: int) -> MazeState:
        """The state after one action."""
        x, y, facing, plates, _ = state
        ahead = 1 if facing else -1
        tile_ahead = self._tile(x + ahead, y, plates)
        hanging = 0  # rows by which hanging from the edge shortens the fall
        if action in (LEFT, RIGHT):
            wanted = int(action == RIGHT)
            if facing != wanted:
                facing = wanted
            elif tile_ahead != "#":
                x += ahead
        elif action == UP:
            opening = self._tile(x, y - 1, plates) == "."
            if opening and self._tile(x + ahead, y - 1, plates) not in "#.":
                x += ahead
                y -= 1
        elif action == DOWN:
            if tile_ahead == ".":
                x += ahead
                hanging = 1
        elif action == A:
            for _ in range(2):
                if self._tile(x + ahead, y, plates) != "#":
                    x += ahead
        elif action == B and tile_ahead not in "#.":
            x += ahead
        edge = y
        while self._tile(x, y, plates) == ".":
            y += 1
        tile = self._tile(x, y, plates)
        crushed = y - edge - hanging >= 2
        arrived = (x, y) != (state.x, state.y)
        impaled = arrived and tile == "^" and action != B
        if tile.islower():
            plates |= 1 << self.letters.index(tile)
        return MazeState(x, y, facing, plates, int(crushed or impaled))

    def _read(self, snapshot: bytes) -> MazeState:
        """The state of a snapshot. Raises InputError for another level or an impossible state."""
        if isinstance(snapshot, bytes) and len(snapshot) == 6 and snapshot[0] == self.level:
            state = MazeState(*snapshot[1:])
            flags = state.facing < 2 and state.dead < 2
            known = state.plates < 2 ** len(self.letters)
            if flags and known and self._tile(state.x, state.y, state.plates) not in "#.":
                return state
        raise InputError(f"no snapshot of maze level {self.level}: {snapshot!r:.60}")

    def _frame(self):
        """The observation of the current state: a copy, which the caller may change."""
        if self.state not in self._seen:
            if len(self._seen) >= FRAMES_KEPT:
                self._seen.clear()
            self._seen[self.state] = self._draw()
        return self._seen[self.state].copy()

    def _draw(self):
        """The luminance of the room, centred on black. Integers: the same on every machine."""
        size = self.frame_size
        picture = self._picture(size // COLUMNS, size // ROWS)
        height, width, _ = picture.shape
        top = (size - height) // 2
        left = (size - width) // 2
        frame = np.zeros((size, size), np.uint8)
        luminance = (picture.astype(np.uint32) @ LUMINANCE) >> 8
        frame[top : top + height, left : left + width] = luminance
        return frame

    def _picture(self, w, h):
        """The room with the agent, in tiles of w x h pixels: (3 h, 10 w, 3) uint8."""
        state = self.state
        room, column, row = self._place(state.x, state.y)
        picture = self._paint_room(room, state.plates, w, h)
        box = picture[row * h : (row + 1) * h, column * w : (column + 1) * w]
        paint_agent(box, state.facing, state.dead)
        return picture

    def _paint_room(self, room, plates, w, h):
        """The room without the agent, (3 h, 10 w, 3) uint8; plates and gates show their state."""
        picture = paint_back_wall(room, w, h)
        for row, column in np.ndindex(ROWS, COLUMNS):
            x = room % self.across * COLUMNS + column
            y = room // self.across * ROWS + row
            tile = self.tiles[y][x]
            pressed = tile.isalpha() and self._pressed(tile, plates)
            box = picture[row * h : (row + 1) * h, column * w : (column + 1) * w]
            paint_tile(box, tile, pressed)
        return picture


def paint_back_wall(room, w, h):
    """The back wall of a room, (3 h, 10 w, 3) uint8. Rooms differ in pattern, shade and tint."""
    down, across = np.indices((ROWS * h, COLUMNS * w)) // max(1, w // 3)
    patterns = (
        np.zeros_like(down),
        down // 2 % 2,
        across // 2 % 2,
        (down // 2 + across // 2) % 2,
        (down + across) // 2 % 2,
    )
    shade = 18 + room * 5 % 7 * 8 + 16 * patterns[room % 5]
    tint = np.array(TINTS[room % 3])
    return (shade[..., None] * tint).astype(np.uint8)


def paint_tile(box: np.ndarray, tile: str, pressed: bool) -> None:
    """Paint one tile, (h, w, 3) uint8, in place. pressed: of a plate, and of the plate's gate."""
    h, w, _ = box.shape
    thick = max(1, h // 8)
    if tile == "#":
        box[:] = STONE
        box[:: thick * 2] = np.array(STONE) * 3 // 4  # joints
    elif tile != ".":
        box[-thick:] = FLOOR
    if tile == "^":
        for i in range(w):
            along = (2 * i + 1) / w % 1  # position within one of the two teeth
            height = round(0.3 * h * (1 - abs(along * 2 - 1)))
            box[h - thick - height : h - thick, i] = STEEL
    elif tile.islower() and pressed:
        box[-thick:] = SUNK
    elif tile.islower():
        box[-2 * thick :] = PLATE
    elif tile.isupper():
        bars = np.arange(w) // max(1, w // 3) % 2 == 0
        bottom = h // 5 if pressed else h - thick
        box[:bottom, bars] = STEEL


def paint_agent(box: np.ndarray, facing: int, dead: int) -> None:
    """Paint the agent into a tile, (h, w, 3) uint8, in place, above the floor, scaled to it."""
    drawing = DEAD if dead else ALIVE
    sprite = np.array([list(line) for line in drawing.split()])  # (12, 6)
    if not facing:
        sprite = sprite[:, ::-1]
    height = len(box) - max(1, len(box) // 8)
    width = box.shape[1]
    rows = (2 * np.arange(height) + 1) * 12 // (2 * height)
    columns = (2 * np.arange(width) + 1) * 6 // (2 * width)
    body = sprite[rows][:, columns]  # (height, width)
    for letter, colour in COLOURS.items():
        box[:height][body == letter] = colour


# ---- The emulators (3.2, 5, 6.1; S3.2-01, S3.2-02, S5-*, S6.1-01, S6.1-07, S6.2-01, S6.2-02) -----


class EmulatorEnv(PersistentEnv):
    """What the emulators share: frames (S5-01), snapshots (3.2), the end of an episode (R23).

    A step is `frameskip` emulator frames of one action (S6.1-01). The observation is the last of
    them (R22), in gray, resized to (frame_size, frame_size) uint8.
    The reward is 0.0. info holds the readings of RAM, and "blank": no pixel is lit (R24).
    Raises InputError for an action out of range, and for any use after close().

    A subclass sets _emulator, implements _screen, _save, _load, _tick, _ram and _place, and calls
    _begin.
    """

    LIVES = "lives"  # the reading whose drop ends the episode
    level: int | None = None  # leaving it ends the episode
    _emulator = None  # None: closed

    def _begin(self, game, actions, frame_size, frameskip):
        """Make the current state s_init. `game` keeps the snapshots of different games apart."""
        for name, value in (("frameskip", frameskip), ("frame_size", frame_size)):
            if not isinstance(value, int) or value < 1:
                self.close()
                raise InputError(f"{name} is {value!r}: it must be an int, 1 or more")
        self.frameskip = frameskip
        self.action_space = gymnasium.spaces.Discrete(actions)
        self.observation_space = gymnasium.spaces.Box(0, 255, (frame_size, frame_size), np.uint8)
        self._frame = self._observe().tobytes()
        # Most of a state never changes, so it compresses well with s_init as the dictionary.
        self._dictionary = game + self._frame + self._save()
        self._start = self.snapshot()

    def _observe(self):
        """The screen, (H, W, 3) uint8, as an observation."""
        from PIL import Image

        # Pillow computes in integers, so every machine agrees.
        size = self.observation_space.shape
        gray = Image.fromarray(self._screen()).convert("L")
        return np.array(gray.resize(size, Image.Resampling.BILINEAR))  # with antialiasing

    def _check_open(self):
        if self._emulator is None:
            raise InputError("the emulator is closed: make the environment anew")

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Return to s_init, the same state every time. Returns (frame, info)."""
        super().reset(seed=seed)
        frame = self.restore(self._start)
        return frame, self._info(frame)

    def step(self, action: int):
        """One action. Returns (frame, 0.0, terminated, False, info)."""
        self._check_open()
        check_action(action, self.action_space.n)
        lives = self._ram()[self.LIVES]
        for _ in range(self.frameskip):
            self._tick(int(action))
        frame = self._observe()
        self._frame = frame.tobytes()
        info = self._info(frame)
        ended = info[self.LIVES] < lives or info.get("level") != self.level
        return frame, 0.0, ended, False, info

    def _info(self, frame):
        return {**self._ram(), "blank": not frame.any()}

    def snapshot(self) -> bytes:
        """The complete state and the frame, because emulators do not restore the screen."""
        self._check_open()
        packer = zlib.compressobj(level=2, zdict=self._dictionary)
        return packer.compress(self._frame + self._save()) + packer.flush()

    def restore(self, snapshot: bytes) -> np.ndarray:
        """Load a snapshot (see PersistentEnv.restore). Returns the frame stored in it."""
        self._check_open()
        unpacker = zlib.decompressobj(zdict=self._dictionary)
        try:
            # zlib verifies the checksums of dictionary and content.
            content = unpacker.decompress(snapshot)
        except (zlib.error, TypeError):
            content = b""
        whole = unpacker.eof and not unpacker.unused_data
        pixels = len(self._frame)
        if not whole or not self._load(content[pixels:]):
            raise InputError("the snapshot is damaged, or of another game, level or start state")
        self._frame = content[:pixels]
        frame = np.frombuffer(self._frame, np.uint8)
        return frame.reshape(self.observation_space.shape).copy()

    def unit(self) -> tuple[int, int, int] | None:
        """The coverage unit, (room, column, row), or None; see the subclass."""
        self._check_open()
        return self._place(self._ram())

    def close(self) -> None:
        """Release the emulator: stable-retro allows one at a time in a process."""
        self._emulator = None


class PrinceOfPersia(EmulatorEnv):
    """One level of Prince of Persia on the NES, through stable-retro (section 5).

    rom: the user's cartridge image, an iNES file.
    state: the gzip of an emulator state, as the authors publish them (level 1: in the sword's room
    with the sword, 6.2). It holds no screen, so s_init is the state one frame later, without
    buttons. Without `state`, s_init is one second after power-on: this suits only a cartridge that
    is in play by then, because no action presses START.
    The clock is held at 99 minutes.
    info: level, room, x, y (pixels), hit_points, sword, blank.

    unit() is (room, x // 32, y // 32); None if the prince is dead, outside the room (left of it x
    wraps to 65535) or outside the level. %Cov is an estimate: FULL_COVERAGE counts the positions in
    the authors' reference data. We have their numbers but not the sets, so the units visited may
    include others and outnumber them (744 of 721 on level 1); the share is at most 1.

    Raises InputError for an unusable file, a state of another level, a missing stable-retro, or a
    second emulator in the process.
    """

    ACTIONS = ("NO-OP", "LEFT", "RIGHT", "UP", "DOWN", "A", "B")  # S5-02
    # Units in the full coverage sets of levels 1 to 14, from the authors' reference data (R26).
    FULL_COVERAGE = (721, 723, 756, 706, 598, 287, 755, 736, 797, 444, 575, 688, 223, 107)
    LIVES = "hit_points"
    unit_name = "units of 32 x 32 pixels"

    def __init__(
        self,
        rom: str | None = None,
        level: int = 1,
        state: str | None = None,
        frame_size: int = 96,
        frameskip: int = 4,
    ):
        if not isinstance(level, int) or level not in range(1, 15):
            raise InputError(f"Prince of Persia has levels 1 to 14, not {level}")
        if not rom:
            raise InputError("Prince of Persia needs your own cartridge image: --rom FILE.nes")
        try:
            image = Path(rom).read_bytes()
            start = gzip.decompress(Path(state).read_bytes()) if state else None
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(f"cannot read the cartridge or start state: {error}") from None
        if image[:4] != b"NES\x1a" or len(image) < 16 or len(image) < 16 + 16384 * image[4]:
            raise InputError(f"{rom} is no complete NES cartridge image (iNES)")
        self.level = level
        self.full_coverage = self.FULL_COVERAGE[level - 1]
        self._start_emulator(rom, image)
        self._enter(start, state or rom)
        game = b"%d %d" % (zlib.crc32(image), level)
        self._begin(game, len(self.ACTIONS), frame_size, frameskip)

    def _start_emulator(self, rom, image):
        try:
            import stable_retro
        except ImportError:
            raise InputError(
                "Prince of Persia needs stable-retro: pip install stable-retro"
            ) from None
        # A copy, because the core requires the suffix .nes. It reads the file only once.
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder, "rom.nes")
            copy.write_bytes(image)
            try:
                self._emulator = stable_retro.RetroEmulator(str(copy))
            except RuntimeError as error:
                hint = ": close() the first" if "multiple" in str(error) else ""
                raise InputError(f"the emulator refuses {rom}: {error}{hint}") from None
        self._data = stable_retro.data.GameData()
        self._emulator.configure_data(self._data)
        buttons = stable_retro.get_system_info("Nes")["buttons"]  # none is named NO-OP
        masks = [[button == action for button in buttons] for action in self.ACTIONS]
        self._masks = np.array(masks, np.uint8)

    def _enter(self, start, name):
        """Go to s_init, from the start state or from power-on. name: the file to name in errors."""
        problem = f"is not in play on level {self.level}"
        loaded = True
        ticks = 60
        if start is not None:
            # The core accepts any bytes of this length, and may then hang: check the mark first.
            loaded = start[:3] == b"FCS" and self._load(start)
            ticks = 1
            problem += ", or the state is of another cartridge"
        for _ in range(ticks):
            self._tick(0)
        if not loaded:
            problem = "is no state of this emulator"
        if not loaded or self.unit() is None:
            ram = self._ram()
            self.close()
            raise InputError(f"{name} {problem}: {ram}")

    def _screen(self):
        return self._emulator.get_screen()  # (224, 240, 3)

    def _save(self):
        return self._emulator.get_state()

    def _load(self, state):
        return self._emulator.set_state(state)

    def _tick(self, action):
        self._emulator.set_button_mask(self._masks[action])
        self._emulator.step()
        self._data.memory.assign(1221, "<u2", 0x3939)  # the minutes left: "99" in ASCII

    def _ram(self):
        read = self._data.memory.extract
        return {
            "level": read(112, "|u1") + 1,
            "room": read(1246, "|u1"),
            "x": read(1243, "<u2"),
            "y": read(1777, "|u1") & 224,
            "hit_points": read(1743, "|u1"),
            "sword": read(1774, "|u1"),
        }

    def _place(self, ram):
        playing = ram["level"] == self.level and ram["hit_points"] > 0
        inside = ram["x"] <= 332 and 32 <= ram["y"] <= 192
        if not playing or not inside:
            return None
        return ram["room"], ram["x"] // 32, ram["y"] // 32


class Montezuma(EmulatorEnv):
    """Montezuma's Revenge through ale-py, which contains the game. Not in the paper.

    ALE/MontezumaRevenge-v5 without sticky actions (R22), and without its limit of 108,000 frames,
    which a run with rollbacks would exceed. All 18 actions. The full coverage set is unknown.
    info: room, x, y (ALE pixels), lives, blank.
    unit() is (room, column, row) in squares of 16 pixels, a tenth of the screen's width.
    """

    unit_name = "units of 16 x 16 pixels"

    def __init__(self, frame_size: int = 96, frameskip: int = 4):
        try:
            import ale_py
        except ImportError:
            raise InputError("Montezuma's Revenge needs ale-py: pip install ale-py") from None
        ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)  # no banner
        ale = ale_py.ALEInterface()
        ale.setFloat("repeat_action_probability", 0.0)
        ale.setInt("random_seed", 0)  # has no effect, but is part of the state
        ale.loadROM(ale_py.roms.get_rom_path("montezuma_revenge"))
        ale.reset_game()
        self._emulator = ale
        self._state_type = ale_py.ALEState
        self._actions = ale.getMinimalActionSet()
        self._begin(b"Montezuma", len(self._actions), frame_size, frameskip)

    def _screen(self):
        return self._emulator.getScreenRGB()  # (210, 160, 3)

    def _save(self):
        return self._emulator.cloneState(include_rng=True).serialize()

    def _load(self, state):
        self._emulator.restoreState(self._state_type(state))
        return True

    def _tick(self, action):
        self._emulator.act(self._actions[action])

    def _ram(self):
        ram = self._emulator.getRAM().tolist()
        return {"room": ram[3], "x": ram[42], "y": ram[43], "lives": ram[58]}

    def _place(self, ram):
        return ram["room"], ram["x"] // 16, 15 - ram["y"] // 16  # RAM counts y upwards


# ---- Coverage units (5; S5-03, S5-04), and actions -----------------------------------------------


def unit_key(unit) -> tuple[int | str, ...] | None:
    """A coverage unit as a hashable tuple of plain ints and strs, or None.

    unit: an int, a str, or a tuple, list or array of them. Raises InputError for anything else: a
    float nan, for example, differs from itself and would be a new unit at every step.
    """
    if unit is None:
        return None
    parts = unit.tolist() if isinstance(unit, np.ndarray) else unit
    if not isinstance(parts, tuple | list):
        parts = [parts]
    key = []
    for part in parts:
        if isinstance(part, str):
            key.append(str(part))
        elif isinstance(part, int | np.integer | np.bool_):
            key.append(int(part))
        else:
            raise InputError(
                f"unit() returns {unit!r:.60}: it must be an int, a str, a tuple of them, or None"
            )
    return tuple(key)


def check_action(action: int, count: int) -> None:
    """Raise InputError unless `action` is one of 0 to count - 1."""
    if action not in range(count):
        raise InputError(f"there are actions 0 to {count - 1}, and not {action!r}")


# ---- Workers -------------------------------------------------------------------------------------


class Workers:
    """Walks in the workers of an executor of concurrent.futures, or of any object with its map().
    Each worker makes the environment once; it must be able to import this module, rbexplore and
    env_fn."""

    def __init__(self, executor: Executor, env_fn: Callable[[], PersistentEnv], seed: int):
        self.executor = executor
        self.key = uuid.uuid4().hex  # tells a worker whose environment it has
        self.env_fn = env_fn
        self.seed = seed

    def check(self, function, *arguments):
        """Call function(env, *arguments) in a worker. Raises InputError if that fails, because
        env_fn cannot be pickled or imported there, for example."""
        try:
            list(self.map(function, *([argument] for argument in arguments)))
        except InputError:
            raise
        except Exception as error:
            raise InputError(
                f"the workers cannot make the environment ({type(error).__name__}: {error}): "
                f"{DEFINE_IT_IN_A_MODULE}"
            ) from None

    def map(self, function, *arguments):
        """function(env, *arguments) for each tuple of arguments, in order: like map()."""
        call = functools.partial(in_worker, self.key, self.env_fn, self.seed, function)
        try:
            yield from self.executor.map(call, *arguments)
        except BrokenExecutor as error:
            raise InputError(
                f"a worker process died ({error}): it may have run out of memory, or could not "
                f"import the environment; use fewer workers, or {DEFINE_IT_IN_A_MODULE}"
            ) from None


DEFINE_IT_IN_A_MODULE = (
    "define the class or function that makes it in a module, not in a notebook, in __main__ or as "
    "a lambda"
)
_kept = {}  # in a worker: the key of the Workers it served last, and their environment
_one_at_a_time = threading.Lock()  # for executors whose workers are threads


def in_worker(key, env_fn, seed, function, *arguments):
    """function(env, *arguments), with an environment that is made at the first call of a key."""
    with _one_at_a_time:
        if key not in _kept:
            for env in _kept.values():
                env.close()
            _kept.clear()
            _kept[key] = env_fn()
            _kept[key].reset(seed=seed)
        return function(_kept[key], *arguments)


# ---- The factory by name -------------------------------------------------------------------------

ENVIRONMENTS = {"maze": Maze, "pop": PrinceOfPersia, "montezuma": Montezuma}


def make_env(name: str, **options) -> PersistentEnv:
    """The environment of this name, made with these options. Raises InputError for unknown ones."""
    if name not in ENVIRONMENTS:
        raise InputError(f"unknown environment {name!r}: there are {', '.join(ENVIRONMENTS)}")
    known = inspect.signature(ENVIRONMENTS[name]).parameters
    for option in options:
        if option not in known:
            raise InputError(f"{name} has no option {option!r}: it has {', '.join(known)}")
    return ENVIRONMENTS[name](**options)
