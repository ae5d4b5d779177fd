"""Small sets of beams for tests of factor graphs."""

import numpy as np

from taichi_mrf.factor_graph.beams import Beams

CELL = 0.5
"""Cell size of all of them, in metres."""


def beams_of(rows: list[tuple[float, float, float, float, bool]]) -> Beams:
    """Beams in a plane from (x, y, angle, range, hit), in metres and radians."""
    table = np.array([row[:4] for row in rows], np.float64).reshape(-1, 4)
    x, y, angle, reach = table.T
    level = np.zeros(len(rows))
    return Beams(
        np.stack([x, y, level], axis=1),
        np.stack([np.cos(angle), np.sin(angle), level], axis=1),
        reach.astype(np.float32),
        np.array([row[4] for row in rows], bool),
    )


def random_beams(seed: int, number: int, side: float = 1.9) -> Beams:
    """Beams within a square that is at most 4 x 4 cells wide."""
    random = np.random.default_rng(seed)
    a, b = random.uniform(0.05, side, (2, number, 2))
    way = b - a
    reach = np.maximum(np.linalg.norm(way, axis=1), 1e-3)
    angle = np.arctan2(way[:, 1], way[:, 0])
    hit = random.random(number) < 0.75
    return beams_of(
        [(*a[i], angle[i], float(reach[i]), bool(hit[i])) for i in range(number)]  # type: ignore[misc]
    )


def corner_beams(seed: int, number: int) -> Beams:
    """Axis-parallel beams in separate rows and one column, most of whose graphs are trees."""
    random = np.random.default_rng(seed)
    rows = []
    for row in random.permutation(4)[:number]:
        begin, end = sorted(random.choice(np.arange(4), 2, replace=False) * CELL + 0.2)
        back = bool(random.random() < 0.5)
        x, angle = (end, np.pi) if back else (begin, 0.0)
        rows.append((x, row * CELL + 0.25, angle, end - begin, bool(random.random() < 0.7)))
    column = random.integers(4) * CELL + 0.3
    rows.append((column, 0.1, np.pi / 2, float(random.uniform(0.2, 1.7)), bool(random.random() < 0.7)))
    return beams_of(rows)


def room_beams(scans: int = 6, per_scan: int = 90, noise_m: float = 0.02, seed: int = 0) -> Beams:
    """Scans from several places of a room of 8 x 6 m with a pillar; beams beyond 5 m have no return."""
    random = np.random.default_rng(seed)
    rows = []
    for _ in range(scans):
        x, y = random.uniform(1.0, 3.0), random.uniform(1.0, 5.0)
        for angle in random.uniform(-np.pi, np.pi, per_scan):
            c, s = np.cos(angle), np.sin(angle)
            walls = [((8 if c > 0 else 0) - x) / c, ((6 if s > 0 else 0) - y) / s]
            reach = min(walls)
            along, apart = (5 - x) * c + (3 - y) * s, abs(-(5 - x) * s + (3 - y) * c)
            if along > 0 and apart < 0.5:
                reach = min(reach, along - np.sqrt(0.25 - apart**2))
            hit = bool(reach < 5)
            rows.append((x, y, angle, max(0.1, min(reach, 5) + random.normal(0, noise_m)), hit))
    return beams_of(rows)
