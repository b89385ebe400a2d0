"""poet-loc check: the doctor."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from poet_loc.check.doctor import Diagnosis, diagnose, write_repaired
from poet_loc.check.finding import Finding
from poet_loc.cli.arguments import LogFolder, refuse_overwrite_without


@dataclass(frozen=True)
class Arguments:
    """Say what looks wrong in a log, with the evidence and the fix; exit status 1 where something does."""

    log: LogFolder
    json: bool = False
    """Print the findings as JSON."""
    fix: Path | None = None
    """Write a copy of the log to this folder, corrected where that is safe."""
    overwrite: bool = False
    """Replace a --fix folder that holds something."""


def execute(arguments: Arguments) -> int:
    """Check, print, repair; return the exit status."""
    refuse_overwrite_without(arguments.fix, "--fix", arguments.overwrite)
    diagnosis = diagnose(arguments.log)
    if arguments.json:
        print(json.dumps([finding.as_json() for finding in diagnosis.findings], indent=1))
    else:
        _print(diagnosis)
    if arguments.fix is not None:
        write_repaired(diagnosis, arguments.fix, arguments.overwrite)
        repaired = sum(finding.repairable for finding in diagnosis.findings)
        print(f"{arguments.fix}: {repaired} of {len(diagnosis.findings)} findings repaired", file=sys.stderr)
    return 0 if diagnosis.healthy else 1


def _print(diagnosis: Diagnosis) -> None:
    from rich.console import Console
    from rich.text import Text

    console = Console(soft_wrap=True, highlight=False)
    if diagnosis.healthy:
        console.print("nothing found")
        return
    for finding in diagnosis.findings:
        style = "bold red" if finding.severity == "error" else "bold yellow"
        console.print(Text.assemble((finding.severity, style), f" {finding.file}: {finding.what} [{finding.check}]"))
        evidence = ", ".join(_told(finding))
        if evidence:
            console.print(Text(f"    evidence: {evidence}"))
        console.print(Text(f"    fix: {finding.fix}" + ("  (--fix does it)" if finding.repairable else "")))
    console.print(f"{len(diagnosis.findings)} found; what each means: docs/doctor.md")


def _told(finding: Finding) -> Iterator[str]:
    for name, value in finding.evidence.items():
        yield f"{name} {value:.4g}" if isinstance(value, float) and abs(value) < 1e6 else f"{name} {value}"
