"""The hard cases by kind: how many there are, how many are refused, and how far the worst is from the reference."""

from collections.abc import Mapping, Sequence

from minisplat_ref.oracle.cases import Case, Figure, Report
from minisplat_ref.oracle.hard_cases.case import HardCase


def by_group(report: Report, groups: Mapping[str, Sequence[HardCase]]) -> Report:
    """Summarise a report, a row for each group that has cases in it.

    Parameters
    ----------
    report : Report
        From :func:`run_hard_cases`.
    groups : mapping
        The catalogue by kind.

    Returns
    -------
    Report
        Its figures: number of cases, how many were refused, the largest of each error, the sum of the flips.
    """
    rows = []
    for name, members in groups.items():
        names = {member.name for member in members}
        cases = [case for case in report.cases if case.name in names]
        if cases:
            rows.append(Case(name, all(case.passed for case in cases), _figures(cases)))
    return Report(report.title, tuple(rows), report.settings)


def _figures(cases: Sequence[Case]) -> dict[str, Figure]:
    drawn = [case.figures for case in cases if case.figures]
    figures: dict[str, Figure] = {"cases": len(cases), "refused": sum(not case.figures for case in cases)}
    for key in drawn[0] if drawn else ():
        values = [value for row in drawn if isinstance(value := row[key], int | float)]
        figures[key] = sum(values) if isinstance(values[0], int) else max(values)
    return figures
