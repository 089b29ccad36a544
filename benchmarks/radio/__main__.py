"""The command: `make radio`, or `python -m benchmarks.radio --help`."""

import argparse
import sys
import time

from benchmarks.radio import build, model, reference, results
from benchmarks.radio.cases import Case, cases, team
from benchmarks.radio.results import Numbers, Quantile, differences, numbers
from benchmarks.runs import origin
from docs.tables import ROOT, put, table
from transport.protocol.radio.standards_80211 import STANDARDS

DOCUMENT = ROOT / "docs" / "record" / "radio.md"
HEADINGS = ("case", "delivered, %", "", "p50, ms", "", "p99, ms", "", "within")
DEFERRAL_HEADINGS = ("case", "delivered with a backoff, %", "with the rule of ns-3, %")


def main() -> None:
    """Run all cases in both, print the table and renew it in the document."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.radio", description=__doc__)
    parser.add_argument("--only", default="", help="cases whose name has this text; writes nothing")
    only = parser.parse_args().only
    try:
        version = build.version()
        build.program()
    except build.BuildError as error:
        raise SystemExit(str(error)) from error

    chosen = [case for case in cases() if only in case.name]
    rows = []
    reference_numbers: dict[str, Numbers] = {}
    apart = []
    clock = [0.0, 0.0]
    for case in chosen:
        theirs, ours = compared(case, clock)
        reference_numbers[case.name] = theirs
        away = differences(ours, theirs)
        apart += [f"{case.name}: {words}" for words in away]
        rows.append(row(case, ours, theirs, within=not away))
        sys.stdout.write(" | ".join(rows[-1]) + "\n")

    sys.stdout.write("\n".join(["", *apart, ""]) if apart else "all cases within the bars\n")
    if only:
        return
    results.write(version, reference_numbers)
    text = (
        f"Each pair: protocol/radio, ns-3 {version}. {len(chosen)} cases, {len(apart)} differences "
        f"beyond the bars; {clock[1]:.0f} s in protocol/radio, {clock[0]:.0f} s in ns-3. "
        f"{origin()}."
    )
    put(DOCUMENT, "deferral", table(DEFERRAL_HEADINGS, deferral()))
    put(DOCUMENT, "validation", f"{text}\n\n{table(HEADINGS, rows)}")


def deferral() -> list[tuple[str, ...]]:
    """Return the delivered shares with both rules for a frame that meets an idle medium."""
    rows = []
    for stations in (2, 4, 8):
        case = team(stations, 6.0, 0.1)
        shares = [numbers(case, model.run(case, draws=draws)).share for draws in (True, False)]
        rows.append((case.name, *[f"{100 * share:.1f}" for share in shares]))
    return rows


def compared(case: Case, clock: list[float]) -> tuple[Numbers, Numbers]:
    """Return the numbers of a case in ns-3 and in the model, and add their times."""
    standard = STANDARDS[case.standard]
    begin = time.perf_counter()
    control_mbps = standard.acknowledgement_rate_mbps(case.rate_mbps)
    theirs = reference.run(build.program(), case, control_mbps)
    between = time.perf_counter()
    ours = model.run(case)
    clock[0] += between - begin
    clock[1] += time.perf_counter() - between
    return numbers(case, theirs), numbers(case, ours)


def row(case: Case, ours: Numbers, theirs: Numbers, *, within: bool) -> tuple[str, ...]:
    """Return a row of the table."""
    return (
        case.name,
        f"{100 * ours.share:.1f}",
        f"{100 * theirs.share:.1f}",
        *[shown(quantile) for quantile in (ours.p50, theirs.p50, ours.p99, theirs.p99)],
        "yes" if within else "no",
    )


def shown(quantile: Quantile | None) -> str:
    """Return a quantile in ms, or a dash."""
    return "-" if quantile is None else f"{quantile.ms:.2f}"


if __name__ == "__main__":
    main()
