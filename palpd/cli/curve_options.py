"""Options for the columns of another machine's curve, for `palpd analyse` and `palpd import`."""

from typing import Annotated, Literal

import typer

from palpd.errors import BadInput

ForceColumn = Annotated[str | None, typer.Option("--force-column", help="name of the column of the force")]
ForceUnitOption = Annotated[
    Literal["N", "mN", "uN", "nN"] | None, typer.Option("--force-unit", help="unit of that column (default: as its name says, else N)")
]
DepthColumn = Annotated[str | None, typer.Option("--depth-column", help="name of a column that grows as the tip goes in")]
HeightColumn = Annotated[str | None, typer.Option("--height-column", help="name of a column that falls as the tip goes down")]
HeightDownPositive = Annotated[bool, typer.Option("--height-down-positive", help="the height column grows downwards")]
LengthUnitOption = Annotated[
    Literal["m", "mm", "um", "nm"] | None, typer.Option("--length-unit", help="unit of depth or height (default: as its name says, else m)")
]
CompressionNegative = Annotated[bool, typer.Option("--compression-negative", help="pressed is a negative force")]
TimeColumn = Annotated[str | None, typer.Option("--time-column", help="name of the column of the time")]
BaselineOption = Annotated[
    Literal["auto", "free", "zero"], typer.Option("--baseline", help="force before contact; auto: zero for a corrected column")
]


def unit_of(column: str, quantity: Literal["force", "length"], given: str | None) -> tuple[str, list[str]]:
    """The unit of a column: as it is given, else as its name says, else the SI unit.

    Args:
        column: Its name, such as "Force (mN)".
        given: The unit that the user gave; None: none.

    Returns:
        The unit, and a note where the name says another one.

    Raises:
        BadInput: The name says a unit that `palpd analyse` does not read.
    """
    from palpd.analysis.curves import FORCE_UNITS, LENGTH_UNITS
    from palpd.interchange.units import FACTORS, OPTIONS, unit_named

    known, named = FORCE_UNITS if quantity == "force" else LENGTH_UNITS, unit_named(column)
    if named is None or named not in FACTORS[quantity]:
        return given or next(iter(known)), []
    if given is None and named not in known:
        raise BadInput(f"column {column} is in {named}, expected {', '.join(known)}; palpd import reads it, or give {OPTIONS[quantity]}")
    if given is None or given == named:
        return named, []
    return given, [f"column {column} was read in {given}, as given, and its name says {named}"]
