"""Palpation of soft tissue with a force one can believe. The names below are the Python API; palpd.api says what each does."""

TYPE_CHECKING = False  # `typing` takes longer to import than all that `palpd abort` needs
if TYPE_CHECKING:
    from typing import Any

    from palpd.api import (
        Analysis,
        Cell,
        Effect,
        GapDiagnosis,
        LoadedRecording,
        analyse,
        cell_from,
        diagnose,
        export_sim,
        import_file,
        load,
        simulate,
        tip_motion,
        tolerances,
    )

    __version__: str

__all__ = [
    "Analysis", "Cell", "Effect", "GapDiagnosis", "LoadedRecording", "__version__", "analyse", "cell_from", "diagnose", "export_sim",
    "import_file", "load", "simulate", "tip_motion", "tolerances",
]  # fmt: skip


def __getattr__(name: str) -> "Any":
    """Import the API when one of its names is asked for: the daemon and the command line need none of it."""
    if name == "__version__":
        from importlib.metadata import version

        return version("palpd")
    if name in __all__:
        from palpd import api

        return getattr(api, name)
    raise AttributeError(f"module 'palpd' has no attribute {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return [*globals(), *__all__]
