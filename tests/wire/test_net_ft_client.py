"""Bytes of a Net F/T at the driver's end: requests, records, sequence numbers and the page. No emulator takes part."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hw.ati_net_ft import (
    DIGITAL,
    GAGES,
    LINK,
    MONITOR,
    NETWORK,
    OTHER,
    RECORD,
    SATURATED,
    SETTINGS,
    START_REALTIME,
    STATUS_BITS,
    STOP,
    RecordParser,
    read_page,
    request,
    status_word,
)
from palpd.errors import SensorError

GOLDEN = bytes.fromhex("0000000a 00000046 00000000 000f4240 fff0bdc0 fe363c80 00000001 ffffffff 00000000")
"""Record 10 at sample 70: 1 N, -1 N and -30 N at a million counts a newton, and torques of 1, -1 and 0 counts."""
PAGE = b"""<?xml version="1.0" encoding="utf-8"?>
<netft><prodname>Net F/T</prodname><runstat>0x00000000</runstat><runrate>7000</runrate><setuserfilter>3</setuserfilter>
<cfgcalsn>FT12345</cfgcalsn><scfgfu>N</scfgfu><scfgtu>Nm</scfgtu><cfgcpf>1000000</cfgcpf><cfgcpt>1000000</cfgcpt>
<comrdte>Enabled</comrdte><comrdtrate>1000</comrdtrate></netft>"""


def record(sequence: int, ft_sequence: int | None = None, status: int = 0) -> bytes:
    return RECORD.pack(sequence, sequence * 7 & 0xFFFFFFFF if ft_sequence is None else ft_sequence, status, 1, 2, 3, 4, 5, 6)


def test_requests_have_the_bytes_of_the_protocol() -> None:
    assert request(STOP) == bytes.fromhex("1234 0000 00000000")
    assert request(START_REALTIME) == bytes.fromhex("1234 0002 00000000")


def test_a_record_is_read_from_its_bytes() -> None:
    got = RecordParser().feed(GOLDEN)
    assert got is not None
    assert (got.sequence, got.ft_sequence, got.status) == (10, 70, 0)
    assert got.counts == (1_000_000, -1_000_000, -30_000_000, 1, -1, 0)


@pytest.mark.parametrize("length", [0, 1, 35, 37, 72])
def test_a_datagram_of_another_length_is_rejected(length: int) -> None:
    parser = RecordParser()
    assert parser.feed(b"\x01" * length) is None
    assert parser.rejected == 1


def test_records_that_never_came_are_counted() -> None:
    parser = RecordParser()
    assert all(parser.feed(record(number)) for number in (5, 6, 10))
    assert parser.rejected == 3


def test_a_record_that_was_overtaken_is_left_out_and_counted_once() -> None:
    parser = RecordParser()
    assert [parser.feed(record(number)) is not None for number in (5, 7, 6, 8)] == [True, True, False, True]
    assert parser.rejected == 1


def test_a_repeated_record_is_left_out() -> None:
    parser = RecordParser()
    assert [parser.feed(record(number)) is not None for number in (5, 5, 6)] == [True, False, True]
    assert parser.rejected == 0


def test_sequence_numbers_wrap() -> None:
    parser = RecordParser()
    assert all(parser.feed(record(number & 0xFFFFFFFF)) for number in (2**32 - 2, 2**32 - 1, 2**32, 2**32 + 1))
    assert parser.rejected == 0


def test_a_record_whose_samples_stand_still_is_rejected() -> None:
    parser = RecordParser()
    assert parser.feed(record(1, 700))
    assert parser.feed(record(2, 700)) is None
    assert parser.rejected == 1


@given(st.lists(st.binary(max_size=80) | st.integers(0, 2**32 - 1).map(record), max_size=30))
def test_the_sequence_of_accepted_records_only_grows_whatever_comes(datagrams: list[bytes]) -> None:
    parser = RecordParser()
    accepted = [got for got in map(parser.feed, datagrams) if got is not None]
    assert all(0 < (b.sequence - a.sequence) & 0xFFFFFFFF < 1 << 31 for a, b in pairwise(accepted))
    assert parser.rejected >= sum(len(datagram) != 36 for datagram in datagrams)


@pytest.mark.parametrize(
    ("status", "word"),
    [
        (0, 0), (0x80020000, SATURATED), (0x80010000, MONITOR), (0x90000000, GAGES), (0x80000004, GAGES), (0xC0000000, DIGITAL),
        (0x81000000, SETTINGS), (0x80100000, NETWORK), (0x88000000, LINK), (0x80000000, OTHER), (0x1, OTHER),
        (0x88020000, SATURATED | LINK),
    ],
)  # fmt: skip
def test_status_bits_become_bits_of_the_frames_word(status: int, word: int) -> None:
    assert status_word(status) == word


@given(st.integers(1, 2**32 - 1))
def test_no_status_of_the_box_passes_for_healthy(status: int) -> None:
    assert 0 < status_word(status) < 1 << 16


def test_no_bit_of_the_box_stands_twice_in_the_table() -> None:
    masks = [mask for mask, _, _ in STATUS_BITS]
    assert sum(masks) == sum(1 << bit for bit in range(32) if any(mask >> bit & 1 for mask in masks))


def test_the_page_is_read() -> None:
    page = read_page(PAGE, "box")
    assert (page.serial_number, page.counts_per_N, page.rate_Hz, page.internal_rate_Hz) == ("FT12345", 1e6, 1000.0, 7000.0)
    assert (page.filter_cutoff_Hz, page.status) == (152.0, 0)
    assert read_page(PAGE.replace(b"Nm", b"N-m"), "box") == page


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (b"<scfgfu>N<", b"<scfgfu>lbf<", "is set to lbf and Nm, expected N and Nm"),
        (b"<scfgtu>Nm<", b"<scfgtu>N-mm<", "is set to N and N-mm, expected N and Nm"),
        (b"Enabled", b"Disabled", "has RDT Disabled; enable it"),
        (b"cfgcpf", b"cfgxxx", "it has no 'cfgcpf'"),
        (b">1000000</cfgcpt", b">many</cfgcpt", "no page /netftapi2.xml of a Net F/T"),
        (b">1000000</cfgcpf", b">0</cfgcpf", "its calibration is missing"),
        (b"setuserfilter>3", b"setuserfilter>99", "no page"),
        (b"0x00000000", b"fine", "no page"),
        (b"</netft>", b"", "no page"),
    ],
)
def test_a_page_that_will_not_do_is_refused_in_one_sentence(old: bytes, new: bytes, sentence: str) -> None:
    with pytest.raises(SensorError, match=sentence) as raised:
        read_page(PAGE.replace(old, new), "box")
    assert "\n" not in str(raised.value)
