"""Bytes of a Net F/T at the emulator's end, written out by hand. No driver takes part."""

import selectors
import socket
from collections.abc import Iterator

import numpy as np
import pytest

from hw.emulators.net_ft import UNLOADED, NetBox

HOST, HTTP_PORT = "127.0.9.91", 18091
START, STOP, ONE, BIAS = (bytes.fromhex(text) for text in ("1234000200000000", "1234000000000000", "1234000100000001", "1234004200000000"))
CLIENT = (HOST, 4000)


@pytest.fixture
def box() -> Iterator[NetBox]:
    network = selectors.DefaultSelector()
    box = NetBox(HOST, HTTP_PORT, network)
    yield box
    box.close()
    network.close()


def streamed(box: NetBox, wrench: tuple[float, ...] = (0.0,) * 6, now_s: float = 0.0) -> list[bytes]:
    """The datagrams of the next millisecond."""
    datagrams: list[bytes] = []
    genuine = box.datagrams
    box.datagrams = lambda at_s: datagrams.extend(genuine(at_s)) or []  # type: ignore[method-assign]
    box.sample(np.array(wrench), now_s)
    del box.datagrams
    return datagrams


def test_nothing_is_sent_before_a_request(box: NetBox) -> None:
    assert streamed(box) == []


def test_a_record_has_these_bytes(box: NetBox) -> None:
    """Sample 7 of record 1; the unloaded counts and 2 N more on Fx, 30 N less on Fz, 1 mNm on Tx."""
    box.obey(START, CLIENT)
    (record,) = streamed(box, (2.0, 0.0, -30.0, 0.001, 0.0, 0.0))
    assert record == bytes.fromhex("00000001 00000007 00000000 00319750 fff355d0 ff168a60 0000a410 ffffd120 00001388")
    assert 2_000_000 + UNLOADED[0] == 0x00319750


def test_a_stream_goes_on_until_it_is_stopped(box: NetBox) -> None:
    box.obey(START, CLIENT)
    assert [streamed(box)[0][3] for _ in range(3)] == [1, 2, 3]
    box.obey(STOP, CLIENT)
    assert streamed(box) == []


def test_a_single_record_is_one(box: NetBox) -> None:
    box.obey(ONE, CLIENT)
    assert [len(streamed(box)) for _ in range(3)] == [1, 0, 0]


def test_the_later_of_two_clients_is_served(box: NetBox) -> None:
    box.obey(START, CLIENT)
    box.obey(START, (HOST, 4001))
    assert box.client == (HOST, 4001)


@pytest.mark.parametrize("request_", [b"", b"1234", START + b"\0", b"\x12\x35" + START[2:]])
def test_what_is_no_request_is_ignored(box: NetBox, request_: bytes) -> None:
    box.obey(request_, CLIENT)
    assert box.client is None


def test_a_bias_takes_the_present_counts_as_zero(box: NetBox) -> None:
    box.obey(START, CLIENT)
    streamed(box)
    box.obey(BIAS, CLIENT)
    assert streamed(box)[0][12:] == bytes(24)


def test_beyond_its_range_the_transducer_is_saturated(box: NetBox) -> None:
    box.obey(START, CLIENT)
    assert streamed(box, (0.0, 0.0, -290.0, 0.0, 0.0, 0.0))[0][8:12] == bytes.fromhex("80020000")


def test_faults_lose_swap_and_cut_records(box: NetBox) -> None:
    box.obey(START, CLIENT)
    box.faults.lost = 1
    assert streamed(box) == []
    box.faults.swapped = 1
    assert streamed(box) == []
    assert [datagram[3] for datagram in streamed(box)] == [3, 2]
    box.faults.cut = 1
    assert [len(datagram) for datagram in streamed(box)] == [35]
    box.faults.silent_until_s = 5.0
    assert streamed(box, now_s=4.9) == []
    assert streamed(box, now_s=5.0)[0][3] == 6


def test_the_page_names_counts_units_rate_and_filter(box: NetBox) -> None:
    answer = box.answer(b"GET /netftapi2.xml HTTP/1.1\r\nHost: box\r\n\r\n")
    head, _, page = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.0 200 OK\r\n")
    assert b"Content-Length: %d" % len(page) in head
    for line in (b"<cfgcpf>1000000</cfgcpf>", b"<scfgfu>N</scfgfu>", b"<comrdtrate>1000</comrdtrate>", b"<runstat>0x00000000</runstat>"):
        assert line in page
    assert box.answer(b"GET / HTTP/1.1\r\n\r\n").startswith(b"HTTP/1.0 404")


def test_requests_and_visitors_come_over_real_sockets(box: NetBox) -> None:
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.sendto(START, (HOST, 49152))
    visitor = socket.create_connection((HOST, HTTP_PORT), 2.0)
    visitor.sendall(b"GET /netftapi2.xml HTTP/1.1\r\n\r\n")
    for _ in range(20):
        for key, _ in box.network.select(0.05):
            key.data(0.0)
    box.sample(np.zeros(6), 0.0)
    client.settimeout(2.0)
    assert len(client.recv(100)) == 36
    assert visitor.recv(4096).startswith(b"HTTP/1.0 200")
    client.close()
    visitor.close()
