"""Logs one JSON object a line on stderr, for the journal of systemd."""

import logging
import sys

import structlog


def configure() -> None:
    """Set structlog up for a service; nothing in the real-time loop logs."""
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.dict_tracebacks,
            structlog.processors.JSONRenderer(),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.INFO),
        logger_factory=structlog.WriteLoggerFactory(file=sys.stderr),
    )
