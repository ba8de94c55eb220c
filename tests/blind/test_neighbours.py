"""The page of effects that are taken for their neighbours is what the batches beside its command show."""

from benchmarks.neighbours import BATCHES, PAGE, batches_in, table, ways, with_one_effect


def test_the_page_is_what_the_batches_show() -> None:
    _, outcomes = batches_in(BATCHES)
    lines = table(with_one_effect(outcomes))
    assert "\n".join(lines) in PAGE.read_text(encoding="utf-8")


def test_an_effect_that_is_named_instead_counts_as_such_unless_its_group_holds_the_planted_one() -> None:
    _, outcomes = batches_in(BATCHES)
    (cell, *_) = with_one_effect(outcomes)
    (planted,) = cell["planted"]
    other = "probe.mass" if planted != "probe.mass" else "cable.spring"
    assert ways({**cell, "named": [planted], "groups": [[planted]]}, other) == set()
    assert ways({**cell, "named": [planted, other], "groups": [[planted], [other]]}, other) == {"beside"}
    assert ways({**cell, "named": [other], "groups": [[other]]}, other) == {"instead"}
    assert ways({**cell, "named": [other], "groups": [[other, planted]]}, other) == {"instead", "in its group"}
