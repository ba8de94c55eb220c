"""Numbers for people: three digits, the unit that suits the size, and a 95 % interval behind the value."""

from math import floor, isfinite, log10, pi

PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"), (1e-12, "p"))
OF_JOINT = {"N": "N m", "m": "rad", "kg": "kg m²", "N/m": "N m/rad", "N s/m": "N m s/rad", "N/s": "N m/s"}
"""Units of a joint in place of those of an axis: its heights are angles, its forces torques."""
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
WIDE = 0.4
"""Length of an interval, as a share of the value, from which on two digits of the value are enough."""


def number(value: float, digits: int = 3) -> str:
    """A number as people read it, with a power of ten where there would be many zeros.

    Args:
        value: In any unit; NaN becomes a dash.
    """
    if not isfinite(value):
        return "-∞" if value < 0.0 else "∞" if value > 0.0 else "–"
    if value != 0.0 and not 1e-3 <= abs(value) < 1e5:
        mantissa, power = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10{str(int(power)).translate(SUPERSCRIPTS)}"
    return f"{value:.{digits}g}" if abs(value) < 10**digits - 0.5 else f"{value:.0f}"


def kilopascals(modulus_Pa: float | None, beside_Pa: float | None = None) -> str:
    """A modulus in kPa with three digits, one of them a decimal at least.

    Args:
        modulus_Pa: None: a dash.
        beside_Pa: The modulus whose decimals it takes, as a half-width does; None: its own.
    """
    if modulus_Pa is None:
        return "–"
    size_kPa = abs(modulus_Pa if beside_Pa is None else beside_Pa) / 1e3
    return f"{modulus_Pa / 1e3:.{1 if size_kPa >= 10.0 else 2 if size_kPa >= 1.0 else 3}f}"


def scaled(size: float, unit: str) -> tuple[float, str]:
    """The unit in which a size reads well.

    Args:
        size: In the SI unit, at least 0.
        unit: The SI unit; "1" for none.

    Returns:
        One of that unit in the SI unit, and its name.
    """
    if unit == "rad":
        return pi / 180.0, "°"
    if unit == "1":
        return (1e-6, "ppm") if 0.0 < size < 1e-3 else (1.0, "")
    if unit == "Pa":
        return (1e6, "MPa") if size >= 1e6 else (1e3, "kPa") if size >= 1e3 else (1.0, "Pa")
    if unit == "N/m" and size >= 1e3:
        return 1e3, "N/mm"
    if unit == "kg" and size < 0.1:
        scale, name = scaled(1e3 * size, "g")
        return 1e-3 * scale, name
    if unit[0] not in "Nmsg" or unit[1:2] == "²":
        return 1.0, unit
    return next(((scale, prefix + unit) for scale, prefix in PREFIXES if size >= 0.1 * scale), (1.0, unit))


def quantity(value: float, unit: str, ci95: tuple[float, float] | None = None) -> str:
    """A value with the unit that suits it: 62.5 kPa, and with its interval 62.5 (61.8 to 63.2) kPa.

    Args:
        value: In the SI unit.
        unit: The SI unit; "1" for none.
        ci95: Its interval, in the SI unit; None where it has none.
    """
    finite = [abs(each) for each in (value, *(ci95 or ())) if isfinite(each)]
    scale, name = scaled(abs(value) or max(finite, default=0.0), unit)
    text = number(value / scale) if ci95 is None else _with_interval(value / scale, ci95[0] / scale, ci95[1] / scale)
    return f"{text}{'' if name == '°' else ' '}{name}".rstrip()


def _with_interval(value: float, low: float, high: float) -> str:
    """Three digits, more where the interval needs them, two where it is wide."""
    largest = max(map(abs, (value, low, high)))
    if high <= low:
        return number(value)
    if not 1e-3 <= largest < 1e5:
        return f"{number(value)} ({number(low)} to {number(high)})"
    size = abs(value) or largest
    decimals = min(max(0, (1 if high - low > WIDE * size else 2) - floor(log10(size))), 6)
    while f"{low:.{decimals}f}" == f"{high:.{decimals}f}" and decimals < 6:
        decimals += 1
    return f"{value:.{decimals}f} ({low:.{decimals}f} to {high:.{decimals}f})"


def wilson(right: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share.

    Args:
        right: Number of successes.
        n: Number of trials.

    Returns:
        Lower and upper bound; 0 and 1 without a trial.
    """
    from scipy.stats import binomtest  # imported here: whoever prints a number needs none of it

    if n == 0:
        return 0.0, 1.0
    interval = binomtest(right, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)
