"""A simulated controller that speaks KUKAVARPROXY or C3 Bridge."""

from __future__ import annotations

from weldscan.devices.robots.kvp import (
    PROGRAM,
    READ,
    READ_MANY,
    READ_UNICODE,
    WRITE,
    WRITE_MANY,
    WRITE_UNICODE,
    cut_frame,
    decode_request,
    encode_reply,
    framed,
)
from weldscan.errors import InputError
from weldscan.pose import format_e6axis, format_e6pos, format_frame, parse_frame
from weldscan.simulated.controllers import Arm, LinkFault, OutOfReach, TcpController


class KvpController(TcpController):
    """A simulated controller with KUKAVARPROXY or C3 Bridge, our motion program running on it."""

    def __init__(self, arm: Arm | None = None, host: str = "127.0.0.1", port: int = 0, c3: bool = False) -> None:
        self.c3 = c3
        self.variables = {
            "COM_ACTION": "0",
            "COM_TARGET": "",
            "$PRO_NAME1[]": f'"{PROGRAM}"',
            "$PRO_STATE1": "#P_ACTIVE",
        }
        super().__init__(arm, host, port)

    def cut(self, buffer: bytearray) -> bytes | None:
        """Cut one request."""
        return cut_frame(buffer)

    def answer(self, request: bytes, fault: LinkFault | None) -> bytes:
        """Read or write variables."""
        number, function, texts = decode_request(request)
        if fault is LinkFault.WRONG_ID:
            number ^= 0x00FF
        if function in (WRITE, WRITE_UNICODE, WRITE_MANY):
            for name, value in zip(texts[::2], texts[1::2], strict=True):
                self._set(name.upper(), value)
            values: list[str | None] = list(texts[1::2])
        elif function in (READ, READ_UNICODE, READ_MANY):
            values = [self._get(name.upper(), fault) for name in texts]
        else:
            return encode_reply(number, function, [None], ok=False)
        # An unknown variable: C3 Bridge says so, KUKAVARPROXY answers success with nothing in it.
        ok = not (self.c3 and None in values)
        if fault is LinkFault.EMPTY:
            values = [None for _ in values]
        reply = encode_reply(number, function, values, ok=ok)
        if fault is LinkFault.WRONG_LENGTH:
            reply = framed(number, reply[4:] + bytes(7))
        return reply

    def _get(self, name: str, fault: LinkFault | None) -> str | None:
        arm = self.arm
        if name == "COM_ACTION" and not arm.moving and self.variables["$PRO_STATE1"] == "#P_ACTIVE":
            return "0"
        match name:
            case "$POS_ACT":
                text = format_e6pos(arm.position(fault))
                return "{E6POS: X NaN, " + text.split(", ", 1)[1] if fault is LinkFault.NAN else text
            case "$AXIS_ACT":
                return format_e6axis(arm.joints_deg)
            case "$TOOL":
                return format_frame(arm.tool)
            case "$BASE":
                return format_frame(arm.base)
            case "$IPO_MODE":
                return arm.interpolation
            case "$MODE_OP":
                return arm.mode
            case "$ROBNAME[]":
                return '"SIMULATED"'
            case _:
                return self.variables.get(name)

    def _set(self, name: str, value: str) -> None:
        self.variables[name] = value
        # As the program does it: it looks at COM_ACTION when it has arrived, and in T1 alone.
        if name == "COM_ACTION" and value == "1" and self.arm.mode == "#T1" and not self.arm.moving:
            try:
                self.arm.move(parse_frame(self.variables["COM_TARGET"]))
            except (OutOfReach, InputError):  # the controller stops a program that it cannot go on with
                self.variables["$PRO_STATE1"] = "#P_STOP"
