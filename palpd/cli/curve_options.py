"""Options that name the columns of another machine's curve, for `palpd analyse` and `palpd import`."""

from typing import Annotated, Literal

import typer

ForceColumn = Annotated[str | None, typer.Option("--force-column")]
ForceUnitOption = Annotated[Literal["N", "mN", "uN", "nN"], typer.Option("--force-unit")]
DepthColumn = Annotated[str | None, typer.Option("--depth-column", help="grows as the tip goes in")]
HeightColumn = Annotated[str | None, typer.Option("--height-column", help="falls as the tip goes down")]
HeightDownPositive = Annotated[bool, typer.Option("--height-down-positive", help="the height column grows downwards")]
LengthUnitOption = Annotated[Literal["m", "mm", "um", "nm"], typer.Option("--length-unit")]
CompressionNegative = Annotated[bool, typer.Option("--compression-negative", help="pressed is a negative force")]
TimeColumn = Annotated[str | None, typer.Option("--time-column")]
