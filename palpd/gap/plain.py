"""An answer in plain words: what is wrong, how it shows, how sure that is, what to do next. Terminal and report say the same.

It says what out.json holds, and concludes nothing else.
"""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any, TypedDict

from palpd.cell.effects import Effect
from palpd.gap.data.phases import PHASE_PHRASES
from palpd.quantities import OF_JOINT, number, quantity, scaled

CHANNEL_WORDS = {
    "z_m": "height", "fx_N": "force along x", "fy_N": "force along y", "fz_N": "vertical force",
    "tx_Nm": "torque about x", "ty_Nm": "torque about y", "tz_Nm": "torque about z",
}  # fmt: skip
JOINT_WORDS = {"z_m": "angle", "fz_N": "torque"}
"""Channels of a recording of a single joint."""
EVENT_WORDS = {
    "step": "{channel} steps by {size}",
    "pulse": "{channel} is {size} off for a moment",
    "burst": "{channel} scatters by {size} for a moment",
    "fall of the contact force": "the contact force falls during a press ({size})",
    "change of drift": "{channel} drifts from there on, by {size} until the end",
}
UNCALIBRATED = "Of comparisons with healthy recordings fewer are right than the probability says (docs/arena-scores.md)."
DIAGNOSE = "palpd diagnose RECORDING --cell cell.yaml"
MOST_SAID = 2
"""Largest number of indistinguishable effects that a sentence lists; the report lists all."""
MOST_ALIKE = 4
"""Largest number of laws that are listed as fitting as well."""
WITHIN_NOISE = 1.1
"""Rms over that of the noise up to which a simulator agrees with a recording: noise itself scatters by less."""
FAR_FROM_NOISE = 5.0
"""Rms of what remains over that of the noise from which on a share that closes is not enough to say."""
CLEAR = 1.2
"""Rms of a gap over that of a healthy cell above which both are stated: below it, the excess lies in the course and not in the size."""
LEAST_CLOSED = 0.05
"""Share of a gap below which it is not closed."""
SHOWN_WIDTH = 0.02
"""Width of the interval of a closed share above which it is shown."""


class PlainCause(TypedDict):
    """A named cause: what it is and how it shows, each parameter (key, meaning, value), how sure it is, what it could be mistaken for."""

    id: str
    sentence: str
    parameters: list[tuple[str, str, str]]
    sure: str
    mistaken_for: str


class PlainAnswer(TypedDict):
    """A diagnosis in plain words, empty where there is nothing to say. `steps` say what to do next, each with its command."""

    answer: str
    where: str
    sure: str
    causes: list[PlainCause]
    events: list[str]
    closed: str
    steps: list[tuple[str, str]]


def plain_answer(content: Mapping[str, Any], library: Mapping[str, Effect]) -> PlainAnswer:
    """Say an answer in plain words.

    Args:
        content: The content of out.json.
        library: Effects by id, for their descriptions and units.
    """
    sure = {"none": content["p_none"], "unknown": content["p_unknown"]}.get(content["verdict"])
    return {
        "answer": answer_sentence(content, library),
        "where": _where(content),
        "sure": "" if sure is None else UNCALIBRATED if _since_healthy(content) else _sure(sure),
        "causes": [*_laws(content), *(_cause(content, effect, library) for effect in content["effects"])],
        "events": [_event(event, content) for event in sorted(content.get("events") or (), key=lambda event: event["t_s"])],
        "closed": _closed(content),
        "steps": list(_steps(content)),
    }


def channel_words(channel: str, content: Mapping[str, Any]) -> str:
    """A channel in words with its name: vertical force (fz); torque of a joint.

    Args:
        content: The content of out.json.
    """
    return JOINT_WORDS[channel] if content.get("joint") else f"{CHANNEL_WORDS[channel]} ({channel.split('_')[0]})"


def channel_name(channel: str, content: Mapping[str, Any]) -> str:
    """A channel in words: vertical force, or torque of a joint.

    Args:
        content: The content of out.json.
    """
    return (JOINT_WORDS if content.get("joint") else CHANNEL_WORDS)[channel]


def answer_sentence(content: Mapping[str, Any], library: Mapping[str, Effect], *, with_ids: bool = False) -> str:
    """The answer in a sentence; a second sentence names the formula of a law, or the nearest listed cause of something unknown.

    Args:
        content: The content of out.json.
        library: Effects by id, for their descriptions.
        with_ids: Whether each cause is followed by its id and its probability.
    """
    verdict, named, learned, events = (content.get(key) for key in ("verdict", "effects", "learned", "events"))
    probabilities = {each["id"]: each["probability"] for each in content["candidates"]}

    def words(name: str) -> str:
        return _cause_of(name, library) + (f" ({name} {probabilities.get(name, 0.0):.2f})" if with_ids else "")

    def either(effect: Mapping[str, Any]) -> str:
        name, others = effect["id"], list(effect["indistinguishable_from"])
        if len(others) > MOST_SAID:
            return f"{words(name)} or one of {len(others)} others"
        return f"either {' or '.join(map(words, (name, *others)))}" if others else words(name)

    causes = ", and ".join(map(either, named or ()))
    if verdict == "none":
        simulated = content.get("simulated") or {}
        nominal = "it did while it was healthy" if simulated.get("healthy") else "your simulator says" if simulated else "its file says"
        return f"No gap: the cell behaves as {nominal}, within its tolerances" + (f" ({content['p_none']:.2f})." if with_ids else ".")
    if verdict == "effects":
        return f"The gap has {'one cause' if len(named or ()) == 1 else f'{len(named or ())} causes'}: {causes}."
    if verdict == "ambiguous":
        return f"This recording leaves open what causes the gap: {causes}."
    outside = "Something outside palpd's list " + (f"({content['p_unknown']:.2f}) " if with_ids else "")
    if learned:
        first, *further = learned["what"].split("; ")
        formulas = [term["formula"] for term in (learned, *learned["further_terms"]) if term["formula"]] if with_ids else []
        its_law = f" Its law is {' and '.join(formulas)}." if formulas else ""
        return f"{outside}acts, and it follows a law: {first}{', and a second one' if further else ''}.{its_law}"
    nearest = f" The nearest in the list: {causes}." if causes else " Nothing in the list is near."
    if events:
        return f"{outside}happened {'once' if len(events) == 1 else f'{len(events)} times'}, and it follows no law."
    return f"{outside}acts.{nearest}"


def _cause_of(name: str, library: Mapping[str, Effect]) -> str:
    return library[name].cause if name in library else name


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:]}."


def _since_healthy(content: Mapping[str, Any]) -> bool:
    """Whether the answer compares with healthy recordings."""
    return bool((content.get("simulated") or {}).get("healthy"))


def _sure(probability: float) -> str:
    return f"{min(max(100.0 * probability, 1.0), 99.0):.0f} of 100 such answers are right."


def _unexplained(content: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Where what nothing in the list explains is largest; None unless the answer is unknown."""
    return content["unexplained"] if content["verdict"] == "unknown" else None


def shown_place(content: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The channel and phase to look at: of what no cause explains where the answer is unknown, else of the largest gap."""
    return _unexplained(content) or content["where"]


def _where(content: Mapping[str, Any]) -> str:
    place = content["where"]
    if place is None:
        return ""
    gap = next((each for each in content["gap"] if (each["channel"], each["phase"]) == (place["channel"], place["phase"])), None)
    size = ""
    if gap is not None and gap["rms"] > CLEAR * gap["noise_floor"]:
        rms, floor = _sizes(unit_of(place["channel"], content), gap["rms"], gap["noise_floor"])
        size = f": {rms} rms, where a healthy cell shows {floor}"
    shows = f"It shows most in the {channel_words(place['channel'], content)} {PHASE_PHRASES[place['phase']]}{size}."
    rest = _unexplained(content)
    if rest is None:
        return shows
    there = (rest["channel"], rest["phase"]) == (place["channel"], place["phase"])
    if there and size and not content["effects"]:
        return shows
    at = "there" if there else f"in the {channel_words(rest['channel'], content)} {PHASE_PHRASES[rest['phase']]}"
    return f"{shows} What nothing in the list explains is largest {at}: {quantity(rest['rms'], unit_of(rest['channel'], content))} rms."


def _sizes(si: str, *values: float) -> list[str]:
    """Sizes in one unit, to compare them."""
    scale, unit = scaled(max(values), si)
    return [f"{number(value / scale, 2)} {unit}" for value in values]


def unit_of(channel: str, content: Mapping[str, Any] = MappingProxyType({})) -> str:
    """The SI unit of a channel.

    Args:
        content: The content of out.json, where it may be a joint's.
    """
    return own_unit(channel.rsplit("_", 1)[1].replace("Nm", "N m"), content)


def own_unit(unit: str, content: Mapping[str, Any]) -> str:
    """The unit of an axis as the recording has it: that of a joint in its place, where it is one.

    Args:
        content: The content of out.json.
    """
    return OF_JOINT.get(unit, unit) if content.get("joint") else unit


def _cause(content: Mapping[str, Any], effect: Mapping[str, Any], library: Mapping[str, Effect]) -> PlainCause:
    known = library.get(effect["id"])
    meanings = {each.name: (each.label, each.unit) for each in (known.parameters if known is not None else ())}
    parameters = []
    for name, figure in effect["parameters"].items():
        label, of_axis = meanings.get(name, (name, "1"))
        unit = own_unit(of_axis, content)
        bound = ", at the end of its range, so it is a finding and no value" if name in effect.get("at_bound", ()) else ""
        parameters.append((name, label, quantity(figure["value"], unit, tuple(figure["ci95"])) + bound))
    others = "; ".join(f"{_cause_of(other, library)} ({other})" for other in effect["indistinguishable_from"])
    mistaken = f"This recording cannot distinguish it from: {others}." if others else "No other cause in the list fits as well."
    if content["verdict"] == "unknown":
        beside = content.get("learned") and not content["learned"]["replaces_listed"]
        mistaken = "It acts beside the law." if beside else "It is the nearest in the list, and may only imitate what is not in it."
    elif effect.get("family") and not others:
        mistaken = f"Other {effect['family']} would look the same."
    return {
        "id": effect["id"],
        "sentence": _sentence(known.what if known is not None else effect["id"]),
        "parameters": parameters,
        "sure": "" if content["verdict"] == "unknown" else UNCALIBRATED if _since_healthy(content) else _sure(effect["probability"]),
        "mistaken_for": mistaken,
    }


def _laws(content: Mapping[str, Any]) -> Iterator[PlainCause]:
    """The learned law as a cause, where there is one."""
    if learned := content.get("learned"):
        terms = [term for term in (learned, *learned["further_terms"]) if term["formula"]]
        alike = "; ".join(learned["alike"][:MOST_ALIKE])
        yield {
            "id": learned["id"],
            "sentence": _sentence(learned["what"]),
            "parameters": [("x", f"{term['driver']}, in {term['driver_unit']}", f"law = {term['formula']}") for term in terms],
            "sure": _sure(learned["probability"]),
            "mistaken_for": f"This recording cannot distinguish it from: {alike}." if alike else "",
        }


def _event(event: Mapping[str, Any], content: Mapping[str, Any]) -> str:
    channel = channel_name(event["channel"], content)
    size = quantity(abs(event["size"]), unit_of(event["channel"], content))
    words = EVENT_WORDS.get(event["kind"], "{channel}: " + event["kind"] + " of {size}").format(channel=f"the {channel}", size=size)
    return _sentence(f"at {event['t_s']:.2f} s {words}")


def _closed(content: Mapping[str, Any]) -> str:
    """How far the simulator comes with the named causes."""
    shrink, learned = content["shrink"], content.get("learned")
    rest = f" What is not explained follows a law: {learned['what']}." if learned and content["verdict"] != "unknown" else ""
    if shrink["closed"] is None:
        return rest.strip()
    causes = "this cause" if len(content["effects"]) == 1 else "these causes"
    if content["verdict"] == "unknown":
        causes = "what is nearest in the list"
    before, after, noise = _sizes(unit_of(shrink["channel"], content), shrink["before_rms"], shrink["after_rms"], shrink["noise_floor"])
    if shrink["closed"] >= 0.5 and shrink["after_rms"] <= WITHIN_NOISE * shrink["noise_floor"]:
        return f"With {causes} the simulator agrees with {shrink['on']}, to within the noise: {after} rms, {before} without.{rest}"
    if shrink["closed"] < LEAST_CLOSED:
        return f"With {causes} the simulator comes no nearer to {shrink['on']}.{rest}"
    low, high = shrink["ci95"] or (shrink["closed"], shrink["closed"])
    interval = f" ({100 * low:.0f} to {100 * high:.0f} %)" if high - low > SHOWN_WIDTH else ""
    share = f"{min(100.0 * shrink['closed'], 99.0):.0f} %{interval}"
    ratio = shrink["after_rms"] / max(shrink["noise_floor"], 1e-300)
    far = f" What remains is {ratio:.0f} times the noise: this is not the whole answer." if ratio >= FAR_FROM_NOISE else ""
    return f"With {causes} {share} of the gap closes on {shrink['on']}: from {before} to {after} rms, with noise of {noise}.{far}{rest}"


def _steps(content: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """What to do next, the most urgent first."""
    verdict, proposed, learned, events = (content.get(key) for key in ("verdict", "next_experiment", "learned", "events"))
    since_healthy = _since_healthy(content)
    if content["decisive"]:
        yield "First clear up what stands above the answer: it makes the answer doubtful.", ""
    elif verdict == "none":
        yield "Nothing: no gap was found.", ""
    if verdict == "none":
        if (content.get("modulus") or {}).get("far"):  # named causes would change the measured one
            yield "Check that the cell file's modulus is that of this sample: it is far from the measured one.", ""
        return
    if proposed:
        motion = proposed["sentence"].partition(". ")[0].removesuffix(".")
        yield (
            f"{motion}: that should decide. Its plan stands in the report and in the JSON.",
            DIAGNOSE.replace("RECORDING", "FIRST SECOND"),
        )
    elif verdict == "ambiguous":
        yield "palpd knows no motion that decides. Check the causes at the cell, the likeliest first.", ""
    if events:
        yield "Record the same motion again: events that come back in the same place belong to the cell, others are disturbances.", ""
    elif verdict == "unknown" and not learned:
        yield (
            "Look at the cell where the gap is largest. If you know the cause, add it as an effect of your own "
            "(docs/how-to/add-an-effect.md), and diagnose again.",
            f"{DIAGNOSE} --effects my_effect.py",
        )
    if learned and not since_healthy:
        file = learned.get("file") or "out.learned.yaml"
        yield ("If the law is to count from now on, let it join your library; --json writes it.", f"palpd effects --adopt {file}")
    if since_healthy:  # no cell file holds what was compared with
        yield "Look at the cell for what is named. When it is mended, record the same motion and compare again.", ""
        return
    if verdict == "effects" or learned:
        yield ("Use the enriched cell file, which holds what was found.", f"{DIAGNOSE} --cell-out enriched.yaml")
        if any(gap["phase"] in ("loading", "holding", "unloading") for gap in content["gap"]):
            yield ("For E without what was found, analyse the recording with it.", "palpd analyse RECORDING --cell enriched.yaml")
        if not proposed:
            yield (
                "Record another motion and compare it with the prediction: only that proves the answer.",
                "palpd simulate MOTION --cell enriched.yaml --csv predicted.csv",
            )
