"""From the figures of many views to the rows of a table, beside what the paper reports."""

from collections.abc import Mapping, Sequence

from taichi_mrf.evaluation.tables import Entry, Spread, Table
from taichi_mrf.experiments.folds import Scored

COLUMNS: dict[str, str] = {
    "voxel": "voxel",
    "1.5sigma": "1.5sigma",
    "5cm": "5cm",
    "unanswered": "unanswered",
    "sensor": "noisy, sensor",
    "median_abs": "median error (m)",
    "rms": "RMS error (m)",
    "expected_median_abs": "median error of the mean (m)",
    "log_likelihood": "log-likelihood",
}
"""Figure -> heading."""

HOW_TO_READ = (
    "Share of pixels whose surface is right: that of the largest omega (row omega, the paper's metric), for "
    "MRFMap the measured surface where it is near. voxel = the depth lies in its voxel; "
    "1.5sigma = within 1.5 voxels (sigma = one voxel); 5cm = within 5 cm.",
    "Unanswered rays count as wrong. noisy, sensor = the noisy depth within 1.5 sigma of what the sensor "
    "would measure of that surface. Log-likelihood: mean per measured pixel, nats, density per metre.",
)


def score_table(
    name: str,
    title: str,
    scored: Sequence[Scored],
    paper: Mapping[tuple[str, float], Spread],
    notes: Sequence[str] = (),
) -> Table:
    """One row for each contender's reading and voxel size: mean and spread over views (and noise seeds).

    ``paper`` gives, by (row, voxel size), what the paper reports under its own tolerance.
    """
    rows: list[list[Entry]] = []
    sizes = sorted({each.voxel_size for each in scored}, reverse=True)
    names = list(dict.fromkeys(each.row for each in scored))
    for size in sizes:
        for row in names:
            here = [each for each in scored if each.row == row and each.voxel_size == size]
            if not here:
                continue
            figures: list[Entry] = [Spread.of([each.figures[key] for each in here]) for key in COLUMNS]
            reported = paper.get((row, size))
            seconds = Spread.of([each.build_seconds for each in here])
            rows.append([f"{size * 100:g} cm", row, *figures, reported, Spread(seconds.mean), len(here)])
    return Table(
        name,
        title,
        ["voxels", "map", *COLUMNS.values(), "paper", "map (s)", "views"],
        rows,
        [*HOW_TO_READ, *notes],
    )
