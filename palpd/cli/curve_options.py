"""Options for the columns of another machine's curve, for `palpd analyse` and `palpd import`."""

from typing import TYPE_CHECKING, Annotated, Literal

import typer

from palpd.errors import BadInput

if TYPE_CHECKING:
    from palpd.analysis.curves import Curve

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


def unit_of(column: str, quantity: Literal["force", "length"], given: str | None, stated: str = "") -> tuple[str, list[str]]:
    """The unit of a column: as it is given, else as its name says, else the SI unit.

    Args:
        column: Its name, such as "Force (mN)".
        given: The unit that the user gave; None: none.
        stated: What the file states beside the name.

    Returns:
        The unit, and a note where the name says another one.

    Raises:
        BadInput: Nothing is given, and the name says a unit that `palpd analyse` does not read.
    """
    from palpd.analysis.curves import FORCE_UNITS, LENGTH_UNITS
    from palpd.interchange.units import OPTIONS, unit_named, unknown_unit

    known, named = FORCE_UNITS if quantity == "force" else LENGTH_UNITS, unit_named(column, stated)
    if given is None and (other := unknown_unit(column, stated) if named is None else named) and other not in known:
        raise BadInput(
            f"column {column} is in {other}, expected a {quantity} in {', '.join(known)}; palpd import reads other units, or give "
            f"{OPTIONS[quantity]}"
        )
    if given is None or named in (None, given):
        return given or named or next(iter(known)), []
    return given, [f"column {column} was read in {given}, as given, and its name says {named}"]


def refuse_row_of_units(curve: "Curve", force_unit: str, length_unit: str) -> None:
    """Refuse a curve below whose header stands another unit than the one in which it was read.

    Args:
        length_unit: Of its height or depth.

    Raises:
        BadInput: There is such a row.
    """
    from palpd.interchange.units import unit_named

    for column, below, unit, option in zip(curve.columns, curve.below, (force_unit, length_unit), ("force", "length"), strict=True):
        if unit_named("", below) not in (None, unit):
            raise BadInput(
                f"{curve.name}: {below} stands below {column}, and it was read in {unit}; give --{option}-unit, or correct that row"
            )
