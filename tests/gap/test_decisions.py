"""Which verdict follows from which evidence: every branch between the list, a law and events, each with the decision that it makes."""

from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from palpd.gap import decide as decisions
from palpd.gap.calibration import ProbabilityMap
from palpd.gap.decide import decide, listed_answer
from palpd.gap.laws import evidence
from palpd.gap.laws.evidence import look_for_laws
from palpd.gap.laws.search import LearnedLaw

HEIGHT, TIME, TURNS, PRESSES = ("height", None), ("time", None), ("time", 0.5), ("presses", None)
EFFECTS, AMBIGUOUS, UNKNOWN, NONE = (0.01, 0.1, 0), (0.01, 0.1, 3), (0.01, 0.6, 0), (0.9, 0.05, 0)
"""Probability of no gap, probability of something unknown, and number of effects that could stand in the place of each name."""


class Law(NamedTuple):
    """A law that a search returns: its nats, whether it holds on strokes that it has not seen, driver and period, number of terms."""

    nats: float = 0.0
    holds: bool = True
    driver: tuple[str, float | None] = HEIGHT
    terms: int = 1
    one_cycle: bool = False


class Case(NamedTuple):
    """The evidence of a diagnosis.

    Attributes:
        names: Number of effects of the best set.
        list: What the list says, as above.
        gained: Nats by which the listed effects beat the cell without effects.
        events: Nats of the events beside the listed effects, and whether they hold enough of the gap's energy.
        alone_events: Nats of the events in the cell without effects, and how many they are.
        leading: Share of what the effects explain that the best of them alone leaves.
        wander: Nats of a random walk in time.
        scatter: Whether the scatter of the readings names an effect.
    """

    names: int
    list: tuple[float, float, int]
    top: Law = Law()
    events: tuple[float, bool] = (0.0, True)
    alone: Law = Law()
    alone_events: tuple[float, int] = (0.0, 1)
    together: Law | None = None
    gained: float = 100.0
    presses: int = 6
    leading: float = 0.0
    wander: float = -np.inf
    coarse: bool = False
    scatter: bool = False


class Decision(NamedTuple):
    """A verdict: the law with its nats, its role where effects are named, which events, the first words of the note, the refused law."""

    kind: str
    p_unknown: float
    law: str = ""
    role: str = ""
    events: str = ""
    note: str = ""
    refused: str = ""


NOISE = SimpleNamespace(id="noise", probability=0.99, parameters={})


TABLE: dict[str, tuple[Case, Decision]] = {
    "coarse steps forbid the search": (Case(0, UNKNOWN, Law(50), coarse=True), Decision("unknown", 0.6)),
    "a healthy cell": (Case(0, NONE), Decision("none", 0.05)),
    "a single effect leaves nothing": (Case(1, EFFECTS, alone=Law(500)), Decision("effects", 0.1)),
    "a single effect leaves a law that does not hold": (Case(1, EFFECTS, Law(50, holds=False)), Decision("effects", 0.1)),
    "one press alone shows what a single effect leaves": (
        Case(1, EFFECTS, Law(50, holds=False, one_cycle=True)),
        Decision("effects", 0.1, refused="top: one cycle"),
    ),
    "one press alone shows a law in a cell without effects": (
        Case(0, UNKNOWN, Law(50, holds=False, one_cycle=True)),
        Decision("unknown", 0.6, refused="top: one cycle"),
    ),
    "a law in a cell without effects": (Case(0, UNKNOWN, Law(50)), Decision("unknown", 0.988, law="top 50")),
    "a law makes a healthy cell unknown": (Case(0, NONE, Law(12)), Decision("unknown", 0.972, law="top 12")),
    "too few nats for a law": (Case(0, NONE, Law(9.9)), Decision("none", 0.05)),
    "events in a cell without effects": (
        Case(0, UNKNOWN, events=(30, True)),
        Decision("unknown", 0.988, events="top", note="What remains looks"),
    ),
    "events that beat a law": (
        Case(0, UNKNOWN, Law(30), events=(28, True)),
        Decision("unknown", 0.988, events="top", note="What remains looks"),
    ),
    "a law that beats events": (Case(0, UNKNOWN, Law(34), events=(30, True)), Decision("unknown", 0.988, law="top 34")),
    "a law that fails beside weaker events": (
        Case(0, UNKNOWN, Law(34, holds=False), events=(11, True)),
        Decision("unknown", 0.988, events="top", note="What remains looks"),
    ),
    "a law of time": (
        Case(0, UNKNOWN, Law(50, driver=TIME)),
        Decision("unknown", 0.6, note="Something changes smoothly", refused="top: time"),
    ),
    "a law of the phase of a turn in time": (Case(0, UNKNOWN, Law(50, driver=TURNS)), Decision("unknown", 0.988, law="top 50")),
    "a law of the number of presses": (
        Case(0, UNKNOWN, Law(50, driver=PRESSES)),
        Decision("unknown", 0.988, law="top 50", note="The law follows"),
    ),
    "a random walk explains a law as well": (
        Case(0, UNKNOWN, Law(50), wander=48.0),
        Decision("unknown", 0.6, note="Something changes smoothly", refused="top: time"),
    ),
    "a random walk explains less than a law": (Case(0, UNKNOWN, Law(50), wander=46.0), Decision("unknown", 0.988, law="top 50")),
    "what an effect leaves follows a law": (
        Case(1, EFFECTS, Law(30), together=Law(32)),
        Decision("effects", 0.1, law="together 30", role="secondary"),
    ),
    "what an effect leaves follows the law as first found": (
        Case(1, EFFECTS, Law(30)),
        Decision("effects", 0.1, law="top 30", role="secondary"),
    ),
    "what effects leave follows a law, and the list does not explain the gap": (
        Case(1, UNKNOWN, Law(30), together=Law(32)),
        Decision("unknown", 0.6, law="together 30", role="secondary"),
    ),
    "what an effect leaves follows time": (
        Case(1, EFFECTS, Law(30, driver=TIME)),
        Decision("effects", 0.1, note="Something changes smoothly", refused="top: time"),
    ),
    "what an effect leaves wanders in time": (
        Case(1, EFFECTS, Law(30), wander=40.0),
        Decision("effects", 0.1, note="Something changes smoothly", refused="top: time"),
    ),
    "a law beats an effect that leaves one": (Case(1, EFFECTS, Law(30), alone=Law(128)), Decision("effects", 0.1, note="A law outside")),
    "a law does not beat an effect that leaves one": (
        Case(1, EFFECTS, Law(30), alone=Law(126)),
        Decision("effects", 0.1, law="top 30", role="secondary"),
    ),
    "a law beats an effect that leaves one, and does not hold": (
        Case(1, EFFECTS, Law(30), alone=Law(200, holds=False)),
        Decision("effects", 0.1, law="top 30", role="secondary"),
    ),
    "a law beats an effect in an unknown cell": (
        Case(1, UNKNOWN, Law(30), alone=Law(128)),
        Decision("unknown", 0.988, law="alone 28", role="replaces"),
    ),
    "a law of time beats an effect in an unknown cell": (
        Case(1, UNKNOWN, Law(30), alone=Law(128, driver=TIME)),
        Decision("unknown", 0.6, note="Something changes smoothly", refused="alone: time"),
    ),
    "a random walk explains the law that beats an effect": (
        Case(1, UNKNOWN, Law(30), alone=Law(128), wander=126.0),
        Decision("unknown", 0.6, note="Something changes smoothly", refused="alone: time"),
    ),
    "two effects leave nothing": (Case(2, EFFECTS, alone=Law(50)), Decision("effects", 0.1)),
    "two effects leave nothing and a law beats them, the best leaving much": (
        Case(2, EFFECTS, alone=Law(110), leading=0.2),
        Decision("unknown", 0.973, law="alone 10", role="replaces"),
    ),
    "two effects leave nothing and a law beats them, the best leaving little": (
        Case(2, EFFECTS, alone=Law(110), leading=0.19),
        Decision("effects", 0.1, note="A law outside"),
    ),
    "a law of two terms beats two effects, the best leaving much": (
        Case(2, EFFECTS, alone=Law(110, terms=2), leading=0.9),
        Decision("effects", 0.1, note="A law outside"),
    ),
    "a law beats two effects with many rivals, the best leaving much": (
        Case(2, AMBIGUOUS, alone=Law(110), leading=0.5),
        Decision("unknown", 0.973, law="alone 10", role="replaces"),
    ),
    "a law beats two effects with many rivals, the best leaving little": (
        Case(2, AMBIGUOUS, alone=Law(110), leading=0.1),
        Decision("ambiguous", 0.1, note="A law outside"),
    ),
    "one event alone is more probable than two effects": (
        Case(2, EFFECTS, alone_events=(104, 1)),
        Decision("unknown", 0.915, events="alone", note="What remains looks"),
    ),
    "one event alone is as probable as two effects": (Case(2, EFFECTS, alone_events=(102, 1)), Decision("effects", 0.1)),
    "two effects are fewer than three events": (Case(2, EFFECTS, alone_events=(150, 3)), Decision("effects", 0.1)),
    "one event alone is more probable than two effects in two presses": (
        Case(2, EFFECTS, alone_events=(104, 1), presses=2),
        Decision("effects", 0.1),
    ),
    "two effects leave nothing, and a law beats them and one event": (
        Case(2, EFFECTS, alone=Law(110), alone_events=(104, 1), leading=0.2),
        Decision("unknown", 0.973, law="alone 10", role="replaces"),
    ),
    "one event beats two effects, and a law of time beats them all": (
        Case(2, EFFECTS, alone=Law(200, driver=TIME), alone_events=(110, 1)),
        Decision("unknown", 0.973, events="alone", note="What remains looks"),
    ),
    "two effects leave what one press alone shows": (
        Case(2, EFFECTS, Law(50, holds=False, one_cycle=True), alone=Law(50)),
        Decision("effects", 0.1, refused="top: one cycle"),
    ),
    "a law beats three effects in an unknown cell": (
        Case(3, UNKNOWN, alone=Law(110)),
        Decision("unknown", 0.988, law="alone 10", role="replaces"),
    ),
    "three effects leave a law": (
        Case(3, AMBIGUOUS, Law(30), together=Law(40)),
        Decision("ambiguous", 0.1, law="together 30", role="secondary"),
    ),
    "an effect leaves events": (Case(1, EFFECTS, events=(30, True)), Decision("effects", 0.1, note="What the named")),
    "an effect leaves events in an unknown cell": (
        Case(1, UNKNOWN, events=(30, True)),
        Decision("unknown", 0.988, events="top", note="What remains looks"),
    ),
    "an effect leaves small events": (Case(1, EFFECTS, events=(30, False)), Decision("effects", 0.1)),
    "an effect leaves small events and a law": (
        Case(1, EFFECTS, Law(20), events=(30, False)),
        Decision("effects", 0.1, law="top 20", role="secondary"),
    ),
    "an effect imitated events": (
        Case(1, EFFECTS, events=(30, True), alone_events=(101, 1)),
        Decision("unknown", 0.973, events="alone", note="What remains looks"),
    ),
    "an effect imitated events in an unknown cell": (
        Case(1, UNKNOWN, events=(30, True), alone_events=(140, 1)),
        Decision("unknown", 0.988, events="alone", note="What remains looks"),
    ),
    "an effect that may have imitated events in two presses": (
        Case(1, EFFECTS, events=(30, True), alone_events=(101, 1), presses=2),
        Decision("effects", 0.1, note="What the named"),
    ),
    "an effect that imitated events where nothing presses": (
        Case(1, EFFECTS, events=(30, True), alone_events=(101, 1), presses=0),
        Decision("unknown", 0.973, events="alone", note="What remains looks"),
    ),
    "a law beats an effect and the events that it leaves": (
        Case(1, UNKNOWN, events=(30, True), alone=Law(127)),
        Decision("unknown", 0.988, law="alone 27", role="replaces"),
    ),
    "a law does not beat an effect and the events that it leaves": (
        Case(1, UNKNOWN, events=(30, True), alone=Law(126)),
        Decision("unknown", 0.988, events="top", note="What remains looks"),
    ),
    "a law does not beat events alone": (
        Case(1, UNKNOWN, events=(30, True), alone=Law(127), alone_events=(131, 1)),
        Decision("unknown", 0.988, events="alone", note="What remains looks"),
    ),
    "a law of time is no answer where events explain the gap": (
        Case(1, UNKNOWN, events=(30, True), alone=Law(300, driver=TIME)),
        Decision("unknown", 0.988, events="top", note="What remains looks"),
    ),
    "a law beats a named effect and its events": (
        Case(1, EFFECTS, events=(30, True), alone=Law(127)),
        Decision("effects", 0.1, note="A law outside"),
    ),
    "a law beats two named effects and their events, the best leaving much": (
        Case(2, EFFECTS, events=(30, True), alone=Law(127), leading=0.3),
        Decision("unknown", 0.973, law="alone 27", role="replaces"),
    ),
    "an effect leaves a law that is stronger than its events": (
        Case(1, EFFECTS, Law(40), events=(30, True), together=Law(41)),
        Decision("effects", 0.1, law="together 40", role="secondary"),
    ),
    "the law that replaces effects has many nats": (
        Case(3, UNKNOWN, Law(20), alone=Law(130), gained=110.0),
        Decision("unknown", 0.988, law="alone 20", role="replaces"),
    ),
    "a law beside an effect of the scatter": (
        Case(0, NONE, Law(50), scatter=True),
        Decision("effects", 0.05, law="top 50", role="secondary"),
    ),
    "events beside an effect of the scatter": (
        Case(0, NONE, events=(30, True), scatter=True),
        Decision("effects", 0.05, note="What the named"),
    ),
    "nothing beside an effect of the scatter": (Case(0, NONE, scatter=True), Decision("effects", 0.05)),
}


def law_of(one: Law, what: str, scene: Any) -> LearnedLaw:
    quantity, period = one.driver
    driver = SimpleNamespace(quantity=quantity, period=period, memory=None, words=quantity)
    candidate = SimpleNamespace(channel="fz_N", factor="one", driver=driver, what=what)
    held_out = SimpleNamespace(carries=lambda _: one.holds)
    terms = tuple(SimpleNamespace(nats=one.nats / one.terms, candidate=candidate, held_out=held_out) for _ in range(one.terms))
    law: Any = LearnedLaw(scene, SimpleNamespace(of=what, residual=np.zeros((7, 3))), terms if one.nats else ())
    object.__setattr__(law, "change", np.zeros((7, 3)))
    object.__setattr__(law, "one_cycle", one.one_cycle)
    return law


def stubs(case: Case, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Any, Any]:
    """The problem, the cell without effects, and the best set of a case; searches return what the case says."""
    names = tuple("abc"[: case.names])
    library = {name: SimpleNamespace(scatter=False, family=None, parameters=(), tolerance=None) for name in "abcdefg"}
    problem: Any = SimpleNamespace(
        library=library,
        recordings=[SimpleNamespace(phases=SimpleNamespace(presses=case.presses), simulated=None)],
        cell=SimpleNamespace(learned=()),
    )

    def hypothesis(names: tuple[str, ...], gained: float) -> Any:
        return SimpleNamespace(
            names=names, values={name: {} for name in names}, where=(), sizes=dict.fromkeys(names, 20.0), log_evidence=gained, eta=None,
            change=np.zeros((7, 3)), residual=np.zeros((7, 3)), misfit=0.0,
        )  # fmt: skip

    nominal, best = hypothesis((), 0.0), hypothesis(names, case.gained)
    returned = {names: (case.top, case.events[0], 1), (): (case.alone, *case.alone_events)}
    if not names:
        returned = {(): (case.top, case.events[0], 1)}

    def scene_of(_: Any, values: dict[str, Any], eta: Any) -> Any:
        return SimpleNamespace(names=tuple(values), problem=problem)

    def search(scene: Any, space: Any, gained: float = 0.0) -> LearnedLaw:
        what = "alone" if names and not scene.names else "top"
        return law_of(returned[scene.names][0], what, scene)

    def events(scene: Any, space: Any) -> Any:
        what = "alone" if names and not scene.names else "top"
        _, nats, count = returned[scene.names]
        listed: Any = [what] * count
        return evidence.Events(listed, nats, np.zeros((7, 3)))

    def together(_: Any, listed: Any, top: LearnedLaw, gained: float) -> Any:
        law = top if case.together is None else law_of(case.together, "together", top.scene)
        return law, law.space, listed

    monkeypatch.setattr(evidence.Scene, "of", scene_of)
    monkeypatch.setattr(evidence, "search", search)
    monkeypatch.setattr(evidence, "find_events", events)
    monkeypatch.setattr(evidence, "wander_nats", lambda *_: case.wander)
    monkeypatch.setattr(evidence, "_space_beside", lambda *_: SimpleNamespace())
    monkeypatch.setattr(evidence, "_fitted_together", together)
    monkeypatch.setattr(evidence, "log_prior", lambda *_: 0.0)
    monkeypatch.setattr(evidence, "_share", lambda listed, _: 0.2 if case.events[1] or not listed.names else 0.19)
    monkeypatch.setattr(evidence, "_one_cycle", lambda law: (0, 1) if law.one_cycle else None)
    monkeypatch.setattr(evidence, "confounds", lambda *_: {})
    monkeypatch.setattr(evidence, "leading_leaves", lambda *_: case.leading)
    return problem, nominal, best


def learned_stub(law: LearnedLaw, nats: float, _: Any) -> Any:
    return SimpleNamespace(what=law.terms[0].candidate.what, terms=law.terms, nats=nats)


def decided(case: Case, monkeypatch: pytest.MonkeyPatch) -> Decision:
    problem, nominal, best = stubs(case, monkeypatch)
    monkeypatch.setattr(decisions, "learned_effect", learned_stub)
    p_none, p_unknown, rivals = case.list
    groups = {name: list("defg")[:rivals] for name in best.names}
    attribution = SimpleNamespace(p_none=p_none, p_unknown=p_unknown, marginal=dict.fromkeys(best.names, 0.9), groups=groups)
    named = SimpleNamespace(fit=best, parameters={name: {} for name in best.names}, at_bound={name: [] for name in best.names})
    inference: Any = SimpleNamespace(problem=problem, nominal=nominal, fits={}, attribution=attribution, best=named)
    scatter: Any = SimpleNamespace(p_lone_axis=0.0, effects=(NOISE,) if case.scatter else ())
    laws = look_for_laws(inference, listed_answer(inference, scatter), coarse=case.coarse)
    verdict = decide(inference, scatter, laws, ProbabilityMap())
    named_law, beyond = verdict.law, verdict.beyond
    law = f"{named_law.learned.what} {named_law.nats:g}" if named_law is not None else ""
    role = "" if named_law is None else "replaces" if named_law.replaces else "secondary" if named_law.secondary else ""
    events: Any = beyond.events[0] if beyond.events else ""
    refused: Any = beyond.refused and f"{beyond.refused.law.terms[0].candidate.what}: {beyond.refused.reason}"
    return Decision(verdict.kind, round(verdict.p_unknown, 3), law, role, events, " ".join((beyond.note or "").split()[:3]), refused or "")


@pytest.mark.parametrize("name", TABLE)
def test_the_verdict_follows_from_the_evidence_of_the_list_of_laws_and_of_events(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    case, decision = TABLE[name]
    assert decided(case, monkeypatch) == decision
