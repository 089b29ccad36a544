"""Archive of the runs behind the README's tables: each as a scenario file, with its kept result.

`make archive` writes build/payload-transport-<version>-runs.zip. A file is named by the fingerprint
of its run, which the tables of results have as well: `transport run FILE` repeats the run.
"""

import sys
import zipfile
from importlib import metadata
from pathlib import Path

import kept
import tomli_w
from derived_tables import DERIVED, README
from figures import TABLES
from kept import run_id
from measured import Measured
from tables import ROOT

# Files of an archive have one time: equal runs give equal archives.
_TIME = (2026, 1, 1, 0, 0, 0)
_EXPLANATION = """\
Runs of the tables of README.md, payload-transport {version}.

scenarios/ID.toml   a run: all keys of its scenario, with its seed; transport run ID.toml repeats it
results/TABLE.csv   kept results of a table: column "run" is the ID; commit, versions, machine
"""


def tables_of_readme() -> list[str]:
    """Return the names of the tables from which those of the README are made."""
    names = [name for one in DERIVED if one.document == README for name in one.sources]
    return [name for name in dict.fromkeys(names) if kept.file_of(name).exists()]


def scenarios_of(one: Measured) -> dict[str, str]:
    """Return the runs of a table as scenario files by fingerprint."""
    return {run_id(case.scenario): tomli_w.dumps(case.scenario.tree()) for case in one.cases}


def write(file: Path, names: list[str]) -> None:
    """Write the archive of some tables."""
    version = metadata.version("payload-transport")
    contents = {"README.txt": _EXPLANATION.format(version=version)}
    for name in names:
        contents[f"results/{name}.csv"] = kept.file_of(name).read_text(encoding="utf-8")
        for run, text in scenarios_of(TABLES[name]()).items():
            contents[f"scenarios/{run}.toml"] = text

    file.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in sorted(contents.items()):
            archive.writestr(zipfile.ZipInfo(name, _TIME), text, zipfile.ZIP_DEFLATED)


if __name__ == "__main__":
    archive = ROOT / "build" / f"payload-transport-{metadata.version('payload-transport')}-runs.zip"
    write(archive, tables_of_readme())
    sys.stderr.write(f"{archive}\n")
