"""The log of the page: one JSON object a line on stderr, in the form of the service's log, for the journal of systemd."""

import json
import sys
from datetime import UTC, datetime


def log(event: str, **what: object) -> None:
    """Write a line. structlog, which the service uses, would take 20 MB.

    Args:
        event: What happened.
        what: Who asked, and how it ended.
    """
    date = datetime.now(UTC).isoformat().replace("+00:00", "Z")
    print(json.dumps({**what, "event": event, "level": "info", "timestamp": date}), file=sys.stderr, flush=True)
