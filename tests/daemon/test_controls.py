"""One operator holds the controls; the lease ends by release, by force, or where it is not renewed."""

import pytest

from palpd.daemon.controls import LEASE_S, Controls
from palpd.errors import BadInput, Refused


def test_while_nobody_holds_the_controls_each_request_is_carried_out() -> None:
    controls = Controls()
    controls.require(None, 0.0)
    assert controls.holder(0.0) is None


def test_others_are_refused_with_the_name_of_who_holds_them() -> None:
    controls = Controls()
    token, loser = controls.take("Anna", False, 0.0)
    assert loser is None
    controls.require(token, 1.0)
    for other in (None, "guessed"):
        with pytest.raises(Refused, match=r"Anna holds the controls|never yours"):
            controls.require(other, 1.0)
    with pytest.raises(Refused, match="Anna holds the controls"):
        controls.take("Ben", False, 1.0)


def test_a_lease_ends_where_it_is_not_renewed_and_its_holder_learns_why() -> None:
    controls = Controls()
    token, _ = controls.take("Anna", False, 0.0)
    controls.require(token, 0.9 * LEASE_S)
    assert controls.holder(1.8 * LEASE_S) == "Anna", "a request renews it"
    assert controls.holder(1.9 * LEASE_S + 0.01) is None
    controls.require(None, 2.0 * LEASE_S)
    with pytest.raises(Refused, match=r"not renewed within 10 s; take them again"):
        controls.require(token, 2.0 * LEASE_S)


def test_force_takes_them_and_says_from_whom_and_the_loser_learns_by_whom() -> None:
    controls = Controls()
    first, _ = controls.take("Anna", False, 0.0)
    second, loser = controls.take("Ben", True, 1.0)
    assert loser == "Anna"
    assert controls.holder(1.0) == "Ben"
    with pytest.raises(Refused, match="were taken by Ben"):
        controls.require(first, 1.0)
    controls.require(second, 1.0)


def test_released_they_are_free_and_a_late_release_changes_nothing() -> None:
    controls = Controls()
    token, _ = controls.take("Anna", False, 0.0)
    controls.release(token, 1.0)
    second, _ = controls.take("Ben", False, 2.0)
    with pytest.raises(Refused, match="were released"):
        controls.release(token, 2.0)
    assert controls.holder(2.0) == "Ben"
    controls.release(second, 2.0)
    with pytest.raises(Refused, match="nobody holds"):
        controls.release(None, 3.0)


@pytest.mark.parametrize("name", [None, "", "  ", 3, "x" * 65, "a\nb", "\x1b[2J"])
def test_a_name_that_is_none_is_refused(name: object) -> None:
    with pytest.raises(BadInput, match="printable letters"):
        Controls().take(name, False, 0.0)
