"""CiA 301 and 402 on the wire, byte by byte, and the SDO client."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given, strategies as st

from petrobot.services.comm.canopen import cia301 as canopen, cia402
from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import (
    AbortCode,
    DataType,
    Mapped,
    NmtCommand,
    NmtState,
    SdoAbortError,
    SdoClient,
    Transfer,
)
from petrobot.services.comm.canopen.cia402 import DriveCommand, DriveState
from tests.waiting import Limit

WRITTEN_OUT = [
    (canopen.nmt(NmtCommand.START), 0x000, "01 00"),
    (canopen.nmt(NmtCommand.ENTER_PREOPERATIONAL, 3), 0x000, "80 03"),
    (canopen.nmt(NmtCommand.RESET_NODE, 127), 0x000, "81 7f"),
    (canopen.SYNC, 0x080, ""),
    (canopen.heartbeat(5, NmtState.OPERATIONAL), 0x705, "05"),
    (canopen.heartbeat(5, NmtState.BOOT_UP), 0x705, "00"),
    (canopen.emergency(2, 0x8611, 0x21, b"\x07"), 0x082, "11 86 21 07 00 00 00 00"),
    (canopen.sdo_write_request(1, 0x6060, 0, b"\x08"), 0x601, "2f 60 60 00 08 00 00 00"),
    (canopen.sdo_write_request(1, 0x1017, 0, b"\x32\x00"), 0x601, "2b 17 10 00 32 00 00 00"),
    (
        canopen.sdo_write_request(1, 0x1016, 1, b"\xc8\x00\x7f\x00"),
        0x601,
        "23 16 10 01 c8 00 7f 00",
    ),
    (canopen.sdo_read_request(6, 0x6041, 0), 0x606, "40 41 60 00 00 00 00 00"),
    (canopen.sdo_write_reply(1, 0x6060, 0), 0x581, "60 60 60 00 00 00 00 00"),
    (canopen.sdo_read_reply(6, 0x6041, 0, b"\x37\x12"), 0x586, "4b 41 60 00 37 12 00 00"),
    (canopen.sdo_read_reply(6, 0x1000, 0, b"\x92\x01\x02\x00"), 0x586, "43 00 10 00 92 01 02 00"),
    (canopen.sdo_abort(0x581, 0x6041, 0, AbortCode.READ_ONLY), 0x581, "80 41 60 00 02 00 01 06"),
]


@pytest.mark.parametrize(("frame", "cob_id", "data"), WRITTEN_OUT)
def test_frames_byte_by_byte(frame: Frame, cob_id: int, data: str) -> None:
    assert frame == Frame(cob_id, bytes.fromhex(data))


def test_process_data_byte_by_byte() -> None:
    assert canopen.pdo_struct(cia402.RECEIVED).pack(0x000F, -1) == bytes.fromhex(
        "0f 00 ff ff ff ff"
    )
    assert canopen.pdo_struct(cia402.SENT).pack(0x1237, 1_000_000, -2) == bytes.fromhex(
        "37 12 40 42 0f 00 fe ff"
    )
    assert cia402.RECEIVED[1].entry == 0x607A0020
    assert cia402.SENT[2].entry == 0x60770010


def test_a_pdo_has_eight_bytes() -> None:
    with pytest.raises(ValueError, match="these objects need 12"):
        canopen.pdo_struct([Mapped(0x6064, 0, DataType.INTEGER32)] * 3)


def test_mapping_is_written_in_the_order_of_the_standard() -> None:
    steps = canopen.map_pdo(0x1400, 0x1600, 0x201, 1, cia402.RECEIVED)
    assert [(step.index, step.sub, step.value) for step in steps] == [
        (0x1400, 1, 0x80000201),
        (0x1400, 2, 1),
        (0x1600, 0, 0),
        (0x1600, 1, 0x60400010),
        (0x1600, 2, 0x607A0020),
        (0x1600, 0, 2),
        (0x1400, 1, 0x201),
    ]


@given(st.integers(0x081, 0x0FF), st.binary(max_size=8))
def test_emergencies_are_decoded_or_refused(cob_id: int, data: bytes) -> None:
    if len(data) != 8:
        with pytest.raises(ValueError, match="not an emergency"):
            canopen.parse_emergency(Frame(cob_id, data))
        return
    message = canopen.parse_emergency(Frame(cob_id, data))
    assert canopen.emergency(*message) == Frame(cob_id, data)


@given(st.binary(max_size=8))
def test_any_bytes_are_an_sdo_message_or_refused(data: bytes) -> None:
    try:
        message = canopen.parse_sdo(Frame(0x601, data))
    except ValueError:
        assert len(data) != 8
    except SdoAbortError as reason:
        assert reason.code == AbortCode.COMMAND
    else:
        assert (message.index, message.sub) == struct.unpack_from("<HB", data, 1)


@given(st.sampled_from(list(DataType)), st.integers(-(1 << 33), 1 << 33))
def test_values_fit_their_type_or_are_refused(kind: DataType, value: int) -> None:
    if kind is DataType.BOOLEAN:
        return
    bits = 8 * kind.size
    signed = kind.name.startswith("INTEGER")
    low, high = (-(1 << bits - 1), 1 << bits - 1) if signed else (0, 1 << bits)
    if low <= value < high:
        assert kind.unpack(kind.pack(value)) == value
    else:
        with pytest.raises(ValueError, match="does not fit"):
            kind.pack(value)


def test_client_writes_and_reads_one_after_another() -> None:
    client = SdoClient(4)
    client.begin(
        [Transfer(0x6060, 0, DataType.INTEGER8, 8), Transfer(0x6041, 0, DataType.UNSIGNED16)]
    )
    assert client.advance(0.0) == [canopen.sdo_write_request(4, 0x6060, 0, b"\x08")]
    assert client.advance(0.1) == []
    client.receive(canopen.sdo_write_reply(5, 0x6060, 0))  # of another node
    client.receive(canopen.sdo_write_reply(4, 0x6061, 0))  # of another object
    assert client.advance(0.2) == []
    client.receive(canopen.sdo_write_reply(4, 0x6060, 0))
    assert client.advance(0.2) == [canopen.sdo_read_request(4, 0x6041, 0)]
    client.receive(canopen.sdo_read_reply(4, 0x6041, 0, b"\x37\x02"))
    assert not client.busy
    assert client.results == {(0x6041, 0): 0x0237}
    assert client.failure == ""


def test_client_gives_up_after_its_timeout_and_reports_it() -> None:
    client = SdoClient(4, timeout=0.5)
    client.begin([Transfer(0x1000, 0, DataType.UNSIGNED32)])
    client.advance(1.0)
    assert client.advance(1.49) == []
    assert client.advance(1.5) == [canopen.sdo_abort(0x604, 0x1000, 0, AbortCode.TIMEOUT)]
    assert client.failure == "node 4: no answer from 0x1000:0 within 0.5 s"
    assert not client.busy


@pytest.mark.parametrize(
    ("reply", "says"),
    [
        (canopen.sdo_abort(0x584, 0x1000, 0, AbortCode.NO_OBJECT), "no object"),
        (canopen.sdo_write_reply(4, 0x1000, 0), "command"),
        (canopen.sdo_read_reply(4, 0x1000, 0, b"\x01"), "expected 4 bytes for UNSIGNED32, got 1"),
        (Frame(0x584, bytes.fromhex("41 00 10 00 10 00 00 00")), "command"),
    ],
)
def test_client_names_the_error(reply: Frame, says: str) -> None:
    client = SdoClient(4)
    client.begin(
        [Transfer(0x1000, 0, DataType.UNSIGNED32), Transfer(0x1001, 0, DataType.UNSIGNED8)]
    )
    client.advance(0.0)
    client.receive(reply)
    assert says in client.failure
    assert not client.busy


STATUSWORDS = [
    (0x0000, DriveState.NOT_READY_TO_SWITCH_ON),
    (0x0250, DriveState.SWITCH_ON_DISABLED),
    (0x0270, DriveState.SWITCH_ON_DISABLED),
    (0x0231, DriveState.READY_TO_SWITCH_ON),
    (0x0233, DriveState.SWITCHED_ON),
    (0x1237, DriveState.OPERATION_ENABLED),
    (0x0217, DriveState.QUICK_STOP_ACTIVE),
    (0x021F, DriveState.FAULT_REACTION_ACTIVE),
    (0x023F, DriveState.FAULT_REACTION_ACTIVE),
    (0x0218, DriveState.FAULT),
    (0x0238, DriveState.FAULT),
]


@pytest.mark.parametrize(("word", "state"), STATUSWORDS)
def test_statuswords(word: int, state: DriveState) -> None:
    assert cia402.state_of(word) is state
    assert cia402.state_of(word | 0xFF80 & ~0x0) is state or word & 0x80


def test_a_statusword_that_shows_no_state_is_refused() -> None:
    with pytest.raises(ValueError, match="is not a state"):
        cia402.state_of(0x0002)


CONTROLWORDS = [
    (0x0000, DriveCommand.DISABLE_VOLTAGE),
    (0x000D, DriveCommand.DISABLE_VOLTAGE),
    (0x0002, DriveCommand.QUICK_STOP),
    (0x000B, DriveCommand.QUICK_STOP),
    (0x0006, DriveCommand.SHUTDOWN),
    (0x000E, DriveCommand.SHUTDOWN),
    (0x0007, DriveCommand.SWITCH_ON),
    (0x000F, DriveCommand.ENABLE_OPERATION),
    (0x001F, DriveCommand.ENABLE_OPERATION),
    (0x0080, DriveCommand.FAULT_RESET),
    (0x008F, DriveCommand.FAULT_RESET),
]


@pytest.mark.parametrize(("word", "command"), CONTROLWORDS)
def test_controlwords(word: int, command: DriveCommand) -> None:
    assert cia402.command_of(word) is command


def test_commands_and_controlwords_correspond_one_to_one() -> None:
    assert all(cia402.command_of(word) is not None for word in range(256))
    assert all(cia402.command_of(command.word) is command for command in DriveCommand)


def test_enabling_leads_from_every_resting_state_to_operation() -> None:
    for start in (
        DriveState.SWITCH_ON_DISABLED,
        DriveState.FAULT,
        DriveState.QUICK_STOP_ACTIVE,
        DriveState.SWITCHED_ON,
    ):
        state = start
        limit = Limit("operation", steps=5)
        while state is not DriveState.OPERATION_ENABLED and limit.left():
            state = cia402.after(state, cia402.ENABLING[state])


@pytest.mark.parametrize("command", list(DriveCommand))
def test_only_a_reset_leaves_the_fault_state(command: DriveCommand) -> None:
    expected = (
        DriveState.SWITCH_ON_DISABLED if command is DriveCommand.FAULT_RESET else DriveState.FAULT
    )
    assert cia402.after(DriveState.FAULT, command) is expected


def test_no_state_but_switched_on_and_quick_stop_leads_into_operation() -> None:
    ways = {
        state
        for (state, _), after in cia402.TRANSITIONS.items()
        if after is DriveState.OPERATION_ENABLED
    }
    assert ways == {DriveState.SWITCHED_ON, DriveState.QUICK_STOP_ACTIVE}


@given(st.floats(-600.0, 600.0))
def test_units_resolve_a_micro_radian(angle: float) -> None:
    assert abs(cia402.from_units(cia402.to_units(angle)) - angle) <= 0.5e-6 + 1e-12


def test_faults_have_descriptions() -> None:
    assert cia402.fault_text(0x8611) == "following error too large"
    assert cia402.fault_text(0x1234) == "error code 0x1234"
    assert set(cia402.FAULT_TEXT) == set(cia402.DriveFault)
