"""Cost of a lab: sums of bill-of-materials.csv, for the tables of README.md.

    python3 hardware/lab/costs.py             # prints the tables
    python3 hardware/lab/costs.py --write     # writes them into README.md
    python3 hardware/lab/costs.py --students 12 --offerings 1

US dollars, before tax and freight. A row without a price needs a quote: it is listed, but not included in sums. Over
ten years, an item is replaced after its lifetime (`years`), as in the paper.
"""

import argparse
import csv
import math
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
BUDGETS = {"mocap": "motion capture", "uwb": "UWB", "webcams": "two webcams"}
GROUPS = ("localization", "room", "computers", "vehicles", "safety")
# Name, and the total in the paper.
VEHICLES = {
    "paper160": ("160 mm, as the paper's", 475),
    "basic160": ("160 mm, basic controllers", 300),
    "size220": ("220 mm", None),
}

# From the paper's section "Logistics and Cost of Operation".
YEARS, STUDENTS, OFFERINGS, TEAM = 10, 30, 2, 3
VEHICLE, VEHICLES_A_YEAR, UPKEEP_A_TEAM = 475.0, 2, 62.5


class Row(NamedTuple):
    item: str
    group: str
    counts: dict         # number of pieces, by budget and by type of vehicle
    price: float | None  # unit price
    currency: str
    years: int           # lifetime
    seen: str
    source: str
    instead: str


def read(path: Path = HERE / "bill-of-materials.csv") -> list[Row]:
    with path.open(newline="") as f:
        return [Row(
            r["item"], r["group"], {column: int(r[column]) for column in (*BUDGETS, *VEHICLES)},
            float(r["price"]) if r["price"] else None, r["currency"], int(r["years"]), r["seen"],
            r["source"], r["instead"],
        ) for r in csv.DictReader(f)]


def total(rows, column, group=None) -> float:
    """Initial cost of all priced items."""
    return sum(r.counts[column] * r.price for r in rows if r.price is not None and group in (None, r.group))


def unpriced(rows, column) -> list[str]:
    return [r.item for r in rows if r.price is None and r.counts[column]]


def ten_years(rows, budget, students) -> float:
    again = sum(r.counts[budget] * r.price * math.ceil(YEARS / r.years) for r in rows if r.price is not None)
    return again + YEARS * UPKEEP_A_TEAM * math.ceil(students / TEAM)


def a_student(rows, budget, students=STUDENTS, offerings=OFFERINGS) -> float:
    """Cost per student and offering, computed like the paper: all costs of ten years over all students of ten years."""
    return ten_years(rows, budget, students) / (YEARS * offerings * students)


def paper(mocap: float) -> float:
    """The paper's cost per student and offering, computed from its own numbers."""
    upkeep = UPKEEP_A_TEAM * STUDENTS / TEAM
    return (mocap + YEARS * (VEHICLES_A_YEAR * VEHICLE + upkeep)) / (YEARS * OFFERINGS * STUDENTS)


def money(x: float) -> str:
    return f"{x:,.0f}".replace(",", " ")


def table(head, lines) -> str:
    rows = [head, ["---"] * len(head), *lines]
    return "".join("| " + " | ".join(row) + " |\n" for row in rows)


def blocks(rows, students=STUDENTS, offerings=OFFERINGS) -> dict[str, str]:
    names = list(BUDGETS.values())
    sums = [[g, *(money(total(rows, b, g)) if total(rows, b, g) else "quotes" for b in BUDGETS)] for g in GROUPS]
    sums += [["**sum of priced items**", *(f"**{money(total(rows, b))}**" for b in BUDGETS)]]
    sums += [["also needs a quote", *(", ".join(unpriced(rows, b)) for b in BUDGETS)]]
    ours = [f"{a_student(rows, b, students, offerings):.2f}" for b in BUDGETS]
    without = [r._replace(price=0.0) if r.group == "localization" else r for r in rows]
    there = [f"{a_student(without, b, students, offerings):.2f}" for b in BUDGETS]
    small = [f"{a_student(rows, b, 12, 1):.2f}" for b in BUDGETS]
    each = [
        ["the paper, from its own numbers", f"{paper(50_000):.2f}", "", ""],
        ["the paper, localization already there", f"{paper(0):.2f}", "", ""],
        [f"this bill, {students} students, {offerings} offerings a year", *ours],
        ["the same, localization already there", *there],
        ["this bill, 12 students, 1 offering a year", *small],
    ]
    kinds = []
    for column, (name, stated) in VEHICLES.items():
        found = total(rows, column)
        kinds.append([name, f"{found:.2f}", ", ".join(unpriced(rows, column)), "" if stated is None else str(stated),
                      "" if stated is None else f"{stated - found:.2f}"])
    return {
        "budgets": table(["USD, initial cost", *names], sums),
        "students": table(["USD per student and offering", *names], each),
        "vehicles": table(["vehicle", "parts with a price", "parts without", "paper's total", "left for these"], kinds),
    }


def main() -> None:
    args = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    args.add_argument("--write", action="store_true", help="write the tables into README.md, for the paper's class")
    args.add_argument("--students", type=int, default=STUDENTS)
    args.add_argument("--offerings", type=int, default=OFFERINGS, help="course offerings per year")
    given = args.parse_args()
    made = blocks(read(), given.students, given.offerings)
    for name, text in made.items():
        print(f"{name}\n\n{text}")
    if given.write:
        page = HERE / "README.md"
        text = page.read_text()
        for name, block in blocks(read()).items():
            before, rest = text.split(f"<!-- bill: {name} -->\n")
            text = f"{before}<!-- bill: {name} -->\n{block}<!-- end -->{rest.split('<!-- end -->', 1)[1]}"
        page.write_text(text)


if __name__ == "__main__":
    main()
