"""Made-up scans: what sensors and converters write into `.bin` files.

A set of scans has one layout: a scene and a sensor give the coordinates, their order and their padding; a template
gives the columns after x, y and z. Everything is drawn from a seed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

Rng = np.random.Generator

# The columns after x, y, z by number of columns, as data sets, drivers and converters write them.
TEMPLATES: dict[int, tuple[str, ...]] = {
    3: ("",),
    4: ("intensity", "intensity", "zero", "one", "ring", "time", "label", "packed_rgb"),
    5: ("intensity ring", "intensity time", "intensity label", "zero zero", "intensity elongation"),
    6: ("intensity ring time", "red green blue", "nx ny nz", "vx vy vz", "intensity ring zero"),
    7: ("red green blue intensity", "nx ny nz intensity", "intensity ring time returns", "rcs vx vy time"),
    8: ("one intensity zero zero zero", "intensity time returns ring range", "red green blue nx ny"),
}


@dataclass(frozen=True, eq=False)
class MadeSet:
    """The contents of scans of one layout, and the floats per point."""

    scans: tuple[bytes, ...]
    columns: int


def make_set(seed: int) -> MadeSet:
    """Draws a set of scans of 3 to 8 columns."""
    rng = np.random.default_rng(seed)
    columns = int(rng.integers(3, 9))
    extra = str(rng.choice(TEMPLATES[columns])).split()
    style, layout = _Style.draw(rng), SENSORS[rng.integers(len(SENSORS))](rng)
    return MadeSet(tuple(_scan(rng, layout, extra, style) for _ in range(rng.integers(1, 7))), columns)


@dataclass(frozen=True)
class _Style:
    """How one set is written."""

    intensity: str
    time: str
    order: str
    padding: str
    pose: str
    missing: float

    @staticmethod
    def draw(rng: Rng) -> _Style:
        return _Style(
            intensity=str(rng.choice(["fraction", "bytes", "float bytes", "16 bits", "dark"])),
            time=str(rng.choice(["seconds", "negative", "nanoseconds", "absolute"])),
            order=str(rng.choice(["sensor", "sensor", "shuffled", "sorted"])),
            padding=str(rng.choice(["none", "none", "none", "nan", "zeros"])),
            pose=str(rng.choice(["own", "own", "own", "turned", "map", "millimetres"])),
            missing=float(rng.choice([0.02, 0.4])),
        )


@dataclass(frozen=True, eq=False)
class Sweep:
    """Points of a scan in the sensor's order: coordinates, ring and share of the sweep's time."""

    xyz_m: np.ndarray
    ring: np.ndarray
    phase: np.ndarray


def _scan(rng: Rng, layout: Callable[[Rng], Sweep], extra: list[str], style: _Style) -> bytes:
    sweep = layout(rng)
    xyz = sweep.xyz_m
    parts = [_posed(rng, xyz, style)]
    colors, normals = _colors(rng, len(xyz)), _normals(rng, len(xyz))
    velocity = _velocity(rng, len(xyz))
    made = dict(
        zip(
            ("red", "green", "blue", "nx", "ny", "nz", "vx", "vy", "vz"),
            [*colors.T, *normals.T, *velocity.T],
            strict=True,
        )
    )
    made |= {"ring": sweep.ring, "range": np.linalg.norm(xyz, axis=1), "time": _time(rng, sweep.phase, style)}
    for name in extra:
        parts.append((made[name] if name in made else COLUMNS[name](rng, len(xyz), style))[:, None])
    table = np.concatenate(parts, axis=1).astype(np.float32)
    gone = rng.random(len(table)) < style.missing
    if style.padding == "none":
        table = table[~gone]
    else:
        table[gone, : 3 if rng.random() < 0.5 else table.shape[1]] = np.nan if style.padding == "nan" else 0.0
    if style.order == "shuffled":
        rng.shuffle(table)
    elif style.order == "sorted":
        table = table[np.argsort(table[:, 0], kind="stable")]
    return table.tobytes()


def _posed(rng: Rng, xyz: np.ndarray, style: _Style) -> np.ndarray:
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    match style.pose:
        case "turned":
            return xyz @ turn.T
        case "map":
            return xyz + np.array([rng.uniform(2e5, 8e5), rng.uniform(1e6, 6e6), rng.uniform(0, 900)])
        case "millimetres":
            return xyz * 1000
        case _:
            return xyz


# Sensors: each draws a layout, which then draws sweeps.


def _rotating(rng: Rng) -> Callable[[Rng], Sweep]:
    """A rotating LiDAR on a street: beams, their order in the file, steps a turn, height."""
    beams = int(rng.choice([16, 32, 40, 64, 128]))
    low, high = rng.uniform(-30, -10), rng.uniform(2, 20)
    steps = 24_000 // beams
    order = str(rng.choice(["azimuth", "interleaved", "ring", "falling"]))
    height = rng.uniform(0.4, 2.2)

    def sweep(rng: Rng) -> Sweep:
        elevation = np.deg2rad(np.linspace(low, high, beams))
        ring = np.arange(beams)
        if order == "interleaved":
            ring = np.arange(beams).reshape(2, -1).T.ravel()
        elif order == "falling":
            ring = ring[::-1]
        azimuth = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(steps) / steps
        row: Literal["C", "F"] = "F" if order == "ring" else "C"
        a, r = (grid.ravel(row) for grid in np.meshgrid(azimuth, ring, indexing="ij"))
        direction = np.stack(
            [np.cos(elevation[r]) * np.cos(a), np.cos(elevation[r]) * np.sin(a), np.sin(elevation[r])], axis=1
        )
        distance = _street(rng, direction, height)
        phase = ((a - azimuth[0]) / (2 * np.pi)) % 1
        return Sweep(direction * distance[:, None] + rng.normal(0, 0.01, direction.shape), r.astype(float), phase)

    return sweep


def _street(rng: Rng, direction: np.ndarray, height: float) -> np.ndarray:
    """Distances to the ground, to facades and to boxes such as cars."""
    with np.errstate(divide="ignore"):
        ground = np.where(direction[:, 2] < -1e-3, height / -direction[:, 2], np.inf)
        facade = np.full(len(direction), rng.uniform(60, 120))
        for side in (-1, 1):
            facade = np.minimum(
                facade,
                np.where(direction[:, 1] * side > 0.02, rng.uniform(6, 40), np.inf)
                / np.maximum(direction[:, 1] * side, 1e-3),
            )
    distance = np.minimum(ground, facade)
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    for _ in range(rng.integers(2, 12)):
        middle, width = rng.uniform(-np.pi, np.pi), rng.uniform(0.03, 0.3)
        near = np.abs(np.angle(np.exp(1j * (azimuth - middle)))) < width
        distance = np.where(near & (direction[:, 2] < 0.05), np.minimum(distance, rng.uniform(3, 40)), distance)
    return np.minimum(distance, 120.0)


def _room(rng: Rng) -> Callable[[Rng], Sweep]:
    """A depth camera in a room, one point a pixel, camera axes or level axes."""
    level = bool(rng.random() < 0.5)
    height_px, width_px = 120, 160

    def sweep(rng: Rng) -> Sweep:
        v, u = np.mgrid[:height_px, :width_px].reshape(2, -1)
        direction = np.stack([(u - 79.5) / 140, (v - 59.5) / 140, np.ones(u.size)], axis=1)
        depth = np.full(u.size, rng.uniform(2, 6))
        with np.errstate(divide="ignore"):
            depth = np.minimum(depth, np.where(direction[:, 1] > 0.01, 1.2 / direction[:, 1], np.inf))
            depth = np.minimum(depth, np.where(direction[:, 0] > 0.01, rng.uniform(0.8, 3) / direction[:, 0], np.inf))
        for _ in range(rng.integers(1, 6)):
            u0, v0 = rng.uniform(0, 160), rng.uniform(20, 120)
            near = (np.abs(u - u0) < rng.uniform(8, 40)) & (np.abs(v - v0) < rng.uniform(8, 40))
            depth = np.where(near, np.minimum(depth, rng.uniform(0.6, 3)), depth)
        xyz = direction * depth[:, None] + rng.normal(0, 0.003, (u.size, 3))
        return Sweep(xyz[:, [2, 0, 1]] * [1, -1, -1] if level else xyz, v.astype(float), v / height_px)

    return sweep


def _object(rng: Rng) -> Callable[[Rng], Sweep]:
    """Points sampled on a made-up object, centred, of metre size or scaled to the unit ball."""
    unit = bool(rng.random() < 0.5)
    sides = rng.uniform(0.2, 2.0, 3)

    def sweep(rng: Rng) -> Sweep:
        count = int(rng.integers(1_000, 10_000))
        xyz = rng.uniform(-1, 1, (count, 3))
        face = rng.integers(0, 3, count)
        xyz[np.arange(count), face] = np.sign(xyz[np.arange(count), face])
        xyz = xyz * sides
        if unit:
            xyz /= np.linalg.norm(xyz, axis=1).max()
        return Sweep(xyz, face.astype(float), np.arange(count) / count)

    return sweep


SENSORS = (_rotating, _room, _object)


# Columns beside the coordinates.


def _intensity(rng: Rng, count: int, style: _Style) -> np.ndarray:
    share = rng.beta(1.2, 4.0, count)
    match style.intensity:
        case "fraction":
            return share
        case "bytes":
            return np.rint(share * 255)
        case "float bytes":
            return share * 255
        case "16 bits":
            return np.rint(share * 65535)
        case _:
            return np.where(rng.random(count) < 0.9, 0.0, np.rint(share * 255))


def _time(rng: Rng, phase: np.ndarray, style: _Style) -> np.ndarray:
    match style.time:
        case "seconds":
            return phase * 0.1
        case "negative":
            return (phase - 1) * 0.1
        case "nanoseconds":
            return phase * 1e8
        case _:
            return 1.5e9 + rng.uniform(0, 1e8) + phase * 0.1


def _colors(rng: Rng, count: int) -> np.ndarray:
    colors = np.clip(rng.normal(rng.uniform(60, 190), 50, (count, 1)) + rng.normal(0, 12, (count, 3)), 0, 255)
    return np.rint(colors) if rng.random() < 0.6 else colors / 255


def _normals(rng: Rng, count: int) -> np.ndarray:
    axis = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1, 1], (count, 1))
    normals = axis + rng.normal(0, rng.choice([0.02, 0.3]), (count, 3))
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _velocity(rng: Rng, count: int) -> np.ndarray:
    moving = rng.random((count, 1)) < rng.uniform(0.02, 0.5)
    return np.where(moving, rng.normal(0, 6, (count, 3)), 0.0 if rng.random() < 0.5 else rng.normal(0, 0.1, (count, 3)))


def _packed_rgb(rng: Rng, count: int, style: _Style) -> np.ndarray:
    rgb = rng.integers(0, 256, (count, 3)).astype(np.uint32)
    return (rgb[:, 0] << 16 | rgb[:, 1] << 8 | rgb[:, 2]).astype(np.uint32).view(np.float32)


COLUMNS: dict[str, Callable[[Rng, int, _Style], np.ndarray]] = {
    "intensity": _intensity,
    "zero": lambda rng, count, style: np.zeros(count),
    "one": lambda rng, count, style: np.ones(count),
    "label": lambda rng, count, style: np.repeat(rng.integers(0, 20, count // 50 + 1), 50)[:count].astype(float),
    "elongation": lambda rng, count, style: np.where(rng.random(count) < 0.7, 0.0, rng.gamma(1, 0.2, count)),
    "returns": lambda rng, count, style: rng.choice([1.0, 2.0, 3.0], count, p=[0.8, 0.15, 0.05]),
    "rcs": lambda rng, count, style: rng.normal(8, 9, count),
    "ambient": lambda rng, count, style: np.rint(rng.gamma(3, 60, count)),
    "packed_rgb": _packed_rgb,
}


# Files that must be refused.


def _table(rng: Rng, columns: int) -> np.ndarray:
    style = _Style.draw(rng)
    names = ("intensity", "returns", "ambient", "elongation", "rcs", "label")
    sweep = _rotating(rng)(rng)
    extra = [COLUMNS[names[k % len(names)]](rng, len(sweep.xyz_m), style)[:, None] for k in range(columns - 3)]
    return np.concatenate([sweep.xyz_m, *extra], axis=1)


def _of_columns(columns: int) -> Callable[[Rng], bytes]:
    return lambda rng: _table(rng, columns).astype("<f4").tobytes()


# What the other files are, by name: none is a table of rows of 3 to 8 floats.
OTHERS: dict[str, Callable[[Rng], bytes]] = {
    "64-bit floats": lambda rng: _table(rng, 4).astype("<f8").tobytes(),
    "big-endian floats": lambda rng: _table(rng, 4).astype(">f4").tobytes(),
    "16-bit integers": lambda rng: (_table(rng, 4)[:, :4] * 100).astype("<i2").tobytes(),
    "column by column": lambda rng: np.asfortranarray(_table(rng, 4).astype("<f4")).tobytes("F"),
    "a header before the rows": lambda rng: b"\x01\x02\x03\x04 points v1 " + _table(rng, 4).astype("<f4").tobytes(),
    "noise": lambda rng: rng.bytes(160_000),
    "an image": lambda rng: rng.integers(90, 140, 192_000).astype(np.uint8).tobytes(),
    "zeros": lambda rng: bytes(96_000),
    "labels": lambda rng: rng.integers(0, 30, 24_000).astype("<u4").tobytes(),
    "text": lambda rng: "\n".join(" ".join(f"{v:.3f}" for v in row) for row in _table(rng, 3)[:5000]).encode(),
    "2 columns": lambda rng: _table(rng, 3)[:, :2].astype("<f4").tobytes(),
    **{f"{columns} columns": _of_columns(columns) for columns in (9, 12, 16)},
}
