"""All that a diagnosis assumes: priors, thresholds, caps and floors, each with its unit and its source.

Modules of `palpd.gap` read the one instance ASSUMED (`ASSUMED.prior.none`). The assumptions are a part of the program, and not an
argument: no caller has other ones, and 300 functions would pass them on. Who varies them sets ASSUMED before any other module of
`palpd.gap` is imported, in a process of its own, as `benchmarks/sensitivity.py` does.

Numerical guards, steps of differences, grids, memory, layouts, and limits of what an input may be stand beside their use.
"""

from dataclasses import dataclass, field
from typing import TypeVar

from palpd.cell.effects.drivers import FactorName

T = TypeVar("T")
CHOSEN = "chosen"
"""Source of a number that no measurement set: it was chosen once, and the tests and the blind check hold with it."""

PRIORS = "chosen as 0.3 : 0.6 : 0.12 : 0.02 for none to three"


def assume(value: T, unit: str, what: str, source: str = CHOSEN) -> T:
    """Make a field of a stage.

    Args:
        value: The number, or numbers that are varied together.
        unit: Its unit. `probability` and `cosine` lie between 0 and 1, `count` is a whole number; `nats`, `sd`, `ratio` have no
            dimension.
        what: What it is, in a phrase.
        source: What set its value.
    """
    described: T = field(default=value, metadata={"unit": unit, "what": what, "source": source})
    return described


@dataclass(frozen=True)
class PriorAssumptions:
    """Priors of hypotheses and of the sizes of effects."""

    none: float = assume(0.3 / 1.04, "probability", "no effect acts", PRIORS)
    one: float = assume(0.6 / 1.04, "probability", "one effect acts; all single effects are equally probable", PRIORS)
    two: float = assume(0.12 / 1.04, "probability", "two effects act; all pairs are equally probable", PRIORS)
    three: float = assume(0.02 / 1.04, "probability", "three effects act; all triples are equally probable", PRIORS)
    unknown: float = assume(0.15, "probability", "something outside the list acts")
    further_effect_nats: float = assume(
        3.0, "nats", "least price of a further effect: it must explain data that the smaller set does not explain"
    )
    log_size_range: float = assume(
        7.0, "nats", "width of the prior of an effect's size in sigmas, which is log-uniform: e^7 is a factor of a thousand"
    )
    least_size_sd: float = assume(1.0, "sd", "size of an effect from which on that prior falls; smaller effects count as this")
    contrary_nats: float = assume(
        4.0, "nats", "price of an amplitude with a sign that is possible but not usual, such as a reading that creeps down under load"
    )
    natural_spread: float = assume(0.5, "ratio", "scale of the normal prior of a value beyond its natural size, as a share of that size")
    unknown_modulus_log_sd: float = assume(2.5, "sd", "standard deviation of the logarithm of an unknown modulus: a factor of twelve")


@dataclass(frozen=True)
class LawErrorAssumptions:
    """How far real effects differ from their listed laws (Kennedy and O'Hagan 2001)."""

    p_exact: float = assume(0.3, "probability", "an effect follows its listed formula exactly")
    sizes: tuple[float, ...] = assume(
        (0.02, 0.06, 0.12),
        "ratio",
        "sizes of a discrepancy in each direction, as shares of the effect; the middle one counts while a law outside the list is sought",
    )
    p_sizes: tuple[float, ...] = assume((0.3, 0.25, 0.15), "probability", "probabilities of these sizes; with `p_exact` they add up to 1")
    other_shapes: tuple[float, ...] = assume(
        (0.2, 0.45, 2.2, 5.0), "ratio", "factors on a time constant or width at which the law is mixed in: real effects often have several"
    )
    spread_size: float = assume(
        4.0, "ratio", "size of a mixture of time constants over that of other errors of a law: real ones are spread over decades"
    )
    smallest_effect_sd: float = assume(1.0, "sd", "norm of an effect beyond tolerances below which it is too small to show a discrepancy")
    largest_stretch: float = assume(6.0, "ratio", "largest factor by which a direction is scaled up to the size of the effect")
    reach: float = assume(
        0.5,
        "ratio",
        "share of itself by which a parameter may move with a discrepancy, and share of an effect by which it may while a law is sought",
    )
    mean_energy: float = assume(
        0.04,
        "ratio",
        "mean share of the gap's energy in the error of a known law",
        "with `prior.unknown`, odds of known to unknown are even at a share of 0.2",
    )


@dataclass(frozen=True)
class NoiseAssumptions:
    """Noise of the bins, errors of the computation, and the noise that the best residual shows."""

    least_share_of_stated: float = assume(0.5, "ratio", "least measured noise, as a share of the stated noise")
    fewest_at_rest: int = assume(60, "count", "fewest samples at rest from which noise is measured; with fewer, all are used")
    still_span_sd: float = assume(6.0, "sd", "span of 98 % of the heights below which nothing moves", "noise alone spans five")
    model_error_share: float = assume(
        0.02, "ratio", "least error of a simulator, as a share of the gap: no real cell follows its formulas better"
    )
    model_error_quantile: float = assume(0.95, "probability", "quantile of the gap that this share refers to")
    model_error_elsewhere: float = assume(
        0.3,
        "ratio",
        "least error of a simulator in the air over that within presses, and within presses over that in the air",
        "rests of public recordings",
    )
    own_height_share: float = assume(0.25, "ratio", "share of the noise of reported heights that each bin has for itself")
    most_held: float = assume(0.2, "ratio", "share of held samples above which a bin does not count")
    unreported_share: float = assume(
        0.5, "ratio", "share of the servo's lag by acceleration by which the tip may differ from the reported height"
    )
    hidden_delay_s: float = assume(
        0.004, "s", "standard deviation of the delay inside a controller", "half a cycle of a target held at 125 Hz, the slowest usual rate"
    )
    jerk_limit_s: float = assume(
        0.02, "s", "time over which a controller that limits the jerk averages its command, as a standard deviation"
    )
    largest_delay_share: float = assume(0.25, "ratio", "largest hidden delay as a share of the servo's own lag")
    least_width_share: float = assume(0.1, "ratio", "least second moment of a servo behind a hidden delay, as a share of the stated one")
    relaxing_share: float = assume(
        0.3,
        "ratio",
        "force that still relaxes where a recording starts in contact, over the largest of its presses, as a sd",
    )
    relaxing_s: tuple[float, ...] = assume(
        (0.1, 0.3, 1.0, 3.0, 10.0), "s", "time constants with which it relaxes: sums of these follow any between to a few percent"
    )
    starting_speed_share: float = assume(
        0.1, "ratio", "error of the speed with which a recording starts, over that speed; of its height, what this speed moves in 1/ω"
    )
    acceleration_share: float = assume(
        0.05, "ratio", "share of the lag by acceleration by which the heights of a real controller differ by its order"
    )
    damped_mounts_Hz: tuple[float, ...] = assume(
        (12.0, 20.0, 33.0, 55.0),
        "Hz",
        "natural frequencies of heavily damped mounts behind the motion of the tip",
        "12 of 13 false `structure.resonance` in 146 cells without a command had 12 to 52 Hz, 3 with a command 21 to 37 Hz",
    )
    mount_damping_ratio: float = assume(0.4, "1", "damping ratio of these mounts", "those 12 had 0.19 to 1, planted ones 0.02 to 0.08")
    mount_share: float = assume(
        0.3, "ratio", "share of the acceleration that passes such a mount, as a standard deviation", "those 12 had 0.15 to 0.5"
    )
    held_line_ratio: float = assume(
        30.0,
        "ratio",
        "least power of a line in the force, over its neighbours and over the same line at rest, that a held target may have made",
        "twice the largest of 10^5 frequencies of pure noise",
    )
    second_line_ratio: float = assume(
        10.0,
        "ratio",
        "least power over its neighbours of the same line in the speed, or of the second one in the force",
        "one frequency of pure noise in a thousand",
    )
    command_time_share: float = assume(0.1, "ratio", "error of the times of commanded heights, in time steps of the samples")
    excess_ratio: float = assume(1.15, "ratio", "width of a residual over its noise that still is noise, where noise is larger than stated")
    healthy_lateral_ratio: float = assume(1.5, "ratio", "shown over stated noise beyond which lateral axes say nothing of the noise of fz")
    far_from_stated: float = assume(5.0, "ratio", "measured over stated noise from which on a note says so")
    plausible_sd: float = assume(2.0, "sd", "deviation that a cell within specification may have", "95 % of a normal distribution")
    credible_sd: float = assume(
        4.0,
        "sd",
        "deviation above which a tolerance counts as wrong, and a note says so",
        "one in 16 000 healthy cells has such a deviation",
    )
    white_enough: float = assume(
        1.5, "ratio", "variance times correlation time of a residual below which bins count fully", "estimates of white noise stay below"
    )
    compared: int = assume(10, "count", "likeliest hypotheses that are compared again", "less likely ones have never come first")
    rounds: int = assume(2, "count", "largest number of comparisons with the noise of the best residual")


@dataclass(frozen=True)
class RoundingAssumptions:
    """Readings that are rounded coarsely."""

    dithered_steps: float = assume(
        0.36, "steps", "noise from which on rounding averages out", "the mean reading is then less than 3 % of a step off the force"
    )
    coherent_steps: float = assume(2.5, "steps", "motion of the force over which tolerances leave the phase of a rounding error known")
    own_phase: float = assume(
        0.5, "ratio", "rounding error in the air that every stroke and rest has for itself, over all of it: zeros drift"
    )
    most_harmonics: int = assume(4, "count", "harmonics of the rounding error that have columns at most")
    least_harmonic: float = assume(0.15, "ratio", "size of a harmonic, over that of the first, below which it has no column")
    unphased_share: float = assume(0.4, "ratio", "rounding error that no column holds, over all of it", "five harmonics and more have 0.37")
    even_rms_steps: float = assume(0.6, "steps", "rms of rounded readings from which on their variance is the same wherever they rest")
    largest_jump_steps: float = assume(6.0, "steps", "second difference of rounded readings that counts at most")


@dataclass(frozen=True)
class ResidualAssumptions:
    """The test of a residual for structure that no listed effect explains."""

    shapes: int = assume(5, "count", "smooth shapes in a segment: mean, slope, curvature and two more")
    pulse_bins: tuple[int, ...] = assume((1, 3, 9, 27), "count", "lengths of the pulses that are tested, in bins")
    pulses: float = assume(3.0, "expected number", "pulses of one length in a channel")
    pulse_sd: float = assume(8.0, "sd", "prior standard deviation of a pulse")
    outlier_sd: float = assume(10.0, "sd", "prior standard deviation of an outlier")
    group_sd: tuple[float, ...] = assume((2.0, 8.0, 30.0), "sd", "prior standard deviations of coefficients that are not noise")
    p_structure: float = assume(0.01, "probability", "structure in a channel, phase and shape; also that a deviation is out of tolerance")
    least_spread: float = assume(
        0.5,
        "ratio",
        "spread of a deviation over healthy cells, in tolerances, below which the data do not say whether it is out of tolerance",
    )
    tone_nats: float = assume(5.0, "nats", "price of a tone")


@dataclass(frozen=True)
class ScatterAssumptions:
    """Effects that change the scatter of readings and not their mean."""

    healthy_ratio: float = assume(1.2, "ratio", "measured over stated noise up to which noise is within specification")
    healthy_margin: float = assume(0.06, "ratio", "added to this ratio for even odds of the effect sensor.noise")
    tail_sd: float = assume(
        2.0, "sd", "distance from the median of the neighbours beyond which a reading is clipped, if noise is too large"
    )
    tail_window: int = assume(5, "count", "neighbours of this median")
    uneven: float = assume(0.02, "ratio", "share by which healthy noise varies within a recording")
    p_seen: float = assume(0.99, "probability", "a coarse step or held samples act once they have been seen: chance makes neither")
    lone_ratio: float = assume(1.45, "ratio", "noise of one axis over that of the others above which something unknown acts on it")
    axis_error: float = assume(1.3, "ratio", "error of the logarithm of a noise from n samples, times √n")
    ratio_error: float = assume(0.02, "ratio", "least error of the logarithm of the common noise ratio")
    lone_error: float = assume(0.04, "ratio", "least error of the logarithm of the noise of one axis over the others")
    coarse_step_ratio: float = assume(1.4, "ratio", "step of the readings over the stated step above which it is coarse")
    coarse_noise_ratio: float = assume(0.5, "ratio", "step of the readings over the stated noise above which it is coarse")
    fewest_held_runs: int = assume(3, "count", "stretches of repeated rows from which on samples count as held")
    held_chance_ratio: float = assume(4.0, "ratio", "repeated rows over those of chance from which on samples count as held")
    p_long_run: float = assume(0.01, "probability", "that chance makes a stretch as long, below which it counts as held")
    fewest_held_rows: float = assume(10.0, "rows", "repeated rows beyond those of chance from which on samples count as held")


@dataclass(frozen=True)
class SearchAssumptions:
    """Which sets of effects are fitted."""

    fitted_after_scan: int = assume(14, "count", "effects that are fitted after the scan")
    also_fitted_gain: float = assume(0.5, "ratio", "gain over that of the best from which on further effects are fitted")
    large_gap: float = assume(2e4, "squared sd", "gap that is large enough to change how in-tolerance deviations act")
    rounds: int = assume(6, "count", "most linearisations of a likely hypothesis", "most converge in three")
    further_effect_nats: tuple[float, float] = assume(
        (2.0, 3.0), "nats", "by which a single effect must beat none, and a set the best smaller set, before larger sets are searched"
    )
    refined: tuple[int, int] = assume((8, 4), "count", "likeliest single effects, and likeliest sets, that are fitted again")
    extended: tuple[int, int] = assume((4, 2), "count", "likeliest single effects, and likeliest pairs, that are extended")
    added: tuple[int, int] = assume((5, 3), "count", "effects that are tried in addition to a single effect, and to a pair")
    hopeless_nats: float = assume(40.0, "nats", "distance from the likeliest set above which a set is not fitted again")
    tested: int = assume(12, "count", "likeliest hypotheses whose residual is tested")
    stiffer: tuple[float, ...] = assume((1.0, 3.0, 10.0), "ratio", "factors on an unknown modulus at which a limit of readings is sought")
    least_gain: float = assume(4.0, "squared sd", "gain below which a further effect is not fitted: noise gives as much")
    peak_ratio: float = assume(25.0, "ratio", "power of a line in the residual spectrum over its neighbourhood from which on it stands out")
    hump_width: float = assume(
        0.04, "ratio", "half the width of a resonance over its frequency", "damping ratios of 0.02 to 0.1 make such humps"
    )
    neighbourhood: float = assume(1.5, "ratio", "factor to the ends of the neighbourhood of a hump")
    humps: int = assume(3, "count", "humps at which a resonance is sought")
    least_hump_distance: float = assume(0.15, "ratio", "least distance of their logarithms", "a search finds a hump from a tenth away")
    most_starts: int = assume(32, "count", "starting points of one effect", "enough for three parameters at three values each")
    largest_step_sd: float = assume(4.0, "sd", "largest move of a shared deviation in one linearisation")
    largest_deviation_sd: float = assume(8.0, "sd", "largest shared deviation at which nuisances are linearised")


@dataclass(frozen=True)
class NamingAssumptions:
    """What is named, and what is reported."""

    p_none_to_acquit: float = assume(
        0.25, "probability", "no gap, above which nothing is named: a false accusation costs more than a missed effect"
    )
    p_to_name: float = assume(
        0.5,
        "probability",
        "an effect with its group, or something unknown, from which on it is named",
        "blind check: at 0.2, effects taken out of the list are called unknown in 62 % instead of half, known ones in 5 %",
    )
    p_to_name_weak: float = assume(0.8, "probability", "the same for a weak effect beside a larger one")
    weak_sd: float = assume(8.0, "sd", "size below which an effect is weak")
    indistinguishable: float = assume(
        0.04, "odds", "odds against the best set from which on a set that replaces one of its effects makes both indistinguishable"
    )
    largest_group: int = assume(2, "count", "indistinguishable effects above which the verdict is ambiguous")
    least_open_share: float = assume(
        0.02, "odds", "odds against the best set up to which a set is left out of the enriched cell", "two of a hundred drawn cells"
    )
    modulus_apart_sd: float = assume(2.0, "sd", "distance of the measured modulus from the compared one above which the file is questioned")
    unexplained_sd: float = assume(4.0, "sd", "excess of a residual's energy over white noise above which it is unexplained")
    covered: float = assume(0.95, "probability", "an interval holds the parameter", "usual")
    largest_interval_stretch: float = assume(5.0, "ratio", "end of an interval over that of the parabola, at most")


@dataclass(frozen=True)
class LawsAssumptions:
    """The search for a law that no listed effect is, and its prices."""

    sizes_sd: tuple[float, ...] = assume(
        (8.0, 20.0, 50.0, 150.0), "sd", "sizes of a law, and of a random walk, beyond what tolerances hide; equally probable"
    )
    least_share: float = assume(0.004, "ratio", "share of a law's squared change that tolerances leave below which it is no law")
    full_share: float = assume(0.1, "ratio", "share of a law's squared change that tolerances leave above which it costs nothing")
    share_price_nats: float = assume(1.5, "nats", "price for each factor e by which this share lies below `full_share`")
    look_nats: float = assume(6.0, "nats", "that a candidate must reach in the scan of the dictionary")
    named_nats: float = assume(10.0, "nats", "from which on a law is named")
    named_height_nats: float = assume(40.0, "nats", "the same for heights: they are known so well that every controller differs a little")
    further_nats: float = assume(10.0, "nats", "least evidence of a further term: a false second term costs more than a missed one")
    further_share: float = assume(0.06, "ratio", "least evidence of a further term, as a share of what is gained so far")
    most_terms: int = assume(2, "count", "largest number of terms of a law")
    alike_nats: float = assume(3.0, "nats", "difference below which the recording does not distinguish two laws")
    rest_speed_ratios: tuple[float, ...] = assume(
        (0.25, 0.5, 2.0, 4.0), "ratio", "factors on the speed at which friction turns over that are tried for a law of the direction"
    )
    pairs_with_formulas: int = assume(5, "count", "likeliest pairs of factor and driver for which closed formulas are tried")
    folds: int = assume(4, "count", "parts of the strokes that are held out in turn")
    folds_that_gain: int = assume(3, "count", "folds that must gain: a law that one stroke alone shows does not hold in others")
    least_fold_share: float = assume(0.02, "ratio", "share of the evidence that each of these folds must gain")
    least_gain_share: float = assume(0.4, "ratio", "least gain on strokes that were not seen, as a share of the evidence")
    least_share_added: float = assume(
        0.2, "ratio", "least share of the gap's energy of what acts in addition to an effect: less is an error of that effect's law"
    )
    alternations: int = assume(3, "count", "times that listed parameters and the added law are fitted in turn")
    many_parts: int = assume(2, "count", "listed effects from which on a law alone is tried even if they leave nothing")
    most_certain: float = assume(
        0.97, "probability", "a law, at most", "38 of 38 accepted laws were right, which supports (38 + 1) / (38 + 2)"
    )
    one_cycle: float = assume(0.6, "ratio", "share of a law's change from which on one press or stroke alone shows it")
    imitation_cosine: float = assume(0.5, "cosine", "change of an effect and of the law above which the effect imitates it")
    factor_nats: tuple[tuple[FactorName, float], ...] = assume(
        (
            ("one", 0.0),
            ("force", 0.0),
            ("surface", 0.5),
            ("speed", 1.0),
            ("direction", 0.5),
            ("force_direction", 1.0),
            ("air", 1.0),
            ("pushing", 1.5),
            ("acceleration", 1.5),
        ),
        "nats",
        "price of a factor: the rarer kinds of law cost more",
    )
    driver_nats: float = assume(0.5, "nats", "price of a driver that is not the usual height, depth, force or speed")
    rare_driver_nats: float = assume(1.0, "nats", "price of a rare driver, such as the acceleration or the deepest press so far")
    lateral_nats: float = assume(1.5, "nats", "price of a force to the side")
    height_nats: float = assume(8.0, "nats", "price of a law of the height")
    single_axis_nats: float = assume(3.0, "nats", "price of a law of one axis alone")
    fine_nats: float = assume(1.0, "nats", "price of a curve with narrow features")
    relaxed_nats: float = assume(1.5, "nats", "price of a relaxed driver")
    loop_nats: float = assume(2.0, "nats", "price of a driver with play, stop or a limit of speed")
    periodic_nats: float = assume(1.0, "nats", "price of a periodic driver, in addition to the log of the number of tried frequencies")
    grid_nats: float = assume(0.5, "nats", "price of places and widths of a formula that are tried between those of the grid")
    curve_lengths: tuple[float, ...] = assume((1.2, 3.0, 8.0), "sevenths of the range", "correlation lengths of a curve")
    harmonic_variances: tuple[float, ...] = assume((1.0, 0.15, 0.05), "ratio", "prior variances of the harmonics of a curve that repeats")
    square_variance: float = assume(0.3, "ratio", "prior variance of the square of a relaxed state; that of the state is 1")
    time_constants: tuple[float, float] = assume(
        (0.001, 0.3), "ratio", "shortest and longest time constant of relaxed states, as shares of the longest recording"
    )
    dead_bands: tuple[float, ...] = assume((0.01, 0.04, 0.15), "ratio", "dead bands of loops, as shares of the range of height or force")
    rest_speed_m_per_s: float = assume(0.5e-3, "m/s", "largest speed at which friction turns over")
    rest_speed_share: float = assume(0.05, "ratio", "the same on slow rigs, as a share of the 95 % quantile of the speed")
    shallow_share: float = assume(0.1, "ratio", "scale of the distance from the surface, as a share of the deepest press")
    fastest_Hz: float = assume(12.0, "Hz", "largest frequency of a periodic law")
    fastest_rate_share: float = assume(0.4, "ratio", "the same as a share of the rate of the samples")
    shortest_pitch_m: float = assume(2e-4, "m", "shortest pitch of a periodic law")
    strokes_per_pitch: float = assume(100.0, "ratio", "length of a stroke over the shortest pitch")
    pitch_noises: float = assume(20.0, "ratio", "shortest pitch over the noise of a reported height")


@dataclass(frozen=True)
class EventsAssumptions:
    """Events and random walks, which compete with a law."""

    size_sd: float = assume(20.0, "sd", "prior size of an event beyond what tolerances hide")
    pulse_bins: tuple[int, ...] = assume((3, 9, 27, 81), "count", "lengths of pulses and bursts, in bins")
    kinds: float = assume(12.0, "kinds", "kinds and channels of events, among which one is chosen")
    drift_changes: int = assume(60, "count", "times at which a change of drift is tried")
    least_nats: float = assume(6.0, "nats", "of an event below which the search ends")
    most: int = assume(6, "count", "largest number of events")
    burst_sd: tuple[float, ...] = assume((2.0, 5.0), "sd", "spreads that noise may have within a burst")
    wander_knots: int = assume(160, "count", "knots in time of a random walk of the zero or of the scale of fz")
    wander_lengths: tuple[float, ...] = assume((2.0, 8.0, 40.0), "knots", "correlation lengths of this walk")


@dataclass(frozen=True)
class AdviceAssumptions:
    """What to record next, and which effects a motion distinguishes."""

    open_above: float = assume(0.03, "odds", "odds against the best hypothesis above which a hypothesis is open")
    most_open: int = assume(4, "count", "largest number of open hypotheses", "the cost grows with its square")
    worth_nats: float = assume(1.0, "nats", "least expected log odds of a motion that is proposed")
    overhead_s: float = assume(20.0, "s", "time of a run in addition to its motion: opening, taring, the search of the surface")
    patience: float = assume(100.0, "ratio", "repetitions of a motion that count as unlimited patience")
    again: int = assume(6, "count", "repetitions of a press or stroke that alone showed a law")
    most_alike: int = assume(3, "count", "laws that fit as well, against which a motion is sought", "the cost grows with its square")
    one_direction: float = assume(0.98, "cosine", "two effects above which that motion does not distinguish them")
    mostly_alike: float = assume(0.5, "cosine", "two effects up to which they are not similar")
    odds: float = assume(20.0, "odds", "at which two effects count as distinguished")


@dataclass(frozen=True)
class LimitsAssumptions:
    """The smallest size of an effect that a recording shows."""

    odds: float = assume(20.0, "odds", "by which the data favour an effect over none from which on it counts as shown")
    shape_nats: float = assume(2.0, "nats", "cost of a shape that the data determine, such as a time constant")


@dataclass(frozen=True)
class Assumptions:
    """The assumptions of a diagnosis by stage."""

    prior: PriorAssumptions = PriorAssumptions()
    law_error: LawErrorAssumptions = LawErrorAssumptions()
    noise: NoiseAssumptions = NoiseAssumptions()
    rounding: RoundingAssumptions = RoundingAssumptions()
    residual: ResidualAssumptions = ResidualAssumptions()
    scatter: ScatterAssumptions = ScatterAssumptions()
    search: SearchAssumptions = SearchAssumptions()
    naming: NamingAssumptions = NamingAssumptions()
    limits: LimitsAssumptions = LimitsAssumptions()
    laws: LawsAssumptions = LawsAssumptions()
    events: EventsAssumptions = EventsAssumptions()
    advice: AdviceAssumptions = AdviceAssumptions()


ASSUMED = Assumptions()
"""The assumptions of this program."""
