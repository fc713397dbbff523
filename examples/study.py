"""A study for a paper: how long until the areas agree, against the share of messages lost. Table and figure.

    python examples/study.py [FOLDER] [SEEDS]

FOLDER gets rows.csv with one row per run, table.tex and figure.pdf. More seeds, narrower quantiles.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import consensus_dsse as dsse

SCENARIO = "ieee33"
LOSSES = [0.0, 0.2, 0.4, 0.6]
STRATEGIES = ["information", "admm"]


def run_all(seeds: int) -> dsse.Table:
    """Table of all runs: each loss, strategy and seed; in virtual time, which does not depend on the machine."""
    return dsse.sweep(SCENARIO, {"faults.loss": LOSSES}, strategies=STRATEGIES, seeds=seeds, jobs=2)


def find_times(rows: dsse.Table, strategy: str, loss: float) -> np.ndarray:
    """Seconds until the gap to the centralised estimate stays below 1e-6; infinite where it never does."""
    chosen = (np.array(rows.strategy) == strategy) & (rows["faults.loss"] == loss)
    return np.nan_to_num(rows.below_1e6_s[chosen], nan=np.inf)


def write_table(rows: dsse.Table, path: Path) -> None:
    """Medians in milliseconds, for LaTeX."""
    lines = [r"\begin{tabular}{l" + "r" * len(LOSSES) + "}", r"\hline"]
    lines.append("lost & " + " & ".join(rf"{loss:.0%}".replace("%", r"\,\%") for loss in LOSSES) + r" \\ \hline")
    for strategy in STRATEGIES:
        medians = [1000 * float(np.median(find_times(rows, strategy, loss))) for loss in LOSSES]
        lines.append(f"{strategy} & " + " & ".join(f"{median:.0f}" for median in medians) + r" \\")
    path.write_text("\n".join([*lines, r"\hline", r"\end{tabular}"]) + "\n")


def draw(rows: dsse.Table, path: Path) -> None:
    """Median and range from 10 to 90 % of the seeds, at the width of a column."""
    figure, axes = plt.subplots(figsize=(3.5, 2.5), layout="constrained")
    for strategy in STRATEGIES:
        shares = [0.1, 0.5, 0.9]
        times = np.array([np.quantile(find_times(rows, strategy, x), shares, method="nearest") for x in LOSSES])
        axes.plot(LOSSES, times[:, 1], marker="o", label=strategy)
        axes.fill_between(LOSSES, times[:, 0], times[:, 2], alpha=0.2)
    axes.set(xlabel="share of messages lost", ylabel="time to 1e-6 p.u. in s", yscale="log")
    axes.legend()
    figure.savefig(path)


def main(folder: Path, seeds: int) -> None:
    rows = run_all(seeds)
    folder.mkdir(parents=True, exist_ok=True)
    rows.to_csv(folder / "rows.csv")
    write_table(rows, folder / "table.tex")
    draw(rows, folder / "figure.pdf")
    lost = [k for k, outcome in enumerate(rows.outcome) if outcome != "consensus"]
    print(f"{len(rows)} runs, {len(lost)} without consensus; largest gap {np.nanmax(rows.gap_vm_pu):.1e} p.u.")
    print((folder / "table.tex").read_text())


if __name__ == "__main__":  # `sweep` starts processes
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "study"), int(sys.argv[2]) if len(sys.argv) > 2 else 10)
