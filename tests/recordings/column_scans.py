"""Made-up scans: what sensors and converters write into `.bin` files, all drawn from a seed.

A set of scans has one layout: a scene and a sensor give the coordinates, their order and their padding; a template
gives the columns after x, y and z.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

Rng = np.random.Generator

# The columns after x, y, z by number of columns, as data sets, drivers and converters write them.
TEMPLATES: dict[int, tuple[str, ...]] = {
    3: ("",),
    4: ("intensity", "intensity", "zero", "one", "ring", "time", "label", "packed"),
    5: ("intensity ring", "intensity time", "intensity label", "zero zero", "intensity elongation"),
    6: ("intensity ring time", "red green blue", "nx ny nz", "vx vy vz", "intensity ring zero"),
    7: ("red green blue intensity", "nx ny nz intensity", "intensity ring time returns", "rcs vx vy time"),
    8: ("one intensity zero zero zero", "intensity time returns ring range", "red green blue nx ny"),
}


def make_set(seed: int) -> tuple[list[bytes], int]:
    """Draws the contents of scans of one layout, of 3 to 8 columns, and the number of columns."""
    rng = np.random.default_rng(seed)
    columns = int(rng.integers(3, 9))
    extra, sensor = str(rng.choice(TEMPLATES[columns])).split(), SENSORS[rng.integers(len(SENSORS))]
    how = {
        "level": rng.choice((1.0, 255.0, 65535.0)),
        "order": rng.choice(("sensor", "sensor", "shuffled", "sorted")),
        "padding": rng.choice(("none", "none", "none", "nan", "zeros")),
        "missing": rng.choice((0.02, 0.4)),
        "scale": rng.choice((1.0, 1.0, 1.0, 1000.0)),
        "place": rng.choice(((0, 0, 0), (0, 0, 0), (4e5, 5e6, 300))),
        "clock": rng.choice((0.1, -0.1, 1e8)),
    }
    return [_scan(rng, *sensor(rng), extra, how) for _ in range(rng.integers(1, 7))], columns


def _scan(rng: Rng, xyz: np.ndarray, ring: np.ndarray, extra: list[str], how: dict[str, Any]) -> bytes:
    """A file of points (n, 3) and the ring of each."""
    columns = made_columns(rng, xyz, ring, how)
    table = np.column_stack([xyz * how["scale"] + how["place"], *(columns[name] for name in extra)]).astype(np.float32)
    gone = rng.random(len(table)) < how["missing"]
    if how["padding"] == "none":
        table = table[~gone]
    else:
        table[gone, : rng.choice((3, table.shape[1]))] = np.nan if how["padding"] == "nan" else 0.0
    if how["order"] == "shuffled":
        rng.shuffle(table)
    return (table[np.argsort(table[:, 0], kind="stable")] if how["order"] == "sorted" else table).tobytes()


def made_columns(rng: Rng, xyz: np.ndarray, ring: np.ndarray, how: dict[str, Any]) -> dict[str, np.ndarray]:
    """All columns that points may have."""
    n, share = len(xyz), rng.beta(1.2, 4.0, len(xyz))
    rgb = np.rint(np.clip(rng.normal(rng.uniform(60, 190), 50, (n, 1)) + rng.normal(0, 12, (n, 3)), 0, 255))
    normals = np.eye(3)[rng.integers(0, 3, n)] + rng.normal(0, 0.1, (n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    velocity = np.where(rng.random((n, 1)) < 0.2, rng.normal(0, 6, (n, 3)), 0.0)
    vectors = zip(("red", "green", "blue", "nx", "ny", "nz", "vx", "vy", "vz"), np.c_[rgb, normals, velocity].T)  # noqa: B905
    return {
        "intensity": share if how["level"] == 1 else np.rint(share * how["level"]), "ring": ring, "zero": np.zeros(n),
        "one": np.ones(n), "time": np.linspace(0, how["clock"], n), "range": np.linalg.norm(xyz, axis=1),
        "label": np.repeat(rng.integers(0, 20, n // 50 + 1), 50)[:n], "rcs": rng.normal(8, 9, n),
        "returns": rng.choice((1, 2, 3), n, p=(0.8, 0.15, 0.05)), "ambient": np.rint(rng.gamma(3, 60, n)),
        "elongation": np.where(rng.random(n) < 0.7, 0.0, rng.gamma(1, 0.2, n)),
        "packed": (rgb.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)).view(np.float32), **dict(vectors),
    }  # fmt: skip


def _rotating(rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """A rotating LiDAR on a street: the ground, facades to both sides, and boxes such as cars."""
    beams = int(rng.choice((16, 32, 64, 128)))
    elevation = np.deg2rad(np.linspace(rng.uniform(-30, -10), rng.uniform(2, 20), beams))
    azimuth = rng.uniform(0, 2 * np.pi) + np.linspace(0, 2 * np.pi, 24_000 // beams, endpoint=False)
    a, ring = (grid.ravel(rng.choice(("C", "F"))) for grid in np.meshgrid(azimuth, np.arange(beams), indexing="ij"))
    e = elevation[ring]
    direction = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    ground = rng.uniform(0.4, 2.2) / np.maximum(-direction[:, 2], 1e-3)
    facade = rng.uniform(6, 40) / np.maximum(np.abs(direction[:, 1]), 0.05)
    distance = np.minimum(np.minimum(ground, facade), 120.0)
    for middle in rng.uniform(-np.pi, np.pi, 6):
        near = (np.abs(np.angle(np.exp(1j * (a - middle)))) < rng.uniform(0.03, 0.3)) & (direction[:, 2] < 0.05)
        distance = np.where(near, np.minimum(distance, rng.uniform(3, 40)), distance)
    return direction * distance[:, None] + rng.normal(0, 0.01, direction.shape), ring.astype(float)


def _room(rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """A depth camera in a room, one point a pixel."""
    v, u = np.mgrid[:120, :160].reshape(2, -1)
    direction = np.stack([(u - 79.5) / 140, (v - 59.5) / 140, np.ones(u.size)], axis=1)
    floor = 1.2 / np.maximum(direction[:, 1], 0.01)
    wall = rng.uniform(0.8, 3) / np.maximum(direction[:, 0], 0.01)
    depth = np.minimum(np.minimum(floor, wall), rng.uniform(2, 6))
    return direction * depth[:, None] + rng.normal(0, 0.003, (u.size, 3)), v.astype(float)


def _object(rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Points on a box of metre size, in no order."""
    xyz = rng.uniform(-1, 1, (5_000, 3))
    face = rng.integers(0, 3, len(xyz))
    rows = np.arange(len(xyz))
    xyz[rows, face] = np.sign(xyz[rows, face])
    return xyz * rng.uniform(0.2, 2.0, 3), face.astype(float)


SENSORS = (_rotating, _room, _object)


def _table(rng: Rng, columns: int) -> np.ndarray:
    xyz, ring = _rotating(rng)
    made = made_columns(rng, xyz, ring, {"level": 255.0, "clock": 0.1})
    names = ("intensity", "returns", "ambient", "elongation", "rcs", "label")
    return np.column_stack([xyz, *(made[names[k % len(names)]] for k in range(columns - 3))])


# What the other files are, by name: none is a table of rows of 3 to 8 floats.
OTHERS: dict[str, Callable[[Rng], bytes]] = {
    "64-bit floats": lambda rng: _table(rng, 4).astype("<f8").tobytes(),
    "big-endian floats": lambda rng: _table(rng, 4).astype(">f4").tobytes(),
    "16-bit integers": lambda rng: (_table(rng, 4)[:, :4] * 100).astype("<i2").tobytes(),
    "column by column": lambda rng: np.asfortranarray(_table(rng, 4).astype("<f4")).tobytes("F"),
    "a header before the rows": lambda rng: b"\x01\x02\x03\x04 points v1 " + _table(rng, 4).astype("<f4").tobytes(),
    "noise": lambda rng: rng.bytes(160_000),
    "zeros": lambda rng: bytes(96_000),
    "text": lambda rng: "\n".join(" ".join(f"{v:.3f}" for v in row) for row in _table(rng, 3)[:5000]).encode(),
    "2 columns": lambda rng: _table(rng, 3)[:, :2].astype("<f4").tobytes(),
    "12 columns": lambda rng: _table(rng, 12).astype("<f4").tobytes(),
}
