"""What pages say of the scored batches in the repository is what these show."""

from benchmarks.blind_errors import OF_THE_TABLES, lines
from benchmarks.blind_errors import PAGE as DIAGNOSIS
from benchmarks.neighbours import BATCHES, PAGE, batches_in, table, ways, with_one_effect


def test_the_page_is_what_the_batches_show() -> None:
    _, outcomes = batches_in(BATCHES)
    assert "\n".join(table(with_one_effect(outcomes))) in PAGE.read_text(encoding="utf-8")


def test_the_errors_of_the_blind_check_are_what_the_batches_show() -> None:
    outcomes = [outcome for file in OF_THE_TABLES for outcome in batches_in(file)[1]]
    assert len(outcomes) == 2850
    assert "\n".join(lines(outcomes)) in DIAGNOSIS.read_text(encoding="utf-8")


def test_an_effect_that_is_named_instead_counts_as_such_unless_its_group_holds_the_planted_one() -> None:
    _, outcomes = batches_in(BATCHES)
    (cell, *_) = with_one_effect(outcomes)
    (planted,) = cell["planted"]
    other = "probe.mass" if planted != "probe.mass" else "cable.spring"
    assert ways({**cell, "named": [planted], "groups": [[planted]]}, other) == set()
    assert ways({**cell, "named": [planted, other], "groups": [[planted], [other]]}, other) == {"beside"}
    assert ways({**cell, "named": [other], "groups": [[other]]}, other) == {"instead"}
    assert ways({**cell, "named": [other], "groups": [[other, planted]]}, other) == {"instead", "in its group"}
