"""What `palpd setup` keeps of a cell: each step with its date, verdict, findings and figures."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from palpd.daemon.finding import Finding

StepVerdict = Literal["ok", "warn", "fail", "skipped"]


@dataclass(frozen=True, slots=True)
class StepResult:
    """How a step ended; `date` is ISO 8601."""

    date: str
    verdict: StepVerdict
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True, slots=True)
class Commission:
    """The steps that were done or skipped, by name; kept as `commission.json` in the state folder."""

    steps: Mapping[str, StepResult] = field(default_factory=dict)

    def passed(self, name: str) -> bool:
        """Whether a step was done and has not failed."""
        return name in self.steps and self.steps[name].verdict in ("ok", "warn")

    def finding(self, name: str, figure: str) -> Finding | None:
        """The last finding of a step that holds a figure; None where it did not come so far."""
        findings = self.steps[name].findings if name in self.steps else ()
        return next((finding for finding in reversed(findings) if figure in finding.figures), None)

    def figure(self, name: str, key: str) -> float | None:
        """A number that a step measured; None where it did not come so far."""
        finding = self.finding(name, key)
        value = finding.figures[key] if finding is not None else None
        return float(value) if isinstance(value, int | float) else None


def seen(
    name: str, measured: str, expected: str, advice: str = "", *, fails: bool = False, warns: bool = False, **figures: object
) -> Finding:
    """A finding of a step; the advice counts where it fails or warns."""
    return Finding(name, "fail" if fails else "warn" if warns else "ok", measured, advice if fails or warns else "", figures, expected)
