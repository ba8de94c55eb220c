"""What effects could be mistaken for, before anything is recorded."""

import re

from palpd.cell.cell_file import cell_from, nominal
from palpd.cell.effects import EFFECTS, load_effects, user_effects
from palpd.gap.assumptions import ASSUMED
from palpd.gap.similar_effects import Similarity, similar_effects
from tests.paths import EXAMPLE, ROOT

FEW = ("sensor.gain", "tissue.modulus", "robot.lag", "cable.friction", "contact.lateral", "probe.tilt")


def test_a_tilt_is_like_a_lateral_force_and_a_gain_like_a_modulus() -> None:
    library = {name: EFFECTS[name] for name in FEW}
    similar = similar_effects([EFFECTS["sensor.gain"], EFFECTS["contact.lateral"]], nominal(), library)
    of = {effect: [one for one in similar if one.effect == effect] for effect in ("sensor.gain", "contact.lateral")}
    assert of["contact.lateral"][0].other == "probe.tilt"
    assert of["contact.lateral"][0].cosine > ASSUMED.advice.one_direction
    assert "indistinguishable" in of["contact.lateral"][0].words
    assert of["contact.lateral"][1].cosine < 0.2, "nothing else here pushes sideways"
    assert of["sensor.gain"][0].other == "tissue.modulus"
    assert 0.8 < of["sensor.gain"][0].cosine < ASSUMED.advice.one_direction, "the inertia of the strokes tells them"
    assert of["sensor.gain"][0].told_at_snr > of["sensor.gain"][1].told_at_snr


def test_a_user_effect_is_compared_with_the_library() -> None:
    known = load_effects(EXAMPLE)
    (pulse,) = user_effects(known)
    assert pulse.id == "tissue.pulse"
    similar = similar_effects([pulse], nominal(), {name: known[name] for name in (*FEW, pulse.id)})
    assert {one.other for one in similar} <= set(FEW)
    assert max(one.cosine for one in similar) < 0.5


def test_effects_are_compared_on_a_cell_whose_modulus_is_not_known() -> None:
    """Almost all of an effect in proportion to the force is then within specification, and rounding is not small beside the rest."""
    cell = cell_from({"tolerances": {"youngs_modulus": 1.0}}, "a first cell")
    library = {name: EFFECTS[name] for name in ("tissue.thickness", "robot.compliance", "sensor.gain", "tissue.modulus")}
    similar = similar_effects([EFFECTS["tissue.thickness"]], cell, library)
    assert similar[0].other == "robot.compliance"
    assert 0.9 < similar[0].cosine <= 1.0


def test_the_page_quotes_the_words_that_are_printed() -> None:
    text = (ROOT / "docs" / "diagnosis.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^ effect +similar +cosine +what\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    for row in block.splitlines():
        effect, other, cosine, words = re.split(r" {2,}", row.strip())
        snr = float((re.findall(r"SNR (\d+)", words) or [0])[0])
        assert words == Similarity(effect, other, float(cosine), snr).words
