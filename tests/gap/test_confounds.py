"""What effects could be mistaken for, before anything is recorded."""

from pathlib import Path

from palpd.cell_file import nominal
from palpd.effects import EFFECTS, load_effects, own_effects
from palpd.gap.confounds import ONE_DIRECTION, confounds

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "my_effect.py"
FEW = ("sensor.gain", "tissue.modulus", "robot.lag", "cable.friction", "contact.lateral", "probe.tilt")


def test_a_tilt_is_like_a_lateral_force_and_a_gain_like_a_modulus() -> None:
    library = {name: EFFECTS[name] for name in FEW}
    likes = confounds([EFFECTS["sensor.gain"], EFFECTS["contact.lateral"]], nominal(), library)
    of = {effect: [like for like in likes if like.effect == effect] for effect in ("sensor.gain", "contact.lateral")}
    assert of["contact.lateral"][0].other == "probe.tilt"
    assert of["contact.lateral"][0].cosine > ONE_DIRECTION
    assert "not to be told apart" in of["contact.lateral"][0].words
    assert of["contact.lateral"][1].cosine < 0.2, "nothing else here pushes sideways"
    assert of["sensor.gain"][0].other == "tissue.modulus"
    assert 0.8 < of["sensor.gain"][0].cosine < ONE_DIRECTION, "the inertia of the strokes tells them"
    assert of["sensor.gain"][0].told_at_snr > of["sensor.gain"][1].told_at_snr


def test_a_users_own_effect_is_compared_with_the_library() -> None:
    known = load_effects(EXAMPLE)
    (own,) = own_effects(known)
    assert own.id == "tissue.pulse"
    likes = confounds([own], nominal(), {name: known[name] for name in (*FEW, own.id)})
    assert {like.other for like in likes} <= set(FEW)
    assert max(like.cosine for like in likes) < 0.5
