"""A simulated controller that speaks KUKAVARPROXY or C3 Bridge, with `krl/weldscan_kvp.src` running on it."""

from __future__ import annotations

from weldscan.devices.robots import RESPITE_S
from weldscan.devices.robots.kvp import (
    LEASE,
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
from weldscan.devices.robots.program import Status
from weldscan.errors import InputError
from weldscan.pose import format_e6axis, format_e6pos, format_frame, parse_frame, parse_number, parse_whole
from weldscan.simulated.controllers import Arm, LinkFault, TcpController
from weldscan.simulated.controllers.interpreter import Interpreter, Program, Timer
from weldscan.simulated.controllers.program import Driver

NUMBERS = ("COM_ACTION", "COM_GO", "COM_TAKEN", "COM_DONE", "COM_STATUS")


class KvpController(TcpController):
    """A simulated controller with KUKAVARPROXY or C3 Bridge, our motion program running on it.

    `variables["$PRO_STATE1"]` is the start key: at #P_STOP program and arm stand, at #P_ACTIVE they go on.
    """

    def __init__(self, arm: Arm | None = None, host: str = "127.0.0.1", port: int = 0, c3: bool = False) -> None:
        self.c3 = c3
        self.variables = {
            **dict.fromkeys(NUMBERS, "0"),
            "COM_TARGET": "",
            "COM_GOAL": "",
            "$PRO_NAME1[]": f'"{PROGRAM}"',
            "$PRO_STATE1": "#P_ACTIVE",
        }
        self.lease = Timer()
        super().__init__(arm, host, port)
        self.interpreter = Interpreter(
            self.arm, self._program, lambda: self.variables["$PRO_STATE1"] == "#P_ACTIVE" and not self._away.is_set()
        )
        self._driver = Driver(self.arm, self.interpreter)
        self.interpreter.start()

    def close(self) -> None:
        """Stop serving and hang up on everyone."""
        super().close()
        self.interpreter.close()

    def _restarted(self) -> None:
        self.interpreter.reset()

    def cut(self, buffer: bytearray) -> bytes | None:
        """Cut one request."""
        return cut_frame(buffer)

    # --- WELDSCAN_KVP -------------------------------------------------------------------------------------------------

    def _program(self) -> Program:
        for name in NUMBERS:
            self.variables[name] = "0"
        self.lease.set(0)
        yield
        while True:
            while self._number("COM_ACTION") == 0:
                yield
            request = self._number("COM_ACTION")
            self._driver.status = Status.LAPSED
            yield from self._take(request)
            self.lease.set(0)
            self.variables |= {"COM_GO": "0", "COM_TAKEN": "0", "COM_STATUS": str(int(self._driver.status))}
            self.variables["COM_DONE"] = str(request)
            if self._number("COM_ACTION") == request:
                self.variables["COM_ACTION"] = "0"
            yield

    def _take(self, request: int) -> Program:
        goal = self.variables["COM_GOAL"] = self.variables["COM_TARGET"]
        try:
            if not self._driver.look(parse_frame(goal)):
                return
        except InputError:
            self._driver.status = Status.GARBLED
            return
        self._driver.status = Status.LAPSED
        self.variables["COM_GO"] = "0"
        self.lease.set(-1000 * RESPITE_S)
        self.variables["COM_TAKEN"] = str(request)
        while not (self._number("COM_GO") == request or self._number("COM_ACTION") != request or self.lease.flag):
            yield
        if self._number("COM_GO") == request == self._number("COM_ACTION"):
            yield from self._driver.drive(lambda: self.lease.flag)

    def _number(self, name: str) -> int:
        try:
            return parse_whole(self.variables[name])
        except InputError:
            return 0

    # --- KUKAVARPROXY -------------------------------------------------------------------------------------------------

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
            case "$TIMER[16]":
                return str(round(self.lease.milliseconds))
            case "$IPO_MODE":
                return arm.interpolation
            case "$MODE_OP":
                return arm.mode
            case "$ROBNAME[]":
                return '"SIMULATED"'
            case _:
                return self.variables.get(name)

    def _set(self, name: str, value: str) -> None:
        if name == LEASE:
            self.lease.set(parse_number(value))
        else:
            self.variables[name] = value
