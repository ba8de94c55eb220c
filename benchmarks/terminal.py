"""Signals as a command at a terminal takes them."""

import signal


def take_signals() -> None:
    """Take SIGINT and SIGHUP, which a background job ignores (a shell, `nohup`); the commands that it starts would ignore them too."""
    for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, handler)
