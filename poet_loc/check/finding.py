"""What a check has to say: one finding per problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from poet_loc.io.log_folder import Log

Evidence = dict[str, float | int | str]

Severity = Literal["error", "warning"]
"""error: results would be wrong or there would be none; warning: results would be worse than they could be."""


@dataclass(frozen=True)
class Finding:
    """One thing that looks wrong."""

    check: str
    """Name of the problem, the same in docs/doctor.md."""
    severity: Severity
    file: str
    """Which file of the log it is about."""
    what: str
    """One sentence."""
    fix: str
    """What to do about it."""
    evidence: Mapping[str, float | int | str] = field(default_factory=dict)
    """The numbers behind it, by a name that ends in its unit."""
    repair: Callable[[Log], Log] | None = None
    """Returns the log without the problem, where that is safe."""
    repaired_in_reading: bool = False
    """The reader already left the problem out of the log that the later checks see."""

    @property
    def repairable(self) -> bool:
        """Whether --fix takes care of it."""
        return self.repair is not None or self.repaired_in_reading

    def as_json(self) -> dict[str, Any]:
        """Return what --json prints."""
        return {
            "check": self.check,
            "severity": self.severity,
            "file": self.file,
            "what": self.what,
            "evidence": dict(self.evidence),
            "fix": self.fix,
            "repairable": self.repairable,
        }
