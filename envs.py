"""Environments that can be rolled back (paper 3.2 and 5): the contract, a small maze, the emulators, the factory.

Beyond Gymnasium's interface they save and restore their complete state. Coverage units are for metrics and figures only."""

import gzip
import inspect
import tempfile
import zlib
from pathlib import Path

import gymnasium
import numpy as np


class InputError(ValueError):
    """Something that the user can put right; its message is the one line that is shown."""


# ---- The contract of a persistent environment (paper 3.2) --------------------------------------------------------


class PersistentEnv(gymnasium.Env):
    """A Gymnasium environment whose states can be saved and returned to: a persistent MDP (paper 3.2).

    observation_space is a Box of uint8 (H, W), grayscale; action_space is Discrete. Rewards are ignored. Where `step` reports
    info["blank"] = True, the frame is a transition screen and no state (R24): it is stepped and counted, but never a centre.
    A level_map(), if any, is for figures: the level (H, W, 3) uint8 and each unit's box (left, top, width, height) in pixels."""

    full_coverage: int | None = None  # number of units of full coverage (paper 5), None where it is not known
    unit_name = "units"  # what a unit is, printed beside every coverage (reading R26)

    def snapshot(self) -> bytes:
        """The complete state (position, clocks, generators, everything hidden) in as few bytes as possible."""
        raise NotImplementedError

    def restore(self, snapshot: bytes) -> np.ndarray:
        """Return to the state of `snapshot`; gives its observation, (H, W) uint8, and costs no step. The same actions then give
        the same frames and outcomes as the first time, in any process. InputError: malformed, or of another environment."""
        raise NotImplementedError

    def unit(self) -> tuple[int, ...] | None:
        """The coverage unit in which the agent stands (5), None where it is in none or dead. The algorithm never sees it."""
        raise NotImplementedError


def check_contract(env) -> None:
    """Raise InputError, saying what is wrong, unless `env` is a persistent environment as PersistentEnv describes it."""
    names = ["reset", "step", "snapshot", "restore", "unit", "close"]
    if missing := [name for name in names if not callable(getattr(env, name, None))]:
        raise InputError(f"the environment lacks {', '.join(missing)}(), see envs.py; of a wrapped one give env.unwrapped")
    actions, frames = getattr(env, "action_space", None), getattr(env, "observation_space", None)
    if not isinstance(actions, gymnasium.spaces.Discrete) or actions.n > 256:
        raise InputError(f"the action space is {actions}: it must be Discrete with at most 256 actions")
    if not isinstance(frames, gymnasium.spaces.Box) or frames.dtype != np.uint8 or len(frames.shape) not in (2, 3):
        raise InputError(f"the observation space is {frames}: it must be a Box of uint8, (H, W) or (H, W, C)")
    frame = np.array(env.reset()[0])
    if frame.shape != frames.shape or frame.dtype != np.uint8:
        raise InputError(f"reset() gives a frame {frame.shape} of {frame.dtype}: it must be as the observation space says")
    snapshot = env.snapshot()
    if not isinstance(snapshot, bytes) or not np.array_equal(env.restore(snapshot), frame):
        raise InputError("snapshot() must give bytes, and restore() of them the same frame again: see PersistentEnv in envs.py")


# ---- The maze: a side-view level in the spirit of the Prince of Persia (paper 5) ---------------------------------

NOOP, LEFT, RIGHT, UP, DOWN, A, B = range(7)  # the seven actions of the Prince of Persia environment, in its order
COLUMNS, ROWS = 10, 3  # tiles of a room, which is one screen

# A level is drawn in rooms of 10 x 3 tiles, apart by spaces.
#   #  wall      _  floor       @  floor where the agent starts     .  open: no floor, one falls through
#   ^  spikes    a  pressure plate, latched, opens every gate A     A  gate, closed until its plate is pressed
LEVELS = {
    2: """
    ##.____^__ _______.__ _____.____ ___.____##
    ##__.____# ___.______ ___.______ ______.___
    ####__._B_ _____^____ _c____._## #__.^____#
    ##__.____# ##_.____## #____.____ ##____.__#
    ##_.______ ____^___._ #.____C___ ____D__.__
    ##b______# ####__.A^_ #_____._## #.__^__e_#
    ##_.__^___ ____.___## ##___.____ ____._____
    #____.#### ##_.____a# ##____.___ __.___^___
    #@_____### ##___##### #________# #d__E___^#
    """,
    3: """
    ##.____^__ ____^__.__ ___^_.____ ___.__^_##
    ##__.____# ___.____^_ ___.___^__ ______.___
    ####__._B_ __^__^____ _c____._## #__.^____#
    ##__.____# ##_.____## #__^_.____ ##____.__#
    ##_.___^__ ____^___._ #.____C___ ____D__.__
    ##b______# ####__.A^_ #_____._## #.__^__e_#
    ##_.__^___ ____.___## ##___.__^_ ____._____
    #____.#### ##_.____a# ##____.___ __.___^___
    #@_____### ##___##### #_.______# #d__E___^#
    ##_^__.___ ___^_.____ _____.__^_ __________
    #_.__^.___ _.__^_____ ___.___^__ ____._____
    #___G____# #____^__g# #_^_____h# #_^__H__^#
    """,
}
LEVELS[1] = "\n".join(line[:36] for line in LEVELS[2].splitlines())  # its first three columns of rooms

# The agent, facing right, alive and dead; h head, b body: drawn at 6 x 12 to a tile, sampled to the tile's real size.
SPRITE = ("...... ...... ...... ...... ..hhhh ..hhhh ..bb.. .bbbbb .bbb.b ..bb.. .bbbb. bb..bb",
          "...... ...... ...... ...... ...... ...... ...... ...... ...... ...... bbbbbh bbbbhh")
COLOURS = {"h": (255, 214, 170), "b": (255, 255, 255)}
LUMINANCE = np.array([77, 150, 29], np.uint32)  # of red, green and blue, in 1/256
FLOOR, STONE, STEEL, PLATE, SUNK = (186, 160, 120), (112, 98, 86), (196, 206, 214), (240, 196, 60), (84, 60, 40)


class Maze(PersistentEnv):
    """A deterministic level of several rooms, of which the agent sees one; the reward is always 0.
    LEFT and RIGHT turn the agent or, where it faces that way, run one tile. A jumps two tiles ahead, over whatever is in the tile
    between. B steps one tile ahead, onto spikes without harm and never over an edge. UP climbs, from under an opening, to the
    floor beside it that the agent faces. DOWN hangs from the edge ahead and lets go, which takes a row off the fall. A fall of
    two rows or more kills, and so do spikes met in any way but by B.
    unit() is (room, column, row). A snapshot is canonical: equal states have equal bytes. Raises InputError for an unknown
    level, a frame_size that is no int or is below 32, an unknown render_mode."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    unit_name = "tiles"

    def __init__(self, level: int = 1, frame_size: int = 32, render_mode: str | None = None):
        if not isinstance(level, int) or level not in LEVELS:
            raise InputError(f"unknown maze level {level!r}: there are {', '.join(map(str, sorted(LEVELS)))}")
        if not isinstance(frame_size, int) or frame_size < 32:
            raise InputError(f"frame_size must be a whole number of pixels, 32 or more, and not {frame_size!r}")
        if render_mode not in (None, "rgb_array"):
            raise InputError(f"unknown render_mode {render_mode!r}: the maze has rgb_array")
        self.level, self.frame_size, self.render_mode = level, frame_size, render_mode
        self.tiles = [line.replace(" ", "") for line in LEVELS[level].splitlines() if line.strip()]
        self.across, self.down = len(self.tiles[0]) // COLUMNS, len(self.tiles) // ROWS  # rooms
        self.letters = sorted({tile for line in self.tiles for tile in line if tile.islower()})
        (start,) = [(x, y) for y, line in enumerate(self.tiles) for x, tile in enumerate(line) if tile == "@"]
        self.start = self.state = (*start, 1, 0, 0)  # x, y, facing right, plates pressed as bits, dead
        self.observation_space = gymnasium.spaces.Box(0, 255, (frame_size, frame_size), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(7)
        self._seen: dict[tuple, np.ndarray] = {}  # frames of the states met lately
        self.full_coverage = len(self.reachable())

    def reset(self, *, seed=None, options=None):
        """Back to the start of the level; gives the observation, (frame_size, frame_size) uint8, and {}."""
        super().reset(seed=seed)
        self.state = self.start
        return self._frame(), {}

    def step(self, action: int):
        """One action, 0 to 6. Raises InputError for any other, and where the agent is already dead."""
        if action not in range(7):
            raise InputError(f"the maze has actions 0 to 6, and not {action!r}")
        if self.state[4]:
            raise InputError("the agent is dead: reset or restore the maze before the next step")
        self.state = self._next(self.state, action)
        return self._frame(), 0.0, bool(self.state[4]), False, {}

    def snapshot(self) -> bytes:
        """Six bytes: level, x, y, facing, plates, dead."""
        return bytes((self.level, *self.state))

    def restore(self, snapshot: bytes) -> np.ndarray:
        """Return to the state of `snapshot` (see PersistentEnv.restore)."""
        self.state = self._read(snapshot)
        return self._frame()

    def unit(self) -> tuple[int, int, int] | None:
        """(room, column, row) of the living agent, None of a dead one."""
        x, y, *_, dead = self.state
        return None if dead else self._place(x, y)

    def render(self) -> np.ndarray | None:
        """The room in which the agent is, (360, 360, 3) uint8; None without a render_mode."""
        return None if self.render_mode is None else self._picture(36, 120)

    def reachable(self) -> set[tuple[int, int, int]]:
        """Every unit in which the agent can stand alive, by breadth-first search over the full states."""
        return {self._place(x, y) for x, y, *_, dead in self._search(self.start) if not dead}

    def distances(self, snapshot: bytes) -> dict[bytes, int]:
        """Steps from the state of `snapshot` to every full state that follows from it, dead ones too, by snapshot."""
        return {bytes((self.level, *state)): steps for state, steps in self._search(self._read(snapshot)).items()}

    def level_map(self) -> tuple[np.ndarray, dict[tuple[int, int, int], tuple[int, int, int, int]]]:
        """The whole level with tiles of 8 x 24 pixels, nothing pressed yet; a box for each reachable unit."""
        w, h, across = 8, 24, self.across
        rows = [np.hstack([self._paint_room(k * across + i, 0, w, h) for i in range(across)]) for k in range(self.down)]
        return np.vstack(rows), {(room, x, y): ((room % across * COLUMNS + x) * w, (room // across * ROWS + y) * h, w, h)
                                 for room, x, y in self.reachable()}

    def _tile(self, x: int, y: int, plates: int) -> str:
        """The tile as it acts now: beyond the level and at a closed gate there is wall, at an open one floor."""
        tile = self.tiles[y][x] if 0 <= y < len(self.tiles) and 0 <= x < len(self.tiles[0]) else "#"
        opened = tile.isupper() and plates >> self.letters.index(tile.lower()) & 1
        return "_" if opened else "#" if tile.isupper() else tile

    def _next(self, state: tuple, action: int) -> tuple:
        """The state after one action."""
        x, y, facing, plates, _ = state
        ahead, hang = 1 if facing else -1, 0
        if action in (LEFT, RIGHT) and facing != (action == RIGHT):
            facing = 1 - facing
        elif action in (LEFT, RIGHT) and self._tile(x + ahead, y, plates) != "#":
            x += ahead
        elif action == UP:
            if self._tile(x, y - 1, plates) == "." and self._tile(x + ahead, y - 1, plates) not in "#.":
                x, y = x + ahead, y - 1
        elif action == DOWN and self._tile(x + ahead, y, plates) == ".":
            x, hang = x + ahead, 1
        elif action == A:
            for _ in range(2):
                x += ahead if self._tile(x + ahead, y, plates) != "#" else 0
        elif action == B and self._tile(x + ahead, y, plates) not in "#.":
            x += ahead
        edge = y
        while (tile := self._tile(x, y, plates)) == ".":
            y += 1
        arrived = (x, y) != state[:2]
        dead = y - edge - hang >= 2 or (arrived and tile == "^" and action != B)
        if tile.islower():
            plates |= 1 << self.letters.index(tile)
        return x, y, facing, plates, int(dead)

    def _search(self, start: tuple) -> dict[tuple, int]:
        """Breadth-first: each state that follows from `start`, with its distance in steps."""
        steps, queue = {start: 0}, [start]
        for state in queue:  # which grows meanwhile
            for action in range(0 if state[4] else 7):
                after = self._next(state, action)
                if after not in steps:
                    steps[after] = steps[state] + 1
                    queue.append(after)
        return steps

    def _read(self, snapshot: bytes) -> tuple:
        if isinstance(snapshot, bytes) and len(snapshot) == 6 and snapshot[0] == self.level:
            x, y, facing, plates, dead = state = tuple(snapshot[1:])
            if facing < 2 and dead < 2 and not plates >> len(self.letters) and self._tile(x, y, plates) not in "#.":
                return state
        raise InputError(f"no snapshot of maze level {self.level}: {snapshot!r:.60}")

    def _place(self, x: int, y: int) -> tuple[int, int, int]:
        return y // ROWS * self.across + x // COLUMNS, x % COLUMNS, y % ROWS  # room, column, row

    def _frame(self) -> np.ndarray:
        """The observation: luminance, in whole numbers so that every machine agrees, centred on black."""
        if self.state not in self._seen:
            self._seen = self._seen if len(self._seen) < 4096 else {}
            size, frame = self.frame_size, np.zeros((self.frame_size, self.frame_size), np.uint8)
            picture = self._picture(size // COLUMNS, size // ROWS)
            top, left = ((size - side) // 2 for side in picture.shape[:2])
            frame[top : top + picture.shape[0], left : left + picture.shape[1]] = picture.astype(np.uint32) @ LUMINANCE >> 8
            self._seen[self.state] = frame
        return self._seen[self.state].copy()

    def _picture(self, w: int, h: int) -> np.ndarray:
        """The room with the agent, (3 h, 10 w, 3) uint8."""
        x, y, facing, plates, dead = self.state
        room, column, row = self._place(x, y)
        picture = self._paint_room(room, plates, w, h)
        paint_agent(picture[row * h :, column * w :][:h, :w], facing, dead)
        return picture

    def _paint_room(self, room: int, plates: int, w: int, h: int) -> np.ndarray:
        """The room without the agent, (3 h, 10 w, 3) uint8; plates and gates show their state."""
        pixel, thick = max(1, w // 3), max(1, h // 8)
        down, across = np.indices((ROWS * h, COLUMNS * w)) // pixel
        pattern = (down * 0, down // 2 % 2, across // 2 % 2, (down // 2 + across // 2) % 2, (down + across) // 2 % 2)
        shade = 18 + room * 5 % 7 * 8 + 16 * pattern[room % 5]
        tint = ((0.8, 0.9, 1.3), (1.2, 0.9, 0.8), (0.8, 1.1, 0.8))[room % 3]
        picture = (shade[..., None] * np.array(tint)).astype(np.uint8)
        for row, column in np.ndindex(ROWS, COLUMNS):
            tile = self.tiles[room // self.across * ROWS + row][room % self.across * COLUMNS + column]
            box = picture[row * h : (row + 1) * h, column * w : (column + 1) * w]
            pressed = tile.isalpha() and plates >> self.letters.index(tile.lower()) & 1
            if tile == "#":
                box[:] = STONE
                box[::thick * 2] = np.array(STONE) * 3 // 4  # joints
            elif tile != ".":
                box[-thick:] = FLOOR
            if tile == "^":
                for i in range(w):  # two teeth
                    box[h - thick - round(0.3 * h * (1 - abs((2 * i + 1) / w % 1 * 2 - 1))) : h - thick, i] = STEEL
            elif tile.islower():
                box[-thick if pressed else -2 * thick :] = SUNK if pressed else PLATE
            elif tile.isupper():
                box[: h // 5 if pressed else h - thick, np.arange(w) // pixel % 2 == 0] = STEEL  # bars
        return picture


def paint_agent(box: np.ndarray, facing: int, dead: int) -> None:
    """Paint the agent over a tile, (h, w, 3) uint8, in place: above its floor, the sprite sampled to that size."""
    lines = np.array([list(line if facing else line[::-1]) for line in SPRITE[dead].split()])
    h, w = len(box) - max(1, len(box) // 8), box.shape[1]
    body = lines[np.minimum((2 * np.arange(h) + 1) * 12 // (2 * h), 11)][:, (2 * np.arange(w) + 1) * 6 // (2 * w)]
    for letter, colour in COLOURS.items():
        box[:h][body == letter] = colour


# ---- the emulators (3.2, 5, 6.1; S3.2-01, S3.2-02, S5-*, S6.1-01, S6.1-07, S6.2-01, S6.2-02) --------

FRAMESKIP = 4  # emulator frames a step (6.1)


def _overlaps(pixels: int, size: int) -> np.ndarray:
    """(size, pixels): how much of each pixel, in 1/size of it, lies in each of `size` equal parts."""
    part, pixel = np.arange(size)[:, None] * pixels, np.arange(pixels) * size
    return (np.minimum(part + pixels, pixel + size) - np.maximum(part, pixel)).clip(0).astype(float)


class EmulatorEnv(PersistentEnv):
    """What the emulators share: preprocessing (6.1), snapshots (3.2) and the end of an episode (R23).
    Observations are the last frame of a step (R22), gray, area-averaged to (frame_size, frame_size) uint8. The reward is 0.0.
    info holds the subclass's readings of RAM, and "blank": no pixel is lit (R24). A subclass has _tick and _ram, sets _emulator
    and its _screen, _save and _load, then calls _begin."""

    LIVES = "lives"  # the reading whose drop ends the episode
    level: int | None = None  # the level whose leaving ends it, where RAM tells the level

    def _begin(self, game: bytes, actions: int, frame_size: int) -> None:
        """Make the present state s_init. `game` keeps the snapshots of different games apart."""
        self.action_space = gymnasium.spaces.Discrete(actions)
        self.observation_space = gymnasium.spaces.Box(0, 255, (frame_size, frame_size), np.uint8)
        self._frame = self._observe().tobytes()
        # Most of a state never changes: packed against s_init, it takes a fraction of its bytes.
        self._dictionary = game + self._frame + self._save()
        self._start = self.snapshot()

    def _observe(self) -> np.ndarray:
        luma = self._screen().astype(np.float32) @ np.float32([299, 587, 114])  # (H, W)
        down, across = (_overlaps(pixels, self.observation_space.shape[0]) for pixels in luma.shape)
        return (down @ np.rint(luma / 1000) @ across.T // luma.size).astype(np.uint8)  # whole numbers: exact everywhere

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Back to s_init, the same state every time. Returns (frame, info)."""
        super().reset(seed=seed)
        frame = self.restore(self._start)
        return frame, {**self._ram(), "blank": not frame.any()}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Four emulator frames of one action. Returns (frame, 0.0, terminated, False, info)."""
        lives = self._ram()[self.LIVES]
        for _ in range(FRAMESKIP):
            self._tick(action)
        frame, ram = self._observe(), self._ram()
        self._frame = frame.tobytes()
        ended = ram[self.LIVES] < lives or ram.get("level") != self.level
        return frame, 0.0, ended, False, {**ram, "blank": not frame.any()}

    def snapshot(self) -> bytes:
        """The emulator's whole state and the frame, as emulators restore no screen; bytes, compressed."""
        packer = zlib.compressobj(level=2, zdict=self._dictionary)
        return packer.compress(self._frame + self._save()) + packer.flush()

    def restore(self, snapshot: bytes) -> np.ndarray:
        """Load a snapshot, at no step; returns its frame. InputError: damaged, or of another s_init."""
        unpacker, pixels = zlib.decompressobj(zdict=self._dictionary), len(self._frame)
        try:
            content = unpacker.decompress(snapshot)  # zlib compares the checksums of dictionary and content
            loaded = unpacker.eof and not unpacker.unused_data and self._load(content[pixels:]) is not False
        except (zlib.error, TypeError):
            loaded = False
        if not loaded:
            raise InputError("the snapshot is damaged, or of another game, level or start state")
        self._frame = content[:pixels]
        return np.frombuffer(self._frame, np.uint8).reshape(self.observation_space.shape).copy()

    def close(self) -> None:
        """Release the emulator: stable-retro allows one at a time in a process."""
        self._emulator = self._screen = self._save = self._load = None


class PrinceOfPersia(EmulatorEnv):
    """One level of Prince of Persia on the NES, through stable-retro (section 5).
    rom: the user's cartridge image, an iNES file. state: the gzip of an emulator state, as the authors publish them (level 1: in
    the sword's room with the sword, 6.2). As a state has no screen, s_init comes one frame without buttons after it. Without
    `state`, s_init is one second after power-on: only for a cartridge that is then in play on `level`, as no action is START.
    The clock is held at 99 minutes. info: level, room, x, y (pixels), hit_points and sword, and "blank".
    InputError: an unusable file, another level's state, no stable-retro, a second emulator in the process."""

    ACTIONS = ("NO-OP", "LEFT", "RIGHT", "UP", "DOWN", "A", "B")  # section 5; NO-OP names no button
    # Units in the full coverage sets of levels 1 to 14, counted from the authors' reference data (R26).
    FULL_COVERAGE = (721, 723, 756, 706, 598, 287, 755, 736, 797, 444, 575, 688, 223, 107)
    LIVES = "hit_points"
    unit_name = "units of 32 x 32 pixels"

    def __init__(self, rom: str | None = None, level: int = 1, state: str | None = None, frame_size: int = 96):
        if not isinstance(level, int) or level not in range(1, 15):
            raise InputError(f"Prince of Persia has levels 1 to 14, not {level}")
        if not rom:
            raise InputError("Prince of Persia needs your own cartridge image: --rom FILE.nes")
        try:
            image = Path(rom).read_bytes()
            start = gzip.decompress(Path(state).read_bytes()) if state else b""
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(f"cannot read the cartridge or its start state: {error}") from None
        if image[:4] != b"NES\x1a" or len(image) < 16 + 16384 * image[4]:
            raise InputError(f"{rom} is no complete NES cartridge image (iNES)")
        try:
            import stable_retro
        except ImportError:
            raise InputError("Prince of Persia needs stable-retro: pip install stable-retro") from None
        # The core goes by the suffix and reads the file once: a copy will do, and nothing stays behind.
        with tempfile.TemporaryDirectory() as folder:
            Path(folder, "rom.nes").write_bytes(image)
            try:
                self._emulator = stable_retro.RetroEmulator(f"{folder}/rom.nes")
            except RuntimeError as error:
                hint = ": close() the first" if "multiple" in str(error) else ""
                raise InputError(f"the emulator does not take {rom}: {error}{hint}") from None
        self._data = stable_retro.data.GameData()
        self._emulator.configure_data(self._data)
        self._screen = self._emulator.get_screen  # (224, 240, 3)
        self._save, self._load = self._emulator.get_state, self._emulator.set_state
        buttons = stable_retro.get_system_info("Nes")["buttons"]
        self._masks = np.array([[button == name for button in buttons] for name in self.ACTIONS], np.uint8)
        self.level, self.full_coverage = level, self.FULL_COVERAGE[level - 1]
        # The core takes any bytes of the right length, and may then hang: look for a state's mark first.
        loaded = not state or start[:3] == b"FCS" and self._load(start)
        for _ in range(1 if state else 60):
            self._tick(0)
        ram = self._ram()
        if not loaded or self.unit() is None or ram["hit_points"] == 0:
            self.close()
            problem = f"is not in play on level {level}: {ram}" if loaded else "is no state of this emulator"
            raise InputError(f"{state or rom} {problem}")
        self._begin(b"%d %d" % (zlib.crc32(image), level), len(self.ACTIONS), frame_size)

    def _tick(self, action):
        self._emulator.set_button_mask(self._masks[action])
        self._emulator.step()
        self._data.memory.assign(1221, "<u2", 0x3939)  # two digits, 9 and 9: the minutes left

    def _ram(self):
        read = self._data.memory.extract
        return {"level": read(112, "|u1") + 1, "room": read(1246, "|u1"), "x": read(1243, "<u2"),
                "y": read(1777, "|u1") & 224, "hit_points": read(1743, "|u1"), "sword": read(1774, "|u1")}

    def unit(self) -> tuple[int, int, int] | None:
        """(room, x // 32, y // 32). None of the dead, outside the room (left of it x wraps to 65535) or the level."""
        ram = self._ram()
        valid = ram["level"] == self.level and ram["x"] <= 332 and 32 <= ram["y"] <= 192 and ram["hit_points"]
        return (ram["room"], ram["x"] // 32, ram["y"] // 32) if valid else None


class Montezuma(EmulatorEnv):
    """Montezuma's Revenge through ale-py, which brings the game: not in the paper, but needs no cartridge.
    ALE/MontezumaRevenge-v5 without sticky actions (R22) and without its end after 108,000 frames, which rollbacks would
    reach. ALE's minimal actions, all 18. No full coverage set is known. info: room, x, y (ALE pixels), lives, "blank"."""

    unit_name = "units of 16 x 16 pixels"

    def __init__(self, frame_size: int = 96):
        try:
            import ale_py
        except ImportError:
            raise InputError("Montezuma's Revenge needs ale-py: pip install ale-py") from None
        ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)  # no banner
        self._emulator = ale = ale_py.ALEInterface()
        ale.setFloat("repeat_action_probability", 0.0)
        ale.setInt("random_seed", 0)  # of numbers drawn to no effect, but part of the state
        ale.loadROM(ale_py.roms.get_rom_path("montezuma_revenge"))
        ale.reset_game()
        self._screen, self._actions = ale.getScreenRGB, ale.getMinimalActionSet()
        self._save = lambda: ale.cloneState(include_rng=True).serialize()
        self._load = lambda state: ale.restoreState(ale_py.ALEState(state))
        self._begin(b"Montezuma", len(self._actions), frame_size)

    def _tick(self, action):
        self._emulator.act(self._actions[action])

    def _ram(self):
        room, x, y, lives = self._emulator.getRAM()[[3, 42, 43, 58]].tolist()
        return {"room": room, "x": x, "y": y, "lives": lives}

    def unit(self) -> tuple[int, int, int]:
        """(room, column, row) of 16 pixels: a tenth of the screen's width, as a plate is of the Prince's room."""
        room, x, y, _ = self._ram().values()
        return room, x // 16, 15 - y // 16  # RAM counts y upwards


# ---- The factory by name -----------------------------------------------------------------------------------------

gymnasium.register("RbExploreMaze-v0", entry_point=Maze)
ENVIRONMENTS = {"maze": Maze, "pop": PrinceOfPersia, "montezuma": Montezuma}


def make_env(name: str, **options) -> PersistentEnv:
    """The environment of that name; options are its constructor's. Raises InputError for unknown ones."""
    if name not in ENVIRONMENTS:
        raise InputError(f"unknown environment {name!r}: there are {', '.join(ENVIRONMENTS)}")
    known = inspect.signature(ENVIRONMENTS[name]).parameters
    if unknown := [option for option in options if option not in known]:
        raise InputError(f"{name} has no option {unknown[0]!r}: it has {', '.join(known)}")
    return ENVIRONMENTS[name](**options)
