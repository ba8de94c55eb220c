"""What commands write: an option that names an output says so beside its type, and all are checked here before a command begins."""

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial, wraps
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple, TypeVar, get_args, get_type_hints

import typer
from typer.models import ArgumentInfo, ParameterInfo

from palpd.errors import BadInput
from palpd.file_kinds import RECORDING
from palpd.files import check_folder, check_link, check_resumed, check_socket, check_writable, file_use, refuse_twice, with_ending

FOLDER, OWN_FOLDER, NEW_RECORDING, SOCKET, LINK, RESUMED = "folder", "own folder", "new recording", "socket", "link", "resumed file"
"""What an option names besides a plain file: a folder to write into, one for this call alone, a recording whose folder is made, a Unix
socket, a link, a file that is read first."""
SMALLEST, LARGEST = 1e-18, 1e15
"""Least and largest number of an option but for 0: an optical trap holds 1e-12 N, and the stiffest machine has some 1e9 N/m."""
ForceOption = Annotated[bool, typer.Option("--force", help="replace outputs that palpd did not make; an input never")]
Command = TypeVar("Command", bound=Callable[..., Any])


class Output(NamedTuple):
    """Marks an option as the name of an output.

    Attributes:
        kind: What it will be, one of palpd.file_kinds or of the words above.
        beside: Endings of further files that may be written, in place of the ending of this one.
    """

    kind: str
    beside: tuple[str, ...] = ()

    def check(self, path: Path | None) -> None:
        """Refuse a place that cannot be written, or that holds what may not be replaced; None: nothing is written. Raises BadInput."""
        if path is None:
            return
        if check := _CHECKS.get(self.kind):
            refuse_twice(path)
            check(path)
            return
        check_writable(path, kind=self.kind)
        for ending in self.beside:
            check_writable(path.with_name(f"{path.stem}{ending}"))


def _check_recording(path: Path) -> None:
    target = with_ending(path, ".mcap")
    check_folder(target.parent)
    if target.parent.is_dir():
        with file_use():
            check_writable(target, kind=RECORDING)


_CHECKS: Mapping[str, Callable[[Path], None]] = {
    FOLDER: check_folder,
    OWN_FOLDER: partial(check_folder, empty=True),
    NEW_RECORDING: _check_recording,
    SOCKET: check_socket,
    LINK: check_link,
    RESUMED: check_resumed,
}


_EXAMPLES = "\b\nExamples:"
"""How the end of a command's help begins; the first letter keeps its lines as they are."""


def examples_of(command: Any) -> list[str]:
    """The lines that the help of a registered command gives as examples."""
    return [line.strip() for line in (command.epilog or "").removeprefix(_EXAMPLES).splitlines() if line.strip()]


class Application(typer.Typer):
    """An application whose commands write over nothing that they read, and over nothing that palpd did not make without --force."""

    def command(
        self,
        name: str | None = None,
        *,
        examples: Sequence[str] = (),
        apart: Mapping[str, Sequence[str]] = MappingProxyType({}),
        **settings: Any,
    ) -> Callable[[Command], Command]:
        """Register a command; its function stays as it is.

        Args:
            name: Name of the command; the function's where not given.
            examples: Lines that a person may type, which its help ends with.
            apart: Parameters with which others would be left out without a word, so that both together are refused.
            settings: What typer takes besides.

        Returns:
            The decorator.
        """
        register = super().command(name, epilog=_EXAMPLES + "\n  ".join(("", *examples)), **settings)

        def registered(command: Command) -> Command:
            register(_with_checks(command, apart))
            return command

        return registered


def outputs_of(command: Callable[..., Any]) -> dict[str, Output]:
    """The outputs of a command by the names of their parameters."""
    hints = get_type_hints(command, include_extras=True)
    return {name: part for name, hint in hints.items() for part in get_args(hint)[1:] if isinstance(part, Output)}


def inputs_of(command: Callable[..., Any]) -> list[str]:
    """Names of the parameters that are paths and no outputs."""
    outputs = outputs_of(command)
    return [name for name, hint in get_type_hints(command).items() if _holds_path(hint) and name not in outputs]


def _holds_path(hint: Any) -> bool:
    return hint is Path or any(map(_holds_path, get_args(hint)))


def _with_checks(command: Callable[..., Any], apart: Mapping[str, Sequence[str]]) -> Callable[..., Any]:
    """The same command, which checks its options and its outputs first, with --force where it has any."""
    outputs, inputs = outputs_of(command), inputs_of(command)
    signature = inspect.signature(command)
    takes_force = bool(outputs) and "force" not in signature.parameters

    @wraps(command)
    def checked(**values: Any) -> Any:
        force = values.pop("force") if takes_force else None
        for name, value in values.items():
            _refuse_number(name, value)
        with file_use(_paths(values[name] for name in inputs), force=force):
            for name, output in outputs.items():
                output.check(values[name])
            _refuse_together(command, apart, values)
            return command(**values)

    if takes_force:
        force = inspect.Parameter("force", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=ForceOption)
        checked.__signature__ = signature.replace(parameters=[*signature.parameters.values(), force])  # type: ignore[attr-defined]
        checked.__annotations__ = {**command.__annotations__, "force": ForceOption}
    return checked


def _refuse_together(command: Callable[..., Any], apart: Mapping[str, Sequence[str]], values: Mapping[str, Any]) -> None:
    """Refuse two options where one would not count. Raises BadInput."""
    for name in apart:
        if _given(command, values, name):
            refuse_left_out(command, values, apart[name], f"{_spelled(command, name, values)} is given")


def refuse_left_out(
    command: Callable[..., Any],
    values: Mapping[str, Any],
    names: Iterable[str],
    why: str,
    advice: str = "leave out the one or the other",
) -> None:
    """Refuse options that would not count.

    Args:
        values: Values of its parameters.
        names: Parameters that would not count.
        why: Why they would not.
        advice: What to do.

    Raises:
        BadInput: One of them is given.
    """
    given = [_spelled(command, name, values) for name in names if _given(command, values, name)]
    if given:
        raise BadInput(f"{why}, so {' and '.join(given)} would not count; {advice}")


def _given(command: Callable[..., Any], values: Mapping[str, Any], name: str) -> bool:
    return values[name] not in (inspect.signature(command).parameters[name].default, [], ())


def _spelled(command: Callable[..., Any], name: str, values: Mapping[str, Any]) -> str:
    """A parameter as a person types it: the name of an option, or of an argument; of a flag, the side that was given."""
    info = next(part for part in get_args(get_type_hints(command, include_extras=True)[name]) if isinstance(part, ParameterInfo))
    if isinstance(info, ArgumentInfo):
        return str(info.metavar or name.upper()).strip("[].")
    on, _, off = str(info.default if isinstance(info.default, str) else (info.param_decls or ("",))[0]).partition("/")
    return off if values[name] is False and off else on


def _refuse_number(name: str, value: object) -> None:
    """Refuse an option that is nan, infinite or beyond every unit: comparisons with a limit let the first pass. Raises BadInput."""
    for number in value if isinstance(value, list | tuple) else (value,):
        if isinstance(number, float) and not (number == 0.0 or SMALLEST <= abs(number) <= LARGEST):
            raise BadInput(f"--{name.replace('_', '-')} is {number:g}, expected 0 or a number of {SMALLEST:g} to {LARGEST:g}; correct it")


def _paths(values: Iterator[Any]) -> Iterator[Path]:
    for value in values:
        yield from value if isinstance(value, list) else [value] if isinstance(value, Path) else []
