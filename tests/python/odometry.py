"""Prints the error table of the visual odometries from grades.

    vizflyt grade PLUGIN --project square --seeds 5 --variants day,dusk,fog -o square.json
    python3 tests/python/odometry.py square.json ...

One Markdown row for each grade and variant: the absolute trajectory error of the flights (root mean square), median and
maximum over the seeds, the largest error of all, and the number of flights that passed all gates.
"""

import json
import pathlib
import statistics
import sys


def rows(grade: pathlib.Path) -> list[str]:
    """Returns the rows of one grade, one for each variant."""
    runs = json.loads(grade.read_text())["runs"]
    lines = []
    for variant in dict.fromkeys(run["variant"] for run in runs):
        flown = [run for run in runs if run["variant"] == variant]
        found = [run["odometry"] for run in flown if run.get("odometry")]
        through = sum(run["outcome"] == "finished" for run in flown)
        rmse = [one["ate_rmse_m"] for one in found]
        figures = "- | - | -"
        if found:
            most = max(one["ate_max_m"] for one in found)
            figures = f"{statistics.median(rmse):.3f} | {max(rmse):.3f} | {most:.3f}"
        lines.append(f"| {grade.stem} | {variant} | {figures} | {through} of {len(flown)} |")
    return lines


def main() -> None:
    print("| grade | variant | median [m] | worst [m] | largest [m] | finished |")
    print("|---|---|---|---|---|---|")
    for name in sys.argv[1:]:
        print("\n".join(rows(pathlib.Path(name))))


if __name__ == "__main__":
    main()
