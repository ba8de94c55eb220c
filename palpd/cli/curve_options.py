"""Options for the columns of another machine's curve, for `palpd analyse` and `palpd import`."""

from typing import Annotated, Literal

import typer

ForceColumn = Annotated[str | None, typer.Option("--force-column", help="name of the column of the force")]
ForceUnitOption = Annotated[Literal["N", "mN", "uN", "nN"], typer.Option("--force-unit", help="unit of that column")]
DepthColumn = Annotated[str | None, typer.Option("--depth-column", help="name of a column that grows as the tip goes in")]
HeightColumn = Annotated[str | None, typer.Option("--height-column", help="name of a column that falls as the tip goes down")]
HeightDownPositive = Annotated[bool, typer.Option("--height-down-positive", help="the height column grows downwards")]
LengthUnitOption = Annotated[Literal["m", "mm", "um", "nm"], typer.Option("--length-unit", help="unit of depth or height")]
CompressionNegative = Annotated[bool, typer.Option("--compression-negative", help="pressed is a negative force")]
TimeColumn = Annotated[str | None, typer.Option("--time-column", help="name of the column of the time")]
BaselineOption = Annotated[
    Literal["auto", "free", "zero"], typer.Option("--baseline", help="force before contact; auto: zero for a corrected column")
]
