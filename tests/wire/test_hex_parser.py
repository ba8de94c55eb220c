"""The frame parser against golden bytes and against every way of spoiling a stream."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hw.hex_frames import ANSWER, CAPACITY, COUNTS_AT_CAPACITY, DATA, SERIAL_NUMBER, FrameParser, RawFrames

# NO_ERROR as captured from a DAQ; the others hold what a 200 N class sensor reported, written out byte by byte
READING = bytes.fromhex("aa 07 08 10 23 1b 00 00 ff 05 00 25 fe 52 00 5f fc 63 00 06 05 44")
CAPACITIES = bytes.fromhex("aa 01 5e 0e 00 c8 00 c8 00 c8 27 10 27 10 19 64 00 c8 05 22")
COUNTS = bytes.fromhex("aa 01 c2 0e 20 48 20 1e 05 f8 2b fb 2a 44 24 64 06 78 05 b8")
NO_ERROR = bytes.fromhex("aa 00 50 01 00 00 fb")

LIMITS_XE_200N = (24792.0, 24666.0, 4584.0, 33777.0, 32460.0, 27948.0)  # three times those counts


def frame(counter: int, counts: tuple[int, ...] = (0,) * 6, status: int = 0) -> bytes:
    body = DATA + struct.pack(">HH6h", counter & 0xFFFF, status, *counts)
    return body + sum(body).to_bytes(2, "big")


def parse(*pieces: bytes, parser: FrameParser | None = None) -> RawFrames:
    parser = parser or FrameParser()
    parts = [*(parser.feed(piece) for piece in pieces), parser.flush()]
    return RawFrames(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def counters(*pieces: bytes, parser: FrameParser | None = None) -> list[int]:
    return parse(*pieces, parser=parser).counter.tolist()


def test_a_frame_of_a_real_sensor_is_read() -> None:
    frames = parse(READING)
    assert frames.counter.tolist() == [8987]
    assert frames.status.tolist() == [0]
    assert frames.counts.tolist() == [[-251, 37, -430, 95, -925, 6]]


def test_answers_and_registers_between_frames_are_packets_and_no_frames() -> None:
    parser = FrameParser()
    serial_number = SERIAL_NUMBER + b"IRE00042"
    serial_number += sum(serial_number).to_bytes(2, "big")
    stream = frame(1) + NO_ERROR + frame(2) + CAPACITIES + COUNTS + serial_number + frame(3)
    assert counters(stream, parser=parser) == [1, 2, 3]
    assert [packet.header for packet in parser.packets] == [ANSWER, CAPACITY, COUNTS_AT_CAPACITY, SERIAL_NUMBER]
    assert parser.packets[0].payload == b"\0"
    assert struct.unpack(">7H", parser.packets[1].payload) == (200, 200, 200, 10000, 10000, 6500, 200)
    assert struct.unpack(">7H", parser.packets[2].payload) == (8264, 8222, 1528, 11259, 10820, 9316, 1656)
    assert parser.packets[3].payload == b"IRE00042"
    assert parser.rejected == 0


@pytest.mark.parametrize("bit", range(176))
def test_one_flipped_bit_never_passes(bit: int) -> None:
    spoilt = bytearray(READING)
    spoilt[bit // 8] ^= 1 << bit % 8
    parser = FrameParser()
    assert counters(frame(8986), bytes(spoilt), frame(8988), parser=parser) == [8986, 8988]
    assert parser.rejected == 1
    assert parser.lost == 1


def test_a_start_in_the_middle_of_a_frame_costs_that_frame_only() -> None:
    assert counters(frame(1)[9:] + frame(2) + frame(3)) == [2, 3]


def test_a_false_header_does_not_eat_the_frame_behind() -> None:
    for cut in range(1, 22):
        assert counters(frame(1)[:cut] + frame(2)) == [2]


def test_a_window_whose_sum_fits_by_chance_does_not_eat_the_frame_behind() -> None:
    """A frame cut after 19 bytes whose sum is 0x0708: with the next header as its sum it looks whole."""
    body = bytearray(frame(1)[:9]) + bytearray(10)
    filler = 0x0708 - 0xAA - sum(body)  # spread over the bytes of the wrench
    for i in range(9, 19):
        body[i] = min(255, filler)
        filler -= body[i]
    assert filler == 0
    assert counters(frame(0), bytes(body) + frame(2), frame(3), frame(4)) == [0, 2, 3, 4]


def test_header_bytes_inside_a_payload_are_payload() -> None:
    wrench = (struct.unpack(">h", b"\xaa\x07")[0], 0x0810, 5, 0, 0, 0)
    assert counters(frame(7, wrench) + frame(8, wrench)) == [7, 8]
    answer_inside = struct.unpack(">6h", NO_ERROR + bytes(5))
    parser = FrameParser()
    assert counters(frame(7, answer_inside) + frame(8), parser=parser) == [7, 8]
    assert not parser.packets


def test_header_bytes_inside_a_payload_are_payload_also_before_many_frames_at_once() -> None:
    parser = FrameParser(bulk_frames=4)
    ambiguous = frame(20, struct.unpack(">6h", DATA + bytes(8)))
    many = b"".join(frame(counter) for counter in range(21, 40))
    first = b"".join(frame(counter) for counter in range(10, 20))
    assert counters(first, ambiguous + many, parser=parser) == list(range(10, 40))
    assert parser.rejected == 0


def test_one_byte_of_a_header_inside_a_payload_delays_nothing() -> None:
    parser = FrameParser()
    parser.feed(frame(1))
    assert parser.feed(frame(2, (-86, 0, 0, 0, 0, 0))).counter.tolist() == [2]  # 0xffaa


def test_rejects_are_counted_by_frames_worth_of_bytes() -> None:
    parser = FrameParser()
    counters(frame(1) + bytes(5) + frame(2) + bytes(44) + frame(3), parser=parser)
    assert parser.rejected == 1 + 2
    parser = FrameParser()
    for _ in range(100):
        parser.feed(bytes(22))
    assert parser.rejected == 100  # a wrong device or baud rate shows as a storm


def test_what_stands_before_the_first_frame_is_counted_from_the_first_byte() -> None:
    parser = FrameParser()
    counters(bytes(23) + frame(1), parser=parser)
    assert parser.rejected == 2
    assert parser.frames == 1


def test_unasked_packets_do_not_pile_up() -> None:
    parser = FrameParser()
    counters(NO_ERROR * 20, parser=parser)
    assert len(parser.packets) == 16


# judging


def test_without_a_filter_every_value_is_possible_and_handed_over_at_once() -> None:
    parser = FrameParser()
    parser.feed(frame(1, (32767,) * 6))
    assert parser.feed(frame(2, (-32768,) * 6)).counter.tolist() == [2]


def steady(parser: FrameParser, first: int = 100, count: int = 20, wrench: tuple[int, ...] = (-251, 37, -430, 95, -925, 6)) -> list[int]:
    return counters(*(frame(i, wrench) for i in range(first, first + count)), parser=parser)


def test_swapped_counter_bytes_are_seen_by_the_counter() -> None:
    for counter in range(256, 66000, 77):
        parser = FrameParser()
        spoilt = bytearray(frame(counter))
        spoilt[4], spoilt[5] = spoilt[5], spoilt[4]
        good = [(counter + i) & 0xFFFF for i in (-2, -1, 1, 2)]
        if spoilt == frame(counter):
            continue
        assert (
            counters(frame(counter - 2), frame(counter - 1), bytes(spoilt), frame(counter + 1), frame(counter + 2), parser=parser) == good
        )
        assert parser.implausible == 1


def test_swapped_bytes_of_fz_are_seen_by_the_size_of_the_jump() -> None:
    parser = FrameParser(1, 150.0, LIMITS_XE_200N)
    spoilt = bytearray(frame(120, (-251, 37, -430, 95, -925, 6)))
    spoilt[12], spoilt[13] = spoilt[13], spoilt[12]  # -430 counts become 21246, 2.8 kN
    steady(parser)
    assert counters(bytes(spoilt), *(frame(i, (-251, 37, -430, 95, -925, 6)) for i in (121, 122)), parser=parser) == [121, 122]
    assert parser.implausible == 1


def test_a_step_that_stays_is_no_fault() -> None:
    parser = FrameParser(1, 15.0, LIMITS_XE_200N)  # at 15 Hz impossible in one sample, but so it is
    steady(parser, wrench=(0,) * 6)
    assert counters(*(frame(i, (0, 0, 1500, 0, 0, 0)) for i in range(120, 125)), parser=parser) == [*range(120, 125)]
    assert parser.implausible == 0


def test_a_knock_that_the_filter_lets_through_is_handed_over_at_once() -> None:
    parser = FrameParser(1, 150.0, LIMITS_XE_200N)
    steady(parser, wrench=(0,) * 6)
    assert parser.feed(frame(120, (0, 0, -1500, 0, 0, 0))).counter.tolist() == [120]


def test_an_overloaded_frame_is_not_judged_by_size() -> None:
    parser = FrameParser(1, 15.0, LIMITS_XE_200N)
    steady(parser, wrench=(0,) * 6)
    assert parser.feed(frame(120, (0, 0, 30000, 0, 0, 0), status=1 << 7)).counter.tolist() == [120]


def test_a_restarted_counter_is_followed() -> None:
    parser = FrameParser()
    steady(parser)
    assert counters(frame(0), frame(1), frame(2), parser=parser) == [0, 1, 2]


def test_a_gap_of_half_the_range_is_no_gap_but_another_counter() -> None:
    for step, lost in ((0x7FFF, 0x7FFE), (0x8000, 0)):
        parser = FrameParser()
        assert counters(frame(0), frame(step), parser=parser) == [0, step]
        assert parser.lost == lost


def test_after_a_frame_that_was_thrown_away_the_next_comes_at_once_and_only_the_missing_are_lost() -> None:
    parser = FrameParser()
    parser.feed(frame(300) + frame(301))
    spoilt = bytearray(frame(302))
    spoilt[4], spoilt[5] = spoilt[5], spoilt[4]
    assert parser.feed(bytes(spoilt)).counter.tolist() == []
    assert parser.feed(frame(303)).counter.tolist() == [303]
    assert (parser.implausible, parser.lost) == (1, 0)
    parser.feed(bytes(spoilt) + frame(306) + frame(307))
    assert (parser.implausible, parser.lost) == (2, 1)


@pytest.mark.parametrize(
    ("sent", "kept"),
    [((10, 12, 12), [10, 12]), ((10, 10, 11), [10, 11]), ((10, 12, 11), [10, 11]), ((10, 12, 13), [10, 12, 13]), ((10, 9, 11), [10, 11])],
)
def test_of_two_that_contradict_each_other_the_one_that_continues_is_kept(sent: tuple[int, ...], kept: list[int]) -> None:
    assert counters(*map(frame, sent)) == kept


def test_a_frame_without_its_last_byte_is_whole_if_the_next_begins_with_it() -> None:
    counts = next((k, 0, 0, 0, 0, 0) for k in range(256) if frame(5, (k, 0, 0, 0, 0, 0))[-1] == 0xAA)
    assert counters(frame(4) + frame(5, counts)[:-1] + frame(6) + frame(7)) == [4, 5, 6, 7]


@pytest.mark.parametrize(("jump", "at_once"), [(2790, True), (2805, False), (-2790, True), (-2805, False)])
def test_a_value_may_go_61_percent_of_the_way_to_the_limit_in_a_millisecond(jump: int, at_once: bool) -> None:
    """1 - exp(-2π 150 Hz 1 ms) = 0.610 of 4584 counts are 2797."""
    parser = FrameParser(1, 150.0, LIMITS_XE_200N)
    steady(parser, wrench=(0,) * 6)
    assert parser.feed(frame(120, (0, 0, jump, 0, 0, 0))).counter.tolist() == ([120] if at_once else [])


def test_what_is_possible_grows_with_the_time_between() -> None:
    """1000 counts are too far for one millisecond behind 15 Hz, and not for six."""
    for counter, kept in ((120, [121, 122]), (125, [125, 126, 127])):
        parser = FrameParser(1, 15.0, LIMITS_XE_200N)
        steady(parser, wrench=(0,) * 6)
        last = (frame(counter + 1), frame(counter + 2))
        assert counters(frame(counter, (0, 0, 1000, 0, 0, 0)), *last, parser=parser) == kept


def test_a_frame_behind_an_overloaded_one_is_not_judged_by_size() -> None:
    parser = FrameParser(1, 15.0, LIMITS_XE_200N)
    steady(parser, wrench=(0,) * 6)
    parser.feed(frame(120, (0, 0, 30000, 0, 0, 0), status=1 << 7))
    assert parser.feed(frame(121)).counter.tolist() == [121]


def test_a_stuck_counter_is_handed_over_for_others_to_judge() -> None:
    assert counters(*[frame(5)] * 4) == [5, 5, 5, 5]


def test_frames_out_of_order_are_thrown_away() -> None:
    """As in a capture of two programs reading one port: 8987 9057 9067 9037 9107 ..."""
    parser = FrameParser(10)
    assert counters(*map(frame, (8987, 9057, 9067, 9037, 9107, 9117)), parser=parser) == [8987, 9057, 9067, 9107, 9117]


@pytest.mark.parametrize("step", [1, 2, 8, 10, 100])
def test_the_counter_step_is_the_speed_byte_and_gaps_are_counted(step: int) -> None:
    parser = FrameParser(step)
    sent = [i * step & 0xFFFF for i in range(65000 // step, 67000 // step)]
    kept = sent[:5] + sent[8:]
    assert counters(*map(frame, kept), parser=parser) == kept
    assert parser.lost == 3


# properties

wrenches = st.tuples(*[st.integers(-32768, 32767)] * 6)
garbage = st.binary(max_size=40)
headers = st.sampled_from([b"\xaa", b"\xaa\x07", DATA, ANSWER, CAPACITY, b"\xaa\x07\x08\x0a", NO_ERROR])


@st.composite
def spoilt_streams(draw: st.DrawFn) -> tuple[bytes, list[int]]:
    """A stream with frames whole, cut short, with a byte dropped or with anything between; and the counters of the whole ones."""
    counter = draw(st.integers(0, 65535))
    stream, whole = b"", []
    for _ in range(draw(st.integers(1, 25))):
        counter = counter + 1 & 0xFFFF
        sent = frame(counter, draw(wrenches))
        match draw(st.integers(0, 7)):
            case 0:
                stream += sent[: draw(st.integers(1, 21))]
            case 1:
                drop = draw(st.integers(0, 21))
                stream += sent[:drop] + sent[drop + 1 :]
            case 2:
                stream += draw(garbage) + sent
                whole.append(counter)
            case 3:
                stream += draw(headers) + draw(garbage) + sent
                whole.append(counter)
            case _:
                stream += sent
                whole.append(counter)
    return stream, whole


@given(spoilt_streams())
@settings(max_examples=300, deadline=None)
def test_no_frame_that_was_sent_whole_is_lost(case: tuple[bytes, list[int]]) -> None:
    stream, whole = case
    parsed = iter(counters(stream))
    assert all(counter in parsed for counter in whole)  # in this order


@given(spoilt_streams(), st.lists(st.integers(1, 60), max_size=60), st.integers(1, 4))
@settings(max_examples=300, deadline=None)
def test_results_depend_neither_on_the_cuts_nor_on_the_fast_way(case: tuple[bytes, list[int]], cuts: list[int], bulk_frames: int) -> None:
    stream, _ = case
    careful = FrameParser(1, 150.0, LIMITS_XE_200N, bulk_frames=1 << 30)
    fast = FrameParser(1, 150.0, LIMITS_XE_200N, bulk_frames=bulk_frames)
    pieces, at = [], 0
    for size in cuts:
        pieces.append(stream[at : at + size])
        at += size
    pieces.append(stream[at:])
    one, other = parse(*pieces, parser=careful), parse(stream, parser=fast)
    for mine, yours in zip(one, other, strict=True):
        np.testing.assert_array_equal(mine, yours)
    assert (careful.rejected, careful.lost, careful.implausible) == (fast.rejected, fast.lost, fast.implausible)
    assert list(careful.packets) == list(fast.packets)


@given(st.integers(0, 65535), st.lists(wrenches, min_size=20, max_size=80), st.sets(st.integers(0, 79), max_size=8))
@settings(max_examples=100, deadline=None)
def test_the_fast_way_judges_long_runs_as_the_careful_one(first: int, forces: list[tuple[int, ...]], missing: set[int]) -> None:
    stream = b"".join(frame(first + i, force) for i, force in enumerate(forces) if i not in missing)
    careful, fast = (FrameParser(1, 150.0, LIMITS_XE_200N, bulk_frames=n) for n in (1 << 30, 4))
    for mine, yours in zip(parse(stream, parser=careful), parse(stream, parser=fast), strict=True):
        np.testing.assert_array_equal(mine, yours)
    assert (careful.rejected, careful.lost) == (fast.rejected, fast.lost)


@given(st.binary(max_size=500), st.integers(0, 65000))
@settings(max_examples=200, deadline=None)
def test_after_any_noise_the_next_frames_are_found_without_delay(noise: bytes, counter: int) -> None:
    parser = FrameParser()
    parser.feed(noise)
    before = parser.frames
    parser.feed(frame(counter))
    parser.feed(frame(counter + 1))
    assert parser.frames > before


def test_every_swap_that_changes_an_axis_by_more_than_the_filter_lets_through_is_seen() -> None:
    rest = np.array([-251, 37, -430, 95, -925, 6])
    rng = np.random.default_rng(1)
    seen = sent = 0
    for _ in range(400):
        parser = FrameParser(1, 150.0, LIMITS_XE_200N)
        noisy = [tuple((rest + rng.integers(-2, 3, 6)).tolist()) for _ in range(5)]
        at = 8 + 2 * int(rng.integers(0, 6))
        spoilt = bytearray(frame(3, noisy[2]))
        spoilt[at], spoilt[at + 1] = spoilt[at + 1], spoilt[at]
        change = np.abs(np.frombuffer(spoilt, ">i2", 6, 8) - np.array(noisy[2])) / LIMITS_XE_200N
        if change.max() < 0.7:
            continue
        sent += 1
        counters(*(frame(i + 1, n) if i != 2 else bytes(spoilt) for i, n in enumerate(noisy)), parser=parser)
        seen += parser.implausible
    assert sent > 50
    assert seen == sent
