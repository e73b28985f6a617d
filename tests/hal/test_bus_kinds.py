"""The buses of the tests carry what a bus must carry, so that what fails on them is not theirs."""

import can
import pytest
from bus_kinds import KINDS, both_ends


@pytest.fixture(params=KINDS, ids=str)
def kind(request):
    request.param.skip_unless_it_works()
    return request.param


@pytest.mark.long
def test_every_length_arrives_both_ways_and_in_order(kind):
    with both_ends(kind) as ends:
        for here, there in (ends, ends[::-1]):
            frames = [(0x080 + 0x11 * size, bytes(range(size))) for size in range(9)]
            for identifier, data in frames:
                here.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
            heard = [there.recv(2.0) for _ in frames]
            assert [(frame.arbitration_id, bytes(frame.data)) for frame in heard] == frames
            echoes = [here.recv(0.02) for _ in frames]
            assert all(echoes) if kind.echoes else not any(echoes)


def test_a_second_bus_of_the_kind_is_another_bus(kind):
    with both_ends(kind) as (here, _), both_ends(kind) as (_, stranger):
        here.send(can.Message(arbitration_id=0x123, data=b"\x01", is_extended_id=False))
        assert stranger.recv(0.1) is None
